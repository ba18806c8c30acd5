"""A proven bound on the difference between a certificate's policy pi and its evaluation in binary32.

A certificate is about the real function pi. A robot computes it with rounded numbers, in an order that its compiler or
library chooses. The bound rests on the usual model of that (Higham, Accuracy and Stability of Numerical Algorithms,
sections 2.2 and 3.1): each operation has a relative error of at most 2^-24, and a product in a sum passes through no
more additions than the sum has, in any order. The mean value theorem carries each new error to the output, through the
slopes of the activation on a box of states and the errors around it.

With ranges and slopes known on a box, let the computed values be y^_k before and h^_k behind the function phi of
layer k. Then

    net^(x) - net(x) = sum_k J_k (y^_k - W_k h^_(k-1) - b_k)
                     + sum_k J_(k+1) W_(k+1) (h^_k - phi(y^_k)) + J_1 W_1 (x^ - x)

row by row. J_k is the derivative of net by y_k at points between the computed values and those that are exact from
layer k on. All of these lie within E_k of y_k(x), where E_k bounds the error of the layers up to k. Each row of J_k is
stored as a centre and a deviation, and the deviation is bounded twice: entry by entry, and in the 2-norm, which in
wide networks is far less than the entries add up to. All arithmetic is in Arb balls, so rounding breaks no bound.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError, OptionError, SoundnessError
from certify.loop.binary32 import Errors, Machine
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.loop.rigorous import precision, rounded_up

Array = NDArray[np.float64]
Box = tuple[tuple[Fraction, Fraction], ...]

_MOST_ULP = 2.0**20
_MOST_BOXES, _MOST_WEIGHTS = 2**8, 2**20  # parts of the domain, and weights in all of them together


@dataclass(frozen=True, slots=True)
class FloatOptions:
    """Assumptions about the arithmetic, and the effort spent on the bound.

    Parameters
    ----------
    tanh_ulp : accuracy of tanh and of other activations, in units in the last place of binary32 of the exact value; of
        the largest value on a box for other activations.
    chain : the most additions that one product passes through in a sum; None allows any order.
    boxes : number of parts that the domain is cut into; more parts give a smaller bound. None takes a few seconds:
        256 for a network of 4000 weights or less and one from a million on.

    Raises
    ------
    InputError : a number is out of its range.
    """

    tanh_ulp: float = 4.0
    chain: int | None = None
    boxes: int | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.tanh_ulp <= _MOST_ULP:
            raise OptionError(f"`tanh_ulp` must be a number from 0 to {_MOST_ULP:.0f}; found {self.tanh_ulp}.")
        if self.chain is not None and self.chain < 1:
            raise OptionError(f"`chain` must be at least 1, or be left out for any order; found {self.chain}.")
        if self.boxes is not None and self.boxes < 1:
            raise OptionError(f"`boxes` must be at least 1; found {self.boxes}.")


@dataclass(frozen=True, slots=True)
class Part:
    """One source's contribution to the bound of each input, (m,), in the inputs' units."""

    source: str
    errors: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class FloatError:
    """Bounds of |binary32 policy - pi| on the domain.

    Parameters
    ----------
    bounds : one per input, (m,), in its unit, rounded up.
    parts : the contributions, each where the bound of that input is largest; a clip adds none.
    assumptions : the required properties of the robot's program, in words.
    boxes : number of parts that the domain was cut into.
    """

    bounds: tuple[float, ...]
    parts: tuple[Part, ...]
    assumptions: tuple[str, ...]
    boxes: int


def float_error(network: PolicyNetwork, system: System, options: FloatOptions | None = None) -> FloatError:
    """Bound the error of each input when the policy is computed in binary32, for every state of the plant's domain.

    Parameters
    ----------
    network : the policy; its binary64 numbers are rounded to binary32, which is part of the error.
    system : the plant, whose domain holds the states, as deviations from x_eq.
    options : assumptions about the arithmetic; by default any order of summation and a tanh good to 4 units.

    Raises
    ------
    InputError : policy and plant do not fit, a number or a sum may overflow in binary32, or no order of summation
        has chains as short as `options.chain`.

    Notes
    -----
    The bound is about single evaluations of pi. It does not cover a robot's sensors, its actuators, or the time
    between two evaluations.

    Source: Higham, Accuracy and Stability of Numerical Algorithms, 2nd edition, lemma 3.1 and section 3.1.

    Examples
    --------
    >>> from certify import PolicyNetwork, get_system
    >>> law = PolicyNetwork.of_layers(([[-8.0, -2.0]],), ([0.0],), [1.0], [0.0], "identity", "none")
    >>> found = float_error(law, get_system("pendulum"))
    >>> 1e-6 < found.bounds[0] < 1e-4
    True
    """
    options = options if options is not None else FloatOptions()
    if network.is_moved:
        raise InputError("`network` must be the policy as its layers read it; found one that is seen from elsewhere.")
    loop = ClosedLoop(system, network)
    with precision():
        machine = Machine.of(loop, options.tanh_ulp, options.chain)
        found = _refined(machine, system.domain, options.boxes)
        worst = [_worst(found, j) for j in range(network.m)]
        bounds = [rounded_up(errors.total(j)) for j, errors in enumerate(worst)]
        if machine.clip_errors:  # min(max(v, lo), hi) moves by no more than the one of the three that moves most
            bounds = [max(bound, *ends) for bound, ends in zip(bounds, machine.clip_errors, strict=True)]
        parts = tuple(
            Part(source, tuple(rounded_up(errors.parts[source][j]) for j, errors in enumerate(worst)))
            for source in found[0].parts
        )
    return FloatError(tuple(bounds), parts, _assumptions(network, options), len(found))


def _refined(machine: Machine, domain: Box, boxes: int | None) -> list[Errors]:
    """The errors on the parts of the domain; the next cut is always where the bound is largest."""
    whole, ties = machine.errors(domain), itertools.count()
    if boxes is None:
        boxes = max(1, min(_MOST_BOXES, _MOST_WEIGHTS // machine.weights))

    def rank(errors: Errors) -> float:
        return -max(float(errors.total(j) / whole.total(j)) for j in range(machine.m))

    heap: list[tuple[float, int, Box, Errors]] = [(rank(whole), next(ties), domain, whole)]
    while len(heap) < boxes:
        _, _, box, _ = heapq.heappop(heap)
        widths = [float(hi - lo) * reach for (lo, hi), reach in zip(box, machine.reach, strict=True)]
        i = widths.index(max(widths))
        middle = (box[i][0] + box[i][1]) / 2
        for half in ((box[i][0], middle), (middle, box[i][1])):
            part = (*box[:i], half, *box[i + 1 :])
            errors = machine.errors(part)
            heapq.heappush(heap, (rank(errors), next(ties), part, errors))
    return [errors for _, _, _, errors in heap]


def _worst(found: Sequence[Errors], j: int) -> Errors:
    """The errors of the part of the domain where the bound of input j, rounded up, is largest."""
    bounds = [rounded_up(errors.total(j)) for errors in found]
    if not all(map(math.isfinite, bounds)):  # the largest of numbers and NaN may be a number
        raise SoundnessError(f"the bounds of input {j} must be finite where nothing overflows; found {bounds!s:.200}.")
    return found[bounds.index(max(bounds))]


def _assumptions(network: PolicyNetwork, options: FloatOptions) -> tuple[str, ...]:
    """The assumptions about the robot's program, in words."""
    centring = {
        "none": "",
        "output": "; u_eq - scale * squash(net(0)) takes the place of the offset, right to one unit in its last place",
        "preactivation": (
            "; beta - net(0), right to one unit in its last place, is put into the last bias before that is rounded, "
            "or is a term of its own"
        ),
    }[network.centre]
    order = (
        "in any order"
        if options.chain is None
        else f"in an order in which no product passes through more than {options.chain} additions"
    )
    ulp = options.tanh_ulp
    tanh = (
        f"tanh of a binary32 number is within {ulp:g} units in the last place of the exact value t: within {ulp:g} * "
        "2^(e-23) where 2^e <= |t| < 2^(e+1), so that its error is relative near 0, and near 1 at most "
        f"{ulp:g} * 2^-24; below 2^-126 the unit is 2^-149"
    )
    phi = network.activation
    other = (
        f"{phi} of a binary32 number is within {ulp:g} units in the last place of its largest value on the part of the "
        "domain, as a sum of functions is that each err by few units"
    )
    layered = len(network.weights) > 1
    used = network.squash == "tanh" or (layered and phi == "tanh")
    others = layered and phi not in ("tanh", "relu")
    return (
        "operations are those of IEEE binary32, rounded to nearest, or more precise ones; numbers below 2^-126 may be "
        "taken for 0",
        f"weights, biases, scale, offset and clip are the file's, rounded to nearest{centring}",
        "the state lies in the domain and is rounded to nearest once, as a deviation from x_eq",
        f"each value of a layer is the sum of its products and its bias, {order}, with or without fused multiply-add",
        *((tanh,) if used else ()),
        *((other,) if others else ()),
        "the output is scale * squash + offset" + ("" if network.clip is None else ", and the clip comes last"),
    )
