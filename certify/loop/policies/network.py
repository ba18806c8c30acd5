"""The policy `u = pi(x)`: a network with exact binary64 numbers and a centring that gives pi(0) = u_eq.

`net` is a program of steps: layers with a function between them, and before, between or beside them observations,
clips, sums (skip connections) and branches (`certify.loop.networks`).

`raw(x) = scale * tanh(net(x)) + offset` with squash `tanh`, or `scale * net(x) + offset` with squash
`identity`. Centring makes pi(0) = u_eq by its form:

- `output`: `pi(x) = raw(x) - raw(0) + u_eq` (the paper's step 4);
- `preactivation`: `pi(x) = scale * tanh(net(x) - net(0) + beta) + offset` with the real number
  `beta = atanh((u_eq - offset) / scale)`; the input never leaves `offset +- scale`;
- `none`: pi = raw.

So `pi(x) = scale * squash(net(x) + shift) + offset'` with numbers shift and offset', which `centring` gives in any
arithmetic: floats, Arb balls and the terms of formulas put their own numbers into the same lines. With a `clip` (lo,
hi) the policy is `min(max(., lo), hi)` of that: the last step, after the centring; it must be inactive at 0.

An uncentred policy may have its loop's equilibrium as `origin`: the network then reads `origin + x`, exactly, with x
the deviation from there. The network's numbers, and so its hash, do not change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.networks import (
    Affine,
    Clip,
    Map,
    Network,
    clipped,
    frozen,
    has_kink_at,
    like,
    mean_tangent,
    sha256_of,
    tangent_at,
    tanh,
    values,
)
from certify.loop.policies.arithmetic import Arithmetic
from certify.loop.policies.programmed import WHOSE, Programmed, chain

Squash = Literal["tanh", "identity"]
Centre = Literal["output", "preactivation", "none"]
Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PolicyNetwork(Programmed):
    """A network of the states with its squash, centring, scale, offset and clip.

    `of_layers` makes one of weights and biases.

    Parameters
    ----------
    network : the program; it reads the n states and makes m numbers.
    scale, offset : arrays of shape (m,), in the input's units; scale is nonzero.
    squash, centre : see the module's docstring.
    clip : (lo, hi), arrays of shape (m,) in the input's units with lo < hi, which limit each input; or None.
    origin : the state that the network reads at x = 0, shape (n,); empty for 0.

    Raises
    ------
    InputError : shapes do not match, a number is not finite, an option is unknown, or the origin of a policy that is
        centred is not 0.
    """

    scale: Array
    offset: Array
    squash: Squash = "tanh"
    centre: Centre = "preactivation"
    clip: tuple[Array, Array] | None = None
    origin: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of_layers(
        cls,
        weights: Sequence[Any],
        biases: Sequence[Any],
        scale: Any,
        offset: Any,
        squash: Squash = "tanh",
        centre: Centre = "preactivation",
        clip: tuple[Any, Any] | None = None,
        origin: Any = (),
        activation: str = "tanh",
    ) -> PolicyNetwork:
        """The policy of layers with a function between them; float32 weights are converted, which is exact.

        Parameters
        ----------
        weights : arrays of shape (out, in); the first `in` is n, the last `out` is m.
        biases : arrays of shape (out,).
        scale, offset, squash, centre, clip, origin : as `PolicyNetwork` has them.
        activation : the function's name in `certify.loop.activations`; without a meaning where there is one layer.

        Raises
        ------
        InputError : shapes do not chain, a number is not finite, or as `PolicyNetwork`.
        """
        at = np.asarray(origin, dtype=np.float64)
        return cls(chain(weights, biases, activation), scale, offset, squash, centre, clip, at)

    def __post_init__(self) -> None:
        for name in ("scale", "offset"):
            object.__setattr__(self, name, frozen(getattr(self, name), name, WHOSE))
        if self.squash not in get_args(Squash):
            raise InputError(f"`squash` must be one of {get_args(Squash)}; found {self.squash!r}.")
        if self.centre not in get_args(Centre):
            raise InputError(f"`centre` must be one of {get_args(Centre)}; found {self.centre!r}.")
        if self.centre == "preactivation" and self.squash != "tanh":
            raise InputError("`centre` 'preactivation' needs `squash` 'tanh'; found 'identity'. Use 'output'.")
        if self.scale.shape != (self.m,) or self.offset.shape != (self.m,):
            raise InputError(
                f"`scale` and `offset` must have shape ({self.m},); found {self.scale.shape} and {self.offset.shape}."
            )
        if np.any(self.scale == 0):
            raise InputError("`scale` must be nonzero.")
        if self.clip is not None:
            object.__setattr__(self, "clip", _limits(self.clip, self.m))
        origin = self.origin if np.any(self.origin) else np.zeros(self.n)  # of whatever n was before `replace`
        object.__setattr__(self, "origin", frozen(origin, "origin", WHOSE))
        if self.origin.shape != (self.n,):
            raise InputError(f"`origin` must have shape ({self.n},); found {self.origin.shape}.")
        if self.is_moved and self.centre != "none":
            raise InputError(f"`origin` must be 0 of a policy that is centred; found {self.origin.tolist()}.")

    @property
    def is_moved(self) -> bool:
        """True if the network reads another state than 0 at x = 0."""
        return bool(np.any(self.origin != 0))

    def ratios(self, u_eq: Sequence[Fraction]) -> tuple[Fraction, ...]:
        """`(u_eq - offset) / scale`, exactly, (m,): the value of tanh at the origin with preactivation centring.

        Raises
        ------
        InputError : u_eq does not lie strictly inside `offset +- scale`.
        """
        values = []
        for u, scale, offset in zip(u_eq, self.scale, self.offset, strict=True):
            ratio = (u - Fraction(float(offset))) / Fraction(float(scale))
            if not -1 < ratio < 1:
                raise InputError(
                    f"u_eq = {float(u)} must lie strictly inside offset +- scale = {offset} +- {abs(scale)} "
                    "for preactivation centring."
                )
            values.append(ratio)
        return tuple(values)

    def beta(self, u_eq: Sequence[Fraction]) -> Array:
        """`atanh((u_eq - offset) / scale)` rounded to binary64, (m,); the proof uses the real number."""
        return np.array([np.arctanh(float(ratio)) for ratio in self.ratios(u_eq)])

    def net(self, x: Any) -> Any:
        """`net(x)`, last axis n to m, in the arithmetic of x (numpy array or torch tensor)."""
        return values(self.network, x + like(self.origin, x) if self.is_moved else x)

    def __call__(self, x: Any, u_eq: Sequence[Fraction]) -> Any:
        """pi(x) in float64, shape (..., n) to (..., m); for simulation and search, not for proofs."""
        if self.centre != "none":
            return self.folded(u_eq)(x, u_eq)
        return self.clipped(like(self.scale, x) * self.squashed(self.net(x)) + like(self.offset, x))

    def squashed(self, y: Any, arithmetic: Arithmetic[Any] | None = None) -> Any:
        """Squash the last layer's values, before scale and offset; in numpy or torch if no arithmetic is given."""
        return (arithmetic or _ARRAYS).tanh(y) if self.squash == "tanh" else y

    def squash_slope(self, squashed: Any, arithmetic: Arithmetic[Any] | None = None) -> Any:
        """The derivative of the squash at the value `squashed`."""
        one = (arithmetic or _ARRAYS).number(Fraction(1))
        return one - squashed * squashed if self.squash == "tanh" else one

    def clipped(self, u: Any, arithmetic: Arithmetic[Any] | None = None) -> Any:
        """`min(max(u, lo), hi)` of the m inputs: a list in an arithmetic, or if none is given an array (..., m)."""
        if self.clip is None:
            return u
        if arithmetic is None:
            return clipped(u, *(like(end, u) for end in self.clip))
        ends = ([Fraction(float(v)) for v in end] for end in self.clip)
        return [arithmetic.clip(v, lo, hi) for v, lo, hi in zip(u, *ends, strict=True)]

    def require_unclipped(self, at_0: Sequence[Fraction | float]) -> None:
        """Reject a clip that may act at the origin, where the policy without it has the m values `at_0`.

        Raises
        ------
        InputError : a value does not lie strictly inside the clip.
        """
        if self.clip is None:
            return
        for j, (value, lo, hi) in enumerate(zip(at_0, *self.clip, strict=True)):
            if not Fraction(float(lo)) < value < Fraction(float(hi)):
                raise InputError(
                    f"the clip must not act at the origin: there input {j} must lie strictly inside [{lo}, {hi}]; it "
                    f"is {float(value)!r} before the clip. Widen the clip, or take an operating point inside it."
                )

    def centring(
        self, u_eq: Sequence[Fraction], at_0: Sequence[Any], arithmetic: Arithmetic[Any]
    ) -> tuple[list[Any], list[Any]]:
        """(shift, offset'), (m,) each, from net(0): pi = scale * squash(net(x) + shift) + offset'.

        Raises
        ------
        InputError : u_eq does not lie strictly inside `offset +- scale` (centre `preactivation`).
        """
        number = arithmetic.number
        shift = [number(Fraction(0)) for _ in at_0]
        offset = [number(Fraction(float(o))) for o in self.offset]
        if self.centre == "preactivation":
            shift = [arithmetic.atanh(q) - v for q, v in zip(self.ratios(u_eq), at_0, strict=True)]
        if self.centre == "output":
            each = zip(u_eq, self.scale, at_0, strict=True)
            offset = [number(u) - number(Fraction(float(s))) * self.squashed(v, arithmetic) for u, s, v in each]
        return shift, offset

    def folded(self, u_eq: Sequence[Fraction]) -> PolicyNetwork:
        """A network without centring that reads x and is pi up to rounding: for search and simulation."""
        if self.is_moved:
            return replace(self, network=self.network.read_at(self.origin), origin=np.zeros(self.n))
        if self.centre == "none":
            return self
        shift, offset = self.centring(u_eq, self.net(np.zeros(self.n)).tolist(), _ARRAYS)
        network = self.network.shifted(np.array(shift)) if any(shift) else self.network
        return replace(self, network=network, offset=np.array(offset), centre="none")

    def jacobian_at_origin(self, u_eq: Sequence[Fraction]) -> Array:
        """`d pi / d x` at 0 in float64, shape (m, n); at a kink the matrix that is nearest to pi in all directions.

        Raises
        ------
        InputError : the clip may act at the origin.
        """
        kinked = has_kink_at(self.network, self.origin)
        at = mean_tangent(self.network, self.origin) if kinked else tangent_at(self.network, self.origin)
        squashed = self.squashed(self.beta(u_eq) if self.centre == "preactivation" else at.y)
        self.require_unclipped(u_eq if self.centre != "none" else (self.scale * squashed + self.offset).tolist())
        return np.asarray(self.scale[:, None] * ((self.squash_slope(squashed) * np.ones(self.m))[:, None] * at.J))

    def sha256(self) -> str:
        """Hash of the canonical bytes as FORMAT.md has them; the origin is not part of them."""
        arrays = [a for step in self.network.steps for a in step.arrays]
        head, rest = f"certify-policy/1\0{self.squash}\0{self.centre}\0", (self.scale, self.offset, *(self.clip or ()))
        return sha256_of(head.encode(), (*arrays, *rest), self.network.words())


def program_of(policy: PolicyNetwork, u_eq: Sequence[Fraction] = ()) -> Network:
    """pi as one network, with squash, scale, offset and clip as steps; the numbers of a centring are rounded."""
    plain, eye = policy.folded(u_eq), np.eye(policy.m)
    steps = list(plain.network.steps)
    if plain.squash == "tanh":
        steps.append(Map((len(steps),), "tanh"))
    if np.any(plain.scale != 1) or np.any(plain.offset):
        steps.append(Affine((len(steps),), plain.scale * eye, plain.offset))
    if plain.clip is not None:
        steps.append(Clip((len(steps),), *plain.clip))
    return Network(policy.n, tuple(steps))


class _Arrays:
    """Numbers, numpy arrays and torch tensors."""

    def number(self, q: Fraction) -> Any:
        return float(q)

    def atanh(self, q: Fraction) -> Any:
        return float(np.arctanh(float(q)))

    def tanh(self, v: Any) -> Any:
        return tanh(v)

    def clip(self, v: Any, lo: Fraction, hi: Fraction) -> Any:
        return clipped(v, float(lo), float(hi))


_ARRAYS = _Arrays()


def _limits(clip: Any, m: int) -> tuple[Array, Array]:
    if not isinstance(clip, tuple | list) or len(clip) != 2:
        raise InputError(f"`clip` must be a pair (lo, hi) of arrays of shape ({m},), or None; found {clip!r}.")
    lo, hi = (frozen(end, "clip", WHOSE) for end in clip)
    if lo.shape != (m,) or hi.shape != (m,):
        raise InputError(f"`clip` must be two arrays of shape ({m},); found {lo.shape} and {hi.shape}.")
    if not np.all(lo < hi):
        j = int(np.argmin(lo < hi))
        raise InputError(f"`clip` must satisfy lo < hi; found [{lo[j]}, {hi[j]}] for input {j}.")
    return lo, hi
