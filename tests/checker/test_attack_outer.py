"""Attacks on rules `faces` and `outer` with numbers of any magnitude: what they compute on boxes, against exact truth.

The searches of test_outer_attack.py stay where a loop could be. These do not: weights, boxes, coordinates, levels and
ends of domains from the smallest to the largest of binary64, with zeros of both signs, differences that cancel and
products that underflow before something large multiplies them. What is affine or quadratic is decided in rationals;
a network and its derivative in balls of more bits than the numbers span. Trees are of chance, and so are their boxes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

from certify.checker.boxes import batches, middle
from certify.checker.case import Case
from certify.checker.networks import Affine, Network
from certify.checker.outer import Beyond, Dual, InRows, _above, _below
from tests.checker.test_cubic_attack import sizes
from tests.support.certificates import LEAF, Document, edited, encode, make, parse, verdict
from tests.support.leaves import least
from tests.support.outer import expression, stated
from tests.support.outer_loops import PLAIN, scalar
from tests.support.plain import Taylor, affine, chain, form, function_of, layers, slope_of_tanh

Array = np.ndarray
Generator = np.random.Generator
BITS = 2600  # more than from the smallest binary64 number to the product of two of the largest
LIMITS = (-323.0, -308.0, -290.0, -155.0, -150.0, 0.0, 0.0, 0.0, 100.0, 150.0, 154.0, 300.0)  # where squares underflow


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    """As in `rules.check`: overflow becomes infinity or NaN."""
    with np.errstate(all="ignore"), ctx.workprec(BITS):
        yield


def of_any_size(generator: Generator, *shape: int, widest: tuple[float, float] = (-320, 300)) -> Array:
    """Numbers of one magnitude or of many, some of them 0 or -0."""
    powers = (
        generator.uniform(-2, 2, shape),
        generator.uniform(*widest) + generator.uniform(-1, 1, shape),
        generator.uniform(*widest, shape),
        generator.uniform(-20, 20, shape),
        generator.choice(LIMITS, shape) + generator.uniform(-0.5, 0.5, shape),
    )[generator.integers(5)]
    size = generator.uniform(1, 9.9, shape) * 10.0 ** np.clip(powers, *widest)
    zero = generator.random(shape) < 0.08
    return np.where(zero, generator.choice([0.0, -0.0], shape), generator.choice([-1.0, 1.0], shape) * size)


def symbols(generator: Generator, count: int, corner: bool) -> list[float]:
    return (generator.choice([-1.0, 1.0], count) if corner else generator.uniform(-1, 1, count)).tolist()


def exactly(numbers: Any) -> list[Fraction]:
    return [Fraction(v) for v in np.asarray(numbers).tolist()]


def is_finite(*parts: Any) -> bool:
    return all(bool(np.all(np.isfinite(part))) for part in parts)


# ---------------------------------------------------------------------------------------------------- boxes and domains


def case_of_chance(generator: Generator) -> tuple[Beyond, Array, Array]:
    """A plant, T and P of any size, and boxes, one of which ends within a few roundings of its domain and another of
    {V < c2}; no rule need hold."""
    n = int(generator.integers(1, 4))
    T, half = of_any_size(generator, n, n), generator.normal(size=(n, n))
    if generator.random() < 0.6:
        T = generator.normal(size=(n, n)) * 10.0 ** generator.uniform(-3, 3, n)
    if generator.random() < 0.4:  # so that nothing is lost between the coordinates
        T, half = np.diag(np.diag(T)), np.diag(np.diag(half))
    P = half @ half.T * 10.0 ** generator.choice([0, 0, -200, 200, -300])
    least = np.maximum(np.linalg.norm(T, axis=0), 1e-300)[:, None]
    centre = generator.uniform(-1, 1, (n, 6)) / least * 10.0 ** generator.uniform(-2, 2)
    if generator.random() < 0.4:
        centre = of_any_size(generator, n, 6)
    radius = np.abs(centre) * 10.0 ** generator.uniform(*((-16, 1), (-3, 0))[generator.integers(2)])
    lo, hi = centre - radius, centre + radius
    good = np.all(np.isfinite(lo) & np.isfinite(hi), axis=0)
    lo, hi = lo[:, good], hi[:, good]
    domain = []
    for low, high in np.abs(of_any_size(generator, n, 2)).tolist():
        k = int(generator.integers(1, 10**6))
        domain.append([-Fraction(low or 1.0) * Fraction(k + 1, k), Fraction(high or 1.0) * Fraction(k, k + 1)])
    if lo.size:
        axis, near = int(generator.integers(n)), 1 + Fraction(int(generator.integers(-8, 9)), 2**55)
        low, high = spread(exactly(T[axis]), list(zip(exactly(lo[:, 0]), exactly(hi[:, 0]), strict=True)))
        if low > 0:
            domain[axis][1] = low * near
        elif high < 0:
            domain[axis][0] = high * near
    data: Document = make(
        [["-", name] for name in "xyz"[:n]], [(np.zeros((1, n)), [0.0])], np.eye(n), (1.0, 1.0),
        states=tuple("xyz"[:n]), domain=[(str(low), str(high)) for low, high in domain], **PLAIN,
    )  # fmt: skip
    data = stated(edited(data, "lyapunov.P", encode((P + P.T) / 2)), expression("x", 0.0), T, np.ones(n))
    level = float(abs(of_any_size(generator, 1)[0])) or 1.0
    if lo.size and generator.random() < 0.8:
        most = float(Beyond(Case(parse(data))).levels(lo, hi)[1][-1]) * (1 + 2.0**-52 * generator.integers(-3, 4))
        level = most if 0 < most < np.inf else level
    return Beyond(Case(parse(edited(data, "levels.roa", level.hex())))), lo, hi


def spread(row: list[Fraction], box: list[tuple[Fraction, Fraction]]) -> list[Fraction]:
    """The least and the largest of a row times what lies in a box."""
    pairs = [(w * a, w * b) for w, (a, b) in zip(row, box, strict=True)]
    return [sum(map(of, pairs), Fraction(0)) for of in (min, max)]


@sizes(60, 6000)
def test_what_is_known_of_a_box_is_so_exactly(count: int) -> None:
    """That it lies outside of the domain, that V < c2 on it, the forms of x, and V - c2 as a model."""
    met: Counter[str] = Counter()
    for seed in range(count):
        generator = np.random.default_rng([1, seed])
        beyond, lo, hi = case_of_chance(generator)
        n, c2 = beyond.n, Fraction(beyond.c.c2)
        T, P = ([exactly(row) for row in matrix] for matrix in (beyond.T, beyond.c.P))
        centre, radius = middle(lo, hi)
        found = beyond.states(centre, radius)
        x, error = np.moveaxis(found.value, 0, 1), found.error.top
        outside, below = beyond.is_outside(found), beyond.levels(lo, hi)[1] < beyond.c.c2
        gap = Taylor.of(beyond.gap(centre, radius, beyond.c.c2, -1.0))

        def states(z: Sequence[Fraction], T: Any = T) -> list[Fraction]:
            return [sum((t * v for t, v in zip(row, z, strict=True)), Fraction(0)) for row in T]

        def V(z: Sequence[Fraction], states: Any = states, P: Any = P) -> Fraction:
            at = states(z)
            return sum((p * v * w for row, v in zip(P, at, strict=True) for p, w in zip(row, at, strict=True)),
                       Fraction(0))  # fmt: skip

        for k in range(lo.shape[1]):
            ends = list(zip(exactly(lo[:, k]), exactly(hi[:, k]), strict=True))
            if outside[k]:
                met["outside"] += 1
                reach = [spread(row, ends) for row in T]
                pairs = zip(reach, beyond.c.domain, strict=True)
                assert any(most < least or low > high for (low, most), (least, high) in pairs), seed
            if not is_finite(centre[:, k], radius[:, k]):
                continue
            for corner in (True, True, False):
                d = exactly(symbols(generator, n, corner))
                z = [c + r * s for c, r, s in zip(exactly(centre[:, k]), exactly(radius[:, k]), d, strict=True)]
                for own, wrong, value in zip(x[:, :, k], error[:, k], states(z), strict=True):
                    if is_finite(own, wrong):
                        met["form"] += 1
                        first, *slopes = exactly(own)
                        said = first + sum((g * s for g, s in zip(slopes, d, strict=True)), Fraction(0))
                        assert abs(value - said) <= Fraction(float(wrong)), seed
                if below[k]:
                    met["below"] += 1
                    assert V([min(max(v, a), b) for v, (a, b) in zip(z, ends, strict=True)]) < c2, seed
                if is_finite(gap.c[k], gap.g[:, k], gap.Q[:, :, k], gap.r[k]):
                    met["gap"] += 1
                    g, Q = exactly(gap.g[:n, k]), [exactly(row) for row in gap.Q[:n, :n, k]]
                    said = Fraction(float(gap.c[k])) + sum((v * s for v, s in zip(g, d, strict=True)), Fraction(0))
                    said += sum((Q[i][j] * d[i] * d[j] for i in range(n) for j in range(n)), Fraction(0))
                    assert abs(V(z) - c2 - said) <= Fraction(float(gap.r[k])), seed
    assert all(met[what] > count / 4 for what in ("outside", "form", "below", "gap"))


@sizes(200, 20000)
def test_ends_of_faces_are_the_nearest_on_the_right_side(count: int) -> None:
    """Of rationals of 1 to 1,600 bits above and below the line."""
    generator, finite = np.random.default_rng(2), 0
    for _ in range(count):
        above, below = (int.from_bytes(generator.bytes(int(generator.integers(1, 200))), "little") for _ in "ab")
        q = Fraction(above * int(generator.choice([-1, 1])), below | 1)
        if generator.random() < 0.3:
            near = float(of_any_size(generator, 1)[0])
            q = Fraction(near) + Fraction(int(generator.integers(-1, 2)), 10 ** int(generator.integers(1, 700)))
        for end, sign in ((_below(q), 1), (_above(q), -1)):
            if np.isfinite(end):
                finite += 1
                assert (q - Fraction(end)) * sign >= 0
                beyond = float(np.nextafter(end, sign * np.inf))
                assert not np.isfinite(beyond) or (q - Fraction(beyond)) * sign < 0
            else:
                assert abs(q) > Fraction(float(np.finfo(float).max)) and end * sign < 0
    assert finite > count / 4


@sizes(80, 8000)
def test_leaves_of_any_tree_cover_its_box(count: int) -> None:
    """Boxes as wide as binary64 and as narrow as two of its neighbours, asked at corners of leaves too."""
    for seed in range(count):
        generator = np.random.default_rng([3, seed])
        n = int(generator.integers(1, 4))
        lo, hi = -np.abs(of_any_size(generator, n)), np.abs(of_any_size(generator, n))
        if generator.random() < 0.3:
            hi = np.nextafter(lo, np.inf)
        tree, waiting = bytearray(), 1
        while waiting:
            splits = len(tree) < 120 and generator.random() < 0.55
            tree.append(int(generator.integers(n)) if splits else LEAF)
            waiting += 1 if splits else -1
        found = list(batches(bytes(tree), lo, hi, int(generator.integers(1, 9))))
        lower, upper = (np.concatenate([batch[k] for batch in found], axis=1) for k in (1, 2))
        assert lower.shape[1] == tree.count(LEAF)
        leaves = [(exactly(c), exactly(r)) for c, r in zip(*(v.T for v in middle(lower, upper)), strict=True)]
        for _ in range(10):
            point = []
            for i in range(n):
                share = Fraction(generator.uniform())
                inner = Fraction(float(lo[i])) * (1 - share) + Fraction(float(hi[i])) * share
                some = Fraction(float(generator.choice(np.concatenate([lower[i], upper[i]]))))
                point.append(min(max(some if generator.random() < 0.4 else inner, Fraction(lo[i])), Fraction(hi[i])))
            assert any(
                all(abs(p - c) <= r for p, c, r in zip(point, centre, radius, strict=True)) for centre, radius in leaves
            ), seed


# --------------------------------------------------------------------------------------------------------- the networks


def network_of_chance(generator: Generator) -> tuple[Network, Array, Array]:
    """A network and a box of its n states, centre and radius; half of the boxes reach where its tanhs bend."""
    n, depth = (int(v) for v in generator.integers(1, 4, 2))
    widths = [n, *generator.integers(1, 4, depth - 1).tolist(), 1]
    weights, biases = [], []
    for columns, rows in pairwise(widths):
        W, b = of_any_size(generator, rows, columns), of_any_size(generator, rows)
        if generator.random() < 0.5:
            b = np.zeros(rows)
        if rows > 1 and generator.random() < 0.4:  # two units that cancel in the next layer, or nearly
            W[1], b[1] = -W[0] * (1 + generator.choice([0, 2.0**-52, 1e-9])), -b[0]
        weights.append(W)
        biases.append(b)
    centre, radius = of_any_size(generator, n), np.abs(of_any_size(generator, n))
    if generator.random() < 0.5:
        centre = centre / (np.max(np.abs(weights[0] @ centre)) + 1e-300)
        radius = radius / (np.max(np.abs(weights[0]) @ radius) + 1e-300) * generator.choice([1e-12, 1e-3, 1, 10])
        biases[0] = generator.choice([0, 1, 2]) * generator.normal(size=len(biases[0]))
    return chain(weights, biases), centre, radius


class Kept(InRows):
    """Keeps the models of all layers."""

    def __init__(self) -> None:
        self.layers: list[Taylor] = []

    def affine(self, step: Affine, v: Dual) -> Dual:
        made = super().affine(step, v)
        self.layers.append(Taylor.of(made.value))
        return made


def value_of_model(model: Taylor, d: Sequence[arb], row: int | None = None) -> arb | None:
    """Of one in a batch of one, without its remainder; None where it is not finite."""
    at: Any = (0,) if row is None else (row, 0)
    c, g, Q, r = model.c[at], model.g[(..., *at)], model.Q[(..., *at)], model.r[at]
    if not is_finite(c, g, Q, r):
        return None
    value = arb(float(c)) + sum((arb(v) * s for v, s in zip(g.tolist(), d, strict=False)), arb(0))
    for own, s in zip(Q.tolist(), d, strict=False):
        value += s * sum((arb(v) * t for v, t in zip(own, d, strict=False) if v), arb(0))
    return value


@sizes(50, 10000)
def test_networks_of_any_size_lie_in_their_models(count: int) -> None:
    """Every layer, N's least value by lines, and N'F for an F whose symbols are more than those of the box."""
    met: Counter[str] = Counter()
    closest = 0.0
    for seed in range(count):
        generator = np.random.default_rng([4, seed])
        network, centre, radius = network_of_chance(generator)
        function = function_of(network)
        n = len(centre)
        error = np.abs(of_any_size(generator, n)) * generator.choice([0, 0, 1e-16, 1e-3])
        if not is_finite(centre, radius, error):
            continue
        all_symbols = n + int(generator.integers(1, 3))
        x = np.concatenate([centre[:, None], np.diag(radius)], axis=1)[:, :, None]
        box = form(x, error[:, None])
        lowest = float(least(function, box)[0])
        states = [affine(own[0], own[1:], e) for own, e in zip(x, error[:, None], strict=True)]
        sized = [of_any_size(generator, n, *shape, 1, widest=(-20, 20))
                 for shape in ((), (all_symbols,), (all_symbols, all_symbols))]  # fmt: skip
        F = [Taylor(c, g, Q, np.zeros(1)) for c, g, Q in zip(*sized, strict=True)]
        both = function.along([v.model for v in states], [f.model for f in F])
        assert both.rate is not None
        rise, kept = Taylor.of(both.rate), Kept()
        (last,) = kept.entries(*[*function.tape.calls.values()], [Dual(v.model) for v in states])
        models = kept.layers
        assert np.array_equal(last.value.p, both.value.p, equal_nan=True)
        for corner in (True, True, False):
            d = [arb(v) for v in symbols(generator, all_symbols, corner)]
            off = [arb(v) for v in generator.choice([-1.0, 0.0, 1.0], n).tolist()]
            h = [arb(c) + arb(r) * s + arb(e) * o for c, r, e, s, o in
                 zip(centre.tolist(), radius.tolist(), error.tolist(), d[:n], off, strict=True)]  # fmt: skip
            y = [value_of_model(f, d) for f in F]
            checked = []
            for k, (W, b) in enumerate(layers(network)):
                if k:
                    h = [v.tanh() for v in h]
                    y = [(1 - t * t) * v for t, v in zip(h, y, strict=True)]
                y = [sum((arb(w) * v for w, v in zip(row, y, strict=True)), arb(0)) for row in W.tolist()]
                h = [sum((arb(w) * v for w, v in zip(row, h, strict=True)), arb(bias))
                     for row, bias in zip(W.tolist(), b.tolist(), strict=True)]  # fmt: skip
                checked += [("layer", models[k], i, v) for i, v in enumerate(h)]
            for what, model, row, value in (*checked, ("rise", rise, None, y[0])):
                said = value_of_model(model, d[: len(model.g)], row)
                if said is not None:
                    met[what] += 1
                    most = arb(float(model.r[0] if row is None else model.r[row, 0]))
                    assert abs(value - said) <= most, seed
                    closest = max(closest, float(abs(value - said) / most)) if most > 0 else closest
            assert lowest < np.inf or np.isnan(lowest)
            if np.isfinite(lowest):
                met["least"] += 1
                assert h[0] >= arb(lowest), seed
                # of the level beside N, and what underflows, which both bounds make up for
                rounding = 2.0**-46 * float((both.value.size.top + np.abs(both.value.c))[0]) + 2.0**-1000
                below = float(np.nextafter(lowest - rounding, -np.inf))
                assert not np.isfinite(below) or function.is_above(box, below)[0], seed
            assert not function.is_above(box, float(np.nextafter(float(h[0]), np.inf)))[0], seed
    assert 0.9 < closest <= 1 and all(met[what] > count / 2 for what in ("layer", "rise", "least"))


@sizes(400, 20000)
def test_the_slope_of_tanh_at_any_size(count: int) -> None:
    for seed in range(count):
        generator = np.random.default_rng([5, seed])
        c, radius = float(of_any_size(generator, 1)[0]), float(np.abs(of_any_size(generator, 1))[0])
        if seed % 2:
            c, radius = float(generator.uniform(-6, 6)), float(10.0 ** generator.uniform(-18, 2))
        phi = slope_of_tanh(c, radius)
        (f0, f1, f2), (e0, e1, e2) = ([arb(float(v)) for v in part[:3]] for part in (phi.f, phi.e))
        for share in (1.0, -1.0, float(generator.uniform(-1, 1))):
            D = arb(radius) * arb(share)
            left = abs(1 - (arb(c) + D).tanh() ** 2 - f0 - f1 * D - f2 * D * D)
            assert left <= e0 + e1 * abs(D) + e2 * D * D + arb(float(phi.third)) * abs(D) ** 3, seed


# ------------------------------------------------------------------------------------------------------ whole documents


UNBOUNDED: tuple[Any, ...] = (
    "x", ["tanh", "x"], ["atan", "x"], ["/", "-1", "x"], ["exp", ["-", "x"]], ["sin", "x"], ["*", "0", "x"],
)  # fmt: skip


@pytest.mark.parametrize("zeros", [320, 1000])
@pytest.mark.parametrize("tree", UNBOUNDED, ids=str)
def test_a_domain_beyond_binary64_is_refused_by_whatever_depends_on_it(zeros: int, tree: Any) -> None:
    size = "1" + "0" * zeros
    data = scalar(["+", ["-", "x"], "u"], domain=[("-" + size, size)])
    claim = stated(data, expression(tree, -3.0), [[2.0**1000]], [1e300])
    assert verdict(claim) in ("faces", "outer")
