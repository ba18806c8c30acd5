"""Certificates with an outer set {N <= n2}, by hand: what they say of N, trees for it, and where it is wrong.

As in `certificates.py` trees are grown with the checker's own rule for a leaf. A prover in binary64, which looks at a
few points of each box and wants a margin, makes others. Both are hints like any producer's: nothing follows from them
but that a certificate is accepted. What is true of N and of the loop is known otherwise: in closed form, or by a search
for points whose finds are confirmed in ball arithmetic. N'F comes from one complex step, N(x + i t F)/t, as in neither
checker.
"""

from __future__ import annotations

import base64
import itertools
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import reduce
from typing import Any

import numpy as np
from flint import acb, acb_mat, arb, arb_mat, ctx, fmpq, fmpq_mat

from certify.checker.case import Case
from certify.checker.outer import Beyond, is_above_on_faces
from tests.support import claim_oracle
from tests.support.balls import square
from tests.support.certificates import LEAF, Document, decode, edited, encode, halved, parse, passes
from tests.support.uncertain import corners, held

Array = np.ndarray
Layers = Sequence[tuple[Any, Any]]
STEP = 2.0**-200  # of the complex step: its square is nothing beside 1
MARGINS = (0.3, 1.0, 4.0, 16.0)  # of the spread over the points of a box
_ARITHMETIC: dict[str, Callable[..., Any]] = {"+": np.add, "*": np.multiply}
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "tanh": np.tanh, "exp": np.exp, "atan": np.arctan, "sqrt": np.sqrt,
}  # fmt: skip


# -------------------------------------------------------------------------------------------------------- what N can be


def network(layers: Layers, level: float) -> Document:
    arrays = [(np.atleast_2d(np.asarray(W, dtype=float)), np.atleast_1d(b)) for W, b in layers]
    return {
        "kind": "network",
        "layers": [{"shape": list(W.shape), "weight": encode(W), "bias": encode(b)} for W, b in arrays],
        "level": float(level).hex(),
    }


def expression(tree: Any, level: float) -> Document:
    return {"kind": "expression", "expression": tree, "level": float(level).hex()}


def wells(directions: Any, centre: Any = 1.0, size: Any = 1.0) -> Layers:
    """sum_i size_i (tanh(w_i.x - centre_i) - tanh(w_i.x + centre_i)): lowest where each w_i.x is 0, and rising with
    its magnitude."""
    W = np.atleast_2d(np.asarray(directions, dtype=float))
    b, a = (np.broadcast_to(np.asarray(v, dtype=float), len(W)) for v in (centre, size))
    return [(np.concatenate([W, W]), np.concatenate([-b, b])), ([np.concatenate([a, -a])], [0.0])]


def quadratic(M: Any, names: Sequence[str] = ("x", "y", "z")) -> Any:
    """x'Mx as an expression, of binary64 numbers as they stand."""
    n = len(M)
    return [
        "+", *(["*", str(Fraction(float(M[i][j]))), names[i], names[j]] for i in range(n) for j in range(n)),
    ]  # fmt: skip


# ------------------------------------------------------------------------------------------------------- values, floats


def value(tree: Any, names: dict[str, Array]) -> Array:
    """An expression over real or complex numbers."""
    if isinstance(tree, str):
        return names[tree] if tree in names else np.asarray(float(Fraction(tree)))
    name, *operands = tree
    if name == "**":
        return np.asarray(value(operands[0], names) ** operands[1])
    parts = [value(operand, names) for operand in operands]
    if name in _FUNCTIONS:
        return np.asarray(_FUNCTIONS[name](parts[0]))
    if name == "-":
        return -parts[0] if len(parts) == 1 else parts[0] - parts[1]
    return parts[0] / parts[1] if name == "/" else reduce(_ARITHMETIC[name], parts)


class Numbers:
    """V, N and N'F of a document in binary64 at many points (n, B): to find points and boxes, never to judge them."""

    def __init__(self, data: Document) -> None:
        plant = data["plant"]
        self.outer, self.states, self.n = data["claim"]["outer"], plant["states"], len(plant["states"])
        self.level, self.c2 = (float.fromhex(v) for v in (self.outer["level"], data["levels"]["roa"]))
        self.P = square(data["lyapunov"]["P"])
        self.domain = np.array([[_near(q) for q in pair] for pair in plant["domain"]])
        self.bounds = np.array([[_near(q) for q in pair] for pair in plant["input_bounds"]])
        middle = {q["name"]: sum(map(Fraction, q["range"])) / 2 for q in plant["uncertain"]}
        self.loops = [claim_oracle.Loop(held(data, q)) for q in (*corners(data), *([middle] if middle else []))]
        if self.outer["kind"] == "network":
            shapes = [layer["shape"] for layer in self.outer["layers"]]
            self.layers = [
                (decode(layer["weight"]).reshape(shape), decode(layer["bias"])[:, None])
                for layer, shape in zip(self.outer["layers"], shapes, strict=True)
            ]

    def V(self, x: Array) -> Array:
        return np.asarray(np.sum(x * (self.P @ x), axis=0))

    def N(self, x: Array) -> Array:
        """At real or complex points."""
        if self.outer["kind"] == "expression":
            names = dict(zip(self.states, x, strict=True))
            return np.asarray(value(self.outer["expression"], names) + 0 * x[0])
        h = x
        for k, (W, b) in enumerate(self.layers):
            h = W @ (np.tanh(h) if k else h) + b
        return np.asarray(h[0])

    def rises(self, x: Array) -> list[Array]:
        """N'F at each corner of the ranges of what is uncertain, and in their middle."""
        return [self.N(x + 1j * STEP * loop.field(x, loop.inputs(x))).imag / STEP for loop in self.loops]

    def excess(self, x: Array) -> Array:
        """By how much the inputs leave their bounds; at most 0 where they do not."""
        u = self.loops[0].inputs(x)
        return np.max(np.maximum(u - self.bounds[:, 1:], self.bounds[:, :1] - u), axis=0)


def _near(text: str) -> float:
    try:
        return float(Fraction(text))
    except OverflowError:
        return np.inf if not text.startswith("-") else -np.inf


# ------------------------------------------------------------------------------------------------------- trees


def around(T: Any, domain: Sequence[Sequence[str]]) -> Array:
    """The least binary64 box |z| <= root, x = T z, that holds the domain."""
    exact = fmpq_mat([[fmpq(*float(v).as_integer_ratio()) for v in row] for row in np.asarray(T).tolist()]).inv()
    reach = [max(-Fraction(lo), Fraction(hi)) for lo, hi in domain]
    root = []
    for row in exact.tolist():
        least = sum(abs(Fraction(int(v.p), int(v.q))) * most for v, most in zip(row, reach, strict=True))
        near = float(least)
        root.append(near if Fraction(near) >= least else float(np.nextafter(near, np.inf)))
    return np.array(root)


def _points(n: int) -> Array:
    """Corners, middles of sides and faces, centre of [-1, 1]^n: (n, 3^n)."""
    return np.array(list(itertools.product((0.0, -1.0, 1.0), repeat=n))).T


def _above(values: Array, level: float, margin: float) -> Array:
    """Whether all that lies between a few values (points, B) is above a level, probably."""
    least, most = values.min(axis=0), values.max(axis=0)
    return np.asarray(least - margin * (most - least) > level)


def leaf_holds(numbers: Numbers, T: Array, lo: Array, hi: Array, margin: float) -> Array:
    """Of boxes (n, B): probably outside of the domain, in {V < c2}, in {N > n2}, or N falls and the inputs are kept."""
    n, batch = lo.shape
    centre, radius = (lo + hi) / 2, (hi - lo) / 2
    x, reach = T @ centre, np.abs(T) @ radius
    least, most = numbers.domain.T[:, :, None] * (1 + 1e-12)
    S, far = T.T @ numbers.P @ T, np.maximum(np.abs(lo), np.abs(hi))
    off = np.abs(S - np.diag(np.diag(S)))
    inside = np.sum(np.diag(S)[:, None] * far**2, axis=0) + np.sum(far * (off @ far), axis=0) < numbers.c2 * (1 - 1e-9)
    d = _points(n)
    points = (T @ (centre[:, None] + radius[:, None] * d[:, :, None]).reshape(n, -1)).reshape(n, -1)

    def each(values: Array) -> Array:
        return np.asarray(values).reshape(d.shape[1], batch)

    N, V, excess = (each(of(points)) for of in (numbers.N, numbers.V, numbers.excess))
    rises = [each(v) for v in numbers.rises(points)]

    def fall(k: Any, gap: Any) -> Array:
        return np.all([_above(-(rise + k * gap), 0.0, margin) for rise in rises], axis=0)

    found = fall(0.0, 0.0)
    for rise, gap, axis in itertools.product(rises, (numbers.level - N, V - numbers.c2), range(n)):
        ends = [np.all(d == (np.arange(n) == axis)[:, None] * s, axis=0).argmax() for s in (-1.0, 1.0)]
        a, b = (v[ends[1]] - v[ends[0]] for v in (rise, gap))
        found |= fall(np.maximum(np.where(b != 0, -a / np.where(b != 0, b, 1.0), 0.0), 0.0), gap)
    away = np.any((x - reach > most) | (x + reach < least), axis=0)
    kept = _above(-excess, 0.0, margin)
    return np.asarray(away | inside | _above(N, numbers.level, margin) | (found & kept))


def face_holds(numbers: Numbers, axis: int, end: float, lo: Array, hi: Array, margin: float) -> Array:
    """Of boxes on a face, N > n2, probably."""
    n, d = numbers.n, _points(numbers.n)
    points = ((lo + hi) / 2)[:, None] + ((hi - lo) / 2)[:, None] * d[:, :, None]
    points[axis] = end
    return _above(numbers.N(points.reshape(n, -1)).reshape(d.shape[1], -1), numbers.level, margin)


def packed(tree: bytes) -> str:
    return base64.b64encode(tree).decode("ascii")


def unpacked(text: str) -> bytes:
    return base64.b64decode(text)


def faces(data: Document, margin: float, max_leaves: int = 400, depth: int = 12) -> Document:
    """The document with trees for its faces from the prover in binary64."""
    numbers, found = Numbers(data), []
    lowest, most = (
        np.array([outwards(Fraction(pair[side]), side) for pair in data["plant"]["domain"]]) for side in (0, 1)
    )
    for axis, side in itertools.product(range(numbers.n), (0, 1)):
        own = lowest.copy(), most.copy()
        end = own[0][axis] = own[1][axis] = float(Fraction(data["plant"]["domain"][axis][side]))

        def holds(lo: Array, hi: Array, axis: int = axis, end: float = end) -> Array:
            return face_holds(numbers, axis, end, lo, hi, margin)

        found.append(packed(halved(own[1], holds, max_leaves, depth, own[0])))
    return edited(data, "evidence.outer.faces", found)


def with_faces(data: Document) -> Document:
    """The document with trees for its faces that the checker's rule accepts, if any of a few margins gives them."""
    with np.errstate(all="ignore"):
        for margin in MARGINS:
            data = faces(data, margin)
            if next(is_above_on_faces(Case(parse(data))), None) is None:
                break
    return data


def outwards(q: Fraction, side: int) -> float:
    """The binary64 number next to q that is not above it, or not below it for side 1."""
    near = float(q)
    if (Fraction(near) > q) if side == 0 else (Fraction(near) < q):
        near = float(np.nextafter(near, (-np.inf, np.inf)[side]))
    return near


def stated(data: Document, function: Document, T: Any = None, root: Any = None) -> Document:
    """The document with this outer set and a single leaf everywhere; T is that of the inner set unless given."""
    T = square(data["evidence"]["T"]) if T is None else np.atleast_2d(np.asarray(T, dtype=float))
    root = around(T, data["plant"]["domain"]) if root is None else np.asarray(root, dtype=float)
    leaf = packed(bytes([LEAF]))
    data = edited(data, "claim.outer", function)
    evidence = {"T": encode(T), "root": encode(root), "tree": leaf, "faces": [leaf] * (2 * len(T))}
    return edited(data, "evidence.outer", evidence)


def with_outer(
    data: Document, function: Document, *, T: Any = None, root: Any = None, max_leaves: int = 3000, depth: int = 14
) -> Document:
    """The document with this outer set and trees for it, grown as long as there are few leaves."""
    data = with_faces(stated(data, function, T, root))
    with np.errstate(all="ignore"):
        beyond = Beyond(Case(parse(data)))
        tree = halved(beyond.outer.root, lambda *box: passes(beyond, *box), max_leaves, depth)
    return edited(data, "evidence.outer.tree", packed(tree))


def proved(data: Document, margin: float = 1.0, max_leaves: int = 150, depth: int = 12) -> Document:
    """The document with trees from the prover in binary64."""
    outer = data["evidence"]["outer"]
    T, root = square(outer["T"]), decode(outer["root"])
    with np.errstate(all="ignore"):
        numbers = Numbers(data)
        tree = halved(root, lambda *box: leaf_holds(numbers, T, *box, margin), max_leaves, depth)
        return faces(edited(data, "evidence.outer.tree", packed(tree)), margin)


def at_level(data: Document, level: float, max_leaves: int = 3000) -> Document:
    """Another level, and trees for it."""
    T = square(data["evidence"]["outer"]["T"])
    return with_outer(data, {**data["claim"]["outer"], "level": float(level).hex()}, T=T, max_leaves=max_leaves)


def finer(data: Document) -> Document:
    """The document with each leaf of its tree halved on each axis, so that no checker accepts it by little only."""
    leaf = uniform(range(len(data["plant"]["states"])), len(data["plant"]["states"]))
    tree = b"".join(leaf if axis == LEAF else bytes([axis]) for axis in unpacked(data["evidence"]["outer"]["tree"]))
    return edited(data, "evidence.outer.tree", packed(tree))


def uniform(axes: Sequence[int], depth: int) -> bytes:
    """A tree whose leaves are all `depth` splits down, the axes in turn."""
    tree = bytes([LEAF])
    for k in reversed(range(depth)):
        tree = bytes([axes[k % len(axes)]]) + 2 * tree
    return tree


def with_uniform_trees(data: Document, depth: int) -> Document:
    """The document with trees that are as fine everywhere."""
    n = len(data["plant"]["states"])
    others = [[j for j in range(n) if j != axis] for axis in range(n) for _ in range(2)]
    sides = [packed(uniform(own, depth if own else 0)) for own in others]
    data = edited(data, "evidence.outer.tree", packed(uniform(range(n), depth)))
    return edited(data, "evidence.outer.faces", sides)


# --------------------------------------------------------------------------------------------------- where it is wrong


class Balls:
    """N and N'F of a document at points, in ball arithmetic, F for these values of what is uncertain."""

    def __init__(self, data: Document, q: Any) -> None:
        self.loop, self.outer = claim_oracle.Loop(held(data, q)), data["claim"]["outer"]
        self.states = data["plant"]["states"]

    def N(self, x: Sequence[Any]) -> Any:
        """At balls, or complex balls."""
        if self.outer["kind"] == "expression":
            return _in_balls(self.outer["expression"], dict(zip(self.states, x, strict=True)))
        h = acb_mat([[acb(v)] for v in x])
        for k, layer in enumerate(self.outer["layers"]):
            W, b = decode(layer["weight"]).reshape(layer["shape"]), decode(layer["bias"])
            h = acb_mat([[v.tanh()] for v in h.entries()]) if k else h
            h = acb_mat(arb_mat(W.tolist())) * h + acb_mat(arb_mat([[v] for v in b.tolist()]))
        return h[0, 0]

    def rise(self, x: Sequence[arb]) -> arb:
        """N'F within the square of a step of 2^-300, times what N's third derivative is there."""
        _, F = self.loop.closed_loop([list(x)])[0]
        t = arb(2) ** -300
        return (self.N([acb(v, t * f) for v, f in zip(x, F, strict=True)]).imag) / t

    def inputs(self, x: Sequence[arb]) -> list[arb]:
        return list(self.loop.closed_loop([list(x)])[0][0])


def _in_balls(tree: Any, names: dict[str, Any]) -> Any:
    if isinstance(tree, str):
        q = Fraction(0) if tree in names else Fraction(tree)
        return acb(names[tree]) if tree in names else acb(fmpq(q.numerator, q.denominator))
    name, *rest = tree
    if name == "**":
        return _in_balls(rest[0], names) ** rest[1]
    parts = [_in_balls(v, names) for v in rest]
    if name in _FUNCTIONS:
        return getattr(parts[0], name)()
    if name == "-":
        return -parts[0] if len(parts) == 1 else parts[0] - parts[1]
    if name == "/":
        return parts[0] / parts[1]
    return sum(parts[1:], parts[0]) if name == "+" else reduce(lambda a, b: a * b, parts)


def refutation(data: Document, fine: int = 0) -> str | None:
    """A point at which what a document says of N is certainly false, in words; or None, which proves nothing.

    `fine` points a side of the domain; the best of them climb to where the violation is clearest.
    """
    with np.errstate(all="ignore"):
        numbers = Numbers(data)
        for where, x in (("the boundary", _lowest_outside(numbers)), *_violations(numbers, fine)):
            found = _confirmed(data, where, x)
            if found:
                return found
    return None


def _score(numbers: Numbers, x: Array, kind: int) -> Array:
    """Positive where x is a violation: N'F >= 0 for a corner of the ranges, or an input out of its bounds."""
    wrong = numbers.excess(x) if kind < 0 else numbers.rises(x)[kind]
    scale = np.nanmax(np.abs(wrong[np.isfinite(wrong)]), initial=1e-300)
    N = numbers.N(x)
    spread = np.nanmax(np.abs((numbers.level - N)[np.isfinite(N)]), initial=1e-300)
    parts = [wrong / scale, (numbers.level - N) / spread, (numbers.V(x) - numbers.c2) / numbers.c2]
    lo, hi = numbers.domain.T[:, :, None]
    parts += [*((x - lo) / (hi - lo)), *((hi - x) / (hi - lo))]
    return np.nan_to_num(np.min(parts, axis=0), nan=-np.inf)


def _violations(numbers: Numbers, fine: int) -> list[tuple[str, Array]]:
    n = numbers.n
    fine = fine or {1: 2001, 2: 121}.get(n, 25)
    grid = np.meshgrid(*(np.linspace(lo, hi, fine) for lo, hi in numbers.domain), indexing="ij")
    x = np.array([axis.ravel() for axis in grid])
    generator, found = np.random.default_rng(0), []
    for kind in range(-1, len(numbers.loops)):
        score = _score(numbers, x, kind)
        best = x[:, np.argsort(-score, kind="stable")[:12]]
        step = (numbers.domain[:, 1:] - numbers.domain[:, :1]) / fine
        for size in (1.5, 0.5, 0.1, 0.01, 1e-3):
            near = np.repeat(best, 24, axis=1)
            near = np.concatenate([best, near + size * step * generator.standard_normal(near.shape)], axis=1)
            near = np.clip(near, numbers.domain[:, :1], numbers.domain[:, 1:])
            best = near[:, np.argsort(-_score(numbers, near, kind), kind="stable")[:12]]
        found.append(("the inputs" if kind < 0 else f"loop {kind}", best[:, 0]))
    return found


def _lowest_outside(numbers: Numbers) -> Array:
    """Where N is least on the boundary of the domain, nearly, or undefined."""
    lo, hi = numbers.domain.T
    fine = {1: 1, 2: 2001}.get(numbers.n, 41)
    sides = []
    for axis, end in itertools.product(range(numbers.n), (0, 1)):
        spans = [np.linspace(lo[j], hi[j], fine) for j in range(numbers.n)]
        spans[axis] = numbers.domain[axis, end : end + 1]
        sides.append(np.array([v.ravel() for v in np.meshgrid(*spans, indexing="ij")]))
    x = np.concatenate(sides, axis=1)
    N = numbers.N(x)
    return np.asarray(x[:, np.argmin(np.where(np.isfinite(N), N, -np.inf))])


def _confirmed(data: Document, where: str, x: Array) -> str | None:
    """In ball arithmetic, at exactly this point; ends of the domain are those of the document."""
    plant, outer = data["plant"], data["claim"]["outer"]
    with ctx.workprec(1200):
        point, boundary = [], False
        for v, pair in zip(x.tolist(), plant["domain"], strict=True):
            q = next((Fraction(end) for end in pair if float(Fraction(end)) == v), Fraction(v))
            if not Fraction(pair[0]) <= q <= Fraction(pair[1]):
                return None
            boundary |= q in map(Fraction, pair)
            point.append(arb(fmpq(q.numerator, q.denominator)))
        P, level = square(data["lyapunov"]["P"]), arb(float.fromhex(outer["level"]))
        V = sum((arb(P[i, j]) * point[i] * point[j] for i in range(len(x)) for j in range(len(x))), arb(0))
        for q in corners(data):
            balls = Balls(data, q)
            N = balls.N(point)
            if boundary and not N.is_finite():
                return f"N is undefined at {x} on the boundary"
            if not (N.real <= level):
                return None
            if boundary:
                return f"N <= n2 at {x} on the boundary"
            if not V - float.fromhex(data["levels"]["roa"]) >= 0:
                return None
            rise = balls.rise(point)
            if rise >= 0:
                return f"N'F = {float(rise):.3g} at {x}, N = {float(N.real):.6g}, where {where} led"
            for u, pair in zip(balls.inputs(point), plant["input_bounds"], strict=True):
                lo, hi = (arb(fmpq(p.numerator, p.denominator)) for p in map(Fraction, pair))
                if u < lo or u > hi:
                    return f"an input is {float(u):.6g} at {x}, N = {float(N.real):.6g}"
    return None
