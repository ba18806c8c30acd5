"""Forgeries of certificates with activations and steps of all kinds, and violations planted in them: both checkers
refuse each, a forgery under the rule that is meant (tests/support/network_forgeries.py, planted.py)."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.checker.test_networks import checked
from tests.support.network_forgeries import ALL, GROUPS, forgeries
from tests.support.network_loops import honest, raw
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
