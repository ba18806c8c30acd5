"""Policies between a policy and its own linearisation: one number says how much of the hidden units' curvature is left.

A tanh that ranges over a tenth of what it did, behind weights ten times as large, does the same to first order and a
hundredth of what it did to third. Shrinking every hidden unit's range so, by the first layer, and making up for it in
the last one leads from a network (factor 1) to its linearisation (factor 0), squash and centring untouched. Training
would have to find that way through five layers step by step; it is a closed form.

A tanh is straight at 0, so the values at the origin shrink too. Other units keep these values: most are not straight at
0, and a relu has its corner there, which leaves the range as that shrinks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.activations import activation
from certify.loop.networks import Affine, Network, Observe, Sum, Values
from certify.loop.policies import PolicyNetwork

Array = NDArray[np.float64]


def contracted(network: PolicyNetwork, factor: float) -> PolicyNetwork:
    """The policy whose hidden units range over `factor` times what they did; tanh units rest there at the origin too.

    Values before each tanh at the origin become `factor` times as large, and with them, to first order, what each
    unit makes of the state; the next layer's weights take back the change of tanh's slope. Values before other units
    stay at the origin, and so do the slopes. So net(0) and the Jacobian
    at the origin stay, up to the rounding to float32. Layers, squash, centring, scale, offset and clip are the same.

    Parameters
    ----------
    factor : in (0, 1]; 1 gives the policy itself, its numbers rounded to float32.

    Raises
    ------
    InputError : `factor` is out of its range.

    Notes
    -----
    A unit at rest at 0 stays there exactly: a policy with pi(0) = u_eq by zero biases keeps it.
    """
    if not 0 < factor <= 1:
        raise InputError(f"`factor` must be in (0, 1]; found {factor}.")
    if not network.network.is_chain:
        return _contracted_steps(network, factor)
    last = len(network.weights) - 1
    weights, biases = [], []
    h = shrunk = np.zeros(network.n)
    slopes = np.ones(network.n)  # phi' of the old unit over that of the new one
    phi, rests = activation(network.activation), factor if network.activation == "tanh" else 1.0
    for k, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        y = weight @ h + bias
        stretch = (factor if k == 0 else 1.0) / (factor if k == last else 1.0)
        weights.append(_single(weight * slopes * stretch))
        if k == last:
            biases.append(_last_bias(weights[-1], shrunk, y))
            break
        biases.append(_single(rests * y - weights[-1] @ shrunk))
        (h, old), (shrunk, new) = phi.pair(y), phi.pair(weights[-1] @ shrunk + biases[-1])
        slopes = np.ones(len(old))
        if rests != 1:
            slopes = np.divide(old, new, out=np.zeros(len(old)), where=old > 0)  # a saturated unit passes nothing on
    return network.with_layers(weights=tuple(weights), biases=tuple(biases))


def _contracted_steps(network: PolicyNetwork, factor: float) -> PolicyNetwork:
    """The same for a network of any steps, where all vectors keep their values at the origin.

    A vector's deviations are `factor` times what they were where layers alone decide that: the state and the output
    keep theirs, and so does each vector that a step other than a layer ties to one of them.
    """
    steps, values = network.network.steps, _at_origin(network)
    tied = list(range(len(values)))  # a representative of each class of vectors that have one factor

    def root(i: int) -> int:
        return i if tied[i] == i else root(tied[i])

    for k, step in enumerate(steps, 1):
        if not isinstance(step, Affine):
            for i in step.of:
                tied[root(i)] = root(k)
    kept = {root(0), root(len(steps))}
    kept |= {root(k) for k, step in enumerate(steps, 1) if isinstance(step, Observe)}
    share = [1.0 if root(k) in kept else factor for k in range(len(values))]
    weights, biases = [], []
    for k, step in enumerate(steps, 1):
        if isinstance(step, Affine):
            weights.append(_single(step.weight * (share[k] / share[step.of[0]])))
            biases.append(_single(values[k] - weights[-1] @ values[step.of[0]]))
    return network.with_numbers(weights, biases)


class _Kept(Values):
    """Values of one state, all of which are kept."""

    def __init__(self, state: Array) -> None:
        self.found = [state]

    def run_all(self, network: Network) -> list[Array]:
        for step in network.steps:
            self.found.append(getattr(self, step.kind)(step, *(self.found[i] for i in step.of)))
        return self.found


def _at_origin(network: PolicyNetwork) -> list[Array]:
    """Every vector of a network at the origin."""
    return _Kept(np.array(network.origin)).run_all(network.network)


def with_value_at_origin(network: PolicyNetwork, value: Array) -> PolicyNetwork:
    """The network with the bias that makes net(0) equal `value` (m,), up to rounding.

    It is that of the last layer, which is the last step or is added to it; without such a layer nothing changes.
    """
    steps, values = network.network.steps, _at_origin(network)
    last = len(steps)
    if isinstance(steps[-1], Sum):
        read = [i for step in steps for i in step.of]
        layers = [i for i in steps[-1].of if i and isinstance(steps[i - 1], Affine) and read.count(i) == 1]
        last = layers[-1] if layers else last
    step = steps[last - 1]
    if not isinstance(step, Affine):
        return network
    others = values[-1] - values[last] if last < len(steps) else np.zeros(len(value))
    biases = [each.bias for each in network.network.affine]
    at = [each is step for each in network.network.affine].index(True)
    biases[at] = _last_bias(step.weight, values[step.of[0]], value - others)
    return network.with_numbers([each.weight for each in network.network.affine], biases)


def _last_bias(weight: Array, h: Array, wanted: Array) -> Array:
    # If nothing arrives, the bias is the value itself: a file may hold it in double, and exactness may rest on it.
    return _single(wanted - weight @ h) if np.any(h) else np.array(wanted)


def _single(array: Array) -> Array:
    return np.asarray(array.astype(np.float32), dtype=np.float64)
