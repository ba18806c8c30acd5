"""The producer's bounds: containment against Arb without tolerance, order of convergence, width."""

from __future__ import annotations

from fractions import Fraction
from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import flint
import numpy as np
import pytest
import sympy
from hypothesis import assume, given
from hypothesis import strategies as st

from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, Number, atan, cos, evaluate, exp, sin, sqrt, symbols, tan, tanh
from certify.loop.plants import System, get_system
from certify.loop.policies import PolicyNetwork
from certify.loop.rigorous import evaluate_arb, evaluate_policy
from certify.provers.bounds import Models, Taylor, compiled, policy_enclosure, upper_bound
from certify.provers.bounds.loop import played
from certify.provers.bounds.tape import recorded
from certify.provers.bounds.taylor import ConstantsLast, at_a_corner, inner_product
from tests.support.algebra import to_sympy
from tests.support.loops import box, pendulum_network
from tests.support.maxima import drawn, largest
from tests.support.ways import WAYS, Way, bounded, relax_tanh


def tensor(values: object) -> np.ndarray:
    return np.array(values)


def arb(value: float) -> flint.arb:
    return flint.arb(float(value))


@given(
    st.floats(-30, 30),
    st.one_of(st.floats(0, 40), st.floats(-12, 0).map(lambda e: 10.0**e)),
    st.lists(st.floats(-1, 1), min_size=1, max_size=8),
)
def test_tanh_lies_between_its_parallel_lines(centre: float, radius: float, shares: list[float]) -> None:
    flint.ctx.prec = 200
    s, m, gap = (float(v[0]) for v in relax_tanh(tensor([centre]), tensor([radius])))
    for share in [-1.0, 0.0, 1.0, *shares]:
        y = arb(centre) + arb(radius) * arb(share)
        assert abs(y.tanh() - arb(s) * y - arb(m)) <= arb(gap)


@pytest.mark.parametrize("centre", [0.0, 0.3, -0.7, 1.5, -3.0])
def test_relaxation_is_of_second_order_and_never_looser_than_an_interval(centre: float) -> None:
    radii = tensor([2.0**-k for k in range(1, 10)])
    s, _, gap = relax_tanh(np.full_like(radii, centre), radii)
    orders = np.log2(gap[:-1] / gap[1:])
    assert bool((orders[3:] > 1.85).all())
    interval = (np.tanh(centre + radii) - np.tanh(centre - radii)) / 2
    assert bool((gap <= interval * (1 + 1e-12) + 1e-13).all())
    assert bool((s >= 0).all()) and bool((s <= 1).all())


def _networks() -> list[tuple[System, PolicyNetwork]]:
    generator = np.random.default_rng(1)
    pendulum = get_system("pendulum")
    x, y, z, u, v = symbols("x y z u v")
    two = System(
        name="two",
        states=(x, y, z),
        inputs=(u, v),
        parameters={},
        dynamics=(u - Fraction(1, 3), v, -z),
        u_eq=(Fraction(1, 3), Number(0)),
        domain=box(2, 2, 2),
        input_bounds=box(9, 9),
    )
    normal = generator.standard_normal
    wide = PolicyNetwork.of_layers(
        (normal((40, 3)), normal((30, 40)) / 3, normal((2, 30))),
        (generator.standard_normal(40), generator.standard_normal(30), generator.standard_normal(2)),
        np.array([2.0, -3.0]), np.array([0.2, 0.1]), "tanh", "preactivation",
    )  # fmt: skip
    linear = PolicyNetwork.of_layers(
        (generator.standard_normal((2, 3)),), (np.ones(2),), np.ones(2), np.ones(2), "identity", "output"
    )
    return [
        (pendulum, pendulum_network()),
        (pendulum, pendulum_network(centre="output")),
        (two, wide),
        (two, PolicyNetwork.of_layers(wide.weights, wide.biases, wide.scale, wide.offset, "identity", "output")),
        (two, linear),
    ]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("case", range(5))
@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-6, 1e-2, 0.5, 10.0, 1e6])
def test_the_policy_lies_in_its_enclosure(case: int, size: float, way: Way) -> None:
    system, network = _networks()[case]
    loop = ClosedLoop(system, network)
    generator = np.random.default_rng(case)
    n, m, batch = system.n, system.m, 4
    centre = generator.standard_normal((n, batch))
    slopes = size * generator.standard_normal((n, n, batch))
    x = np.concatenate([tensor(centre)[:, None], tensor(slopes)], 1)
    with bounded(way):
        mid, gradient, error, _ = policy_enclosure(loop)(x, np.zeros((n, batch)))
    checked = 0
    for b in range(batch):
        for d in [np.ones(n), *generator.uniform(-1, 1, (3, n))]:
            point = centre[:, b] + slopes[:, :, b] @ d  # a binary64 state, a rounding away from the affine form
            slack = 1e-13 * (1 + size)
            for j, u in enumerate(evaluate_policy(loop, point)):
                form = arb(mid[j, b]) + sum((arb(gradient[j, i, b]) * arb(d[i]) for i in range(n)), flint.arb(0))
                lipschitz = float(
                    np.prod([np.linalg.norm(W, 2) for W in network.weights]) * np.max(np.abs(network.scale))
                )
                assert abs(u - form) <= arb(error[j, b]) + arb(slack * lipschitz)
                checked += 1
    assert checked == batch * 4 * m


def test_policy_error_is_of_second_order(pendulum: System) -> None:
    enclosure = policy_enclosure(ClosedLoop(pendulum, pendulum_network()))
    errors = []
    for k in range(8):
        slopes = 0.2 * 2.0**-k * np.eye(2)[:, :, None]
        x = np.concatenate([tensor([0.4, -0.3])[:, None, None], slopes], 1)
        errors.append(float(enclosure(x, np.zeros((2, 1)))[2][0, 0]))
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(orders[3:] > 1.8)


X, Y = symbols("x y")
EXPRESSIONS = [
    X * Y,
    X**3 - 2 * Y**2 + Fraction(1, 3),
    sin(X) * cos(Y),
    tan(X / 4) + Y,
    (X + Y) / (2 + sin(X) ** 2),
    (3 + X**2) ** -2 * Y,
    Fraction(1, 7) * X * sin(X * Y) - cos(X),
    tanh(X + Y) * exp(-X),
    atan(2 * X * Y - X) + 4 * atan(1) * Y - exp(1),
    sqrt(2 + X) - sqrt(3 + Y) ** -3,
    sqrt(sqrt(2 + X)) * exp(sqrt(2) * Y),
]


def model(c: float, g: list[float]) -> Taylor:
    zero = np.zeros((2, 2, 1))
    return Taylor(tensor([c]), tensor(g)[:, None], zero, np.zeros(1))


@np.errstate(all="ignore")
def on_models(expression: Expression, x: Taylor, y: Taylor) -> Taylor:
    return evaluate(expression, {X: x, Y: y}, Models(x))


@np.errstate(all="ignore")
def on_tape(expression: Expression, x: Taylor, y: Taylor, way: Way) -> Taylor:
    """The same on a tape, for models without Q and r."""
    two = recorded(2, lambda v, algebra: evaluate(expression, {X: v[0], Y: v[1]}, algebra))
    states, none = np.stack([np.concatenate([v.c[None], v.g]) for v in (x, y)]), np.zeros((2, 1))
    system = SimpleNamespace(n=2, m=0, uncertain=())
    with bounded(way):
        loops = compiled.loops(1)
    return played(loops, two, cast(System, system), states, none, none[:0], states[:0, 1:], none[:0])[0]


EVALUATED = {"models": on_models, **{way: partial(on_tape, way=way) for way in WAYS}}


coefficient = st.floats(-1, 1).map(lambda v: round(v, 6))


@pytest.mark.parametrize(
    ("expression", "way"),
    [
        pytest.param(e, way, marks=[pytest.mark.slow] if way == "compiled" and k > 3 else [], id=f"{e}-{way}")
        for k, e in enumerate(EXPRESSIONS)
        for way in EVALUATED
    ],
)
@given(
    st.lists(coefficient, min_size=6, max_size=6),
    st.sampled_from([1.0, 0.1, 1e-3, 1e-9, 0.0]),
    st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=4),
)
def test_taylor_models_contain_the_function(
    way: str, expression: Expression, numbers: list[float], size: float, points: list[tuple[float, float]]
) -> None:
    flint.ctx.prec = 200
    (a, b), g, h = numbers[:2], [size * v for v in numbers[2:4]], [size * v for v in numbers[4:]]
    result = EVALUATED[way](expression, model(a, g), model(b, h))
    bound = float(upper_bound(result)[0][0])
    assume(bool(np.isfinite(result.r[0])))  # NaN: a pole could not be excluded, and nothing is claimed
    for d in points:
        values = {
            X: arb(a) + arb(g[0]) * arb(d[0]) + arb(g[1]) * arb(d[1]),
            Y: arb(b) + arb(h[0]) * arb(d[0]) + arb(h[1]) * arb(d[1]),
        }
        true = evaluate_arb(expression, values)
        polynomial = arb(result.c[0])
        for i in range(2):
            polynomial += arb(result.g[i, 0]) * arb(d[i])
            for j in range(2):
                polynomial += arb(result.Q[i, j, 0]) * arb(d[i]) * arb(d[j])
        assert abs(true - polynomial) <= arb(result.r[0])
        assert true <= arb(bound)


@pytest.mark.parametrize("way", EVALUATED)
@pytest.mark.parametrize("expression", EXPRESSIONS, ids=str)
def test_taylor_remainder_is_of_third_order(expression: Expression, way: str) -> None:
    remainders = []
    for k in range(2, 9):
        size = 0.5 * 2.0**-k
        result = EVALUATED[way](expression, model(0.3, [size, -0.4 * size]), model(-0.2, [0.1 * size, size]))
        remainders.append(float(result.r[0]))
    if max(remainders) < 1e-13:  # a polynomial of degree two: nothing but rounding
        assert sympy.Poly(to_sympy(expression), *sympy.symbols("x y")).total_degree() <= 2
        return
    orders = np.log2(np.array(remainders[:-1]) / np.array(remainders[1:]))
    assert np.all(orders[2:] > 2.8)


@given(st.lists(st.floats(-1e6, 1e6), min_size=16, max_size=16), st.sampled_from([1.0, 1e-8, 1e8]))
def test_rows_of_models_contain_their_sums(numbers: list[float], size: float) -> None:
    """In one product, and row by row as a tape has them, against exact sums of the same coefficients."""
    matrix = size * np.array(numbers[:4]).reshape(2, 2)
    values = []
    for c, g, h, p, q, r in (numbers[4:10], numbers[10:16]):
        Q = tensor([[p, q], [q, -p]])[:, :, None]
        values.append(Taylor(tensor([c]), tensor([g, h])[:, None], Q, tensor([abs(r)])))
    together = Models(values[0]).combined(matrix, values)
    apart = ConstantsLast.combined(Models(values[0]), matrix, values)
    for found in (together, apart):
        for row, result in zip(matrix, found, strict=True):
            wrong = Fraction(0)
            for name in ("c", "g", "Q"):
                parts = [getattr(v, name).flatten().tolist() for v in (*values, result)]
                for a, b, own in zip(*parts, strict=True):
                    wrong += abs(Fraction(row[0]) * Fraction(a) + Fraction(row[1]) * Fraction(b) - Fraction(own))
            rest = sum(abs(Fraction(k)) * Fraction(float(v.r[0])) for k, v in zip(row, values, strict=True))
            assert wrong + rest <= Fraction(float(result.r[0]))


@pytest.mark.parametrize("way", EVALUATED)
def test_a_pole_in_reach_is_never_bounded(way: str) -> None:
    roots = ((sqrt(X), 0.05), (sqrt(X), -3.0), (X * sqrt(X), 0.1), (exp(X), 64.0))
    for expression, centre in ((1 / X, 0.05), (tan(X), 1.5), (X**-2, 0.0), *roots):
        result = EVALUATED[way](expression, model(centre, [0.1, 0.0]), model(0.0, [0.0, 0.0]))
        assert not bool(upper_bound(result)[0][0] < float("inf"))


def test_upper_bound_is_exact_for_separable_quadratics() -> None:
    generator = np.random.default_rng(3)
    t = np.linspace(-1, 1, 20_001)
    for _ in range(50):
        g, q = generator.standard_normal(2), generator.standard_normal(2)
        separable = Taylor(tensor([0.5]), tensor(g)[:, None], np.diag(tensor(q))[:, :, None], tensor([0.0]))
        value = 0.5 + sum(np.max(g[i] * t + q[i] * t**2) for i in range(2))
        bound = float(upper_bound(separable)[0][0])
        assert value <= bound <= value + 1e-6


@pytest.mark.parametrize("kind", ["steep", "level", "flat"])
@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_no_upper_bound_is_below_the_exact_maximum(n: int, kind: str) -> None:
    """Inside, on faces and at corners, of the lesser of two bounds and of that at a corner alone."""
    generator, exact = np.random.default_rng([n, len(kind)]), 0
    each = [drawn(generator, n, kind) for _ in range(60)]
    g, Q = (np.moveaxis(np.array(part, dtype=np.float64), 0, -1) for part in zip(*each, strict=True))
    quadratic = Taylor(np.zeros(60), g, Q, np.zeros(60))
    bound, corner = upper_bound(quadratic)[0], at_a_corner(quadratic)
    for b, most in enumerate(largest(*one) for one in each):
        assert most <= min(Fraction(float(bound[b])), Fraction(float(corner[b])))
        exact += corner[b] <= float(most) + 1e-8
    assert kind != "steep" or exact > 10


def test_the_enclosure_is_invariant_under_the_oddness_of_tanh(pendulum: System) -> None:
    """Negating a hidden layer's incoming and outgoing weights leaves the function, and its bounds, as they are."""
    network = pendulum_network()
    W, b = network.weights, network.biases
    flipped = PolicyNetwork.of_layers((-W[0], -W[1], W[2]), (-b[0], b[1], b[2]), network.scale, network.offset)
    x = np.concatenate([tensor([0.2, 0.5])[:, None, None], 0.3 * np.eye(2)[:, :, None]], 1)
    none = np.zeros((2, 1))
    first, second = (policy_enclosure(ClosedLoop(pendulum, w))(x, none) for w in (network, flipped))
    for a, c in zip(first[:3], second[:3], strict=True):
        np.testing.assert_allclose(a, c, rtol=1e-9, atol=1e-12)


def test_an_inner_product_lies_within_its_third_order() -> None:
    """Of members of models at points: beside c, g and Q only sum t_i d_i^2 and the remainder."""
    generator, N, batch = np.random.default_rng(7), 3, 20

    def models() -> list[Taylor]:
        Q = generator.standard_normal((4, N, N, batch))
        parts = (generator.standard_normal((4, batch)), generator.standard_normal((4, N, batch)), Q + Q.swapaxes(1, 2))
        return [Taylor(*row, np.full(batch, 1e-6)) for row in zip(*parts, strict=True)]

    def at(v: Taylor, d: Any) -> Any:
        return v.c + np.einsum("ib,ib->b", v.g, d) + np.einsum("ib,ijb,jb->b", d, v.Q, d)

    first, second = [Taylor(v.c, v.g, 0 * v.Q, v.r) for v in models()], models()  # so nothing is of fourth order
    third = 0.0
    for x, y in ((first, second), (second, first)):
        found, t = inner_product(x, y)
        for _ in range(200):
            d = generator.uniform(-1, 1, (N, batch))
            truth = sum((at(v, d) + 1e-6) * (at(w, d) - 1e-6) for v, w in zip(x, y, strict=True))
            assert np.all(np.abs(truth - at(found, d)) <= (t * d * d).sum(0) + found.r)
            third = max(third, float(np.max((np.abs(truth - at(found, d)) - found.r) / (t * d * d).sum(0))))
    each = [v.norms()[1] * w.norms()[2] + v.norms()[2] * w.norms()[1] for v, w in zip(x, y, strict=True)]
    assert third > 0.2 and np.all(t.sum(0) < sum(each))
