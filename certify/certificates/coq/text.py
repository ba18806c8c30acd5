"""The files that Coq reads beside the theory: the claim, the evidence, the theorem, and its axioms.

Every character of code in them is part of a fixed word or of a number. Of people's names only plain words enter, and
only comments: a certificate can pass nothing but numbers to Coq.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.certificates.coq.data import Claimed
from certify.certificates.coq.evidence import Evidence, Leaf, Split
from certify.certificates.coq.expression import Expression
from certify.errors import InputError

Array = NDArray[np.float64]
_WIDTH = 120
_WORD = re.compile(r"[A-Za-z0-9_]{1,64}", re.ASCII)
_SHA256 = re.compile(r"[0-9a-f]{64}", re.ASCII)
_NUMBER = re.compile(r"(Dyadic|Ratio) \S+ \S+", re.ASCII)
_GLUE = "\0"  # a space at which no line ends
_SQUASH = {"tanh": "ByTanh", "identity": "ByIdentity"}
_CENTRE = {"output": "AtOutput", "preactivation": "AtPreactivation", "none": "NotCentred"}
_NODES = {
    "add": "Add", "neg": "Neg", "mul": "Mul", "inv": "Inv", "sin": "Sin", "cos": "Cos", "tanh": "Tanh", "exp": "Exp",
    "atan": "Atan", "sqrt": "Sqrt",
}  # fmt: skip


def claim_text(claimed: Claimed, rate: Fraction) -> str:
    """`Claim.v`: the certificate's numbers and the claimed rate.

    Parameters
    ----------
    rate : of V, `Vdot <= -rate V`.

    Raises
    ------
    InputError : the rate is not positive, or less than the certificate's, which is twice its lambda.
    """
    if not (rate > 0 and rate >= 2 * Fraction(claimed.rate)):
        raise InputError(
            f"the rate must be positive and at least {2 * claimed.rate:.6g}, twice the certificate's; found {rate}."
        )
    network = claimed.network
    hashes = {"certificate": claimed.sha256, "policy": network.sha256()}
    if any(_SHA256.fullmatch(h) is None for h in hashes.values()):
        raise InputError("hashes must be 64 digits; found others.")
    plant = f", of the plant {claimed.name}" if _WORD.fullmatch(claimed.name) else ""
    layers = [_layer(W, b) for W, b in zip(network.weights, network.biases, strict=True)]
    channels = [
        f"Channel ({dyadic(s)}) ({dyadic(o)}) ({ratio(u)}) ({ratio(lo)}) ({ratio(hi)})"
        for s, o, u, (lo, hi) in zip(network.scale, network.offset, claimed.u_eq, claimed.bounds, strict=True)
    ]
    parts = [
        f"(** What a certificate claims, as numbers{plant}.\n\n    sha256 of the certificate: {hashes['certificate']}\n"
        f"    sha256 of its policy:      {hashes['policy']}\n\n"
        "    Its meaning is in Spec.v; the numbers are exact, and those of the certificate. *)\n"
        "From Coq Require Import List ZArith.\nRequire Import Vectors Spec.\nImport ListNotations.\n",
        "(** xdot = f(x, u), an expression a state *)\n"
        + _definition("field", "list expr", _list(map(expression, claimed.field))),
        "(** Where the states may be *)\n"
        + _definition("domain", "list (rational * rational)", _list(map(_pair, claimed.domain))),
        "(** Of each input: scale, offset, value at rest, least, greatest *)\n"
        + _definition("channels", "list channel", _list(channels)),
        "(** The policy: of each neuron its weights and its bias *)\n"
        + "\n".join(_definition(f"layer_{k}", "layer", text) for k, text in enumerate(layers, 1)),
        "(** V = x'P x, and c2 *)\n"
        + _definition("P", "list (list dyadic)", _list(_row(row) for row in claimed.P))
        + _definition("level", "dyadic", dyadic(claimed.level)),
        _definition(
            "certificate",
            "certificate",
            "Certificate field domain channels "
            f"[{'; '.join(f'layer_{k}' for k in range(1, len(layers) + 1))}]\n  "
            f"{_SQUASH[network.squash]} {_CENTRE[network.centre]} P level",
        ),
        "(** How fast V decays: Vdot <= - rate V *)\n" + _definition("rate", "rational", ratio(rate)),
    ]
    return "\n".join(parts)


def evidence_text(evidence: Evidence) -> str:
    """`Evidence.v`: the result of the search."""
    lines: list[str] = []
    _tree(evidence.splits, 1, lines)
    parts = [
        "(** What leads the proof; nobody has to believe it (Data.v). *)\n"
        "From Coq Require Import List ZArith Floats.\nRequire Import Vectors Spec Data.\nImport ListNotations.\n",
        _definition("coordinates", "list (list rational)", _list(_list(map(ratio, row), 0) for row in evidence.T)),
        _definition("inverse", "list (list rational)", _list(_list(map(ratio, row), 0) for row in evidence.W)),
        _definition("half_widths", "list float", _list(map(number, evidence.root))),
        _definition("core_widths", "list float", _list(map(number, evidence.core))),
        _definition("partition", "tree", "\n".join(lines).lstrip()),
        _definition("evidence", "evidence", "Evidence coordinates inverse half_widths core_widths partition"),
    ]
    return "\n".join(parts)


PROOF = """(** The proof: the check says true, and what it says true of is so. *)
Require Spec Soundness Claim Evidence.

Theorem proved : Spec.claim Claim.certificate (Spec.ratio Claim.rate).
Proof.
  refine (Soundness.sound _ _ Evidence.evidence _).
  vm_cast_no_check (eq_refl true).
Qed.
"""
ASSUMPTIONS = """(** The axioms that the proof rests on. Nothing is imported here: each is printed with its module. *)
Require Proof.
Print Assumptions Proof.proved.
"""


def number(value: float) -> str:
    """A binary64 number as Coq's primitive float, exactly."""
    value = float(value)
    if not np.isfinite(value):
        raise InputError(f"numbers of a proof must be finite; found {value}.")
    mantissa, _, exponent = abs(value).hex().partition("p")
    text = f"{mantissa.rstrip('0').rstrip('.') if '.' in mantissa else mantissa}p{exponent}"
    return f"(-{text})%float" if value < 0 else f"{text}%float"


def dyadic(value: float) -> str:
    """A binary64 number as an integer times a power of two, exactly; the integer is odd, or 0."""
    numerator, denominator = float(value).as_integer_ratio()
    exponent = 1 - denominator.bit_length()
    while numerator and numerator % 2 == 0:
        numerator, exponent = numerator // 2, exponent + 1
    return f"Dyadic {_integer(numerator)} {_integer(exponent)}"


def ratio(value: Fraction) -> str:
    """A rational in lowest terms."""
    return f"Ratio {_integer(value.numerator)} {value.denominator}"


def expression(e: Expression) -> str:
    """An expression of the plant."""
    if e.kind == "state":
        return f"State {e.index}"
    if e.kind == "input":
        return f"Input {e.index}"
    if e.kind == "const":
        return f"Const ({ratio(e.number)})"
    operands = " ".join(f"({expression(operand)})" for operand in e.operands)
    return f"Pow {operands} {e.index}" if e.kind == "pow" else f"{_NODES[e.kind]} {operands}"


def _integer(value: int) -> str:
    return f"({value})" if value < 0 else str(value)


def _pair(pair: tuple[Fraction, Fraction]) -> str:
    return f"({ratio(pair[0])}, {ratio(pair[1])})"


def _row(row: Iterable[float]) -> str:
    return _list(map(dyadic, row), 0)


def _layer(weight: Array, bias: Array) -> str:
    return _list(f"({_row(row)}, {dyadic(b)})" for row, b in zip(weight, bias, strict=True))


def _list(items: Iterable[str], indent: int = 2) -> str:
    """Items in Coq's brackets, one per line if there is an indent."""
    if indent:
        return "[\n" + ";\n".join(f"{' ' * indent}{item}" for item in items) + "]"
    return f"[{'; '.join(items)}]"


def _definition(name: str, kind: str, body: str) -> str:
    head = f"Definition {name} : {kind} :="
    if "\n" not in body and len(head) + len(body) + 2 <= _WIDTH:
        return f"{head} {body}.\n"
    lines = [wrapped for line in body.split("\n") for wrapped in _wrap(line)]
    return f"{head}{' ' if body.startswith('[') else chr(10) + '  '}{chr(10).join(lines)}.\n"


def _wrap(line: str) -> list[str]:
    """A line cut where it is too long, but not within a number."""
    if len(line) <= _WIDTH:
        return [line]
    whole = _NUMBER.sub(lambda number: number.group().replace(" ", _GLUE), line)
    indent = " " * (len(line) - len(line.lstrip()) + 2)
    cut = textwrap.wrap(whole, _WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return [piece.replace(_GLUE, " ") for piece in cut]


def _tree(node: Leaf | Split, depth: int, lines: list[str]) -> None:
    """One node per line, indented by its depth."""
    space = " " * (2 * depth)
    if isinstance(node, Leaf):
        lines.append(f"{space}(Leaf {number(node.k)})")
        return
    lines.append(f"{space}(Split {node.axis} {number(node.at)}")
    _tree(node.below, depth + 1, lines)
    _tree(node.above, depth + 1, lines)
    lines[-1] += ")"
