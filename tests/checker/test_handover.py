"""Rule `handover` in both checkers: true claims, forgeries of each part, floors that just do not fit, trajectories."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
import pytest
from flint import fmpq

from certify.checker import document, handover, rules
from certify.checker.case import Case
from certify.checker.errors import Rejected
from certify.checker.words import report
from certify.reference import rules as reference_rules
from certify.reference.__main__ import in_words
from certify.reference.document import read
from certify.reference.handover import gap
from certify.reference.handover import handover as of_reference
from certify.reference.rational import positive_definite
from certify.reference.refusal import Refused
from tests.checker.test_reference_data import true
from tests.checker.test_uncertain import disturbed_claim
from tests.support.balls import with_ball
from tests.support.certificates import Document, decode, edited, encode, grow, make, rehash
from tests.support.earlier import newer
from tests.support.marks import slow_after
from tests.support.steps import stepping

Edit = Callable[[Document], Document]
ACCEPTED = (None, None)


def dumped(data: Document) -> bytes:
    return json.dumps(newer(data)).encode("ascii")


def verdicts(data: Document) -> tuple[str | None, str | None]:
    """The rules that the checker and the reference refuse a document under; None where one accepts."""
    raw = dumped(data)
    try:
        rules.check(document.certificate(json.loads(raw), "0" * 64))
    except Rejected as no:
        by_checker: str | None = no.rule
    else:
        by_checker = None
    found = reference_rules.judge(raw)
    return by_checker, None if found.result == "ACCEPTED" else str(found.rule)


def joined(outer: Document, inner: Document) -> Document:
    return {**newer(outer), "then": newer(inner)}


TERM = ["*", "1/2", "u"]  # of x' = q x + u / 2, which for |x| <= 1 is -x + u / 2 + w, |w| <= 1/10


def near(c2: float = 0.1, P: float = 2.0, **more: Any) -> Document:
    """x' = q x + u / 2 with q in [-11/10, -9/10], u = -tanh(x)."""
    settings: dict[str, Any] = {"uncertain": [("q", "-11/10", "-9/10")], "cells": [1], "centre": "none"} | more
    return grow(make([["+", ["*", "q", "x"], TERM]], [([[1.0]], [0.0])], [[P]], (c2 / 2, c2), **settings))


@cache
def far() -> Document:
    return newer(grow(disturbed_claim()))


@cache
def plain() -> Document:
    return joined(far(), near())


def nearby() -> Document:
    """A second claim that is `nearby`: x' = q x + u / 2 + 1/100."""
    inner = make(
        [["+", ["*", "q", "x"], TERM, "1/100"]], [([[1.0]], [0.0])], [[2.0]], (0.01, 0.1), claim="nearby",
        uncertain=[("q", "-11/10", "-9/10")], cells=[1], centre="none",
    )  # fmt: skip
    ball = {"J": encode([0.071]), "weights": encode([2.0**-40]), "weight": encode([1.0])}
    return joined(far(), grow(edited(inner, "evidence.contraction", ball)))


def in_steps(sample: tuple[str, str] | None) -> Document:
    """The same loop far and near with steps of time."""
    more: dict[str, Any] = {"discrete": True} if sample is None else {"sample": sample, "order": 2}
    term, far_term = ("1/2", "w") if sample is None else ("-1", "w")
    layers = [([[-0.25]], [0.0])]
    outer = stepping(
        [["+", ["*", term, "x"], "u", far_term]], layers, [[1.0]], (0.04, 0.25, 1.0), edge=0.5,
        uncertain=[("w", "-1/100", "1/100")], cells=[1], **more,
    )  # fmt: skip
    inner = stepping([["+", ["*", term, "x"], "u"]], layers, [[1.0]], (0.05, 0.1), **more)
    return joined(outer, inner)


TRUE: dict[str, Callable[[], Document]] = {
    "plain": plain,
    "nearby": nearby,
    "discrete": lambda: in_steps(None),
    "held": lambda: in_steps(("1/20", "1/10")),
    "the same plant": lambda: joined(far(), near(uncertain=[("q", "-1", "-9/10")])),
    "other domains and bounds": lambda: joined(far(), near(domain=(("-2", "5/2"),), input_bounds=(("-4", "2"),))),
    "another name": lambda: edited(plain(), "then.plant.name", "other"),
}


@pytest.mark.parametrize("name", TRUE)
def test_true_claims_are_accepted(name: str) -> None:
    assert verdicts(TRUE[name]()) == ACCEPTED


# ------------------------------------------------------------------------------------------------------------ forgeries


def put(path: str, value: Any) -> Edit:
    return lambda data: edited(data, path, value)


def then(change: Callable[[Document], Document]) -> Edit:
    """An edit of the second certificate, whose hash is that of its policy again."""
    return lambda data: edited(data, "then", lambda inner: rehashed(change(inner)))


def rehashed(inner: Document) -> Document:
    return newer(rehash(inner))


def renamed(old: str, new: str) -> Edit:
    """A name of the second plant that is another, in its equations too."""

    def change(inner: Document) -> Document:
        text = json.dumps(inner["plant"]).replace(f'"{old}"', f'"{new}"')
        return {**inner, "plant": json.loads(text)}

    return put("then", change)


def array(path: str, change: Callable[[Any], Any]) -> Edit:
    return put(path, lambda text: encode(change(decode(text))))


def level(path: str, factor: float) -> Edit:
    return put(path, lambda text: (float.fromhex(text) * factor).hex())


def without(path: str, key: str) -> Edit:
    return put(path, lambda old: {k: v for k, v in old.items() if k != key})


OF_FORMAT: dict[str, Edit] = {
    "null": put("then", None),
    "a list": put("then", []),
    "a word": put("then", "0" * 64),
    "an empty object": put("then", {}),
    "nested": lambda data: edited(data, "then", lambda inner: {**inner, "then": near()}),
    "a practical one": put("then", lambda _: newer(grow(disturbed_claim(floor=0.02)))),
    "a claim that is asymptotic before": lambda _: joined(near(), near()),
    "a nearby one before": lambda data: {**nearby()["then"], "then": near()},
    "no schema": without("then", "schema"),
    "another schema": put("then.schema", "certify-certificate/8"),
    "no provenance": without("then", "provenance"),
    "a provenance that is null": put("then.provenance", None),
    "a key more": put("then", lambda inner: {**inner, "note": ""}),
    "a kind that is unknown": put("then.claim.kind", "stable"),
    "a kind that is null": put("then.claim.kind", None),
    "a claim of the first kind": put("then.claim.kind", "practical"),
    "a claim without V": put("then.claim", {"kind": "invariant", "outer": None}),
    "a claim that is null": put("then.claim", None),
    "a tube": put("then.claim.kind", "enlarged"),
    "levels with a floor": put("then.levels", lambda old: {**old, "floor": (0.01).hex()}),
    "levels without roa": without("then.levels", "roa"),
    "an infinite level": put("then.levels.roa", "inf"),
    "a solver's word": put(
        "then.evidence",
        {"kind": "trusted-solver", "solver": "dReal", "version": "4", "precision": (0.5).hex(), "queries": []},
    ),
    "evidence that is null": put("then.evidence", None),
    "no networks": put("then.networks", []),
    "a range the wrong way round": put("then.plant.uncertain.0.range", ["-9/10", "-11/10"]),
}
OF_HANDOVER: dict[str, Edit] = {
    "a name of a state": renamed("x", "y"),
    "a name of an input": renamed("u", "v"),
    "another u_eq": put("then.plant.u_eq", ["1/1000000"]),
    "another time": put("then.plant.time", "discrete"),
    "an input that is held": put("then.claim.sample", ["1/100", "1/100"]),
    "a policy that is another by a hair": then(
        lambda c: edited(c, "networks.0.steps.0.weight", encode([np.nextafter(1.0, 2.0)]))
    ),
    "a policy with another bias": then(lambda c: edited(c, "networks.0.steps.0.bias", encode([1e-300]))),
    "a policy of the other sign": then(lambda c: edited(c, "policy.scale", encode([1.0]))),
    "a policy that is moved": then(lambda c: edited(c, "policy.offset", encode([1e-9]))),
    "a policy with a clip": then(lambda c: edited(c, "policy.clip", [encode([-2.0]), encode([2.0])])),
    "a policy that is centred": then(lambda c: edited(c, "policy.centre", "output")),
    "an origin": put("policy.origin", encode([1e-9])),
    "a level too low": level("then.levels.roa", 0.7),
    "a level of nothing": put("then.levels.roa", (2.0**-1000).hex()),
    "a level below 0": level("then.levels.roa", -1.0),
    "a level of 0": put("then.levels.roa", (0.0).hex()),
    "a floor too high": lambda data: edited(edited(data, "levels.floor", (0.06).hex()), "levels.local", (0.06).hex()),
    "a form too steep": put("then.lyapunov.P", encode([[3.0]])),
    "a form that is just too steep": put("then.lyapunov.P", encode([[np.nextafter(2.5, 3.0)]])),
}
OF_THE_SECOND: dict[str, tuple[str, Edit]] = {
    "another hash": ("hash", put("then.policy.sha256", "0" * 64)),
    "an equilibrium elsewhere": (
        "equilibrium",
        put("then.plant.dynamics.0", lambda f: ["+", f, "1/1000"]),
    ),
    "levels the wrong way round": ("levels", put("then.levels.local", (0.2).hex())),
    "a form below 0": ("lyapunov", put("then.lyapunov.P", encode([[-2.0]]))),
    "a domain too small": ("domain", put("then.plant.domain", [["-1/10", "1/10"]])),
    "a root too small": ("root", put("then.evidence.root", encode([0.1]))),
    "coordinates without an inverse": ("coordinates", put("then.evidence.T", encode([[0.0]]))),
    "inputs out of bounds": ("inputs", put("then.plant.input_bounds", [["-1/100", "1/100"]])),
    "no ball's width": ("local", put("then.evidence.local.J", encode([[0.01]]))),
    "a tree that is none": ("tree", put("then.evidence.tree", "AAA=")),
    "a range that lets it grow": ("local", put("then.plant.uncertain.0.range", ["-11/10", "1"])),
    "other equations": ("local", put("then.plant.dynamics.0", ["+", ["*", "q", "x"], ["*", "-3", "u"]])),
}
OF_THE_FIRST: dict[str, tuple[str, Edit]] = {
    "a stronger disturbance": ("ring", put("plant.uncertain.0.range", ["-1", "1"])),
    "a domain too small": ("domain", put("plant.domain", [["-1/2", "1/2"]])),
}


@pytest.mark.parametrize("name", OF_FORMAT)
def test_what_is_no_second_certificate_is_refused_under_format(name: str) -> None:
    assert verdicts(OF_FORMAT[name](plain())) == ("format", "format")


@pytest.mark.parametrize("name", OF_HANDOVER)
def test_what_does_not_take_over_is_refused_under_handover(name: str) -> None:
    assert verdicts(OF_HANDOVER[name](plain())) == ("handover", "handover")


@pytest.mark.parametrize("name", OF_THE_SECOND | {f"first: {k}": v for k, v in OF_THE_FIRST.items()})
def test_all_rules_are_about_both(name: str) -> None:
    rule, edit = OF_THE_FIRST[name[7:]] if name.startswith("first: ") else OF_THE_SECOND[name]
    assert verdicts(edit(plain())) == (rule, rule)


def leaves_of(value: Any, path: str) -> list[str]:
    """The places of all numbers, words and empty lists."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [leaf for k, v in inner for leaf in leaves_of(v, f"{path}.{k}")] or [path]


@pytest.mark.parametrize("wrong", ["", {}, 7])
def test_each_field_of_the_second_is_read(wrong: Any) -> None:
    places = [path for path in leaves_of(plain()["then"], "then") if not path.startswith("then.provenance")]
    assert len(places) > 40
    for path in places:
        if not (wrong == 7 and path.endswith((".order", ".cells.0", ".shape.0", ".shape.1", ".of.0", ".reads"))):
            found = verdicts(edited(plain(), path, wrong))
            assert None not in found and set(found) <= {"format", "hash", "tree"}, (path, found)


def test_the_same_edit_is_refused_at_a_place_of_the_second() -> None:
    raw = dumped(OF_THE_SECOND["a domain too small"][1](plain()))
    with pytest.raises(Rejected) as no:
        rules.check(document.certificate(json.loads(raw), ""))
    assert no.value.at == "then.x" == reference_rules.judge(raw).at


def test_periods_must_be_the_same() -> None:
    held = in_steps(("1/20", "1/10"))
    for sample in (["1/20", "1/20"], ["0", "1/10"], ["1/20", "1/9"]):
        assert verdicts(edited(held, "then.claim.sample", sample)) == ("handover", "handover")


# -------------------------------------------------------------------------------------------------- planted violations


def ellipsoids(seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Two forms and a floor, of which the second form is at most about 1."""
    generator = np.random.default_rng(seed)
    n = int(generator.integers(1, 5))
    P, other = (M @ M.T + 0.1 * np.eye(n) for M in generator.normal(size=(2, n, n)))
    half = np.linalg.inv(np.linalg.cholesky(P))
    floor = 2.0 ** int(generator.integers(-20, 20))
    other = other / (float(np.linalg.eigvalsh(half @ other @ half.T)[-1]) * floor)
    return (P + P.T) / 2, (other + other.T) / 2, floor


def of_forms(P: np.ndarray, other: np.ndarray, floor: float, c2: float) -> Document:
    """A file of two certificates, whose evidence shows nothing, about x' = x."""
    n = len(P)
    names = [f"x{i}" for i in range(n)]
    data = newer(make(names, [(np.zeros((1, n)), [0.0])], P, (floor, 2 * floor), claim="practical", states=names,
                      domain=[("-9", "9")] * n, centre="none"))  # fmt: skip
    ball = {"J": encode(np.eye(n)), "multipliers": encode(np.zeros((3, n))), "weight": encode(np.eye(n)),
            "edge": (0.0).hex(), "order": 1}  # fmt: skip
    inner = edited(edited(data, "claim.kind", "asymptotic"), "evidence.local", ball)
    inner = edited(edited(inner, "levels", {"local": c2.hex(), "roa": c2.hex()}), "lyapunov.P", encode(other))
    return {**data, "then": inner}


@pytest.mark.parametrize("seed", slow_after(60, range(200)))
def test_a_floor_that_just_fits_and_one_that_just_does_not(seed: int) -> None:
    """Levels a hair below and above the largest value of the second form on the floor."""
    for c2, fits in ((1 - 1e-9, False), (1 + 1e-9, True)):
        raw = dumped(of_forms(*ellipsoids(seed), c2))
        case = Case(document.certificate(json.loads(raw), ""))
        assert not list(handover.is_same_loop(case))
        assert (not list(handover.is_entered(case))) is fits
        assert positive_definite(gap(read(raw))) is fits


@pytest.mark.parametrize("name", ["a level too low", "a policy of the other sign", "a form that is just too steep"])
def test_some_forgeries_get_through_without_the_rule(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(handover, "OF_HANDOVER", ())
    data = OF_HANDOVER[name](plain())
    if name == "a policy of the other sign":  # which is an honest claim of another loop
        data = edited(data, "then.plant.dynamics.0", ["+", ["*", "q", "x"], ["*", "-1/2", "u"]])
    rules.check(document.certificate(json.loads(dumped(data)), ""))


def test_measurements_of_both_are_around_the_same_point() -> None:
    """The true plants of this file and of the data's are others: only the rule's own parts are looked at."""
    raw, measured = dumped(plain()), dumped(true("scalar"))
    c, of = (document.certificate(json.loads(each), "") for each in (raw, measured))
    other, by = read(raw), read(measured)
    assert of.data is not None and c.then is not None and other.then is not None and by.data is not None
    for shift, fits in ((0, True), (Fraction(1, 10**9), False)):
        moved = replace(of.data, origin=tuple(q + shift for q in of.data.origin))
        case = Case(replace(c, data=of.data, then=replace(c.then, data=moved)))
        assert (not list(handover.is_same_loop(case))) is fits
        also = replace(by.data, origin=tuple(q + fmpq(shift.numerator, shift.denominator) for q in by.data.origin))
        both = replace(other, data=by.data, then=replace(other.then, data=also))
        if fits:
            of_reference(both)
        else:
            with pytest.raises(Refused):
                of_reference(both)
    of_reference(replace(other, data=by.data))


def called(bias: float, levels: tuple[float, float], claim: str) -> Document:
    """x' = -x + f(x) + u, u = -tanh(x), f a network that is this number."""
    equation = ["+", ["-", "x"], ["network", "f", 0, "x"], "u"]
    data = newer(make([equation], [([[1.0]], [0.0])], [[1.0]], levels, claim=claim, centre="none"))
    step = {"kind": "affine", "of": [0], "shape": [1, 1], "weight": encode([[0.0]]), "bias": encode([bias])}
    return grow(with_ball({**data, "networks": [*data["networks"], {"name": "f", "reads": 1, "steps": [step]}]}))


def test_the_same_section_plant_may_call_other_networks() -> None:
    """Each claim is true of its own plant, and one of the first does not converge: it is none of both."""
    outer, inner = called(0.125, (0.04, 0.25), "practical"), called(0.0, (0.05, 0.1), "asymptotic")
    assert outer["plant"] == inner["plant"] and verdicts(joined(outer, inner)) == ACCEPTED
    x = 0.1
    for _ in range(4000):
        x += 0.01 * (-x + 0.125 - np.tanh(x))
    assert abs(x + np.tanh(x) - 0.125) < 1e-9 and x > 0.06


# ---------------------------------------------------------------------------------------------- limits, words, truth


def test_the_words() -> None:
    raw = dumped(plain())
    said = in_words(read(raw))
    assert "once in V <= 0.04, one from V <= 0.1 of the next, which says: plant, policy" in said
    c = document.certificate(json.loads(raw), "")
    tally = rules.check(c)
    assert tally.then is not None
    answer = {"result": "ACCEPTED", "rules": tally.rules, "modules": [], "margins": {"local": None, "ring": None},
              "then": {"rules": tally.then.rules}}  # fmt: skip
    lines = report(c, answer)
    assert any("enters V <= 0.04, which lies in V <= 0.1 of the one below" in line for line in lines)
    assert sum(line.startswith("claim: ") for line in lines) == 2


def test_trajectories_of_plants_of_both_converge() -> None:
    """x' = q(t) x + u / 2 is -x + u / 2 + w with |w| <= 1/5 for |x| <= 1."""
    generator = np.random.default_rng(0)
    for _ in range(20):
        size, phase, x = generator.uniform(0, 0.1), generator.uniform(0, 6), float(generator.choice([-1.0, 1.0]))
        for k in range(4000):
            q = -1 + size * np.sin(0.05 * k + phase)
            assert abs((q + 1) * x) <= 0.2
            x += 0.01 * (q * x - np.tanh(x) / 2)
        assert abs(x) < 1e-6
