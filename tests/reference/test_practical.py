"""The reference on claim `practical`: everything ends in {V <= c0}, and nothing else covers what is inside."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.support.balls import with_ball
from tests.support.certificates import LEAF, Document, edited, make, rehash, with_tree
from tests.support.reference import CONTINUOUS, judge, judge_bytes

SPLIT = 0


def practical(data: Document, floor: float | None = None) -> Document:
    """The claim with c1 as c0, or with another c0."""
    result = edited(data, "claim", {"kind": "practical", **CONTINUOUS})
    result["evidence"]["local"], levels = None, data["levels"]
    least = levels["local"] if floor is None else floor.hex()
    result["levels"] = {"floor": least, "local": least, "roa": levels["roa"]}
    return result


def tree(depth: int) -> bytes:
    """All boxes of one state, 2^depth of them."""
    return bytes([LEAF]) if depth == 0 else bytes([SPLIT]) + 2 * tree(depth - 1)


def scalar(dynamics: Any, levels: tuple[float, float] = (0.04, 1.0), depth: int = 6, **more: Any) -> Document:
    """x' = dynamics with u = -tanh(x) / 2, V = x^2 <= c2."""
    options: dict[str, Any] = {"centre": "none", "scale": [-0.5], **more}
    return practical(make([dynamics], [([[1.0]], [0.0])], [[1.0]], levels, tree=tree(depth), **options))


def test_a_loop_without_an_equilibrium_at_the_origin() -> None:
    """x' = -x + 1/20 + u/20: V falls from |x| = 1/10 on."""
    loop = ["+", ["-", "x"], "1/20", ["*", "1/20", "u"]]
    assert judge(scalar(loop)) is None
    asymptotic = edited(scalar(loop), "claim", {"kind": "asymptotic", **CONTINUOUS})
    asymptotic["levels"] = {"local": (0.04).hex(), "roa": (1.0).hex()}
    assert judge(asymptotic) == "format"  # a ball is missing
    assert judge(with_ball(asymptotic)) == "equilibrium"
    assert judge(scalar(loop, (0.0004, 1.0), depth=9)) == "ring"  # below |x| = 1/21 V grows
    assert judge(scalar(["+", "x", "u"])) == "ring"


@pytest.mark.parametrize("bias", [0.0, 0.25])
def test_centring_none_has_no_condition(bias: float) -> None:
    data = scalar(["+", ["-", "x"], ["*", "1/20", "u"]])
    data["policy"]["layers"][0]["bias"] = make([], [([[1.0]], [bias])], [[1.0]], (1, 1))["policy"]["layers"][0]["bias"]
    assert judge(rehash(data)) is None


def test_preactivation_keeps_its_condition() -> None:
    assert judge(scalar(["-", "x"], centre="preactivation", u_eq=["1/2"])) == "centring"
    assert judge(scalar(["-", "x"], centre="preactivation", u_eq=["1/4"])) is None


HOLES = {
    "a pole at the origin": ["+", ["-", "x"], ["*", "1/1000000", ["/", "1", "x"]]],
    "0 times a pole": ["+", ["-", "x"], ["*", "0", ["/", "1", "x"]]],
    "a pole near the origin": ["+", ["-", "x"], ["*", "0", ["/", "1", ["+", "x", "1/32"]]]],
    "0/0": ["+", ["-", "x"], ["*", "0", ["*", "x", ["**", "x", -1]]]],
    "0 times a tan at its pole": ["+", ["-", "x"], ["*", "0", ["tan", ["+", "x", "355/226"]]]],
}


@pytest.mark.parametrize("name", HOLES)
def test_an_inside_leaf_needs_a_model_of_F(name: str) -> None:
    assert judge(scalar(HOLES[name])) == "ring"
    assert judge(scalar(["-", "x"])) is None


def test_an_inside_leaf_needs_its_inputs() -> None:
    """u = tanh(40 x) - tanh(39 x) is largest near the origin, inside {V < c0}."""
    layers = [(np.array([[40.0], [39.0]]), [0.0, 0.0]), (np.array([[1.0, -1.0]]), [0.0])]
    options: dict[str, Any] = {"squash": "identity", "centre": "none", "scale": [1.0], "tree": tree(10)}
    data = make([["-", "x"]], layers, [[1.0]], (0.04, 1.0), input_bounds=[("-1", "1")], **options)
    assert judge(practical(data)) is None
    narrow = practical(edited(data, "plant.input_bounds", [["-1/200", "1/200"]]))
    assert judge(narrow) == "inputs"


def test_equal_levels_do_not_skip_the_leaves() -> None:
    assert judge(scalar(["-", "x"], (1.0, 1.0))) is None
    assert judge(scalar("x", (1.0, 1.0))) == "ring"
    assert judge(scalar(HOLES["0 times a pole"], (1.0, 1.0))) == "ring"
    assert judge(scalar(["-", "x"], (1.0, 1.0), input_bounds=[("-1/4", "1/4")])) == "inputs"
    assert judge(with_tree(scalar(["-", "x"], (1.0, 1.0)), tree(6)[:-1])) == "tree"


@pytest.mark.parametrize(("floor", "rule"), [(0.0, "levels"), (-0.0, "levels"), (-1.0, "levels"), (2.0, "levels")])
def test_levels(floor: float, rule: str) -> None:
    assert judge(practical(make([["-", "x"]], [([[1.0]], [0.0])], [[1.0]], (0.5, 1.0)), floor)) == rule


def test_the_keys_of_the_levels_belong_to_the_claim() -> None:
    data = scalar(["-", "x"])
    assert judge(edited(data, "claim", {"kind": "asymptotic", **CONTINUOUS})) == "format"
    assert judge(edited(data, "levels", {"local": (0.04).hex(), "roa": (1.0).hex()})) == "format"
    assert judge(edited(data, "claim", {"kind": "sampled"})) == "format"
    assert judge_bytes(b"{}") == "format"


def test_a_trusted_solver() -> None:
    evidence = {"kind": "trusted-solver", "solver": "dReal", "version": "4", "precision": (0.5).hex(), "queries": []}
    assert judge(edited(scalar(["+", "1", "x"]), "evidence", evidence)) == "TRUSTED"
    assert judge(edited(scalar(["-", "x"], (0.5, 16.0)), "evidence", evidence)) == "domain"
