"""Arrays as a file has them: raw little-endian bytes in base64, never decimal."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import CertificateFormatError
from certify.loop.activations import ACTIVATIONS
from certify.loop.expressions import Symbol, from_tree, to_tree
from certify.loop.networks import Affine, Clip, Concat, Map, Network, Observe, Product, Step, Sum

Array = NDArray[np.float64]


def encode(array: Array) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype="<f8").tobytes()).decode("ascii")


def decode(text: str, shape: tuple[int, ...]) -> Array:
    return np.frombuffer(base64.b64decode(text), dtype="<f8").reshape(shape).astype(np.float64)


def network_section(name: str, network: Network) -> dict[str, Any]:
    """A network as its section of a file."""
    return {"name": name, "reads": network.reads, "steps": [_step(step) for step in network.steps]}


def _step(step: Step) -> dict[str, Any]:
    parts: dict[str, Any] = {"kind": step.kind, "of": list(step.of)}
    match step:
        case Affine():
            parts |= {"shape": list(step.weight.shape), "weight": encode(step.weight), "bias": encode(step.bias)}
        case Map():
            parts["function"] = step.function
        case Clip():
            parts |= {"lo": encode(step.lo), "hi": encode(step.hi)}
        case Observe():
            parts["names"] = [s.name for s in step.symbols]
            parts["expressions"] = [to_tree(e) for e in step.expressions]
    return parts


def read_network(section: Mapping[str, Any]) -> Network:
    """The network of a section.

    Raises
    ------
    CertificateFormatError : it has a function that this program does not prove.
    InputError : its steps do not belong together.
    """
    sizes, steps = [int(section["reads"])], list[Step]()
    for part in section["steps"]:
        steps.append(_read_step(part, section["name"], [sizes[i] for i in part["of"]]))
        sizes.append(steps[-1].size([sizes[i] for i in part["of"]]))
    return Network(sizes[0], tuple(steps))


def _read_step(part: Mapping[str, Any], name: str, widths: Sequence[int]) -> Step:
    of = tuple(part["of"])
    match part["kind"]:
        case "affine":
            rows, columns = part["shape"]
            return Affine(of, decode(part["weight"], (rows, columns)), decode(part["bias"], (rows,)))
        case "map":
            if part["function"] not in ACTIVATIONS:
                raise CertificateFormatError(
                    f"the network {name} has the function {str(part['function'])[:40]!r}. The checkers read such "
                    "files, this command does not yet."
                )
            return Map(of, part["function"])
        case "clip":
            return Clip(of, decode(part["lo"], (widths[0],)), decode(part["hi"], (widths[0],)))
        case "sum":
            return Sum(of)
        case "concat":
            return Concat(of)
        case "product":
            return Product(of)
        case "observe":
            names = {s: Symbol(s) for s in part["names"]}
            return Observe(of, tuple(names.values()), tuple(from_tree(t, names) for t in part["expressions"]))
    raise CertificateFormatError(f"the network {name} has a step of an unknown kind, {str(part['kind'])[:40]!r}.")


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
