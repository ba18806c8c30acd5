"""The Lyapunov function file `certify-lyapunov/1`: a neural or a polynomial function, as plain tensors only.

Nothing in a file is executed, and equal functions give equal bytes (see `certify.loop.files.plain`): a polynomial's
terms are written in the order of their exponents. The file has no level: a certificate states the level that holds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from certify.errors import InputError
from certify.loop.files.plain import (
    array_in,
    integers_in,
    layers_in,
    origin_in,
    read_plain,
    require_keys,
    tensors,
    write_plain,
)
from certify.lyapunov.neural import Neural
from certify.lyapunov.polynomial import Polynomial

FORMAT = "certify-lyapunov/1"
_KEYS = {"format", "kind", "system"}
_KINDS = {"network": {"activation", "weights", "biases"}, "polynomial": {"exponents", "coefficients"}}
_WHAT = "Lyapunov file"


@dataclass(frozen=True, slots=True)
class StoredLyapunov:
    """A function with the plant that it was made for.

    Parameters
    ----------
    function : neural or polynomial, of deviations from the plant's operating point, in the plant's order of states.
    system : name of the plant.
    parameters : parameters of the plant as text or numbers (text means its decimal value).
    training : the record of its making; never trusted, may be empty.

    Raises
    ------
    InputError : the function is of another kind.
    """

    function: Neural | Polynomial
    system: str
    parameters: Mapping[str, float | int | str] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.function, Neural | Polynomial):
            raise InputError(
                f"a Lyapunov file must hold a Neural or a Polynomial; found {type(self.function).__name__}. "
                "A quadratic function is given by its P."
            )
        object.__setattr__(self, "parameters", MappingProxyType(dict(self.parameters)))
        object.__setattr__(self, "training", MappingProxyType(dict(self.training)))


def save_lyapunov(
    path: str | Path,
    function: Neural | Polynomial,
    system: str,
    parameters: Mapping[str, float | int | str] | None = None,
    training: Mapping[str, Any] | None = None,
) -> None:
    """Write a Lyapunov function to `path` in one step; the same function gives the same bytes.

    Parameters
    ----------
    system, parameters, training : as of `StoredLyapunov`.

    Raises
    ------
    InputError : the function is neither neural nor polynomial, or the file cannot be written.
    """
    stored = StoredLyapunov(function, system, parameters or {}, training or {})
    kind, numbers = _numbers(stored.function)
    data = {
        "format": FORMAT,
        "kind": kind,
        **numbers,
        "system": {"name": stored.system, "parameters": dict(stored.parameters)},
        "training": dict(stored.training),
    }
    write_plain(path, data, _WHAT)


def load_lyapunov(path: str | Path) -> StoredLyapunov:
    """Read a Lyapunov file.

    Raises
    ------
    InputError : the file is missing, is not an archive of plain tensors, or does not follow `certify-lyapunov/1`.
    """
    data = read_plain(path, _WHAT)
    try:
        return _stored(data)
    except InputError as error:
        raise InputError(f"{_WHAT} {path}: {error}") from error


def _numbers(function: Neural | Polynomial) -> tuple[str, dict[str, Any]]:
    if isinstance(function, Polynomial):
        order = np.lexsort(function.exponents.T[::-1])
        exponents = np.asarray(function.exponents[order], dtype=np.int64)
        return "polynomial", {"exponents": exponents, "coefficients": tensors([function.coefficients[order]])[0]}
    depth, numbers = len(function.weights), tensors((*function.weights, *function.biases))
    return "network", {"activation": "tanh", "weights": numbers[:depth], "biases": numbers[depth:]}


def _stored(data: Any) -> StoredLyapunov:
    found = data.get("format") if isinstance(data, dict) else type(data).__name__
    if not isinstance(data, dict) or found != FORMAT:
        raise InputError(f"`format` must be {FORMAT!r}; found {found!r}.")
    kind = data.get("kind")
    if not isinstance(kind, str) or kind not in _KINDS:
        raise InputError(f"`kind` must be one of {', '.join(_KINDS)}; found {kind!r}.")
    require_keys(data, _KEYS | _KINDS[kind], {"training"})
    system, parameters, training = origin_in(data)
    function: Neural | Polynomial
    if kind == "network":
        if data["activation"] != "tanh":
            raise InputError(
                f"`activation` must be 'tanh'; found {data['activation']!r}. Only tanh networks are proved."
            )
        function = Neural(*layers_in(data))
    else:
        coefficients = array_in(data["coefficients"], "coefficients")
        function = Polynomial(integers_in(data["exponents"], "exponents"), coefficients)
    return StoredLyapunov(function, system, parameters, training)
