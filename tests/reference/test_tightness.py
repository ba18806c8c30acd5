"""The reference's bounds are no looser than the checker's: it accepts each certificate that is only just accepted."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
import scipy.linalg
from flint import arb, arb_mat

from certify.checker.near import Above
from certify.checker.taylor import Taylor as Checkers
from certify.checker.taylor import pairs, upper_bound
from certify.provers.bounds.taylor import Taylor as Provers
from certify.provers.bounds.taylor import upper_bound as provers_upper_bound
from certify.reference.taylor import Taylor as References
from tests.reference.test_reference import judge, verdict
from tests.support.balls import with_ball
from tests.support.certificates import Document, edited, encode, grow, make
from tests.support.marks import slow_after


def limit(at: Callable[[float], Document], least: float, most: float, steps: int) -> tuple[float, int, int]:
    """Halve an interval in proportion, down to where the checker's verdict changes; `least` is known to be accepted.

    Where it changes, how many certificates on the way both accept, and how many the reference alone refuses.
    """
    together = alone = 0
    for _ in range(steps):
        middle = (least * most) ** 0.5
        data = at(middle)
        if verdict(data) != "ACCEPTED":
            most = middle
            continue
        least = middle
        refused = judge(data) is not None
        together, alone = together + (not refused), alone + refused
    return least, together, alone


@pytest.mark.slow
@pytest.mark.parametrize("share", slow_after(1, [0.8, 0.1, 0.5]))
@pytest.mark.parametrize("seed", slow_after(1, range(20)))
def test_balls_of_stiff_loops_with_ranges(seed: int, share: float) -> None:
    """A pendulum whose mass has a range, up to the widest that the checker accepts."""
    generator = np.random.default_rng(seed)
    K = np.array([generator.uniform(1.5, 5.0), generator.uniform(0.3, 1.5)])
    W, b = generator.standard_normal((12, 2)), generator.uniform(-0.5, 0.5, 12)
    slopes = 1 - np.tanh(b) ** 2
    layers = [(W, b), (-K[None] / 6 @ np.linalg.pinv(slopes[:, None] * W), [0.0])]
    A = np.array([[0.0, 1.0], [19.62 - K[0] / 0.0375, -(0.1 + K[1]) / 0.0375]])
    P = scipy.linalg.solve_continuous_lyapunov(A.T, -np.eye(2))
    P = np.round(2**20 * (P + P.T)) / 2**21
    f = ["+", ["*", "981/50", ["sin", "x"]], ["/", ["-", "u", ["*", "1/10", "y"]], ["*", "1/4", "q"]]]

    def at(level: float, width: float) -> Document:
        mass, far = Fraction(3, 20), Fraction(width)
        return with_ball(make(
            ["y", f], layers, P, (level, level), states="xy", domain=[("-3", "3"), ("-20", "20")],
            squash="tanh", centre="preactivation", scale=[6.0], input_bounds=[("-6", "6")],
            uncertain=[("q", str(mass - far), str(mass + far))], cells=[1 + seed % 3],
        ))  # fmt: skip

    known, together, alone = limit(lambda c: at(c, 1e-6), 1e-8, 1.0, 16)
    level = share * known
    _, more, others = limit(lambda width: at(level, width), 1e-6, 0.1, 24)
    assert together > 2 and more > 2 and alone == others == 0


@pytest.mark.parametrize("hidden", [1, 2, 3])
@pytest.mark.parametrize("seed", slow_after(1, range(12)))
def test_leaves_under_deep_policies(seed: int, hidden: int) -> None:
    """A tree whose leaves are no smaller than the checker needs them, with levels raised until one of them fails."""
    generator = np.random.default_rng([seed, hidden])
    sizes = [2, *generator.integers(3, 9, hidden).tolist(), 1]
    layers = [
        (generator.standard_normal((b, a)) / np.sqrt(a), generator.uniform(-0.3, 0.3, b)) for a, b in pairwise(sizes)
    ]
    squash, centre = (("tanh", "preactivation"), ("tanh", "output"), ("identity", "output"))[seed % 3]
    f = [["+", ["-", "x"], ["*", "1/4", ["sin", "y"]]], ["+", ["*", "-1", "y"], ["*", "x", "y", "1/2"], "u"]]
    data = make(
        f, layers, np.eye(2), (0.05, 0.5), states="xy", domain=[("-3", "3")] * 2, squash=squash, centre=centre,
        scale=[0.5], input_bounds=[("-9", "9")],
    )  # fmt: skip
    data = with_ball(edited(data, "evidence.root", encode([1.5, 1.5])))
    grown = grow(data, max_leaves=400, depth=12)
    if verdict(grown) != "ACCEPTED":
        pytest.skip("the loop does not fall")
    *_, alone = limit(lambda c: edited(grown, "levels.roa", c.hex()), 0.5, 2.0, 12)
    assert judge(grown) is None and alone == 0


@pytest.mark.parametrize("seed", range(8))
def test_a_coefficient_that_is_noise_says_nothing_of_the_corner(seed: int) -> None:
    """Multipliers make some g_i 0 up to rounding, others in each program: all bound such models alike, and rightly."""
    generator = np.random.default_rng([seed, 30])
    n, models, noisy = 5, 40, generator.permutation(5)[: 1 + seed % 3]
    g, Q = generator.standard_normal((n, models)), 0.3 * generator.standard_normal((n, n, models))
    Q = (Q + Q.swapaxes(0, 1)) / 2
    i, j = pairs(n)
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * n)).reshape(n, -1)
    found, least = list[np.ndarray](), np.full(models, -np.inf)
    for noise in (1e-17, -1e-17, generator.choice([-1e-15, 1e-15], (len(noisy), models))):
        g[noisy] = noise
        least = np.maximum(least, (g.T @ corners + np.einsum("ik,ijb,jk->bk", corners, Q, corners)).max(1))
        none = np.zeros(models)
        q = np.where((i == j)[:, None], 1.0, 2.0) * Q[i, j]
        found.append(upper_bound(Checkers(none, np.vstack([g, q]), Above(none))))
        found.append(provers_upper_bound(Provers(none, g, Q, none))[0])
        references = [
            References(arb(0), arb_mat([g[:, b].tolist()]), arb_mat(Q[..., b].tolist())) for b in range(models)
        ]
        found.append(np.array([float(model.bound().upper()) for model in references]))
    assert np.ptp(found, axis=0).max() < 1e-9 and np.all(np.min(found, axis=0) >= least - 1e-12)
