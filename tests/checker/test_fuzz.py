"""Files made to break the checker: at random, to exhaust the machine, and read by the checker on its own.

The fuzzer drives the command line's own entry in process. Whatever the file holds, the checker ends with status 0, 1, 2
or 3, says so in one line or in one strict JSON object, and comes to an end; what it accepts is put to an oracle in ball
arithmetic that looks for a counterexample. The default run takes 2,000 inputs, `-m slow` 100,000. Files that could
exhaust memory or time are checked in processes of their own, which report their peak.
"""

from __future__ import annotations

import base64
import contextlib
import copy
import io
import json
import random
import shutil
import signal
import struct
import subprocess
import sys
import venv
from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import flint
import numpy as np
import pytest
from flint import arb, ctx
from hypothesis import HealthCheck, given, note, settings
from hypothesis import strategies as st

import certify.checker
from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates.verdict import Verdict
from certify.checker import document
from certify.checker.__main__ import main
from certify.checker.strict import MAX_BYTES
from certify.loop.plants import get_system
from certify.loop.policies import load_policy
from tests.checker.test_path import glide, waypoint
from tests.support.balls import ball as ball_of
from tests.support.balls import centred, enlarge, enlarged_from, reached_from, with_ball
from tests.support.certificates import LEAF, Document, decode, dump, edited, encode, grow, make, rehash
from tests.support.marks import slow_after
from tests.support.oracle import ball, policies_in_arb, value_of

CHECKER = Path(certify.checker.__file__).parent
SHIPPED = Path(__file__).parents[2] / "examples" / "policies" / "pendulum.pt"
RULES = {
    "format", "hash", "levels", "lyapunov", "equilibrium", "centring", "domain", "coordinates", "root", "local", "tree",
    "ring", "inputs", "tube", "flow",
}  # fmt: skip
RESULTS = {0: "ACCEPTED", 1: "REJECTED", 3: "TRUSTED"}
SECONDS = 5  # for one small file; a thousand times what it takes
OPTIONS = ([], ["--json"])
GIB = 2**30


# ----------------------------------------------------------------------------------------------------------- seed files


@cache
def scalar() -> Document:
    """xdot = x/2 - tanh(x)."""
    return grow(make([["+", ["/", "x", "2"], "u"]], [([[1.0]], [0.25])], [[1.0]], (0.01, 3.5)))


@cache
def enlarged() -> Document:
    """The same, with a tube of two slabs from |x| <= 0.3 into |x| <= 0.25."""
    data = make([["+", ["/", "x", "2"], "u"]], [([[1.0]], [0.25])], [[1.0]], (0.01, 0.0625))
    return enlarge(grow(data), [np.eye(1) / c for c in (0.09, 0.075, 0.0624)], [0.5, 0.5])


@cache
def planar() -> Document:
    """A pendulum under two tanh layers, centred at the output."""
    dynamics = ["w", ["+", ["sin", "a"], ["-", ["/", "w", "2"]], "u"]]
    layers = [(np.array([[0.5, 0.0], [0.0, 0.5]]), [0.1, -0.1]), ([[-5.0, -3.0]], [0.0])]
    P = np.array([[1.5, 0.5], [0.5, 0.75]])
    T = np.round(np.linalg.inv(np.linalg.cholesky(P).T) * 64) / 64
    return grow(make(
        dynamics, layers, P, (0.01, 0.02), states=("a", "w"), domain=[("-3", "3"), ("-3", "3")], squash="identity",
        input_bounds=[("-9", "9")], centre="output", scale=[1.0], T=T,
    ))  # fmt: skip


@cache
def trusted() -> Document:
    queries = [["ring", "unsat"], ["domain", "unsat"]]
    evidence = {
        "kind": "trusted-solver", "solver": "dreal", "version": "4.21", "precision": (1e-3).hex(), "queries": queries,
    }  # fmt: skip
    return edited(scalar(), "evidence", evidence)


@cache
def reached() -> Document:
    """xdot = -x, with a tube around a path, all of it by hand."""
    return glide()


SEEDS: tuple[Callable[[], Document], ...] = (scalar, enlarged, reached, planar, trusted)
seeds = st.sampled_from(range(len(SEEDS)))


# ------------------------------------------------------------------------------------------------------------- raw text


class Raw(str):
    """Text that goes into the file as it stands."""

    __slots__ = ()


class Twice(NamedTuple):
    """An object whose key stands in the file once more, with another value."""

    node: dict[str, Any]
    key: str
    value: Any


def text(node: Any) -> str:
    """The JSON text of a document that may hold `Raw` and `Twice`."""
    if isinstance(node, Raw):
        return str(node)
    if isinstance(node, Twice):
        return text(node.node)[:-1] + f",{json.dumps(node.key)}:{text(node.value)}}}"
    if isinstance(node, dict):
        return "{" + ",".join(f"{json.dumps(k)}:{text(v)}" for k, v in node.items()) + "}"
    if isinstance(node, list):
        return "[" + ",".join(map(text, node)) + "]"
    return json.dumps(node)


TOKENS = [
    "{", "}", "[", "]", ",", ":", '"', "\\", "\\u", "\\ud800", "\\u0000", "null", "true", "false", "NaN", "Infinity",
    "-Infinity", "0", "-0", "1", "-", "1e9", "1E400", "0.5", "1234567890", "12345678901", "9" * 5000, '"a"', '""',
    '"schema"', '"certify-certificate/8"', '"plant"', '"x"', '"0x1.0000000000000p+0"', "0x10", "//", "/*", "'a'", " ",
    "\n", "\t", "\x00", "\x1f", "\x7f", "\u0661", "\u2028", "\ufeff", "\U0001f600", "\ud800", "\udfff", "[" * 500,
    '{"a":' * 500, "[" * 2000 + "]" * 2000,
]  # fmt: skip
raw_bytes = st.one_of(
    st.binary(max_size=300),
    st.text(max_size=80).map(lambda s: s.encode("utf-8", "surrogatepass")),
    st.lists(st.sampled_from(TOKENS), max_size=40).map(lambda parts: "".join(parts).encode("utf-8", "surrogatepass")),
    st.text(st.characters(), max_size=30).map(lambda s: json.dumps(s).encode()),
)


# --------------------------------------------------------------------------------------------------- edits of the bytes

byte_edits = st.lists(
    st.tuples(
        st.sampled_from(["set", "bit", "insert", "delete", "copy", "move", "token", "cut"]),
        st.integers(0, 2**20),
        st.integers(0, 255),
        st.integers(1, 60),
    ),
    min_size=1,
    max_size=5,
)


@st.composite
def edited_bytes(draw: st.DrawFn) -> bytes:
    raw = bytearray(dump(SEEDS[draw(seeds)]()))
    for kind, position, value, length in draw(byte_edits):
        k = position % max(1, len(raw))
        if kind == "set":
            raw[k : k + 1] = bytes([value])
        elif kind == "bit":
            raw[k : k + 1] = bytes(b ^ (1 << value % 8) for b in raw[k : k + 1])
        elif kind == "insert":
            raw[k:k] = bytes([value]) * (length if value % 2 else 1)
        elif kind == "delete":
            del raw[k : k + length]
        elif kind == "copy":
            raw[k:k] = raw[k : k + length]
        elif kind == "move":
            part = raw[k : k + length]
            del raw[k : k + length]
            to = position // 7 % (len(raw) + 1)
            raw[to:to] = part
        elif kind == "token":
            raw[k : k + value % 4] = TOKENS[length % len(TOKENS)].encode("utf-8", "surrogatepass")
        elif length < 6:
            del raw[k:]
    return bytes(raw)


# ---------------------------------------------------------------------------------------------------- edits of the JSON

EXTREME = [
    0.0, -0.0, 5e-324, 2.0**-1074 * 3, 2.0**-1022, 2.0**-1000, 2.0**-961, 2.0**-540, 2.0**-511, 2.0**-270, 1e-9, 0.5,
    1.0, 20.0, 64.0, 2.0**30, 2.0**53, 2.0**270, 2.0**511, 2.0**512, 2.0**540, 2.0**1000, 2.0**1022, 2.0**1023,
    float(np.finfo(float).max),
]  # fmt: skip
numbers = st.one_of(
    st.floats(-4, 4),
    st.sampled_from([s * v for v in EXTREME for s in (1.0, -1.0)]),
    st.floats(allow_nan=False, allow_infinity=False),
)
digits = st.one_of(st.integers(1, 9), st.sampled_from([16, 309, 400, 1200, 1201]))


def written(length: int, first: str, rest: str) -> str:
    return first + rest * (length - 1)


naturals = st.builds(written, digits, st.sampled_from("13789"), st.sampled_from("0379"))
rationals = st.one_of(
    st.sampled_from(["0", "1", "-1", "2", "1/2", "-3/7", "5/2", "1/1000", "1000", "-0", "0/7", "6/4"]),
    st.builds(lambda sign, q: sign + q, st.sampled_from(["", "-"]), naturals),
    st.builds(lambda sign, p, q: f"{sign}{p}/{q}", st.sampled_from(["", "-"]), naturals, naturals),
    st.builds(lambda k: str(2**k) if k >= 0 else f"1/{2**-k}", st.integers(-3900, 3900)),
)
arrays = st.one_of(
    st.lists(numbers, max_size=5).map(encode),
    st.lists(st.sampled_from([np.nan, np.inf, -np.inf]), min_size=1, max_size=3).map(encode),
    st.binary(max_size=40).map(lambda raw: base64.b64encode(raw).decode()),
)
words = st.one_of(
    st.text(max_size=6),
    st.text(st.characters(categories=["Cs", "Cc", "Cn", "Mn", "Nd"]), max_size=4),
    st.sampled_from(["", "x", "u", "+", "**", "sin", "tan", "tanh", "identity", "none", "output", "partition-tree",
                     "trusted-solver", "preactivation", "\0", "\ud800", "\udc00\ud800", "a" * 5000, "\u00e9" * 300,
                     "\u0661", "x\n", "constructor", "__class__"]),
)  # fmt: skip
verbatim = st.one_of(
    st.sampled_from(TOKENS),
    st.integers(1, 4000).map(lambda k: "[" * k + "]" * k),
    st.integers(1, 4000).map(lambda k: '{"a":' * k + "0" + "}" * k),
    st.integers(1, 4500).map(lambda k: "7" * k),
    st.integers(-(10**12), 10**12).map(str),
    st.sampled_from(['"\ud800"', '"\\ud800\\ud800"', '"\\uDBFF"', '"a\0b"', '"\\u0000"', '"\\x41"', '"\U0010ffff"',
                     "+1", "01", "0x1", ".5", "1.", "1e", "1e-400", "-", "tru", "nul", "[,]", '{"a"}', "{1:2}"]),
).map(Raw)  # fmt: skip
leaves = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**40), 2**40), words, rationals, numbers.map(float.hex), arrays, verbatim
)
junk = st.recursive(
    leaves,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)

Place = tuple[Any, Any]  # a container and a key or an index in it


def places(node: Any) -> list[Place]:
    """Every entry of every list and object below the node, as (container, key)."""
    if isinstance(node, Twice):
        return places(node.node)
    below = list(node.items()) if isinstance(node, dict) else list(enumerate(node)) if isinstance(node, list) else []
    return [place for key, value in below for place in ((node, key), *places(value))]


json_edits = st.lists(
    st.tuples(
        st.sampled_from(["junk", "junk", "swap", "copy", "delete", "again", "rename", "wrap"]),
        st.integers(0, 2**20),
        st.integers(0, 2**20),
        junk,
    ),
    min_size=1,
    max_size=3,
)


@st.composite
def edited_json(draw: st.DrawFn) -> bytes:
    top = {"": edited(SEEDS[draw(seeds)](), "schema", "certify-certificate/8")}  # a deep copy
    for kind, position, other, value in draw(json_edits):
        found = places(top)
        if not found:
            break
        node, key = found[position % len(found)]
        another, place = found[other % len(found)]
        if kind == "swap":
            node[key], another[place] = copy.deepcopy((another[place], node[key]))  # one may lie within the other
        elif kind == "copy":
            node[key] = copy.deepcopy(another[place])
        elif kind == "delete" and node is not top:
            del node[key]
        elif kind == "again" and isinstance(node[key], dict) and node[key]:
            names = list(node[key])
            node[key] = Twice(node[key], names[other % len(names)], value)
        elif kind == "rename" and isinstance(node, dict) and node is not top:
            node[value if isinstance(value, str) and not isinstance(value, Raw) else f"{key} "] = node.pop(key)
        elif kind == "wrap":
            node[key] = [node[key]] if other % 2 else {"a": node[key]}
        else:
            node[key] = value
    if draw(st.booleans()):
        with contextlib.suppress(KeyError, IndexError, TypeError, ValueError, AttributeError, struct.error):
            rehash(top[""])
    return text(top[""]).encode("utf-8", "surrogatepass")


# -------------------------------------------------------------------------------------------------------- the equations


def _nodes(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.one_of(
        st.tuples(st.sampled_from("+*"), inner, inner).map(list),
        st.tuples(st.sampled_from("-/"), inner, inner).map(list),
        st.tuples(st.sampled_from(["-", "sin", "cos", "tan", "tanh", "exp", "atan", "sqrt"]), inner).map(list),
        st.tuples(st.just("**"), inner, st.sampled_from([1, 2, 3, 7, 63, 64, -1, -2, -64])).map(list),
        st.tuples(st.sampled_from("+*"), inner, inner, inner).map(list),
        st.builds(_tower, inner, st.lists(st.sampled_from([2, 3, 64, -1, -64]), min_size=2, max_size=12)),
        st.builds(_shared, st.sampled_from("+*-/"), inner, st.integers(1, 7)),
        st.builds(
            _nested,
            st.sampled_from(["-", "sin", "cos", "tan", "tanh", "exp", "atan", "sqrt"]),
            inner,
            st.sampled_from([1, 5, 50, 190, 201]),
        ),
    )


def _tower(base: Any, exponents: list[int]) -> Any:
    for exponent in exponents:
        base = ["**", base, exponent]
    return base


def _shared(operator: str, tree: Any, times: int) -> Any:
    for _ in range(times):
        tree = [operator, tree, tree] if len(repr(tree)) < 50_000 else tree
    return tree


def _nested(operator: str, tree: Any, depth: int) -> Any:
    for _ in range(depth if _depth(tree) + depth < 230 else 1):  # far beyond 200 nothing new is to be seen
        tree = [operator, tree]
    return tree


def _depth(tree: Any) -> int:
    return 1 + max(map(_depth, tree), default=0) if isinstance(tree, list) else 0


_names = st.sampled_from(["x", "x", "x", "u", "u"])
_wrong = st.one_of(
    junk,
    st.sampled_from([["log", "x"], ["**", "x", 65], ["**", "x", 0], ["**", "x", "2"], ["**", "x", True], ["+"], ["sin"],
                     [], ["sin", "x", "x"], ["-", "x", "x", "x"], "y", "X", "x ", {"+": ["x", "x"]}, ["x", "+", "x"]]),
)  # fmt: skip
right_trees = st.recursive(_names | rationals, _nodes, max_leaves=8)
wrong_trees = st.recursive(_names | rationals | _wrong, _nodes, max_leaves=6)


@st.composite
def equations(draw: st.DrawFn) -> bytes:
    """xdot = x/2 - tanh(x) and a drawn expression: alone, added, or multiplied so that f(0) = 0 is kept."""
    tree = draw(st.one_of(right_trees, right_trees, wrong_trees))
    linear = ["+", ["/", "x", "2"], "u"]
    tree = draw(st.sampled_from([
        tree, ["+", linear, tree], ["+", linear, ["*", "x", tree]], ["+", linear, ["*", "x", "x", "x", tree]],
        ["+", linear, ["*", ["/", "1", "1" + "0" * 30], "x", ["sin", "x"], tree]], ["*", linear, ["+", "1", tree]],
    ]))  # fmt: skip
    level = draw(st.sampled_from([1e-4, 2.0**-200, 2.0**-1000, 0.01]))
    ratio = draw(st.sampled_from([1.0, 1.0, 2.0, 350.0]))
    data = make([], [([[1.0]], [0.0])], [[1.0]], (level, level * ratio))
    data["plant"]["dynamics"] = [tree]
    if draw(st.integers(0, 5)) == 0:
        data["plant"]["u_eq"] = [draw(rationals)]
    if draw(st.integers(0, 3)) == 0:
        data["evidence"]["tree"] = scalar()["evidence"]["tree"]
    return text(data).encode("utf-8", "surrogatepass")


# ---------------------------------------------------------------------------------------- well-formed, extreme numbers

trees = st.one_of(
    st.just(bytes([LEAF])),
    st.just(base64.b64decode("AP8A//8=")),
    st.lists(st.sampled_from([0, 1, 2, LEAF]), min_size=1, max_size=40).map(bytes),
    st.integers(1, 1100).map(lambda k: bytes(k) + bytes([LEAF]) * (k + 1)),
)


@st.composite
def any_numbers(draw: st.DrawFn) -> bytes:
    """Up to three states, two inputs and two hidden layers; shapes agree, the hash is honest, P is often definite."""
    n, m = draw(st.integers(1, 3)), draw(st.integers(1, 2))
    widths = [n, *draw(st.lists(st.integers(1, 3), max_size=2)), m]
    some = draw(st.sampled_from([numbers, st.floats(-2, 2), st.sampled_from(EXTREME)]))

    def array(*shape: int) -> np.ndarray:
        size = int(np.prod(shape))
        return np.array(draw(st.lists(some, min_size=size, max_size=size))).reshape(shape)

    def diagonal() -> np.ndarray:
        return np.diag(np.array(draw(st.lists(st.sampled_from(EXTREME[2:]), min_size=n, max_size=n))))

    states, inputs = [f"x{i}" for i in range(n)], [f"u{j}" for j in range(m)]
    names = {"x": states[0], "u": inputs[0]}

    def renamed(tree: Any) -> Any:
        return names.get(tree, tree) if isinstance(tree, str) else [*tree[:1], *map(renamed, tree[1:])] if isinstance(
            tree, list) else tree  # fmt: skip

    dynamics = [["+", ["*", "-2", x], ["*", x, renamed(draw(st.just("0") | right_trees))]] for x in states]
    P, T = (array(n, n) if draw(st.integers(0, 3)) == 0 else diagonal() for _ in range(2))
    levels = sorted(abs(v) or 1.0 for v in draw(st.tuples(numbers, numbers)))
    root = np.abs(array(n))
    if draw(st.booleans()):  # so that the last rules run as well
        P, T, root, levels = np.eye(n), np.eye(n), np.full(n, 3.0), [1e-6, draw(st.sampled_from([1e-6, 1e-5, 1.0]))]
    largest = draw(st.sampled_from(["3", str(2**600), "9" * 1201]))
    data = make(
        dynamics, [(array(b, a), array(b)) for a, b in pairwise(widths)], np.abs(P), tuple(levels),
        states=states, inputs=inputs, u_eq=["0"] * m, domain=[(f"-{largest}", largest)] * n,
        input_bounds=[(f"-{largest}", largest)] * m, squash=draw(st.sampled_from(["tanh", "identity"])),
        centre=draw(st.sampled_from(["output", "none"])), scale=np.where(array(m) == 0, 1.0, array(m)), offset=array(m),
        T=T, root=root, tree=draw(trees),
    )  # fmt: skip
    if draw(st.booleans()):
        data = edited(data, "evidence.local", centred(array(n, n), np.abs(array(3, n))))
    if draw(st.booleans()):  # a tube into {V <= c2}, or anywhere

        def node(factor: float) -> Any:
            with np.errstate(all="ignore"):
                near = factor * np.abs(P) / levels[1]
            return encode(near if draw(st.booleans()) and np.isfinite(near).all() else array(n, n))

        def one_ball() -> Document:
            mine = {key: data["evidence"]["local"][key] for key in ("J", "multipliers", "weight")}
            return mine if draw(st.booleans()) else ball_of(array(n, n), np.abs(array(3, n)))

        times = draw(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=2))
        moves = draw(st.booleans())

        def one_path() -> Document | None:
            shares = st.floats(0.1, 0.9) | numbers
            return waypoint(array(n), draw(shares), *np.abs(array(3)).tolist()) if moves else None

        slabs = [
            {"middle": node(1.5), "end": node(2.0), "duration": h.hex(), "path": one_path()} | one_ball() for h in times
        ]
        start = node(1.0)
        claim = (reached_from(np.eye(n), array(n)) if moves else enlarged_from(np.eye(n))) | {"start": start}
        data = edited(data, "claim", claim)
        data["evidence"]["tube"] = slabs
    return dump(data)


ARRAYS = ["policy.scale", "policy.offset", "policy.layers.0.weight", "policy.layers.0.bias", "lyapunov.P", "evidence.T",
          "evidence.root", "evidence.local.J", "evidence.local.multipliers"]  # fmt: skip


def power(k: int) -> str:
    return str(2**k) if k >= 0 else f"1/{2**-k}"


@st.composite
def scaled(draw: st.DrawFn) -> bytes:
    """xdot = x/2 - tanh(x) in other units, valid as it stands or up to one number."""
    k = draw(st.one_of(st.integers(-20, 20), st.integers(-530, 530)))
    P, root = (1.0, 2.0**k) if draw(st.booleans()) else (4.0**-k if abs(k) < 510 else 1.0, 1.0)
    level = P * 4.0**k if abs(k) < 500 else 1.0
    bound = draw(st.sampled_from([3, 2**20])) * Fraction(2) ** k
    seed = scalar()
    data = make(
        [["+", ["/", "x", "2"], ["*", power(k), "u"]]], [([[2.0**-k]], [0.25])], [[P]], (0.01 * level, 3.5 * level),
        domain=[(str(-bound), str(bound))], T=[[2.0**k / root]], root=decode(
            seed["evidence"]["root"]) * root, tree=base64.b64decode(seed["evidence"]["tree"]),
    )  # fmt: skip
    change = draw(st.sampled_from(["none", "number", "nudge", "level", "tree", "centre", "bounds"]))
    path = draw(st.sampled_from(ARRAYS))
    if change == "number":
        data = edited(data, path, encode([draw(numbers)] * len(decode(_at(data, path)))))
    elif change == "nudge":
        factor = draw(st.sampled_from([1 - 2.0**-53, 1 + 2.0**-52, 0.999, 1.001, 0.9, 1.1, -1.0, 2.0, 0.5]))
        with np.errstate(over="ignore"):
            changed = np.clip(decode(_at(data, path)) * factor, -1e308, 1e308)
        data = edited(data, path, encode(changed))
    elif change == "level":
        value = abs(draw(numbers | st.sampled_from([3.5 * level, 3.6 * level, 3.66 * level, 3.7 * level, 4 * level])))
        data = edited(data, draw(st.sampled_from(["levels.local", "levels.roa"])), value.hex())
    elif change == "tree":
        data = edited(data, "evidence.tree", base64.b64encode(draw(trees)).decode())
    elif change == "centre":
        data = edited(data, "policy.centre", draw(st.sampled_from(["none", "output"])))
    elif change == "bounds":
        low, high = sorted([Fraction(draw(numbers)), Fraction(draw(numbers))])
        data = edited(
            data, draw(st.sampled_from(["plant.domain.0", "plant.input_bounds.0"])), [str(low), str(high + 1)]
        )
    return dump(rehash(with_ball(data) if draw(st.booleans()) else data))


def _at(data: Any, path: str) -> Any:
    for key in path.split("."):
        data = data[int(key) if key.isdigit() else key]
    return data


# --------------------------------------------------------------------------------------------------------- the property


class Endless(BaseException):
    """The checker did not come to an end; the command line's own handler must not take it for an error of its own."""


@contextlib.contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise `Endless` after so many seconds of this process's own time."""

    def stop(*_: object) -> None:
        raise Endless(f"{seconds} s")

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def peak() -> int:
    """The most memory this process has held, in bytes; 0 where the system does not say."""
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return 1024 * int(next(line for line in lines if line.startswith("VmHWM:")).split()[1])
    return 0


def strict(answer: str) -> dict[str, Any]:
    """The one JSON object that the text is."""

    def refuse(number: str) -> None:
        raise AssertionError(f"{number} is not JSON")

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        assert len(dict(pairs)) == len(pairs), "a key stands twice"
        return dict(pairs)

    assert answer.endswith("\n") and answer.count("\n") == 1
    value = json.loads(answer, parse_constant=refuse, object_pairs_hook=once)
    assert isinstance(value, dict)
    return value


def judged(raw: bytes, path: Path, options: list[str]) -> int:
    """The status for a file, after everything that holds for any file has been asserted."""
    path.write_bytes(raw)
    out, err, before = io.StringIO(), io.StringIO(), peak()
    seconds = SECONDS
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), time_limit(seconds):
        status = main([str(path), *options])
    printed, complaint = out.getvalue(), err.getvalue()
    assert peak() - before < GIB
    assert status in RESULTS, f"status {status}: {printed[-500:]} {complaint[-500:]}"
    assert complaint == "" and printed.isascii()
    if "--json" in options:
        answer = strict(printed)
        assert answer["result"] == RESULTS[status]
        rule = answer.get("rule")
    else:
        last = printed.splitlines()[-1]
        assert last.startswith(RESULTS[status] + " ") and printed.endswith("\n")
        assert [line.split()[0] for line in printed.splitlines()].count(RESULTS[status]) == 1
        rule = last.split()[1].removeprefix("rule=") if status == 1 else None
    assert rule in RULES if status == 1 else rule is None
    return status


def counterexample(raw: bytes, path: Path) -> str | None:
    """A point at which an accepted certificate's claim certainly fails, or None if the search finds none."""
    path.write_bytes(raw)
    c, trees = document.read(str(path)), json.loads(raw)["plant"]["dynamics"]
    generator = random.Random(0)
    n = len(c.states)
    with ctx.workprec(3000):
        P = [[arb(float(v)) for v in row] for row in c.P]

        def form(a: list[arb], b: list[arb]) -> arb:
            return sum((a[i] * P[i][j] * b[j] for i in range(n) for j in range(n)), arb(0))

        points: list[list[arb]] = []
        for k in range(12):
            direction = [arb(generator.gauss(0, 1)) / P[i][i].sqrt() for i in range(n)]
            inner, outer = arb(c.c1), arb(c.c2)
            target = [outer, outer * 0.99, inner, inner * 0.5, outer * generator.random()][k % 5]
            stretch = (target / form(direction, direction)).sqrt() * (1 - arb(2) ** -1000)
            points.append([(v * stretch).mid() for v in direction])
        for x, u in zip(points, policies_in_arb(c.policy, c.u_eq, points), strict=True):
            if not 0 < form(x, x) <= arb(c.c2):
                continue
            values = dict(zip((*c.states, *c.inputs), (*x, *u), strict=True))
            at = f"{[float(v) for v in x]}"
            if form(x, [value_of(tree, values) for tree in trees]) >= 0:
                return f"Vdot >= 0 at {at}"
            for v, (lo, hi) in zip((*x, *u), (*c.domain, *c.input_bounds), strict=True):
                if v < ball(lo) or v > ball(hi):
                    return f"a bound is left at {at}"
        return _leaves_tube(c, trees, generator)


def _leaves_tube(c: document.Certificate, trees: list[Any], generator: random.Random) -> str | None:
    """A point of a slab's ellipsoids, around a path of their edges, in which e'P(t)e does not fall."""
    if c.tube is None:
        return None
    n, before = len(c.states), c.tube.start
    centre = [arb(0)] * n if c.tube.centre is None else [arb(float(v)) for v in c.tube.centre]
    for k, slab in enumerate(c.tube.slabs):
        nodes = [[[arb(float(v)) for v in row] for row in P] for P in (before, slab.middle, slab.end)]
        h, before, begin = arb(slab.duration), slab.end, centre
        if slab.path is not None:
            centre = [arb(float(v)) for v in slab.path.centre]
        moved = [(q - p) / h for p, q in zip(begin, centre, strict=True)]
        for s in (arb(0), arb(1) / 2, arb(1), arb(generator.random())):
            weights, rates = [(1 - s) ** 2, 2 * s * (1 - s), s * s], [-2 * (1 - s), 2 - 4 * s, 2 * s]
            P, R = ([[sum((w * M[i][j] for w, M in zip(each, nodes, strict=True)), arb(0)) for j in range(n)]
                     for i in range(n)] for each in (weights, rates))  # fmt: skip
            inside = [1 - arb(2) ** -1000, arb(generator.random())]
            for share in inside if slab.path is None else [arb(1), arb(1)]:
                d = [arb(generator.gauss(0, 1)) for _ in range(n)]
                size = sum((d[i] * P[i][j] * d[j] for i in range(n) for j in range(n)), arb(0))
                e = [(v * (share / size).sqrt()).mid() for v in d]
                x = [(1 - s) * p + s * q + v for p, q, v in zip(begin, centre, e, strict=True)]
                (u,) = policies_in_arb(c.policy, c.u_eq, [x])
                values = dict(zip((*c.states, *c.inputs), (*x, *u), strict=True))
                F = [value_of(tree, values) - v for tree, v in zip(trees, moved, strict=True)]
                falls = sum(
                    (e[i] * (R[i][j] / h * e[j] + 2 * P[i][j] * F[j]) for i in range(n) for j in range(n)), arb(0)
                )
                if not falls < 0:
                    return f"e'P(t)e does not fall in slab {k}"
    return None


STRATEGIES: dict[str, Callable[[], st.SearchStrategy[bytes]]] = {
    "raw bytes": lambda: raw_bytes,
    "edited bytes": edited_bytes,
    "edited JSON": edited_json,
    "equations": equations,
    "any numbers": any_numbers,
    "other units": scaled,
}


def campaign(name: str, count: int, path: Path, derandomize: bool) -> None:
    @settings(
        max_examples=count,
        derandomize=derandomize,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(STRATEGIES[name](), st.sampled_from(OPTIONS))
    def one(raw: bytes, options: list[str]) -> None:
        note(f"the file: {raw!r}")
        if judged(raw, path, options) == 0:
            assert counterexample(raw, path) is None

    one()


@pytest.mark.parametrize("name", slow_after(3, STRATEGIES))
def test_every_file_is_judged(name: str, tmp_path: Path) -> None:
    campaign(name, 120, tmp_path / "certificate.json", derandomize=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", STRATEGIES)
def test_a_hundred_thousand_files_are_judged(name: str, tmp_path: Path) -> None:
    campaign(name, 17_000, tmp_path / "certificate.json", derandomize=False)


@pytest.mark.parametrize("seed", SEEDS, ids=lambda seed: seed.__name__)
def test_the_files_they_are_made_from_pass(seed: Callable[[], Document], tmp_path: Path) -> None:
    path = tmp_path / "certificate.json"
    for options in OPTIONS:
        assert judged(dump(seed()), path, options) == (3 if seed is trusted else 0)
    assert seed is trusted or counterexample(dump(seed()), path) is None


def test_the_oracle_finds_a_false_claim(tmp_path: Path) -> None:
    """A level beyond the region of attraction, and inputs beyond their bounds."""
    path = tmp_path / "certificate.json"
    for field, value, found in (
        ("levels.roa", (4.0).hex(), "Vdot"),
        ("plant.input_bounds.0", ["-1/2", "1/2"], "bound"),
    ):
        wrong = dump(edited(scalar(), field, value))
        assert judged(wrong, path, []) == 1
        assert found in (counterexample(wrong, path) or "")
    for field, change in (("duration", lambda h: (0.1).hex()), ("middle", lambda P: encode(1.2 * decode(P)))):
        wrong = dump(edited(enlarged(), f"evidence.tube.1.{field}", change))
        assert judged(wrong, path, []) == 1
        assert "slab 1" in (counterexample(wrong, path) or "")
    for field, change in (("duration", (0.1).hex()), ("path.centre", encode([1.0])), ("path.centre", encode([1.7]))):
        wrong = dump(edited(reached(), f"evidence.tube.1.{field}", change))
        assert judged(wrong, path, []) == 1
        assert "slab 1" in (counterexample(wrong, path) or "")


# --------------------------------------------------------------------------------------------- files made to exhaust it

LIMIT = 3 * GIB // 2  # of memory, for any file that is refused for its form
ALLOWED = 6 * GIB  # what a process may map: beyond, a check is an error
PATIENCE = 120  # seconds, for any file; a guard against files that take hours


class Ended(NamedTuple):
    status: int
    out: str
    err: str
    peak: int


def in_a_process(path: Path, *arguments: str) -> Ended:
    """The command line in a process of its own, which may map 6 GiB and reports the most memory that it held."""
    report = path.with_suffix(".peak")
    code = (
        "import resource, sys;"
        f"resource.setrlimit(resource.RLIMIT_AS, ({ALLOWED}, {ALLOWED}));"
        f"sys.path.insert(0, {str(CHECKER.parent.parent)!r});"
        "from certify.checker.__main__ import main;"
        f"status = main({[str(path), *arguments]!r});"
        f"open({str(report)!r}, 'w').write(open('/proc/self/status').read());"
        "sys.exit(status)"
    )
    command = [sys.executable, "-I", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE)
    assert report.exists(), f"status {done.returncode}: {done.stderr[-500:]}"
    held = next(line for line in report.read_text().splitlines() if line.startswith("VmHWM:"))
    return Ended(done.returncode, done.stdout, done.stderr, 1024 * int(held.split()[1]))


needs_linux = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs the system's count of memory")


@pytest.fixture
def large(tmp_path: Path) -> Iterator[Path]:
    """A path whose file does not outlive the test."""
    path = tmp_path / "certificate.json"
    yield path
    path.unlink(missing_ok=True)


def around(marker: str) -> tuple[bytes, bytes]:
    """The scalar certificate before and behind a value that replaces provenance's text, or an entry's."""
    before, behind = dump(edited(scalar(), marker, "@")).split(b'"@"')
    return before, behind


def repeated(part: bytes, size: int, marker: str = "provenance.tool") -> bytes:
    """The scalar certificate, one of its values replaced by a list of `size` bytes that repeats a part."""
    before, behind = around(marker)
    return b"".join([before, b"[", (part + b",") * (size // (len(part) + 1)), part, b"]", behind])


MANY_VALUES: dict[str, Callable[[], bytes]] = {
    "lists": lambda: repeated(b"[]", 120 * 2**20),
    "objects": lambda: repeated(b"{}", 60 * 2**20),
    "integers": lambda: repeated(b"1234567890", 120 * 2**20),
    "words": lambda: repeated(b'"ab"', 120 * 2**20),
    "lists in the equations": lambda: repeated(b"[]", 60 * 2**20, "plant.dynamics"),
    "pairs": lambda: repeated(b'["q","a"]', 60 * 2**20),
    "keys": lambda: b"{" + b",".join(b'"%x":0' % k for k in range(4_000_000)) + b"}",
    "many objects": lambda: repeated(b'{"a":0,"b":0}', 60 * 2**20),
    "open lists": lambda: b"[" * (60 * 2**20),
    "open objects": lambda: b'{"a":' * (12 * 2**20),
    "truncated": lambda: repeated(b"[]", 60 * 2**20)[:-3],
}


@needs_linux
@pytest.mark.parametrize("name", [
    pytest.param(n, marks=[] if n in ("lists", "open lists") else [pytest.mark.slow]) for n in MANY_VALUES
])  # fmt: skip
def test_files_of_many_values_are_refused(name: str, large: Path) -> None:
    large.write_bytes(MANY_VALUES[name]())
    done = in_a_process(large)
    assert (done.status, done.err) == (1, "") and done.out.startswith("REJECTED rule=format at=")
    assert done.peak < LIMIT


def filled(unit: str, marker: str = "provenance.tool", opening: str = '"', closing: str = '"') -> bytes:
    """The scalar certificate with a value in which one unit is repeated until the file is as large as it may be."""
    before, behind = around(marker)
    before, behind, raw = before + opening.encode(), closing.encode() + behind, unit.encode()
    return before + raw * ((MAX_BYTES - len(before) - len(behind)) // len(raw)) + behind


NEARLY_TOO_LARGE: dict[str, tuple[Callable[[], bytes], set[int]]] = {
    "a long text": (lambda: filled("a"), {0, 1}),
    "a long text of escapes": (lambda: filled("\\u0041"), {0, 1}),
    "a long text, one letter of it wide": (lambda: filled("a", opening='"\U0001f600'), {0, 1}),
    "wide text": (lambda: filled("\u4e00"), {0, 1}),
    "a tree": (lambda: filled("////", "evidence.tree"), {1}),
    "weights": (lambda: filled("AAAA", "policy.layers.0.weight"), {1}),
    "a rational": (lambda: filled("7", "plant.domain.0.1"), {1}),
    "a name": (lambda: filled("x", "plant.name"), {1}),
    "a key": (lambda: filled("x", opening='{"', closing='":0}'), {0, 1}),
    "an integer": (lambda: filled("7", opening="", closing=""), {1}),
    "a decimal number": (lambda: filled("7", opening="0.", closing=""), {1}),
    "white space": (lambda: filled(" ", opening="", closing="null"), {0, 1}),
}


@needs_linux
@pytest.mark.parametrize("name", [
    pytest.param(n, marks=[] if n == "a tree" else [pytest.mark.slow]) for n in NEARLY_TOO_LARGE
])  # fmt: skip
def test_files_just_below_the_limit_fit_into_memory(name: str, large: Path) -> None:
    build, expected = NEARLY_TOO_LARGE[name]
    raw = build()
    assert MAX_BYTES - 8 <= len(raw) <= MAX_BYTES
    large.write_bytes(raw)
    done = in_a_process(large)
    assert done.status in expected and done.err == "" and len(done.out) < 10_000
    assert done.peak < LIMIT


def wide_plant(terms: list[Any], n: int = 64, **changes: Any) -> Document:
    """n states, n inputs, u = -x, f_i = u_i + the terms that fall to it; levels so low that those hardly count."""
    states, inputs = [f"x{i}" for i in range(n)], [f"u{i}" for i in range(n)]
    dynamics = [["+", u, *terms[i::n]] for i, u in enumerate(inputs)]
    settings = {
        "states": states, "inputs": inputs, "u_eq": ["0"] * n, "domain": [("-3", "3")] * n, "squash": "identity",
        "input_bounds": [("-9", "9")] * n, "centre": "none", "scale": [1.0] * n, "offset": [0.0] * n,
        "root": [2.0**-39] * n,
    }  # fmt: skip
    layers = [(-np.eye(n), [0.0] * n)]
    plain = [["+", u] for u in inputs]
    data = make(plain, layers, np.eye(n), (2.0**-81, 2.0**-80), **{**settings, **changes})
    data["plant"]["dynamics"] = dynamics
    data["evidence"]["local"] = centred(np.eye(n) * 1.5 * 2.0**-40, np.full((3, n), 2.0**-20))
    return data


def products(count: int) -> list[Any]:
    names = [f"{letter}{i}" for letter in "xu" for i in range(64)]
    return [["*", names[i % 64], names[i // 64]] for i in range(count)]


def colliding(count: int) -> list[Any]:
    """Rationals all of whose hashes are 0 in Python, each times a state."""
    return [["*", "x", f"1/{2**70 + k * (2**61 - 1)}"] for k in range(1, count + 1)]


def long_rationals(count: int) -> list[Any]:
    """Rationals of 1,201 digits above and below, each times a state."""
    return [["*", "x", f"{10**1199 + 2 * k + 1}/{10**1200 + k}"] for k in range(count)]


def extreme_matrices(reach_P: int, reach_T: int, n: int = 64) -> Document:
    """A definite P and any T; 53 bits each, and exponents up to so far in both directions."""
    generator = np.random.default_rng(0)

    def mixed(reach: int, *shape: int) -> np.ndarray:
        return generator.uniform(1, 2, shape) * np.ldexp(1.0, generator.choice([-reach, 0, reach], shape))

    cross = np.tril(generator.uniform(1, 2, (n, n)) * 2.0**-reach_P, -1) / 256
    P = np.diag(mixed(reach_P, n)) + cross + cross.T
    far = str(2**3000)
    base = wide_plant([], n, domain=[("-" + far, far)] * n, root=[2.0**1000] * n)
    evidence = {
        "T": encode(mixed(reach_T, n, n) if reach_T else np.eye(n)),
        "root": encode([2.0**1000] * n),
        "tree": encode_tree([LEAF]),
        "local": centred(np.diag(2 * np.diag(P) ** -0.5), np.ones((3, n))),
    }
    return base | {
        "lyapunov": {"kind": "quadratic", "P": encode(P)},
        "levels": {"local": (1.0).hex(), "roa": (2.0).hex()},
        "evidence": base["evidence"] | evidence,
    }


def encode_tree(nodes: list[int]) -> str:
    return base64.b64encode(bytes(nodes)).decode()


def balanced(depth: int) -> bytes:
    """A tree of 2^depth leaves in preorder."""
    tree = bytes([LEAF])
    for _ in range(depth):
        tree = bytes([0]) + tree + tree
    return tree


def one_state(*terms: Any, **changes: Any) -> Document:
    """xdot = u + the terms, u = -x, by the local rule alone at a low level."""
    level = 2.0**-200
    return make([["+", "u", *terms]], [([[-1.0]], [0.0])], [[1.0]], (level, level), squash="identity", centre="none",
                scale=[1.0], input_bounds=[("-9", "9")], **changes)  # fmt: skip


HARD: dict[str, tuple[Callable[[], Document], set[str]]] = {
    "600 products of 64 states and 64 inputs": (lambda: wide_plant(products(600)), {"local"}),
    # 64 states and thousands of operations may need more memory than there is, which is an error and no verdict
    "6,000 products of 64 states and 64 inputs": (lambda: wide_plant(products(6000)), {"local", "format"}),
    "one sum of 6,000 products": (
        lambda: edited(wide_plant([]), "plant.dynamics.0", ["+", "u0", *products(6000)]), {"local", "format"}
    ),
    "one sum of 9,800 rationals": (
        lambda: edited(wide_plant([]), "plant.dynamics.0", [
            "+", "u0", *(str(k) for k in range(1, 4900)), *(str(-k) for k in range(1, 4900))
        ]), {"local", "format", "error"},
    ),
    "values that are needed again": (
        lambda: edited(edited(wide_plant([]), "plant.dynamics.0", ["+", "u0", *products(3200)]), "plant.dynamics.1", [
            "+", "u1", *products(3200)
        ]), {"local", "format"},
    ),
    "extreme P": (lambda: extreme_matrices(1000, 0), {"lyapunov", "domain", "coordinates", "root", "local"}),
    "extreme T": (lambda: extreme_matrices(0, 1000), {"coordinates"}),
    "extreme P and T": (lambda: extreme_matrices(1000, 1000), {"lyapunov", "coordinates"}),
    "large P": (lambda: extreme_matrices(200, 0), {"lyapunov", "local", "inputs"}),
    "large P and T": (lambda: extreme_matrices(75, 30), {"coordinates"}),
    "hashes that collide": (lambda: one_state(*colliding(6000)), {"ACCEPTED", "format"}),
    "long rationals": (lambda: one_state(_nested("-", ["+", "x", *long_rationals(4000)], 191)), {"ACCEPTED", "format"}),
    "a million leaves": (
        lambda: edited(one_state(), "evidence.tree", base64.b64encode(balanced(20)).decode()), {"ACCEPTED"}
    ),
    "towers of powers": (
        lambda: one_state(*(_tower(["*", "x", str(k)], [64] * 150) for k in range(1, 9))), {"ACCEPTED", "local"}
    ),
    "towers of powers of a rational": (
        lambda: one_state(*(["*", "x", _tower(str(k), [64] * 150)] for k in range(3, 9))), {"format"}
    ),
    "sums of fractions": (
        lambda: one_state(*(["*", "x", ["/", "1", str(10**300 + k)]] for k in range(2500))), {"ACCEPTED"}
    ),
}  # fmt: skip


SLOW = {
    "6,000 products of 64 states and 64 inputs", "one sum of 6,000 products", "one sum of 9,800 rationals",
    "values that are needed again", "large P", "large P and T", "sums of fractions", "long rationals",
    "600 products of 64 states and 64 inputs", "towers of powers", "towers of powers of a rational",
    "hashes that collide",
}  # fmt: skip


@needs_linux
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] if n in SLOW else []) for n in HARD])
def test_hard_certificates_are_judged_within_bounds(name: str, large: Path) -> None:
    build, expected = HARD[name]
    large.write_bytes(dump(rehash(build())))
    done = in_a_process(large, "--json")
    answer = strict(done.out)
    assert done.err == "" and answer.get("rule", answer.get("result", "error")) in expected, answer
    assert done.peak < ALLOWED


@needs_linux
@pytest.mark.slow
def test_a_network_of_sixteen_million_weights_fits_into_memory(large: Path) -> None:
    """u = -x through a layer of 16,384 and one of 1,024; a file of 179 million bytes."""
    widths, layers = [1, 2**14, 2**10, 1], []
    for columns, rows in pairwise(widths):
        W = np.full((rows, columns), 2.0**-30)
        W[0, 0] = 1.0
        layers.append((W, np.zeros(rows)))
    large.write_bytes(dump(make(["u"], layers, [[1.0]], (2.0**-40, 2.0**-40), input_bounds=[("-9", "9")])))
    done = in_a_process(large, "--json")
    assert done.status == 0 and strict(done.out)["result"] == "ACCEPTED"
    assert done.peak < LIMIT


# ----------------------------------------------------------------------------------------------- the checker on its own

ABSENT = ("torch", "scipy", "sympy", "mpmath", "matplotlib", "controllers", "typer", "hypothesis",
          "certify.analysis", "certify.loop", "certify.certificates")  # fmt: skip


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment that holds numpy, python-flint and the checker's folder, and nothing else."""
    folder = tmp_path_factory.mktemp("alone")
    venv.create(folder, with_pip=False, symlinks=True)
    packages = next(folder.glob("lib/python*/site-packages"))
    assert list(packages.iterdir()) == []
    for module, pattern in ((np, "numpy*"), (flint, "flint"), (flint, "python_flint*")):
        for found in Path(module.__file__).parent.parent.glob(pattern):
            (packages / found.name).symlink_to(found)
    assert {p.name.split("-")[0] for p in packages.iterdir()} <= {
        "numpy", "numpy.libs", "flint", "python_flint", "python_flint.libs"
    }  # fmt: skip
    shutil.copytree(CHECKER, packages / "certify" / "checker", ignore=shutil.ignore_patterns("__pycache__"))
    return folder / "bin" / "python"


@pytest.fixture(scope="module")
def shipped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The certificate of the pendulum's policy that ships."""
    policy = load_policy(SHIPPED)
    system = get_system("pendulum").with_parameters(policy.parameters)
    folder = tmp_path_factory.mktemp("shipped")
    assert certify_roa(system, policy.network, folder, RoaOptions(candidate="lyapunov")).verdict is Verdict.PROVED
    return folder / "certificate.json"


def run_alone(python: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [str(python), "-I", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder, timeout=PATIENCE)


def test_the_shipped_certificate_is_accepted_with_numpy_and_flint_alone(
    alone: Path, shipped: Path, tmp_path: Path
) -> None:
    done = run_alone(alone, tmp_path, "-m", "certify.checker", str(shipped))
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[-1].startswith("ACCEPTED c1=")
    answer = strict(run_alone(alone, tmp_path, "-m", "certify.checker", str(shipped), "--json").stdout)
    claim = json.loads(shipped.read_bytes())
    assert answer["policy_sha256"] == claim["policy"]["sha256"] == load_policy(SHIPPED).network.sha256()
    assert answer["levels"]["roa"] == float.fromhex(claim["levels"]["roa"])


def test_every_verdict_is_given_alone(alone: Path, shipped: Path, tmp_path: Path) -> None:
    path = tmp_path / "certificate.json"
    claim = json.loads(shipped.read_bytes())
    level = float.fromhex(claim["levels"]["roa"])
    for raw, status in (
        (dump(edited(claim, "levels.roa", (2 * level).hex())), 1), (b"{", 1), (dump(trusted()), 3), (dump(planar()), 0),
    ):  # fmt: skip
        path.write_bytes(raw)
        done = run_alone(alone, tmp_path, "-m", "certify.checker", str(path))
        assert (done.returncode, done.stderr) == (status, "") and done.stdout.count("\n") >= 1
    done = run_alone(alone, tmp_path, "-m", "certify.checker", str(tmp_path / "absent.json"))
    assert done.returncode == 2 and "Traceback" not in done.stderr


def test_nothing_else_is_there_or_is_asked_for(alone: Path, shipped: Path, tmp_path: Path) -> None:
    """What the checker loads is the standard library, numpy, python-flint and itself."""
    code = (
        "import importlib.util, sys\n"
        "from certify.checker.__main__ import main\n"
        f"status = main([{str(shipped)!r}])\n"
        "third = {m.split('.')[0] for m in sys.modules} - {*sys.stdlib_module_names, 'cython_runtime'}\n"
        "print(*sorted(m for m in third if not m.startswith('_')))\n"
        f"print(*[m for m in {ABSENT!r} if importlib.util.find_spec(m) is not None])\n"
        "sys.exit(status)\n"
    )
    done = run_alone(alone, tmp_path, "-c", code)
    assert (done.returncode, done.stderr) == (0, "")
    loaded, present = done.stdout.split("\n")[-3:-1]
    assert (loaded.split(), present) == (["certify", "flint", "numpy"], "")


def test_an_optimising_interpreter_gives_the_same_verdicts_alone(alone: Path, shipped: Path, tmp_path: Path) -> None:
    path = tmp_path / "certificate.json"
    claim = json.loads(shipped.read_bytes())
    path.write_bytes(dump(edited(claim, "evidence.tree", encode_tree([LEAF]))))
    for file, status in ((shipped, 0), (path, 1)):
        done = run_alone(alone, tmp_path, "-OO", "-m", "certify.checker", str(file))
        assert (done.returncode, done.stderr) == (status, "")
