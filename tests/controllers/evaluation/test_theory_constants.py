"""The constants of the theory: exact where that is known, never beyond it, and attacked by loops that break them."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import flint
import numpy as np
import pytest
import scipy.linalg
from typer.testing import CliRunner

from certify.certificates.ellipsoids import Ellipsoid
from certify.certificates.membership import ProvedSet
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, Symbol, substitute, symbols
from certify.loop.plants import System, get_system, in_floats, with_input_errors
from certify.loop.policies import Policy, PolicyNetwork, load_policy, save_policy
from certify.loop.rigorous import is_definite
from controllers.cli import app
from controllers.evaluation import theory_constants as module
from controllers.evaluation.proved_set import require_same_loop
from controllers.evaluation.theory_constants import Constant, theory
from controllers.identification.linearisation import discrete_linearisation
from controllers.options import Plant, preset

POLICIES = Path(__file__).parents[3] / "examples" / "policies"
DT, GAMMA = 0.1, 0.9
SLACK = 1.01  # a bound that is this much weaker than the truth is still worth printing


def _scalar(a=1.0, b=2.0, gain=1.5, K=1.5, weight=3.0):
    """x' = a x + b u under u = -tanh(gain x), whose record says that the gain is K."""
    x, u = symbols("x u")
    rate = Fraction(str(a)) * x + Fraction(str(b)) * u
    system = System("line", (x,), (u,), {}, (rate,), (Number(0),), ((-3, 3),), ((-1, 1),))
    layers = (np.array([[0.5]]), np.array([[-2.0 * gain]]))
    network = PolicyNetwork.of_layers(
        layers, (np.zeros(1), np.zeros(1)), np.ones(1), np.zeros(1), "tanh", "preactivation"
    )
    training = {"dt": DT, "gamma": GAMMA, "reward_weights": [weight], "K": [[K]]}
    options = replace(preset("pendulum"), reward_weights=(weight,), state_weights=(1.0,))
    return Policy(network, "line", {}, training), (
        system,
        Plant(preset=options, initial_states=(0.1,), positions=("x",)),
    )


def _constants(policy, own, proved=None):
    return theory(policy, own, proved, states=5, duration=5.0)


def _proved_set(policy, system, P):
    ellipsoids = (Ellipsoid("{V <= c2}", np.array(P), 1.0),)
    return ProvedSet(
        ellipsoids,
        system=system,
        claim="asymptotic",
        policy_sha256=policy.network.sha256(),
        certificate_sha256="0" * 64,
    )


def test_on_a_line_every_constant_is_known():
    a, b, gain, K = 1.0, 2.0, 1.5, 1.25
    policy, own = _scalar(a, b, gain, K)
    found = _constants(policy, own, _proved_set(policy, own[0], [[7.0]]))
    free, forced = math.exp(a * DT), b * math.expm1(a * DT) / a
    step = free - forced * gain
    known = {
        "a_V": 1 / (1 - step**2),
        "gamma_star": step**2,
        "a_V_at_gamma": 1 / (1 - GAMMA * step**2),
        "gamma_star_at_gamma": GAMMA * step**2,
        "distance": gain - K,
        "epsilon_K": K - a / b,
        "epsilon_K_held": (1 - abs(free - forced * K)) / forced,
        "epsilon_P": gain - a / b,
    }
    for name, value in known.items():
        constant = found[name]
        assert constant.how == "proved"
        beyond = constant.value / value if constant.relation == "<=" else value / constant.value
        assert 1 - 1e-12 <= beyond < SLACK, name
    # The tanh only weakens the input, so on the box of initial states a sum is at least that of the linear part.
    assert found["a_V"].value / SLACK < found["a_V_sampled"].value < 1.1 * found["a_V"].value
    assert found["a_V_sampled"].how == "estimated" and found["gamma"].value == GAMMA


@pytest.mark.parametrize("K", [-1.5, 0.4])
def test_about_a_gain_that_does_not_stabilise_nothing_is_said(K):
    found = _constants(*_scalar(K=K))
    assert found["epsilon_K"].value is None and found["epsilon_K_held"].value is None
    assert "not shown" in found["epsilon_K"].by


def test_a_loop_that_is_not_stable_has_neither_bound():
    policy, own = _scalar(gain=0.4)
    found = _constants(policy, own, _proved_set(policy, own[0], [[7.0]]))
    assert found["a_V"].value is None and found["gamma_star"].value is None
    assert found["epsilon_P"].value is None
    assert found["a_V_at_gamma"].value is not None  # the discount hides that it is unstable: this is why gamma* exists
    assert found["gamma_star_at_gamma"].value > GAMMA


def test_a_reward_that_does_not_weigh_a_state_bounds_no_cost():
    policy, own = _scalar()
    policy = replace(policy, training={**policy.training, "reward_weights": [0.0]})
    found = _constants(policy, own)
    assert found["a_V"].value is None and "weigh every state" in found["a_V"].by
    assert found["a_V_sampled"].value is None


def _pendulum():
    policy = load_policy(POLICIES / "pendulum.pt")
    return policy, theory(policy, states=5, duration=5.0), get_system("pendulum")


def test_within_epsilon_no_gain_breaks_the_loop_and_it_is_nearly_the_largest_that_can_be_said():
    policy, found, system = _pendulum()
    K = np.array(policy.training["K"])
    A, B = (in_floats(M) for M in ClosedLoop(system, policy.network).plant_jacobians())
    held = discrete_linearisation(system, policy.training["dt"])
    generator = np.random.default_rng(0)
    for _ in range(200):
        D = generator.standard_normal(K.shape)
        D /= np.linalg.norm(D, 2)
        continuous = np.linalg.eigvals(A - B @ (K - found["epsilon_K"].value * D))
        assert continuous.real.max() < 0
        stepped = np.linalg.eigvals(held[0] - held[1] @ (K - found["epsilon_K_held"].value * D))
        assert np.abs(stepped).max() < 1
    # The smallest complex matrix that breaks it has the size 1 / max ||(i w - F)^-1 B|| over all frequencies w.
    F = A - B @ K
    gains = [np.linalg.norm(np.linalg.solve(1j * w * np.eye(2) - F, B), 2) for w in (0, *np.logspace(-3, 3, 2000))]
    assert 1 / SLACK < found["epsilon_K"].value * max(gains) < 1.0001


def test_above_gamma_star_the_discounted_cost_falls_along_the_linear_loop():
    policy, found, system = _pendulum()
    A, B = discrete_linearisation(system, policy.training["dt"])
    F = A + B @ policy.network.jacobian_at_origin(system.exact_u_eq())
    Q = np.diag(policy.training["reward_weights"])
    for gamma in np.linspace(found["gamma_star"].value + 1e-4, 0.999, 20):
        V = scipy.linalg.solve_discrete_lyapunov(math.sqrt(gamma) * F.T, Q)
        assert np.linalg.eigvalsh(F.T @ V @ F - V).max() < 0


def test_the_certificates_function_falls_within_its_epsilon_and_not_far_beyond():
    policy, _, system = _pendulum()
    loop = ClosedLoop(system, policy.network)
    F, B, _ = loop.linearise()
    P = scipy.linalg.solve_continuous_lyapunov(F.T, -np.diag([1.0, 3.0]))
    epsilon = theory(policy, proved=_proved_set(policy, system, P), states=5, duration=5.0)["epsilon_P"].value

    def fall(D):
        moved = F + B @ D
        return np.linalg.eigvalsh(moved.T @ P + P @ moved).max()

    around = [np.array([[math.cos(t), math.sin(t)]]) for t in np.linspace(0, 2 * math.pi, 400)]
    assert max(fall(epsilon * D) for D in around) < 0 < max(fall(SLACK * epsilon * D) for D in around)


def test_a_set_of_another_loop_is_refused():
    policy, own = _scalar()
    other, _ = _scalar(gain=1.6)
    with pytest.raises(InputError, match="about the policy that is evaluated"):
        _constants(policy, own, _proved_set(other, own[0], [[7.0]]))
    with pytest.raises(InputError, match="about the plant that is simulated"):
        _constants(policy, own, _proved_set(policy, _scalar(a=1.1)[1][0], [[7.0]]))
    with pytest.raises(InputError, match="about the plant that is simulated"):
        _constants(policy, own, _proved_set(policy, replace(own[0], time="discrete"), [[7.0]]))
    held = own[0].with_sample((0, Fraction(1, 10)))
    said = _constants(policy, (held, own[1]), _proved_set(policy, held, [[7.0]]))["epsilon_P"]
    assert said.value is None and "held input" in said.by


def test_a_set_that_is_proved_for_less_of_what_is_uncertain_is_refused():
    policy, (nominal, _) = _scalar()
    little, pushed = (with_input_errors(nominal, {"u": Fraction(1, size)}) for size in (100, 10))
    for less in (nominal, little):
        with pytest.raises(InputError, match=r"for all that is uncertain of line, `error_u` in \[-0\.1, 0\.1\]"):
            require_same_loop(_proved_set(policy, less, [[7.0]]), policy.network, pushed)
    for plant in (nominal, little, pushed):  # what holds for more holds for these
        require_same_loop(_proved_set(policy, pushed, [[7.0]]), policy.network, plant)
    backwards = replace(
        little, dynamics=tuple(substitute(e, {Symbol("error_u"): -Symbol("error_u")}) for e in little.dynamics)
    )
    with pytest.raises(InputError, match="about the plant that is simulated"):
        require_same_loop(_proved_set(policy, backwards, [[7.0]]), policy.network, little)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gamma": 1.0}, r"`training\.gamma` in \[0, 1\)"),
        ({"dt": 0.0}, r"`training\.dt` must be positive"),
        ({"reward_weights": [1.0, 2.0]}, "reward_weights"),
        ({"K": [[math.nan]]}, "finite"),
    ],
)
def test_a_record_that_cannot_be_used_is_refused(change, message):
    policy, own = _scalar()
    with pytest.raises(InputError, match=message):
        _constants(replace(policy, training={**policy.training, **change}), own)


def test_a_policy_that_does_not_rest_at_the_origin_is_refused():
    policy, own = _scalar()
    off = policy.network.with_layers(biases=(np.ones(1), np.zeros(1)), centre="none")
    with pytest.raises(InputError, match="centr"):
        _constants(replace(policy, network=off), own)


def test_what_floats_propose_counts_for_nothing_until_it_is_shown(monkeypatch):
    policy, own = _scalar()
    monkeypatch.setattr(module, "_riccati", lambda solve: np.array([[-1.0]]))
    assert _constants(policy, own)["epsilon_K"].value is None
    monkeypatch.setattr(module.scipy.linalg, "solve_discrete_lyapunov", lambda a, q: np.array([[-1.0]]))
    assert _constants(policy, own)["a_V"].value is None
    monkeypatch.setattr(module.scipy.linalg, "solve_discrete_lyapunov", lambda a, q: q)  # less than the cost
    assert _constants(policy, own)["a_V"].value is None


def test_definite_is_what_is_certain():
    generator = np.random.default_rng(0)
    for n in range(1, 6):
        root = generator.standard_normal((n, n))
        for shift in (0.1, -0.1):
            M = root @ root.T
            M += (shift - np.linalg.eigvalsh(M)[0]) * np.eye(n)
            assert is_definite(flint.arb_mat(M.tolist())) is (shift > 0)
    assert not is_definite(flint.arb_mat([[flint.arb(1, 1)]]))
    assert not is_definite(flint.arb_mat([[flint.arb.nan()]]))
    assert not is_definite(flint.arb_mat([[1, 1], [1, 1]]))
    wide = flint.arb(0, 1.1)  # one of its matrices is not definite
    assert not is_definite(flint.arb_mat([[1, wide], [wide, 1]]))


def test_the_command_says_which_numbers_are_proved():
    arguments = ["theory", str(POLICIES / "pendulum.pt"), "--states", "5"]
    shown = CliRunner().invoke(app, arguments)
    assert shown.exit_code == 0, shown.stderr
    assert "epsilon_K_held" in shown.stdout and "(proved, linear part), and above that of the simulated" in shown.stdout
    found = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)
    assert found["system"] == "pendulum" and found["constants"]["epsilon_K"]["how"] == "proved"
    assert found["constants"]["a_V_sampled"]["how"] == "estimated"
    refused = CliRunner().invoke(app, ["theory", str(POLICIES / "without_gain" / "pendulum.pt"), "--json"])
    assert refused.exit_code == 2 and "error" in json.loads(refused.stdout)


def test_the_numbers_that_are_shown_are_bounds_as_well():
    """Six digits of an upper bound that were rounded to the nearest would claim more than was proved."""
    arguments = ["theory", str(POLICIES / "pendulum.pt"), "--states", "5"]
    exact = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)["constants"]
    shown = dict(line.split(maxsplit=1) for line in CliRunner().invoke(app, arguments).stdout.splitlines())
    assert {constant["relation"] for constant in exact.values()} == {"<=", ">=", "="}
    for name, constant in exact.items():
        words = shown[name].split("  ")[0].removeprefix(f"{constant['relation']} ").removeprefix("= ")
        digits = Fraction(words.replace(" × 10", "e").translate(str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")))
        gap = digits - Fraction(constant["value"])
        assert abs(gap) < Fraction(constant["value"]) / 10**5
        assert {"<=": gap >= 0, ">=": gap <= 0, "=": True}[constant["relation"]], name


def test_of_what_is_absent_nothing_is_called_proved(tmp_path):
    policy = load_policy(POLICIES / "pendulum.pt")
    record = {name: value for name, value in policy.training.items() if name != "K"}
    save_policy(tmp_path / "p.pt", replace(policy, training=record | {"reward_weights": [0.0, 1.0]}))
    shown = CliRunner().invoke(app, ["theory", str(tmp_path / "p.pt"), "--states", "2"])
    assert shown.exit_code == 0, shown.stderr
    lines = [line for line in shown.stdout.splitlines() if " none " in line]
    assert len(lines) >= 6 and not any("proved" in line for line in lines)


@pytest.mark.parametrize("change", [{"dt": 1000.0}, {"reward_weights": [1e-300, 1e300]}])
def test_numbers_beyond_floats_show_nothing_and_end_nothing(change):
    """exp(A dt) of a plant that falls over has no float at such a dt."""
    policy = load_policy(POLICIES / "pendulum.pt")
    found = _constants(replace(policy, training={**policy.training, **change}), None)
    assert found["a_V"].value is None and "not shown" in found["a_V"].by


def test_a_gain_that_is_met_but_for_rounding_has_a_distance():
    """An entry whose ball has 0 within it has no square in Arb."""
    off = flint.arb_mat([[flint.arb(0, 1e-20), flint.arb(3)]])
    found = module._distance(off, np.array([[0.0, 1.0]]))
    assert 4.0 <= found.value < 4.0 + 1e-14
    with pytest.raises(InputError, match="`distance` must be finite"):
        module._distance(flint.arb_mat([[flint.arb.nan()]]), np.array([[0.0]]))


@pytest.mark.parametrize(
    "change", [{"value": math.inf}, {"value": math.nan}, {"relation": "="}, {"relation": "<=", "how": "recorded"}]
)
def test_a_constant_is_a_finite_bound_or_read(change):
    arguments = {"name": "a_V", "value": 1.0, "relation": "<=", "how": "proved", "by": "hand"}
    with pytest.raises(InputError, match="a_V"):
        Constant(**{**arguments, **change})
