"""Whether states lie in a proved set, decided in rationals: about files that the checker accepts and no others."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from certify import PolicyNetwork, certify_roa
from certify.analysis.arguments import region
from certify.certificates import parse_certificate
from certify.certificates.ellipsoids import Box, Ellipsoid
from certify.certificates.located import Containment, Located
from certify.certificates.membership import ProvedSet, proved_set
from certify.cli.main import _run
from certify.errors import CertificateFormatError, InputError
from certify.loop.expressions import Number, Symbol, cos, sin, symbols
from certify.loop.plants import System, load_system
from certify.lyapunov import Neural, Symbolic
from certify.lyapunov.sublevel import Sublevel
from controllers.evaluation.proved_set import count_covered
from tests.support.beyond import line, network, plane
from tests.support.certificates import write
from tests.support.loops import box
from tests.support.marks import slow_after

EXAMPLES = Path(__file__).parent.parent.parent / "examples"
F = Fraction


def still(n: int, x_eq: tuple[int, ...] = ()) -> System:
    """x' = -x, with an input that does nothing."""
    states = symbols(f"x{i}" for i in range(n))
    u = Symbol("u")
    return System(
        name="still",
        states=states,
        inputs=(u,),
        parameters={},
        dynamics=(-states[0] + u, *(-s for s in states[1:])),
        u_eq=(Number(0),),
        domain=box(*[3] * n),
        input_bounds=box(1),
        x_eq=tuple(map(Number, x_eq)),
    )


def union(*matrices: Any, level: float = 1.0) -> ProvedSet:
    ellipsoids = tuple(Ellipsoid(f"E{k}", np.array(P, dtype=float), level) for k, P in enumerate(matrices))
    system, unknown = still(len(ellipsoids[0].P)), "0" * 64
    return ProvedSet(ellipsoids, system=system, claim="asymptotic", policy_sha256=unknown, certificate_sha256=unknown)


def at(*values: Fraction | int) -> Box:
    return tuple((F(v), F(v)) for v in values)


@pytest.fixture(scope="module")
def disc(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An accepted certificate of x^2 + y^2 <= 1, in deviations from (2, 0)."""
    folder = tmp_path_factory.mktemp("disc")
    law = PolicyNetwork.of_layers((np.zeros((1, 2)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    result = certify_roa(still(2, (2, 0)), law, folder, P=np.eye(2), level=1.0)
    assert result.verdict.value == "PROVED" and result.certificate is not None, result.reason
    return result.certificate


@pytest.fixture(scope="module")
def enlarged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An accepted certificate with a tube, for the shipped policy of the pendulum."""
    folder = tmp_path_factory.mktemp("tube")
    policy = EXAMPLES / "policies" / "pendulum.pt"
    result = certify_roa("pendulum", policy, folder, level=0.3, enlarge=True, effort=0.4)
    assert result.tube is not None and result.certificate is not None, result.reason
    return result.certificate


# --------------------------------------------------------------------------------------------------- points and boxes


@pytest.mark.parametrize(
    ("state", "answer"),
    [
        ((F(3, 5), F(4, 5)), Containment.CONTAINED),  # on the boundary, exactly
        ((F(3, 5) + F(1, 10**40), F(4, 5)), Containment.NOT_CONTAINED),
        ((F(3, 5) - F(1, 10**40), F(4, 5)), Containment.CONTAINED),
        ((F(0), F(0)), Containment.CONTAINED),
        ((F(1), F(1, 10**200)), Containment.NOT_CONTAINED),
    ],
)
def test_points_at_the_boundary(state: tuple[Fraction, ...], answer: Containment) -> None:
    found = union(np.eye(2)).locate(at(*state))
    assert found.answer is answer
    assert (found.within == "E0") is (answer is Containment.CONTAINED)
    assert (found.outside == state) is (answer is Containment.NOT_CONTAINED)


def test_a_box_is_contained_up_to_its_corners() -> None:
    disc = union(np.eye(2))
    touching = (F(-3, 5), F(3, 5)), (F(-4, 5), F(4, 5))
    assert disc.locate(touching).answer is Containment.CONTAINED
    beyond = (F(-3, 5), F(3, 5)), (F(-4, 5), F(4, 5) + F(1, 10**30))
    found = disc.locate(beyond)
    assert found.answer is Containment.NOT_CONTAINED and found.outside is not None
    assert abs(found.outside[1]) == F(4, 5) + F(1, 10**30)


@pytest.mark.parametrize("n", [2, 17])  # corner by corner, and by a bound
def test_an_ellipsoid_may_lie_around_another_point(n: int) -> None:
    """The unit ball around (2, 0, ...): what is contained of a box is what is left of it as seen from there."""
    centre = (2.0, *[0.0] * (n - 1))
    plain = union(np.eye(n))
    moved = replace(plain, claim="reached", ellipsoids=(Ellipsoid("E0", np.eye(n), 1.0, centre),))
    side = F(1, 5)
    around = ((F(2) - side, F(2) + side), *[(-side, side)] * (n - 1))
    assert moved.locate(around).answer is Containment.CONTAINED
    assert plain.locate(around).answer is Containment.NOT_CONTAINED
    assert moved.locate(at(F(3), *[0] * (n - 1))).answer is Containment.CONTAINED  # on its boundary
    beyond = at(F(3) + F(1, 10**40), *[0] * (n - 1))
    assert moved.locate(beyond).answer is Containment.NOT_CONTAINED
    assert moved.holds([[0] * n, [F(5, 2), *[0] * (n - 1)]]) == [False, True]


def test_levels_are_the_binary_numbers_that_they_are() -> None:
    tenth = union(np.eye(1), level=0.1)
    assert F(0.1) > F(1, 10)  # of a square 0.1 exactly, the binary number lets in a little more
    inside, outside = math.isqrt(10**59), math.isqrt(10**59) + 10**18
    assert tenth.locate(at(F(inside, 10**30))).answer is Containment.CONTAINED
    assert tenth.locate(at(F(outside, 10**30))).answer is Containment.NOT_CONTAINED


def test_a_box_across_a_union() -> None:
    """All corners lie in one of two ellipsoids, none in both; the middles of the sides lie in neither: not decided."""
    one = [[31 / 6, -29 / 6], [-29 / 6, 31 / 6]]
    other = [[31 / 6, 29 / 6], [29 / 6, 31 / 6]]
    both = union(one, other)
    square = ((F(-1), F(1)), (F(-1), F(1)))
    assert both.locate(square).answer is Containment.UNDECIDED
    assert both.locate(at(1, 0)).answer is Containment.NOT_CONTAINED
    assert [both.locate(at(1, s)).within for s in (1, -1)] == ["E0", "E1"]
    assert both.holds([(1, 1), (1, -1), (1, 0)]) == [True, True, False]


@pytest.mark.parametrize(
    ("half", "answer"), slow_after(1, [(F(1, 5), Containment.CONTAINED), (F(1, 4), Containment.NOT_CONTAINED)])
)
def test_more_corners_than_are_looked_at(half: Fraction, answer: Containment) -> None:
    assert union(np.eye(20)).locate(((-half, half),) * 20).answer is answer
    assert union(np.eye(16)).locate(((-half, half),) * 16).answer is Containment.CONTAINED


def test_where_the_bound_is_too_large_nothing_is_said() -> None:
    """x'Px is largest at corners of alternating signs, which nobody looks at here; a bound is larger still."""
    n = 18
    P = np.eye(n) - 0.45 * (np.eye(n, k=1) + np.eye(n, k=-1))
    rising = np.ones(n)
    half = F(1, 4)
    assert float(rising @ P @ rising) / 16 < 1 < n / 16
    assert union(P).locate(((-half, half),) * n).answer is Containment.UNDECIDED
    assert union(P).locate(((-half / 3, half / 3),) * n).answer is Containment.CONTAINED


def test_the_bound_counts_what_is_off_the_middle() -> None:
    """Of 17 states one lies far out: the terms across the middle and the width decide."""
    n = 17
    P = np.eye(n)
    around = ((F(9, 10), F(95, 100)),) + ((F(-1, 20), F(1, 20)),) * (n - 1)
    value = F(95, 100) ** 2 + (n - 1) * F(1, 400)
    assert union(P, level=float(value) + 1e-9).locate(around).answer is Containment.CONTAINED
    assert union(P, level=float(value) - 1e-9).locate(around).answer is Containment.NOT_CONTAINED


@given(st.integers(1, 4), st.integers(0, 10**6))
def test_what_is_said_to_be_contained_is(n: int, seed: int) -> None:
    """Every answer against points of the box, whose values are rational."""
    generator = np.random.default_rng(seed)
    root = generator.standard_normal((n, n))
    where = union(root @ root.T + 0.1 * np.eye(n), level=float(generator.uniform(0.5, 8)))
    middle, half = generator.uniform(-1, 1, n), generator.uniform(0, 1, n) * (generator.random(n) < 0.7)
    region = tuple((F(c) - F(h), F(c) + F(h)) for c, h in zip(middle, half, strict=True))
    found = where.locate(region)
    shares = generator.integers(0, 65, (20, n))
    points = [[lo + (hi - lo) * F(int(k), 64) for (lo, hi), k in zip(region, row, strict=True)] for row in shares]
    if found.answer is Containment.CONTAINED:
        assert all(where.holds(points))
    else:
        assert found.answer is Containment.NOT_CONTAINED and found.outside is not None
        assert where.holds([found.outside]) == [False]
        assert all(v in pair for v, pair in zip(found.outside, region, strict=True))


@pytest.mark.parametrize("wrong", [((F(0), F(0)),), ((F(1), F(0)), (F(0), F(0)))])
def test_what_is_no_box_is_refused(wrong: Box) -> None:
    with pytest.raises(InputError, match="2 intervals lo <= hi"):
        union(np.eye(2)).locate(wrong)


def test_a_containment_is_no_bool() -> None:
    with pytest.raises(TypeError, match="is no bool"):
        bool(Containment.NOT_CONTAINED)


# ------------------------------------------------------------------------------------------------------ how it is asked


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x0=2.5", ((F(1, 2), F(1, 2)), (F(0), F(0)))),
        ("x1=1/3", ((F(0), F(0)), (F(1, 3), F(1, 3)))),
        (" x1 = -0.1 .. .2 , x0 = 1..3", ((F(-1), F(1)), (F(-1, 10), F(1, 5)))),
        ("x1=1e-3..1e-3", ((F(0), F(0)), (F(1, 1000), F(1, 1000)))),
    ],
)
def test_states_are_named_by_their_values(text: str, expected: Box) -> None:
    assert region(text, still(2, (2, 0)), "STATES") == expected


def test_deviations_are_what_they_say() -> None:
    assert region("x0=1/2", still(2, (2, 0)), "STATES", deviations=True) == ((F(1, 2), F(1, 2)), (F(0), F(0)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "takes NAME=VALUE"),
        ("x0", "takes NAME=VALUE"),
        ("x0=", "takes NAME=VALUE"),
        ("x0=1,", "takes NAME=VALUE"),
        ("y=1", "no state 'y'; it has: x0, x1"),
        ("x0=1,x0=1", "found x0 twice"),
        ("x0=2..1", "LO <= HI"),
        ("x0=nan", "must be a finite number"),
        ("x0=1..inf", "must be a finite number"),
        ("x0=1..", "must be a finite number"),
        ("x0=one", "must be a finite number"),
    ],
)
def test_what_names_no_state_is_refused(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        region(text, still(2), "STATES")


# ------------------------------------------------------------------------------------------------------- certificates


def ask(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, dict[str, Any]]:
    status = _run([*map(str, arguments), "--json"], True)
    return status, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(
    ("states", "status", "result"),
    [
        ("x0=2.6,x1=0.8", 0, "contained"),
        ("x0=2.6,x1=0.8000000000000000000000000000000000001", 1, "not contained"),
        ("x0=1.4..2.6,x1=-0.8..0.8", 0, "contained"),
        ("x0=1.4..2.6,x1=-0.8..0.9", 1, "not contained"),
        ("x1=1", 0, "contained"),
        ("x0=0", 1, "not contained"),
    ],
)
def test_the_command(disc: Path, capsys: pytest.CaptureFixture[str], states: str, status: int, result: str) -> None:
    found, data = ask(capsys, "contains", disc, states)
    assert (found, data["result"]) == (status, result)
    assert data["certificate_sha256"] == hashlib.sha256(disc.read_bytes()).hexdigest()
    assert data["operating_point"] == {"x0": "2", "x1": "0"} and data["claim"] == {"kind": "asymptotic"}
    assert (data["within"] == "{V <= c2}") is (status == 0) and (data["outside"] is None) is (status == 0)


def test_the_command_in_words(disc: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(["contains", str(disc), "x0=1.4..2.6"], False) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert first == "CONTAINED  x0 = 1.4..2.6, x1 = 0: in {V <= c2}" and "x0 = 2, x1 = 0" in second
    assert _run(["contains", str(disc), "x0=1..3,x1=1"], False) == 1
    assert capsys.readouterr().out.startswith("NOT CONTAINED  x0 = 1..3, x1 = 1: (1, 1) is not in the set")
    assert _run(["contains", str(disc), "x0=0.5", "--deviations"], False) == 0
    assert capsys.readouterr().out.startswith("CONTAINED  x0 = 2.5, x1 = 0")


@pytest.mark.parametrize(
    ("given", "shown"),
    [
        ("x0=2.99999999,x1=0", "CONTAINED  x0 = 2.99999999, x1 = 0"),
        ("x0=3.00000001,x1=0", "NOT CONTAINED  x0 = 3.00000001, x1 = 0"),
        ("x0=7/3,x1=0", "CONTAINED  x0 = 7/3, x1 = 0"),
        ("x0=2..2.9999999,x1=0", "CONTAINED  x0 = 2..2.9999999, x1 = 0"),
        ("x0=2.99999999999999999999999999,x1=0", "CONTAINED  x0 = about 3, x1 = 0"),
    ],
)
def test_an_answer_is_about_the_number_that_it_shows(
    disc: Path, capsys: pytest.CaptureFixture[str], given: str, shown: str
) -> None:
    """Six digits of a state next to the boundary may be a state on its other side."""
    _run(["contains", str(disc), given], False)
    assert capsys.readouterr().out.startswith(shown)


def test_a_number_beyond_all_floats_is_refused(disc: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, data = ask(capsys, "contains", disc, "x0=1e400")
    assert status == 2 and data["error"] == "`x0` must be a number below 1.8e308 in size; found 1e400."


def test_bad_usage(disc: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert ask(capsys, "contains", disc, "y=1") == (2, {"error": "still has no state 'y'; it has: x0, x1."})
    status, data = ask(capsys, "contains", tmp_path / "none.json", "x0=1")
    assert status == 2 and "cannot be read" in data["error"]


def document(path: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads(path.read_text())
    return data


def larger_level(data: dict[str, Any]) -> None:
    data["levels"]["roa"] = (20.0).hex()


def less_than_a_tree(data: dict[str, Any]) -> None:
    data["evidence"]["tree"] = ""


def a_solver(data: dict[str, Any]) -> None:
    word = {"kind": "trusted-solver", "solver": "dReal", "version": "4", "precision": (0.5).hex(), "queries": []}
    data["evidence"] = word


@pytest.mark.parametrize(
    ("forge", "said"),
    [(larger_level, "REJECTED rule=domain"), (less_than_a_tree, "REJECTED rule=tree"), (a_solver, "TRUSTED")],
)
def test_what_the_checker_does_not_accept_has_no_proved_set(
    disc: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    forge: Callable[[dict[str, Any]], None],
    said: str,
) -> None:
    data = document(disc)
    forge(data)
    path = tmp_path / "certificate.json"
    path.write_text(json.dumps(data))
    status, answer = ask(capsys, "contains", path, "x0=2")
    assert status == 2 and "must be a certificate that the checker accepts" in answer["error"]
    assert said in answer["error"]
    with pytest.raises(InputError):
        proved_set(path)


def test_a_file_that_is_none(tmp_path: Path) -> None:
    path = tmp_path / "certificate.json"
    path.write_text("{}")
    with pytest.raises((InputError, CertificateFormatError)):
        proved_set(path)


def test_a_forged_operating_point_is_shown_and_moves_no_deviation(
    disc: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The checker knows nothing of it, so that a file with another one is accepted: it is said with every answer."""
    data = document(disc)
    data["provenance"]["x_eq"] = {"x0": "100", "x1": "0"}
    path = tmp_path / "certificate.json"
    path.write_text(json.dumps(data))
    status, answer = ask(capsys, "contains", path, "x0=100.5")
    assert status == 0 and answer["operating_point"] == {"x0": "100", "x1": "0"}
    for file in (path, disc):
        assert ask(capsys, "contains", file, "x0=1.5", "--deviations")[0] == 1
        assert ask(capsys, "contains", file, "x0=0.5", "--deviations")[0] == 0


@pytest.mark.slow
def test_a_tube_s_start_belongs_to_the_set(enlarged: Path) -> None:
    proved = proved_set(enlarged)
    inner, start = proved.ellipsoids
    assert (proved.claim, inner.name, start.name) == ("enlarged", "{V <= c2}", "the tube's start")
    names = set()
    for ellipsoid, other in ((inner, start), (start, inner)):
        for direction in np.vstack([np.eye(2), np.random.default_rng(0).standard_normal((200, 2))]):
            x = direction * 0.999 * math.sqrt(ellipsoid.level / (direction @ ellipsoid.P @ direction))
            found = proved.locate(at(*map(F, x)))
            assert found.answer is Containment.CONTAINED
            if x @ other.P @ x > 1.01 * other.level:
                names.add(found.within)
                assert found.within == ellipsoid.name
    assert "the tube's start" in names


# ------------------------------------------------------------------------------------------------------- an outer set


@pytest.fixture(scope="module")
def beyond(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """x^2 + y^2 <= 1/4 united with {N <= -2.55}, N a network, both even in x and y."""
    return write(network(), tmp_path_factory.mktemp("network"))


@pytest.fixture(scope="module")
def by_formula(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """x^2 + y^2 <= 1/4 united with x^2 + y^2/4 <= 0.9 in |x|, |y| <= 2."""
    return write(plane(), tmp_path_factory.mktemp("formula"))


INNER, OUTER = "{V <= c2}", "{N <= n2} within the domain"


def test_the_outer_set_belongs_to_it(by_formula: Path) -> None:
    where = proved_set(by_formula)
    for states, within in (
        ("x=0.1,y=0.2", INNER),
        ("x=0.9", OUTER),
        ("x=0.95", None),
        ("y=1.8973", OUTER),
        ("y=1.8975", None),
        ("y=2.5", None),  # beyond the domain
        ("x=-0.3..0.3,y=-0.3..0.3", INNER),
        ("x=-0.7..0.7,y=-1..1", OUTER),
        ("x=-0.7..0.7,y=-1.3..1.3", None),
        ("x=0.8,y=-1..1", OUTER),
    ):
        found = where.locate(region(states, where.system, "STATES"))
        answer = Containment.NOT_CONTAINED if within is None else Containment.CONTAINED
        assert (found.answer, found.within, found.outside is None) == (answer, within, within is not None), states


def test_the_command_knows_it(by_formula: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, data = ask(capsys, "contains", by_formula, "x=0.9")
    assert (status, data["within"], data["outside"]) == (0, OUTER, None)
    assert _run(["contains", str(by_formula), "x=0..0.9,y=1"], False) == 1
    assert capsys.readouterr().out == "NOT CONTAINED  x = 0..0.9, y = 1: (0.9, 1) is not in the set\n"


def test_a_state_on_the_boundary_is_decided_in_rationals(tmp_path: Path) -> None:
    """x^2 is 9/16, which is a binary number, at 3/4."""
    where = proved_set(write(line(0.5625), tmp_path))
    assert where.locate(at(F(3, 4))).within == OUTER
    assert where.locate(at(F(3, 4) + F(1, 10**60))).answer is Containment.NOT_CONTAINED
    assert where.holds([[F(3, 4)], [F(3, 4) + F(1, 10**60)], [-0.75], [0.1]]) == [True, False, True, True]
    assert where.excludes([[F(3, 4)], [F(3, 4) + F(1, 10**60)], [-0.75], [0.1]]) == [False, True, False, False]


def test_sets_contain_a_box_together() -> None:
    """The disc is what {N <= 1} leaves out in its middle: neither contains the box, and both of them do."""
    x0, x1 = symbols("x0 x1")
    ring = Sublevel(Symbolic(1 / (Fraction(1, 4) + x0**2 + x1**2), (x0, x1)), 2.0, ((F(-3), F(3)),) * 2)
    both = replace(union(np.eye(2)), outer=ring)
    box = ((F(-6, 5), F(6, 5)), (F(-9, 10), F(9, 10)))
    assert both.locate(box) == Located(Containment.CONTAINED, within=f"E0 and {OUTER}")
    assert both.locate(((F(-3), F(3)),) * 2).answer is Containment.CONTAINED
    assert both.locate(((F(-3), F(3)), (F(-3), F(31, 10)))).answer is Containment.NOT_CONTAINED
    hole = replace(both, ellipsoids=union(np.eye(2), level=0.2).ellipsoids)  # {N <= 2} begins at 1/4
    found = hole.locate(box)
    assert found.answer is Containment.NOT_CONTAINED and found.outside is not None
    assert F(1, 5) < found.outside[0] ** 2 + found.outside[1] ** 2 < F(1, 4)


def test_boxes_that_touch_the_boundary_are_not_decided_by_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """sin^2 + cos^2 is 1 on all of the box, and no ball tells: it takes all the pieces there are, and says nothing."""
    monkeypatch.setattr("certify.certificates.membership._PIECES", 100)
    x0, x1 = symbols("x0 x1")
    flat = sin(x0) ** 2 + cos(x0) ** 2 + 0 * x1
    both = replace(union(np.eye(2)), outer=Sublevel(Symbolic(flat, (x0, x1)), 1.0, ((F(-3), F(3)),) * 2))
    assert both.locate(((F(3, 2), F(2)), (F(0), F(0)))) == Located(Containment.UNDECIDED)
    assert both.locate(at(2, 0)) == Located(Containment.UNDECIDED)


@given(st.integers(0, 10**6))
def test_what_is_said_of_a_union_is_true(seed: int) -> None:
    generator = np.random.default_rng(seed)
    weights = (generator.standard_normal((5, 2)), generator.standard_normal((1, 5)))
    N = Neural(weights, (generator.standard_normal(5), np.zeros(1)))
    level = float(np.quantile(N(generator.uniform(-2, 2, (200, 2))), 0.7))
    where = replace(union(np.eye(2), level=0.5), outer=Sublevel(N, level, ((F(-2), F(2)),) * 2))
    middle, half = generator.uniform(-1.5, 1.5, 2), generator.uniform(0, 0.6, 2)
    region = tuple((F(c) - F(h), F(c) + F(h)) for c, h in zip(middle, half, strict=True))
    found = where.locate(region)
    points = generator.uniform(middle - half, middle + half, (40, 2))
    inside = (np.sum(points**2, axis=1) <= 0.5) | ((N(points) <= level) & np.all(np.abs(points) <= 2, axis=1))
    assert where.holds(points.tolist()) == inside.tolist()
    assert where.excludes(points.tolist()) == (~inside).tolist()
    if found.answer is Containment.CONTAINED:
        assert all(inside)
    elif found.answer is Containment.NOT_CONTAINED:
        assert found.outside is not None and where.excludes([found.outside]) == [True]
        assert all(lo <= v <= hi for v, (lo, hi) in zip(found.outside, region, strict=True))


def test_judging_a_policy_counts_the_union(by_formula: Path) -> None:
    read = parse_certificate(by_formula.read_bytes(), "certificate")
    x = np.random.default_rng(1).uniform(-2, 2, (500, 2))
    found = count_covered(proved_set(by_formula), read.network, read.system, x)
    inside = (x[:, 0] ** 2 + x[:, 1] ** 2 / 4 <= 0.9) | (np.sum(x**2, axis=1) <= 0.25)
    assert (found.inside, found.states) == (np.count_nonzero(inside), 500) and found.inside > 100


def test_a_network_s_set_is_that_of_the_file(beyond: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where = proved_set(beyond)
    points = np.random.default_rng(0).uniform(-2, 2, (300, 2))
    value = sum(np.tanh(v - 1) - np.tanh(v + 1) for v in points.T)
    inside = (value <= -2.55) | (np.sum(points**2, axis=1) <= 0.25)
    assert where.holds(points.tolist()) == inside.tolist() and 10 < sum(inside) < 290
    assert ask(capsys, "contains", beyond, "x=-0.6..0.6,y=-0.5..0.5")[0] == 0
    assert ask(capsys, "contains", beyond, "x=-0.6..0.6,y=-0.9..0.5")[0] == 1


# ------------------------------------------------------------------------------------------------------- certify roa


MAGLEV = [
    "roa", "--policy", str(EXAMPLES / "policies" / "maglev.pt"),
    "--system", str(EXAMPLES / "plants" / "maglev.toml"), "--candidate", "lyapunov", "--quiet",
]  # fmt: skip
SMALL = ["--level", "1e-6"]


@pytest.mark.parametrize(
    ("states", "result", "word"),
    slow_after(
        1,
        [
            ("h=0.0101", "contained", "CONTAINED  h = 0.0101"),
            ("h=0.015..0.02", "not contained", "NOT CONTAINED  h = 0.015"),
        ],
    ),
)
def test_roa_says_it_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], states: str, result: str, word: str
) -> None:
    """In values of the states, whose operating point is h = 0.01."""
    command = [*MAGLEV, *SMALL, "--contains", states, "--out", str(tmp_path / "o")]
    status, data = ask(capsys, *command)
    assert status == 0 and data["contains"]["result"] == result
    assert ask(capsys, "contains", tmp_path / "o" / "certificate.json", states)[1]["result"] == result
    assert _run(command, False) == 0
    assert word in capsys.readouterr().out


def test_roa_without_a_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [*MAGLEV, "--level", "1e9", "--contains", "h=0.01", "--out", str(tmp_path / "o")]
    status, data = ask(capsys, *command)
    assert status != 0 and data["verdict"] != "PROVED"
    assert (data["contains"]["result"], data["contains"]["within"]) == ("undecided", None)
    assert _run(command, False) == status
    assert "UNDECIDED  h = 0.01, v = 0: nothing was proved" in capsys.readouterr().out


def test_roa_is_asked_in_vain(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What names no state is refused before anything is proved; and nobody asked is null."""
    status, data = ask(capsys, *MAGLEV, "--contains", "x=1", "--out", str(tmp_path / "o"))
    assert status == 2 and "has no state 'x'" in data["error"] and not (tmp_path / "o").exists()
    status, data = ask(capsys, *MAGLEV, *SMALL, "--out", str(tmp_path / "o"))
    assert status == 0 and data["contains"] is None


def test_the_operating_point_of_a_certificate_is_that_of_its_plant(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run([*MAGLEV, *SMALL, "--out", str(tmp_path / "o")], False) == 0
    capsys.readouterr()
    found = proved_set(tmp_path / "o" / "certificate.json").system.operating_point()
    assert found == load_system(EXAMPLES / "plants" / "maglev.toml").operating_point()
