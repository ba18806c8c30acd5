"""The rules, as tables in FORMAT.md's order: what is not shown is refused under the name of its rule.

A rule is a function that yields its failures as (place, detail) and returns how many things it has looked at; the
first failure of all ends the examination. Together the rules imply the claim: FORMAT.md has the inequalities,
docs/mathematics/ the proof. What only some certificates need is a module that is loaded for these alone. An answer
names the modules that it rests on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from importlib import import_module
from itertools import islice
from typing import Any, TypeVar

import numpy as np

from . import ball, boxes, local, ring
from .boxes import in_order
from .case import Case, Failures, only_where
from .document import Certificate, Partition
from .errors import Rejected
from .exact import Exact, Exactly, gershgorin_lower, policy_at_origin
from .expression import evaluate
from .functions import Undecided
from .near import Array, self_test
from .network import reaches


def levels(case: Case) -> Failures:
    c = case.c
    inner = c.c0 if c.practical else c.c1
    if not 0 < inner <= c.c1 <= c.c2 < float("inf"):
        yield "levels", f"must satisfy 0 < {' <= '.join(c.levels)}"
    if not (isinstance(c.evidence, Partition) and case.covered) and inner != c.c1:
        yield "levels.local", "must be the floor where there is no ball"
    return 1


def lyapunov(case: Case) -> Failures:
    """In rationals, by Sylvester's criterion."""
    if not case.P_inverse:
        yield "lyapunov.P", "P must be symmetric and positive definite"
    return 1


def equilibrium(case: Case) -> Failures:
    """f(0, u_eq) = 0 in rationals, whatever the uncertain quantities are: these are numbers without a value."""
    c = case.c
    at_rest = [*[Fraction(0)] * len(c.states), *c.u_eq, *[None] * len(c.uncertain)]
    try:
        F = evaluate(c.dynamics, Exact, [Exact(q) for q in at_rest], Exactly().entries)
    except Undecided as error:
        yield "plant.dynamics", f"f(0, u_eq) is not decided exactly: {error}"
    else:
        for name, f in zip(c.states, F, strict=True):
            if f.value is None:
                yield name, "f(0, u_eq) is not decided exactly: it is no number that rationals know"
            if f.value != 0:
                yield name, "f(0, u_eq) must be 0"
    return len(c.states)


def domain(case: Case) -> Failures:
    """max of x_i^2 on {V <= c2} is c2 (P^-1)_ii, in rationals."""
    for name, (lo, hi), p in zip(case.c.states, case.c.domain, case.P_inverse, strict=True):
        if not (lo < 0 < hi and Fraction(case.c.c2) * p < min(-lo, hi) ** 2):
            yield name, "{V <= c2} must lie in the interior of the domain"
    return len(case.c.states)


def coordinates(case: Case) -> Failures:
    if not (case.S_inverse and gershgorin_lower(case.S) > 0):
        yield "evidence.T", "T'PT must be positive definite and diagonally dominant"
    return 1


def root(case: Case) -> Failures:
    for i, (b, s) in enumerate(zip(case.partition.root.tolist(), case.S_inverse, strict=True)):
        if not (b > 0 and Fraction(case.c.c2) * s <= Fraction(b) ** 2):
            yield f"axis {i}", "the root box must contain {V <= c2}"
    return len(case.c.states)


def centring(case: Case) -> Failures:
    """pi(0) = u_eq, by form or in rationals."""
    policy, u_eq = case.c.policy, case.c.u_eq
    if policy.centre == "preactivation" and not all(-1 < q < 1 for q in reaches(policy, u_eq)):
        yield "policy.offset", "u_eq must lie strictly inside offset +- scale"
    if policy.centre != "none" and policy.clip:
        ends = zip(*(end.tolist() for end in policy.clip), u_eq, strict=True)
        if not all(Fraction(lo) < u < Fraction(hi) for lo, hi, u in ends):
            yield "policy.clip", "u_eq must lie strictly inside the clip"
    if policy.centre == "none" and not (case.c.practical or case.c.without_V):
        try:
            shown = policy_at_origin(policy) == list(u_eq)
        except Undecided:
            shown = False
        if not shown:
            yield "policy.centre", "pi(0) = u_eq cannot be shown exactly without centring"
    return 1


Subject = TypeVar("Subject")
Table = Sequence[tuple[str, Callable[[Subject], Failures]]]

STATED: Table[Case] = [
    (rule.__name__, rule) for rule in (levels, lyapunov, equilibrium, domain, coordinates, root, centring)
]
ON_THE_BALL: Table[local.Local] = (
    ("local", local.fits),
    ("inputs", ball.keeps_inputs),
    ("local", ball.is_not_clipped),
    ("flow", only_where(lambda c: c.sample, "flow", "stays_on_ball")),
    ("keep", only_where(lambda c: c.keep, "keep", "on_local_ball")),
    ("local", local.decreases),
)
OF_THE_TREE: Table[Case] = (("tree", ring.is_partition),)
ON_LEAVES: Table[ring.RingLeaves] = (
    ("inputs", boxes.keeps_inputs),
    ("flow", only_where(lambda c: c.sample, "flow", "stays_on_leaves")),
    ("keep", only_where(lambda c: c.keep, "keep", "on_leaves")),
    ("ring", ring.decreases),
)
OTHERS: Sequence[tuple[str, Callable[[Certificate], object]]] = (  # modules with rules of their own, and who needs them
    ("handover", lambda c: c.then),
    ("data", lambda c: c.data),
    ("samples", lambda c: c.samples),
    ("", lambda c: isinstance(c.evidence, Partition)),  # the rules about ball and tree
    ("tube", lambda c: c.tube),
    ("contraction", lambda c: c.contraction),
    ("outer", lambda c: c.outer),
    ("ranks", lambda c: c.ranks),
)
_KEPT = 4_000_000  # numbers, just below the 2^25 bytes up to which glibc adapts
READ = {"format": 1, "hash": 1}  # rules of document.py, which have held
RULES = (
    *READ,
    *dict.fromkeys(name for table in (STATED, ON_THE_BALL, OF_THE_TREE, ON_LEAVES) for name, _ in table),
    *("handover", "data", "samples", "tube", "contraction", "outer", "faces", "angles", "ranks"),  # in modules
)


@dataclass
class Tally:
    """Each rule's count, and margins, which are floats for people: 1 - the remainder's largest part of the decay, and
    the smallest bounds of -Vdot and -N'F on the leaves of which they are asked."""

    rules: Counter[str] = field(default_factory=lambda: Counter(dict.fromkeys(RULES, 0) | READ))
    margins: dict[str, float | None] = field(default_factory=lambda: dict.fromkeys(("local", "ring", "outer")))
    then: Tally | None = None  # of the certificate that takes over
    every: bool = False  # whether a tree is refused at its first leaf that fails, or when all are known

    def hold(self, table: Table[Subject], subject: Subject) -> None:
        """Raise `Rejected` at the first failure of the first rule that fails; count what the rules have looked at."""
        for failure in self.failures(table, subject):
            raise failure

    def failures(self, table: Table[Subject], subject: Subject) -> Iterator[Rejected]:
        """The failures, and a count of what the rules have looked at that have none."""
        for name, rule in table:
            failures = rule(subject)
            try:
                while True:
                    yield Rejected(name, *next(failures))
            except StopIteration as done:
                self.rules[name] += done.value

    def hold_on_leaves(
        self, table: Table[Any], bounds: boxes.Boxes, tree: bytes, asked: Callable[[Any], Array]
    ) -> float | None:
        """Do so on the leaves of a tree; returns the margin of the bounds that must be negative, None if there are
        none."""

        def examine(first: int, lo: Array, hi: Array) -> tuple[Counter[str], float, list[Rejected]]:
            own, leaves = Tally(Counter()), bounds.examine(first, lo, hi)
            failures = own.failures(table, leaves)
            found = list(failures if self.every else islice(failures, 1))
            return own.rules, float(np.min(-asked(leaves), initial=np.inf)), found

        least, refused = np.inf, list[Rejected]()
        for counts, margin, found in in_order(examine, bounds.leaves(), tree.count(boxes.LEAF), bounds.case.jobs):
            self.rules.update(counts)
            least, refused = min(least, margin), refused + found
            if found and not self.every:
                break
        if refused:
            refused[0].every = tuple(no.at for no in refused) if self.every else ()
            raise refused[0]
        return least if least < np.inf else None


def check(c: Certificate, jobs: int = 1, every: bool = False) -> Tally:
    """Check every rule, those for leaves in so many processes; returns the tally, raises `Rejected` at the first rule
    that fails.

    Where evidence cannot be replayed, only the rules about what is stated are checked, and the caller must not say
    ACCEPTED; the tally then has no leaves. If `every` leaf that fails is wanted, a refusal names them: all under rule
    `ring`, else the first of each batch.
    """
    self_test()
    np.empty(_KEPT)  # given back at once: an allocator that adapts then keeps arrays, and need not ask for each anew
    replayed = isinstance(c.evidence, Partition)
    spared = {"equilibrium": c.practical, "coordinates": not replayed, "root": not replayed}
    spared |= dict.fromkeys(("levels", "lyapunov", "equilibrium", "domain"), True) if c.without_V else {}
    with np.errstate(all="ignore"):  # overflow becomes infinity or NaN, and every test then fails
        tally, case = Tally(every=every), Case(c, jobs)
        tally.hold([(name, rule) for name, rule in STATED if not spared.get(name)], case)
        for module, needs in OTHERS:
            if needs(c):
                examine = import_module(f".{module}", __package__).examine if module else _examine
                examine(tally, case)
    if c.then is not None:
        try:
            tally.then = check(c.then, jobs)
        except Rejected as no:
            raise Rejected(no.rule, f"then.{no.at}", no.detail) from None
    return tally


def _examine(tally: Tally, case: Case) -> None:
    """The rules about ball and tree."""
    c = case.c
    if case.covered:
        origin = local.Local.of(case)
        tally.hold(ON_THE_BALL, origin)
        least = min(origin.margins, default=np.nan)
        if np.isfinite(least):  # binary64 may not hold the sides of an inequality that rationals decide
            tally.margins["local"] = least
    tally.hold(OF_THE_TREE, case)
    if not case.covered or c.c1 != c.c2:
        bounds, tree = ring.Ring.of(case), case.partition.tree
        tally.margins["ring"] = tally.hold_on_leaves(ON_LEAVES, bounds, tree, lambda leaves: leaves.bound[leaves.meet])
