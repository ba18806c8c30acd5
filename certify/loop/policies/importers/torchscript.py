"""TorchScript archives, their code read as text: affine layers, activations and constant scalings that form one chain.

torch.jit.load compiles the code of an archive and runs the methods by which its modules set their state; some
operations of TorchScript read files. So it is not called. The code is parsed by Python's grammar, which it follows, and
only the statements below are understood; constants and parameters are pickles, read as data. The comparison is with
torch itself, given the same operations one by one.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from certify.errors import InputError
from certify.loop.files.arrays import Numbers
from certify.loop.files.pickles import Call, Name, brief
from certify.loop.files.torchfile import TorchFile, is_tensor
from certify.loop.policies.importers.operations import (
    ADVICE,
    KNOWN,
    PARTS,
    REAL,
    WITHOUT_WEIGHT_NORM,
    Batch,
    Value,
    depends,
    held,
    is_array,
    operation,
    run,
)
from certify.loop.policies.importers.reading import Observations, Reading, Values, gives

_MAX_OPERATIONS = 1000
_MAX_DEPTH = 40
_MAX_TEXT = 2**20
_IN_PLACE = (
    *("relu", "elu", "leaky_relu", "selu", "celu", "silu", "mish", "tanh", "sigmoid"),
    *("hardtanh", "hardswish", "hardsigmoid", "relu6", "clamp"),
)
_HOOKS = ("__forward_pre_hooks__", "__forward_hooks__")
_RESERVED = ("torch", "__torch__", "ops", "CONSTANTS", "getattr")
_COMPARED: dict[str, Callable[[Any, Any], bool]] = {
    **{
        "gt": operator.gt,
        "lt": operator.lt,
        "ge": operator.ge,
        "le": operator.le,
        "eq": operator.eq,
        "ne": operator.ne,
    },
    "__is__": lambda a, b: a is b,
    "__isnot__": lambda a, b: a is not b,
}


@dataclass(frozen=True, slots=True)
class _Program:
    """The archive's classes, functions and constants, how many operations were met, the values that one of them has
    overwritten, and those that share their memory with a part or a whole."""

    file: TorchFile
    classes: dict[Name, ast.ClassDef]
    functions: dict[str, ast.FunctionDef]
    constants: tuple[Any, ...]
    observations: int
    count: list[int] = field(default_factory=lambda: [0])
    overwritten: list[Value] = field(default_factory=list)
    shared: list[Value] = field(default_factory=list)

    def counted(self) -> None:
        """Count an operation or a call."""
        self.count[0] += 1
        if self.count[0] > _MAX_OPERATIONS:
            raise InputError(f"{self.file.what} must have at most {_MAX_OPERATIONS} operations; it has more.")


def is_torchscript(file: TorchFile) -> bool:
    """True if a torch file holds code."""
    return any(name.startswith(f"{file.root}code/") for name in file.archive.names)


def read_torchscript(file: TorchFile, observations: int, wanted: str | None = None) -> Reading:
    """The policy of a TorchScript archive, whose `forward` takes the observation and gives the action.

    Parameters
    ----------
    observations : how many numbers an observation has.
    wanted : the place of the action among what `forward` gives, counted from 0; None if it gives the action alone.

    Raises
    ------
    InputError : the archive is damaged, or its code is no chain of known operations.
    """
    constants = file.pickle("constants.pkl") if file.holds("constants.pkl") else ()
    program = _Program(file, *_definitions(file), constants if isinstance(constants, tuple) else (), observations)
    try:
        result = _forward(program, file.pickle("data.pkl"), [Value()], 0)
    except RecursionError as error:
        raise InputError(f"the code of {file.what} nests too deep to be read.") from error
    value = _action(result, wanted, file.what)
    _require_kept(program, value)
    made = value.made
    own = any(a.dtype == np.float64 and a.ndim for v in made for a in v.given if is_array(a))

    torch = _torch(file.what)

    def evaluate(x: Observations, double: bool) -> Values:
        with torch.no_grad():
            known = dict[int, Any]()
            start = torch.tensor(x, dtype=torch.float64 if double else torch.float32)
            for v in made:
                given = [known.get(id(g), start) if isinstance(g, Value) else g for g in v.given]
                known[id(v)] = run(v.name, given, double)
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


def _action(result: Any, wanted: str | None, what: str) -> Value:
    """The action among what `forward` returns."""
    several = result if isinstance(result, tuple | list) else (result,)
    if wanted is None and len(several) > 1:
        raise InputError(
            f"forward in {what} must return the action; it returns {len(several)} values. Say which is the action with "
            "--output, counted from 0, as in --output 0."
        )
    if wanted is not None and not (wanted.isdecimal() and int(wanted) < len(several)):
        raise InputError(
            f"--output must be a number below {len(several)}, one of the values of {what}; found {wanted}."
        )
    value = several[int(wanted or 0)]
    if not depends(value) or value.under is not None:
        raise InputError(f"forward in {what} must return what it makes of the observation, rows of actions.")
    found: Value = value
    return found


def _forward(program: _Program, module: Any, given: list[Any], depth: int, method: str = "forward") -> Any:
    """A call of a module; a trace has a method for each of its calls, forward, forward1, forward2."""
    what = program.file.what
    if not isinstance(module, Call) or not isinstance(module.function, Name) or len(module.states) != 1:
        raise InputError(f"{what} must hold modules; found {brief(module)}.")
    if "torch.nn.utils.parametrize" in str(module.function):
        raise InputError(f"a weight of {what} is computed by {module.function.name}. {WITHOUT_WEIGHT_NORM}")
    definition = program.classes.get(module.function)
    body = [] if definition is None else definition.body
    methods = [node for node in body if isinstance(node, ast.FunctionDef)]
    if depth == 0 and any(isinstance(n, ast.Name) and n.id in _HOOKS for part in body for n in ast.walk(part)):
        # of a module inside another one the code that calls it has them
        raise InputError(f"{module.function} in {what} has a forward hook: write it into forward before you save it.")
    forward = [node for node in methods if node.name == method]
    if len(forward) != 1:
        raise InputError(f"{module.function} in {what} must have one {method}.")
    return _called(program, forward[0], [module, *given], depth, f"{method} of {module.function} in {what}")


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
            case ast.Assign(targets=[ast.Tuple(elts=names)]) if all(
                isinstance(name, ast.Name) and name.id not in _RESERVED for name in names
            ):
                parts = _evaluate(program, statement.value, values, depth)
                if not isinstance(parts, list | tuple) or len(parts) != len(names):
                    raise InputError(f"{at} must take apart as many values as there are: {_text(statement)}.")
                values |= {name.id: part for name, part in zip(names, parts, strict=True) if isinstance(name, ast.Name)}
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
    """The value of an expression: a module, a constant, or a `Value`."""
    match node:
        case ast.Name(id=name) if name in values:
            return values[name]
        case ast.Constant(value=bool() | int() | float() | str() | None as value):
            return value
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
            return -value
        case ast.List(elts=parts):
            return [_evaluate(program, part, values, depth) for part in parts]
        case ast.Tuple(elts=parts):
            return tuple(_evaluate(program, part, values, depth) for part in parts)
        case ast.Call(
            func=ast.Name(id="int") | ast.Attribute(value=ast.Attribute(value=ast.Name(id="ops")), attr="NumToTensor"),
            args=[inner],
            keywords=[],
        ):
            size = _evaluate(program, inner, values, depth)
            if isinstance(size, Batch) or type(size) is int:
                return size
        case ast.Call(func=ast.Name(id="unchecked_cast" | "annotate"), args=[_, inner], keywords=[]):
            return _evaluate(program, inner, values, depth)
        case ast.Subscript(value=inner, slice=at):
            parts, place = (_evaluate(program, one, values, depth) for one in (inner, at))
            if isinstance(parts, list | tuple) and type(place) is int and -len(parts) <= place < len(parts):
                return parts[place]
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
            arguments = [_evaluate(program, argument, values, depth) for argument in node.args]
            return _operation(program, name, arguments, node)
        case ast.Call(func=inner, args=arguments, keywords=[]) if function := _function(program, inner, values):
            given = [_evaluate(program, argument, values, depth) for argument in arguments]
            return _called(program, function, given, depth + 1, f"{function.name} in {program.file.what}")
        case ast.Call(func=ast.Attribute(value=inner, attr=method), args=arguments, keywords=[]):
            module = _evaluate(program, inner, values, depth)
            given = [_evaluate(program, argument, values, depth) for argument in arguments]
            if _is_call(method) and not any(depends(v) for v in given):
                given = [_held(program, v) for v in given]
            return _forward(program, module, given, depth + 1, method)
    raise InputError(f"{program.file.what} has an expression that is not read: {_text(node)}. Known are {KNOWN}.")


def _function(program: _Program, node: ast.expr, values: dict[str, Any]) -> ast.FunctionDef | None:
    """The archive's function that a name stands for, or the whole path of one; None if it is none."""
    if isinstance(node, ast.Name):
        found = values.get(node.id)
        return found if isinstance(found, ast.FunctionDef) else None
    names = list[str]()
    while isinstance(node, ast.Attribute):
        names.append(node.attr)
        node = node.value
    if not isinstance(node, ast.Name) or node.id != "__torch__":  # others are values and their attributes
        return None
    return program.functions.get(".".join([node.id, *names[::-1]]))


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
    if isinstance(value, Call | float | int | str) or value is None:
        return value
    raise InputError(f"{name} in {program.file.what} must be a module, a number or a word; found {brief(value)}.")


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
    plain = all(v is None or isinstance(v, int | float | str) for v in given)
    if plain and not node.keywords and name == "__not__" and len(given) == 1:
        return not given[0]
    if not node.keywords and name in ("__is__", "__isnot__") and len(given) == 2 and given[1] is None:
        return (given[0] is None) == (name == "__is__")
    if plain and not node.keywords and name in _COMPARED and len(given) == 2:
        return _COMPARED[name](*given)
    if name == "format":
        return ""  # words of an error
    if name in ("dim", "size") and given and depends(given[0]):
        return _shape(program, name, given, at)
    for value in [v for part in given for v in (part if isinstance(part, list) else [part])]:
        _require_kept(program, value)
    if name.removesuffix("_") in _IN_PLACE and name.endswith("_"):
        if not depends(given[0]) or any(given[0] is value for value in program.shared):
            raise InputError(
                f"{at} must not overwrite a constant, a part of a value, or a value of which parts are read."
            )
        program.overwritten.extend(v for v in given if isinstance(v, Value))
        name = name.removesuffix("_")
    if name in ("zeros", "zeros_like"):
        return _zeros(program, name, given, node, at)
    if name in ADVICE:
        raise InputError(f"{at} is not read. {ADVICE[name]}")
    approximate = None
    for word in node.keywords:
        said = word.value.value if isinstance(word.value, ast.Constant) else word
        if name == "gelu" and word.arg == "approximate" and said in ("none", "tanh"):
            approximate = str(said)
        # alpha is written out even where it is 1, and then changes nothing
        elif said is not None and (word.arg != "alpha" or said != 1):
            raise InputError(f"{at} has {word.arg}, which is not read.")
    if name == "div" and not any(depends(v) for v in given) and _is_old(program.file):
        raise InputError(f"{at} is of constants alone, in a format of torch before 1.6. Save it with a newer one.")
    made = operation(name, given, approximate, program.observations, at)
    if name in PARTS:
        parts = made if isinstance(made, list) else [made]
        program.shared.extend(v for v in (given[0], *parts) if isinstance(v, Value))
    return made


def _is_old(file: TorchFile) -> bool:
    """True for a format in which the quotient of integers is rounded."""
    said = file.archive.read(f"{file.root}version").strip() if file.holds("version") else b""
    return not said.isdigit() or int(said) < 4


def _held(program: _Program, value: Any) -> Any:
    """A constant row that a module reads, as a value; anything else as it is."""
    constant = value.constant if isinstance(value, Value) else value
    if not is_array(constant):
        return value
    row = held(constant, program.observations, program.file.what)
    program.shared.append(row)  # with the constant
    return row


def _zeros(program: _Program, name: str, given: list[Any], node: ast.Call, at: str) -> Numbers:
    """A row of zeros, of some width or of a value's."""
    said = {word.arg: word.value for word in node.keywords}
    kind = said.get("dtype")
    if not isinstance(kind, ast.Constant | None) or (kind is not None and kind.value not in (None, *REAL)):
        raise InputError(f"{at} must be of floating-point numbers.")
    width = 0
    match name, given:
        case "zeros", [[int(size)] | [Batch() | 1, int(size)]]:
            width = size
        case "zeros_like", [Value(constant=None) as like]:
            width = gives(like.chain, program.observations)
    if width > 0:
        return np.zeros((1, width), dtype=np.float32)
    raise InputError(f"{at} must be a row of zeros.")


def _shape(program: _Program, name: str, given: list[Any], at: str) -> Any:
    """The number of axes of a value, its shape, or the size of an axis."""
    shape = [Batch(), gives(given[0].chain, program.observations)]
    if name == "dim" and len(given) == 1:
        return 2
    if name == "size" and len(given) == 1:
        return shape
    if name == "size" and len(given) == 2 and given[1] in (0, 1, -1):
        return shape[given[1]]
    raise InputError(f"{at} is not read.")


def _require_kept(program: _Program, value: Any) -> None:
    """Refuse a value that an operation in place has overwritten."""
    if any(value is gone for gone in program.overwritten):
        raise InputError(f"{program.file.what} must not read a value again that an operation in place has overwritten.")


def _text(node: ast.AST) -> str:
    try:
        return repr(ast.unparse(node)[:120])
    except (RecursionError, ValueError):
        return f"a {type(node).__name__}"
