"""Conditions for solvers of formulas: the negation of each, so that a proof is the answer "unsatisfiable".

A `Query` holds constraints over the states and is satisfiable if and only if its condition fails; the local condition,
whose margin vanishes at the origin, is asked through one that implies it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.certificates.claims.claim import Problem
from certify.certificates.claims.conditions import BeforeClip, Condition, OfState, Radicand, Vdot, radicands
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Tree, cornered, differentiate, to_tree
from certify.loop.plants import System

Array = NDArray[np.float64]
BEFORE_CLIP = "b."  # and the input's number


@dataclass(frozen=True, slots=True)
class Query:
    """Satisfiable if and only if a condition fails.

    `variables` are names with their exact bounds; `definitions` are names with trees, each over what comes before
    it; `constraints` are relations (tree, ">=" or "<=" or ">", tree) that hold together. Beside the operators of the
    plant's trees, `tanh`, `log`, `min` and `max` occur.
    """

    name: str
    variables: tuple[tuple[str, Fraction, Fraction], ...]
    definitions: tuple[tuple[str, Tree], ...]
    constraints: tuple[tuple[Tree, str, Tree], ...]


def query(condition: Condition, problem: Problem) -> Query:
    """The negation of a condition: somewhere in the domain box every guard holds and the margin does not.

    Raises
    ------
    InputError : the local condition, where -(A'P + PA) is not positive definite; a plant with uncertain
    quantities, because the query would be about nominal values alone; time in steps, or a rate; an equation with
    abs, min, max or clip; another activation than tanh.
    """
    system = problem.loop.system
    require_no_corners(system)
    if problem.loop.network.activation != "tanh":
        raise InputError(
            f"queries for solvers of formulas must be about tanh policies; this one has "
            f"{problem.loop.network.activation} between its layers. Use the engine bounds."
        )
    if system.ranges:
        raise InputError(
            f"queries for solvers of formulas must be about exact equations; {system.name} has ranges of "
            f"{', '.join(system.ranges)}. Leave the ranges out, or use the engine bounds."
        )
    if system.in_steps or problem.rate:
        raise InputError(
            f"queries for solvers of formulas must be about Vdot; {system.name} has "
            f"{'steps' if system.in_steps else 'a rate'}. Use the engine bounds."
        )
    constraints: list[tuple[Tree, str, Tree]] = [
        ("V.", "<=" if guard.side == "inside" else ">=", exact(guard.level)) for guard in condition.guards
    ]
    definitions = _level(problem)
    margin = condition.margin
    if condition.punctured:
        definitions, constraint = _local(problem)
        constraints.append(constraint)
    elif isinstance(margin, Vdot):
        definitions += [*_policy(problem.loop), *_vdot(problem)]
        constraints.append(("Vdot.", ">=", "0"))
    elif isinstance(margin, Radicand):
        definitions += [*_policy(problem.loop), ("r.", to_tree(radicands(problem)[margin.index]))]
        constraints.append(("r.", "<=", "0"))
    else:
        symbols = system.states if isinstance(margin, OfState) else system.inputs
        name = f"{BEFORE_CLIP}{margin.index}" if isinstance(margin, BeforeClip) else symbols[margin.index].name
        definitions += [] if isinstance(margin, OfState) else _policy(problem.loop)
        fails = {("above", True): ">=", ("below", True): "<=", ("above", False): ">", ("below", False): "<"}
        constraints.append((name, fails[margin.side, condition.strict], exact(margin.bound)))
    variables = tuple((s.name, lo, hi) for s, (lo, hi) in zip(system.states, system.domain, strict=True))
    return Query(condition.name, variables, tuple(definitions), tuple(constraints))


def require_no_corners(system: System) -> None:
    """Refuse a plant whose equations are not differentiable, as the local condition's query must know them.

    Raises
    ------
    InputError : one has abs, min, max or clip.
    """
    for term in cornered(*system.dynamics):
        raise InputError(
            f"queries for solvers of formulas must be about smooth equations; {system.name} has {term}. "
            "Use the engine bounds, whose certificates the checker reads."
        )


def _local(problem: Problem) -> tuple[list[tuple[str, Tree]], tuple[Tree, str, Tree]]:
    """`||P Dg + (P Dg)'||_F >= r` with g = F - A x and r < lambda_min(-(A'P + PA)).

    `Vdot = x'(A'P + PA)x + 2 x'P g(x)`, g(0) = 0, and g(x) is the mean of Dg(t x) x over 0 <= t <= 1; so if there is no
    such state, Vdot < 0 for 0 < V <= c1. A is a binary64 matrix and r is shown in rationals. The query of LyZNet
    (Liu, Meng, Fitzsimmons, Zhou 2024). Dg is that of the policy before its clip: `clip_conditions` say that it is the
    same on {V <= c1}.
    """
    P, n = problem.V.P, problem.loop.system.n
    A, _, _ = problem.loop.linearise()
    r = decay(P, A)
    definitions = [*_level(problem), *_policy(problem.loop), *_policy_jacobian(problem.loop), *_jacobian(problem.loop)]
    for i in range(n):
        for j in range(n):
            definitions.append((f"Dg.{i}.{j}", ["-", f"DF.{i}.{j}", exact(float(A[i, j]))]))
    for i in range(n):
        for j in range(n):
            column = [f"Dg.{k}.{j}" for k in range(n)]
            definitions.append((f"PDg.{i}.{j}", combination(P[i], column)))
    squares = [["**", ["+", f"PDg.{i}.{j}", f"PDg.{j}.{i}"], 2] for i in range(n) for j in range(n)]
    return definitions, (total(squares), ">=", str(r * r))


def decay(P: Array, A: Array) -> Fraction:
    """A number below every eigenvalue of `-(A'P + PA)`, shown in rationals; near the smallest one.

    Raises
    ------
    InputError : the matrix is not positive definite.
    """
    p, a = ([[Fraction(float(v)) for v in row] for row in M] for M in (P, A))
    n = len(p)
    M = [
        [-sum((a[k][i] * p[k][j] + p[i][k] * a[k][j] for k in range(n)), Fraction(0)) for j in range(n)]
        for i in range(n)
    ]
    least = float(np.min(np.linalg.eigvalsh(np.array(M, dtype=np.float64))))
    for share in (1 - 1e-9, 1 - 1e-6, 1 - 1e-3, 0.5):
        r = Fraction(share * least)
        if r > 0 and _positive_definite([[M[i][j] - (r if i == j else 0) for j in range(n)] for i in range(n)]):
            return r
    raise InputError(f"-(A'P + PA) must be positive definite; its smallest eigenvalue is about {least:.3g}.")


def _positive_definite(M: list[list[Fraction]]) -> bool:
    """By elimination without pivoting: every pivot is positive."""
    M = [row.copy() for row in M]
    for k in range(len(M)):
        if not M[k][k] > 0:
            return False
        for i in range(k + 1, len(M)):
            factor = M[i][k] / M[k][k]
            for j in range(k, len(M)):
                M[i][j] -= factor * M[k][j]
    return True


def exact(value: float | Fraction) -> str:
    """A number as an exact fraction."""
    return str(Fraction(value))


def total(terms: Sequence[Tree]) -> Tree:
    """The sum of trees."""
    return "0" if not terms else (terms[0] if len(terms) == 1 else ["+", *terms])


def combination(coefficients: Iterable[float], trees: Iterable[Tree], constant: float = 0.0) -> Tree:
    """`sum c_i t_i + constant`; zero coefficients are left out."""
    terms: list[Tree] = [["*", exact(float(c)), t] for c, t in zip(coefficients, trees, strict=True) if c != 0]
    return total([*terms, exact(constant)] if constant or not terms else terms)


def _level(o: Problem) -> list[tuple[str, Tree]]:
    """Definition of `V.`, with `Px.i` on the way."""
    x = [s.name for s in o.loop.system.states]
    result: list[tuple[str, Tree]] = [(f"Px.{i}", combination(row, x)) for i, row in enumerate(o.V.P)]
    return [*result, ("V.", total([["*", s, f"Px.{i}"] for i, s in enumerate(x)]))]


def _vdot(o: Problem) -> list[tuple[str, Tree]]:
    """Definition of `Vdot.` = 2 x'P f(x, pi(x))."""
    F = o.loop.dynamics
    result: list[tuple[str, Tree]] = [(f"f.{i}", to_tree(e)) for i, e in enumerate(F)]
    return [*result, ("Vdot.", ["*", "2", total([["*", f"Px.{i}", f"f.{i}"] for i in range(len(F))])])]


def _policy(loop: ClosedLoop) -> list[tuple[str, Tree]]:
    """Definitions of the neurons `h.k.i`, of the squashed outputs `s.j`, with a clip of its argument, `b.j`, and of
    the inputs under their own names."""
    network, system = loop.network, loop.system
    last = len(network.weights)
    result = _neurons(loop, "h", [s.name for s in system.states])
    if network.centre != "none":
        result += _neurons(loop, "o", [])  # the same network at the origin
    at_0 = [_Term(f"o.{last}.{j}") for j in range(network.m)]
    shift, offset = network.centring(loop.u_eq, at_0, _TERMS)
    for j, symbol in enumerate(system.inputs):
        entering = shift[j] + _Term(f"h.{last}.{j}")
        result.append((f"s.{j}", network.squashed(entering, _TERMS).tree))
        name = symbol.name if network.clip is None else f"{BEFORE_CLIP}{j}"
        result.append((name, (_Term(exact(network.scale[j])) * _Term(f"s.{j}") + offset[j]).tree))
    if network.clip is not None:
        inputs = network.clipped([_Term(f"{BEFORE_CLIP}{j}") for j in range(network.m)], _TERMS)
        result += [(symbol.name, u.tree) for symbol, u in zip(system.inputs, inputs, strict=True)]
    return result


@dataclass(frozen=True, slots=True)
class _Term:
    """A tree with operators; terms that add nothing are omitted."""

    tree: Tree

    def __add__(self, other: _Term) -> _Term:
        if "0" in (self.tree, other.tree):
            return other if self.tree == "0" else self
        return _Term(["+", self.tree, other.tree])

    def __sub__(self, other: _Term) -> _Term:
        return _Term(["-", self.tree, other.tree])

    def __mul__(self, other: _Term) -> _Term:
        return _Term(["*", self.tree, other.tree])


class _Terms:
    def number(self, q: Fraction) -> _Term:
        return _Term(str(q))

    def atanh(self, q: Fraction) -> _Term:
        """`log((1 + q) / (1 - q)) / 2`."""
        return _Term("0" if q == 0 else ["/", ["log", str((1 + q) / (1 - q))], "2"])

    def tanh(self, v: _Term) -> _Term:
        return _Term(["tanh", v.tree])

    def clip(self, v: _Term, lo: Fraction, hi: Fraction) -> _Term:
        return _Term(["min", ["max", v.tree, str(lo)], str(hi)])


_TERMS = _Terms()


def _neurons(loop: ClosedLoop, prefix: str, inputs: list[Tree]) -> list[tuple[str, Tree]]:
    """tanh of each layer but the last, at the states `inputs`; none of them means the origin."""
    network = loop.network
    result: list[tuple[str, Tree]] = []
    if inputs and network.is_moved:
        moved = [["+", exact(float(at)), x] if at else x for x, at in zip(inputs, network.origin, strict=True)]
        result += [(f"{prefix}.0.{i}", tree) for i, tree in enumerate(moved)]
        inputs = [name for name, _ in result]
    for k, (W, b) in enumerate(zip(network.weights, network.biases, strict=True), start=1):
        trees = [combination(row if inputs else [], inputs, float(c)) for row, c in zip(W, b, strict=True)]
        inputs = [f"{prefix}.{k}.{i}" for i in range(len(b))]
        result += zip(inputs, trees if k == len(network.weights) else [["tanh", t] for t in trees], strict=True)
    return result


def _policy_jacobian(loop: ClosedLoop) -> list[tuple[str, Tree]]:
    """Definitions of `Du.j.i`, the derivatives of the inputs, by the chain rule over `h.k.i` and `s.j`."""
    network, n = loop.network, loop.system.n
    result: list[tuple[str, Tree]] = []
    before = [[("1" if i == j else "0") for j in range(n)] for i in range(n)]  # rows: outputs of the layer before
    for k, W in enumerate(network.weights, start=1):
        last = k == len(network.weights)
        names = [[f"J.{k}.{i}.{j}" for j in range(n)] for i in range(len(W))]
        for i, row in enumerate(W):
            for j in range(n):
                product = exact(float(row[j])) if k == 1 else combination(row, [line[j] for line in before])
                slope = ["-", "1", ["**", f"h.{k}.{i}", 2]]
                result.append((names[i][j], product if last else ["*", slope, product]))
        before = names
    for i in range(network.m):
        scale = _Term(exact(network.scale[i])) * network.squash_slope(_Term(f"s.{i}"), _TERMS)
        result += [(f"Du.{i}.{j}", (scale * _Term(before[i][j])).tree) for j in range(n)]
    return result


def _jacobian(loop: ClosedLoop) -> list[tuple[str, Tree]]:
    """Definitions of `DF.i.j`, the closed loop's Jacobian at x."""
    system = loop.system
    result: list[tuple[str, Tree]] = []
    for i, e in enumerate(loop.dynamics):
        for j, state in enumerate(system.states):
            terms = [to_tree(differentiate(e, state))]
            terms += [["*", to_tree(differentiate(e, u)), f"Du.{k}.{j}"] for k, u in enumerate(system.inputs)]
            result.append((f"DF.{i}.{j}", total(terms)))
    return result
