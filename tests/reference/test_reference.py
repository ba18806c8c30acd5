"""Two checkers written apart, from one page: `certify.checker` and `certify.reference` give the same verdicts.

The bounds are the same, those of FORMAT.md, but the roundings differ. So on what is within these of its limit they may
differ, either way; on the certificates and mutants below they do not, but for the few that say so.
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
import json
import math
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat, arb_series, ctx, fmpq, fmpq_mat
from hypothesis import example, given
from hypothesis import strategies as st

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates.verdict import Verdict
from certify.loop.plants import get_system
from certify.loop.policies import load_policy
from certify.reference import balls, leaves, local, rational
from certify.reference.document import Certificate
from certify.reference.document import read as read_certificate
from certify.reference.evidence import Ball, Tree
from certify.reference.fields import exact
from certify.reference.lines import tanh_between
from certify.reference.loop import Loop
from certify.reference.model import Model
from certify.reference.refusal import Refused
from certify.reference.table import FUNCTIONS
from certify.reference.tangents import Policy
from tests.checker.test_format import NOT_A_HEX_FLOAT, NOT_A_RATIONAL, NOT_BASE64, NOT_IN_THE_GRAMMAR, RAW, SHAPES
from tests.checker.test_rules import (
    ABLATED,
    FALSE,
    HARMLESS,
    HONEST,
    MUTANTS,
    Edit,
    bump,
    coordinates,
    honest,
    lyapunov,
    reordered,
    scalar_claim,
)
from tests.support.balls import centred, with_ball
from tests.support.certificates import (
    LEAF,
    Document,
    decode,
    dump,
    edited,
    encode,
    grow,
    make,
    parse,
    rehash,
    tree_of,
    verdict,
    with_tree,
)
from tests.support.earlier import earlier
from tests.support.models import beyond, curved, form, inputs_on, linear, matrix, model
from tests.support.oracle import policy_in_arb, value_of
from tests.support.reference import judge, judge_bytes

SHIPPED = Path(__file__).parents[2] / "examples" / "policies" / "pendulum.pt"


def fraction(q: fmpq) -> Fraction:
    return Fraction(int(q.p), int(q.q))


def tree_evidence(c: Certificate) -> Tree:
    assert isinstance(c.evidence, Tree)
    return c.evidence


def both(data: Document) -> tuple[str, str]:
    return judge(data) or "ACCEPTED", verdict(data)


def ball_of(c: Certificate) -> Ball:
    ball = tree_evidence(c).ball
    assert ball is not None
    return ball


@pytest.fixture(scope="module")
def shipped(tmp_path_factory: pytest.TempPathFactory) -> Document:
    """The certificate of the policy that ships."""
    policy = load_policy(SHIPPED)
    system = get_system("pendulum").with_parameters(policy.parameters)
    result = certify_roa(system, policy.network, tmp_path_factory.mktemp("shipped"), RoaOptions(candidate="lyapunov"))
    assert result.verdict is Verdict.PROVED and result.certificate is not None
    return earlier(json.loads(result.certificate.read_text()))


@cache
def crane(centre: str, v: tuple[str, str]) -> Document:
    """Three states, two inputs, tan, cos and a quotient; `v` are the bounds of the second input."""
    generator = np.random.default_rng(3)
    W, b, scale = 0.5 * generator.standard_normal((8, 3)), generator.uniform(-0.3, 0.3, 8), np.array([1.5, 1.0])
    x = generator.uniform(-1, 1, (3000, 3))
    h, at_0 = np.tanh(x @ W.T + b), np.tanh(b)
    target = np.arctanh(np.clip(-(x @ np.array([[2.0, 0.3, 0.1], [0.2, 0.1, 1.5]]).T) / scale, -0.9, 0.9))
    last = np.linalg.lstsq(h - at_0, target, rcond=1e-2)[0].T
    A = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 0.5]])
    A[1:] += scale[:, None] * (last * (1 - at_0**2)) @ W
    P = lyapunov(A)
    dynamics: list[Any] = [
        "y",
        ["+", ["-", ["sin", "y"]], ["*", "u", ["/", "1", ["+", "1", ["*", "1/4", ["**", "x", 2]]]]]],
        ["+", ["*", "1/2", ["tan", "z"]], ["*", "v", ["cos", "x"]]],
    ]
    return grow(make(
        dynamics, [(W, b), (last, -last @ at_0)], P, (1e-4, 0.05), states="xyz", inputs="uv", u_eq=["0", "0"],
        domain=[("-3/2", "3/2")] * 3, input_bounds=[("-2", "2"), v], centre=centre, scale=scale, offset=[0.0, 0.0],
        T=coordinates(P, A),
    ))  # fmt: skip


# ------------------------------------------------------------------------------------------------------- what is honest


@pytest.mark.parametrize("name", HONEST)
def test_honest_certificates_are_accepted(name: str) -> None:
    assert judge(honest(name)) is None


def test_the_certificate_of_the_policy_that_ships_is_accepted(shipped: Document) -> None:
    assert both(shipped) == ("ACCEPTED", "ACCEPTED")


@pytest.mark.parametrize("centre", ["output", "preactivation"])
@pytest.mark.parametrize("v", [("-3/2", "3/2"), ("-9/10", "1")])
def test_two_inputs_and_three_states_are_accepted(centre: str, v: tuple[str, str]) -> None:
    assert both(crane(centre, v)) == ("ACCEPTED", "ACCEPTED")


@pytest.mark.parametrize("edit", HARMLESS)
def test_harmless_edits_stay_accepted(edit: str) -> None:
    assert judge_bytes(HARMLESS[edit](with_ball(honest("linear")))) is None


@pytest.mark.parametrize("exponent", [-200, 0, 100])  # at 200 what a tanh leaves out has no square in binary64
def test_units_do_not_matter(exponent: int) -> None:
    assert both(grow(bump(exponent, "+"), max_leaves=3000, depth=30)) == ("ACCEPTED", "ACCEPTED")


# ------------------------------------------------------------------------------------------------------- what is false


@pytest.mark.parametrize(
    ("rule", "base", "edit", "what"), [pytest.param(r, b, e, what, id=f"{r}-{b}-{what}") for r, b, what, e in MUTANTS]
)
def test_mutants_are_rejected_by_the_same_rule(rule: str, base: str, edit: Edit, what: str) -> None:
    found = judge(edit(honest(base)))
    if what == "a leaf in place of a split":  # the claim is still true, and a finer bound may prove it
        assert found in (None, "ring")
    else:
        assert found == rule


@pytest.mark.parametrize("rule", ABLATED)
def test_a_certificate_that_breaks_one_rule_alone(rule: str) -> None:
    assert judge(ABLATED[rule]()) == rule


@pytest.mark.parametrize(("rule", "data"), [pytest.param(rule, data, id=what) for rule, what, data, _ in FALSE])
def test_false_claims(rule: str, data: Document) -> None:
    assert judge(data) == rule


@pytest.mark.parametrize("exponent", [-430, -100, 0, 300])
def test_a_claim_that_is_false_on_a_small_interval(exponent: int) -> None:
    assert judge(grow(bump(exponent), max_leaves=3000, depth=16)) is not None


def test_a_claim_just_beyond_the_region_of_attraction() -> None:
    assert judge(grow(scalar_claim(c2=1.915009**2), max_leaves=4000, depth=40)) == "ring"
    assert judge(grow(scalar_claim(c2=1.915007**2), max_leaves=4000, depth=40)) is None


def number(path: str, change: Callable[[np.ndarray], Any]) -> Edit:
    """An edit of an array, hashed honestly."""
    return lambda data: rehash(edited(data, path, lambda text: encode(change(decode(text)))))


def scaled_level(name: str, factor: float) -> Edit:
    return lambda data: edited(data, f"levels.{name}", lambda text: (factor * float.fromhex(text)).hex())


def leaf_in_place_of(split: int) -> Edit:
    """The whole branch at that byte becomes one leaf."""

    def change(data: Document) -> Document:
        tree, end, open_ = tree_of(data), split, 1
        while open_:
            open_ += 1 if tree[end] != LEAF else -1
            end += 1
        return with_tree(data, tree[:split] + bytes([LEAF]) + tree[end:])

    return change


SABOTAGE: list[tuple[str, Edit]] = [
    ("hash", lambda d: edited(d, "policy.layers.1.weight", lambda text: encode(-decode(text)))),
    ("levels", scaled_level("local", 1e4)),
    ("domain", scaled_level("roa", 1.01)),
    ("root", number("evidence.root", lambda a: a * (1 - 2.0**-20))),
    ("root", number("evidence.T", lambda a: a * (1 - 2.0**-20))),
    ("coordinates", number("evidence.T", lambda a: a * [1, 0, 1, 0])),
    ("centring", number("policy.offset", lambda a: a - 6)),
    ("local", scaled_level("local", 2)),
    ("local", lambda d: with_ball(scaled_level("local", 2)(d))),
    ("local", number("policy.layers.2.weight", lambda a: -a)),
    ("local", number("policy.scale", lambda a: a / 6)),
    ("tree", lambda d: with_tree(d, tree_of(d)[:-1])),
    ("tree", lambda d: with_tree(d, tree_of(d) + bytes([LEAF]))),
    ("tree", lambda d: with_tree(d, tree_of(d)[:-1] + bytes([2, LEAF, LEAF]))),
    ("ring", leaf_in_place_of(0)),
    ("ring", leaf_in_place_of(1)),
    ("ring", scaled_level("local", 1e-6)),
    ("ring", lambda d: edited(d, "plant.dynamics.1", lambda f: [*f, ["**", ["/", "theta_dot", "8"], 15]])),
    ("ring", lambda d: edited(d, "plant.dynamics.1", lambda f: [*f, ["**", ["/", "theta", "2"], 9]])),
    ("inputs", lambda d: edited(d, "plant.input_bounds.0.1", "5")),
]


@pytest.mark.parametrize(("rule", "edit"), SABOTAGE)
def test_sabotage_of_the_certificate_that_ships(shipped: Document, rule: str, edit: Edit) -> None:
    assert both(edit(shipped)) == (rule, rule)


def test_every_leaf_of_the_certificate_that_ships_is_needed(shipped: Document) -> None:
    """Without any one leaf the tree is no tree."""
    tree = tree_of(shipped)
    for k in [k for k, byte in enumerate(tree) if byte == LEAF][::7]:
        assert judge(with_tree(shipped, tree[:k] + tree[k + 1 :])) == "tree"


@pytest.mark.parametrize("rule", ["inputs", "ring"])
def test_false_claims_about_two_inputs(rule: str) -> None:
    data = crane("output", ("-3/2", "3/2"))
    if rule == "inputs":
        data = edited(data, "plant.input_bounds.1", ["-1/10", "1/10"])
    else:
        data = edited(data, "plant.dynamics.2.1.1", "3/4")
    assert both(data) == (rule, rule)


# ------------------------------------------------------------------------------------------------------------- the file


@pytest.mark.parametrize("name", RAW)
def test_malformed_files(name: str) -> None:
    assert judge_bytes(RAW[name]()) == "format"


MALFORMED = [
    *(("plant.u_eq.0", v) for v in NOT_A_RATIONAL),
    *(("levels.local", v) for v in NOT_A_HEX_FLOAT),
    *((path, v) for path in ("lyapunov.P", "policy.scale", "evidence.tree") for v in NOT_BASE64),
    *(("policy.layers.0.shape", v) for v in SHAPES),
    *(("plant.dynamics.0.2", v) for v in NOT_IN_THE_GRAMMAR.values()),
    *(("plant.name", v) for v in ("", "1a", "a b", "a.b", "\u00e9", "x" * 65, 7)),
]


def test_malformed_values() -> None:
    for path, value in MALFORMED:
        data = edited(honest("scalar"), path, value)
        assert judge(data) == "format", (path, value)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("plant.u_eq.0", "-0/7"),
        ("plant.domain.0.1", "1" * 1201),
        ("plant.name", "x" * 64),
        ("plant.name", "_sin"),
        ("plant.dynamics.0", ["+", ["+", ["/", "x", "2"], "u"]]),
        ("plant.dynamics.0", ["+", ["/", "x", "2"], "u", ["*", "0", ["sin", "22/7"]]]),
        ("plant.dynamics.0", ["+", ["/", "x", "2"], "u", ["-", ["cos", "x"], "1"]]),
        ("plant.dynamics.0", ["+", ["/", "x", "2"], "u", ["*", "1/1000", "x", ["tan", ["/", "x", "4"]]]]),
        ("plant.dynamics.0", ["+", ["/", "x", "2"], "u", ["*", "1/1000", "x", ["**", ["+", "x", "9"], -3]]]),
        *(
            ("plant.dynamics.0", ["+", ["/", "x", "2"], "u", ["*", "1/1000", "x", tree]])
            for tree in (
                ["tanh", "x"],
                ["exp", ["*", "9", "x"]],
                ["atan", ["*", "3", "x"]],
                ["sqrt", ["+", "2", "x"]],
                ["sqrt", "x"],
                ["sqrt", ["**", "x", 2]],
                ["sqrt", "2"],
                ["exp", ["*", "-900", "x"]],
                ["exp", "1"],
                ["exp", ["exp", "x"]],
                ["sqrt", ["+", "17/9", ["tanh", "x"]]],
                ["tanh", "1"],
                ["sqrt", "-4"],
            )
        ),
        *(
            ("plant.dynamics.0", ["+", ["/", "x", "2"], "u", tree])
            for tree in (
                ["-", ["exp", "x"], "1"],
                ["*", "0", ["exp", "1"]],
                ["*", "0", ["atan", "1"]],
                ["*", "0", ["sqrt", "0"]],
                ["*", "0", ["sqrt", "4/9"]],
                ["*", "0", ["sqrt", "2"]],
                ["*", "0", ["sqrt", ["-", "1"]]],
                ["*", "1/9", ["-", ["sqrt", ["+", "4", "x"]], "2"]],
                ["*", "0", ["sqrt", ["/", "4", "0"]]],
            )
        ),
        ("plant.input_bounds", [["1", "1"]]),
        ("policy.sha256", 3),
        ("evidence.tree", "/w=="),
        ("evidence.tree", ""),
    ],
)
def test_odd_values_are_read_alike(path: str, value: Any) -> None:
    mine, theirs = both(edited(honest("scalar"), path, value))
    assert mine == theirs


@pytest.mark.parametrize("splits", [4096, 4097])
def test_the_limit_on_open_boxes(splits: int) -> None:
    mine, theirs = both(with_tree(scalar_claim(0.01, 0.01), bytes([0]) * splits + bytes([LEAF]) * (splits + 1)))
    assert mine == theirs == ("ACCEPTED" if splits == 4096 else "tree")


def trusted(data: Document, **changes: Any) -> Document:
    evidence = {
        "kind": "trusted-solver", "solver": "dReal", "version": "4.21.06.2", "precision": (1e-3).hex(),
        "queries": [["local", "unsat"], ["ring", "unsat"]], **changes,
    }  # fmt: skip
    return edited(data, "evidence", evidence)


def test_what_a_solver_says_is_trusted_and_called_so() -> None:
    assert judge(trusted(honest("scalar"))) == "TRUSTED"
    assert judge(trusted(scalar_claim(4.0, 4.0))) == "TRUSTED"  # false; claims 3 to 5 are the solver's
    for word in ("two words", "", "a\nb", "x" * 81, "\u00e9", 1):
        assert both(trusted(honest("scalar"), solver=word)) == ("format", "format")
    for precision in (0.0, -0.0, -1e-3):
        assert both(trusted(honest("scalar"), precision=precision.hex())) == ("format", "format")


@pytest.mark.parametrize("rule", ["hash", "levels", "lyapunov", "equilibrium", "centring", "domain"])
def test_what_remains_of_the_rules_when_a_solver_is_trusted(rule: str) -> None:
    for found, base, _, edit in MUTANTS:
        if found == rule:
            data = edit(honest(base))
            assert both(trusted(data)) == (rule, rule)


# ------------------------------------------------------------------------------------------------------ the reference


def test_it_leaves_the_document_and_the_precision_as_they_are() -> None:
    data, precision = copy.deepcopy(honest("rotor")), ctx.prec
    judge(data)
    judge(reordered(data))
    assert data == honest("rotor") and ctx.prec == precision


@given(st.floats(-30, 30), st.floats(0, 40))
@example(0.0, 0.0)
@example(-1e-300, 2e-300)
@example(-0.5, 1.0)
@example(700.0, 1.0)
@example(-3.0, 1e-12)
def test_a_tanh_lies_between_its_two_lines(lo: float, width: float) -> None:
    with ctx.workprec(160):
        slope, shift, gap = tanh_between(arb(lo), arb(lo + width))
        for t in np.linspace(0, 1, 33).tolist():
            y = arb(lo) + arb(t) * (arb(lo + width) - arb(lo))
            assert abs(y.tanh() - slope * y - shift) <= arb((gap * (1 + arb(2) ** -100)).upper() + arb(2) ** -140)
        if 1e-12 < width < 1:
            assert 0 <= gap <= 0.1 * width**2  # |tanh''| < 0.77, an eighth of it


def member(v: Model, d: list[float], sign: int) -> arb:
    """The largest or the least number that v allows at d, errors of inputs among the rest."""
    return linear(v, d) + curved(v, d) + sign * form(v.whole, d)


def value_of_function(name: str, v: arb) -> arb:
    return 1 / v if name == "1/" else getattr(v, name)()


@pytest.mark.parametrize("size", [1, 2, 3])
@pytest.mark.parametrize("h", [1.0, 0.1, 1e-4])
def test_a_local_model_of_a_product_or_a_function_holds(size: int, h: float) -> None:
    """Of anything that the models of the operands allow, with errors of inputs that they share."""
    generator, count = np.random.default_rng(size), size * (size + 1) * (size + 2) // 6

    def semidefinite() -> np.ndarray:
        A = generator.choice([0, 1, 1]) * generator.standard_normal((size, size))
        result: np.ndarray = h * A @ A.T
        return result

    def anything() -> Model:
        a, Q = (h * generator.choice([0, 1, 1]) * generator.standard_normal((size, k)) for k in (1, size))
        K = h * generator.choice([0, 1, 1]) * generator.standard_normal(count)
        at_0 = generator.choice([-1, 0, 1]) * generator.uniform(0, 2) + generator.choice([0, 20 * h])
        B = (generator.choice([0, 1, 1], 2) * generator.standard_normal(2)).tolist()
        return model(at_0, a[:, 0], Q + Q.T, semidefinite(), K, B, errors)

    def value(v: Model) -> arb:
        """Somewhere within its own bound; the errors of the inputs are the same for all."""
        own = float(generator.choice([-1, 1])) * form(v.E, d)
        return linear(v, d) + curved(v, d) + own + named(v)

    def named(v: Model) -> arb:
        return balls.total(b * e for b, e in zip(v.B, common, strict=True))

    def left(truth: arb, v: Model) -> arb:
        """What remains beside the named errors, as a part of d'Ed."""
        return beyond(truth - named(v), dataclasses.replace(v, B=(), errors=()), d)

    with ctx.workprec(160):
        for _ in range(60):
            errors = [matrix(semidefinite()) for _ in range(2)]
            v, w = anything(), anything()
            d = generator.standard_normal(size)
            d = (d / np.linalg.norm(d) * generator.choice([1 - 1e-12, 0.5])).tolist()
            common = [float(generator.choice([-1, 1, 0.3])) * form(U, d) for U in errors]
            x, y = value(v), value(w)
            assert left(x * y, v * w) <= 1
            assert left(x - y, v + -w) <= 1
            assert left(x - 2, v.shifted(arb(-2))) <= 1
            for name in ("sin", "cos", "tanh", "exp", "atan"):
                if name != "exp" or v.v < 5:  # else rounding is more than what this helper forgives
                    assert left(value_of_function(name, x), v.function(name)) <= 1
            if abs(v.v) > v.radius:
                assert left(1 / x, v.function("1/")) <= 1
            else:
                with pytest.raises(Refused, match="local"):
                    v.function("1/")
            if v.v > v.radius:
                assert left(x.sqrt(), v.function("sqrt")) <= 1
            else:
                with pytest.raises(Refused, match="local"):
                    v.function("sqrt")


PARTS = [p for p in itertools.product([0, 1], repeat=4) if any(p)]  # of a, Q, K, E: which are not 0


def one_state(at_0: float, sizes: tuple[float, ...], of_input: float = 0.0) -> Model:
    """What is left is in E; or, of an input whose error is that large, it is weighed such that it is as large."""
    a, Q, K, E = sizes
    if of_input:
        return model(at_0, [a], [[Q]], [[0.0]], [K], [-E / of_input], [matrix([[of_input]])])
    return model(at_0, [a], [[Q]], [[E]], [K])


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize("p", PARTS)
def test_the_remainder_of_a_product_is_the_least(p: tuple[int, ...], named: bool) -> None:
    """In one state, where everything has the same sign: no term of E may go."""
    for q in PARTS:
        with ctx.workprec(160):
            v, w = (
                one_state(c, tuple(x * y for x, y in zip(parts, (0.5, 0.25, 0.125, 0.375), strict=True)), 0.75 * named)
                for c, parts in ((0.75, p), (1.25, q))
            )
            product, value = v * w, member(v, [1.0], 1) * member(w, [1.0], 1)
            assert product.whole[0, 0] == 0 or 1 >= beyond(value, product, [1.0]) > 1 - 1e-12, q


LINEAR = (1, 0, 0, 0)


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize(
    ("name", "at_0", "parts"),
    [
        *((name, 0.0, [p for p in PARTS if p != LINEAR]) for name in ("sin", "tanh")),  # a fifth order
        *(
            (name, at, PARTS)
            for name, at in (
                *(("1/", -2.0), ("1/", 0.75), ("cos", 0.0), ("cos", 1.0), ("sin", -1.0), ("exp", 0.5), ("sqrt", 2.0)),
                *(("tanh", 0.5), ("tanh", -0.25), ("tanh", 2.0), ("atan", math.tan(math.pi / 10))),
            )
        ),
    ],
)
def test_the_remainder_of_a_function_is_the_least(
    name: str, at_0: float, parts: list[tuple[int, ...]], named: bool
) -> None:
    """In one state, where v moves little and the terms of the leading order have the same sign."""
    h = 2.0**-14
    for each in parts:
        with ctx.workprec(300):
            v = one_state(at_0, tuple(h * p for p in each), 2 * h * named)
            found = beyond(value_of_function(name, member(v, [1.0], 1)), v.function(name), [1.0])
            assert 1 >= found > (0.99 if name == "atan" else 0.995), each


def series(name: str, v: arb) -> arb_series:
    x = arb_series([v, 1], 5)
    if name == "tanh":
        return 1 - 2 / ((2 * x).exp() + 1)
    return getattr(x, name)()


@pytest.mark.parametrize("name", ["sin", "cos", "tanh", "exp", "atan", "1/", "sqrt"])
def test_the_fourth_derivative_is_bounded(name: str) -> None:
    """Over ranges of all sizes, by series of balls; for 1/v and sqrt the rest itself, divided by D^4."""
    generator = np.random.default_rng(4)
    with ctx.workprec(200):
        for _ in range(200):
            c, reach = float(generator.uniform(-4, 4)), float(np.exp(generator.uniform(-9, 1.5)))
            if name == "sqrt" or (name == "1/" and abs(c) <= reach):
                c = reach * float(1 + np.exp(generator.uniform(-9, 2))) * (1 if name == "sqrt" else np.sign(c))
            at = FUNCTIONS[name].derivatives(arb(c))
            most = FUNCTIONS[name].fourth(arb(c), at, arb(reach))
            assert most is not None
            for D in [-reach, reach, *(reach * generator.uniform(-1, 1, 8))]:
                v = arb(c) + arb(float(D))
                if name in ("1/", "sqrt"):
                    e = arb(float(D))
                    cube = at[0] + at[1] * e + at[2] / 2 * e * e + at[3] / 6 * e * e * e
                    here = 24 * (value_of_function(name, v) - cube) / (e * e * e * e)
                else:
                    here = 24 * series(name, v)[4]
                assert abs(here) <= most * (1 + arb(2) ** -40) + arb(2) ** -100


@pytest.mark.parametrize(
    ("name", "at_0", "reach"),
    [
        ("1/", 2.0, 2.0),
        ("1/", -1.0, 3.0),
        ("1/", 0.0, 0.0),
        ("sqrt", 2.0, 2.0),
        ("sqrt", -2.0, 0.5),
        ("sqrt", 0.0, 0.0),
    ],
)
def test_what_may_be_undefined_has_no_fourth_derivative(name: str, at_0: float, reach: float) -> None:
    assert FUNCTIONS[name].fourth(arb(at_0), (arb(1),) * 4, arb(reach)) is None
    with pytest.raises(Refused, match="local"):
        model(at_0, [reach], [[0.0]], [[0.0]]).function(name)


def local_inputs(data: Document, rho: float) -> list[Model]:
    """The policy on the ball x = T rho d, ||d|| <= 1."""
    c = read_certificate(dump(with_ball(data)))
    return inputs_on(c, exact(rho) * tree_evidence(c).T)


def deep(squash: str, centre: str) -> Document:
    """Three hidden layers, two states and two inputs; only the policy is of interest."""
    generator = np.random.default_rng(7)
    sizes = [2, 5, 4, 3, 2]
    layers = [(generator.standard_normal((b, a)), generator.uniform(-1, 1, b)) for a, b in itertools.pairwise(sizes)]
    return make(
        ["u", "v"], layers, np.eye(2), (0.01, 0.01), states="xy", inputs="uv", u_eq=["1/4", "-1/3"],
        domain=[("-3", "3")] * 2, input_bounds=[("-9", "9")] * 2, squash=squash, centre=centre, scale=[-2.0, 1.5],
        offset=[0.0, 0.125], T=np.array([[1.0, 0.25], [-0.5, 2.0]]),
    )  # fmt: skip


@pytest.mark.parametrize("name", ["rotor", "tanh output", "tanh preactivation", "identity output"])
@pytest.mark.parametrize("rho", [0.01, 0.1, 1.0])
def test_the_local_ball_encloses_the_policy(name: str, rho: float) -> None:
    """At points of the ball, against ball arithmetic that shares nothing with it."""
    data = honest(name) if name == "rotor" else deep(*name.split())
    c, generator = parse(data), np.random.default_rng(1)
    mine = read_certificate(dump(with_ball(data)))
    T = tree_evidence(mine).T.tolist()
    with ctx.workprec(160):
        inputs = local_inputs(data, rho)
        for direction in generator.standard_normal((40, mine.n)):
            d = direction / np.linalg.norm(direction) * generator.uniform(0, 1 - 1e-12)
            z = [arb(rho) * v for v in d.tolist()]
            x = [balls.total(arb(t) * v for t, v in zip(row, z, strict=True)) for row in T]
            for value, u in zip(policy_in_arb(c.policy, c.u_eq, x), inputs, strict=True):
                assert beyond(value, u, d.tolist()) <= 1


CHAIN = ((0.75, 0.5), (1.25, 0.25), (0.875, 0.375), (1.5, 0.125))


@pytest.mark.parametrize("squash", ["tanh", "identity"])
@pytest.mark.parametrize("what", ["Q", "K"])
def test_the_local_model_is_sharp_on_a_small_ball(squash: str, what: str) -> None:
    """A chain of tanhs that all bend the same way, at 0 for K: what is left is Q, and K, as the ball shrinks."""
    layers = [(np.array([[w]]), np.array([-b if what == "Q" else 0.0])) for w, b in CHAIN]
    data = make(["u"], layers, np.eye(1), (0.01, 0.01), squash=squash, centre="output", scale=[2.0])
    rho, policy = 2.0**-20, parse(data).policy
    with ctx.workprec(160):
        (u,) = local_inputs(data, rho)
        (value,) = policy_in_arb(policy, [Fraction(0)], [arb(rho)])
        bound = u.Q[0, 0] if what == "Q" else u.K[0, 0]
        assert abs((value - linear(u, [1.0])) / bound - 1) < 1e-4
        assert what == "Q" or u.bend == 0


@pytest.mark.parametrize("squash", ["tanh", "identity"])
def test_what_a_local_model_leaves_out_is_of_the_fourth_order(squash: str) -> None:
    """Beside the truth, on balls that shrink: a sixteenth of it at half the radius, and no hundred times the truth."""
    layers = [(np.array([[w]]), np.array([-b])) for w, b in CHAIN]
    data = make(["u"], layers, np.eye(1), (0.01, 0.01), squash=squash, centre="output", scale=[2.0])
    policy, rests, bounds = parse(data).policy, list[float](), list[float]()
    with ctx.workprec(300):
        for rho in (2.0**-8, 2.0**-9, 2.0**-10):
            (u,) = local_inputs(data, rho)
            (value,) = policy_in_arb(policy, [Fraction(0)], [arb(rho)])
            rests.append(float(abs(value - linear(u, [1.0]) - curved(u, [1.0]))))
            bounds.append(float(u.whole[0, 0]))
    assert all(15 < p / q < 17 for values in (rests, bounds) for p, q in itertools.pairwise(values))
    assert rests[-1] < bounds[-1] < 100 * rests[-1]


@pytest.mark.parametrize("scale", [2.0, -0.5])
@pytest.mark.parametrize("squash", ["tanh", "identity"])
def test_a_single_tanh_leaves_out_what_it_must(squash: str, scale: float) -> None:
    """As the output, or as the only unit before it: on a small ball no number is left that a bound could spare."""
    layers = [(np.array([[0.75]]), np.array([0.5]))]
    if squash == "identity":
        layers.append((np.array([[-1.5]]), np.array([0.25])))
    data = make(["u"], layers, np.eye(1), (0.01, 0.01), squash=squash, centre="output", scale=[scale])
    rho, policy = 2.0**-20, parse(data).policy
    with ctx.workprec(300):
        (u,) = local_inputs(data, rho)
        (value,) = policy_in_arb(policy, [Fraction(0)], [arb(rho)])
        assert 1 >= beyond(value * 2**60, scaled(u, 2**60), [1.0]) > 0.99


def scaled(v: Model, factor: int) -> Model:
    """Such that what is left is large beside the rounding that `beyond` forgives."""
    return dataclasses.replace(
        v, v=v.v * factor, a=factor * v.a, Q=factor * v.Q, K=factor * v.K, E=factor * v.whole, B=(), errors=()
    )


@pytest.mark.parametrize("name", ["rotor", "rotor, preactivation", "crane"])
@pytest.mark.parametrize("rho", [2.0**-20, 0.01])
def test_the_ball_encloses_F(name: str, rho: float) -> None:
    data = crane("output", ("-3/2", "3/2")) if name == "crane" else honest(name)
    c, mine, generator = parse(data), read_certificate(dump(with_ball(data))), np.random.default_rng(1)
    with ctx.workprec(160):
        J = exact(rho) * tree_evidence(mine).T
        loop = Loop(mine)
        F = loop.within(loop.known(J, "local", "ball"), (), "local", "ball").components
        for direction in generator.standard_normal((40, mine.n)):
            d = (direction / np.linalg.norm(direction) * generator.uniform(0, 1 - 1e-12)).tolist()
            x = (arb_mat(J) * arb_mat([[arb(v)] for v in d])).entries()
            names = dict(
                zip(mine.plant.states + mine.plant.inputs, x + policy_in_arb(c.policy, c.u_eq, x), strict=True)
            )
            for equation, f in zip(data["plant"]["dynamics"], F, strict=True):
                assert beyond(value_of(equation, names), f, d) <= 1


@pytest.mark.parametrize("power", [2, 3, 5])
@pytest.mark.parametrize("states", ["x", "xy"])
def test_the_limit_of_the_local_rule(power: int, states: str) -> None:
    """Without an input: x' = -x + 2 x^k alone, or x' = -x and y' = -y + 2 x^k, with V = 4 ||x||^2.

    In one state the rule ends where Vdot < 0 does, at 2 r^(k - 1) = 1. In two a square is its Q, 2 r^2 on d_x^2, which
    leaves 8 r^2 - 4 r^4 / beta and 8 r^2 - 16 r^2 beta. A cube is N, with 2 r^4 where one of four indices is y: S_cubic
    is tau_y + N_x'N_x / tau_x on d_y^2, and on d_x^2 tau_x + N_y'N_y / tau_y + N_x'N_x / tau_x, 2 + sqrt(12) + 4 /
    sqrt(3) times r^2^2. A fifth power is a product of x^2 x^2 and x, and no more than E = 2 r^5 I: 8 r^2 - 16 r^6.
    """
    n = len(states)
    beta = 2.0**-60 if power > 2 else 0.49975 if n == 2 else 0.25
    limit = 4 * 0.5 ** (2 / (power - 1))
    if n == 2 and power < 5:
        limit = 4.0 if power == 2 else 4 * 8 / (2 + math.sqrt(12) + 4 / math.sqrt(3))
    turned = n == 2 and power != 3
    T = np.array([[0.6, -0.8], [0.8, 0.6]]) if turned else np.eye(n)
    bent = ["*", "2", ["**", "x", power]]
    dynamics: list[Any] = [["-", "x"], ["+", ["-", "y"], bent]] if n == 2 else [["+", ["-", "x"], bent]]
    for c1, found in ((0.999 * limit, None), (1.001 * limit, "local")):
        layers = [(np.zeros((1, n)), [0.0])]
        data = make(dynamics, layers, 4 * np.eye(n), (c1, c1), states=states, domain=[("-3", "3")] * n, T=T)
        J = math.sqrt(c1 / 4) * (1 + 2.0**-40) * T
        rows = [[0.0] * n, [2.0**-60] * (n - 1) + [beta], [0.0] * n]
        if n == 2 and power == 3:  # jointly
            rows = [[0.0] * n, [0.0] * n, [2.0**-60] * n]
        assert judge(edited(with_ball(data), "evidence.local", centred(J, rows))) == found


def test_the_inputs_on_the_local_ball() -> None:
    data = honest("rotor")
    data = with_ball(edited(data, "levels.roa", data["levels"]["local"]))
    c = read_certificate(dump(data))
    with ctx.workprec(160):
        reach = [Fraction(float(u.radius)) for u in inputs_on(c, ball_of(c).J)]
    for factor, found in ((1 + Fraction(1, 2**20), None), (1 - Fraction(1, 2**20), "inputs")):
        each = zip(map(fraction, c.plant.u_eq), reach, strict=True)
        bounds = [[str(q - factor * r), str(q + factor * r)] for q, r in each]
        assert judge(edited(data, "plant.input_bounds", bounds)) == found


@pytest.mark.parametrize("what", ["a", "Q", "K", "E"])
@pytest.mark.parametrize("bad", ["nan", "inf", "-inf", "[0 +/- inf]"])
def test_what_is_not_finite_is_not_accepted(monkeypatch: pytest.MonkeyPatch, what: str, bad: str) -> None:
    c = read_certificate(dump(with_ball(honest("local only"))))
    policy = Policy.on

    def broken(*arguments: Any) -> Any:
        (first, *others), units = policy(*arguments)
        old = getattr(first, what)
        change = {what: arb_mat(old.nrows(), old.ncols(), [arb(bad)] * len(old.entries()))}
        return [dataclasses.replace(first, **change), *others], units

    with ctx.workprec(160):
        local.local(Loop(c), ball_of(c), ())
        monkeypatch.setattr(Policy, "on", broken)
        monkeypatch.setattr("certify.reference.loop.within_bounds", lambda *_: True)
        with pytest.raises(Refused, match="local"):
            local.local(Loop(c), ball_of(c), ())


def leaves_of(data: Document) -> tuple[leaves.Leaves, list[leaves.Leaf]]:
    c = read_certificate(dump(with_ball(data)))
    S, _ = rational.coordinates(c, tree_evidence(c))
    all_leaves = leaves.Leaves(c, tree_evidence(c).T, S)
    return all_leaves, all_leaves.enclose(list(leaves.boxes(tree_evidence(c))))


@pytest.mark.parametrize("name", ["rotor", "rotor, preactivation", "crane"])
def test_leaves_enclose_the_policy_V_and_Vdot(name: str) -> None:
    """At points of each leaf, against ball arithmetic that shares nothing with the leaf's models."""
    data = crane("output", ("-3/2", "3/2")) if name == "crane" else honest(name)
    c, generator = parse(data), np.random.default_rng(1)
    with ctx.workprec(160):
        shared, each = leaves_of(data)
        mine = shared.c
        for leaf in each[::5]:
            Vdot, V = shared.D(leaf).bound(), (shared.V(leaf).bound(), (-shared.V(leaf)).bound())
            for d in generator.uniform(-1, 1, (3, mine.n)).round().tolist():
                ends = zip(leaf.box.lo, leaf.box.hi, d, strict=True)
                z = [(Fraction(a) + Fraction(b) + (Fraction(b) - Fraction(a)) * Fraction(t)) / 2 for a, b, t in ends]
                point = fmpq_mat(mine.n, 1, [fmpq(v.numerator, v.denominator) for v in z])
                x = [arb(v) for v in (tree_evidence(mine).T * point).entries()]
                u = policy_in_arb(c.policy, c.u_eq, x)
                for value, (centre, radius) in zip(u, leaf.ranges(), strict=True):
                    assert abs(value - centre) <= radius * (1 + arb(2) ** -100)
                names = dict(zip(mine.plant.states + mine.plant.inputs, x + u, strict=True))
                f = [value_of(e, names) for e in data["plant"]["dynamics"]]
                Px = [sum((arb(p) * v for p, v in zip(row, x, strict=True)), arb(0)) for row in c.P.tolist()]
                assert 2 * sum((p * v for p, v in zip(Px, f, strict=True)), arb(0)) <= Vdot
                value = sum((p * v for p, v in zip(Px, x, strict=True)), arb(0))
                assert value <= V[0] + arb(2) ** -100 and -value <= V[1] + arb(2) ** -100


@pytest.mark.parametrize("name", ["tanh output", "tanh preactivation", "tanh none", "identity output"])
def test_leaves_of_a_batch_enclose_a_deep_policy(name: str) -> None:
    """Three layers of tanhs, boxes of many sizes in one batch: each has slopes of its own, the products are shared."""
    tree, generator = bytes([0, LEAF, 1, LEAF, 0, LEAF, 1, LEAF, LEAF]), np.random.default_rng(2)
    data = with_tree(deep(*name.split()), tree)
    data = edited(data, "evidence.root", encode([0.5, 0.75]))
    c, (shared, each) = parse(data), leaves_of(data)
    T, worst = tree_evidence(shared.c).T.tolist(), 0.0
    assert len({tuple(leaf.box.lo) + tuple(leaf.box.hi) for leaf in each}) == 5
    with ctx.workprec(128):
        for leaf in each:
            points = [*itertools.product([-1.0, 1.0], repeat=2), *generator.uniform(-1, 1, (60, 2)).tolist()]
            for at in points:
                ends = zip(leaf.box.lo, leaf.box.hi, at, strict=True)
                z = [0.5 * lo + 0.5 * hi + 0.5 * (hi - lo) * t for lo, hi, t in ends]
                x = [balls.total(arb(t) * v for t, v in zip(row, z, strict=True)) for row in T]
                d = [(arb(v) - m) / r for v, m, r in zip(z, leaf.centre, leaf.radius, strict=True)]
                for value, u in zip(policy_in_arb(c.policy, c.u_eq, x), leaf.u, strict=True):
                    mid, slopes, error = u.form
                    off = abs(value - mid - balls.total(s * t for s, t in zip(slopes, d, strict=True)))
                    assert off <= error * (1 + arb(2) ** -60)
                    worst = max(worst, float(off / error))
    assert worst > 0.05  # not by being wide


def test_a_leaf_is_enclosed_alike_alone_and_among_others() -> None:
    data = edited(deep("tanh", "output"), "evidence.root", encode([0.5, 0.75]))
    shared, each = leaves_of(with_tree(data, bytes([0, LEAF, 1, LEAF, 0, LEAF, 1, LEAF, LEAF])))
    with ctx.workprec(128):
        for leaf in each:
            (alone,) = shared.enclose([leaf.box])
            for u, other_u in zip(leaf.u, alone.u, strict=True):
                (mid, slopes, error), (other, others, same) = u.form, other_u.form
                for v, w in zip((mid, *slopes, error), (other, *others, same), strict=True):
                    assert abs(v - w) <= arb(2) ** -80
