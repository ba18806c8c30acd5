"""ONNX's operators by their names, as exact steps on the values of a graph."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from certify.errors import InputError
from certify.loop.files.arrays import Numbers
from certify.loop.policies.importers import graph
from certify.loop.policies.importers.constants import computed, is_constant
from certify.loop.policies.importers.graph import Chain
from certify.loop.policies.importers.operations import ADVICE as torch_advice
from certify.loop.policies.importers.options import WITH_TANH
from certify.loop.policies.importers.reading import gives
from certify.loop.policies.importers.steps import MOST_NORMALISED, Activate, Affine, Diagonal, activated

ACTIVATIONS = ("Tanh", "Elu", "Sigmoid", "Gelu", "Softplus", "Mish", "Softsign", "LeakyRelu", "Selu", "Celu")
OPERATIONS = {
    "Gemm", "MatMul", "Conv", "Add", "Sub", "Mul", "Div", "Neg", "Clip", "Relu", *ACTIVATIONS,
    "Identity", "Cast", "Flatten", "Reshape", "Constant", "Concat", "LayerNormalization", "Pow",
    "Abs", "HardSigmoid", "HardSwish", "ReduceMean", "Sqrt", "Reciprocal", "Min", "Max", "PRelu", "Log", "Greater",
    "Where", "Slice", "Split", "BatchNormalization", "Shape", "Gather",
}  # fmt: skip
KNOWN = (
    f"Gemm, MatMul, Add, Sub, Mul, Div, Neg, Clip, Relu, {', '.join(ACTIVATIONS)}, "
    "PRelu, HardSigmoid, HardSwish, Abs, Pow, Min, Max, LayerNormalization, ReduceMean and Sqrt as parts of one, "
    "BatchNormalization, Concat, Slice, Split, Identity, Flatten, Constant, and Conv whose kernel is as large as its "
    "image"
)
NORMALISATIONS = ("InstanceNormalization", "GroupNormalization")
_SELU = {"gamma": float(np.float32(1.05070102214813)), "alpha": float(np.float32(1.67326319217681))}  # of the standard
_HARD_SIGMOID = {"alpha": float(np.float32(0.2)), "beta": 0.5}
TAKES_INTEGERS = ("Reshape", "Pow", "ReduceMean", "Slice", "Split", "Gather")
_CONSTANTS = {"Add": "add", "Sub": "sub", "Mul": "mul", "Div": "div", "Neg": "neg", "Sqrt": "sqrt", "Pow": "pow"}
_CONSTANTS |= {"Reciprocal": "reciprocal", "Min": "minimum", "Max": "maximum", "Abs": "abs"}


ADVICE: Mapping[str, str] = {
    **dict.fromkeys(("Sin", "Cos"), torch_advice["cos"]),
    **dict.fromkeys(("Unsqueeze", "Squeeze"), torch_advice["select"]),
    **dict.fromkeys(("ReduceL2", "Einsum"), "Write the weights out, as a matrix, before the export."),
}
"""The next step where an operator is not read, by its name."""


@dataclass(frozen=True, slots=True)
class Root:
    """The square root of a value, by which another may be divided, or the inverse of that."""

    under: Chain
    inverse: bool = False


@dataclass(frozen=True, slots=True)
class Above:
    """The comparison of a value with a number, which softplus is written with."""

    chain: Chain
    than: float


@dataclass(frozen=True, slots=True)
class Shape:
    """The shape of a value whose rows have so many numbers."""

    width: int


Made = Chain | Root | Above | Shape | Numbers
"""The value of a graph's node: steps from the observation, a constant, or a part of what is read as one."""


def applied(kind: str, given: list[Any], flags: dict[str, Any], wide: int, count: int, at: str) -> list[Made]:
    """The values of a node, `count` of them.

    Parameters
    ----------
    wide : the number of observations; 0 if the graph leaves it open.

    Raises
    ------
    InputError : the node is none that is read.
    """
    if all(v is None or is_constant(v) for v in given):
        return [_constant(kind, given, flags, wide, at)]
    if kind == "Shape" and isinstance(given[0], tuple) and not flags:
        return [Shape(gives(given[0], wide))]
    if kind == "Gather" and isinstance(given[0], Shape) and np.ravel(given[1]).tolist() in ([1], [-1]):
        return [np.full(np.shape(given[1]), given[0].width)]
    if kind == "Gather":
        raise InputError(f"{at} is not read. {torch_advice['select']}")
    if kind == "Slice":
        return [_sliced(given, wide, at)]
    if kind == "Split":
        return _split(given, flags, wide, count, at)
    if kind == "ReduceMean":
        return [_averaged(given, flags, wide, at)]
    if kind == "Conv":
        return [_convolved(given, flags, wide, at)]
    return [_apply(kind, given, flags, at)]


def _constant(kind: str, given: list[Any], flags: dict[str, Any], wide: int, at: str) -> Made:
    """A node of constants alone; a layer of a constant row is steps from 0 times the observation."""
    if kind == "Cast":
        _require_real(flags, at)
    if kind in ("Cast", "Identity") and len(given) == 1:
        return np.asarray(given[0])
    values = [v for v in given if v is not None]
    if (
        kind in ("Add", "Sub", "Mul", "Div")
        and len(values) == 2
        and all(isinstance(v, np.ndarray) and v.dtype.kind == "i" for v in values)
    ):
        one, other = values  # sizes of a row
        whole = {"Add": np.add, "Sub": np.subtract, "Mul": np.multiply, "Div": np.floor_divide}[kind]
        if kind == "Div" and (np.any(other <= 0) or np.any(one < 0)):
            raise InputError(f"{at} divides integers that are not positive.")
        return np.asarray(whole(one, other))
    made = computed(_CONSTANTS.get(kind, ""), tuple(values), at)
    if made is None and kind in ("Gemm", "MatMul") and wide and len(values) == len(given) > 1:
        return _apply(kind, [graph.held(given[0], wide, at), *given[1:]], flags, at)
    if made is None:
        raise InputError(
            f"{at} joins constants alone, and is not read of these; it must join one value that depends on the "
            "observation with constants."
        )
    return made


def _sliced(given: list[Any], wide: int, at: str) -> Chain:
    """Entries of a row: Slice(value, starts, ends, axes, steps)."""
    value, *said = given
    numbers = [[0] if v is None else np.ravel(v).tolist() for v in said]
    match numbers:
        case [[int(start)], [int(stop)], [1 | -1], *steps] if isinstance(value, tuple) and steps in ([], [[1]]):
            return graph.selected(value, gives(value, wide), start, stop, at)
        case [[0], [stop], [0], *steps] if isinstance(value, tuple) and stop >= 2**31 - 1 and steps in ([], [[1]]):
            return value
    raise InputError(f"{at} must take entries of a row, along axis 1 of a batch of observations (k, n).")


def _split(given: list[Any], flags: dict[str, Any], wide: int, count: int, at: str) -> list[Made]:
    """Rows taken apart: into parts of given sizes, or of equal ones."""
    value, width = given[0], gives(given[0], wide) if isinstance(given[0], tuple) else 0
    sizes = np.ravel(given[1]).tolist() if given[1:] and given[1] is not None else [-(-width // count)] * count
    if not width or "axis" not in flags or flags["axis"].i not in (1, -1) or len(sizes) != count:
        raise InputError(f"{at} must take apart the numbers of a row, along axis 1.")
    ends = np.minimum(np.cumsum([0, *sizes]), width).tolist()
    return [graph.selected(value, width, a, b, at) for a, b in pairwise(ends)]


def _averaged(given: list[Any], flags: dict[str, Any], wide: int, at: str) -> Chain:
    """The mean of a row, whose axis is an attribute or, from opset 18 on, a second input."""
    said = list(flags["axes"].ints) if "axes" in flags else np.ravel(given[1]).tolist() if given[1:] else []
    kept = flags["keepdims"].i if "keepdims" in flags else 1
    if not given or not isinstance(given[0], tuple) or said not in ([1], [-1]) or kept != 1:
        raise InputError(f"{at} (a part of LayerNorm, as exporters write it) must be over axis 1, with keepdims 1.")
    width = gives(given[0], wide)
    if not 0 < width <= MOST_NORMALISED:
        raise InputError(f"{at} must be of 1 to {MOST_NORMALISED} numbers, by a layer or by the shape of the input.")
    return graph.averaged(given[0], width)


def _convolved(given: list[Any], flags: dict[str, Any], wide: int, at: str) -> Chain:
    """A layer as a convolution whose kernel is as large as the image, so that it has one position there."""
    said = {name: flag.s if name == "auto_pad" else tuple(flag.ints) or flag.i for name, flag in flags.items()}
    plain = {"auto_pad": (b"NOTSET", b"VALID"), "group": (1,)}
    if len(given) not in (2, 3) or not isinstance(given[0], tuple):
        raise InputError(f"{at} must join one value that depends on the observation with constants.")
    weight = graph.real(given[1], at)
    once = all(said[name] in may for name, may in plain.items() if name in said)
    once = once and not any(said.get("pads", ())) and all(k == 1 for k in said.get("dilations", ()))
    if weight.ndim < 3 or not once or weight[:1].size != gives(given[0], wide):
        raise InputError(f"{at} must have a kernel as large as its image, one group, and neither padding nor dilation.")
    return graph.affine(given[0], weight.reshape(len(weight), -1), (*given, None)[2], at)


def _apply(kind: str, given: list[Any], flags: dict[str, Any], at: str) -> Made:
    if kind == "Sqrt" and len(given) == 1 and isinstance(given[0], tuple):
        return Root(given[0])
    if kind == "Greater" and len(given) == 2 and isinstance(given[0], tuple) and np.size(given[1]) == 1:
        return Above(given[0], float(np.ravel(graph.real(given[1], at))[0]))
    if kind == "Where":
        return _softplus(given, at)
    if any(isinstance(value, Above | Shape) for value in given):
        raise InputError(f"{at} reads a comparison or a shape, which is not read.")
    found = [k for k, value in enumerate(given) if isinstance(value, tuple | Root)]
    if any(isinstance(value, Root) for value in given) or (len(found) == 2 and kind == "Div"):
        return _divided(kind, given, at)
    if len(found) == len(given) == 2 and kind == "Mul":
        return graph.product(*given)
    if len(found) == len(given) > 1 and kind in ("Add", "Sub", "Concat"):
        return _joined(kind, given, flags, at)
    if len(found) != 1:
        raise InputError(
            f"{at} must join one value that depends on the observation with constants; it has {len(found)}. Add, Sub, "
            "Mul and Concat may join several."
        )
    return _on_one(kind, given, found[0], flags, at)


def _on_one(kind: str, given: list[Any], place: int, flags: dict[str, Any], at: str) -> Chain:
    """A node that reads one value, and constants."""
    chain: Chain
    chain, others = given[place], [v for v in given if not isinstance(v, tuple)]
    match kind, place, len(given):
        case "Gemm", 0, 2 | 3:
            return _gemm(chain, given, flags, at)
        case "MatMul", 0, 2:
            weight = graph.real(given[1], at)
            if weight.ndim != 2:
                raise InputError(f"the weight of {at} must be a matrix; its shape is {weight.shape}.")
            return graph.affine(chain, weight.T, None, at)
        case ("Add", _, 2) | ("Sub", 0, 2):
            return graph.shifted(chain, others[0], at, sign=-1 if kind == "Sub" else 1)
        case "Sub", 1, 2:
            return graph.shifted(graph.negated(chain), others[0], at)
        case "Mul", _, 2:
            return graph.scaled(chain, others[0], at)
        case "Div", 0, 2:
            return graph.scaled(chain, others[0], at, divide=True)
        case "Pow", 0, 2:
            return graph.powered(chain, others[0], at)
        case "Neg", 0, 1:
            return graph.negated(chain)
        case _, 0, 1 if kind in ACTIVATIONS:
            return _activated(chain, kind, flags, at)
        case "Abs", 0, 1:
            return graph.magnitude(chain)
        case "PRelu", 0, 2:
            return graph.leaked(chain, others[0], at)
        case "Max", _, 2:
            return graph.clipped(chain, others[0], None, at)
        case "Min", _, 2:
            return graph.clipped(chain, None, others[0], at)
        case "Log", 0, 1 if chain[-1:] == (Activate("sigmoid"),):
            return graph.mapped(chain[:-1], "logsigmoid")
        case "HardSwish" | "HardSigmoid" | "LayerNormalization" | "BatchNormalization", 0, _:
            return _composed(kind, chain, given, flags, at)
        case "Cast", 0, 1:
            _require_real(flags, at)
            return chain
        case "Identity", 0, 1:
            return chain
        case "Flatten", 0, 1 if flags["axis"].i in (1, -1) if "axis" in flags else True:
            return chain
        case "Reshape", 0, 2 if _keeps_width(chain, given[1]) and not ("allowzero" in flags and flags["allowzero"].i):
            return chain
        case "Relu", 0, 1:
            return graph.clipped(chain, 0.0, None, at)
        case "Clip", 0, 1 | 2 | 3:
            bounds = [*given[1:], None, None]
            return graph.clipped(chain, bounds[0], bounds[1], at)
    raise InputError(f"{at} is not read: the operations are {KNOWN}, with the observation in the usual place.")


def _softplus(given: list[Any], at: str) -> Chain:
    """Softplus as exporters write it, `Where(beta h > 20, h, softplus(beta h) / beta)`; the two differ by 2e-9."""
    match given:
        case [Above(chain=inner, than=than), tuple() as straight, tuple() as bent] if than >= 20 and all(
            a is b for chain in (inner, bent) for a, b in zip(straight, (*chain, *straight), strict=False)
        ):
            scales, more = inner[len(straight) :], bent[len(straight) :]
            betas = [step.scale[0] for step in scales if isinstance(step, Diagonal)]
            formula = activated("softplus", *betas[:1])
            if len(scales) < 2 and scales == formula[:-1][: len(scales)] and more == formula:
                return bent
    raise InputError(f"{at} is not read, but for softplus as exporters write it. {WITH_TANH}")


def _divided(kind: str, given: list[Any], at: str) -> Chain | Root:
    """A quotient of two values, or by the square root of one."""
    match kind, given:
        case ("Div", [tuple() as one, Root(inverse=False) as root]) | (
            "Mul",
            [tuple() as one, Root(inverse=True) as root] | [Root(inverse=True) as root, tuple() as one],
        ):
            return graph.divided_by_root(one, root.under, at)
        case ("Reciprocal", [Root(inverse=False) as root]) | ("Div", [np.ndarray(), Root(inverse=False) as root]) if (
            kind == "Reciprocal" or (np.size(given[0]) == 1 and np.ravel(given[0])[0] == 1)
        ):
            return Root(root.under, inverse=True)
        case "Div", [tuple() as one, tuple() as other]:
            return graph.divided(one, other, at)
    raise InputError(f"{at} reads a square root, which may only divide a value, as in layer normalisation.")


def _gemm(chain: Chain, given: list[Any], flags: dict[str, Any], at: str) -> Chain:
    """`alpha W h + beta b`."""
    if "transA" in flags and flags["transA"].i:
        raise InputError(f"{at} must not transpose the observation (transA).")
    alpha, beta = (float(flags[k].f) if k in flags else 1.0 for k in ("alpha", "beta"))
    weight = graph.real(given[1], at)
    if weight.ndim != 2:
        raise InputError(f"the weight of {at} must be a matrix; its shape is {weight.shape}.")
    weight = weight if "transB" in flags and flags["transB"].i else weight.T
    if alpha == 1 and beta == 1:
        return graph.affine(chain, weight, given[2] if len(given) == 3 else None, at)
    chain = graph.affine(chain, weight, None, at)
    chain = chain if alpha == 1 else graph.scaled(chain, alpha, at)
    if len(given) == 3 and given[2] is not None:
        chain = graph.moved(chain, tuple(v * graph.row(beta, at)[0] for v in graph.row(given[2], at)))
    return chain


def _composed(kind: str, chain: Chain, given: list[Any], flags: dict[str, Any], at: str) -> Chain:
    """Operations that are made of several steps."""
    if kind == "HardSwish" and len(given) == 1:
        return graph.mapped(chain, "hardswish")
    if kind == "HardSigmoid" and len(given) == 1:
        said = (float(flags[k].f) if k in flags else v for k, v in _HARD_SIGMOID.items())
        return graph.mapped(chain, "hardsigmoid", *said)
    if kind == "BatchNormalization":
        epsilon = float(flags["epsilon"].f) if "epsilon" in flags else float(np.float32(1e-5))
        if len(given) != 5 or any(v is None for v in given) or ("training_mode" in flags and flags["training_mode"].i):
            raise InputError(f"{at} must be in evaluation mode, with the statistics of training.")
        return graph.batch_normalised(chain, given[3], given[4], epsilon, given[1], given[2], at)
    axis = flags["axis"].i if "axis" in flags else -1
    if kind != "LayerNormalization" or len(given) not in (2, 3) or axis not in (1, -1):
        raise InputError(f"{at} is not read: it must normalise the numbers of a row, along axis 1.")
    epsilon = float(flags["epsilon"].f) if "epsilon" in flags else float(np.float32(1e-5))
    gain = graph.real(given[1], at)
    return graph.layer_normalised(chain, gain.size, epsilon, gain, (*given, None)[2], at)


def _joined(kind: str, chains: list[Chain], flags: dict[str, Any], at: str) -> Chain:
    """Values that depend on the observation, joined: sums, differences, and one behind the other in a row."""
    if kind == "Concat":
        if "axis" not in flags or flags["axis"].i not in (1, -1):
            raise InputError(f"{at} must put the numbers of a row one behind the other, along axis 1.")
        return graph.joined("concat", *chains)
    one, other = chains
    return graph.subtracted(one, other) if kind == "Sub" else graph.joined("sum", one, other)


_ALPHAS = {"LeakyRelu": float(np.float32(0.01)), "Elu": 1.0, "Celu": 1.0}  # where nothing is said


def _activated(chain: Chain, kind: str, flags: dict[str, Any], at: str) -> Chain:
    """An activation of the chain."""
    if kind in _ALPHAS:
        alpha = float(flags["alpha"].f) if "alpha" in flags else _ALPHAS[kind]
        name = "leaky_relu" if kind == "LeakyRelu" else kind.lower()
        return graph.mapped(chain, name, alpha)
    if kind == "Selu":
        return graph.mapped(chain, "selu", *(float(flags[k].f) if k in flags else v for k, v in _SELU.items()))
    approximate = flags["approximate"].s if "approximate" in flags else b"none"
    if approximate not in (b"none", b"tanh"):
        raise InputError(f"{at} must be the exact one or its tanh form; found approximate {approximate!r}.")
    return graph.mapped(chain, "gelu-tanh" if approximate == b"tanh" else kind.lower())


def _require_real(flags: dict[str, Any], at: str) -> None:
    """Refuse a Cast to integers or to half precision, which changes numbers by more than rounding."""
    import onnx

    if "to" not in flags or flags["to"].i not in (onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE):
        raise InputError(f"{at} must be a cast to float32 or float64.")


def _keeps_width(chain: Chain, shape: Any) -> bool:
    """True if a Reshape to `shape` leaves rows of a batch as they are, because it names their width."""
    wide = [step for step in chain if isinstance(step, Affine)]
    said = np.asarray(shape).ravel().tolist()
    return len(said) == 2 and (
        said == [0, -1] or (bool(wide) and said in ([-1, len(wide[-1].bias)], [0, len(wide[-1].bias)]))
    )
