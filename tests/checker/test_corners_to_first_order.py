"""Abs of what may be 0 in the middle of a ball, in equations: known to first order. Attacks on both programs.

Random equations lie in their models at sampled d, in 300 bits; loops are accepted up to near the level where their drag
turns them, and false claims are not, however the corner is hidden.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import arb

from certify.checker import document
from certify.checker.ball import Ball
from certify.checker.case import Case
from tests.checker.test_attack_activations import (
    DEFINITIONS,
    PROGRAMS,
    Array,
    Claim,
    behind,
    closer,
    contracts,
    is_limited,
    lies_in_the_checkers,
    lies_in_the_references,
    many_digits,
    of_the_reference,
    on_a_ball,
    sampled,
)
from tests.checker.test_attack_networks import call
from tests.checker.test_networks import hash_of
from tests.support.certificates import Document, encode, make
from tests.support.earlier import newer
from tests.support.marks import slow_after

__all__ = ["many_digits"]
ABS: Any = ["abs", "x"]
DRAG: Any = ["*", "x", ABS]


# -------------------------------------------------------------------------------------------------------------- models


def bent(rng: Any, depth: int) -> Any:
    """A tree whose corners are in the middle, or moved away by q, or by a policy's value that is nearly 0."""
    leaf = ["x", "y", "q", "u", ["+", "x", "q"], ["*", "1/3", "y"]]
    if depth == 0:
        return leaf[int(rng.integers(len(leaf)))]
    a, b = bent(rng, depth - 1), bent(rng, int(rng.integers(depth)))
    kinds: list[Any] = [
        ["abs", a], ["abs", a], ["*", a, ["abs", b]], ["*", ["abs", a], ["abs", b]], ["+", a, ["abs", b]],
        ["max", a, "0"], ["min", a, b], ["clip", a, "-1/8", "0"], ["sin", ["abs", a]], ["*", a, b],
        ["/", a, ["+", "2", ["*", ["abs", b], ["abs", b]]]], ["tanh", ["-", a, ["abs", b]]], ["**", ["abs", a], 3],
    ]  # fmt: skip
    return kinds[int(rng.integers(len(kinds)))]


def random_equations(seed: int) -> tuple[Document, Array]:
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-4, -0.3)
    reach = Fraction(scale * float(rng.choice([1e-9, 1e-3, 0.05, 1.0])))
    middle, at, W = Fraction(str(rng.choice(["0", "0", "1/1000"]))), rng.normal(size=2), rng.normal(size=(1, 2))
    data = newer(make(
        [["+", "x", "u"], ["+", "y", "u"]], [(W, rng.choice([0.0, 1e-17, 1e-3], 1) - W @ at)], np.eye(2),
        (1.0, 1.0), states=("x", "y"), inputs=("u",), u_eq=("0",), domain=[("-9", "9")] * 2,
        input_bounds=[("-999", "999")], squash="tanh", centre="none", scale=[1.5], offset=[0.0],
        claim="nearby", time=str(rng.choice(["discrete", "continuous"])),
        uncertain=[("q", str(middle - reach), str(middle + reach))],
    ))  # fmt: skip
    data["plant"]["dynamics"] = [["+", bent(rng, 3), ["*", "q", "u"]], bent(rng, 2)]
    J = rng.normal(size=(2, 2)) * scale
    data["evidence"]["contraction"] = {"J": encode(J), "weights": encode([1.0, 1.0]), "weight": encode(np.eye(2))}
    data["policy"]["origin"] = encode(at)
    data["policy"]["sha256"] = hash_of(data)
    return data, J


@pytest.mark.usefixtures("many_digits")
@pytest.mark.parametrize("seed", slow_after(25, range(400)))
def test_equations_at_corners_lie_in_the_models_of_both_programs(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """For each q of the cell, values at d = 0 and on the ball, with Lipschitz constants of what is left."""
    for name in ("sin", "tanh"):
        monkeypatch.setitem(DEFINITIONS, name, getattr(arb, name))
    rng, (data, J) = np.random.default_rng(seed), random_equations(seed)
    c = document.certificate(json.loads(json.dumps(data)), "")
    with np.errstate(all="ignore"):
        G = Ball(Case(c), J, "here").change(c.ranges)
    theirs = of_the_reference(data, J, c.ranges[0])
    for share, j, start, own in sampled(c, J, rng, 8):
        if np.all(np.isfinite(G[j].remainder)) and np.isfinite(G[j].slack.top):
            lies_in_the_checkers(G[j], share, start, own)
        if theirs is not None:
            lies_in_the_references(theirs[j].where([share]), start, own)


@pytest.mark.parametrize("tree", [DRAG, ["*", ["max", "x", "0"], "x"], ["**", ABS, 3], ["*", ABS, ["sin", "x"]]])
def test_what_is_multiplied_by_0_is_of_second_order(tree: Any) -> None:
    data = json.loads(on_a_ball(tree, 0.25))
    with np.errstate(all="ignore"):
        (f,) = Ball(Case(document.certificate(data, "")), np.array([[0.25]]), "here").F()
        size, slack = abs(float(f.a.value[0])), float(f.slack.top)
        assert size == 0.0 and slack < 1e-300 and float(f.remainder[0, 0]) < 2 * 0.25**2
        assert float(f.lipschitz.top) < 8 * 0.25**2


# ------------------------------------------------------------------------------- loops that the drag makes unstable

GAIN: Any = [{"name": "q", "range": ["0", "4"]}]
MOVED: Any = [{"name": "q", "range": ["-1/16", "1/16"]}]
HELD: Any = {"sample": ["1/8", "1/4"]}


def of(k: str, tree: Any = DRAG) -> Any:
    """k times a term, less x."""
    return ["-", ["*", k, tree], "x"]


def around_a_level(r: float) -> bytes:
    """With 2 x F + (x^2 - c0)/2 < 0 on the ball."""
    data = json.loads(on_a_ball(of("4"), r))
    data["claim"]["kind"] = "practical"
    data["levels"]["floor"] = (0.0004).hex()
    data["evidence"]["local"]["edge"] = (0.5).hex()
    return json.dumps(data).encode()


def on_one_side(tree: Any, r: float) -> bytes:
    """Half of the term is 2 x^2, with the multiplier that is best for it."""
    data = json.loads(on_a_ball(of("4", tree), r))
    data["evidence"]["local"]["multipliers"] = encode([[0.0], [0.0], [2 * r**3]])
    return json.dumps(data).encode()


CLAIMS: dict[str, tuple[Claim, float, float]] = {  # up to which r it is true, and what is shown
    "drag of the wrong sign": (lambda r: on_a_ball(of("4"), r), 0.25, 0.98),
    "a weak linear part": (lambda r: on_a_ball(["-", DRAG, ["*", "1/1000", "x"]], r), 0.001, 0.98),
    "to the right only": (lambda r: on_one_side(["*", ["max", "x", "0"], "x"], r), 0.25, 0.95),
    "to the left only": (lambda r: on_one_side(["*", ["min", "x", "0"], ["-", "x"]], r), 0.25, 0.95),
    "a cube": (lambda r: on_a_ball(of("16", ["*", ["**", ABS, 2], "x"]), r), 0.25, 0.98),
    "of a sine": (lambda r: on_a_ball(of("4", ["*", ABS, ["sin", "x"]]), r), 0.2514, 0.9),
    "of a function": (lambda r: on_a_ball(of("4", ["*", ["sin", ABS], "x"]), r), 0.2527, 0.8),
    "divided": (lambda r: on_a_ball(of("4", ["/", DRAG, ["+", "1", ABS]]), r), 1 / 3, 0.4),
    "abs of abs": (lambda r: on_a_ball(of("4", ["*", "x", ["abs", ["-", ABS, ["*", "2", ABS]]]]), r), 0.25, 0.3),
    "any gain": (lambda r: on_a_ball(of("q"), r, uncertain=GAIN), 0.25, 0.95),
    "discrete time": (lambda r: on_a_ball(["*", "4", DRAG], r, time="discrete"), 0.25, 0.95),
    "an overshoot": (
        lambda r: on_a_ball(["-", ["/", "x", "2"], ["*", "4", DRAG]], r, time="discrete"), 0.375, 0.3,
    ),
    "around a level": (around_a_level, 0.27, 0.6),
    "a network's value": (
        lambda r: on_a_ball(of("4", ["*", "x", ["abs", call("f", "x")]]), r, behind("softsign", shift=0.0)),
        1 / 3, 0.6,
    ),
    "a slope beside it": (lambda r: on_a_ball(["+", ["*", "1/2", ABS], of("4")], r), 0.125, 0.95),
}  # fmt: skip


@PROGRAMS
@pytest.mark.parametrize("name", CLAIMS)
def test_drag_of_the_wrong_sign_limits_a_ball(name: str, program: Callable[[bytes], str | None]) -> None:
    is_limited(program, *CLAIMS[name])


@PROGRAMS
@pytest.mark.parametrize("k", [1, 4, 1000])
def test_a_level_a_trillionth_above_the_limit_is_refused(k: int, program: Callable[[bytes], str | None]) -> None:
    """x' = k x |x| - x turns at x = 1/k exactly."""
    for share in (1 + 1e-9, 1 + 1e-12):
        assert program(on_a_ball(of(str(k)), share / k)) == "local"
    assert program(on_a_ball(of(str(k)), (1 - 1e-6) / k)) is None


FALSE: dict[str, Any] = {  # loops that leave each ball around 0, on one side at least
    "abs alone": ABS,
    "minus abs alone": ["-", ABS],
    "a steep corner": of("1001/1000", ABS),
    "a steep corner to the left": of("-1001/1000", ABS),
    "max": of("1001/1000", ["max", "x", "0"]),
    "min": of("1001/1000", ["min", "x", "0"]),
    "of a max of two": of("1/2", ["max", ["*", "2001/1000", "x"], "x"]),
    "a clip": of("2", ["clip", "x", "0", "1"]),
    "two corners that add up": ["+", of("1/2", ABS), ["*", "501/1000", ABS]],
    "a scaled corner": ["-", ["*", "1001/1000", ["abs", ["*", "x", "3"]]], ["*", "3", "x"]],
    "drag without damping": DRAG,
    "drag against too little": ["-", ["*", "1/1000000", "x"], DRAG],
    "a factor that is not 0": of("1", ["*", ["+", "x", "1001/1000"], ABS]),
    "a sine of it": of("1001/1000", ["sin", ["*", "2", ABS]]),
    "a tanh of it": of("2", ["tanh", ABS]),
    "an inverse of it": of("2", ["-", ["/", "1", ["-", "1", ABS]], "1"]),
    "a root of it": of("3", ["-", ["sqrt", ["+", "1", ABS]], "1"]),
    "an exponential of it": of("2", ["-", ["exp", ABS], "1"]),
    "abs of it": of("2", ["abs", ["-", ["*", "2", ABS], ABS]]),
    "times 1": of("2", ["*", ABS, ["cos", "x"]]),
    "over 1": of("2", ["/", ABS, ["+", "1", DRAG]]),
}  # fmt: skip


@PROGRAMS
@pytest.mark.parametrize("name", FALSE)
@pytest.mark.parametrize("r", [1e-6, 0.01])
def test_a_loop_that_leaves_is_refused(name: str, r: float, program: Callable[[bytes], str | None]) -> None:
    for time in ("continuous", "discrete"):
        tree = FALSE[name] if time == "continuous" else ["+", "x", FALSE[name]]
        assert program(on_a_ball(tree, r, time=time)) == "local"


@PROGRAMS
@pytest.mark.parametrize("tree", [ABS, ["max", "x", ["*", "1/2", "x"]], ["sin", ABS], ["tanh", ["abs", ["-", "x"]]]])
def test_a_corner_that_the_decay_exceeds_is_shown(tree: Any, program: Callable[[bytes], str | None]) -> None:
    for k in ("9/10", "-9/10"):
        assert program(on_a_ball(of(k, tree), 0.01)) is None


# ---------------------------------------------------------------------------------------------------------- contraction


@pytest.mark.parametrize("time", ["continuous", "discrete"])
def test_contraction_ends_where_the_slope_of_drag_does(time: str) -> None:
    """8 |x| is the slope of 4 x |x|, and x' = 4 x |x| - x contracts for |x| < 1/8; so do its steps, 4 x |x|."""
    tree = of("4") if time == "continuous" else ["*", "4", DRAG]
    assert contracts(closer(tree, None, 0.02, time, 1e-9)) == {"checker", "reference"}
    for r in (0.12500001, 0.15, 1.0):
        assert not contracts(closer(tree, None, r, time, 1e-9))


def test_contraction_ends_where_the_slope_of_a_square_does() -> None:
    """4 |x^2| is within 4 r^2 of 0, and twice as steep."""
    tree = of("4", ["abs", ["*", "x", "x"]])
    assert contracts(closer(tree, None, 0.03, "continuous", 1e-9)) == {"checker", "reference"}
    for r in (0.12500001, 0.15, 0.2):
        assert not contracts(closer(tree, None, r, "continuous", 1e-9))


@pytest.mark.parametrize("name", FALSE)
def test_pairs_that_part_at_a_corner_are_refused(name: str) -> None:
    for r in (1e-6, 0.01):
        assert not contracts(closer(FALSE[name], None, r, "continuous", 1e-9))


def test_contraction_with_a_slope_that_leaps() -> None:
    """-x + k |x| contracts for |k| < 1."""
    assert contracts(closer(of("1/4", ABS), None, 0.1, "continuous", 1e-9)) == {"checker", "reference"}
    for k in ("1001/1000", "-1001/1000", "3"):
        assert not contracts(closer(of(k, ABS), None, 0.1, "continuous", 1e-9))
