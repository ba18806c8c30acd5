"""Rule `limits`: how many numbers and how many operations a file asks for, by the sizes that it states.

No single size is dear, but their products are: leaves times operations times the square of the symbols, cells times
corners times powers of the states. All of it is counted before anything is computed. This program is slower than what
the counts were measured with, and so takes fewer operations unless it is asked to be patient.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from .document import Certificate, Function
from .evidence import Covering, Tree
from .layers import Layer
from .rational import bits
from .refusal import require

MAX_NUMBERS = 2**25
MAX_OPERATIONS, MAX_IN_PATIENCE = 2**34, 2**46  # the second where somebody has said that it may take days
LEAF = 255


def limits(c: Certificate, most: int) -> None:
    count, work = numbers(c), operations(c)
    require(count <= MAX_NUMBERS, "limits", "numbers", f"{count} numbers at once; {MAX_NUMBERS} are allowed")
    more = f"; with --patient {MAX_IN_PATIENCE}" if most < work <= MAX_IN_PATIENCE else ""
    require(work <= most, "limits", "operations", f"{work} operations; {most} are allowed{more}")


@dataclass(frozen=True)
class Size:
    """Sizes in a file: `s` symbols on a leaf, `d` entries on a ball, `y` of what is uncertain, `a` operations."""

    n: int
    m: int
    s: int
    d: int
    y: int
    a: int

    @property
    def t(self) -> int:
        """Numbers of a model on a ball."""
        return 2 * self.d**2 + self.d * (self.d + 1) * (self.d + 2) // 6


def size_of(c: Certificate) -> Size:
    y = c.k + c.varies
    return Size(c.n, c.m, c.n + c.m + y, c.n + (c.claim == "reached"), y, len(c.plant.dynamics.steps))


def asked_of_leaves(c: Certificate, evidence: Tree) -> bool:
    return evidence.ball is None or c.inner != c.outer


def before_each(layers: Sequence[Layer]) -> list[tuple[int, int, int]]:
    """Rows and columns of each layer, and the units of all layers before it."""
    result, units = [], 0
    for layer in layers:
        result.append((layer.rows, layer.columns, units))
        units += layer.rows
    return result


def numbers(c: Certificate) -> int:
    """An estimate of how many numbers are held at once."""
    z, evidence, shapes = size_of(c), c.evidence, before_each(c.policy.layers)
    count = 4 * sum(p * q for p, q, _ in shapes)
    if not isinstance(evidence, Tree):
        return count
    order = max(evidence.order, evidence.ball.order if evidence.ball else 1)
    values = z.a * (1 if c.sample is None else 4 * order) + 2 * z.n + 8
    if asked_of_leaves(c, evidence) or c.beyond is not None:
        count += values * (z.s + 1) ** 2 + 2**14 * (z.n + z.m + len(shapes))
    if evidence.ball or evidence.contraction or evidence.tube:
        count += values * (z.t + z.d * z.y + z.m) + z.d**4 // 4
        count += sum(p * (4 * before + 3 * z.t) for p, _, before in shapes)
    if c.beyond is not None:
        square = (z.s + 1) ** 2
        count += sum(p * (4 * q + 2 * square) for p, q, _ in before_each(c.beyond.layers))
        count += 8 * steps_of(c.beyond) * square
    return count


def operations(c: Certificate) -> int:
    """Elementary operations on numbers, in all."""
    z, evidence, shapes = size_of(c), c.evidence, before_each(c.policy.layers)
    work = 2**15 * z.a + folding(shapes) + inverting(z.n, bits(c.P))
    if c.policy.centre == "none" and c.ends_at_origin:
        work += 2**12 * sum(p * q for p, q, _ in shapes)
    if not isinstance(evidence, Tree):
        return work
    of_S = min(2 * bits(evidence.T) + bits(c.P) + 16, 2**16 // z.n)
    work += inverting(z.n, of_S) + 2**8 * len(evidence.tree)
    if asked_of_leaves(c, evidence):
        leaves, times = evidence.tree.count(LEAF), evaluations(c, evidence.order)
        models, calls = z.a * times + z.n**2 + 4 * z.n, z.n * z.s**2 + 160 * len(shapes)
        work += leaves * on_a_box(z.n, models, z.a * (evidence.order + 1), z.s, calls)
        work += on_leaves(leaves, shapes, z.n, z.m)
    return work + on_balls(c, z, evidence) + in_tube(c, z, evidence) + beyond(c, z, evidence.covering)


def inverting(n: int, length: int) -> int:
    """A matrix of rationals."""
    return n**5 * length**2 // 2**13 + 2**10 * n**3


def deciding(n: int) -> int:
    """Operations to decide that a matrix is positive definite."""
    return 2**14 * n**3


def evaluations(c: Certificate, order: int) -> int:
    """Evaluations of the equations for a series in time."""
    return 1 if c.sample is None else 2 * order**3 + 8


def steps_of(N: Function) -> int:
    return 0 if N.expression is None else len(N.expression.steps)


# ---------------------------------------------------------------------------------------------------- leaves and balls


def folding(shapes: Sequence[tuple[int, int, int]]) -> int:
    """Operations that are done once with a network's weights."""
    return sum(p * q * (2**9 + 8 * min(p, q)) for p, q, _ in shapes)


def on_leaves(leaves: int, shapes: Sequence[tuple[int, int, int]], n: int, m: int) -> int:
    """A network between affine forms."""
    each = sum(p * (q * (n + m + 2) + 5 * before + 64 * (n + m) + 7 * 2**9) for p, q, before in shapes)
    widest = max((p for p, _, _ in shapes), default=0)
    paths = sum(p * before * (q + 3 * 2**6) for p, q, before in shapes) // 8
    return leaves * each // 8 + (1 + leaves * widest // 2**14) * paths


def on_a_box(n: int, models: int, values: int, symbols: int, calls: int) -> int:
    """So many models, `values` of which are held, on a leaf in n states; `calls` are those beside the models'."""
    square = (symbols + 4) ** 2
    each = 8 * square * models + square * (values + 4) * (32 * models + calls) // 2**9
    return each + 2**11 + 2**7 * n + n**3


def as_models(shapes: Sequence[tuple[int, int, int]], symbols: int) -> int:
    """A network's layers in models on a leaf."""
    return sum(p * (symbols + 4) ** 2 * (2 * q + 64) for p, q, _ in shapes)


def policy_on_a_ball(c: Certificate, z: Size) -> int:
    shapes = before_each(c.policy.layers)
    return sum(p * (q * (z.d + before) + (before + 64) * z.t) + 2**21 for p, q, before in shapes)


def equations_on_a_ball(z: Size) -> int:
    """Once."""
    return z.a * (2**17 + 64 * z.t + 16 * z.d**2 * (z.m + z.y))


def inequality(c: Certificate, z: Size) -> int:
    units = sum(layer.rows for layer in c.policy.layers)
    rows = z.d + 1
    return 2**23 + 2**12 * rows**4 + 8 * z.d**5 + 4 * units * z.d**3 + deciding(rows)


def on_balls(c: Certificate, z: Size, evidence: Tree) -> int:
    cells, work = math.prod(evidence.cells), 0
    decided = cells * 2**z.y * inequality(c, z) + deciding(z.n)
    if evidence.ball is not None:
        times = cells + (0 if c.sample is None else evaluations(c, evidence.ball.order) + 8)
        work += policy_on_a_ball(c, z) + times * equations_on_a_ball(z) + decided
    if evidence.contraction is not None:
        work += policy_on_a_ball(c, z) + cells * equations_on_a_ball(z) + decided
    return work


def in_tube(c: Certificate, z: Size, evidence: Tree) -> int:
    each = policy_on_a_ball(c, z) + equations_on_a_ball(z) + 3 * (inequality(c, z) + deciding(z.n))
    matrices = [P for slab in evidence.tube for P in (slab.middle, slab.end)]
    matrices += [] if c.start is None else [c.start]
    return len(evidence.tube) * each + sum(inverting(z.n, bits(P)) for P in matrices)


def beyond(c: Certificate, z: Size, covering: Covering | None) -> int:
    """Operations for another function N, on the faces of the domain and on its own leaves."""
    N = c.beyond
    if N is None or covering is None:
        return 0
    shapes, steps, policy = before_each(N.layers), steps_of(N), before_each(c.policy.layers)
    faces, leaves = sum(face.count(LEAF) for face in covering.faces), covering.tree.count(LEAF)
    held, calls = max([2 * steps, *(p for p, _, _ in shapes)]), 200 * len(shapes)
    work = folding(shapes) + inverting(z.n, bits(covering.T)) + 2**8 * len(covering.tree)
    work += 2**8 * sum(len(face) for face in covering.faces)
    work += faces * (on_a_box(z.n, steps, held, z.n, calls) + as_models(shapes, z.n))
    each = sum(p * (q * (z.n + 3) + 5 * before + 64 * (z.n + 1) + 7 * 2**9) for p, q, before in shapes)
    paths = sum(p * before * (q + 3 * 2**6) for p, q, before in shapes) // 8
    work += (faces + leaves) * each // 8 + (1 + faces + leaves) * paths
    calls += z.n * z.s**2 + 160 * len(policy)
    work += leaves * on_a_box(z.n, z.a + 8 * steps + 4 * z.n, max(held, z.a), z.s, calls)
    return work + leaves * as_models(shapes, z.s) + on_leaves(leaves, policy, z.n, z.m)
