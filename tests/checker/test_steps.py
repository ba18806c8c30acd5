"""Claims over steps, at a rate, around a level: what is planted beyond the truth is refused, and what lies within it is
accepted. The truth is known in closed form (tests/support/stepped_loops.py), and integrated here once more."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction
from functools import reduce

import numpy as np
import pytest

from certify.checker.document import Certificate
from tests.support.certificates import Document, dump, parse, verdict
from tests.support.marks import slow_after
from tests.support.reference import judge
from tests.support.step_forgeries import BASES, base, forgeries
from tests.support.stepped_loops import Family, families, peaked, shares

FAMILIES = {family.name: family for family in families()}
EVERY = list(FAMILIES)
FIRST = [EVERY[k] for k in (0, 4, 7, 9)]  # one of each kind
RULES = ("centring", "coordinates", "domain", "equilibrium", "flow", "format", "hash", "inputs", "levels", "local",
         "lyapunov", "ring", "root", "tree")  # fmt: skip
EACH = 6  # planted violations of a family


def value(tree: object, names: dict[str, np.ndarray]) -> np.ndarray:
    """An equation of these loops in binary64."""
    if isinstance(tree, str):
        return names[tree] if tree in names else np.asarray(float(Fraction(tree)))
    assert isinstance(tree, list)
    name, *operands = tree
    if name == "**":
        return np.asarray(value(operands[0], names) ** operands[1])
    parts = [value(operand, names) for operand in operands]
    if len(parts) == 1:
        return np.asarray({"-": np.negative, "sin": np.sin, "tanh": np.tanh}[name](parts[0]))
    return np.asarray(reduce({"+": np.add, "*": np.multiply, "/": np.divide, "-": np.subtract}[name], parts))


def policy(c: Certificate, x: np.ndarray) -> np.ndarray:
    """Of one layer, x (n, B)."""
    [[W, bias]], p = [step.arrays for step in c.policy.network.steps], c.policy
    squash = np.tanh if p.squash == "tanh" else lambda v: v
    u = W @ x + (bias[:, None] if p.centre == "none" else 0.0)
    return np.asarray(p.scale[:, None] * squash(u) + p.offset[:, None])


def largest(data: Document) -> float:
    """The largest (D + 2 lambda V) / V on all levels, at constant values at the ends of ranges and of periods."""
    c = parse(data)
    inner = c.c0 if c.practical else 1e-4 * c.c1
    angles = np.linspace(0, 2 * np.pi, 360)
    circle = np.array([[1.0, -1.0]]) if len(c.states) == 1 else np.stack([np.cos(angles), np.sin(angles)])
    circle = np.linalg.inv(np.linalg.cholesky(c.P)).T @ circle
    worst = -math.inf
    for level, q, h in itertools.product(
        (inner, c.c1, c.c2), itertools.product(*c.ranges), set(c.sample or (Fraction(int(c.discrete)),))
    ):
        x = circle * math.sqrt(level)
        u = policy(c, x)

        def f(at: np.ndarray, u: np.ndarray = u, q: tuple[Fraction, ...] = q) -> np.ndarray:
            numbers = [*at, *u, *(np.asarray(float(v)) for v in q)]
            names = dict(zip((*c.states, *c.inputs, *c.uncertain), numbers, strict=True))
            return np.stack([value(tree, names) + 0 * at[0] for tree in c.dynamics.trees])

        V, t = np.sum(x * (c.P @ x), axis=0), float(h)
        if c.discrete:
            rise = np.sum(f(x) * (c.P @ f(x)), axis=0) - V
        elif t == 0:
            rise = 2 * np.sum(x * (c.P @ f(x)), axis=0)
        else:
            after, step = x, t / 64
            for _ in range(64):
                k1 = f(after)
                k2 = f(after + step / 2 * k1)
                k3 = f(after + step / 2 * k2)
                after = after + step / 6 * (k1 + 2 * k2 + 2 * k3 + f(after + step * k3))
            rise = (np.sum(after * (c.P @ after), axis=0) - V) / t
        worst = max(worst, float(np.max(rise / V + 2 * c.rate)))
    return worst


def test_there_are_enough_planted_violations() -> None:
    near = sum(share < 0.05 for share in shares(EACH, np.random.default_rng(0)))
    assert EACH * len(FAMILIES) >= 200 and 2 * near >= EACH


@pytest.mark.parametrize("name", slow_after(4, [*FIRST, *(name for name in EVERY if name not in FIRST)]))
def test_what_is_planted_is_refused_and_what_lies_within_is_accepted(name: str) -> None:
    family: Family = FAMILIES[name]
    generator = np.random.default_rng(len(name))
    for number, share in enumerate(shares(EACH, generator)):
        false, true = family.beyond(share), family.within(family.near * (1 + number / EACH))
        assert largest(false) > 0 > largest(true), share
        assert verdict(false) in ("local", "ring", "flow"), share
        assert verdict(true) == "ACCEPTED", share


@pytest.mark.parametrize("peak", slow_after(3, [0.5, 0.501, 0.52, 0.6, 0.75, 0.9]))
def test_a_step_out_of_what_is_to_be_kept_is_refused(peak: float) -> None:
    """D is negative wherever V >= c0, and from 0 a step leads to the peak, beyond c0."""
    assert largest(peaked(peak)) < 0
    assert verdict(peaked(peak)) == "ring"
    assert verdict(peaked(0.95 - peak)) == "ACCEPTED"


# ------------------------------------------------------------------------------------------------------------ forgeries


@pytest.mark.parametrize("name", BASES)
def test_the_originals_are_accepted(name: str) -> None:
    assert verdict(base(name)) == "ACCEPTED"
    assert largest(base(name)) < 0


@pytest.mark.parametrize("name", BASES)
def test_the_second_checker_accepts_the_originals(name: str) -> None:
    assert judge(base(name)) is None


def test_forgeries_are_refused_by_the_rule_that_is_meant() -> None:
    each = [(rule, what, verdict(data)) for rule, what, data in forgeries()]
    wrong = [f"{what}: {found} in place of {rule}" for rule, what, found in each if found != rule]
    assert not wrong, "\n".join(wrong)
    assert len(each) >= 300 and len({what for _, what, _ in each}) == len(each)
    apart = [what for rule, what, _ in each if rule != "format"]
    assert len(apart) >= 300 and set(RULES) == {rule for rule, *_ in each}


def test_forgeries_differ_from_the_originals() -> None:
    honest = {dump(base(name)) for name in BASES}
    files = [dump(data) for *_, data in forgeries()]
    assert not honest & set(files) and len(set(files)) == len(files)


@pytest.mark.parametrize("rule", RULES)
def test_the_second_checker_refuses_forgeries(rule: str) -> None:
    each = [(what, judge(data)) for stated, what, data in forgeries() if stated == rule]
    wrong = [f"{what}: {found} in place of {rule}" for what, found in each if found != rule]
    assert not wrong, "\n".join(wrong)
