"""A query written so that dReal's own simplification has nothing to round.

dReal merges constants before it solves: it adds the coefficients of like terms, multiplies constant factors and divides
constants, all in plain binary64, and takes the rounded result for the number that was meant. `x/10 + x/5 - 3x/10 <= 0`
on [1, 2] comes out unsatisfiable, though it holds everywhere. Intervals enter only afterwards. So nothing is left to
merge:

- Constants are folded here, in rationals. Every expression is a sum `c_0 + sum c_i T_i` whose terms T_i are products of
  *atoms*: states, values of functions, inverses, and sums that stand as factors. Like terms are one term.
- A coefficient that binary64 holds is written as a number. Any other becomes a variable of its own between the two
  neighbouring binary64 numbers; so does a product of coefficients that would need more digits.
- What depends on no state, such as the network at the origin, is enclosed in Arb and becomes one variable a sum.
- A sum that stands as a factor is a definition, and where it would stand alone it is multiplied by a variable in
  [1, 1]: dReal then sees a product, which it neither flattens into the sum around it nor takes for a constant.
- The terms of each sum are shown to be different expressions and no constants, whatever the solver knows about + - * /
  and equal arguments: their values at two points of a finite field differ, where functions are hashes of their
  arguments. Terms that are not told apart get coefficients that are variables, or 1 and -1.

The variables relax the query by units in the last place, so "unsatisfiable" remains a proof. Bounds on a single state
are rounded outwards.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import flint

from certify.certificates.claims.queries import Query
from certify.errors import InputError
from certify.loop.expressions import Tree
from certify.loop.rigorous import ball
from certify.provers.dreal.field import Residues, hashed, inverted, residue
from certify.provers.dreal.sums import Monomial, Sum, add, atom_of, constant, scaled, times

_PRECISION = 200  # bits
_KNOWN = {  # f(a) = b, exactly
    "sin": (0, 0),
    "tan": (0, 0),
    "tanh": (0, 0),
    "cos": (0, 1),
    "exp": (0, 1),
    "atan": (0, 0),
    "sqrt": (1, 1),
    "log": (1, 0),
}
_OF_TWO = ("min", "max")


@dataclass(frozen=True, slots=True)
class Formula:
    """`variables` (name, lo, hi) in binary64, the states first; `stands_for` says what the others enclose.

    `definitions` are names with trees, each over what comes before it; every number in a tree is binary64. The
    constraints hold together.
    """

    name: str
    variables: tuple[tuple[str, float, float], ...]
    stands_for: Mapping[str, str]
    definitions: tuple[tuple[str, Tree], ...]
    constraints: tuple[tuple[Tree, str, Tree], ...]


def formula(query: Query) -> Formula:
    """The query without anything that could be rounded.

    Raises
    ------
    InputError : a number beyond binary64, a division by zero, or an operator that is not known.
    """
    before, flint.ctx.prec = flint.ctx.prec, _PRECISION
    try:
        return _formula(query)
    finally:
        flint.ctx.prec = before


def _formula(query: Query) -> Formula:
    writer = _Writer()
    values: dict[str, Sum] = {}
    states = []
    for name, lo, hi in query.variables:
        states.append((name, _below(lo), _above(hi)))
        writer.residues.declare(name)
        values[name] = atom_of(name)
    for name, tree in query.definitions:
        values[name] = writer.read(tree, values)
    names = {name for name, _, _ in states}
    constraints = []
    for left, relation, right in query.constraints:
        difference = add(writer.read(left, values), writer.read(right, values), -1)
        constraints.append(_bound(difference, relation, names) or (writer.write(difference), relation, "0"))
    variables = (*states, *((pin.name, pin.lo, pin.hi) for pin in writer.pins.values()))
    stands_for = {pin.name: pin.what for pin in writer.pins.values()}
    return Formula(query.name, variables, stands_for, tuple(writer.definitions), tuple(constraints))


def _bound(difference: Sum, relation: str, states: set[str]) -> tuple[Tree, str, Tree] | None:
    """`c x + d` against 0 as a bound on the state x, rounded outwards and never strict; None for anything else."""
    terms = [m for m in difference if m != ()]
    if len(terms) != 1 or len(terms[0]) != 1 or terms[0][0][1] != 1 or terms[0][0][0] not in states:
        return None
    c = difference[terms[0]]
    end = -difference.get((), Fraction(0)) / c
    if (relation[0] == ">") == (c > 0):
        return terms[0][0][0], ">=", str(Fraction(_below(end)))
    return terms[0][0][0], "<=", str(Fraction(_above(end)))


@dataclass(frozen=True, slots=True)
class _Pin:
    """A variable that encloses one real number."""

    name: str
    lo: float
    hi: float
    what: str


class _Writer:
    """Reads trees as sums over atoms, and writes sums as trees over numbers of binary64, atoms and variables."""

    def __init__(self) -> None:
        self.definitions: list[tuple[str, Tree]] = []
        self.pins: dict[object, _Pin] = {}
        self._atoms: dict[object, str] = {}
        self._sums: set[str] = set()  # atoms that are sums
        self._balls: dict[str, flint.arb] = {}  # atoms that depend on no state
        self.residues = Residues()

    def read(self, tree: Tree, values: Mapping[str, Sum]) -> Sum:
        """The exact value of a tree over sums that are known."""
        if isinstance(tree, str):
            return values[tree] if tree in values else constant(Fraction(tree))
        operator, *rest = tree
        if operator == "**":
            return self.power(self.read(rest[0], values), int(rest[1]))
        parts = [self.read(part, values) for part in rest]
        if operator == "-" and len(parts) == 1:
            return scaled(parts[0], Fraction(-1))
        if operator in ("+", "-"):
            result = parts[0]
            for part in parts[1:]:
                result = add(result, part, 1 if operator == "+" else -1)
            return result
        if operator in ("*", "/"):
            result = parts[0]
            for part in parts[1:]:
                result = self.product(result, part if operator == "*" else self.inverse(part))
            return result
        if operator in _KNOWN and len(parts) == 1:
            return self.function(operator, parts[0])
        if operator in _OF_TWO and len(parts) == 2:
            return self.extreme(operator, parts[0], parts[1])
        allowed = " ".join((*_KNOWN, *_OF_TWO))
        raise InputError(f"{operator!r} is no operator of a query; allowed are + - * / ** {allowed}.")

    def product(self, a: Sum, b: Sum) -> Sum:
        """A constant times a sum is distributed as long as binary64 holds the coefficients."""
        if not a or not b:
            return {}
        for number, other in ((a, b), (b, a)):
            if set(number) == {()} and (len(other) == 1 or all(_held(number[()] * c) for c in other.values())):
                return scaled(other, number[()])
        (m, c), (k, d) = self.factor(a), self.factor(b)
        return {times(m, k): c * d}

    def power(self, base: Sum, exponent: int) -> Sum:
        """An integer power."""
        if exponent < 0:
            return self.inverse(self.power(base, -exponent))
        if exponent == 0:
            return constant(Fraction(1))
        if not base:
            return {}
        monomial, c = self.factor(base)
        return {tuple((atom, k * exponent) for atom, k in monomial): c**exponent}

    def inverse(self, value: Sum) -> Sum:
        """1 / value, an atom unless the value is a constant."""
        if not value:
            raise InputError("a query divides by zero.")
        monomial, c = self.factor(value)
        if monomial == ():
            return constant(1 / c)
        if self.fixed(monomial):
            ball = 1 / self.ball({monomial: Fraction(1)})
            return {((self.constant(("/", monomial), ball), 1),): 1 / c}
        first, second = self.residues.of(monomial)
        if first == second:  # perhaps a constant, by which dReal would divide
            monomial = times(monomial, ((self.one(), 1),))
        residues = [inverted(r) for r in self.residues.of(monomial)]
        name = self.atom(("/", monomial), lambda: ["/", "1", self.factors(monomial)], residues)
        return {((name, 1),): 1 / c}

    def function(self, name: str, argument: Sum) -> Sum:
        """An atom, unless the value is known exactly."""
        at, result = _KNOWN[name]
        if argument == constant(Fraction(at)):
            return constant(Fraction(result))
        key = (name, frozenset(argument.items()))
        if all(self.fixed(m) for m in argument):
            return atom_of(self.constant(key, getattr(self.ball(argument), name)()))
        residues = [hashed(name, r) for r in self.residues.of_sum(argument)]
        return atom_of(self.atom(key, lambda: [name, self.write(argument)], residues))

    def extreme(self, name: str, a: Sum, b: Sum) -> Sum:
        """An atom `min` or `max` of two sums, unless both are constants."""
        key = (name, frozenset(a.items()), frozenset(b.items()))
        if all(self.fixed(m) for value in (a, b) for m in value):
            return atom_of(self.constant(key, getattr(self.ball(a), name)(self.ball(b))))
        first, second = zip(self.residues.of_sum(a), self.residues.of_sum(b), strict=True)
        residues = [hashed(f"{name} {v}", w) for v, w in (first, second)]
        return atom_of(self.atom(key, lambda: [name, self.write(a), self.write(b)], residues))

    def factor(self, value: Sum) -> tuple[Monomial, Fraction]:
        """A sum as one monomial and its coefficient; with several terms it becomes an atom."""
        if len(value) == 1:
            ((monomial, c),) = value.items()
            return monomial, c
        name = self.atom(("+", frozenset(value.items())), lambda: self.write(value), self.residues.of_sum(value))
        self._sums.add(name)
        return ((name, 1),), Fraction(1)

    def fixed(self, monomial: Monomial) -> bool:
        """True if it depends on no state."""
        return all(atom in self._balls for atom, _ in monomial)

    def ball(self, value: Sum) -> flint.arb:
        """An enclosure of what depends on no state."""
        total = flint.arb(0)
        for monomial, c in value.items():
            term = ball(c)
            for atom, k in monomial:
                for _ in range(k):
                    term *= self._balls[atom]
            total += term
        return total

    def constant(self, key: object, enclosure: flint.arb) -> str:
        """The name of what depends on no state."""
        if key not in self._atoms:
            if not enclosure.is_finite():
                raise InputError("a query has a constant that is not a finite number.")
            name = f"k.{len(self._atoms)}"
            self._atoms[key], self._balls[name] = name, enclosure
            self.residues.declare(name)
        return self._atoms[key]

    def atom(self, key: object, tree: Callable[[], Tree], residues: Sequence[int]) -> str:
        """The name of a term that is the same each time."""
        if key not in self._atoms:
            written = tree()
            name = f"t.{len(self._atoms)}"
            self._atoms[key] = name
            self.residues.set(name, residues)
            self.definitions.append((name, written))
        return self._atoms[key]

    def write(self, value: Sum) -> Tree:
        """A tree that holds a variable, and no two numbers that could meet."""
        known = {m: c for m, c in value.items() if self.fixed(m)}
        if set(known) <= {()}:
            parts = dict(value)
        else:
            parts = dict(atom_of(self.enclosed(known)))
            parts |= {m: c for m, c in value.items() if m not in known}
        if set(parts) <= {()}:
            return ["*", self.number(parts.get((), Fraction(0))), self.one()]
        residues = [self.residues.of(m) for m in parts]
        constants = sum(first == second for first, second in residues)
        apart = len(set(residues)) == len(residues) and constants == (1 if () in parts else 0)
        terms: list[Tree] = []
        for monomial, c in parts.items():
            number = self.number(c) if apart else self.pin(c)
            if monomial == ():
                terms.append(number)
            elif abs(c) == 1:
                alone = len(monomial) == 1 and monomial[0][1] == 1 and monomial[0][0] in self._sums
                term = self.factors(monomial + (((self.one(), 1),) if alone else ()))
                terms.append(term if c == 1 else ["-", term])
            else:
                terms.append(["*", number, self.factors(monomial)])
        written = terms[0] if len(terms) == 1 else ["+", *terms]
        return written if apart else ["*", written, self.one()]

    def factors(self, monomial: Monomial) -> Tree:
        """A product of atoms; those that depend on no state are variables here."""
        names = [self.enclosed(atom_of(atom)) if atom in self._balls else atom for atom, _ in monomial]
        powers: list[Tree] = [name if k == 1 else ["**", name, k] for name, (_, k) in zip(names, monomial, strict=True)]
        return powers[0] if len(powers) == 1 else ["*", *powers]

    def number(self, q: Fraction) -> str:
        """The number itself where binary64 holds it, or else the variable that stands for it."""
        return str(q) if _held(q) else self.pin(q)

    def pin(self, q: Fraction) -> str:
        """The variable that stands for a rational."""
        return self._pinned(q, _below(q), _above(q), str(q), (residue(q), residue(q)))

    def one(self) -> str:
        """The variable that stands for 1 and keeps a sum a product."""
        return self.pin(Fraction(1))

    def enclosed(self, value: Sum) -> str:
        """The variable that stands for what depends on no state."""
        enclosure = self.ball(value)
        lo, hi = _below(_exact(enclosure.lower())), _above(_exact(enclosure.upper()))
        what = f"a constant near {float(enclosure.mid()):.17g}"
        return self._pinned(frozenset(value.items()), lo, hi, what, self.residues.of_sum(value))

    def _pinned(self, key: object, lo: float, hi: float, what: str, residues: tuple[int, int]) -> str:
        if key not in self.pins:
            name = f"c.{len(self.pins)}"
            self.pins[key] = _Pin(name, lo, hi, what)
            self.residues.set(name, residues)
        return self.pins[key].name


def _exact(value: flint.arb) -> Fraction:
    """The number that a ball of radius zero is."""
    mantissa, exponent = value.man_exp()
    return Fraction(int(mantissa)) * Fraction(2) ** int(exponent)


def _nearest(q: Fraction) -> float:
    try:
        return float(q)
    except OverflowError:
        raise InputError("a query has a number beyond binary64.") from None


def _held(q: Fraction) -> bool:
    return Fraction(_nearest(q)) == q


def _below(q: Fraction) -> float:
    """The largest binary64 number that is not above q."""
    v = _nearest(q)
    return v if Fraction(v) <= q else math.nextafter(v, -math.inf)


def _above(q: Fraction) -> float:
    """The smallest binary64 number that is not below q."""
    v = _nearest(q)
    return v if Fraction(v) >= q else math.nextafter(v, math.inf)
