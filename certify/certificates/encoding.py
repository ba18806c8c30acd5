"""Arrays as a file has them: raw little-endian bytes in base64, never decimal."""

from __future__ import annotations

import base64
from collections.abc import Container, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import CertificateFormatError

Array = NDArray[np.float64]


def encode(array: Array) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype="<f8").tobytes()).decode("ascii")


def decode(text: str, shape: tuple[int, ...]) -> Array:
    return np.frombuffer(base64.b64decode(text), dtype="<f8").reshape(shape).astype(np.float64)


def network_section(
    name: str, weights: Sequence[Array], biases: Sequence[Array], function: str = "tanh"
) -> dict[str, Any]:
    """A network of affine layers with a function between them, as steps, each of the vector just before."""
    steps: list[dict[str, Any]] = []
    for W, b in zip(weights, biases, strict=True):
        if steps:
            steps.append({"kind": "map", "of": [len(steps)], "function": function})
        array = {"shape": list(W.shape), "weight": encode(W), "bias": encode(b)}
        steps.append({"kind": "affine", "of": [len(steps)], **array})
    return {"name": name, "reads": int(weights[0].shape[1]), "steps": steps}


def layers_of(network: Mapping[str, Any], functions: Container[str] = ("tanh",)) -> list[Mapping[str, Any]]:
    """The affine steps of a network that has one of these functions between them, each of the vector just before.

    Raises
    ------
    CertificateFormatError : the network has other steps.
    """
    function = function_of(network)
    kinds = [(step["kind"], step["of"], step.get("function", function)) for step in network["steps"]]
    expected = [(("affine", "map")[k % 2], [k], function) for k in range(len(kinds))]
    if kinds != expected or len(kinds) % 2 == 0 or function not in functions:
        which = "tanh" if "relu" not in functions else "one function of the table"
        raise CertificateFormatError(
            f"the network {network['name']} must be of affine steps with {which} between them, each of the vector just "
            "before; found others, which the checkers read but reports and Coq do not yet."
        )
    return list(network["steps"][::2])


def function_of(network: Mapping[str, Any]) -> str:
    """The function of its first step `map`; tanh where it has none."""
    return next((str(step.get("function")) for step in network["steps"] if step.get("kind") == "map"), "tanh")


def decode_layers(
    network: Mapping[str, Any], functions: Container[str] = ("tanh",)
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """The weights and biases of such a network."""
    layers = layers_of(network, functions)
    weights = tuple(decode(x["weight"], tuple(x["shape"])) for x in layers)
    return weights, tuple(decode(x["bias"], (x["shape"][0],)) for x in layers)


def network_named(networks: Sequence[Mapping[str, Any]], name: str) -> Mapping[str, Any]:
    """The network of this name.

    Raises
    ------
    CertificateFormatError : there is none.
    """
    for network in networks:
        if network["name"] == name:
            return network
    raise CertificateFormatError(f"`networks` must have one named {str(name)[:60]!r}; found none.")
