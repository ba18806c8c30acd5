"""Small closed loops with known answers, shared by the tests."""

from __future__ import annotations

import os
from fractions import Fraction

import numpy as np
import pytest
import sympy
import torch
from hypothesis import settings

from certify.policies import TanhNetwork
from certify.systems import System, get_system

torch.set_num_threads(1)  # the suite runs one process a core

settings.register_profile("ci", deadline=None, derandomize=True, max_examples=50)
settings.register_profile("fuzz", deadline=None, max_examples=5000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


def box(*half_widths: float | str) -> tuple[tuple[Fraction, Fraction], ...]:
    """Symmetric intervals."""
    return tuple((-Fraction(d), Fraction(d)) for d in half_widths)


def scalar_tanh() -> tuple[System, TanhNetwork]:
    """xdot = x/2 - tanh(x): the origin attracts exactly |x| < 1.915008048..."""
    x, u = sympy.symbols("x u")
    system = System(
        name="scalar",
        states=(x,),
        inputs=(u,),
        parameters={},
        dynamics=(x / 2 + u,),
        u_eq=(sympy.Integer(0),),
        domain=box(3),
        input_bounds=box(1),
    )
    network = TanhNetwork((np.array([[-1.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")
    return system, network


def chain(n: int, poles: list[float]) -> tuple[System, TanhNetwork]:
    """An integrator chain of n states under linear feedback that places `poles` exactly (up to integers)."""
    coefficients = np.poly(poles)[:0:-1].real.round(9)  # of s^0 .. s^(n-1)
    x = sympy.symbols(f"x1:{n + 1}")
    u = sympy.Symbol("u")
    system = System(
        name=f"chain{n}",
        states=tuple(x),
        inputs=(u,),
        parameters={},
        dynamics=(*x[1:], u),
        u_eq=(sympy.Integer(0),),
        domain=box(*[1 + Fraction(i, 2) for i in range(n)]),
        input_bounds=box(10_000),
    )
    network = TanhNetwork((-coefficients[None, :],), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    return system, network


def pendulum_network(widths: tuple[int, ...] = (16, 16), centre: str = "preactivation", seed: int = 0) -> TanhNetwork:
    """A tanh policy near the saturated LQR u = 6 tanh(-Kx/6): random features, last layer by least squares."""
    generator = np.random.default_rng(seed)
    K = np.array([2.8, 0.95])
    weights, biases, width = [], [], 2
    for out in widths:
        weights.append(generator.standard_normal((out, width)) / np.sqrt(width) * (0.7 if width == 2 else 1.0))
        biases.append(generator.uniform(-0.5, 0.5, out))
        width = out
    x = generator.uniform(-1, 1, (4000, 2)) * [3.5, 12.0] * generator.random((4000, 1))
    x = np.concatenate([x, 1e-3 * generator.standard_normal((200, 2))])
    h, h0 = x, np.zeros((1, 2))
    for W, b in zip(weights, biases, strict=True):
        h, h0 = np.tanh(h @ W.T + b), np.tanh(h0 @ W.T + b)
    importance = np.where(np.arange(len(x)) < 4000, 1.0, 3000.0)
    target = -(x @ K) / 6
    last, *_ = np.linalg.lstsq((h - h0) * importance[:, None], target * importance, rcond=1e-6)
    return TanhNetwork(
        (*weights, last[None, :]), (*biases, np.array([0.1])), np.array([6.0]), np.zeros(1), "tanh", centre
    )


@pytest.fixture
def pendulum() -> System:
    return get_system("pendulum")
