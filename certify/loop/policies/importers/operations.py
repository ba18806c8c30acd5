"""torch's operations by their names, as exact steps on the values of a program, and as torch's own functions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np

from certify.errors import InputError
from certify.loop.files.arrays import Numbers
from certify.loop.policies.importers import graph
from certify.loop.policies.importers.constants import computed, is_constant
from certify.loop.policies.importers.graph import Chain
from certify.loop.policies.importers.options import WITH_TANH, WITHOUT_NORMALISATION
from certify.loop.policies.importers.reading import gives

KNOWN = (
    "linear, addmm, matmul, add, sub, rsub, mul, div, neg, cat, chunk, split, slice, clamp, maximum, minimum, "
    "hardtanh, relu, tanh, elu, sigmoid, silu, gelu, softplus, mish, leaky_relu, prelu, selu, celu, relu6, "
    "hardsigmoid, hardswish, log_sigmoid, pow, abs, h / (1 + abs(h)), layer_norm, batch_norm, rms_norm, and sqrt of "
    "constants"
)
"""The operations that are read, in words."""
_ACTIVATIONS: dict[str, tuple[float, ...]] = {  # with what a program may write behind the value
    **{"tanh": (), "sigmoid": (), "silu": (), "gelu": (), "mish": (), "elu": (1.0, 1.0, 1.0), "softplus": (1.0, 20.0)},
    "gelu-tanh": (),
    **dict.fromkeys(("selu", "relu6", "hardsigmoid", "hardswish", "log_sigmoid"), ()),
}
_NORMALISATIONS = ("group_norm", "instance_norm")
_DEFAULTS: dict[str, tuple[Any, ...]] = {"hardtanh": (-1.0, 1.0), "clamp": (None, None)}
_WITHOUT_DROPPING = ("dropout", "feature_dropout", "alpha_dropout", "feature_alpha_dropout")
_SINGLE = float(np.finfo(np.float32).eps)  # RMSNorm's epsilon where none is said
REAL = (6, 7)  # torch's numbers for float32 and float64
_AS_OBSERVATIONS = (
    "Save the network behind it, and say what that reads with --states, as in --states "
    "'cos(theta),sin(theta),theta_dot'."
)
WITHOUT_WEIGHT_NORM = (
    "Write the weights out before you save it: torch.nn.utils.parametrize.remove_parametrizations(layer, 'weight'), or "
    "torch.nn.utils.remove_weight_norm(layer)."
)
"""The next step where a weight is computed from others."""
ADVICE: Mapping[str, str] = {
    **dict.fromkeys(_NORMALISATIONS, WITHOUT_NORMALISATION),
    **dict.fromkeys(("sin", "cos", "atan2"), _AS_OBSERVATIONS),
    **dict.fromkeys(("select", "unsqueeze", "squeeze"), "Keep the rows of a batch: x[:, :1], say, instead of x[:, 0]."),
    **dict.fromkeys(("_weight_norm", "mv", "vdot", "norm", "norm_except_dim"), WITHOUT_WEIGHT_NORM),
    **dict.fromkeys(("tensor", "device"), "Make a constant a buffer of the module, with register_buffer."),
}
"""The next step where an operation is not read, by its name."""
_LAYERS = {"linear": 0, "matmul": 0, "mm": 0, "addmm": 1}  # and the place of the row that they read
_EVALUATED = "Call model.eval() before you save it."
PARTS = ("chunk", "split", "slice", "narrow", "split_with_sizes")
"""Operations whose results share their memory with what they are parts of."""


@dataclass(frozen=True, slots=True)
class Batch:
    """The number of observations in a batch, which no value depends on."""


@dataclass(frozen=True, slots=True)
class Value:
    """A value of a program: the exact steps from the observation to it, and torch's operation that made it, with its
    arguments, values and constants.

    Parameters
    ----------
    constant : its numbers, if it depends on no observation.
    under : the steps to a value, if this one is its square root or the inverse of that.
    """

    chain: Chain = ()
    name: str = ""
    given: tuple[Any, ...] = ()
    constant: Numbers | None = None
    under: Chain | None = None

    @property
    def before(self) -> list[Value]:
        """The values that it is made of."""
        return [v for v in self.given if isinstance(v, Value)]

    @property
    def made(self) -> list[Value]:
        """All values from the observation to it, in an order in which they can be computed."""
        found, waiting = dict[int, Value](), [self]
        while waiting:
            missing = [v for v in waiting[-1].before if id(v) not in found]
            waiting += missing
            if not missing:
                value = waiting.pop()
                found[id(value)] = value
        return [v for v in found.values() if v.name]


def depends(value: Any) -> bool:
    """True if a value depends on the observation."""
    return isinstance(value, Value) and value.constant is None


def operation(name: str, given: list[Any], approximate: str | None, wide: int, at: str) -> Any:
    """The result of an operation on values and constants.

    Parameters
    ----------
    approximate : the form of gelu.
    wide : the number of observations.

    Raises
    ------
    InputError : it is no operation that is read.
    """
    name = "gelu-tanh" if name == "gelu" and approximate == "tanh" else name
    if name in ("t", "numpy_T") and len(given) == 1 and is_array(given[0]) and given[0].ndim == 2:
        return given[0].T
    values = [v for part in given for v in (part if isinstance(part, list) else [part]) if depends(v)]
    if not values:
        return _constant(name, given, wide, at)
    if any(v.under is not None for v in values) and not (name in ("mul", "div") and len(given) == len(values) == 2):
        raise InputError(f"{at} reads a square root, which may only divide a value, as in a normalisation.")
    if (result := _unchanged(name, given, wide, at)) is not None:
        return result
    if name in PARTS:
        return _parts(name, given, wide, at)
    if name == "cat" and len(given) == 2 and given[1] in (1, -1) and _all_depend(given[0]):
        return Value(graph.joined("concat", *(v.chain for v in given[0])), name, tuple(given[0]))
    if (several := _several(name, given, at)) is not None:
        return several
    if name in ("layer_norm", "batch_norm", "rms_norm"):
        return Value(_normalised(name, given, wide, at), name, tuple(given))
    if name == "mean" and len(given) >= 3 and given[1] in ([1], [-1]) and given[2] is True and depends(given[0]):
        return Value(graph.averaged(given[0].chain, gives(given[0].chain, wide)), name, tuple(given[:3]))
    if name in ("rsqrt", "sqrt") and len(given) == 1:
        return Value((), name, tuple(given), under=given[0].chain)
    return _elementwise(name, given, at)


def _elementwise(name: str, given: list[Any], at: str) -> Value:
    """An operation on one value, with constants."""
    places = [k for k, value in enumerate(given) if depends(value)]
    others = tuple(v.constant if isinstance(v, Value) else v for v in given if not depends(v))
    if name not in _FUNCTIONS:
        raise InputError(f"{at} is not read: the operations are {KNOWN}. {WITH_TANH}")
    if len(places) != 1 or any(isinstance(v, bool) or not (v is None or is_constant(v)) for v in others):
        raise InputError(
            f"{at} must join one value that depends on the observation with constants; add, sub, mul and cat may "
            "join several."
        )
    return Value(_step(name, places[0], len(given), given[places[0]].chain, others, at), name, tuple(given))


def held(constant: Any, wide: int, at: str) -> Value:
    """A constant row as a value, so that a network may read it, as in net(x) - net(0).

    Raises
    ------
    InputError : it is no row of numbers.
    """
    chain = graph.held(constant, wide, at)
    exact = is_array(constant) and constant.dtype.kind == "f"
    row = constant if exact else np.asarray(graph.real(constant, at), dtype=np.float32)
    return Value(chain, "held", (row.reshape(1, -1),))


def _constant(name: str, given: list[Any], wide: int, at: str) -> Any:
    """An operation on constants: python's own numbers, or exact ones of arrays; a layer's is a value that is held."""
    exact = tuple(v.constant if isinstance(v, Value) else v for v in given)
    made = computed(name, exact, at) if all(is_constant(v) for v in exact) else None
    if made is None and name in _LAYERS and len(given) > _LAYERS[name] and is_constant(exact[_LAYERS[name]]):
        k = _LAYERS[name]
        return operation(name, [*given[:k], held(exact[k], wide, at), *given[k + 1 :]], None, wide, at)
    if made is None:
        raise InputError(f"{at} is not read of constants alone. Save the policy with the result as a buffer.")
    if all(isinstance(v, int) for v in given) and name in ("add", "sub", "mul", "neg"):
        return int(made.item())
    if all(isinstance(v, int | float) for v in given) and name not in ("sqrt", "rsqrt", "pow"):
        return float(made.item())  # as the program's own numbers are
    return Value((), name, tuple(given), made)


def _unchanged(name: str, given: list[Any], wide: int, at: str) -> Value | None:
    """The value itself, of an operation that changes no number of it; None of another operation."""
    value: Value = given[0]
    if not depends(value):
        return None
    if name in _WITHOUT_DROPPING and len(given) == 3:
        if given[2] is not False:
            raise InputError(f"{at} must be in evaluation mode. {_EVALUATED}")
        return value
    if name in ("contiguous", "detach", "clone", "alias") or (name == "flatten" and given[1:] in ([1], [1, -1])):
        return value
    if name in ("to", "type_as", "float", "double"):
        to = given[1] if len(given) > 1 else None
        if (name == "to" and (type(to) is not int or to not in REAL)) or (name == "type_as" and not depends(to)):
            raise InputError(f"{at} must be a conversion to float32 or float64.")
        return value
    if name in ("view", "reshape") and len(given) == 2 and isinstance(given[1], list) and len(given[1]) == 2:
        rows, width = given[1]
        known = gives(value.chain, wide)
        if (isinstance(rows, Batch) and width in (known, -1)) or (rows == -1 and width == known):
            return value
        raise InputError(f"{at} must leave the rows of a batch as they are.")
    return None


def _parts(name: str, given: list[Any], wide: int, at: str) -> Any:
    """Entries of a row: a list of values for chunk and split, a value for slice and narrow."""
    value, *said = given
    if not depends(value) or not all(isinstance(v, int) or v is None for v in said if not isinstance(v, list)):
        raise InputError(f"{at} must take parts of one value at constant places.")
    width = gives(value.chain, wide)
    match name, said:
        case "slice", [] | [0] | [0, 0 | None] | [0, 0 | None, None | 9223372036854775807, *_] if said[3:] in ([], [1]):
            return value
        case "slice", [1 | -1, start, *end] if end[1:] in ([], [1]):
            start, stop = (0 if start is None else start), (width if not end or end[0] is None else end[0])
            return Value(graph.selected(value.chain, width, start, stop, at), name, tuple(given))
        case "narrow", [1 | -1, int(start), int(length)] if start >= 0:
            return Value(graph.selected(value.chain, width, start, start + length, at), name, tuple(given))
        case "chunk", [int(count), 1 | -1] if count > 0:
            sizes = [-(-width // count)] * count
        case "split", [int(size), 1 | -1] if size > 0:
            sizes = [size] * -(-width // size)
        case "split" | "split_with_sizes", [list(sizes), 1 | -1] if all(type(s) is int and s > 0 for s in sizes):
            pass
        case _:
            raise InputError(f"{at} must take entries of a row, along axis 1 of a batch of observations (k, n).")
    ends = np.minimum(np.cumsum([0, *sizes]), width).tolist()
    pairs = [(a, b) for a, b in pairwise(ends) if a < b]
    return [Value(graph.selected(value.chain, width, a, b, at), "slice", (value, 1, a, b)) for a, b in pairs]


def _several(name: str, given: list[Any], at: str) -> Value | None:
    """An operation that joins two values; None if it joins no two."""
    if len(given) != 2 or not _all_depend(given):
        return None
    one, other = given
    if other.under is not None or one.under is not None:
        root, factor = (other, one) if other.under is not None else (one, other)
        if (
            factor.under is None
            and (name, root.name) in (("mul", "rsqrt"), ("div", "sqrt"))
            and (name == "mul" or root is other)
        ):
            return Value(graph.divided_by_root(factor.chain, root.under, at), name, (one, other))
        raise InputError(f"{at} reads a square root, which may only divide a value, as in a normalisation.")
    match name:
        case "add":
            return Value(graph.joined("sum", one.chain, other.chain), name, (one, other))
        case "sub":
            return Value(graph.subtracted(one.chain, other.chain), name, (one, other))
        case "div":
            return Value(graph.divided(one.chain, other.chain, at), name, (one, other))
        case "mul":
            return Value(graph.product(one.chain, other.chain), name, (one, other))
    return None


def _normalised(name: str, given: list[Any], wide: int, at: str) -> Chain:
    """layer_norm and rms_norm over the entries of a row, and batch_norm in evaluation."""
    match name, [*given, *(None, None, 1e-5)[max(len(given) - 2, 0) :]]:
        case "layer_norm", [Value() as value, [int(width)], gain, bias, float(epsilon), *rest] if (
            width > 0 and len(rest) <= 1 and all(v is None or is_array(v) for v in (gain, bias))
        ):
            return graph.layer_normalised(value.chain, width, epsilon, gain, bias, at)
        case "batch_norm", [Value() as value, gain, bias, mean, var, bool(training), _, float(epsilon), *_] if all(
            v is None or is_array(v) for v in (gain, bias, mean, var)
        ):
            if training or mean is None or var is None:
                raise InputError(f"{at} must be in evaluation mode, with the statistics of training. {_EVALUATED}")
            return graph.batch_normalised(value.chain, mean, var, epsilon, gain, bias, at)
    match given:
        case [Value() as value, [int(width)], gain, *rest] if (
            name == "rms_norm" and width == gives(value.chain, wide) and (gain is None or is_array(gain))
        ):
            said = rest[0] if rest else None
            if said is None and gain is not None and gain.dtype == np.float32:
                said = _SINGLE
            if not isinstance(said, float):
                raise InputError(f"{at} must have a number for its epsilon, as in torch.nn.RMSNorm({width}, eps=1e-6).")
            made = graph.root_normalised(value.chain, width, Fraction(said), at)
            return made if gain is None else graph.scaled(made, gain, at)
    raise InputError(f"{at} is read of a value that depends on the observation, over one axis, with constants.")


def _all_depend(given: Any) -> bool:
    """True if all of these depend on the observation."""
    return isinstance(given, list) and len(given) > 1 and all(depends(v) for v in given)


def _step(name: str, place: int, count: int, chain: Chain, given: tuple[Any, ...], at: str) -> Chain:
    match name, place, count:
        case "linear", 0, 2 | 3:
            return graph.affine(chain, given[0], given[1] if count == 3 else None, at)
        case "addmm", 1, 3:
            return graph.affine(chain, graph.real(given[1], at).T, given[0], at)
        case "matmul" | "mm", 0, 2:
            return graph.affine(chain, graph.real(given[0], at).T, None, at)
        case "add", _, 2:
            return graph.shifted(chain, given[0], at)
        case "sub", 0, 2:
            return graph.shifted(chain, given[0], at, sign=-1)
        case ("sub", 1, 2) | ("rsub", 0, 2):
            return graph.shifted(graph.negated(chain), given[0], at)
        case "mul", _, 2:
            return graph.scaled(chain, given[0], at)
        case "div", 0, 2:
            return graph.scaled(chain, given[0], at, divide=True)
        case "neg", 0, 1:
            return graph.negated(chain)
        case "abs", 0, 1:
            return graph.magnitude(chain)
        case "pow", 0, 2:
            return graph.powered(chain, given[0], at)
        case "leaky_relu" | "celu", 0, 1 | 2:
            return graph.mapped(chain, name, *given)
        case "prelu", 0, 2:
            return graph.leaked(chain, given[0], at)
        case "softplus", 0, 3 if given[0] > 0 and given[1] == 20:
            return graph.mapped(chain, "softplus", given[0])
        case "elu", 0, 2 | 3 | 4 if given[1:] == (1.0, 1.0)[: len(given) - 1]:
            return graph.mapped(chain, name, given[0])
        case _, 0, _ if name in _ACTIVATIONS and given == _ACTIVATIONS[name][: len(given)]:
            return graph.mapped(chain, name.replace("log_s", "logs"))
        case "relu", 0, 1:
            return graph.clipped(chain, 0.0, None, at)
        case ("clamp", 0, 1 | 2 | 3) | ("hardtanh", 0, 1 | 2 | 3):
            lo, hi = (*given, *_DEFAULTS[name][len(given) :])
            return graph.clipped(chain, lo, hi, at)
        case "maximum" | "max", _, 2 if is_array(given[0]):  # of a number max is a reduction
            return graph.clipped(chain, given[0], None, at)
        case "minimum" | "min", _, 2 if is_array(given[0]):
            return graph.clipped(chain, None, given[0], at)
    said = f" with {', '.join(map(str, given))}" if name in _ACTIVATIONS else ""
    raise InputError(f"{at}{said} is not read: the operations are {KNOWN}. {WITH_TANH}")


def run(name: str, given: list[Any], double: bool) -> Any:
    """torch's own operation, with its constants as they are or in double precision."""
    import torch

    kind = np.float64 if double else None
    arguments = [torch.from_numpy(np.array(v, dtype=kind)) if is_array(v) else v for v in given]
    return _FUNCTIONS[name](torch, *arguments)


def _functional(name: str) -> Callable[..., Any]:
    return lambda torch, *given: getattr(torch.nn.functional, name)(*given)


def _of_torch(name: str) -> Callable[..., Any]:
    return lambda torch, *given: getattr(torch, name)(*given)


def _sliced(torch: Any, value: Any, axis: int, start: int | None, stop: int | None = None, *_: int) -> Any:
    return value[:, start:stop]


_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{
        name: _of_torch(name)
        for name in (
            *(
                "addmm",
                "matmul",
                "mm",
                "add",
                "sub",
                "rsub",
                "mul",
                "div",
                "neg",
                "abs",
                "pow",
                "tanh",
                "sigmoid",
                "relu",
            ),
            *("clamp", "maximum", "minimum", "max", "min", "sqrt", "rsqrt", "reciprocal", "narrow", "mean"),
        )
    },
    **{
        name: _functional(name)
        for name in (
            *(
                "linear",
                "silu",
                "gelu",
                "mish",
                "leaky_relu",
                "selu",
                "celu",
                "hardsigmoid",
                "hardswish",
                "relu6",
                "softplus",
            ),
            *("hardtanh", "prelu"),
        )
    },
    "held": lambda torch, row: row,
    "cat": lambda torch, *values: torch.cat(values, 1),
    "slice": _sliced,
    "gelu-tanh": lambda torch, h: torch.nn.functional.gelu(h, approximate="tanh"),
    "elu": lambda torch, h, alpha=1.0, *_: torch.nn.functional.elu(h, alpha),
    "layer_norm": lambda torch, *given: torch.nn.functional.layer_norm(*given[:5]),
    "rms_norm": lambda torch, h, shape, gain=None, epsilon=None: torch.nn.functional.rms_norm(
        h, shape, gain, _SINGLE if epsilon is None else epsilon
    ),
    "batch_norm": lambda torch, h, gain, bias, mean, var, training, momentum, epsilon, *_: (
        torch.nn.functional.batch_norm(h, mean, var, gain, bias, False, momentum, epsilon)
    ),
    "log_sigmoid": _functional("logsigmoid"),
}


def is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray)
