"""The program of a policy, and its layers where it has nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.networks import Affine, Network, layered
from certify.loop.networks.written import as_written

Array = NDArray[np.float64]
WHOSE = "the policy"  # in messages


@dataclass(frozen=True, slots=True)
class Programmed:
    """A network of the n states that makes m numbers."""

    network: Network

    @property
    def n(self) -> int:
        """Number of states that the network reads."""
        return self.network.reads

    @property
    def m(self) -> int:
        """Number of inputs that the network commands."""
        return self.network.gives

    @property
    def layers(self) -> tuple[int, ...]:
        """Widths from what the first layer reads to the input, such as (2, 16, 16, 1), as they were written."""
        return as_written(self.network).widths

    @property
    def words(self) -> str:
        """Widths and functions, such as `2-16-16-1 tanh`, or how many steps there are, for people."""
        network = as_written(self.network)
        functions = "".join(f" {name}" for name in network.functions)
        if network.is_observed_chain:
            text = "-".join(map(str, network.widths)) + functions
        else:
            text = f"{self.n} to {self.m} in {len(network.steps)} steps" + (functions and f" with{functions}")
        return (
            text if network.observation is None else f"{text} of {', '.join(map(str, network.observation.expressions))}"
        )

    def require_layers(self, what: str) -> None:
        """Reject a network that is not layers of the states with one function between them.

        Raises
        ------
        InputError : it has other steps, which `what` does not read yet.
        """
        if not self.network.is_chain:
            kinds = ", ".join(dict.fromkeys(step.kind for step in self.network.steps))
            raise InputError(
                f"{what} needs a policy of layers that read the states, with one function between them; found the "
                f"steps {kinds}. `certify roa` proves such a policy."
            )

    @property
    def activation(self) -> str:
        """The function between the layers, tanh where there is one layer; raises as `require_layers`."""
        self.require_layers("this")
        return next(iter(self.network.functions), "tanh")

    @property
    def weights(self) -> tuple[Array, ...]:
        """The matrices of the layers; raises as `require_layers`."""
        self.require_layers("this")
        return tuple(step.weight for step in self.network.affine)

    @property
    def biases(self) -> tuple[Array, ...]:
        """The biases of the layers; raises as `require_layers`."""
        self.require_layers("this")
        return tuple(step.bias for step in self.network.affine)

    def with_layers(
        self,
        weights: Sequence[Any] | None = None,
        biases: Sequence[Any] | None = None,
        activation: str | None = None,
        **others: Any,
    ) -> Self:
        """The same policy with other numbers in its layers, or another function between them; `others` are further
        fields."""
        self.require_layers("to replace its layers one")
        given = (weights or self.weights, biases or self.biases, activation or self.activation)
        return replace(self, network=chain(*given), **others)

    def with_numbers(self, weights: Sequence[Any], biases: Sequence[Any]) -> Self:
        """The same policy of any steps with other matrices and biases in its layers, in their order."""
        new = zip(weights, biases, strict=True)
        steps = [Affine(step.of, *next(new)) if isinstance(step, Affine) else step for step in self.network.steps]
        return replace(self, network=Network(self.n, tuple(steps)))


def chain(weights: Sequence[Any], biases: Sequence[Any], function: str) -> Network:
    """The network of a policy's layers with a function between them.

    Raises
    ------
    InputError : shapes do not chain, a number is not finite, or there is no such function.
    """
    steps = layered(weights, biases, function, WHOSE)
    return Network(int(np.shape(weights[0])[1]), steps)
