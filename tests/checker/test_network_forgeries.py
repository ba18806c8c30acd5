"""Forgeries of certificates with activations and steps of all kinds, and violations planted in them: both checkers
refuse each, a forgery under the rule that is meant (tests/support/network_forgeries.py, planted.py)."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.checker.test_networks import checked
from tests.support.network_forgeries import ALL, GROUPS, forgeries
from tests.support.network_loops import ACTIVATIONS, honest, raw
from tests.support.planted import planted
from tests.support.reference import judge_bytes

Program = Callable[[bytes], str | None]
PROGRAMS = pytest.mark.parametrize("program", [checked, judge_bytes], ids=["checker", "reference"])


@PROGRAMS
def test_the_originals_are_accepted(program: Program) -> None:
    for name, form in ALL:
        assert program(raw(honest(name, form))) is None, (name, form)


def refuse_all(group: str, few: bool, program: Program) -> None:
    each = [(rule, what, program(raw(data))) for rule, what, data in forgeries(group, few)]
    wrong = [f"{what}: {found} in place of {rule}" for rule, what, found in each if found != rule]
    assert not wrong, "\n".join(wrong)


@PROGRAMS
@pytest.mark.parametrize("group", GROUPS)
def test_forgeries_are_refused_by_the_rule_that_is_meant(group: str, program: Program) -> None:
    refuse_all(group, True, program)


@pytest.mark.slow
@PROGRAMS
@pytest.mark.parametrize("group", ["evidence", "claims"])
def test_the_other_forgeries_are_too(group: str, program: Program) -> None:
    refuse_all(group, False, program)


def test_forgeries_are_many_and_differ() -> None:
    """From each other and from the originals; more than 300 of a policy whose hash is its own."""
    found = [forgery for group in GROUPS for forgery in forgeries(group, True)]
    files = [raw(data) for *_, data in found]
    assert len(set(files)) == len(files) == len({what for _, what, _ in found}) > 2200
    assert not {raw(honest(*base)) for base in ALL} & set(files)
    assert sum(rule not in ("format", "hash") for rule, *_ in found) > 300
    rules = {
        "format",
        "hash",
        "levels",
        "lyapunov",
        "equilibrium",
        "domain",
        "coordinates",
        "root",
        "centring",
        "local",
    }
    rules |= {"inputs", "flow", "tree", "ring", "tube", "contraction", "faces", "outer"}
    assert {rule for rule, *_ in found} == rules


# ----------------------------------------------------------------------------------------------------------- violations

PLANTED = 200  # of each function


@pytest.mark.parametrize(
    ("name", "seeds"),
    [(name, range(3)) for name in ACTIVATIONS]
    + [pytest.param(name, range(3, PLANTED), marks=pytest.mark.slow) for name in ACTIVATIONS],
)
def test_planted_violations_are_refused(name: str, seeds: range) -> None:
    """Vdot is positive at a state that Arb names, by a ten thousandth of what it was or by more."""
    for seed in seeds:
        made = planted(name, seed)
        assert made.rise > 0
        file = raw(made.certificate)
        for program in (checked, judge_bytes):
            assert program(file) in ("local", "inputs", "ring"), seed


@pytest.mark.slow
@pytest.mark.parametrize("name", ACTIVATIONS)
def test_bumps_of_half_the_height_are_often_proved(name: str) -> None:
    """So that what is refused above is refused for its height."""
    each = [planted(name, seed, 0.5) for seed in range(40)]
    assert all(made.rise < 0 for made in each)
    assert sum(checked(raw(made.certificate)) is None for made in each) >= 10
    assert sum(judge_bytes(raw(made.certificate)) is None for made in each) >= 10
