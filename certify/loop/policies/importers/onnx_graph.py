"""ONNX graphs of Gemm, MatMul, Add, Sub, Mul, Div, Neg, Clip and activations that form one chain.

The file is parsed, and only the part of its graph that the action depends on is read. The comparison runs that part in
the reference evaluator of the onnx package, which knows only the standard operators. Exporters add operations that
change no number: Identity, Cast between float32 and float64, Flatten, Reshape to the same width, and Expand to the
width that a value has already, which is removed before the graph runs.
"""

from __future__ import annotations

from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from certify.errors import InputError
from certify.loop.files.arrays import Numbers
from certify.loop.policies.importers.graph import Chain
from certify.loop.policies.importers.onnx_operations import (
    ACTIVATIONS,
    ADVICE,
    KNOWN,
    NORMALISATIONS,
    OPERATIONS,
    TAKES_INTEGERS,
    Made,
    applied,
)
from certify.loop.policies.importers.onnx_weights import load_weights
from certify.loop.policies.importers.onnx_written import with_gelu, written_out
from certify.loop.policies.importers.options import WITH_TANH, WITHOUT_NORMALISATION
from certify.loop.policies.importers.reading import Observations, Reading, Values

_STANDARD = ("", "ai.onnx")
_FLAGS = {
    "Gemm": {"alpha", "beta", "transA", "transB"},
    "Conv": {"auto_pad", "dilations", "group", "kernel_shape", "pads", "strides"},
    "Constant": {"value", "value_float", "value_floats", "value_int", "value_ints"},
    "Cast": {"to", "saturate"},
    "Flatten": {"axis"},
    "Reshape": {"allowzero"},
    "Elu": {"alpha"},
    "LeakyRelu": {"alpha"},
    "Celu": {"alpha"},
    "HardSigmoid": {"alpha", "beta"},
    "ReduceMean": {"axes", "keepdims", "noop_with_empty_axes"},
    "Selu": {"alpha", "gamma"},
    "Concat": {"axis"},
    "Gelu": {"approximate"},
    "LayerNormalization": {"axis", "epsilon", "stash_type"},
    "BatchNormalization": {"epsilon", "momentum", "training_mode"},
    "Split": {"axis", "num_outputs"},
    "Gather": {"axis"},
}
_ELEMENTWISE = {
    "Add",
    "Sub",
    "Mul",
    "Div",
    "Neg",
    "Clip",
    "Relu",
    *ACTIVATIONS,
    "Exp",
    "Log",
    "Identity",
    "Cast",
    "Pow",
    "Abs",
    "Sqrt",
    "PRelu",
    "Min",
    "Max",
    "Reciprocal",
    "HardSigmoid",
    "HardSwish",
}


def read_onnx(raw: bytes, what: str, wanted: str | None = None, folder: Path | None = None) -> Reading:
    """The policy of an ONNX file with one input.

    Parameters
    ----------
    wanted : the output that is the action; None if there is only one.
    folder : the folder of the file, and of a file of its weights if there is one.

    Raises
    ------
    InputError : the onnx package is missing, the file is damaged, has several outputs and `wanted` is none of them, its
        weights lie where they are not read, or the graph is no chain of known operations.
    """
    try:
        import onnx
        from google.protobuf.message import DecodeError
        from onnx.reference import ReferenceEvaluator
    except ImportError as error:
        raise InputError(
            "a file of ONNX needs the package that reads it; "
            "install it with pip install '.[onnx]' in the project's folder."
        ) from error
    try:
        model = onnx.load_model_from_string(raw)
    except (DecodeError, ValueError, RuntimeError) as error:
        raise InputError(f"{what} is no ONNX file or is damaged: {error}.") from error
    if model.functions:
        raise InputError(f"{what} must hold standard operators only; it defines others.")
    old = any(opset.version < 14 for opset in model.opset_import if opset.domain in _STANDARD)
    if old and any(node.op_type == "BatchNormalization" for node in model.graph.node):
        # onnx's own evaluator takes the moments of the batch there
        raise InputError(f"{what} has a BatchNormalization of an old opset; export it with opset_version=17 or later.")
    name, output = _ends(model.graph, wanted, what)
    unread = _prune(model, output, what)
    beside = load_weights(model.graph, folder, what)
    gemms = _as_numpy_broadcasts(model)
    shape = _given_shape(model.graph, name, what)
    steps = _walk(model.graph, name, output, shape, what)
    for node in gemms:
        node.attribute.append(onnx.helper.make_attribute("broadcast", 1))  # without it onnx's evaluator takes one row
    double = any(t.data_type == onnx.TensorProto.DOUBLE for t in model.graph.initializer)
    try:
        evaluators = {False: ReferenceEvaluator(model), True: ReferenceEvaluator(_doubled(model))}
    except (RuntimeError, TypeError, ValueError, KeyError, AttributeError) as error:
        raise InputError(f"the evaluator of the onnx package cannot read {what}: {error}.") from error

    def evaluate(x: Observations, double: bool) -> Values:
        given = x.reshape(len(x), *shape[1:]) if len(shape) > 2 else x
        given = given.astype(np.float64 if double else np.float32)
        with np.errstate(all="ignore"):  # of the branch that Elu does not take; what is not finite is refused later
            values: Values = np.asarray(evaluators[double].run([output], {name: given})[0])
        return values.reshape(len(x), -1) if len(shape) > 2 else values

    kinds = [node.op_type for node in model.graph.node if node.op_type != "Constant"]
    return Reading(
        words=f"ONNX graph {', '.join(kinds)[:200]}",
        steps=steps,
        evaluate=evaluate,
        double=double,
        program=f"the file's graph as far as {output}, run by the reference evaluator of onnx",
        unread=dict.fromkeys(unread, f"{output} does not depend on it"),
        beside=beside,
    )


def _as_numpy_broadcasts(model: Any) -> list[Any]:
    """Take the attribute `broadcast` away where it is without an axis, and return the nodes of Gemm before opset 7.

    Before opset 7 the shapes of two operands must be equal; with `broadcast` the second may be one number, or have the
    last axes of the first. So it is in numpy, which also takes shapes that those operators do not.
    """
    if all(opset.version >= 7 for opset in model.opset_import if opset.domain in _STANDARD):
        return []
    nodes = [node for node in model.graph.node if node.op_type in ("Gemm", "Add", "Sub", "Mul", "Div")]
    for node in nodes:
        said = {a.name: a.i for a in node.attribute}
        if said.get("broadcast") in (0, 1) and "axis" not in said:
            for k in reversed([k for k, a in enumerate(node.attribute) if a.name == "broadcast"]):
                del node.attribute[k]
    return [node for node in nodes if node.op_type == "Gemm"]


def _prune(model: Any, output: str, what: str) -> list[str]:
    """Remove all from a model that the output does not depend on; return the names of the removed tensors."""
    graph_ = model.graph
    widths = _widths(graph_)
    wanted, nodes = {output}, []
    for node in reversed(graph_.node):
        if not wanted.intersection(node.output):
            continue
        kept = type(node)()
        kept.CopyFrom(node)
        if node.op_type == "Expand" and len(node.input) == 2:
            before, after = (widths.get(name) for name in node.input)
            if before is None or before != after:
                raise InputError(f"Expand {node.name} in {what} must leave a value as wide as it is.")
            kept.op_type = "Identity"
            del kept.input[1:]
        nodes.append(kept)
        wanted.update(kept.input)
    left_out = [t.name for t in graph_.initializer if t.name not in wanted]
    for field, keep in (("initializer", wanted), ("output", {output})):
        values = getattr(graph_, field)
        for k in reversed([k for k, value in enumerate(values) if value.name not in keep]):
            del values[k]
    del graph_.node[:]
    graph_.node.extend(nodes[::-1])
    return left_out


def _widths(graph_: Any) -> dict[str, int]:
    """The widths of the graph's values, as far as the layers determine them, and of those whose shape is taken."""
    found: dict[str, int] = {}
    sizes = {tensor.name: tuple(tensor.dims) for tensor in graph_.initializer}
    for name, size in sizes.items():
        if all(k == 1 for k in size[:-1]):
            found[name] = size[-1] if size else 1
    for node in graph_.node:
        kind, given = node.op_type, list(node.input)
        size = sizes.get(given[1], ()) if len(given) > 1 else ()
        if kind == "Constant":
            dims = next((tuple(a.t.dims) for a in node.attribute if a.name == "value"), None)
            width = 1 if dims == () else dims[-1] if dims and all(k == 1 for k in dims[:-1]) else None
        elif kind in ("Gemm", "MatMul"):
            turned = kind == "Gemm" and any(a.name == "transB" and a.i for a in node.attribute)
            width = size[0 if turned else 1] if len(size) == 2 else None
        elif kind in ("Shape", "ConstantOfShape"):
            width = found.get(given[0]) if given and not node.attribute[1:] else None
        elif kind == "Expand":
            width = found.get(given[-1])
        elif kind in _ELEMENTWISE:
            several = {found.get(name) for name in given if name} - {1}
            width = 1 if not several else several.pop() if len(several) == 1 else None
        else:
            width = None
        if width is not None and len(node.output) == 1:
            found[node.output[0]] = width
    return found


def _doubled(model: Any) -> Any:
    """The same model with its constants in double precision."""
    import onnx
    from onnx import numpy_helper

    copied = onnx.ModelProto()
    copied.CopyFrom(model)
    written_out(copied.graph)
    attributes = [(node.op_type, a) for node in copied.graph.node for a in node.attribute]
    held = (a.t for kind, a in attributes if kind == "Constant" and a.name == "value")
    for tensor in (*copied.graph.initializer, *held):
        if tensor.data_type == onnx.TensorProto.FLOAT:
            tensor.CopyFrom(numpy_helper.from_array(_constant(tensor, "the graph").astype(np.float64), tensor.name))
    for kind, a in attributes:
        if kind == "Cast" and a.i == onnx.TensorProto.FLOAT:
            a.i = onnx.TensorProto.DOUBLE
    return copied


def _ends(graph_: Any, wanted: str | None, what: str) -> tuple[str, str]:
    """The names of the one input that is no constant, and of the output that is the action."""
    constants = {t.name for t in graph_.initializer}
    inputs = [value.name for value in graph_.input if value.name not in constants]
    outputs = [value.name for value in graph_.output]
    if len(inputs) != 1 or not outputs:
        raise InputError(
            f"the graph of {what} must have one input, the observation, and an output, the action; "
            f"found {', '.join(inputs) or 'none'} and {', '.join(outputs) or 'none'}."
        )
    if wanted is None and len(outputs) > 1:
        raise InputError(
            f"the graph of {what} must have one output, the action; it has {', '.join(outputs)}. Say which is the "
            f"action with --output, as in --output {outputs[0]}."
        )
    if wanted is not None and wanted not in outputs:
        raise InputError(f"--output must name an output of {what}, {', '.join(outputs)}; found {wanted!r}.")
    return inputs[0], wanted if wanted is not None else outputs[0]


def _walk(graph_: Any, name: str, output: str, shape: tuple[int, ...], what: str) -> Chain:
    """The steps that lead from the input, of such a shape, to the output."""
    if graph_.sparse_initializer:
        raise InputError(f"the tensors of {what} must be dense.")
    constants: dict[str, Numbers] = {}
    for tensor in graph_.initializer:
        if tensor.name in constants:
            raise InputError(f"{what} must name each tensor once; {tensor.name} stands there twice.")
        constants[tensor.name] = _constant(tensor, what)
    chains: dict[str, Made] = {name: ()}
    wide = prod(shape[1:]) if len(shape) > 2 else max(shape[-1:], default=0)
    said = [node for node in graph_.node if node.op_type == "Constant" and len(node.output) == 1]
    numbers = {node.output[0]: _attribute({a.name: a for a in node.attribute}, what) for node in said}
    for node in with_gelu(list(graph_.node), constants | numbers, output):
        at = f"{node.op_type} {node.name}".strip()
        if node.domain not in _STANDARD or (len(node.output) != 1 and node.op_type != "Split"):
            raise InputError(f"{what} must hold {KNOWN}; found {node.domain}.{at}.")
        if any(made in chains or made in constants for made in node.output):
            raise InputError(f"{what} must name each value once; {node.output[0]} stands there twice.")
        if node.op_type in NORMALISATIONS:
            raise InputError(f"{at} in {what} is not read. {WITHOUT_NORMALISATION}")
        if node.op_type not in OPERATIONS:
            advice = ADVICE.get(node.op_type, f"The operations are {KNOWN}. {WITH_TANH}")
            raise InputError(f"{at} in {what} is not read. {advice}")
        flags = {a.name: a for a in node.attribute}
        if len(flags) != len(node.attribute):
            raise InputError(f"{at} in {what} must have each attribute once.")
        unknown = sorted(set(flags) - _FLAGS.get(node.op_type, set()))
        if unknown:
            raise InputError(f"{at} in {what} has {', '.join(unknown)}, which is not read; the operations are {KNOWN}.")
        if node.op_type == "Constant":
            constants[node.output[0]] = numbers[node.output[0]]
            continue
        given = [None if not i else chains[i] if i in chains else constants.get(i) for i in node.input]
        if any(i and v is None for i, v in zip(node.input, given, strict=True)):
            raise InputError(f"{at} in {what} reads a value that nothing before it makes.")
        integers = [v for v in given if isinstance(v, np.ndarray) and v.dtype.kind not in "fO"]
        if len(integers) < len(given) and integers and node.op_type not in TAKES_INTEGERS:
            raise InputError(f"{at} in {what} must be of floating-point numbers (float32 or float64).")
        for end, made in zip(
            node.output, applied(node.op_type, given, flags, wide, len(node.output), f"{at} in {what}"), strict=True
        ):
            (constants if isinstance(made, np.ndarray) else chains)[end] = made  # type: ignore[assignment]
    if output not in chains:
        raise InputError(f"the output of {what} does not depend on its input.")
    found = chains[output]
    if not isinstance(found, tuple):
        raise InputError(f"the output of {what} must be rows of actions.")
    return found


def _given_shape(graph_: Any, name: str, what: str) -> tuple[int, ...]:
    """The shape of the graph's input, with 0 for what the graph leaves open: images of one size, or rows."""
    (dims,) = (value.type.tensor_type.shape.dim for value in graph_.input if value.name == name)
    shape = tuple(max(0, int(dim.dim_value)) for dim in dims)
    if len(shape) > 2 and not all(shape[1:]):
        raise InputError(f"the input of {what} must be rows, or images whose size the graph says; found {shape}.")
    return shape


def _attribute(flags: dict[str, Any], what: str) -> Numbers:
    if set(flags) == {"value"}:
        return _constant(flags["value"].t, what)
    if set(flags) == {"value_int"}:
        return np.array(flags["value_int"].i)
    if set(flags) == {"value_ints"}:
        return np.array(list(flags["value_ints"].ints))
    if set(flags) == {"value_float"}:
        return np.array(flags["value_float"].f)
    if set(flags) == {"value_floats"}:
        return np.array(list(flags["value_floats"].floats))
    raise InputError(f"a Constant in {what} must be a tensor or floats; found {sorted(flags)}.")


def _constant(tensor: Any, what: str) -> Numbers:
    """A tensor that lies in the file itself, with as many numbers as its shape says."""
    import onnx
    from onnx import numpy_helper

    if tensor.data_location == onnx.TensorProto.EXTERNAL or tensor.external_data:
        raise InputError(f"tensor {tensor.name} of {what} must lie in the file itself; it lies in another one.")
    if tensor.data_type not in (onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE, onnx.TensorProto.INT64):
        raise InputError(f"tensor {tensor.name} of {what} must hold floating-point numbers (float32 or float64).")
    if any(size < 0 for size in tensor.dims):
        raise InputError(f"the shape of tensor {tensor.name} of {what} must have no negative size.")
    try:
        array: Numbers = numpy_helper.to_array(tensor)
    except (ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"tensor {tensor.name} of {what} is damaged: {error}.") from error
    return array
