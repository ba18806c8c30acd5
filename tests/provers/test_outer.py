"""The engine of an outer set: its models enclose N and N'F, it proves what is so, and what is false it never proves."""

from __future__ import annotations

import dataclasses
import math
import re
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.certificates import Certificate, OuterTree, PartitionTree, run_checker
from certify.certificates.claims import Asymptotic, Problem
from certify.certificates.tree import leaves
from certify.certificates.verdict import Stop
from certify.effort import Effort
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, Number, cos, exp, sqrt, symbols
from certify.loop.plants import System, corners
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import Neural, Symbolic
from certify.lyapunov.function import Quadratic
from certify.provers.base import Budget, Progress, Task
from certify.provers.bounds import NeuralEnclosure, SymbolicEnclosure, Taylor, upper_bound
from certify.provers.boxes.engine import BoundsEngine
from certify.provers.execution import ThreadRunner
from certify.provers.outer import Nothing, OuterProof, prove_outer, split_again, split_face_again
from certify.provers.outer.falsify import Falsifier
from certify.provers.outer.rule import FaceBound, FallBound
from tests.support.loops import box, scalar_tanh
from tests.support.marks import slow_after

RUNNER = ThreadRunner()
X, Y, U, W = symbols("x y u w")
LINE, SQUARE = box(3), box(2, 2)
LIMIT = 1.915008048  # of x' = x/2 - tanh(x)


def of_layers(*layers: Any) -> Neural:
    return Neural(
        tuple(np.array(w, dtype=float) for w, _ in layers), tuple(np.array(b, dtype=float) for _, b in layers)
    )


def wells(directions: Any, width: float) -> Neural:
    """A sum of valleys `tanh(v.x - b) - tanh(v.x + b)`, each of which rises with |v.x|."""
    rows = np.repeat(np.array(directions, dtype=float), 2, axis=0)
    signs = np.tile([1.0, -1.0], len(directions))
    return of_layers((rows, -signs * width), (signs[None], [0.0]))


def plane(domain: Any = SQUARE, dynamics: Any = (-X + Y / 8, U - X / 8), **more: Any) -> System:
    """Two states that fall to the origin while they turn, under u = -y."""
    return System(
        name="plane",
        states=(X, Y),
        inputs=(U,),
        parameters={},
        dynamics=dynamics,
        u_eq=(Number(0),),
        domain=domain,
        input_bounds=box(9),
        **more,
    )


def minus_y() -> PolicyNetwork:
    return PolicyNetwork.of_layers(
        (np.array([[0.0, -1.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )


def scalar(dynamics: Expression = X / 2 + U, domain: Any = LINE, **more: Any) -> Problem:
    system, network = scalar_tanh()
    changed = dataclasses.replace(system, dynamics=(dynamics,), domain=domain, **more)
    return Problem(ClosedLoop(changed, network), Quadratic(np.eye(1)))


def planar(system: System | None = None) -> Problem:
    return Problem(ClosedLoop(plane() if system is None else system, minus_y()), Quadratic(np.eye(2)))


def attempt(problem: Problem, N: Neural | Symbolic, level: float | None = None, **more: Any) -> OuterProof | Nothing:
    n = problem.loop.system.n
    T = more.pop("T", np.eye(n))
    runner = more.pop("runner", RUNNER)
    return prove_outer(problem, more.pop("c2", 0.25), T, N, level, Budget(**more), runner)


def prove(problem: Problem, N: Neural | Symbolic, level: float | None = None, **more: Any) -> OuterProof | None:
    found = attempt(problem, N, level, **more)
    return found if isinstance(found, OuterProof) else None


def rises(problem: Problem, c2: float, N: Neural | Symbolic, level: float, count: int = 200_000) -> np.ndarray:
    """N'F, the worst of the corners of what is uncertain, at samples at which it must be negative."""
    system = problem.loop.system
    lo, hi = np.array([[float(end) for end in pair] for pair in system.domain]).T
    x = np.random.default_rng(3).uniform(lo, hi, (count, system.n))
    x = x[(N(x) <= level) & (problem.V(x) >= c2)]
    f, u, slope = system.uncertain_function(), problem.loop.policy(x), N.gradient(x)
    return np.max([(slope * f(x, u, list(map(float, q.values())))).sum(-1) for q in corners(system)], axis=0)


def holds(problem: Problem, found: OuterProof, c2: float = 0.25) -> None:
    """Every leaf of the evidence is proved for the level by the rules, looked at for itself; so are samples."""
    system, N, level = problem.loop.system, found.outer.function, found.outer.level
    lo, hi = leaves(found.evidence.tree, found.evidence.root)
    rule = FallBound(problem, c2, found.evidence.T, N)
    assert bool(rule(np.array(lo.T.copy()), np.array(hi.T.copy()), 0.0, level).proved.all())
    assert len(found.evidence.faces) == 2 * system.n
    for k, tree in enumerate(found.evidence.faces):
        axis, side = divmod(k, 2)
        low, high = np.array([[float(end) for end in pair] for pair in system.domain]).T
        low[axis] = high[axis] = float(system.domain[axis][side])
        middle, half = (low + high) / 2, (high - low) / 2
        corners = (np.array((middle + part).T.copy()) for part in leaves(tree, half))
        assert bool(FaceBound(system, axis, side, N)(*corners, 0.0, level).proved.all())
    assert np.max(rises(problem, c2, N, level), initial=-np.inf) < 0


# -------------------------------------------------------------------------------------------------------- enclosures


def random_boxes(n: int, batch: int, size: float, seed: int) -> tuple[np.ndarray, np.random.Generator]:
    """States `x[:, 0] + x[:, 1:] d`, (n, n + 1, B)."""
    generator = np.random.default_rng(seed)
    centre = generator.uniform(-1, 1, (n, 1, batch))
    return np.array(np.concatenate([centre, size * generator.standard_normal((n, n, batch))], 1)), generator


def random_rates(x: np.ndarray, more: int, generator: np.random.Generator) -> list[Taylor]:
    """Models of F, one for each state, in the symbols of the boxes and some others."""
    n, batch = x.shape[0], x.shape[2]
    N = n + more

    def draw(*shape: int) -> np.ndarray:
        return np.array(0.3 * generator.standard_normal((*shape, batch)))

    return [Taylor(draw(), draw(N), draw(N, N), 0.1 * np.abs(draw())) for _ in range(n)]


def at(model: Taylor, d: np.ndarray, rest: float) -> np.ndarray:
    """A value (B,) that the model allows at d (N, B), `rest` between -1 and 1."""
    quadratic = (model.Q * d[:, None] * d[None]).sum((0, 1))
    return model.c + (model.g * d).sum(0) + quadratic + rest * model.r


FUNCTIONS = {
    "affine": of_layers(([[0.5, -2.0]], [0.25])),
    "shallow": wells([[1.0, 0.5], [-0.25, 2.0]], 0.5),
    "deep": of_layers(
        (np.random.default_rng(1).standard_normal((5, 2)), np.random.default_rng(2).standard_normal(5)),
        (np.random.default_rng(3).standard_normal((4, 5)), np.random.default_rng(4).standard_normal(4)),
        (np.random.default_rng(5).standard_normal((1, 4)), [0.5]),
    ),
    "expression": Symbolic(1 - cos(X) + X * Y**2 / 3 + exp(Y / 2) / (3 + X), (X, Y)),
    "state": Symbolic(X, (X, Y)),
    "constant": Symbolic(Number(2), (X, Y)),
}


def enclosure(N: Neural | Symbolic) -> NeuralEnclosure | SymbolicEnclosure:
    return NeuralEnclosure(N) if isinstance(N, Neural) else SymbolicEnclosure(N)


@pytest.mark.parametrize("size", slow_after(2, [1e-9, 0.01, 0.1, 0.5]))
@pytest.mark.parametrize("name", FUNCTIONS)
def test_models_contain_n_and_its_derivative(name: str, size: float) -> None:
    N, batch, more = FUNCTIONS[name], 40, 2
    x, generator = random_boxes(2, batch, size, 0)
    F = random_rates(x, more, generator)
    known = enclosure(N)(x, np.zeros((2, batch)))
    index = np.arange(batch)
    along, share = known.along(F, index)
    assert share.shape == (2, batch) and bool((share >= 0).all())
    (least, _), (most, _) = (upper_bound(Taylor(s * v.c, s * v.g, s * v.Q, v.r)) for s, v in ((-1, along), (1, along)))
    for k in range(200):
        d = generator.uniform(-1, 1, (2 + more, batch)) if k % 2 else generator.choice([-1.0, 1.0], (2 + more, batch))
        point = (x[:, 0] + (x[:, 1:] * d[:2]).sum(1)).T
        rate = np.stack([at(f, d, generator.choice([-1.0, 1.0])) for f in F], 1)
        value, slope = N(point), (N.gradient(point) * rate).sum(1)
        inside = at(known.value, d[:2], 0.0)
        tight = known.value.r + 1e-13
        assert np.all(np.abs(value - inside) <= tight)
        assert np.all(slope <= most + 1e-13) and np.all(slope >= -least - 1e-13)


def test_some_boxes_of_a_batch_have_the_models_that_they_have_alone() -> None:
    x, generator = random_boxes(2, 30, 0.1, 7)
    F, error = random_rates(x, 1, generator), np.zeros((2, 30))
    index = np.array([3, 17, 29])
    for N in (FUNCTIONS["deep"], FUNCTIONS["expression"]):
        some, _ = enclosure(N)(x, error).along([f.at(index) for f in F], index)
        alone, _ = enclosure(N)(x.take(index, -1), error.take(index, -1)).along([f.at(index) for f in F], np.arange(3))
        for one, other in zip((some.c, some.g, some.Q, some.r), (alone.c, alone.g, alone.Q, alone.r), strict=True):
            assert np.allclose(one, other, rtol=1e-12, atol=1e-14)


def test_the_models_are_of_second_order() -> None:
    """Halving a box takes the remainders of N and of N'F down eightfold, and more where what bounds the third
    derivative falls with the box."""
    N, rest = FUNCTIONS["deep"], []
    for size in (0.02, 0.01):
        x, _ = random_boxes(2, 50, size, 1)
        zeros = np.zeros((2, 2, 50))
        F = [Taylor(c[0], np.zeros_like(zeros[0]), zeros, zeros[0, 0]) for c in np.ones((2, 1, 50))]
        known = enclosure(N)(x, zeros[0])
        rest.append((np.median(known.value.r), np.median(known.along(F, np.arange(50))[0].r)))
    for coarse, fine in zip(*rest, strict=True):
        assert 6 < float(coarse / fine) < 17


@pytest.mark.parametrize("size", [0.01, 0.3, 5.0, 100.0])
def test_the_lines_bound_a_network_from_below_on_boxes_of_any_size(size: float) -> None:
    N, batch = FUNCTIONS["deep"], 60
    x, generator = random_boxes(2, batch, size, 3)
    least = enclosure(N).least(x, np.zeros((2, batch)), -math.inf)
    assert np.all(least >= N(np.zeros(2)) - 2 * np.abs(N.weights[-1]).sum() - 1)  # tanh knows an end
    for _ in range(200):
        d = np.array(generator.uniform(-1, 1, (2, batch)))
        assert np.all(N((x[:, 0] + (x[:, 1:] * d).sum(1)).T) >= least)


# ---------------------------------------------------------------------------------------------------------- the rules


def test_a_box_with_a_violation_is_never_proved() -> None:
    """x' = x/2 - tanh(x), N = x^2: every box that holds a point beyond the limit, N at most the level."""
    problem, N = scalar(), Symbolic(X**2, (X,))
    rule = FallBound(problem, 0.25, np.eye(1), N)
    generator = np.random.default_rng(0)
    middle = generator.uniform(LIMIT, 3, (1, 500))
    half = 10.0 ** generator.uniform(-6, 0.3, (1, 500))
    lo, hi = (np.array(middle + half * (side - generator.random((1, 500)))) for side in (0.0, 1.0))
    lo, hi = np.minimum(lo, hi), np.maximum(lo, hi)
    holds_one = (lo[0] <= 2.9) & (hi[0] >= LIMIT + 1e-9)
    assert not bool((rule(lo, hi, 0.0, 8.5).proved & holds_one).any())
    for low, high, level, proved in (
        (1.5, 1.51, 8.5, True),  # N falls
        (2.5, 2.51, 8.5, False),
        (2.5, 2.51, 6.0, True),  # N > n2
        (3.001, 4.0, 99.0, True),  # outside
        (2.999, 4.0, 99.0, False),
        (-0.4, 0.4, 99.0, True),  # V < c2
        (-0.4, 2.5, 99.0, False),
    ):
        assert is_proved(rule, [low], [high], level) is proved


def is_proved(rule: FallBound, lo: list[float], hi: list[float], level: float) -> bool:
    corners = (np.array(corner)[:, None] for corner in (lo, hi))
    return bool(rule(*corners, 0.0, level).proved[0])


def test_what_divides_by_a_range_that_holds_zero_is_not_proved() -> None:
    problem = planar(plane(dynamics=(-X, U + Y**3 / (X - 1) * Fraction(1, 10**9))))
    rule = FallBound(problem, 0.25, np.eye(2), Symbolic(X**2 + Y**2, (X, Y)))
    assert is_proved(rule, [0.7, 0.6], [0.8, 0.7], 99.0)
    assert not is_proved(rule, [0.95, 0.6], [1.05, 0.7], 99.0)


def test_an_expression_that_has_no_model_is_not_above_a_level() -> None:
    problem, N = scalar(), Symbolic(1 / (X - 1) ** 2 + X**2, (X,))
    rule = FallBound(problem, 0.25, np.eye(1), N)
    found = rule(*(np.array([[end]]) for end in (0.9, 1.1)), 0.0, -5.0)
    assert not bool(found.proved[0]) and float(found.lowest[0]) == -math.inf


def test_inputs_out_of_bounds_are_not_proved() -> None:
    system = dataclasses.replace(plane(), input_bounds=box(1))
    rule = FallBound(planar(system), 0.25, np.eye(2), Symbolic(X**2 + Y**2, (X, Y)))
    assert is_proved(rule, [0.1, 0.8], [0.2, 0.9], 99.0)
    assert not is_proved(rule, [0.1, 0.95], [0.2, 1.05], 99.0)
    found = rule(*(np.array([[0.1], [end]]) for end in (1.1, 1.2)), 0.0, 99.0)
    assert not bool(found.proved[0]) and float(found.violated[0]) < 99


# ---------------------------------------------------------------------------------------------------------- the level


@pytest.mark.parametrize("falsified", [True, False])
def test_a_known_limit_is_reached_and_never_passed(falsified: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the falsifier and without: then the pass itself meets the violation."""
    problem, N = scalar(), Symbolic(X**2, (X,))
    if not falsified:
        monkeypatch.setattr(Falsifier, "search", lambda self, cap: None)
    found = prove(problem, N)
    assert found is not None and found.stop is Stop.WITNESS and found.witness is not None
    assert 0.99 * LIMIT**2 < found.outer.level < LIMIT**2 <= found.witness.level < 1.001 * LIMIT**2
    assert found.witness.describe(problem.loop.system).startswith("N does not fall at x = ")
    holds(problem, found)


def test_a_blind_pass_still_stops_below_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither samples nor descents: what cannot be proved lowers the level by itself."""
    monkeypatch.setattr(Falsifier, "search", lambda self, cap: None)
    monkeypatch.setattr(Falsifier, "lowest", lambda self, x: None)
    problem = scalar()
    found = prove(problem, Symbolic(X**2, (X,)))
    assert found is not None and 0.95 * LIMIT**2 < found.outer.level < LIMIT**2
    holds(problem, found)


@pytest.mark.parametrize(("domain", "least"), [(box("3/2"), 2.25), (((Fraction(-1), Fraction(5, 2)),), 1.0)])
def test_the_domain_ends_the_level(domain: Any, least: float) -> None:
    problem = scalar(domain=domain)
    found = prove(problem, Symbolic(X**2, (X,)))
    assert found is not None and found.stop is Stop.DOMAIN
    assert 0.999 * least < found.outer.level < least
    holds(problem, found)


def test_a_level_that_is_asked_for_is_that_level() -> None:
    problem, N = scalar(), Symbolic(X**2, (X,))
    found = prove(problem, N, 2.0)
    assert found is not None and (found.outer.level, found.stop) == (2.0, Stop.REQUESTED)
    too_high = prove(problem, N, 5.0)
    assert too_high is not None and too_high.stop is Stop.WITNESS and too_high.outer.level < LIMIT**2


def test_a_quantity_is_taken_at_its_worst() -> None:
    """x' = a x - tanh(x): the limit is that of the largest a, tanh(x) = 3/5 x."""
    limit = 1.2
    for _ in range(200):
        limit = math.tanh(limit) / 0.6
    problem = scalar(W * X + U, parameters={"w": Fraction(1, 2)}, ranges={"w": (Fraction(1, 4), Fraction(3, 5))})
    found = prove(problem, Symbolic(X**2, (X,)))
    assert found is not None and found.witness is not None and found.witness.values == {"w": Fraction(3, 5)}
    assert 0.98 * limit**2 < found.outer.level < limit**2
    holds(problem, found)


@pytest.mark.parametrize("T", [np.eye(2), np.array([[0.8, -0.5], [0.7, 1.1]])])
def test_a_network_on_a_domain_that_is_not_symmetric(T: np.ndarray) -> None:
    domain = tuple((Fraction(lo), Fraction(hi)) for lo, hi in (("-2", "5/2"), ("-9/4", "7/3")))
    problem, N = planar(plane(domain)), wells([[1.0, 0.0], [-0.5, 0.875], [-0.5, -0.875]], 0.75)
    found = prove(problem, N, T=T)
    assert found is not None and found.stop in (Stop.DOMAIN, Stop.WITNESS)
    face = min(N(edge).min() for edge in edges(domain))
    assert N(np.zeros(2)) < found.outer.level < face
    assert found.leaves == sum(tree.count(255) for tree in (found.evidence.tree, *found.evidence.faces))
    holds(problem, found)


def edges(domain: Any) -> list[np.ndarray]:
    """Points of a rectangle's sides."""
    (a, b), (c, d) = [[float(end) for end in pair] for pair in domain]
    t = np.linspace(0, 1, 2001)
    return [
        np.stack([x, y], 1)
        for x, y in (
            (a + 0 * t, c + (d - c) * t),
            (b + 0 * t, c + (d - c) * t),
            (a + (b - a) * t, c + 0 * t),
            (a + (b - a) * t, d + 0 * t),
        )
    ]


def test_a_planted_rise_is_not_proved(monkeypatch: pytest.MonkeyPatch) -> None:
    """A whirl in a small disc, which no sample of a few hits: V and N fall everywhere else."""
    monkeypatch.setattr(Falsifier, "search", lambda self, cap: None)
    bump = exp(-400 * ((X - 1) ** 2 + (Y - Fraction(1, 2)) ** 2))
    problem = planar(plane(dynamics=(-X + 2 * bump, U)))
    N = Symbolic(X**2 + Y**2, (X, Y))
    found = prove(problem, N)
    x = np.array([1.0, 0.5])
    assert float((N.gradient(x) * problem.loop.system.function()(x, problem.loop.policy(x))).sum()) > 0
    assert found is not None and 0.25 < found.outer.level < 1.25 and found.stop is Stop.WITNESS
    holds(problem, found)


@pytest.mark.parametrize("boxes", slow_after(3, [1, 40, 80, 150, 300, 600]))
def test_an_end_of_the_budget_leaves_a_lower_level(boxes: int) -> None:
    problem, N = planar(), wells([[1.0, 0.0], [-0.5, 0.875], [-0.5, -0.875]], 0.75)
    whole = prove(problem, N)
    found = prove(problem, N, boxes=boxes, batch=16)
    assert whole is not None
    if found is not None:
        assert found.outer.level <= whole.outer.level + 1e-3
        holds(problem, found)
    else:
        assert boxes < 600


def test_boxes_too_small_to_halve_are_no_limit_on_boxes() -> None:
    found = prove(planar(), wells([[1.0, 0.0], [-0.5, 0.875], [-0.5, -0.875]], 0.75), least_width=0.1)
    assert found is not None and found.stop is Stop.SMALL


def test_no_time_proves_nothing() -> None:
    assert prove(planar(), wells([[1.0, 0.0], [0.0, 1.0]], 0.75), effort=Effort(1.0)) is None


@pytest.mark.parametrize(
    ("N", "more", "why"),
    [
        (Symbolic(X**2 + Y**2, (X, Y)), {"c2": 99.0}, "every sampled state of the domain lies in the ellipsoid"),
        (Symbolic(X**2 + Y**2, (X, Y)), {"level": 0.1}, "the level that was asked for, 0.1, is not above the least"),
        (Symbolic(-(X**2) - Y**2, (X, Y)), {}, "N somewhere on the faces, .*, is not above the least"),
        (wells([[1.0, 0.0], [0.0, 1.0]], 0.75), {"effort": Effort(1.0)}, "where x = -2; the effort for that ended"),
        (Symbolic(X**2 + Y**2 - 3 * X * Y, (X, Y)), {"c2": 0.01}, "not above|smaller level"),
    ],
)
def test_why_nothing_is_proved_is_said(N: Neural | Symbolic, more: dict[str, Any], why: str) -> None:
    found = attempt(planar(), N, **more)
    assert isinstance(found, Nothing) and re.search(why, found.why), found


def test_progress_is_told() -> None:
    told: list[Progress] = []
    N = wells([[1.0, 0.0], [0.0, 1.0]], 0.75)
    found = prove_outer(planar(), 0.25, np.eye(2), N, None, Budget(batch=16), RUNNER, told.append)
    assert isinstance(found, OuterProof) and told[-1].open == 0 and told[-1].proved == pytest.approx(1.0)
    for numbers in ([p.proved for p in told], [p.level for p in told]):
        assert numbers == sorted(numbers)
    assert all(p.level <= p.target for p in told)


def test_the_answer_is_the_same_each_time_and_on_any_number_of_threads() -> None:
    problem, N = planar(), wells([[1.0, 0.0], [0.0, 1.0]], 0.75)
    found = [prove(problem, N, runner=ThreadRunner(threads)) for threads in (1, 1, 2, 3)]
    answers = [None if one is None else (one.outer.level, one.evidence.tree) for one in found]
    assert answers[0] is not None and answers == [answers[0]] * 4


@pytest.mark.parametrize(
    ("N", "c2"),
    [(Symbolic(-(X**2) - Y**2, (X, Y)), 0.25), (Symbolic(X**2 + Y**2, (X, Y)), 9.0), (Symbolic(X - X, (X, Y)), 0.25)],
)
def test_nothing_is_proved_of_what_rises_or_lies_inside(N: Symbolic, c2: float) -> None:
    assert prove(planar(), N, c2=c2) is None


def test_an_expression_without_a_value_somewhere_in_the_domain() -> None:
    """sqrt(2 + x) has none for x < -2, and N is not known to be above any level there."""
    assert prove(scalar(), Symbolic(X**2 + sqrt(2 + X), (X,))) is None
    found = prove(scalar(domain=box("3/2")), Symbolic(X**2 + sqrt(2 + X) / 8, (X,)))
    assert found is not None and found.stop is Stop.DOMAIN
    holds(scalar(domain=box("3/2")), found)


def test_other_plants_and_functions_are_refused() -> None:
    N = Symbolic(X**2 + Y**2, (X, Y))
    for system in (plane(time="discrete"), plane(sample=(Fraction(0), Fraction(1, 10)))):
        with pytest.raises(InputError, match="continuous time"):
            prove(planar(system), N)
    with pytest.raises(InputError, match=r"the rate 0\.5"):
        prove(dataclasses.replace(planar(), rate=0.5), N)
    with pytest.raises(InputError, match="2 states"):
        prove(planar(), of_layers(([[1.0]], [0.0])))
    with pytest.raises(InputError, match=r"in this order"):
        prove(planar(), Symbolic(X**2, (Y, X)))


# ---------------------------------------------------------------------------------------------------------- certificate


@pytest.mark.parametrize("name", ["expression", "network"])
def test_the_checker_accepts_what_is_proved_and_no_higher_level(name: str, tmp_path: Path) -> None:
    domain = tuple((Fraction(lo), Fraction(hi)) for lo, hi in (("-2", "5/2"), ("-9/4", "7/3")))
    problem, T = planar(plane(domain)), np.array([[0.8, -0.5], [0.5, 0.8]])
    N = {
        "expression": Symbolic(X**2 + Fraction(5, 4) * Y**2, (X, Y)),
        "network": wells([[1.0, 0.0], [-0.5, 0.875], [-0.5, -0.875]], 0.75),
    }[name]
    inner = BoundsEngine(T, RUNNER).prove(Task(problem, "asymptotic", 0.25), Budget())
    assert isinstance(inner.claim, Asymptotic) and isinstance(inner.evidence, PartitionTree)
    found = prove(problem, N, T=T, c2=inner.claim.roa)
    assert found is not None

    def answer(level: float, evidence: OuterTree) -> Any:
        claim = dataclasses.replace(inner.claim, outer=dataclasses.replace(found.outer, level=level))
        whole = dataclasses.replace(inner.evidence, outer=evidence)
        path = tmp_path / "certificate.json"
        path.write_bytes(
            Certificate(problem.loop.system, problem.loop.network, problem.V, claim, whole).to_json().encode()
        )
        return run_checker(path)

    assert answer(found.outer.level, found.evidence)["result"] == "ACCEPTED"
    assert answer(found.outer.level - 0.1, found.evidence)["result"] == "ACCEPTED"
    raised = answer(found.outer.level + 0.2 * abs(found.outer.level), found.evidence)
    assert (raised["result"], raised["rule"]) == ("REJECTED", "faces")


def test_a_leaf_that_is_split_again_is_covered_and_holds() -> None:
    domain = tuple((Fraction(lo), Fraction(hi)) for lo, hi in (("-2", "5/2"), ("-9/4", "7/3")))
    problem, N = planar(plane(domain)), wells([[1.0, 0.0], [-0.5, 0.875], [-0.5, -0.875]], 0.75)
    found = prove(problem, N)
    assert found is not None
    claim = Asymptotic(0.25, 0.25, outer=found.outer)
    evidence = split_again(problem, found.evidence, claim, 5)
    evidence = split_face_again(problem, evidence, claim, 3, 2)
    assert len(evidence.tree) == len(found.evidence.tree) + 14
    assert [len(new) - len(old) for new, old in zip(evidence.faces, found.evidence.faces, strict=True)] == [0, 0, 0, 14]
    holds(problem, dataclasses.replace(found, evidence=evidence))
    lo, hi = leaves(evidence.tree, evidence.root)
    assert np.prod(hi - lo, axis=1).sum() == pytest.approx(np.prod(2 * evidence.root))
    with pytest.raises(InputError, match="found 100000"):
        split_again(problem, found.evidence, claim, 100_000)
    with pytest.raises(InputError, match="outer set"):
        split_again(problem, found.evidence, Asymptotic(0.25, 0.25), 5)
