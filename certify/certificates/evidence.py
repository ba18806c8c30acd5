"""Evidence of a claim, which the checker replays, or a solver's word: as data and as a section of the file."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates.claims.claim import UNPROVED
from certify.certificates.encoding import decode, encode
from certify.certificates.tree import LEAF
from certify.errors import InputError

Array = NDArray[np.float64]
_OF_A_BALL = ("J", "multipliers", "weight")
_MOST_OF_A_BYTE = 255
_OF_A_PATH = ("share", "edge", "motion", "joint")


@dataclass(frozen=True, slots=True)
class LocalBall:
    """Evidence of the local proof: a ball x = J d, ||d|| <= 1, J (n, n), that contains {V <= c1}, and `multipliers`
    (3, n) of the matrix inequality on it with the `weight` (n, n) from which all others follow.

    `edge` is the multiplier of V - c0 of a practical claim, `order` that of the series in time of a sampled one.
    `directions` are trees of directions where relus and clips may have kinks on the ball (checker/FORMAT.md, kinks):
    none or 2 n, None where no kink is allowed.
    """

    J: Array
    multipliers: Array
    weight: Array
    edge: float = 0.0
    order: int = 1
    directions: tuple[bytes, ...] | None = None


@dataclass(frozen=True, slots=True)
class Contraction:
    """Evidence that trajectories come closer: a ball x = J d, ||d|| <= 1, J (n, n), that contains {V <= c0}, and the
    `weights` (n,) of one bound on it and the `weight` (n, n) of another; `directions` and `order` as a LocalBall has
    them, but without an order where no input is held."""

    J: Array
    weights: Array
    weight: Array
    directions: tuple[bytes, ...] | None = None
    order: int | None = None


@dataclass(frozen=True, slots=True)
class Waypoint:
    """The end of a slab of a tube around a path, and the numbers of its inequality beyond the multipliers.

    Parameters
    ----------
    centre : the centre of the slab's ellipsoids at its end, (n,); between its ends it moves on a line.
    share : the share of the slab's ball that its middle's motion takes, between 0 and 1.
    edge, motion, joint : multipliers of the tube's edge and of the motion, and the motion's entry of the third row.
    """

    centre: Array
    share: float
    edge: float
    motion: float
    joint: float


@dataclass(frozen=True, slots=True)
class Slab:
    """A piece of a tube, on which P(t) is a polynomial of degree 2 in Bernstein's form.

    Parameters
    ----------
    middle, end : its coefficients after that of the slab before, (n, n); the piece ends at {x'Px <= 1}, P = `end`.
    duration : units of time.
    J, multipliers, weight : a ball that contains it, (n, n), and what the matrix inequalities on it take, (3, n) and
        (k, k), k = n at rest and n + 1 along a path.
    path : None where the ellipsoids stay around the origin.
    """

    middle: Array
    end: Array
    duration: float
    J: Array
    multipliers: Array
    weight: Array
    path: Waypoint | None = None


@dataclass(frozen=True, slots=True)
class OuterTree:
    """Evidence of a claim's outer set: a partition of a box around the domain, and one of each of the domain's faces.

    Parameters
    ----------
    T, root : (n, n) and (n,), half-widths of the root box in z, x = T z.
    tree : the partition in preorder, one byte for each node.
    faces : the same for the lower and the upper end of each state, in the order of the states, 2 n in all.
    """

    T: Array
    root: Array
    tree: bytes
    faces: tuple[bytes, ...]


@dataclass(frozen=True, slots=True)
class RankTree:
    """Evidence of a claim's ranks: a partition of the box lo <= x <= hi.

    Parameters
    ----------
    lo, hi : (n,) each, the box's corners.
    tree : the partition in preorder, one byte for each node.
    ranks : (N,), of each leaf in the tree's order: from it the target, {V <= c2} or a region, is reached after so many
        steps at the latest, 0 within it, 65,535 where nothing is said.
    steps : (N,), of each leaf: after so many steps its image lies in leaves of lower ranks, or in the target.
    frame : N, (n, n), in whose coordinates N x errors of images are bounded; None: in those of the states.
    moving : they are bounded in directions that turn with them.
    memory : the steps for which errors of images stay symbols.

    Raises
    ------
    InputError : corners, ranks, steps and frame do not have shapes of one tree.
    """

    lo: Array
    hi: Array
    tree: bytes
    ranks: NDArray[np.uint16]
    steps: NDArray[np.uint16]
    frame: Array | None = None
    moving: bool = False
    memory: int = 1

    def __post_init__(self) -> None:
        found = self.tree.count(LEAF)
        if self.frame is not None and self.frame.shape != (len(self.lo), len(self.lo)):
            raise InputError(f"a frame must have the shape (n, n), n = {len(self.lo)}; found {self.frame.shape}.")
        if self.lo.shape != self.hi.shape or self.lo.ndim != 1 or {len(self.ranks), len(self.steps)} != {found}:
            raise InputError(
                f"a tree of ranks must have two corners of one length, and a rank and steps for each of its {found} "
                f"leaves; found {self.lo.shape}, {self.hi.shape}, {len(self.ranks)} and {len(self.steps)}."
            )

    @property
    def proved(self) -> NDArray[np.bool_]:
        """True for each leaf that has a rank, (N,)."""
        proved: NDArray[np.bool_] = self.ranks != UNPROVED
        return proved

    @property
    def most(self) -> int:
        """The highest rank; 0 if there is none."""
        return int(self.ranks[self.proved].max(initial=0))

    def without(self, dropped: NDArray[np.bool_]) -> RankTree:
        """The same without the ranks of some leaves, (N,)."""
        ranks = np.where(dropped, UNPROVED, self.ranks).astype(np.uint16)
        return replace(self, ranks=ranks, steps=np.where(dropped, 0, self.steps).astype(np.uint16))


@dataclass(frozen=True, slots=True)
class PartitionTree:
    """Evidence that the checker replays.

    Parameters
    ----------
    T, root : (n, n) and (n,), half-widths of the root box in z, x = T z.
    tree : the partition in preorder, one byte for each node.
    local : of the local proof; None where the claim has none.
    cells : into how many parts the range of each uncertain quantity is cut for it, in their order.
    tube : the slabs, in their order, of a claim that is enlarged by a tube.
    order : of the series in time on its leaves, where the input is held over a period.
    contraction : of a claim of a nearby equilibrium.
    outer : of a claim with an outer set.
    ranks : of a claim with ranks.
    """

    T: Array
    root: Array
    tree: bytes
    local: LocalBall | None = None
    tube: tuple[Slab, ...] = ()
    cells: tuple[int, ...] = ()
    order: int = 1
    contraction: Contraction | None = None
    outer: OuterTree | None = None
    ranks: RankTree | None = None


@dataclass(frozen=True, slots=True)
class RanksAlone:
    """Evidence of a claim without V: a tree of `ranks`; `order` is that of the series in time, where the input is held
    over a period."""

    ranks: RankTree
    order: int = 1


@dataclass(frozen=True, slots=True)
class TrustedSolver:
    """Evidence that cannot be replayed: what a solver answered. `queries` are pairs (name, answer)."""

    solver: str
    version: str
    precision: float
    queries: tuple[tuple[str, str], ...]


def evidence_section(evidence: PartitionTree | TrustedSolver | RanksAlone | OuterTree) -> dict[str, Any]:
    if isinstance(evidence, OuterTree):
        return {"kind": "outer", "outer": _outer_tree(evidence)}
    if isinstance(evidence, RanksAlone):
        return {"kind": "ranks", "order": evidence.order, "ranks": _rank_tree(evidence.ranks)}
    if isinstance(evidence, PartitionTree):
        return {
            "kind": "partition-tree",
            "T": encode(evidence.T),
            "root": encode(evidence.root),
            "tree": base64.b64encode(evidence.tree).decode("ascii"),
            "cells": list(evidence.cells),
            "order": evidence.order,
            "local": None if evidence.local is None else _local(evidence.local),
            "contraction": None if evidence.contraction is None else _contraction(evidence.contraction),
            "tube": [
                {"middle": encode(slab.middle), "end": encode(slab.end), "duration": float(slab.duration).hex()}
                | _ball(slab)
                | {"path": None if slab.path is None else _path(slab.path)}
                for slab in evidence.tube
            ],
            "outer": None if evidence.outer is None else _outer_tree(evidence.outer),
        } | ({} if evidence.ranks is None else {"ranks": _rank_tree(evidence.ranks)})
    return {
        "kind": "trusted-solver",
        "solver": evidence.solver,
        "version": evidence.version,
        "precision": float(evidence.precision).hex(),
        "queries": [list(pair) for pair in evidence.queries],
    }


def read_evidence(data: Mapping[str, Any], n: int) -> PartitionTree | TrustedSolver:
    if data["kind"] == "partition-tree":
        root, local = decode(data["root"], (n,)), data["local"]
        return PartitionTree(
            decode(data["T"], (n, n)),
            root,
            base64.b64decode(data["tree"]),
            None if local is None else _read_local(local, n),
            tuple(
                Slab(
                    decode(slab["middle"], (n, n)),
                    decode(slab["end"], (n, n)),
                    float.fromhex(slab["duration"]),
                    *_read_ball(slab, n, n + (slab["path"] is not None)),
                    None if slab["path"] is None else _read_path(slab["path"], n),
                )
                for slab in data["tube"]
            ),
            tuple(map(int, data["cells"])),
            int(data["order"]),
            None if data["contraction"] is None else _read_contraction(data["contraction"], n),
            None if data["outer"] is None else _read_outer_tree(data["outer"], n),
            _read_rank_tree(data["ranks"], n) if "ranks" in data else None,
        )
    queries = tuple((str(name), str(answer)) for name, answer in data["queries"])
    return TrustedSolver(str(data["solver"]), str(data["version"]), float.fromhex(data["precision"]), queries)


def read_ranks_alone(data: Mapping[str, Any], n: int) -> RanksAlone:
    if data["kind"] != "ranks":
        raise ValueError(f"evidence of this claim must be of kind 'ranks'; found {data['kind']!r}")
    return RanksAlone(_read_rank_tree(data["ranks"], n), int(data["order"]))


def read_outer_alone(data: Mapping[str, Any], n: int) -> OuterTree:
    if data["kind"] != "outer":
        raise ValueError(f"evidence of this claim must be of kind 'outer'; found {data['kind']!r}")
    return _read_outer_tree(data["outer"], n)


def _outer_tree(evidence: OuterTree) -> dict[str, Any]:
    tree, *faces = (base64.b64encode(nodes).decode("ascii") for nodes in (evidence.tree, *evidence.faces))
    return {"T": encode(evidence.T), "root": encode(evidence.root), "tree": tree, "faces": faces}


def _read_outer_tree(data: Mapping[str, Any], n: int) -> OuterTree:
    tree, *faces = (base64.b64decode(nodes) for nodes in (data["tree"], *data["faces"]))
    return OuterTree(decode(data["T"], (n, n)), decode(data["root"], (n,)), tree, tuple(faces))


def _rank_tree(evidence: RankTree) -> dict[str, Any]:
    size = "<u2" if evidence.steps.max(initial=0) > _MOST_OF_A_BYTE else "u1"
    numbers = {"ranks": evidence.ranks.astype("<u2").tobytes(), "steps": evidence.steps.astype(size).tobytes()}
    parts = {"tree": evidence.tree, **numbers}
    others: dict[str, Any] = {} if evidence.frame is None else {"frame": encode(evidence.frame)}
    others |= {"moving": True} if evidence.moving else {}
    others |= {} if evidence.memory == 1 else {"memory": evidence.memory}
    corners = {"lo": encode(evidence.lo), "hi": encode(evidence.hi)}
    return corners | others | {name: base64.b64encode(part).decode("ascii") for name, part in parts.items()}


def _read_rank_tree(data: Mapping[str, Any], n: int) -> RankTree:
    tree, ranks, steps = (base64.b64decode(data[name]) for name in ("tree", "ranks", "steps"))
    corners = decode(data["lo"], (n,)), decode(data["hi"], (n,))
    frame = decode(data["frame"], (n, n)) if "frame" in data else None
    size = "<u2" if len(steps) == len(ranks) else "u1"
    of_leaves = np.frombuffer(ranks, "<u2").astype(np.uint16), np.frombuffer(steps, size).astype(np.uint16)
    return RankTree(*corners, tree, *of_leaves, frame, "moving" in data, data.get("memory", 1))


def _ball(evidence: LocalBall | Slab) -> dict[str, str]:
    return {name: encode(getattr(evidence, name)) for name in _OF_A_BALL}


def _contraction(ball: Contraction) -> dict[str, Any]:
    order = {} if ball.order is None else {"order": ball.order}
    return {name: encode(getattr(ball, name)) for name in ("J", "weights", "weight")} | order | _directions(ball)


def _read_contraction(data: Mapping[str, Any], n: int) -> Contraction:
    arrays = decode(data["J"], (n, n)), decode(data["weights"], (n,)), decode(data["weight"], (n, n))
    return Contraction(*arrays, _read_directions(data), data.get("order"))


def _directions(ball: LocalBall | Contraction) -> dict[str, Any]:
    if ball.directions is None:
        return {}
    return {"directions": [base64.b64encode(tree).decode("ascii") for tree in ball.directions]}


def _read_directions(data: Mapping[str, Any]) -> tuple[bytes, ...] | None:
    return tuple(map(base64.b64decode, data["directions"])) if "directions" in data else None


def _local(ball: LocalBall) -> dict[str, Any]:
    return {**_ball(ball), "edge": float(ball.edge).hex(), "order": ball.order, **_directions(ball)}


def _read_local(data: Mapping[str, Any], n: int) -> LocalBall:
    return LocalBall(*_read_ball(data, n, n), float.fromhex(data["edge"]), int(data["order"]), _read_directions(data))


def _read_ball(data: Mapping[str, str], n: int, k: int) -> tuple[Array, Array, Array]:
    """k is how many entries d has."""
    J, multipliers, weight = (data[name] for name in _OF_A_BALL)
    return decode(J, (n, n)), decode(multipliers, (3, n)), decode(weight, (k, k))


def _path(path: Waypoint) -> dict[str, str]:
    numbers = {name: float(getattr(path, name)).hex() for name in _OF_A_PATH}
    return {"centre": encode(path.centre), **numbers}


def _read_path(data: Mapping[str, str], n: int) -> Waypoint:
    return Waypoint(decode(data["centre"], (n,)), *(float.fromhex(data[name]) for name in _OF_A_PATH))
