"""Attacks on rules `faces` and `outer`: searches for what would make ACCEPTED wrong.

Functions N are random, networks of huge and tiny weights and expressions of every function, on loops of every form, in
coordinates that are as good as singular: points of boxes climb to where a bound is used most, and there it must hold
with certainty, in ball arithmetic. Whole certificates of loops of chance are accepted only where no search refutes
them. Where an end, a level, a pole or a tangent is exactly at its limit, the limit decides. Each campaign has a sample
that always runs and a full size, `pytest -m slow`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import acb, arb, ctx

from certify.checker.boxes import middle
from certify.checker.case import Case
from certify.checker.document import Certificate
from certify.checker.outer import Beyond
from tests.checker.test_cubic_attack import climb, random_loop, random_tree, sizes
from tests.support.certificates import LEAF, Document, edited, encode, parse, verdict
from tests.support.leaves import beyond_on_boxes
from tests.support.marks import slow_after
from tests.support.oracle import ball, policies_in_arb, value_of
from tests.support.outer import (
    Balls,
    expression,
    network,
    packed,
    proved,
    quadratic,
    refutation,
    stated,
    unpacked,
    with_outer,
    with_uniform_trees,
)
from tests.support.outer_forgeries import stripped
from tests.support.outer_loops import SQUARE, UNUSED, base, of_chance, planar, saturated, scalar
from tests.support.plain import Taylor, affine, chain, function_of, slope_of_tanh
from tests.support.reached import dot
from tests.support.uncertain import random_plant

Array = np.ndarray
Generator = np.random.Generator
BITS, STEP = 900, 250
REFUSED = ("faces", "outer", "inputs")


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    """As in `rules.check`: overflow becomes infinity or NaN."""
    with np.errstate(all="ignore"), ctx.workprec(BITS):
        yield


# ------------------------------------------------------------------------------------------------- the models, on boxes


def random_network(generator: Generator, n: int) -> Document:
    widths, layers = [n, *generator.integers(1, 7, generator.integers(0, 4)), 1], []
    for columns, rows in itertools.pairwise(widths):
        W = generator.standard_normal((rows, columns)) / columns**0.5
        size = generator.choice([1e-300, 1e-9, 0.01, 1, 1, 1, 3, 30, 1e6])
        layers.append((size * W, generator.choice([0, 1, 5, 1e5]) * generator.normal(size=rows)))
    return network(layers, 0.0)


def random_function(generator: Generator, states: str) -> Document:
    if generator.random() < 0.5:
        return random_network(generator, len(states))
    return expression(random_tree(generator, states, int(generator.integers(1, 5))), 0.0)


def random_case(seed: int) -> tuple[Document, Beyond, Array, Array]:
    """A loop with a function beyond it, and corners of boxes of its coordinates; nothing is claimed to hold."""
    generator = np.random.default_rng([17, seed])
    data = random_loop(generator)[0] if seed % 3 else random_plant(seed, practical=seed % 2 == 0)
    n = len(data["plant"]["states"])
    T = generator.standard_normal((n, n))
    if generator.random() < 0.4:  # nearly of rank 1, or of very different columns
        T = T[:, :1] @ T[:1] + 10.0 ** generator.uniform(-12, -1) * T
        T = T * 10.0 ** generator.uniform(-8, 8, n)
    data = stated(data, random_function(generator, "xyz"[:n]), T, np.ones(n))
    size = 2 * 10.0 ** generator.uniform(-7, 0.3) / np.linalg.norm(T, axis=0)
    centre = generator.uniform(-1, 1, (n, 3)) * 10.0 ** generator.uniform(-3, 0.5) / np.linalg.norm(T, axis=0)[:, None]
    radius = size[:, None] * generator.random((n, 3)) ** 2
    return data, Beyond(Case(parse(data))), centre - radius, centre + radius


class Truth:
    """N, N'F and the inputs at points of boxes, exactly but for the width of balls."""

    def __init__(self, data: Document, c: Certificate) -> None:
        self.c, self.balls = c, Balls(data, {q: Fraction(1) for q in c.uncertain})

    def at(self, x: list[arb], q: list[arb]) -> tuple[arb, arb, list[arb]]:
        u = policies_in_arb(self.c.policy, self.c.u_eq, [x])[0]
        names = dict(zip((*self.c.states, *self.c.inputs, *self.c.uncertain), (*x, *u, *q), strict=True))
        F = [value_of(tree, names) for tree in self.c.dynamics.trees]
        t = arb(2) ** -STEP
        ahead = self.balls.N([acb(v, t * f) for v, f in zip(x, F, strict=True)])
        return self.balls.N([acb(v) for v in x]).real, ahead.imag / t, u


def left_over(model: Taylor, k: int, value: arb, symbols: list[arb]) -> arb:
    """What the k-th member of a batch leaves of a value."""
    g, Q = model.g[:, k].tolist(), model.Q[:, :, k].tolist()
    said = arb(float(model.c[k])) + sum((arb(v) * s for v, s in zip(g, symbols, strict=False)), arb(0))
    for row, s in zip(Q, symbols, strict=False):
        said += s * sum((arb(v) * t for v, t in zip(row, symbols, strict=False)), arb(0))
    return abs(value - said)


@sizes(16, 600)
def test_no_point_of_a_box_leaves_its_models(count: int) -> None:
    """N, and N'F with the symbols of what the inputs' enclosures leave and of what is uncertain."""
    closest, known = 0.0, 0
    for seed in range(count):
        data, beyond, lo, hi = random_case(seed)
        generator, n, k = np.random.default_rng(seed), beyond.n, beyond.k
        centre, radius = middle(lo, hi)
        N, rise, least, mid, slopes, wide = beyond_on_boxes(beyond, lo, hi)
        finite = [np.isfinite(v.c) & np.isfinite(v.size) & np.isfinite(v.r) for v in (N, rise)]
        asked = [i for i in range(lo.shape[1]) if finite[0][i]]
        known += sum(int(v[asked].sum()) for v in finite)
        truth, T = Truth(data, beyond.c), beyond.T.tolist()

        def use(
            d: Array, truth: Truth = truth, T: Any = T, N: Taylor = N, rise: Taylor = rise, mid: Array = mid,
            slopes: Array = slopes, wide: Array = wide, centre: Array = centre, radius: Array = radius,
            asked: Any = asked, least: Array = least, finite: Any = finite, n: int = n,
        ) -> float:  # fmt: skip
            spread = np.clip(2 * d, -1, 1)
            s, own = [arb(v) for v in spread[:n].tolist()], [arb(v) for v in spread[n:].tolist()]
            ends = [[ball(q) for q in pair] for pair in truth.c.ranges]
            q = [(a + b) / 2 + (b - a) / 2 * v for (a, b), v in zip(ends, own, strict=True)]
            most = 0.0
            for i in asked:
                z = [
                    arb(c) + arb(r) * v for c, r, v in zip(centre[:, i].tolist(), radius[:, i].tolist(), s, strict=True)
                ]
                x = [dot([arb(t) for t in row], z) for row in T]
                value, falling, u = truth.at(x, q)
                assert not np.isfinite(least[i]) or value >= arb(float(least[i]))
                left = left_over(N, i, value, s)
                assert left <= arb(float(N.r[i])), (i, d.tolist())
                most = max(most, float(left / arb(float(N.r[i]))))
                if not finite[1][i]:
                    continue
                errors = []
                for v, m, slope, w in zip(
                    u, mid[:, i].tolist(), slopes[:, :, i].tolist(), wide[:, i].tolist(), strict=True
                ):
                    e = v - arb(m) - sum((arb(a) * b for a, b in zip(slope, s, strict=True)), arb(0))
                    assert abs(e) <= arb(w)
                    errors.append(e / arb(w))
                left = left_over(rise, i, falling, [*s, *errors, *own])
                assert left <= arb(float(rise.r[i])), (i, d.tolist())
                most = max(most, float(left / arb(float(rise.r[i]))))
            return most

        if asked:
            closest = max(closest, climb(generator, n + k, use, 8))
    assert 0.5 < closest <= 1 and known > count


@pytest.mark.parametrize("radius", [1e-300, 1e-12, 1e-6, 1e-3, 0.1, 1.0, 30.0])
def test_what_the_derivative_of_tanh_leaves(radius: float) -> None:
    """Within all that is said of it, and next to it where the fourth derivative of tanh is largest near c."""
    closest = 0.0
    for c in np.linspace(-3, 3, 61):
        phi = slope_of_tanh(c, radius)
        f, e = ([float(v) for v in part[:3]] for part in (phi.f, phi.e))
        for share in (-1.0, -0.5, 0.0, 0.3, 1.0):
            D = arb(float(share * radius))
            size = abs(D)
            true = 1 - (arb(float(c)) + D).tanh() ** 2
            left = abs(true - arb(f[0]) - arb(f[1]) * D - arb(f[2]) * D**2)
            rounding = arb(e[0]) + arb(e[1]) * size + arb(e[2]) * size**2
            assert left <= rounding + arb(float(phi.third)) * size**3
            if share:
                closest = max(closest, float((left - rounding) / (arb(float(phi.third)) * size**3)))
    assert closest > 0.5 or not 1e-4 < radius < 0.02


@pytest.mark.parametrize("width", [2, 5, 40])
def test_layers_that_cancel_leave_roundings_alone(width: int) -> None:
    """States that are known exactly, and weights whose sum of products is as good as 0."""
    generator, closest = np.random.default_rng(width), 0.0
    for size in (1e-200, 1e-3, 1.0, 1e9, 1e150):
        x, W = generator.normal(size=(width, 50)), size * generator.normal(size=(1, width))
        x[-1] = -(W[0, :-1] @ x[:-1]) / W[0, -1]
        states = [affine(v, np.zeros((1, 50))).model for v in x]
        model = Taylor.of(function_of(chain((W,), (np.zeros(1),))).along(states, [None] * width).value)
        for k in range(50):
            each = zip(W[0].tolist(), x[:, k].tolist(), strict=True)
            off = abs(Fraction(float(model.c[k])) - sum(Fraction(a) * Fraction(b) for a, b in each))
            assert off <= Fraction(float(model.r[k]))
            closest = max(closest, float(off / Fraction(float(model.r[k]))))
    assert closest > 1e-3


# ----------------------------------------------------------------------------------------------- certificates of chance


@pytest.mark.slow
@sizes(10, 500)
def test_what_is_accepted_of_chance_is_not_refuted(count: int) -> None:
    """Levels around the limit that a search knows nearly, and functions of which nobody knows anything."""
    accepted = refused = 0
    for seed in range(count):
        generator = np.random.default_rng([18, seed])
        if seed % 2:
            data = of_chance(100 + seed).claim(float(generator.choice([0.5, 0.9, 0.98, 1.0, 1.02, 1.3])))
        else:
            inner = stripped(base(("square", "walls", "van der Pol", "clip", "range")[seed // 2 % 5]))
            N = random_function(generator, "xy"[: len(inner["plant"]["states"])])
            data = with_outer(inner, at_some_level(inner, N, generator), max_leaves=120, depth=12)
        found = verdict(data)
        accepted, refused = accepted + (found == "ACCEPTED"), refused + (found in REFUSED)
        assert found in ("ACCEPTED", *REFUSED)
        assert found != "ACCEPTED" or refutation(data) is None, seed
    assert accepted >= count / 8 and refused >= count / 8


def at_some_level(data: Document, N: Document, generator: Generator) -> Document:
    """At the value of N at a state of the domain, or at one of the least on its boundary."""
    balls = Balls(edited(data, "claim.outer", N), {q["name"]: Fraction(0) for q in data["plant"]["uncertain"]})
    domain = np.array([[float(Fraction(q)) for q in pair] for pair in data["plant"]["domain"]])
    values = []
    for _ in range(20):
        x = domain[:, 0] + (domain[:, 1] - domain[:, 0]) * generator.random(len(domain))
        axis = int(generator.integers(len(domain)))
        x[axis] = domain[axis, int(generator.integers(2))]
        values.append(float(balls.N([acb(v) for v in x.tolist()]).real))
    finite = [v for v in values if np.isfinite(v)] or [0.0]
    level = min(finite) - float(generator.choice([0, 1e-3, 0.1, 0.5])) * (max(finite) - min(finite) + 1e-3)
    return {**N, "level": float(level).hex()}


# ---------------------------------------------------------------------------------------------- exactly at their limits

FACES = ("1/3", "2/3", "1/10", "5/7", "1", "4/3", "123456789/987654321", "3/2", "1" + "0" * 20 + "/7")


@pytest.mark.parametrize("end", FACES)
@pytest.mark.parametrize("kind", slow_after(1, ["slope", "layer", "square", "inverse"]))
def test_a_face_at_a_rational_is_decided_by_its_exact_value(end: str, kind: str) -> None:
    """x' = -x: N at this end against the binary64 numbers next to it; at the other end N is far above."""
    q, generator = Fraction(end), np.random.default_rng(len(end))
    data = scalar(["+", ["-", "x"], "u"], float(q) ** 2 / 1000, domain=[(str(-4 * q), end)])
    for w in generator.uniform(0.5, 2, 2).tolist():
        slope = Fraction(w)
        value = {"slope": slope * q, "layer": -slope * q, "square": q * q, "inverse": -1 / (q * q)}[kind]
        tree: Any = {
            "slope": ["*", str(slope), ["sqrt", SQUARE]], "square": SQUARE, "inverse": ["-", ["**", "x", -2]],
        }.get(kind)  # fmt: skip
        levels = [float(value)]
        for _ in range(3):
            levels = [float(np.nextafter(levels[0], -np.inf)), *levels, float(np.nextafter(levels[-1], np.inf))]
        for level in [*levels, float(value) - 1e-9 * abs(float(value)), float(value) + 1e-9 * abs(float(value))]:
            N = network([([[-w]], [0.0])], level) if kind == "layer" else expression(tree, level)
            refused = verdict(stated(data, N)) == "faces"
            assert refused or Fraction(level) < value
            assert not (refused and level < float(value) - 0.9e-9 * abs(float(value)))


@pytest.mark.parametrize("kind", ["layer", "expression"])
def test_faces_reach_into_the_corners_of_the_domain(kind: str) -> None:
    """N = 8 - a x - b y is least at a corner, whose coordinates are no binary64 numbers."""
    a, b, x, y = Fraction(3, 4), Fraction(5, 8), Fraction(4, 3), Fraction(5, 7)
    value = 8 - a * x - b * y
    data = planar([["-", "x"], ["-", ["+", "y", UNUSED]]], [[0.0, 0.0]], np.eye(2), 0.01,
                  domain=(("-4/3", "4/3"), ("-6/7", "5/7")))  # fmt: skip
    tree = ["+", "8", ["*", str(-a), "x"], ["*", str(-b), "y"]]
    for level in (value, value + Fraction(1, 10**9), value + Fraction(1, 10**4), value - Fraction(1, 10**9)):
        near = float(level)
        N = network([([[-float(a), -float(b)]], [8.0])], near) if kind == "layer" else expression(tree, near)
        found = verdict(stated(data, N))
        assert found == "faces" or level < value
        assert found != "faces" or level >= value


@pytest.mark.parametrize("c", slow_after(1, ["1", "7/5", "1/3"]))
def test_a_state_at_rest_beyond_the_ellipsoid_is_refused(c: str) -> None:
    """x' = -x ((x^2 - c)^2 - e): for e = 0 N'F is 0 at x^2 = c and negative beside it; for e < 0 the claim is true."""
    for e in (
        Fraction(0),
        Fraction(1, 10**30),
        Fraction(1, 2**52),
        Fraction(1, 10**9),
        Fraction(1, 100),
        Fraction(-1, 4),
    ):
        tree = ["+", ["*", "-1", "x", ["-", ["**", ["-", SQUARE, c], 2], str(e)]], UNUSED]
        data = scalar(tree, 0.0625, domain=[("-2", "2")])
        claim = with_outer(data, expression(SQUARE, 3.0), max_leaves=60, depth=24)
        assert verdict(claim) == ("ACCEPTED" if e < 0 else "outer")
        assert e < 0 or {verdict(proved(claim)), verdict(with_uniform_trees(claim, 8))} == {"outer"}


@pytest.mark.parametrize("share", slow_after(1, [0.0, 1e-12, 1e-6, 0.01, 0.3]))
@pytest.mark.parametrize("tree", ["root", "pole", "both", "nothing times a pole"])
def test_a_function_that_is_undefined_beyond_the_ellipsoid_is_refused(tree: str, share: float) -> None:
    """A hole of N at x^2 = a: where it ends within {V < c2} the claim is true, and beyond that it is not."""
    for a, holds in ((0.25 * (1 + share), False), (0.25 * (1 - max(share, 0.05)), True)):
        gap = ["-", SQUARE, str(Fraction(a))]
        N = {
            "root": ["sqrt", gap], "pole": ["-", ["/", "1", gap]], "both": ["-", ["/", "1", ["sqrt", gap]]],
            "nothing times a pole": ["+", SQUARE, ["*", "0", ["/", "1", gap]]],
        }[tree]  # fmt: skip
        level = {"root": 1.2, "pole": -0.4, "both": -0.6, "nothing times a pole": 2.0}[tree]
        claim = with_outer(saturated(), expression(N, level), max_leaves=60, depth=40)
        assert verdict(claim) == ("ACCEPTED" if holds else "outer")
        assert holds or {verdict(proved(claim)), verdict(with_uniform_trees(claim, 7))} == {"outer"}


@pytest.mark.parametrize("at", ["3/4", "1", "2/3", "3/2"])
def test_a_pole_of_the_loop_beyond_the_ellipsoid_is_refused(at: str) -> None:
    """Where a leaf ends at it as well: leaves are closed. x' = -x - (x^3/10^6) / (x - pole)^2 falls everywhere else."""
    pole = ["/", ["**", "x", 3], ["*", "1000000", ["**", ["-", "x", at], 2]]]
    data = scalar(["-", ["+", ["-", "x"], UNUSED], pole], 0.0625, domain=[("-2", "2")])
    claim = with_outer(data, expression(SQUARE, 3.0), max_leaves=60, depth=40)
    assert verdict(stripped(claim)) == "ACCEPTED"
    assert {verdict(trees) for trees in (claim, proved(claim), with_uniform_trees(claim, 7))} == {"outer"}


# -------------------------------------------------------------------------------------- huge, tiny, as good as singular


@pytest.mark.parametrize("power", slow_after(1, [-300, -100, 0, 100, 150]))
def test_states_of_any_size(power: int) -> None:
    """x' = -x + x^3/s^2 attracts |x| < s; whatever can be told in binary64 is the truth."""
    s = Fraction(2) ** power
    data = scalar(
        ["+", ["-", "x"], ["/", ["**", "x", 3], str(s**2)], "u"], float(s * s / 16), domain=[(str(-2 * s), str(2 * s))]
    )
    functions = (
        (SQUARE, lambda share: share * share * float(s * s)),
        (["*", str(1 / s), ["sqrt", SQUARE]], lambda share: share),
        (["/", SQUARE, str(s**2)], lambda share: share * share),
    )
    for share, (N, value) in itertools.product((0.95, 1.0, 1.001, 1.5), functions):
        claim = with_outer(data, expression(N, value(share)), T=[[2.0 ** (power // 2)]], max_leaves=60, depth=16)
        found = verdict(claim)
        assert found != "ACCEPTED" or share < 1
        assert found == "ACCEPTED" or share >= 1 or abs(power) > 100


@pytest.mark.parametrize("skew", slow_after(3, [1e-3, 1e-6, 1e-9, 1e-12, 2.0**-52, 0.0]))
def test_coordinates_as_good_as_singular(skew: float) -> None:
    """A linear loop whose N falls, or not by a few percent, in coordinates whose axes are as good as parallel."""
    A = np.array([[-1.0, 0.5], [-0.5, -1.5]])
    for end, holds in ((1.2, True), (1.9, False)):
        M = np.diag([1 + end, 1 - end / 2])
        rows = [
            ["+", *(["*", str(Fraction(v)), x] for v, x in zip(row, "xy", strict=True)), UNUSED] for row in A.tolist()
        ]
        data = planar(rows, [[0.0, 0.0]], np.eye(2), 0.25)
        T = np.array([[1.0, 1.0], [1.0, 1.0 + skew]])
        if not skew:
            assert verdict(stated(data, expression(quadratic(M), 0.5), T, [9.0, 9.0])) in ("faces", "outer")
            continue
        claim = with_outer(data, expression(quadratic(M), 0.15), T=T, max_leaves=500, depth=30)
        assert holds or verdict(claim) in REFUSED
        assert verdict(edited(claim, "evidence.outer.root", encode([9.0, 9.0]))) in REFUSED


def test_a_level_next_to_zero_and_the_smallest_numbers() -> None:
    """N = 0 on a face is above -2^-1074 and not above 0, and models say so only as far as they round."""
    data = scalar(["+", ["-", "x"], "u"], 0.0625, domain=[("-1", "1")])
    for tree in (["-", SQUARE, "1"], ["*", "0", "x"], "0", ["-", "x", "x"]):
        for level in (0.0, 2.0**-1074, 2.0**-1022, 1e-300):
            assert verdict(stated(data, expression(tree, level))) == "faces"
        assert verdict(with_outer(data, expression(tree, -1e-9), max_leaves=100)) == "ACCEPTED"
    for W in (2.0**-1074, 2.0**-600, 0.0):
        for level in (0.0, W):
            assert verdict(stated(data, network([([[W]], [0.0])], level))) == "faces"


@pytest.mark.parametrize("size", slow_after(1, [1e100, 1e200, 1e307]))
def test_weights_that_overflow(size: float) -> None:
    data = saturated()
    for layers in ([([[size], [-size]], [0.0, size]), ([[size, size]], [0.0])], [([[size]], [-size])],
                   [([[1.0]], [0.0]), ([[size]], [0.0]), ([[-size]], [size])]):  # fmt: skip
        for level in (0.0, -size, size, 1.0):
            claim = with_outer(data, network(layers, level), max_leaves=100, depth=10)
            assert verdict(claim) != "ACCEPTED" or refutation(claim) is None


def test_a_leaf_in_the_place_of_any_subtree_changes_nothing_that_is_false() -> None:
    """Each subtree of a tree for a claim that is false by little, and of a true one: coarser trees prove no more."""
    for name, level in (("square", 3.7), ("van der Pol", None)):
        data = base(name)
        if level is not None:
            data = edited(data, "claim.outer.level", level.hex())
            data = with_outer(stripped(data), data["claim"]["outer"], max_leaves=40)
        tree = unpacked(data["evidence"]["outer"]["tree"])
        for k in range(0, len(tree), 5):
            end, open_ = k, 1
            while open_:
                open_ += -1 if tree[end] == LEAF else 1
                end += 1
            coarse = edited(data, "evidence.outer.tree", packed(tree[:k] + bytes([LEAF]) + tree[end:]))
            found = verdict(coarse)
            assert found in (("outer",) if level is not None else ("outer", "ACCEPTED"))
