"""Fold a file's steps into the form of a proof: a network, then squash, scale, offset and a clip.

Affine steps that follow each other become one layer, whose numbers are computed exactly, in rationals, and rounded once
to the nearest binary64; where a normaliser divides by the square root of a rational that is no square, the number is
enclosed in Arb until both ends of the enclosure round to the same binary64. So the policy that is proved is the folded
one, and it differs from the file's real-number policy by at most half a unit in the last place of each weight, bias,
scale and offset; the ends of a clip are rounded inwards. A layer that stands alone keeps its numbers as they are.

A clip of the observation is inactive on a box of states, which is returned with the network: inside the box the folded
policy is the real one. With `keep_clips` the clip is a step of the network instead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import flint
import numpy as np

from certify.errors import InputError
from certify.loop import networks
from certify.loop.expressions import Symbol, sqrt
from certify.loop.networks import Network
from certify.loop.policies.importers.steps import (
    Activate,
    Affine,
    Branches,
    Clip,
    Diagonal,
    InverseRoot,
    Normalise,
    Step,
    Tanh,
    nearest,
    spread,
)
from certify.loop.policies.network import Array, Centre, Squash

Bounds = tuple[Fraction | None, Fraction | None]
_BITS = (128, 512, 2048, 8192)
_ROOT_BITS = 128
_NO_BOUNDS: Bounds = (None, None)
_JOINED = {"sum": networks.Sum, "concat": networks.Concat, "product": networks.Product}
_V = Symbol("v")


@dataclass(frozen=True, slots=True)
class Folded:
    """The numbers of a policy `clip(scale * squash(net(o)) + offset)`, and the box without clipped observations.

    Parameters
    ----------
    network : net, which reads the n observations.
    scale, offset : shape (m,).
    squash : `tanh` or `identity`.
    clip : (lo, hi), shapes (m,), or None.
    inactive : for each observation the exact bounds within which no clip of it acts, rounded inwards where they are no
        rationals; None for a side without a bound.
    """

    network: Network
    scale: Array
    offset: Array
    squash: Squash
    clip: tuple[Array, Array] | None
    inactive: tuple[Bounds, ...]


def fold(steps: Sequence[Step], n: int, keep_clips: bool = False, centre: Centre = "none") -> Folded:
    """Fold the steps from n observations to the action, which is centred so before its clip.

    Raises
    ------
    InputError : their shapes do not chain, there is no layer, or an action has no bounds where it is clipped.
    """
    inner = [k for k, step in enumerate(steps) if isinstance(step, Affine | Activate | Branches)]
    if not inner:
        raise InputError("a policy must have a layer; the file has none.")
    ends = [k for k, step in enumerate(steps) if isinstance(step, Tanh) and k > inner[-1]]
    body, tail = steps[: ends[-1] if ends else inner[-1] + 1], steps[ends[-1] + 1 if ends else inner[-1] + 1 :]
    squash: Squash = "tanh" if ends else "identity"
    clips = [step for step in tail if isinstance(step, Clip)]
    if not ends and clips and any(all(None in getattr(clip, side) for clip in clips) for side in ("lo", "hi")):
        body, tail = steps, ()
    program = _Program(n)
    inactive = program.begin(body, n, keep_clips)
    network = Network(n, tuple(program.steps))
    scale, offset, clip = _tail(tail, network.gives, squash == "tanh" and centre != "output")
    return Folded(network, scale, offset, squash, clip, tuple(inactive))


class _Program:
    """The steps of a network, made one after the other; `sizes` are those of its vectors."""

    def __init__(self, n: int) -> None:
        self.steps: list[networks.Step] = []
        self.sizes = [n]

    def begin(self, chain: Sequence[Step], n: int, keep_clips: bool) -> list[Bounds]:
        """The whole chain, whose first steps are those of a normaliser; the bounds within which no clip acts."""
        first = next((k for k, s in enumerate(chain) if not isinstance(s, Diagonal | Normalise | Clip)), len(chain))
        front, rest = chain[:first], chain[first:]
        if keep_clips:
            front = [part for step in front for part in _apart(step)]
            last = max((k for k, step in enumerate(front) if isinstance(step, Clip)), default=-1)
            number = self._front(front[: last + 1])
            self.follow((*front[last + 1 :], *rest), number)
            return [_NO_BOUNDS] * n
        head, bounds = _head(front, n)
        run = next((k for k, step in enumerate(rest) if not isinstance(step, Affine | Diagonal)), len(rest))
        if run:
            number = self._affine(0, *_layer(head, rest[:run], n))
        else:
            number = 0 if head.is_nothing else self._affine(0, *_behind(head, _matrix(np.eye(n)), [Fraction(0)] * n))
        self.follow(rest[run:], number)
        return bounds

    def _front(self, steps: Sequence[Step]) -> int:
        """A normaliser with its clips, which stay."""
        number, done = 0, 0
        for k, step in enumerate(steps):
            if isinstance(step, Clip):
                n = self.sizes[number]
                head, _ = _head(steps[done:k], n)
                if not head.is_nothing:
                    number = self._affine(number, *_behind(head, _matrix(np.eye(n)), [Fraction(0)] * n))
                number, done = self._clip(step, number), k + 1
        return number

    def follow(self, chain: Sequence[Step], number: int) -> int:
        """The steps of a chain that begins with vector `number`; the number of its result."""
        k = 0
        while k < len(chain):
            run = next((j for j in range(k, len(chain)) if not isinstance(chain[j], Affine | Diagonal)), len(chain))
            if run > k:
                number, k = self._affine(number, *_layer(None, chain[k:run], self.sizes[number])), run
                continue
            step = chain[k]
            match step:
                case Tanh():
                    number = self._then(networks.Map((number,), "tanh"))
                case Activate():
                    number = self._then(networks.Map((number,), step.function))
                case Clip():
                    number = self._clip(step, number)
                case Branches():
                    ends = tuple(self.follow(branch, number) for branch in step.of)
                    number = self._then(_JOINED[step.kind](ends))
                case InverseRoot():
                    number = self._then(networks.Observe((number,), (_V,), (1 / sqrt(_V),)))
                case _:
                    raise InputError("a normaliser must read the observation itself.")
            k += 1
        return number

    def _affine(self, number: int, weight: Array, bias: Array) -> int:
        return self._then(networks.Affine((number,), weight, bias))

    def _clip(self, step: Clip, number: int) -> int:
        """A clip, also of one side: max(h, lo) is relu(h - lo) + lo."""
        width = self.sizes[number]
        lo, hi = spread(step.lo, width), spread(step.hi, width)
        if None not in lo and None not in hi:
            if not any(lo):  # relu6: the corner at 0, where an equilibrium may lie, is relu's
                number, lo = self._then(networks.Map((number,), "relu")), tuple(-v for v in hi if v is not None)
            ends = (_numbers([v for v in end if v is not None]) for end in (lo, hi))
            return self._then(networks.Clip((number,), *ends))
        for end, sign in ((lo, 1), (hi, -1)):
            if all(v is None for v in end):
                continue
            if None in end:
                raise InputError("a clip between layers must have a bound for every component, or for none.")
            at = _numbers([v for v in end if v is not None])
            eye = sign * np.eye(width)
            if sign < 0 or np.any(at):
                number = self._affine(number, eye, -sign * at)
            number = self._then(networks.Map((number,), "relu"))
            if sign < 0 or np.any(at):
                number = self._affine(number, eye, at)
        return number

    def _then(self, step: networks.Step) -> int:
        self.steps.append(step)
        self.sizes.append(step.size([self.sizes[i] for i in step.of]))
        return len(self.steps)


def _apart(step: Step) -> tuple[Step, ...]:
    """A normaliser's clip as a step of its own."""
    if not isinstance(step, Normalise) or step.limit is None:
        return (step,)
    return (Normalise(step.mean, step.square), Clip((-step.limit,), (step.limit,)))


@dataclass(frozen=True, slots=True)
class _Head:
    """The map before the first layer: `o -> factor * (o - mean) / sqrt(square) + offset`, componentwise."""

    factor: tuple[Fraction, ...]
    mean: tuple[Fraction, ...]
    square: tuple[Fraction, ...]
    offset: tuple[Fraction, ...]

    @property
    def is_nothing(self) -> bool:
        return all(v == 1 for v in (*self.factor, *self.square)) and not any((*self.mean, *self.offset))


def _head(steps: Sequence[Step], n: int) -> tuple[_Head, list[Bounds]]:
    zero, one = (Fraction(0),) * n, (Fraction(1),) * n
    head, bounds = _Head(one, zero, one, zero), [_NO_BOUNDS] * n
    for step in steps:
        match step:
            case Diagonal():
                scale, offset = spread(step.scale, n), spread(step.offset, n)
                head = _Head(
                    tuple(s * f for s, f in zip(scale, head.factor, strict=True)),
                    head.mean,
                    head.square,
                    tuple(s * o + t for s, o, t in zip(scale, head.offset, offset, strict=True)),
                )
            case Normalise():
                # Before it there may be shifts only, such as that of the operating point.
                if any(v != 1 for v in (*head.factor, *head.square)) or any(b != _NO_BOUNDS for b in bounds):
                    raise InputError("a normaliser must read the observation itself.")
                before = head.offset
                mean = tuple(m - t for m, t in zip(spread(step.mean, n), before, strict=True))
                head = _Head(one, mean, spread(step.square, n), zero)
                if step.limit is not None:
                    bounds = [_preimage(head, i, (-step.limit, step.limit), _NO_BOUNDS) for i in range(n)]
            case Clip():
                limits = zip(spread(step.lo, n), spread(step.hi, n), strict=True)
                bounds = [_preimage(head, i, limit, bounds[i]) for i, limit in enumerate(limits)]
            case _:
                raise InputError("a normaliser must read the observation itself.")
    return head, bounds


def _preimage(head: _Head, i: int, limit: Bounds, known: Bounds) -> Bounds:
    """The observations i that `head` takes into `limit`, within `known`; rounded inwards where they are irrational."""
    factor, ends = head.factor[i], list[Fraction | None]()
    if factor == 0:
        raise InputError("an observation that is multiplied by 0 must not be clipped.")
    for side, value in enumerate(limit if factor > 0 else limit[::-1]):
        if value is None:
            ends.append(known[side])
            continue
        distance = (value - head.offset[i]) / factor
        square = distance**2 * head.square[i]
        root = _root(square)
        if root is None:
            # A larger lower end and a smaller upper end are inside.
            up = (side == 0) == (distance > 0)
            root = _root_towards(square, up)
        end = head.mean[i] + (root if distance > 0 else -root)
        ends.append(_larger(known[0], end) if side == 0 else _smaller(known[1], end))
    lo, hi = ends
    if lo is not None and hi is not None and not lo < hi:
        raise InputError("the clips of the observation leave no states on which none of them acts.")
    return lo, hi


def _larger(a: Fraction | None, b: Fraction | None) -> Fraction | None:
    return b if a is None else a if b is None else max(a, b)


def _smaller(a: Fraction | None, b: Fraction | None) -> Fraction | None:
    return b if a is None else a if b is None else min(a, b)


def _root(square: Fraction) -> Fraction | None:
    """The square root of a rational if it is one."""
    up, down = math.isqrt(square.numerator), math.isqrt(square.denominator)
    return Fraction(up, down) if up * up == square.numerator and down * down == square.denominator else None


def _root_towards(square: Fraction, up: bool) -> Fraction:
    """A rational above (or below) the square root of a rational that is no square, at most 2^-128 from it."""
    scaled = square.numerator * square.denominator << 2 * _ROOT_BITS
    return Fraction(math.isqrt(scaled) + up, square.denominator << _ROOT_BITS)


def _layer(head: _Head | None, segment: Sequence[Step], width: int) -> tuple[Array, Array]:
    """One layer from all affine steps of a segment, and from `head` before them."""
    if len(segment) == 1 and isinstance(segment[0], Affine) and (head is None or head.is_nothing):
        _require_width(segment[0].weight, width)
        return segment[0].weight, segment[0].bias
    weight, bias = _product(segment, width)
    if head is None:
        head = _Head(*((Fraction(v),) * width for v in (1, 0, 1, 0)))
    return _behind(head, weight, bias)


def _product(segment: Sequence[Step], width: int) -> tuple[flint.fmpq_mat, list[Fraction]]:
    """The exact weight and bias of affine steps that follow each other."""
    weight: flint.fmpq_mat | None = None
    scale, bias = [Fraction(1)] * width, [Fraction(0)] * width  # a diagonal, as long as there is no weight
    for step in segment:
        if isinstance(step, Affine):
            _require_width(step.weight, len(bias))
            matrix = _matrix(step.weight)
            shifted = matrix * _column(bias)
            out = matrix.nrows()
            bias = [_fraction(shifted[i, 0]) + Fraction(float(step.bias[i])) for i in range(out)]
            diagonal = flint.fmpq_mat(width, width, [0] * width**2) if weight is None else None
            if diagonal is not None:
                for i, s in enumerate(scale):
                    diagonal[i, i] = _rational(s)
            weight = matrix * (weight if diagonal is None else diagonal)
        elif isinstance(step, Diagonal):
            scales, offsets = spread(step.scale, len(bias)), spread(step.offset, len(bias))
            bias = [s * b + o for s, b, o in zip(scales, bias, offsets, strict=True)]
            if weight is None:
                scale = [s * t for s, t in zip(scales, scale, strict=True)]
            else:
                rows = range(weight.nrows())
                entries = [_rational(scales[i]) * weight[i, j] for i in rows for j in range(weight.ncols())]
                weight = flint.fmpq_mat(weight.nrows(), weight.ncols(), entries)
    if weight is None:
        weight = flint.fmpq_mat(width, width, [0] * width**2)
        for i, s in enumerate(scale):
            weight[i, i] = _rational(s)
    return weight, bias


def _behind(head: _Head, weight: flint.fmpq_mat, bias: list[Fraction]) -> tuple[Array, Array]:
    """The layer behind a normaliser, each number of it rounded once."""
    rows, columns = weight.nrows(), weight.ncols()
    roots = [_root(q) for q in head.square]
    out, shift = np.empty((rows, columns)), np.empty(rows)
    for i in range(rows):
        entries = [_fraction(weight[i, j]) * head.factor[j] for j in range(columns)]
        rest = bias[i] + sum(
            (_fraction(weight[i, j]) * head.offset[j] for j in range(columns)), start=Fraction(0)
        )  # fmt: skip
        odd = []
        for j, (entry, root) in enumerate(zip(entries, roots, strict=True)):
            if root is not None:
                out[i, j] = nearest(entry / root)
                rest -= entry * head.mean[j] / root
            else:
                out[i, j] = _rounded(Fraction(0), [(entry, head.square[j])])
                odd.append((-entry * head.mean[j], head.square[j]))
        shift[i] = _rounded(rest, odd)
    return out, shift


def _rounded(rest: Fraction, terms: list[tuple[Fraction, Fraction]]) -> float:
    """`rest + sum of a / sqrt(q)` over the terms (a, q), rounded once to the nearest binary64."""
    terms = [(a, q) for a, q in terms if a != 0]
    if not terms:
        return nearest(rest)
    lo = hi = 0.0
    for bits in _BITS:
        with flint.ctx.workprec(bits):
            total = flint.arb(_rational(rest))
            for a, q in terms:
                total += flint.arb(_rational(a)) / flint.arb(_rational(q)).sqrt()
            lo, hi = nearest(_end(total.lower())), nearest(_end(total.upper()))
        if lo == hi:
            return lo
    # Terms that cancel exactly, or to the middle of two numbers: nothing separates the ends, which are neighbours.
    return lo


def _end(value: flint.arb) -> Fraction:
    mantissa, exponent = value.mid().man_exp()
    return Fraction(int(mantissa)) * Fraction(2) ** int(exponent)


def _tail(steps: Sequence[Step], width: int, ranged: bool) -> tuple[Array, Array, tuple[Array, Array] | None]:
    """Scale, offset and clip; `ranged` says that the action lies in offset +- scale, as it does behind a tanh unless it
    is centred after that."""
    scale, offset = [Fraction(1)] * width, [Fraction(0)] * width
    lows: list[Fraction | None] = [None] * width
    highs: list[Fraction | None] = [None] * width
    for step in steps:
        match step:
            case Diagonal():
                for i, (s, o) in enumerate(zip(spread(step.scale, width), spread(step.offset, width), strict=True)):
                    if s == 0:
                        raise InputError(f"the scale of an action must not be 0; that of input {i} is.")
                    scale[i], offset[i] = s * scale[i], s * offset[i] + o
                    ends = [None if v is None else s * v + o for v in (lows[i], highs[i])]
                    lows[i], highs[i] = ends if s > 0 else ends[::-1]
            case Clip():
                for i, (lo, hi) in enumerate(zip(spread(step.lo, width), spread(step.hi, width), strict=True)):
                    lows[i] = _larger(lows[i], lo)
                    highs[i] = _smaller(highs[i], hi)
            case _:
                raise InputError("after the last layer there may be a tanh, a scale, an offset and a clip only.")
    return _numbers(scale), _numbers(offset), _clip(scale, offset, lows, highs, ranged)


def _clip(
    scale: list[Fraction],
    offset: list[Fraction],
    lows: list[Fraction | None],
    highs: list[Fraction | None],
    ranged: bool,
) -> tuple[Array, Array] | None:
    """The clip of the action, with the squash's own range where a side has none; None if none of it can act."""
    if all(v is None for v in (*lows, *highs)):
        return None
    acts = False
    for i in range(len(scale)):
        if ranged:
            least, most = offset[i] - abs(scale[i]), offset[i] + abs(scale[i])
            lo, hi = lows[i], highs[i]
            acts = acts or (lo is not None and lo > least) or (hi is not None and hi < most)
            lows[i], highs[i] = least if lo is None else lo, most if hi is None else hi
        else:
            acts = True
        if lows[i] is None or highs[i] is None:
            raise InputError(
                f"a clip of an action without a tanh must have two bounds; that of input {i} has one "
                "(ReLU at the output is such a clip)."
            )
    if not acts:
        return None
    ends = [_inside(lo, hi) for lo, hi in zip(lows, highs, strict=True) if lo is not None and hi is not None]
    lo_hi = (np.array([lo for lo, _ in ends]), np.array([hi for _, hi in ends]))
    for i, (a, b) in enumerate(zip(*lo_hi, strict=True)):
        if not a < b:
            raise InputError(f"the clips of input {i} leave nothing between them; found [{a}, {b}].")
    return lo_hi


def _inside(lo: Fraction, hi: Fraction) -> tuple[float, float]:
    """The largest interval of binary64 in [lo, hi]: an input that is clipped at its bound 2/5 may not reach 0.4."""
    low, high = nearest(lo), nearest(hi)
    return (
        low if Fraction(low) >= lo else math.nextafter(low, math.inf),
        high if Fraction(high) <= hi else math.nextafter(high, -math.inf),
    )


def _require_width(weight: Array, width: int) -> None:
    if weight.shape[1] != width:
        raise InputError(f"a layer must take {width} numbers; its weight has shape {weight.shape}.")


def _numbers(values: Sequence[Fraction]) -> Array:
    return np.array([nearest(v) for v in values])


def _matrix(array: Array) -> flint.fmpq_mat:
    return flint.fmpq_mat(*array.shape, [flint.fmpq(*float(v).as_integer_ratio()) for v in array.ravel()])


def _column(values: Sequence[Fraction]) -> flint.fmpq_mat:
    return flint.fmpq_mat(len(values), 1, [_rational(v) for v in values])


def _rational(q: Fraction) -> flint.fmpq:
    return flint.fmpq(q.numerator, q.denominator)


def _fraction(q: flint.fmpq) -> Fraction:
    return Fraction(int(q.p), int(q.q))
