"""What Coq is told is what the certificate says: every number is read back from the text and from the file apart."""

from __future__ import annotations

import base64
import hashlib
import math
import re
import struct
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from certify.certificates.coq.data import read_claim
from certify.certificates.coq.text import claim_text, dyadic, number
from certify.errors import CertifyError, InputError
from tests.certificates.coq_cases import Document, everything, pendulum, raw, scalar
from tests.support.certificates import edited, encode, policy_hash, rehash
from tests.support.earlier import earlier

# Reading Coq's text: numbers, names, applications, lists and pairs.

_TOKEN = re.compile(r"\s*(-?[0-9]+|[A-Za-z_][A-Za-z0-9_]*|[\[\]();,])")
CONSTRUCTORS = {
    "Dyadic": lambda m, e: Fraction(m) * Fraction(2) ** e,
    "Ratio": Fraction,
}


def definitions(text: str) -> dict[str, tuple[str, Any]]:
    """Name to type and body of every definition."""
    code = re.sub(r"\(\*.*?\*\)", "", text, flags=re.S)
    found = {}
    for name, kind, body in re.findall(r"^Definition (\w+) : ([^:]*?) :=\s(.*?)\.$", code, re.M | re.S):
        assert name not in found
        found[name] = (kind, read(body))
    return found


def read(body: str) -> Any:
    tokens, at = [], 0
    while body[at:].strip():
        match = _TOKEN.match(body, at)
        assert match is not None, body[at : at + 40]
        tokens.append(match[1])
        at = match.end()
    value, rest = application(tokens)
    assert not rest
    return value


def application(tokens: list[str]) -> tuple[Any, list[str]]:
    parts = []
    while tokens and tokens[0] not in (")", "]", ";", ","):
        token, tokens = tokens[0], tokens[1:]
        if token == "(":
            inner, tokens = application(tokens)
            if tokens[0] == ",":
                other, tokens = application(tokens[1:])
                inner = ("pair", inner, other)
            assert tokens[0] == ")"
            tokens = tokens[1:]
        elif token == "[":
            items = []
            while tokens[0] != "]":
                item, tokens = application(tokens)
                items.append(item)
                assert tokens[0] in (";", "]")
                tokens = tokens[1:] if tokens[0] == ";" else tokens
            inner, tokens = items, tokens[1:]
        else:
            inner = int(token) if re.fullmatch(r"-?[0-9]+", token) else token
        parts.append(inner)
    if isinstance(parts[0], str) and parts[0] in CONSTRUCTORS:
        return CONSTRUCTORS[parts[0]](*parts[1:]), tokens
    return (parts[0] if len(parts) == 1 else tuple(parts)), tokens


def numbers(text: str) -> list[Fraction]:
    raw_ = base64.b64decode(text)
    return [Fraction(v) for v in struct.unpack(f"<{len(raw_) // 8}d", raw_)]


def rows(text: str, width: int) -> list[list[Fraction]]:
    flat = numbers(text)
    return [flat[i : i + width] for i in range(0, len(flat), width)]


def in_coq(e: Any, x: list[float], u: list[float]) -> float:
    """The value of Coq's expression, as Spec.v has it."""
    head, *args = e
    if head in ("State", "Input"):
        return (x if head == "State" else u)[args[0]]
    if head == "Const":
        return float(args[0])
    if head == "Pow":
        return in_coq(args[0], x, u) ** args[1]
    values = [in_coq(a, x, u) for a in args]
    return {
        "Add": lambda a, b: a + b, "Mul": lambda a, b: a * b, "Neg": lambda a: -a, "Inv": lambda a: 1 / a,
        "Sin": math.sin, "Cos": math.cos, "Tanh": math.tanh, "Exp": math.exp, "Atan": math.atan, "Sqrt": math.sqrt,
    }[head](*values)  # fmt: skip


def in_file(tree: Any, values: dict[str, float]) -> float:
    """The value of the file's tree, as FORMAT.md has it."""
    if isinstance(tree, str):
        return values[tree] if tree in values else float(Fraction(tree))
    if tree[0] == "**":
        return in_file(tree[1], values) ** tree[2]
    a = [in_file(t, values) for t in tree[1:]]
    return {
        "+": lambda *a: sum(a), "*": lambda *a: math.prod(a), "-": lambda *a: -a[0] if len(a) == 1 else a[0] - a[1],
        "/": lambda a, b: a / b, "sin": math.sin, "cos": math.cos, "tan": math.tan, "tanh": math.tanh,
        "exp": math.exp, "atan": math.atan, "sqrt": math.sqrt,
    }[tree[0]](*a)  # fmt: skip


def constants(e: Any) -> set[Fraction]:
    if not isinstance(e, tuple):
        return set()
    return {e[1]} if e[0] == "Const" else {c for a in e[1:] for c in constants(a)}


def written(tree: Any) -> set[Fraction]:
    if isinstance(tree, str):
        return {Fraction(tree)} if re.fullmatch(r"-?[0-9/]+", tree) else set()
    return {c for a in tree[1:] if not isinstance(a, int) for c in written(a)}


@pytest.mark.parametrize("data", [pendulum(), scalar(), everything()], ids=["pendulum", "scalar", "everything"])
def test_every_number_of_the_certificate_is_in_coqs_text(data: Document) -> None:
    found = definitions(claim_text(read_claim(raw(data)), Fraction(3, 64)))
    plant, policy = data["plant"], data["policy"]
    n = len(plant["states"])
    assert found["P"] == ("list (list dyadic)", rows(data["lyapunov"]["P"], n))
    assert found["level"] == ("dyadic", Fraction(float.fromhex(data["levels"]["roa"])))
    assert found["rate"] == ("rational", Fraction(3, 64))
    assert found["domain"][1] == [("pair", Fraction(lo), Fraction(hi)) for lo, hi in plant["domain"]]
    assert found["channels"][1] == [
        ("Channel", scale, offset, Fraction(rest), Fraction(least), Fraction(greatest))
        for scale, offset, rest, (least, greatest) in zip(
            numbers(policy["scale"]), numbers(policy["offset"]), plant["u_eq"], plant["input_bounds"], strict=True
        )
    ]
    (network,) = data["networks"]
    affine = [step for step in network["steps"] if step["kind"] == "affine"]
    assert network["name"] == policy["network"] and len(network["steps"]) == 2 * len(affine) - 1
    for k, layer in enumerate(affine, 1):
        weights = rows(layer["weight"], layer["shape"][1])
        assert found[f"layer_{k}"][0] == "layer"
        assert found[f"layer_{k}"][1] == [
            ("pair", row, bias) for row, bias in zip(weights, numbers(layer["bias"]), strict=True)
        ]
    squash = {"tanh": "ByTanh", "identity": "ByIdentity"}[policy["squash"]]
    centre = {"output": "AtOutput", "preactivation": "AtPreactivation", "none": "NotCentred"}[policy["centre"]]
    layers = [f"layer_{k}" for k in range(1, len(affine) + 1)]
    assert found["certificate"] == (
        "certificate",
        ("Certificate", "field", "domain", "channels", layers, squash, centre, "P", "level"),
    )
    assert list(found) == ["field", "domain", "channels", *layers, "P", "level", "certificate", "rate"]


@pytest.mark.parametrize("data", [pendulum(), scalar(), everything()], ids=["pendulum", "scalar", "everything"])
def test_the_equations_have_the_same_values(data: Document) -> None:
    field = definitions(claim_text(read_claim(raw(data)), Fraction(1)))["field"][1]
    plant = data["plant"]
    rng = np.random.default_rng(0)
    assert len(field) == len(plant["dynamics"])
    for coq, tree in zip(field, plant["dynamics"], strict=True):
        assert constants(coq) == written(tree)
        for _ in range(5):
            x, u = rng.uniform(-1, 1, len(plant["states"])).tolist(), rng.uniform(-1, 1, len(plant["inputs"])).tolist()
            values = dict(zip(plant["states"], x, strict=True)) | dict(zip(plant["inputs"], u, strict=True))
            assert in_coq(coq, x, u) == pytest.approx(in_file(tree, values), rel=1e-12)


def test_the_hashes_are_those_of_the_bytes() -> None:
    given = raw(everything())
    text = claim_text(read_claim(given), Fraction(1))
    assert f"sha256 of the certificate: {hashlib.sha256(given).hexdigest()}\n" in text
    assert f"sha256 of its policy:      {policy_hash(earlier(everything())['policy'])}\n" in text
    assert hashlib.sha256(given + b" ").hexdigest() in claim_text(read_claim(given + b" "), Fraction(1))


@pytest.mark.parametrize("value", [0.0, -0.0, 1.0, -0.75, -3.5, 0.1, 5e-324, -1.7976931348623157e308, 2.0**-1074 * 3])
def test_numbers_are_exact(value: float) -> None:
    head, mantissa, exponent = dyadic(value).replace("(", "").replace(")", "").split()
    assert head == "Dyadic" and Fraction(int(mantissa)) * Fraction(2) ** int(exponent) == Fraction(value)
    assert int(mantissa) % 2 or value == 0
    sign, text = re.fullmatch(r"(\(-)?(0x[^)%]*)\)?%float", number(value)).groups()  # type: ignore[union-attr]
    assert (-float.fromhex(text) if sign else float.fromhex(text)) == value
    assert (sign is not None) == (value < 0)


def test_an_infinite_number_is_not_written() -> None:
    with pytest.raises(InputError, match="must be finite"):
        number(math.inf)


def test_names_say_nothing_to_coq() -> None:
    """States named as Coq's words change nothing, and the plant's name the comment alone."""
    plain = everything()
    odd = rehash(everything())
    odd["plant"] |= {"name": "Admitted", "states": ["Axiom", "Qed"], "inputs": ["Load", "fun"]}
    new = dict(zip(("x", "y", "u", "w"), ("Axiom", "Qed", "Load", "fun"), strict=True))

    def renamed(tree: Any) -> Any:
        return (
            new.get(tree, tree)
            if isinstance(tree, str)
            else [tree[0], *(t if isinstance(t, int) else renamed(t) for t in tree[1:])]
        )

    odd["plant"]["dynamics"] = [renamed(tree) for tree in odd["plant"]["dynamics"]]
    texts = [claim_text(read_claim(raw(data)), Fraction(1)) for data in (plain, odd)]
    bodies = [text.split("*)", 1)[1] for text in texts]
    assert bodies[0] == bodies[1]
    assert texts[1].startswith("(** What a certificate claims, as numbers, of the plant Admitted.\n")
    assert "Axiom" not in texts[1]
    assert texts[0].startswith("(** What a certificate claims, as numbers, of the plant plant.\n")


UNSUPPORTED = {
    "claims of kind practical": ("claim.kind", "practical"),
    "an outer set": ("claim.outer", {"expression": "x", "level": (1.0).hex()}),
    "boxes with ranks": ("claim.ranks", {"angles": [], "steps": 1}),
    "constraints": ("claim.keep", ["x"]),
    "ranges that measurements bound": ("claim.data", {}),
    "an input that is held": ("claim.sample", ["0", "1/10"]),
    "plants in discrete time": ("plant.time", "discrete"),
    "uncertain quantities": ("plant.uncertain", [{"name": "q", "range": ["0", "1"]}]),
    "a clip": ("policy.clip", [encode([-1.0]), encode([1.0])]),
    "more than one network": ("networks", lambda networks: [*networks, networks[0] | {"name": "N"}]),
    "functions V of kind network": ("lyapunov.kind", "network"),
}


@pytest.mark.parametrize("found", UNSUPPORTED)
def test_what_coqs_statement_cannot_say_is_refused(found: str) -> None:
    with pytest.raises(InputError, match=rf"found {found}.*a proof in Coq is there for"):
        read_claim(raw(rehash(edited(scalar(), *UNSUPPORTED[found]))))


@pytest.mark.parametrize(
    ("kind", "entries"),
    [
        ("reaches", ("kind", "sample", "target", "ranks")),
        ("remains", ("kind", "sample", "ranks")),
        ("invariant", ("kind", "outer")),
        ("practical", ("kind", "rate", "sample", "outer")),
    ],
)
def test_claims_that_it_does_not_know_are_named(kind: str, entries: tuple[str, ...]) -> None:
    """They have other entries, and two of them no V; a second certificate may take over from a practical one."""
    data = edited(scalar(), "claim", dict.fromkeys(entries) | {"kind": kind})
    other = data | {"lyapunov": None, "levels": {}} if kind != "practical" else data | {"then": data}
    with pytest.raises(InputError, match=rf"found claims of kind {kind}\. a proof in Coq is there for"):
        read_claim(raw(other))


TANH: Document = {"kind": "map", "of": [1], "function": "tanh"}
OTHER_STEPS = "affine steps with tanh between them"


def then(step: Document) -> Callable[[list[Document]], list[Document]]:
    """A network of one layer goes on with a step, and the layer again."""
    return lambda steps: [*steps, step, steps[0] | {"of": [2]}]


def deep(layers: int) -> Callable[[list[Document]], list[Document]]:
    """A network of one layer has it so many times."""
    return lambda steps: [(TANH if k % 2 else steps[0]) | {"of": [k]} for k in range(2 * layers - 1)]


def without(key: str) -> Callable[[Document], Document]:
    return lambda section: {k: v for k, v in section.items() if k != key}


MALFORMED = {
    "another schema": ("schema", "certify-certificate/6", "must have the schema"),
    "an unknown key": ("plant", lambda p: p | {"delay": "1"}, "`plant` must have exactly the keys"),
    "a key less": ("levels", lambda _: {"roa": (1.0).hex()}, "`levels` must have exactly the keys"),
    "a plant's name that ends a comment": ("plant.name", "p *) Axiom no : False. (*", "name must be an identifier"),
    "a plant's name that is a line of its own": ("plant.name", "x\nPROVED IN COQ  x", "name must be an identifier"),
    "a plant's name that is a list": ("plant.name", ["x"], "name must be an identifier"),
    "an inner level that is no number": ("levels.local", "low", "must be a hex float"),
    "a provenance that is a list": ("provenance", [], "provenance must be an object"),
    "an integer of eleven digits": ("provenance", {"seed": 10**10}, "integers must have at most 10 characters"),
    "a layer of 16,385 rows": (
        "networks.0.steps",
        [{"kind": "affine", "of": [0], "shape": [16385, 1], "weight": "", "bias": ""}],
        "at most 16384 rows",
    ),
    "another policy": ("policy.scale", encode([-2.0]), "sha256 must be"),
    "a decimal level": ("levels.roa", 1, "must be a hex float"),
    "a level not canonical": ("levels.roa", "0x1p0", "canonical form"),
    "a level of zero": ("levels.roa", (0.0).hex(), "level must be positive"),
    "an infinite level": ("levels.roa", "inf", "must be a finite hex float"),
    "a negative rate": ("claim.rate", (-1.0).hex(), "rate at least 0"),
    "base64 not canonical": ("lyapunov.P", lambda t: t[:-2] + "9=", "canonical base64"),
    "P of another shape": ("lyapunov.P", encode([1.0, 1.0]), "canonical base64 of"),
    "P not finite": ("lyapunov.P", encode([math.nan]), "P must be finite"),
    "an empty domain": ("plant.domain.0", ["1", "1"], "pairs lo < hi"),
    "a rational with a leading zero": ("plant.u_eq.0", "01", "must be a rational"),
    "a rational over zero": ("plant.u_eq.0", "1/0", "must be a rational"),
    "a decimal rational": ("plant.u_eq.0", "0.5", "must be a rational"),
    "a state twice": ("plant.states", ["x", "x"], "different names"),
    "an input named as a state": ("plant.inputs", ["x"], "found x twice"),
    "a name with a space": ("plant.states", ["x y"], "must be an identifier"),
    "a name with a line's end": ("plant.states", ["x\n"], "must be an identifier"),
    "an unknown name in an equation": ("plant.dynamics.0", "v", "must be a rational"),
    "an absolute value": ("plant.dynamics.0", ["abs", "x"], "smooth equations; found abs"),
    "an unknown operator": ("plant.dynamics.0", ["sgn", "x"], "operators must be those"),
    "an operator with too many operands": ("plant.dynamics.0", ["/", "x", "x", "x"], "operators must be those"),
    "an operator with none": ("plant.dynamics.0", ["+"], "must be a tree"),
    "a power of 65": ("plant.dynamics.0", ["**", "x", 65], "integer exponent"),
    "a power of 0": ("plant.dynamics.0", ["**", "x", 0], "integer exponent"),
    "a power of True": ("plant.dynamics.0", ["**", "x", True], "integer exponent"),
    "equations less": ("plant.dynamics", [], "`dynamics` must be a list of 1"),
    "a call in an equation": ("plant.dynamics.0", ["network", "policy", 0, "x"], "found 'policy'"),
    "a clip in an equation": ("plant.dynamics.0", ["clip", "x", "-1", "1"], "smooth equations; found clip"),
    "a least in an equation": ("plant.dynamics.0", ["min", "x", "u"], "smooth equations; found min"),
    "layers that do not chain": ("networks.0.steps.0.shape", [1, 2], "layers must lead from"),
    "a layer of another shape": ("networks.0.steps.0.shape", [True, 1], r"must have a shape \[out, in\]"),
    "a layer with an unknown key": ("networks.0.steps.0", lambda step: step | {"gain": "2"}, "found the keys .*gain"),
    "a layer less a key": ("networks.0.steps.0", without("bias"), "a step must have"),
    "a layer of another vector": ("networks.0.steps.0.of", [1], OTHER_STEPS),
    "a layer of False": ("networks.0.steps.0.of", [False], "a step must have"),
    "a layer more": ("networks.0.steps", then(TANH), "sha256 must be"),
    "a tanh with an unknown key": ("networks.0.steps", then(TANH | {"gain": "2"}), "found the keys .*gain"),
    "a tanh that is not named": ("networks.0.steps", then({"kind": "map", "of": [1]}), OTHER_STEPS),
    "another function": ("networks.0.steps", then(TANH | {"function": "sin"}), OTHER_STEPS),
    "a tanh of the argument": ("networks.0.steps", then(TANH | {"of": [0]}), OTHER_STEPS),
    "a tanh of True": ("networks.0.steps", then(TANH | {"of": [True]}), "a step must have"),
    "a tanh at the end": ("networks.0.steps", lambda steps: [*steps, TANH], OTHER_STEPS),
    "a sum": ("networks.0.steps", then({"kind": "sum", "of": [0, 1]}), OTHER_STEPS),
    "no steps": ("networks.0.steps", [], OTHER_STEPS),
    "257 steps": ("networks.0.steps", deep(129), "at most 256 steps"),
    "a network of a name that is none": ("networks.0.name", "a policy", "must have one named 'policy'"),
    "a network with an unknown key": ("networks.0", lambda network: network | {"gives": 1}, "exactly the keys"),
    "a network that reads two numbers": ("networks.0.reads", 2, "must read 1 states; found 2"),
    "a network that reads True": ("networks.0.reads", True, "must read 1 states; found True"),
    "a network twice": ("networks", lambda networks: 2 * networks, "found more than one network"),
    "no network": ("networks", [], "must have one named 'policy'; found none"),
    "a policy of another network": ("policy.network", "N", "must have one named 'N'"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_what_is_no_certificate_is_refused(name: str) -> None:
    path, value, message = MALFORMED[name]
    with pytest.raises(CertifyError, match=message):
        read_claim(raw(edited(scalar(), path, value)))


def test_a_network_has_a_name() -> None:
    data = edited(edited(scalar(), "policy.network", "a policy"), "networks.0.name", "a policy")
    with pytest.raises(CertifyError, match="a network's name must be an identifier"):
        read_claim(raw(data))


def test_networks_of_the_most_steps_are_read() -> None:
    data = edited(scalar(), "networks.0.steps", deep(128))
    assert len(data["networks"][0]["steps"]) == 255 and len(read_claim(raw(rehash(data))).network.weights) == 128


def test_a_matrix_that_is_not_symmetric_is_refused() -> None:
    data = edited(everything(), "lyapunov.P", encode([[1.0, 0.1], [0.2, 1.0]]))
    with pytest.raises(InputError, match="`P` must be symmetric"):
        read_claim(raw(data))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (b"\xff", "must be JSON"),
        (b"[" * 100_000, "must be JSON|must be as FORMAT.md"),
        (b"[]", "schema"),
        (b'{"schema": 1, "schema": 2}', "each key once"),
        (b'{"schema": 1.5}', "must not be decimal"),
        (b'{"schema": NaN}', "must not be decimal"),
        (b'{"schema": "certify-certificate/8"}', "must have the schema.*An earlier release"),
        (b'{"schema": "certify-certificate/9"}', "must be as FORMAT.md has it"),
    ],
)
def test_bytes_that_are_no_certificate_are_refused(given: bytes, message: str) -> None:
    with pytest.raises(CertifyError, match=message):
        read_claim(given)


def test_equations_have_a_limit() -> None:
    deep: Any = "x"
    for _ in range(201):
        deep = ["sin", deep]
    with pytest.raises(CertifyError, match="at most 200 deep"):
        read_claim(raw(edited(scalar(), "plant.dynamics.0", deep)))
    for tall in (["+", *["x"] * 600], _subtracted(150)):
        with pytest.raises(CertifyError, match="at most 200 deep once"):
            read_claim(raw(edited(scalar(), "plant.dynamics.0", tall)))
    for low in (["+", *["x"] * 199], _subtracted(99)):
        claim_text(read_claim(raw(edited(scalar(), "plant.dynamics.0", low))), Fraction(1))
    doubling: Any = "x"
    for _ in range(20):
        doubling = ["tan", doubling]  # its operand stands twice
    with pytest.raises(CertifyError, match="20,000 nodes"):
        read_claim(raw(edited(scalar(), "plant.dynamics.0", doubling)))


def _subtracted(times: int) -> Any:
    tree: Any = "x"
    for _ in range(times):
        tree = ["-", "0", tree]
    return tree


def test_the_rate_is_at_least_the_certificates() -> None:
    """Twice lambda, for V decays twice as fast as its root."""
    claimed = read_claim(raw(edited(scalar(), "claim.rate", (0.25).hex())))
    claim_text(claimed, Fraction(1, 2))
    for rate in (Fraction(499, 1000), Fraction(0), Fraction(-1)):
        with pytest.raises(InputError, match=r"at least 0\.5"):
            claim_text(claimed, rate)
    with pytest.raises(InputError, match="must be positive"):
        claim_text(read_claim(raw(scalar())), Fraction(0))
