"""Read a pickle as data: every global stays a name, and no call in it is made.

A pickle is a program, and a reader that looks up its functions can be made to run them. This reader looks up none: the
opcodes work on a stack of numbers, text, bytes and its own containers. A class becomes the pair of its names; a call,
a new object or its state becomes a `Call`. The readers of tensors and arrays look for a few known forms in the result.
Python's own `Unpickler` with a `find_class` is not enough: it sets the attributes of the objects that it gets.
"""

from __future__ import annotations

import io
import pickletools
from dataclasses import dataclass, field
from typing import Any

from certify.errors import InputError

_MAX_OPCODES = 2_000_000
_SCALARS = {
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT",
    "STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8",
    "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8",
}  # fmt: skip
_WORDS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}


@dataclass(frozen=True, slots=True)
class Name:
    """A global that the pickle names; it was not looked up."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


_KEY = (str, bytes, int, float, bool, type(None), Name)


@dataclass(frozen=True, slots=True)
class Persistent:
    """A reference to something outside the pickle, as its program wrote it down."""

    reference: Any


@dataclass(frozen=True, slots=True, eq=False)
class Call:
    """A call, or a new object, that the pickle asks for and this reader does not make; the lists hold its arguments."""

    function: Any
    arguments: Any
    states: list[Any] = field(default_factory=list)
    items: list[Any] = field(default_factory=list)
    pairs: list[tuple[Any, Any]] = field(default_factory=list)

    def __repr__(self) -> str:
        # Its contents may contain it in turn, or be many times as long as the pickle.
        return f"a call of {self.function if isinstance(self.function, Name) else 'something'}"


def read_pickle(raw: bytes, what: str) -> Any:
    """The value that a pickle describes, as plain containers, `Name`, `Persistent` and `Call`.

    Parameters
    ----------
    raw : the pickle.
    what : its name in messages.

    Raises
    ------
    InputError : it is damaged, or uses an opcode that plain data does not need.
    """
    return read_next(io.BytesIO(raw), what)[0]


def read_next(stream: io.BytesIO, what: str) -> tuple[Any, list[Persistent]]:
    """The value of the pickle at which a stream stands, and all references in it; the stream then stands behind it.

    Raises
    ------
    InputError : as `read_pickle`.
    """
    machine = _Machine()
    try:
        for count, (opcode, argument, _) in enumerate(pickletools.genops(stream)):
            if count > _MAX_OPCODES:
                raise InputError(f"{what} must have at most {_MAX_OPCODES} steps; it has more.")
            if opcode.name == "STOP":
                return machine.pop(), machine.references
            machine.step(opcode.name, argument)
    except InputError as error:
        raise InputError(f"{what} cannot be read, and nothing in it was executed: {error}") from error
    except (ValueError, IndexError, KeyError, TypeError, OverflowError) as error:
        raise InputError(f"{what} is no pickle or is damaged: {type(error).__name__}: {error}.") from error
    raise InputError(f"{what} ends before its pickle does.")


class _Machine:
    """The stack, the marks and the memo of a pickle."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.marks: list[list[Any]] = []
        self.memo: dict[int, Any] = {}
        self.references: list[Persistent] = []

    def pop(self) -> Any:
        return self.stack.pop()

    def marked(self) -> list[Any]:
        """Pop the items pushed since the last mark."""
        items, self.stack = self.stack, self.marks.pop()
        return items

    def step(self, name: str, argument: Any) -> None:
        if name in _SCALARS:
            self.stack.append(argument)
        elif name in _WORDS:
            self.stack.append(_WORDS[name])
        elif name in ("PROTO", "FRAME"):
            return
        elif name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
            self.memo[len(self.memo) if name == "MEMOIZE" else int(argument)] = self.stack[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            self.stack.append(self.memo[int(argument)])
        elif name == "MARK":
            self.marks.append(self.stack)
            self.stack = []
        elif name == "POP_MARK":
            self.marked()
        elif name == "POP":
            # On an empty stack it takes the mark away, as Python's own reader has it.
            if self.stack:
                self.pop()
            else:
                self.marked()
        elif name == "DUP":
            self.stack.append(self.stack[-1])
        else:
            self._build(name, argument)

    def _build(self, name: str, argument: Any) -> None:
        """A container, or an item of one."""
        stack = self.stack
        match name:
            case "EMPTY_LIST":
                stack.append([])
            case "EMPTY_TUPLE":
                stack.append(())
            case "EMPTY_DICT":
                stack.append({})
            case "EMPTY_SET":
                stack.append(set())
            case "LIST":
                items = self.marked()
                self.stack.append(items)
            case "TUPLE":
                items = self.marked()
                self.stack.append(tuple(items))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                count = int(name[-1])
                if len(stack) < count:
                    raise IndexError("a tuple of more than there is")
                stack[-count:] = [tuple(stack[-count:])]
            case "DICT":
                items = self.marked()
                made: dict[Any, Any] = {}
                _set_items(made, items)
                self.stack.append(made)
            case "FROZENSET":
                items = self.marked()
                self.stack.append(frozenset(_key(item) for item in items))
            case "APPEND":
                item = self.pop()
                _append(stack[-1], [item])
            case "APPENDS" | "ADDITEMS":
                items = self.marked()
                _append(self.stack[-1], items)
            case "SETITEM":
                value, key = self.pop(), self.pop()
                _set_items(stack[-1], [key, value])
            case "SETITEMS":
                items = self.marked()
                _set_items(self.stack[-1], items)
            case _:
                self._refer(name, argument)

    def _refer(self, name: str, argument: Any) -> None:
        """A name, a call, a state, or something outside the pickle."""
        stack = self.stack
        match name:
            case "GLOBAL":
                module, _, attribute = argument.partition(" ")
                stack.append(Name(module, attribute))
            case "STACK_GLOBAL":
                attribute, module = self.pop(), self.pop()
                if not isinstance(module, str) or not isinstance(attribute, str):
                    raise InputError("a global must be named by two words.")
                stack.append(Name(module, attribute))
            case "REDUCE" | "NEWOBJ":
                arguments, function = self.pop(), self.pop()
                stack.append(_call(function, arguments))
            case "NEWOBJ_EX":
                named, arguments, function = self.pop(), self.pop(), self.pop()
                stack.append(Call(function, (arguments, named)))
            case "INST":
                module, _, attribute = argument.partition(" ")
                items = self.marked()
                self.stack.append(Call(Name(module, attribute), tuple(items)))
            case "OBJ":
                items = self.marked()
                self.stack.append(Call(items[0], tuple(items[1:])))
            case "BUILD":
                state = self.pop()
                if isinstance(stack[-1], Call):
                    stack[-1].states.append(state)
                elif not isinstance(stack[-1], dict):  # an ordered dictionary may carry attributes: nobody needs them
                    raise InputError(f"it gives a state to {brief(stack[-1])}.")
            case "PERSID" | "BINPERSID":
                self.references.append(Persistent(argument if name == "PERSID" else self.pop()))
                stack.append(self.references[-1])
            case _:
                raise InputError(f"it uses {name}, which plain data does not need.")


def _call(function: Any, arguments: Any) -> Any:
    if function == Name("collections", "OrderedDict") and isinstance(arguments, tuple):
        made: dict[Any, Any] = {}
        for pair in arguments[0] if arguments else ():
            key, value = pair
            made[_key(key)] = value
        return made
    return Call(function, arguments)


def _append(target: Any, items: list[Any]) -> None:
    if isinstance(target, list):
        target.extend(items)
    elif isinstance(target, set):
        target.update(_key(item) for item in items)
    elif isinstance(target, Call):
        target.items.extend(items)
    else:
        raise InputError(f"it appends to {brief(target)}.")


def _set_items(target: Any, items: list[Any]) -> None:
    if len(items) % 2:
        raise InputError("a key has no value.")
    pairs = list(zip(items[::2], items[1::2], strict=True))
    if isinstance(target, dict):
        target.update((_key(key), value) for key, value in pairs)
    elif isinstance(target, Call):
        target.pairs.extend(pairs)
    else:
        raise InputError(f"it sets items of {brief(target)}.")


def _key(value: Any) -> Any:
    """A key whose hash takes time linear in its size: nested tuples of the same tuple could take for ever."""
    flat = value if isinstance(value, tuple) else (value,)
    if all(isinstance(part, _KEY) for part in flat):
        return value
    raise InputError(f"a key must be text, a number or a name; found {brief(value)}.")


def brief(value: Any) -> str:
    """A value of a pickle in a few words: containers are not opened, they may hold themselves."""
    if isinstance(value, str | bytes | int | float | Call) or value is None:
        return repr(value)[:60]
    return f"the name {str(value)[:80]}" if isinstance(value, Name) else f"a {type(value).__name__}"
