"""Third-order models and the inequality on them: what is proved by K, and what each tanh unit leaves out.

Truth is in ball arithmetic or rationals, and what is not certain counts as a failure. Bounds are asked twice: that
nothing crosses them, and that something comes close.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx, fmpq, fmpq_mat

from certify.checker import decrease, local, tube
from certify.checker.ball import Ball
from certify.checker.case import Case
from certify.checker.decrease import Models, Multipliers
from certify.checker.document import Certificate
from certify.checker.exact import exactly
from certify.checker.jets import Jet as Batch
from certify.checker.jets import Units, unpacked
from certify.checker.near import Above, Cubic, Near, Square, Vector, symmetric
from certify.checker.pairs import in_binary64
from certify.checker.smooth import add as add_smooth
from tests.checker.test_ball import curved as every_function
from tests.checker.test_path import linear as along
from tests.checker.test_path import placed
from tests.checker.test_rules import honest
from tests.support.balls import with_ball
from tests.support.certificates import Document, edited, encode, make, parse, verdict
from tests.support.jets import (
    Jet,
    beyond_tangent,
    bound_of_pairs,
    changed,
    constant,
    curved,
    models_of,
    plain,
    remainders,
    seen,
    units_of,
)
from tests.support.marks import slow_after
from tests.support.oracle import policy_in_arb, quadratic, value_of
from tests.support.plain import elementary, layers

Generator = np.random.Generator
JUST = 1 - 2.0**-40
add_smooth()
FUNCTIONS = ["sin", "cos", "tanh", "exp", "atan", "inv", "sqrt"]


def quotient(v: float) -> fmpq:
    return fmpq(*float(v).as_integer_ratio())


def points(generator: Generator, k: int, count: int = 6) -> list[list[float]]:
    """In the unit ball, most of them next to its edge."""
    d = generator.standard_normal((count, k))
    d *= (1 - 2.0**-40) / np.linalg.norm(d, axis=1, keepdims=True)
    return (d * np.resize([1, 1, 1, 0.7, 1e-3, 1e-40], count)[:, None]).tolist()


# -------------------------------------------------------------------------------------------- functions of one variable


def derivatives(name: str, c: arb) -> list[arb]:
    """phi, phi', phi''/2, phi'''/6 and phi''''/24, each by its own formula."""
    if name in ("sin", "cos"):
        s, t = (c.sin(), c.cos()) if name == "sin" else (c.cos(), -c.sin())
        return [s, t, -s / 2, -t / 6, s / 24]
    if name == "tanh":
        t = c.tanh()
        p = 1 - t * t
        return [t, p, -t * p, (6 * t * t - 2) * p / 6, 8 * t * (2 - 3 * t * t) * p / 24]
    if name == "exp":
        return [c.exp() / math.factorial(j) for j in range(5)]
    if name == "atan":
        p = 1 / (1 + c * c)
        return [c.atan(), p, -c * p**2, (6 * c * c - 2) * p**3 / 6, c * (1 - c * c) * p**4]
    if name == "inv":
        return [(-1) ** j / c ** (j + 1) for j in range(5)]
    s = c.sqrt()
    return [s, 1 / (2 * s), -1 / (8 * s**3), 1 / (16 * s**5), -5 / (128 * s**7)]


def value(name: str, v: arb) -> arb:
    return 1 / v if name == "inv" else getattr(v, name)()


@pytest.mark.parametrize("name", FUNCTIONS)
def test_expansions_enclose_their_functions(name: str) -> None:
    """The first four terms at any number within the error, and how far the fourth order goes; none is far too wide."""
    generator, widest, tight = np.random.default_rng(3), 0.0, 0.0
    for _ in range(150):
        c = float(generator.choice([1e-3, 1.0, 8.0]) * generator.standard_normal())
        c = abs(c) if name == "sqrt" else c
        error = float(generator.choice([0.0, 1e-12, 1e-3]) * abs(c))
        radius = float(generator.choice([1e-6, 0.02, 0.4]) * (abs(c) if name in ("inv", "sqrt") else 1.0))
        phi = elementary(name, np.float64(c), error, radius)
        with ctx.workprec(1200):
            for s, r in itertools.product((-1.0, 0.0, 0.9), (-1.0, -0.6, 1e-9, 1.0)):
                at = arb(c) + arb(s) * arb(error)
                terms, D = derivatives(name, at), arb(r) * arb(radius)
                for term, f, e in zip(terms, phi.f, phi.e, strict=False):
                    assert abs(term - arb(float(f))) <= arb(float(e))
                left = abs(value(name, at + D) - sum((t * D**j for j, t in enumerate(terms[:4])), arb(0)))
                bound = arb(float(phi.fourth)) * D**4
                assert left <= bound
                if abs(r) == 1 and radius > 1e-3:
                    tight = max(tight, float((left / bound).mid()))
                if not error:
                    widest = max(
                        widest, *(float(e) / max(1.0, abs(float(f))) for f, e in zip(phi.f, phi.e, strict=True))
                    )
    assert tight > (0.5 if name != "atan" else 0.3)
    assert widest < 1e-12 or name in ("inv", "sqrt")  # these grow without bound as c falls


def test_the_suprema_of_the_format() -> None:
    """Of the fourth and fifth derivatives of tanh, and of the fourth of atan, on all of the line."""
    most = {"tanh4": 0.0, "tanh5": 0.0, "atan4": 0.0}
    with ctx.workprec(80):
        for k in range(-2000, 2000):
            t = (arb(k) + arb("0.5")) / 2000 + arb(0, 1 / 4000)  # t in [-1, 1], in pieces
            v = ((arb(k) + arb("0.5")) / 2000 + arb(0, 1 / 4000)) * arb.pi() / 2  # the angle of atan
            found = {
                "tanh4": 8 * t * (2 - 3 * t * t) * (1 - t * t),
                "tanh5": (16 - 120 * t**2 + 120 * t**4) * (1 - t * t),
                "atan4": 6 * v.cos() ** 4 * (4 * v).sin(),
            }
            for name, limit in (("tanh4", 4.1), ("tanh5", 16.1), ("atan4", 4.7)):
                assert abs(found[name]) <= arb(limit)
                most[name] = max(most[name], float(abs(found[name]).mid()))
    assert most["tanh4"] > 4.08 and most["tanh5"] > 15.9 and most["atan4"] > 4.66


# ----------------------------------------------------------------------------------------------------------------- jets


def random_jet(generator: Generator, k: int, U: np.ndarray, size: float = 1.0) -> Jet:
    def number() -> float:
        return float(size * abs(generator.standard_normal()) * 2.0 ** generator.integers(-12, 1))

    half, root = generator.standard_normal((2, k, k))
    E = root @ root.T * number() * generator.choice([0, 1, 1])
    return Jet(
        np.float64(generator.choice([-1, 1]) * number()), number() * 2.0**-8 * generator.choice([0, 1]),
        generator.standard_normal(k) * number(), number() * 2.0**-8 * generator.choice([0, 1]),
        (half + half.T) * number(), generator.standard_normal(k * (k + 1) * (k + 2) // 6) * number(),
        semidefinite((E + E.T) / 2), generator.standard_normal(len(U)) * number(), U,
        np.zeros(0), np.zeros((0, k)), 0.0,
    )  # fmt: skip


def semidefinite(E: np.ndarray) -> np.ndarray:
    """Matrices that are semidefinite in spite of rounding."""
    trace = np.trace(E, axis1=-2, axis2=-1)
    return np.asarray(E + (2.0**-39 * trace)[..., None, None] * np.eye(E.shape[-1]))


def shares(generator: Generator, m: int, k: int) -> np.ndarray:
    """U of the errors of a family, semidefinite."""
    root = generator.standard_normal((m, k, k)) * 2.0 ** generator.integers(-12, 0, (m, 1, 1))
    return semidefinite(root @ root.swapaxes(1, 2))


class Member:
    """A function that a jet holds, where the errors of its family are these shares of their bounds."""

    def __init__(self, jet: Jet, own: float, common: list[float]) -> None:
        self.jet, self.own, self.common = jet, own, common
        self.c = arb(float(jet.c)) + arb(own) * arb(float(jet.error))
        self.a = [arb(float(v)) for v in jet.a]
        self.a[0] += arb(own) * arb(float(jet.slack))

    def __call__(self, d: list[float]) -> arb:
        linear = sum((p * arb(x) for p, x in zip(self.a, d, strict=True)), self.c)
        return linear + curved(self.jet, d) + known(self.jet, self.common, d) + arb(self.own) * quadratic(self.jet.E, d)


def known(jet: Jet, common: list[float], d: list[float]) -> arb:
    """sum_j B_j e_j."""
    each = zip(jet.B.tolist(), common, jet.U, strict=True)
    return sum((arb(b) * arb(w) * quadratic(U.tolist(), d) for b, w, U in each), arb(0))


def closeness(result: Jet, common: list[float], truth: Any, gradient: list[arb], where: list[list[float]]) -> float:
    """The largest part of E that is used. What is certain to all orders is asserted, the family's errors included."""
    used, at_0 = 0.0, truth([0.0] * len(gradient))
    assert abs(at_0 - arb(float(result.c))) <= arb(float(result.error))
    distance = sum(((p - arb(float(q))) ** 2 for p, q in zip(gradient, result.a, strict=True)), arb(0))
    assert distance <= arb(float(result.slack)) ** 2
    for d in where:
        linear = sum((p * arb(x) for p, x in zip(gradient, d, strict=True)), at_0)
        left = abs(truth(d) - linear - curved(result, d) - known(result, common, d))
        bound = quadratic(result.E, d)
        length = sum((arb(v) ** 2 for v in d), arb(0)).sqrt()
        assert left <= bound, d
        assert abs(truth(d) - at_0) <= arb(float(result.radius)) * length
        used = max(used, float((left / bound).mid()) if bound > 1e-30 else 0.0)
    return used


@pytest.mark.parametrize("size", slow_after(1, [1e-6, 0.02, 0.3]))
def test_operations_know_the_errors_that_their_operands_share(size: float) -> None:
    generator, used = np.random.default_rng(int(size * 1e6)), 0.0
    with ctx.workprec(2500):
        for _ in range(30):
            k, m = 3, 2
            U = shares(generator, m, k) * size
            common = generator.choice([-1.0, 1.0, 0.5, 0.0], m).tolist()
            x, y = random_jet(generator, k, U, size), random_jet(generator, k, U, size)
            v, w = (Member(jet, float(generator.choice([-JUST, JUST, 0.0])), common) for jet in (x, y))
            where = points(generator, k)
            sums = [p + q for p, q in zip(v.a, w.a, strict=True)]
            products = [v.c * q + w.c * p for p, q in zip(v.a, w.a, strict=True)]
            closeness(x + y, common, lambda d, v=v, w=w: v(d) + w(d), sums, where)
            closeness(-x, common, lambda d, v=v: -v(d), [-p for p in v.a], where)
            used = max(used, closeness(x * y, common, lambda d, v=v, w=w: v(d) * w(d), products, where))
            for name in FUNCTIONS:
                jet = changed(x, c=np.float64(abs(x.c) + 12 * size)) if name in ("inv", "sqrt") else x
                f, u = jet.function(name), Member(jet, v.own, common)
                if not np.isfinite(f.E).all():
                    assert name in ("inv", "sqrt")
                    continue
                slope = derivatives(name, u.c)[1]
                truth = lambda d, u=u, name=name: value(name, u(d))  # noqa: E731
                used = max(used, closeness(f, common, truth, [slope * p for p in u.a], where))
    assert used > 0.05


def alone(part: str, generator: Generator, U: np.ndarray) -> Jet:
    """A jet that is 0 but for one of its parts."""
    k = U.shape[1]
    nothing = constant(Fraction(0), U, 0)
    half, root = generator.standard_normal((2, k, k))
    only = {"a": generator.standard_normal(k), "Q": half + half.T, "E": root @ root.T, "B": np.ones(len(U)),
            "K": generator.standard_normal(k * (k + 1) * (k + 2) // 6)}  # fmt: skip
    return changed(nothing, **{part: only[part]})


@pytest.mark.parametrize(("left", "right"), list(itertools.product("aQKEB", repeat=2)))
def test_every_pair_of_parts_has_its_place_in_a_product(left: str, right: str) -> None:
    generator = np.random.default_rng(70)
    with ctx.workprec(2500):
        for _ in range(4):
            U = shares(generator, 1, 2)
            x, y = alone(left, generator, U), alone(right, generator, U)
            v, w = Member(x, JUST, [JUST]), Member(y, JUST, [JUST])
            closeness(x * y, [JUST], lambda d, v=v, w=w: v(d) * w(d), [arb(0)] * 2, points(generator, 2))


@pytest.mark.parametrize("order", [2, 3, 4])
@pytest.mark.parametrize(("left", "right"), list(itertools.combinations_with_replacement("aQKEB", 2)))
def test_every_power_has_its_place_in_what_a_function_adds(order: int, left: str, right: str) -> None:
    """D^2, D^3 or D^4 itself, of two parts of a jet: |D^order - d'H d - C[d]| <= d'R d."""
    generator, used = np.random.default_rng(order), 0.0
    f = [float(j == order) for j in range(4)]
    with ctx.workprec(2500):
        for size in (0.01, 0.3, 1.0, 1.0, 3.0):
            U = shares(generator, 1, 2)
            x, y = alone(left, generator, U), alone(right, generator, U)
            jet = x if left == right else changed(x, **{right: size * getattr(y, right)})
            member = Member(jet, JUST, [JUST])
            H, C, R = beyond_tangent(jet, f, 1.0, float(order == 4))
            for d in points(generator, 2):
                bound = quadratic(R.tolist(), d)
                off = abs(member(d) ** order - curved(plain(0.0, 0.0, jet.a, 0.0, H, R, C), d))
                assert off <= bound, d
                used = max(used, float((off / bound).mid()) if bound > 1e-30 else 0.0)
    assert used > 0.02 or left == right == "a"


@pytest.mark.parametrize("order", [2, 3, 4])
@pytest.mark.parametrize(("slack", "q", "E"), [(0.1, 0.0, 0.0), (0.0, 0.5, 0.0), (0.3, 0.5, 0.0), (0.2, 0.3, 0.4)])
def test_powers_of_one_direction_reach_their_bounds(order: int, slack: float, q: float, E: float) -> None:
    """D^order of D = (1 + slack) d + q d^2 + E d^2 at d = 1."""
    jet = plain(0.0, 0.0, np.array([1.0]), slack, np.array([[q]]), np.array([[E]]))
    H, C, R = beyond_tangent(jet, [float(j == order) for j in range(4)], 1.0, float(order == 4))
    off, bound = (1 + slack + q + E) ** order - H[0, 0] - C[0], R[0, 0]
    assert off <= bound * (1 + 1e-12) and off > 0.99 * bound


def test_a_cube_keeps_the_direction_of_the_gradient() -> None:
    """3 y^2 z of D^3 counts along the gradient, and across it only what is of second order in z."""
    jet = plain(0.0, 0.0, np.array([1.0, 0.0]), 0.0, np.diag([0.0, 1e-6]), np.zeros((2, 2)))
    _, _, R = beyond_tangent(jet, [0.0, 0.0, 0.0, 1.0], 1.0, 0.0)
    assert 2.9e-6 < R[0, 0] < 3.1e-6 and R[1, 1] < 1e-11


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("c", [0.3, -0.8, 1.7])
def test_a_function_of_one_direction_is_bounded_tightly(name: str, c: float) -> None:
    """What is left of phi(c + d/4) is of fourth order, E a few times as large at most, nothing in other directions."""
    c = abs(c) if name == "sqrt" else c
    a = np.array([0.25 if name not in ("inv", "sqrt") else 0.25 * abs(c), 0.0])
    f = plain(np.float64(c), 0.0, a, 0.0, np.zeros((2, 2)), np.zeros((2, 2))).function(name)
    with ctx.workprec(200):
        terms, D = derivatives(name, arb(c)), arb(a[0])
        left = max(
            float(
                abs(
                    value(name, arb(c) + s * D) - sum((t * (s * D) ** j for j, t in enumerate(terms[:4])), arb(0))
                ).mid()
            )
            for s in (-1, 1)
        )
        assert abs(arb(float(f.K[0])) - terms[3] * D**3) < 1e-15 and not f.K[1:].any()
    most = 4.7 / 24 if name == "atan" else 0.0  # of all of the line
    assert left < f.E[0, 0] < 6 * left + 0.2 * float(abs(D).mid()) ** 5 + most * a[0] ** 4 and f.E[1, 1] < 1e-14


def test_errors_that_are_shared_cancel() -> None:
    """v - w, v w - w v and sin(v) - sin(w) of the same errors: nothing is left of them to first order."""
    U = np.array([np.eye(2) * 0.01])
    one = Jet(np.float64(1), 0.0, np.zeros(2), 0.0, np.zeros((2, 2)), np.zeros(4), np.zeros((2, 2)), np.ones(1), U,
              np.zeros(0), np.zeros((0, 2)), 0.0)  # fmt: skip
    assert abs((one + -one).B[0]) == 0 and np.trace((one + -one).whole) < 1e-12
    assert (one + one).B[0] == 2 and np.trace((one + one).E) < 1e-12
    product = one * one
    assert product.B[0] == 2 and 1e-4 < np.trace(product.E) < 3e-4  # the square of the error alone
    assert abs(one.function("sin").B[0] - math.cos(1)) < 1e-14 and np.trace(one.function("sin").E) < 3e-4


def test_a_tensor_is_stored_once() -> None:
    generator = np.random.default_rng(8)
    for k in (1, 2, 3, 5):
        a, Q = generator.standard_normal(k), generator.standard_normal((k, k))
        Q = Q + Q.T
        found = symmetric(Vector(a), Square(Q))
        whole = unpacked(found.value, k)
        truth = sum(np.transpose(np.multiply.outer(a, Q), order) for order in itertools.permutations(range(3))) / 6
        assert np.allclose(whole, truth, rtol=0, atol=1e-14) and whole.shape == (k, k, k)
        size = float(np.linalg.norm(whole))
        assert size <= Cubic(found.value).size.top <= size * (1 + 1e-9)


# --------------------------------------------------------------------------------------------------- networks and loops


def by_hand(squash: str, centre: str, widths: list[int], seed: int, scale: float = 1.0) -> Document:
    """A plant in which inputs act linearly, in a product and in a function, under a random network."""
    generator = np.random.default_rng(seed)
    n, m = widths[0], widths[-1]
    layers = [
        (generator.standard_normal((out, into)) / math.sqrt(into) * 1.4, 0.5 * generator.standard_normal(out))
        for into, out in itertools.pairwise(widths)
    ]
    states, inputs = [f"x{i}" for i in range(n)], [f"u{j}" for j in range(m)]
    pairs = zip(itertools.cycle(inputs), itertools.cycle(reversed(inputs)), strict=False)
    dynamics = [
        ["+", ["-", x], ["*", "1/3", u, ["cos", x]], ["sin", ["/", v, "2"]], ["*", u, v]]
        for x, (u, v) in zip(states, pairs, strict=False)
    ]
    return make(
        dynamics, layers, np.eye(n), (0.01, 0.01), states=states, inputs=inputs, u_eq=["0"] * m,
        domain=[("-3", "3")] * n, input_bounds=[("-9", "9")] * m, squash=squash, centre=centre,
        scale=[scale * (-1.25) ** j for j in range(m)], offset=[0.05] * m,
    )  # fmt: skip


def spied(found: Ball, monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, Any, Any]]:
    """The gradients of the layers' values, each with H and C of what its tanh was said to add."""
    seen: list[tuple[Any, Any, Any]] = []
    before = Batch.beyond_tangent

    def spy(jet: Batch, phi: Any) -> Any:
        H, C, R = before(jet, phi)
        seen.append((jet.a.value.T, np.moveaxis(H.value, -1, 0), C.value.T))
        return H, C, R

    with monkeypatch.context() as patch, np.errstate(all="ignore"):
        patch.setattr(Batch, "beyond_tangent", spy)
        assert found.outputs
    return seen


def layers_in_arb(c: Certificate, x: list[arb]) -> list[list[arb]]:
    """The value of each layer, before its tanh; the last one is centred."""
    layers, at_0 = _layers(c, x), _layers(c, [arb(0)] * len(x))
    if c.policy.centre == "preactivation":
        of = zip(c.u_eq, c.policy.offset.tolist(), c.policy.scale.tolist(), strict=True)
        betas = [((arb(fmpq(q.numerator, q.denominator)) - arb(o)) / arb(s)).atanh() for q, o, s in of]
        layers[-1] = [v - p + beta for v, p, beta in zip(layers[-1], at_0[-1], betas, strict=True)]
    return layers


def _layers(c: Certificate, x: list[arb]) -> list[list[arb]]:
    h, result = x, []
    for number, (W, b) in enumerate(layers(c.policy.network)):
        h = [v.tanh() for v in h] if number else h
        rows = zip(W.tolist(), b.tolist(), strict=True)
        h = [sum((arb(w) * v for w, v in zip(row, h, strict=True)), arb(p)) for row, p in rows]
        result.append(h)
    return result


NETWORKS = [
    (squash, centre, widths)
    for (squash, centre), widths in itertools.product(
        [("tanh", "preactivation"), ("tanh", "output"), ("tanh", "none"), ("identity", "output"), ("identity", "none")],
        [[2, 2], [2, 5, 2], [3, 6, 4, 2]],
    )
]


@pytest.mark.parametrize(("squash", "centre", "widths"), slow_after(4, NETWORKS))
@pytest.mark.parametrize("moving", [False, True])
def test_units_carry_all_that_their_inputs_leave_out(
    squash: str, centre: str, widths: list[int], moving: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unit by unit |e_q| <= d'R_q d; with the true e_q nothing is left of an input but rounding, and of F but E."""
    if centre == "none" and not moving:
        return  # pi(0) is not u_eq
    data, used, of_units = by_hand(squash, centre, widths, len(widths)), 0.0, 0.0
    generator, n = np.random.default_rng(5), widths[0]
    for size in (1e-3, 0.05, 0.3):
        J = size * generator.standard_normal((n, n))
        found = Ball(Case(parse(data)), J, "ball")
        if moving:
            ends = 0.4 * generator.standard_normal((2, n)) * [[1], [size]]
            (found,) = tube.pieces(Case(parse(placed(data, ends[0].tolist(), ends.sum(0).tolist(), 0.5, J))))
        layers = spied(found, monkeypatch)
        with np.errstate(all="ignore"):
            units, inputs, F = found.units, seen(found.inputs), seen(found.F())
        R = remainders(units)
        hidden = len(R) - len(inputs)
        for d in points(generator, n + moving):
            with ctx.workprec(500):
                x, u, errors = at_point(found, layers, d)
                m, u_0, _ = at_point(found, layers, [0.0] * len(d))
                length = sum((arb(v) ** 2 for v in d), arb(0)).sqrt()
                bounds = [quadratic(own.tolist(), d) for own in R]
                assert all(abs(e) <= bound for e, bound in zip(errors[:hidden], bounds, strict=False))
                of_units = max(
                    [of_units, *(share(e, bound) for e, bound in zip(errors[:hidden], bounds, strict=False))]
                )
                beyond = [v - p - linear(jet, d) - curved(jet, d) for v, p, jet in zip(u, u_0, inputs, strict=True)]
                slacks = [arb(float(jet.slack)) * length for jet in inputs]
                for j, (jet, left, slack) in enumerate(zip(inputs, beyond, slacks, strict=True)):
                    carried = zip(units.reach[j].tolist(), errors[:hidden], strict=False)
                    own = arb(abs(float(units.reach[j, hidden + j]))) * bounds[hidden + j]
                    rest = left - sum((arb(p) * e for p, e in carried), arb(0))
                    assert abs(rest) <= slack + quadratic(jet.E, d) + own
                    assert abs(left) <= slack + quadratic(jet.whole, d)
                    assert abs(u_0[j] - arb(float(jet.c))) <= arb(float(jet.error)) + arb(2) ** -400
                truths = (fields(found.case.c, *at) for at in ((x, u), (m, u_0)))
                for f, v, v_0 in zip(F, *truths, strict=True):
                    shared = sum((arb(b) * e for b, e in zip(f.B.tolist(), beyond, strict=True)), arb(0))
                    room = sum((arb(abs(b)) * slack for b, slack in zip(f.B.tolist(), slacks, strict=True)), arb(0))
                    bound = arb(float(f.slack)) * length + quadratic(f.E, d)
                    left = v - v_0 - linear(f, d) - curved(f, d) - shared
                    assert abs(left) <= bound + room
                    used = max(used, share(left, bound))
    assert used > 0.05 and (of_units > 0.1 or len(widths) == 2)


def at_point(found: Ball, layers: list[tuple[Any, Any, Any]], d: list[float]) -> tuple[list[arb], list[arb], list[arb]]:
    """x and pi(x) at a point of the ball, and what each tanh adds there to its tangent beyond its model."""
    c, n = found.case.c, len(found.J)
    m, w = ([Fraction(0)] * n, [Fraction(0)] * n) if found.motion is None else found.motion
    middle, step = ([arb(fmpq(q.numerator, q.denominator)) for q in part] for part in (m, w))
    x = [p + q * arb(d[-1]) + sum((arb(a) * arb(v) for a, v in zip(row, d, strict=False)), arb(0))
         for p, q, row in zip(middle, step, found.J.tolist(), strict=True)]  # fmt: skip
    errors = []
    for (a, H, C), values, at_0 in zip(layers, layers_in_arb(c, x), layers_in_arb(c, middle), strict=False):
        for q, (v, p) in enumerate(zip(values, at_0, strict=True)):
            model = curved(plain(0.0, 0.0, a[q], 0.0, H[q], H[q], C[q]), d)
            errors.append(v.tanh() - p.tanh() - (1 - p.tanh() ** 2) * (v - p) - model)
    return x, policy_in_arb(c.policy, c.u_eq, x), errors


def fields(c: Certificate, x: list[arb], u: list[arb]) -> list[arb]:
    names = dict(zip((*c.states, *c.inputs), (*x, *u), strict=True))
    return [value_of(tree, names) for tree in c.dynamics.trees]


def share(left: arb, bound: arb) -> float:
    """Of the bound, where it is more than rounding."""
    return float((abs(left) / bound).mid()) if bound > 1e-12 else 0.0


def linear(jet: Jet, d: list[float]) -> arb:
    return sum((arb(float(a)) * arb(v) for a, v in zip(jet.a, d, strict=True)), arb(0))


@pytest.mark.parametrize("scale", [5e-324, -(2.0**-1060)])
def test_a_subnormal_scale_of_an_input_that_bends_much_contains(scale: float) -> None:
    found = Ball(Case(parse(every_function())), np.eye(2), "ball")
    net = found.case.net
    found.case.__dict__["net"] = replace(net, scale=np.array([scale, 1.0]))
    Q, flat = np.full((2, 2, 2), 2.0**500 / 3), np.zeros((2, 2, 2))
    found.__dict__["outputs"] = Batch(
        Near(np.zeros(2)), Vector(np.zeros((2, 2))), Square(Q), Cubic(np.zeros((4, 2))), Square(flat),
        Near(np.full((1, 2), 2.0**-20)), Units(np.full((2, 2, 1), 2.0**400)), Above(np.zeros(2)),
    )  # fmt: skip
    with np.errstate(all="ignore"):
        u = seen(found.inputs)[0]
    least = abs(quotient(scale)) * (quotient(2.0**-53) * quotient(Q[0, 0, 0]))
    assert quotient(u.E[0, 0]) >= least
    off = abs(quotient(found.units.reach[0, 0]) - quotient(scale) * quotient(2.0**-20))
    assert quotient(u.E[0, 0]) >= off * quotient(2.0**400)


# ---------------------------------------------------------------------------------------------------------------- pairs


def form(A: fmpq_mat, d: list[fmpq]) -> fmpq:
    column = fmpq_mat(len(d), 1, d)
    return (column.transpose() * A * column)[0, 0]


WEIGHTS = {
    "even": lambda g, k: np.eye(k),
    "definite": lambda g, k: np.cov(g.standard_normal((k, 2 * k))).reshape(k, k),
    "lopsided": lambda g, k: np.diag(10.0 ** g.uniform(-300, 300, k)),
    "random": lambda g, k: g.standard_normal((k, k)),
    "negative": lambda g, k: -np.eye(k),
    "nothing": lambda g, k: np.zeros((k, k)),
    "huge": lambda g, k: np.full((k, k), 1.7e308),
    "tiny": lambda g, k: np.full((k, k), 5e-324),
}


@pytest.mark.parametrize("kind", WEIGHTS)
@pytest.mark.parametrize(
    ("p_size", "T_size"), [(1.0, 1.0), (2.0**-900, 2.0**400), (2.0**500, 2.0**-1000), (1e-160, 1e-160)]
)
def test_pairs_are_bounded_whatever_the_weight(kind: str, p_size: float, T_size: float) -> None:
    generator, closest = np.random.default_rng(len(kind)), 0.0
    for _ in range(12):
        k, count, rows = (int(v) for v in generator.integers(1, 5, 3))
        p, T = p_size * generator.standard_normal((count, k)), T_size * generator.standard_normal((count, rows, k))
        p[generator.random(count) < 0.2], T[generator.random(count) < 0.2] = 0, 0
        wrong, wrong_T = p_size * generator.choice([0, 1e-3], count), T_size * generator.choice([0, 1e-3], count)
        with np.errstate(all="ignore"):
            S = bound_of_pairs(p, wrong, T, wrong_T, WEIGHTS[kind](generator, k))
        assert S.transpose() == S
        with ctx.workprec(4000):
            for d in points(generator, k):
                length = sum((arb(v) ** 2 for v in d), arb(0)).sqrt()
                total = arb(0)
                for row, matrix, e, f in zip(p.tolist(), T.tolist(), wrong.tolist(), wrong_T.tolist(), strict=True):
                    along = abs(sum((arb(a) * arb(v) for a, v in zip(row, d, strict=True)), arb(0))) + arb(e) * length
                    turned = [sum((arb(a) * arb(v) for a, v in zip(r, d, strict=True)), arb(0)) for r in matrix]
                    total += 2 * along * (sum((v * v for v in turned), arb(0)).sqrt() + arb(f) * length)
                bound = arb(form(S, [quotient(v) for v in d]))
                assert total <= bound
                closest = max(closest, float((total / bound).mid()) if bound > 0 else 0.0)
    assert closest > 0.1 or kind in ("lopsided", "random", "negative", "huge", "tiny", "nothing")


def test_one_pair_is_bounded_as_well_as_can_be() -> None:
    """In one entry of d it is 2 |p| |T| d^2; in more, the trace of the bound is the least there is."""
    S = bound_of_pairs(np.array([[3.0]]), np.zeros(1), np.array([[[5.0]]]), np.zeros(1), np.array([[7.0]]))
    assert 30 <= S[0, 0] <= fmpq(30 * (2**40 + 1), 2**40)
    p, T = np.array([[3.0, 0.0]]), np.array([[[0.0, 0.5], [0.0, 2.0]]])
    S = bound_of_pairs(p, np.zeros(1), T, np.zeros(1), np.eye(2))
    trace = 2 * 3 * math.sqrt(0.25 + 4)
    assert trace <= float(int((S[0, 0] + S[1, 1]).p)) / int((S[0, 0] + S[1, 1]).q) <= trace * (1 + 1e-9)


@pytest.mark.parametrize("by", [0, 900, -900, 3000])
def test_rationals_in_binary64(by: int) -> None:
    entries = [fmpq(1, 3), fmpq(-7, 5), fmpq(0), fmpq(1, 2**80)]
    a, e = in_binary64(fmpq_mat(2, 2, [v * fmpq(2) ** by for v in entries]))
    assert np.max(np.abs(a.value)) <= 1
    for found, error, v in zip(a.value.ravel(), a.error.top.ravel(), entries, strict=True):
        off = abs(quotient(found) * fmpq(2) ** (e - by) - v)
        assert off <= abs(v) * fmpq(1, 2**53) and off <= quotient(error) * fmpq(2) ** (e - by)
    assert in_binary64(fmpq_mat(1, 2))[0].value.tolist() == [[0.0, 0.0]]


# ----------------------------------------------------------------------------------------------------------- inequality


def random_models(generator: Generator, n: int, k: int, units: int) -> Models:
    m = 2
    U = np.zeros((m, k, k))
    F = [changed(random_jet(generator, k, U), B=generator.standard_normal(m)) for _ in range(n)]
    R = shares(generator, units, k)
    known = units_of(generator.standard_normal((m, units)), R)
    return models_of(generator.standard_normal((n, n)), F, known, True)


@pytest.mark.parametrize("n", slow_after(2, [1, 2, 3]))
@pytest.mark.parametrize("kind", WEIGHTS)
def test_the_two_new_sums_bound_what_they_stand_for(n: int, kind: str) -> None:
    """Exactly, at rational points: 2 sum_i (b_i.d) K_i[d], and 2 sum_q (p_q.d) e_q with the worst signs."""
    generator, closest = np.random.default_rng(n), [0.0, 0.0]
    for k, _ in itertools.product((n, n + 1), range(6)):
        models = random_models(generator, n, k, 5)
        b = exactly(generator.standard_normal((n, k)) * 2.0 ** float(generator.integers(-300, 300)))
        weight = WEIGHTS[kind](generator, k)
        apart = tuple(fmpq(int(beta)) for beta in generator.integers(0, 2, n))
        with np.errstate(all="ignore"):
            by = Multipliers(apart, apart, apart, weight)
            sums = decrease.cubic(models, b, by), decrease.of_units(models, b, weight)
        L, R = exactly(models.units.reach), [exactly(part) for part in remainders(models.units)]
        p = b.transpose() * models.B * L
        whole = [unpacked(K, k) for K in models.K.T]
        for d in points(generator, k):
            q = [quotient(v) for v in d]
            along = [sum((b[i, j] * q[j] for j in range(k)), fmpq(0)) for i in range(n)]
            thirds = [tensor(K, q) for K in whole]
            cubic = abs(2 * sum((a * t for a, t in zip(along, thirds, strict=True)), fmpq(0)))
            of_units = 2 * sum(
                (abs(sum((p[j, r] * q[j] for j in range(k)), fmpq(0))) * form(R[r], q) for r in range(5)), fmpq(0)
            )
            for number, (S, truth) in enumerate(zip(sums, (cubic, of_units), strict=True)):
                bound = form(S, q)
                assert truth <= bound
                closest[number] = max(
                    closest[number], float(int((truth / bound * 2**60).p // (truth / bound * 2**60).q)) / 2**60
                )
    assert min(closest) > 0.2 or kind not in ("even", "definite")


def tensor(K: np.ndarray, q: list[fmpq]) -> fmpq:
    """K[d], entry by entry."""
    places = itertools.product(range(len(q)), repeat=3)
    return sum((quotient(K[h, i, j]) * q[h] * q[i] * q[j] for h, i, j in places), fmpq(0))


def cube(k: str, level: float = 1.0) -> Document:
    """x' = k x^3 - x on |x| <= 1, with no tree to look at: V decreases if k < 1 and only then."""
    data = make([["-", ["*", k, ["**", "x", 3]], "x"]], [([[0.0]], [0.0])], 1.0, (level, level), domain=[("-9", "9")],
                root=[1.25])  # fmt: skip
    return with_ball(data)


def unit(s: str) -> Document:
    """x' = s x + tanh(x - 1.472) - tanh(-1.472) on |x| <= 1, a tanh of the network whose terms all have one sign."""
    layers = [([[1.0]], [-1.472]), ([[1.0]], [0.0])]
    data = make([["+", ["*", s, "x"], "u"]], layers, 1.0, (1.0, 1.0), domain=[("-9", "9")], input_bounds=[("-9", "9")],
                squash="identity", centre="output", scale=[1.0], root=[1.25])  # fmt: skip
    return with_ball(data)


def test_a_cube_is_proved_up_to_its_edge() -> None:
    """The rule of second order would take |x|^3 for |x|^2: now only rounding is left."""
    assert verdict(cube("99999/100000")) == "ACCEPTED"
    assert verdict(cube("1")) == "local" and verdict(cube("100001/100000")) == "local"


def test_a_unit_is_proved_up_to_its_edge() -> None:
    """tanh(x - 1.472) - tanh(-1.472) is 0.46010 at 1: slope -0.46 is a false claim, -0.66 is proved."""
    assert verdict(unit("-46/100")) == "local"
    assert verdict(unit("-66/100")) == "ACCEPTED"


@pytest.mark.parametrize(("name", "false"), [("cubic", cube("3/2")), ("of_units", unit("-456/1000"))])
def test_without_either_sum_a_false_claim_gets_through(
    name: str, false: Document, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert verdict(false) == "local"
    monkeypatch.setattr(decrease, name, lambda models, b, weight: fmpq_mat(b.ncols(), b.ncols()))
    assert verdict(false) == "ACCEPTED"


def test_what_is_shown_is_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loops of two states with every function and a product of inputs: where `local` holds, Vdot < 0 at points."""
    generator, answers = np.random.default_rng(17), []
    documents = [
        by_hand(*kind, [2, 5, 2], seed, 0.3)
        for seed, kind in enumerate([("tanh", "preactivation"), ("identity", "output")] * 3)
    ]
    for data, level in itertools.product([every_function(), *documents], (1e-3, 0.03, 0.2, 0.5)):
        text = float(level).hex()
        tried = with_ball(
            edited(edited(data, "levels", {"local": text, "roa": text}), "evidence.root", encode(np.full(2, 2.0)))
        )
        c = parse(tried)
        with np.errstate(all="ignore"):
            on = local.Local.of(Case(c))
            answers.append(next(local.decreases(on), None) is None)
        with ctx.workprec(200):
            for d in points(generator, 2, 30) if answers[-1] else []:
                x = [sum((arb(p) * arb(v) for p, v in zip(row, d, strict=True)), arb(0)) for row in on.J.tolist()]
                names = dict(zip((*c.states, *c.inputs), (*x, *policy_in_arb(c.policy, c.u_eq, x)), strict=True))
                assert sum((v * value_of(tree, names) for v, tree in zip(x, c.dynamics.trees, strict=True)), arb(0)) < 0
    assert 3 < sum(answers) < len(answers)


# ---------------------------------------------------------------------------------------------- forgeries of the weight

FORGED: dict[str, Any] = {
    "negative": lambda a: -a,
    "nothing": lambda a: 0 * a,
    "random": lambda a: np.random.default_rng(1).standard_normal(a.shape) * 1e3,
    "huge": lambda a: np.full(a.shape, 1.7e308),
    "tiny": lambda a: np.full(a.shape, 5e-324),
    "alternating": lambda a: np.resize([1e300, -1e-300], a.shape),
}


@pytest.mark.parametrize("kind", FORGED)
@pytest.mark.parametrize("false", [cube("1"), cube("3/2"), unit("-46/100"), unit("-456/1000")])
def test_no_weight_proves_what_is_false(kind: str, false: Document) -> None:
    def change(text: str) -> str:
        return encode(FORGED[kind](np.eye(1)))

    assert verdict(edited(false, "evidence.local.weight", change)) == "local"


@pytest.mark.parametrize("kind", FORGED)
def test_any_weight_ends_in_a_verdict(kind: str) -> None:
    for data, at, n in ((honest("rotor"), "local", 2), (honest("enlarged"), "tube.0", 1), (along(), "tube.0", 3)):
        found = verdict(edited(data, f"evidence.{at}.weight", encode(FORGED[kind](np.eye(n)))))
        assert found in ("ACCEPTED", "local", "tube", "ring")


SHAPES: dict[str, Any] = {
    "a row": np.ones(2),
    "too many": np.ones((3, 3)),
    "none": np.ones((0, 0)),
    "infinite": np.full((2, 2), np.inf),
    "no number": np.array([[1.0, 0.0], [0.0, np.nan]]),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_a_weight_of_another_shape_is_refused(shape: str) -> None:
    assert verdict(edited(honest("rotor"), "evidence.local.weight", encode(SHAPES[shape]))) == "format"


@pytest.mark.parametrize("where", ["local", "tube.0"])
def test_a_ball_without_its_weight_is_refused(where: str) -> None:
    data = edited(along(), f"evidence.{where}", lambda part: {k: v for k, v in part.items() if k != "weight"})
    assert verdict(data) == "format"


def test_along_a_path_a_weight_has_a_row_for_the_motion() -> None:
    assert verdict(edited(along(), "evidence.tube.0.weight", encode(np.eye(2)))) == "format"
    assert verdict(edited(along(), "evidence.tube.0.weight", encode(np.eye(3)))) == "ACCEPTED"


def test_constants_have_no_part_in_the_errors() -> None:
    q = constant(Fraction(2, 3), np.ones((2, 3, 3)), 0)
    assert not q.B.any() and np.trace(q.whole) < 1e-150 and q.K.shape == (10,)
