"""Attacks on steps of kind `product`: bounds of second order and whole programs against Arb, at all magnitudes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

from certify.checker import ball
from certify.checker.calls import enclose
from certify.checker.elementary import lines_around_product
from certify.checker.expression import parse
from certify.checker.jets import Units
from certify.checker.near import Above, Form
from certify.checker.network import OnBoxes
from certify.checker.networks import Affine, Map, Network, Step
from certify.checker.wiring import Concat, Observe, Product, Sum
from certify.reference.affine import OnBoxes as Theirs
from certify.reference.affine import moved_together
from certify.reference.model import Model
from certify.reference.tangents import OnBall as Tangents
from tests.checker.test_attack_networks import Truths
from tests.checker.test_networks import a_jet
from tests.reference.test_networks import read
from tests.support.marks import slow_after

Array = Any
SCALES = [0.0, 5e-324, 1e-300, 1e-160, 1e-30, 1.0, 1e30, 1e160, 1e300]


@pytest.fixture(autouse=True)
def many_digits() -> Any:
    before, ctx.prec = ctx.prec, 2500
    yield
    ctx.prec = before


def drawn(rng: Any, shape: tuple[int, ...], scale: float) -> Array:
    with np.errstate(all="ignore"):
        return np.nan_to_num(rng.normal(size=shape) * rng.choice([0.0, 1.0, 1.0], size=shape) * scale)


@pytest.mark.parametrize("one", SCALES)
@pytest.mark.parametrize("other", SCALES)
def test_products_of_second_order_lie_between_their_lines(one: float, other: float) -> None:
    rng = np.random.default_rng([SCALES.index(one), SCALES.index(other)])
    for _ in range(20):
        V, W = (drawn(rng, (4, 1, 1), scale) for scale in (one, other))
        if rng.random() < 0.5 and one > 0 and other > 0:
            with np.errstate(all="ignore"):
                W = np.nan_to_num(V * (other / one) * (1 + rng.choice([0.0, 1e-9, 0.3]) * rng.normal(size=V.shape)))
        V[0] = W[0] = 0.0
        v, w = (abs(drawn(rng, (1, 1), scale * rng.choice([0.0, 1e-3, 1.0]))) for scale in (one, other))
        with np.errstate(all="ignore"):
            m, gap = lines_around_product(Form(V), Above(v), Form(W), Above(w), False)
            center, top = float(m[0, 0]), float(gap.top[0, 0])
        X, Y = ([arb(float(c)) for c in part[1:, 0, 0]] for part in (V, W))
        least, most = moved_together(X, arb(float(v[0, 0])), Y, arb(float(w[0, 0])), False)
        for d in np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T:
            for s, t in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                x = sum((c * arb(float(e)) for c, e in zip(X, d, strict=True)), s * arb(float(v[0, 0])))
                y = sum((c * arb(float(e)) for c, e in zip(Y, d, strict=True)), t * arb(float(w[0, 0])))
                assert not (np.isfinite(center) and np.isfinite(top) and abs(x * y - arb(center)) > arb(top))
                assert not x * y > most and not -(x * y) > least


def test_what_is_not_finite_bounds_nothing() -> None:
    V, W = np.zeros((2, 3, 1)), np.ones((2, 3, 1))
    W[0] = V[0] = 0.0
    V[1, :, 0] = [np.inf, np.nan, 1.0]
    for same in (True, False):
        with np.errstate(all="ignore"):
            m, gap = lines_around_product(Form(V), Above(np.zeros((3, 1))), Form(W), Above(np.zeros((3, 1))), same)
        finite = np.isfinite(m[:, 0]) & np.isfinite(gap.top[:, 0])
        assert finite.tolist() == [False, False, True]
    with np.errstate(all="ignore"):
        _, gap = lines_around_product(
            Form(V[:, 2:]), Above(np.full((1, 1), np.nan)), Form(W[:, 2:]), Above(np.zeros((1, 1))), False
        )
    assert not np.isfinite(gap.top[0, 0])


def test_a_square_is_not_negative_and_a_difference_has_little_of_its_own() -> None:
    g = np.array([0.0, 1.0, -2.0])[:, None, None]
    none = Above(np.zeros((1, 1)))
    m, gap = lines_around_product(Form(g), none, Form(g), none, True)
    assert (float(m[0, 0]), float(gap.top[0, 0])) == (pytest.approx(4.5), pytest.approx(4.5))
    m, gap = lines_around_product(Form(g), none, Form(-3 * g), none, False)
    assert (float(m[0, 0]), float(gap.top[0, 0])) == (pytest.approx(-13.5), pytest.approx(13.5))
    crossed = np.array([0.0, 2.0, 1.0])[:, None, None]
    m, gap = lines_around_product(Form(g), none, Form(crossed), none, False)
    assert abs(float(m[0, 0])) + float(gap.top[0, 0]) <= 9.0 + 1e-9


def program(rng: Any, gain: float) -> Network:
    """Random steps with many products, of vectors of one entry, of themselves, behind each other."""
    steps, sizes = list[Step](), [2]

    def add(step: Step) -> int:
        steps.append(step)
        sizes.append(step.size)
        return len(steps)

    for _ in range(int(rng.integers(3, 8))):
        i = int(rng.integers(max(0, len(sizes) - 2), len(sizes)))
        kind = rng.choice(["affine", "map", "product", "product", "product", "sum"])
        fits = [j for j, size in enumerate(sizes) if size == sizes[i] or 1 in (size, sizes[i])]
        j = int(rng.choice(fits))
        if kind == "affine":
            rows = int(rng.choice([1, 1, 3]))
            add(Affine((i,), rows, rng.normal(size=(rows, sizes[i])) * gain, rng.normal(size=rows) * gain))
        elif kind == "map":
            add(Map((i,), sizes[i], str(rng.choice(["tanh", "relu", "sigmoid"]))))
        elif kind == "product":
            pair = (i, i) if rng.random() < 0.3 else (i, j) if rng.random() < 0.5 else (j, i)
            add(Product(pair, max(sizes[k] for k in pair)))
        elif sizes[i] == sizes[j]:
            add(Sum((i, j), sizes[i]))
    loose = set(range(len(sizes) - 1)) - {k for step in steps for k in step.of}
    for k in sorted(loose):
        add(Concat((k, len(steps)), sizes[k] + sizes[-1]))
    add(Affine((len(steps),), 2, rng.normal(size=(2, sizes[-1])), np.zeros(2)))
    return Network("net", 2, tuple(steps))


@pytest.mark.parametrize("seed", slow_after(40, range(120)))
def test_programs_of_products_lie_within_both_enclosures(seed: int) -> None:
    """Without a tolerance, at corners and within, from numbers that underflow to numbers that overflow."""
    rng = np.random.default_rng(seed)
    gain = float(10.0 ** rng.choice([0, 0, 0, -80, 60]))
    net, radius = program(rng, gain), 10.0 ** rng.uniform(-8, 1)
    x = np.concatenate([rng.normal(size=(1, 2, 1)), rng.normal(size=(2, 2, 1)) * radius])
    doubt = np.abs(rng.normal(size=(2, 1))) * radius * rng.choice([0.0, 0.1])
    with np.errstate(all="ignore"):
        u = enclose(net, Form(x, Above(doubt)), (0, 1))
    algebra = Theirs(1)
    rows = [[arb(float(x[k, i, 0])) for k in range(3)] for i in range(2)]
    theirs = algebra.forms(read(net).run(algebra, algebra.given(rows, [[arb(float(v))] for v in doubt[:, 0]])), [0, 1])
    for _ in range(12):
        d = np.sign(rng.normal(size=2)) * rng.random(2) ** rng.choice([0.0, 1.0])
        e = [arb(float(v)) * int(rng.choice([-1, 1])) for v in doubt[:, 0]]
        at = [sum((row[1 + k] * arb(float(d[k])) for k in range(2)), row[0] + e[i]) for i, row in enumerate(rows)]
        for j, value in enumerate(Truths().run(net, at)):
            ours = u.value[:, j, 0]
            if np.all(np.isfinite(ours)):
                form = arb(float(ours[0])) + sum(
                    (arb(float(g)) * arb(float(t)) for g, t in zip(ours[1:], d, strict=True)), arb(0)
                )
                top = float(u.error.top[j, 0])
                assert not np.isfinite(top) or not abs(value - form) > arb(top)
            ((mid, slopes, error),) = theirs[j]
            other = sum((g * arb(float(t)) for g, t in zip(slopes, d, strict=True)), mid)
            assert not abs(value - other) > error


def normalisation(rng: Any, width: int) -> Network:
    """affine, layer normalisation, tanh, affine."""
    W, b = rng.normal(size=(width, 2)), rng.normal(size=width)
    return Network(
        "net",
        2,
        (
            Affine((0,), width, W - W.mean(0), b - b.mean()),
            Product((1, 1), width),
            Affine((2,), 1, np.full((1, width), 1 / width), np.array([1e-5])),
            Observe((3,), 1, ("v",), parse([["/", "1", ["sqrt", "v"]]], ("v",), "here")),
            Product((1, 4), width),
            Map((5,), width, "tanh"),
            Affine((6,), 2, rng.normal(size=(2, width)) / width**0.5, np.zeros(2)),
        ),
    )


@pytest.mark.parametrize("width", [2, 3, 32])
def test_errors_of_a_layer_normalisation_shrink_with_the_square_of_the_box(width: int) -> None:
    rng = np.random.default_rng(width)
    net, x = normalisation(rng, width), rng.normal(size=2)
    errors = []
    for radius in (1e-2, 1e-3):
        form = np.concatenate([x[None], radius * np.eye(2)])[:, :, None]
        u = enclose(net, Form(form, Above(np.zeros((2, 1)))), (0, 1))
        algebra = Theirs(1)
        rows = [[arb(float(form[k, i, 0])) for k in range(3)] for i in range(2)]
        theirs = algebra.forms(read(net).run(algebra, algebra.given(rows)), [0, 1])
        assert np.allclose(u.error.top[:, 0], [float(each[0][2].upper()) for each in theirs], rtol=0.02, atol=1e-12)
        errors.append(u.error.top[:, 0])
    assert np.all(errors[1] < errors[0] / 50)


def test_an_error_passes_a_product_with_the_other_factor() -> None:
    """(x + e) c - c (x + e) is 0, whatever e is, and so is the bound that goes backwards."""
    c = Affine((0,), 1, np.zeros((1, 2)), np.array([3.0]))
    steps = (
        c,
        Product((0, 1), 2),
        Product((1, 0), 2),
        Concat((2, 3), 4),
        Affine((4,), 2, np.hstack([np.eye(2), -np.eye(2)]), np.zeros(2)),
    )
    net = Network("net", 2, steps)
    boxes = OnBoxes(net, Form(np.ones((1, 2, 1)), Above(np.full((2, 1), 0.5))))
    assert np.all(boxes.backwards(np.eye(2)).top < 1e-12)
    algebra = Theirs(1)
    value = read(net).run(algebra, algebra.given([[arb(1)], [arb(1)]], [[arb(0.5)], [arb(0.5)]]))
    assert all(not error > 1e-12 for ((_, _, error),) in algebra.forms(value, [0, 1]))


def chosen(*rows: list[float]) -> list[Step]:
    """For each row an affine step of the argument."""
    return [Affine((0,), 1, np.array([row]), np.zeros(1)) for row in rows]


def test_old_errors_of_products_are_as_long_as_they_are_said_to_be() -> None:
    """A number of [-1/2, 1/2] more in a vector of one entry arrives in all entries at once."""
    c = np.array([3.0, -4.0, 12.0])
    constant = Affine((0,), 3, np.zeros((3, 1)), c)
    for of in ((0, 1), (1, 0)):
        net = Network("net", 1, (constant, Product(of, 3)))
        boxes = OnBoxes(net, Form(np.ones((1, 1, 1)), Above(np.full((1, 1), 0.5))))
        assert boxes.last.ball.top[0] == pytest.approx(6.5) and boxes.last.ball.top[0] >= 6.5
        algebra = Theirs(1)
        value = read(net).run(algebra, algebra.given([[arb(1)]], [[arb(0.5)]]))
        assert not value.length[0] < 6.5 and value.length[0] < 6.6
    pair = Network("net", 3, (Affine((0,), 3, np.eye(3), c), Product((0, 1), 3)))
    boxes = OnBoxes(pair, Form(np.ones((1, 3, 1)), Above(np.full((3, 1), 0.5))))
    most = np.linalg.norm(0.5 * (np.abs(c + 1) + 1))
    assert most <= boxes.last.ball.top[0] < most * 1.001
    algebra = Theirs(1)
    value = read(pair).run(algebra, algebra.given([[arb(1)]] * 3, [[arb(0.5)]] * 3))
    assert not value.length[0] < most * (1 - 1e-15) and value.length[0] < most * 1.001


@pytest.mark.parametrize("seed", range(20))
def test_a_product_on_a_ball_is_that_of_models(seed: int) -> None:
    """Two entries of an argument, with terms of each order and a Lipschitz constant, by a step and by an expression."""
    rng = np.random.default_rng(seed)
    units = Units(np.zeros((2, 2, 0)), np.zeros((0, 0)))
    v, w = (jet * jet + jet.function("sin") for jet, _ in (a_jet(rng, 2, 0.3, units) for _ in range(2)))
    given = [replace(x, lip=x.lip + 0.1) for x in (v, w)]
    net = Network("net", 2, (*chosen([1.0, 0.0], [0.0, 1.0]), Product((1, 2), 1)))
    found, expected = ball.OnBall(2).value(net, given), given[0] * given[1]
    whole = found.remainder[..., 0] + np.tensordot(found.units.U, np.abs(found.B.value[:, 0]), 1)
    assert np.allclose(found.Q.value[..., 0], expected.Q.value, rtol=1e-12, atol=1e-15)
    assert np.allclose(found.K.value[:, 0], expected.K.value, rtol=1e-12, atol=1e-15)
    assert np.allclose(whole, expected.whole.majorant, rtol=1e-9, atol=1e-13)
    assert found.lipschitz.top[0] == pytest.approx(float(expected.lipschitz.top), rel=1e-9)
    assert found.c.value[0] == pytest.approx(float(expected.c.value), rel=1e-14)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("unsure", [0.0, 0.1])
def test_so_it_is_in_the_reference(seed: int, unsure: float) -> None:
    """Where values and gradients are not known exactly, too: an expression may say no less than a step does."""
    rng = np.random.default_rng(seed)
    given = list[Model]()
    for _ in range(2):
        v = Model.affine(arb(float(rng.normal())), [arb(float(t)) for t in rng.normal(size=2) * 0.3], lip=arb(0))
        v = v * v + v.function("sin")
        given.append(replace(v, lip=v.lip and v.lip + 0.1, off=arb(unsure), slack=arb(unsure / 2)))
    net = read(Network("net", 2, (*chosen([1.0, 0.0], [0.0, 1.0]), Product((1, 2), 1))))
    algebra = Tangents(given)
    (found,), _ = algebra.results(net.run(algebra, algebra.first), [0])
    expected = given[0] * given[1]
    for part in ("v", "off", "slack", "lip"):
        assert abs(getattr(found, part) - getattr(expected, part)) < 1e-12
    for part in ("a", "Q", "K", "whole"):
        each = zip(getattr(found, part).entries(), getattr(expected, part).entries(), strict=True)
        assert all(abs(x - y) < 1e-12 for x, y in each)
