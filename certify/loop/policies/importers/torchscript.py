"""TorchScript archives, their code read as text: affine layers, activations and constant scalings that form one chain.

torch.jit.load compiles the code of an archive and runs the methods by which its modules set their state; some
operations of TorchScript read files. So it is not called. The code is parsed by Python's grammar, which it follows, and
only the statements below are understood; constants and parameters are pickles, read as data. The comparison is with
torch itself, given the same operations one by one.
"""

from __future__ import annotations

import ast
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from certify.errors import InputError
from certify.loop.files.arrays import Numbers
from certify.loop.files.pickles import Call, Name, brief
from certify.loop.files.torchfile import TorchFile, is_tensor
from certify.loop.policies.importers import graph
from certify.loop.policies.importers.graph import Chain
from certify.loop.policies.importers.options import WITH_TANH, WITHOUT_NORMALISATION
from certify.loop.policies.importers.reading import Observations, Reading, Values

_MAX_OPERATIONS = 1000
_MAX_DEPTH = 40
_MAX_TEXT = 2**20
_KNOWN = (
    "linear, addmm, matmul, add, sub, rsub, mul, div, neg, cat, clamp, hardtanh, relu, tanh, elu, sigmoid, silu, gelu, "
    "softplus, mish, leaky_relu, selu, celu, relu6, hardsigmoid, hardswish, log_sigmoid, pow, abs, "
    "h / (1 + abs(h)) and layer_norm"
)
_ACTIVATIONS: dict[str, tuple[float, ...]] = {  # with what a program may write behind the value
    **{"tanh": (), "sigmoid": (), "silu": (), "gelu": (), "mish": (), "elu": (1.0, 1.0, 1.0), "softplus": (1.0, 20.0)},
    "gelu-tanh": (),
    **dict.fromkeys(("selu", "relu6", "hardsigmoid", "hardswish", "log_sigmoid"), ()),
}
_IN_PLACE = (
    *("relu", "elu", "leaky_relu", "selu", "celu", "silu", "mish", "tanh", "sigmoid"),
    *("hardtanh", "hardswish", "hardsigmoid", "relu6", "clamp"),
)
_NORMALISATIONS = ("batch_norm", "group_norm", "instance_norm", "rms_norm")
_RESERVED = ("torch", "__torch__", "ops", "CONSTANTS", "getattr")
_DEFAULTS: dict[str, tuple[Any, ...]] = {"hardtanh": (-1.0, 1.0), "clamp": (None, None)}


@dataclass(frozen=True, slots=True)
class _Value:
    """A value that depends on the observation: the exact steps to it, and torch's operation that made it, with its
    arguments, values and constants."""

    chain: Chain = ()
    name: str = ""
    given: tuple[Any, ...] = ()

    @property
    def before(self) -> list[_Value]:
        """The values that it is made of."""
        return [v for v in self.given if isinstance(v, _Value)]

    @property
    def made(self) -> list[_Value]:
        """All values from the observation to it, in an order in which they can be computed."""
        found, waiting = dict[int, _Value](), [self]
        while waiting:
            missing = [v for v in waiting[-1].before if id(v) not in found]
            waiting += missing
            if not missing:
                value = waiting.pop()
                found[id(value)] = value
        return [v for v in found.values() if v.name]


@dataclass(frozen=True, slots=True)
class _Program:
    """The archive's classes, functions and constants, how many operations were met, and the values that one of them
    has overwritten."""

    file: TorchFile
    classes: dict[Name, ast.ClassDef]
    functions: dict[str, ast.FunctionDef]
    constants: tuple[Any, ...]
    count: list[int] = field(default_factory=lambda: [0])
    overwritten: list[_Value] = field(default_factory=list)

    def counted(self) -> None:
        """Count an operation or a call."""
        self.count[0] += 1
        if self.count[0] > _MAX_OPERATIONS:
            raise InputError(f"{self.file.what} must have at most {_MAX_OPERATIONS} operations; it has more.")


def is_torchscript(file: TorchFile) -> bool:
    """True if a torch file holds code."""
    return any(name.startswith(f"{file.root}code/") for name in file.archive.names)


def read_torchscript(file: TorchFile) -> Reading:
    """The policy of a TorchScript archive, whose `forward` takes the observation and gives the action.

    Raises
    ------
    InputError : the archive is damaged, or its code is no chain of known operations.
    """
    constants = file.pickle("constants.pkl") if file.holds("constants.pkl") else ()
    program = _Program(file, *_definitions(file), constants if isinstance(constants, tuple) else ())
    try:
        value = _forward(program, file.pickle("data.pkl"), _Value(), 0)
    except RecursionError as error:
        raise InputError(f"the code of {file.what} nests too deep to be read.") from error
    _require_kept(program, value)
    made = value.made
    own = any(a.dtype == np.float64 and a.ndim for v in made for a in v.given if _is_array(a))

    torch = _torch(file.what)

    def evaluate(x: Observations, double: bool) -> Values:
        with torch.no_grad():
            known = dict[int, Any]()
            start = torch.tensor(x, dtype=torch.float64 if double else torch.float32)
            for v in made:
                known[id(v)] = _run(
                    v.name, [known.get(id(g), start) if isinstance(g, _Value) else g for g in v.given], double
                )
            values: Values = known[id(value)].numpy() if made else start.numpy()
        return values

    words = f"TorchScript of {', '.join(v.name for v in made)[:200]}"
    ran = "the operations of the file's code, one by one in torch (the code is read as text, and not run)"
    return Reading(words=words, steps=value.chain, evaluate=evaluate, double=own, program=ran)


def _torch(what: str) -> Any:
    """The module that the file's operations are those of."""
    try:
        import torch
    except ImportError as error:
        raise InputError(
            f"{what} is compared with torch itself, which is not installed; install it with pip install "
            "'.[torch]' in the project's folder, or give the module's state_dict."
        ) from error
    return torch


def _definitions(file: TorchFile) -> tuple[dict[Name, ast.ClassDef], dict[str, ast.FunctionDef]]:
    """The classes of the archive's code by the names that its pickle has for them, and its functions by theirs."""
    classes, functions = dict[Name, ast.ClassDef](), dict[str, ast.FunctionDef]()
    start = f"{file.root}code/"
    for member in file.archive.names:
        if not member.startswith(start) or not member.endswith(".py"):
            continue
        raw = file.archive.read(member)
        if len(raw) > _MAX_TEXT:
            raise InputError(f"{member} in {file.what} must be at most 1 MiB of code; it has {len(raw)} bytes.")
        try:
            tree = ast.parse(raw.decode("ascii"))
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise InputError(f"{member} in {file.what} is no code that can be read: {error}.") from error
        module = member.removeprefix(start).removesuffix(".py").replace("/", ".")
        for node in tree.body:
            if not isinstance(node, ast.ClassDef | ast.FunctionDef):
                continue
            name = Name(module, node.name)
            if name in classes or str(name) in functions:
                raise InputError(f"{file.what} must define each name once; {name} stands there twice.")
            if isinstance(node, ast.ClassDef):
                classes[name] = node
            else:
                functions[str(name)] = node
    return classes, functions


def _forward(program: _Program, module: Any, given: _Value, depth: int, method: str = "forward") -> _Value:
    """A call of a module; a trace has a method for each of its calls, forward, forward1, forward2."""
    what = program.file.what
    if not isinstance(module, Call) or not isinstance(module.function, Name) or len(module.states) != 1:
        raise InputError(f"{what} must hold modules; found {brief(module)}.")
    definition = program.classes.get(module.function)
    methods = [] if definition is None else [n for n in definition.body if isinstance(n, ast.FunctionDef)]
    forward = [node for node in methods if node.name == method]
    if len(forward) != 1 or len(forward[0].args.args) != 2:
        raise InputError(f"{module.function} in {what} must have one {method} of one observation.")
    result = _called(program, forward[0], [module, given], depth, f"{method} of {module.function} in {what}")
    if isinstance(result, _Value):
        return result
    raise InputError(f"{method} of {module.function} in {what} must return what it makes of the observation.")


def _called(program: _Program, function: ast.FunctionDef, given: list[Any], depth: int, at: str) -> Any:
    """The result of a function of the archive; arguments that are not given have their defaults."""
    if depth > _MAX_DEPTH:
        raise InputError(f"the modules of {program.file.what} must nest at most {_MAX_DEPTH} deep.")
    program.counted()
    names, said = [argument.arg for argument in function.args.args], function.args.defaults
    missing = len(names) - len(given)
    if len(set(names)) != len(names) or any(name in _RESERVED for name in names):
        raise InputError(f"{at} must not rename {', '.join(_RESERVED)}, nor give two arguments one name.")
    other = function.args
    if function.decorator_list or other.posonlyargs or other.vararg or other.kwonlyargs or other.kwarg:
        raise InputError(f"{at} must have arguments by their place alone.")
    if not 0 <= missing <= len(said):
        raise InputError(f"{at} must have {len(names)} arguments; it is given {len(given)}.")
    defaults = [_evaluate(program, node, {}, depth) for node in said[len(said) - missing :]]
    values = dict[str, Any](zip(names, [*given, *defaults], strict=True))
    returned = _through(program, function.body, values, depth, at)
    if returned is None:
        raise InputError(f"{at} must return its value.")
    return returned[0]


def _through(program: _Program, body: list[ast.stmt], values: dict[str, Any], depth: int, at: str) -> tuple[Any] | None:
    """The value that these statements return, alone in a tuple; None if they end without a return."""
    for statement in body:
        match statement:
            case ast.Assign(targets=[ast.Name(id=name)]) if name not in _RESERVED:
                values[name] = _evaluate(program, statement.value, values, depth)
            case ast.Return(value=ast.expr() as expression):
                return (_evaluate(program, expression, values, depth),)
            case ast.If(test=test):
                decided = _evaluate(program, test, values, depth)
                if not isinstance(decided, bool):
                    raise InputError(f"{at} must branch on constants alone; found {_text(test)}.")
                returned = _through(program, statement.body if decided else statement.orelse, values, depth, at)
                if returned is not None:
                    return returned
            case ast.Pass():
                continue
            case _:
                raise InputError(f"{at} has a statement that is not read: {_text(statement)}.")
    return None


def _evaluate(program: _Program, node: ast.expr, values: dict[str, Any], depth: int) -> Any:
    """The value of an expression: a module, a constant, or a `_Value`."""
    match node:
        case ast.Name(id=name) if name in values:
            return values[name]
        case ast.Constant(value=bool() | int() | float() | str() | None as value):
            return value
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
            return -value
        case ast.List(elts=parts):
            return [_evaluate(program, part, values, depth) for part in parts]
        case ast.Attribute(value=ast.Name(id="CONSTANTS"), attr=attr) if attr[:1] == "c" and attr[1:].isdecimal():
            index = int(attr[1:])
            if index >= len(program.constants):
                raise InputError(f"{program.file.what} has no constant {index}.")
            return _tensor(program, program.constants[index], attr, "constants")
        case ast.Attribute() if (function := _function(program, node, values)) is not None:
            return function
        case ast.Attribute(value=inner, attr=attr):
            return _attribute(program, _evaluate(program, inner, values, depth), attr)
        case ast.Call(func=ast.Name(id="getattr"), args=[inner, ast.Constant(value=str() as attr)], keywords=[]):
            return _attribute(program, _evaluate(program, inner, values, depth), attr)
        case ast.Call(func=ast.Attribute(value=ast.Name(id="torch"), attr=name)):
            if name in _NORMALISATIONS:
                raise InputError(f"torch.{name} in {program.file.what} is not read. {WITHOUT_NORMALISATION}")
            arguments = [_evaluate(program, argument, values, depth) for argument in node.args]
            return _operation(program, name, arguments, node)
        case ast.Call(func=inner, args=arguments, keywords=[]) if function := _function(program, inner, values):
            given = [_evaluate(program, argument, values, depth) for argument in arguments]
            return _called(program, function, given, depth + 1, f"{function.name} in {program.file.what}")
        case ast.Call(func=ast.Attribute(value=inner, attr=method), args=[argument], keywords=[]) if _is_call(method):
            module = _evaluate(program, inner, values, depth)
            given = _evaluate(program, argument, values, depth)
            if not isinstance(given, _Value):
                raise InputError(f"a module of {program.file.what} must be given what depends on the observation.")
            return _forward(program, module, given, depth + 1, method)
    raise InputError(f"{program.file.what} has an expression that is not read: {_text(node)}. Known are {_KNOWN}.")


def _function(program: _Program, node: ast.expr, values: dict[str, Any]) -> ast.FunctionDef | None:
    """The archive's function that a name stands for, or the whole path of one; None if it is none."""
    if isinstance(node, ast.Name):
        found = values.get(node.id)
        return found if isinstance(found, ast.FunctionDef) else None
    names = list[str]()
    while isinstance(node, ast.Attribute):
        names.append(node.attr)
        node = node.value
    return program.functions.get(".".join([node.id, *names[::-1]])) if isinstance(node, ast.Name) else None


def _is_call(method: str) -> bool:
    return method == "forward" or (method.startswith("forward") and method[7:].isdecimal())


def _attribute(program: _Program, module: Any, name: str) -> Any:
    state = module.states[0] if isinstance(module, Call) and len(module.states) == 1 else None
    fixed = _fixed(program, module, name)
    if not isinstance(state, dict) or (name in state) == (fixed is not None):
        found = "has no" if fixed is None else "says twice what is its"
        raise InputError(f"a module of {program.file.what} {found} {name}.")
    if fixed is not None:
        return fixed
    value = state[name]
    if is_tensor(value):
        return _tensor(program, value, name, "data")
    if isinstance(value, Call | float | int) or value is None:
        return value
    raise InputError(f"{name} in {program.file.what} must be a module or a number; found {brief(value)}.")


def _fixed(program: _Program, module: Any, name: str) -> int | float | None:
    """The number that a module's class gives to an attribute, as it does to constants; None if it gives none."""
    definition = program.classes.get(module.function) if isinstance(module, Call) else None
    for node in [] if definition is None else definition.body:
        match node:
            case ast.AnnAssign(target=ast.Name(id=found), value=ast.expr() as value) if found == name:
                number = _evaluate(program, value, {}, 0)
                if isinstance(number, int | float) and not isinstance(number, bool):
                    return number
                raise InputError(f"{name} in {program.file.what} must be a number; found {_text(value)}.")
    return None


def _tensor(program: _Program, node: Any, name: str, folder: str) -> Numbers:
    return program.file.tensor(node, f"{name} in {program.file.what}", folder)


def _operation(program: _Program, name: str, given: list[Any], node: ast.Call) -> Any:
    at = f"torch.{name} in {program.file.what}"
    program.counted()
    if name == "gt" and len(given) == 2 and all(isinstance(v, int | float) for v in given) and not node.keywords:
        return given[0] > given[1]
    for value in [v for part in given for v in (part if isinstance(part, list) else [part])]:
        _require_kept(program, value)
    if name.removesuffix("_") in _IN_PLACE and name.endswith("_"):
        program.overwritten.extend(v for v in given if isinstance(v, _Value))
        name = name.removesuffix("_")
    for word in node.keywords:
        said = word.value.value if isinstance(word.value, ast.Constant) else None
        if name == "gelu" and word.arg == "approximate" and said in ("none", "tanh"):
            name = "gelu" if said == "none" else "gelu-tanh"
        # alpha is written out even where it is 1, and then changes nothing
        elif word.arg != "alpha" or said != 1:
            raise InputError(f"{at} has {word.arg}, which is not read.")
    if name in ("t", "numpy_T") and len(given) == 1 and _is_array(given[0]) and given[0].ndim == 2:
        return given[0].T
    if name == "cat" and len(given) == 2 and given[1] in (1, -1) and _are_values(given[0]):
        return _Value(graph.joined("concat", *(v.chain for v in given[0])), name, tuple(given[0]))
    if name in ("add", "sub") and len(given) == 2 and _are_values(given):
        one, other = (v.chain for v in given)
        chain = graph.subtracted(one, other) if name == "sub" else graph.joined("sum", one, other)
        return _Value(chain, name, tuple(given))
    if name == "div" and len(given) == 2 and _are_values(given):
        one, other = (v.chain for v in given)
        return _Value(graph.divided(one, other, at), name, tuple(given))
    if name == "mul" and len(given) == 2 and _are_values(given):
        return _Value(graph.product(*(v.chain for v in given)), name, tuple(given))
    if name == "layer_norm":
        return _Value(_normalised(given, at), name, tuple(given[:5]))
    places = [k for k, value in enumerate(given) if isinstance(value, _Value)]
    if len(places) != 1 or any(isinstance(value, Call | bool | list) for value in given):
        raise InputError(
            f"{at} must join one value that depends on the observation with constants; add, sub, mul and cat may "
            "join several."
        )
    others = tuple(v for v in given if not isinstance(v, _Value))
    chain = _step(name, places[0], len(given), given[places[0]].chain, others, at)
    return _Value(chain, name, tuple(given))


def _require_kept(program: _Program, value: Any) -> None:
    """Refuse a value that an operation in place has overwritten."""
    if any(value is gone for gone in program.overwritten):
        raise InputError(f"{program.file.what} must not read a value again that an operation in place has overwritten.")


def _normalised(given: list[Any], at: str) -> Chain:
    """layer_norm(value, [width], gain, bias, epsilon), over the entries of a row; the last ones may be left out."""
    match [*given, *(None, None, 1e-5)[max(len(given) - 2, 0) :]]:
        case [_Value() as value, [int(width)], gain, bias, float(epsilon), *rest] if (
            width > 0 and len(rest) <= 1 and all(v is None or _is_array(v) for v in (gain, bias))
        ):
            return graph.layer_normalised(value.chain, width, epsilon, gain, bias, at)
    raise InputError(f"{at} is read of a value that depends on the observation, over one axis, with constants.")


def _are_values(given: Any) -> bool:
    """True if all of these depend on the observation."""
    return isinstance(given, list) and len(given) > 1 and all(isinstance(v, _Value) for v in given)


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
        case "elu", 0, 2 | 3 | 4 if given[1:] == (1.0, 1.0)[: len(given) - 1] and given[0] != 1:
            return graph.mapped(chain, name, given[0])
        case _, 0, _ if name in _ACTIVATIONS and given == _ACTIVATIONS[name][: len(given)]:
            return graph.mapped(chain, name.replace("log_s", "logs"))
        case "relu", 0, 1:
            return graph.clipped(chain, 0.0, None, at)
        case ("clamp", 0, 1 | 2 | 3) | ("hardtanh", 0, 1 | 2 | 3):
            lo, hi = (*given, *_DEFAULTS[name][len(given) :])
            return graph.clipped(chain, lo, hi, at)
    said = f" with {', '.join(map(str, given))}" if name in _ACTIVATIONS else ""
    raise InputError(f"{at}{said} is not read: the operations are {_KNOWN}. {WITH_TANH}")


def _run(name: str, given: list[Any], double: bool) -> Any:
    """torch's own operation, with its constants as they are or in double precision."""
    import torch

    kind = np.float64 if double else None
    arguments = [torch.from_numpy(np.array(v, dtype=kind)) if _is_array(v) else v for v in given]
    functions: dict[str, Callable[..., Any]] = {
        "linear": torch.nn.functional.linear,
        "addmm": torch.addmm,
        "matmul": torch.matmul,
        "mm": torch.mm,
        "add": torch.add,
        "sub": torch.sub,
        "rsub": torch.rsub,
        "cat": lambda *values: torch.cat(values, 1),
        "mul": torch.mul,
        "div": torch.div,
        "neg": torch.neg,
        "abs": torch.abs,
        "pow": torch.pow,
        "gelu-tanh": lambda h: torch.nn.functional.gelu(h, approximate="tanh"),
        "tanh": torch.tanh,
        "sigmoid": torch.sigmoid,
        **{name: getattr(torch.nn.functional, name) for name in ("silu", "gelu", "mish")},
        "elu": lambda h, alpha=1.0, *_: torch.nn.functional.elu(h, alpha),
        **{n: getattr(torch.nn.functional, n) for n in ("leaky_relu", "selu", "celu", "hardsigmoid", "hardswish")},
        "layer_norm": torch.nn.functional.layer_norm,
        "relu6": torch.nn.functional.relu6,
        "log_sigmoid": torch.nn.functional.logsigmoid,
        "softplus": lambda h, *_: torch.nn.functional.softplus(h),
        "relu": torch.relu,
        "clamp": torch.clamp,
        "hardtanh": torch.nn.functional.hardtanh,
    }
    return functions[name](*arguments)


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray)


def _text(node: ast.AST) -> str:
    try:
        return repr(ast.unparse(node)[:120])
    except (RecursionError, ValueError):
        return f"a {type(node).__name__}"
