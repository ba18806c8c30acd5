"""Rule `data` in both checkers: true claims, forgeries of each part, and true parameters that no box may lose."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest

from certify.reference.__main__ import in_words
from certify.reference.document import read
from tests.checker.test_reference_ranks import certificate, scaled, within
from tests.checker.test_uncertain import scaled_claim, spring_claim
from tests.support.certificates import Document, decode, dump, edited, encode, grow, make
from tests.support.marks import slow_after
from tests.support.measured import SHA256, Claim, Experiment, claimed, derived, with_data
from tests.support.rank_forgeries import verdicts
from tests.support.ranked import Loop, affine, around_level
from tests.support.steps import stepping

Edit = Callable[[Document], Document]


def spring(x: Any, u: Any, p: Any) -> Sequence[Any]:
    return [x[1], (-p[1] * x[1] - x[0] + u[0]) / p[0]]


SPRING = Experiment(
    spring, ("m", "b"), (1.02, 0.97), (("9/10", "11/10"), ("9/10", "11/10")), ((0.5, 0.0), (-0.5, 0.5)), 10,
    ("1/10", "1/10"), ("1/1000", "1/500"), ("1/3", "0"),
)  # fmt: skip
SCALAR = Experiment(
    lambda x, u, p: [p[0] * x[0] + u[0]], ("q",), (0.6,), (("0", "1"),), ((1.0,), (-1.5,)), 8, ("1/10", "1/10"),
    ("1/1000",), ("0",),
)  # fmt: skip
STEPS = replace(SCALAR, f=lambda x, u, p: [p[0] * x[0] + u[0]], period=None, order=1, drift=0.01)
TURNED = replace(
    SPRING, f=lambda x, u, p: spring(x, u, (p[0] + p[1], p[0] / 2 - p[1] + 0.5)), names=("s", "d"), truth=(0.99, 0.03),
    priors=(("9/10", "11/10"), ("-1/10", "1/10")), axes=(("m", "0", ("1", "1")), ("b", "1/2", ("1/2", "-1"))),
)  # fmt: skip
SUM = replace(
    SCALAR, f=lambda x, u, p: [(p[0] + p[1]) * x[0] + u[0]], names=("a", "b"), truth=(0.35, 0.25),
    priors=(("0", "1/2"), ("0", "1/2")), axes=(("q", "0", ("1", "1")),),
)  # fmt: skip
HALVES = bytes([0, 255, 0, 255, 255])


def of_spring(ranges: Sequence[tuple[str, str]]) -> Document:
    (m, b) = ranges
    return grow(spring_claim(uncertain=[("m", *m), ("b", *b)]))


def of_scalar(ranges: Sequence[tuple[str, str]]) -> Document:
    return grow(scaled_claim(["*", "q", "x"], ("q", *ranges[0]), cells=[1]))


def of_steps(ranges: Sequence[tuple[str, str]]) -> Document:
    """x+ = q x + u + w, u = -x/2, for all |w| <= 1/100."""
    return stepping(
        [["+", ["*", "q", "x"], "u", "w"]], [([[-0.5]], [0.0])], [[1.0]], (0.01, 1.0, 1.0), discrete=True, edge=0.5,
        uncertain=[("w", "-1/100", "1/100"), ("q", *ranges[0])], cells=[1, 1],
    )  # fmt: skip


def held(ranges: Sequence[tuple[str, str]]) -> Document:
    """x' = q x + u with an input that is held."""
    return stepping(
        [["+", ["*", "q", "x"], "u"]], [([[-1.0]], [0.0])], [[1.0]], (0.25, 0.75), sample=("1/20", "1/10"), order=2,
        uncertain=[("q", *ranges[0])], cells=[1],
    )  # fmt: skip


def ranked(ranges: Sequence[tuple[str, str]]) -> Document:
    """x+ = q x + u, u = -x/10, with boxes that lead into |x| <= 1/4 in steps that shrink x to 0.55 of it or less."""
    loop = Loop([["+", ["*", "q", "x"], "u"]], [affine([[-0.1]])], None, uncertain=[("q", *ranges[0])])
    return around_level(certificate(loop, scaled(0.525, wide=0.05), within(0.24))[0], 16.0, 1.0)


TRUE: dict[str, tuple[Experiment, Claim]] = {
    "spring": (SPRING, of_spring),
    "a range of periods": (replace(SPRING, period=("99/1000", "1/10"), pieces=2), of_spring),
    "scalar": (SCALAR, of_scalar),
    "parts of the priors": (replace(SCALAR, tree=HALVES), of_scalar),
    "discrete": (STEPS, of_steps),
    "with ranks": (replace(STEPS, priors=(("2/5", "13/20"),), drift=0.0), ranked),
    "held": (replace(SCALAR, rounds=1), held),
    "pieces": (replace(SCALAR, order=5, pieces=4), of_scalar),
    "axes": (TURNED, of_spring),
    "an axis of two parameters": (SUM, of_scalar),
    "an axis in steps": (
        replace(STEPS, f=SUM.f, names=SUM.names, truth=SUM.truth, priors=SUM.priors, axes=SUM.axes),
        of_steps,
    ),
}


@cache
def true(name: str) -> Document:
    return claimed(*TRUE[name])


@pytest.mark.parametrize("noise", [Fraction(1, 100), Fraction(1, 1000), Fraction(0)])
def test_a_known_box(noise: Fraction) -> None:
    """x+ = q x from 1 to 1/2: q lies from (1/2 - noise)/(1 + noise) to (1/2 + noise)/(1 - noise)."""
    once = replace(STEPS, f=lambda x, u, p: [p[0] * x[0]], truth=(0.5,), noise=(str(noise),), size=0.0, steps=1,
                   starts=((1.0,),), drift=0.0)  # fmt: skip
    data = edited(with_data(of_steps([("0", "1")]), once), "plant.dynamics", [["*", "q", "x"]])
    data = edited(data, f"{SAID}.runs.0.states", encode([1.0, 0.5]))
    ((lo, hi),), _, _ = derived(data, 4)
    exact = (Fraction(1, 2) - noise) / (1 + noise), (Fraction(1, 2) + noise) / (1 - noise)
    for end, sign, q in ((lo, 1, exact[0]), (hi, -1, exact[1])):
        assert 0 <= sign * (q - Fraction(str(end))) <= Fraction(1, 10**9) + 4 * noise**2


@pytest.mark.parametrize("name", TRUE)
def test_a_true_claim(name: str) -> None:
    assert verdicts(true(name)) == (None, None)


def weights_of(data: Document) -> str:
    """Those of some round."""
    fit = found(data, FIT)
    return str((fit["rounds"] or fit["leaves"][0])[0]["weights"])


def test_the_words() -> None:
    said = in_words(read(dump(true("a range of periods"))))
    assert "of all constants m in [9/10, 11/10], b in [9/10, 11/10] none is consistent with the 20 transitions" in said
    assert f"{SHA256}; measured x + 1/3 +- 1/1000, v +- 1/500, each over some time in [99/1000, 1/10]" in said
    assert "each over" not in in_words(read(dump(true("discrete"))))


# ------------------------------------------------------------------------------------------------------------ forgeries


def put(path: str, value: Any) -> Edit:
    """An edit of one entry, which a value replaces, or value(old)."""
    return lambda data: edited(data, path, value)


def without(path: str, key: str) -> Edit:
    return put(path, lambda old: {k: v for k, v in old.items() if k != key})


def array(path: str, change: Callable[[Any], Any]) -> Edit:
    """An edit of an array."""
    return put(path, lambda old: encode(change(decode(old))))


def entry(at: int, change: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The change of one entry of an array."""

    def changed(values: Any) -> Any:
        values[at] = change(values[at])
        return values

    return changed


def weights(k: int, change: Callable[[Any], Any]) -> Edit:
    """An edit of the multipliers of round k, (2, 2, 20, 2)."""
    return array(f"{FIT}.rounds.{k}.weights", lambda w: change(w.reshape(2, 2, 20, 2)))


def moved(path: str, shift: str) -> Edit:
    """An edit of a rational."""
    return put(path, lambda old: str(Fraction(old) + Fraction(shift)))


def ends(path: str, shares: tuple[float, float]) -> Edit:
    """An edit of a pair, whose ends move up by shares of its width."""

    def change(pair: list[str]) -> list[str]:
        lo, hi = map(Fraction, pair)
        return [str(end + Fraction(share) * (hi - lo)) for end, share in zip((lo, hi), shares, strict=True)]

    return put(path, change)


def box(k: int, j: int, shares: tuple[float, float]) -> Edit:
    """An edit of the box of round k in the same way."""

    def change(values: Any) -> Any:
        values = values.reshape(2, 2)
        values[:, j] += np.array(shares) * (values[1, j] - values[0, j])
        return values

    return array(f"{FIT}.rounds.{k}.box", change)


def swapped(*paths: str) -> Edit:
    """An edit that gives two entries to each other."""

    def swap(data: Document) -> Document:
        values = [found(data, path) for path in paths]
        for path, value in zip(paths, reversed(values), strict=True):
            data = edited(data, path, value)
        return data

    return swap


def found(data: Any, path: str) -> Any:
    for key in path.split("."):
        data = data[int(key) if key.isdigit() else key]
    return data


SAID, FIT, M, B = "claim.data", "evidence.data", "plant.uncertain.0", "plant.uncertain.1"
PRIOR, RUN = f"{SAID}.parameters", f"{SAID}.runs.0"
NAN, INFINITY = encode([np.nan] * 80), encode([np.inf] + [0.0] * 79)
OF_FORMAT: dict[str, Edit] = {
    "no measurements": without("claim", "data"),
    "no evidence": without("evidence", "data"),
    "measurements that are null": put(SAID, None),
    "evidence that is null": put(FIT, None),
    "a key more": put(f"{SAID}.sensor", "S1"),
    "no noise": without(SAID, "noise"),
    "a hash too short": put(f"{SAID}.sha256", SHA256[1:]),
    "a hash too long": put(f"{SAID}.sha256", SHA256 + "0"),
    "a hash of other letters": put(f"{SAID}.sha256", SHA256[1:] + "g"),
    "a hash and a line": put(f"{SAID}.sha256", SHA256 + "\n"),
    "a hash that is a number": put(f"{SAID}.sha256", 7),
    "no parameters": put(PRIOR, []),
    "a parameter that the plant does not have": put(f"{PRIOR}.0.name", "k"),
    "a parameter that is a state": put(f"{PRIOR}.0.name", "x"),
    "a parameter twice": put(f"{PRIOR}.1.name", "m"),
    "a parameter that is a list": put(f"{PRIOR}.0.name", ["m"]),
    "a prior the wrong way round": put(f"{PRIOR}.0.range", ["11/10", "9/10"]),
    "a prior of one number": put(f"{PRIOR}.0.range", ["1", "1"]),
    "a prior in decimals": put(f"{PRIOR}.0.range", ["0.9", "1.1"]),
    "a prior without an end": put(f"{PRIOR}.0.range", ["1"]),
    "no period": put(f"{SAID}.period", None),
    "a period of 0": put(f"{SAID}.period", ["0", "1/10"]),
    "a period before": put(f"{SAID}.period", ["-1/10", "1/10"]),
    "a period the wrong way round": put(f"{SAID}.period", ["1/10", "1/11"]),
    "a period of three": put(f"{SAID}.period", ["1/10"] * 3),
    "an origin too short": put(f"{SAID}.origin", ["1/3"]),
    "an origin that is binary64": put(f"{SAID}.origin", ["0x1.0p+0", "0"]),
    "a noise too long": put(f"{SAID}.noise", ["1/1000"] * 3),
    "a noise below 0": put(f"{SAID}.noise", ["1/1000", "-1/500"]),
    "no runs": put(f"{SAID}.runs", []),
    "a run of no steps": put(f"{SAID}.runs.0", {"steps": 0, "states": encode([0.0, 0.0]), "inputs": ""}),
    "steps that are true": put(f"{RUN}.steps", True),
    "steps that are a word": put(f"{RUN}.steps", "10"),
    "a step more": put(f"{RUN}.steps", 11),
    "a step less": put(f"{RUN}.steps", 9),
    "steps below 0": put(f"{RUN}.steps", -10),
    "steps beyond all": put(f"{RUN}.steps", 2**16 + 1),
    "a state less": array(f"{RUN}.states", lambda x: x[2:]),
    "an input less": array(f"{RUN}.inputs", lambda u: u[1:]),
    "no states": put(f"{RUN}.states", ""),
    "a state that is no number": array(f"{RUN}.states", entry(3, lambda x: np.nan)),
    "an infinite state": array(f"{RUN}.states", entry(3, lambda x: -np.inf)),
    "an infinite input": array(f"{RUN}.inputs", entry(0, lambda u: np.inf)),
    "a run less": put(f"{SAID}.runs", lambda runs: runs[1:]),
    "a run twice": put(f"{SAID}.runs", lambda runs: [*runs, runs[0]]),
    "order 0": put(f"{FIT}.order", 0),
    "order 9": put(f"{FIT}.order", 9),
    "an order that is true": put(f"{FIT}.order", True),
    "no pieces": put(f"{FIT}.pieces", 0),
    "65 pieces": put(f"{FIT}.pieces", 65),
    "rounds that are an object": put(f"{FIT}.rounds", {}),
    "65 rounds": put(f"{FIT}.rounds", lambda rounds: rounds[:1] * 65),
    "65 rounds of a leaf": put(f"{FIT}.leaves", [[None] * 65]),
    "multipliers that are missing": array(f"{FIT}.rounds.0.weights", lambda w: w[1:]),
    "no multipliers": put(f"{FIT}.rounds.0.weights", ""),
    "multipliers that are no numbers": put(f"{FIT}.rounds.0.weights", NAN),
    "an infinite multiplier": put(f"{FIT}.rounds.0.weights", INFINITY),
    "an infinite box": put(f"{FIT}.rounds.0.box", encode([-np.inf, -np.inf, np.inf, np.inf])),
    "a box of one parameter": put(f"{FIT}.rounds.0.box", encode([0.9, 1.1])),
    "a round without a box": without(f"{FIT}.rounds.0", "box"),
    "a round with a name": put(f"{FIT}.rounds.0.name", "first"),
    "no leaves": put(f"{FIT}.leaves", []),
    "a tree that is no base64": put(f"{FIT}.tree", "/w="),
    "a tree that is null": put(f"{FIT}.tree", None),
}
TINY = 4e-6  # of a width: the boxes are wider than the bounds by a millionth on each side
OF_DATA: dict[str, Edit] = {
    "a range narrower from below": ends(f"{M}.range", (1e-6, 0.0)),
    "a range narrower from above": ends(f"{M}.range", (0.0, -1e-6)),
    "another range narrower from below": ends(f"{B}.range", (1e-6, 0.0)),
    "another range narrower from above": ends(f"{B}.range", (0.0, -1e-6)),
    "a range that is moved": ends(f"{M}.range", (1e-6, 1e-6)),
    "a first box narrower from below": box(0, 0, (TINY, 0.0)),
    "a first box narrower from above": box(0, 0, (0.0, -TINY)),
    "a box narrower from below": box(1, 1, (TINY, 0.0)),
    "a box narrower from above": box(1, 1, (0.0, -TINY)),
    "a box of which nothing is left": box(1, 0, (0.6, -0.6)),
    "a first box of which nothing is left": box(0, 0, (0.6, -0.6)),
    "a box that is wider than the ranges": box(1, 0, (-1e-6, 0.0)),
    "ranges that go to each other": swapped(f"{M}.range", f"{B}.range"),
    "names that go to each other": swapped(f"{M}.name", f"{B}.name"),
    "names of priors that do": swapped(f"{PRIOR}.0.name", f"{PRIOR}.1.name"),
    "a wider prior": ends(f"{PRIOR}.0.range", (-1e-3, 0.0)),
    "another wider prior": ends(f"{PRIOR}.1.range", (0.0, 1e-3)),
    "a far wider prior": put(f"{PRIOR}.0.range", ["-1", "3"]),
    "a prior elsewhere": put(f"{PRIOR}.0.range", ["2", "3"]),
    "more noise": moved(f"{SAID}.noise.0", "1/100000"),
    "more noise of the speed": moved(f"{SAID}.noise.1", "1/100000"),
    "noise of all that there is": put(f"{SAID}.noise", ["1" + "0" * 400] * 2),
    "an origin that is moved": moved(f"{SAID}.origin.0", "1/10000"),
    "another origin that is moved": moved(f"{SAID}.origin.1", "-1/10000"),
    "a shorter period": put(f"{SAID}.period", ["1/11", "1/11"]),
    "a period a little longer": put(f"{SAID}.period", ["1001/10000", "1001/10000"]),
    "a range of periods": put(f"{SAID}.period", ["1/10", "1001/10000"]),
    "a period of a year": put(f"{SAID}.period", ["31557600", "31557600"]),
    "a lower order": put(f"{FIT}.order", 2),
    "order 1": put(f"{FIT}.order", 1),
    "an input that is moved": array(f"{RUN}.inputs", lambda u: u + 1e-3),
    "inputs that change sign": array(f"{RUN}.inputs", lambda u: -u),
    "states that are scaled": array(f"{RUN}.states", lambda x: 1.001 * x),
    "states that change places": array(f"{RUN}.states", lambda x: x.reshape(-1, 2)[:, ::-1]),
    "a run backwards": array(f"{RUN}.states", lambda x: x.reshape(-1, 2)[::-1]),
    "states far away": array(f"{RUN}.states", lambda x: 1e300 * x),
    "runs that go to each other": swapped(f"{SAID}.runs.0", f"{SAID}.runs.1"),
    "the first round left out": put(f"{FIT}.rounds", lambda rounds: rounds[1:]),
    "the last round left out": put(f"{FIT}.rounds", lambda rounds: rounds[:1]),
    "no rounds": put(f"{FIT}.rounds", []),
    "rounds that go to each other": swapped(f"{FIT}.rounds.0", f"{FIT}.rounds.1"),
    "their boxes alone": swapped(f"{FIT}.rounds.0.box", f"{FIT}.rounds.1.box"),
    "their multipliers alone": swapped(f"{FIT}.rounds.0.weights", f"{FIT}.rounds.1.weights"),
    "multipliers that are 0": weights(1, lambda w: 0 * w),
    "multipliers that are -0": weights(1, lambda w: -0.0 * w),
    "those of lower bounds that are 0": weights(1, lambda w: w * [[[[0.0]]], [[[1.0]]]]),
    "those of upper bounds that are 0": weights(1, lambda w: w * [[[[1.0]]], [[[0.0]]]]),
    "lower for upper bounds": weights(1, lambda w: w[::-1]),
    "multipliers of the other parameter": weights(1, lambda w: w[:, ::-1]),
    "multipliers of the next transition": weights(1, lambda w: np.roll(w, 1, 2)),
    "multipliers of the other state": weights(1, lambda w: w[..., ::-1]),
    "multipliers with the other sign": weights(1, lambda w: -w),
    "multipliers twice as large": weights(1, lambda w: 2 * w),
    "multipliers that are a little larger": weights(0, lambda w: 1.001 * w),
    "the largest multiplier left out": weights(1, lambda w: np.where(np.abs(w) < np.abs(w).max(), w, 0.0)),
    "huge multipliers": weights(1, lambda w: np.sign(w) * 1.7e308),
    "huge multipliers and nothing left": lambda data: weights(1, lambda w: w * 1e300)(box(1, 0, (9.0, -9.0))(data)),
    "tiny multipliers": weights(1, lambda w: np.sign(w) * 5e-324),
    "a plant that is another": put("plant.dynamics.1.2", lambda m: ["*", "1001/1000", m]),
    "a tree of two leaves": put(f"{FIT}.tree", base64.b64encode(bytes([0, 255, 255])).decode()),
    "an axis that there is not": put(f"{FIT}.tree", base64.b64encode(bytes([2, 255, 255])).decode()),
    "no tree": put(f"{FIT}.tree", ""),
    "bytes behind the tree": put(f"{FIT}.tree", base64.b64encode(bytes([255, 255])).decode()),
    "a tree that ends early": put(f"{FIT}.tree", base64.b64encode(bytes([0, 255])).decode()),
}


@pytest.mark.parametrize("name", OF_FORMAT)
def test_forgeries_of_the_form(name: str) -> None:
    assert verdicts(OF_FORMAT[name](true("spring"))) == ("format", "format")


@pytest.mark.parametrize("name", OF_DATA)
def test_forgeries_of_the_data(name: str) -> None:
    assert verdicts(OF_DATA[name](true("spring"))) == ("data", "data")


# ---------------------------------------------------------------------------------------------------------------- axes

WEIGHTS: dict[str, Callable[[np.random.Generator, Any], Any]] = {
    "nearly": lambda chance, w: w * (1 + 1e-3 * chance.standard_normal(w.shape)),
    "any": lambda chance, w: chance.standard_normal(w.shape) * chance.choice([1.0, 1e2, 1e4]),
    "few": lambda chance, w: np.where(chance.random(w.shape) < 0.1, w, 0.0) + w[0] * 1e-300,
    "huge": lambda chance, w: chance.choice([1.0, -1.0, 0.5, -0.5, 0.0], w.shape) * 1.7e308,
    "huge, of both signs": lambda chance, w: np.sign(w) * chance.choice([1.7e308, 1e308, 1e150], w.shape),
    "tiny": lambda chance, w: chance.choice([5e-324, -5e-324, 1e-310], w.shape),
}
AXES, TURN, BY = f"{SAID}.axes", f"{FIT}.turned", f"{SAID}.axes.0.by"
OF_AXES_FORMAT: dict[str, Edit] = {
    "no axes": without(SAID, "axes"),
    "axes that are empty": put(AXES, []),
    "axes that are null": put(AXES, None),
    "no multipliers": without(FIT, "turned"),
    "multipliers that are null": put(TURN, None),
    "multipliers of one axis": array(TURN, lambda w: w[: len(w) // 2]),
    "multipliers that are no numbers": array(TURN, lambda w: np.nan * w),
    "an axis less": put(AXES, lambda axes: axes[:1]),
    "an axis twice": put(f"{AXES}.1.name", "m"),
    "an axis that the plant does not have": put(f"{AXES}.0.name", "s"),
    "an axis that is a state": put(f"{AXES}.0.name", "x"),
    "an axis that is a list": put(f"{AXES}.0.name", ["m"]),
    "an axis of another key": put(f"{AXES}.0.from", "0"),
    "an axis without a place": without(f"{AXES}.0", "at"),
    "a place in decimals": put(f"{AXES}.0.at", "0.5"),
    "a factor in decimals": put(f"{BY}.0", "1.5"),
    "a factor that is divided by 0": put(f"{BY}.0", "1/0"),
    "a factor less": put(BY, ["1"]),
    "a factor more": put(BY, ["1", "1", "0"]),
    "a parameter that is a quantity": put(f"{PRIOR}.0.name", "m"),
    "a parameter that is a state": put(f"{PRIOR}.0.name", "x"),
    "a parameter that is an input": put(f"{PRIOR}.0.name", "u"),
    "a parameter twice": put(f"{PRIOR}.1.name", "s"),
    "a parameter that is no name": put(f"{PRIOR}.1.name", "2 d"),
    "a parameter that is a number": put(f"{PRIOR}.1.name", 2),
    "no parameters": lambda data: put(f"{AXES}.1.by", [])(put(BY, [])(put(PRIOR, [])(data))),
}


def turned(change: Callable[[Any], Any]) -> Edit:
    """An edit of the axes' multipliers, (2, 2, 20, 2)."""
    return array(TURN, lambda w: change(w.reshape(2, 2, 20, 2)))


OF_AXES: dict[str, Edit] = {
    "a range narrower from below": ends(f"{M}.range", (TINY, 0.0)),
    "a range narrower from above": ends(f"{M}.range", (0.0, -TINY)),
    "another range narrower from below": ends(f"{B}.range", (TINY, 0.0)),
    "another range narrower from above": ends(f"{B}.range", (0.0, -TINY)),
    "ranges that go to each other": swapped(f"{M}.range", f"{B}.range"),
    "axes that do": swapped(f"{AXES}.0.name", f"{AXES}.1.name"),
    "an axis that is moved": moved(f"{AXES}.0.at", "1/1000000"),
    "another that is moved": moved(f"{AXES}.1.at", "-1/1000000"),
    "a larger factor": moved(f"{BY}.0", "1/10000"),
    "a smaller factor": moved(f"{BY}.1", "-1/10"),
    "a factor of the other sign": put(f"{AXES}.1.by.1", "1"),
    "factors that go to each other": swapped(f"{AXES}.1.by.0", f"{AXES}.1.by.1"),
    "factors of all that there is": put(BY, ["1" + "0" * 400] * 2),
    "a place beyond all": put(f"{AXES}.0.at", "-1" + "0" * 400),
    "wider priors": ends(f"{PRIOR}.0.range", (-1e-3, 1e-3)),
    "multipliers that are 0": turned(lambda w: 0 * w),
    "multipliers that are -0": turned(lambda w: -0.0 * w),
    "those of lower bounds that are 0": turned(lambda w: w * [[[[0.0]]], [[[1.0]]]]),
    "those of upper bounds that are 0": turned(lambda w: w * [[[[1.0]]], [[[0.0]]]]),
    "lower for upper bounds": turned(lambda w: w[::-1]),
    "multipliers of the other axis": turned(lambda w: w[:, ::-1]),
    "multipliers of the next transition": turned(lambda w: np.roll(w, 1, 2)),
    "multipliers of the other state": turned(lambda w: w[..., ::-1]),
    "multipliers of the other sign": turned(lambda w: -w),
    "multipliers twice as large": turned(lambda w: 2 * w),
    "multipliers that are a little larger": turned(lambda w: 1.001 * w),
    "huge multipliers": turned(lambda w: np.sign(w) * 1.7e308),
    "tiny multipliers": turned(lambda w: np.sign(w) * 5e-324),
    "no rounds": put(f"{FIT}.rounds", []),
    "a wider box before": box(1, 0, (-0.1, 0.0)),
    "more noise": moved(f"{SAID}.noise.0", "1/100000"),
    "another input": array(f"{RUN}.inputs", lambda u: u + 1e-3),
    "a plant that is another": put("plant.dynamics.1.2", lambda m: ["*", "1001/1000", m]),
}


@pytest.mark.parametrize("name", OF_AXES_FORMAT)
def test_forgeries_of_the_form_of_axes(name: str) -> None:
    assert verdicts(OF_AXES_FORMAT[name](true("axes"))) == ("format", "format")


@pytest.mark.parametrize("name", OF_AXES)
def test_forgeries_of_axes(name: str) -> None:
    assert verdicts(OF_AXES[name](true("axes"))) == ("data", "data")


def test_axes_where_the_claim_has_none() -> None:
    assert verdicts(put(TURN, encode([1.0] * 160))(true("spring"))) == ("format", "format")
    ranges = [q["range"] for q in true("spring")["plant"]["uncertain"]]
    wide = put(AXES, [{"name": q, "at": "0", "by": by} for q, by in (("m", ["1", "0"]), ("b", ["0", "1"]))])
    renamed = put(f"{PRIOR}.0.name", "m0")(put(f"{PRIOR}.1.name", "b0")(wide(true("spring"))))
    assert verdicts(put(TURN, encode([1.0] + [0.0] * 159))(renamed)) == ("data", "data"), ranges


@pytest.mark.parametrize("name", slow_after(1, ["axes", "an axis of two parameters", "an axis in steps"]))
@pytest.mark.parametrize("kind", WEIGHTS)
def test_no_multipliers_of_axes_exclude_the_truth(name: str, kind: str) -> None:
    """The range of an axis ends just before its true value, and all other ranges are as wide as can be."""
    data, tried, chance = true(name), TRUE[name][0], np.random.default_rng(len(name))
    best = decode(data["evidence"]["data"]["turned"])
    for axis, at, by in tried.axes:
        value = float(Fraction(at)) + sum(float(Fraction(q)) * p for q, p in zip(by, tried.truth, strict=True))
        for end in (0, 1):
            forged = put(TURN, encode(WEIGHTS[kind](chance, best)))(data)
            for k, quantity in enumerate(data["plant"]["uncertain"]):
                pair = ["-1000", "1000"]
                if quantity["name"] == axis:
                    pair[end] = str(Fraction(value + (1 - 2 * end) * 1e-9))
                forged = put(f"plant.uncertain.{k}.range", pair)(forged)
            assert verdicts(forged) == ("data", "data")


@pytest.mark.parametrize("size", ["huge", "tiny"])
def test_axes_without_rounds_and_a_bound_that_is_no_number(size: str) -> None:
    """Sums of multipliers and noise exceed binary64; or they say nothing of any axis."""
    alone = put(f"{FIT}.rounds", [])(put(f"{SAID}.noise.0", "1000")(true("an axis in steps")))
    value = {"huge": 1.7e308, "tiny": 5e-324}[size]
    assert verdicts(array(TURN, lambda w: np.full_like(w, value))(alone)) == ("data", "data")


def test_a_factor_of_an_axis_that_is_rounded_much() -> None:
    """q = 3/2^1075 p, a factor that binary64 rounds up by a third; x+ = 2^74 q x from 1 to 3/4 has p = 2^999."""
    most = 2**1000
    once = replace(STEPS, f=lambda x, u, p: [x[0]], names=("p",), noise=("0",), size=0.0, steps=1, starts=((1.0,),),
                   drift=0.0, priors=((str(-most), str(most)),), axes=(("q", "0", (f"3/{2**1075}",)),))  # fmt: skip
    data = edited(
        with_data(of_steps([(f"-{10**30}", str(10**30))]), once), "plant.dynamics", [["*", str(2**74), ["*", "q", "x"]]]
    )
    data = edited(data, f"{SAID}.runs.0.states", encode([1.0, 0.75]))
    box = encode([0.3 * 2.0**1000, 0.4 * 2.0**1000])
    wrong = edited(data, f"{FIT}.rounds", [{"box": box, "weights": encode([0.5, 0.5])}])
    assert verdicts(wrong) == ("data", "data")


def unknown_axis(most: str, weight: float) -> Document:
    """x+ = x/2 with q = 2^53 + p, of which data say nothing: p in [5/24, 11/24], q in [0, most]."""
    once = replace(STEPS, f=lambda x, u, p: [x[0] / 2], names=("p",), truth=(0.3,), noise=("1/1000",), size=0.0,
                   steps=1, starts=((1.0,),), drift=0.0, priors=(("5/24", "11/24"),),
                   axes=(("q", str(2**53), ("1",)),))  # fmt: skip
    data = edited(with_data(of_steps([("0", "1")]), once), "plant.dynamics", [["/", "x", "2"]])
    return put(TURN, encode([weight] * 2))(put("plant.uncertain.1.range", ["0", most])(data))


def test_the_end_of_an_axis_is_rounded_outwards() -> None:
    """q reaches up to 2^53 + 11/24, which binary64 rounds to 2^53."""
    assert "data" not in verdicts(unknown_axis(str(2**53 + 100), 1e-9))
    assert verdicts(unknown_axis(f"{10 * 2**53 + 3}/10", 1e-9)) == ("data", "data")
    assert verdicts(unknown_axis(str(2**53 + Fraction(11, 24) - Fraction(1, 10**30)), 1e-9)) == ("data", "data")


def test_multipliers_of_axes_are_not_all_0() -> None:
    """In ranges that hold all that the priors allow, too."""
    assert verdicts(unknown_axis(str(2**53 + 100), 0.0)) == ("data", "data")


# -------------------------------------------------------------------------------------------------- parts of the priors

NOTHING, LEAVES = encode([1.2, 0.9]), f"{FIT}.leaves"
OF_LEAVES: dict[str, Edit] = {
    "a leaf without rounds": put(f"{LEAVES}.0", []),
    "the last leaf without rounds": put(f"{LEAVES}.2", []),
    "leaves that go to each other": swapped(f"{LEAVES}.0", f"{LEAVES}.2"),
    "a leaf with the true value of which nothing is left": put(f"{LEAVES}.1.0.box", NOTHING),
    "the same by the multipliers of another": put(f"{LEAVES}.1", lambda rounds: [{**rounds[0], "box": NOTHING}]),
    "a leaf of which too little is left": array(f"{LEAVES}.2.0.box", lambda both: both + np.array([TINY, 0.0])),
    "a leaf less": put(LEAVES, lambda leaves: leaves[:2]),
    "a leaf more": put(LEAVES, lambda leaves: [*leaves, []]),
    "another tree": put(f"{FIT}.tree", base64.b64encode(bytes([0, 0, 255, 255, 255])).decode()),
    "the second axis": put(f"{FIT}.tree", base64.b64encode(bytes([1, 255, 0, 255, 255])).decode()),
    "priors that are wider": put(f"{PRIOR}.0.range", ["0", "2"]),
}


@pytest.mark.parametrize("name", OF_LEAVES)
def test_forgeries_of_parts_of_the_priors(name: str) -> None:
    assert verdicts(OF_LEAVES[name](true("parts of the priors"))) == ("data", "data")


def test_rounds_behind_nothing_do_not_matter() -> None:
    data = true("parts of the priors")
    behind = {"box": encode([0.1, 0.2]), "weights": encode([0.0] * 32)}
    assert verdicts(edited(data, f"{LEAVES}.0", lambda rounds: [*rounds, behind])) == (None, None)
    assert verdicts(edited(data, f"{LEAVES}.0", lambda rounds: [behind, *rounds])) == ("data", "data")


def test_nothing_that_is_left_proves_nothing() -> None:
    """The upper quarter of the priors has no consistent parameter, which both see, and refuse."""
    data = edited(true("parts of the priors"), f"{PRIOR}.0.range", ["3/4", "1"])
    data[FIT.split(".", maxsplit=1)[0]]["data"] |= {
        "tree": "/w==",
        "leaves": [found(data, f"{LEAVES}.2")],
        "rounds": [],
    }
    assert verdicts(data) == ("data", "data")
    wide = edited(data, "plant.uncertain.0.range", ["0", "1"])
    assert verdicts(wide) == ("data", "data")


# ------------------------------------------------------------------------------------------------------ true parameters


def excluding(data: Document, j: int, end: int, value: float, weights: Any) -> Document:
    """One round whose box ends just before a value, and is as wide as can be elsewhere."""
    priors = found(data, PRIOR)
    lo, hi = np.array([[float(Fraction(q)) for q in each["range"]] for each in priors]).T
    box = np.array([lo, hi]) + np.outer([-1, 1], hi - lo)
    box[end, j] = value + (1 - 2 * end) * 1e-9 * (hi - lo)[j]
    data = edited(data, f"{FIT}.rounds", [{"box": encode(box), "weights": encode(weights)}])
    for name, (a, b) in zip([each["name"] for each in priors], box.T.tolist(), strict=True):
        (k,) = [k for k, q in enumerate(data["plant"]["uncertain"]) if q["name"] == name]
        data = edited(data, f"plant.uncertain.{k}.range", [str(Fraction(a) - 1), str(Fraction(b) + 1)])
    return data


@pytest.mark.parametrize(
    ("name", "kind"), slow_after(12, product(["scalar", "discrete", "spring", "a range of periods"], WEIGHTS))
)
def test_no_multipliers_exclude_the_truth(name: str, kind: str) -> None:
    """Measured numbers are at the ends of the noise, so that bounds come close to the true parameters."""
    data, chance = true(name), np.random.default_rng(len(name))
    best = decode(data["evidence"]["data"]["rounds"][0]["weights"])
    for j, value in enumerate(TRUE[name][0].truth):
        for end in (0, 1):
            forged = excluding(data, j, end, value, WEIGHTS[kind](chance, best))
            assert verdicts(forged) == ("data", "data")
            beyond = edited(forged, f"{FIT}.rounds.0.box", lambda old: encode(decode(old)[::-1]))
            assert verdicts(beyond) == ("data", "data")


@pytest.mark.parametrize("seed", slow_after(1, range(20)))
def test_sums_that_exceed_binary64(seed: int) -> None:
    """x+ = q x without noise: all that is summed cancels in truth, and in parts of a sum it is infinite."""
    chance = np.random.default_rng(seed)
    exact = replace(STEPS, f=lambda x, u, p: [p[0] * x[0]], truth=(0.5,), priors=(("1/4", "9/16"),), noise=("0",),
                    drift=0.0, size=0.0, starts=((1.0,), (-1.0,)), steps=8)  # fmt: skip
    data = with_data(of_steps([("1/4", "9/16")]), exact)
    data = edited(data, "plant.uncertain.0.range", [f"-1/{10**300}", f"1/{10**300}"])
    for _ in range(25):
        w = chance.choice([1.7e308, -1.7e308, 1e308, -1e308, 1.0, 0.0], (2, 1, 16, 1)) * chance.choice([1.0, 2.0**-8])
        for end in (0, 1):
            forged = excluding(data, 0, end, 0.5, w)
            assert verdicts(forged) == ("data", "data")
            nothing = edited(forged, f"{FIT}.rounds.0.box", encode([0.6, 0.3]))
            assert verdicts(nothing) == ("data", "data")


def pendulum(chance: np.random.Generator, discrete: bool) -> Experiment:
    """omega' = -a sin theta - b omega + k u, in discrete time in Euler steps, with random parameters in the priors."""
    middle = np.array([9.0, 0.5, 2.0])
    wide = middle * chance.choice([0.05, 0.2, 0.4])
    truth = middle + wide * chance.uniform(-1, 1, 3) * chance.choice([1.0, 0.5])
    least = Fraction(int(chance.integers(5, 30)), 200)

    def f(x: Any, u: Any, p: Any) -> Sequence[Any]:
        rate = [x[1], -p[0] * np.sin(x[0]) - p[1] * x[1] + p[2] * u[0]]
        return [x[0] + rate[0] / 20, x[1] + rate[1] / 20] if discrete else rate

    priors = [(str(Fraction(a - b)), str(Fraction(a + b))) for a, b in zip(middle.tolist(), wide.tolist(), strict=True)]
    starts = tuple((float(a), float(b)) for a, b in chance.uniform(-2, 2, (chance.integers(1, 4), 2)))
    return Experiment(
        f, ("a", "b", "k"), tuple(truth.tolist()), tuple(priors), starts, int(chance.integers(2, 9)),
        None if discrete else (str(least), str(least * Fraction(100 + int(chance.integers(2)), 100))),
        tuple(f"{chance.integers(1, 20)}/10000" for _ in range(2)), ("2/7", "-1/7"), rounds=int(chance.integers(1, 4)),
        order=1 if discrete else int(chance.integers(1, 6)), pieces=1 if discrete else int(chance.integers(1, 4)),
        size=float(chance.choice([0.0, 1.0, 5.0])), seed=int(chance.integers(2**30)),
        tree=[b"\xff", bytes([0, 255, 255]), bytes([0, 1, 255, 255, 2, 255, 255])][chance.integers(3)],
    )  # fmt: skip


@pytest.mark.parametrize("seed", slow_after(3, range(200)))
def test_true_parameters_stay(seed: int) -> None:
    """In the box that random multipliers leave, and in what both programs can be told."""
    chance, discrete = np.random.default_rng(seed), seed % 4 == 0
    tried = pendulum(chance, discrete)
    rate = ["+", ["-", ["*", "a", ["sin", "x"]]], ["-", ["*", "b", "v"]], ["*", "k", "u"]]
    steps = [["+", "x", ["/", "v", "20"]], ["+", "v", ["/", rate, "20"]]]
    claim = make(
        steps if discrete else ["v", rate], [([[0.0, -0.5]], [0.0])], np.eye(2), (0.01, 0.01), states=("x", "v"),
        domain=[("-2", "2")] * 2, squash="identity", centre="none", scale=[1.0], claim="practical", cells=[1] * 3,
        uncertain=[(q, "0", "99") for q in tried.names], time="discrete" if discrete else "continuous",
    )  # fmt: skip
    data = with_data(claim, tried)
    left, _, rounds = derived(data, tried.rounds)
    for (lo, hi), value in zip(left, tried.truth, strict=True):
        assert Fraction(str(lo)) <= Fraction(value) <= Fraction(str(hi))
    whole = edited(edited(data, f"{FIT}.tree", "/w=="), LEAVES, [[]])
    _, _, made = derived(whole, 1)
    best = decode(made[0]["weights"]) if made else np.ones(12 * tried.steps * len(tried.starts))
    for j, value in enumerate(tried.truth):
        for end in (0, 1):
            w = best * (1 + chance.choice([0.0, 1e-9, 0.1]) * chance.standard_normal(best.shape))
            assert verdicts(excluding(whole, j, end, value, w)) == ("data", "data")
    assert verdicts(edited(data, f"{FIT}.rounds", rounds))[1] != "format"
