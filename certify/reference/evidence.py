"""Rule `format` for the section `evidence`, which saves the rules a search.

Nothing here is trusted: a ball that is too small, a negative multiplier or a duration of 0 has the form of a
certificate, and is rejected by the rule that uses it.
"""

from __future__ import annotations

import math
import re
from array import array
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from flint import fmpq_mat

from .fields import binary64, column, decoded, entries, keys, numbers, square
from .refusal import require

MAX_SLABS = 10**4
MAX_PARTS, MAX_CELLS = 64, 4096  # of one range; of all of them together
MAX_ORDER = 8  # of a series in time
MAX_MEMORY = 16  # steps after which errors of images have no symbols any more
MAX_PIECES, MAX_ROUNDS, MAX_LEAVES = 64, 64, 4096  # of a measured transition; of bounds from all of them; of priors
WITH_TUBE = ("enlarged", "reached")  # claims about a set of starts that is no level set of V
REACHES, REMAINS, INVARIANT = "reaches", "remains", "invariant"
WITHOUT_V = (REACHES, REMAINS, INVARIANT)
WITH_FLOOR = ("practical", "nearby")  # claims about a set in which everything ends, {V <= c0}, and not the origin
WORD = re.compile(r"[A-Za-z0-9_.+-]{1,80}")


@dataclass(frozen=True)
class Ball:
    """All x = J d with ||d|| <= 1, and the rows of multipliers with which `decrease` is decided on it.

    In a slab with a path g has one more number than the others, for the motion, and `weight` a row and a column more.
    `edge` is the multiplier of V - c0 where the claim has a floor, `order` that of the series in time with a sample.
    `directions` are trees of cones of d, of which none stands for all d; None where kinks have no models.
    """

    J: fmpq_mat
    alpha: array[float]
    beta: array[float]
    g: array[float]
    weight: fmpq_mat
    edge: float = 0.0
    order: int = 1
    directions: tuple[bytes, ...] | None = None


@dataclass(frozen=True)
class Contraction:
    """All x = J d with ||d|| <= 1, where any two trajectories approach each other.

    The weights g and `weight` select one of many bounds; `directions` are those of a ball, `order` is that of the
    series in time.
    """

    J: fmpq_mat
    weights: array[float]
    weight: fmpq_mat
    directions: tuple[bytes, ...] | None = None
    order: int = 1


@dataclass(frozen=True)
class Path:
    """The ellipsoids of a slab move in a straight line, and their last one lies around `centre`, a column.

    Of the ball that has to hold them the motion takes `share`; `edge` and `motion` are multipliers.
    """

    centre: fmpq_mat
    share: float
    edge: float
    motion: float


@dataclass(frozen=True)
class Slab:
    """A slab of a tube: from one node by `middle` to the next, `end`, in time `duration`; around 0 without a path."""

    middle: fmpq_mat
    end: fmpq_mat
    duration: float
    ball: Ball
    path: Path | None


@dataclass(frozen=True)
class Covering:
    """Trees over all of the domain, in coordinates x = T z, and over each of its faces; of some claims they are all."""

    T: fmpq_mat
    root: array[float]
    tree: bytes
    faces: tuple[bytes, ...]


@dataclass(frozen=True)
class Ranking:
    """A tree over the box from `lo` to `hi`, whose leaves have two bytes of `ranks` each and one or two of `steps`.

    Errors of images are bounded after the matrix `frame`, turned along with them if `moving`, and have symbols of their
    own for `memory` steps.
    """

    lo: array[float]
    hi: array[float]
    frame: fmpq_mat | None
    moving: bool
    memory: int
    tree: bytes
    ranks: bytes
    steps: bytes


@dataclass(frozen=True)
class Round:
    """A box (2, K) that measurements leave of another one, by these multipliers, (2, K, T, n)."""

    box: array[float]
    weights: array[float]


@dataclass(frozen=True)
class Fit:
    """Rounds for each leaf of a tree over the priors, and for all that they leave; where there are axes, `turned` has
    the multipliers of these.

    A transition is followed in `pieces` series of this order.
    """

    order: int
    pieces: int
    tree: bytes
    leaves: tuple[tuple[Round, ...], ...]
    rounds: tuple[Round, ...]
    turned: array[float] | None


@dataclass(frozen=True)
class Tree:
    """Evidence that can be replayed. `tube` belongs to claims that have a start, `contraction` to `nearby`.

    `covering`, which is `outer` in the file, belongs to claims that go beyond {V <= c2} by another function, `ranking`,
    which is `ranks`, to those that go beyond it by ranks of boxes, `fit`, which is `data`, to those with data.

    Claims that have a floor may do without a `ball`.
    `cells` has a number for each uncertain quantity: into how many equal parts rule `local` cuts its range. `order` is
    that of the series in time on leaves.
    """

    T: fmpq_mat
    root: array[float]
    tree: bytes
    order: int
    cells: tuple[int, ...]
    ball: Ball | None
    contraction: Contraction | None
    tube: tuple[Slab, ...]
    covering: Covering | None
    ranking: Ranking | None
    fit: Fit | None


@dataclass(frozen=True)
class Ranked:
    """Evidence for a claim that a region is reached or boxes are never left, that can be replayed as well."""

    order: int
    ranking: Ranking


@dataclass(frozen=True)
class Trusted:
    """Evidence that cannot."""

    solver: str
    version: str


class Fitted(NamedTuple):
    """Numbers of `parameters`, of `measured` states at the ends of transitions, and of `axes`."""

    parameters: int
    measured: int
    discrete: bool
    axes: int


def read_evidence(
    value: Any,
    n: int,
    k: int,
    claim: str,
    sampled: bool,
    further: bool,
    ranked: bool,
    fitted: Fitted | None,
    held: bool,
    functions: bool = False,
) -> Tree | Ranked | Covering | Trusted:
    """`sampled` says whether a series in time may have an order above 1, `further` whether the claim has an `outer`,
    `ranked` whether it has `ranks`, `held` whether inputs are, `functions` whether some are sampled; `fitted` is there
    with `data`."""
    if claim in (REACHES, REMAINS):
        return read_ranked(value, n, claim, sampled)
    if claim == INVARIANT:
        alone = keys(value, "evidence", "kind", "outer")
        require(alone["kind"] == "outer", "format", "evidence.kind", f"'outer' was expected with claim '{claim}'")
        return read_covering(alone["outer"], n)
    if isinstance(value, dict) and value.get("kind") == "trusted-solver":
        said = claim not in (*WITH_TUBE, "nearby")
        require(said, "format", "evidence.kind", f"claim '{claim}' must be replayed")
        require(k == 0, "format", "evidence.kind", "what is uncertain must be replayed")
        return read_trusted(value)
    names = ("kind", "T", "root", "tree", "order", "cells", "local", "contraction", "tube", "outer")
    further_names = (
        *(("ranks",) if ranked else ()),
        *(("data",) if fitted else ()),
        *(("samples",) if functions else ()),
    )
    evidence = keys(value, "evidence", *names, *further_names)
    require(evidence["kind"] == "partition-tree", "format", "evidence.kind", "an unknown kind")
    T, root = square(evidence["T"], "evidence.T", n), numbers(evidence["root"], "evidence.root", n)
    tree = decoded(evidence["tree"], "evidence.tree")
    order = read_order(evidence["order"], "evidence.order", sampled)
    cells = read_cells(evidence["cells"], "evidence.cells", k)
    ball = None
    if claim not in WITH_FLOOR or evidence["local"] is not None:
        ball = read_local(evidence["local"], n, claim, sampled)
    contraction = read_contraction(evidence["contraction"], n, claim, held, sampled)
    tube = entries(evidence["tube"], "evidence.tube")
    least, most = (1, MAX_SLABS) if claim in WITH_TUBE else (0, 0)
    fits = least <= len(tube) <= most
    require(fits, "format", "evidence.tube", f"{least} to {most} slabs are allowed with claim '{claim}'")
    moves = claim == "reached"
    slabs = tuple(read_slab(v, f"evidence.tube.{k}", n, moves) for k, v in enumerate(tube))
    none = further or evidence["outer"] is None
    require(none, "format", "evidence.outer", "null was expected, which claim.outer is")
    covering = read_covering(evidence["outer"], n) if further else None
    ranking = read_ranking(evidence["ranks"], n) if ranked else None
    fit = read_fit(evidence["data"], fitted) if fitted else None
    return Tree(T, root, tree, order, cells, ball, contraction, slabs, covering, ranking, fit)


def read_ranked(value: Any, n: int, claim: str, sampled: bool) -> Ranked:
    evidence = keys(value, "evidence", "kind", "order", "ranks")
    require(evidence["kind"] == "ranks", "format", "evidence.kind", f"'ranks' was expected with claim '{claim}'")
    return Ranked(read_order(evidence["order"], "evidence.order", sampled), read_ranking(evidence["ranks"], n))


def read_ranking(value: Any, n: int) -> Ranking:
    at = "evidence.ranks"
    ranking = keys(value, at, "lo", "hi", "tree", "ranks", "steps", maybe=("frame", "moving", "memory"))
    lo, hi = (numbers(ranking[end], f"{at}.{end}", n) for end in ("lo", "hi"))
    frame = square(ranking["frame"], f"{at}.frame", n) if "frame" in ranking else None
    moves = ranking.get("moving", True) is True  # which 1 equals
    require(moves, "format", f"{at}.moving", "no value but true was expected")
    memory = ranking.get("memory", 1)
    good = type(memory) is int and 1 <= memory <= MAX_MEMORY  # True is an int to isinstance
    require(good, "format", f"{at}.memory", f"an integer from 1 to {MAX_MEMORY} was expected")
    tree, ranks, steps = (decoded(ranking[key], f"{at}.{key}") for key in ("tree", "ranks", "steps"))
    return Ranking(lo, hi, frame, "moving" in ranking, memory, tree, ranks, steps)


def read_fit(value: Any, fitted: Fitted) -> Fit:
    """In discrete time there is no series."""
    at = "evidence.data"
    data = keys(value, at, "order", "pieces", "tree", "leaves", "rounds", *(("turned",) if fitted.axes else ()))
    order, pieces = read_order(data["order"], f"{at}.order", not fitted.discrete), data["pieces"]
    most = 1 if fitted.discrete else MAX_PIECES
    good = type(pieces) is int and 1 <= pieces <= most  # True is an int to isinstance
    require(good, "format", f"{at}.pieces", f"an integer from 1 to {most} was expected")
    tree, leaves = decoded(data["tree"], f"{at}.tree"), entries(data["leaves"], f"{at}.leaves")
    require(1 <= len(leaves) <= MAX_LEAVES, "format", f"{at}.leaves", f"1 to {MAX_LEAVES} leaves are allowed")
    each = tuple(read_rounds(rounds, f"{at}.leaves.{k}", fitted) for k, rounds in enumerate(leaves))
    size, turned = 2 * fitted.axes * fitted.measured, None
    if fitted.axes:
        turned = numbers(data["turned"], f"{at}.turned", size)
    return Fit(order, pieces, tree, each, read_rounds(data["rounds"], f"{at}.rounds", fitted), turned)


def read_rounds(value: Any, at: str, fitted: Fitted) -> tuple[Round, ...]:
    rounds, found = entries(value, at), list[Round]()
    require(len(rounds) <= MAX_ROUNDS, "format", at, f"at most {MAX_ROUNDS} rounds are allowed")
    for k, each in enumerate(rounds):
        stated, ends = keys(each, f"{at}.{k}", "box", "weights"), 2 * fitted.parameters
        box = numbers(stated["box"], f"{at}.{k}.box", ends)
        found.append(Round(box, numbers(stated["weights"], f"{at}.{k}.weights", ends * fitted.measured)))
    return tuple(found)


def read_covering(value: Any, n: int) -> Covering:
    at = "evidence.outer"
    covering = keys(value, at, "T", "root", "tree", "faces")
    T, root = square(covering["T"], f"{at}.T", n), numbers(covering["root"], f"{at}.root", n)
    tree, faces = decoded(covering["tree"], f"{at}.tree"), entries(covering["faces"], f"{at}.faces", 2 * n)
    return Covering(T, root, tree, tuple(decoded(face, f"{at}.faces.{k}") for k, face in enumerate(faces)))


def read_order(value: Any, at: str, sampled: bool) -> int:
    """Without a sample there is no series, and one through networks is not known: then the order is 1."""
    most = MAX_ORDER if sampled else 1
    good = type(value) is int and 1 <= value <= most  # True is an int to isinstance
    require(good, "format", at, f"an integer from 1 to {most} was expected")
    return int(value)


def read_local(value: Any, n: int, claim: str, sampled: bool) -> Ball:
    at = "evidence.local"
    local = keys(value, at, "J", "multipliers", "weight", "edge", "order", maybe=("directions",))
    edge, order = binary64(local["edge"], f"{at}.edge"), read_order(local["order"], f"{at}.order", sampled)
    good = edge >= 0 and (edge == 0 or claim in WITH_FLOOR)
    require(good, "format", f"{at}.edge", f"{edge!r} is not allowed with claim '{claim}'")
    return replace(read_ball(local, at, n), edge=edge, order=order, directions=read_directions(local, at, n))


def read_directions(value: dict[str, Any], at: str, n: int) -> tuple[bytes, ...] | None:
    if "directions" not in value:
        return None
    trees = entries(value["directions"], f"{at}.directions")
    require(len(trees) in (0, 2 * n), "format", f"{at}.directions", f"a list of 0 or of {2 * n} was expected")
    return tuple(decoded(tree, f"{at}.directions.{k}") for k, tree in enumerate(trees))


def read_contraction(value: Any, n: int, claim: str, held: bool, sampled: bool) -> Contraction | None:
    """With an order where inputs are held, which is 1 unless a series is `sampled`."""
    at = "evidence.contraction"
    if claim != "nearby":
        require(value is None, "format", at, f"null was expected with claim '{claim}'")
        return None
    contraction = keys(value, at, "J", "weights", "weight", *(("order",) if held else ()), maybe=("directions",))
    order = read_order(contraction["order"], f"{at}.order", sampled) if held else 1
    J, weight = (square(contraction[key], f"{at}.{key}", n) for key in ("J", "weight"))
    weights, directions = numbers(contraction["weights"], f"{at}.weights", n), read_directions(contraction, at, n)
    return Contraction(J, weights, weight, directions, order)


def read_cells(value: Any, at: str, k: int) -> tuple[int, ...]:
    parts = entries(value, at, k)
    good = all(type(part) is int and 1 <= part <= MAX_PARTS for part in parts)  # True is an int to isinstance
    require(good, "format", at, f"integers from 1 to {MAX_PARTS} were expected")
    require(math.prod(parts) <= MAX_CELLS, "format", at, f"more than {MAX_CELLS} cells")
    return tuple(parts)


def read_ball(value: dict[str, Any], at: str, n: int, moves: bool = False) -> Ball:
    J, rows = square(value["J"], f"{at}.J", n), numbers(value["multipliers"], f"{at}.multipliers", 3 * n)
    weight = square(value["weight"], f"{at}.weight", n + moves)
    return Ball(J, rows[:n], rows[n : 2 * n], rows[2 * n :], weight)


def read_slab(value: Any, at: str, n: int, moves: bool) -> Slab:
    slab = keys(value, at, "middle", "end", "duration", "J", "multipliers", "weight", "path")
    duration = binary64(slab["duration"], f"{at}.duration")
    middle, end = (square(slab[key], f"{at}.{key}", n) for key in ("middle", "end"))
    ball, path = read_ball(slab, at, n, moves), None
    if moves:
        path, joint = read_path(slab["path"], f"{at}.path", n)
        ball = replace(ball, g=ball.g + array("d", [joint]))
    else:
        require(slab["path"] is None, "format", f"{at}.path", "null was expected: the claim has no path")
    return Slab(middle, end, duration, ball, path)


def read_path(value: Any, at: str, n: int) -> tuple[Path, float]:
    """The path, and `joint`, the last number of the slab's g."""
    path = keys(value, at, "centre", "share", "edge", "motion", "joint")
    share, edge, motion, joint = (binary64(path[key], f"{at}.{key}") for key in ("share", "edge", "motion", "joint"))
    return Path(column(path["centre"], f"{at}.centre", n), share, edge, motion), joint


def read_trusted(value: dict[str, Any]) -> Trusted:
    evidence = keys(value, "evidence", "kind", "solver", "version", "precision", "queries")
    positive = binary64(evidence["precision"], "evidence.precision") > 0
    require(positive, "format", "evidence.precision", "must be positive")
    queries = entries(evidence["queries"], "evidence.queries")
    said = [word for pair in queries for word in entries(pair, "evidence.queries", 2)]
    for word in (evidence["solver"], evidence["version"], *said):
        good = isinstance(word, str) and WORD.fullmatch(word) is not None
        require(good, "format", "evidence", "a word was expected")
    return Trusted(evidence["solver"], evidence["version"])
