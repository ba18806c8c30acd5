"""What is proved is the equation as it was written: where a part of it has no value in the set, nothing is PROVED.

The oracle reads the text for itself and evaluates each part of it in Arb; it shares nothing with the project's trees.
"""

from __future__ import annotations

import ast
import copy
import io
import json
import pickle
import random
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import flint
import numpy as np
import pytest
import sympy

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates.limits import require_within_limits
from certify.certificates.verdict import Verdict
from certify.checker import __main__ as checker
from certify.checker import expression as checkers_tape
from certify.errors import InputError
from certify.loop.expressions import (
    FUNCTIONS,
    Expression,
    Number,
    Operation,
    differentiate,
    evaluate_exactly,
    from_sympy,
    from_tree,
    symbols,
    to_tree,
)
from certify.loop.plants import System
from certify.loop.plants.equations import parse_expression
from certify.loop.policies import PolicyNetwork
from certify.loop.rigorous import evaluate_arb
from certify.reference.expressions import equations
from certify.report.mathml import typeset
from tests.support.algebra import same, to_sympy

X, U, K, W = symbols("x u k w")
HALF, LEVEL = Fraction(2), 1.9
POLICY = PolicyNetwork.of_layers((np.array([[-0.5]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")

# ------------------------------------------------------------------------------------------------------------- oracle


class Undefined(Exception):
    """A part of the text has no value."""


def value(node: ast.AST, names: dict[str, flint.arb]) -> flint.arb:
    """The value of a text's part in Arb; raises `Undefined` if it or a part of it has none."""
    if isinstance(node, ast.Constant):
        q = Fraction(str(node.value))
        return flint.arb(flint.fmpq(q.numerator, q.denominator))
    if isinstance(node, ast.Name):
        return names[node.id]
    if isinstance(node, ast.UnaryOp):
        found = -value(node.operand, names)
    elif isinstance(node, ast.Call):
        assert isinstance(node.func, ast.Name) and node.func.id in FUNCTIONS
        found = getattr(value(node.args[0], names), node.func.id)()
    else:
        assert isinstance(node, ast.BinOp)
        a, b = value(node.left, names), value(node.right, names)
        kind = type(node.op).__name__
        if kind == "Pow":
            k = int(b.unique_fmpz())
            found = a**k if k > 0 else 1 / a**-k
        else:
            found = {"Add": a + b, "Sub": a - b, "Mult": a * b}[kind] if kind != "Div" else a / b
    if not found.is_finite():
        raise Undefined
    return found


def is_undefined(text: str, specials: list[Fraction]) -> bool:
    """Whether a part of the text has no value at one of these points, or of a grid, in the set."""
    root = Fraction(LEVEL)
    points = [Fraction(k, 16) for k in range(-22, 23)] + specials
    tree = ast.parse(text, mode="eval").body
    zero = flint.arb(0)
    for x in points:
        if x * x > root:
            continue
        try:
            value(tree, {"x": flint.arb(flint.fmpq(x.numerator, x.denominator)), "u": zero, "k": zero, "w": zero})
        except Undefined:
            return True
    return False


# ---------------------------------------------------------------------------------------------------------- equations

ONES = (
    "(x - {a})/(x - {a})", "sqrt(x - {a})**2/(x - {a})", "(x - {a})**2*(x - {a})**(-2)", "cos(x - {a})/cos(x - {a})",
    "(tan(x - {a}) + 5)/(tan(x - {a}) + 5)", "exp(sqrt(x - {a}))*exp(-sqrt(x - {a}))",
    "((x - {a})*(x + {b}))/((x - {a})*(x + {b}))", "(1 + k/(x - {a}))", "(x - {a})*(1/(x - {a}))", "exp(x)/exp(x)",
    "(x**2 - {a}**2)/((x - {a})*(x + {a}))", "sqrt(x - {a})/sqrt(x - {a})", "(4 + x)/(x + 4)", "(1 + 0*tanh(x))",
)  # fmt: skip
"""Texts whose value is 1 to whoever simplifies them."""
ZEROS = (
    "k/(x - {a})", "k*sqrt(x - {a})", "w/(x - {a})", "w*tan(x - {a})", "0/(x - {a})**2", "k*(x - {a})**(-3)",
    "sqrt(x - {a}) - sqrt(x - {a})", "1/(x - {a}) - 1/(x - {a})", "0*atan(1/(x - {a}))", "x*k*exp(1/(x - {a}))",
    "k*sin(x)", "w*x", "x - x", "(k + w)/(3 + x)", "sqrt({a} - x)*k", "0*x",
)  # fmt: skip
"""Texts whose value is 0 to whoever simplifies them."""


def written(rng: random.Random) -> tuple[str, list[Fraction]]:
    """A random equation that is `u - x` to whoever simplifies it, and the points that it is odd at."""
    specials = []

    def some(texts: tuple[str, ...]) -> str:
        a, b = (Fraction(rng.randint(-24, 24), rng.choice([2, 3, 5, 8])) or Fraction(7, 5) for _ in "ab")
        specials.extend([a, -b, -a])
        return rng.choice(texts).format(a=f"({a})", b=f"({b})")

    forms = (
        "-x*{one} + u + {zero}", "{zero} - x + {one}*u", "-({one} + {zero})*x + u*{other}", "-x + (u + {zero})/{one}",
        "u - sqrt((3 + x)**2)*x*{one}/(x + 3)", "-x*{one}*{other} + u", "u + {zero} - x", "-x/{one} + u*{one}",
    )  # fmt: skip
    return rng.choice(forms).format(one=some(ONES), other=some(ONES), zero=some(ZEROS)), specials


def plant(text: str) -> System:
    equation = parse_expression(text, {"x": X, "u": U, "k": K, "w": W})
    domain, inputs = ((-HALF, HALF),), ((Fraction(-9), Fraction(9)),)
    return System("odd", (X,), (U,), {"k": Fraction(0)}, (equation,), (Number(0),), domain, inputs, disturbances=(W,))


@pytest.fixture
def checked_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """The checker in this process: its start would take most of the time."""

    def run(path: Path, **_: Any) -> dict[str, Any]:
        said = io.StringIO()
        with redirect_stdout(said):
            checker.main(["--json", "--", str(path)])
        return dict(json.loads(said.getvalue()))

    monkeypatch.setattr("certify.analysis.acceptance.run_checker", run)


def proved(text: str, folder: Path, claim: Any = "auto") -> bool:
    """Whether a run says PROVED of the set {x^2 <= 1.9}."""
    options = RoaOptions(P=np.eye(1), level=LEVEL, max_boxes=400, claim=claim)
    try:
        system = plant(text)
        result = certify_roa(system, POLICY, folder, options)
    except InputError:
        return False
    return result.verdict is Verdict.PROVED


# -------------------------------------------------------------------------------------------------------------- proofs


def survey(seeds: range, folder: Path) -> tuple[int, int, int]:
    """How many equations are proved, undefined in the set, and neither; fails where one is both."""
    counts = [0, 0, 0]
    for seed in seeds:
        text, specials = written(random.Random(seed))
        undefined, is_proved = is_undefined(text, specials), proved(text, folder)
        assert not (undefined and is_proved), f"PROVED, and has no value at a point of the set: {text}"
        counts[0 if is_proved else 1 if undefined else 2] += 1
    return counts[0], counts[1], counts[2]


@pytest.mark.usefixtures("checked_here")
@pytest.mark.parametrize(
    "seeds", [range(25), pytest.param(range(100, 10_100), marks=pytest.mark.slow)], ids=["25", "10000"]
)
def test_nothing_is_proved_where_a_part_of_the_equation_has_no_value(tmp_path: Path, seeds: range) -> None:
    held, undefined, _ = survey(seeds, tmp_path)
    assert held > len(seeds) / 10 and undefined > len(seeds) / 10


CANCELLING = ("-sqrt(x)**2 + u", "-x*(x-1)/(x-1) + u", "-x + k/(x-1) + u", "-x + w/(x-1) + u", "-x + 0/(x-1)**2 + u")


@pytest.mark.parametrize("text", CANCELLING)
def test_an_equation_that_cancels_to_a_stable_one_is_not_proved(tmp_path: Path, text: str) -> None:
    """Where it has no value at all around the origin, it is no input that a run can use."""
    assert is_undefined(text, [Fraction(1)]) and not proved(text, tmp_path)
    assert not proved(text, tmp_path, claim="practical")
    assert same(plant(text).exact_dynamics()[0], U - X)  # says sympy, which once saw it first


def test_the_same_equation_is_proved_where_it_has_values(tmp_path: Path) -> None:
    result = certify_roa(plant("-x*(x-2)/(x-2) + k/(x+2) + u"), POLICY, tmp_path, RoaOptions(P=np.eye(1), level=LEVEL))
    assert result.verdict is Verdict.PROVED and result.certificate is not None
    stated = json.loads(result.certificate.read_text())["plant"]["dynamics"]
    quotient = ["/", ["*", ["-", "x"], ["+", "x", "-2"]], ["+", "x", "-2"]]
    assert stated == [["+", quotient, ["/", "0", ["+", "x", "2"]], "u"]]


# --------------------------------------------------------------------------------------------------------------- trees

TEXTS = [written(random.Random(seed))[0] for seed in range(200)]
NAMES = {"x": X, "u": U, "k": K, "w": W}


def at(text: str, point: dict[str, Fraction]) -> flint.arb | None:
    """The value of a text by the oracle, None if it has none."""
    names = {name: flint.arb(flint.fmpq(q.numerator, q.denominator)) for name, q in point.items()}
    try:
        return value(ast.parse(text, mode="eval").body, names)
    except Undefined:
        return None


def random_point(seed: int) -> dict[str, Fraction]:
    rng = random.Random(seed)
    return {name: Fraction(rng.randint(-40, 40), rng.choice([3, 7, 8])) for name in NAMES}


@pytest.mark.parametrize("part", range(4))
def test_gathered_constants_change_neither_a_value_nor_where_there_is_one(part: int) -> None:
    for seed, text in enumerate(TEXTS[part::4]):
        expression = parse_expression(text, NAMES)
        for k in range(20):
            point = random_point(100 * seed + k)
            wanted = at(text, point)
            balls = {NAMES[n]: flint.arb(flint.fmpq(q.numerator, q.denominator)) for n, q in point.items()}
            found = evaluate_arb(expression, balls)
            assert found.is_finite() == (wanted is not None), (text, point)
            assert wanted is None or found.overlaps(wanted)


def test_text_and_lists_give_the_tree_back() -> None:
    for text in TEXTS:
        expression = parse_expression(text, NAMES)
        assert from_tree(json.loads(json.dumps(to_tree(expression))), NAMES) is expression
        again = parse_expression(str(expression), NAMES)
        for k in range(5):
            a, b = at(text, random_point(k)), at(str(again), random_point(k))
            assert (a is None) == (b is None) and (a is None or b is None or a.overlaps(b))


def test_equal_trees_are_one_object_through_pickles_and_threads() -> None:
    expression = parse_expression("sin(x)*u/(k + w) - 3*x**2", NAMES)
    assert pickle.loads(pickle.dumps(expression)) is expression
    assert copy.deepcopy(expression) is expression
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda _: [parse_expression(text, NAMES) for text in TEXTS[:40]], range(16)))
    assert all(a is b for row in made for a, b in zip(row, made[0], strict=True))


def test_derivatives_are_those_of_sympy() -> None:
    texts = ["sin(x)*cos(u)/(3 + x)", "tan(x/5)**3", "tanh(x*u)**(-2)", "exp(-x)*atan(x*u)", "sqrt(9 + x)**3/x",
             "x**(-64)", "x/(x + u)/u", "-(x - u)**2*(1 - x)*(k + x)", "5"]  # fmt: skip
    point = {"x": Fraction(3, 7), "u": Fraction(-5, 3), "k": Fraction(1, 2), "w": Fraction(0)}
    balls = {NAMES[n]: flint.arb(flint.fmpq(q.numerator, q.denominator)) for n, q in point.items()}
    for text in texts:
        for name in ("x", "u"):
            found = evaluate_arb(differentiate(parse_expression(text, NAMES), NAMES[name]), balls)
            wanted = sympy.diff(to_sympy(parse_expression(text, NAMES)), sympy.Symbol(name))
            number = wanted.subs({sympy.Symbol(n): sympy.Rational(q) for n, q in point.items()}).evalf(30)
            assert abs(float(found.mid()) - float(number)) <= 1e-12 * max(1.0, abs(float(number))), text


def test_a_derivative_keeps_the_points_at_which_there_is_none() -> None:
    for text in ("k*sqrt(x)", "0/x", "sqrt(x)**2", "x/x"):
        found = differentiate(parse_expression(text, NAMES), X)
        balls = {NAMES[n]: flint.arb(0) for n in NAMES}
        assert not evaluate_arb(found, balls).is_finite()


def test_what_sympy_simplified_is_taken_only_from_who_asks_for_that() -> None:
    x = sympy.Symbol("x")
    odd = x * (x - 1) / (x - 1)
    with pytest.raises(InputError, match="from_sympy"):
        System("s", (X,), (U,), {}, (odd,), (Number(0),), ((-HALF, HALF),), ((-HALF, HALF),))
    assert from_sympy(odd) is X  # which is all that is left of it


def test_a_number_that_has_no_value_is_refused_where_the_plant_is_read(tmp_path: Path) -> None:
    for text in ("u - x/(2 - 2)", "u - x*sqrt(-1)", "u + (1 - 1)**(-1)"):
        with pytest.raises(InputError, match=r"divides by 0|square root of -1"):
            plant(text)
    with pytest.raises(InputError, match=r"has no value with the parameters k = 0: it divides by 0"):
        plant("u - x/k").exact_dynamics()


# -------------------------------------------------------------------------------------------- odd names, numbers, sizes


@pytest.mark.parametrize("q", ["1000000000000000000001/9", "-123456789012345678901/9", "1000000000000000000001", "1/3"])
@pytest.mark.parametrize("form", ["x/q", "q**2*x", "1/q/x", "x - q", "-q*x", "2*(x + q)"])
def test_text_gives_long_fractions_back(form: str, q: str) -> None:
    expression, point = parse_expression(form, {"x": X, "q": Number(Fraction(q))}), {X: Fraction(3, 5)}
    assert evaluate_exactly(parse_expression(str(expression), {"x": X}), point) == evaluate_exactly(expression, point)


def test_a_letter_that_python_takes_for_another_is_refused(tmp_path: Path) -> None:
    """To Python a bold x is x, so that an equation would not be about the name that a line of [where] gives it."""
    with pytest.raises(InputError, match="plain ASCII; found '\U0001d431'"):
        parse_expression("u - \U0001d431", NAMES)


def test_a_long_equation_is_read_in_the_time_of_its_length() -> None:
    row = "(" + "+".join(["x*3"] * 40) + ")"
    start = time.perf_counter()
    parse_expression("+".join([row] * 118), NAMES)  # 20 kB
    assert time.perf_counter() - start < 5  # it took half a minute


def test_a_long_sum_that_stands_in_many_places_takes_little_time() -> None:
    long: Expression = X
    for _ in range(13):
        long = parse_expression("s + s", {"s": long})
    start = time.perf_counter()
    for k in range(600):  # of the 1,400 such lines that 20 kB hold
        parse_expression(f"1/(s + {k})", {"s": long})
    assert time.perf_counter() - start < 3


def test_both_checkers_hold_a_number_of_more_digits_than_python_writes() -> None:
    number = "7" * 1200
    equation = ["+", ["*", number, number, number, number, "x"], "u"]
    assert len(checkers_tape.parse([equation], ["x", "u"], "plant.dynamics").operations) == 5
    assert len(equations([equation], {"x", "u"}, "plant.dynamics").steps) == 5


def test_an_equation_that_nests_too_deep_is_refused_with_words() -> None:
    deep: Expression = X
    for _ in range(200):
        deep = parse_expression("sin(s)", {"s": deep})
    for _ in range(2):
        with pytest.raises(InputError, match="nest at most 200 deep"):
            parse_expression("sin(s)", {"s": deep})
    deep = Operation("sin", deep)
    for _ in range(590):
        deep = Operation("sin", deep)
    system = replace(plant("u - x"), dynamics=(U - X + deep,))
    with pytest.raises(InputError, match="at most 200 levels of nesting in an equation; found 79"):
        require_within_limits(system, POLICY)


def test_numbers_that_python_does_not_write_are_refused_with_words() -> None:
    """Python writes at most 4,300 digits."""
    with pytest.raises(InputError, match="more than 14000 bits"):
        replace(plant("u - x*sqrt(0 - k*k)"), parameters={"k": Fraction(10**2200 + 1)}).exact_dynamics()
    with pytest.raises(InputError, match="parameter k of odd must have at most 14000 bits"):
        replace(plant("u - k*x"), parameters={"k": Fraction(10) ** 4500})


@pytest.mark.parametrize("text", ["u - x*1e400/1e400", "u - x*1e400*1e-400", "u - x*(1e200*1e200)*1e-400"])
def test_numbers_that_cancel_must_lie_within_the_range_of_the_checkers_too(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match="range of binary64; one is about 10"):
        certify_roa(plant(text), POLICY, tmp_path, RoaOptions(P=np.eye(1), level=LEVEL))


@pytest.mark.usefixtures("checked_here")
@pytest.mark.parametrize(
    "text",
    [
        "u - x + 1/(1e80 + x) - 1/1e80", "u - x/(1e-90 + 1e-90*x*x)*1e-90", "u - x - x*sqrt(1e130 + x)/1e65",
    ],
)  # fmt: skip
@pytest.mark.parametrize("ranged", [False, True])
def test_middles_whose_powers_leave_binary64_raise_nothing(tmp_path: Path, text: str, ranged: bool) -> None:
    system = plant(text + " + w*x")
    system = system.with_ranges({"w": (Fraction(-1, 9), Fraction(1, 9))}) if ranged else system
    for each in (system, replace(system, time="discrete")):
        result = certify_roa(each, POLICY, tmp_path, RoaOptions(P=np.eye(1), level=LEVEL, max_boxes=100))
        assert result.verdict in (Verdict.UNKNOWN, Verdict.REFUTED)


@pytest.mark.parametrize("wave", ["sin", "cos"])
def test_a_derivative_beyond_binary64_is_named(tmp_path: Path, wave: str) -> None:
    system = plant(f"u - x - x*{wave}((1e150 + x)*(1e150 + x)*(1e150 + x))")
    with pytest.raises(InputError, match="derivatives of odd at the origin must be within the range of binary64"):
        certify_roa(system, POLICY, tmp_path, RoaOptions(P=np.eye(1), level=LEVEL, max_boxes=100))


def test_the_page_shows_numbers_of_every_size() -> None:
    for text, shown in (
        ("1e-400*x", "<mn>1</mn><mo>·</mo><msup><mn>10</mn><mrow><mo>−</mo><mn>400</mn></mrow></msup>"),
        ("x*(1e200*1e200)", "<mn>1</mn><mo>·</mo><msup><mn>10</mn><mrow><mn>400</mn></mrow></msup>"),
        ("1234567.8912*x", "<mn>1234567.9</mn>"),
    ):
        assert shown in typeset("", parse_expression(text, NAMES))
