"""Networks on leaves, between affine forms.

The weights meet several leaves at a time: an affine step is one product of matrices of balls whose columns are the
centres and the half-widths of all leaves of a batch, and one of magnitudes for their errors. What is left to Python is
a few operations for each entry of a `map` on each leaf.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property

from flint import arb, arb_mat

from .balls import ONE, ZERO, lesser, norm, total
from .expressions import Call
from .lines import Line, clipped
from .networks import Affine, Clip, Concat, Map, Observe, Product, Sum, paired
from .refusal import Refused
from .table import FUNCTIONS
from .taylor import Taylor, constant

Form = tuple[arb, list[arb], arb]  # mid + slopes.d within an error
Rows = list[list[arb]]  # for each entry of a vector a number for each leaf


class Forms:
    """A vector on some leaves: `rows` has for each entry the constant and the coefficients on each leaf.

    An entry differs from its form by at most a fresh error and an old one; None stands for none. `length` bounds the
    2-norm of all that is old. `gaps` are errors that arise at this vector, all others come from vectors of which it is
    made: `ways` has these, and what a matrix of numbers with which this vector reaches something is for each of them.
    """

    def __init__(
        self, rows: Rows, fresh: Rows | None = None, old: Rows | None = None, gaps: Rows | None = None
    ) -> None:
        self.rows, self.fresh, self.old, self.gaps = rows, fresh, old, gaps
        self.ways: list[tuple[Forms, Callable[[Rows], Rows]]] = []
        self.measured: Callable[[], list[arb]] = lambda: []

    @cached_property
    def length(self) -> list[arb]:
        """For each leaf, where there is an old error."""
        return self.measured()

    @cached_property
    def error(self) -> Rows | None:
        return both(self.fresh, self.old)

    def lengths(self, count: int) -> list[arb]:
        """Bounds of the 2-norms of all errors."""
        old = self.length if self.old is not None else [ZERO] * count
        if self.fresh is None:
            return old
        return [v + norm(fresh) for v, fresh in zip(old, by_leaf(self.fresh), strict=True)]


class OnBoxes:
    """Networks between affine forms on `count` leaves, on each of which `undefined` tells whether something may be."""

    def __init__(self, count: int) -> None:
        self.count, self.made, self.undefined = count, list[Forms](), set[int]()

    def given(self, rows: Rows, errors: Rows | None = None) -> Forms:
        """The vector that a network reads."""
        return self.vector(Forms(rows, errors, gaps=errors))

    def vector(self, v: Forms, *ways: tuple[Forms, Callable[[Rows], Rows]]) -> Forms:
        v.ways = [(source, way) for source, way in ways if source.error is not None]
        self.made.append(v)
        return v

    def stride(self, v: Forms) -> int:
        return len(v.rows[0]) // self.count

    # --------------------------------------------------------------------------------------------------- the steps

    def affine(self, step: Affine, v: Forms) -> Forms:
        W, stride = step.W, self.stride(v)
        rows = (W * arb_mat(v.rows)).tolist()
        for row, bias in zip(rows, step.b, strict=True):
            row[::stride] = [x + bias for x in row[::stride]]
        result = Forms(rows, old=self.through(step, v))
        result.measured = lambda: [step.norm * x for x in v.lengths(self.count)]
        return self.vector(result, (v, lambda ways: (W.transpose() * arb_mat(ways)).tolist()))

    def through(self, step: Affine, v: Forms) -> Rows | None:
        """The errors behind the weights, old ones through magnitudes or the norm of a row, whichever is less."""
        if v.old is None:
            return None if v.fresh is None else (step.magnitudes * arb_mat(v.fresh)).tolist()
        if v.fresh is None:
            through: list[tuple[list[arb], list[arb]]] = [
                ([], row) for row in (step.magnitudes * arb_mat(v.old)).tolist()
            ]
        else:
            each = step.magnitudes * arb_mat([f + o for f, o in zip(v.fresh, v.old, strict=True)])
            through = [(row[: self.count], row[self.count :]) for row in each.tolist()]
        result = Rows()
        for (fresh, old), length in zip(through, step.row_norms, strict=True):
            row = [lesser(o, length * x) for o, x in zip(old, v.length, strict=True)]
            result.append([f + o for f, o in zip(fresh, row, strict=True)] if fresh else row)
        return result

    def map(self, step: Map, v: Forms) -> Forms:
        return self.relaxed(v, [step.function] * step.size)

    def clip(self, step: Clip, v: Forms) -> Forms:
        return self.relaxed(v, [(arb(lo), arb(hi)) for lo, hi in zip(step.lo, step.hi, strict=True)])

    def relaxed(self, v: Forms, kinds: Sequence[str | tuple[arb, arb]]) -> Forms:
        """Each entry's function between two lines on the range of the entry; a clip has its two ends for a name."""
        rows, slopes, gaps, stride = Rows(), Rows(), Rows(), self.stride(v)
        for row, kind, taken in zip(v.rows, kinds, self.ranges(v), strict=True):
            entries, steep, apart = list[arb](), list[arb](), list[arb]()
            for b, (middle, reach) in enumerate(taken):
                slope, shift, gap = self.line(kind, middle, reach, b)
                entries.append(slope * middle + shift)
                entries += [slope * x for x in row[b * stride + 1 : (b + 1) * stride]]
                steep.append(slope)
                apart.append(gap)
            rows.append(entries)
            slopes.append(steep)
            gaps.append(apart)
        both_rows = zip(slopes, v.error or [], strict=v.error is not None)
        old = v.error and [[abs(s) * e for s, e in zip(*each, strict=True)] for each in both_rows]
        result = Forms(rows, gaps, old, gaps)

        def measured() -> list[arb]:
            each = zip(v.lengths(self.count), by_leaf(slopes), by_leaf(old or []), strict=True)
            return [lesser(max_of([abs(s) for s in steep]) * x, norm(after)) for x, steep, after in each]

        result.measured = measured
        return self.vector(result, (v, lambda ways: scaled(ways, slopes)))

    def line(self, kind: str | tuple[arb, arb], middle: arb, reach: arb, leaf: int) -> Line:
        if not isinstance(kind, str):
            return clipped(middle - reach, middle + reach, *kind)
        result = FUNCTIONS[kind].line(middle, reach)
        if result is None:
            self.undefined.add(leaf)
            return ZERO, ZERO, arb("nan")
        return result

    def sum(self, step: Sum, *vectors: Forms) -> Forms:
        rows, fresh, old = vectors[0].rows, vectors[0].fresh, vectors[0].old
        for v in vectors[1:]:
            rows, fresh, old = both(rows, v.rows) or [], both(fresh, v.fresh), both(old, v.old)
        result = Forms(rows, fresh, old)
        result.measured = lambda: [total(each) for each in zip(*(v.length for v in vectors if v.old), strict=True)]
        return self.vector(result, *((v, lambda ways: ways) for v in vectors))

    def concat(self, step: Concat, *vectors: Forms) -> Forms:
        fresh, old = (self.stacked([part(v) for v in vectors], vectors) for part in (fresh_of, old_of))
        result = Forms([row for v in vectors for row in v.rows], fresh, old)
        result.measured = lambda: [norm(each) for each in zip(*(v.length for v in vectors if v.old), strict=True)]
        ways, start = list[tuple[Forms, Callable[[Rows], Rows]]](), 0
        for v in vectors:
            ways.append((v, part_of(start, start + len(v.rows))))
            start += len(v.rows)
        return self.vector(result, *ways)

    def product(self, step: Product, v: Forms, w: Forms) -> Forms:
        """(c + X)(e + Y) = c e + c Y + e X + X Y on each leaf: the errors of X and Y count e and c times."""
        rows, gaps = multiplied(v, w, self.count, self.stride(v))
        factors = [(u, [row[:: self.stride(u)] for row in by.rows]) for u, by in ((v, w), (w, v))]
        old = both(*(passed(u.error, by, step.size) for u, by in factors))
        result = Forms(rows, gaps, old, gaps)
        result.measured = lambda: [
            lesser(total(each), norm(after))
            for *each, after in zip(
                *(lengthened(u, by, self.count) for u, by in factors), by_leaf(old or []), strict=True
            )
        ]
        return self.vector(result, *((u, returning(by, len(u.rows), step.size)) for u, by in factors))

    def stacked(self, parts: Sequence[Rows | None], vectors: Sequence[Forms]) -> Rows | None:
        if all(part is None for part in parts):
            return None
        each = zip(parts, vectors, strict=True)
        return [row for part, v in each for row in (part or [[ZERO] * self.count] * len(v.rows))]

    def observe(self, step: Observe, v: Forms) -> Forms:
        """The expressions of models of the entries, on one leaf after the other."""
        forms, gaps = (Rows([] for _ in range(step.size)) for _ in range(2))
        errors, stride = v.error or [[ZERO] * self.count] * len(v.rows), self.stride(v)
        for b in range(self.count):
            each = zip(step.names, v.rows, errors, strict=True)
            names = {name: model_of(row[b * stride : (b + 1) * stride], error[b]) for name, row, error in each}
            try:
                results: list[Taylor] = step.expressions.evaluate(names, constant)
            except Refused:
                self.undefined.add(b)
                results = [Taylor(ZERO, r=arb("nan"))] * step.size
            for f, row, gap in zip(results, forms, gaps, strict=True):
                row += [f.c, *f.slopes(stride - 1)]
                gap.append(f.second + f.r)
        return self.vector(Forms(forms, gaps, gaps=gaps))

    def shifted(self, v: Forms, shifts: Iterable[arb]) -> Forms:
        """v and a number more in each entry."""
        rows, stride = [list(row) for row in v.rows], self.stride(v)
        for row, shift in zip(rows, shifts, strict=True):
            row[::stride] = [x + shift for x in row[::stride]]
        result = Forms(rows, v.fresh, v.old)
        result.measured = lambda: v.length
        return self.vector(result, (v, lambda ways: ways))

    # ------------------------------------------------------------------------------------------------- the results

    def ranges(self, v: Forms) -> list[list[tuple[arb, arb]]]:
        """For each entry its middle and its reach on each leaf."""
        stride, result = self.stride(v), list[list[tuple[arb, arb]]]()
        for row, errors in zip(v.rows, v.error or [[ZERO] * self.count] * len(v.rows), strict=True):
            each = [(row[b * stride : (b + 1) * stride], error) for b, error in enumerate(errors)]
            result.append([(middle, sum(map(abs, slopes), error)) for (middle, *slopes), error in each])
        return result

    def forms(self, v: Forms, wanted: Sequence[int]) -> list[list[Form]]:
        """Some entries of a vector, each on each leaf."""
        stride, nan = self.stride(v), arb("nan")
        result = []
        for i, errors in zip(wanted, self.errors(v, wanted), strict=True):
            each = []
            for b, error in enumerate(errors):
                mid, *slopes = v.rows[i][b * stride : (b + 1) * stride]
                each.append((nan, slopes, nan) if b in self.undefined else (mid, slopes, error))
            result.append(each)
        return result

    def errors(self, v: Forms, wanted: Sequence[int]) -> Rows:
        """Each gap times the magnitude of the number with which it reaches an entry, over all vectors before."""
        count, m = self.count, len(wanted)
        errors = [[ZERO] * count for _ in wanted]
        at_last = [[ONE if i == j else ZERO for j in wanted for _ in range(count)] for i in range(len(v.rows))]
        ways = {id(v): at_last}  # for each entry that to the first that is wanted on all leaves, to the second, ...
        for vector in reversed(self.made):
            way = ways.pop(id(vector), None)
            if way is None:
                continue
            for row, gap in zip(way, vector.gaps or [], strict=vector.gaps is not None):
                for j in range(m):
                    part = row[j * count : (j + 1) * count]
                    errors[j] = [e + abs(w) * g for e, w, g in zip(errors[j], part, gap, strict=True)]
            for source, back in vector.ways:
                more = back(way)
                ways[id(source)] = both(ways.get(id(source)), more) or []
        return errors


def called(call: Call, given: Sequence[Taylor], symbols: int, first: int) -> list[Taylor]:
    """Entries of a call on a leaf, each with a symbol of its own; that of the first is number `first`."""
    algebra = OnBoxes(1)
    rows = [[v.c, *v.slopes(symbols)] for v in given]
    value = call.network.run(algebra, algebra.given(rows, [[v.second + v.r] for v in given]))
    result = []
    for k, ((mid, slopes, error),) in enumerate(algebra.forms(value, call.entries), first + call.place):
        slopes[k] += error
        result.append(Taylor(mid, arb_mat(1, symbols, slopes)))
    return result


def multiplied(v: Forms, w: Forms, count: int, stride: int) -> tuple[Rows, Rows]:
    """Forms of products of the entries, and their gaps."""
    rows, gaps, nothing = Rows(), Rows(), [ZERO] * count
    wrong = paired(*(u.error or [nothing] * len(u.rows) for u in (v, w)))
    for (row, other), doubts in zip(paired(v.rows, w.rows), wrong, strict=True):
        entries, apart = list[arb](), list[arb]()
        for b, (of_X, of_Y) in enumerate(zip(*doubts, strict=True)):
            c, *X = row[b * stride : (b + 1) * stride]
            e, *Y = other[b * stride : (b + 1) * stride]
            least, most = moved_together(X, of_X, Y, of_Y, v is w)
            entries.append(c * e + (most - least) / 2)
            entries += [e * x + c * y for x, y in zip(X, Y, strict=True)]
            apart.append((most + least) / 2)
        rows.append(entries)
        gaps.append(apart)
    return rows, gaps


def lengthened(v: Forms, factors: Rows, count: int) -> list[arb]:
    """On each leaf a bound of the 2-norm of factors times the errors of v; a single entry has all factors."""
    each = zip(v.lengths(count), by_leaf(factors), strict=True)
    return [x * (norm(by) if len(v.rows) == 1 else max_of([abs(f) for f in by])) for x, by in each]


def moved_together(X: list[arb], of_X: arb, Y: list[arb], of_Y: arb, same: bool) -> tuple[arb, arb]:
    """(l, u) with -l <= x y <= u where x and y are within errors of forms without a constant; or the same number.

    x y is p/4 times the difference of the squares of x + y/p and x - y/p; and never beyond the sizes' product.
    """
    x, y = total(map(abs, X)) + of_X, total(map(abs, Y)) + of_Y
    if same:
        return ZERO, x * x
    p = (y / x).mid() if x > 0 and y > 0 else ZERO
    if not (p.is_finite() and p > 0):
        return x * y, x * y
    errors = of_X + of_Y / p
    down = total(abs(a - b / p) for a, b in zip(X, Y, strict=True)) + errors
    up = total(abs(a + b / p) for a, b in zip(X, Y, strict=True)) + errors
    return lesser(p * down * down / 4, x * y), lesser(p * up * up / 4, x * y)


def passed(errors: Rows | None, factors: Rows, size: int) -> Rows | None:
    """Errors times the magnitudes of factors, for so many entries."""
    if errors is None:
        return None
    each = list(paired(errors, factors))
    found = [[e * abs(f) for e, f in zip(*pair, strict=True)] for pair in each]
    return found * (size // len(found))


def returning(factors: Rows, count: int, size: int) -> Callable[[Rows], Rows]:
    """The way back to a vector of so many entries that has these factors; one alone is reached from all entries."""

    def back(ways: Rows) -> Rows:
        found = scaled(ways, factors * (size // len(factors)))
        return found if count == size else [[total(column) for column in zip(*found, strict=True)]]

    return back


def model_of(form: list[arb], error: arb) -> Taylor:
    c, *g = form
    return Taylor(c, arb_mat(1, len(g), g), r=error)


def fresh_of(v: Forms) -> Rows | None:
    return v.fresh


def old_of(v: Forms) -> Rows | None:
    return v.old


def part_of(start: int, end: int) -> Callable[[Rows], Rows]:
    return lambda ways: ways[start:end]


def both(a: Rows | None, b: Rows | None) -> Rows | None:
    """The sum of two of equal shape; None is 0."""
    if a is None or b is None:
        return b if a is None else a
    return [[x + y for x, y in zip(*each, strict=True)] for each in zip(a, b, strict=True)]


def scaled(ways: Rows, slopes: Rows) -> Rows:
    result = Rows()
    for way, steep in zip(ways, slopes, strict=True):
        result.append([w * s for w, s in zip(way, steep * (len(way) // len(steep)), strict=True)])
    return result


def by_leaf(rows: Rows) -> Rows:
    return [list(column) for column in zip(*rows, strict=True)]


def max_of(values: Sequence[arb]) -> arb:
    """A number at or above all of them."""
    result = values[0]
    for v in values[1:]:
        if not v <= result:
            result = v if v >= result else result.max(v)
    return arb(result.upper())


def clip(y: Form, lo: arb, hi: arb) -> Form:
    """min(max(y, lo), hi) of an affine form."""
    mid, coefficients, error = y
    reach = total(abs(v) for v in coefficients) + error
    slope, shift, gap = clipped(mid - reach, mid + reach, lo, hi)
    return slope * mid + shift, [slope * v for v in coefficients], slope * error + gap
