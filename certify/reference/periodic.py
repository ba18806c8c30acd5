"""Rule `angles`: what the loop does is the same at states that differ by multiples of 2 pi in angles.

A number's winding is by how many turns it grows where an angle grows by one, an integer for each angle. Whatever has a
winding is known to grow by whole turns, everywhere and for the same angle by as many; whatever has none returns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add

from flint import fmpq

from .document import Certificate
from .expressions import Call
from .networks import Affine, Clip, Observe, OnLists
from .refusal import Refused, require

RULE, PERIODIC = "angles", ("sin", "cos")
MAX_TURNS = 2**32  # integers of many digits would take hours


def angles(c: Certificate) -> None:
    """The policy, the equations, and the expressions of `keep` and `target` are periodic in each angle."""
    if c.ranks is None or not c.ranks.angles:
        return
    count = len(c.ranks.angles)
    none = Winding((0,) * count)
    states = dict.fromkeys(c.plant.states, none)
    for k, name in enumerate(c.ranks.angles):
        states[name] = Winding(tuple(int(i == k) for i in range(count)))
    everything = states | dict.fromkeys((*c.plant.inputs, *c.plant.uncertain), none)

    def constant(q: fmpq) -> Winding:
        return Winding(none.turns, int(q.p) if q.q == 1 else None)

    def called(call: Call, given: Sequence[Winding]) -> list[Winding]:
        value: list[Winding] = call.network.run(Windings(constant), list(given))
        return [value[i] for i in call.entries]

    try:
        u = c.policy.network.run(Windings(constant), list(states.values()))
        known(all(not v.winds for v in u), "policy", "the policy winds with an angle")
        for i, (f, name) in enumerate(
            zip(c.plant.dynamics.evaluate(everything, constant, called), c.plant.states, strict=True)
        ):
            asked = states[name].turns if c.plant.discrete else none.turns
            known(f.turns == asked, f"dynamics.{i}", "it does not turn as its state does")
        for at, expressions, names in (("keep", c.keep, everything), ("target", c.target, states)):
            found = [] if expressions is None else expressions.evaluate(names, constant)
            for i, g in enumerate(found):
                known(not g.winds, f"{at}.{i}", "it winds with an angle")
    except Refused as no:
        raise Refused(RULE, no.at, no.detail) from None


def known(holds: bool, at: str, detail: str) -> None:
    require(holds, RULE, at, detail)


@dataclass(frozen=True)
class Winding:
    """`turns` has a number for each angle; `factor` is the number itself where it is known to be an integer."""

    turns: tuple[int, ...]
    factor: int | None = None

    def __post_init__(self) -> None:
        few = all(-MAX_TURNS <= v <= MAX_TURNS for v in self.turns)
        require(few, RULE, "loop", f"a number winds more than {MAX_TURNS} times")

    @property
    def winds(self) -> bool:
        return any(self.turns)

    def still(self, what: str) -> Winding:
        """The winding of something periodic that is made of it and of nothing else; it must not wind itself."""
        require(not self.winds, RULE, "loop", f"{what} of a number that winds with an angle")
        return Winding(self.turns)

    def times(self, k: int) -> Winding:
        return Winding(tuple(k * v for v in self.turns))

    def __add__(self, other: Winding) -> Winding:
        return Winding(tuple(v + w for v, w in zip(self.turns, other.turns, strict=True)))

    def __neg__(self) -> Winding:
        return self.times(-1)

    def __mul__(self, other: Winding) -> Winding:
        if self.factor is not None:
            return other.times(self.factor)
        if other.factor is not None:
            return self.times(other.factor)
        other.still("a product")
        return self.still("a product")

    def function(self, name: str) -> Winding:
        return Winding((0,) * len(self.turns)) if name in PERIODIC else self.still(f"'{name}'")


class Windings(OnLists):
    """Networks of windings: vectors are lists of them."""

    def __init__(self, constant: Callable[[fmpq], Winding]) -> None:
        self.constant = constant

    def affine(self, step: Affine, v: list[Winding]) -> list[Winding]:
        nothing = Winding((0,) * len(v[0].turns))
        winding = [(k, x) for k, x in enumerate(v) if x.winds]
        return [
            reduce(add, (x.times(whole(w)) for w, x in ((step.row(i)[k], x) for k, x in winding)), nothing)
            for i in range(step.size)
        ]

    def clip(self, step: Clip, v: list[Winding]) -> list[Winding]:
        return [x.still("a clip") for x in v]

    def observe(self, step: Observe, v: list[Winding]) -> list[Winding]:
        names = dict(zip(step.names, v, strict=True))
        return step.expressions.evaluate(names, self.constant)


def whole(weight: float) -> int:
    """A weight of a number that winds."""
    require(weight.is_integer(), RULE, "loop", f"the weight {weight!r} of a number that winds is no integer")
    return int(weight)
