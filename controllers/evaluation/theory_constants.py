"""The constants on which the paper's theory rests, for one policy: proved where that is affordable.

Two questions. *Does the discount keep stability?* Let q(x) = x'Q_r x be what a step takes from the reward, and V(x) the
discounted sum of q along the closed loop. If V <= a_V q, then V falls along the loop for every discount above
gamma* = 1 - 1/a_V, since V(x+) - V(x) = ((1 - gamma) V(x) - q(x)) / gamma. a_V is to serve every discount, so it is
that of the sum without one; for the discount that was used the sum with it will do.

*May the gain be off?* Training makes ||J_mu(0) + K|| small, never zero. epsilon_K is a size up to which that difference
cannot matter: for every matrix D with ||D|| <= epsilon_K in the spectral norm the linear loop with the Jacobian -K + D
is asymptotically stable.

Both are matrix inequalities. Their solutions are found in floats and count for nothing until the inequality itself
holds in Arb balls, for the plant's nominal equations, which are exact, the policy's numbers and the very float that
is given. A constant about more than the linear part is a largest value over simulations, and called estimated.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Literal

import flint
import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from certify.certificates.membership import ProvedSet
from certify.errors import InputError, OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System
from certify.loop.policies import Policy
from certify.loop.rigorous import gain_at_origin, held_at_origin, is_definite, plant_at_origin, precision, rounded_up
from controllers.evaluation.proved_set import require_same_loop
from controllers.evaluation.record import recorded
from controllers.options import Plant
from controllers.plants.choice import plant_of
from controllers.simulation.closed_loop import held_loop
from controllers.simulation.trajectories import initial_states, mean_action

Array = NDArray[np.float64]
How = Literal["proved", "estimated", "recorded"]


Relation = Literal["<=", ">=", "="]


_SLACK = 1e-6  # by which an inequality is solved more strictly than it is asked, relative


_DOUBLINGS, _HALVINGS = 60, 10  # steps of the search for a largest epsilon: 0.1 % at the end


@dataclass(frozen=True, slots=True)
class Constant:
    """One number of the theory.

    Parameters
    ----------
    value : None where there is no such number; `by` then says why.
    relation : of the true constant to `value`, a bound from above, a bound from below, or the number itself.
    by : how it was found, in a few words.
    """

    name: str
    value: float | None
    relation: Relation
    how: How
    by: str

    def __post_init__(self) -> None:
        if self.value is not None and not math.isfinite(self.value):
            raise InputError(f"`{self.name}` must be finite or None; found {self.value}.")
        if (self.relation == "=") != (self.how == "recorded"):
            raise InputError(f"`{self.name}` is a bound exactly if it is not read from the record.")


@dataclass(frozen=True, slots=True)
class Theory:
    """The constants of one policy, by name in the order in which they are shown."""

    system: str
    sha256: str
    constants: tuple[Constant, ...]

    def __getitem__(self, name: str) -> Constant:
        return next(constant for constant in self.constants if constant.name == name)

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        constants = {
            c.name: {"value": c.value, "relation": c.relation, "how": c.how, "by": c.by} for c in self.constants
        }
        return {"system": self.system, "policy": {"sha256": self.sha256}, "constants": constants}


def theory(
    policy: Policy,
    chosen: tuple[System, Plant] | None = None,
    proved: ProvedSet | None = None,
    states: int = 200,
    seed: int = 0,
    duration: float = 20.0,
) -> Theory:
    """The constants of `policy` on the plant that it names, or on the `chosen` one; with what a certificate's P allows.

    Parameters
    ----------
    states, seed : initial states of the estimate of a_V, uniform in the plant's box.
    duration : seconds over which their costs are summed up.

    Raises
    ------
    InputError : the plant is not in continuous time, or does not rest at the origin under this policy; the record
        lacks `dt`, `gamma` or `reward_weights`; or `proved` is about another loop.
    """
    if states < 1 or not 0 < duration < math.inf:
        raise OptionError(f"`states` and `duration` must be positive and finite; found {states} and {duration}.")
    system, plant = plant_of(policy, chosen)
    if system.time != "continuous":
        raise InputError(
            f"{system.name} must be in continuous time, because the constants are about an action that is held over "
            "`dt`; it is in discrete time. Use `controllers evaluate` and `certify roa`, which take such a plant."
        )
    loop = ClosedLoop(system, policy.network)
    loop.require_rest()
    dt, gamma = recorded(policy, "dt", ()), recorded(policy, "gamma", ())
    Q = np.asarray(recorded(policy, "reward_weights", (system.n,)))
    if not dt > 0 or not 0 <= gamma < 1:
        raise InputError(f"`training.dt` must be positive and `training.gamma` in [0, 1); found {dt} and {gamma}.")
    with precision():
        plant_now, plant_held = plant_at_origin(loop), held_at_origin(loop, Fraction(dt))
        J = gain_at_origin(loop)
        K = np.asarray(recorded(policy, "K", (system.m, system.n))) if "K" in policy.training else None
        constants = [
            Constant("gamma", gamma, "=", "recorded", "the policy's record"),
            *_discount(plant_held, J, Q, dt, gamma),
            *_estimated(loop, Q, dt, initial_states(system, states, seed, plant), duration),
            _distance(J, K),
            _deviation("epsilon_K", plant_now, K, "continuous input", held=False),
            _deviation("epsilon_K_held", plant_held, K, f"input held over {dt:g} s", held=True),
        ]
        if proved is not None:
            require_same_loop(proved, policy.network, system)
            if any(proved.origin):
                raise InputError("the certificate must be about the origin; it is about another equilibrium.")
            constants.append(_allowed_by_certificate(plant_now, J, proved))
    return Theory(system.name, policy.network.sha256(), tuple(constants))


def _discount(
    plant: tuple[flint.arb_mat, flint.arb_mat], J: flint.arb_mat, Q: Array, dt: float, gamma: float
) -> list[Constant]:
    """a_V and gamma* of the linear part, for every discount and for the one that was used."""
    by = f"linear part, input held over {dt:g} s"
    F = plant[0] + plant[1] * J
    found: list[Constant] = []
    for suffix, discount, sum_of in (
        ("", 1.0, "undiscounted sum"),
        ("_at_gamma", gamma, f"sum discounted by {gamma:g}"),
    ):
        value, why = _bounding_cost(F, Q, discount)
        star = None if value is None else rounded_up(1 - 1 / flint.arb(value)) if value > 1 else 0.0
        found += [
            Constant(f"a_V{suffix}", value, "<=", "proved", f"{by}, {sum_of} of x'Q_r x{why}"),
            Constant(f"gamma_star{suffix}", star, "<=", "proved", f"1 - 1/a_V{suffix}{why}"),
        ]
    return found


def _bounding_cost(F: flint.arb_mat, Q: Array, discount: float) -> tuple[float | None, str]:
    """`V <= x'Sx <= a_V x'Q_r x` if S, `S - discount F'SF - Q_r` and `a_V Q_r - S` are positive definite."""
    if not (Q > 0).all():
        return None, ": the reward must weigh every state"
    middle, root = math.sqrt(discount) * _floats(F), np.sqrt(Q)
    try:
        if not np.abs(np.linalg.eigvals(middle)).max() < 1:
            return None, ": not shown, since in floats the sum has no end"
        with warnings.catch_warnings(), np.errstate(all="ignore"):  # the solution is checked
            warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)
            S = scipy.linalg.solve_discrete_lyapunov(middle.T, (1 + _SLACK) * np.diag(Q))
            S = (S + S.T) / 2
            value = (1 + _SLACK) * float(np.linalg.eigvalsh(S / root[:, None] / root).max())
    except (np.linalg.LinAlgError, ValueError):  # numbers beyond floats, or a matrix at the edge of stability
        return None, ": not shown, floats do not hold it"
    if not math.isfinite(value):
        return None, ": not shown, floats do not hold it"
    weights, bound = _exactly(np.diag(Q)), _exactly(S)
    falls = bound - flint.arb(discount) * (F.transpose() * bound * F) - weights
    if all(map(is_definite, (bound, falls, flint.arb(value) * weights - bound))):
        return value, ""
    return None, ": not shown"


def _estimated(loop: ClosedLoop, Q: Array, dt: float, x0: Array, duration: float) -> list[Constant]:
    """a_V from below: of each run the sum of q over q at its start, which truncation only makes smaller."""
    system = loop.system
    by = f"largest of {len(x0)} simulated states, {duration:g} s each"
    runs = held_loop(system, dt, mean_action(loop.network, system), Q, np.zeros(system.m))
    at_start = (Q * x0 * x0).sum(axis=1)
    total = np.zeros(len(x0))
    for _, total in runs.run(x0, duration):  # noqa: B007  # the last one is wanted
        pass
    if not (at_start > 0).all():
        by += ": one of them costs nothing at its start"
    elif not np.isfinite(total).all():
        by += f": {int((~np.isfinite(total)).sum())} diverged"
    else:
        value = float((total / dt / at_start).max())
        star = max(0.0, 1 - 1 / value)
        return [
            Constant("a_V_sampled", value, ">=", "estimated", by),
            Constant("gamma_star_sampled", star, ">=", "estimated", f"1 - 1/a_V_sampled; {by}"),
        ]
    return [Constant(name, None, ">=", "estimated", by) for name in ("a_V_sampled", "gamma_star_sampled")]


def _distance(J: flint.arb_mat, K: Array | None) -> Constant:
    """||J_mu(0) + K||, Frobenius norm, which no spectral norm exceeds."""
    if K is None:
        return Constant("distance", None, "<=", "proved", "the record has no gain")
    off = J + _exactly(K)
    sizes = [off[i, j].abs_upper() for i in range(off.nrows()) for j in range(off.ncols())]
    # The norm of the sizes, which are numbers: a ball around 0 has no square in Arb, and no root of one.
    square = sum((size * size for size in sizes), flint.arb(0))
    return Constant(
        "distance", rounded_up(square.sqrt().abs_upper()), "<=", "proved", "||J_mu(0) + K||, Frobenius norm"
    )


def _deviation(
    name: str, plant: tuple[flint.arb_mat, flint.arb_mat], K: Array | None, by: str, *, held: bool
) -> Constant:
    """The largest epsilon_K that is found, around the gain of the record."""
    if K is None:
        return Constant(name, None, ">=", "proved", "the record has no gain")
    A, B = plant
    F, G = A - B * _exactly(K), B
    prove = _prove_held if held else _prove_continuous
    found = _largest(lambda epsilon: prove(F, G, epsilon))
    if found is None:
        return Constant(name, None, ">=", "proved", f"{by}: that u = u_eq - K x is stable is not shown")
    return Constant(name, found, ">=", "proved", f"||J_mu(0) + K|| up to which the linear loop is stable, {by}")


def _prove_continuous(F: flint.arb_mat, G: flint.arb_mat, epsilon: float) -> bool:
    """Show that `F + G D` is Hurwitz for all ||D|| <= epsilon; False if that does not succeed.

    With w = D x, |w| <= epsilon |x|: if the form x'(F'P + P F + epsilon^2) x + 2 x'P G w - |w|^2 is negative definite,
    so is that of P along `F + G D`. P comes from the Riccati equation of the bounded real lemma.
    """
    f, g = _floats(F), _floats(G)
    weight = (epsilon * (1 + _SLACK)) ** 2 * np.eye(len(f))
    P = _riccati(lambda: scipy.linalg.solve_continuous_are(f, g, weight, -np.eye(g.shape[1])))
    if P is None:
        return False
    balls = _exactly(P)
    PF, PG = balls * F, balls * G
    return is_definite(balls) and _is_negative(PF.transpose() + PF, PG, -_identity(G.ncols()), epsilon)


def _prove_held(F: flint.arb_mat, G: flint.arb_mat, epsilon: float) -> bool:
    """Show that all eigenvalues of `F + G D` lie in the unit disk for all ||D|| <= epsilon; see above."""
    f, g = _floats(F), _floats(G)
    weight = (epsilon * (1 + _SLACK)) ** 2 * np.eye(len(f))
    P = _riccati(lambda: scipy.linalg.solve_discrete_are(f, g, weight, -np.eye(g.shape[1])))
    if P is None:
        return False
    balls = _exactly(P)
    PF, PG = balls * F, balls * G
    corner = G.transpose() * PG - _identity(G.ncols())
    return is_definite(balls) and _is_negative(F.transpose() * PF - balls, F.transpose() * PG, corner, epsilon)


def _allowed_by_certificate(
    plant: tuple[flint.arb_mat, flint.arb_mat], J: flint.arb_mat, proved: ProvedSet
) -> Constant:
    """The change of the policy's Jacobian until the certificate's V no longer falls to second order at the origin.

    Any tau > 0 may show it, by the form x'(F'P + P F + tau epsilon^2) x + 2 x'P G w - tau |w|^2.
    """
    name = "epsilon_P"
    by = "change of J_mu(0) up to which the certificate's V falls at the origin, continuous input"
    if proved.system.sample is not None:
        return Constant(name, None, ">=", "proved", f"{by}: the certificate is about a held input")
    A, B = plant
    F = A + B * J
    raw = _exactly(proved.ellipsoids[0].P)
    P = (raw + raw.transpose()) * flint.arb(0.5)
    PF, PG = P * F, P * B
    fall, push = _floats(PF + PF.transpose()), _floats(PG)
    best, chosen = 0.0, 1.0
    sizes = float(np.linalg.norm(push)) ** 2, float(np.linalg.norm(fall))
    for tau in (sizes[0] / sizes[1] if min(sizes) > 0 else 1.0) * np.logspace(-6, 6, 241):
        room = -float(np.linalg.eigvalsh(fall + push @ push.T / tau).max())
        if room > 0 and math.sqrt(room / tau) > best:
            best, chosen = math.sqrt(room / tau), float(tau)
    epsilon = best * (1 - _SLACK)
    tau = flint.arb(chosen)
    root = flint.arb(epsilon) * tau.sqrt()
    if not best > 0 or not _is_negative(PF + PF.transpose(), PG, -tau * _identity(B.ncols()), root):
        return Constant(name, None, ">=", "proved", f"{by}: that it falls at all is not shown")
    return Constant(name, epsilon, ">=", "proved", by)


def _is_negative(X: flint.arb_mat, Y: flint.arb_mat, Z: flint.arb_mat, epsilon: flint.arb | float) -> bool:
    """True if [[X + epsilon^2 I, Y], [Y', Z]] is certainly negative definite."""
    n, m = X.nrows(), Z.nrows()
    whole = flint.arb_mat(n + m, n + m)
    for i in range(n + m):
        for j in range(i + 1):
            whole[i, j] = -(X[i, j] if i < n else Y[j, i - n] if j < n else Z[i - n, j - n])
    square = flint.arb(epsilon) ** 2
    for i in range(n):
        whole[i, i] = whole[i, i] - square
    return is_definite(whole)


def _largest(holds: Callable[[float], bool]) -> float | None:
    """A number that passes, and 0.1 % beyond which none was seen to; None if none passes at any size."""
    value = 1.0
    if holds(value):
        for _ in range(_DOUBLINGS):
            if not holds(2 * value):
                break
            value *= 2
    else:
        for _ in range(_DOUBLINGS):
            value /= 2
            if holds(value):
                break
        else:
            return None
    step = value
    for _ in range(_HALVINGS):
        step /= 2
        if holds(value + step):
            value += step
    return value


def _riccati(solve: Callable[[], Array]) -> Array | None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)  # the solution is checked
        try:
            P = np.asarray(solve(), dtype=np.float64)
        except (np.linalg.LinAlgError, ValueError):
            return None
    return (P + P.T) / 2 if np.isfinite(P).all() else None


def _exactly(M: Array) -> flint.arb_mat:
    return flint.arb_mat([[flint.arb(float(v)) for v in row] for row in M])


def _floats(M: flint.arb_mat) -> Array:
    return np.array([[float(M[i, j].mid()) for j in range(M.ncols())] for i in range(M.nrows())])


def _identity(n: int) -> flint.arb_mat:
    return _exactly(np.eye(n))
