"""States drawn from the set of a certificate, and the policy's nonlinearity there: in floats, no part of a proof."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from certify.certificates import AnyCertificate, Certificate
from certify.certificates.ellipsoids import Ellipsoid
from certify.certificates.membership import Region, region_of
from certify.errors import CertifyError
from certify.loop.expressions import Number, jumping, nodes, substitute
from certify.loop.plants import System
from certify.loop.policies.nonlinearity import Nonlinearity, nonlinearity

Array = NDArray[np.float64]
STATES = 1000
"""States drawn for the nonlinearity, the same in every call."""
_DRAWS, _LEAST = 20_000, 100  # from a box around the set, of which so many must lie in it


def nonlinearity_of(read: AnyCertificate) -> Nonlinearity | None:
    """The policy's nonlinearity on the set of a certificate; None where floats cannot tell.

    The states are uniform in the tube's start, or in {V <= c2}; with an outer set or ranks in the whole set. Claims
    without V need no equilibrium: their linear part is a fit. Where inputs are scores of actions nothing is said: with
    scores that are near others may be the largest.
    """
    system = read.system
    if _are_scores(system):
        return None
    try:
        with np.errstate(all="ignore"):
            states = states_in(region_of(read), _box_of(read))
            if states is None or not np.all(np.isfinite(states)):
                return None
            u_eq = system.exact_u_eq()
            return nonlinearity(read.network, u_eq, states, fitted=not isinstance(read, Certificate))
    except (CertifyError, ValueError, ArithmeticError):  # a rejected file need not make sense
        return None


def _are_scores(system: System) -> bool:
    """True if the inputs decide nothing but how the equations jump."""
    jumps = dict.fromkeys(jumping(*system.dynamics), Number(0))
    others = set(nodes(*(substitute(expression, jumps) for expression in system.dynamics)))
    return bool(jumps) and others.isdisjoint(system.inputs)


def states_in(region: Region, box: tuple[Array, Array]) -> Array | None:
    """States (N, n) of a region, uniform in its last ellipsoid or, if it is more than ellipsoids, in the part of it
    that lies in a box; None if too few of those that are drawn do."""
    generator = np.random.default_rng(0)
    if region.outer is not None or region.ranked is not None:
        x = generator.uniform(*box, (_DRAWS, region.n))
        with np.errstate(all="ignore"):
            x = x[region.holds_in_floats(x)][:STATES]
        if len(x) >= _LEAST:
            return np.asarray(x)
    return _in_ellipsoid(region.ellipsoids[-1], generator) if region.ellipsoids else None


def _in_ellipsoid(ellipsoid: Ellipsoid, generator: np.random.Generator) -> Array:
    n = len(ellipsoid.P)
    direction = generator.standard_normal((STATES, n))
    radius = np.sqrt(ellipsoid.level) * generator.uniform(size=(STATES, 1)) ** (1 / n)
    z = radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    lower = np.linalg.cholesky((ellipsoid.P + ellipsoid.P.T) / 2)
    x = np.linalg.solve(lower.T, z.T).T
    return np.asarray(x + np.array(ellipsoid.centre) if ellipsoid.centre else x)


def _box_of(read: AnyCertificate) -> tuple[Array, Array]:
    """The box of ranks, or the domain."""
    ranked = region_of(read).ranked
    if ranked is not None:
        return ranked.tree.lo, ranked.tree.hi
    lo, hi = np.array([[float(end) for end in pair] for pair in read.system.domain]).T
    return lo, hi
