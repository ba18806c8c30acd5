"""The checker's arithmetic as plain numbers, which is how tests look at it: a value and an upper bound of its error."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from flint import arb
from numpy.typing import NDArray

from certify.checker import elementary as rounding
from certify.checker import near, network, taylor, wiring
from certify.checker.activations import add as add_activations
from certify.checker.document import Policy
from certify.checker.expression import parse
from certify.checker.functions import FUNCTIONS
from certify.checker.near import Above, Form, Near
from certify.checker.networks import Affine, Map, Network, Step
from certify.checker.outer import Function
from certify.checker.smooth import add as add_smooth

add_activations()
add_smooth()


if TYPE_CHECKING:
    from certify.loop.policies import PolicyNetwork

Array = NDArray[np.float64]
Pair = tuple[Any, Any]


def top(bound: Above) -> Any:
    """An upper bound as binary64 numbers; 0 for what is exact."""
    return 0.0 if bound is near.ZERO else bound.top


def parts(x: Near) -> Pair:
    """The value and the bound of its error, of one shape."""
    return x.value, np.broadcast_to(top(x.error), np.shape(x.value))


def tanh(y: Array) -> Pair:
    return parts(near.tanh(Near(y)))


def sin_cos(y: Array) -> tuple[Any, Any, Any, Any]:
    (s, s_error), (c, c_error) = (parts(x) for x in near.sin_cos(Near(y)))
    return s, c, s_error, c_error


def exp(y: Array) -> Pair:
    return parts(rounding.exp(Near(y)))


def atan(y: Array) -> Pair:
    return parts(rounding.atan(Near(y)))


def relax_tanh(centre: Array, radius: Array) -> tuple[Array, Array, Array]:
    slope, shift, gap = near.lines_around_tanh(centre, Above(radius))
    return slope, shift, gap.top


def float_with_error(q: Fraction) -> tuple[float, float]:
    value, error = parts(near.near(q))
    return float(value), float(error)


def atanh_with_error(q: Fraction) -> tuple[float, float]:
    value, error = parts(near.near_atanh(q))
    return float(value), float(error)


def arb_with_error(x: arb) -> tuple[float, float]:
    value, error = parts(near.near_ball(x))
    return float(value), float(error)


def total(array: Array, axis: int) -> Any:
    return Above(array).sum(axis).top


def norm(array: Array, axis: int | tuple[int, ...]) -> Any:
    return near.norm(array, axis).top


def spectral_norm(W: Array) -> float:
    bound = float(near.spectral_norm(W).top)
    return np.inf if np.isnan(bound) else bound


class Taylor:
    """A model with the whole symmetric matrix Q (N, N, B)."""

    def __init__(self, c: Array, g: Array, Q: Array, r: Any) -> None:
        i, j = taylor.pairs(len(g))
        both = Q[i, j] + np.where((i != j).reshape(-1, *[1] * (Q.ndim - 2)), Q[j, i], 0.0)
        self.model = taylor.Taylor(c, np.concatenate([g, both]), Above(r + 0 * c))

    @classmethod
    def of(cls, model: taylor.Taylor) -> Taylor:
        made = cls.__new__(cls)
        made.model = model
        return made

    @property
    def c(self) -> Array:
        found: Array = self.model.c
        return found

    @property
    def g(self) -> Array:
        return self.model.g

    @property
    def Q(self) -> Array:
        N = self.model.symbols
        i, j = taylor.pairs(N)
        Q = np.zeros((N, N, *self.model.c.shape))
        half = self.model.q * np.where(i == j, 1.0, 0.5).reshape(-1, *[1] * self.model.c.ndim)  # exact
        Q[i, j], Q[j, i] = half, half
        return Q

    @property
    def r(self) -> Array:
        return np.array(np.broadcast_to(top(self.model.r), np.shape(self.model.c)))

    @property
    def size(self) -> Array:
        found: Array = self.model.size.top
        return found

    @property
    def reach(self) -> Array:
        found: Array = self.model.moved.top
        return found

    def at(self, index: Any) -> Taylor:
        return Taylor.of(self.model.at(index))

    def __add__(self, other: Taylor) -> Taylor:
        return Taylor.of(self.model + other.model)

    def __neg__(self) -> Taylor:
        return Taylor.of(-self.model)

    def __mul__(self, other: Taylor) -> Taylor:
        return Taylor.of(self.model * other.model)

    def scaled(self, k: Any) -> Taylor:
        return Taylor.of(self.model.scaled(k))

    def function(self, name: str) -> Taylor:
        return Taylor.of(self.model.function(name))

    def widened(self, symbols: int) -> Taylor:
        return Taylor.of(self.model.widened(symbols))


def affine(c: Array, g: Array, r: Any = 0.0) -> Taylor:
    return Taylor.of(taylor.affine(c, g, Above(r + 0 * c)))


def constant(q: Fraction, symbols: int, batch: int) -> Taylor:
    return Taylor.of(taylor.constant(q, symbols, batch))


def inner_product(x: Sequence[Taylor], y: Sequence[Taylor]) -> Taylor:
    return Taylor.of(taylor.inner_product([v.model for v in x], [v.model for v in y]))


def upper_bound(model: Taylor) -> Array:
    return taylor.upper_bound(model.model)


def both_bounds(model: Taylor) -> tuple[Array, Array]:
    """By squares, and at a corner."""
    return taylor._by_squares(model.model), taylor._at_a_corner(model.model)


def form(x: Array, error: Array) -> Form:
    """x (n, k, B) within error (n, B), as the checker has it: (k, n, B)."""
    return Form(np.moveaxis(x, 1, 0), Above(error))


def shown(u: Form) -> tuple[Array, Array, Array]:
    """Its centre (m, B), slopes (m, n, B) and error (m, B)."""
    return u.value[0], np.moveaxis(u.value[1:], 0, 1), np.broadcast_to(top(u.error), u.value[0].shape)


def enclose_on_boxes(net: network.Folded, x: Array, x_error: Array) -> tuple[Array, Array, Array]:
    return shown(network.enclose_on_boxes(net, form(x, x_error)))


def clipped(mid: Array, slopes: Array, error: Array, least: Array, most: Array) -> tuple[Array, Array, Array]:
    """Forms within `error` of numbers, clipped as `enclose_on_boxes` does it."""
    v = form(np.concatenate([mid[:, None], slopes], axis=1), error)
    cut, slope, gap = wiring.clip_forms(Form(v.value), v.range.error, least, most)
    return shown(cut.wider(v.error * slope + gap))


def chain(weights: Sequence[Array], biases: Sequence[Array], name: str = "policy") -> Network:
    """A network of these layers, with tanh between them."""
    steps: list[Step] = []
    for W, b in zip(weights, biases, strict=True):
        if steps:
            steps.append(Map((len(steps),), steps[-1].size, "tanh"))
        steps.append(Affine((len(steps),), len(W), W, b))
    return Network(name, weights[0].shape[1], tuple(steps))


def policy(given: PolicyNetwork) -> Policy:
    """A policy of the producer as the checker has it."""
    origin = given.origin if given.is_moved else None
    own = given.scale, given.offset, given.squash, given.centre, given.clip, origin
    return Policy(chain(given.weights, given.biases), *own)


def layers(network: Network) -> list[tuple[Array, Array]]:
    """W and b of the affine steps of a chain."""
    if not network.is_chain:
        raise ValueError(f"{network.name} is no chain of layers")
    return [(step.weight, step.bias) for step in network.steps if isinstance(step, Affine)]


def function_of(network: Network) -> Function:
    """N = the network's first number, of a rule about boxes beyond the ellipsoid."""
    names = [f"x{i}" for i in range(network.reads)]
    return Function(parse([["network", network.name, 0, *names]], names, "N", {network.name: network}))


def expansion(phi: Any) -> SimpleNamespace:
    """Values f and errors e of an expansion, and its three bounds."""
    pairs = [parts(x) for x in (phi.f if hasattr(phi, "f") else phi.stored)]
    rest = {name: getattr(phi, name).top for name in ("third", "fourth", "last") if hasattr(phi, name)}
    return SimpleNamespace(f=tuple(v for v, _ in pairs), e=tuple(e for _, e in pairs), **rest)


def elementary(name: str, c: Any, error: Any, radius: Any) -> SimpleNamespace:
    """The expansion of a function at numbers within `error` of c."""
    known = near.ZERO if np.all(np.asarray(error) == 0) else Above(np.asarray(error, dtype=np.float64))
    return expansion(FUNCTIONS[name].expansion(Near(np.asarray(c, dtype=np.float64), known), Above(radius)))


def slope_of_tanh(c: float, radius: float) -> SimpleNamespace:
    """The expansion of tanh' at c."""
    phi = FUNCTIONS["tanh"].expansion(Near(np.array(c)), Above(np.array(radius)))
    return expansion(phi.derivative)
