"""Random small loops with ranks, and forgeries of their certificates.

The evidence is what the checker's own images of leaves allow, so that there is no margin that would hide a mistake in
them: whether it is true is for trajectories to say (`rank_truth`).
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np

from certify.checker import document, rules
from certify.checker.case import Case
from certify.checker.errors import Rejected
from certify.checker.ranks import Course, Steps
from certify.reference import rules as reference_rules
from tests.support.rank_truth import Truth, boxes
from tests.support.ranked import (
    HAIR,
    UNRANKED,
    Document,
    Interval,
    Loop,
    affine,
    dumped,
    encode,
    least_ranks,
    mapped,
    meets,
    raw,
    two_bytes,
    uniform,
)

Array = Any
Verdicts = tuple[str | None, str | None]  # of the checker and of the reference
RULES = {"ranks", "flow", "inputs", "keep"}


def by_checker(data: Document) -> str | None:
    """The rule that the checker refuses a document under; None if it accepts."""
    try:
        rules.check(document.certificate(json.loads(dumped(data)), "0" * 64))
    except Rejected as no:
        return no.rule
    return None


def by_reference(data: Document) -> str | None:
    """The rule that the reference refuses it under."""
    found = reference_rules.judge(dumped(data))
    return None if found.result == "ACCEPTED" else str(found.rule)


def verdicts(data: Document) -> Verdicts:
    return by_checker(data), by_reference(data)


# --------------------------------------------------------------------------------------------------------------- loops


@dataclass(frozen=True)
class Ranked:
    """A loop with its root box, tree and what is known of its leaves."""

    loop: Loop
    lo: list[float]
    hi: list[float]
    tree: bytes
    ranks: list[int]
    steps: list[int]

    @property
    def document(self) -> Document:
        return self.loop.document(self.lo, self.hi, self.tree, two_bytes(self.ranks), bytes(self.steps))

    @property
    def moving(self) -> list[int]:
        """The leaves that have steps."""
        return [i for i, k in enumerate(self.steps) if k]

    @property
    def most(self) -> int:
        return max((r for r in self.ranks if r != UNRANKED), default=0)

    def with_leaf(self, i: int, rank: int, steps: int) -> Ranked:
        ranks, counts = [*self.ranks[:i], rank, *self.ranks[i + 1 :]], [*self.steps[:i], steps, *self.steps[i + 1 :]]
        return replace(self, ranks=ranks, steps=counts)


class Draw:
    """A random loop of one to three states: steps or held inputs, angles, something uncertain, corners."""

    def __init__(
        self, seed: int, sizes: Sequence[int] = (1, 1, 2, 2, 2, 3), memory: int | None = None, moving: bool = False
    ) -> None:
        self.chance = np.random.default_rng(seed)
        self.n = int(self.chance.choice(sizes))
        self.states = ("x", "y", "z")[: self.n]
        self.sampled, self.unsure = self.chance.random() < 0.5, self.chance.random() < 0.4
        self.angles = [i for i in range(self.n) if self.chance.random() < 0.35]
        self.straight = [i for i in range(self.n) if i not in self.angles]
        self.frames = np.random.default_rng([seed, 1])  # of its own: other draws stay as they are
        self.memory, self.moving = memory, moving

    def frame(self) -> list[list[float]] | None:
        """None, or a matrix: turned, sheared, nearly singular, or of very different scales."""
        chance, n = self.frames, self.n
        kind, M = chance.integers(4), np.linalg.qr(chance.standard_normal((n, n)))[0]
        if kind == 1:
            M = M @ np.diag(10.0 ** chance.uniform(-1, 1, n)) @ chance.standard_normal((n, n))
        if kind == 2:
            M = np.diag(2.0 ** chance.uniform(-300, 300, n)) @ M
        return None if kind == 3 else M.tolist()

    def fraction(self, lo: float, hi: float) -> str:
        return str(Fraction(round(self.chance.uniform(lo, hi) * 1024), 1024))

    def layer(self, rows: int, columns: int, size: float, of: int) -> Document:
        W = size * self.chance.standard_normal((rows, columns))
        return affine(W.round(3).tolist(), (0.2 * self.chance.standard_normal(rows)).round(3).tolist(), of)

    def network(self) -> list[Document]:
        """Sines of angles, and the other states, through one layer."""
        steps, last = list[Document](), 0
        rows = np.eye(self.n)
        if self.angles:
            steps += [affine(rows[self.angles].tolist()), mapped("sin", 1)]
            if self.straight:
                steps += [affine(rows[self.straight].tolist()), {"kind": "concat", "of": [2, 3]}]
            last = len(steps)
        function = str(self.chance.choice(["tanh", "tanh", "sin", "cos"]))
        return [*steps, self.layer(3, self.n, 1.0, last), mapped(function, last + 1), self.layer(1, 3, 0.4, last + 2)]

    def dynamics(self) -> list[Any]:
        """A stable matrix, of sines and cosines of angles, with the input and terms that have corners or products."""
        A = self.chance.standard_normal((self.n, self.n))
        A *= self.chance.uniform(0.2, 0.6) / np.max(np.abs(np.linalg.eigvals(A)))
        found = []
        for i, name in enumerate(self.states):
            row: list[Any] = ["+", ["*", self.fraction(0.1, 0.5), "u"]]
            for j, other in enumerate(self.states):
                part = [str(self.chance.choice(["sin", "cos"])) if i != j else "sin", other]
                size = A[i, j] - 1.5 * (i == j and self.sampled)
                size = -abs(size) if i == j and j in self.angles else size
                row.append(["*", self.fraction(size, size), part if j in self.angles else other])
            row += [name] if i in self.angles and not self.sampled else []
            row += [self.fraction(-0.5, 0.5)] if i in self.angles and self.chance.random() < 0.4 else []
            row += [[], [["*", "1/10", ["abs", "u"]]], [["*", "1/10", ["max", "u", "1/10"]]]][self.chance.integers(3)]
            row += [[], [["*", "1/4", "q"]], [["*", "q", "1/3", "u"]]][self.chance.integers(3)] if self.unsure else []
            found.append(row)
        return found

    def target(self) -> list[Any]:
        each = [["-", "1", ["cos", x]] if i in self.angles else ["*", "1/2", x, x] for i, x in enumerate(self.states)]
        if self.chance.random() < 0.6:
            return [["-", ["+", *each], self.fraction(0.15, 0.6)]]
        return [["-", part, self.fraction(0.1, 0.4)] for part in each]

    def loop(self) -> Loop:
        h = self.chance.choice([0.2, 0.4, 0.6, 0.9])
        least = h * self.chance.choice([0.5, 1.0])
        return Loop(
            self.dynamics(),
            self.network(),
            self.target(),
            states=self.states,
            sample=(self.fraction(least, least), self.fraction(h, h)) if self.sampled else None,
            order=int(self.chance.integers(1, 4)) if self.sampled else 1,
            uncertain=[("q", "-1/8", "1/4")] if self.unsure else [],
            angles=tuple(self.states[i] for i in self.angles),
            domain=("-6", "6"),
            frame=self.frame(),
            memory=self.memory,
            moving=self.moving,
        )

    def ranked(self, hair: float = HAIR, depths: Sequence[int] = (6, 8, 9)) -> Ranked:
        """The loop with the ranks that the checker's images allow, widened by a hair."""
        turned = [3.25 if i in self.angles else 2.0 for i in range(self.n)]
        away = [float(self.chance.choice([0, 0, 3, 7])) if i in self.angles else 0.0 for i in range(self.n)]
        lo, hi = ([a + sign * w for a, w in zip(away, turned, strict=True)] for sign in (-1, 1))
        tree, _ = uniform(lo, hi, depths[self.n - 1])
        return solved(self.loop(), lo, hi, tree, self.angles, 5 if self.sampled else 4, hair)


class _Each(Course):
    """A course that knows what each leaf fails by."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.good = np.ones(count, dtype=bool)

    def note(self, rule: str, hold: Array, numbers: Array, detail: str) -> None:
        self.good[numbers] &= hold


def solved(
    loop: Loop, lo: list[float], hi: list[float], tree: bytes, angles: Sequence[int], longest: int, hair: float
) -> Ranked:
    """The least ranks by images of up to so many steps."""
    every = boxes(tree, lo, hi)
    blank = Ranked(loop, lo, hi, tree, [UNRANKED] * len(every), [0] * len(every))
    there, after = _images(blank.document, every, longest)

    def met(box: list[Interval] | None) -> Sequence[int] | None:
        """The leaves that a box meets, none if it is in the target."""
        if not box:
            return None if box is None else ()
        return meets(every, [(a - hair, b + hair) for a, b in box], lo, hi, angles)

    ranks, steps = least_ranks(there, [[met(box) for box in row] for row in after])
    return replace(blank, ranks=ranks, steps=steps)


def _images(
    data: Document, every: Sequence[Sequence[Interval]], longest: int
) -> tuple[list[bool], list[list[list[Interval] | None]]]:
    """Which leaves lie in the target; for each the boxes where it is after each number of steps: of no intervals if it
    is in the target, None if something that must hold before does not."""
    with np.errstate(all="ignore"):
        steps = Steps(Case(document.certificate(json.loads(dumped(data)), "0" * 64)))
        lo, hi = (np.array([[end[side] for end in box] for box in every]).T for side in (0, 1))
        x = steps.start(lo, hi)
        there, course = steps.is_in_target(x), _Each(len(every))
        found: list[list[list[Interval] | None]] = [[] for _ in every]
        for _ in range(longest):
            x, _ = steps.step(x, np.arange(len(every)), course)
            ends, come = np.array(x.range.ends).transpose(2, 1, 0).tolist(), steps.is_in_target(x)
            for row, good, here, box in zip(found, course.good, come, ends, strict=True):
                row.append(None if not good else [] if here else [(a, b) for a, b in box])
    return there.tolist(), found


# ----------------------------------------------------------------------------------------------------------- forgeries


@dataclass(frozen=True)
class Forgery:
    """A document, what is changed in it, and the rules that may refuse it; `maybe` if it may be true as well."""

    what: str
    data: Document
    rules: set[str]
    maybe: bool = False


def edited(data: Document, path: str, value: Any) -> Document:
    """With the entry at a path replaced."""
    result = copy.deepcopy(data)
    *parents, last = path.split(".")
    at = result
    for key in parents:
        at = at[key]
    at[last] = value
    return result


class Forger:
    """Forgeries of a certificate that is accepted."""

    def __init__(self, made: Ranked, seed: int) -> None:
        self.made, self.data, self.chance = made, made.document, np.random.default_rng(seed)
        self.states, self.angles = made.loop.states, made.loop.angles

    def all(self) -> Iterator[Forgery]:
        yield from self.of_ranks()
        yield from self.of_bytes()
        if self.made.moving:
            yield from self.of_what_must_hold()
        yield from self.of_places()
        yield from self.of_little()

    def some(self, of: Sequence[int], count: int = 2) -> list[int]:
        return [int(i) for i in self.chance.permutation(np.array(of, dtype=int))[:count]]

    def of_ranks(self) -> Iterator[Forgery]:
        """Other ranks and steps: these are the least that images allow."""
        made = self.made
        for i in self.some(made.moving):
            r, k = made.ranks[i], made.steps[i]
            if r > k:
                yield Forgery("a rank less by one", made.with_leaf(i, r - 1, k).document, {"ranks"})
            yield Forgery("a rank of 0", made.with_leaf(i, 0, 0).document, {"ranks"})
            yield Forgery("no steps", made.with_leaf(i, r, 0).document, {"ranks"})
            yield Forgery("more steps than the rank", made.with_leaf(i, r, r + 1).document, {"ranks"})
        for i in self.some([i for i, r in enumerate(made.ranks) if r == UNRANKED]):
            yield Forgery("a rank of 1", made.with_leaf(i, 1, 1).document, RULES)
            yield Forgery("a high rank", made.with_leaf(i, made.most + 1, 1).document, RULES)
            yield Forgery("a rank of 0 elsewhere", made.with_leaf(i, 0, 0).document, {"ranks"})
            yield Forgery("steps without a rank", made.with_leaf(i, UNRANKED, 1).document, {"ranks"})
        if made.moving:
            last = made.ranks.index(made.most)
            higher = made.with_leaf(last, made.most, made.steps[last])
            low = edited(higher.document, "claim.ranks.steps", made.most - 1)
            yield Forgery("a rank above the most", low, {"ranks"} if made.most > 1 else {"format"})
            circle = replace(made, ranks=[r if r in (0, UNRANKED) else made.most for r in made.ranks])
            if made.most > 1:
                yield Forgery("all ranks alike", circle.document, {"ranks"}, maybe=True)

    def of_bytes(self) -> Iterator[Forgery]:
        """Other bytes of the tree, ranks and steps."""
        made, ranking = self.made, "evidence.ranks"
        n = len(self.states)
        singular = encode(*[1.0] * n * n) if n > 1 else encode(0.0)
        for frame, rule in ((singular, "ranks"), (encode(*[1.0] * (n * n + 1)), "format"), (None, "format")):
            yield Forgery("another frame", edited(self.data, f"{ranking}.frame", frame), {rule})
        for memory in (0, 17, 1.5, "2", True, None):
            yield Forgery("a memory that is none", edited(self.data, f"{ranking}.memory", memory), {"format"})
        for moving in (False, 1, "true", None):
            yield Forgery("a moving that is none", edited(self.data, f"{ranking}.moving", moving), {"format"})
        some = [i for i, byte in enumerate(made.tree) if byte != 255]
        for i in self.some(some, 1):
            cut = made.tree[:i] + b"\xff" + made.tree[i + 1 :]
            yield Forgery("a node is a leaf", edited(self.data, f"{ranking}.tree", raw(cut)), {"ranks"})
            odd = made.tree[:i] + bytes([len(self.states)]) + made.tree[i + 1 :]
            yield Forgery("an axis that is none", edited(self.data, f"{ranking}.tree", raw(odd)), {"ranks"})
        for end, what in ((made.tree[:-1], "a leaf too few"), (made.tree + b"\xff", "a leaf too many"), (b"", "none")):
            yield Forgery(what, edited(self.data, f"{ranking}.tree", raw(end)), {"ranks"})
        ranks = two_bytes(made.ranks)
        yield Forgery("a byte too few", edited(self.data, f"{ranking}.ranks", raw(ranks[:-1])), {"ranks"})
        yield Forgery("two bytes too many", edited(self.data, f"{ranking}.ranks", raw(ranks + b"\0\0")), {"ranks"})
        yield Forgery("a step too few", edited(self.data, f"{ranking}.steps", raw(bytes(made.steps[:-1]))), {"ranks"})
        if made.moving:
            other = b"".join(ranks[i : i + 2][::-1] for i in range(0, len(ranks), 2))
            yield Forgery(
                "the higher byte first", edited(self.data, f"{ranking}.ranks", raw(other)), {"ranks"}, maybe=True
            )
        first = replace(made, hi=[made.lo[0], *made.hi[1:]])
        yield Forgery("a root box of no width", first.document, {"ranks"})

    def of_what_must_hold(self) -> Iterator[Forgery]:
        """Constraints, inputs, the domain and the target, beyond what trajectories have."""
        truth = Truth(self.data)

        def largest(tree: Any) -> float:
            return truth.worst(tree, np.random.default_rng(5))

        def near(number: float, less: float) -> str:
            return str(Fraction(number) - Fraction(less))

        straight = [name for name in self.states if name not in self.angles]
        trees: list[Any] = ["u", ["-", "u"], ["*", "u", "u"], *straight, *(["-", name] for name in straight)]
        trees += [["cos", name] for name in self.angles] + [["sin", ["*", "2", name]] for name in self.angles]
        for i in self.some(range(len(trees)), 4):
            grazed = ["-", trees[i], near(largest(trees[i]), 1e-6)]
            keep = self.data["claim"] | {"keep": ["-1", grazed]}
            yield Forgery("an obstacle that is grazed", edited(self.data, "claim", keep), {"keep"})
        bound = near(largest(["abs", "u"]), 1e-6)
        if Fraction(bound) > 0:
            low = edited(self.data, "plant.input_bounds", [[f"-{bound}", bound]])
            yield Forgery("an input beyond its bounds", low, {"inputs"})
        for name in straight:
            k, end = self.states.index(name), near(largest(name), 1e-6)
            domain = copy.deepcopy(self.data["plant"]["domain"])
            domain[k] = ["-6", end]
            small = edited(self.data, "plant.domain", domain)
            yield Forgery("a domain that is left", small, {"ranks", "flow"})
        for more in ("100", "1/2"):
            target = [["+", g, more] for g in self.data["claim"]["target"]]
            yield Forgery("a smaller target", edited(self.data, "claim.target", target), {"ranks"})

    def of_places(self) -> Iterator[Forgery]:
        """Angles that are none, and boxes of angles that are too short."""
        made = self.made
        for i, name in enumerate(self.states):
            if name not in self.angles:
                other = edited(self.data, "claim.ranks.angles", [*self.angles, name])
                yield Forgery("a state that is no angle", other, {"angles", "ranks"})
            else:
                hi = [*made.hi[:i], math.nextafter(made.lo[i] + 2 * math.pi, -99), *made.hi[i + 1 :]]
                yield Forgery("less than a turn", replace(made, hi=hi).document, {"ranks"})
        if self.angles:
            x = self.angles[0]
            for more in ([["-", ["*", "0", x], ["sin", ["*", "1/2", x]], "9"]], [["-", ["*", x, x], "999"]], [x]):
                keep = self.data["claim"] | {"keep": more}
                if more[0][0] != "-" or len(more[0]) == 3:
                    yield Forgery("a constraint that winds", edited(self.data, "claim", keep), {"angles"})

    def of_little(self) -> Iterator[Forgery]:
        """What a hair may decide: other ends, axes and ranks, a leaf less, other periods and ranges."""
        made = self.made
        for i in range(len(self.states)):
            for by in (1e-9, -1e-9, 0.05):
                lo, hi = ([*end[:i], end[i] + by, *end[i + 1 :]] for end in (made.lo, made.hi))
                yield Forgery("an end that is moved", replace(made, lo=lo).document, RULES, maybe=True)
                yield Forgery("another end", replace(made, hi=hi).document, RULES, maybe=True)
        axes = [i for i, axis in enumerate(made.tree) if axis < len(self.states) - 1]
        for i in self.some(axes, 2):
            tree = made.tree[:i] + bytes([made.tree[i] + 1]) + made.tree[i + 1 :]
            yield Forgery("another axis", replace(made, tree=tree).document, RULES, maybe=True)
        for i in self.some([i for i, r in enumerate(made.ranks) if r != UNRANKED]):
            yield Forgery("a leaf without a rank", made.with_leaf(i, UNRANKED, 0).document, RULES, maybe=True)
        for i in self.some(made.moving):
            for k in (1, made.steps[i] + 1, made.ranks[i]):
                yield Forgery("other steps", made.with_leaf(i, made.ranks[i], k).document, RULES, maybe=True)
            for j in self.some([j for j, k in enumerate(made.steps) if k or made.ranks[j] == UNRANKED], 1):
                one = made.with_leaf(i, made.ranks[j], made.steps[j])
                both = one.with_leaf(j, made.ranks[i], made.steps[i])
                yield Forgery("two leaves exchanged", both.document, RULES, maybe=True)
        if made.loop.sample:
            least, most = map(Fraction, made.loop.sample)
            for pair in ((least / 2, most), (least, most * 3 / 2), (Fraction(0), most)):
                other = edited(self.data, "claim.sample", [str(h) for h in pair])
                yield Forgery("other periods", other, RULES, maybe=True)
        for name in self.angles:
            rest = [other for other in self.angles if other != name]
            yield Forgery("an angle less", edited(self.data, "claim.ranks.angles", rest), RULES, maybe=True)
        if made.loop.uncertain:
            wide = edited(self.data, "plant.uncertain", [{"name": "q", "range": ["-1", "1"]}])
            yield Forgery("a wider range", wide, RULES, maybe=True)
