"""The reference's rule `samples`: ends that functions attain, edges to 1e-12, each field of the format, the count.

What is expected is written down here from the format's text, in fractions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cache
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest
from flint import fmpq, fmpq_mat

from certify.reference import document
from certify.reference.__main__ import in_words
from certify.reference.refusal import Refused
from certify.reference.samples import ONE, Sampled, interval, read_samples
from tests.checker.test_handover import dumped, verdicts
from tests.support.certificates import Document, edited, grow, make
from tests.support.earlier import newer
from tests.support.marks import slow_after

F, BY = "claim.samples.functions.0", "evidence.samples.0"
ACCEPTED, REFUSED, MALFORMED = (None, None), ("samples", "samples"), ("format", "format")
CLOSE = Fraction(1, 10**12)
Numbers = Sequence[Fraction | int]


def texts(numbers: Numbers) -> list[str]:
    return [str(Fraction(q)) for q in numbers]


def exact(q: Any) -> fmpq:
    return fmpq(Fraction(q).numerator, Fraction(q).denominator)


def solved(rows: Sequence[Numbers], sums: Numbers) -> list[Fraction]:
    """Weights v with sum_k v_k rows_k = sums."""
    columns = fmpq_mat([list(map(exact, row)) for row in rows]).transpose()
    found = columns.solve(fmpq_mat([[exact(q)] for q in sums])).entries()
    return [Fraction(int(v.p), int(v.q)) for v in found]


# ---------------------------------------------------------------------------------------------- documents of this file

M = [[Fraction(1, 50), Fraction(1, 100)], [Fraction(1, 100), Fraction(1, 30)]]
BOX = [(-3, 3), (-1, 1)]
AXES = [[-3, Fraction(-1, 7), 0, 2, 3], [-1, 0, 1]]


def samples_of(g: Callable[..., Fraction], count: int, seed: int) -> tuple[list[list[Fraction]], list[Fraction]]:
    """Points anywhere in the box, and what g is there, off by 1/2000 in turn."""
    drawn = np.random.default_rng(seed).integers((-300, -100), (301, 101), (count, 2)).tolist()
    points = [[Fraction(x, 100), Fraction(u, 100)] for x, u in drawn]
    return points, [g(*z) + Fraction((-1) ** k, 2000) for k, z in enumerate(points)]


def rho(f: Document, z: Sequence[Fraction]) -> Fraction:
    pairs = product(range(len(z)), repeat=2)
    return sum((Fraction(f["curvature"][i][j]) * abs(z[i] * z[j]) for i, j in pairs), Fraction(0)) / 2


def ends(f: Document, p: Numbers, both: Sequence[Sequence[Any]]) -> tuple[Fraction, Fraction]:
    found = []
    for sign, weights in zip((-1, 1), both, strict=True):
        end = Fraction(0)
        for k, v in weights:
            away = [Fraction(a) - b for a, b in zip(f["points"][k], p, strict=True)]
            wrong = Fraction(f["noise"]) + rho(f, away)
            end += Fraction(v) * Fraction(f["values"][k]) + sign * abs(Fraction(v)) * wrong
        found.append(end)
    return found[0], found[1]


def by_nearest(f: Document, p: Numbers, one: bool, unit: Numbers) -> list[list[Any]]:
    """Weights of the nearest samples that span, the first in two parts; each next sample in place of one of them."""
    order = sorted(range(len(f["points"])), key=lambda k: sum((Fraction(a) - b) ** 2 for a, b in
                                                              zip(f["points"][k], p, strict=True)))  # fmt: skip
    chosen: list[int] = []
    rows: list[list[Fraction]] = []
    for k in order:
        row = [*([Fraction(1)] if one else []), *map(Fraction, f["points"][k])]
        if fmpq_mat([list(map(exact, r)) for r in (*rows, row)]).rank() == len(rows) + 1:
            chosen, rows = [*chosen, k], [*rows, row]
        if len(rows) == len(unit):
            break
    v = solved(rows, unit)
    first = [[chosen[0], str(v[0] / 3)], [chosen[0], str(2 * v[0] / 3)]]
    return [*first, *([k, str(w)] for k, w in zip(chosen[1:], v[1:], strict=True))]


def function(points: Sequence[Numbers], values: Numbers, vanishes: bool) -> Document:
    return {
        "state": "x", "variables": ["x", "u"], "box": list(map(texts, BOX)), "curvature": list(map(texts, M)),
        "noise": "1/1000", "vanishes": vanishes, "points": list(map(texts, points)), "values": texts(values),
    }  # fmt: skip


def with_samples(data: Document, f: Document, by: Document) -> Document:
    data = newer(data)
    claim = {**data["claim"], "samples": {"sha256": "0" * 64, "functions": [f]}}
    return {**data, "claim": claim, "evidence": {**data["evidence"], "samples": [by]}}


def far_equation(E: Fraction) -> list[Any]:
    return ["+", ["-", "x"], ["*", "1/2", "u"], ["*", "r", str(E)]]


def least(data: Document) -> Fraction:
    """The least constant E beside -x + u/2."""
    f, by = data["claim"]["samples"]["functions"][0], data["evidence"]["samples"][0]
    axes, off = [list(map(Fraction, axis)) for axis in by["axes"]], {}
    for p, both in zip(product(*axes), by["weights"], strict=True):
        lo, hi = ends(f, p, both)
        P = -p[0] + p[1] / 2
        off[p] = max(hi - P, P - lo)
    bends = []
    for cell in product(*map(pairwise, axes)):
        bend = sum(((b - a) / 2) ** 2 * Fraction(f["curvature"][j][j]) for j, (a, b) in enumerate(cell))
        bends.append(max(off[p] for p in product(*cell)) + bend / 2)
    return max(bends)


@cache
def far() -> Document:
    """x' = g(x, u) from 90 samples, each grid point's interval by its nearest."""
    data = make([far_equation(Fraction(1, 6))], [([[1.0]], [0.0])], [[1.0]], (0.04, 1.0), claim="practical",
                uncertain=[("r", "-1", "1")], cells=[1], centre="none")  # fmt: skip
    f = function(*samples_of(lambda x, u: -x + u / 2, 90, 1), False)
    weights = [[by_nearest(f, p, True, [1, *p])] * 2 for p in product(*AXES)]
    by = {"error": "r", "slopes": [], "axes": list(map(texts, AXES)), "weights": weights}
    data = with_samples(grow(data), f, by)
    return edited(data, "plant.dynamics.0", far_equation(least(data)))


@cache
def near() -> Document:
    """x' = g(x, u), g(0) = 0, whose slopes lie in the very ranges that the weights leave."""
    s, ranges = (3, 1), [("a", "-2", "0"), ("b", "0", "1"), ("r", "-1", "1")]
    E = ["+", *(["*", str(sum(q * b for q, b in zip(row, s, strict=True)) / (2 * a)), ["**", z, 2]]
                for row, a, z in zip(M, s, "xu", strict=True))]  # fmt: skip
    data = make([["+", ["*", "a", "x"], ["*", "b", "u"], ["*", "r", E]]], [([[1.0]], [0.0])], [[1.0]], (0.1, 1.0),
                uncertain=ranges, cells=[1, 1, 1], centre="none")  # fmt: skip
    points = [[Fraction(x, 10), Fraction(u, 10)] for x, u in ((2, 1), (-2, 1), (3, -2), (-1, -2), (30, 10))]
    f = function(points, [-x + u / 2 for x, u in points], True)
    both = [[by_nearest(f, (0, 0), False, unit)] * 2 for unit in ([1, 0], [0, 1])]
    data = with_samples(grow(data), f, {"error": "r", "slopes": ["a", "b"], "axes": [], "weights": both})
    for j in (0, 1):
        data = edited(data, f"plant.uncertain.{j}.range", texts(ends(f, (0, 0), both[j])))
    return data


# --------------------------------------------------------------------------------------------------- ends are attained


def drawn(draw: np.random.Generator, *shape: int) -> list[Any]:
    return np.vectorize(lambda k: Fraction(int(k), 97), otypes=[object])(draw.integers(-300, 300, shape)).tolist()


def of_this(curvature: Any, w: Fraction, points: Any, values: Any, slopes: tuple[str, ...]) -> Sampled:
    rows = lambda m: tuple(tuple(map(exact, row)) for row in m)  # noqa: E731
    names = tuple(f"z{j}" for j in range(len(curvature)))
    more = rows(points), tuple(map(exact, values)), None, slopes, (), ()
    return Sampled(0, names, (), rows(curvature), exact(w), bool(slopes), *more)


@pytest.mark.parametrize("slopes", [False, True])
@pytest.mark.parametrize("seed", slow_after(20, range(200)))
def test_no_end_is_wider_than_what_the_samples_allow(seed: int, slopes: bool) -> None:
    """Values that are off by all of the noise and of the second derivatives, each in the direction of its weight."""
    draw = np.random.default_rng(seed)
    d, n = int(draw.integers(1, 5)), int(draw.integers(1, 9))
    curvature = [[abs(q) for q in row] for row in drawn(draw, d, d)]
    curvature = [[curvature[min(i, j)][max(i, j)] for j in range(d)] for i in range(d)]
    w, (c, *gradient) = abs(drawn(draw, 1)[0]), drawn(draw, d + 1)
    v, points = drawn(draw, n), drawn(draw, n, d)
    total = sum(v) or Fraction(1)
    v = [q / total for q in v] if sum(v) else [Fraction(1), *[Fraction(0)] * (n - 1)]
    p = [sum(q * z[j] for q, z in zip(v, points, strict=True)) for j in range(d)]
    if slopes:  # then the sum of all points, weighted, is a direction, and p is 0
        c, sums, p = Fraction(0), p, [Fraction(0)] * d
        wanted = sum(a * b for a, b in zip(gradient, sums, strict=True))
    else:
        sums, wanted = [Fraction(1), *p], c
    f = {"curvature": curvature}
    weights = [(k, exact(q)) for k, q in enumerate(v)]
    found = []
    for sign in (1, -1):
        values = []
        for q, z in zip(v, points, strict=True):
            away = [a - b for a, b in zip(z, p, strict=True)]
            straight = c + sum(a * b for a, b in zip(gradient, away, strict=True))
            values.append(straight + sign * (1 if q > 0 else -1) * (w + rho(f, away)))
        one = of_this(curvature, w, points, values, ("a",) * d if slopes else ())
        found.append(interval(one, (weights, weights), [*map(exact, p)], [*map(exact, sums)], "here"))
    assert found[0][0] == exact(wanted) == found[1][1]
    width = sum(2 * abs(q) * (w + rho(f, [a - b for a, b in zip(z, p, strict=True)]))
                for q, z in zip(v, points, strict=True))  # fmt: skip
    assert all(hi - lo == exact(width) for lo, hi in found)


@pytest.mark.parametrize("seed", slow_after(20, range(200)))
def test_quadratics_are_inside_and_some_are_at_an_end(seed: int) -> None:
    """Samples on a line through p on both its sides, in the quadrant where all of the matrix counts."""
    draw = np.random.default_rng(seed)
    d, side = int(draw.integers(1, 5)), [int(v) for v in draw.choice([-1, 1], 4)]
    square = [[abs(q) for q in row] for row in drawn(draw, d, d)]
    bound = [[square[min(i, j)][max(i, j)] for j in range(d)] for i in range(d)]
    p, (c, *gradient), w = drawn(draw, d), drawn(draw, d + 1), Fraction(int(draw.integers(0, 3)), 7)
    along = [side[j] * abs(q) for j, q in enumerate(drawn(draw, d))]
    steps = [-Fraction(int(draw.integers(1, 9)), 5), Fraction(int(draw.integers(1, 9)), 7)]
    v = [steps[1] / (steps[1] - steps[0]), -steps[0] / (steps[1] - steps[0])]
    points = [[a + t * b for a, b in zip(p, along, strict=True)] for t in steps]

    def value(z: Sequence[Fraction], bends: Fraction) -> Fraction:
        away = [a - b for a, b in zip(z, p, strict=True)]
        second = sum(side[i] * side[j] * bound[i][j] * away[i] * away[j] for i in range(d) for j in range(d))
        return c + sum(a * b for a, b in zip(gradient, away, strict=True)) + bends * second / 2

    weights = [(k, exact(q)) for k, q in enumerate(v)]
    for bends, off in ((1, 1), (-1, -1), (Fraction(1, 2), -1), (Fraction(-1, 3), 1), (0, 0), (1, -1)):
        one = of_this(bound, w, points, [value(z, Fraction(bends)) + off * w for z in points], ())
        lo, hi = interval(one, (weights, weights), [*map(exact, p)], [ONE, *map(exact, p)], "here")
        assert lo <= exact(c) <= hi
        assert (lo == exact(c)) == (w == 0 or off == 1) * (bends == 1) or lo == hi
        assert (hi == exact(c)) == (w == 0 or off == -1) * (bends == -1) or lo == hi


# --------------------------------------------------------------------------------------------------- edges, both ways


def times(factor: Fraction) -> Callable[[str], str]:
    return lambda text: str(Fraction(text) * factor)


def plus(by: Any) -> Callable[[str], str]:
    return lambda text: str(Fraction(text) + Fraction(by))


def test_the_least_error_is_accepted_and_a_little_less_is_not() -> None:
    data, E = far(), least(far())
    assert verdicts(data) == ACCEPTED
    assert verdicts(edited(data, "plant.dynamics.0", far_equation(E * (1 - CLOSE)))) == REFUSED


@pytest.mark.parametrize("j", [0, 1])
@pytest.mark.parametrize("side", slow_after(1, [0, 1]))
def test_the_least_range_of_a_slope_is_accepted_and_a_little_less_is_not(j: int, side: int) -> None:
    data, path = near(), f"plant.uncertain.{j}.range.{side}"
    assert verdicts(data) == ACCEPTED
    inwards = lambda text: plus((1 - 2 * side) * abs(Fraction(text)) * CLOSE)(text)  # noqa: E731
    assert verdicts(edited(data, path, inwards)) == REFUSED


EACH = [(p, side, k) for p in range(15) for side in (0, 1) for k in range(4)]


@pytest.mark.parametrize(("p", "side", "k"), slow_after(40, EACH))
def test_weights_have_exact_sums(p: int, side: int, k: int) -> None:
    """Also where the error in the equation would be large enough for any interval."""
    data = edited(far(), "plant.dynamics.0", far_equation(Fraction(9)))
    at = f"{BY}.weights.{p}.{side}"
    assert verdicts(data)[1] not in ("format", "samples")
    nonzero = Fraction(far()["evidence"]["samples"][0]["weights"][p][side][k][1]) != 0
    for forged in (edited(data, f"{at}.{k}.1", plus(CLOSE)),
                   *([edited(data, f"{at}.{k}.1", times(1 + CLOSE)), edited(data, at, lambda w: w[:k] + w[k + 1 :])]
                     if nonzero else [])):  # fmt: skip
        assert verdicts(forged) == REFUSED


def test_weights_that_sum_to_the_point_but_not_to_1() -> None:
    """At the grid's point 0 weights of 0 would say that the function is 0 there."""
    data, k = far(), 2 * 3 + 1
    for weights in ([[0, "0"]], [[5, "1"], [5, "-1"]]):
        for side in (0, 1):
            assert verdicts(edited(data, f"{BY}.weights.{k}.{side}", weights)) == REFUSED


def test_weights_that_sum_to_1_but_not_to_the_point() -> None:
    data = edited(far(), "plant.dynamics.0", far_equation(Fraction(9)))
    for j in (0, 1):
        for k in range(15):
            near_by = data["evidence"]["samples"][0]["weights"][k][0][0][0]
            assert verdicts(edited(data, f"{BY}.weights.{k}.{j}", [[near_by, "1"]])) == REFUSED


@pytest.mark.parametrize("path", [f"{F}.noise", f"{F}.curvature.0.0", f"{F}.curvature.1.1"])
def test_what_is_known_less_well_is_refused(path: str) -> None:
    for data in (far(), near()):
        assert verdicts(edited(data, path, times(1 + CLOSE))) == REFUSED


def test_what_is_known_of_both_variables_together_counts() -> None:
    for data in (far(), near()):
        more = [[M[0][0], M[0][1] * (1 + CLOSE)], [M[1][0] * (1 + CLOSE), M[1][1]]]
        assert verdicts(edited(data, f"{F}.curvature", list(map(texts, more)))) == REFUSED


@pytest.mark.parametrize("name", ["far", "near"])
def test_intervals_may_be_points_but_not_less(name: str) -> None:
    """The upper ends lowered to the lower ones by values of further samples: no function has values below."""
    data, f = (far(), near())[name == "near"], (far(), near())[name == "near"]["claim"]["samples"]["functions"][0]
    data = edited(data, "plant.dynamics.0", far_equation(Fraction(9))) if name == "far" else data
    for number, p in enumerate(product(*AXES)) if name == "far" else enumerate([(0, 0)] * 2):
        both = data["evidence"]["samples"][0]["weights"][number]
        lo, hi = ends(f, p, both)
        further = [[k + len(f["values"]), v] for k, v in both[1]]
        size = sum(abs(Fraction(v)) for _, v in both[1])
        for over, found in ((0, None), (CLOSE, "samples")):
            low = (hi - lo) * (1 + over) / size
            moved = {k: Fraction(f["values"][k]) - low * (1 if Fraction(v) > 0 else -1) for k, v in both[1]}
            values = [*f["values"], *(str(moved.get(k, y)) for k, y in enumerate(f["values"]))]
            forged = edited(edited(data, f"{F}.points", lambda z: [*z, *z]), f"{F}.values", values)
            forged = edited(forged, f"{BY}.weights.{number}.1", further)
            assert [rule if rule == "samples" else None for rule in verdicts(forged)] == [found] * 2


# ----------------------------------------------------------------------------------------------------------- the fields

LONG = 2**128
ODD: dict[str, Sequence[Any]] = {
    f"{F}.state": ("y", "u", "r", 0, None, ["x"]),
    f"{F}.variables": ([], ["x"], ["x", "x"], ["x", "r"], ["x", "u", "u"], "xu", None, ["x", 0]),
    f"{F}.box": ([], [["-3", "3"]], [["-3", "3"]] * 3, None, {"x": ["-3", "3"]}),
    f"{F}.box.0": (["3", "-3"], ["3", "3"], ["-3"], ["-3", "0", "3"], None, [-3, 3], ["-3", f"{LONG}"], "-3,3"),
    f"{F}.box.1": (["-1", "9/10"], ["-9/10", "1"], ["-1", f"{LONG - 1}/{LONG}"]),
    f"{F}.curvature": ([], [["1/50"]], [["1/50", "0"], ["1/100", "1/30"]], [["0", "-1"], ["-1", "0"]], None),
    f"{F}.curvature.0.0": ("-1/50", f"{LONG}", f"1/{LONG}", 0, "0.02", None),
    f"{F}.noise": ("-1/1000", f"1/{LONG}", 0, None, "1e-3", ["1/1000"], "1/0"),
    f"{F}.vanishes": (0, 1, None, "false", []),
    f"{F}.points": ([], None, {}, [["0", "0"]], lambda z: z[1:], lambda z: [*z, z[0]], [[]] * 90, [["0"]] * 90),
    f"{F}.points.0": ([], ["0"], ["0"] * 3, None, "0", [0, 0], ["0", f"1/{LONG}"], ["0", None], [["0"], ["0"]]),
    f"{F}.points.0.0": ("-4", "4", "3000000000001/1000000000000", "-3000000000001/1000000000000"),
    f"{F}.points.89.1": ("-2", "2", f"{LONG - 1}/{LONG - 2}"),
    f"{F}.values": ([], None, {}, lambda y: y[1:], lambda y: [*y, y[0]], lambda y: [*y[1:], None]),
    f"{F}.values.3": (f"{LONG}", f"1/{LONG}", 0, None, "0x1p0", ["0"]),
    f"{BY}.error": ("", "x", "u", "q", 0, [], ["r"]),
    f"{BY}.slopes": (["r"], ["r", "r"], None, "", {}, ["a", "b"]),
    f"{BY}.axes": ([], [["-3", "3"]], [["-3", "3"], ["-1", "1"]], None, [["-3", "3"]] * 3, {}),
    f"{BY}.axes.0": ([], ["-3"], ["3"], None, ["3", "-3"], ["-3", "0", "0", "2", "3"], ["-3", "1", "0", "2", "3"],
                     ["-3", "-3", "0", "2", "3"], ["-3", "0", "2", "3", "3"], lambda z: [*z, "3"], lambda z: z[1:]),
    f"{BY}.axes.0.0": ("-4", "-299/100", f"-{3 * LONG + 1}/{LONG}", 0),
    f"{BY}.axes.0.2": (f"1/{LONG}", "2", "-1/7", "-1"),
    f"{BY}.axes.1.2": ("99/100", "2", "0"),
    f"{BY}.weights": ([], None, {}, lambda w: w[1:], lambda w: [*w, w[0]]),
    f"{BY}.weights.0": ([], None, lambda w: w[:1], lambda w: [*w, w[0]], {}),
    f"{BY}.weights.14.1": ([], None, {}, [0, "1"], lambda w: [*w, *[[0, "0"]] * (65 - len(w))]),
    f"{BY}.weights.14.1.3": ([], [0], [0, "0", "0"], None, "0", {}),
    f"{BY}.weights.14.0.3.0": (90, -1, True, None, "0", 0.0, [0], 10**9),
    f"{BY}.weights.14.0.3.1": (0, 1.0, None, "0.5", ["1"], "1/0", "01"),
    "claim.samples": (None, [], {}, {"sha256": "0" * 64}),
    "claim.samples.sha256": ("0" * 63, "G" * 64, None, 0),
    "claim.samples.functions": ([], None, {}, lambda f: f * 2),
    "evidence.samples": ([], None, {}, lambda s: s * 2),
    "policy.origin": ("AAAAAAAAwD8=",),
}  # fmt: skip


@pytest.mark.parametrize("path", ODD)
def test_each_field_has_one_form(path: str) -> None:
    for value in ODD[path]:
        forged = edited(far(), path, value)
        assert verdicts(forged) == MALFORMED, f"{path} {value}"


@pytest.mark.parametrize("path", [F, BY, "claim.samples"])
def test_each_key_is_there_and_no_other(path: str) -> None:
    at: Any = far()
    for key in path.split("."):
        at = at[int(key) if key.isdigit() else key]
    for key in at:
        assert verdicts(edited(far(), path, lambda o, key=key: {k: v for k, v in o.items() if k != key})) == MALFORMED
    assert verdicts(edited(far(), path, lambda o: {**o, "more": "0"})) == MALFORMED


SLOPES_ODD: dict[str, Sequence[Any]] = {
    f"{BY}.axes": ([[]], [[], []], [["-3", "3"], ["-1", "1"]], None),
    f"{BY}.slopes": (["a"], ["a", "a"], ["a", "r"], ["a", "b", "b"], ["a", "x"], ["a", 0]),
    f"{BY}.weights": (lambda w: w[:1], lambda w: [*w, w[0]], []),
    f"{F}.vanishes": (False,),
}


@pytest.mark.parametrize("path", SLOPES_ODD)
def test_each_field_has_one_form_with_slopes(path: str) -> None:
    for value in SLOPES_ODD[path]:
        assert verdicts(edited(near(), path, value)) == MALFORMED, f"{path} {value}"


def test_what_may_be_is_taken() -> None:
    """Weights of more bits than other numbers, 64 of them, points at the box's ends and twice, numbers of 2^7 bits."""
    data, tiny = far(), Fraction(1, 3**600)
    some = data["evidence"]["samples"][0]["weights"][0][0]
    split = [*some[1:], [some[0][0], str(Fraction(some[0][1]) - tiny)], [some[0][0], str(tiny)]]
    assert verdicts(edited(data, f"{BY}.weights.0.0", split)) == ACCEPTED
    full = [*some, *[[89, "0"]] * (64 - len(some))]
    assert verdicts(edited(data, f"{BY}.weights.0.1", full)) == ACCEPTED
    assert verdicts(edited(data, f"{BY}.axes.0.0", f"-{3 * LONG}/{LONG}")) == ACCEPTED  # the bits are those of -3
    more = edited(data, f"{F}.points", lambda z: [*z, ["3", "-1"], ["-3", "1"], z[0], [f"-1/{LONG - 1}", "0"]])
    more = edited(more, f"{F}.values", lambda y: [*y, "7", "7", y[0], f"{LONG - 1}/{LONG - 3}"])
    assert verdicts(more) == ACCEPTED


def test_a_box_may_be_larger_than_the_domain() -> None:
    """Then the grid reaches over all of the box."""
    data = edited(far(), f"{F}.box.0", ["-4", "3"])
    assert verdicts(data) == MALFORMED
    wider = edited(data, f"{BY}.axes.0.0", "-4")
    f = wider["claim"]["samples"]["functions"][0]
    for k, u in enumerate(AXES[1]):
        wider = edited(wider, f"{BY}.weights.{k}", [by_nearest(f, (-4, u), True, [1, -4, u])] * 2)
    E = least(wider)
    assert least(far()) < E
    assert verdicts(edited(wider, "plant.dynamics.0", far_equation(E)))[1] not in ("format", "samples")
    assert verdicts(edited(wider, "plant.dynamics.0", far_equation(E * (1 - CLOSE)))) == REFUSED


def test_a_box_has_a_width() -> None:
    """All samples and the grid may have the same input, but then the box's ends are not a pair."""
    data = edited(edited(far(), f"{F}.box.1", ["0", "0"]), f"{BY}.axes.1", ["0"])
    data = edited(data, f"{F}.points", lambda z: [[x, "0"] for x, _ in z])
    weights = [[[[k, "1"]]] * 2 for k in range(len(AXES[0]))]
    assert verdicts(edited(data, f"{BY}.weights", weights)) == MALFORMED


@pytest.mark.parametrize("name", ["far", "near"])
def test_the_box_reaches_over_domain_and_input_bounds(name: str) -> None:
    data = far() if name == "far" else near()
    for path, value in (("plant.domain.0", ["-3", "3000000000001/1000000000000"]),
                        ("plant.domain.0", ["-3000000000001/1000000000000", "3"]),
                        ("plant.input_bounds.0", ["-1000000000001/1000000000000", "1"]),
                        ("plant.input_bounds.0", ["-1", "2"])):  # fmt: skip
        assert verdicts(edited(data, path, value)) == REFUSED


def test_a_function_that_vanishes_does_so_in_its_box() -> None:
    """Input bounds that exclude 0, and samples as far as these."""
    data = edited(far(), "plant.input_bounds.0", ["1/100", "1"])
    data = edited(edited(data, f"{F}.box.1", ["1/100", "1"]), f"{BY}.axes.1", ["1/100", "1"])
    keep = [k for k, z in enumerate(far()["claim"]["samples"]["functions"][0]["points"]) if Fraction(z[1]) >= CLOSE]
    for key in ("points", "values"):
        data = edited(data, f"{F}.{key}", lambda old: [old[k] for k in keep])
    f = data["claim"]["samples"]["functions"][0]
    grid = list(product(AXES[0], (Fraction(1, 100), 1)))
    data = edited(data, f"{BY}.weights", [[by_nearest(f, p, True, [1, *p])] * 2 for p in grid])
    data = edited(data, "plant.dynamics.0", far_equation(Fraction(9)))
    assert verdicts(data)[1] not in ("format", "samples")
    assert verdicts(edited(data, f"{F}.vanishes", True)) == REFUSED


@pytest.mark.slow
def test_there_are_as_many_samples_as_may_be() -> None:
    c, shown = document.read(dumped(far())), far()["evidence"]["samples"]

    def read(count: int) -> int:
        stated = edited(far()["claim"]["samples"], "functions.0.points", lambda z: z + [["0", "0"]] * (count - len(z)))
        stated["functions"][0]["values"] += ["0"] * (count - len(stated["functions"][0]["values"]))
        return len(read_samples(stated, shown, document.SHA256, c.plant, ()).functions[0].values)

    assert read(2**18) == 2**18
    with pytest.raises(Refused, match="1 to 262144 points"):
        read(2**18 + 1)


def test_no_variable_is_an_angle() -> None:
    c = document.read(dumped(far()))
    stated, shown = far()["claim"]["samples"], far()["evidence"]["samples"]
    assert read_samples(stated, shown, document.SHA256, c.plant, ("y",)) == c.samples
    with pytest.raises(Refused, match="no angle"):
        read_samples(stated, shown, document.SHA256, c.plant, ("x",))


# ------------------------------------------------------------------------------------------------- the words


def test_the_words() -> None:
    assert (
        "x, of x, u in x in [-3, 3], u in [-1, 1]: continuous second derivatives of at most 1/50 by x and x, 1/100 by "
        "x and u, 1/30 by u and u, at points there values within 1/1000 of the 90 that the certificate states; of "
    ) in in_words(document.read(dumped(far())))
    assert "of the 5 that the certificate states, is 0 at 0; of" in in_words(document.read(dumped(near())))
