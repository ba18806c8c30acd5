"""Certified sets that are reached: proved and accepted by both checkers, and only for the loop of the certificate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify import certify_roa
from certify.analysis.options import RoaOptions
from certify.analysis.reaching import ReachOptions, ReachResult, certify_reach, into_set_of
from certify.certificates import Certificate, parse_certificate, run_checker
from certify.certificates.located import Containment
from certify.certificates.membership import proved_set
from certify.effort import Effort
from certify.errors import InputError, OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, sin, symbols
from certify.loop.plants import System, with_constraints
from certify.loop.policies import PolicyNetwork
from certify.provers.ranks import Question, Region, root_box, with_order
from tests.support.loops import box
from tests.support.ranks import hanging, linear_plant

Loop = tuple[System, PolicyNetwork]
BEGIN = ((Fraction(3), Fraction(7, 2)), (Fraction(2), Fraction(21, 10)))


def swinging(period: Fraction | None = Fraction(1, 5)) -> Loop:
    """A hanging pendulum with friction and without torque; its input is held over a period, or follows at once."""
    theta, omega, u = symbols("theta omega u")
    system = System(
        name="swinging",
        states=(theta, omega),
        inputs=(u,),
        parameters={},
        dynamics=(omega, u - 3 * sin(theta) - 2 * omega),
        u_eq=(Number(0),),
        domain=box(3, 5),
        input_bounds=box(1),
        sample=None if period is None else (period, period),
    )
    weights, zeros = (np.zeros((1, 2)),), (np.zeros(1),)
    return system, PolicyNetwork.of_layers(weights, zeros, np.ones(1), np.zeros(1), "identity", "none")


def pushed() -> Loop:
    """x+ = x/2 + u with u = 1/8 everywhere: it rests at 1/4."""
    x, u = symbols("x u")
    system = System(
        name="pushed",
        states=(x,),
        inputs=(u,),
        parameters={},
        dynamics=(x / 2 + u,),
        u_eq=(Number(0),),
        domain=box(4),
        input_bounds=box(1),
        time="discrete",
    )
    weights, bias = (np.zeros((1, 1)),), (np.array([0.125]),)
    return system, PolicyNetwork.of_layers(weights, bias, np.ones(1), np.zeros(1), "identity", "none")


def known(loop: Loop, folder: Path, **options: object) -> Path:
    """The certificate of a run about this loop."""
    options = {"candidate": "ellipsoid", "effort": 0.1} | options
    result = certify_roa(*loop, out=folder, **options)  # type: ignore[arg-type]
    assert result.verdict == "PROVED" and result.certificate is not None
    return result.certificate


def led(loop: Loop, target: Path, out: Path, begin: object = BEGIN, within: int | None = None) -> ReachResult:
    options = ReachOptions(target=(str(target),), begin=begin, within=within, effort=0.2)  # type: ignore[arg-type]
    return certify_reach(*loop, out, options)


def accepted_by_both(result: ReachResult) -> Certificate:
    assert result.verdict == "PROVED" and result.certificate is not None and result.raw is not None
    for program in ("checker", "reference"):
        assert run_checker(result.certificate, program=program)["result"] == "ACCEPTED"
    return parse_certificate(result.raw, "certificate")


def test_a_box_leads_into_the_set(tmp_path: Path) -> None:
    loop = linear_plant()
    target = known(loop, tmp_path / "set", level=0.5)
    result = led(loop, target, tmp_path / "led")
    given, found = parse_certificate(target.read_bytes(), "set"), accepted_by_both(result)
    assert (found.kind, found.roa, found.P.tolist(), found.claim.keep) == (
        given.kind, given.roa, given.P.tolist(), given.claim.keep,
    )  # fmt: skip
    assert result.runs is not None and result.runs.longest is not None and result.steps is not None
    assert 0 < result.runs.longest <= result.steps <= result.runs.longest + 4
    assert proved_set(tmp_path / "led" / "certificate.json").locate(BEGIN).answer is Containment.CONTAINED
    assert led(loop, target, tmp_path / "soon", within=1).verdict == "REFUTED"
    again = led(loop, tmp_path / "led" / "certificate.json", tmp_path / "again")
    assert again.raw == result.raw  # ranks of a target are replaced


def test_full_turns_of_an_angle_do_not_count(tmp_path: Path) -> None:
    loop = hanging()
    target = known(loop, tmp_path / "set", level=2.0)
    begin = ((Fraction(7), Fraction(71, 10)), (Fraction(0), Fraction(1, 10)))
    result = led(loop, target, tmp_path / "led", begin)
    found = accepted_by_both(result)
    assert found.claim.ranks is not None and found.claim.ranks.angles == ("theta",)
    assert result.runs is not None and result.runs.longest is not None and result.steps is not None
    assert result.runs.longest <= result.steps
    assert led(loop, target, tmp_path / "soon", begin, within=1).verdict == "UNKNOWN"  # Arb sees no turns


@pytest.mark.slow
def test_a_held_input_with_a_higher_order(tmp_path: Path) -> None:
    """The series in time that the set was proved with is too short for boxes that take many periods."""
    loop = swinging()
    target = known(loop, tmp_path / "set", level=0.05, effort=0.02)
    result = led(loop, target, tmp_path / "led", ((Fraction(1), Fraction(11, 10)), (Fraction(0), Fraction(0))))
    given, found = parse_certificate(target.read_bytes(), "set"), accepted_by_both(result)
    assert found.evidence.order > given.evidence.order  # type: ignore[union-attr]


@pytest.mark.slow
def test_ranks_beside_a_set_take_a_higher_order_if_the_ring_is_cheap(tmp_path: Path) -> None:
    loop = swinging()
    alone, ranked = (
        known(loop, tmp_path / name, level=0.05, effort=0.01, ranks=name == "ranked") for name in ("alone", "ranked")
    )
    orders = [parse_certificate(path.read_bytes(), "set").evidence.order for path in (alone, ranked)]  # type: ignore[union-attr]
    assert orders[0] < orders[1]
    closed = ClosedLoop(*loop)
    question = Question(closed, Region((loop[0].states[0],), loop[0].states), (), root_box(closed), 3)
    x = np.random.default_rng(0).uniform(*root_box(closed), (30, 2)).T
    effort = Effort()
    assert with_order(question, x, effort, leaves=1000, most=1e3) == question and not effort.spent
    assert with_order(question, x, effort, leaves=1000, most=1e9).order > 3
    assert effort.spent >= 30 * question.course((1,)).operations  # a step from each state


def test_a_set_around_another_equilibrium(tmp_path: Path) -> None:
    """The certificate is in deviations from where the loop rests, the box in those of the plant."""
    loop, begin = pushed(), ((Fraction(2), Fraction(3)),)
    target = known(loop, tmp_path / "set", level=0.01, around="rest")
    found = accepted_by_both(result := led(loop, target, tmp_path / "led", begin))
    assert found.kind == "nearby" and found.network.is_moved and result.begin == {"x": begin[0]}
    proved = proved_set(tmp_path / "led" / "certificate.json")
    at = [[(lo - q, hi - q) for (lo, hi), q in zip(begin, proved.system.exact_x_eq(), strict=True)]]
    assert proved.locate(at[0]).answer is Containment.CONTAINED and result.begin == {"x": (2, 3)}


def heavier(loop: Loop) -> Loop:
    system, network = loop
    return replace(system, dynamics=(system.dynamics[0], system.dynamics[1] * Number(Fraction(9, 10)))), network


def kept(loop: Loop) -> Loop:
    return with_constraints(loop[0], ["x <= 3.9"], []), loop[1]


def braked(loop: Loop) -> Loop:
    weights, zeros = (np.array([[-0.25, 0.0]]),), (np.zeros(1),)
    return loop[0], PolicyNetwork.of_layers(weights, zeros, np.ones(1), np.zeros(1), "identity", "none")


def narrowed(loop: Loop) -> Loop:
    return replace(loop[0], domain=box(3, 4)), loop[1]


@pytest.mark.parametrize(
    ("changed", "named"),
    [(heavier, "equations"), (kept, "constraints"), (braked, "policy"), (narrowed, "a wider one")],
)
def test_another_loop_is_refused(changed: Callable[[Loop], Loop], named: str, tmp_path: Path) -> None:
    loop = linear_plant()
    target = known(loop, tmp_path / "set", level=0.5)
    with pytest.raises(OptionError, match=named):
        led(changed(loop), target, tmp_path / "led")
    assert not (tmp_path / "led").exists()


def test_a_wider_domain_and_another_name_are_not(tmp_path: Path) -> None:
    system, network = linear_plant()
    target = known((system, network), tmp_path / "set", level=0.5)
    accepted_by_both(led((replace(system, name="other", domain=box(5, 5)), network), target, tmp_path / "led"))


def test_another_period_is_refused(tmp_path: Path) -> None:
    target = known(swinging(), tmp_path / "set", level=0.05)
    for other in (swinging(Fraction(1, 4)), swinging(None)):
        with pytest.raises(OptionError, match="differs in period"):
            into_set_of(target, *other, RoaOptions(reach_from={"theta": 1.0}))


def test_a_certificate_that_is_rejected_is_not_used(tmp_path: Path) -> None:
    loop = linear_plant()
    target = known(loop, tmp_path / "set", level=0.5)
    forged = target.with_name("forged.json")
    given = parse_certificate(target.read_bytes(), "set")
    forged.write_text(replace(given, claim=replace(given.claim, roa=40.0)).to_json())
    with pytest.raises(InputError, match="it says REJECTED"):
        led(loop, forged, tmp_path / "led")
    assert not (tmp_path / "led").exists()


def test_the_target_is_not_overwritten(tmp_path: Path) -> None:
    loop = linear_plant()
    target = known(loop, tmp_path, level=0.5)
    with pytest.raises(OptionError, match="in another folder"):
        led(loop, target, tmp_path)
    with pytest.raises(OptionError, match="one certificate, or comparisons"):
        ReachOptions(target=(str(target), "x <= 1"))


def test_a_tube_into_the_set(tmp_path: Path) -> None:
    """In continuous time the set is proved again, with the tube."""
    loop = swinging(None)
    target = known(loop, tmp_path / "set", level=0.05)
    asked = into_set_of(target, *loop, RoaOptions(reach_from={"theta": 1.0}, effort=0.02))
    result = certify_roa(*loop, out=tmp_path / "led", options=asked)
    assert result.verdict == "PROVED" and result.raw is not None
    given, found = parse_certificate(target.read_bytes(), "set"), parse_certificate(result.raw, "led")
    assert (found.kind, found.roa, found.P.tolist()) == ("reached", given.roa, given.P.tolist())
    practical = known(loop, tmp_path / "practical", claim="practical", effort=0.02)
    with pytest.raises(OptionError, match="asymptotic certificate where a tube"):
        into_set_of(practical, *loop, asked)
