"""The modules of torch in a policy that was pickled whole: what they say of the functions between its layers.

Such a file holds what a state_dict holds, and the classes of the modules, but not what the `forward` of another class
does with them. So it is read as its state_dict; and the functions that its modules are must be those that the options
say, in their places where layers and functions are numbered together.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from certify.errors import InputError
from certify.loop.files.arrays import is_number
from certify.loop.files.pickles import Call
from certify.loop.policies.importers.options import ImportOptions, Output
from certify.loop.policies.importers.steps import in_words, plainly
from certify.loop.policies.importers.tensors import class_of
from certify.loop.policies.importers.unread import known_by_name

_NOTHING = {"Module", "Linear", "Sequential", "ModuleList", "ModuleDict", "Identity", "Dropout", "Flatten"}
_FUNCTIONS = {
    "Tanh": "tanh", "ReLU": "relu", "ELU": "elu", "LeakyReLU": "leaky_relu", "Sigmoid": "sigmoid", "SiLU": "silu",
    "Mish": "mish", "Softplus": "softplus", "Softsign": "softsign", "CELU": "celu", "SELU": "selu", "ReLU6": "relu6",
    "Hardsigmoid": "hardsigmoid", "Hardswish": "hardswish", "LogSigmoid": "logsigmoid",
}  # fmt: skip
_NUMBERS = {"ELU": "alpha", "LeakyReLU": "negative_slope", "CELU": "alpha", "Softplus": "beta"}
_ENDS: dict[Output, list[str]] = {"identity": [], "tanh": ["tanh"], "relu-tanh": ["tanh", "relu"]}
_TRACED = "save the policy traced, torch.jit.trace(model.eval(), torch.zeros(1, n)).save(FILE), or write it as ONNX."
_THRESHOLD, _EPSILON = 20, 1e-5  # of torch's Softplus and LayerNorm


def require_said(modules: Mapping[str, Call], groups: Mapping[str, Collection[int]], options: ImportOptions) -> None:
    """Refuse modules that are or hold a function that the options do not say, or that stand elsewhere.

    Parameters
    ----------
    modules : by their names, as those of a state_dict have them.
    groups : the numbers of the policy's layers by their prefixes, in their order.

    Raises
    ------
    InputError : there are such.
    """
    if options.activation is None or options.squash is None:
        return  # which are asked for
    wanted, ends, found = in_words(options.activation), _ENDS[options.squash], dict[str, str]()
    for name, module in modules.items():
        own = any(f"{name}.".startswith(f"{prefix}.") for prefix in filter(None, groups))
        if own or known_by_name(f"{name}.weight", {}, "", 1) is None:
            found[name] = _function(module, name, options)
            if found[name] not in ("", wanted, *ends):
                raise InputError(
                    f"the file's module {name} is {found[name]}; --activation says {wanted}, and --squash "
                    f"{options.squash}. Say what the modules are, or {_TRACED}"
                )
    for k, (prefix, layers) in enumerate(groups.items(), start=1):
        start = f"{prefix}." if prefix else ""
        numbered = {name.removeprefix(start): function for name, function in found.items() if name.startswith(start)}
        placed = {int(name): function for name, function in numbered.items() if name.isdigit() and function}
        if placed and not _in_turn(placed, sorted(layers), wanted, ends if k == len(groups) else [wanted]):
            raise InputError(
                f"the modules of {prefix or 'the file'} must be layers with {wanted} between each two of them, and "
                f"behind the last nothing or what --squash says; they are others. {_TRACED.capitalize()}"
            )


def numbers_in(modules: Mapping[str, Call]) -> list[str]:
    """The numbers of classes that are not torch's, which their forward may use, in words."""
    own = {name: module.states[0] for name, module in modules.items() if not str(class_of(module)).startswith("torch.")}
    pairs = [(f"{name}.{k}" if name else str(k), v) for name, state in own.items() for k, v in state.items()]
    return [f"{name} = {plainly(v)}" for name, v in pairs if isinstance(v, int | float) and not isinstance(v, bool)]


def _in_turn(placed: Mapping[int, str], layers: Sequence[int], wanted: str, ends: list[str]) -> bool:
    """True if of these functions one stands between each two layers, and behind the last none or the ends."""
    parts: list[list[str]] = [[] for _ in range(len(layers) + 1)]
    for number, function in sorted(placed.items()):
        parts[sum(layer < number for layer in layers)].append(function)
    before, *between, behind = parts
    return not before and all(each == [wanted] for each in between) and behind in ([], ends)


def _function(module: Call, name: str, options: ImportOptions) -> str:
    """The function that a module is, in words; empty for one that is none, or of a class that is not torch's.

    Raises
    ------
    InputError : it is another module of torch, or has numbers that no option says.
    """
    of, state = class_of(module), module.states[0]
    if of is not None and not of.module.startswith("torch."):
        return ""
    kind = of.name if of is not None and of.module.startswith("torch.nn.modules.") else ""
    if kind in _NOTHING:
        return ""
    if kind in _FUNCTIONS and state.get("threshold", _THRESHOLD) == _THRESHOLD:
        number = state.get(_NUMBERS.get(kind, ""))
        if kind not in _NUMBERS:
            return in_words(_FUNCTIONS[kind])
        if isinstance(number, int | float) and is_number(number):
            return in_words(f"{_FUNCTIONS[kind]}:{plainly(float(number))}")
    epsilon = float(options.norm_epsilon or _EPSILON)
    if kind == "LayerNorm" and options.norm is not None and state["_parameters"].get("weight") is not None:
        if state.get("eps") == epsilon:
            return ""
        raise InputError(f"the file's {name} has eps = {state.get('eps')}: say so with --norm-epsilon.")
    raise InputError(
        f"the file has a module {name or 'itself'} of {of}, of which no option says what becomes: {_TRACED}"
    )
