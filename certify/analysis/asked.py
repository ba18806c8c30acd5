"""Requests in a plant's own terms: boxes and states by the states' names, and the reasons to refuse them.

A run asks here before it begins; nothing here is part of a proof.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.analysis.options import Place, RoaOptions, interval
from certify.certificates.ellipsoids import Box
from certify.errors import InputError, OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.constraints import not_kept_at_origin
from certify.loop.plants import System, kept_constraints
from certify.loop.plants.constraints import in_words

Array = NDArray[np.float64]


def require_one_that_knows(system: System, options: RoaOptions) -> None:
    """Refuse a solver of formulas and a tube along a path, which need exact equations, if something has a range, and
    with tubes around the origin, which need Vdot, if time has steps.

    Raises
    ------
    InputError : the option, and what has a range or goes in steps.
    """
    if options.claim == "invariant":
        raise OptionError(
            "`claim` invariant must be asked alone: of `certify roa` for one policy, in Python of "
            "`certify.analysis.staying.certify_invariant`."
        )
    if options.lyapunov is None and options.lyapunov_level is not None:
        raise OptionError("`lyapunov_level` must be the level of a function; give one as `lyapunov`.")
    if options.goes_beyond and system.in_steps:
        raise InputError(
            "a set beyond the ellipsoid must be of a plant in continuous time whose input follows the state at once; "
            f"the time of {system.name} goes in steps. Ask for the set without it."
        )
    if system.constraints and options.engine != "bounds":
        raise OptionError(
            "`engine` must be bounds where constraints are to be kept: dReal is not asked about them; found "
            f"{', '.join(system.constraints)} in {system.name}. Use the engine bounds, or leave the constraints out "
            "(in the plant's file the table [constraints])."
        )
    if options.engine == "bounds" and not options.enlarges:
        return
    if system.in_steps:
        what = "a tube" if options.enlarges else "dReal's question"
        found = "its time is discrete" if system.time == "discrete" else "its input is held over a period"
        instead = "ask for the set with the engine bounds, and --ranks for what leads into it"
        if options.reach_from is not None:
            instead = "name what is to be reached with --target: a region, or the certificate of a set (certify roa)"
        raise InputError(
            f"{what} must be about a plant in continuous time whose input follows the state at once; of {system.name} "
            f"{found}. In steps {instead}."
        )
    if not system.ranges:
        return
    found = f"found ranges of {', '.join(system.ranges)} in {system.name}"
    if options.reach_from is not None:
        raise InputError(
            f"a tube around a path must be of exact equations: there is no such claim yet for what is uncertain; "
            f"{found}. Ask for the set with --enlarge, or leave the ranges out (of a disturbance in the plant's file: "
            "the half-width 0)."
        )
    if options.engine == "bounds":
        return
    raise OptionError(
        f"`engine` must be bounds where something is uncertain: dReal is asked about exact equations; {found}. Use the "
        "engine bounds, or leave the ranges out."
    )


def require_kept_at_origin(loop: ClosedLoop) -> None:
    """Refuse a constraint that does not hold where V is 0.

    Raises
    ------
    InputError : it does not, at some corner of the ranges of what is uncertain.
    """
    found = not_kept_at_origin(loop)
    if found is None:
        return
    name, value = found
    g = constraints_in_words(loop.system)[name]
    at = zip(loop.system.states, loop.system.exact_x_eq(), strict=True)
    raise InputError(
        f"the constraint {name}, {g}, must hold where V is 0, at {', '.join(f'{s} = {float(q):g}' for s, q in at)}; "
        f"its left side is {value:.4g} there, and every set around that point would violate it."
    )


def constraints_in_words(system: System) -> dict[str, str]:
    """The inequalities that a claim keeps by name, over the states' values, as in `p - 1.5 < 0`."""
    return in_words(replace(system, constraints=kept_constraints(system)))


def ellipsoid_in(system: System, box: Mapping[str, float] | None = None) -> Array:
    """P (n, n) of the ellipsoid {x'Px <= 1} with these half-axes; default: the nearer sides of the domain.

    Raises
    ------
    InputError : the box has no state, or one that the plant has not.
    """
    names = [s.name for s in system.states]
    sides = {n: min(-float(lo), float(hi)) for n, (lo, hi) in zip(names, system.domain, strict=True)}
    box = sides if box is None else box
    if not box or not box.keys() <= sides.keys():
        raise OptionError(
            f"`box` must name states of {system.name}, {', '.join(names)}; found {', '.join(box) or 'none'}."
        )
    least = min(width / sides[name] for name, width in box.items())
    return np.diag([float(box.get(name, least * sides[name])) ** -2 for name in names])


def box_in(system: System, values: Mapping[str, Place]) -> Box:
    """A state or a box by the states' values, as deviations from the operating point, at which states without a value
    are.

    Raises
    ------
    InputError : it names what is no state, or does not lie in the interior of the domain.
    """
    names, at = [s.name for s in system.states], system.exact_x_eq()
    if not values or not values.keys() <= set(names):
        raise OptionError(
            f"`reach_from` must name states of {system.name}, {', '.join(names)}; found {', '.join(values) or 'none'}."
        )
    box = tuple(
        (Fraction(lo) - q, Fraction(hi) - q)
        for (lo, hi), q in ((interval(values.get(name, q)), q) for name, q in zip(names, at, strict=True))
    )
    for name, q, ends, (lo, hi) in zip(names, at, box, system.domain, strict=True):
        for v in ends:
            if not lo < v < hi:
                raise OptionError(
                    f"`reach_from` must lie in the interior of the domain, {name} between {float(lo + q):g} and "
                    f"{float(hi + q):g}; found {float(v + q):g}."
                )
    return box


def values_of(system: System, box: Box) -> Box:
    """A box of the states' values from one of deviations from the operating point."""
    return tuple((q + lo, q + hi) for q, (lo, hi) in zip(system.exact_x_eq(), box, strict=True))


def ellipsoid_around(system: System, box: Box) -> Array | None:
    """P (n, n) of an ellipsoid {x'Px <= 1} that holds a box moved to 0, with axes along the states; None for a state.

    Along states that have an interval it is the smallest, along others as wide as `ellipsoid_in` makes it.
    """
    wide = {s.name: float(hi - lo) / 2 for s, (lo, hi) in zip(system.states, box, strict=True) if lo < hi}
    return ellipsoid_in(system, {name: math.sqrt(len(wide)) * r for name, r in wide.items()}) if wide else None
