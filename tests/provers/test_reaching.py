"""Regions that are reached: true claims are proved and accepted by both checkers, false ones never are."""

from __future__ import annotations

import math
from contextlib import nullcontext
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify.analysis.reaching import ReachOptions, ReachResult, certify_reach
from certify.analysis.reaching.options import target_of
from certify.analysis.reaching.runs import Run, is_refuted
from certify.certificates import ReachCertificate, parse_any, run_checker
from certify.certificates.located import Containment
from certify.certificates.membership import proved_set
from certify.errors import BackendError, CertificateFormatError, InputError, OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, Number, Symbol, symbols
from certify.loop.plants import System, with_constraints
from certify.loop.plants.system import Interval
from certify.loop.policies import PolicyNetwork
from certify.provers.execution import rows
from certify.provers.ranks.search import COUNTS
from tests.support.jobs import PlayedRunner, Troupe
from tests.support.loops import box
from tests.support.ranks import hanging, linear_plant

HAIR = Fraction(1, 10**6)
Box = tuple[Interval, ...]
TARGET = ("x**2 + y**2 <= 1",)
BEGIN = ((Fraction(3), Fraction(7, 2)), (Fraction(2), Fraction(21, 10)))


def gain(n: int) -> PolicyNetwork:
    """u = 0 of n states."""
    return PolicyNetwork.of_layers((np.zeros((1, n)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")


def plant(dynamics: dict[str, Expression], half: int = 4, period: Fraction | None = None) -> System:
    """A plant of these states with an input that acts on nothing, in steps or with a held input."""
    return System(
        name="small",
        states=tuple(map(Symbol, dynamics)),
        inputs=symbols("u"),
        parameters={},
        dynamics=tuple(dynamics.values()),
        u_eq=(Number(0),),
        domain=box(*[half] * len(dynamics)),
        input_bounds=box(1),
        time="discrete" if period is None else "continuous",
        sample=None if period is None else (period, period),
    )


def halving() -> System:
    """x+ = x/2."""
    (x,) = symbols("x")
    return plant({"x": x / 2})


def sliding() -> System:
    """x+ = x - 1/2, y+ = y."""
    x, y = symbols("x y")
    return plant({"x": x - Number(Fraction(1, 2)), "y": y})


def at(*values: Fraction | int | str) -> Box:
    return tuple((Fraction(v), Fraction(v)) for v in values)


def asked(system: System, out: Path, *target: str, begin: Box | None = None, within: int | None = None) -> ReachResult:
    options = ReachOptions(target=target, begin=begin, within=within, effort=0.1)
    return certify_reach(system, gain(system.n), out, options)


def accepted_by_both(result: ReachResult) -> ReachCertificate:
    assert result.certificate is not None and result.raw is not None
    for program in ("checker", "reference"):
        assert run_checker(result.certificate, program=program)["result"] == "ACCEPTED"
    found = parse_any(result.raw, "certificate")
    assert isinstance(found, ReachCertificate) and found.to_json().encode() == result.raw
    return found


def test_a_box_of_a_linear_loop(tmp_path: Path) -> None:
    system, network = linear_plant()
    begin, options = BEGIN, ReachOptions(target=TARGET, begin=BEGIN, effort=0.1)
    result = certify_reach(system, network, tmp_path, options)
    assert result.verdict == "PROVED" and result.runs is not None and result.runs.longest is not None
    assert result.steps is not None and result.runs.longest <= result.steps <= result.runs.longest + 4
    certificate = accepted_by_both(result)
    assert list(certificate.constraints) == ["wall", "force_1", "force_2"] or len(certificate.constraints) == 2
    proved = proved_set(tmp_path / "certificate.json")
    assert proved.locate(begin).answer is Containment.CONTAINED
    assert proved.locate(at(30, 2)).answer is Containment.NOT_CONTAINED
    late = certify_reach(system, network, tmp_path, ReachOptions(target=options.target, begin=begin, within=1))
    assert late.verdict == "REFUTED" and "shown in Arb" in late.reason


def of_a_cluster(out: Path, troupe: Troupe, monkeypatch: pytest.MonkeyPatch) -> ReachResult:
    """A run for a linear loop whose cluster is the troupe."""
    monkeypatch.setattr("certify.provers.execution.shared._WORTH", 0.0)
    places = {"tcp://nowhere:1": nullcontext(PlayedRunner(troupe))}
    monkeypatch.setattr("certify.analysis.reaching.run.runner_at", places.__getitem__)
    return certify_reach(*linear_plant(), out, ReachOptions(target=TARGET, effort=0.1, cluster=next(iter(places))))


def test_a_cluster_finds_the_same_certificate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    troupe, options = Troupe(seed=7), ReachOptions(target=TARGET, effort=0.1)
    alone = certify_reach(*linear_plant(), tmp_path / "alone", options)
    shared = of_a_cluster(tmp_path / "shared", troupe, monkeypatch)
    assert alone.verdict == shared.verdict == "PROVED" and alone.raw == shared.raw and alone.raw is not None
    assert alone.boxes == shared.boxes and troupe.answered > 3


def test_a_cluster_that_lies_proves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each box is said to lie in the target: the checker refuses it, and the error names the cluster."""
    vector, many, each = (2,), (len(COUNTS),), (len(COUNTS), 1)
    images = [
        *(("lo", "f8", each + vector), ("hi", "f8", each + vector)),
        *(("there", "u1", each), ("known", "u1", many), ("arrived", "u1", many)),
    ]
    row = np.dtype(
        [
            *images,
            *((name, "u1") for name in ("inside", "meets", "loose", "fails")),
            ("first", "f8", (2, *vector)),
            ("taken", "f8"),
            ("steep", "f8", vector),
        ]
    )

    def lie(job: bytes, answer: bytes) -> bytes:
        told = np.frombuffer(rows.unsealed(job, answer), row).copy()
        told["inside"] = 1
        return rows.sealed(job, told.tobytes())

    with pytest.raises(BackendError, match="workers of tcp://nowhere:1, who may be at fault"):
        of_a_cluster(tmp_path, Troupe(play=lie), monkeypatch)
    assert not (tmp_path / "certificate.json").exists()


def test_all_that_is_reached_without_a_box(tmp_path: Path) -> None:
    result = asked(halving(), tmp_path, "x <= 0.1", "x >= -0.1")
    assert result.verdict == "PROVED" and result.ranks is not None and result.ranks.covered > 0.99
    accepted_by_both(result)
    few = asked(halving(), tmp_path, "x <= 0.1", "x >= -0.1", within=2)
    assert few.verdict == "PROVED" and few.ranks is not None and few.ranks.steps <= 2
    assert 0.09 < few.ranks.covered < 0.1  # |x| <= 0.4 of 4
    accepted_by_both(few)


@pytest.mark.parametrize("short", [True, False])
def test_a_target_that_is_missed_by_a_hair(tmp_path: Path, short: bool) -> None:
    bound = Fraction(1, 4) + (-HAIR if short else HAIR)
    result = asked(halving(), tmp_path, f"x <= {float(bound):.7f}", begin=at(1), within=2)
    assert result.verdict == ("REFUTED" if short else "PROVED")
    if not short:
        assert result.steps == 2
        accepted_by_both(result)


def test_a_corner_of_a_box_that_comes_too_late(tmp_path: Path) -> None:
    begin = ((Fraction(1, 2), 1 + 4 * HAIR),)
    assert asked(halving(), tmp_path, "x <= 0.25", begin=begin, within=2).verdict == "REFUTED"


@pytest.mark.parametrize("grazed", [True, False])
def test_an_obstacle_on_the_way(tmp_path: Path, grazed: bool) -> None:
    radius = Fraction(1, 10) + (HAIR if grazed else -HAIR)
    system = with_constraints(sliding(), [], [f"(x - 1)**2 + y**2 < {float(radius):.7f}**2"])
    result = asked(system, tmp_path, "x <= 0.2", begin=at(2, "0.1"))
    assert result.verdict == ("REFUTED" if grazed else "PROVED")
    if grazed:
        assert "avoid is violated after 2 steps" in result.reason
    else:
        accepted_by_both(result)


def test_an_obstacle_behind_the_target_is_none(tmp_path: Path) -> None:
    system = with_constraints(sliding(), ["x >= 0.1"], [])
    assert asked(system, tmp_path, "x <= 0.6", begin=at(2, 0)).verdict == "PROVED"
    assert asked(system, tmp_path, "x <= 0.05", begin=at(2, 0)).verdict == "PROVED"  # from 1/2 to 0
    assert asked(system, tmp_path, "x <= -0.3", begin=at(2, 0)).verdict == "REFUTED"


@pytest.mark.parametrize("bound", ["2", "0.999999"])
def test_a_constraint_is_kept_between_two_sampling_instants(tmp_path: Path, bound: str) -> None:
    """x = cos(t - 1/4) is 0.969 at the instants 0 and 1/2, and 1 between them."""
    x, y = symbols("x y")
    system = with_constraints(plant({"x": y, "y": -x}, period=Fraction(1, 2)), [f"x <= {bound}"], [])
    begin = at(Fraction(math.cos(-0.25)), Fraction(-math.sin(-0.25)))
    result = asked(system, tmp_path, "x <= 0", begin=begin)
    assert result.verdict == ("PROVED" if bound == "2" else "UNKNOWN")
    if bound == "2":
        assert result.steps == 4
        accepted_by_both(result)


@pytest.mark.parametrize("short", [True, False])
def test_a_held_input(tmp_path: Path, short: bool) -> None:
    (x,) = symbols("x")
    bound = math.exp(-1) + (-1e-6 if short else 1e-6)
    result = asked(plant({"x": -x}, period=Fraction(1, 2)), tmp_path, f"x <= {bound:.9f}", begin=at(1), within=2)
    assert result.verdict == ("REFUTED" if short else "PROVED")
    if not short:
        accepted_by_both(result)


def test_an_angle_that_turns(tmp_path: Path) -> None:
    system, network = hanging()
    begin = ((Fraction(3, 2), Fraction(2)), (Fraction(-1), Fraction(0)))
    options = ReachOptions(target=("cos(theta) >= 0.9", "omega**2 <= 1"), begin=begin, effort=0.2)
    result = certify_reach(system, network, tmp_path, options)
    assert result.verdict == "PROVED"
    accepted_by_both(result)
    proved = proved_set(tmp_path / "certificate.json")
    assert proved.locate(at("8.0", "-0.5")).answer is Containment.CONTAINED  # a turn further


def test_a_target_of_an_angle_must_turn_too(tmp_path: Path) -> None:
    system, network = hanging()
    options = ReachOptions(target=("theta <= 0.5",), begin=at(1, 0), effort=0.05)
    with pytest.raises(InputError, match="full turn"):
        certify_reach(system, network, tmp_path, options)


def test_a_state_that_never_arrives_is_unknown_with_a_witness(tmp_path: Path) -> None:
    result = asked(halving(), tmp_path, "x <= -0.1", begin=at(1))
    assert result.verdict == "UNKNOWN" and result.runs is not None and result.runs.failing is not None
    assert result.runs.failing.end == "late" and "in a simulation" in result.reason and result.certificate is None


def test_what_leaves_the_domain_is_unknown(tmp_path: Path) -> None:
    (x,) = symbols("x")
    result = asked(plant({"x": 2 * x}), tmp_path, "x <= 0", begin=at(1))
    assert result.verdict == "UNKNOWN" and result.runs is not None and result.runs.failing is not None
    assert result.runs.failing.end == "left"


def test_arb_decides_alone() -> None:
    """What floats say of a run counts for nothing: a run that arrives, or violates nothing, refutes nothing."""
    loop = ClosedLoop(halving(), gain(1))
    target = target_of(loop.system, ["x <= 0.25"])
    start = (Fraction(1),)
    assert not is_refuted(loop, target, Run(start, "late", 2), 2)
    assert is_refuted(loop, target, Run(start, "late", 1), 1)
    assert not is_refuted(loop, target, Run(start, "late", 1), 2)  # of fewer steps than were asked about
    assert not is_refuted(loop, target, Run(start, "left", 1), 1)
    kept = ClosedLoop(with_constraints(halving(), ["x >= 0.5"], []), gain(1))
    assert not is_refuted(kept, target, Run(start, "violates", 1, "keep"), None)  # x = 1/2 there, which is allowed


@pytest.mark.parametrize("text", ["x", "x < 1", "x == 1", "u <= 1", "1 <= 2", "0 <= x <= 1", "x <= "])
def test_a_target_that_is_none(text: str) -> None:
    with pytest.raises(OptionError, match="target"):
        target_of(halving(), [text])


def test_what_cannot_be_asked(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="steps"):
        certify_reach(_continuous(), gain(1), tmp_path, ReachOptions(target=("x <= 0.1",)))


def test_a_certificate_without_v_is_not_taken_for_one_with_a_set(tmp_path: Path) -> None:
    from certify.certificates import read_certificate

    asked(halving(), tmp_path, "x <= 0.1", "x >= -0.1")
    with pytest.raises(CertificateFormatError, match="has no V"):
        read_certificate(tmp_path / "certificate.json")


def _continuous() -> System:
    (x,) = symbols("x")
    return System(
        name="plain",
        states=(x,),
        inputs=symbols("u"),
        parameters={},
        dynamics=(-x,),
        u_eq=(Number(0),),
        domain=box(4),
        input_bounds=box(1),
    )


def test_a_box_in_the_region_is_there_at_once(tmp_path: Path) -> None:
    result = asked(halving(), tmp_path, "x <= 2", "x >= -2", begin=((Fraction(1), Fraction(3, 2)),))
    assert (result.verdict, result.steps) == ("PROVED", 0)
    accepted_by_both(result)
