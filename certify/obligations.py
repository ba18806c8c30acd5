"""What has to be proved, as frozen data: the same description for every engine.

For the closed loop F, `V = x'Px` and `Vdot = 2 x'P F`:

- local: Vdot < 0 on 0 < V <= inner, for every smaller level too;
- ring: Vdot < 0 on inner <= V <= outer, and the input stays in its bounds;
- domain: {V <= outer} lies in the interior of the domain box.

`Obligations` is what the bounds engine takes. A solver of formulas takes a `Query`: the negation of one claim, as
constraints over the states, so that a proof is the answer "unsatisfiable".
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.closed_loop import ClosedLoop
from certify.errors import InputError
from certify.systems.trees import to_tree

Array = NDArray[np.float64]
Tree = Any  # nested lists: a name, an exact fraction as text, or an operator with its operands


@dataclass(frozen=True, slots=True)
class Obligations:
    """The claims about one closed loop and one quadratic Lyapunov function.

    Parameters
    ----------
    loop : the closed loop.
    P : (n, n), symmetric.
    T : (n, n), invertible; `x = T z` are the coordinates in which boxes are drawn. No claim depends on it.
    """

    loop: ClosedLoop
    P: Array
    T: Array

    def __post_init__(self) -> None:
        n = self.loop.system.n
        for name in ("P", "T"):
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.shape != (n, n) or not np.all(np.isfinite(array)):
                raise InputError(f"`{name}` must be a finite matrix of shape ({n}, {n}); found shape {array.shape}.")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if not np.array_equal(self.P, self.P.T):
            i, j = np.argwhere(self.P != self.P.T)[0]
            raise InputError(f"`P` must be symmetric; P[{i}, {j}] = {self.P[i, j]} but P[{j}, {i}] = {self.P[j, i]}.")

    @property
    def inputs_bounded_by_form(self) -> bool:
        """True if the squashing alone keeps the input in its bounds."""
        network, bounds = self.loop.network, self.loop.system.input_bounds
        if network.squash != "tanh" or network.centre == "output":
            return False
        return all(
            lo <= float(o) - abs(float(s)) and float(o) + abs(float(s)) <= hi
            for o, s, (lo, hi) in zip(network.offset, network.scale, bounds, strict=True)
        )


@dataclass(frozen=True, slots=True)
class Query:
    """Satisfiable if and only if a claim is false.

    `variables` are names with their exact bounds; `definitions` are names with trees, each over what comes before
    it; `constraints` are relations (tree, ">=" or "<=" or ">", tree) that hold together. Beside the operators of the
    plant's trees, `tanh` and `log` occur.
    """

    name: str
    variables: tuple[tuple[str, Fraction, Fraction], ...]
    definitions: tuple[tuple[str, Tree], ...]
    constraints: tuple[tuple[Tree, str, Tree], ...]


def queries(obligations: Obligations, inner: float, outer: float) -> list[Query]:
    """One query for each claim: domain, local, ring, inputs."""
    found = [*domain_queries(obligations, outer), local_query(obligations, inner)]
    if inner < outer:
        found.append(ring_query(obligations, inner, outer))
    return found if obligations.inputs_bounded_by_form else [*found, *input_queries(obligations, outer)]


def domain_queries(obligations: Obligations, outer: float) -> list[Query]:
    """For each side of the domain box: V <= outer somewhere on it.

    {V <= outer} is connected and holds the origin, so it leaves the interior of the box only through a side.
    """
    system = obligations.loop.system
    result = []
    for symbol, (lo, hi) in zip(system.states, system.domain, strict=True):
        for side, relation, end in (("below", "<=", lo), ("above", ">=", hi)):
            constraints = [("V.", "<=", exact(outer)), (symbol.name, relation, exact(end))]
            result.append(_query(obligations, f"domain-{symbol.name}-{side}", _level(obligations), constraints))
    return result


def local_query(obligations: Obligations, inner: float) -> Query:
    """Somewhere in V <= inner, `||P Dg + (P Dg)'||_F >= r` with g = F - A x and r < lambda_min(-(A'P + PA)).

    `Vdot = x'(A'P + PA)x + 2 x'P g(x)`, g(0) = 0, and g(x) is the mean of Dg(t x) x over 0 <= t <= 1; so if there is no
    such state, Vdot < 0 for 0 < V <= inner. A is a binary64 matrix and r is shown in rationals. The query of LyZNet
    (Liu, Meng, Fitzsimmons, Zhou 2024).

    Raises
    ------
    InputError : -(A'P + PA) is not positive definite.
    """
    o, n = obligations, obligations.loop.system.n
    A, _, _ = o.loop.linearise()
    r = decay(o.P, A)
    definitions = [*_level(o), *_policy(o.loop), *_policy_jacobian(o.loop), *_jacobian(o.loop)]
    for i in range(n):
        for j in range(n):
            definitions.append((f"Dg.{i}.{j}", ["-", f"DF.{i}.{j}", exact(float(A[i, j]))]))
    for i in range(n):
        for j in range(n):
            column = [f"Dg.{k}.{j}" for k in range(n)]
            definitions.append((f"PDg.{i}.{j}", combination(o.P[i], column)))
    squares = [["**", ["+", f"PDg.{i}.{j}", f"PDg.{j}.{i}"], 2] for i in range(n) for j in range(n)]
    return _query(o, "local", definitions, [("V.", "<=", exact(inner)), (total(squares), ">=", str(r * r))])


def ring_query(obligations: Obligations, inner: float, outer: float) -> Query:
    """Somewhere in inner <= V <= outer, Vdot >= 0."""
    level = [("V.", ">=", exact(inner)), ("V.", "<=", exact(outer))]
    definitions = [*_level(obligations), *_policy(obligations.loop), *_vdot(obligations)]
    return _query(obligations, "ring", definitions, [*level, ("Vdot.", ">=", "0")])


def input_queries(obligations: Obligations, outer: float) -> list[Query]:
    """For each input and bound: somewhere in V <= outer, pi lies beyond it."""
    system = obligations.loop.system
    definitions = [*_level(obligations), *_policy(obligations.loop)]
    result = []
    for symbol, (lo, hi) in zip(system.inputs, system.input_bounds, strict=True):
        for side, pair in (("below", (exact(lo), symbol.name)), ("above", (symbol.name, exact(hi)))):
            constraints = [("V.", "<=", exact(outer)), (pair[0], ">", pair[1])]
            result.append(_query(obligations, f"inputs-{symbol.name}-{side}", definitions, constraints))
    return result


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


def _query(
    o: Obligations, name: str, definitions: Iterable[tuple[str, Tree]], constraints: Iterable[tuple[Tree, str, Tree]]
) -> Query:
    system = o.loop.system
    variables = tuple((s.name, lo, hi) for s, (lo, hi) in zip(system.states, system.domain, strict=True))
    return Query(name, variables, tuple(definitions), tuple(constraints))


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


def _level(o: Obligations) -> list[tuple[str, Tree]]:
    """Definition of `V.`, with `Px.i` on the way."""
    x = [s.name for s in o.loop.system.states]
    result: list[tuple[str, Tree]] = [(f"Px.{i}", combination(row, x)) for i, row in enumerate(o.P)]
    return [*result, ("V.", total([["*", s, f"Px.{i}"] for i, s in enumerate(x)]))]


def _vdot(o: Obligations) -> list[tuple[str, Tree]]:
    """Definition of `Vdot.` = 2 x'P f(x, pi(x))."""
    F = o.loop.system.exact_dynamics()
    result: list[tuple[str, Tree]] = [(f"f.{i}", to_tree(e)) for i, e in enumerate(F)]
    return [*result, ("Vdot.", ["*", "2", total([["*", f"Px.{i}", f"f.{i}"] for i in range(len(F))])])]


def _policy(loop: ClosedLoop) -> list[tuple[str, Tree]]:
    """Definitions of the neurons `h.k.i`, of the squashed outputs `s.j`, and of the inputs under their own names."""
    network, system = loop.network, loop.system
    last = len(network.weights)
    result = _neurons(loop, "h", [s.name for s in system.states])
    if network.centre != "none":
        result += _neurons(loop, "o", [])  # the same network at the origin
    squash = network.squash == "tanh"
    for j, symbol in enumerate(system.inputs):
        net: Tree = f"h.{last}.{j}"
        origin = f"o.{last}.{j}"
        scale, offset, u_eq = exact(network.scale[j]), exact(network.offset[j]), str(loop.u_eq[j])
        if network.centre == "preactivation":
            ratio = (loop.u_eq[j] - Fraction(float(network.offset[j]))) / Fraction(float(network.scale[j]))
            # atanh(q) = log((1 + q) / (1 - q)) / 2
            beta: Tree = "0" if ratio == 0 else ["/", ["log", str((1 + ratio) / (1 - ratio))], "2"]
            net = ["+", ["-", net, origin], beta]
        result.append((f"s.{j}", ["tanh", net] if squash else net))
        value: Tree = ["+", ["*", scale, f"s.{j}"], offset]
        if network.centre == "output":
            value = ["+", ["*", scale, ["-", f"s.{j}", ["tanh", origin] if squash else origin]], u_eq]
        result.append((symbol.name, value))
    return result


def _neurons(loop: ClosedLoop, prefix: str, inputs: list[Tree]) -> list[tuple[str, Tree]]:
    """tanh of each layer but the last, at the states `inputs`; none of them means the origin."""
    network = loop.network
    result: list[tuple[str, Tree]] = []
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
        scale: Tree = exact(network.scale[i])
        if network.squash == "tanh":
            scale = ["*", scale, ["-", "1", ["**", f"s.{i}", 2]]]
        result += [(f"Du.{i}.{j}", ["*", scale, before[i][j]]) for j in range(n)]
    return result


def _jacobian(loop: ClosedLoop) -> list[tuple[str, Tree]]:
    """Definitions of `DF.i.j`, the closed loop's Jacobian at x."""
    system = loop.system
    result: list[tuple[str, Tree]] = []
    for i, e in enumerate(system.exact_dynamics()):
        for j, state in enumerate(system.states):
            terms = [to_tree(e.diff(state))]
            terms += [["*", to_tree(e.diff(u)), f"Du.{k}.{j}"] for k, u in enumerate(system.inputs)]
            result.append((f"DF.{i}.{j}", total(terms)))
    return result
