"""The closed loop: equilibrium, linearisation, rigorous values at a point."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import flint
import numpy as np
import pytest

from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, Symbol, symbols
from certify.loop.plants import System, get_system, load_system, with_input_errors
from certify.loop.policies import PolicyNetwork
from certify.loop.rigorous import eigenvalues, evaluate_policy, evaluate_vdot
from tests.support.loops import box, chain, pendulum_network, scalar_tanh


def test_linearisation_of_the_pendulum(pendulum: System) -> None:
    network = pendulum_network()
    loop = ClosedLoop(pendulum, network)
    A, B, K = loop.linearise()
    np.testing.assert_allclose(B, [[0], [1 / (0.15 * 0.25)]])
    np.testing.assert_allclose(A + B @ K, [[0, 1], [9.81 / 0.5, -0.1 / (0.15 * 0.25)]])
    f = pendulum.function()
    step = 1e-6 * np.eye(2)
    numeric = (f(step, loop.policy(step)) - f(-step, loop.policy(-step))).T / 2e-6
    np.testing.assert_allclose(A, numeric, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("centre", ["preactivation", "output"])
def test_eigenvalues_are_enclosed(pendulum: System, centre: str) -> None:
    loop = ClosedLoop(pendulum, pendulum_network(centre=centre))
    balls = eigenvalues(loop)
    assert balls is not None
    floats = sorted(np.linalg.eigvals(loop.linearise()[0]), key=lambda v: v.real)
    for ball, value in zip(sorted(balls, key=lambda v: float(v.real)), floats, strict=True):
        assert float(abs(ball - complex(value)).abs_upper()) < 1e-9 * abs(value)
        assert float(ball.real.rad()) < 1e-20


@pytest.mark.parametrize("centre", ["preactivation", "output"])
def test_vdot_at_a_point_agrees_with_floats(pendulum: System, centre: str) -> None:
    loop = ClosedLoop(pendulum, pendulum_network(centre=centre))
    P = np.array([[1.0, 0.1], [0.1, 0.05]])
    f = pendulum.function()
    for x in np.random.default_rng(0).standard_normal((20, 2)):
        ball = evaluate_vdot(loop, P, x)
        assert float(abs(ball - 2 * float(x @ P @ f(x, loop.policy(x)))).abs_upper()) < 1e-11
        assert float(ball.rad()) < 1e-40


def test_scalar_plant_has_its_known_limit() -> None:
    loop = ClosedLoop(*scalar_tanh())
    P = np.eye(1)
    assert evaluate_vdot(loop, P, np.array([1.915008])) < 0
    assert evaluate_vdot(loop, P, np.array([1.915009])) > 0


def test_counts_must_match(pendulum: System) -> None:
    _, wrong = chain(3, [-1, -2, -3])
    with pytest.raises(InputError, match="must read 2 states"):
        ClosedLoop(pendulum, wrong)


def test_the_origin_must_be_an_equilibrium() -> None:
    x, u = symbols("x u")
    system = System("s", (x,), (u,), {}, (x + u + Fraction(1, 10**9),), (Number(0),), box(1), box(1))
    network = PolicyNetwork.of_layers((np.array([[-2.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")
    with pytest.raises(InputError, match="must be exactly 0"):
        ClosedLoop(system, network).require_rest()


def test_uncentred_policy_is_refused(pendulum: System) -> None:
    with pytest.raises(InputError, match="not centred"):
        ClosedLoop(pendulum, pendulum_network(centre="none")).require_rest()


def test_nonzero_equilibrium_input() -> None:
    x, u = symbols("x u")
    c = Symbol("c")
    system = System("s", (x,), (u,), {"c": Fraction(3, 10)}, (u - c,), (c,), box(1), box(1))
    network = PolicyNetwork.of_layers((np.array([[-2.0]]),), (np.array([0.7]),), np.ones(1), np.array([0.1]))
    loop = ClosedLoop(system, network)
    value = evaluate_policy(loop, np.zeros(1))[0]
    with flint.ctx.workprec(200):
        assert (10 * value).contains(3) and float(value.rad()) < 1e-40
    assert evaluate_vdot(loop, np.eye(1), np.array([0.5])) < 0


def test_a_policy_that_is_not_centred_is_told_by_how_much_and_what_to_type() -> None:
    """Of pi(0), where it is no fraction, the message says what it is about, and options as they are typed."""
    system = get_system("pendulum")
    base = pendulum_network((8, 8))
    off = base.with_layers(biases=tuple(b + 0.1 for b in base.biases), centre="none")
    with pytest.raises(InputError, match=r"exactly u_eq = 0; its input u is about -?\d\.\d+\. .*--centre output or"):
        ClosedLoop(system, off).require_rest()
    value = float(off(np.zeros(2), (Fraction(0),))[0])
    with pytest.raises(InputError, match=f"about {value:.9g}"):
        ClosedLoop(system, off).require_rest()
    near = off.with_layers(biases=(*off.biases[:-1], off.biases[-1] - np.arctanh(value / off.scale[0])))
    with pytest.raises(InputError, match="whether exactly that cannot be decided: tanh at the operating point"):
        ClosedLoop(system, near).require_rest()
    plain = replace(off, squash="identity")
    with pytest.raises(InputError, match=r"with --centre output, or ask for less with --claim practical"):
        ClosedLoop(system, plain).require_rest()


def test_a_loop_that_rests_nowhere_for_all_values_is_told_so() -> None:
    system = with_input_errors(get_system("pendulum"), {"u": Fraction(1, 10)})
    with pytest.raises(InputError, match=r"whatever error_u may be; theta_dot' depends on that there. Ask for --claim"):
        ClosedLoop(system, pendulum_network((8, 8))).require_rest()


def test_terms_that_cancel_only_if_written_so_are_told_from_others(tmp_path: Path) -> None:
    """(1 + u)/m - 1/m is 0 at u = 0 whatever m is, which an evaluation term by term does not see."""
    text = (
        'name = "p"\nstates = ["x"]\ninputs = ["u"]\npositive = ["m"]\n[parameters]\nm = [1, 2]\n[dynamics]\n'
        'x = "{}"\n[u_eq]\nu = 0\n[domain]\nx = [-1, 1]\n[input_bounds]\nu = [-3, 3]\n'
    )
    loops = []
    for equation in ("-x + (1 + u)/m - 1/m", "-x + (1 + u - 1)/m", "-x + (1 + u)/m - 1"):
        (tmp_path / "p.toml").write_text(text.format(equation))
        loops.append(ClosedLoop(load_system(tmp_path / "p.toml"), scalar_tanh()[1]))
    with pytest.raises(InputError, match=r"x' is 0 there at the ends of the ranges, but its terms cancel only"):
        loops[0].require_rest()
    loops[1].require_rest()
    with pytest.raises(InputError, match="x' depends on that there"):
        loops[2].require_rest()
    both = text.replace("m = [1, 2]", "m = [1, 2]\nk = [1, 2]").format("-x + u + m - k")  # 0 where they are equal
    (tmp_path / "p.toml").write_text(both)
    with pytest.raises(InputError, match="x' depends on that there"):
        ClosedLoop(load_system(tmp_path / "p.toml"), scalar_tanh()[1]).require_rest()
