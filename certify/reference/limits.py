"""Rule `limits`: how many numbers and how many operations a file asks for, by the sizes that it states.

No single size is dear, but their products are: leaves times operations times the square of the symbols, cells times
corners times powers of the states. All of it is counted before anything is computed. This program is slower than what
the counts were measured with, and so takes fewer operations unless it is asked to be patient.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

from .document import Certificate
from .evidence import Covering, Ranked, Tree, Trusted
from .expressions import Equations
from .handover import gap
from .networks import Affine, Clip, Map, Network, Observe, Product, Step
from .rational import bits
from .refusal import require

MAX_NUMBERS = 2**25
AT_CORNERS = 6  # quantities whose corners are all asked
MAX_OPERATIONS, MAX_IN_PATIENCE = 2**34, 2**46  # the second where somebody has said that it may take days
LEAF = 255


def limits(c: Certificate, most: int | None = None) -> None:
    """Neither too many numbers at once, nor more operations than these (None: than this program takes)."""
    count, work = numbers(c), operations(c)
    if c.then is not None:
        count, work = count + numbers(c.then), work + operations(c.then) + handing_over(c)
    most = MAX_OPERATIONS if most is None else most
    require(count <= MAX_NUMBERS, "limits", "numbers", f"{count} numbers at once; the reference allows {MAX_NUMBERS}")
    more = f"; with --patient {MAX_IN_PATIENCE}" if most < work <= MAX_IN_PATIENCE else ""
    require(work <= most, "limits", "operations", f"{work} operations; the reference allows {most}{more}")


# ----------------------------------------------------------------------------------------------------------- the sizes


@dataclass(frozen=True)
class Nets:
    """Some networks: rows and columns of their steps with the units of the network before each.

    `units` are those of all of them, `widest` is the most entries of a vector, `read` counts the vectors that steps
    read, `waiting` the entries of those that a step reads which is not the next, by `widest`, `dear` the entries of
    functions that take long.
    """

    shapes: tuple[tuple[int, int, int], ...]
    units: int
    widest: int
    read: int
    waiting: int
    dear: int

    @property
    def weights(self) -> int:
        return sum(p * q for p, q, _ in self.shapes)

    @property
    def folding(self) -> int:
        """Operations that are done once with the weights."""
        return sum(p * q * (2**9 + 8 * min(p, q)) for p, q, _ in self.shapes)

    @property
    def paths(self) -> int:
        """The ways of errors to the value, once for many leaves."""
        return sum(p * g * (q + 3 * 2**6) for p, q, g in self.shapes) // 8

    def forms(self, leaves: int, symbols: int) -> int:
        """Affine forms on so many leaves."""
        each = sum(p * (q * (symbols + 2) + 5 * g + 64 * symbols + 7 * 2**9) for p, q, g in self.shapes)
        each += 2**15 * self.dear
        return leaves * each // 8

    def models(self, symbols: int) -> int:
        """A model for every entry, on one leaf."""
        return sum(p * (symbols + 4) ** 2 * (2 * q + 64) for p, q, _ in self.shapes)

    def tangents(self, d: int, t: int) -> int:
        """On one ball."""
        return sum(p * (q * (d + g) + g * t) + 2**21 for p, q, g in self.shapes) + 64 * self.units * t


def nets(called: Sequence[Network], *policy: Network) -> Nets:
    """The arguments of a call may be units of its network."""
    networks, arguments = (*policy, *called), [network.reads for network in called]
    shapes = [shape for network in policy for shape in shapes_of(network)]
    shapes += [(p, q, g + network.reads) for network in called for p, q, g in shapes_of(network)]
    steps = [(k, step) for network in networks for k, step in enumerate(network.steps)]
    units = sum(units_of(step) for _, step in steps) + sum(arguments)
    widest = max((size for network in networks for size in network.sizes), default=0)
    waiting = -(-sum(map(entries_waiting, networks)) // max(widest, 1))
    read = sum(len(step.of) for _, step in steps)
    dear = sum(step.size for _, step in steps if isinstance(step, Map) and step.function not in ("tanh", "relu"))
    return Nets(tuple(shapes), units, widest, read, waiting, dear)


def entries_waiting(network: Network) -> int:
    """The entries of vectors that a step reads which is not the next."""
    late = {i for k, step in enumerate(network.steps) for i in step.of if i != k}
    return sum(network.reads if i == 0 else network.steps[i - 1].size for i in late)


def units_of(step: Step) -> int:
    return step.size if isinstance(step, Map | Clip | Product | Observe) else 0


def shapes_of(network: Network) -> Iterator[tuple[int, int, int]]:
    """Entries and columns of each step, where another than `affine` has the vectors that it reads as columns, and the
    units before it. A map of what an affine step has just made belongs to that one."""
    units = 0
    for k, step in enumerate(network.steps):
        if isinstance(step, Affine):
            yield step.size, step.columns, units
        elif k == 0 or not isinstance(step, Map) or step.of[0] != k or not isinstance(network.steps[k - 1], Affine):
            yield step.size, len(step.of), units
        units += units_of(step)


def called(expressions: Equations) -> list[Network]:
    """The network of each call."""
    return [call.network for call in expressions.calls.values()]


def observing(*networks: Network) -> int:
    """Operations of the expressions in networks."""
    steps = (step for network in networks for step in network.steps)
    return sum(len(step.expressions.steps) for step in steps if isinstance(step, Observe))


@dataclass(frozen=True)
class Sizes:
    """Sizes in a file: `s` symbols on a leaf, `d` entries on a ball, `y` of what is uncertain, `a` operations.

    `z` are entries of calls, `nets` the policy's network and those of the calls.
    """

    n: int
    m: int
    z: int
    s: int
    d: int
    y: int
    a: int
    nets: Nets

    @property
    def t(self) -> int:
        """Numbers of a model on a ball."""
        return 2 * self.d**2 + self.d * (self.d + 1) * (self.d + 2) // 6


def sizes_of(c: Certificate) -> Sizes:
    f, policy = c.plant.dynamics, c.policy.network
    y, z, a = c.k + c.varies, f.entries, len(f.steps) + observing(policy, *called(f))
    a += sum(len(more.steps) for more in (c.keep, c.target) if more is not None)
    return Sizes(c.n, c.m, z, c.n + c.m + y + z, c.n + (c.claim == "reached"), y, a, nets(called(f), policy))


def asked_of_leaves(c: Certificate, evidence: Tree | Ranked | Covering) -> bool:
    return isinstance(evidence, Tree) and (evidence.ball is None or c.inner != c.outer)


def evaluations(c: Certificate, order: int) -> int:
    """Evaluations of the equations for a series in time."""
    return 1 if c.sample is None else 2 * order**3 + 8


# --------------------------------------------------------------------------------------------------------- the numbers


def numbers(c: Certificate) -> int:
    """An estimate of how many numbers are held at once."""
    z, evidence = sizes_of(c), c.evidence
    count, square = 4 * z.nets.weights, (z.s + 1) ** 2
    if isinstance(evidence, Trusted):
        return count
    ball, near = (evidence.ball, evidence.contraction) if isinstance(evidence, Tree) else (None, None)
    orders = (ball.order if ball else 1, near.order if near else 1)
    order = max(1 if isinstance(evidence, Covering) else evidence.order, *orders)
    values = values_held(c, z, order)
    if not isinstance(evidence, Covering) and evidence.ranking is not None:
        count += 2**4 * len(evidence.ranking.tree)
        count += held_on_leaves(with_errors(z, evidence.ranking.memory), values_held(c, z, evidence.order))
    if asked_of_leaves(c, evidence) or c.beyond is not None:
        count += held_on_leaves(z, values)
    if isinstance(evidence, Tree) and (ball or near or evidence.tube):
        count += values * (z.t + z.d * z.y + z.m + z.z) + z.d**4 // 4
        count += sum(4 * p * (z.d + g) for p, _, g in z.nets.shapes) + 3 * z.nets.units * z.t
    if c.data is not None and isinstance(evidence, Tree) and evidence.fit is not None:
        symbols = z.n + len(c.data.parameters)
        count += 4 * len(c.plant.dynamics.steps) * evidence.fit.order * (symbols + 1) ** 2
        count += 8 * c.data.steps * z.n * symbols
    if c.beyond is not None:
        N = c.beyond.expression
        over = nets(called(N))
        count += sum(4 * p * q + 2 * p * square for p, q, _ in over.shapes)
        count += 2**14 * (over.read + 8 * over.waiting * (z.s + 1))
        count += 8 * (len(N.steps) + observing(*called(N))) * square
    return count


def values_held(c: Certificate, z: Sizes, order: int) -> int:
    return z.a * (1 if c.sample is None else 4 * order) + 2 * z.n + 8


def held_on_leaves(z: Sizes, values: int) -> int:
    return values * (z.s + 1) ** 2 + 2**14 * (z.n + z.m + z.z + z.nets.read + 8 * z.nets.waiting * (z.s + z.m + z.z))


def with_errors(z: Sizes, memory: int) -> Sizes:
    """The same with a symbol more for each state and each step of the memory."""
    return replace(z, s=z.s + memory * z.n)


# ------------------------------------------------------------------------------------------------------ the operations


def operations(c: Certificate) -> int:
    """Elementary operations on numbers, in all."""
    z, evidence = sizes_of(c), c.evidence
    work = 2**15 * z.a + z.nets.folding
    if isinstance(evidence, Ranked):
        return work + in_ranks(c, z, evidence)
    if isinstance(evidence, Covering):
        return work + beyond(c, z, evidence)
    work += inverting(z.n, bits(c.P))
    if c.ends_at_origin:
        work += 2**12 * z.nets.weights + 2**19 * nets(called(c.plant.dynamics)).weights
    if not isinstance(evidence, Tree):
        return work
    of_S = min(2 * bits(evidence.T) + bits(c.P) + 16, 2**16 // z.n)
    work += inverting(z.n, of_S) + 2**8 * len(evidence.tree)
    if asked_of_leaves(c, evidence):
        leaves = evidence.tree.count(LEAF)
        work += models_on_leaves(c, z, leaves, evidence.order) + on_leaves(c, z, leaves, evidence.order)
    work += on_balls(c, z, evidence) + in_tube(c, z, evidence) + beyond(c, z, evidence.covering)
    return work + in_ranks(c, z, evidence) + of_data(c, z, evidence) + of_samples(c)


def models_on_leaves(c: Certificate, z: Sizes, leaves: int, order: int) -> int:
    models, calls = z.a * evaluations(c, order) + z.n**2 + 4 * z.n, z.n * z.s**2 + 160 * z.nets.read
    return on_boxes(leaves, z.n, models, z.a * (order + 1), z.s, calls)


def in_ranks(c: Certificate, z: Sizes, evidence: Tree | Ranked) -> int:
    """Operations for the leaves with ranks and all their steps."""
    ranking = evidence.ranking
    if ranking is None:
        return 0
    leaves, steps, wider = ranking.tree.count(LEAF), sum(ranking.steps), with_errors(z, ranking.memory)
    work = 2**9 * len(ranking.tree) + 2**17 * leaves
    work += 0 if ranking.frame is None else inverting(z.n, bits(ranking.frame))
    work += models_on_leaves(c, wider, steps + leaves, evidence.order)
    return work + on_leaves(c, wider, steps + leaves, evidence.order)


def of_data(c: Certificate, z: Sizes, evidence: Tree) -> int:
    """Operations for all transitions in each round, and for their bounds of each parameter."""
    data, fit = c.data, evidence.fit
    if data is None or fit is None:
        return 0
    a, count = len(c.plant.dynamics.steps), len(data.parameters)
    rounds = len(fit.rounds) + sum(map(len, fit.leaves)) + bool(data.axes)
    transitions = data.steps * rounds
    series, symbols = 1 if c.plant.discrete else 2 * fit.order**3 + 8, z.n + count
    work = on_boxes(transitions, z.n, fit.pieces * (a * series + 4 * z.n), a * (fit.order + 1), symbols, 0)
    work += 2**17 * rounds * fit.order * fit.pieces * (a + 4 * z.n)
    return work + 2**6 * max(count, len(data.axes)) * transitions * z.n * (symbols + 2**6)


def of_samples(c: Certificate) -> int:
    """Operations to expand the equations, and of each function for its weights and on its grid."""
    if c.samples is None:
        return 0
    work = 2**24 * len(c.plant.dynamics.steps)
    for f in c.samples.functions:
        d = len(f.variables)
        for weights in chain.from_iterable(f.weights):
            work += 2**3 * d * len(weights) * (2**11 * d + len(weights) * max(q.height_bits() for _, q in weights))
        if not f.slopes:
            b = max(q.height_bits() for axis in f.axes for q in axis)
            work += 2**12 * b * d * len(f.weights) + f.cells * (2**18 * b * d + 2 ** (d + 10))
    return work


def handing_over(c: Certificate) -> int:
    """Operations to decide that one ellipsoid lies in another; none where they do not have the same axes."""
    same = c.then is not None and c.then.n == c.n
    return inverting(c.n, min(bits(gap(c)), 2**16 // c.n)) if same else 0


def inverting(n: int, length: int) -> int:
    """A matrix of rationals."""
    return n**5 * length**2 // 2**13 + 2**10 * n**3


def deciding(n: int) -> int:
    """Operations to decide that a matrix is positive definite."""
    return 2**14 * n**3


def on_boxes(leaves: int, n: int, models: int, values: int, symbols: int, calls: int) -> int:
    """So many models, `values` of which are held, on leaves in n states; `calls` are those beside the models'."""
    square = (symbols + 4) ** 2
    each = 8 * square * models + square * (values + 4) * (32 * models + calls) // 2**9
    return leaves * (each + 2**11 + 2**7 * n + n**3)


def on_leaves(c: Certificate, z: Sizes, leaves: int, order: int) -> int:
    """All networks between affine forms; those of calls as often as the equations are evaluated."""
    once = z.nets.forms(leaves, z.s) + (1 + leaves * z.nets.widest // 2**14) * z.nets.paths
    return once * (evaluations(c, order) if z.z else 1)


def networks_on_a_ball(z: Sizes) -> int:
    return z.nets.tangents(z.d, z.t)


def equations_on_a_ball(z: Sizes) -> int:
    """Once, with the networks that they call."""
    calls = networks_on_a_ball(z) if z.z else 0
    return z.a * (2**17 + 64 * z.t + 16 * z.d**2 * (z.m + z.y + z.z)) + calls


def inequality(z: Sizes) -> int:
    rows = z.d + 1
    return 2**23 + 2**12 * rows**4 + 8 * z.d**5 + 4 * z.nets.units * z.d**3 + deciding(rows)


def on_balls(c: Certificate, z: Sizes, evidence: Tree) -> int:
    cells, work = math.prod(evidence.cells), 0
    once = networks_on_a_ball(z) + deciding(z.n)
    if evidence.ball is not None:
        times = cells + beside_cells(c, evidence.ball.order)
        each = inequality(z) + 2**8 * z.y * z.n * (z.d + 1) ** 2
        corners = cells * 2 ** min(z.y, AT_CORNERS)
        work += times * equations_on_a_ball(z) + once + corners * each
        work += on_cones(z, evidence.ball.directions, times, corners)
    if evidence.contraction is not None:
        times = cells + beside_cells(c, evidence.contraction.order)
        work += times * equations_on_a_ball(z) + once + cells * 2**z.y * inequality(z)
        work += on_cones(z, evidence.contraction.directions, times, cells * 2**z.y)
    return work


def beside_cells(c: Certificate, order: int) -> int:
    """Evaluations of the equations for what is the same in all cells."""
    return 0 if c.sample is None else evaluations(c, order) + 8


def on_cones(z: Sizes, directions: Sequence[bytes] | None, times: int, corners: int) -> int:
    """Models and inequalities on each cone, beside those on all of a ball."""
    if directions is None:
        return 0
    cones = sum(tree.count(LEAF) for tree in directions) if directions else 1
    each = inequality(z) + 2**8 * (z.y * z.n + z.nets.units) * (z.d + 1) ** 2
    once = networks_on_a_ball(z) + times * equations_on_a_ball(z)
    return cones * (once + corners * each) + 2**8 * sum(map(len, directions))


def in_tube(c: Certificate, z: Sizes, evidence: Tree) -> int:
    cells = math.prod(evidence.cells)
    once = inequality(z) + deciding(z.n) + 2**8 * z.y * z.n * (z.d + 1) ** 2
    each = networks_on_a_ball(z) + cells * (equations_on_a_ball(z) + 3 * 2 ** min(z.y, AT_CORNERS) * once)
    matrices = [P for slab in evidence.tube for P in (slab.middle, slab.end)]
    matrices += [] if c.start is None else [c.start]
    work: int = len(evidence.tube) * each + sum(inverting(z.n, bits(P)) for P in matrices)
    return work


def beyond(c: Certificate, z: Sizes, covering: Covering | None) -> int:
    """Operations for another function N, on the faces of the domain and on its own leaves."""
    if c.beyond is None or covering is None:
        return 0
    N = c.beyond.expression
    a, over = len(N.steps) + observing(*called(N)), nets(called(N))
    faces, leaves = sum(face.count(LEAF) for face in covering.faces), covering.tree.count(LEAF)
    held, calls = max(2 * a, over.widest), 200 * over.read
    work = over.folding + inverting(z.n, bits(covering.T))
    work += 2**8 * (len(covering.tree) + sum(map(len, covering.faces)))
    work += on_boxes(faces, z.n, a, held, z.n, calls) + faces * over.models(z.n)
    work += over.forms(faces + leaves, z.n + 1) + (1 + faces + leaves) * over.paths
    calls += z.n * z.s**2 + 160 * z.nets.read
    work += on_boxes(leaves, z.n, z.a + 8 * a + 4 * z.n, max(held, z.a), z.s, calls)
    return work + leaves * over.models(z.s) + on_leaves(c, z, leaves, 1)
