"""Arrays as a file has them: raw little-endian bytes in base64, never decimal."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def encode(array: Array) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype="<f8").tobytes()).decode("ascii")


def decode(text: str, shape: tuple[int, ...]) -> Array:
    return np.frombuffer(base64.b64decode(text), dtype="<f8").reshape(shape).astype(np.float64)


def encode_layers(weights: Sequence[Array], biases: Sequence[Array]) -> list[dict[str, Any]]:
    return [
        {"shape": list(W.shape), "weight": encode(W), "bias": encode(b)} for W, b in zip(weights, biases, strict=True)
    ]


def decode_layers(layers: Sequence[Mapping[str, Any]]) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    weights = tuple(decode(x["weight"], tuple(x["shape"])) for x in layers)
    return weights, tuple(decode(x["bias"], (x["shape"][0],)) for x in layers)
