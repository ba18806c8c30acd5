"""A robot's arithmetic: policies evaluated step by step in binary32, in orders and with a tanh that a test chooses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Literal

import numpy as np
import torch

from certify.loop.policies import PolicyNetwork

Array = np.ndarray[Any, np.dtype[Any]]
f32 = np.float32


@dataclass(frozen=True)
class Machine:
    """How sums are ordered, whether products are fused into them, what tiny numbers become, and which tanh there is.

    `folded`: what preactivation centring adds is put into the last bias; otherwise it is a term of its own, the first.
    """

    order: Literal["forwards", "backwards", "pairs", "rising", "shuffled"] = "forwards"
    fused: bool = False
    flush: bool = False
    folded: bool = True
    tanh: Callable[[Array], Array] = np.tanh

    def __call__(self, network: PolicyNetwork, u_eq: Sequence[Fraction], x: Array) -> Array:
        """The inputs (N, m) for states (N, n), which are rounded first."""
        h = self._kept(x.astype(f32))
        without = network.folded(u_eq)
        for k, W in enumerate(network.weights):
            own = k == len(network.weights) - 1 and network.centre == "preactivation" and not self.folded
            bias = (network if own else without).biases[k]
            h = self._kept(self.tanh(h)) if k else h
            extra = [self._kept((without.biases[k] - bias).astype(f32))] if own else []
            h = self._sums(self._kept(W.astype(f32)), [*extra, self._kept(bias.astype(f32))], h)
        h = self._kept(self.tanh(h)) if network.squash == "tanh" else h
        scale, offset = self._kept(network.scale.astype(f32)), self._kept(without.offset.astype(f32))
        u = self._fma(scale, h, np.broadcast_to(offset, h.shape))
        return (
            u
            if network.clip is None
            else np.minimum(np.maximum(u, network.clip[0].astype(f32)), network.clip[1].astype(f32))
        )

    def _sums(self, W: Array, terms: list[Array], h: Array) -> Array:
        """(N, out): what stands before the products, the products, in the order of this machine."""
        count = h.shape[1]
        places = {
            "forwards": np.arange(count),
            "backwards": np.arange(count)[::-1],
            "rising": np.argsort(np.abs(W).sum(axis=0)),
            "shuffled": np.random.default_rng(count).permutation(count),
        }
        if self.order == "pairs":
            products = [self._kept(W[:, i] * h[:, i : i + 1]) for i in range(count)]
            products += [np.broadcast_to(t, products[0].shape) for t in terms]
            while len(products) > 1:
                pairs = [self._kept(a + b) for a, b in zip(products[::2], products[1::2], strict=False)]
                products = pairs + products[len(pairs) * 2 :]
            return products[0]
        total = np.broadcast_to(terms[0], (len(h), len(W)))
        for t in terms[1:]:
            total = self._kept(total + t)
        for i in places[self.order]:
            total = self._fma(W[:, i], h[:, i : i + 1], total)
        return total

    def _fma(self, a: Array, b: Array, c: Array) -> Array:
        if self.fused:  # the product of two binary32 numbers is exact in binary64
            return self._kept((a.astype(float) * b.astype(float) + c.astype(float)).astype(f32))
        return self._kept(self._kept(a * b) + c)

    def _kept(self, v: Array) -> Array:
        if v.dtype != f32:
            raise TypeError(f"every number must be binary32; found {v.dtype}.")
        return np.where(np.abs(v) < f32(2.0**-126), f32(0), v) if self.flush else v


def units(t: Array) -> Array:
    """Units in the last place of binary32 of values of tanh, which binary64 may have rounded to 1 or 0."""
    with np.errstate(divide="ignore"):
        exponent = np.floor(np.log2(np.abs(t)))
    return np.asarray(2.0 ** (np.clip(exponent, -126, -1) - 23))


def off_by(ulps: float) -> Callable[[Array], Array]:
    """A tanh that is off by up to so many units of the exact value, away from 0 or towards it by its last digit."""

    def tanh(y: Array) -> Array:
        exact = np.tanh(y.astype(float))
        unit = units(exact)
        away = np.where(np.signbit(exact), -1.0, 1.0) * np.where((y.view(np.int32) & 1) == 1, -1.0, 1.0)
        return (exact + away * max(ulps - 0.5, 0.0) * unit).astype(f32)

    return tanh


def by_torch(network: PolicyNetwork, u_eq: Sequence[Fraction], x: Array) -> Array:
    """What torch makes of the policy in float32, with its own products and its own tanh."""
    without = network.folded(u_eq)
    single = PolicyNetwork.of_layers(  # its numbers stay what they are; the tensors made of them are float32
        without.weights, without.biases, without.scale, without.offset, without.squash, "none", without.clip
    )
    return single(torch.tensor(x, dtype=torch.float32), u_eq).numpy()


def adversarial(
    act: Callable[[Array], Array], exact: Callable[[Array], Array], lo: Array, hi: Array, seed: int = 0
) -> Array:
    """States (N, n) of a box: random ones, corners, the middle, and the worst of them climbed to worse ones."""
    generator = np.random.default_rng(seed)
    n = len(lo)
    x = generator.uniform(lo, hi, (3000, n))
    x[:500] *= generator.random((500, 1)) ** 4
    x[500:1000] = np.where(generator.random((500, n)) < 0.5, lo, hi)
    x[1000:1500] = (x[1000:1500].astype(f32) + np.spacing(x[1000:1500].astype(f32)).astype(float) / 2).clip(lo, hi)
    best, worst = x, np.abs(act(x) - exact(x)).max(axis=1)
    for step in (0.1, 0.03, 0.01, 1e-3, 1e-5, 1e-7):
        leaders = best[np.argsort(-worst)[:100]]
        near = np.repeat(leaders, 10, axis=0)
        near = np.clip(near + step * (hi - lo) * generator.standard_normal(near.shape), lo, hi)
        best, worst = np.concatenate([best, near]), np.concatenate([worst, np.abs(act(near) - exact(near)).max(axis=1)])
    return best
