"""Strict reading: whatever the bytes are, the checker accepts, rejects or says that it cannot read, and never stumbles.

Malformed files go through `document.read` in process; the command line is driven as a process of its own.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import socket
import subprocess
import sys
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from certify.checker import document, rules, strict, words
from certify.checker.__main__ import main
from certify.checker.errors import Rejected, Unreadable
from certify.checker.exact import Exact, Undecided
from certify.checker.expression import evaluate, parse
from certify.checker.schema import Value
from certify.checker.strict import MAX_BYTES
from certify.reference.expressions import equations
from certify.reference.refusal import Refused
from tests.support.certificates import Document, dump, edited, encode, grow, make, rehash, write


@cache
def good() -> Document:
    """xdot = x/2 - tanh(x)."""
    return grow(make([["+", ["/", "x", "2"], "u"]], [([[1.0]], [0.25])], [[1.0]], (0.01, 3.5)))


def claim(*dynamics: Any, **changes: Any) -> Document:
    """A document that the local rule alone decides, for tests of the equations; its ball suits xdot = x/2 - tanh(x)."""
    data = make([["+", ["/", "x", "2"], "u"]], [([[1.0]], [0.0])], [[1.0]], (1e-4, 1e-4), **changes)
    return edited(data, "plant.dynamics", list(dynamics))


def outcome(raw: bytes, folder: Path) -> str:
    """`ACCEPTED` or the rule's name; any exception but `Rejected` goes through."""
    try:
        rules.check(document.read(str(write(raw, folder))))
    except Rejected as no:
        return no.rule
    return "ACCEPTED"


def run(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-I", "-m", "certify.checker", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd)


# ----------------------------------------------------------------------------------------------------------- the bytes


def spliced(old: str, new: str) -> Callable[[], bytes]:
    def build() -> bytes:
        text = dump(good()).decode()
        assert text.count(old) == 1
        return text.replace(old, new).encode("utf-8", "surrogatepass")

    return build


RAW: dict[str, Callable[[], bytes]] = {
    "empty": lambda: b"",
    "null": lambda: b"null",
    "a list": lambda: b"[]",
    "a number": lambda: b"7",
    "truncated": lambda: dump(good())[:-1],
    "truncated in the middle": lambda: dump(good())[: len(dump(good())) // 2],
    "two documents": lambda: dump(good()) * 2,
    "a byte behind": lambda: dump(good()) + b"\0",
    "byte order mark": lambda: b"\xef\xbb\xbf" + dump(good()),
    "UTF-16": lambda: dump(good()).decode().encode("utf-16"),
    "invalid UTF-8": lambda: dump(good()).replace(b"by hand", b"by\xff hand"),
    "overlong UTF-8": lambda: dump(good()).replace(b"by hand", b"by\xc0\xa0hand"),
    "encoded surrogate": spliced("by hand", "by \ud800 hand"),
    "control character": spliced("by hand", "by \n hand"),
    "single quotes": lambda: dump(good()).replace(b'"', b"'"),
    "comment": spliced('"provenance"', '/* */ "provenance"'),
    "trailing comma": spliced('"name": "plant",', '"name": "plant",,'),
    "duplicate key": spliced('"name": "plant"', '"name": "other", "name": "plant"'),
    "duplicate key, escaped": spliced('"name": "plant"', '"n\\u0061me": "other", "name": "plant"'),
    "duplicate key in provenance": spliced('"tool":', '"tool": "1", "tool":'),
    "duplicate section": spliced('"levels": {', '"levels": {"local": "0x0.0p+0", "roa": "0x0.0p+0"}, "levels": {'),
    "unknown key": spliced('"name": "plant"', '"name": "plant", "units": "m"'),
    "missing key": spliced('"name": "plant", ', ""),
    "decimal number in provenance": spliced('"written by hand"', "0.5"),
    "exponent in provenance": spliced('"written by hand"', "1e3"),
    "NaN": spliced('"written by hand"', "NaN"),
    "Infinity": spliced('"written by hand"', "Infinity"),
    "minus Infinity": spliced('"written by hand"', "-Infinity"),
    "long integer": spliced('"written by hand"', "1" * 11),
    "very long integer": spliced('"written by hand"', "1" * 100_000),
    "deep lists": spliced('"written by hand"', "[" * 100_000 + "]" * 100_000),
    "deep objects": spliced('"written by hand"', '{"a":' * 100_000 + "1" + "}" * 100_000),
    "unclosed lists": lambda: b"[" * 1_000_000,
}


@pytest.mark.parametrize("name", sorted(RAW))
def test_malformed_files_are_rejected(name: str, tmp_path: Path) -> None:
    raw = RAW[name]()
    assert raw != dump(good())
    assert outcome(raw, tmp_path) == "format"


def test_the_file_they_are_made_from_is_accepted(tmp_path: Path) -> None:
    assert outcome(dump(good()), tmp_path) == "ACCEPTED"


def test_a_file_beyond_the_limit_is_rejected(tmp_path: Path) -> None:
    path = write(b"", tmp_path)
    with path.open("r+b") as stream:
        stream.truncate(MAX_BYTES + 1)  # sparse
    with pytest.raises(Rejected, match="rule=format at=file: larger than") as no:
        document.read(str(path))
    assert no.value.rule == "format"


@pytest.mark.skipif(not os.path.exists("/dev/zero"), reason="needs an endless file")
def test_an_endless_file_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(strict, "MAX_BYTES", 2**16)
    with pytest.raises(Unreadable, match="not a regular file"):
        document.read("/dev/zero")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
@pytest.mark.parametrize(
    ("kind", "arguments"),
    [
        *(
            ("pipe", line.split())
            for line in ("check", "check --reference", "contains x=0", "report", "plot --out f.pdf")
        ),
        *((kind, ["check"]) for kind in ("link to a pipe", "socket", "folder", "device")),
    ],
)
def test_what_is_no_regular_file_is_refused_at_once(
    kind: str, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody writes into the pipe: whoever opened it as a file would wait for ever."""
    path = Path(os.devnull) if kind == "device" else tmp_path / "certificate.json"
    if kind == "folder":
        path.mkdir()
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as server:
            monkeypatch.chdir(tmp_path)  # a socket's name is short
            server.bind(path.name)
    elif kind != "device":
        os.mkfifo(tmp_path / "pipe")
        path.symlink_to(tmp_path / "pipe")
        path = path if kind == "link to a pipe" else tmp_path / "pipe"
    name, *rest = arguments
    line = [sys.executable, "-m", "certify", name, str(path), *rest]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=60, cwd=tmp_path)
    assert done.returncode == 2 and done.stdout == "" and "Traceback" not in done.stderr
    assert str(path) in done.stderr and ("regular file" in done.stderr or "cannot be read" in done.stderr)


# ---------------------------------------------------------------------------------------------------------- the values

NOT_A_RATIONAL = [
    None, True, 1, [], {}, "", " 1", "1 ", "1\n", "+1", "01", "1/0", "1/-2", "1/02", "0.5", "1e3", "1/2/3", "--1",
    "1_0", "0x1", "inf", "nan", "\u0661", "\uff11", "1" * 1202, "1/" + "1" * 1202, "-", "/", "1/", "x/2",
]  # fmt: skip
NOT_A_HEX_FLOAT = [
    None, True, 3, [], "", "1", "0x1p+0", "0x1.8p+1", "0x1.80000000000000p+1", "0x1.8000000000000p1", "inf", "nan",
    "-inf", "0X1.8000000000000p+1", "0x1.8000000000000P+1", "+0x1.8000000000000p+1", "0x2.8000000000000p+1",
    "0x1.8000000000000p+01", "0x1.8000000000000p+1024", "0x1.8000000000000p-1080", "0x1.8000000000000p+9999",
    "0x1.000000000000Ap+1", "0x0.0000000000000p+0", "0x1.8000000000000p+1 ", "0x0.8000000000000p+1",
    "0x1.8000000000000p-1030",
]  # fmt: skip
NOT_BASE64 = [
    None,
    1,
    [],
    "AAAA AAAA",
    "AAAA\nAAAA",
    "AAA",
    "AAAAA",
    "====",
    "AAAA====",
    "A===",
    "\u00e9",
    "-_-_",
    "=AAA",
    "AP9=",
]
PATHS_OF_RATIONALS = [
    "plant.u_eq.0",
    "plant.domain.0.0",
    "plant.domain.0.1",
    "plant.input_bounds.0.0",
    "plant.dynamics.0.2",
]
PATHS_OF_ARRAYS = [
    "policy.scale", "policy.offset", "policy.layers.0.weight", "policy.layers.0.bias", "lyapunov.P", "evidence.T",
    "evidence.root",
]  # fmt: skip


def assert_format(data: Document, folder: Path) -> None:
    assert outcome(json.dumps(data).encode(), folder) == "format"


@pytest.mark.parametrize("value", NOT_A_RATIONAL, ids=lambda v: repr(v)[:20])
def test_rationals_are_strict(value: Any, tmp_path: Path) -> None:
    for path in PATHS_OF_RATIONALS:
        assert_format(edited(good(), path, value), tmp_path)


@pytest.mark.parametrize("value", NOT_A_HEX_FLOAT, ids=lambda v: repr(v)[:30])
def test_hex_floats_are_strict(value: Any, tmp_path: Path) -> None:
    for path in ("levels.local", "levels.roa"):
        assert_format(edited(good(), path, value), tmp_path)


@given(st.floats(allow_nan=False, allow_infinity=False))
@example(5e-324)
@example(-0.0)
@example(float(np.finfo(float).max))
def test_hex_floats_are_read_exactly(value: float) -> None:
    read = Value(value.hex()).binary64()
    assert read == value and np.signbit(read) == np.signbit(value)


@pytest.mark.parametrize("value", [*NOT_BASE64, encode([1.0, 2.0]), encode([np.nan]), encode([-np.inf]), ""], ids=repr)
def test_arrays_are_strict(value: Any, tmp_path: Path) -> None:
    for path in PATHS_OF_ARRAYS:
        assert_format(edited(good(), path, value), tmp_path)


@pytest.mark.parametrize("value", NOT_BASE64, ids=repr)
def test_the_tree_is_strict(value: Any, tmp_path: Path) -> None:
    assert_format(edited(good(), "evidence.tree", value), tmp_path)


def test_arrays_are_little_endian_and_in_row_order() -> None:
    raw = bytes.fromhex("000000000000f03f0000000000000040000000000000084000000000000010c0")
    read = Value(base64.b64encode(raw).decode()).array(2, 2)
    assert read.tolist() == [[1.0, 2.0], [3.0, -4.0]]


def places(value: Any, path: str = "") -> list[str]:
    """Every path in a document, of sections as well as of values."""
    below = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [p for k, v in below for p in (f"{path}{k}", *places(v, f"{path}{k}."))]


TYPED = [p for p in places(good()) if p not in ("policy.sha256", "evidence.tree", "provenance.tool")]
EMPTY = ("plant.uncertain", "evidence.cells", "evidence.tube")  # lists of none in what is good
VALUES = [None, False, 0, 3, "", "a text", [], [[]], {}, {"a": []}, [1, 2, 3], "\ud800"]


@pytest.mark.parametrize("path", ["", *TYPED])
def test_a_value_of_another_type_is_rejected(path: str, tmp_path: Path) -> None:
    for value in VALUES:
        one = of_another_type(path, value)
        assert_format(edited(good(), path, one) if path else one, tmp_path)


def of_another_type(path: str, value: Any) -> Any:
    """The value, or one like it where it would do."""
    if path == "provenance" and isinstance(value, dict):
        value = list(value)  # any object would do there
    if path == "policy.clip" and value is None:
        value = "null"  # null says that there is none
    if path in ("claim.sample", "claim.outer", "evidence.contraction", "evidence.outer") and value is None:
        value = "null"
    if path in EMPTY and value == []:
        value = [None]
    return value


SHAPES = [
    [1],
    [1, 1, 1],
    [True, 1],
    [1, True],
    [1, 0],
    [0, 1],
    [-1, 1],
    [1, 2],
    [2**14 + 1, 1],
    ["1", 1],
    [1, None],
    "11",
]


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_shapes_are_strict(shape: Any, tmp_path: Path) -> None:
    assert_format(edited(good(), "policy.layers.0.shape", shape), tmp_path)


def test_layers_must_fit_each_other_and_the_plant(tmp_path: Path) -> None:
    layer = good()["policy"]["layers"][0]
    wide = {"shape": [2, 1], "weight": encode([1.0, 1.0]), "bias": encode([0.0, 0.0])}
    for layers in ([wide], [wide, layer], [layer] * 65, [layer, wide]):
        assert_format(edited(good(), "policy.layers", layers), tmp_path)
    narrow = {"shape": [1, 2], "weight": encode([0.5, 0.5]), "bias": encode([0.0])}
    deep = rehash(edited(good(), "policy.layers", [wide, narrow]))
    assert outcome(dump(deep), tmp_path) != "format"


# ------------------------------------------------------------------------------------------------------- the equations

NOT_IN_THE_GRAMMAR: dict[str, Any] = {
    "unknown operator": ["log", "x"],
    "operator of another type": [1, "x"],
    "list as an operator": [["+"], "x", "x"],
    "surrogate as an operator": ["\ud800", "x"],
    "no operands": ["+"],
    "nothing": [],
    "number": 1,
    "boolean": True,
    "null": None,
    "object": {"op": "+"},
    "unknown name": ["+", "x", "y"],
    "sine of two": ["sin", "x", "x"],
    "root of two": ["sqrt", "x", "x"],
    "exponential of nothing": ["exp"],
    "function in capitals": ["Exp", "x"],
    "inverse by its name": ["inv", "x"],
    "negation by its name": ["neg", "x"],
    "inverse by its sign": ["1/", "x"],
    "difference of three": ["-", "x", "x", "x"],
    "quotient of one": ["/", "x"],
    "quotient of three": ["/", "x", "1", "2"],
    "power of one": ["**", "x"],
    "power of three": ["**", "x", 2, 2],
    "power with exponent 0": ["**", "x", 0],
    "power with exponent -0": ["**", "x", -0],
    "power with exponent 65": ["**", "x", 65],
    "power with exponent -65": ["**", "x", -65],
    "power with a boolean": ["**", "x", True],
    "power with a text": ["**", "x", "2"],
    "power with an expression": ["**", "x", ["+", "1", "1"]],
    "power with null": ["**", "x", None],
    "power of nothing": ["**", [], 2],
}


@pytest.mark.parametrize("name", sorted(NOT_IN_THE_GRAMMAR))
def test_what_is_not_in_the_grammar_is_rejected(name: str, tmp_path: Path) -> None:
    assert_format(claim(["+", "u", NOT_IN_THE_GRAMMAR[name]]), tmp_path)


def nested(depth: int, leaf: Any = "x") -> Any:
    for _ in range(depth):
        leaf = ["-", leaf]
    return leaf


def test_depth_and_size_of_the_equations_are_limited(tmp_path: Path) -> None:
    linear = ["+", ["/", "x", "2"], "u"]
    assert outcome(dump(claim(nested(198, linear))), tmp_path) == "ACCEPTED"
    assert_format(claim(nested(201, linear)), tmp_path)
    assert_format(claim(nested(700, linear)), tmp_path)
    assert outcome(dump(claim(["+", *[linear] * 3000])), tmp_path) == "ACCEPTED"
    assert_format(claim(["+", *[linear] * 10_000]), tmp_path)


@pytest.mark.parametrize("exponent", [*range(1, 20), 31, 32, 33, 63, 64])
def test_powers_mean_what_they_say(exponent: int) -> None:

    tape = parse([["**", "x", exponent], ["**", "x", -exponent]], ["x"], "plant.dynamics")
    values = evaluate(tape, Exact, [Exact(Fraction(-3, 2))])
    assert [v.value for v in values] == [Fraction(-3, 2) ** k for k in (exponent, -exponent)]


def expressions() -> st.SearchStrategy[Any]:
    leaves = st.sampled_from(["x", "u", "0", "1", "-3/7", "5/2"])
    return st.recursive(
        leaves,
        lambda inner: st.one_of(
            st.tuples(st.sampled_from("+*"), inner, inner).map(list),
            st.tuples(st.sampled_from("+*"), inner, inner, inner).map(list),
            st.tuples(st.sampled_from("-/"), inner, inner).map(list),
            st.tuples(st.just("-"), inner).map(list),
            st.tuples(st.just("**"), inner, st.integers(1, 4)).map(list),
        ),
        max_leaves=12,
    )


@given(expressions())
@example(["**", ["**", "x", 2], 3])
@example(["**", ["-", "x"], 2])
@example(["-", ["**", "x", 2]])
@example(["/", "1", ["/", "x", "u"]])
@example(["-", "x", ["-", "x", "u"]])
@example(["**", "-3/7", 2])
@example(["/", "x", ["-", "1", "1"]])
@example(["+", ["/", "1", "3"], ["*", "0", ["/", "u", ["-", "2"]]]])
def test_the_printed_equations_are_the_parsed_ones(tree: Any) -> None:
    """The text, read as Python over the rationals, and the tape have the same values."""
    try:
        tape = parse([tree], ["x", "u"], "plant.dynamics")
    except Rejected as no:
        assert no.rule == "format" and no.detail == "a division by the number 0"
        with pytest.raises(Refused, match="a division by the number 0"):
            equations([tree], {"x", "u"}, "plant.dynamics")
        return
    exact_text = re.sub(r"(?<![\w*])\d+", lambda m: f"Fraction({m[0]})", words.expression(tape.trees[0]))
    x, u = Fraction(7, 5), Fraction(-2, 3)
    try:
        value = evaluate(tape, Exact, [Exact(x), Exact(u)])[0].value
    except Undecided:
        return
    assert eval(exact_text, {"Fraction": Fraction, "x": x, "u": u}) == value


# ---------------------------------------------------------------------------------------------------- the command line


def test_accepted_prints_the_claim(tmp_path: Path) -> None:
    done = run(write(good(), tmp_path), cwd=tmp_path)
    lines = done.stdout.splitlines()
    assert done.returncode == 0 and done.stderr == ""
    assert lines[0] == "plant plant: xdot = f(x, u), states (x), inputs (u)"
    assert lines[1:4] == ["  x' = ((x / 2) + u)", "  domain x in [-3, 3]", "  input u in [-1, 1], u_eq = 0"]
    assert "1-1 tanh" in lines[4] and good()["policy"]["sha256"] in lines[5] and "preactivation" in lines[5]
    assert lines[6].endswith("P = 1.0") and "V <= 3.5 " in lines[7]
    assert lines[-1].startswith("ACCEPTED c1=0.01 c2=3.5 sha256=") and len(lines) == 12


def test_accepted_as_json_is_one_strict_object(tmp_path: Path) -> None:
    def refuse(text: str) -> None:
        raise AssertionError(text)

    raw = dump(good())
    local_only = claim(["+", ["/", "x", "2"], "u"])
    for data, arguments in ((raw, ["--json"]), (dump(local_only), ["--json"])):
        path = write(data, tmp_path)
        done = run(*arguments, path, cwd=tmp_path)
        answer = json.loads(done.stdout, parse_constant=refuse)
        assert done.returncode == 0 and done.stderr == "" and answer["result"] == "ACCEPTED"
        assert answer["certificate_sha256"] == hashlib.sha256(data).hexdigest()
        assert answer["policy_sha256"] == json.loads(data)["policy"]["sha256"]
        assert answer["levels"]["roa"] == float.fromhex(json.loads(data)["levels"]["roa"])
        assert answer["rules"]["local"] == 1 and answer["rules"]["tree"] == answer["leaves"] >= 1
        assert answer["rules"]["ring"] == answer["ring_leaves"]
        assert 0 < answer["margins"]["local"] < 1 and set(answer["seconds"]) == {"start", "check"}
        assert done.stdout.count("\n") == 1


def test_rejected(tmp_path: Path) -> None:
    path = write(edited(good(), "levels.local", (4.0).hex()), tmp_path)
    done = run(path, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout == "REJECTED rule=levels at=levels: must satisfy 0 < local <= roa\n"
    done = run(path, "--json", cwd=tmp_path)
    assert done.returncode == 1 and json.loads(done.stdout) == {
        "result": "REJECTED", "rule": "levels", "at": "levels", "detail": "must satisfy 0 < local <= roa",
        "text": ["REJECTED rule=levels at=levels: must satisfy 0 < local <= roa"],
    }  # fmt: skip


def test_not_json_is_rejected_rule_format(tmp_path: Path) -> None:
    done = run(write(b"\xff\xfe{", tmp_path))
    assert done.returncode == 1 and done.stdout.startswith("REJECTED rule=format at=file: ")


@pytest.mark.parametrize(
    "arguments",
    [[], ["a", "b"], ["-x"], ["--json"], ["--JSON", "a"], ["--js", "a"], ["--arithmetic", "arb", "a"]],
)
def test_usage(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.startswith("usage: ")


@pytest.mark.parametrize("json_flag", [[], ["--json"]])
def test_a_file_that_cannot_be_read(json_flag: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in (tmp_path / "absent.json", tmp_path):
        assert main([str(path), *json_flag]) == 2
        printed = capsys.readouterr()
        if json_flag:
            assert "cannot be read" in json.loads(printed.out)["error"] and printed.err == ""
        else:
            assert "cannot be read" in printed.err and printed.out == ""
    with pytest.raises(Unreadable):
        document.read(str(tmp_path))


@pytest.mark.parametrize("json_flag", [[], ["--json"]])
def test_a_name_that_is_not_text(json_flag: list[str]) -> None:
    done = run(b"/nowhere/\xff".decode("utf-8", "surrogateescape"), *json_flag)
    assert done.returncode == 2 and "cannot be read" in done.stdout + done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize("json_flag", [[], ["--json"]])
def test_an_internal_error_accepts_nothing(
    json_flag: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> None:
        raise ArithmeticError("no such machine")

    monkeypatch.setattr(rules, "self_test", fail)
    assert main([str(write(good(), tmp_path)), *json_flag]) == 70
    printed = capsys.readouterr()
    assert "ACCEPTED" not in printed.out + printed.err and "no such machine" in printed.out + printed.err
    assert not json_flag or list(json.loads(printed.out)) == ["error", "text"]


def test_huge_rationals_in_a_claim_are_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    huge = "9" * 400 + "/7"
    data = claim(["+", ["/", "x", "2"], "u"], domain=[("-" + huge, huge)], input_bounds=[("-" + huge, huge)])
    assert main([str(write(data, tmp_path))]) == 0
    assert huge in capsys.readouterr().out


def test_the_checker_loads_nothing_of_the_project(tmp_path: Path) -> None:
    path = write(good(), tmp_path)
    code = (
        f"import sys; from certify.checker.__main__ import main; status = main([{str(path)!r}]);"
        "sys.stderr.write(' '.join(m for m in sys.modules if m.split('.')[0] in "
        "('certify', 'controllers', 'torch', 'sympy', 'scipy'))); sys.exit(status)"
    )
    done = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0
    assert all(m == "certify" or m.startswith("certify.checker") for m in done.stderr.split())


def test_a_file_whose_name_looks_like_an_option(tmp_path: Path) -> None:
    for name in ("--help", "--json", "-x"):
        (tmp_path / name).write_bytes(dump(good()))
        for path in (f"./{name}", name):
            done = run("--", path, cwd=tmp_path)
            assert done.returncode == 0 and "ACCEPTED" in done.stdout, done.stderr


def test_a_practical_claim_is_printed_for_what_it_is(tmp_path: Path) -> None:
    data = grow(make(
        [["+", ["/", "x", "2"], "u", "1/100"]], [([[1.0]], [0.25])], [[1.0]], (0.04, 3.0), claim="practical",
    ))  # fmt: skip
    path = write(data, tmp_path)
    lines = run(path).stdout.splitlines()
    said = next(line for line in lines if line.startswith("claim: "))
    assert said == (
        "claim: every trajectory of the closed loop that starts in V <= 3.0 stays there, enters V <= 0.04 in finite "
        "time and stays there from then on; nothing is claimed about what happens inside V <= 0.04, and the origin "
        "need not be an equilibrium; u stays in its bounds"
    )
    assert lines[-1].startswith("ACCEPTED c0=0.04 c1=0.04 c2=3.0 ") and not any("asymptotic" in line for line in lines)
    answer = json.loads(run("--json", path).stdout)
    assert answer["claim"] == "practical" and answer["levels"] == {"floor": 0.04, "local": 0.04, "roa": 3.0}
    assert answer["margins"]["local"] is None and answer["margins"]["ring"] > 0
    assert answer["rules"]["equilibrium"] == answer["rules"]["local"] == 0


def test_a_practical_claim_with_one_level_asks_the_leaves(tmp_path: Path) -> None:
    """c0 = c2: the ring is a surface, and leaves are not skipped."""
    stable = make([["-", "x"]], [([[1.0]], [0.0])], [[1.0]], (1.0, 1.0), claim="practical")
    assert outcome(dump(grow(stable)), tmp_path) == "ACCEPTED"
    for wrong in ("x", ["*", "-1", "x", ["/", "x", "x"]]):
        assert outcome(dump(grow(edited(stable, "plant.dynamics.0", wrong), max_leaves=50)), tmp_path) == "ring"
    assert outcome(dump(edited(stable, "evidence.tree", "AA==")), tmp_path) == "tree"


def test_the_format_s_own_example_is_accepted_with_its_margin(tmp_path: Path) -> None:
    """The format prints one certificate in full and works out its numbers."""
    text = (Path(document.__file__).parent / "format" / "example.md").read_text(encoding="utf-8")
    [example] = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    file = write(example.encode(), tmp_path)
    answer = run(file)
    assert "ACCEPTED c1=0.25 c2=2.0" in answer.stdout and "margins: local 62.9%" in answer.stdout
    [margin] = re.findall(r"a margin of ([0-9.]+) %", text)
    assert f"local {margin}%" in answer.stdout
    judge = [sys.executable, "-m", "certify.reference", str(file)]
    assert "ACCEPTED" in subprocess.run(judge, capture_output=True, text=True, check=False).stdout
    assert "REJECTED rule=domain" in run(write(example.replace("+1", "+2").encode(), tmp_path)).stdout
