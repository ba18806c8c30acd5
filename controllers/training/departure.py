"""The departure of a network from its own linearisation on a box, by its hidden units: a proof has to absorb it.

Bounds on Vdot follow each unit's difference from its tangent at the origin along the paths to the inputs and add
magnitudes. So what a proof sees of a policy is a sum over units, not the policy's shape: two bends that cancel cost
twice. The sum below is that one, in the smooth form that a gradient needs. A tanh whose values range over +- v differs
from its tangent by about v^3 / 3, while its weight towards the inputs grows as 1 / v only: the same action from smaller
ranges is easier to prove. Other smooth units differ by about v^2, a relu by what lies beyond its corner. The last
tanh is left out; it keeps the inputs in their bounds and is not to be trained away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from certify.loop.policies import PolicyNetwork
from controllers.training.forms import Forms, Numbers
from controllers.training.units import Units

_TANH = Units()
WORTH_FLATTENING = 1.0  # departure on the box, above which a proof of the box is hardly in reach (docs/how-to)
_LEAST = 1e-30  # below any range that counts: a network that ignores the state has no scale of its own


@dataclass(frozen=True, slots=True)
class Linearisation:
    """A network at the origin, layer by layer; the last layer is the one before the squash.

    Parameters
    ----------
    values : values at the origin before each unit, (width,) each; the last ones are net(0).
    jacobians : their Jacobians, (width, n) each; the last one is that of net, (m, n).
    gains : Jacobians (m, width) of net with respect to each hidden layer's units, which is one fewer.
    """

    values: tuple[Tensor, ...]
    jacobians: tuple[Tensor, ...]
    gains: tuple[Tensor, ...]


def linearised(weights: Sequence[Tensor], biases: Sequence[Tensor], units: Units = _TANH) -> Linearisation:
    """The network `W_k phi(... phi(W_0 x + b_0) ...) + b_k` at the origin; can be differentiated."""
    values: list[Tensor] = []
    jacobians: list[Tensor] = []
    for W, b in zip(weights, biases, strict=True):
        if values:
            h, slope = units.pair(values[-1])
            values.append(W @ h + b)
            jacobians.append(W @ (slope[:, None] * jacobians[-1]))
        else:
            values.append(b)
            jacobians.append(W)
    gains: list[Tensor] = []
    for k in range(len(weights) - 1, 0, -1):
        _, slope = units.pair(values[k])
        gains.append(weights[k] if not gains else (gains[-1] * slope) @ weights[k])
    return Linearisation(tuple(values), tuple(jacobians), tuple(reversed(gains)))


def departure(weights: Sequence[Tensor], biases: Sequence[Tensor], box: Tensor, units: Units = _TANH) -> Tensor:
    """The bends that hidden units may add to net(x) on a box, relative to the range of its linear part there.

    `sum_j sum_i |C_ji| (|r_i(v_i)| + |r_i(-v_i)|) / 2  /  sum_j v_j`, with
    `r_i(v) = phi(y_i + v) - phi(y_i) - phi'(y_i) v` of the hidden unit i, y_i its value at the origin,
    `v_i = sum_l |J_il| box_l` its range to first order, C_ji its gain towards the j-th value before the squash, and v_j
    that value's range.

    Parameters
    ----------
    weights, biases : of the layers, (out, in) and (out,); scalings of the states are folded in.
    box : half-widths (n,), in the states' units.
    units : phi.

    Returns
    -------
    A number without unit, 0 for an affine network; it can be differentiated. The last layer's scale makes no difference
    to it, so that doing less is no way to lower it.

    Notes
    -----
    No bound: ranges and gains are those of first order. It is computed in float64, whatever the weights are, because
    r_i cancels: at v = 0.01 single precision has nothing left of it.
    """
    at_0 = linearised([W.double() for W in weights], [b.double() for b in biases], units)
    half_widths = box.double()
    total = half_widths.new_zeros(())
    for y, J, C in zip(at_0.values, at_0.jacobians, at_0.gains, strict=False):  # the last layer has no units here
        v, (h, slope) = J.abs() @ half_widths, units.pair(y)
        above, below = (units(y + end) - h - slope * end for end in (v, -v))
        total = total + (C.abs() @ ((above.abs() + below.abs()) / 2)).sum()
    linear = (at_0.jacobians[-1].abs() @ half_widths).sum()
    return total / linear.clamp_min(_LEAST)


def departure_of_steps(numbers: Numbers, box: Tensor, origin: Tensor) -> Tensor:
    """The departure of a network of any steps on the box with half-widths (n,) around the state `origin` (n,).

    Its units' bends are those of `Forms`, errors of lines and not differences from tangents: about half of `departure`.
    """
    forms = Forms(numbers)
    y, J = forms.run(numbers.network, (origin[None], torch.diag(box)[None]))
    bends = forms.errors(y).sum() if forms.bends else J.new_zeros(())
    return bends / J.abs().sum().clamp_min(_LEAST)


def departure_of(network: PolicyNetwork, box: Sequence[float]) -> float:
    """`departure` of a policy on the box with these half-widths, (n,)."""
    layers = network.network.affine
    weights = [torch.tensor(a.weight, dtype=torch.float64) for a in layers]
    biases = [torch.tensor(a.bias, dtype=torch.float64) for a in layers]
    if not network.network.is_chain:
        numbers, half_widths = Numbers(network.network, weights, biases), torch.tensor(box, dtype=torch.float64)
        return departure_of_steps(numbers, half_widths, torch.tensor(network.origin)).item()
    return departure(weights, biases, torch.tensor(box, dtype=torch.float64), Units(network.activation)).item()
