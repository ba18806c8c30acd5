"""Sums of rule `limits` for what only some have: outer, ranks, data, samples, a tube, a second certificate."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from math import prod

from .case import AT_CORNERS
from .document import Certificate, Partition
from .limits import LEAF, Net, Sizes


def numbers(sizes: Sizes) -> int:
    """Held at once."""
    return of_function(sizes) + of_following(sizes) + of_measured(sizes)


def work(sizes: Sizes) -> int:
    """Elementary operations."""
    return of_ranks(sizes) + of_outer(sizes) + of_data(sizes) + of_samples(sizes) + of_tube(sizes) + of_balls(sizes)


def of_function(sizes: Sizes) -> int:
    """Numbers for N and the loop on leaves of its tree."""
    if sizes.c.outer is None:
        return 0
    tape, area = sizes.c.outer.function, (sizes.s + 1) ** 2
    N, of_tape = Net(tape.called), tape.size
    found = 4 * N.entries + sum(2 * rows * area for rows, *_ in N.steps) + 8 * of_tape * area
    return found + N.held_on_leaves(sizes.s + 1) + sizes.on_leaves(1, sizes.s)


def of_following(sizes: Sizes) -> int:
    """Numbers for leaves that are followed by steps."""
    if sizes.c.ranks is None:
        return 0
    return 2**4 * len(sizes.c.ranks.tree) + sizes.on_leaves(
        sizes.c.ranks.order, sizes.s + sizes.c.ranks.memory * sizes.n
    )


def of_measured(sizes: Sizes) -> int:
    """Numbers for transitions that are followed."""
    data = sizes.c.data
    if data is None:
        return 0
    symbols = sizes.n + len(data.parameters)
    return sizes.c.dynamics.size * 4 * data.order * (symbols + 1) ** 2 + 8 * data.transitions * sizes.n * symbols


def of_ranks(sizes: Sizes) -> int:
    """Steps from leaves, and the leaves that their images meet."""
    ranks = sizes.c.ranks
    if ranks is None:
        return 0
    leaves = len(ranks.steps)
    of_all = sizes.of_leaves(leaves + sum(ranks.steps), ranks.order, sizes.s + ranks.memory * sizes.n)
    of_frame = 0 if ranks.frame is None else sizes.inverse(sizes.bits(ranks.frame))
    return 2**9 * len(ranks.tree) + 2**17 * leaves + of_frame + of_all


def of_data(sizes: Sizes) -> int:
    """Transitions, and sums of them, in all rounds."""
    data = sizes.c.data
    if data is None:
        return 0
    rounds = len(data.rounds) + sum(map(len, data.leaves))
    rounds += data.turned is not None
    k, followed, a = len(data.parameters), rounds * data.transitions, sizes.c.dynamics.size
    times = 2 * data.order**3 + 8 if data.period else 1
    models = data.pieces * (a * times + 4 * sizes.n)
    found = sizes.boxes(followed, models, a * (data.order + 1), sizes.n + k, 0)
    found += 2**6 * max(k, len(data.axes)) * followed * sizes.n * (sizes.n + k + 2**6)
    return found + 2**17 * rounds * data.order * data.pieces * (a + 4 * sizes.n)  # however few transitions are left


def of_samples(sizes: Sizes) -> int:
    """Equations as polynomials, weighted samples, and what polynomials may be off by on cells."""
    samples, found = sizes.c.samples, 0
    if samples is None:
        return 0
    for f in samples.functions:
        d = len(f.variables)
        for weights in chain(*f.weights):
            count, bits = len(weights), max(v.height_bits() for _, v in weights)
            found += 2**3 * d * count * (2**11 * d + count * bits)
        if not f.slopes:
            bits, cells = max(q.height_bits() for axis in f.axes for q in axis), prod(len(axis) - 1 for axis in f.axes)
            found += 2**12 * bits * d * len(f.weights) + cells * (2**18 * bits * d + 2 ** (d + 10))
    return found + 2**24 * len(sizes.c.dynamics.operations)


def of_handover(sizes: Sizes, then: Certificate) -> int:
    """The inequality of two matrices."""
    if len(then.states) != sizes.n:
        return 0
    from .handover import difference

    numerators, _ = difference(sizes.c, then).numer_denom()
    return sizes.inverse(min(max(v.height_bits() for v in numerators.entries()), 2**16 // sizes.n))


def of_tube(sizes: Sizes) -> int:
    tube = sizes.c.tube
    if tube is None:
        return 0
    cells = prod(sizes.evidence.cells) if isinstance(sizes.evidence, Partition) else 1
    corners: int = 3 * cells * 2 ** min(sizes.y, AT_CORNERS)
    of_each = sizes.inequality + sizes.decision(sizes.n) + 2**8 * sizes.y * sizes.n * (sizes.d + 1) ** 2
    of_each = sizes.ball + cells * sizes.equations + corners * of_each
    nodes = [tube.start, *(P for slab in tube.slabs for P in (slab.middle, slab.end))]
    found: int = len(tube.slabs) * of_each + sum(sizes.inverse(sizes.bits(P)) for P in nodes)
    return found


def of_balls(sizes: Sizes) -> int:
    """The rule `contraction`, and cones of both balls."""
    evidence, close, found = sizes.evidence, sizes.c.contraction, 0
    if not isinstance(evidence, Partition):
        return 0
    cells = prod(evidence.cells)
    if evidence.local is not None:
        times, corners = sizes.times(evidence, evidence.local.order), cells * 2 ** min(sizes.y, AT_CORNERS)
        found += of_cones(sizes, evidence.local.directions, times, corners)
    if close is not None:
        times, corners = sizes.times(evidence, close.order), cells * 2**sizes.y
        found += sizes.ball + times * sizes.equations + corners * sizes.inequality + sizes.decision(sizes.n)
        found += of_cones(sizes, close.directions, times, corners)
    return found


def of_cones(sizes: Sizes, directions: Sequence[bytes] | None, times: int, corners: int) -> int:
    """Models, for which the equations are evaluated so many times, and inequalities on cones."""
    if directions is None:
        return 0
    leaves = max(1, sum(tree.count(LEAF) for tree in directions))
    each = sizes.inequality + 2**8 * (sizes.y * sizes.n + sizes.net.units) * (sizes.d + 1) ** 2
    return leaves * (sizes.ball + times * sizes.equations + corners * each) + 2**8 * sum(map(len, directions))


def of_outer(sizes: Sizes) -> int:
    evidence = sizes.c.outer
    if evidence is None:
        return 0
    tape = evidence.function
    N, of_tape = Net(tape.called), tape.size
    calls, values = 200 * N.reads, max(N.widest, 2 * of_tape)
    faces, leaves = sum(tree.count(LEAF) for tree in evidence.faces), evidence.tree.count(LEAF)
    found = N.folded + sizes.inverse(sizes.bits(evidence.T))
    found += 2**8 * sum(map(len, (evidence.tree, *evidence.faces)))
    found += sizes.boxes(faces, of_tape, values, sizes.n, calls) + faces * N.models((sizes.n + 4) ** 2)
    found += (faces + leaves) * N.on_a_leaf(sizes.n + 1) // 8 + (1 + faces + leaves) * N.paths
    models, calls = sizes.a + 8 * of_tape + 4 * sizes.n, calls + sizes.n * sizes.s**2 + 160 * sizes.net.reads
    found += sizes.boxes(leaves, models, max(values, sizes.a), sizes.s, calls)
    return found + leaves * N.models((sizes.s + 4) ** 2) + sizes.policies(leaves, 1, sizes.s)
