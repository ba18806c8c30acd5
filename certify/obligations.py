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


def ring_query(obligations: Obligations, inner: float, outer: float) -> Query:
    """Somewhere in inner <= V <= outer, Vdot >= 0."""
    level = [("V.", ">=", exact(inner)), ("V.", "<=", exact(outer))]
    return _query(obligations, "ring", _vdot(obligations), [*level, ("Vdot.", ">=", "0")])


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


def _vdot(o: Obligations) -> list[tuple[str, Tree]]:
    """Definitions up to `V.` and `Vdot.` = 2 x'P f(x, pi(x))."""
    system = o.loop.system
    x = [s.name for s in system.states]
    result = _policy(o.loop)
    result += [(f"f.{i}", to_tree(e)) for i, e in enumerate(system.exact_dynamics())]
    result += [(f"Px.{i}", combination(row, x)) for i, row in enumerate(o.P)]
    result.append(("V.", total([["*", s, f"Px.{i}"] for i, s in enumerate(x)])))
    result.append(("Vdot.", ["*", "2", total([["*", f"Px.{i}", f"f.{i}"] for i in range(len(x))])]))
    return result


def _policy(loop: ClosedLoop) -> list[tuple[str, Tree]]:
    """Definitions of the hidden neurons `h.k.i` and of the inputs under their own names."""
    network, system = loop.network, loop.system
    result: list[tuple[str, Tree]] = []
    names: dict[str, list[Tree]] = {"h": [s.name for s in system.states], "o": ["0"] * system.n}
    for prefix in ("h",) if network.centre == "none" else ("h", "o"):  # o: the same network at the origin
        for k, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
            last = k == len(network.weights) - 1
            inputs = names[prefix] if k or prefix == "h" else []
            trees = [combination(row if inputs else [], inputs, float(c)) for row, c in zip(W, b, strict=True)]
            new = [f"{prefix}.{k + 1}.{i}" for i in range(len(b))]
            result += list(zip(new, trees if last else [["tanh", t] for t in trees], strict=True))
            names[prefix] = list(new)
    squash = network.squash == "tanh"
    for j, symbol in enumerate(system.inputs):
        net, scale, offset = names["h"][j], exact(network.scale[j]), exact(network.offset[j])
        u_eq = loop.u_eq[j]
        if network.centre == "preactivation":
            ratio = (u_eq - Fraction(float(network.offset[j]))) / Fraction(float(network.scale[j]))
            # atanh(q) = log((1 + q) / (1 - q)) / 2
            beta: Tree = "0" if ratio == 0 else ["/", ["log", str((1 + ratio) / (1 - ratio))], "2"]
            value: Tree = ["+", ["*", scale, ["tanh", ["+", ["-", net, names["o"][j]], beta]]], offset]
        elif network.centre == "output":
            pair = [["tanh", v] if squash else v for v in (net, names["o"][j])]
            value = ["+", ["*", scale, ["-", *pair]], str(u_eq)]
        else:
            value = ["+", ["*", scale, ["tanh", net] if squash else net], offset]
        result.append((symbol.name, value))
    return result
