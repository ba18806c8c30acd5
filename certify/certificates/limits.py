"""The limits of the certificate format; a plant or policy beyond them is rejected before any work is done.

The checkers have the same limits of sizes; a test compares the numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction

import numpy as np

from certify.certificates.claims import MOST_KEPT
from certify.errors import InputError
from certify.loop.expressions import Expression, Operation, Tree, constant_of, gathered, nodes, to_tree
from certify.loop.networks import Observe
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork

MOST_STATES, MOST_STEPS, MOST_ROWS = 64, 256, 2**14
MOST_NODES, MOST_DEPTH, MOST_EXPONENT, MOST_DIGITS = 20_000, 200, 64, 1201
MOST_NUMBERS = 2**26  # operations times the numbers of a jet, under the rule `local`
_LARGEST = Fraction(2) ** 1000
MOST_MATRIX_BITS = 2**16  # of the longest number of P, times n


def require_within_limits(system: System, network: PolicyNetwork) -> None:
    """Reject a closed loop that no certificate can hold.

    Raises
    ------
    InputError : a limit of the format is exceeded; the message names it.
    """
    observations = [e for step in network.network.steps if isinstance(step, Observe) for e in step.expressions]
    dynamics = (*system.uncertain_dynamics(), *observations, *system.uncertain_constraints().values())
    deepest = max(e.depth for e in dynamics)
    if deepest > MOST_DEPTH:
        raise InputError(_too_large(system, "levels of nesting in an equation", deepest, MOST_DEPTH))
    trees = [to_tree(e) for e in dynamics]
    listed = [node for tree in trees for node in _nodes(tree, 0)]
    numbers = [q for pair in (*system.domain, *system.input_bounds) for q in pair] + list(system.exact_u_eq())
    digits = [len(part) for q in (*numbers, *(Fraction(n) for n, _ in listed if _is_number(n))) for part in _parts(q)]
    parts = (*nodes(*dynamics), *nodes(*map(gathered, dynamics)))
    made = [q for q in map(constant_of, parts) if q is not None]
    for q in (*numbers, *made):
        if not abs(q) < _LARGEST:
            raise InputError(
                f"numbers of {system.name} must lie within the range of binary64; one is about 10^{_magnitude(q)}."
            )
    exponents = [abs(p.exponent) for p in nodes(*dynamics) if isinstance(p, Operation) and p.operator == "**"]
    for what, found, most in (
        ("states", system.n, MOST_STATES),
        ("inputs", system.m, MOST_STATES),
        ("constraints", len(system.constraints), MOST_KEPT),
        ("steps of the policy", len(network.network.steps), MOST_STEPS),
        ("units in a layer", max(network.network.sizes), MOST_ROWS),
        ("nodes in the equations", len(listed), MOST_NODES),
        ("as the largest exponent in an equation", max(exponents, default=1), MOST_EXPONENT),
        ("digits in the parts of a rational", max(digits), MOST_DIGITS),
        ("operations in the equations, times the numbers of a model of each,", _size(system, dynamics), MOST_NUMBERS),
    ):
        if found > most:
            raise InputError(_too_large(system, what, found, most))


def _too_large(system: System, what: str, found: int, most: int) -> str:
    return f"{system.name} with this policy is too large for a certificate: at most {most} {what}; found {found}."


def _magnitude(q: Fraction) -> int:
    """The decimal exponent of a number that may be too long to be written."""
    return round((q.numerator.bit_length() - q.denominator.bit_length()) * math.log10(2))


def require_short(P: np.ndarray) -> None:
    """Reject a P whose exact inverse takes too long.

    Raises
    ------
    InputError : n times the bits of its longest number exceed the format's limit.
    """
    parts = [Fraction(float(v)).as_integer_ratio() for v in P.ravel()]
    common = max(below for _, below in parts)  # powers of 2
    bits = len(P) * max((2 * abs(above) * (common // below)).bit_length() for above, below in parts)
    if bits > MOST_MATRIX_BITS:
        raise InputError(
            f"`P` has entries of too different magnitude for an exact inverse: at most {MOST_MATRIX_BITS} bits times "
            f"states; found {bits}. Scale the states, or try another candidate."
        )


def numbers_of_a_jet(k: int) -> int:
    """About how many numbers a third-order model in k variables holds."""
    return k**2 + k * (k + 1) * (k + 2) // 6


def _size(system: System, expressions: Sequence[Expression]) -> int:
    """Operations, each counted once however often it stands in the equations, times their numbers; an upper bound."""
    return sum(_operations(node) for node in nodes(*expressions)) * numbers_of_a_jet(system.n)


def _operations(node: Expression) -> int:
    if not isinstance(node, Operation):
        return 1
    if node.operator in ("+", "*"):
        return len(node.operands) - 1
    if node.operator == "**":
        return 2 * abs(node.exponent).bit_length()
    if node.operator in ("min", "max"):
        return 7 * (len(node.operands) - 1)
    return {"/": 2, "tan": 4, "clip": 13}.get(node.operator, 1)


def _nodes(tree: Tree, depth: int) -> Iterator[tuple[Tree, int]]:
    """Every node of a tree with its depth, without recursion."""
    waiting = [(tree, depth)]
    while waiting:
        node, depth = waiting.pop()
        yield (node if isinstance(node, str) else node[0]), depth
        if not isinstance(node, str):
            operands = node[1:2] if node[0] == "**" else node[1:]
            waiting += [(operand, depth + 1) for operand in operands]


def _is_number(text: str) -> bool:
    return text[0].isdigit() or (text[0] == "-" and len(text) > 1)


def _parts(q: Fraction) -> tuple[str, str]:
    return str(abs(q.numerator)), str(q.denominator)
