"""A second checker of certificates, written from FORMAT.md alone: as plain as possible, and slow.

It shares no code with `certify.checker`. What is rational is decided in `fractions.Fraction`, the rest in Arb balls of
160 bits; a comparison of balls counts only if it is certain. Where FORMAT.md leaves a choice (the two lines around a
tanh, the multiplier k of the S-procedure, the range of a third derivative on a leaf, the bound of a spectral norm) the
choice here is this module's own, so that the two checkers may differ by a hair on a leaf or on the local ball. What
`this checker refuses` for its size alone is not refused here.

`judge` returns None if the certificate is accepted, the name of the first rule that fails, or `TRUSTED`.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import math
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from flint import arb, arb_mat, ctx, fmpq

LEAF = 255
MAX_BYTES = 256 * 2**20
MAX_WAITING = 4096  # boxes of the tree beside the one in hand
MAX_BITS = 2**14  # of a numerator or denominator on the way to f(0, u_eq)
MAX_LAYERS, MAX_WIDTH = 64, 2**14
MAX_NESTING, MAX_NODES = 200, 20_000  # of lists, and of lists, names and numbers in all equations
WORD = r"[A-Za-z0-9_.+-]{1,80}"
IDENTIFIER = r"[A-Za-z_][A-Za-z0-9_]{0,63}"
RATIONAL = r"-?(0|[1-9][0-9]{0,1200})(/[1-9][0-9]{0,1200})?"


class Refused(Exception):
    """Carries the name of the rule that failed."""


def require(condition: bool, rule: str) -> None:
    if not condition:
        raise Refused(rule)


def judge(data: dict[str, Any]) -> str | None:
    """The verdict on a document that was parsed or built in Python."""
    return judge_bytes(json.dumps(data).encode())


def judge_bytes(raw: bytes) -> str | None:
    """The verdict on the bytes of a file."""
    try:
        with ctx.workprec(160):
            return rules(read(raw))
    except Refused as no:
        return str(no)


# ----------------------------------------------------------------------------------------------------------- the file


@dataclass
class Layer:
    W: list[list[Fraction]]
    b: list[Fraction]


@dataclass
class Claim:
    """The sections of a file, every number exact."""

    states: list[str]
    inputs: list[str]
    dynamics: list[Any]
    u_eq: list[Fraction]
    domain: list[list[Fraction]]
    input_bounds: list[list[Fraction]]
    layers: list[Layer]
    squash: str
    centre: str
    scale: list[Fraction]
    offset: list[Fraction]
    P: list[list[Fraction]]
    c1: Fraction
    c2: Fraction
    trusted: bool
    T: list[list[Fraction]]
    root: list[float]
    tree: bytes


def read(raw: bytes) -> Claim:
    """Rules `format` and `hash`: the file is as FORMAT.md describes it, and the policy's sha256 is right."""
    require(len(raw) <= MAX_BYTES, "format")
    try:
        data = json.loads(
            raw.decode("utf-8"), object_pairs_hook=unique, parse_float=refuse, parse_constant=refuse, parse_int=integer
        )
    except (ValueError, RecursionError):
        raise Refused("format") from None
    data = keys(data, "schema", "claim", "plant", "policy", "lyapunov", "levels", "evidence", "provenance")
    require(data["schema"] == "certify-certificate/2" and isinstance(data["provenance"], dict), "format")

    plant = keys(data["plant"], "name", "states", "inputs", "dynamics", "u_eq", "domain", "input_bounds")
    states, inputs = entries(plant["states"]), entries(plant["inputs"])
    n, m = len(states), len(inputs)
    require(1 <= n <= 64 and 1 <= m <= 64, "format")
    for word in [plant["name"], *states, *inputs]:
        require(isinstance(word, str) and re.fullmatch(IDENTIFIER, word) is not None, "format")
    require(len({*states, *inputs}) == n + m, "format")
    dynamics = entries(plant["dynamics"], n)
    require(sum(expression(node, {*states, *inputs}, 0) for node in dynamics) <= MAX_NODES, "format")
    u_eq = [rational(q) for q in entries(plant["u_eq"], m)]
    domain = [[rational(q) for q in entries(pair, 2)] for pair in entries(plant["domain"], n)]
    bounds = [[rational(q) for q in entries(pair, 2)] for pair in entries(plant["input_bounds"], m)]
    for lo, hi in [*domain, *bounds]:
        require(lo < hi, "format")

    policy = keys(data["policy"], "layers", "squash", "centre", "scale", "offset", "sha256")
    squash, centre, layers, width = policy["squash"], policy["centre"], [], n
    require(squash in ("tanh", "identity") and centre in ("output", "preactivation", "none"), "format")
    require(squash == "tanh" or centre != "preactivation", "format")
    digest = hashlib.sha256(f"certify-policy/1\0{squash}\0{centre}\0".encode())
    for entry in entries(policy["layers"]):
        layer = keys(entry, "shape", "weight", "bias")
        shape = entries(layer["shape"], 2)
        require(all(type(s) is int and 1 <= s <= MAX_WIDTH for s in shape) and shape[1] == width, "format")
        W, b = array(layer["weight"], math.prod(shape)), array(layer["bias"], shape[0])
        digest.update(struct.pack("<3Q", 2, *shape) + packed(W) + struct.pack("<2Q", 1, shape[0]) + packed(b))
        layers.append(Layer(square(W, width), [Fraction(v) for v in b]))
        width = shape[0]
    require(0 < len(layers) <= MAX_LAYERS and width == m, "format")
    scale, offset = array(policy["scale"], m), array(policy["offset"], m)
    require(all(v != 0 for v in scale), "format")
    for a in (scale, offset):
        digest.update(struct.pack("<2Q", 1, m) + packed(a))
    require(policy["sha256"] == digest.hexdigest(), "hash")

    require(keys(data["claim"], "kind")["kind"] == "asymptotic", "format")
    lyapunov = keys(data["lyapunov"], "kind", "P")
    require(lyapunov["kind"] == "quadratic", "format")
    P = square(array(lyapunov["P"], n * n), n)
    levels = keys(data["levels"], "local", "roa")
    c1, c2 = binary64(levels["local"]), binary64(levels["roa"])
    evidence = data["evidence"]
    trusted = isinstance(evidence, dict) and evidence.get("kind") == "trusted-solver"
    T, root, tree = [0.0] * (n * n), [0.0] * n, b""
    if trusted:
        evidence = keys(evidence, "kind", "solver", "version", "precision", "queries")
        require(binary64(evidence["precision"]) > 0, "format")
        queries = [word for pair in entries(evidence["queries"]) for word in entries(pair, 2)]
        for word in [evidence["solver"], evidence["version"], *queries]:
            require(isinstance(word, str) and re.fullmatch(WORD, word) is not None, "format")
    else:
        evidence = keys(evidence, "kind", "T", "root", "tree")
        require(evidence["kind"] == "partition-tree", "format")
        T, root, tree = array(evidence["T"], n * n), array(evidence["root"], n), decode(evidence["tree"])
    return Claim(
        states, inputs, dynamics, u_eq, domain, bounds, layers, squash, centre, [Fraction(v) for v in scale],
        [Fraction(v) for v in offset], P, c1, c2, trusted, square(T, n), root, tree,
    )  # fmt: skip


def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    require(len({key for key, _ in pairs}) == len(pairs), "format")
    return dict(pairs)


def refuse(text: str) -> None:
    raise Refused("format")


def integer(text: str) -> int:
    require(len(text) <= 10, "format")
    return int(text)


def keys(value: Any, *names: str) -> dict[str, Any]:
    require(isinstance(value, dict) and set(value) == set(names), "format")
    return dict(value)


def entries(value: Any, count: int | None = None) -> list[Any]:
    require(isinstance(value, list) and count in (None, len(value)), "format")
    return list(value)


def rational(text: Any) -> Fraction:
    require(isinstance(text, str) and re.fullmatch(RATIONAL, text) is not None, "format")
    return Fraction(text)


def binary64(text: Any) -> Fraction:
    try:
        value = float.fromhex(text)
    except (TypeError, ValueError, OverflowError):
        raise Refused("format") from None
    require(math.isfinite(value) and value.hex() == text, "format")
    return Fraction(value)


def decode(text: Any) -> bytes:
    try:
        raw = base64.b64decode(text, validate=True) if isinstance(text, str) else b""
    except (binascii.Error, ValueError):
        raise Refused("format") from None
    require(isinstance(text, str) and base64.b64encode(raw).decode() == text, "format")
    return raw


def array(text: Any, count: int) -> list[float]:
    raw = decode(text)
    require(len(raw) == 8 * count, "format")
    values = list(struct.unpack(f"<{count}d", raw))
    require(all(math.isfinite(v) for v in values), "format")
    return values


def packed(values: Sequence[float]) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


def square(values: Sequence[float], columns: int) -> list[list[Fraction]]:
    """Rows of `columns` entries."""
    exact = [Fraction(v) for v in values]
    return [exact[k : k + columns] for k in range(0, len(exact), columns)]


def expression(node: Any, names: set[str], depth: int) -> int:
    """Refuses what is not in the grammar; otherwise the number of nodes."""
    if isinstance(node, str):
        require(node in names or re.fullmatch(RATIONAL, node) is not None, "format")
        return 1
    require(isinstance(node, list) and len(node) > 1 and isinstance(node[0], str) and depth < MAX_NESTING, "format")
    name, *operands = node
    if name == "**":
        require(len(operands) == 2 and type(operands[1]) is int and 0 < abs(operands[1]) <= 64, "format")
        operands = operands[:1]
    most = {"+": math.inf, "*": math.inf, "-": 2, "/": 2, "**": 1, "sin": 1, "cos": 1, "tan": 1}
    require(name in most and (2 if name == "/" else 1) <= len(operands) <= most[name], "format")
    return 1 + sum(expression(operand, names, depth + 1) for operand in operands)


def evaluate(node: Any, names: Mapping[str, Any], constant: Callable[[Fraction], Any]) -> Any:
    """An expression over any numbers that have `+`, unary `-`, `*` and `function(name)`; `1/` is a function."""
    if isinstance(node, str):
        return names[node] if node in names else constant(Fraction(node))
    name, *operands = node
    if name == "**":
        result = power(evaluate(operands[0], names, constant), abs(operands[1]))
        return result if operands[1] > 0 else result.function("1/")
    first, *others = [evaluate(operand, names, constant) for operand in operands]
    for other in others:
        if name == "*":
            first = first * other
        else:
            first = first + (-other if name == "-" else other) if name != "/" else first * other.function("1/")
    if name == "-" and not others:
        return -first
    if name == "tan":
        return first.function("sin") * first.function("cos").function("1/")
    return first.function(name) if name in ("sin", "cos") else first


def power(base: Any, k: int) -> Any:
    """The product of k > 0 factors, by repeated squaring."""
    if k == 1:
        return base
    half = power(base, k // 2)
    return half * half * base if k % 2 else half * half


# ------------------------------------------------------------------------------------------------- the rational rules


def rules(c: Claim) -> str | None:
    """Every rule in its order."""
    require(0 < c.c1 <= c.c2, "levels")
    inverse = inverse_diagonal(c.P)
    require(inverse is not None, "lyapunov")
    equilibrium(c)
    for (lo, hi), s in zip(c.domain, inverse or [], strict=True):
        require(lo < 0 < hi and c.c2 * s < min(-lo, hi) ** 2, "domain")
    if c.trusted:
        centring(c)
        return "TRUSTED"
    S = product(product(transpose(c.T), c.P), c.T)
    inverse = inverse_diagonal(S)
    require(inverse is not None and discs(S) > 0, "coordinates")
    for b, s in zip(c.root, inverse or [], strict=True):
        require(b > 0 and c.c2 * s <= Fraction(b) ** 2, "root")
    centring(c)
    local(c, S)
    leaves = [Leaf(c, S, lo, hi) for lo, hi in partition(c)]  # rule `tree`
    if c.c1 < c.c2:
        in_ring = [leaf for leaf in leaves if not leaf.misses_the_ring()]
        for leaf in in_ring:
            inputs(c, leaf.policy())
        for leaf in in_ring:
            require(leaf.decreases(), "ring")
    return None


def dot(a: Sequence[Fraction], b: Sequence[Fraction]) -> Fraction:
    return sum((v * w for v, w in zip(a, b, strict=True)), Fraction(0))


def transpose(A: list[list[Fraction]]) -> list[list[Fraction]]:
    return [list(column) for column in zip(*A, strict=True)]


def product(A: list[list[Fraction]], B: list[list[Fraction]]) -> list[list[Fraction]]:
    return [[dot(row, column) for column in transpose(B)] for row in A]


def inverse_diagonal(A: list[list[Fraction]]) -> list[Fraction] | None:
    """The diagonal of A^-1 if A = A' and every pivot of elimination without pivoting is positive (rule `lyapunov`)."""
    n = len(A)
    if any(A[i][j] != A[j][i] for i in range(n) for j in range(n)):
        return None
    rows = [[*A[i], *(Fraction(i == j) for j in range(n))] for i in range(n)]
    for i in range(n):
        if rows[i][i] <= 0:
            return None
        for k in range(n):
            if k != i:
                factor = rows[k][i] / rows[i][i]
                rows[k] = [a - factor * b for a, b in zip(rows[k], rows[i], strict=True)]
    return [rows[i][n + i] / rows[i][i] for i in range(n)]


def discs(A: list[list[Fraction]]) -> Fraction:
    """Gershgorin's lower bound min_i (A_ii - sum_j |A_ij|) on the eigenvalues of a symmetric matrix."""
    return min(row[i] - sum(abs(v) for j, v in enumerate(row) if j != i) for i, row in enumerate(A))


@dataclass
class Exact:
    """A rational number on the way to f(0, u_eq)."""

    value: Fraction

    def __post_init__(self) -> None:
        bits = max(self.value.numerator.bit_length(), self.value.denominator.bit_length())
        require(bits <= MAX_BITS, "equilibrium")

    def __add__(self, other: Exact) -> Exact:
        return Exact(self.value + other.value)

    def __mul__(self, other: Exact) -> Exact:
        return Exact(self.value * other.value)

    def __neg__(self) -> Exact:
        return Exact(-self.value)

    def function(self, name: str) -> Exact:
        require((self.value == 0) == (name != "1/"), "equilibrium")
        return Exact(1 / self.value if name == "1/" else Fraction(name == "cos"))


def equilibrium(c: Claim) -> None:
    """Rule `equilibrium`: f(0, u_eq) = 0 in rationals; sin, cos and tan at exact 0 only; no division by 0."""
    names = dict.fromkeys(c.states, Exact(Fraction(0)))
    names.update(zip(c.inputs, map(Exact, c.u_eq), strict=True))
    for node in c.dynamics:
        require(evaluate(node, names, Exact).value == 0, "equilibrium")


def centring(c: Claim) -> None:
    """Rule `centring`: |u_eq - offset| < |scale| (`preactivation`); raw(0) = u_eq in rationals (`none`).

    A value that is not known to be rational is None; a weight of exact 0 ignores it.
    """
    if c.centre == "preactivation":
        for q, scale, offset in zip(c.u_eq, c.scale, c.offset, strict=True):
            require(-1 < (q - offset) / scale < 1, "centring")
    if c.centre != "none":
        return

    def tanh(value: Fraction | None) -> Fraction | None:
        return Fraction(0) if value == 0 else None

    h: list[Fraction | None] = [Fraction(0)] * len(c.states)
    for k, layer in enumerate(c.layers):
        h = [tanh(v) for v in h] if k else h
        y: list[Fraction | None] = []
        for row, b in zip(layer.W, layer.b, strict=True):
            used = [(w, v) for w, v in zip(row, h, strict=True) if w != 0]
            y.append(None if any(v is None for _, v in used) else b + sum((w * (v or 0) for w, v in used), Fraction(0)))
        h = y
    if c.squash == "tanh":
        h = [tanh(v) for v in h]
    for v, q, scale, offset in zip(h, c.u_eq, c.scale, c.offset, strict=True):
        require(v is not None and scale * v + offset == q, "centring")


# -------------------------------------------------------------------------------------------------------- Arb, shared


def ball(q: Fraction | float) -> arb:
    q = Fraction(q)
    return arb(fmpq(q.numerator, q.denominator))


def total(terms: Iterable[arb]) -> arb:
    return sum(terms, arb(0))


def norm(values: Iterable[arb]) -> arb:
    """The largest 2-norm of a vector of balls."""
    return total(sup(v) ** 2 for v in values).sqrt()


def sup(value: arb) -> arb:
    """The largest absolute value in a ball."""
    return arb(value.abs_upper())


def largest(values: Sequence[arb]) -> arb:
    result = values[0]
    for value in values[1:]:
        result = result.max(value)
    return result


def derivatives(name: str, y: arb) -> list[arb]:
    """phi, phi', phi'', phi''' on a ball."""
    if name == "1/":
        p = 1 / y
        return [p, -(p * p), 2 * p * p * p, -6 * p * p * p * p]
    s, k = y.sin(), y.cos()
    return [s, k, -s, -k] if name == "sin" else [k, -s, -k, s]


def affine(layer: Layer, rows: list[list[arb]]) -> list[list[arb]]:
    """W h + b, where h_i is given by `rows[i]`: a constant and then coefficients."""
    result = []
    for exact, b in zip(layer.W, layer.b, strict=True):
        weights = [ball(w) for w in exact]
        row = [total(w * v for w, v in zip(weights, column, strict=True)) for column in zip(*rows, strict=True)]
        result.append([row[0] + ball(b), *row[1:]])
    return result


def beta(c: Claim) -> list[arb]:
    return [ball((q - b) / s).atanh() for q, s, b in zip(c.u_eq, c.scale, c.offset, strict=True)]


def inputs(c: Claim, ranges: Sequence[tuple[arb, arb]]) -> None:
    """Rule `inputs`: `offset +- scale` lies in the bounds and the centring keeps the input there, or `ranges` do.

    `ranges` has the centre and the radius of each input's enclosure.
    """
    each = zip(c.scale, c.offset, c.input_bounds, strict=True)
    if (
        c.centre != "output"
        and c.squash == "tanh"
        and all(lo <= b - abs(s) and b + abs(s) <= hi for s, b, (lo, hi) in each)
    ):
        return
    for (centre, radius), (lo, hi) in zip(ranges, c.input_bounds, strict=True):
        require(bool(centre - radius >= ball(lo)) and bool(centre + radius <= ball(hi)), "inputs")


# ------------------------------------------------------------------------------------------------------ the local rule


@dataclass
class Local:
    """v(0) + a.d + d'Qd + r(d) with |r(d)| <= d'Ed, for ||d|| <= 1; a is a column."""

    v: arb
    a: arb_mat
    Q: arb_mat
    E: arb_mat

    def __post_init__(self) -> None:
        self.slope, self.bend = norm(self.a.entries()), norm(self.Q.entries())
        self.curve = self.bend + norm(self.E.entries())
        self.radius = self.slope + self.curve

    @classmethod
    def affine(cls, v: arb, a: Sequence[arb]) -> Local:
        n = len(a)
        return cls(v, arb_mat(n, 1, list(a)), arb_mat(n, n), arb_mat(n, n))

    def __add__(self, other: Local) -> Local:
        return Local(self.v + other.v, self.a + other.a, self.Q + other.Q, self.E + other.E)

    def __neg__(self) -> Local:
        return Local(-self.v, -self.a, -self.Q, self.E)

    def __mul__(self, other: Local) -> Local:
        """v w = v(0) w(0) + v(0) dw + w(0) dv + (a_v.d)(a_w.d) + dv (dw - a_w.d) + (dv - a_v.d)(a_w.d)."""
        v, w, outer = self, other, self.a * other.a.transpose()
        Q = v.v * w.Q + w.v * v.Q + (outer + outer.transpose()) / 2
        E = (abs(v.v) + v.radius) * w.E + (abs(w.v) + w.slope) * v.E
        E += (v.radius * w.bend + w.slope * v.bend) * identity(outer.nrows())
        return Local(v.v * w.v, v.v * w.a + w.v * v.a, Q, E)

    def function(self, name: str) -> Local:
        at = derivatives(name, self.v)
        if name == "1/":
            least = abs(self.v) - self.radius
            require(bool(least > 0), "local")
            third = 6 / least**4
        else:
            third = (abs(at[3]) + self.radius).min(arb(1))
        H, R = self.beyond_tangent(at[2] / 2, third)
        return Local(at[0], at[1] * self.a, at[1] * self.Q + H, abs(at[1]) * self.E + R)

    def beyond_tangent(self, half: arb, third: arb) -> tuple[arb_mat, arb_mat]:
        """(H, R): a function of v less its tangent at v(0) is d'Hd within d'Rd.

        half = phi''(v(0)) / 2, third >= |phi'''| on the range. (v - v(0))^2 is d'aa'd but for (v - v(0) - a.d)(v - v(0)
        + a.d), that is within (2 slope + curve) d'(bend I + E)d, and |v - v(0)|^3 <= radius (v - v(0))^2.
        """
        square, cubic = self.a * self.a.transpose(), third * self.radius / 6
        spread = (abs(half) + cubic) * (2 * self.slope + self.curve)
        return half * square, spread * self.E + cubic * square + spread * self.bend * identity(square.nrows())

    def tanh(self) -> tuple[arb, arb, arb_mat, arb_mat]:
        """The value and the slope of the tangent at v(0), and (H, R) of what tanh adds to it; |tanh'''| <= 2."""
        t = self.v.tanh()
        return t, 1 - t * t, *self.beyond_tangent(-t * (1 - t * t), arb(2))


def local(c: Claim, S: list[list[Fraction]]) -> None:
    """Rule `local`: ||I - N||_2 + ||W||_2 < 1 on z = rho d; rule `inputs` on that ball."""
    n, rho = len(c.states), arb(ball(c.c1 / discs(S)).sqrt().upper())
    states = local_states(c, rho)
    u = local_policy(c, states)
    inputs(c, [(v.v, v.radius) for v in u])
    B, C, E = local_vdot(c, states, u)
    require(all(v.is_finite() for A in (B, E, *C) for v in A.entries()), "local")
    require(all(bool(B[i, i] < 0) for i in range(n)), "local")
    D = arb_mat([[1 / (-B[i, i]).sqrt() if i == j else arb(0) for j in range(n)] for i in range(n)])
    N = D * (-(B + B.transpose()) / 2 - E) * D
    W = arb_mat([(D * A * D).entries() for A in C])
    require(bool(spectral(identity(n) - N) + spectral(W) < 1), "local")


def local_states(c: Claim, rho: arb) -> list[Local]:
    """x = T rho d."""
    return [Local.affine(arb(0), [rho * ball(t) for t in row]) for row in c.T]


def local_policy(c: Claim, states: list[Local]) -> list[Local]:
    """The policy on the local ball: y(d) = y(0) + J d + L A(d), and A_q(d) is d'H_q d within d'R_q d.

    A row is y_i(0), then J_i, then L_i: one entry for each tanh q of the layers before.
    """
    rows, bends = affine(c.layers[0], [[x.v, *x.a.entries()] for x in states]), list[tuple[arb_mat, arb_mat]]()
    for layer in c.layers[1:]:
        tangents, own = [], []
        for row in rows:
            t, slope, H, R = local_model(row, bends).tanh()
            tangents.append([t, *(slope * v for v in row[1:])])
            own.append((H, R))
        rows = [[*row, *map(ball, w)] for row, w in zip(affine(layer, tangents), layer.W, strict=True)]
        bends += own
    if c.centre == "preactivation":
        rows = [[y, *row[1:]] for y, row in zip(beta(c), rows, strict=True)]
    result, zero = [], arb_mat(len(states), len(states))
    for q, s, row in zip(c.u_eq, map(ball, c.scale), rows, strict=True):
        y = local_model(row, bends)
        _, slope, H, R = y.tanh() if c.squash == "tanh" else (y.v, arb(1), zero, zero)
        result.append(  # pi(0) = u_eq exactly
            Local(ball(q), s * slope * y.a, s * (slope * y.Q + H), abs(s) * (slope * y.E + R))
        )
    return result


def local_model(row: list[arb], bends: list[tuple[arb_mat, arb_mat]]) -> Local:
    """Q = sum_q L_q H_q and E = sum_q |L_q| R_q, L the end of the row."""
    y = Local.affine(row[0], row[1 : len(row) - len(bends)])
    L = row[len(row) - len(bends) :]
    Q = sum((v * H for v, (H, _) in zip(L, bends, strict=True)), y.Q)
    return Local(y.v, y.a, Q, sum((abs(v) * R for v, (_, R) in zip(L, bends, strict=True)), y.E))


def local_vdot(c: Claim, states: list[Local], u: list[Local]) -> tuple[arb_mat, list[arb_mat], arb_mat]:
    """B, C, E: Vdot / (2 rho) is d'Bd + sum_j d_j d'C_j d within d'Ed; F(0) = 0 exactly."""
    size = range(len(states))
    names = dict(zip(c.states + c.inputs, states + u, strict=True))
    F = [evaluate(node, names, lambda q: Local.affine(ball(q), [arb(0) for _ in size])) for node in c.dynamics]
    PT = arb_mat([[ball(v) for v in row] for row in product(c.P, c.T)])
    zero = arb_mat(len(F), len(F))
    B = PT.transpose() * arb_mat([f.a.entries() for f in F])
    C = [sum((PT[i, j] * f.Q for i, f in enumerate(F)), zero) for j in size]
    E = sum((norm(row) * f.E for row, f in zip(PT.tolist(), F, strict=True)), zero)
    return B, C, E


def identity(n: int) -> arb_mat:
    return arb_mat(n, n, [int(i == j) for i in range(n) for j in range(n)])


def spectral(A: arb_mat) -> arb:
    """A bound of the largest singular value: the root of ||(AA')^(2^k)||_F, at most n^(1/2^(k+2)) too large."""
    result, squared = norm(A.entries()), A * A.transpose()
    for k in range(30):
        bound = norm(squared.entries())
        for _ in range(k + 1):
            bound = bound.sqrt()
        result, squared = bound if bound < result else result, squared * squared
    return result


# --------------------------------------------------------------------------------------------------------- the leaves


def partition(c: Claim) -> Iterator[tuple[list[float], list[float]]]:
    """Rule `tree`: the leaves of a binary tree in preorder, exactly all bytes used, at most 4,096 waiting."""
    waiting, position = [([-b for b in c.root], list(c.root))], 0
    while waiting:
        lo, hi = waiting.pop()
        require(position < len(c.tree) and len(waiting) <= MAX_WAITING, "tree")
        axis, position = c.tree[position], position + 1
        if axis == LEAF:
            yield lo, hi
            continue
        require(axis < len(c.root), "tree")
        middle = 0.5 * lo[axis] + 0.5 * hi[axis]
        below, above = list(hi), list(lo)
        below[axis] = above[axis] = middle
        waiting += [(above, hi), (lo, below)]  # the lower half is next
    require(position == len(c.tree), "tree")


@dataclass
class Taylor:
    """c + g.d + d'Qd + [-r, r] for d in [-1, 1]^(n + m)."""

    c: arb
    g: list[arb]
    Q: list[list[arb]]
    r: arb

    @classmethod
    def affine(cls, c: arb, g: Sequence[arb]) -> Taylor:
        return cls(c, list(g), [[arb(0)] * len(g) for _ in g], arb(0))

    def first(self) -> arb:
        """sup |g.d|."""
        return total(abs(v) for v in self.g)

    def second(self) -> arb:
        """A bound of |d'Qd|."""
        return total(abs(v) for row in self.Q for v in row)

    def __add__(self, other: Taylor) -> Taylor:
        Q = [[x + y for x, y in zip(a, b, strict=True)] for a, b in zip(self.Q, other.Q, strict=True)]
        return Taylor(self.c + other.c, [x + y for x, y in zip(self.g, other.g, strict=True)], Q, self.r + other.r)

    def scaled(self, k: arb) -> Taylor:
        return Taylor(k * self.c, [k * v for v in self.g], [[k * v for v in row] for row in self.Q], abs(k) * self.r)

    def __neg__(self) -> Taylor:
        return self.scaled(arb(-1))

    def __mul__(self, other: Taylor) -> Taylor:
        p, q, size = self, other, range(len(self.g))
        g = [p.c * q.g[i] + q.c * p.g[i] for i in size]
        Q = [[p.c * q.Q[i][j] + q.c * p.Q[i][j] + p.g[i] * q.g[j] for j in size] for i in size]
        r = p.first() * q.second() + p.second() * q.first() + p.second() * q.second()
        r += p.r * (abs(q.c) + q.first() + q.second() + q.r) + q.r * (abs(p.c) + p.first() + p.second())
        return Taylor(p.c * q.c, g, Q, r)

    def function(self, name: str) -> Taylor:
        """phi(c) + phi'(c) e + phi''(c) e^2 / 2 + phi'''(.) e^3 / 6 with e the model less its constant c."""
        size = range(len(self.g))
        rest = self.second() + self.r
        lo, hi = -(-self).bound(), self.bound()
        whole = (self.c - lo).max(hi - self.c)
        at, on = derivatives(name, self.c), derivatives(name, lo.union(hi))
        Q = [[at[1] * self.Q[i][j] + at[2] / 2 * self.g[i] * self.g[j] for j in size] for i in size]
        r = abs(at[1]) * self.r + abs(at[2]) / 2 * (2 * self.first() * rest + rest * rest)
        return Taylor(at[0], [at[1] * v for v in self.g], Q, r + sup(on[3]) * whole**3 / 6)

    def bound(self) -> arb:
        """c + r + sum |Q_ij + Q_ji| + the exact maximum of g_i t + Q_ii t^2 over |t| <= 1 for each symbol."""
        result = self.c + self.r
        for i, g in enumerate(self.g):
            result += total(abs(self.Q[i][j] + self.Q[j][i]) for j in range(i))
            q = self.Q[i][i]
            if q < 0 and abs(g) <= -2 * q:
                result += g * g / (-4 * q)  # at t = -g / 2q
            elif q < 0 and abs(g) >= -2 * q:
                result += abs(g) + q
            else:
                result += abs(g) + q.max(arb(0))
        return result


@dataclass
class Leaf:
    """One box lo <= z <= hi, with z = centre + radius d."""

    claim: Claim
    S: list[list[Fraction]]
    lo: list[float]
    hi: list[float]

    def __post_init__(self) -> None:
        ends = [(Fraction(a), Fraction(b)) for a, b in zip(self.lo, self.hi, strict=True)]
        self.centre, self.radius = [(a + b) / 2 for a, b in ends], [(b - a) / 2 for a, b in ends]
        self.largest = [max(abs(a), abs(b)) for a, b in ends]
        self.least = [Fraction(0) if a <= 0 <= b else min(abs(a), abs(b)) for a, b in ends]
        S, size = self.S, range(len(ends))
        pairs = [abs(S[i][j]) * self.largest[i] * self.largest[j] for i in size for j in size if i != j]
        self.cross = sum(pairs, Fraction(0))
        self.symbols = len(ends) + len(self.claim.inputs)
        self.forms: list[tuple[list[arb], arb]] | None = None

    def misses_the_ring(self) -> bool:
        """sum S_ii min z_i^2 - sum_{i != j} |S_ij| max|z_i| max|z_j| > c2, or its counterpart is below c1."""
        diagonal = [self.S[i][i] for i in range(len(self.lo))]
        V_min = dot(diagonal, [z * z for z in self.least]) - self.cross
        V_max = dot(diagonal, [z * z for z in self.largest]) + self.cross
        return V_min > self.claim.c2 or V_max < self.claim.c1

    def model(self, constant: arb, coefficients: Sequence[arb] = (), first: int = 0) -> Taylor:
        """An affine model whose coefficients belong to the symbols from the number `first` on."""
        g = [arb(0)] * first + list(coefficients)
        g += [arb(0)] * (self.symbols - len(g))
        return Taylor(constant, g, [[arb(0)] * self.symbols for _ in g], arb(0))

    def states(self) -> list[list[arb]]:
        """x = T z: a constant and the coefficients of d."""
        return [
            [ball(dot(row, self.centre)), *(ball(t * r) for t, r in zip(row, self.radius, strict=True))]
            for row in self.claim.T
        ]

    def enclosure(self) -> list[tuple[list[arb], arb]]:
        if self.forms is None:
            self.forms = leaf_policy(self.claim, self.states())
        return self.forms

    def policy(self) -> list[tuple[arb, arb]]:
        """The centre and the radius of each input's enclosure."""
        return [(form[0], total(abs(v) for v in form[1:]) + e) for form, e in self.enclosure()]

    def decreases(self) -> bool:
        """Rule `ring`: the bound of Vdot, Vdot + k (c2 - V) or Vdot + k (V - c1) is negative for a k >= 0.

        The first-order part c + sum |g_i| of the bound is piecewise linear in k; each of its kinks is tried.
        """
        Vdot, V = self.Vdot(), self.V()
        if Vdot.bound() < 0:
            return True
        for sign, level in ((-1, self.claim.c2), (1, self.claim.c1)):
            W = V.scaled(arb(sign)) + self.model(ball(-sign * level))
            for g, w in zip(Vdot.g, W.g, strict=True):
                k = -(g / w).mid()
                if k > 0 and (Vdot + W.scaled(k)).bound() < 0:  # never with a k that is infinite or not a number
                    return True
        return False

    def Vdot(self) -> Taylor:
        """(2 P x)'F, where 2 P x = 2 P T z is affine in d."""
        c, n = self.claim, len(self.lo)
        names = {name: self.model(row[0], row[1:]) for name, row in zip(c.states, self.states(), strict=True)}
        for j, (name, (form, e)) in enumerate(zip(c.inputs, self.enclosure(), strict=True)):
            names[name] = self.model(form[0], form[1:]) + self.model(arb(0), [e], first=n + j)
        result = self.model(arb(0))
        for node, row in zip(c.dynamics, product(c.P, c.T), strict=True):
            slopes = [ball(2 * v * r) for v, r in zip(row, self.radius, strict=True)]
            gradient = self.model(ball(2 * dot(row, self.centre)), slopes)
            result = result + gradient * evaluate(node, names, lambda q: self.model(ball(q)))
        return result

    def V(self) -> Taylor:
        """z'Sz, the off-diagonal part in the remainder."""
        result = self.model(arb(0))
        for i, (z, r) in enumerate(zip(self.centre, self.radius, strict=True)):
            result = result + self.model(ball(self.S[i][i] * z * z), [ball(2 * self.S[i][i] * z * r)], first=i)
            result.Q[i][i] = ball(self.S[i][i] * r * r)
        result.r = ball(self.cross)
        return result


def leaf_policy(c: Claim, x: list[list[arb]]) -> list[tuple[list[arb], arb]]:
    """([mid, slopes], e) of each input: u = mid + slopes.d +- e on the leaf x = x[.][0] + x[.][1:].d.

    Each tanh lies in slope y + shift +- gap, and each gap is a symbol of its own until the output: that carries every
    error to the output through the product of all later weights and slopes, as a backward pass does.
    """
    n, forms, at_0 = len(x), x, [[arb(0)] for _ in x]
    for number, layer in enumerate(c.layers):
        if number:
            forms, at_0 = tanh_layer(forms), [[v.tanh()] for (v,) in at_0]
        forms, at_0 = affine(layer, forms), affine(layer, at_0)
    if c.centre == "preactivation":
        for form, (y,), b in zip(forms, at_0, beta(c), strict=True):
            form[0] += b - y
    if c.squash == "tanh":
        forms, at_0 = tanh_layer(forms), [[v.tanh()] for (v,) in at_0]
    result = []
    for form, (y,), q, s, b in zip(forms, at_0, c.u_eq, c.scale, c.offset, strict=True):
        u = [ball(s) * v for v in form]
        u[0] += ball(q) - ball(s) * y if c.centre == "output" else ball(b)
        result.append((u[: n + 1], total(abs(v) for v in u[n + 1 :])))
    return result


def tanh_layer(forms: list[list[arb]]) -> list[list[arb]]:
    """Replaces each form by slope * form + shift, and gives its gap a symbol of its own."""
    result = []
    for i, form in enumerate(forms):
        reach = total(abs(v) for v in form[1:])
        slope, shift, gap = lines(arb((form[0] - reach).lower()), arb((form[0] + reach).upper()))
        line = [slope * v for v in form] + [gap if j == i else arb(0) for j in range(len(forms))]
        line[0] += shift
        result.append(line)
    return result


def lines(lo: arb, hi: arb) -> tuple[arb, arb, arb]:
    """slope, shift, gap with |tanh(y) - slope y - shift| <= gap on [lo, hi]; the slope is near the chord's.

    The extrema of tanh(y) - slope y are at the ends or where tanh(y)^2 = 1 - slope.
    """
    chord = (hi.tanh() - lo.tanh()) / (hi - lo) if lo < hi else 1 - lo.tanh() ** 2
    slope, at = arb(min(max(float(chord.mid()), 0.0), 1.0)), [lo, hi]
    if slope > 1e-30:
        critical = (1 - slope).sqrt().atanh()
        at += [y for y in (critical, -critical) if not (y < lo or y > hi)]
    else:
        slope = arb(0)  # then tanh(y) itself, which has no critical point
    values = [y.tanh() - slope * y for y in at]
    top, bottom = largest(values), -largest([-v for v in values])
    return slope, (top + bottom) / 2, (top - bottom) / 2
