"""Evidence that a plant's equations stand for all functions of given samples: what both checkers derive again.

The equations are those that `certify fit` has written, so that little is searched for here: the weights of samples that
bound slopes at the origin. All else is compared, so that a file which was changed is refused before a search.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from math import prod
from typing import Any

from certify.analysis.fitting.grid import enclosed
from certify.analysis.fitting.linear import Sampling, least_square
from certify.analysis.fitting.polynomial import Bound, Polynomial, errors
from certify.analysis.fitting.samples import bounds_of, require_within
from certify.certificates.samples import SampleBounds, Standing, Weights
from certify.errors import InputError
from certify.loop.expressions import to_tree
from certify.loop.plants import Samples, System, Unknown

Powers = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Equation:
    """An equation P + r E that stands for an unknown function.

    Parameters
    ----------
    unknown : the function.
    P : coefficients by the powers of variables and slopes.
    E : of the variables.
    """

    unknown: Unknown
    P: Mapping[Powers, Fraction]
    E: Bound

    def refused(self, wanted: str) -> InputError:
        return _other(self.unknown, wanted)


def standing_for(system: System, samples: Samples) -> SampleBounds:
    """The evidence for the equations of all unknown functions.

    Raises
    ------
    InputError : an equation is not as `certify fit` writes it, a range or a bound does not hold all that the samples
        leave, or the domain or the input bounds reach beyond the box.
    """
    return tuple(_standing(system, samples, one) for one in samples.unknowns)


def _standing(system: System, samples: Samples, one: Unknown) -> Standing:
    taken, noise = samples.taken[one.state], samples.noise[one.state]
    require_within(system, one, noise)
    fixed = next((name for name in (one.error, *one.slopes) if name and name not in system.ranges), None)
    if fixed is not None:
        raise InputError(f"{fixed} must have a range, as certify fit writes it; found one value.")
    sampling = Sampling(one, taken, noise)
    found = _equation(system, one)
    if one.error is not None and not (system.ranges[one.error][0] <= -1 and system.ranges[one.error][1] >= 1):
        raise InputError(f"the range of {one.error} must hold [-1, 1], as certify fit writes it.")
    if one.slopes:
        return Standing((), _of_slopes(system, found, sampling))
    p = Polynomial(one.variables, (Fraction(1),) * len(one.variables), tuple(found.P), tuple(found.P.values()))
    grid = enclosed(sampling, samples.near_origin)
    if any(e > found.E.least(cell) for cell, e in errors(p, one, grid).items()):
        raise found.refused("a bound [residual] that holds all that the samples allow")
    return Standing(grid.axes, tuple((each.lower, each.upper) for each in grid.bounds.values()))


def _of_slopes(system: System, found: Equation, sampling: Sampling) -> tuple[tuple[Weights, Weights], ...]:
    """The weights of samples that show the ranges of the slopes at the origin."""
    one, d = found.unknown, len(found.unknown.slopes)
    if {tuple(int(i % d == j) for i in range(2 * d)): Fraction(1) for j in range(d)} != found.P:
        raise found.refused("the sum of slopes times variables")
    sizes = [max(abs(lo), abs(hi)) for lo, hi in (bounds_of(system)[name] for name in one.variables)]
    if found.E.constant or any(k < q for k, q in zip(found.E.rise, least_square(one, sizes), strict=True)):
        raise found.refused("a bound [residual] that holds what second derivatives allow beyond the linear part")
    weights = list[tuple[Weights, Weights]]()
    for name, slope in zip(one.slopes, sampling.slopes(), strict=True):
        lo, hi = system.ranges[name]
        if not lo <= slope.lo <= slope.hi <= hi:
            raise InputError(
                f"the range of {name} must hold all that the samples leave, [{float(slope.lo):.9g}, "
                f"{float(slope.hi):.9g}]; found [{float(lo):.9g}, {float(hi):.9g}]. certify fit writes such ranges."
            )
        weights.append((slope.lower, slope.upper))
    return tuple(weights)


def _other(one: Unknown, wanted: str) -> InputError:
    return InputError(f"the equation of {one.state} must have {wanted}, as certify fit writes it for these samples.")


def _equation(system: System, one: Unknown) -> Equation:
    """The equation in its parts, expanded."""
    from sympy import QQ
    from sympy.polys.rings import ring

    d, error, own = len(one.variables), one.error, one.slopes
    names = [*one.variables, *own, *([] if error is None else [error])]
    R, *symbols = ring(names, QQ)
    tree = to_tree(system.uncertain_dynamics()[[s.name for s in system.states].index(one.state)])
    P, E = dict[Powers, Fraction](), dict[Powers, Fraction]()
    for powers, c in _expanded(tree, dict(zip(names, symbols, strict=True)), R, one).terms():
        exact = Fraction(int(c.numerator), int(c.denominator))
        if error is None or not powers[-1]:
            P[powers[: d + len(own)]] = exact
        elif powers[-1] == 1 and not any(powers[d:-1]):
            E[powers[:d]] = exact
        else:
            raise _other(one, "one residual, times a bound of the variables alone")
    constant, squares = (0,) * d, [tuple(2 * (i == j) for i in range(d)) for j in range(d)]
    if not {*E} <= {constant, *squares} or min(E.values(), default=Fraction(0)) < 0:
        raise _other(one, "a bound [residual] of a number and squares of variables")
    bound = Bound(one.variables, E.get(constant, Fraction(0)), tuple(E.get(k, Fraction(0)) for k in squares))
    return Equation(one, P, bound)


def _expanded(tree: Any, names: Mapping[str, Any], R: Any, one: Unknown) -> Any:
    """An equation as a polynomial of a ring."""
    if isinstance(tree, str):
        if tree in names:
            return names[tree]
        if tree.isidentifier():
            raise _other(one, f"its own variables alone, and not {tree},")
        q = Fraction(tree)
        return R(R.domain(q.numerator, q.denominator))
    operator, *rest = tree
    if operator == "**" and rest[1] > 0:
        return _expanded(rest[0], names, R, one) ** rest[1]
    if operator not in ("+", "-", "*", "/"):
        raise _other(one, "a polynomial")
    first, *others = (_expanded(each, names, R, one) for each in rest)
    if operator == "-":
        return first - others[0] if others else -first
    if operator == "/" and others[0].is_ground and others[0]:
        return first / others[0].LC
    if operator == "+":
        return sum(others, first)
    if operator == "/":
        raise _other(one, "a polynomial")
    return prod(others, start=first)
