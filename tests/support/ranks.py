"""Certificates with ranks and constraints, made by hand: a search in floats over a uniform tree.

The claim about {V <= c2} is that of a run; the leaves, their ranks and the constraints are put beside it here, with
images of leaves that are affine with an error.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from certify import certify_roa
from certify.certificates import Certificate, PartitionTree, RankTree, leaves_within, parse_certificate
from certify.certificates.claims import UNPROVED, Ranks
from certify.loop.expressions import Number, sin, symbols
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from tests.support.loops import box

Array = NDArray[np.float64]
Image = Callable[[Array, Array], tuple[Array, Array]]
"""Of centres and half-widths (N, 2): those of boxes that contain the images after `STEPS` steps."""
STEPS = 5


def linear_plant() -> tuple[System, PolicyNetwork]:
    """x+ = (4 x + y)/5 + u, y+ = (4 y - x)/5 with u = -x/5, which shrinks every state; with constraints."""
    x, y, u = symbols("x y u")
    system = System(
        name="shrinking",
        states=(x, y),
        inputs=(u,),
        parameters={},
        dynamics=((4 * x + y) / 5 + u, (4 * y - x) / 5),
        u_eq=(Number(0),),
        domain=box(4, 4),
        input_bounds=box(2),
        time="discrete",
        units={"x": "m", "y": "m/s", "u": "N"},
        constraints={"wall": x - Number(5), "force": u * u - Number(1)},
    )
    weights, zeros = (np.array([[-0.2, 0.0]]),), (np.zeros(1),)
    return system, PolicyNetwork.of_layers(weights, zeros, np.ones(1), np.zeros(1), "identity", "none")


def linear_image(centre: Array, radius: Array) -> tuple[Array, Array]:
    """The image of boxes (N, 2) under five steps of the linear loop, and its half-widths."""
    A = np.linalg.matrix_power(np.array([[0.6, 0.2], [-0.2, 0.8]]), STEPS)
    return centre @ A.T, radius @ np.abs(A).T


def hanging() -> tuple[System, PolicyNetwork]:
    """A pendulum that hangs, with friction, in Euler steps of a tenth; the policy gives no torque. Upright it stays."""
    theta, omega, u = symbols("theta omega u")
    system = System(
        name="hanging",
        states=(theta, omega),
        inputs=(u,),
        parameters={},
        dynamics=(theta + omega / 10, omega + (u - 3 * sin(theta) - 3 * omega) / 10),
        u_eq=(Number(0),),
        domain=box(4, 7),
        input_bounds=box(1),
        time="discrete",
        units={"theta": "rad", "omega": "rad/s"},
        angles=("theta",),
    )
    weights, zeros = (np.zeros((1, 2)),), (np.zeros(1),)
    return system, PolicyNetwork.of_layers(weights, zeros, np.ones(1), np.zeros(1), "identity", "none")


def hanging_image(centre: Array, radius: Array) -> tuple[Array, Array]:
    """The image of boxes (N, 2) under five steps of the hanging pendulum, and its half-widths: by tangents, and the
    second derivative of the sine.
    """
    middle, A, error = centre, np.broadcast_to(np.eye(2), (len(centre), 2, 2)), np.zeros_like(centre)
    for _ in range(STEPS):
        theta, omega = middle.T
        J = np.zeros((len(centre), 2, 2))
        J[:, 0, 0], J[:, 0, 1], J[:, 1, 0], J[:, 1, 1] = 1, 0.1, -0.3 * np.cos(theta), 0.7
        wide = (np.einsum("kij,kj->ki", np.abs(A), radius) + error)[:, 0]
        error = np.einsum("kij,kj->ki", np.abs(J), error) + np.stack([0 * wide, 0.15 * wide**2], -1)
        middle, A = np.stack([theta + omega / 10, 0.7 * omega - 0.3 * np.sin(theta)], -1), J @ A
    return middle, np.einsum("kij,kj->ki", np.abs(A), radius) + error


@cache
def base(name: str) -> Certificate:
    """The certificate of a run, without ranks."""
    (system, network), level = {"linear": (linear_plant(), 3.0), "hanging": (hanging(), 10.0)}[name]
    raw = certify_roa(replace(system, constraints={}, angles=()), network, level=level).raw
    assert raw is not None
    return parse_certificate(raw, name)


@cache
def linear(depth: int = 8, keep: bool = True) -> Certificate:
    """The linear loop with ranks on the box |x|, |y| <= 3.75 and its two constraints."""
    system, _ = linear_plant()
    corner = np.full(2, 3.75)
    return with_ranks(base("linear"), system, linear_image, -corner, corner, depth, keep)


@cache
def pendulum(depth: int = 10) -> Certificate:
    """The hanging pendulum with ranks on a box that is longer than a turn."""
    system, _ = hanging()
    corner = np.array([3.25, 6.5])
    return with_ranks(base("hanging"), system, hanging_image, -corner, corner, depth, keep=False)


def with_ranks(
    made: Certificate, system: System, image: Image, lo: Array, hi: Array, depth: int, keep: bool
) -> Certificate:
    """A certificate with a uniform tree of ranks of 2^depth leaves and, with `keep`, the plant's constraints."""
    assert isinstance(made.evidence, PartitionTree)
    tree = uniform(depth, len(lo))
    turned = [s.name in system.angles for s in system.states]
    ranks = search(made, image, lo, hi, tree, turned)
    steps = np.where((ranks > 0) & (ranks != UNPROVED), STEPS, 0).astype(np.uint16)
    evidence = replace(made.evidence, ranks=RankTree(lo, hi, tree, ranks, steps))
    most = int(ranks[ranks != UNPROVED].max())
    kept = tuple(system.uncertain_constraints().values()) if keep else ()
    claim = replace(made.claim, ranks=Ranks(system.angles, most), keep=kept)
    plant = replace(made.system, angles=system.angles, constraints=system.constraints, units=system.units)
    return replace(made, system=plant, claim=claim, evidence=evidence)


def uniform(depth: int, n: int) -> bytes:
    """A tree that splits all axes in turn."""
    return bytes([255]) if depth == 0 else _level(depth, 0, n)


def _level(depth: int, axis: int, n: int) -> bytes:
    below = bytes([255]) if depth == 1 else _level(depth - 1, (axis + 1) % n, n)
    return bytes([axis]) + below + below


def search(
    made: Certificate, image: Image, lo: Array, hi: Array, tree: bytes, turned: list[bool]
) -> NDArray[np.uint16]:
    """The ranks of a uniform tree of two states, one round after the other: of a leaf whose image lies in {V <= c2}, or
    in leaves of lower ranks.
    """
    lower, upper = leaves_within(tree, lo, hi)
    centre, radius = (lower + upper) / 2, (upper - lower) / 2
    middle, reach = image(centre, radius)
    reach = reach + 1e-9
    ranks = np.full(len(lower), UNPROVED, dtype=np.uint16)
    ranks[_highest(made.P, centre, radius) <= made.roa * (1 - 1e-9)] = 0
    at_once = _highest(made.P, middle, reach) <= made.roa * (1 - 1e-9)
    edges = [np.append(np.unique(lower[:, i]), hi[i]) for i in range(2)]
    cells = np.stack([np.searchsorted(edges[i], centre[:, i]) - 1 for i in range(2)])
    pieces = [_turned(middle, reach, lo, hi, i) if turned[i] else [_whole(middle, reach, i)] for i in range(2)]
    for rank in range(STEPS, 400 * STEPS, STEPS):
        bad = np.zeros([len(e) - 1 for e in edges], dtype=np.int64)
        bad[tuple(cells)] = ranks == UNPROVED
        table = np.pad(bad.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
        leads = np.ones(len(ranks), dtype=np.bool_)
        for first, second in itertools.product(*pieces):
            leads &= _all_ranked(table, edges, (first, second))
        new = (ranks == UNPROVED) & (leads | at_once if rank == STEPS else leads)
        if not np.any(new):
            break
        ranks[new] = rank
    return ranks


def _whole(middle: Array, reach: Array, i: int) -> tuple[Array, Array]:
    return middle[:, i] - reach[:, i], middle[:, i] + reach[:, i]


def _turned(middle: Array, reach: Array, lo: Array, hi: Array, i: int) -> list[tuple[Array, Array]]:
    """Intervals of an angle that cover the box, turned into [lo, hi]; where one is not needed, the same twice."""
    w = 2 * np.pi * np.round(((lo + hi) / 2)[i] / (2 * np.pi) - middle[:, i] / (2 * np.pi))
    a, b = (end + w for end in _whole(middle, reach, i))
    under, over = a < lo[i], b > hi[i]
    near = np.where(under, lo[i], a), np.where(over, hi[i], b)
    far = (
        np.where(under, a + 2 * np.pi - 1e-9, np.where(over, lo[i], near[0])),
        np.where(under, hi[i], np.where(over, b - 2 * np.pi + 1e-9, near[1])),
    )
    return [near, far]


def _all_ranked(
    table: NDArray[np.int64], edges: list[Array], box: tuple[tuple[Array, Array], ...]
) -> NDArray[np.bool_]:
    """True for each box that lies in the root and meets leaves of finite rank only, edges included."""
    inside, ends = np.ones(len(box[0][0]), dtype=np.bool_), []
    for e, (a, b) in zip(edges, box, strict=True):
        inside &= (a >= e[0]) & (b <= e[-1])
        first, last = np.searchsorted(e[1:], a, "left"), np.searchsorted(e[:-1], b, "right")
        ends.append((np.clip(first, 0, len(e) - 1), np.clip(last, 0, len(e) - 1)))
    (p, q), (r, s) = ends
    return np.asarray(inside & (table[q, s] - table[p, s] - table[q, r] + table[p, r] == 0))


def _highest(P: Array, centre: Array, radius: Array) -> Array:
    """The largest x'Px on boxes, which a corner has."""
    signs = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    at = centre[:, None] + signs * radius[:, None]
    return np.asarray(np.einsum("kci,ij,kcj->kc", at, P, at).max(axis=1))
