"""A proved set beside simulated states: it must be about the same closed loop, and some of the states lie in it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certify.certificates.membership import ProvedSet
from certify.errors import InputError
from certify.loop.expressions import Expression, gathered
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Covered:
    """The number of initial states in the set that a certificate proves, each of them decided in rationals.

    `claim` is the kind of claim that it makes about them, `certificate_sha256` the file's.
    """

    inside: int
    states: int
    claim: str
    certificate_sha256: str


def count_covered(proved: ProvedSet, network: PolicyNetwork, system: System, x0: Array) -> Covered:
    """Count the states (N, n), deviations from x_eq, in a set that is proved about this very closed loop.

    Raises
    ------
    InputError : as `require_same_loop`.
    """
    require_same_loop(proved, network, system)
    inside = sum(proved.holds(proved.deviations(x0.tolist())))
    return Covered(inside, len(x0), proved.claim, proved.certificate_sha256)


def require_same_loop(proved: ProvedSet, network: PolicyNetwork, system: System) -> None:
    """Refuse a set that is proved about another closed loop.

    Raises
    ------
    InputError : the certificate is about another policy, about other equations, or about less of what is uncertain.
    """
    if proved.policy_sha256 != network.sha256():
        raise InputError(
            f"the certificate must be about the policy that is evaluated, {network.sha256()}; it is about "
            f"{proved.policy_sha256}. Certify this one with `certify roa`."
        )
    theirs = proved.system
    for name, (lo, hi) in system.ranges.items():
        known = theirs.ranges.get(name)
        if known is None or not known[0] <= lo <= hi <= known[1]:
            said = "one value of it" if known is None else f"[{float(known[0]):g}, {float(known[1]):g}]"
            raise InputError(
                f"the certificate must hold for all that is uncertain of {system.name}, `{name}` in [{float(lo):g}, "
                f"{float(hi):g}]; it is about {said}. Certify the policy on this plant."
            )
    alike = (theirs.states, theirs.inputs, theirs.time) == (system.states, system.inputs, system.time)
    mine = proved.seen_from_there(system) if alike else system
    equal = _dynamics(theirs, system.ranges) == _dynamics(mine, system.ranges)
    if not alike or not equal or theirs.exact_u_eq() != mine.exact_u_eq():
        raise InputError(
            f"the certificate must be about the plant that is simulated, {system.name} with these parameters; it is "
            f"about {theirs.name} with other equations. Certify the policy on this plant."
        )


def require_same_question(proved: ProvedSet, network: PolicyNetwork, system: System) -> None:
    """Refuse a set that is proved about another closed loop, or about this one as it no longer is.

    Raises
    ------
    InputError : as `require_same_loop`; or domain, bounds of the inputs, what is uncertain, or how long inputs are held
        were others.
    """
    require_same_loop(proved, network, system)
    seen = proved.seen_from_there(system)
    for name in ("domain", "input_bounds", "ranges", "sample"):
        theirs, mine = getattr(proved.system, name), getattr(seen, name)
        if theirs != mine:
            raise InputError(
                f"the certificate must be about {system.name} as it is; its `{name}` was another one. Certify the "
                "policy on this plant."
            )


def _dynamics(system: System, acting: Iterable[str]) -> tuple[Expression, ...]:
    """The equations with these uncertain quantities free, all others at their nominal values, and constants gathered:
    an input with an error of 0 is the input."""
    still = {name: None for name in system.ranges if name not in set(acting)}
    return tuple(map(gathered, system.with_ranges(still).uncertain_dynamics()))
