"""Small closed loops with known answers, shared by the tests."""

from __future__ import annotations

import dataclasses
from fractions import Fraction

import numpy as np
import scipy.linalg

from certify.loop.activations import ACTIVATIONS
from certify.loop.expressions import Number, Symbol, atan, exp, sqrt, symbols, tanh
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork


def box(*half_widths: float | str) -> tuple[tuple[Fraction, Fraction], ...]:
    """Symmetric intervals."""
    return tuple((-Fraction(d), Fraction(d)) for d in half_widths)


def scalar_tanh() -> tuple[System, PolicyNetwork]:
    """xdot = x/2 - tanh(x): the origin attracts exactly |x| < 1.915008048..."""
    x, u = symbols("x u")
    system = System(
        name="scalar",
        states=(x,),
        inputs=(u,),
        parameters={},
        dynamics=(x / 2 + u,),
        u_eq=(Number(0),),
        domain=box(3),
        input_bounds=box(1),
    )
    network = PolicyNetwork.of_layers((np.array([[-1.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")
    return system, network


def scalar_clip() -> tuple[System, PolicyNetwork]:
    """xdot = x/2 - 2 clip(x, -1/2, 1/2): the origin attracts exactly |x| < 2, and the clip acts for |x| > 1/2."""
    system, _ = scalar_tanh()
    x, u = system.states[0], system.inputs[0]
    ends = np.array([-0.5]), np.array([0.5])
    network = PolicyNetwork.of_layers(
        (np.array([[1.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none", ends
    )
    return dataclasses.replace(system, name="saturated", dynamics=(x / 2 - 2 * u,)), network


def tank() -> tuple[System, PolicyNetwork]:
    """xdot = x/9 + u - sqrt(16 + x), u = 4: the origin attracts, and x > -16 leaves it from x = 9 on."""
    x, u = symbols("x u")
    system = System(
        name="tank",
        states=(x,),
        inputs=(u,),
        parameters={},
        dynamics=(x / 9 + u - sqrt(16 + x),),
        u_eq=(Number(4),),
        domain=box(15),
        input_bounds=box(5),
    )
    network = PolicyNetwork.of_layers(
        (np.zeros((1, 1)),), (np.array([4.0]),), np.ones(1), np.zeros(1), "identity", "none"
    )
    return system, network


def units_apart(unit: Fraction, bias: float = 0.0) -> tuple[System, PolicyNetwork]:
    """A damped oscillator whose position has another unit than its speed; with a bias it rests beside the origin."""
    p, v, u = symbols("p v u")
    system = System(
        name="oscillator",
        states=(p, v),
        inputs=(u,),
        parameters={},
        dynamics=(v * unit, -p / unit - v + u),
        u_eq=(Number(0),),
        domain=((-unit, unit), *box(1)),
        input_bounds=box(3),
    )
    k = float(unit)
    weights = np.array([[-0.3 / k, -0.2], [0.5 / k, 0.1]]), np.array([[0.7, -0.4]])
    biases = np.array([bias, 0.0]), np.zeros(1)
    return system, PolicyNetwork.of_layers(weights, biases, np.full(1, 2.0), np.zeros(1), "tanh", "none")


def valve() -> tuple[System, PolicyNetwork]:
    """Two states and every function of equations beside sin, cos and tan, at points where they are known exactly."""
    x, y, u = symbols("x y u")
    system = System(
        name="valve",
        states=(x, y),
        inputs=(u,),
        parameters={},
        dynamics=(
            y * exp(-x / 4) + tanh(x * y) / 3,
            u - sqrt(4 + x + y / 2) - atan(y) / 2 + x**2 / sqrt(4 + y) ** 3,
        ),
        u_eq=(Number(2),),
        domain=box("3/2", "3/2"),
        input_bounds=box(9),
    )
    gain = np.array([[-1.5, -1.0]])
    network = PolicyNetwork.of_layers(
        (gain,), (np.zeros(1),), np.full(1, 2.0), np.array([1.0]), "tanh", "preactivation"
    )
    return system, network


def chain(n: int, poles: list[float]) -> tuple[System, PolicyNetwork]:
    """An integrator chain of n states under linear feedback that places `poles` exactly (up to integers)."""
    coefficients = np.poly(poles)[:0:-1].real.round(9)  # of s^0 .. s^(n-1)
    x = symbols(f"x{i}" for i in range(1, n + 1))
    u = Symbol("u")
    system = System(
        name=f"chain{n}",
        states=tuple(x),
        inputs=(u,),
        parameters={},
        dynamics=(*x[1:], u),
        u_eq=(Number(0),),
        domain=box(*[1 + Fraction(i, 2) for i in range(n)]),
        input_bounds=box(10_000),
    )
    network = PolicyNetwork.of_layers(
        (-coefficients[None, :],), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )
    return system, network


def springs(push: str) -> tuple[System, PolicyNetwork]:
    """Two softening springs that hold each other, little damped; the policy adds to one, which a force disturbs."""
    p, v, q, w, u, force = symbols("p v q w u force")
    system = System(
        name="springs",
        states=(p, v, q, w),
        inputs=(u,),
        parameters={},
        dynamics=(v, -p + p**3 / 4 - v / 2 + u + force + q / 2, w, -q + q**3 / 4 - w / 2 + p / 2),
        u_eq=(Number(0),),
        domain=box(2, 2, 2, 2),
        input_bounds=box(1),
        disturbances=(force,),
        ranges={"force": (-Fraction(push), Fraction(push))},
    )
    gain = np.array([[-0.3, -0.2, 0.0, 0.0]])
    return system, PolicyNetwork.of_layers((gain,), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")


def saturated_lqr(
    K: np.ndarray,
    scale: float,
    offset: float,
    spread: list[float],
    widths: tuple[int, ...],
    centre: str,
    seed: int,
    activation: str = "tanh",
) -> PolicyNetwork:
    """A policy near u = offset + scale tanh(-Kx/scale): random features, last layer by least squares.

    K (m, n); spread (n,): half-widths of the states over which it is fitted.
    """
    generator, phi = np.random.default_rng(seed), ACTIVATIONS[activation]
    m, n = K.shape
    weights, biases, width = [], [], n
    for out in widths:
        first = width == n and not weights
        stretch = 1.4 / np.array(spread) if first else 1.0
        weights.append(generator.standard_normal((out, width)) * stretch / width**0.5)
        biases.append(generator.uniform(-0.5, 0.5, out))
        width = out
    x = generator.uniform(-1, 1, (4000, n)) * np.array(spread) * generator.random((4000, 1))
    x = np.concatenate([x, 1e-3 * generator.standard_normal((200, n))])
    h, h0 = x, np.zeros((1, n))
    for W, b in zip(weights, biases, strict=True):
        h, h0 = phi(h @ W.T + b), phi(h0 @ W.T + b)
    importance = np.where(np.arange(len(x)) < 4000, 1.0, 3000.0)[:, None]
    last, *_ = np.linalg.lstsq((h - h0) * importance, -(x @ K.T) / scale * importance, rcond=1e-6)
    return PolicyNetwork.of_layers(
        *((*weights, last.T), (*biases, np.full(m, 0.1)), np.full(m, scale), np.full(m, offset), "tanh", centre),
        activation=activation,
    )


def pendulum_network(widths: tuple[int, ...] = (16, 16), centre: str = "preactivation", seed: int = 0) -> PolicyNetwork:
    """A policy for the pendulum that stabilises it."""
    return saturated_lqr(np.array([[2.8, 0.95]]), 6.0, 0.0, [2.0, 8.0], widths, centre, seed)


def lqr_gain(system: System, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Continuous LQR gain of the plant's linearisation, (m, n)."""
    f, n = system.function(), system.n
    u_eq = np.array([float(u) for u in system.exact_u_eq()])
    step = 1e-6
    rows = np.concatenate([np.eye(n, n + system.m), np.eye(system.m, n + system.m, n)]) * step
    forward, back = (f(s * rows[:, :n], u_eq + s * rows[:, n:]) for s in (1, -1))
    J = ((forward - back) / (2 * step)).T
    A, B = J[:, :n], J[:, n:]
    return np.asarray(np.linalg.solve(R, B.T @ scipy.linalg.solve_continuous_are(A, B, Q, R)))
