"""Import policies in memory, a torch module or a state_dict, in the same way as their files.

A module is more than its tensors: the functions between the layers are in its code. So it is traced, and the trace is
read like a TorchScript archive: affine layers, activations and constant scalings, and nothing else. A trace follows one
observation and ignores branches; torch's warning about a branch counts as an error, and the folded policy is compared
with the module itself at states of the plant's domain, not with its trace. A state_dict holds only numbers, and missing
facts are asked for, as for a file.
"""

from __future__ import annotations

import copy
import io
import sys
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from certify.errors import InputError
from certify.loop.files.torchfile import written
from certify.loop.policies.importers.importing import Imported, import_bytes
from certify.loop.policies.importers.options import ImportOptions
from certify.loop.policies.importers.reading import Evaluate, Observations, Values

if TYPE_CHECKING:
    import torch

    from certify.loop.plants import System

_INSTEAD = (
    "Give its state_dict with the options of one, or a module of Linear layers, activations and constant scalings, "
    "whose forward takes states (k, n) and returns actions (k, m)."
)


def import_module(module: torch.nn.Module, plant: System, options: ImportOptions | None = None) -> Imported:
    """A torch module in evaluation mode as a policy of this program; the module is copied and stays as it is.

    Parameters
    ----------
    module : `forward` takes observations (k, n) and gives actions (k, m).
    plant : the plant that it controls.
    options : facts that the module does not contain, see `ImportOptions`.

    Raises
    ------
    InputError : it cannot be copied or traced, is no chain of supported layers, differs from the folded policy by more
    than rounding, or a fact is missing from the options.
    """
    options = options if options is not None else ImportOptions()
    name = f"the module {type(module).__name__}"
    n = plant.n if options.states is None else len(options.states)
    try:
        still = copy.deepcopy(module).cpu().eval()
        for layer in list(still.modules()):
            _write_out(layer)
        for parameter in still.parameters():
            parameter.requires_grad_(False)
        raw = _traced(still, n)
        evaluate = _evaluation(still, options.output)
    except Exception as error:  # code of whoever wrote the module
        raise InputError(f"{name} cannot be copied and traced: {_brief(error)} {_INSTEAD}") from error
    try:
        return import_bytes(raw, name, plant, options, evaluate=evaluate)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


def import_state_dict(tensors: Mapping[str, Any], plant: System, options: ImportOptions | None = None) -> Imported:
    """The layers `PREFIX.N.weight` and `PREFIX.N.bias` of a state_dict as a policy of this program.

    Parameters
    ----------
    tensors : torch tensors or arrays of floating-point numbers by their names; mappings of such count as well.
    plant : the plant that it controls.
    options : facts that the numbers do not contain, see `ImportOptions`.

    Raises
    ------
    InputError : a value is neither, the layers are not those of one policy, or a fact is missing from the options.
    """
    raw = written(_plain(tensors, "the state_dict"))
    try:
        return import_bytes(raw, "state_dict", plant, options if options is not None else ImportOptions())
    except InputError as error:
        raise InputError(f"the state_dict: {error}") from error


def _traced(module: torch.nn.Module, n: int) -> bytes:
    """The bytes of the module's trace for one observation, in the precision of its parameters."""
    import torch

    dtype = next((p.dtype for p in module.parameters()), torch.float32)
    buffer = io.BytesIO()
    # As errors the warnings would be raised in the midst of torch's C code, which loses them.
    with warnings.catch_warnings(record=True) as told, torch.no_grad():
        warnings.simplefilter("always")
        traced = torch.jit.trace(module, torch.zeros(1, n, dtype=dtype), check_trace=False)  # type: ignore[no-untyped-call]
        torch.jit.save(traced, buffer)
    for warning in told:
        if issubclass(warning.category, torch.jit.TracerWarning):  # type: ignore[attr-defined]
            hint = "A constant belongs into a buffer (register_buffer), not into forward"
            raise InputError(f"it branches, or hides a number from torch. {hint}. {warning.message}")
    return buffer.getvalue()


def _write_out(layer: torch.nn.Module) -> None:
    """Make a parameter of each weight that a layer computes from others, as weight_norm does, and say RMSNorm's own
    epsilon, which is another one in double precision."""
    import torch
    from torch.nn.utils import parametrize

    if isinstance(layer, torch.nn.RMSNorm) and layer.eps is None:
        layer.eps = float(torch.finfo(torch.float32).eps)

    if parametrize.is_parametrized(layer):
        # remove_parametrizations would change the class, which copies of the layer share
        computed = layer.get_submodule("parametrizations").named_children()
        weights = {name: getattr(layer, name).detach() for name, _ in computed}
        layer.__class__ = type(layer).__bases__[0]
        del layer.parametrizations
        for name, weight in weights.items():
            layer.register_parameter(name, torch.nn.Parameter(weight, requires_grad=False))


def _evaluation(module: torch.nn.Module, output: str | None) -> Evaluate:
    """The module's own values, in double precision or in single."""
    import torch

    versions = {True: copy.deepcopy(module).double(), False: copy.deepcopy(module).float()}

    def evaluate(x: Observations, double: bool) -> Values:
        with torch.no_grad():
            given = torch.tensor(x, dtype=torch.float64 if double else torch.float32)
            result = versions[double](given)
            values: Values = (result[int(output or 0)] if isinstance(result, tuple | list) else result).numpy()
        return values

    return evaluate


def _plain(node: Any, what: str) -> Any:
    """Dictionaries of arrays, and nothing else."""
    if isinstance(node, Mapping):
        for key in node:
            if not isinstance(key, str):
                raise InputError(f"the keys of {what} must be text; found {key!r:.60}, a {type(key).__name__}.")
        return {key: _plain(value, f"{what}[{key!r}]") for key, value in node.items()}
    if isinstance(node, np.ndarray) and node.dtype.kind == "f":
        if node.itemsize > 8:
            raise InputError(f"{what} cannot be read as a tensor: its numbers are {node.dtype}.")
        return node
    torch = sys.modules.get("torch")  # whoever has a tensor has loaded it
    if torch is None or not isinstance(node, torch.Tensor):
        raise InputError(
            f"{what} must be a tensor, an array of floats or a mapping of these; it is a {type(node).__name__}."
        )
    try:
        still = node.detach().cpu()
        return (still.float() if still.dtype in (torch.float16, torch.bfloat16) else still).numpy()
    except (TypeError, ValueError, RuntimeError) as error:  # a layout that numpy has not, a tensor without numbers
        raise InputError(f"{what} cannot be read as a tensor: {_brief(error)}") from error


def _brief(error: Exception) -> str:
    first = str(error).strip().splitlines()
    return f"{type(error).__name__}: {first[0].strip().rstrip('.:') if first else 'no message'}."
