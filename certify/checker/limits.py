"""The rule `limits`: count a file's demands from the sizes that it states, before any other computation.

Each rule alone is cheap, and so is each size; their product is not. docs/mathematics/limits.md has these sums, which
count the work of this checker and the reference generously: a unit is about a nanosecond here. They read sizes only.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from math import prod

from .case import AT_CORNERS, Case, Failures
from .document import Certificate, Partition
from .networks import Map, Network
from .schema import Array

MOST_NUMBERS = 2**25
MOST_WORK, MOST_IN_PATIENCE = 3 * 2**37, 2**46  # ten minutes; many hours, if somebody says that there is time for it
LEAF = 255


def is_bearable(case: Case) -> Failures:
    """`limits`: neither too many numbers at once, nor too many operations in all."""
    both = [Sizes(c) for c in (case.c, case.c.then) if c is not None]
    count, work = sum(sizes.numbers() for sizes in both), sum(sizes.work() for sizes in both)
    if case.c.then is not None:
        from . import demands

        work += demands.of_handover(both[0], case.c.then)
    most = MOST_IN_PATIENCE if case.patient else MOST_WORK
    if count > MOST_NUMBERS:
        yield "numbers", f"the file asks for {in_short(count)} at once; the checker allows {in_short(MOST_NUMBERS)}"
    if work > most:
        more = f"; with --patient {in_short(MOST_IN_PATIENCE)}" if most < work <= MOST_IN_PATIENCE else ""
        yield "operations", f"the file asks for {in_short(work)}; the checker allows {in_short(most)}{more}"
    return 1


def in_short(count: int) -> str:
    """Two digits and a power of ten; a count may be beyond binary64."""
    power = max(len(str(count)) - 1, 0)
    return f"{count}" if power < 4 else f"{count // 10 ** (power - 1) / 10}e{power}"


class Net:
    """Sums over the steps of networks, as `Network.shapes` has them, of which the arguments of calls are units too."""

    def __init__(self, called: Sequence[Network], policy: Sequence[Network] = ()) -> None:
        networks, arguments = [*policy, *called], [network.reads for network in called]
        steps = [step for network in networks for step in network.steps]
        self.steps = [shape for network in policy for shape in network.shapes]
        self.steps += [(r, c, before + network.reads) for network in called for r, c, before in network.shapes]
        self.units = sum(step.units for step in steps) + sum(arguments)
        self.widest = max((network.widest for network in networks), default=0)
        self.kept = -(-sum(network.kept for network in networks) // max(self.widest, 1))
        self.reads = sum(len(step.of) for step in steps)
        self.dear = sum(step.size for step in steps if isinstance(step, Map) and step.function not in ("tanh", "relu"))
        self.entries = sum(rows * columns for rows, columns, _ in self.steps)

    @property
    def folded(self) -> int:
        return sum(r * c * (2**9 + 8 * min(r, c)) for r, c, _ in self.steps)

    @property
    def paths(self) -> int:
        return sum(r * before * (c + 3 * 2**6) for r, c, before in self.steps) // 8

    def held_on_leaves(self, symbols: int) -> int:
        """Vectors that wait for a step, on as many leaves as are examined at once."""
        return 2**14 * (self.reads + 8 * self.kept * symbols)

    def held_on_a_ball(self, d: int, t: int) -> int:
        return sum(4 * r * (d + before) for r, _, before in self.steps) + 3 * self.units * t

    def on_a_leaf(self, symbols: int) -> int:
        return 2**15 * self.dear + sum(
            r * (c * (symbols + 2) + 5 * before + 64 * symbols + 7 * 2**9) for r, c, before in self.steps
        )

    def on_a_ball(self, d: int, t: int) -> int:
        return sum(r * (c * (d + before) + before * t) + 2**21 for r, c, before in self.steps) + 64 * self.units * t

    def models(self, area: int) -> int:
        return sum(r * area * (2 * c + 64) for r, c, _ in self.steps)


class Sizes:
    """Sizes of a certificate, in the letters of docs/mathematics/limits.md."""

    def __init__(self, c: Certificate) -> None:
        self.c, self.evidence = c, c.evidence
        self.n, self.m, quantities = len(c.states), len(c.inputs), len(c.uncertain)
        self.varies = int(c.sample is not None and c.sample[0] < c.sample[1])
        self.y = quantities + self.varies
        self.z = c.dynamics.entries
        self.s = self.n + self.m + self.y + self.z
        self.d = self.n + (c.claim == "reached")
        self.t = 2 * self.d**2 + self.d * (self.d + 1) * (self.d + 2) // 6
        self.a = c.dynamics.size + c.policy.network.operations + c.stated
        self.net = Net(c.dynamics.called, [c.policy.network])

    # ------------------------------------------------------------------------------------------------------ numbers

    def numbers(self) -> int:
        """Held at once."""
        found = 4 * self.net.entries + self.of_features[0]
        if not isinstance(self.evidence, Partition):
            return found
        balls = self.evidence.local, self.c.contraction
        order = max(self.evidence.order, *(part.order if part else 1 for part in balls))
        values = (4 * order if self.c.sample else 1) * self.a + 2 * self.n + 8
        if self.asked and not self.c.outer:
            found += self.on_leaves(order, self.s)
        if self.evidence.local or self.c.contraction or self.c.tube:
            found += values * (self.t + self.d * self.y + self.m + self.z) + self.d**4 // 4
            found += self.net.held_on_a_ball(self.d, self.t)
        return found

    @cached_property
    def of_features(self) -> tuple[int, int]:
        """Numbers and operations of what only some certificates have."""
        c, local = self.c, isinstance(self.evidence, Partition) and self.evidence.local
        has = (c.outer, c.ranks, c.data, c.samples, c.tube, c.contraction, local and local.directions is not None)
        if not any(has):
            return 0, 0
        from . import demands

        return demands.numbers(self), demands.work(self)

    def on_leaves(self, order: int, symbols: int) -> int:
        """Numbers on as many leaves as are examined at once."""
        values = (4 * order if self.c.sample else 1) * self.a + 2 * self.n + 8
        held = self.net.held_on_leaves(symbols + self.m + self.z)
        return values * (symbols + 1) ** 2 + 2**14 * (self.n + self.m + self.z) + held

    # --------------------------------------------------------------------------------------------------------- work

    def work(self) -> int:
        """Elementary operations."""
        found = 2**15 * self.a + self.net.folded
        found += 0 if self.c.without_V else self.inverse(self.bits(self.c.P))
        if not (self.c.practical or self.c.without_V):
            found += 2**12 * self.net.entries + 2**19 * Net(self.c.dynamics.called).entries
        found += self.of_features[1]
        if not isinstance(self.evidence, Partition):
            return found
        seen = min(2 * self.bits(self.evidence.T) + self.bits(self.c.P) + 16, 2**16 // self.n)
        found += self.inverse(seen) + 2**8 * len(self.evidence.tree)
        if self.asked:
            found += self.of_leaves(self.evidence.tree.count(LEAF), self.evidence.order, self.s)
        return found + self.of_ball(self.evidence)

    @property
    def asked(self) -> bool:
        """True if the leaves of the ring are examined."""
        return isinstance(self.evidence, Partition) and (self.evidence.local is None or self.c.c1 != self.c.c2)

    def bits(self, A: Array) -> int:
        """Bits of the longest numerator over a common denominator."""
        parts = [v.as_integer_ratio() for v in A.ravel().tolist()]
        common = max(below for _, below in parts)  # of powers of 2
        return max((abs(above) * (common // below)).bit_length() for above, below in parts)

    def inverse(self, bits: int) -> int:
        """Operations for the inverse of an exact matrix of n rows."""
        return self.n**5 * bits**2 // 2**13 + 2**10 * self.n**3

    def decision(self, rows: int) -> int:
        """Operations to decide that an exact matrix is positive definite."""
        return 2**14 * rows**3

    def evaluations(self, order: int) -> int:
        """Evaluations of the equations for a series of that order in time."""
        return 2 * order**3 + 8 if self.c.sample else 1

    def boxes(self, leaves: int, models: int, values: int, symbols: int, calls: int) -> int:
        """So many models on each leaf, `values` of which are held; `calls` are those beside the models'."""
        area = (symbols + 4) ** 2
        of_each = 8 * area * models + area * (values + 4) * (32 * models + calls) // 2**9
        return leaves * (of_each + 2**11 + 2**7 * self.n + self.n**3)

    def policies(self, leaves: int, order: int, symbols: int) -> int:
        each, batches = self.net.on_a_leaf(symbols), 1 + leaves * self.net.widest // 2**14
        times = self.evaluations(order) if self.z else 1  # of calls, in those of the equations
        return times * (leaves * each // 8 + batches * self.net.paths)

    def of_leaves(self, leaves: int, order: int, symbols: int) -> int:
        """The loop on so many leaves."""
        calls = self.n * symbols**2 + 160 * self.net.reads
        models = self.a * self.evaluations(order) + self.n**2 + 4 * self.n
        found = self.boxes(leaves, models, self.a * (order + 1), symbols, calls)
        return found + self.policies(leaves, order, symbols)

    @property
    def ball(self) -> int:
        """The networks on a ball, once."""
        return self.net.on_a_ball(self.d, self.t)

    @property
    def equations(self) -> int:
        """The equations in models on a ball, once, with the networks that they call."""
        calls = self.ball if self.z else 0
        return self.a * (2**17 + 64 * self.t + 16 * self.d**2 * (self.m + self.y + self.z)) + calls

    @property
    def inequality(self) -> int:
        """One matrix inequality on a ball."""
        rows = self.d + 1
        return 2**23 + 2**12 * rows**4 + 8 * self.d**5 + 4 * self.net.units * self.d**3 + self.decision(rows)

    def of_ball(self, evidence: Partition) -> int:
        """The rule `local`."""
        if evidence.local is None:
            return 0
        each = self.inequality + 2**8 * self.y * self.n * (self.d + 1) ** 2
        times, corners = self.times(evidence, evidence.local.order), prod(evidence.cells) * 2 ** min(self.y, AT_CORNERS)
        found: int = self.ball + times * self.equations + corners * each + self.decision(self.n)
        return found

    def times(self, evidence: Partition, order: int) -> int:
        """Evaluations of the equations on a ball, for all cells."""
        return prod(evidence.cells) + (self.evaluations(order) + 8 if self.c.sample else 0)
