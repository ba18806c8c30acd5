"""Steps: held inputs, discrete time, a rate. What the ring proves holds on dense integrations, and nothing else."""

from __future__ import annotations

import dataclasses
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates.claims import Problem
from certify.certificates.verdict import Stop, Verdict
from certify.effort import UNIT, Effort
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, Symbol, numerical, symbols
from certify.loop.plants import System, get_system, with_input_errors
from certify.loop.plants.equations import parse_expression
from certify.loop.policies import PolicyNetwork
from certify.loop.rigorous import eigenvalues, evaluate_increment, evaluate_vdot, instability
from certify.lyapunov import choose_candidate, diagonalising_coordinates, slowest_decay, solve_lyapunov
from certify.lyapunov.function import Quadratic
from certify.provers.base import Budget
from certify.provers.bounds import Flow, Taylor
from certify.provers.boxes.order import choose_order
from certify.provers.boxes.rule import VdotBound
from certify.provers.boxes.search import prove_inwards, prove_outwards
from certify.provers.execution import ThreadRunner
from certify.provers.falsify import falsify, refutes
from tests.provers.test_vdot import boxes, cartpole_case
from tests.support.loops import box, pendulum_network, scalar_tanh, valve
from tests.support.marks import slow_after

INNER, OUTER = 0.02, 0.5


@dataclasses.dataclass(frozen=True)
class Stepped:
    problem: Problem
    T: np.ndarray

    @property
    def loop(self) -> ClosedLoop:
        return self.problem.loop


def stepped(system: System, network: PolicyNetwork, rate: float = 0.0, P: np.ndarray | None = None) -> Stepped:
    loop = ClosedLoop(system, network)
    if P is None:
        P = solve_lyapunov(loop.mean_rate(), np.eye(system.n), loop.step)
    T = diagonalising_coordinates(P, loop.mean_rate(), loop.step)
    return Stepped(Problem(loop, Quadratic(P), rate), T)


def held(lo: str, hi: str | None = None) -> tuple[Fraction, Fraction]:
    return Fraction(lo), Fraction(hi or lo)


def uncertain_pendulum() -> System:
    system = get_system("pendulum")
    m = system.parameters["m"]
    system = system.with_ranges({"m": (m * Fraction(9, 10), m * Fraction(11, 10))})
    return with_input_errors(system, {str(system.inputs[0]): Fraction(1, 20)})


def linear(gain: float, sample: tuple[Fraction, Fraction] | None) -> tuple[System, PolicyNetwork]:
    """xdot = u, u = -gain x: held over h, x+ = (1 - gain h) x."""
    system, network = scalar_tanh()
    network = PolicyNetwork.of_layers(
        (np.array([[-gain]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )
    system = dataclasses.replace(
        system, dynamics=(system.inputs[0],), input_bounds=box(1000), domain=box(10), sample=sample
    )
    return system, network


def alone(dynamics: str, time: str = "discrete", domain: str = "3") -> tuple[System, PolicyNetwork]:
    """A plant of one state on which no input acts."""
    system, _ = scalar_tanh()
    system = dataclasses.replace(
        system,
        dynamics=(parse_expression(dynamics, {s.name: s for s in (*system.states, *system.inputs)}),),
        domain=box(domain),
        time=time,
    )
    return system, PolicyNetwork.of_layers(
        (np.zeros((1, 1)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )


CASES = {
    "scalar": lambda: stepped(scalar_tanh()[0].with_sample(held("1/5")), scalar_tanh()[1]),
    "pendulum": lambda: stepped(get_system("pendulum").with_sample(held("1/50")), pendulum_network(), 0.1),
    "jitter": lambda: stepped(get_system("pendulum").with_sample(held("1/100", "1/50")), pendulum_network()),
    "at once": lambda: stepped(get_system("pendulum").with_sample(held("0", "1/25")), pendulum_network()),
    "cartpole": lambda: stepped(cartpole_case().loop.system.with_sample(held("1/50")), cartpole_case().loop.network),
    "functions": lambda: stepped(valve()[0].with_sample(held("1/20", "1/10")), valve()[1], 0.05),
    "uncertain": lambda: stepped(uncertain_pendulum().with_sample(held("1/100", "1/50")), pendulum_network()),
    "discrete": lambda: stepped(*alone("x/2 - tanh(x) + x**3/20")),
}


def increment(case: Stepped, x: np.ndarray, generator: np.random.Generator, pieces: int = 4) -> np.ndarray:
    """D' (B,) at states (B, n): over a random period of the range, with quantities that switch a few times in it."""
    loop, system = case.loop, case.loop.system
    u, f = loop.policy(x), system.uncertain_function()
    ranges = [(float(lo), float(hi)) for _, (lo, hi) in system.uncertain]

    def drawn() -> list[float]:
        return [generator.choice([lo, hi, generator.uniform(lo, hi)]) for lo, hi in ranges]

    P, V = case.problem.V.P, case.problem.V(x)
    if system.time == "discrete":
        return np.asarray(case.problem.V(f(x, u, drawn())) - V + 2 * case.problem.rate * V)
    lo, hi = (float(h) for h in system.sample or (0, 0))
    h = generator.choice([lo, hi, generator.uniform(lo, hi)])
    if h == 0:
        return np.asarray(2 * ((x @ P) * f(x, u, drawn())).sum(-1) + 2 * case.problem.rate * V)
    cuts = np.sort(generator.random(pieces - 1))
    after = x
    for share in np.diff(np.concatenate([[0.0], cuts, [1.0]])):
        q, step = drawn(), h * share / 20
        for _ in range(20):
            k1 = f(after, u, q)
            k2 = f(after + step / 2 * k1, u, q)
            k3 = f(after + step / 2 * k2, u, q)
            k4 = f(after + step * k3, u, q)
            after = after + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.asarray((case.problem.V(after) - V) / h + 2 * case.problem.rate * V)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("order", slow_after(1, [3, 2, 1]))
def test_the_bound_holds_wherever_a_box_meets_the_ring(name: str, order: int) -> None:
    case = CASES[name]()
    n = case.loop.system.n
    generator = np.random.default_rng(1)
    met, told = 0, []
    for size in (0.2, 0.02, 1e-6):
        lo, hi = boxes(n, 150, size)
        found = VdotBound(case.problem, case.T, order=order)(lo, hi, INNER, OUTER)
        told.append(float(np.isfinite(found.bound).mean()))
        for _ in range(20):
            share = generator.random(lo.shape)
            share = np.where(generator.random(lo.shape) < 0.3, np.round(share), share)
            z = (lo + share * (hi - lo)).T
            inside = ((z**2).sum(1) >= INNER) & ((z**2).sum(1) <= OUTER)
            values = increment(case, z[inside] @ case.T.T, generator)
            assert not np.any(values > found.bound[inside] + 1e-9)  # NaN says nothing
            met += int(inside.sum())
    assert met > 1000 and told[-1] > 0.9


@pytest.mark.parametrize("name", slow_after(1, ["pendulum", "cartpole", "functions"]))
def test_a_longer_series_leaves_less_at_a_point(name: str) -> None:
    """What the last coefficient's enclosure adds falls with each order; the falsifier knows D' itself."""
    case = CASES[name]()
    generator = np.random.default_rng(0)
    z = generator.standard_normal((case.loop.system.n, 50))
    z *= 0.1 / np.linalg.norm(z, axis=0)
    truth = np.array([_highest(case, case.T @ point) for point in z.T])
    gaps = []
    for order in (1, 2, 3):
        bounds = VdotBound(case.problem, case.T, order=order).at_points(np.array(z), OUTER)
        assert np.all(bounds >= truth - 1e-12)
        gaps.append(float(np.median(bounds - truth)))
    assert gaps[1] < 0.5 * gaps[0] and gaps[2] < gaps[1]


def _highest(case: Stepped, x: np.ndarray) -> float:
    """D' in Arb, over periods of the range."""
    lo, hi = case.loop.system.sample or (Fraction(0), Fraction(0))
    every = dict.fromkeys([lo, (lo + hi) / 2, hi])
    return max(float(evaluate_increment(case.loop, case.problem.V.P, x, h, case.problem.rate)) for h in every)


def one_model(centre: float, radius: float) -> dict[Symbol, Taylor]:
    tensor = np.array([centre])
    g = np.array([[radius]])
    return {Symbol("x"): Taylor(tensor, g, np.zeros((1, 1, 1)), 0 * tensor)}


@pytest.mark.parametrize("order", [2, 3])
def test_a_state_that_turns_back_rises_no_farther_than_it_does(order: int) -> None:
    """x' = v, v' = -160 from 8/5: x is highest after 10 ms."""
    x, v = symbols("x v")
    at = {s: Taylor(np.array([c]), np.zeros((2, 1)), np.zeros((2, 2, 1)), np.zeros(1)) for s, c in ((x, 0.0), (v, 1.6))}
    mean = Flow((v, -160 + 0 * v), held("1/50"), order)(at, {}, {}, 2)
    assert 1.6**2 / 320 <= mean.up[0, 0] <= 1.6**2 / 320 * (1 + 1e-9) and mean.down[1, 0] >= 3.2
    assert mean.down[0, 0] <= 1e-12 and Flow((v, -160 + 0 * v), held("1/50"), 1)(at, {}, {}, 2).up[0, 0] >= 0.032


def test_the_flow_of_a_plant_that_escapes() -> None:
    """xdot = x^2 from 1: x/(1 - x t), which exists for t < 1 only; the mean of f over h is x^2/(1 - x h)."""
    x = Symbol("x")
    states = {x: next(iter(one_model(1.0, 1e-3).values()))}
    for h in ("1/20", "1/10"):
        mean = Flow((x**2,), held(h), 4)(states, {}, {}, 1)
        assert bool(mean.exists)
        for point in (0.999, 1.0, 1.001):
            value, model = point**2 / (1 - point * float(Fraction(h))), mean.G[0]
            centre = float((model.c + model.g[0] * (point - 1) / 1e-3)[0])
            assert abs(value - centre) <= float(model.r[0]) + float(np.abs(model.Q).sum())
            rise = value * float(Fraction(h))
            assert mean.down[0, 0] <= 0 and rise <= mean.up[0, 0] <= 1.1 * rise
    for h in ("1", "2"):
        assert not bool(Flow((x**2,), held(h), 4)(states, {}, {}, 1).exists)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_flow_of_a_plant_that_only_falls(order: int) -> None:
    """x' = -x^3 from 5/2: farther up it is steeper by so much that no box has both ends equally far."""
    x = Symbol("x")
    mean = Flow((-(x**3),), held("1/25"), order)({x: one_model(2.5, 0.0)[x]}, {}, {}, 1)
    fall, model = 2.5 - 2.5 / np.sqrt(1.5), mean.G[0]
    assert bool(mean.exists) and mean.up[0, 0] <= 1e-9 and fall <= mean.down[0, 0] <= 0.625 * (1 + 1e-9)
    assert abs(float(model.c[0]) + 25 * fall) <= float(model.r[0])


@pytest.mark.parametrize(
    "equations", [("q**2", "-y"), ("p*y", "q"), ("q**2*y", "q"), ("q*x/(2 + q) + q**2*y", "q**3 - x*q*p")]
)
@pytest.mark.parametrize("order", slow_after(2, [1, 2, 3, 4]))
def test_the_mean_over_a_period_holds_for_quantities_that_switch(equations: tuple[str, str], order: int) -> None:
    """A symbol stands for a quantity's mean: of q, -1 for one half and 1 for the other, it is 0, and of q^2 it is 1."""
    x, y, q, p = symbols("x y q p")
    f = tuple(parse_expression(text, {"x": x, "y": y, "q": q, "p": p}) for text in equations)
    rate = numerical(f, (x, y, q, p))
    centre, h = {x: 0.3, y: -0.2}, 0.25

    def model(value: float, symbol: int, radius: float) -> Taylor:
        g = np.zeros((4, 1))
        g[symbol] = radius
        c = np.array([value])
        return Taylor(c, g, np.zeros((4, 4, 1)), 0 * c)

    states = {s: model(v, i, 0.05) for i, (s, v) in enumerate(centre.items())}
    quantities = {q: model(0.0, 2, 1.0), p: model(0.5, 3, 0.5)}
    mean = Flow(f, held("1/4"), order)(states, {}, quantities, 2)
    assert bool(mean.exists)
    generator = np.random.default_rng(0)
    for _ in range(60):
        d = generator.uniform(-1, 1, 2)
        before = np.array(list(centre.values())) + 0.05 * d
        switching = generator.choice([-1.0, 1.0], 4) if generator.random() < 0.7 else generator.uniform(-1, 1, 4)
        other = generator.uniform(0, 1, 4)
        after = before.copy()
        for a, b in zip(switching, other, strict=True):
            step = h / 4 / 50
            for _ in range(50):
                k1 = np.array(rate(*after, a, b))
                k2 = np.array(rate(*(after + step / 2 * k1), a, b))
                k3 = np.array(rate(*(after - step * k1 + 2 * step * k2), a, b))
                after = after + step / 6 * (k1 + 4 * k2 + k3)
        G = (after - before) / h
        all_d = np.array([*d, switching.mean(), 2 * other.mean() - 1])
        for found, value in zip(mean.G, G, strict=True):
            told = found.c[0] + found.g[:, 0] @ all_d + all_d @ found.Q[:, :, 0] @ all_d
            assert abs(float(told) - value) <= float(found.r[0]) + 1e-9


def test_a_held_input_knows_the_exact_limit_of_its_period() -> None:
    """x+ = (1 - k h) x decreases for k h < 2 and for no other period."""
    for sample, holds in (
        (held("19/10"), True),
        (held("0", "199/100"), True),
        (held("2001/1000"), False),
        (held("19/10", "21/10"), False),
        (held("5/2"), False),
    ):
        case = stepped(*linear(1.0, sample), P=np.eye(1))
        ring = prove_outwards(case.problem, case.T, 0.01, 1.0, Budget(boxes=4000), ThreadRunner())
        assert (ring.outer == 1.0) is holds, sample
        assert holds or ring.outer == 0.01


def test_a_loop_that_sampling_makes_unstable_is_never_proved() -> None:
    """Stable in continuous time, with a spectral radius above 1 at this period: no V, no ring, and it is refuted."""
    system, network = linear(1.0, None)
    assert slowest_decay(ClosedLoop(system, network).mean_rate()) > 0
    loop = ClosedLoop(system.with_sample(held("1", "21/10")), network)
    values = eigenvalues(loop)
    assert values is not None and any(bool(instability(loop, v) > 0) for v in values)
    with pytest.raises(InputError, match="must be stable"):
        choose_candidate(loop, "lyapunov")
    problem = Problem(loop, Quadratic(np.eye(1)))
    witness = falsify(problem, np.eye(1), 1.0, samples=100)
    assert witness is not None and witness.period == Fraction(21, 10) and refutes(problem, witness, 1.0)
    pendulum, slow = get_system("pendulum"), held("1/5")
    plain = ClosedLoop(pendulum, pendulum_network())
    P = solve_lyapunov(plain.mean_rate(), np.eye(2))
    sampled = Problem(ClosedLoop(pendulum.with_sample(slow), pendulum_network()), Quadratic(P))
    T = diagonalising_coordinates(P, plain.mean_rate())
    assert np.max(np.abs(np.linalg.eigvals(np.eye(2) + 0.2 * sampled.loop.mean_rate()))) > 1
    ring = prove_outwards(sampled, T, 1e-3, 0.1, Budget(boxes=5_000), ThreadRunner())
    assert ring.outer == 1e-3


def test_a_rate_is_proved_up_to_the_truth() -> None:
    """xdot = -x: V falls at 2 V. Held over h = 1/2, at (1 - 1/4)/(1/2) V = 2 (3/4) V."""
    for sample, truth in ((None, 1.0), (held("1/2"), 0.75)):
        for share, holds in ((0.999, True), (1.001, False)):
            case = stepped(*linear(1.0, sample), rate=share * truth, P=np.eye(1))
            ring = prove_outwards(case.problem, case.T, 0.01, 1.0, Budget(boxes=4000), ThreadRunner())
            assert (ring.outer == 1.0) is holds
            witness = falsify(case.problem, case.T, 1.0, samples=100)
            assert (witness is None) is holds


def drift(sample: tuple[Fraction, Fraction], speed: int) -> Stepped:
    """x' = speed while y falls fast: on the ring V falls over a period, and x moves by speed h."""
    x, y = symbols("x y")
    system, _ = scalar_tanh()
    system = dataclasses.replace(
        system,
        states=(x, y),
        x_eq=(Number(0),) * 2,
        dynamics=(Number(speed), -5 * y),
        domain=box(1, 10),
        sample=sample,
    )
    network = PolicyNetwork.of_layers((np.zeros((1, 2)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    return Stepped(Problem(ClosedLoop(system, network), Quadratic(np.eye(2))), np.eye(2))


def test_a_solution_that_leaves_the_domain_between_samples_is_not_proved() -> None:
    """V falls on these boxes, and x reaches 0.9 + 0.1 speed at the end of the period; the domain ends at 1."""
    lo = np.array([[0.9 - 1e-6], [5.0]])
    hi = np.array([[0.9 + 1e-6], [5.0 + 1e-3]])
    for sample in (held("1/10"), held("0", "1/10"), held("1/1000", "1/10")):
        for speed, holds in ((0, True), (-5, True), (2, False), (1, False)):
            rule = VdotBound(drift(sample, speed).problem, np.eye(2), order=3)
            kept = bool(np.isfinite(rule(lo, hi, 1e-3, 90.0).bound))
            assert kept is holds, (sample, speed)
    # What lies beyond the level does not count: with c2 = 0.5 no x above 0.7072 does.
    slow = drift(held("1/10"), 2)
    assert bool(np.isfinite(VdotBound(slow.problem, np.eye(2), order=3)(lo, hi, 1e-3, 0.5).bound))


def test_nothing_is_proved_where_an_equation_has_no_value() -> None:
    for equation in ("x/2 + x**2/(x - 1)", "sqrt(x) - x"):
        for time in ("continuous", "discrete"):
            system, network = alone(equation, time)
            if time == "continuous":
                system = system.with_sample(held("1/100"))
            problem = Problem(ClosedLoop(system, network), Quadratic(np.eye(1)))
            rule = VdotBound(problem, np.eye(1))
            lo, hi = (np.array([[v]]) for v in (-1.5, 1.5))
            found = rule(lo, hi, 1e-9, 1.0)
            assert not bool(found.proved) and not bool(found.smooth)
            least = np.array([[-1.0 if "sqrt" in equation else 1.0]])
            assert bool(np.isinf(rule.at_points(least, 1.0)))
            assert bool(np.isfinite(rule.at_points(0.0 * least + 0.5, 1.0)))


def test_a_step_may_not_lead_out_of_the_inner_level() -> None:
    """x+ = 3 x/(1 + 25 x^4) falls in magnitude beyond (2/25)^(1/4) = 0.532, but leads from 0.340 to 0.765."""
    case = stepped(*alone("3*x/(1 + 25*x**4)"), P=np.eye(1))
    ring = prove_inwards(case.problem, case.T, 1e-3, 2.0, Budget(boxes=100_000), ThreadRunner())
    truth = (3 * (1 / 75) ** 0.25 / (1 + 1 / 3)) ** 2
    assert ring.covered and ring.outer == 2.0
    assert truth < ring.inner < 1.05 * truth


def test_the_floor_of_a_disturbed_map() -> None:
    """x+ = x/2 + q, |q| <= 1/10: {|x| <= r} is entered and kept for r > 1/5."""
    system, network = alone("x/2")
    q = Symbol("q")
    system = dataclasses.replace(
        system,
        dynamics=(system.dynamics[0] + q,),
        disturbances=(q,),
        ranges={"q": (Fraction(-1, 10), Fraction(1, 10))},
    )
    problem = Problem(ClosedLoop(system, network), Quadratic(np.eye(1)))
    ring = prove_inwards(problem, np.eye(1), 1e-4, 1.0, Budget(boxes=100_000), ThreadRunner())
    assert ring.covered and 0.04 < ring.inner < 0.0405


def test_increments_in_arb_are_those_of_the_exact_map() -> None:
    x = np.array([0.75])
    for h in (Fraction(1, 2), Fraction(21, 10), Fraction(1, 1000)):
        loop = ClosedLoop(*linear(1.0, (h, h)))
        exact = ((1 - h) ** 2 - 1) / h * Fraction(9, 16)
        assert evaluate_increment(loop, np.eye(1), x, h).overlaps(_arb(exact))
    loop = ClosedLoop(*linear(1.0, None))
    assert evaluate_increment(loop, np.eye(1), x, None, 0.5).overlaps(evaluate_vdot(loop, np.eye(1), x) + _arb("9/16"))
    escaping = ClosedLoop(*alone("x**2", "continuous"))
    assert not evaluate_increment(escaping, np.eye(1), np.array([1.0]), Fraction(2)).is_finite()
    system, network = alone("x/2")
    assert evaluate_increment(ClosedLoop(system, network), np.eye(1), x).overlaps(_arb("-27/64"))


def _arb(value: Fraction | str) -> object:
    import flint

    q = Fraction(value)
    return flint.arb(flint.fmpq(q.numerator, q.denominator))


def test_the_sampled_map_of_the_linearisation() -> None:
    """exp of the matrix with the input held, against a dense integration of the linear plant, to first order."""
    loop = ClosedLoop(get_system("pendulum").with_sample(held("1/50")), pendulum_network())
    A, B, K = loop.linearise()
    M = np.eye(2)
    U = -K
    for _ in range(2000):
        k1 = (A + B @ K) @ M + B @ U
        k2 = (A + B @ K) @ (M + 0.5e-5 * k1) + B @ U
        M = M + 1e-5 * k2
    np.testing.assert_allclose(np.eye(2) + loop.step * loop.mean_rate(), M, rtol=1e-8)
    values = eigenvalues(loop)
    assert values is not None and all(bool(instability(loop, v) < 0) for v in values)
    expected = np.sort(np.abs(np.linalg.eigvals(M)))
    np.testing.assert_allclose(sorted(abs(complex(v.mid())) for v in values), expected, rtol=1e-7)


def test_candidates_decrease_over_a_step() -> None:
    loop = ClosedLoop(get_system("pendulum").with_sample(held("1/20")), pendulum_network())
    L, h = loop.mean_rate(), loop.step
    for name in ("lyapunov", "scaled", "lqr", "optimised"):
        P = choose_candidate(loop, name, effort=Effort(5 * UNIT)).P  # type: ignore[arg-type]
        assert np.max(np.linalg.eigvalsh(L.T @ P + P @ L + h * L.T @ P @ L)) < 0
    P = solve_lyapunov(L, np.eye(2), h, 0.9 * slowest_decay(L, h))
    residual = L.T @ P + P @ L + h * L.T @ P @ L + 1.8 * slowest_decay(L, h) * P + np.eye(2)
    assert np.abs(residual).max() < 1e-9 * np.abs(P).max()
    with pytest.raises(InputError):
        solve_lyapunov(L, np.eye(2), h, 1.1 * slowest_decay(L, h))


def test_the_order_is_chosen_once_and_the_same_each_time() -> None:
    plain = stepped(get_system("pendulum"), pendulum_network())
    assert choose_order(plain.problem, plain.T, 1e-3, 1.0) == 1
    case = CASES["jitter"]()
    assert choose_order(case.problem, case.T, 1e-3, 1.0) == choose_order(case.problem, case.T, 1e-3, 1.0) >= 2
    ring = prove_outwards(case.problem, case.T, 1e-3, 0.1, Budget(boxes=20_000), ThreadRunner())
    assert ring.stop is Stop.REQUESTED and ring.order >= 2 and math.isclose(ring.outer, 0.1)


@pytest.mark.parametrize(
    ("dynamics", "time", "rate", "words"),
    [
        ("-x", "continuous", 1.0, "V does not fall faster than at the rate 1 at x"),
        ("x/2", "discrete", 0.375, "V does not fall faster than at the rate 0.375 over a step at x"),
        ("3*x/2", "discrete", 0.0, "V does not fall over a step at x"),
        ("x", "continuous", 0.0, "Vdot >= 0 at x"),
    ],
)
def test_a_violation_of_a_rate_is_not_said_to_be_more(dynamics: str, time: str, rate: float, words: str) -> None:
    """At the fastest rate there is V falls, exactly at it: a condition of the claim fails, and Vdot < 0."""
    loop = ClosedLoop(*alone(dynamics, time))
    problem = Problem(loop, Quadratic(np.eye(1)), rate)
    found = falsify(problem, np.eye(1), 1.0)
    assert found is not None and refutes(problem, found, 1.0)
    assert found.describe(loop.system, problem.rate).startswith(words)


def test_a_refuted_rate_is_told_as_such(tmp_path: Path) -> None:
    options = RoaOptions(P=np.eye(1), level=1.0, rate=1.0, claim="asymptotic")
    system, network = alone("-x + u", "continuous")
    result = certify_roa(system, dataclasses.replace(network, centre="output"), tmp_path, options)
    assert result.verdict is Verdict.REFUTED
    assert "V does not fall faster than at the rate 1 at x" in result.reason and "Vdot" not in result.reason


@pytest.mark.parametrize(("dynamics", "time", "falls"), [("-x + u", "continuous", 1.0), ("x/2 + u", "discrete", 0.375)])
@pytest.mark.parametrize("level", [0.25, None])
@pytest.mark.parametrize("factor", slow_after(1, [1.0, 1.2]))
def test_of_a_rate_that_is_met_exactly_a_smaller_one_is_suggested(
    dynamics: str, time: str, falls: float, level: float | None, factor: float, tmp_path: Path
) -> None:
    system, network = alone(dynamics, time)
    network = dataclasses.replace(network, centre="output")
    options = RoaOptions(P=np.eye(1), level=level, rate=factor * falls, claim="asymptotic", effort=0.1)
    result = certify_roa(system, network, tmp_path, options)
    assert result.verdict is (Verdict.UNKNOWN if level is None else Verdict.REFUTED)
    assert result.diagnosis is not None and "equality is not enough" in result.diagnosis.next.why
    assert f"falls at the rate {falls:g} per " in result.diagnosis.next.why
    lower = float(dict(result.diagnosis.next.options)["--rate"])
    assert 0.98 * falls < lower < falls
    again = certify_roa(system, network, tmp_path, dataclasses.replace(options, rate=lower))
    assert again.verdict is Verdict.PROVED
