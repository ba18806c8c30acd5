"""Where a loop rests that does not rest at the origin, and what is claimed then."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import flint
import mpmath
import numpy as np
import pytest

from certify.analysis.acceptance import _lowered
from certify.analysis.maximise import certify_largest
from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import Certificate, PartitionTree, read_certificate, run_checker
from certify.certificates.claims import Asymptotic, Nearby
from certify.certificates.membership import proved_set
from certify.certificates.verdict import Stop, Verdict
from certify.cli.main import _run
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.equilibrium import Rest, find_rest, seen_from
from certify.loop.expressions import Expression, Number, atan, exp, heaviside, sin, symbols
from certify.loop.float32 import float_error
from certify.loop.plants import System, domain_of_values, get_system, load_system
from certify.loop.policies import Policy, PolicyNetwork, load_policy, save_policy
from certify.loop.rigorous import field_on, precision
from certify.lyapunov.function import Quadratic
from controllers.evaluation.proved_set import count_covered, require_same_loop, require_same_question
from tests.support.loops import box, units_apart

PLAIN = Path(__file__).parent.parent.parent / "examples" / "policies" / "without_gain" / "pendulum.pt"
LITTLE = ["roa", "--policy", str(PLAIN), "--candidate", "lqr", "--effort", "0.02"]


def scalar(f: Expression, weight: float, bias: float, clip: tuple[float, float] | None = None) -> ClosedLoop:
    """xdot = f(x, u), u = clip(weight x + bias)."""
    x, u = symbols("x u")
    system = System("s", (x,), (u,), {}, (f,), (Number(0),), box(3), box(9))
    bounds = None if clip is None else (np.array([clip[0]]), np.array([clip[1]]))
    network = PolicyNetwork.of_layers(
        (np.array([[weight]]),), (np.array([bias]),), np.ones(1), np.zeros(1), "identity", "none", clip=bounds
    )
    return ClosedLoop(system, network)


x, u = symbols("x u")


@pytest.mark.parametrize("bias", [0.25, -0.3, 1e-9])
def test_the_digits_are_the_roots(bias: float) -> None:
    """sin x - x/2 ... = 0 against fifty digits of another library."""
    found = find_rest(scalar(sin(x) / 2 + u, -1.0, bias))
    assert found is not None and found.stable
    mpmath.mp.dps = 50
    truth = mpmath.findroot(lambda v: mpmath.sin(v) / 2 - v + mpmath.mpf(bias), bias)
    assert abs(mpmath.mpf(found.x[0]) - truth) <= abs(truth) * mpmath.mpf(10) ** -11
    slope = mpmath.cos(truth) / 2 - 1
    assert abs(complex(found.eigenvalues[0]) - complex(slope)) < 1e-5
    assert abs(mpmath.mpf(found.u[0]) - (mpmath.mpf(bias) - truth)) <= mpmath.mpf(10) ** -11


def test_a_clip_that_acts_at_rest_leaves_the_plant_alone_there() -> None:
    """xdot = -x + u with u = clip(0.5 - x, 1/4, 1): the loop would rest at 1/4 exactly on the bound's edge; at 0.2 with
    a bound of 0.2, where the input is held and the only eigenvalue is the plant's."""
    found = find_rest(scalar(-x + u, -1.0, 0.5, (-1.0, 0.125)))
    assert found is not None and found.x == ("0.125000000000",) and found.eigenvalues == ("-1",)
    edge = find_rest(scalar(-x + u, -1.0, 0.5, (-1.0, 0.25)))
    assert edge is None or edge.x == ("0.250000000000",)


def test_a_rest_that_is_not_stable_is_not_called_so() -> None:
    found = find_rest(scalar(x + u, 0.5, 0.25))
    assert found is not None and not found.stable and found.eigenvalues == ("1.5",)


def test_units_change_the_digits_alone(tmp_path: Path) -> None:
    """A microactuator in metres and coulombs was not seen to rest anywhere, and its set had 896,039 boxes."""
    found = [find_rest(ClosedLoop(*units_apart(unit, 0.01))) for unit in (Fraction(1), Fraction(1, 10**13))]
    one, small = (None if rest is None else Fraction(rest.x[0]) for rest in found)
    assert one is not None and small is not None and abs(small * 10**13 / one - 1) < Fraction(1, 10**11)
    unit = Fraction(1, 10**9)
    proved = certify_roa(*units_apart(unit, 0.01), tmp_path, RoaOptions(candidate="lqr", effort=0.1))
    assert proved.verdict is Verdict.PROVED and proved.claim == "nearby" and (proved.volume or 0) > 2 * unit


@pytest.mark.parametrize("candidate", ["auto", "lqr"])
def test_a_loop_that_is_not_stable_there_is_told_so(tmp_path: Path, candidate: Literal["auto", "lqr"]) -> None:
    """Nothing is refuted: a floor may hold what leaves the point. A V that somebody gives is tried."""
    loop = scalar(x - x**3 + u, 0.5, 0.25)
    result = certify_roa(
        loop.system, loop.network, tmp_path, RoaOptions(candidate=candidate, around="origin", effort=0.2)
    )
    assert (result.verdict, result.stop, result.P) == (Verdict.UNKNOWN, Stop.UNSTABLE, None)
    assert result.reason == "unstable linearisation: eigenvalues 1.5 where V is to be 0"
    given = RoaOptions(P=np.eye(1), around="origin")
    proved = certify_roa(loop.system, loop.network, tmp_path, given)
    assert proved.verdict is Verdict.PROVED and proved.levels.floor is not None
    assert proved.levels.floor > 1.0  # both stable points lie inside


@pytest.mark.parametrize("f", [1 + x**2 + 0 * u, x**2 + u])
def test_what_is_not_shown_is_not_said(f: Expression) -> None:
    """No point of rest at all; and a double one, which the test cannot tell from none."""
    assert find_rest(scalar(f, 0.0, 0.0)) is None


def test_practical_stability_is_claimed_where_the_policy_is_not_centred(tmp_path: Path) -> None:
    policy = load_policy(PLAIN)
    system = get_system("pendulum").with_parameters(policy.parameters)
    options = RoaOptions(candidate="lqr", around="origin")
    result = certify_roa(system, policy.network, tmp_path, options)
    assert result.verdict is Verdict.PROVED and result.claim == "nearby"
    assert result.notice is not None and "not centred" in result.notice
    data = result.to_dict()
    assert data["claim"] == {"kind": "nearby"} and data["rest"]["stable"] is True
    theta = float(data["rest"]["x"][0])
    loop = ClosedLoop(system, policy.network)
    f = system.function()
    rest = np.array([theta, 0.0])
    assert np.abs(f(rest, loop.policy(rest[None])[0])).max() < 1e-9
    assert result.P is not None and result.levels.floor is not None
    assert rest @ result.P @ rest <= result.levels.floor  # what rests is inside the small set
    with pytest.raises(InputError, match="not centred"):
        certify_roa(system, policy.network, tmp_path, RoaOptions(claim="asymptotic"))


def test_the_command_centres_on_request_and_says_what_that_changes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [*LITTLE, "--out", str(tmp_path), "--json"]
    assert _run([*command, "--claim", "practical"], True) == 0
    further = json.loads(capsys.readouterr().out)["diagnosis"]["next"]
    assert further["options"] == {"--centre": "preactivation", "--claim": "auto"}
    assert _run(shlex.split(further["command"])[1:], True) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["claim"] == {"kind": "asymptotic"}
    assert "changes u by up to" in captured.err
    assert _run([*command, "--squash", "tanh"], True) == 2 and "must be left out" in capsys.readouterr().out
    shipped = str(PLAIN.parent.parent / "pendulum.pt")
    assert _run(["roa", "--policy", shipped, "--centre", "output", "--out", str(tmp_path)], False) == 2
    assert "must be left out" in capsys.readouterr().err


def test_a_loop_that_rests_at_the_origin_gets_the_stronger_claim(tmp_path: Path) -> None:
    loop = scalar(x / 2 + u, -1.0, 0.0)
    result = certify_roa(loop.system, loop.network, tmp_path, RoaOptions(candidate="lyapunov", effort=0.2))
    assert result.claim == "asymptotic" and result.rest is None and result.notice is None
    assert loop.system.domain == ((Fraction(-3), Fraction(3)),)


# ------------------------------------------------------------------------------------------ seen from where it rests


def bent(centre: Literal["none", "output"] = "none", **changes: Any) -> ClosedLoop:
    """Two states with an operating point, an uncertain parameter, a disturbance and a product of state and input."""
    a, b, c, d, v = symbols("a b c d v")
    f = (b + c * sin(a) / 8, -2 * b - sin(a) + v * (1 + a / 4) + d)
    system = System(
        "bent", (a, b), (v,), {"c": Fraction(1)}, f, (Number(0),), box(2, 3), box(9),
        x_eq=(Fraction(1, 3), Number(0)), disturbances=(d,), **changes,
    )  # fmt: skip
    generator = np.random.default_rng(5)
    layers = (generator.standard_normal((5, 2)), np.array([[0.3, -0.2, 0.1, 0.4, -0.5]]))
    biases = generator.uniform(-1, 1, 5), np.array([0.25])
    network = PolicyNetwork.of_layers(layers, biases, np.ones(1), np.zeros(1), "identity", centre)
    return ClosedLoop(system, network)


@pytest.mark.parametrize("time", ["continuous", "discrete"])
def test_seen_from_elsewhere_it_is_the_same_loop(time: Literal["continuous", "discrete"]) -> None:
    """F_moved(x) = F(origin + x), or less the origin in discrete time, at fifty digits; places keep their values."""
    ranges = {"c": (Fraction(1, 2), Fraction(2)), "d": (Fraction(-1, 9), Fraction(1, 9))}
    loop = bent(time=time, ranges=ranges)
    moved = seen_from(loop, Rest(("0.3125", "-0.75"), ("0.5",), (), True))
    assert moved.network.origin.tolist() == [0.3125, -0.75] and moved.u_eq == (Fraction(1, 2),)
    assert domain_of_values(moved.system) == domain_of_values(loop.system)
    assert moved.system.exact_x_eq() == (Fraction(1, 3) + Fraction(5, 16), Fraction(-3, 4))
    assert moved.system.ranges == loop.system.ranges and moved.network.sha256() == loop.network.sha256()
    generator = np.random.default_rng(1)
    for _ in range(20):
        at = generator.uniform(-1, 1, 2)
        x = [Fraction(float(v)) for v in at]
        there = [v + Fraction(float(o)) for v, o in zip(x, moved.network.origin, strict=True)]
        with precision(200):
            here, _ = field_on(moved, [flint.arb(flint.fmpq(v.numerator, v.denominator)) for v in x])
            before, _ = field_on(loop, [flint.arb(flint.fmpq(v.numerator, v.denominator)) for v in there])
            shift = [0.0, 0.0] if time == "continuous" else moved.network.origin.tolist()
            for v, w, o in zip(here, before, shift, strict=True):
                assert v.overlaps(w - flint.arb(o)) and v.rad() < 1e-50
        assert np.allclose(moved.policy(at), loop.policy(at + moved.network.origin), rtol=0, atol=1e-14)


def test_a_point_of_rest_that_newton_misses_is_found_along_a_trajectory() -> None:
    """On the way from 0 to the point of rest at 1 the rate rises before it falls, and Newton's steps lead away."""
    flat = atan(200 * (1 - x)) + exp(-40 * x**2) * 3 * x + 0 * u
    found = find_rest(scalar(flat, 0.0, 0.0))
    assert found is not None and abs(float(found.x[0]) - 1) < 1e-12 and found.stable


@pytest.mark.parametrize("around", ["auto", "rest"])
def test_the_set_lies_around_where_the_loop_rests(tmp_path: Path, around: Literal["auto", "rest"]) -> None:
    policy = load_policy(PLAIN)
    system = get_system("pendulum").with_parameters(policy.parameters)
    result = certify_roa(system, policy.network, tmp_path, RoaOptions(candidate="lqr", around=around, effort=0.02))
    assert result.verdict is Verdict.PROVED and result.claim == "nearby" and result.certificate is not None
    assert run_checker(result.certificate, "reference")["result"] == "ACCEPTED"
    assert result.rest is not None and result.levels.floor is not None and result.P is not None
    at = np.array([float(v) for v in result.rest.x])
    values = np.array([float(q) for q in result.system.exact_x_eq()])
    assert np.abs(values - at).max() < 1e-11 and at[0] < -0.08
    assert domain_of_values(result.system) == domain_of_values(system)
    assert result.levels.floor < 1e-6 * result.P[0, 0] * at[0] ** 2  # the small set leaves the origin out
    assert result.contains(at) and not result.contains([3.1, 19.0])
    read = read_certificate(result.certificate)
    assert read.network.origin.tolist() == values.tolist() and read.network.sha256() == policy.network.sha256()
    f = read.system.function()
    if around == "rest":
        page = result.report(tmp_path / "report.html").read_text("utf-8")
        assert (
            f"seen from there: its layers read −{-at[0]:.9f}"[:40] in page
            and "its layers read" in page.split("Numbers")[-1]
        )
        said = [run_checker(result.certificate, program) for program in ("checker", "reference")]
        assert all(answer["origin"] == values.tolist() for answer in said)
        assert all(repr(float(values[0])) in "".join(answer["text"]) for answer in said)
    assert np.abs(f(np.zeros(2), ClosedLoop(read.system, read.network).policy(np.zeros((1, 2)))[0])).max() < 1e-9


def test_what_is_given_in_deviations_from_the_origin_stays_there(tmp_path: Path) -> None:
    policy = load_policy(PLAIN)
    system = get_system("pendulum").with_parameters(policy.parameters)
    for given in (RoaOptions(P=np.diag([30.0, 1.0])), RoaOptions(level=2.0)):
        result = certify_roa(system, policy.network, tmp_path, replace(given, claim="practical"))
        assert result.rest is not None and not any(result.system.exact_x_eq()) and not result.network.is_moved


def test_without_a_stable_point_of_rest_it_is_not_asked_for(tmp_path: Path) -> None:
    loop = scalar(x + u, 0.5, 0.25)
    for options in (RoaOptions(around="rest"), RoaOptions(around="rest", claim="practical")):
        with pytest.raises(InputError, match="stable equilibrium"):
            certify_roa(loop.system, loop.network, tmp_path, options)
    with pytest.raises(InputError, match="`around` rest needs another `claim`"):
        RoaOptions(around="rest", claim="asymptotic")
    loop = bent("output")
    with pytest.raises(InputError, match="without centring"):
        certify_roa(loop.system, loop.network, tmp_path, RoaOptions(around="rest", claim="practical"))


def test_a_policy_seen_from_elsewhere_is_neither_saved_nor_called_centred(tmp_path: Path) -> None:
    loop = bent()
    network = replace(loop.network, origin=np.array([0.5, 0.0]))
    with pytest.raises(InputError, match="as its layers read it"):
        save_policy(tmp_path / "p.pt", Policy(network, "bent"))
    with pytest.raises(InputError, match="`origin` must be 0 of a policy that is centred"):
        replace(network, centre="output")
    evidence, claim = PartitionTree(np.eye(2), np.ones(2), b"\xff"), Asymptotic(roa=1.0, local=0.5)
    with pytest.raises(InputError, match="`origin` of a policy must be 0"):
        Certificate(loop.system, network, Quadratic(np.eye(2)), claim, evidence)
    with pytest.raises(InputError, match="without centring, as it is"):
        seen_from(ClosedLoop(loop.system, network), Rest(("0.25", "0"), ("0",), (), True))
    with pytest.raises(InputError, match="without centring, as it is"):
        seen_from(bent("output"), Rest(("0.25", "0"), ("0",), (), True))
    with pytest.raises(InputError, match="as its layers read it"):
        float_error(network, loop.system)
    with pytest.raises(InputError, match=r"`origin` must have shape \(2,\)"):
        replace(network, origin=np.ones(3))


def test_a_set_around_the_rest_is_told_from_one_around_another_point(tmp_path: Path) -> None:
    """A policy's hash is the same from wherever it is looked at: what is compared is the loop in its own deviations."""
    policy = load_policy(PLAIN)
    system = get_system("pendulum").with_parameters(policy.parameters)
    result = certify_roa(system, policy.network, tmp_path, RoaOptions(candidate="lqr", effort=0.1))
    assert result.certificate is not None and result.rest is not None
    proved = proved_set(result.certificate)
    require_same_question(proved, policy.network, system)
    rest = [float(v) for v in result.rest.x]
    edge = float(
        np.max(np.abs(np.linalg.inv(proved.ellipsoids[0].P).diagonal()[0] * proved.ellipsoids[0].level)) ** 0.5
    )
    certificate, problem = read_certificate(result.certificate), result.problem
    assert problem is not None and certificate.kind == "nearby"
    floor = result.levels.floor or 0.0
    above = replace(certificate, claim=replace(certificate.claim, local=4 * floor))
    refusals = [{"rule": rule, "at": at} for rule, at in (("ring", "leaf 0"), ("local", ""), ("contraction", ""))]
    below, higher, without = (_lowered(above, answer, problem, 2) for answer in refusals)
    assert below is not None and below.kind == "nearby" and below.claim.inner < below.roa < certificate.roa
    assert higher is not None and isinstance(higher.claim, Nearby) and higher.claim.floor == 1.5 * floor
    assert without is not None and without.kind == "practical" and without.roa == certificate.roa
    states = np.array([rest, [rest[0] + 0.999 * edge, rest[1]], [rest[0] + 1.001 * edge, rest[1]]])
    expected = [bool(v) for v in result.contains(states)]
    assert proved.holds(proved.deviations(states.tolist())) == expected and expected[0] and not expected[-1]
    assert count_covered(proved, policy.network, system, states).inside == sum(expected)
    for other in (replace(proved, origin=()), replace(proved, origin=(0.0, 0.25)), replace(proved, origin=(9.0, 0.0))):
        with pytest.raises(InputError):
            require_same_loop(other, policy.network, system)
    with pytest.raises(InputError, match="`domain`"):
        require_same_question(proved, policy.network, system.with_domain({"theta": (Fraction(-3), Fraction(3))}))


def test_what_is_asked_of_a_set_is_about_its_own_point(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`--contains` names values: 2.8 lies outside, and would lie inside if it were a deviation; -2.9 the other way."""
    command = [*LITTLE, "--out", str(tmp_path), "--json", "--contains"]
    for states, inside in (("theta=2.8", False), ("theta=-2.9", True)):
        assert _run([*command, states], True) == 0
        said = json.loads(capsys.readouterr().out)["contains"]
        assert said["result"] == ("contained" if inside else "not contained")
        assert said["box"]["theta"] == [str(Fraction(states.split("=")[1]))] * 2
        assert _run(["contains", str(tmp_path / "certificate.json"), states, "--json"], True) == int(not inside)
        assert json.loads(capsys.readouterr().out)["result"] == said["result"]
    assert _run([*command, "omega=1"], True) == 2 and "no state 'omega'" in capsys.readouterr().out


@pytest.mark.slow
def test_the_largest_rate_is_of_the_set_around_the_rest(tmp_path: Path) -> None:
    policy = load_policy(PLAIN)
    system = get_system("pendulum").with_parameters(policy.parameters)
    result = certify_largest("rate", system, policy.network, tmp_path, RoaOptions(candidate="lqr", effort=0.1))
    assert result.verdict is Verdict.PROVED and result.certificate is not None and result.rest is not None
    assert result.problem is not None and result.problem.rate > 0.5
    read = read_certificate(result.certificate)
    assert read.network.is_moved and read.system.exact_x_eq()[0] < 0 and result.contains([-0.0843, 0.0])


def test_in_discrete_time_it_is_a_fixed_point() -> None:
    """x+ = x/2 + u, u = 1/4 - x/4, rests at 1/3, where a step multiplies a deviation by 1/4."""
    loop = scalar(x / 2 + u, -0.25, 0.25)
    found = find_rest(ClosedLoop(replace(loop.system, time="discrete"), loop.network))
    assert found is not None and found.stable and found.x == ("0.333333333333",) and found.u == ("0.166666666667",)
    assert found.eigenvalues == ("0.25",)
    for gain, stable in ((-1.25, True), (-1.75, False)):  # it turns around, by 0.75 and by 1.25
        turned = scalar(x / 2 + u, gain, 0.25)
        found = find_rest(ClosedLoop(replace(turned.system, time="discrete"), turned.network))
        assert found is not None and found.stable is stable
        assert found.x == (f"{0.25 / (0.5 - gain):.12f}",)


def test_no_rest_is_enclosed_across_a_jump() -> None:
    """A step leads away from the jump on either side, by more than what floats see."""
    p, v, u = symbols("p v u")
    at = Fraction(1, 10**21)
    away = 2 * p - 2 * at + 2 * at * heaviside(p - at)
    system = System("jump", (p, v), (u,), {}, (away, v / 2), (Number(0),), box(1, 1), box(1), time="discrete")
    network = PolicyNetwork.of_layers((np.zeros((1, 2)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    assert find_rest(ClosedLoop(system, network)) is None


@pytest.mark.slow
def test_a_range_moves_the_fixed_point_of_a_map(tmp_path: Path) -> None:
    """The Henon map whose a has a range: practically stable for any a(k), and for each a with one fixed point."""
    folder = Path(__file__).parents[2] / "examples"
    system = load_system(folder / "plants" / "henon.toml").with_ranges({"a": (Fraction(139, 100), Fraction(141, 100))})
    policy = load_policy(folder / "policies" / "henon.pt")
    result = certify_roa(system, policy.network, tmp_path, RoaOptions(candidate="lyapunov", effort=0.06))
    assert result.verdict is Verdict.PROVED and result.claim == "nearby" and result.certificate is not None
    assert result.levels.floor is not None and result.levels.floor < 1e-2
    certificate = read_certificate(result.certificate)
    V, loop = certificate.V.P, ClosedLoop(system, policy.network)
    states = np.linalg.solve(np.linalg.cholesky(V).T, np.array([[1.0, 0.0, -0.7], [0.0, -1.0, 0.7]])).T
    for a in ("1.39", "1.4", "1.41"):
        f, x = system.with_parameters({"a": a}).function(), states * np.sqrt(certificate.roa)
        for _ in range(2000):
            x = np.stack([f(v, loop.policy(v[None])[0]) for v in x])
        assert np.ptp(x, axis=0).max() < 1e-9 and x[0] @ V @ x[0] <= result.levels.floor


def test_a_stable_equilibrium_is_preferred() -> None:
    """x' = (x + 3/10)(1 - x): Newton's method goes from 0 to -3/10, the trajectory to 1."""
    x, u = symbols("x u")
    system = System("two", (x,), (u,), {}, ((x + Fraction(3, 10)) * (1 - x) + u,), (Number(0),), box(2), box(9))
    none = PolicyNetwork.of_layers((np.zeros((1, 1)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    rest = find_rest(ClosedLoop(system, none))
    assert rest is not None and rest.stable and float(rest.x[0]) == pytest.approx(1)
