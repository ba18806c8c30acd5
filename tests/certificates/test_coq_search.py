"""What the search finds holds where it is looked at point by point, and where it finds nothing it says why."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from functools import cache
from itertools import product

import numpy as np
import pytest

from certify.certificates.coq import search as searching
from certify.certificates.coq.data import Claimed, read_claim
from certify.certificates.coq.evidence import Evidence, Leaf, Split, Tree, inverse
from certify.certificates.coq.search import Found, Limits, jacobian, search
from certify.certificates.coq.slopes import Boxes, Interval, Quantity, bounds
from certify.certificates.coq.text import evidence_text
from certify.errors import InputError
from tests.certificates.coq_cases import Document, everything, pendulum, raw, scalar, van_der_pol
from tests.certificates.test_coq_data import in_file
from tests.support.certificates import edited, encode, make, rehash

Array = np.ndarray


def claim_of(data: Document) -> Claimed:
    return read_claim(raw(rehash(data)))


@cache
def pendulums() -> Found:
    return search(claim_of(pendulum()), Fraction(1, 13))


def evidence_of(found: Found) -> Evidence:
    assert found.evidence is not None, found.reason
    return found.evidence


def boxes_of(node: Tree, lo: Array, hi: Array) -> Iterator[tuple[Leaf, Array, Array]]:
    """The boxes that are not divided; that a box is divided within itself is asked on the way."""
    if isinstance(node, Leaf):
        yield node, lo, hi
        return
    assert isinstance(node, Split) and lo[node.axis] < node.at < hi[node.axis]
    below, above = hi.copy(), lo.copy()
    below[node.axis] = above[node.axis] = node.at
    yield from boxes_of(node.below, lo, below)
    yield from boxes_of(node.above, above, hi)


def loop(data: Document, x: Array) -> tuple[Array, Array, Array]:
    """Inputs, F and V at states (N, n), from the file's own trees."""
    claimed = claim_of(data)
    u = claimed.network(x, claimed.u_eq)
    names = (*data["plant"]["states"], *data["plant"]["inputs"])
    values = [dict(zip(names, row, strict=True)) for row in np.hstack([x, u]).tolist()]
    F = np.array([[in_file(tree, row) for tree in data["plant"]["dynamics"]] for row in values])
    return u, F, np.einsum("ki,ij,kj->k", x, claimed.P, x)


def replay(data: Document, evidence: Evidence, rate: float) -> None:
    """All that Coq asks of the evidence, at the corners of each box and at points within."""
    claimed, rng = claim_of(data), np.random.default_rng(0)
    n = claimed.n
    for i, j in product(range(n), repeat=2):
        assert sum(evidence.T[i][k] * evidence.W[k][j] for k in range(n)) == (i == j)
    T = np.array(evidence.T, dtype=float)
    root, core = np.array(evidence.root), np.array(evidence.core)
    ball = rng.standard_normal((500, n))
    ball *= np.sqrt(claimed.level / np.einsum("ki,ij,kj->k", ball, claimed.P, ball))[:, None]
    assert np.all(np.abs(ball @ np.array(evidence.W, dtype=float).T) < root)
    lo, hi = np.array(claimed.domain, dtype=float).T
    assert np.all((ball > lo) & (ball < hi))
    small, large = np.array(claimed.bounds, dtype=float).T
    corners = np.array(list(product((0.0, 1.0), repeat=n)))
    for leaf, lo, hi in boxes_of(evidence.splits, -root, root):
        z = lo + np.vstack([corners, rng.uniform(size=(12, n))]) * (hi - lo)
        u, F, V = loop(data, z @ T.T)
        D = 2 * np.einsum("ki,ij,kj->k", z @ T.T, claimed.P, F) + rate * V
        if V.min() > claimed.level:
            continue
        assert np.all((u >= small) & (u <= large))
        if np.all(np.abs(z) <= core):
            assert np.all(D < 0)
            continue
        assert leaf.k >= 0 and np.all(D + leaf.k * (claimed.level - V) < 0)


def test_the_pendulums_evidence_holds() -> None:
    found = pendulums()
    replay(pendulum(), evidence_of(found), 1 / 13)
    assert found.rate == Fraction(1, 13) and found.boxes >= evidence_of(found).leaves and not found.reason


def test_the_pendulum_takes_few_boxes() -> None:
    """585 with plain bounds, 271 with slopes and no multipliers (of the level 0.999999)."""
    assert evidence_of(pendulums()).leaves <= 140


def test_multipliers_show_what_holds_in_the_set_alone() -> None:
    """Beyond the level V increases somewhere, and without multipliers 309 boxes are needed."""
    found = search(claim_of(van_der_pol()), Fraction(1, 4000))
    replay(van_der_pol(), evidence_of(found), 1 / 4000)
    assert evidence_of(found).leaves <= 200


@pytest.mark.parametrize("data", [pendulum(), van_der_pol()], ids=["pendulum", "van der pol"])
def test_the_bounds_show_every_leaf(data: Document) -> None:
    """The search's own bounds, box by box as Coq looks at them, with the multiplier that is written."""
    claimed, rate = claim_of(data), Fraction(1, 4000)
    evidence = evidence_of(search(claimed, rate))
    root, core = np.array(evidence.root), np.array(evidence.core)
    used = 0
    for leaf, lo, hi in boxes_of(evidence.splits, -root, root):
        found = bounds(claimed, np.array(evidence.T, dtype=float), Boxes((lo + hi)[None] / 2, (hi - lo)[None] / 2))
        decay = found.Vdot + found.V.times(float(rate)) + found.V.plus(-claimed.level).times(-leaf.k)
        falls = leaf.k >= 0 and decay.cut().range.hi[0] < 0
        assert falls or found.V_plain.lo[0] > claimed.level or (np.all(lo >= -core) and np.all(hi <= core))
        used += leaf.k > 0
    assert used > 0


def test_a_rate_that_hardly_holds() -> None:
    """Near the origin V decays at the rate 1."""
    data = edited(scalar(), "levels.roa", (0.01).hex())
    replay(data, evidence_of(search(claim_of(data), Fraction(99, 100))), 0.99)


def test_the_text_has_every_leaf_and_split() -> None:
    evidence = evidence_of(pendulums())
    text = evidence_text(evidence)
    assert text.count("Leaf ") == evidence.leaves and text.count("Split ") == evidence.leaves - 1
    assert text.count("(") == text.count(")") and max(map(len, text.splitlines())) <= 120
    assert all(abs(v.numerator) < 2**21 for row in evidence.T for v in row)


@pytest.mark.parametrize("coordinates", [[[0.7]], [[-3.0]]])
def test_a_scalar_loop(coordinates: list[list[float]]) -> None:
    data = edited(scalar(), "evidence.T", encode(coordinates))
    found = search(claim_of(data))
    replay(data, evidence_of(found), float(found.rate))
    assert found.rate == Fraction(1, 40)  # a twentieth of 1/2


def test_a_core_that_is_all_needs_no_division() -> None:
    data = make(["u"], [([[1.0]], [0.0])], [[1.0]], (0.001, 0.01), centre="none", squash="identity")
    evidence = evidence_of(search(claim_of(data)))
    assert isinstance(evidence.splits, Leaf) and evidence.core == evidence.root
    replay(data, evidence, 0.05)


def test_asymmetric_domains_and_inputs_count_where_they_are_narrow() -> None:
    """The set is |x| <= 1: a domain to -1.2 holds it, and one to -0.9 does not, whatever the other side is."""
    assert search(claim_of(edited(scalar(), "plant.domain.0", ["-6/5", "99"]))).evidence is not None
    found = search(claim_of(edited(scalar(), "plant.domain.0", ["-9/10", "99"])))
    assert found.evidence is None and "does not lie in the domain" in found.reason
    assert search(claim_of(edited(scalar(), "plant.input_bounds.0", ["-4/5", "4/5"]))).evidence is not None
    narrow = claim_of(edited(scalar(), "plant.input_bounds.0", ["-7/10", "4/5"]))
    assert search(narrow, Fraction(1, 40), Limits(5, 100)).evidence is None


def test_what_is_false_is_not_found() -> None:
    """|x| < 1.915 is attracted, and x = 1.92 is not; V decays at most at the rate 1 near the origin."""
    at = edited(edited(scalar(), "plant.domain.0", ["-9", "9"]), "levels.roa", (1.92**2).hex())
    found = search(claim_of(at))
    assert found.evidence is None and "V does not decrease at this rate" in found.reason
    assert search(claim_of(edited(at, "levels.roa", (1.88**2).hex()))).evidence is not None
    found = search(claim_of(scalar()), Fraction(101, 100))
    assert found.evidence is None and "no box around the origin is small enough" in found.reason


def test_a_loop_that_is_not_stable() -> None:
    found = search(claim_of(edited(scalar(), "plant.dynamics.0", ["+", ["*", "2", "x"], "u"])))
    assert found.evidence is None and found.reason == "the linearised loop does not decay"


def test_a_small_rate_is_tried_where_a_larger_one_fails() -> None:
    """At |x| = 1.9, V decays at the rate 0.0067 only: 1/40 is too much, and 1/160 takes far more boxes than 1/640."""
    data = edited(edited(scalar(), "plant.domain.0", ["-9", "9"]), "levels.roa", (1.9**2).hex())
    found = search(claim_of(data))
    replay(data, evidence_of(found), float(found.rate))
    assert found.rate == Fraction(1, 640)
    assert evidence_of(found).leaves < 0.7 * evidence_of(search(claim_of(data), Fraction(1, 160))).leaves


def test_a_certificates_rate_is_the_least() -> None:
    data = edited(scalar(), "claim.rate", (0.0625).hex())
    assert search(claim_of(data)).rate == Fraction(1, 8)
    with pytest.raises(InputError, match=r"at least 0\.125"):
        search(claim_of(data), Fraction(1, 9))


def test_limits_end_the_search() -> None:
    found = search(claim_of(pendulum()), Fraction(1, 13), Limits(boxes=20))
    assert found.evidence is None and "more than 20 boxes are needed" in found.reason
    found = search(claim_of(pendulum()), Fraction(1, 13), Limits(seconds=1e-9))
    assert found.evidence is None and "the time ended" in found.reason
    for wrong in ({"seconds": 0.0}, {"boxes": 0}):
        with pytest.raises(InputError, match="limits must be positive"):
            Limits(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("plant.dynamics.0", ["+", ["*", "1/2", "x"], "u", "1/9"], r"found 1/9 in entry 0"),
        ("plant.dynamics.0", ["+", ["*", "1/2", "x"], "u", ["sin", "1"]], "found no rational number"),
        ("plant.dynamics.0", ["+", "u", ["/", "x", "x"]], "found no rational number"),
        ("networks.0.steps.0.bias", encode([0.5]), "must have no biases"),
        ("policy.offset", encode([0.5]), "must have no biases and the offset u_eq"),
    ],
)
def test_a_loop_must_rest_by_its_form(path: str, value: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        search(claim_of(edited(scalar(), path, value)))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("lyapunov.P", encode([[5e-324]])),
        ("evidence.T", encode([[1e308]])),
        ("levels.roa", (5e-324).hex()),
        ("claim.rate", (1.7e308).hex()),
        ("plant.domain.0", ["-" + "9" * 1200, "9" * 1200]),
        ("plant.dynamics.0", ["+", ["*", "9" * 1200, "x"], "u"]),
    ],
)
def test_numbers_beyond_floats_end_the_search(path: str, value: object) -> None:
    found = search(claim_of(edited(scalar(), path, value)))
    assert found.evidence is None and "floats cannot hold" in found.reason


def test_every_function_at_rest() -> None:
    data = everything()
    _, F, _ = loop(data, np.zeros((1, 2)))
    assert np.allclose(F, 0)
    found = search(claim_of(data))  # which asks that it rests by its form, and then finds that it is unstable
    assert found.evidence is None and "decay" in found.reason


# Bounds by slopes


def test_ranges_and_slopes_hold_what_they_bound() -> None:
    """Of a loop with every function: at points of boxes inputs, F, V and Vdot lie in their ranges, and differ from
    their values at the centre by slopes times distances."""
    data, rng = everything(), np.random.default_rng(1)
    claimed, T = claim_of(data), np.array([[0.4, -0.2], [0.1, 0.5]])
    centre, half = rng.uniform(-0.6, 0.6, (60, 2)), 10.0 ** rng.uniform(-4, -0.5, (60, 2))
    found = bounds(claimed, T, Boxes(centre, half))
    at_centre = by_hand(data, centre @ T.T)
    for _ in range(20):
        away = rng.uniform(-1, 1, centre.shape) * half
        for q, here, there in zip(quantities(found), by_hand(data, (centre + away) @ T.T), at_centre, strict=True):
            contains(q.range, here)
            contains(q.range, there)
            contains(Interval(q.value, q.value), there)
            reach = q.slopes * Interval(away, away)
            contains(reach.total(), here - there)
        contains(found.V_plain, by_hand(data, (centre + away) @ T.T)[-2])


def quantities(found: object) -> list[Quantity]:
    inputs, F, V, Vdot = (getattr(found, name) for name in ("inputs", "F", "V", "Vdot"))
    return [*inputs, *F, V, Vdot]


def by_hand(data: Document, x: Array) -> list[Array]:
    u, F, V = loop(data, x)
    return [*u.T, *F.T, V, 2 * np.einsum("ki,ij,kj->k", x, claim_of(data).P, F)]


def contains(interval: Interval, value: Array) -> None:
    slack = 1e-12 * (1 + np.abs(value))
    assert np.all((interval.lo - slack <= value) & (value <= interval.hi + slack))


def test_slopes_are_narrow() -> None:
    """On ever smaller boxes, ranges grow with the boxes and slopes become derivatives."""
    data = everything()
    claimed, centre = claim_of(data), np.array([[0.3, -0.2]])
    wide, narrow = (bounds(claimed, np.eye(2), Boxes(centre, np.full((1, 2), w))) for w in (1e-2, 1e-4))
    for a, b in zip(quantities(wide), quantities(narrow), strict=True):
        assert np.all(b.slopes.hi - b.slopes.lo <= 0.011 * (a.slopes.hi - a.slopes.lo) + 1e-12)
        assert b.range.hi - b.range.lo <= 0.011 * (a.range.hi - a.range.lo)


FUNCTIONS = {
    "sin": np.sin, "cos": np.cos, "tanh": np.tanh, "exp": np.exp, "atan": np.arctan, "sqrt": np.sqrt,
    "inv": lambda t: 1 / t, "2": lambda t: t**2, "3": lambda t: t**3, "1": lambda t: t,
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_on_intervals(name: str) -> None:
    """Wide ones and narrow ones; at their ends slopes are what they are least able to hide."""
    rng, function = np.random.default_rng(5), FUNCTIONS[name]
    centre, half = rng.uniform(-6, 6, (300, 1)), 10.0 ** rng.uniform(-2, 0.7, (300, 1))
    if name in ("sqrt", "inv"):
        half = np.minimum(half, 0.999 * np.abs(centre))
    if name == "sqrt":
        centre = np.abs(centre)
    z = Boxes(centre, half).coordinates()
    q = z.power(int(name)) if name.isdigit() else z.function(name)
    assert np.allclose(q.value, function(centre))
    for share in (-1, -0.7, -0.3, 0, 0.4, 0.8, 1):
        value = function(centre + share * half)
        contains(q.range, value)
        contains(
            (q.slopes * Interval(share * half[..., None], share * half[..., None])).total(), value - function(centre)
        )


@pytest.mark.parametrize(
    ("name", "lo", "hi"), [("inv", -1.0, 2.0), ("inv", 0.0, 1.0), ("sqrt", -0.1, 1.0), ("sqrt", 0.0, 1.0)]
)
def test_what_is_undefined_is_not_bounded(name: str, lo: float, hi: float) -> None:
    box = Boxes(np.array([[(lo + hi) / 2]]), np.array([[(hi - lo) / 2]]))
    with np.errstate(all="ignore"):
        assert np.isnan(box.coordinates()[0].function(name).range.lo).all()


def test_a_box_where_the_plant_is_undefined_is_not_done() -> None:
    """1/(x + 1/2) within the set: nothing is found, and nothing is taken for decrease."""
    pole = ["-", ["/", "1", ["+", "x", "1/2"]], "2"]
    found = search(
        claim_of(edited(scalar(), "plant.dynamics.0", ["+", ["*", "-9", "x"], pole, "u"])), None, Limits(5, 500)
    )
    assert found.evidence is None


def test_the_jacobian() -> None:
    data, step = everything(), 1e-6
    J = jacobian(claim_of(data))
    for j, e in enumerate(np.eye(2)):
        _, up, _ = loop(data, (step * e)[None])
        _, down, _ = loop(data, (-step * e)[None])
        assert np.allclose(J[:, j], (up - down)[0] / (2 * step), rtol=1e-6)


def test_definite_matrices() -> None:
    rng = np.random.default_rng(0)
    for n in (1, 2, 4):
        M = rng.standard_normal((40, n, n))
        M += np.eye(n) * rng.uniform(-1, 4, (40, 1, 1))
        found = searching._definite(Interval(M, M))
        least = np.linalg.eigvalsh(M + M.transpose(0, 2, 1)).min(1)
        assert np.array_equal(found, least > 0) and found.any() and not found.all()
        assert not searching._definite(Interval(M - 10, M + 10)).any()


def test_an_inverse_is_exact() -> None:
    M = tuple(tuple(Fraction(v) for v in row) for row in ((0, 1, 0), (2, 5, 7), (1, 1, "1/3")))
    W = inverse(M)
    assert all(sum(M[i][k] * W[k][j] for k in range(3)) == (i == j) for i in range(3) for j in range(3))
    with pytest.raises(InputError, match="singular"):
        inverse(((Fraction(1), Fraction(2)), (Fraction(2), Fraction(4))))
