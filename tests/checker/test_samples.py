"""Rule `samples` in both checkers: true claims, forgeries of each part, bounds that just do not fit, true functions."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cache
from itertools import pairwise, product
from math import prod
from typing import Any

import numpy as np
import pytest
from flint import fmpq

from certify.analysis.fitting.linear import Sampling
from certify.checker import document, rules
from certify.checker.errors import Rejected
from certify.checker.samples import Function
from certify.checker.words import report
from certify.loop.plants import Sampled, Unknown
from certify.reference.__main__ import in_words
from certify.reference.document import read
from tests.checker.test_handover import dumped, joined, nearby, verdicts
from tests.checker.test_reference_data import true
from tests.support.certificates import Document, edited, encode, grow, make
from tests.support.earlier import newer
from tests.support.marks import slow_after

ACCEPTED = (None, None)
F, BY = "claim.samples.functions.0", "evidence.samples.0"
TINY = Fraction(1, 10**12)
Forged = dict[str, Callable[[], list[Document]]]


def texts(numbers: Sequence[Fraction | int]) -> list[str]:
    return [str(Fraction(q)) for q in numbers]


def with_samples(data: Document, functions: Sequence[Document], shown: Sequence[Document]) -> Document:
    data = newer(data)
    claim = {**data["claim"], "samples": {"sha256": "0" * 64, "functions": list(functions)}}
    return {**data, "claim": claim, "evidence": {**data["evidence"], "samples": list(shown)}}


def function(
    state: str, variables: Sequence[str], M: Sequence[Sequence[Any]], noise: Any, vanishes: bool,
    axes: Sequence[Sequence[Any]], g: Callable[..., Any],
) -> Document:  # fmt: skip
    """Samples of g on a grid."""
    points = list(product(*axes))
    return {
        "state": state, "variables": list(variables), "box": [texts([axis[0], axis[-1]]) for axis in axes],
        "curvature": [texts(row) for row in M], "noise": str(noise), "vanishes": vanishes,
        "points": list(map(texts, points)), "values": texts([g(*map(Fraction, z)) for z in points]),
    }  # fmt: skip


def on_grid(axes: Sequence[Sequence[Any]], error: str | None = "r") -> Document:
    """Evidence of a grid at whose points samples are, in its order."""
    weights = [[[[k, "1"]], [[k, "1"]]] for k in range(prod(map(len, axes)))]
    return {"error": error, "slopes": [], "axes": list(map(texts, axes)), "weights": weights}


# Far: P = -x + u/2 + x^2/50, samples off by 1/50 in turn, M_xx = 1/10. On a cell of widths 1 and 2
E_FAR = Fraction(1, 50) + Fraction(1, 100) + Fraction(1, 8) * (Fraction(1, 10) + Fraction(1, 25))
X, U = range(-3, 4), (-1, 1)


def term(E: Any) -> list[Any]:
    return ["*", "r", str(E)] if isinstance(E, Fraction) else ["*", "r", E]


def equation(E: Any = E_FAR) -> list[Any]:
    return ["+", ["-", "x"], ["*", "1/2", "u"], ["*", "1/50", ["**", "x", 2]], term(E)]


@cache
def far() -> Document:
    """x' = g(x, u), of which V = x^2 falls until |x| = 1/5."""
    data = make([equation()], [([[1.0]], [0.0])], [[1.0]], (0.04, 1.0), claim="practical", uncertain=[("r", "-1", "1")],
                cells=[1], centre="none")  # fmt: skip
    turn = iter([1, -1] * 99)
    f = function("x", ("x", "u"), [["1/10", "1/50"], ["1/50", 0]], "1/100", False, [X, U],
                 lambda x, u: -x + u / 2 + x**2 / 50 + Fraction(next(turn), 50))  # fmt: skip
    return with_samples(grow(data), [f], [on_grid([X, U])])


NEAR_X, NEAR_U = [-3, Fraction(-1, 10), 0, Fraction(1, 10), 3], [-1, Fraction(-1, 10), 0, Fraction(1, 10), 1]
K = Fraction(1, 10) + Fraction(1, 300), Fraction(8, 100)  # (M s)_j / (2 s_j), s = (3, 1)


def linear(k: tuple[Fraction, Fraction] = K) -> list[Any]:
    E = ["+", *(["*", str(q), ["**", z, 2]] for q, z in zip(k, "xu", strict=True))]
    return ["+", ["*", "a", "x"], ["*", "b", "u"], ["*", "r", E]]


@cache
def near() -> Document:
    """x' = g(x, u) with g(0) = 0, whose slopes are within 1/50 and 3/200 of -1 and 1/2."""
    a, b = (-1, Fraction(1, 50)), (Fraction(1, 2), Fraction(3, 200))
    ranges = [(name, str(m - e), str(m + e)) for name, (m, e) in zip("ab", (a, b), strict=True)]
    data = make([linear()], [([[1.0]], [0.0])], [[1.0]], (0.1, 1.0), uncertain=[*ranges, ("r", "-1", "1")],
                cells=[1, 1, 1], centre="none")  # fmt: skip
    f = function("x", ("x", "u"), [["1/5", "1/50"], ["1/50", "1/10"]], "1/1000", True, [NEAR_X, NEAR_U],
                 lambda x, u: -x + u / 2)  # fmt: skip
    both = [[[7, "-5"], [17, "5"]], [[11, "-5"], [13, "5"]]]  # from (-1/10, 0) and (1/10, 0), (0, -1/10) and (0, 1/10)
    shown = {"error": "r", "slopes": ["a", "b"], "axes": [], "weights": [[each, each] for each in both]}
    return with_samples(grow(data), [f], [shown])


@cache
def aslant() -> Document:
    """The same, with weights of (1/10, 1/10) and (-1/10, 1/10) for the slope in x, which leave 27/1000."""
    data = edited(near(), f"{BY}.weights.0", [[[8, "-5"], [18, "5"]] for _ in range(2)])
    return edited(data, "plant.uncertain.0.range", texts([-1 - Fraction(27, 1000), -1 + Fraction(27, 1000)]))


@cache
def two() -> Document:
    """x' = g(x), y' = h(y), samples of straight lines."""
    names = (("r", "x"), ("q", "y"))
    data = make([["+", ["-", z], ["*", r, "1/10"]] for r, z in names], [([[1.0, 0.0]], [0.0])], np.eye(2), (0.25, 1.0),
                states=("x", "y"), domain=[("-3", "3")] * 2, claim="practical", cells=[1, 1],
                uncertain=[("r", "-1", "1"), ("q", "-1", "1")])  # fmt: skip
    functions = [function(z, (z,), [["1/2"]], "1/40", False, [X], lambda v: -v) for z in "xy"]
    return with_samples(grow(data), functions, [on_grid([X], r) for r, _ in names])


@cache
def unbent() -> Document:
    """The same, of x' = g(x) without noise or curvature, of which any weights give exact values."""
    return edited(edited(two(), F, function("x", ("x",), [[0]], 0, False, [X], lambda v: -v)), BY, on_grid([X]))


@cache
def scattered() -> Document:
    """x' = g(x, u) as in `far`, of which 80 samples are taken anywhere, each off by 1/2000 in turn."""
    draw = np.random.default_rng(3)
    drawn = draw.integers((-300, -100), (301, 101), (80, 2)).tolist()
    points = [(Fraction(x, 100), Fraction(u, 100)) for x, u in drawn]
    values = [-x + u / 2 + x**2 / 50 + Fraction((-1) ** k, 2000) for k, (x, u) in enumerate(points)]
    f = {**function("x", ("x", "u"), [["1/10", "1/50"], ["1/50", 0]], "1/1000", False, [X, U], lambda *_: 0),
         "points": list(map(texts, points)), "values": texts(values)}  # fmt: skip
    data = edited(edited(far(), F, f), BY, bounded_by_programs(f, [X, U]))
    return edited(data, "plant.dynamics.0", equation(least_error(data)))


def bounded_by_programs(f: Document, axes: Sequence[Sequence[Any]]) -> Document:
    """Evidence with weights from linear programs at the points of a grid."""
    numbers = lambda rows: tuple(tuple(map(Fraction, row)) for row in rows)  # noqa: E731
    one = Unknown(f["state"], tuple(f["variables"]), numbers(f["curvature"]), numbers(f["box"]))
    sampling = Sampling(one, Sampled(numbers(f["points"]), *numbers([f["values"]])), Fraction(f["noise"]))
    ends = [sampling.at(tuple(map(Fraction, p)))[2:] for p in product(*axes)]
    weights = [[[[k, str(v)] for k, v in each] for each in both] for both in ends]
    return {**on_grid(axes), "weights": weights}


def rho(f: Document, z: Sequence[Fraction]) -> Fraction:
    return sum(Fraction(q) * abs(a * b) for row, a in zip(f["curvature"], z, strict=True)
               for q, b in zip(row, z, strict=True)) / 2  # fmt: skip


def ends_at(f: Document, p: Sequence[Any], both: Sequence[Sequence[Any]]) -> list[Fraction]:
    """The interval at p by weights, as the format says it."""
    found = []
    for sign, weights in zip((-1, 1), both, strict=True):
        end = Fraction(0)
        for k, text in weights:
            v, away = Fraction(text), [Fraction(a) - b for a, b in zip(f["points"][k], p, strict=True)]
            end += v * Fraction(f["values"][k]) + sign * abs(v) * (Fraction(f["noise"]) + rho(f, away))
        found.append(end)
    return found


def least_error(data: Document) -> Fraction:
    """The least constant E that the rule takes in the equation of `far`, of which x^2/50 alone is bent."""
    f, by = data["claim"]["samples"]["functions"][0], data["evidence"]["samples"][0]
    x, u = (list(map(Fraction, axis)) for axis in by["axes"])
    off = {}
    for p, both in zip(product(x, u), by["weights"], strict=True):
        lo, hi = ends_at(f, p, both)
        P = -p[0] + p[1] / 2 + p[0] ** 2 / 50
        off[p] = max(hi - P, P - lo)
    bend = Fraction(f["curvature"][0][0]) / 2 + Fraction(1, 50)
    cells = product(pairwise(x), pairwise(u))
    return max(max(off[p] for p in product(*cell)) + ((cell[0][1] - cell[0][0]) / 2) ** 2 * bend for cell in cells)


TRUE = {
    "scattered": scattered,
    "far": far,
    "near": near,
    "aslant": aslant,
    "two": two,
    "unbent": unbent,
    "composed": lambda: joined(far(), near()),
    "composed of scattered samples": lambda: joined(scattered(), near()),
}


@pytest.mark.parametrize("name", TRUE)
def test_a_true_claim(name: str) -> None:
    assert verdicts(TRUE[name]()) == ACCEPTED


@pytest.mark.parametrize("more", [["**", "x", 2], ["*", ["**", "x", 2], ["**", "u", 2]], ["**", "u", 4]])
def test_a_bound_may_grow_with_the_state(more: list[Any]) -> None:
    data = edited(far(), "plant.dynamics.0", equation(["+", str(E_FAR), ["*", "1/1000", more]]))
    assert verdicts(data) == ACCEPTED


def plus(by: Any) -> Callable[[str], str]:
    return lambda text: str(Fraction(text) + Fraction(by))


def coarser(data: Document, k: int, box: Sequence[Any] = (-3, 3)) -> Document:
    """Without one value of the first axis and its samples."""
    axis = [z for j, z in enumerate(X) if j != k]

    def edit(f: Document) -> Document:
        kept = [j for j, z in enumerate(f["points"]) if Fraction(z[0]) in axis]
        own = {"points": [f["points"][j] for j in kept], "values": [f["values"][j] for j in kept]}
        return {**f, **own, "box": [texts(box), f["box"][1]]}

    return edited(edited(data, F, edit), BY, on_grid([axis, U]))


def of_one(data: Document, z: str, axis: Sequence[int]) -> Document:
    """Of a function of one variable, with samples that are 0."""
    own = function("x", (z,), [["1/10"]], "1/100", False, [axis], lambda _: 0)
    return edited(edited(data, F, own), BY, on_grid([axis]))


def of_far() -> Forged:
    """Kinds of forgeries, with the values of each."""
    data, n = far(), len(far()["claim"]["samples"]["functions"][0]["values"])
    e = lambda path, *values: [edited(data, path, v) for v in values]  # noqa: E731
    return {
        "a sampled value": lambda: [
            edited(data, f"{F}.values.{k}", plus(d)) for k in range(n) for d in ("1/20", "-1/20", 3)
        ],
        "a sampled value, by little": lambda: [
            edited(data, f"{F}.values.{k}", plus(TINY * (-1) ** k)) for k in range(n)
        ],
        "noise": lambda: e(f"{F}.noise", *(plus(d) for d in (TINY, "1/1000", 1))),
        "negative noise": lambda: e(f"{F}.noise", "-1/100", "-1"),
        "noise of another kind": lambda: e(f"{F}.noise", "0.01", 0, None, ["1/100"], "1/0", "01/100"),
        "curvature": lambda: e(f"{F}.curvature.0.0", *(plus(d) for d in (TINY, "1/1000", 5))),
        "curvature along the other axis": lambda: e(f"{F}.curvature.1.1", str(TINY), "1/10"),
        "curvature that is not symmetric": lambda: e(f"{F}.curvature.0.1", "0", "1/49"),
        "negative curvature": lambda: e(
            f"{F}.curvature", [["-1/10", "1/50"], ["1/50", "0"]], [["1/10", "-1"], ["-1", "0"]]
        ),
        "curvature of another shape": lambda: e(
            f"{F}.curvature", [["1/10"]], [["1/10", "1/50"]], [], [["1/10", "1/50"]] * 3
        ),
        "a coarser grid": lambda: [coarser(data, k) for k in range(1, 6)],
        "a grid that ends early": lambda: [coarser(data, k) for k in (0, 6)]
        + [coarser(data, 0, (-2, 3)), coarser(data, 6, (-3, 2))],
        "a missing row": lambda: e(f"{F}.values", lambda v: v[1:], lambda v: v[:-1], lambda v: v[:5] + v[6:]),
        "a row too many": lambda: e(f"{F}.values", lambda v: [*v, v[-1]], lambda v: [v[0], *v]),
        "a point too few or too many": lambda: e(
            f"{F}.points", lambda v: v[1:], lambda v: [*v, v[-1]], [[]] * n, [["0"]] * n
        ),
        "no samples": lambda: [
            edited(d, f"{F}.values", []) for d in (data, edited(data, f"{F}.points", []))
        ],
        "a sample that was moved": lambda: [
            edited(data, f"{F}.points.{k}.{j}", plus(d))
            for k in range(n)
            for j in (0, 1)
            for d in (TINY, -TINY, Fraction(1, 10**9), 1)
        ],
        "a point outside of the box": lambda: e(f"{F}.points.0.0", "-3000000001/1000000000", "-4", "4")
        + e(f"{F}.points.0.1", "2", "-3"),
        "a hole in the axis": lambda: e(f"{BY}.axes.0", texts([-3, -2, -1, 1, 2, 3]), texts([-3, -2, -1, 0, 0, 2, 3])),
        "an axis out of order": lambda: e(f"{BY}.axes.0", texts([-3, -1, -2, 0, 1, 2, 3]), texts(range(3, -4, -1))),
        "a step of the grid": lambda: e(f"{BY}.axes.0.3", str(TINY), "1/10", "-1/1000", "1/2"),
        "the end of the grid": lambda: e(f"{BY}.axes.0.0", "-299/100", "-4") + e(f"{BY}.axes.1.1", "99/100", "2"),
        "an end of the box": lambda: e(f"{F}.box.0.0", "-299/100", "-4") + e(f"{F}.box.1.1", "99/100", "2"),
        "a box that is none": lambda: e(f"{F}.box.0", ["-3", "-3"], ["3", "-3"], ["-3"], ["-3", "0", "3"], None)
        + e(f"{F}.box", [["-3", "3"]], [], [["-3", "3"]] * 3),
        "an axis of one value": lambda: e(f"{BY}.axes.1", ["0"], [], ["-1"]),
        "axes that are none": lambda: e(f"{BY}.axes", [], None, [texts(X)], [texts(X), texts(U), texts(U)]),
        "weights": lambda: [edited(data, f"{BY}.weights.{k}.{side}.0.1", v) for k in range(n) for side in (0, 1)
                    for v in ("0", "-1", "2", "999999999/1000000000", str(1 + TINY))],
        "weights of another sample": lambda: [
            edited(data, f"{BY}.weights.{k}.{side}.0.0", (k + 1) % n) for k in range(n) for side in (0, 1)
        ],
        "samples that are none": lambda: [edited(data, f"{BY}.weights.{k}.0.0.0", v) for k in (0, n - 1)
                                  for v in (n, -1, True, "0", None, 0.0)],
        "lists of weights": lambda: e(f"{BY}.weights", [], lambda w: w[1:], lambda w: [*w, w[0]], lambda w: w[::-1])
        + e(f"{BY}.weights.0", [], [[[0, "1"]]], [[[0, "1"]]] * 3, [[], [[0, "1"]]], [[[0, "1"]], []])
        + e(f"{BY}.weights.0.0", [[0, "1"], [0, "0"], *[[0, "0"]] * 63], [[0]], [[0, "1", "1"]], [0, "1"]),
        "weights that give another point": lambda: e(
            f"{BY}.weights.0.0", [[0, "1"], [1, "1"], [2, "-1"]], [[0, "2"], [1, "-1"]]
        ),
        "a domain beyond": lambda: e("plant.domain.0", ["-3", "301/100"], ["-31/10", "3"], ["-3", "100"]),
        "input bounds beyond": lambda: e("plant.input_bounds.0", ["-1", "101/100"], ["-3", "1"], ["-1", "10"]),
        "swapped axes": lambda: e(f"{BY}.axes", lambda a: a[::-1]) + e(f"{F}.variables", ["u", "x"]),
        "swapped samples": lambda: e(f"{F}.values", lambda v: [*v[7:], *v[:7]], lambda v: v[::-1], sorted),
        "a bound that is too small": lambda: [
            edited(data, "plant.dynamics.0", equation(E_FAR - d)) for d in (TINY, Fraction(1, 1000), E_FAR)
        ],
        "a bound that is too small somewhere": lambda: [
            edited(data, "plant.dynamics.0", equation(["+", str(E_FAR - d), ["*", "1/1000", more]]))
            for d in (TINY, Fraction(1, 10000))
            for more in (["**", "x", 2], ["**", "u", 2], ["*", ["**", "x", 2], ["**", "u", 2]], "x",
                         ["-", ["**", "u", 3]], ["*", "x", "u"])
        ],
        "a bound that is 0 somewhere": lambda: [
            edited(data, "plant.dynamics.0", equation(["*", "r", E])) for E in (["**", "x", 2], "x", ["*", "x", "u"])
        ],
        "another polynomial": lambda: [
            edited(data, "plant.dynamics.0", lambda tree, k=k, v=v: [*tree[:k], v, *tree[k + 1 :]])
            for k, v in ((1, ["-", ["*", "x", "1001/1000"]]), (2, ["*", "51/100", "u"]), (3, "0"),
                         (3, ["*", "1/50", ["**", "x", 3]]), (2, "0"))
        ],
        "no polynomial": lambda: [
            edited(data, "plant.dynamics.0", lambda tree, v=v: [*tree, v])
            for v in (["sin", ["*", "x", "1/100000"]], ["/", "x", ["+", "2", "x"]], ["abs", "x"],
                      ["*", "0", ["sin", "x"]], ["*", "r", "r", "1/1000"], ["*", "1/1000000", ["**", "x", 21]],
                      ["*", "r", "r", "1/1000", ["**", "x", 2]])
        ],
        "a range of the error": lambda: e("plant.uncertain.0.range", ["-1", "999/1000"], ["-9/10", "1"], ["0", "1"]),
        "no error": lambda: e(f"{BY}.error", None),
        "an error that is none": lambda: e(f"{BY}.error", "x", "u", "q", 0, [], "R"),
        "slopes of what need not vanish": lambda: [
            edited(edited(data, f"{BY}.slopes", s), f"{BY}.weights", w)
            for s, w in ((["r", "r"], [[[[0, "1"]]] * 2] * 2), (["r"], [[[[0, "1"]]] * 2]))
        ],
        "weights without slopes": lambda: e(f"{BY}.weights", [[[[0, "1"]], [[0, "1"]]]], None),
        "what vanishes": lambda: e(f"{F}.vanishes", None, 1, 0, "true", "false", []),
        "another state": lambda: e(f"{F}.state", "y", "u", "r", 0, None),
        "other variables": lambda: e(
            f"{F}.variables", ["x", "x"], ["x", "r"], ["x", "y"], [], ["x"], ["x", "u", "u"], "xu"
        ),
        "a variable less": lambda: [of_one(data, z, a) for z, a in (("x", X), ("u", U))],
        "a function twice": lambda: [
            edited(edited(data, "claim.samples.functions", lambda f: f * 2), "evidence.samples", lambda s: s * 2)
        ],
        "no function": lambda: e("claim.samples.functions", [], None, {}),
        "evidence of another": lambda: e("evidence.samples", [], lambda s: s * 2, None, {}),
        "long numbers": lambda: e(f"{F}.noise", f"1/{2**128}") + e(f"{BY}.axes.0.0", f"-{2**128}") + e(
            f"{F}.points.0.0", f"1/{2**128}") + e(f"{F}.box.0.0", f"-{2**128}") + e(
            f"{F}.values.0", f"{3**90}/{2**140}") + e(f"{F}.curvature.0.0", str(2**128)),
        "a hash that is none": lambda: e("claim.samples.sha256", "0" * 63, "G" * 64, "A" * 64, 0, None, ""),
        "other keys": lambda: e(F, lambda f: {**f, "more": 1}, lambda f: {k: v for k, v in f.items() if k != "noise"})
        + e(BY, lambda f: {**f, "more": 1}) + e("claim.samples", lambda s: {**s, "file": "x"}),
        "one section alone": lambda: [
            {**data, part: {k: v for k, v in data[part].items() if k != "samples"}} for part in ("claim", "evidence")
        ],
        "an origin of the policy": lambda: e("policy.origin", encode([0.125]), encode([-1e-9])),
        "a claim that may have none": lambda: e("claim.kind", "nearby", "asymptotic"),
    }  # fmt: skip


def shorter(k: int, side: int, share: Fraction) -> Document:
    """`near` with one list of weights times a factor, and the end of the slope's range that follows from it."""
    data = edited(near(), f"{BY}.weights.{k}.{side}", lambda w: [[i, str(share * Fraction(v))] for i, v in w])
    both = data["evidence"]["samples"][0]["weights"][k]
    end = ends_at(data["claim"]["samples"]["functions"][0], (0, 0), both)[side]
    return edited(data, f"plant.uncertain.{k}.range.{side}", str(end))


def of_near() -> Forged:
    data = near()
    e = lambda path, *values: [edited(data, path, v) for v in values]  # noqa: E731
    ends = [(k, side) for k in (0, 1) for side in (0, 1)]
    return {
        "a range of a slope": lambda: [
            edited(data, f"plant.uncertain.{k}.range.{side}", plus((1 - 2 * side) * d))
            for k, side in ends
            for d in (TINY, Fraction(1, 1000), Fraction(1, 100))
        ],
        "a sampled value that a slope rests on": lambda: [
            edited(data, f"{F}.values.{k}", plus(d)) for k in (7, 17, 11, 13) for d in (TINY, -TINY, 1)
        ],
        "noise": lambda: e(f"{F}.noise", *(plus(d) for d in (TINY, 1))),
        "curvature": lambda: e(f"{F}.curvature.0.0", *(plus(d) for d in (TINY, 1)))
        + e(f"{F}.curvature.1.1", *(plus(d) for d in (TINY, 1))),
        "mixed curvature": lambda: e(
            f"{F}.curvature", [["1/5", "1/49"], ["1/49", "1/10"]], [["1/5", "1"], ["1", "1/10"]]
        ),
        "weights": lambda: [
            edited(data, f"{BY}.weights.{k}.{side}.0.1", v) for k, side in ends for v in ("-4", "0", "5", "-5001/1000")
        ],
        "other samples": lambda: [
            edited(data, f"{BY}.weights.{k}.{side}.0.0", v) for k, side in ends for v in (0, 6, 12, 24, 8)
        ],
        "samples that are none": lambda: [
            edited(data, f"{BY}.weights.{k}.{side}.0.0", v) for k, side in ends for v in (25, -1, True, "7", None, 7.0)
        ],
        "weights that give less than the direction, and a range by them": lambda: [
            shorter(k, side, share) for k, side in ends for share in (Fraction(999, 1000), Fraction(1001, 1000))
        ],
        "weights of the other slope": lambda: e(f"{BY}.weights", lambda w: w[::-1]),
        "lists of weights": lambda: e(f"{BY}.weights.0", [], [[[7, "-5"], [17, "5"]]], None)
        + [edited(data, f"{BY}.weights.{k}.{side}", [[12, "0"]]) for k, side in ends]
        + e(f"{BY}.weights.0.0", [], [[7, "-5", "5"]], [[7]], [[7, "0"]] * 65),
        "a sample that was moved": lambda: [
            edited(data, f"{F}.points.{k}.{j}", plus(d)) for k in (7, 17, 11, 13) for j in (0, 1) for d in (TINY, -TINY)
        ],
        "axes beside slopes": lambda: e(f"{BY}.axes", [texts(NEAR_X), texts(NEAR_U)], [texts([-3, 3]), texts([-1, 1])]),
        "a box without the origin": lambda: e(f"{F}.box.0", ["1/100", "3"], ["-3", "-1/100"]),
        "slopes in another order": lambda: e(f"{BY}.slopes", ["b", "a"], ["a"], ["a", "a"], ["a", "r"], []),
        "what need not vanish": lambda: e(f"{F}.vanishes", False),
        "a bound that is too small": lambda: [
            edited(data, "plant.dynamics.0", linear(k))
            for k in ((K[0] - TINY, K[1]), (K[0], K[1] - TINY), (K[0], Fraction(0)), (Fraction(0), K[1]))
        ],
        "a bound of another form": lambda: [
            edited(data, "plant.dynamics.0", lambda tree, v=v: [*tree, ["*", "r", v]])
            for v in (["*", "x", "u"], "x", "1/1000", ["**", "x", 4], "-1")
        ],
        "another linear part": lambda: [
            edited(data, "plant.dynamics.0", lambda tree, v=v: [*tree, v])
            for v in (["*", "a", "x"], "x", ["*", "a", "u"], ["*", "r", "a", ["**", "x", 2]],
                      ["*", "1/1000", ["**", "x", 2]], ["*", "a", "b", "x"])
        ],
        "a wider domain": lambda: e("plant.domain.0", ["-301/100", "3"], ["-3", "4"]),
        "wider input bounds": lambda: e("plant.input_bounds.0", ["-1", "11/10"]),
    }  # fmt: skip


def of_scattered() -> Forged:
    data = scattered()
    e = lambda path, *values: [edited(data, path, v) for v in values]  # noqa: E731
    weights = data["evidence"]["samples"][0]["weights"]
    used = sorted({k for both in weights for each in both for k, _ in each})
    places = [(p, side, k) for p in range(14) for side in (0, 1) for k in range(len(weights[p][side]))]
    return {
        "a weight": lambda: [edited(data, f"{BY}.weights.{p}.{side}.{k}.1", plus(d))
                     for p, side, k in places for d in (TINY, -TINY, Fraction(1, 10**9), 1)],
        "another sample": lambda: [edited(data, f"{BY}.weights.{p}.{side}.{k}.0", lambda j: (j + 1) % 80)
                           for p, side, k in places],
        "a weight too few": lambda: [
            edited(data, f"{BY}.weights.{p}.{side}", lambda w: w[1:]) for p, side, _ in places
        ],
        "a sample that was moved": lambda: [edited(data, f"{F}.points.{k}.{j}", plus(d))
                                    for k in used for j in (0, 1) for d in (TINY, Fraction(1, 10**9))],
        "sampled values": lambda: [forged for forged in e(f"{F}.values", *(
            lambda v, d=d: [plus(d)(y) for y in v] for d in (TINY, -TINY, 1)), lambda v: v[::-1])
            if least_error(forged) > least_error(data)],
        "noise": lambda: e(f"{F}.noise", plus(TINY), plus("1/1000")),
        "curvature": lambda: e(f"{F}.curvature.0.0", plus(TINY), plus(1)) + e(f"{F}.curvature.1.1", str(TINY), "1"),
        "mixed curvature": lambda: e(
            f"{F}.curvature", *([["1/10", q], [q, "0"]] for q in ("20000001/1000000000", "1"))
        ),
        "a bound that is too small": lambda: e(
            "plant.dynamics.0", equation(least_error(data) - TINY), equation(Fraction(1, 200))
        ),
        "points of the grid in another order": lambda: e(
            f"{BY}.weights", lambda w: w[::-1], lambda w: [w[1], w[0], *w[2:]]
        ),
        "a coarser grid": lambda: e(BY, bounded_by_programs(data["claim"]["samples"]["functions"][0], [[-3, 0, 3], U])),
        "swapped ends": lambda: e(f"{BY}.weights", lambda w: [both[::-1] for both in w]),
    }  # fmt: skip


def of_aslant() -> Forged:
    data = aslant()
    return {
        "a range of a slope": lambda: [
            edited(data, f"plant.uncertain.0.range.{side}", plus((1 - 2 * side) * d))
            for side in (0, 1) for d in (TINY, Fraction(1, 1000), Fraction(1, 5000))
        ],
        "mixed curvature": lambda: [
            edited(data, f"{F}.curvature", [["1/5", q], [q, "1/10"]]) for q in ("201/10000", "-1/50", "1/10")
        ],
    }  # fmt: skip


def of_two() -> Forged:
    data = two()
    e = lambda path, *values: [edited(data, path, v) for v in values]  # noqa: E731
    return {
        "an error in another equation": lambda: e(
            "plant.dynamics.1", *([*["+", ["-", "y"]], ["*", "q", "1/10"], ["*", "r", w]] for w in ("1/1000", "0"))
        ) + e("plant.dynamics.0", ["+", ["-", "x"], ["*", "r", "1/10"], ["*", "1/1000", "q"]]),
        "a name that is none of the function's": lambda: e(
            "plant.dynamics.0", *(["+", ["-", "x"], ["*", "r", "1/10"], ["*", "1/1000", z]] for z in "yu")
        ) + e("plant.dynamics.0", ["+", ["-", "x"], ["*", "r", "1/10", ["+", "1", ["*", "1/1000", "y"]]]]),
        "one error for both": lambda: [
            edited(e("evidence.samples.1.error", "r")[0], "plant.dynamics.1", ["+", ["-", "y"], ["*", "r", "1/10"]])
        ],
        "functions in another order": lambda: e("claim.samples.functions", lambda f: f[::-1]) + e(
            "evidence.samples", lambda s: s[::-1]),
        "weights that give the point and another sum": lambda: [
            edited(unbent(), f"{BY}.weights.{k}.{side}", v)
            for k, v in ((0, [[6, "-1"]]), (0, [[1, "3/2"]]), (3, [[3, "2"]]), (2, [[2, "1"], [3, "1"]]))
            for side in (0, 1)
        ],
        "another variable": lambda: e("claim.samples.functions.0.variables", ["y"], ["u"]),
        "a sampled state in another equation": lambda: e(
            "plant.dynamics.1", ["+", ["-", "y"], ["*", "q", "1/10"], "x"]
        ),
    }  # fmt: skip


FORGED = {"scattered": of_scattered, "far": of_far, "near": of_near, "aslant": of_aslant, "two": of_two}
BY_FORM = ("samples that are none", "what vanishes", "long numbers", "no function")


def odd() -> dict[str, Document]:
    """True claims with sections that no certificate may have, though what they say would follow."""
    claims, same = "claim.samples.functions", edited(two(), "plant.dynamics.1", ["-", "y"])
    same = edited(same, f"{claims}.1", lambda _: two()["claim"]["samples"]["functions"][0])
    once = edited(two(), BY, on_grid([[*X[:3], *X[2:]]]))
    once = edited(once, f"{BY}.weights", lambda w: [*w[:3], *w[2:-1]])
    data = newer(true("scalar"))
    straight = function("x", ("x", "u"), [[0, 0], [0, 0]], 0, False, [X, U], lambda x, u: x / 4 + u)
    nearly = newer(nearby()["then"])
    constant = function("x", ("x", "u"), [[0, 0], [0, 0]], 0, False, [X, U], lambda x, u: u / 2 - x)
    exact = edited(
        edited(edited(two(), "plant.uncertain", []), "evidence.cells", []), "plant.dynamics", [["-", "x"], "0"]
    )
    exact = edited(exact, "evidence.samples", [on_grid([X], None)] * 2)
    beyond = edited(
        edited(far(), f"{F}.points", lambda v: [*v, ["3000001/1000000", "0"]]), f"{F}.values", lambda v: [*v, "0"]
    )
    return {
        "a point outside of the box": beyond,
        "no name, of no quantities": edited(exact, "evidence.samples.0.error", ""),
        "no name": edited(two(), "evidence.samples.0.error", ""),
        "a state twice": edited(same, "evidence.samples.1", on_grid([X], "q")),
        "a quantity that stands for two": edited(two(), "evidence.samples.1.error", "r"),
        "an axis with a number twice": once,
        "data": with_samples(data, [straight], [on_grid([X, U], None)]),
        "nearby": with_samples(nearly, [constant], [on_grid([X, U], None)]),
    }


@pytest.mark.parametrize("kind", odd())
def test_sections_that_no_certificate_may_have(kind: str) -> None:
    assert verdicts(odd()[kind]) == ("format", "format")


@pytest.mark.parametrize(("name", "kind"), [(name, kind) for name, of in FORGED.items() for kind in of()])
def test_forgeries_are_refused_by_both(name: str, kind: str) -> None:
    forged = FORGED[name]()[kind]()
    assert forged
    for number, data in enumerate(forged):
        found = verdicts(data)
        assert None not in found, f"{kind} {number}: {found}"
        assert kind not in BY_FORM or found == ("format", "format")


def contradicted(by: Any) -> Document:
    """`far` with a second sample at the first of its points, so far above the other, by which its lower end goes."""
    data, n = far(), len(far()["claim"]["samples"]["functions"][0]["values"])
    data = edited(edited(data, f"{F}.points", lambda v: [*v, v[0]]), f"{F}.values", lambda v: [*v, plus(by)(v[0])])
    return edited(data, f"{BY}.weights.0.0", [[n, "1"]])


def test_samples_that_contradict_each_other_at_a_point() -> None:
    """Two samples at one point are no fault, as long as they are no more than twice the noise apart."""
    for by, found in ((0, ACCEPTED), ("1/50", ACCEPTED), (Fraction(1, 50) + TINY, ("samples", "samples"))):
        assert verdicts(contradicted(by)) == found
    with pytest.raises(Rejected, match="the samples contradict the declared bounds, at -3, -1"):
        rules.check(document.certificate(json.loads(dumped(contradicted("1/10"))), "0" * 64))


@pytest.mark.parametrize("off", [Fraction(0), Fraction(1, 250), Fraction(1, 250) + TINY, Fraction(1, 200)])
def test_samples_that_contradict_each_other_about_a_slope(off: Fraction) -> None:
    """Samples at the points of two others, for which the slope is by off/10 larger; its range holds both ends."""
    data = near()
    for k, sign in ((7, -1), (17, 1)):
        data = edited(data, f"{F}.points", lambda v, k=k: [*v, v[k]])
        data = edited(data, f"{F}.values", lambda v, k=k, sign=sign: [*v, plus(sign * off)(v[k])])
    data = edited(data, f"{BY}.weights.0.0", [[25, "-5"], [26, "5"]])
    e = Fraction(1, 50)
    assert ends_at(data["claim"]["samples"]["functions"][0], (0, 0), data["evidence"]["samples"][0]["weights"][0]) == [
        -1 + 10 * off - e, -1 + e]  # fmt: skip
    assert verdicts(data) == (ACCEPTED if 10 * off <= 2 * e else ("samples", "samples"))


@pytest.mark.parametrize(("low", "rule"), [("-1", "local"), ("1/100", "samples")])
def test_the_box_of_what_vanishes_has_the_origin(low: str, rule: str) -> None:
    """Slopes from samples with u > 0; with the first box, in which 0 is, a later rule is the first to fail."""
    f = function("x", ("x", "u"), [["1/5", "1/50"], ["1/50", "1/10"]], "1/1000", True, [NEAR_X, [Fraction(1, 10), 1]],
                 lambda x, u: -x + u / 2)  # fmt: skip
    data = edited(edited(near(), F, f), f"{F}.box.1", [low, "1"])
    both = [[[2, "-5"], [6, "5"]]] * 2, [[[4, "10"]]] * 2
    data = edited(edited(data, f"{BY}.weights", list(both)), "plant.input_bounds.0", [low, "1"])
    for k, ends in enumerate((["-2", "0"], ["0", "1"])):
        data = edited(data, f"plant.uncertain.{k}.range", ends)
    assert verdicts(data) == (rule, rule)


def test_a_sample_may_have_several_weights_in_a_list() -> None:
    data = edited(far(), f"{BY}.weights.0.0", [[0, "1/3"], [0, "2/3"], [5, "0"]])
    assert verdicts(data) == ACCEPTED


SMALL = f"1/{10**40}"
LARGE = {
    "degree": [["*", SMALL, ["**", "x", 21]]],
    "terms": [["*", SMALL, ["**", "x", i], ["**", "u", j]] for i in range(1, 12) for j in range(1, 12)],
    "bits": [["*", f"1/{3**324}", "x"]],
    "parts": [["*", SMALL, ["**", "x", 20], ["**", "u", k]] for k in range(1, 20)],
    "on the way": [["*", SMALL, ["**", ["+", "x", "u", "1"], 20]]],
    "pairs": [
        [
            "*",
            SMALL,
            ["+", *[["**", "x", i] for i in range(1, 13)], *[["**", "u", i] for i in range(1, 21)], "1"],
            [
                "+",
                *[["**", "x", i] for i in range(1, 8)],
                *[["**", "u", i] for i in range(1, 21)],
                *[["*", "x", ["**", "u", i]] for i in range(1, 6)],
            ],
            "0",
        ]
    ],
    "on the way, to nothing": [["**", "x", 21], ["-", ["**", "x", 21]]],
}


@pytest.mark.parametrize("kind", LARGE)
def test_polynomials_that_are_too_large(kind: str) -> None:
    """They change nothing that counts, and fewer of the same are accepted."""
    data = edited(far(), "plant.dynamics.0", [*equation(E_FAR + Fraction(1, 1000)), *LARGE[kind]])
    assert verdicts(data) == ("samples", "samples")
    fewer = [["*", SMALL, ["**", "x", 20]], ["*", SMALL, "x", "u"], ["*", f"1/{3**300}", "x"]]
    assert verdicts(edited(data, "plant.dynamics.0", [*equation(E_FAR + Fraction(1, 1000)), *fewer])) == ACCEPTED


def test_there_are_many_kinds() -> None:
    kinds = [forged() for of in FORGED.values() for forged in of().values()]
    assert len(kinds) >= 60 and sum(map(len, kinds)) >= 250


# ------------------------------------------------------------------------------------------------------ just inside


def one(M: Fraction, step: Fraction, noise: Fraction, E: Fraction, off: Fraction = Fraction(0)) -> Document:
    """x' = -x + r E, samples -x + off at the multiples of a step."""
    data = edited(two(), "plant.dynamics.0", ["+", ["-", "x"], ["*", "r", str(E)]])
    axis = [k * step for k in range(int(-3 / step), int(3 / step) + 1)]
    f = function("x", ("x",), [[M]], noise, False, [axis], lambda v: -v + off)
    return edited(edited(data, F, f), BY, on_grid([axis]))


def is_shown(data: Document) -> bool:
    """True if the rule holds in both programs, False if in neither."""
    found = {rule == "samples" for rule in verdicts(data)}
    assert len(found) == 1
    return not found.pop()


@pytest.mark.parametrize("M", [Fraction(0), Fraction(1, 3), Fraction(2), Fraction(10**6)])
@pytest.mark.parametrize("step", slow_after(1, [Fraction(3, 7), Fraction(1), Fraction(1, 20)]))
@pytest.mark.parametrize("noise", [Fraction(0), Fraction(1, 10)])
def test_a_bump_between_two_samples_is_what_is_allowed(M: Fraction, step: Fraction, noise: Fraction) -> None:
    """-x + noise + M/2 v (step - v) on each cell, v from its lower end, reaches the bound in the middle of the cell: so
    no smaller one is true, and with a little more curvature the same function is outside."""
    top = noise + M / 2 * (step / 2) * (step / 2)
    assert is_shown(one(M, step, noise, top))
    for less in (TINY, top / 100, top):
        assert less == 0 or not is_shown(one(M, step, noise, top - less))
    assert not is_shown(one(M + TINY, step, noise, top)) and not is_shown(one(M, step, noise + TINY, top))
    assert not is_shown(one(M, step, noise, top, off=TINY)) and not is_shown(one(M, step, noise, top, off=-TINY))


@pytest.mark.parametrize("seed", slow_after(60, range(200)))
def test_any_weights_bound_a_consistent_function(seed: int) -> None:
    """At the point that they give, exactly: of a quadratic function whose second derivatives are M or -M, sampled with
    all of the noise, which is the function at an end where weights are positive and it bends most along each axis."""
    draw, extreme, sign = np.random.default_rng(seed), seed % 3 == 0, -1 if seed % 2 else 1
    d, count = int(draw.integers(1, 5)), int(draw.integers(1, 9))

    def numbers(least: int, *shape: int) -> list[Any]:
        return [Fraction(v, 10) for v in draw.integers(least, 9, shape).ravel().tolist()]

    z = [tuple(numbers(-9, d)) for _ in range(count)]
    v = numbers(1 if extreme else -5, count)
    v = [w / sum(v) for w in v] if sum(v) else [Fraction(1), *[Fraction(0)] * (count - 1)]
    p = tuple(sum((w * q[j] for w, q in zip(v, z, strict=True)), Fraction(0)) for j in range(d))
    upper, signs = np.triu(draw.integers(0, 30, (d, d))), np.triu(draw.choice([-1, 1], (d, d)))
    bends = np.diag(np.diag(upper)) if extreme else upper + np.triu(upper, 1).T
    turned = sign * bends if extreme else bends * (signs + np.triu(signs, 1).T)
    M, H = ([[Fraction(m, 10) for m in row] for row in each.tolist()] for each in (bends, turned))
    a, w = numbers(-9, d), Fraction(1, 7)

    def g(q: Sequence[Fraction]) -> Fraction:
        bent = sum((H[i][j] * q[i] * q[j] for i in range(d) for j in range(d)), Fraction(0)) / 2
        return bent + sum((s * c for s, c in zip(a, q, strict=True)), Fraction(0))

    values = [g(q) + sign * w * (1 if u >= 0 else -1) for q, u in zip(z, v, strict=True)]
    exact = lambda q: fmpq(q.numerator, q.denominator)  # noqa: E731
    vector = lambda q: tuple(map(exact, q))  # noqa: E731
    f = Function(0, tuple(range(d)), (), tuple(map(vector, M)), exact(w), False, tuple(map(vector, z)), vector(values))
    each = tuple((k, exact(u)) for k, u in enumerate(v))
    (low_sums, lo), (high_sums, hi) = f.ends(vector(p), (each, each))
    assert low_sums == high_sums == (1, *vector(p)) and lo <= exact(g(p)) <= hi
    assert not extreme or (lo if sign > 0 else hi) == exact(g(p))


class Random:
    """g = p + sum_k c_k cos(w_k.z + s_k) of d variables, sampled on a grid, beside a polynomial P near p."""

    def __init__(self, seed: int) -> None:
        draw = self.draw = np.random.default_rng(seed)
        self.d = int(draw.integers(1, 4))
        self.names = ("x", "y", "u")[: self.d]
        self.c, self.w, self.s = draw.normal(size=2), draw.normal(size=(2, self.d)), draw.uniform(0, 6, 2)
        self.powers = [tuple(draw.integers(0, 4, self.d).tolist()) for _ in range(4)]
        self.P = [Fraction(int(draw.integers(-99, 99)), 100) for _ in self.powers]
        self.axes = [self.axis(-3, 3) if name != "u" else self.axis(-1, 1) for name in self.names]

    def axis(self, lo: int, hi: int) -> list[Fraction]:
        inner = {Fraction(int(v), 100) for v in self.draw.integers(100 * lo + 1, 100 * hi, self.draw.integers(0, 4))}
        return sorted({Fraction(lo), Fraction(hi)} | inner)

    def value(self, z: np.ndarray) -> np.ndarray:
        return np.cos(z @ self.w.T + self.s) @ self.c + self.polynomial(z)

    def polynomial(self, z: np.ndarray) -> np.ndarray:
        each = zip(self.P, self.powers, strict=True)
        return sum(float(q) * np.prod(z ** np.array(k), axis=-1) for q, k in each)

    @property
    def curvature(self) -> list[list[Fraction]]:
        """A bound, of the cosines by their sizes, of the polynomial by those of its terms on the box."""
        reach = [float(max(abs(axis[0]), abs(axis[-1]))) for axis in self.axes]
        M = np.einsum("k,ki,kj->ij", np.abs(self.c), np.abs(self.w), np.abs(self.w))
        for q, k in zip(self.P, self.powers, strict=True):
            for i, j in product(range(self.d), repeat=2):
                left, factor = list(k), abs(float(q))
                for axis in (i, j):
                    factor *= left[axis]
                    left[axis] = max(left[axis] - 1, 0)
                M[i, j] += factor * np.prod([v**e for v, e in zip(reach, left, strict=True)])
        return [[Fraction(int(max(M[i, j], M[j, i]) * 1e6) + 1, 10**6) for j in range(self.d)] for i in range(self.d)]

    def document(self, E: Fraction, scattered: bool) -> Document:
        terms = [["*", str(q), *(["**", z, e] for z, e in zip(self.names, k, strict=True) if e)]
                 for q, k in zip(self.P, self.powers, strict=True)]  # fmt: skip
        data = edited(two(), "plant.dynamics.0", ["+", *terms, ["*", "r", str(E)]])
        points = np.array([[float(v) for v in z] for z in product(*self.axes)])
        if scattered:
            points = self.draw.uniform(points.min(axis=0), points.max(axis=0), (15 * self.d, self.d)).round(2)
        wrong = self.draw.choice([-0.0099, 0.0099], len(points))
        values = [Fraction(f"{y:.12f}") for y in self.value(points) + wrong]
        f = {
            **function("x", self.names, self.curvature, "1/100", False, self.axes, lambda *_: 0),
            "points": [texts([Fraction(str(v)) for v in z]) for z in points.tolist()],
            "values": texts(values),
        }
        by = bounded_by_programs(f, self.axes) if scattered else on_grid(self.axes)
        return edited(edited(data, F, f), BY, by)


@pytest.mark.parametrize("scattered", [False, True])
@pytest.mark.parametrize("seed", slow_after(1, range(200)))
def test_true_functions_are_within_the_least_bound(seed: int, scattered: bool) -> None:
    """The least E that both programs accept holds g - P at drawn points and in cells' middles; the two agree on it."""
    g, lo, hi = Random(seed), Fraction(0), Fraction(10**8)
    data = g.document(hi, scattered)

    def shown(E: Fraction) -> bool:
        return is_shown(edited(data, "plant.dynamics.0", lambda tree: [*tree[:-1], ["*", "r", str(E)]]))

    assert shown(hi)
    while hi - lo > hi / 1000:
        middle = (lo + hi) / 2
        lo, hi = (lo, middle) if shown(middle) else (middle, hi)
    ends = np.array([[float(axis[0]), float(axis[-1])] for axis in g.axes])
    drawn = g.draw.uniform(ends[:, 0], ends[:, 1], (500, g.d))
    middles = np.array(list(product(*([float(a + b) / 2 for a, b in pairwise(axis)] for axis in g.axes))))
    for z in (drawn, middles):
        assert np.abs(g.value(z) - g.polynomial(z)).max() <= float(hi)


# ------------------------------------------------------------------------------------------------- words and numbers


def test_the_words() -> None:
    c = document.certificate(json.loads(dumped(near())), "0" * 64)
    said = "\n".join(report(c, {"result": "ACCEPTED", "rules": {}, "margins": {}, "modules": []}))
    assert "for every plant in which x' is instead a function of x, u with continuous second derivatives" in said
    near_by = "the 25 samples that the certificate states at points there, and is 0 at 0"
    assert f"within 1/1000 (about 0.001) of {near_by}" in said
    assert f"of other functions nothing is claimed; the samples are said to be of a file with sha256 {'0' * 64}" in said
    words = in_words(read(dumped(near())))
    assert "values within 1/1000 of the 25 that the certificate states, is 0 at 0" in words
    assert "is 0 at 0" not in in_words(read(dumped(far())))
