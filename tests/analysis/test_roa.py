"""Known answers through the whole pipeline, checker included."""

from __future__ import annotations

import copy
import dataclasses
import json
import pickle
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import flint
import numpy as np
import pytest
import scipy.linalg
import sympy
from torch import Tensor

from certify.analysis import acceptance
from certify.analysis.candidates.trials import Trial, trial
from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import Certificate, checking, run_checker, sole_writer
from certify.certificates.claims import Problem
from certify.certificates.located import Containment
from certify.certificates.verdict import Verdict
from certify.effort import WHOLE
from certify.errors import BackendError, InputError, SoundnessError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, Number, Symbol, sin, symbols
from certify.loop.plants import System, get_system
from certify.loop.policies import PolicyNetwork, bounded_by_form, load_policy
from certify.lyapunov import domain_limit, leaves_domain, solve_lyapunov
from certify.lyapunov.function import Quadratic
from certify.provers.base import Progress
from certify.provers.boxes.rule import BoxBounds, VdotBound
from certify.provers.falsify import Witness, refutes
from certify.report.rows import rows_of
from tests.support.loops import box, chain, pendulum_network, scalar_tanh
from tests.support.marks import slow_after

SHIPPED = Path(__file__).parent.parent.parent / "examples" / "policies" / "pendulum.pt"

QUICK = RoaOptions(effort=0.2)


@pytest.mark.parametrize("n", slow_after(1, [3, 2, 4, 5, 6]))
def test_linear_plants_reach_their_domain(tmp_path: Path, n: int) -> None:
    system, network = chain(n, [-1.0 - k for k in range(n)])
    result = certify_roa(system, network, tmp_path, RoaOptions(candidate="ellipsoid", effort=0.2))
    assert result.verdict is Verdict.PROVED and result.reason == "domain"
    # The limit in exact rationals, from the binary64 P that was proved.
    assert result.P is not None
    inverse = sympy.Matrix([[sympy.Rational(float(v)) for v in row] for row in result.P]).inv()
    limit = min(
        Fraction(hi) ** 2 / Fraction(int(inverse[i, i].p), int(inverse[i, i].q))
        for i, (_, hi) in enumerate(system.domain)
    )
    level = result.levels.roa
    assert level is not None
    assert 0.99 * float(limit) <= level and Fraction(level) < limit


def test_P_of_a_linear_plant_in_exact_rationals(tmp_path: Path) -> None:
    system, network = chain(2, [-1.0, -2.0])
    result = certify_roa(system, network, tmp_path, RoaOptions(candidate="lyapunov"))
    np.testing.assert_allclose(result.P, [[1.25, 0.25], [0.25, 0.25]], rtol=1e-14)


def test_a_pole_in_the_right_half_plane_is_refused(tmp_path: Path) -> None:
    system, network = chain(3, [-1.0, -2.0, 0.5])
    result = certify_roa(system, network, tmp_path)
    assert result.verdict is Verdict.REFUTED
    assert "unstable" in result.reason and "0.5" in result.reason
    assert not (tmp_path / "certificate.json").exists()


def test_a_spectrum_on_the_axis_is_unknown(tmp_path: Path) -> None:
    system, network = chain(2, [1j, -1j])
    result = certify_roa(system, network, tmp_path)
    assert result.verdict is Verdict.UNKNOWN and "axis" in result.reason


@pytest.mark.parametrize(
    ("x", "verdict"),
    [
        (1.0, Verdict.PROVED),
        (1.915, Verdict.PROVED),
        (1.915008, Verdict.PROVED),
        (1.915009, Verdict.REFUTED),
        (2.5, Verdict.REFUTED),
    ],
)
def test_scalar_plant_just_inside_and_just_outside(tmp_path: Path, x: float, verdict: Verdict) -> None:
    result = certify_roa(*scalar_tanh(), tmp_path, RoaOptions(level=x * x))
    assert result.verdict is verdict
    if verdict is Verdict.PROVED:
        assert result.levels.roa == x * x
    else:
        assert result.witness is not None and result.witness.level <= x * x
        assert not (tmp_path / "certificate.json").exists()


def test_scalar_plant_largest_level(tmp_path: Path) -> None:
    result = certify_roa(*scalar_tanh(), tmp_path, QUICK)
    level = result.levels.roa
    assert result.verdict is Verdict.PROVED and result.reason == "witness"
    assert level is not None and 0.99 * 1.915008**2 < level < 1.915009**2


def test_a_level_outside_the_domain(tmp_path: Path) -> None:
    assert certify_roa(*scalar_tanh(), tmp_path, RoaOptions(level=9.5)).verdict is Verdict.REFUTED


@pytest.mark.parametrize("centre", slow_after(1, ["preactivation", "output"]))
def test_a_wrong_raw_equilibrium_is_centred(tmp_path: Path, pendulum: System, centre: str) -> None:
    network = pendulum_network(centre=centre)
    result = certify_roa(pendulum, network, tmp_path, QUICK)
    assert result.verdict is Verdict.PROVED and result.checker is not None
    assert result.checker["result"] == "ACCEPTED"


def test_uncentred_or_displaced_loops_are_refused(tmp_path: Path, pendulum: System) -> None:
    with pytest.raises(InputError, match="not centred"):
        certify_roa(pendulum, pendulum_network(centre="none"), tmp_path, RoaOptions(claim="asymptotic"))
    x, u = symbols("x u")
    displaced = System("s", (x,), (u,), {}, (u - x + 1,), (Number(0),), box(1), box(1))
    with pytest.raises(InputError, match="must be exactly 0"):
        certify_roa(displaced, scalar_tanh()[1], tmp_path, RoaOptions(claim="asymptotic"))


def test_levels_scale_with_P(tmp_path: Path, pendulum: System) -> None:
    """(P, c) -> (aP, ac) leaves the set as it is."""
    network = pendulum_network((8, 8))
    base = certify_roa(pendulum, network, tmp_path, QUICK)
    assert base.P is not None and base.levels.roa is not None
    scaled = certify_roa(pendulum, network, tmp_path, RoaOptions(P=4.0 * base.P, effort=0.2))
    assert scaled.levels.roa == pytest.approx(4.0 * base.levels.roa, rel=1e-5)


def test_the_lqr_candidate_solves_its_equation(tmp_path: Path, pendulum: System) -> None:
    from certify.loop.closed_loop import ClosedLoop

    network = pendulum_network()
    result = certify_roa(pendulum, network, tmp_path, RoaOptions(candidate="lqr", R=(2.0,)))
    A, _, K = ClosedLoop(pendulum, network).linearise()
    np.testing.assert_allclose(result.P, solve_lyapunov(A, np.eye(2) + 2 * K.T @ K), rtol=1e-12)
    assert result.verdict is Verdict.PROVED


def test_input_bounds_limit_the_level(tmp_path: Path) -> None:
    """u = -1.5 x with |u| <= 1 on xdot = x/2 + u: V = x^2 / 2, so c <= (2/3)^2 / 2."""
    x, u = symbols("x u")
    system = System("s", (x,), (u,), {}, (x / 2 + u,), (Number(0),), box(3), box(1))
    network = PolicyNetwork.of_layers(
        (np.array([[-1.5]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )
    result = certify_roa(system, network, tmp_path, RoaOptions(candidate="lyapunov"))
    assert result.verdict is Verdict.PROVED and result.reason == "inputs"
    level = result.levels.roa
    assert level is not None and 0.99 * (4 / 9) / 2 < level < (4 / 9) / 2


def test_an_exact_level_is_unknown_when_the_budget_runs_out(tmp_path: Path, pendulum: System) -> None:
    result = certify_roa(pendulum, pendulum_network(), tmp_path, RoaOptions(level=6.0, max_boxes=10))
    assert result.verdict is Verdict.UNKNOWN and result.reason.startswith("boxes")
    assert not (tmp_path / "certificate.json").exists()


def test_the_largest_level_within_a_budget_is_still_proved(tmp_path: Path, pendulum: System) -> None:
    result = certify_roa(pendulum, pendulum_network(), tmp_path, RoaOptions(candidate="lyapunov", max_boxes=150))
    full = certify_roa(pendulum, pendulum_network(), tmp_path, RoaOptions(candidate="lyapunov"))
    assert result.verdict is Verdict.PROVED and result.reason == "boxes"
    local, level, best = result.levels.local, result.levels.roa, full.levels.roa
    assert local is not None and level is not None and best is not None
    assert local <= level < best


def test_the_shipped_policy(tmp_path: Path, pendulum: System) -> None:
    policy = load_policy(SHIPPED)
    assert policy.network.layers == (2, 16, 16, 1)
    result = certify_roa(pendulum.with_parameters(policy.parameters), policy.network, tmp_path, QUICK)
    assert result.verdict is Verdict.PROVED
    roa, limit = result.levels.roa, result.levels.domain_limit
    sampled = result.levels.sampled_limit
    assert roa is not None and limit is not None
    assert roa >= 0.95 * min(limit, sampled if sampled is not None else np.inf)
    data = json.loads(json.dumps(result.to_dict()))
    assert data["checked"] == "ACCEPTED" and data["levels"]["roa"] == roa
    assert set(data["seconds"]) == {
        "load", "data", "candidate", "local", "ring", "tube",
        "simulate", "learn", "outer", "ranks", "write", "check", "report", "total",
    }  # fmt: skip
    assert run_checker(tmp_path / "certificate.json")["policy_sha256"] == policy.network.sha256()


def test_equal_runs_write_equal_certificates(tmp_path: Path, pendulum: System) -> None:
    for name in ("a", "b"):
        certify_roa(pendulum, pendulum_network((8, 8)), tmp_path / name, QUICK)
    assert (tmp_path / "a" / "certificate.json").read_bytes() == (tmp_path / "b" / "certificate.json").read_bytes()


def test_a_file_that_says_more_than_was_meant_is_a_soundness_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the certificate that is accepted in the end states other levels than the result, the run ends loudly."""
    honest = Certificate.to_json

    def exaggerate(certificate: Certificate) -> str:
        claim = dataclasses.replace(certificate.claim, roa=certificate.roa * 1.5)
        return honest(dataclasses.replace(certificate, claim=claim))

    monkeypatch.setattr(Certificate, "to_json", exaggerate)
    with pytest.raises(SoundnessError, match="other levels"):
        certify_roa(*scalar_tanh(), tmp_path, RoaOptions(candidate="lyapunov"))
    assert not (tmp_path / "certificate.json").exists()


@pytest.mark.parametrize("trust", slow_after(1, [0.1, 1e6]))
def test_whatever_the_checker_refuses_a_run_ends_with_what_it_accepts(
    tmp_path: Path, pendulum: System, monkeypatch: pytest.MonkeyPatch, trust: float
) -> None:
    """An engine that takes bounds for negative that are not: barely so, where leaves are split again, or at all."""
    honest = VdotBound.__call__

    def careless(self: VdotBound, lo: Tensor, hi: Tensor, inner: float, outer: float) -> BoxBounds:
        found = honest(self, lo, hi, inner, outer)
        return found._replace(proved=found.bound < trust)

    options = RoaOptions(candidate="lyapunov", effort=0.2)
    network = pendulum_network()
    true = certify_roa(pendulum, network, tmp_path / "true", options).levels
    monkeypatch.setattr(VdotBound, "__call__", careless)
    result = certify_roa(pendulum, network, tmp_path / "careless", options)
    assert result.verdict is Verdict.PROVED and result.checker is not None
    assert result.notice is not None and "the checker refused leaf" in result.notice
    assert result.levels.roa is not None and true.roa is not None and true.local is not None
    assert true.local <= result.levels.roa <= true.roa * (1 + 1e-9)
    assert result.checker["levels"] == {"local": result.levels.local, "roa": result.levels.roa}
    assert run_checker(tmp_path / "careless" / "certificate.json")["result"] == "ACCEPTED"
    assert not list((tmp_path / "careless").glob("*.unchecked.json"))


def test_what_cannot_be_mended_is_a_soundness_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "certify.analysis.acceptance.run_checker",
        lambda *_, **__: {"result": "REJECTED", "rule": "hash", "at": "policy"},
    )
    with pytest.raises(SoundnessError, match=r"rejects what the engine proved.*unchecked\.json reproduces"):
        certify_roa(*scalar_tanh(), tmp_path, RoaOptions(candidate="lyapunov"))
    assert not (tmp_path / "certificate.json").exists()
    assert len(list(tmp_path.glob("*.unchecked.json"))) == 1


def test_a_checker_that_cannot_run_is_a_backend_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.executable", "/bin/false")
    with pytest.raises(BackendError, match="no verdict"):
        certify_roa(*scalar_tanh(), tmp_path, QUICK)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"level": -1.0}, "level"),
        ({"level": float("nan")}, "level"),
        ({"candidate": "sos"}, "candidate"),
        ({"time_limit": 0.0}, "time_limit"),
    ],
)
def test_bad_options(options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        RoaOptions(**options)  # type: ignore[arg-type]


def test_bad_weights(tmp_path: Path) -> None:
    for weights in ((1.0, 1.0), (0.0,), (float("nan"),)):
        with pytest.raises(InputError, match="positive numbers"):
            certify_roa(*scalar_tanh(), tmp_path, RoaOptions(Q=weights))


def test_a_verdict_is_not_a_bool() -> None:
    with pytest.raises(TypeError, match="is no bool"):
        bool(Verdict.PROVED)
    assert {v.name: v.exit_status for v in Verdict} == {"PROVED": 0, "TRUSTED": 3, "REFUTED": 1, "UNKNOWN": 3}


def test_a_verdict_is_equal_to_its_name_and_to_no_other_text() -> None:
    for verdict in Verdict:
        assert [one for one in Verdict if one == verdict.value] == [verdict]
        assert verdict != Verdict("UNKNOWN" if verdict is Verdict.PROVED else "PROVED").value
        assert hash(verdict) == hash(verdict.value) and {verdict: 1}[verdict.value] == 1  # type: ignore[index]
        assert pickle.loads(pickle.dumps(verdict)) is verdict and copy.deepcopy(verdict) is verdict
    for slip in ("proved", "PROOVED", "", "accepted"):
        with pytest.raises(ValueError, match=r"a Verdict must be compared with one of 'PROVED', .*; found"):
            bool(slip == Verdict.PROVED)
        with pytest.raises(ValueError, match="must be compared"):
            bool(slip != Verdict.UNKNOWN)
    assert Verdict.PROVED != 1 and Verdict.PROVED is not None and Containment.CONTAINED != Verdict.PROVED
    assert Containment.CONTAINED == "contained" and Containment.UNDECIDED != "contained"


def test_every_registered_plant_can_be_named() -> None:
    assert get_system("pendulum").name == "pendulum"


def test_two_runs_in_one_folder_do_not_meet(tmp_path: Path) -> None:
    with sole_writer(tmp_path), pytest.raises(InputError, match="another run is writing"):
        certify_roa(*scalar_tanh(), tmp_path, QUICK)
    assert certify_roa(*scalar_tanh(), tmp_path, RoaOptions(level=1.0)).verdict is Verdict.PROVED


def test_an_answer_about_other_bytes_is_no_proof(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another run's certificate is accepted instead of this one's."""
    other = certify_roa(*scalar_tanh(), tmp_path / "other", RoaOptions(level=1.0)).certificate
    assert other is not None
    monkeypatch.setattr("certify.analysis.acceptance.run_checker", lambda *_, **__: run_checker(other))
    with pytest.raises(SoundnessError, match="other bytes"):
        certify_roa(*scalar_tanh(), tmp_path / "mine", RoaOptions(level=2.0))
    assert not (tmp_path / "mine" / "certificate.json").exists()


def test_the_reference_is_asked_where_it_is_quick(tmp_path: Path) -> None:
    result = certify_roa(*scalar_tanh(), tmp_path, QUICK)
    assert result.checker is not None and result.to_dict()["reference"] == "ACCEPTED"
    assert result.checker["reference"]["certificate_sha256"] == result.checker["certificate_sha256"]
    assert dict(rows_of(result.to_dict(), True))["checker"] == "ACCEPTED BY BOTH"
    assert "So did the reference" in result.report().read_text()


def test_what_the_reference_refuses_is_mended_or_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its refusal counts as the checker's does: the leaf is split, then the level lowered."""
    told = list[int]()

    def refusing(path: Path, program: str = "checker", **given: Any) -> dict[str, Any]:
        if program == "checker":
            return run_checker(path, **given)
        told.append(len(path.read_bytes()))
        level = float.fromhex(json.loads(path.read_bytes())["levels"]["roa"])
        return {"result": "REJECTED", "rule": "ring", "at": "leaf 0", "detail": f"{level}"}

    monkeypatch.setattr("certify.analysis.acceptance.run_checker", refusing)
    with pytest.raises(SoundnessError, match=r"rejects what the engine proved.*reference"):
        certify_roa(*scalar_tanh(), tmp_path, QUICK)
    assert len(told) > 3 and told[1] > told[0]  # the first leaf was split


@pytest.mark.parametrize("wrong", ["certificate_sha256", "levels"])
def test_a_reference_s_answer_about_something_else_is_no_proof(
    wrong: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def other(path: Path, program: str = "checker", **given: Any) -> dict[str, Any]:
        answer = run_checker(path, program, **given)
        return answer if program == "checker" else {**answer, wrong: {}}

    monkeypatch.setattr("certify.analysis.acceptance.run_checker", other)
    with pytest.raises(SoundnessError, match="is about other"):
        certify_roa(*scalar_tanh(), tmp_path, QUICK)


@pytest.mark.parametrize("long", ["by its leaves", "by its bytes", "as it turns out"])
def test_a_reference_that_needs_long_is_not_waited_for(
    long: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def alone(path: Path, **options: Any) -> dict[str, Any]:
        if options.get("program") == "reference":
            assert long == "as it turns out" and options["seconds"] == 5
            raise TimeoutError
        return run_checker(path, **options)

    monkeypatch.setattr(acceptance, "run_checker", alone)
    if long != "as it turns out":
        monkeypatch.setattr(acceptance, "_LEAVES" if long == "by its leaves" else "_BYTES", -1)
    result = certify_roa(*scalar_tanh(), tmp_path, QUICK)
    assert result.verdict is Verdict.PROVED and result.to_dict()["reference"] is None
    assert "ACCEPTED BY BOTH" not in dict(rows_of(result.to_dict(), True))["checker"]


def test_the_checker_beside_the_running_package_is_meant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "elsewhere" / "checker"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    (folder / "__main__.py").write_text(
        'def bound_memory():\n    pass\n\n\ndef main(arguments):\n    print(\'{"error": "another"}\')\n    return 70\n'
    )
    monkeypatch.setattr(checking, "__file__", str(tmp_path / "elsewhere" / "certificate" / "checking.py"))
    assert checking.ask(tmp_path) == (70, {"error": "another"})


def test_the_domain_is_decided_in_rationals() -> None:
    """A float inverse of this P is off by more than the slack of 1e-9 that was once left for it."""
    P = scipy.linalg.hilbert(9)
    exact = flint.fmpq_mat(9, 9, [flint.fmpq(*v.as_integer_ratio()) for v in P.ravel().tolist()]).inv()
    limit = min(1 / Fraction(int(exact[i, i].p), int(exact[i, i].q)) for i in range(9))
    assert abs(1 / np.max(np.diag(np.linalg.inv(P))) / float(limit) - 1) > 1e-9
    domain = box(*[1] * 9)
    level = domain_limit(P, domain)
    assert 0 <= float(limit) - level < 1e-15 * level and Fraction(level) <= limit
    assert leaves_domain(P, level, domain) is (Fraction(level) == limit)
    assert not leaves_domain(P, float(np.nextafter(level, 0)), domain)
    assert leaves_domain(P, float(np.nextafter(level, 1)), domain)


def test_a_witness_above_the_level_refutes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    x = np.array([1.9150081])
    loop = ClosedLoop(*scalar_tanh())
    problem = Problem(loop, Quadratic(np.eye(1)))
    witness = Witness(x, float(x[0] ** 2), "vdot")
    exact = Fraction(x[0]) ** 2
    above, below = float(exact), float(exact)
    while Fraction(above) < exact:
        above = float(np.nextafter(above, 9))
    while Fraction(below) >= exact:
        below = float(np.nextafter(below, 0))
    assert refutes(problem, witness, above) and not refutes(problem, witness, below)
    monkeypatch.setattr("certify.analysis.candidates.trials.falsify", lambda *_: witness)
    result = certify_roa(*scalar_tanh(), tmp_path, RoaOptions(level=3.0))
    assert result.verdict is Verdict.PROVED and result.levels.roa == 3.0


def test_a_policy_that_is_nearly_centred_is_named_before_any_work(tmp_path: Path) -> None:
    system, network = scalar_tanh()
    off = network.with_layers(biases=(np.array([1e-12]),))
    with pytest.raises(InputError, match=r"not centred.*practical"):
        certify_roa(system, off, tmp_path, RoaOptions(claim="asymptotic"))


def test_an_equilibrium_that_is_not_decided_in_rationals_is_named(tmp_path: Path) -> None:
    x, u = symbols("x u")
    dynamics = (sin(1 + x) - sin(1) + u,)
    system = System("s", (x,), (u,), {}, dynamics, (Number(0),), box(1), box(9))
    network = PolicyNetwork.of_layers(
        (np.array([[-5.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )
    with pytest.raises(InputError, match="not decided in rationals: sin of 1"):
        certify_roa(system, network, tmp_path, RoaOptions(claim="asymptotic"))


def test_input_bounds_are_decided_in_rationals(tmp_path: Path) -> None:
    """offset + scale is 1 + 2^-53, which rounds to the bound 1: the squash alone does not keep the input below it."""
    half = float(np.nextafter(0.5, 1))
    network = PolicyNetwork.of_layers((np.array([[-2.0]]),), (np.zeros(1),), np.array([half]), np.array([0.5]))
    bounds = ((Fraction(-1), Fraction(1)),)
    assert 0.5 + half == 1.0 and not bounded_by_form(network, bounds)
    assert bounded_by_form(network, ((Fraction(-1), Fraction(2)),))


@pytest.mark.parametrize(
    ("dynamics", "named"),
    [
        (lambda x, u: u - x * Fraction(1, 10**1300), "digits"),
        (lambda x, u: u - sum((x + k) * sin(x + k * x**2) for k in range(1, 3000)) * x**2, "nodes"),
        (lambda x, u: u - nested(x, 101), "nesting"),
    ],
)
def test_a_plant_too_large_for_a_certificate_is_named(
    tmp_path: Path, dynamics: Callable[[Symbol, Symbol], Expression], named: str
) -> None:
    x, u = symbols("x u")
    system = System("large", (x,), (u,), {}, (dynamics(x, u),), (Number(0),), box(1), box(9))
    network = PolicyNetwork.of_layers(
        (np.array([[-5.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )
    with pytest.raises(InputError, match=f"too large for a certificate.*{named}"):
        certify_roa(system, network, tmp_path)


def nested(x: Symbol, depth: int) -> Expression:
    result = x
    for _ in range(depth):
        result = sin(x * result)
    return result


def test_a_pass_says_in_which_direction_it_goes(tmp_path: Path) -> None:
    """An aim lies above what is proved, or below it where a floor is looked for."""
    seen: list[Progress] = []
    system, network = scalar_tanh()
    pushed = dataclasses.replace(system, dynamics=(system.dynamics[0] + sympy.Rational(1, 100),))
    certify_roa(pushed, network, tmp_path, RoaOptions(claim="practical"), progress=lambda _, state: seen.append(state))
    found = [state for state in seen if state is not None]
    assert {state.down for state in found} >= {True}
    assert all(state.target <= state.level if state.down else state.target >= state.level for state in found)


@pytest.mark.parametrize("ends", ["refuted", "unknown", "with an error", "interrupted"])
def test_an_earlier_run_s_files_do_not_lie_where_the_result_is_looked_for(
    ends: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are set aside under a name that says so, and people are told; what is somebody's own stays.

    A run that cannot begin has no result, and leaves them in place.
    """
    system, network = scalar_tanh()
    proved = certify_roa(system, network, tmp_path, RoaOptions(level=0.5))
    assert proved.verdict is Verdict.PROVED and proved.raw is not None
    (tmp_path / "report.html").write_text("<pre>python -I -m certify.checker certificate.json</pre>")
    (tmp_path / "search.json").write_text("my own notes")
    options = {"refuted": RoaOptions(level=3.9), "unknown": RoaOptions(level=0.5, max_boxes=1)}
    if ends == "interrupted":
        monkeypatch.setattr(
            "certify.analysis.stages.candidate.named", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt)
        )
    if ends == "with an error":
        monkeypatch.setattr(
            "certify.analysis.stages.candidate.named", lambda *_: (_ for _ in ()).throw(InputError("no such candidate"))
        )
    if ends == "unknown":
        monkeypatch.setattr("certify.provers.boxes.engine.prove_local", lambda *_: None)
    given, told = options.get(ends, RoaOptions(level=0.5)), list[str]()
    if ends in options:
        assert certify_roa(system, network, tmp_path, given, tell=told.append).verdict.value == ends.upper()
    else:
        with pytest.raises((InputError, KeyboardInterrupt)):
            certify_roa(system, network, tmp_path, given, tell=told.append)
    names = {path.name for path in tmp_path.iterdir()}
    if ends == "with an error":
        kept = tmp_path / "certificate.json"
        assert names == {kept.name, "report.html", "search.json"} and not told
    else:
        kept = tmp_path / "certificate.earlier.json"
        assert names == {kept.name, "report.earlier.html", "search.json"}
        assert told == [f"no certificate is written; that of an earlier run is kept as {kept}"]
    assert kept.read_bytes() == proved.raw
    assert (tmp_path / "search.json").read_text() == "my own notes"


def test_a_run_that_writes_a_certificate_says_nothing_of_the_earlier_one(tmp_path: Path) -> None:
    told = list[str]()
    for _ in range(2):
        certify_roa(*scalar_tanh(), tmp_path, RoaOptions(level=0.5), tell=told.append)
    assert not told and (tmp_path / "certificate.earlier.json").exists()


def test_a_run_that_finds_the_folder_taken_leaves_what_lies_there(tmp_path: Path) -> None:
    system, network = scalar_tanh()
    certify_roa(system, network, tmp_path, RoaOptions(level=0.5))
    with sole_writer(tmp_path), pytest.raises(InputError, match="another run"):
        certify_roa(system, network, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["certificate.json"]


def test_a_file_that_is_in_the_way_is_named_and_stays(tmp_path: Path) -> None:
    system, network = scalar_tanh()
    certify_roa(system, network, tmp_path, RoaOptions(level=0.5))
    (tmp_path / "certificate.earlier.json").write_text("my own notes")
    with pytest.raises(InputError, match=r"certificate\.earlier\.json, which is another file"):
        certify_roa(system, network, tmp_path, RoaOptions(level=0.5))
    assert (tmp_path / "certificate.earlier.json").read_text() == "my own notes"


class Made:
    """Candidates that take all of the effort that they are granted."""

    def __init__(self, P: float) -> None:
        self.P, self.granted = P, list[float]()

    def __call__(self, loop: ClosedLoop, *given: Any) -> Trial:
        effort = given[-1]
        self.granted.append(effort.left)
        effort.charge(effort.left)
        self.P *= 0.9  # each is a new one
        return trial(loop, np.array([[self.P]]), "optimised", RoaOptions())


def test_candidates_take_no_more_effort_than_there_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    system, network = scalar_tanh()
    made = Made(1.0)
    for name in ("optimised", "robust", "corrected"):
        monkeypatch.setattr(f"certify.analysis.stages.candidate.{name}", made)
    found = certify_roa(system, network, tmp_path, RoaOptions(effort=0.1))
    assert found.verdict is Verdict.PROVED
    assert len(made.granted) >= 2 and sum(made.granted) <= 0.1 * WHOLE
