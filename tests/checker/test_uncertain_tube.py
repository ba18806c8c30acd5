"""Tubes where something is uncertain, attacked: loops of one state whose limits are known by hand, a spring whose
residual switches against it, and points of the ellipsoids in floats. Both checkers are asked each time.

`decay` is x' = -q x from |x| <= 2 into |x| < 1: of its six coefficients two ask for q > 2/3, the others for less.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from certify import PolicyNetwork, certify_roa
from certify.analysis.options import RoaOptions
from certify.loop.plants import load_system
from tests.checker.test_tube import ball, scalar, slab, verdicts
from tests.support.balls import reached_from
from tests.support.certificates import Document, decode, edited, encode
from tests.support.marks import slow_after

NONE = 2.0**-60
FLAT, BENT = [[0.0], [NONE], [0.0]], [[0.0], [0.0], [NONE]]
Array = np.ndarray
Edit = Callable[[Document], Document]


def decay(lo: str, hi: str, cells: int = 1, equation: Any = None, rows: Any = FLAT) -> Document:
    """x' = -q x, or another equation in x and q."""
    slabs = [slab(0.375, 0.5625, 0.75, 2.125, rows), slab(0.75, 1.0625, 0.5, 1.375, rows)]
    more = {"uncertain": [("q", lo, hi)], "cells": [cells]}
    return scalar(["-", ["*", "q", "x"]] if equation is None else equation, 1.0, ball(1.5, rows), 0.25, slabs, **more)


LIMITS = [
    ("67/100", "1", 1, True),
    ("666667/1000000", "1", 1, True),
    ("666667/1000000", "1000", 4, True),
    ("666666/1000000", "1", 1, False),
    ("2/3", "1", 1, False),
    ("2/3", "1", 64, False),
    ("1/2", "1", 64, False),
    ("0", "1", 1, False),
    ("-1", "1", 1, False),
    ("-3", "-1", 2, False),
]


@pytest.mark.parametrize(("lo", "hi", "cells", "holds"), LIMITS)
def test_the_slowest_decay_decides(lo: str, hi: str, cells: int, holds: bool) -> None:
    """At 2/3 two coefficients are exactly 0."""
    assert verdicts(decay(lo, hi, cells)) == {"ACCEPTED" if holds else "local" if lo.startswith(("0", "-")) else "tube"}


RESIDUALS = [
    (["+", ["-", "x"], ["*", "q", "x"]], ("-1/4", "1/4"), True),
    (["+", ["-", "x"], ["*", "q", "x"]], ("-1/3", "1/3"), False),
    (["+", ["-", "x"], ["*", "q", "x"]], ("-33333/100000", "33333/100000"), True),
    (["+", ["-", "x"], ["*", "q", ["**", "x", 3]]], ("-1/100", "1/100"), True),
    (["+", ["-", "x"], ["*", "q", ["**", "x", 3]]], ("-1/11", "1/11"), False),
]


@pytest.mark.parametrize(("equation", "ends", "holds"), RESIDUALS)
def test_a_residual_may_take_what_decay_is_left(equation: Any, ends: tuple[str, str], holds: bool) -> None:
    """A third of the decay at 0, and of the cubic one 1/12 at x = 2, the start, where 1 - 4 q is 2/3."""
    rows = FLAT if equation[2][2] == "x" else BENT
    assert verdicts(decay(*ends, equation=equation, rows=rows)) == {"ACCEPTED" if holds else "tube"}


@pytest.mark.parametrize("most", ["4/3", "133333/100000"])
def test_the_last_cell_counts(most: str) -> None:
    """x' = -(2 - q) x: its decay is slowest at the upper end."""
    found = verdicts(decay("1", most, 64, ["-", ["*", ["+", "2", ["-", "q"]], "x"]]))
    assert found == {"tube" if most == "4/3" else "ACCEPTED"}


KEPT = [
    ("q", "3", False),
    ("q", "31/10", False),
    ("q", "32/10", True),
    (["-", "q"], "7/5", False),
    (["-", "q"], "3/2", True),
]


@pytest.mark.parametrize(("more", "most", "holds"), KEPT)
def test_a_constraint_is_kept_for_every_value(more: Any, most: str, holds: bool) -> None:
    """x + q or x - q below a number in every cell, on balls that reach 2.125: the last or the first cell decides."""
    data = decay("67/100", "1", 4)
    data["claim"]["keep"] = [["+", "x", more, ["-", most]]]
    assert verdicts(data) == {"ACCEPTED" if holds else "keep"}


@pytest.mark.parametrize(("least", "holds"), [("7/10", True), ("2/3", False), ("1/2", False)])
def test_more_quantities_than_have_corners(least: str, holds: bool) -> None:
    """x' = -(q1 + ... + q8) x / 8."""
    names = [f"q{k}" for k in range(1, 9)]
    data = decay(least, "1", equation=["-", ["/", ["*", ["+", *names], "x"], "8"]])
    data["plant"]["uncertain"] = [{"name": name, "range": [least, "1"]} for name in names]
    data["evidence"]["cells"] = [1] * 8
    assert verdicts(data) == {"ACCEPTED" if holds else "tube"}


def test_a_residual_that_does_not_vanish_has_no_tube() -> None:
    """The origin is no equilibrium: refused before the tube, whatever its size."""
    found = verdicts(decay("-1/1000000", "1/1000000", equation=["+", ["-", "x"], "q"]))
    assert "ACCEPTED" not in found and found <= {"equilibrium"}


def test_a_tube_along_a_path_has_none() -> None:
    """The same file without the uncertain quantity is read, and refused under its rule."""
    data = decay("67/100", "1")
    data["claim"] = reached_from([0.25], [0.0])
    path = {"centre": encode([0.0])} | {key: (0.5).hex() for key in ("share", "edge", "motion", "joint")}
    for one in data["evidence"]["tube"]:
        one |= {"path": path, "weight": encode(np.eye(2))}
    assert verdicts(data) == {"format"}
    known = edited(edited(data, "plant.uncertain", []), "evidence.cells", [])
    assert verdicts(edited(known, "plant.dynamics.0", ["-", "x"])) == {"tube"}


def measured() -> Document:
    """The section `data` of a claim about q of `decay`, with one transition."""
    run = {"steps": 1, "states": encode([1.0, 0.5]), "inputs": encode([0.0])}
    prior = {"name": "q", "range": ["67/100", "1"]}
    times = {"period": ["1", "1"], "origin": ["0"], "noise": ["1"]}
    return {"sha256": "0" * 64, "parameters": [prior], **times, "runs": [run]}


FOREIGN: dict[str, Edit] = {
    "discrete time": lambda data: edited(data, "plant.time", "discrete"),
    "a sample": lambda data: edited(data, "claim.sample", ["1/100", "1/100"]),
    "a rate": lambda data: edited(data, "claim.rate", (0.25).hex()),
    "ranks": lambda data: edited(data, "claim.ranks", {"angles": [], "steps": 5}),
    "samples": lambda data: edited(data, "claim.samples", []),
    "data without evidence": lambda data: edited(data, "claim.data", measured()),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_a_tube_has_no_steps_rate_ranks_or_samples(name: str) -> None:
    assert verdicts(FOREIGN[name](decay("67/100", "1"))) == {"format"}


@pytest.mark.parametrize("kind", ["enlarged", "reached"])
def test_data_belong_to_a_tube_around_the_origin_alone(kind: str) -> None:
    """The evidence is a round that narrows nothing; where data are allowed it is refused for what it does not show."""
    data = decay("67/100", "1")
    if kind == "reached":
        data["claim"] = reached_from([0.25], [0.0])
    data["claim"]["data"] = measured()
    tree = {"order": 1, "pieces": 1, "tree": "/w==", "leaves": [[]], "rounds": []}
    assert verdicts(edited(data, "evidence.data", tree)) == {"ACCEPTED" if kind == "enlarged" else "format"}


# -------------------------------------------------------------------------------------------------- the command's own

SPRING = """name = "soft_spring"
states = ["p", "v"]
inputs = ["F"]
[parameters]
k = {k}
[dynamics]
p = "v"
v = "-p + k*p**3 - 2*v + F"
[residual]
v = "{e}"
[u_eq]
F = 0
[domain]
p = [-2, 2]
v = [-2, 2]
[input_bounds]
F = [-1, 1]
"""


@cache
def spring(e: str, k: str = "0.25") -> Document:
    """As the command writes it, with residuals of a size."""
    network = PolicyNetwork.of_layers(
        weights=([[-0.3, -0.2]],), biases=([0.0],), scale=[1.0], offset=[0.0], squash="tanh", centre="none"
    )
    with TemporaryDirectory() as folder:
        path = Path(folder)
        (path / "soft.toml").write_text(SPRING.format(e=e, k=k))
        system = load_system(path / "soft.toml")
        options = RoaOptions(candidate="lyapunov", level=0.3, enlarge=True)
        result = certify_roa(system, network, path / "out", options)
        assert (result.verdict.value, result.claim) == ("PROVED", "enlarged")
        return json.loads((path / "out" / "certificate.json").read_text())


SIZES = ["0.05*v", "0.2*v", "0.1*p**2", "0.1*abs(p) + 0.1*v"]


def rates(x: Array, w: Array, e: str, k: float | Array) -> Array:
    p, v = x.T
    bound = eval(e, {"p": p, "v": v, "abs": np.abs})
    return np.stack([v, -p + k * p**3 - 2 * v + np.tanh(-0.3 * p - 0.2 * v) + w * bound], 1)


def nodes_of(data: Document) -> list[tuple[float, Array, Array, Array]]:
    before, found = decode(data["claim"]["start"]).reshape(2, 2), list[Any]()
    for one in data["evidence"]["tube"]:
        middle, end = (decode(one[key]).reshape(2, 2) for key in ("middle", "end"))
        found.append((float.fromhex(one["duration"]), before, middle, end))
        before = end
    return found


@pytest.mark.parametrize(("e", "k"), slow_after(1, [("0.1*v", "[0.2, 0.3]"), *((e, "0.25") for e in reversed(SIZES))]))
def test_trajectories_stay_in_the_tube_whatever_the_residual_does(e: str, k: str) -> None:
    """It switches at random, or at each step against the tube; it reaches the set in time."""
    data, draw, N = spring(e, k), np.random.default_rng(7), 300
    assert verdicts(data) == {"ACCEPTED"}
    slabs, ends = nodes_of(data), (0.2, 0.3) if k.startswith("[") else (0.25, 0.25)
    angle, P = draw.uniform(0, 2 * np.pi, N), slabs[0][1]
    x = np.linalg.solve(np.linalg.cholesky(P).T, np.stack([np.cos(angle), np.sin(angle)])).T
    against, most = np.arange(N) % 2 == 0, 0.0
    for h, before, middle, end in slabs:
        for step in range(8):
            s = step / 8
            at = (1 - s) ** 2 * before + 2 * s * (1 - s) * middle + s * s * end
            push = (x @ at)[:, 1]
            w = np.where(
                against,
                np.where(push * rates(x, np.ones(N), e, 0)[:, 1] - push * rates(x, -np.ones(N), e, 0)[:, 1] > 0, 1, -1),
                draw.choice([-1, 1], N),
            )
            stiff = np.where(push * x[:, 0] ** 3 > 0, ends[1], ends[0])
            for _ in range(4):
                mid = x + h / 64 * rates(x, w, e, stiff)
                x = x + h / 32 * rates(mid, w, e, stiff)
        W = np.einsum("ki,ij,kj->k", x, end, x)
        most = max(most, float(W.max()))
    assert most <= 1 + 1e-6
    V = decode(data["lyapunov"]["P"]).reshape(2, 2)
    assert np.einsum("ki,ij,kj->k", x, V, x).max() <= float.fromhex(data["levels"]["roa"])


@pytest.mark.slow
@pytest.mark.parametrize("e", slow_after(1, SIZES))
def test_what_is_accepted_holds_at_points_and_wider_ranges_are_refused(e: str) -> None:
    """As its range grows a residual is refused before condition 7 fails at any point that is drawn."""
    data, draw, refused, failed = spring(e), np.random.default_rng(3), 0, 0
    assert [q["name"] for q in data["plant"]["uncertain"]] == ["residual_v"]
    for factor in (1.0, 1.01, 1.1, 2.0, 5.0, 10.0, 20.0):
        wider = edited(data, "plant.uncertain.0.range", [f"{-factor!r}", f"{factor!r}"]) if factor > 1 else data
        holds = all(_falls(draw, factor, e, *one) for one in nodes_of(data))
        found = verdicts(wider)
        assert holds or "ACCEPTED" not in found
        refused, failed = refused + ("ACCEPTED" not in found), failed + (not holds)
    assert refused >= failed > 0


def _falls(
    draw: np.random.Generator, factor: float, e: str, h: float, before: Array, middle: Array, end: Array
) -> bool:
    s, w = draw.uniform(0, 1, 400)[:, None, None], draw.choice([-factor, factor], 400)
    P = (1 - s) ** 2 * before + 2 * s * (1 - s) * middle + s * s * end
    rate = 2 * ((1 - s) * (middle - before) + s * (end - middle)) / h
    x = draw.normal(size=(400, 2))
    x *= (draw.uniform(0, 1, 400) ** 0.5 / np.sqrt(np.einsum("ki,kij,kj->k", x, P, x)))[:, None]
    F = rates(x, w, e, 0.25)
    return bool(np.all(np.einsum("ki,kij,kj->k", x, rate, x) + 2 * np.einsum("ki,kij,kj->k", x, P, F) < 0))
