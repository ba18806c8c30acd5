"""Networks in floating point: values of arrays and tensors, and derivatives; nothing is proved with them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, reduce
from typing import Any

import numpy as np

from certify.loop.expressions import Expression, Symbol, numerical
from certify.loop.networks.layers import clipped, like
from certify.loop.networks.steps import Affine, Algebra, Array, Clip, Concat, Map, Network, Observe, Product, Sum

_AT_KINK = 1e-12  # what a relu reads that counts as 0
_NEAR, _DIRECTIONS = 1e-6, 512  # of states around one with a kink


class Values(Algebra[Any]):
    """Arrays or tensors, entries along the last axis."""

    def affine(self, step: Affine, v: Any) -> Any:
        found = v @ like(step.weight.T, v)
        found += like(step.bias, v)  # a second array would cost several times the product
        return found

    def map(self, step: Map, v: Any) -> Any:
        return step.phi(v)

    def clip(self, step: Clip, v: Any) -> Any:
        return clipped(v, like(step.lo, v), like(step.hi, v))

    def sum(self, step: Sum, *vectors: Any) -> Any:
        return reduce(lambda a, b: a + b, vectors)

    def concat(self, step: Concat, *vectors: Any) -> Any:
        return joined(vectors)

    def product(self, step: Product, v: Any, w: Any) -> Any:
        return v * w

    def observe(self, step: Observe, v: Any) -> Any:
        return evaluated(step.expressions, step.symbols, v)


_VALUES = Values()


def values(network: Network, x: Any) -> Any:
    """The network's value at x (..., reads), in the arithmetic of x: (..., gives)."""
    return _VALUES.run(network, x)


def joined(vectors: tuple[Any, ...]) -> Any:
    """Arrays or tensors one behind the other, along the last axis."""
    if isinstance(vectors[0], np.ndarray):
        return np.concatenate(vectors, axis=-1)
    import torch

    return torch.cat(vectors, dim=-1)


def evaluated(expressions: tuple[Expression, ...], symbols: tuple[Symbol, ...], v: Any) -> Any:
    """Expressions of the last axis of v."""
    module = "numpy" if isinstance(v, np.ndarray) else "torch"
    found = _compiled(expressions, symbols, module)(*(v[..., i] for i in range(len(symbols))))
    if isinstance(v, np.ndarray):
        return np.stack([np.broadcast_to(np.asarray(e, dtype=v.dtype), v.shape[:-1]) for e in found], axis=-1)
    import torch

    columns = (torch.as_tensor(e, dtype=v.dtype, device=v.device).expand(v.shape[:-1]) for e in found)
    return torch.stack(list(columns), dim=-1)


@cache
def _compiled(expressions: tuple[Expression, ...], symbols: tuple[Symbol, ...], module: Any) -> Any:
    return numerical(expressions, symbols, module)


def jacobian(step: Observe, v: Array) -> Array:
    """The derivatives of observations at v (..., k), (..., w, k)."""
    flat = evaluated(step.slopes, step.symbols, v)
    return np.asarray(flat.reshape(*v.shape[:-1], len(step.expressions), len(step.symbols)))


@dataclass(frozen=True, slots=True)
class Tangent:
    """A vector's value y (w,) at one state, and its Jacobian J (w, k)."""

    y: Array
    J: Array


class Tangents(Algebra[Tangent]):
    """Values and Jacobians together."""

    def affine(self, step: Affine, v: Tangent) -> Tangent:
        return Tangent(step.weight @ v.y + step.bias, step.weight @ v.J)

    def map(self, step: Map, v: Tangent) -> Tangent:
        y, slope = step.phi.pair(v.y)
        return Tangent(y, slope[:, None] * v.J)

    def clip(self, step: Clip, v: Tangent) -> Tangent:
        inside = (v.y > step.lo) & (v.y < step.hi)
        return Tangent(np.minimum(np.maximum(v.y, step.lo), step.hi), np.where(inside[:, None], v.J, 0.0))

    def sum(self, step: Sum, *vectors: Tangent) -> Tangent:
        return Tangent(np.sum([v.y for v in vectors], axis=0), np.sum([v.J for v in vectors], axis=0))

    def concat(self, step: Concat, *vectors: Tangent) -> Tangent:
        return Tangent(np.concatenate([v.y for v in vectors]), np.concatenate([v.J for v in vectors]))

    def product(self, step: Product, v: Tangent, w: Tangent) -> Tangent:
        return Tangent(v.y * w.y, v.y[:, None] * w.J + w.y[:, None] * v.J)

    def observe(self, step: Observe, v: Tangent) -> Tangent:
        return Tangent(evaluated(step.expressions, step.symbols, v.y), jacobian(step, v.y) @ v.J)


def tangent_at(network: Network, x: Array) -> Tangent:
    """The network's value (gives,) and Jacobian (gives, reads) at a state (reads,)."""
    return Tangents().run(network, Tangent(x, np.eye(network.reads)))


class _AtKinks(Tangents):
    """Tangents that notice an entry that is at a kink."""

    def __init__(self) -> None:
        self.found = False

    def map(self, step: Map, v: Tangent) -> Tangent:
        if step.function == "relu":
            self.found |= bool(np.any(np.abs(v.y) <= _AT_KINK))
        return super().map(step, v)

    def clip(self, step: Clip, v: Tangent) -> Tangent:
        self.found |= bool(np.any(np.minimum(np.abs(v.y - step.lo), np.abs(v.y - step.hi)) <= _AT_KINK))
        return super().clip(step, v)


def has_kink_at(network: Network, x: Array) -> bool:
    """True if a relu or a clip has its kink at a state (reads,), so that the network has no derivative there."""
    along = _AtKinks()
    along.run(network, Tangent(x, np.eye(network.reads)))
    return along.found


def mean_tangent(network: Network, x: Array) -> Tangent:
    """The network's value at a state (reads,), and the Jacobian (gives, reads) that is nearest to its changes in all
    directions, by least squares: where it has a kink."""
    d = np.random.default_rng(0).normal(size=(_DIRECTIONS, network.reads))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    d = _NEAR * np.concatenate([d, -d])
    at = tangent_at(network, x).y
    J = np.linalg.lstsq(d, values(network, x + d) - at, rcond=None)[0].T
    return Tangent(at, J)


class Gradients(Values):
    """A network's values at states x (B, reads), `value` (B, gives), and derivatives of numbers that follow from it."""

    def __init__(self, network: Network, x: Array) -> None:
        self.network = network
        self._slopes: list[Any] = []  # of each step, where it is no matrix of numbers
        self.value: Array = self.run(network, x)

    def map(self, step: Map, v: Array) -> Array:
        y, slope = step.phi.pair(v)
        self._slopes.append(slope)
        return y

    def clip(self, step: Clip, v: Array) -> Array:
        self._slopes.append(np.where((v > step.lo) & (v < step.hi), 1.0, 0.0))
        return np.asarray(super().clip(step, v))

    def product(self, step: Product, v: Array, w: Array) -> Array:
        self._slopes.append((v, w))
        return np.asarray(super().product(step, v, w))

    def observe(self, step: Observe, v: Array) -> Array:
        self._slopes.append(jacobian(step, v))
        return np.asarray(super().observe(step, v))

    def backwards(self, slope: Array) -> Array:
        """The derivative (B, reads) by x of a number whose derivative by the value is `slope` (B, gives)."""
        steps, local = self.network.steps, list(self._slopes)
        arriving: dict[int, Array] = {len(steps): slope}
        for k, step in reversed(list(enumerate(steps, 1))):
            own = arriving.pop(k)
            for i, part in zip(step.of, self._before(step, own, local), strict=True):
                arriving[i] = arriving[i] + part if i in arriving else part
        return arriving[0]

    def _before(self, step: Any, own: Array, local: list[Any]) -> list[Array]:
        """The derivatives by each vector that a step reads, so far as they pass through it."""
        match step:
            case Affine():
                return [own @ step.weight]
            case Sum():
                return [own] * len(step.of)
            case Concat():
                ends = np.cumsum([self.network.sizes[i] for i in step.of])[:-1]
                return np.split(own, ends, axis=-1)
            case Product():
                v, w = local.pop()
                return [_gathered(own * w, v), _gathered(own * v, w)]
            case Observe():
                return [np.einsum("bw,bwk->bk", own, local.pop())]
        return [own * local.pop()]


def _gathered(part: Array, v: Array) -> Array:
    """The part of a product that arrives at v; at a single entry all of it together."""
    return part if part.shape == v.shape else np.asarray(part.sum(axis=-1, keepdims=True))
