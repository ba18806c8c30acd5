"""tanh, exp, atan and sqrt in equations: exact where they can be, enclosed elsewhere, proved and refused end to end."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat, ctx, fmpq
from hypothesis import given
from hypothesis import strategies as st

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import run_checker
from certify.certificates.claims import Asymptotic, conditions
from certify.certificates.claims.queries import query
from certify.certificates.verdict import Verdict
from certify.checker import expression as checker_expression
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import (
    Expression,
    Number,
    atan,
    evaluate_exactly,
    exp,
    from_tree,
    sqrt,
    symbols,
    tanh,
    to_tree,
)
from certify.loop.plants import System, load_system
from certify.loop.plants.toml import parse_expression
from certify.loop.policies import PolicyNetwork
from certify.loop.rigorous import evaluate_arb
from certify.provers.ball.local import prove_local
from certify.reference import expressions as reference_expressions
from certify.reference import model as reference_model
from certify.reference import rules as reference_rules
from certify.reference import taylor as reference_taylor
from certify.reference.refusal import Refused
from certify.reference.symmetric import orders, triples
from tests.support import plain as plain_models
from tests.support.balls import with_ball
from tests.support.cases import case_of
from tests.support.certificates import Document, edited, grow, make, verdict
from tests.support.jets import constant as jet_of
from tests.support.jets import curved, plain
from tests.support.loops import box, tank, valve
from tests.support.oracle import value_of
from tests.support.reference import judge

X, Y, U = symbols("x y u")

# --------------------------------------------------------------------------------------------------------- expressions

WRITTEN: list[tuple[str, Any]] = [
    ("tanh(x)", ["tanh", "x"]),
    ("exp(-x)", ["exp", ["-", "x"]]),
    ("exp(1)", ["exp", "1"]),
    ("atan(x)", ["atan", "x"]),
    ("sqrt(x)", ["sqrt", "x"]),
    ("sqrt(9/4)", ["sqrt", ["/", "9", "4"]]),
    ("sqrt(2)", ["sqrt", "2"]),
    ("1/sqrt(x)", ["/", "1", ["sqrt", "x"]]),
    ("x*sqrt(x)", ["*", "x", ["sqrt", "x"]]),
    ("x*x - x/x + 0*x", ["+", ["*", "x", "x"], ["-", ["/", "x", "x"]], ["*", "0", "x"]]),
    ("sqrt(x)**2", ["**", ["sqrt", "x"], 2]),
    ("sqrt(sqrt(x))", ["sqrt", ["sqrt", "x"]]),
    ("1/(x*sqrt(sqrt(x)))", ["/", "1", ["*", "x", ["sqrt", ["sqrt", "x"]]]]),
]


@pytest.mark.parametrize(("text", "tree"), WRITTEN)
def test_equations_become_trees(text: str, tree: Any) -> None:
    expression = parse_expression(text, {"x": X})
    assert to_tree(expression) == tree
    assert from_tree(tree, {"x": X}) == expression


@pytest.mark.parametrize(
    "text",
    ["4*atan(1)*x", "exp(1)**2 - exp(x)*exp(2*x)", "sin(atan(x)) + cos(atan(3*x))", "sqrt(8)*sqrt(1/3 + x)**5",
     "atan(-x)", "tan(atan(x)/2)", "exp(x/2)**3/sqrt(exp(x))", "sqrt(4*x + 2)", "tanh(-x)/sqrt(1/8)", "sqrt(x**2)",
     "0.15*exp(0.3)"],
)  # fmt: skip
def test_what_is_read_of_an_equation_has_its_value(text: str) -> None:
    """The tree says the same as the text does in balls, and so does its evaluation with constants gathered."""
    expression = parse_expression(text, {"x": X})
    with ctx.workprec(200):
        for x in (Fraction(1, 3), Fraction(7, 4)):
            point = arb(fmpq(x.numerator, x.denominator))
            names = {f: getattr(arb, f) for f in ("sin", "cos", "tan", "tanh", "exp", "atan", "sqrt")}
            by_python = eval(_in_balls(text), {"x": point, "ball": _ball, **names})
            found = (value_of(to_tree(expression), {"x": point}), evaluate_arb(expression, {X: point}))
            for value in found:
                assert value.overlaps(by_python) and float((value - by_python).abs_upper()) < 1e-40


def _ball(text: str) -> arb:
    q = Fraction(text)
    return arb(fmpq(q.numerator, q.denominator))


def _in_balls(text: str) -> str:
    """The text with its numbers as balls; exponents stay integers."""
    return re.sub(r"(?<![\w*.])(?<!\*\*)(\d+\.?\d*)", r'ball("\1")', text)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("tanh(x)", 0), ("exp(x)", 1), ("atan(x)", 0), ("sqrt(x + 4/9)", Fraction(2, 3)),
        ("1/sqrt(x + 4)", Fraction(1, 2)), ("sqrt(exp(x) + 3)", 2), ("sqrt(sqrt(16 + x))", 2),
        ("tanh(x)*sqrt(1 + x)", 0), ("x*sqrt(x + 8)", 0), ("exp(1)*x", 0), ("x*exp(sqrt(2) + x)/cos(1)", 0),
        ("sin(x)*sqrt(x**2 + 2) + 3", 3),
    ],
)  # fmt: skip
def test_exact_values(text: str, value: Fraction | int) -> None:
    assert evaluate_exactly(parse_expression(text, {"x": X}), {X: Fraction(0)}) == value


@pytest.mark.parametrize(
    "text",
    ["tanh(x + 1)", "exp(1 - x)", "atan(x + 1)", "sqrt(2 + x)", "sqrt(x)", "sqrt(x - 4)", "x*sqrt(x - 8)", "x*sqrt(x)",
     "sqrt(2 + x) - sqrt(2)", "x + exp(1)", "x/sin(x)"],
)  # fmt: skip
def test_what_is_not_rational_is_not_decided(text: str) -> None:
    with pytest.raises(InputError):
        evaluate_exactly(parse_expression(text, {"x": X}), {X: Fraction(0)})


@pytest.mark.parametrize("text", ["x**0", "log(x)", "sqrt(x, 2)", "x**0.5", "x**(1/2)", "sqrt", "exp()", "asin(x)"])
def test_equations_outside_the_grammar(text: str) -> None:
    with pytest.raises(InputError):
        to_tree(parse_expression(text, {"x": X}))


def test_floating_point_follows(tmp_path: Path) -> None:
    """numpy and torch get the same field; a file may use the functions."""
    path = tmp_path / "plant.toml"
    path.write_text(
        'name = "p"\nstates = ["x"]\ninputs = ["u"]\n'
        '[dynamics]\nx = "u + sqrt(2)*tanh(x) - exp(x/3)*atan(x) + sqrt(2 + x) - exp(1)*4*atan(1) + exp(0.5)"\n'
        "[u_eq]\nu = 0\n[domain]\nx = [-1, 1]\n[input_bounds]\nu = [-9, 9]\n"
    )
    system = load_system(path)
    x, u = np.array([[0.3], [-0.7]]), np.array([[0.1], [2.0]])
    v = x[:, 0]
    expected = u[:, 0] + 2**0.5 * np.tanh(v) - np.exp(v / 3) * np.arctan(v) + np.sqrt(2 + v)
    expected += -np.e * np.pi + np.exp(0.5)
    np.testing.assert_allclose(system.function()(x, u)[:, 0], expected, rtol=1e-14)
    import torch

    np.testing.assert_allclose(system.function("torch")(torch.tensor(x), torch.tensor(u))[:, 0], expected, rtol=1e-14)


# ------------------------------------------------------------------------------------------------ both checkers' bounds

FUNCTIONS = ["sin", "cos", "tan", "tanh", "exp", "atan", "sqrt"]
CONSTANTS = st.sampled_from(["1", "-1/3", "2", "7/5", "1/10", "-5/2"])
TREES = st.recursive(
    st.sampled_from(["x", "y"]) | CONSTANTS,
    lambda inner: st.one_of(
        st.tuples(st.sampled_from(FUNCTIONS), inner).map(list),
        st.tuples(st.sampled_from(["+", "*", "-", "/"]), inner, inner).map(list),
        st.tuples(st.just("**"), inner, st.sampled_from([2, 3, -1, -2])).map(list),
        st.tuples(st.just("sqrt"), st.tuples(st.just("+"), st.just("2"), inner).map(list)).map(list),
    ),
    max_leaves=7,
)


@given(TREES, st.integers(0, 10**6), st.sampled_from([1.0, 0.3, 1e-2, 1e-6]))
def test_models_of_random_equations_contain_them(tree: Any, seed: int, size: float) -> None:
    """On a box and on a ball, by both checkers, at points in balls; where a model is refused nothing is claimed."""
    generator = np.random.default_rng(seed)
    centre, slopes = generator.uniform(-1, 1, 2), size * generator.uniform(-1, 1, (2, 2))
    at_0 = centre * (generator.random() < 0.7)
    points = [*generator.uniform(-1, 1, (4, 2)).tolist(), [1.0, -1.0], [-1.0, -1.0]]
    with ctx.workprec(200), np.errstate(all="ignore"):
        compiled = reference_expressions.equations([tree], {"x", "y"}, "plant")
        tape = checker_expression.parse([tree], ("x", "y"), "plant.dynamics")
        # boxes
        states = [plain_models.affine(np.array([c]), g[:, None]) for c, g in zip(centre, slopes, strict=True)]
        [v] = checker_expression.evaluate(tape, lambda q: plain_models.constant(q, 2, 1), states)
        if np.isfinite((v.size + v.r)[0]):
            for d in points:
                off = abs(
                    _at(tree, centre, slopes, d) - arb(float(v.c[0])) - _form(v.g[:, 0].tolist(), v.Q[:, :, 0], d)
                )
                assert off <= arb(float(v.r[0]))
        names = {
            name: reference_taylor.Taylor(arb(float(c)), arb_mat([[arb(float(a)) for a in g]]))
            for name, c, g in zip("xy", centre, slopes, strict=True)
        }
        try:
            [w] = compiled.evaluate(names, lambda q: reference_taylor.Taylor(arb(q)))
        except Refused:
            w = None
        if w is not None and w.is_finite():
            g = arb_mat(1, 2) if w.g is None else w.g
            Q = arb_mat(2, 2) if w.Q is None else w.Q
            for d in points:
                off = abs(_at(tree, centre, slopes, d) - w.c - _form(g.entries(), Q.tolist(), d))
                assert off <= w.r + arb(2) ** -100 * (1 + w.r + abs(w.c))
        # balls
        n = np.zeros((2, 2))
        jets = [plain(np.float64(c), 0.0, a, 0.0, n, n) for c, a in zip(at_0, slopes, strict=True)]
        [jet] = checker_expression.evaluate(tape, lambda q: jet_of(q, np.zeros((1, 2, 2)), 0), jets)
        models = {
            name: reference_model.Model.affine(arb(float(c)), [arb(float(v)) for v in a])
            for name, c, a in zip("xy", at_0, slopes, strict=True)
        }
        try:
            [model] = compiled.evaluate(models, lambda q: reference_model.Model.affine(arb(q), [arb(0)] * 2))
        except Refused:
            model = None
        finite = bool(
            np.isfinite([jet.size, jet.slack, *np.ravel(jet.a), *np.ravel(jet.Q), *jet.K, *np.ravel(jet.E)]).all()
        )
        for corner in points[:4]:
            d = (np.array(corner) / max(1.0, float(np.linalg.norm(corner)))).tolist()
            value = _at(tree, at_0, slopes, d) if finite or model is not None else arb(0)
            length = arb(d[0]) ** 2 + arb(d[1]) ** 2
            if finite:
                room = (
                    arb(float(jet.error))
                    + arb(float(jet.slack)) * length.sqrt()
                    + _form([arb(0)] * 2, jet.E.tolist(), d)
                )
                known = _form(jet.a.tolist(), [[0] * 2] * 2, d) + curved(jet, d)
                assert abs(value - arb(float(jet.c)) - known) <= room
            if model is not None and all(v.is_finite() for v in (model.v, *model.a, *model.Q, *model.E)):
                a, Q, E = model.a.entries(), model.Q.tolist(), model.E.tolist()
                e, each = [arb(t) for t in d], zip(orders(2), triples(2), model.K.entries(), strict=True)
                thirds = sum((often * k * e[h] * e[i] * e[j] for often, (h, i, j), k in each), arb(0))
                off = abs(value - model.v - _form(a, Q, d) - thirds)
                assert off <= _form([arb(0)] * 2, E, d) + arb(2) ** -100 * (1 + abs(model.v))


def _at(tree: Any, centre: np.ndarray, slopes: np.ndarray, d: list[float]) -> arb:
    x, y = (
        arb(float(c)) + sum((arb(float(a)) * arb(t) for a, t in zip(row, d, strict=True)), arb(0))
        for c, row in zip(centre, slopes, strict=True)
    )
    return value_of(tree, {"x": x, "y": y})


def _form(g: Any, Q: Any, d: list[float]) -> arb:
    """g.d + d'Q d."""
    linear = sum((arb(a) * arb(t) for a, t in zip(g, d, strict=True)), arb(0))
    return linear + sum(
        (arb(q) * arb(s) * arb(t) for s, row in zip(d, Q, strict=True) for q, t in zip(row, d, strict=True)), arb(0)
    )


def test_the_third_derivatives_of_the_format() -> None:
    """On a grid, in balls: the suprema of the table, and what is left of a root."""
    with ctx.workprec(120):
        for k in range(-400, 400):
            v = arb(k) / 40 + arb(0, 0.0126)
            t = v.tanh()
            assert abs((6 * t * t - 2) * (1 - t * t)) <= arb(2) + arb(10) ** -1
            p = 1 / (1 + v * v)
            assert abs((6 * v * v - 2) * p * p * p) <= arb(2) + arb(10) ** -1
        for c, v in ((2.0, 0.5), (2.0, 3.75), (1e-3, 5e-3), (7.0, 7.0009765625), (1.0, 2.0**-40)):
            s, w, D = arb(c).sqrt(), arb(v).sqrt(), arb(v) - arb(c)
            left = w - (s + D / (2 * s) - D * D / (8 * s**3))
            assert left.overlaps(D**3 * (3 * s + w) / (8 * s**3 * (s + w) ** 3))


# ------------------------------------------------------------------------------------------------- through the pipeline


def scalar(dynamics: Expression, width: float | str = 3, gain: float = -1.0) -> tuple[System, PolicyNetwork]:
    system = System("s", (X,), (U,), {}, (dynamics,), (Number(0),), box(width), box(9))
    network = PolicyNetwork.of_layers(
        (np.array([[gain]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )
    return system, network


# A loop under u = -x, and where its region of attraction ends.
KNOWN: dict[str, tuple[Callable[[], tuple[System, PolicyNetwork]], float]] = {
    "tanh": (lambda: scalar(X / 2 + tanh(U)), 1.9150080481545375),
    "exp": (lambda: scalar(X / 2 + exp(U) - 1), 1.5936242600400401),
    "atan": (lambda: scalar(X / 2 + atan(U)), 2.331122370414423),
    "sqrt": (tank, 9.0),
}


@pytest.mark.parametrize("name", KNOWN)
def test_a_plant_of_each_function_is_proved_up_to_its_edge(name: str, tmp_path: Path) -> None:
    build, edge = KNOWN[name]
    system, network = build()
    result = certify_roa(system, network, tmp_path, RoaOptions(candidate="lyapunov", effort=0.1))
    assert result.verdict is Verdict.PROVED and result.P is not None and result.levels.roa is not None
    limit = edge**2 * float(result.P[0, 0])
    assert 0.998 * limit < result.levels.roa < limit
    path = tmp_path / "certificate.json"
    assert run_checker(path)["result"] == "ACCEPTED" and reference_rules.judge(path.read_bytes()).result == "ACCEPTED"
    beyond = certify_roa(system, network, tmp_path / "beyond", RoaOptions(level=1.0001 * limit))
    assert beyond.verdict is Verdict.REFUTED


def test_a_plant_of_all_functions(tmp_path: Path) -> None:
    system, network = valve()
    result = certify_roa(system, network, tmp_path, RoaOptions(candidate="ellipsoid", effort=0.2))
    assert result.verdict is Verdict.PROVED
    path = tmp_path / "certificate.json"
    assert run_checker(path)["result"] == "ACCEPTED" and reference_rules.judge(path.read_bytes()).result == "ACCEPTED"
    # simulated from the edge of the set, in floating point, every trajectory comes in
    assert result.P is not None and result.levels.roa is not None
    angle = np.linspace(0, 2 * np.pi, 60)
    L = np.linalg.inv(np.linalg.cholesky(result.P)).T
    x = (np.sqrt(result.levels.roa) * (L @ np.array([np.cos(angle), np.sin(angle)]))).T
    loop, f = ClosedLoop(system, network), system.function()
    for _ in range(4000):
        x = x + 0.01 * f(x, loop.policy(x))
    assert np.abs(x).max() < 1e-6


def claim(dynamics: Any, c1: float = 0.01, c2: float = 1.0, **changes: Any) -> Document:
    """A document about one state under u = -x, grown with the checker's own rule."""
    settings = {"squash": "identity", "centre": "none", "scale": [1.0], "input_bounds": [("-9", "9")]}
    return grow(make([dynamics], [([[-1.0]], [0.0])], [[1.0]], (c1, c2), **{**settings, **changes}))


HONEST: dict[str, Any] = {
    "tanh": ["+", ["/", "x", "2"], ["tanh", "u"]],
    "exp": ["+", ["/", "x", "2"], ["exp", "u"], "-1"],
    "atan": ["+", ["/", "x", "2"], ["atan", "u"]],
    "sqrt": ["+", "u", ["-", ["sqrt", ["+", "4", "x"]], "2"]],
    "drag": ["-", "u", ["*", "x", "1/10", ["sqrt", ["+", "2", ["**", "x", 2]]], ["exp", ["sin", "1"]]]],
}


@cache
def honest(name: str) -> Document:
    """Shared between tests, which edit copies."""
    return claim(HONEST[name])


FORGED: list[tuple[str, str, Any]] = [  # rule, base, equation
    ("ring", "tanh", ["+", ["*", "4/5", "x"], ["tanh", "u"]]),
    ("local", "tanh", ["+", ["/", "x", "2"], ["tanh", ["-", "u"]]]),
    ("local", "tanh", ["+", ["/", "x", "2"], ["*", "1/2", ["tanh", "u"]]]),
    ("equilibrium", "tanh", ["+", ["/", "x", "2"], ["tanh", ["+", "u", "1/1000"]]]),
    ("ring", "exp", ["+", ["*", "2/3", "x"], ["exp", "u"], "-1"]),
    ("local", "exp", ["+", ["/", "x", "2"], ["exp", "x"], "-1"]),
    ("equilibrium", "exp", ["+", ["/", "x", "2"], ["exp", "u"]]),
    ("equilibrium", "exp", ["+", ["/", "x", "2"], ["exp", ["+", "u", "1"]], "-3"]),
    ("ring", "atan", ["+", ["*", "4/5", "x"], ["atan", "u"]]),
    ("local", "atan", ["+", ["/", "x", "2"], ["atan", "x"]]),
    ("equilibrium", "atan", ["+", ["/", "x", "2"], ["atan", ["+", "u", "1"]]]),
    ("equilibrium", "sqrt", ["+", "u", ["-", ["sqrt", ["+", "4", "x"]], "3"]]),
    ("equilibrium", "sqrt", ["+", "u", ["-", ["sqrt", ["+", "5", "x"]], "2"]]),
    ("equilibrium", "sqrt", ["+", "u", ["*", "0", ["sqrt", ["-", "x", "4"]]]]),  # nowhere defined
    ("equilibrium", "sqrt", ["+", "u", ["sqrt", ["**", "x", 2]]]),  # |x|
    ("equilibrium", "sqrt", ["+", "u", ["*", "0", ["sqrt", "x"]]]),  # for half of the states undefined
    ("local", "sqrt", ["+", "u", ["*", "0", ["sqrt", ["+", "1/100000000", "x"]]]]),
    ("ring", "sqrt", ["+", "u", ["*", "0", ["sqrt", ["+", "1/4", "x"]]]]),  # undefined from -1/4 on
    ("ring", "drag", ["+", "u", ["*", "0", ["sqrt", ["+", "1/3", "x"]]]]),  # and so with a root that is not rational
    ("local", "drag", ["+", "u", ["*", "0", ["sqrt", ["+", "1/300000000", "x"]]]]),
    ("local", "drag", ["+", "u", ["*", "x", ["/", "1", ["-", ["sqrt", "2"], ["sqrt", "2"]]]]]),  # 0/0 in disguise
    ("local", "drag", ["+", "u", ["*", "0", ["sqrt", ["-", ["sin", "1"], "1"]]]]),
    ("equilibrium", "drag", ["+", "u", ["*", "x", ["sqrt", ["+", "x", "-8"]]]]),
    ("equilibrium", "drag", ["+", "u", ["*", "0", ["/", "1", "x"]]]),
    ("equilibrium", "drag", ["+", "u", ["sqrt", "2"], ["-", ["sqrt", "2"]]]),
    ("equilibrium", "drag", ["+", "u", ["*", "1/1000000", ["exp", "1"]]]),
    ("ring", "sqrt", ["+", "u", ["*", "0", ["sqrt", ["+", "1", "x"]]]]),  # not differentiable on the boundary alone
    ("ring", "sqrt", ["*", "u", ["sqrt", ["+", "1/4", "x"]]]),
    ("format", "sqrt", ["+", "u", ["sqrt", "x", "2"]]),
    ("format", "sqrt", ["+", "u", ["log", ["+", "1", "x"]]]),
]


@pytest.mark.parametrize("name", HONEST)
def test_honest_certificates_are_accepted_by_both(name: str) -> None:
    assert verdict(honest(name)) == "ACCEPTED" and judge(honest(name)) is None


@pytest.mark.parametrize(("rule", "name", "tree"), FORGED, ids=[f"{b} {i}" for i, (_, b, _) in enumerate(FORGED)])
def test_forged_equations_are_refused_by_both(rule: str, name: str, tree: Any) -> None:
    forged = edited(honest(name), "plant.dynamics", [tree])
    forged = forged if rule == "format" else with_ball(forged)
    assert verdict(forged) == rule and judge(forged) == rule
    if rule != "format":  # and no tree helps
        assert verdict(grow(forged, max_leaves=600, depth=20)) == rule


@pytest.mark.parametrize("name", HONEST)
def test_one_function_in_the_place_of_another(name: str) -> None:
    """The evidence is for one plant: under the others it is refused, or the claim happens to be true of them."""
    text = json.dumps(HONEST[name])
    for other in ("sin", "cos", "tan", "tanh", "exp", "atan", "sqrt"):
        tree = json.loads(text.replace(f'"{name}"', f'"{other}"'))
        data = edited(honest(name), "plant.dynamics", [tree])
        by_checker, by_reference = verdict(data), judge(data)
        assert (by_checker == "ACCEPTED") is (by_reference is None), other
        if other == name or by_checker != "ACCEPTED":
            continue
        with ctx.workprec(120):
            for k in [*range(-100, 0), *range(1, 101)]:
                x = arb(k) / 100
                assert x * value_of(tree, {"x": x, "u": -x}) < 0


@pytest.mark.parametrize(("edge", "rule"), [(3.98, "ACCEPTED"), (4.0, "ring"), (4.1, "ring")])
def test_a_root_that_may_reach_0_on_the_set_is_refused(edge: float, rule: str) -> None:
    """xdot = 2 - sqrt(4 + x) attracts all that is defined, x > -4."""
    dynamics = ["-", "2", ["sqrt", ["+", "4", "x"]]]
    data = claim(dynamics, c2=edge**2, domain=[("-5", "5")])
    assert verdict(data) == rule and judge(data) == (None if rule == "ACCEPTED" else rule)


def test_a_root_inside_of_a_practical_floor_must_be_defined() -> None:
    """V = x^2, u = -x: the ring is fine, and at 0 the root of |x| - 1/10 is not there."""
    root = ["sqrt", ["-", ["**", "x", 2], "1/100"]]
    data = claim(["+", "u", ["*", "0", root]], 0.25, 1.0, claim="practical")
    assert verdict(data) == "ring" and judge(data) == "ring"
    above = ["sqrt", ["+", ["**", "x", 2], "1/100"]]
    data = claim(["+", "u", ["*", "0", above]], 0.25, 1.0, claim="practical")
    assert verdict(data) == "ACCEPTED" and judge(data) is None


@pytest.mark.slow
def test_exponentials_that_overflow_are_never_accepted_for_nothing() -> None:
    """What the checker does not know of it refuses; no false claim comes through where numbers overflow."""
    for rate in ("100", "100000", "9" * 300):
        harmless = claim(["+", "u", ["*", "0", ["exp", ["*", rate, "x"]]]])
        assert verdict(harmless) in ("local", "ring") and judge(harmless) in (None, "local", "ring")
        false = claim(["+", "u", ["-", ["exp", ["*", rate, "x"]], "1"]])
        assert verdict(false) in ("local", "ring") and judge(false) in ("local", "ring")
        tower = claim(["+", "u", ["-", ["exp", ["exp", ["*", rate, "x"]]], ["exp", "1"]]])
        assert verdict(tower) == "equilibrium" == judge(tower)
    small = ["exp", "-700"], ["exp", ["*", "-700", ["+", "x", "1"]]]
    wrong = claim(["-", *small], claim="practical")  # it grows, by less than the checker can see
    assert verdict(wrong) == "ring" == judge(wrong)
    assert verdict(claim(["-", *small[::-1]], claim="practical")) == "ring"  # true, and beyond what it can see


def test_the_local_proof_knows_the_functions() -> None:
    for build, edge in KNOWN.values():
        case = case_of(*build())
        level = prove_local(case.problem, case.T, 100.0)
        assert level is not None and 0 < level < edge**2 * float(case.P[0, 0])
    near = case_of(*scalar(U * sqrt(X + Fraction(1, 100)) * 10))
    level = prove_local(near.problem, near.T, 1.0)
    assert level is not None and level < 1e-4 * float(near.P[0, 0])


def test_solvers_are_asked_whether_roots_are_defined() -> None:
    case = case_of(*tank())
    found = conditions(Asymptotic(roa=1.0, local=0.1), case.problem)
    asked = query(next(c for c in found if c.name == "root-0"), case.problem)
    assert asked.constraints[-1] == ("r.", "<=", "0") and ("r.", ["+", "16", "x"]) in asked.definitions
    nested = case_of(*scalar(U + sqrt(3 + sqrt(1 + X)) * X / 100 + sqrt(2) * X / 100))
    names = [c.name for c in conditions(Asymptotic(roa=1.0, local=0.1), nested.problem)]
    assert [n for n in names if n.startswith("root")] == ["root-0", "root-1"]
