"""The plants of `examples/plants`: that their equations are the physics they name, and that each policy belongs to its
plant and is provable."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates.verdict import Verdict
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import available_systems, controllability, linearise, load_system, residuals
from certify.loop.policies import load_policy
from controllers.options import default_record
from controllers.plants.choice import chosen_plant

EXAMPLES = Path(__file__).parent.parent / "examples"
PLANTS = sorted((EXAMPLES / "plants").glob("*.toml"))
Array = NDArray[np.float64]


def states(name: str, count: int = 200) -> tuple[Array, Array, Array]:
    """States' values x (count, n), inputs u and what the plant's equations give there, from its file."""
    system = load_system(EXAMPLES / "plants" / f"{name}.toml")
    generator = np.random.default_rng(0)
    lo, hi = np.array(system.domain, dtype=float).T
    u_lo, u_hi = np.array(system.input_bounds, dtype=float).T
    x, u = generator.uniform(lo, hi, (count, system.n)), generator.uniform(u_lo, u_hi, (count, system.m))
    at = np.array([float(q) for q in system.exact_x_eq()])
    return x + at, u, system.function()(x, u)


@pytest.mark.parametrize("path", PLANTS, ids=lambda p: p.stem)
def test_a_policy_belongs_to_its_plant(path: Path) -> None:
    """By name, parameters and sizes; the loop rests at the origin, exactly; it was trained as the file says."""
    system, policy = load_system(path), load_policy(EXAMPLES / "policies" / f"{path.stem}.pt")
    assert policy.system == system.name and system.name not in available_systems()
    assert {name: Fraction(value) for name, value in policy.parameters.items()} == dict(system.parameters)
    assert residuals(system) == {s.name: 0 for s in system.states}
    assert all(isinstance(r, Fraction) for r in residuals(system).values())
    loop = ClosedLoop(system, policy.network)
    loop.require_rest()
    eigenvalues = np.linalg.eigvals(loop.linearise()[0])
    assert np.abs(eigenvalues).max() < 1 if system.time == "discrete" else eigenvalues.real.max() < 0
    found = controllability(*linearise(system))
    assert found.exact and found.rank == system.n
    mine, own = chosen_plant(str(path))
    assert mine == system
    wanted = own.preset.record() | {"transitions": "latest"}  # they were trained before that was a choice
    record = {**default_record(), **policy.training}
    assert {name: record[name] for name in wanted} == wanted


def test_there_are_eight() -> None:
    assert [p.stem for p in PLANTS] == [
        "bicycle",
        "furuta",
        "henon",
        "maglev",
        "satellite",
        "two_machines",
        "two_tanks",
        "van_der_pol",
    ]


def test_the_readme_shows_the_bicycle(tmp_path: Path) -> None:
    text = (EXAMPLES.parent / "README.md").read_text().split("```toml\n")[1].split("```")[0]
    (tmp_path / "bicycle.toml").write_text(text)
    shown, plant = load_system(tmp_path / "bicycle.toml"), load_system(EXAMPLES / "plants" / "bicycle.toml")
    for name in ("name", "states", "inputs", "parameters", "dynamics", "u_eq", "domain", "input_bounds"):
        assert getattr(shown, name) == getattr(plant, name), name


def test_van_der_pol_runs_backwards() -> None:
    x, u, change = states("van_der_pol")
    forward = np.stack([x[:, 1], -x[:, 0] + (1 - x[:, 0] ** 2) * x[:, 1]], -1)
    np.testing.assert_allclose(change, -forward + np.stack([0 * u[:, 0], u[:, 0]], -1), atol=1e-12)


def test_the_bicycle_turns_on_a_circle() -> None:
    """At a steering angle delta the rear axle runs on a circle of radius L / tan(delta)."""
    x, u, change = states("bicycle")
    np.testing.assert_allclose(change[:, 1] * 2.5 / np.tan(x[:, 2]), 5, rtol=1e-12)
    np.testing.assert_allclose(change[:, 0], 5 * np.sin(x[:, 1]), atol=1e-12)
    np.testing.assert_allclose(change[:, 2], (u[:, 0] - x[:, 2]) / 0.2, atol=1e-12)


def test_the_energy_of_furuta_s_pendulum_changes_by_torque_and_friction() -> None:
    """The Lagrangian of two bodies written as energies of points: none of the file's own terms."""
    x, u, change = states("furuta")
    J1, m1, l1, J2, m2, L1, l2, g = 0.0248, 0.3, 0.15, 0.00386, 0.075, 0.278, 0.148, 9.81

    def energy(q: Array) -> Array:
        _, alpha, phi_dot, alpha_dot = q.T
        s, c = np.sin(alpha), np.cos(alpha)
        # velocity of the pendulum's centre: along the arm, across it, upwards
        along = -l2 * s * phi_dot
        across = L1 * phi_dot + l2 * c * alpha_dot
        up = -l2 * s * alpha_dot
        moving = m2 * (along**2 + across**2 + up**2) / 2
        turning = J2 * (alpha_dot**2 + s**2 * phi_dot**2) / 2  # a slender rod has no inertia about itself
        return (J1 + m1 * l1**2) * phi_dot**2 / 2 + moving + turning + m2 * g * l2 * c

    h = 1e-6
    power = (energy(x + h * change) - energy(x - h * change)) / (2 * h)
    wanted = u[:, 0] * x[:, 2] - 1e-4 * x[:, 2] ** 2 - 2.8e-4 * x[:, 3] ** 2
    np.testing.assert_allclose(power, wanted, atol=1e-7 * np.abs(power).max() + 1e-8)


def attitude(s: Array) -> Array:
    """Body to world of modified Rodrigues parameters, through the axis and the angle 4 atan|s|."""
    size = np.linalg.norm(s)
    a, angle = s / size, 4 * np.arctan(size)
    cross = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def test_the_satellite_is_a_rigid_body() -> None:
    """R' = R [w]x, and the angular momentum in the world changes by the torques alone."""
    J = np.array([12.0, 10.0, 8.0])
    for x, u, change in zip(*states("satellite", 20), strict=True):
        s, w, h = x[:3], x[3:], 1e-6
        R = attitude(s)
        moved = (attitude(s + h * change[:3]) - attitude(s - h * change[:3])) / (2 * h)
        cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        np.testing.assert_allclose(moved, R @ cross, atol=1e-8)
        momentum = moved @ (J * w) + R @ (J * change[3:])
        np.testing.assert_allclose(momentum, R @ u, atol=1e-7)


def test_two_machines_swing_about_a_rational_angle() -> None:
    x, u, change = states("two_machines")
    angle = 2 * np.arctan(15 / 26)
    assert abs(np.degrees(angle) - 60) < 0.05
    wanted = -0.5 * x[:, 1] - (np.sin(x[:, 0] + angle) - np.sin(angle)) + u[:, 0]
    np.testing.assert_allclose(change, np.stack([x[:, 1], wanted], -1), atol=1e-12)


def test_the_map_of_henon_takes_a_step() -> None:
    x, u, after = states("henon")
    np.testing.assert_allclose(after[:, 0] + 0.63, 1 - 1.4 * x[:, 0] ** 2 + x[:, 1] + u[:, 0], atol=1e-12)
    np.testing.assert_allclose(after[:, 1] + 0.3 * 0.63, 0.3 * x[:, 0], atol=1e-12)


def test_the_magnet_s_force_falls_with_the_square_of_the_gap() -> None:
    x, u, change = states("maglev")
    assert x[:, 0].min() > 0.004 and x[:, 0].max() < 0.016
    force = 9.81 * (u[:, 0] / 0.8) ** 2 * (0.01 / x[:, 0]) ** 2
    np.testing.assert_allclose(change, np.stack([x[:, 1], 9.81 - force], -1), rtol=1e-12, atol=1e-12)


def test_the_tanks_empty_as_torricelli_says() -> None:
    """h' = -a sqrt(h) has the solution (sqrt(h0) - a t / 2)^2, and what leaves one tank enters the other."""
    x, u, change = states("two_tanks")
    h = 1e-6
    emptied = ((np.sqrt(x[:, 0]) - 0.5 * h / 2) ** 2 - (np.sqrt(x[:, 0]) + 0.5 * h / 2) ** 2) / (2 * h)
    np.testing.assert_allclose(change[:, 0], emptied + 0.4 * u[:, 0], atol=1e-7)
    np.testing.assert_allclose(change.sum(1), 0.4 * u[:, 0] - 0.5 * np.sqrt(x[:, 1]), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "volume"),
    [
        ("van_der_pol", 7.37),
        ("two_machines", 5.65),
        ("two_tanks", 451),
        ("maglev", 5.03e-3),
        ("bicycle", 5.19),
        ("furuta", 16.8),
        ("henon", 0.89),
        ("satellite", 0.259),
    ],
)
def test_a_set_is_proved_within_a_minute(tmp_path: Path, name: str, volume: float) -> None:
    """At least the volumes of examples/README.md, rounded down."""
    system, policy = (
        load_system(EXAMPLES / "plants" / f"{name}.toml"),
        load_policy(EXAMPLES / "policies" / f"{name}.pt"),
    )
    options = RoaOptions(candidate="optimised", effort=1.2)
    result = certify_roa(system, policy.network, tmp_path, options)
    assert result.verdict is Verdict.PROVED
    assert result.to_dict()["volume"] > volume
