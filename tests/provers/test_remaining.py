"""Boxes that are never left, in steps: the search for the largest set, and the run from end to end."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.analysis.options import RoaOptions
from certify.analysis.reaching.runs import ends_of_runs
from certify.analysis.staying import InvariantResult, certify_invariant
from certify.certificates import RankTree, RemainCertificate, leaves_within, parse_any, parse_certificate, run_checker
from certify.certificates.located import Containment
from certify.certificates.membership import proved_set
from certify.certificates.verdict import Verdict
from certify.effort import Effort
from certify.errors import CertificateFormatError, InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, Number, cos, sin, symbols
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.provers.execution import ThreadRunner
from certify.provers.ranks import Nothing, Question, prove_remaining, root_box
from tests.support.loops import box
from tests.support.marks import slow_after

X, Y, U = symbols("x y u")
NO_SEEDS = np.zeros((2, 0))


def steps(dynamics: tuple[Expression, ...], **more: Any) -> System:
    """A plant in discrete time, in the box |x|, |y| <= 2."""
    known: dict[str, Any] = {"domain": box(2, 2), "input_bounds": box(9), "time": "discrete", "u_eq": (Number(0),)}
    return System("plant", (X, Y), (U,), {}, dynamics, **(known | more))


def policy(*gains: float) -> PolicyNetwork:
    return PolicyNetwork.of_layers([np.array([gains])], [np.zeros(1)], [1.0], [0.0], "identity", "none")


def searched(system: System, effort: float = 2e8, gains: tuple[float, ...] = (0.0, 0.0)) -> Any:
    """The leaves of a plant's domain that are never left, and what is left without one of them."""
    loop = ClosedLoop(system, policy(*gains))
    question = Question(loop, Nothing(), tuple(system.uncertain_constraints().values()), root_box(loop))
    return prove_remaining(question, NO_SEEDS, Effort(effort), ThreadRunner())


def kept(tree: RankTree) -> tuple[np.ndarray, np.ndarray]:
    lower, upper = leaves_within(tree.tree, tree.lo, tree.hi)
    return lower[tree.proved], upper[tree.proved]


def proved(
    system: System, folder: Path, gains: tuple[float, ...] = (0.0, 0.0), effort: float = 0.05
) -> InvariantResult:
    return certify_invariant(system, policy(*gains), folder, RoaOptions(claim="invariant", effort=effort))


def test_all_of_a_domain_that_shrinks() -> None:
    found, _ = searched(steps((X / 2 + U, Y / 2 - X / 4)))
    assert found.share == pytest.approx(1.0) and found.done and set(found.evidence.steps.tolist()) == {1}


@pytest.mark.parametrize("factor", [Number(1), Number(2)])
def test_nothing_of_a_domain_that_does_not(factor: Expression) -> None:
    """Boxes that stay where they are meet their neighbours, and the domain's end; others grow."""
    assert searched(steps((factor * X + U, factor * Y + X / 9))) is None


def test_an_unstable_state_is_kept_out() -> None:
    """x+ = 3/2 x - x^3/4, which leaves 0 for 2^(1/2) or its mirror image; |x| < 1/4 is forbidden."""
    cubic = 3 * X / 2 - X**3 / 4 + U
    system = steps((cubic, Y / 2), constraints={"away": Number(1) / 16 - X**2})
    found, _ = searched(system)
    lower, upper = kept(found.evidence)
    assert np.all((lower[:, 0] >= 0.25) | (upper[:, 0] <= -0.25))
    assert found.share > 0.8  # of 0.875


def test_a_rotation_needs_several_steps() -> None:
    """A seventh of a turn and a shrinking by 2 %: corners of the domain leave it, a disc does not."""
    c, s = (Number(round(v * 2**20)) / 2**20 for v in (0.98 * math.cos(0.9), 0.98 * math.sin(0.9)))
    found, _ = searched(steps((c * X - s * Y + U, s * X + c * Y)), 1e9)
    lower, upper = kept(found.evidence)
    far = np.hypot(*np.maximum(np.abs(lower), np.abs(upper)).T)
    assert 0.6 < found.share < math.pi / 4 + 0.2 and max(found.evidence.steps) > 1 and far.max() < 2.9


def test_a_leaf_that_is_refused_takes_those_along_that_need_it() -> None:
    """x+ = x/2 leads all leaves to the middle, y+ = -y/2 too: without a leaf in the middle nothing is left."""
    found, without = searched(steps((X / 2 + U, -Y / 2)))
    lower, upper = kept(found.evidence)
    middle = int(np.argmin(np.abs(lower + upper).max(1)))
    assert without(middle) is None
    found, without = searched(steps((X / 2 + U, -Y / 2)))
    corner = int(np.argmax(np.abs(lower + upper).min(1)))
    tree, ranks = without(corner)
    assert int(tree.proved.sum()) == len(lower) - 1 and ranks.steps == 1


def test_rounds_only_add() -> None:
    system = steps((3 * X / 2 - X**3 / 4 + U, Y / 2), constraints={"away": Number(1) / 16 - X**2})
    shares = list[float]()
    loop = ClosedLoop(system, policy(0.0, 0.0))
    question = Question(loop, Nothing(), tuple(system.uncertain_constraints().values()), root_box(loop))
    prove_remaining(question, NO_SEEDS, Effort(1e9), ThreadRunner(), lambda share, *_: shares.append(share))
    assert len(shares) > 5 and shares == sorted(shares) and shares[-1] > shares[0]


@pytest.fixture(scope="module")
def cycle(tmp_path_factory: pytest.TempPathFactory) -> InvariantResult:
    """Van der Pol's oscillator in forward time, held for a twentieth, which stays away from 0."""
    system = System(
        "cycle", (X, Y), (U,), {}, (Y, (1 - X**2) * Y - X + U), u_eq=(Number(0),), domain=box(3, 4),
        input_bounds=box(1), constraints={"moving": Number(1) / 4 - X**2 - Y**2},
    ).with_sample((Fraction(1, 20), Fraction(1, 20)))  # fmt: skip
    return proved(system, tmp_path_factory.mktemp("cycle"), (0.0, -0.1), 0.02)


def test_boxes_around_a_limit_cycle_are_accepted(cycle: InvariantResult) -> None:
    assert cycle.verdict is Verdict.PROVED and cycle.ranks is not None and cycle.raw is not None
    assert (
        cycle.ranks.covered > 0.7
        and cycle.simulated is not None
        and cycle.simulated.proved > 0.9 * cycle.simulated.staying
    )
    read = parse_any(cycle.raw, "cycle")
    assert isinstance(read, RemainCertificate) and read.to_json().encode() == cycle.raw
    with pytest.raises(CertificateFormatError, match="never left"):
        parse_certificate(cycle.raw, "cycle")


def test_runs_from_the_boxes_stay(cycle: InvariantResult) -> None:
    assert cycle.certificate is not None
    found = proved_set(cycle.certificate)
    x = np.random.default_rng(5).uniform([-3, -4], [3, 4], (1500, 2))
    start = x[found.holds_in_floats(x)]
    end, _ = ends_of_runs(ClosedLoop(cycle.system, cycle.network), start, 400, Effort())
    assert len(start) > 900 and np.all(np.isfinite(end))
    assert np.all(np.hypot(*end.T) > 0.5)
    point = tuple((Fraction(v), Fraction(v)) for v in cycle.state.values())
    assert found.locate(point).answer is Containment.CONTAINED


def test_an_angle_that_is_read_by_sines_counts_as_a_place(tmp_path: Path) -> None:
    """theta+ = theta + 1/2 turns for ever; the other state follows its sine."""
    system = steps((X + Number(1) / 2, Y / 2 + sin(X) / 4 + U), angles=("x",))
    found = proved(system, tmp_path)
    assert found.verdict is Verdict.PROVED and found.ranks is not None and found.ranks.angles == ("x",)
    assert found.ranks.covered > 0.99
    reads = proved(system, tmp_path / "reads", (0.1, 0.0))  # the policy counts turns
    assert reads.verdict is Verdict.UNKNOWN and reads.following


def test_a_constraint_that_counts_turns_is_refused(tmp_path: Path) -> None:
    system = steps((X + Number(1) / 2, Y / 2 + U), angles=("x",), constraints={"few": X - Number(9)})
    with pytest.raises(InputError, match="full turn of x"):
        proved(system, tmp_path)


def test_unknown_says_what_to_try(tmp_path: Path) -> None:
    found = proved(steps((2 * X + U, 2 * Y)), tmp_path)
    assert found.verdict is Verdict.UNKNOWN and "the effort is over" in found.reason
    assert found.following == ("--effort 0.2", "a smaller --domain")
    gone = proved(steps((X + Number(5) + U, Y)), tmp_path)  # all of it leaves at once
    assert gone.verdict is Verdict.UNKNOWN and "no box is left" in gone.reason
    assert gone.following == ("another --domain",)
    assert not (tmp_path / "certificate.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("seed", slow_after(1, range(6)))
def test_random_loops_never_end_in_an_error(seed: int, tmp_path: Path) -> None:
    """What is proved is accepted by both, and runs from it stay."""
    chance = np.random.default_rng(seed)
    a = [Number(int(v)) / 64 for v in chance.integers(-60, 60, 8)]
    system = steps(
        (a[0] * X + a[1] * Y + a[2] * cos(2 * Y) + U, a[3] * X + a[4] * Y + a[5] * sin(X) + a[6] * X * Y),
        constraints={"g": X * Y - Number(int(chance.integers(16, 200))) / 64},
    )
    found = proved(system, tmp_path, tuple(chance.uniform(-0.5, 0.5, 2)), 0.02)
    if found.verdict is not Verdict.PROVED:
        assert found.verdict is Verdict.UNKNOWN
        return
    assert found.certificate is not None
    assert run_checker(found.certificate, program="reference")["result"] == "ACCEPTED"
    x = chance.uniform(-2, 2, (500, 2))
    start = x[proved_set(found.certificate).holds_in_floats(x)]
    end, _ = ends_of_runs(ClosedLoop(found.system, found.network), start, 200, Effort())
    assert np.all(np.isfinite(end))
