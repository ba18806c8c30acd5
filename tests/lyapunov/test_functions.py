"""Lyapunov functions as values: their numbers, gradients, and what is refused."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from certify.errors import InputError
from certify.lyapunov import LyapunovFunction, Neural, Polynomial, Quadratic
from tests.support.foreign import mlp, values


def neural(n: int = 3, hidden: tuple[int, ...] = (7, 5), seed: int = 0) -> tuple[Neural, torch.nn.Sequential]:
    """A network and the module of torch that it was made from."""
    module = mlp((n, *hidden, 1), seed=seed)
    layers = [layer for layer in module if isinstance(layer, torch.nn.Linear)]
    numbers = ([p.detach().numpy() for p in (layer.weight, layer.bias)] for layer in layers)
    weights, biases = zip(*numbers, strict=True)
    return Neural(weights, biases), module


def polynomial(n: int = 3, terms: int = 12, degree: int = 6, seed: int = 0) -> Polynomial:
    generator = np.random.default_rng(seed)
    rows = generator.multinomial(degree, np.full(n + 1, 1 / (n + 1)), 4 * terms)[:, :n]
    exponents = np.unique(np.vstack([rows, np.eye(n, dtype=rows.dtype)]), axis=0)[-terms:]
    return Polynomial(exponents, generator.standard_normal(len(exponents)))


def quadratic(n: int = 3) -> Quadratic:
    M = np.random.default_rng(2).standard_normal((n, n))
    return Quadratic(M + M.T)


FUNCTIONS: list[LyapunovFunction] = [neural()[0], neural(1, ())[0], polynomial(), polynomial(1, 3, 12), quadratic()]


@pytest.mark.parametrize("function", FUNCTIONS)
def test_every_leading_shape(function: LyapunovFunction) -> None:
    x = np.random.default_rng(1).uniform(-1, 1, (4, 5, function.n))
    each = np.array([[function(point) for point in row] for row in x])
    slopes = np.array([[function.gradient(point) for point in row] for row in x])
    assert function(x).shape == (4, 5) and function.gradient(x).shape == x.shape
    np.testing.assert_allclose(function(x), each, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(function.gradient(x), slopes, rtol=1e-12, atol=1e-14)
    assert function(x[:0]).shape == (0, 5) and function.gradient(x[:0]).shape == (0, 5, function.n)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_the_gradient_is_the_limit_of_difference_quotients(function: LyapunovFunction) -> None:
    """Central quotients of a smooth function converge at order 2: an error in the gradient would not shrink."""
    generator = np.random.default_rng(3)
    x, d = generator.uniform(-1, 1, (20, function.n)), generator.standard_normal((20, function.n))
    along = np.sum(function.gradient(x) * d, axis=-1)
    off = [np.max(np.abs((function(x + h * d) - function(x - h * d)) / (2 * h) - along)) for h in (1e-2, 1e-3)]
    assert off[1] < 1e-4 and (off[1] < off[0] / 50 or off[0] < 1e-9)


def test_a_network_is_what_torch_computes() -> None:
    N, module = neural()
    x = np.random.default_rng(4).uniform(-2, 2, (100, 3))
    np.testing.assert_allclose(N(x), values(module, x)[:, 0], rtol=1e-13, atol=1e-14)
    given = torch.tensor(x, requires_grad=True)
    (slope,) = torch.autograd.grad(module(given).sum(), given)
    np.testing.assert_allclose(N.gradient(x), slope.numpy(), rtol=1e-12, atol=1e-14)
    assert (N.n, N.widths) == (3, (3, 7, 5, 1))


def test_numbers_are_copies_that_stay() -> None:
    weight = np.ones((1, 2))
    N, p = Neural((weight,), (np.zeros(1),)), Polynomial(np.eye(2, dtype=int), np.ones(2))
    weight[0, 0] = 5
    assert N.weights[0][0, 0] == 1
    for array in (*N.weights, *N.biases, p.exponents, p.coefficients):
        assert not array.flags.writeable
    N.gradient(np.zeros(2))[0] = 7  # the gradient of an affine function is a copy as well
    assert N.gradient(np.zeros(2)).tolist() == [1, 1]


NETWORKS: dict[str, tuple[Any, Any, str]] = {
    "two outputs": ((np.ones((2, 3)),), (np.zeros(2),), "one output; its last layer has 2"),
    "no layer": ((), (), "at least one"),
    "a bias is missing": ((np.ones((1, 3)),), (), "as many weights as biases"),
    "widths": ((np.ones((4, 3)), np.ones((1, 5))), (np.zeros(4), np.zeros(1)), "the 4 outputs of layer 0"),
    "a vector": ((np.ones(3),), (np.zeros(1),), r"weight \(out, in\)"),
    "no state": ((np.ones((1, 0)),), (np.zeros(1),), r"weight \(out, in\)"),
    "nan": ((np.full((1, 3), np.nan),), (np.zeros(1),), "`weights` of a Lyapunov network must be finite"),
    "infinity": ((np.ones((1, 3)),), (np.array([np.inf]),), "`biases` of a Lyapunov network must be finite"),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_no_such_network(name: str) -> None:
    weights, biases, message = NETWORKS[name]
    with pytest.raises(InputError, match=message):
        Neural(weights, biases)


POLYNOMIALS: dict[str, tuple[Any, Any, str]] = {
    "real exponents": ([[1.0, 2.0]], [1.0], "must be integers"),
    "truths": ([[True, False]], [1.0], "must be integers"),
    "a vector": ([1, 2], [1.0, 1.0], "shape"),
    "no term": (np.zeros((0, 2), dtype=int), [], "at least one of each"),
    "no state": (np.zeros((2, 0), dtype=int), [1.0, 2.0], "at least one of each"),
    "negative": ([[2, 0], [1, -1]], [1.0, 1.0], "between 0 and 12; found -1"),
    "a high power": ([[13, 0]], [1.0], "between 0 and 12; found 13"),
    "a huge power": (np.array([[2**63, 2**63]], dtype=np.uint64), [1.0], "between 0 and 12"),
    "a high degree": ([[7, 6]], [1.0], "degree .* 1 to 12; found 13"),
    "a constant": ([[0, 0]], [1.0], "degree .* 1 to 12; found 0"),
    "a term twice": ([[2, 0], [0, 2], [2, 0]], [1.0, 2.0, 3.0], r"\[2, 0\] stands there twice"),
    "too few coefficients": ([[2, 0], [0, 2]], [1.0], "2 finite numbers.*found shape \\(1,\\)\\."),
    "nan": ([[2, 0], [0, 2]], [1.0, np.nan], "not all finite"),
    "too many terms": (np.indices((13,) * 4).reshape(4, -1).T[:4097], np.ones(4097), "at most 4096 terms; found 4097"),
}


@pytest.mark.parametrize("name", POLYNOMIALS)
def test_no_such_polynomial(name: str) -> None:
    exponents, coefficients, message = POLYNOMIALS[name]
    with pytest.raises(InputError, match=message):
        Polynomial(exponents, coefficients)


def test_a_constant_term_beside_others_is_a_term() -> None:
    p = Polynomial(np.array([[0, 0], [0, 12]], dtype=np.int8), np.array([0.25, 2.0]))
    assert (
        p.degree == 12
        and p(np.zeros(2)) == 0.25
        and p.exactly(np.array([9.0, 0.5])) == Fraction(1, 4) + Fraction(2, 4096)
    )


@given(st.integers(1, 4), st.integers(1, 12), st.integers(0, 10_000))
def test_floats_are_near_the_rational_value(n: int, degree: int, seed: int) -> None:
    """A product of at most 12 factors and a sum of at most 20 terms round fewer than 64 times."""
    p = polynomial(n, 20, degree, seed)
    x = np.random.default_rng(seed).uniform(-2, 2, n)
    magnitude = Polynomial(p.exponents, np.abs(p.coefficients)).exactly(np.abs(x))
    assert abs(Fraction(float(p(x))) - p.exactly(x)) <= Fraction(64, 2**53) * magnitude


def test_a_quadratic_function_as_a_polynomial() -> None:
    V, x = quadratic(2), np.array([0.1, -0.7])
    p = Polynomial(np.array([[2, 0], [1, 1], [0, 2]]), np.array([V.P[0, 0], 2 * V.P[0, 1], V.P[1, 1]]))
    assert p.exactly(x) == V.exactly(x)
    np.testing.assert_allclose(p.gradient(x), V.gradient(x), rtol=1e-14)
