"""Sets that are never left: the search, functions learned for it, planted violations, the run from end to end."""

from __future__ import annotations

import itertools
import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify.analysis.options import RoaOptions
from certify.analysis.staying import InvariantResult, certify_invariant
from certify.certificates import InvariantCertificate, parse_any, parse_certificate, run_checker
from certify.certificates.located import Containment
from certify.certificates.membership import proved_set
from certify.certificates.verdict import Verdict
from certify.errors import CertificateFormatError, OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.lyapunov import Symbolic
from certify.provers.outer import Nothing, StayProof
from certify.provers.outer.bands import aim
from tests.support.marks import slow_after
from tests.support.staying import ANNULUS, RADIUS, X, Y, obstacle, planted, policy, proof, radius_at, ring

BRAKE = policy([0.0, -1.0])
VIOLATIONS = [what for what, *_ in planted()]


@pytest.mark.parametrize("what", slow_after(24, [*VIOLATIONS[::2], *VIOLATIONS[1::2]]))
def test_what_is_planted_is_never_proved(what: str) -> None:
    """An obstacle, a leak, an input or a face of the domain that a set violates by 1e-6."""
    system, network, level = next(rest for name, *rest in planted() if name == what)
    found = proof(system, network, ANNULUS, level, effort=0.004)
    assert isinstance(found, Nothing) and found.why


def test_there_are_many_of_them() -> None:
    assert len(VIOLATIONS) >= 40


@pytest.mark.parametrize("what", VIOLATIONS[:8])
def test_without_it_the_same_is_proved(what: str) -> None:
    """The same a little farther away: the obstacle by 1 %, N'F below -1/20, the input and the domain by 1 %."""
    by = -0.05 if what.startswith("leak") else -0.01
    system, network, level = next(rest for name, *rest in planted(by) if name == what)
    assert isinstance(proof(system, network, ANNULUS, level), StayProof)


def test_the_level_is_in_the_widest_band() -> None:
    """N falls below 1, where the origin is, and from 1 to 9, where the domain ends."""
    found = aim(ClosedLoop(ring(), BRAKE), Symbolic(ANNULUS, (X, Y)))
    assert 8 < found.levels[0] < 9 and found.least < 1e-3 and found.hazard is None


def test_an_obstacle_ends_the_band() -> None:
    found = aim(ClosedLoop(obstacle(1.0), BRAKE), Symbolic(ANNULUS, (X, Y)))
    assert found.hazard is not None and found.hazard.constraint == "c0" and abs(found.hazard.level - 0.5) < 0.01
    assert all(level < 0.5 for level in found.levels)


@pytest.mark.parametrize(("level", "words"), [(9.5, "a face of the domain"), (-1.0, "no sampled state")])
def test_a_level_of_no_use_is_not_tried(level: float, words: str) -> None:
    found = proof(ring(), BRAKE, ANNULUS, level)
    assert isinstance(found, Nothing) and words in found.why


def test_a_function_that_falls_nowhere_is_of_no_use() -> None:
    found = proof(ring(), BRAKE, X, None)
    assert isinstance(found, Nothing) and found.why


# ------------------------------------------------------------------------------------------------------------- the run


def run(folder: Path, system=None, **options) -> InvariantResult:  # type: ignore[no-untyped-def]
    system = ring([Fraction(1, 20) - RADIUS]) if system is None else system
    return certify_invariant(system, BRAKE, folder, RoaOptions(claim="invariant", **options))


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> InvariantResult:
    return run(tmp_path_factory.mktemp("given"), lyapunov=Symbolic(ANNULUS, (X, Y)))


def test_a_given_function_is_proved_and_accepted_by_both(given: InvariantResult) -> None:
    assert given.verdict is Verdict.PROVED and given.certificate is not None and given.outer is not None
    for program in ("checker", "reference"):
        answer = run_checker(given.certificate, program)
        assert answer["result"] == "ACCEPTED" and answer["claim"] == "invariant"
    hole = (1 - 0.05) ** 2  # N at the hole's edge, up to which the annulus may go
    assert 0.8 * hole < given.outer.level < hole
    area = np.pi * (np.sqrt(given.outer.level) * 2)
    assert abs(given.outer.volume - area) < 5 * given.outer.deviation + 0.01 * area


def test_the_object_says_the_set(given: InvariantResult) -> None:
    data = json.loads(json.dumps(given.to_dict()))
    assert data["verdict"] == "PROVED" and data["checked"] == data["reference"] == "ACCEPTED"
    assert data["claim"] == {"kind": "invariant"} and data["next"] == [] and data["learned"] is None
    assert data["outer"]["kind"] == "expression" and set(data["state"]) == {"x", "y"}
    x, y = data["state"]["x"], data["state"]["y"]
    assert (x**2 + y**2 - 1) ** 2 <= data["outer"]["level"]


def test_states_of_the_set_are_found_in_it(given: InvariantResult) -> None:
    assert given.certificate is not None
    found = proved_set(given.certificate)
    assert found.n == 2 and found.claim == "invariant"
    assert found.holds([(1.0, 0.0), (0.0, 0.0), (0.0, -1.2), (1.9, 0.0)]) == [True, False, True, False]
    box = ((Fraction(9, 10), Fraction(11, 10)), (Fraction(-1, 10), Fraction(1, 10)))
    assert found.locate(box).answer is Containment.CONTAINED
    assert found.locate(((Fraction(-1), Fraction(1)), (Fraction(0), Fraction(0)))).answer is Containment.NOT_CONTAINED


def test_commands_about_v_refuse_the_file(given: InvariantResult) -> None:
    assert given.raw is not None and isinstance(parse_any(given.raw, "file"), InvariantCertificate)
    with pytest.raises(CertificateFormatError, match="a set is never left, and has no V"):
        parse_certificate(given.raw, "file")


def test_trajectories_stay(given: InvariantResult) -> None:
    """Simulated from states of the set near its boundary."""
    assert given.outer is not None
    loop, N = ClosedLoop(given.system, given.network), given.outer.function
    x = np.random.default_rng(0).uniform(-2, 2, (20_000, 2))
    x = x[(N(x) <= given.outer.level) & (N(x) > 0.9 * given.outer.level)]
    assert len(x) > 100
    f = given.system.function()
    for _ in range(400):
        x = x + 0.005 * f(x, loop.policy(x))
        assert np.all(N(x) <= given.outer.level)


@pytest.mark.slow
def test_a_polynomial_is_learned(tmp_path: Path) -> None:
    found = run(tmp_path, candidate="polynomial", degree=4, effort=0.2)
    assert found.verdict is Verdict.PROVED and "polynomial of degree 4" in found.learned
    assert found.outer is not None and found.outer.volume > 4


def test_what_is_not_proved_says_what_to_try(tmp_path: Path) -> None:
    found = run(tmp_path, lyapunov=Symbolic(X**2 + 3 * Y**2 + 5 * X * Y, (X, Y)), effort=0.05)
    assert found.verdict is Verdict.UNKNOWN and found.reason and "--candidate polynomial" in found.following
    assert not (tmp_path / "certificate.json").exists()


def test_a_level_that_was_asked_for_counts(tmp_path: Path) -> None:
    found = run(tmp_path, lyapunov=Symbolic(ANNULUS, (X, Y)), lyapunov_level=0.25)
    assert found.verdict is Verdict.PROVED and found.outer is not None and found.outer.level == 0.25
    assert radius_at(0.25) < 1.23


@pytest.mark.parametrize(
    "odd",
    [{"level": 1.0}, {"rate": 0.1}, {"ranks": True}, {"candidate": "lqr"}, {"engine": "dreal"}, {"around": "rest"}],
)
def test_options_of_an_ellipsoid_are_refused(odd: dict[str, object]) -> None:
    with pytest.raises(OptionError, match="`claim` invariant has no ellipsoid"):
        RoaOptions(claim="invariant", **odd)  # type: ignore[arg-type]


def test_pages_and_words(given: InvariantResult) -> None:
    from certify.report.drawn import page_of
    from certify.report.stayed import summary

    assert given.raw is not None and given.certificate is not None
    answer = run_checker(given.certificate)
    page = page_of(given.raw, given.certificate, answer, given.to_dict())
    assert "never leaves" in page and "PROVED" in page and page.count("<svg") + page.count("data:image/svg") >= 1
    refused = page_of(given.raw, given.certificate, {"result": "REJECTED", "rule": "outer", "at": "x"}, None)
    assert "Nothing here is proved" in refused and "PROVED · ACCEPTED" not in refused
    assert summary(given.to_dict()) is not None
    assert len(list(itertools.chain(given.to_dict()["seconds"]))) >= 4
