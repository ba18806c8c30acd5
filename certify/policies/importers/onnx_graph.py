"""ONNX graphs of Gemm, MatMul, Add, Sub, Mul, Div, Neg, Clip, Relu and Tanh that form one chain.

The file is parsed and never run; tensors that lie in other files are not followed. The comparison asks the reference
evaluator of the onnx package, which knows the standard operators and nothing else.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from certify.errors import InputError
from certify.policies.importers import graph
from certify.policies.importers.arrays import Numbers
from certify.policies.importers.graph import Chain
from certify.policies.importers.reading import Observations, Reading, Values

_KNOWN = "Gemm, MatMul, Add, Sub, Mul, Div, Neg, Clip, Relu, Tanh, Identity and Constant"
_STANDARD = ("", "ai.onnx")
_FLAGS = {"Gemm": {"alpha", "beta", "transA", "transB"}, "Constant": {"value", "value_float", "value_floats"}}


def read_onnx(raw: bytes, what: str) -> Reading:
    """The policy of an ONNX file with one input and one output.

    Raises
    ------
    InputError : the onnx package is missing, the file is damaged, or the graph is no chain of known operations.
    """
    try:
        import onnx
        from google.protobuf.message import DecodeError
        from onnx.reference import ReferenceEvaluator
    except ImportError as error:
        raise InputError(
            "a file of ONNX needs the package that reads it; install it with pip install 'certify[onnx]'."
        ) from error
    try:
        model = onnx.load_model_from_string(raw)
    except (DecodeError, ValueError, RuntimeError) as error:
        raise InputError(f"{what} is no ONNX file or is damaged: {error}.") from error
    if model.functions or any(opset.domain not in _STANDARD for opset in model.opset_import):
        raise InputError(f"{what} must hold standard operators only; it defines or imports others.")
    name, output = _ends(model.graph, what)
    steps = _walk(model.graph, name, output, what)
    double = any(t.data_type == onnx.TensorProto.DOUBLE for t in model.graph.initializer)
    try:
        evaluators = {False: ReferenceEvaluator(model), True: ReferenceEvaluator(_doubled(model))}
    except (RuntimeError, TypeError, ValueError, KeyError, AttributeError) as error:
        raise InputError(f"the evaluator of the onnx package cannot read {what}: {error}.") from error

    def evaluate(x: Observations, double: bool) -> Values:
        given = x.astype(np.float64 if double else np.float32)
        values: Values = np.asarray(evaluators[double].run([output], {name: given})[0])
        return values

    nodes = [node.op_type for node in model.graph.node if node.op_type != "Constant"]
    return Reading(words=f"ONNX graph {', '.join(nodes)[:200]}", steps=steps, evaluate=evaluate, double=double)


def _doubled(model: Any) -> Any:
    """The same model with its constants in double precision."""
    import onnx
    from onnx import numpy_helper

    copied = onnx.ModelProto()
    copied.CopyFrom(model)
    attributes = [a for node in copied.graph.node if node.op_type == "Constant" for a in node.attribute]
    for tensor in (*copied.graph.initializer, *(a.t for a in attributes if a.name == "value")):
        tensor.CopyFrom(numpy_helper.from_array(_constant(tensor, "the graph").astype(np.float64), tensor.name))
    return copied


def _ends(graph_: Any, what: str) -> tuple[str, str]:
    """The names of the one input that is no constant, and of the one output."""
    constants = {t.name for t in graph_.initializer}
    inputs = [value.name for value in graph_.input if value.name not in constants]
    outputs = [value.name for value in graph_.output]
    if len(inputs) != 1 or len(outputs) != 1:
        raise InputError(
            f"the graph of {what} must have one input, the observation, and one output, the action; "
            f"found {', '.join(inputs) or 'none'} and {', '.join(outputs) or 'none'}."
        )
    return inputs[0], outputs[0]


def _walk(graph_: Any, name: str, output: str, what: str) -> Chain:
    """The steps that lead from the input to the output."""
    if graph_.sparse_initializer:
        raise InputError(f"the tensors of {what} must be dense.")
    constants: dict[str, Numbers] = {}
    for tensor in graph_.initializer:
        if tensor.name in constants:
            raise InputError(f"{what} must name each tensor once; {tensor.name} stands there twice.")
        constants[tensor.name] = _constant(tensor, what)
    chains: dict[str, Chain] = {name: ()}
    for node in graph_.node:
        at = f"{node.op_type} {node.name}".strip()
        if node.domain not in _STANDARD or len(node.output) != 1:
            raise InputError(f"{what} must hold {_KNOWN}; found {node.domain}.{at}.")
        if node.output[0] in chains or node.output[0] in constants:
            raise InputError(f"{what} must name each value once; {node.output[0]} stands there twice.")
        flags = {a.name: a for a in node.attribute}
        if len(flags) != len(node.attribute):
            raise InputError(f"{at} in {what} must have each attribute once.")
        unknown = sorted(set(flags) - _FLAGS.get(node.op_type, set()))
        if unknown:
            raise InputError(
                f"{at} in {what} has {', '.join(unknown)}, which is not read; the operations are {_KNOWN}."
            )
        if node.op_type == "Constant":
            constants[node.output[0]] = _attribute(flags, what)
            continue
        given = [None if not i else chains[i] if i in chains else constants.get(i) for i in node.input]
        if any(i and v is None for i, v in zip(node.input, given, strict=True)):
            raise InputError(f"{at} in {what} reads a value that nothing before it makes.")
        chains[node.output[0]] = _apply(node.op_type, given, flags, f"{at} in {what}")
    if output not in chains:
        raise InputError(f"the output of {what} does not depend on its input.")
    return chains[output]


def _apply(kind: str, given: list[Any], flags: dict[str, Any], at: str) -> Chain:
    found = [k for k, value in enumerate(given) if isinstance(value, tuple)]
    if len(found) != 1:
        raise InputError(
            f"{at} must join one value that depends on the observation with constants; it has {len(found)}."
        )
    chain: Chain
    place, chain, others = found[0], given[found[0]], [v for v in given if not isinstance(v, tuple)]
    match kind, place, len(given):
        case "Gemm", 0, 2 | 3:
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
        case "MatMul", 0, 2:
            weight = graph.real(given[1], at)
            if weight.ndim != 2:
                raise InputError(f"the weight of {at} must be a matrix; its shape is {weight.shape}.")
            return graph.affine(chain, weight.T, None, at)
        case "Add", _, 2:
            return graph.shifted(chain, others[0], at)
        case "Sub", 0, 2:
            return graph.shifted(chain, others[0], at, sign=-1)
        case "Sub", 1, 2:
            return graph.shifted(graph.negated(chain), others[0], at)
        case "Mul", _, 2:
            return graph.scaled(chain, others[0], at)
        case "Div", 0, 2:
            return graph.scaled(chain, others[0], at, divide=True)
        case "Neg", 0, 1:
            return graph.negated(chain)
        case "Tanh", 0, 1:
            return graph.tanh(chain)
        case "Identity", 0, 1:
            return chain
        case "Relu", 0, 1:
            return graph.clipped(chain, 0.0, None, at)
        case "Clip", 0, 1 | 2 | 3:
            bounds = [*given[1:], None, None]
            return graph.clipped(chain, bounds[0], bounds[1], at)
    raise InputError(f"{at} is not read: only tanh networks are proved, and the operations are {_KNOWN}.")


def _attribute(flags: dict[str, Any], what: str) -> Numbers:
    if set(flags) == {"value"}:
        return _constant(flags["value"].t, what)
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
    if tensor.data_type not in (onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE):
        raise InputError(f"tensor {tensor.name} of {what} must hold floating-point numbers (float32 or float64).")
    if any(size < 0 for size in tensor.dims):
        raise InputError(f"the shape of tensor {tensor.name} of {what} must have no negative size.")
    try:
        array: Numbers = numpy_helper.to_array(tensor)
    except (ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"tensor {tensor.name} of {what} is damaged: {error}.") from error
    return array
