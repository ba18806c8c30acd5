"""Rule `format` for affine layers with tanh between them: those of the policy and those of another function alike.

Weights stay binary64 numbers in flat arrays until a rule asks for them: a file of the largest size holds millions.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from .fields import entries, keys, little_endian, numbers
from .refusal import require

MAX_LAYERS, MAX_WIDTH = 64, 2**14


@dataclass(frozen=True)
class Layer:
    """`W h + b`: W row by row, all numbers as they stand in the file."""

    rows: int
    columns: int
    weight: array[float]
    bias: array[float]

    def row(self, i: int) -> array[float]:
        return self.weight[i * self.columns : (i + 1) * self.columns]


def bytes_of(layers: Sequence[Layer]) -> Iterator[bytes]:
    """The bytes to hash: the axes and the numbers of each weight and each bias."""
    for layer in layers:
        yield struct.pack("<3Q", 2, layer.rows, layer.columns) + little_endian(layer.weight)
        yield struct.pack("<2Q", 1, layer.rows) + little_endian(layer.bias)


def read_layers(value: Any, at: str, columns: int, rows: int) -> tuple[Layer, ...]:
    """Read layers that map `columns` numbers to `rows` numbers."""
    layers, width = [], columns
    described = entries(value, at)
    require(1 <= len(described) <= MAX_LAYERS, "format", at, f"1 to {MAX_LAYERS} layers are allowed")
    for k, entry in enumerate(described):
        each = keys(entry, f"{at}.{k}", "shape", "weight", "bias")
        out, into = entries(each["shape"], f"{at}.{k}.shape", 2)
        fits = type(out) is int and type(into) is int and 1 <= out <= MAX_WIDTH and into == width
        require(fits, "format", f"{at}.{k}.shape", f"[rows, {width}] with 1 to {MAX_WIDTH} rows was expected")
        W, b = numbers(each["weight"], f"{at}.{k}.weight", out * into), numbers(each["bias"], f"{at}.{k}.bias", out)
        layers.append(Layer(out, into, W, b))
        width = out
    require(width == rows, "format", at, f"the last layer must have {rows} rows")
    return tuple(layers)
