"""The rounding campaign: every enclosure against Arb at 200 bits, at length and without any tolerance.

An argument is an argument of the *claim*: the numbers that an enclosure was given and a point of the box that they
name, which is exact (it is formed in Arb, never in binary64). A violation is an argument for which
`|true - value| <= error` is not certain, so that NaN, a ball that straddles the bound and a negative error all count
against the enclosure; what is not certain at 200 bits is asked again at 4,000 before it counts. An infinite or NaN
error claims nothing, and each test says how many arguments may end so.

Each test has a sample that always runs and the full size, `pytest -m slow tests/checker/test_rounding.py`, which also
writes the largest |true - value| / error to standard output and to the report.
"""

from __future__ import annotations

import itertools
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cache
from typing import Any, get_args

import numpy as np
import pytest
from flint import arb, ctx
from numpy.typing import NDArray

from certify.checker import elementary, near
from certify.checker import network as checker
from certify.checker.boxes import middle
from certify.checker.case import Case
from certify.checker.document import Certificate, Policy
from certify.checker.ring import Ring
from certify.checker.taylor import upper_bound
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, cos, sin, symbols, tan, to_tree
from certify.loop.plants import System, get_system
from certify.loop.policies import PolicyNetwork
from certify.loop.policies.network import Centre, Squash
from certify.loop.rigorous import evaluate_policy
from certify.provers.bounds import policy_enclosure
from certify.provers.bounds import taylor as producer_taylor
from tests.support import plain
from tests.support.certificates import make, parse
from tests.support.leaves import on_boxes
from tests.support.loops import box
from tests.support.marks import slow_after
from tests.support.oracle import Array, awkward, policies_in_arb, policy_in_arb, value_of
from tests.support.ways import Way, bounded, relax_tanh

BITS, MANY_BITS = 200, 4000
CHUNK = 2**15
Flags = NDArray[np.bool_]
Generator = np.random.Generator


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    """As in `rules.check`: overflow becomes infinity or NaN."""
    with np.errstate(all="ignore"), ctx.workprec(BITS):
        yield


# ------------------------------------------------------------------------------------------------------------ decisions


@dataclass
class Tally:
    """What a campaign has seen; the ratios |true - value| / error are floats for people.

    A wide box is enclosed as tightly as its form allows, so that the ratio comes near 1 by design; `rounding` is the
    worst where the box is one point, which leaves nothing but rounding to be bounded.
    """

    tried: int = 0
    unclaimed: int = 0
    violations: int = 0
    worst: float = 0.0
    rounding: float = 0.0
    examples: list[str] = field(default_factory=list)

    def judge(self, residual: Callable[..., arb], errors: Array, alone: Flags, *columns: list[Any]) -> None:
        """Count row by row whether `|residual(row)| <= error` is certain; `alone`: the box is one point."""
        for error, is_point, *row in zip(errors.tolist(), alone.tolist(), *columns, strict=True):
            self.tried += 1
            if not abs(error) < math.inf:
                self.unclaimed += 1
                continue
            distance, bound = abs(residual(*row)), arb(error)
            if not distance <= bound:
                with ctx.workprec(MANY_BITS):
                    distance = abs(residual(*row))
                    if not distance <= bound:
                        self.violations += 1
                        if len(self.examples) < 5:
                            self.examples.append(f"{distance.str(5)} > {error:.5g} at {_words(row)}")
            if error > 0:
                ratio = float(distance) / error
                self.worst = max(self.worst, ratio)
                if is_point:
                    self.rounding = max(self.rounding, ratio)


def _words(row: list[Any]) -> str:
    return ", ".join(v.hex() if isinstance(v, float) else str(v) for v in row)


Report = Callable[[str, Tally, float], None]


@pytest.fixture
def report(request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]) -> Report:
    """Records a tally, then asks that nothing was violated and that enough was claimed."""
    start = time.monotonic()

    def conclude(name: str, tally: Tally, least_claimed: float) -> None:
        seconds = time.monotonic() - start
        for what in ("tried", "unclaimed", "violations", "worst", "rounding"):
            request.node.user_properties.append((f"{name}: {what}", getattr(tally, what)))
        if request.node.get_closest_marker("slow"):
            with capsys.disabled():
                sys.stdout.write(
                    f"\n{name}, {request.node.originalname}: {tally.tried:,} arguments, {tally.unclaimed:,} without a "
                    f"claim, {tally.violations} violations, worst |true - value| / error {tally.worst:.6f} "
                    f"({tally.rounding:.6f} from rounding alone), {seconds:.0f} s\n"
                )
        assert tally.violations == 0, "\n".join([f"{name}: {tally.violations} violations", *tally.examples])
        assert tally.tried - tally.unclaimed >= least_claimed * tally.tried > 0

    return conclude


def sizes(sample: tuple[int, int], full: tuple[int, int]) -> pytest.MarkDecorator:
    """The two sizes of a campaign, as (first, second) of what it counts."""
    return pytest.mark.parametrize(("first", "second"), slow_after(1, [sample, full]), ids=["sample", "full"])


@pytest.mark.parametrize(
    ("residual", "error", "violated"),
    [
        (arb(1), 1.0, False),
        (-arb(1), 1.0, False),
        (arb(1), math.nextafter(1.0, 0.0), True),
        (arb(1, 1e-30), 1.0, True),  # may or may not hold
        (arb("nan"), 1.0, True),
        (arb("inf"), 1e308, True),
        (arb(0), 0.0, False),
        (arb(0), -1.0, True),
        (arb(2.0**-1074), 0.0, True),
        (arb("1e-500"), 0.0, True),
    ],
)
def test_only_certain_containment_counts(residual: arb, error: float, violated: bool) -> None:
    tally = Tally()
    tally.judge(lambda: residual, np.array([error]), np.array([True]))
    assert (tally.violations, tally.unclaimed) == (int(violated), 0)


def test_what_is_undecided_at_200_bits_is_asked_again() -> None:
    tally = Tally()
    tally.judge(lambda: (arb(1) / 3) * 3 - arb("1e-300"), np.array([1.0]), np.array([True]))
    assert tally.violations == 0
    for error in (math.inf, -math.inf, math.nan):
        tally.judge(lambda: arb(0), np.array([error]), np.array([True]))
    assert (tally.tried, tally.unclaimed, tally.violations) == (4, 3, 0)


# ------------------------------------------------------------------------------------------- arguments of one variable


def signs(generator: Generator, count: int) -> Array:
    return generator.choice([-1.0, 1.0], count)


def powers(generator: Generator, count: int, low: float, high: float) -> Array:
    """Log-uniform between 2^low and 2^high."""
    return np.exp2(generator.uniform(low, high, count))


def mixture(generator: Generator, *kinds: Array) -> Array:
    """Element by element one of the arrays."""
    stacked = np.stack(kinds)
    return np.asarray(stacked[generator.integers(len(kinds), size=stacked.shape[1]), np.arange(stacked.shape[1])])


def drawn(generator: Generator, count: int, end: float) -> Array:
    """Every magnitude of binary64; the interesting range; the grid and its midpoints within 8 ulp; the table's end."""
    grid = generator.integers(0, int(64 * end) + 64, count) / 64
    return signs(generator, count) * mixture(
        generator,
        powers(generator, count, -1074, 1023.99),
        powers(generator, count, -60, 8),
        generator.uniform(0, 1.1 * end, count),
        generator.uniform(0, 4, count),
        np.abs(grid + generator.integers(-8, 9, count) * np.spacing(grid)),
        generator.uniform(0.95 * end, 1.05 * end, count),
    )


def awkward_numbers(generator: Generator, count: int, end: float) -> Array:
    """Awkward numbers in random order, again from the start when all have been used."""
    near_turns = np.arange(1, int(end)) * (np.pi / 2)
    turns = [near_turns, np.nextafter(near_turns, 0.0), np.nextafter(near_turns, 100.0)]
    points = np.concatenate([awkward(end, 8), *turns, *(-t for t in turns)])
    return np.asarray(np.resize(generator.permutation(points), count))


def shares(generator: Generator, count: int) -> Array:
    """Positions in [-1, 1]: ends, centre and their neighbours, anything between."""
    special = [0.0, 5e-324, 0.5, np.nextafter(1.0, 0.0), 1.0, 1.0, 1.0, 1.0]
    return signs(generator, count) * mixture(
        generator, generator.uniform(0, 1, count), generator.choice(special, count)
    )


def boxes(generator: Generator, count: int, end: float, hard: bool) -> tuple[Array, Array]:
    """Centres and radii >= 0."""
    if hard:
        c, other = (awkward_numbers(generator, count, end) for _ in range(2))
        return c, mixture(generator, np.abs(other), np.abs(other - c), np.zeros(count))  # or: an end is awkward
    c = drawn(generator, count, end)
    return c, mixture(
        generator,
        powers(generator, count, -1074, 1023.99),
        powers(generator, count, -60, 8),
        np.abs(c) * powers(generator, count, -55, 2),
        powers(generator, count, -20, 0),
        generator.uniform(0, 2, count),
        np.where(generator.random(count) < 0.1, 0.0, generator.uniform(0, end, count)),
    )


Columns = tuple[Array, ...]
Judged = tuple[Array, Flags, Columns]  # errors, where the box is one point, columns of the residual


@dataclass(frozen=True)
class Elementary:
    """An enclosure of one variable: what it is given, what it claims, and the truth less the claim."""

    end: float
    claim: Callable[[Generator, int, float, bool], Judged]
    residual: Callable[..., arb]
    least_claimed: float


def value_claim(
    function: Callable[[Array], Columns], value: int, error: int
) -> Callable[[Generator, int, float, bool], Judged]:
    def claim(generator: Generator, count: int, end: float, hard: bool) -> Judged:
        y = awkward_numbers(generator, count, end) if hard else drawn(generator, count, end)
        columns = function(y)
        return columns[error], columns[error] < 1, (y, columns[value])  # 1: out of the table, nothing was computed

    return claim


def line_claim(relax: Callable[[Array, Array], Columns]) -> Callable[[Generator, int, float, bool], Judged]:
    def claim(generator: Generator, count: int, end: float, hard: bool) -> Judged:
        c, r = boxes(generator, count, end, hard)
        slope, shift, gap = relax(c, r)
        critical = signs(generator, count) * np.arctanh(np.sqrt(np.clip(1 - slope, 0.0, 1 - 2.0**-53)))
        tangent = np.clip(np.nan_to_num((critical - c) / r), -1, 1)  # where the lines are met, if the box reaches there
        point = mixture(generator, shares(generator, count), tangent)
        return gap, (r == 0) & (np.abs(c) < end), (c, r, point, slope, shift)

    return claim


def line_residual(c: float, r: float, t: float, slope: float, shift: float) -> arb:
    y = arb(c) + arb(r) * arb(t)
    return y.tanh() - arb(slope) * y - arb(shift)


def producer_relax(c: Array, r: Array) -> Columns:
    return relax_tanh(np.asarray(c), np.asarray(r))


def model_claim(
    function: Callable[[Columns], tuple[Any, Any, Any, Any]],
) -> Callable[[Generator, int, float, bool], Judged]:
    """A model of one symbol, `c + g d + Q d^2 + [-r, r]`; half of them affine."""

    def claim(generator: Generator, count: int, end: float, hard: bool) -> Judged:
        c, g = boxes(generator, count, end, hard)
        g = signs(generator, count) * np.where(generator.random(count) < 0.5, np.minimum(g, 0.999 * np.abs(c)), g)
        affine = generator.random(count) < 0.5
        Q, r = (np.where(affine, 0.0, g * powers(generator, count, -60, 0)) for _ in range(2))
        Q, r = signs(generator, count) * Q, np.abs(r)
        value, gradient, curvature, error = function((c, g[None], Q[None, None], r))
        d, t = shares(generator, count), shares(generator, count)
        alone = (g == 0) & (Q == 0) & (r == 0) & (np.abs(c) < end)
        return error, alone, (c, g, Q, r, d, t, value, gradient[0], curvature[0, 0])

    return claim


def model_residual(function: Callable[[arb], arb]) -> Callable[..., arb]:
    def residual(
        c: float, g: float, Q: float, r: float, d: float, t: float, value: float, gradient: float, curvature: float
    ) -> arb:
        x = arb(d)
        v = arb(c) + x * (arb(g) + x * arb(Q)) + arb(r) * arb(t)
        return function(v) - arb(value) - x * (arb(gradient) + x * arb(curvature))

    return residual


def checker_model(name: str) -> Callable[[Columns], Any]:
    def function(parts: Columns) -> Any:
        result = plain.Taylor(*parts).function(name)
        return result.c, result.g, result.Q, result.r

    return function


def producer_model(name: str) -> Callable[[Columns], Any]:
    def function(parts: Columns) -> Any:
        with np.errstate(all="ignore"):
            result = getattr(producer_taylor.Taylor(*parts), name)()
        return result.c, result.g, result.Q, result.r

    return function


def sine(y: float, s: float) -> arb:
    return arb(y).sin() - arb(s)


TANH_END, ANGLE_END = near._TANH_END, near._ANGLE_END
EXP_END = elementary._EXP_END
INVERSE, SINE, COSINE = (model_residual(f) for f in (lambda v: 1 / v, lambda v: v.sin(), lambda v: v.cos()))
TANH, EXP, ATAN, SQRT = (model_residual(f) for f in (arb.tanh, arb.exp, arb.atan, arb.sqrt))
ELEMENTARY = {
    "checker tanh": Elementary(
        TANH_END, value_claim(plain.tanh, 0, 1), lambda y, t: arb(y).tanh() - arb(t), 1.0
    ),
    "checker sin": Elementary(ANGLE_END, value_claim(plain.sin_cos, 0, 2), sine, 1.0),
    "checker cos": Elementary(
        ANGLE_END, value_claim(plain.sin_cos, 1, 3), lambda y, c: arb(y).cos() - arb(c), 1.0
    ),
    "checker exp": Elementary(EXP_END, value_claim(plain.exp, 0, 1), lambda y, v: arb(y).exp() - arb(v), 0.7),
    "checker atan": Elementary(8.0, value_claim(plain.atan, 0, 1), lambda y, v: arb(y).atan() - arb(v), 1.0),
    "checker relax_tanh": Elementary(TANH_END, line_claim(plain.relax_tanh), line_residual, 0.9),
    "checker model of 1/v": Elementary(ANGLE_END, model_claim(checker_model("inv")), INVERSE, 0.5),
    "checker model of sin": Elementary(ANGLE_END, model_claim(checker_model("sin")), SINE, 0.7),
    "checker model of tanh": Elementary(TANH_END, model_claim(checker_model("tanh")), TANH, 0.7),
    "checker model of exp": Elementary(EXP_END, model_claim(checker_model("exp")), EXP, 0.3),
    "checker model of atan": Elementary(8.0, model_claim(checker_model("atan")), ATAN, 0.7),
    "checker model of sqrt": Elementary(8.0, model_claim(checker_model("sqrt")), SQRT, 0.2),
    "producer model of tanh": Elementary(TANH_END, model_claim(producer_model("tanh")), TANH, 0.7),
    "producer model of exp": Elementary(EXP_END, model_claim(producer_model("exp")), EXP, 0.3),
    "producer model of atan": Elementary(8.0, model_claim(producer_model("atan")), ATAN, 0.7),
    "producer model of sqrt": Elementary(8.0, model_claim(producer_model("sqrt")), SQRT, 0.2),
    "checker model of cos": Elementary(ANGLE_END, model_claim(checker_model("cos")), COSINE, 0.7),
    "producer relax_tanh": Elementary(TANH_END, line_claim(producer_relax), line_residual, 0.9),
    "producer model of 1/v": Elementary(ANGLE_END, model_claim(producer_model("inverse")), INVERSE, 0.5),
    "producer model of sin": Elementary(ANGLE_END, model_claim(producer_model("sin")), SINE, 0.7),
    "producer model of cos": Elementary(ANGLE_END, model_claim(producer_model("cos")), COSINE, 0.7),
}  # fmt: skip


@pytest.mark.parametrize("name", ELEMENTARY)
@sizes((20_000, 10_000), (10_000_000, 100_000))
def test_elementary_enclosures(name: str, first: int, second: int, report: Report) -> None:
    case, tally = ELEMENTARY[name], Tally()
    for hard, total in ((False, first), (True, second)):
        generator = np.random.default_rng([list(ELEMENTARY).index(name), hard])
        for done in range(0, total, CHUNK):
            errors, alone, columns = case.claim(generator, min(CHUNK, total - done), case.end, hard)
            tally.judge(case.residual, errors, alone, *(column.tolist() for column in columns))
    report(name, tally, case.least_claimed)


# ------------------------------------------------------------------------------------------------------ whole networks

FORMS: list[tuple[Squash, Centre]] = [
    (squash, centre)
    for squash, centre in itertools.product(get_args(Squash), get_args(Centre))
    if (squash, centre) != ("identity", "preactivation")
]


def random_policy(
    generator: Generator, n: int, scale: Array, offset: Array, squash: Squash, centre: Centre, wide: bool
) -> Policy:
    """Depth 1 to 5, widths 1 to 64 or 256, small to saturated; net(0) = 0 if there is no centring.

    In one of four the neurons of each hidden layer come in pairs that cancel to about 40 bits in the next.
    """
    depth = max(1, int(generator.integers(6)))  # one layer in one of three: there the bounds are tight
    hidden = [256] * (depth - 1) if wide else np.rint(powers(generator, depth - 1, 0, 6)).astype(int).tolist()
    widths = [n, *hidden, len(scale)]
    size, spread = generator.choice([0.1, 0.7, 1.5, 5.0, 100.0]), generator.choice([0.0, 0.3, 3.0, 30.0])
    weights = [
        size * generator.standard_normal((out, into)) / math.sqrt(into) for into, out in itertools.pairwise(widths)
    ]
    biases = [(0.0 if centre == "none" else spread) * generator.standard_normal(out) for out in widths[1:]]
    if generator.random() < 0.25:
        for k, width in enumerate(hidden):
            half = width // 2
            weights[k][half : 2 * half], biases[k][half : 2 * half] = weights[k][:half], biases[k][:half]
            nearly = 1 + 2.0**-40 * generator.standard_normal(half)
            weights[k + 1][:, half : 2 * half] = -weights[k + 1][:, :half] * nearly
    return Policy(plain.chain(weights, biases), scale, offset, squash, centre)


def network_of(policy: Policy, squash: Squash, centre: Centre) -> PolicyNetwork:
    weights, biases = zip(*plain.layers(policy.network), strict=True)
    return PolicyNetwork.of_layers(weights, biases, policy.scale, policy.offset, squash, centre)


def still_system(n: int, u_eq: tuple[Fraction, ...]) -> System:
    """A plant with n states that lets the producer read the equilibrium input, and nothing else."""
    states, inputs = symbols(f"x{i}" for i in range(1, n + 1)), symbols(f"u{i}" for i in range(1, len(u_eq) + 1))
    return System(
        name="still",
        states=states,
        inputs=inputs,
        parameters={},
        dynamics=tuple(-x for x in states),
        u_eq=tuple(Fraction(q.numerator, q.denominator) for q in u_eq),
        domain=box(*[1] * n),
        input_bounds=box(*[1] * len(u_eq)),
    )


BOX_SIZES = [0.0, 1e-12, 1e-9, 1e-6, 1e-3, 0.1, 1.0, 10.0, 1e3, 1e6]
EACH = 4  # points in a box


def points(generator: Generator, n: int, count: int) -> Array:
    """Points of [-1, 1]^n, (n, EACH, B): inside, corners, and edges and faces between."""
    shape = n, EACH, count
    inside, corners = generator.uniform(-1, 1, shape), generator.choice([-1.0, 1.0], shape)
    kind, coin = generator.random((1, EACH, count)), generator.random(shape)
    return np.where((kind < 0.3) | ((kind > 0.7) & (coin < 0.5)), inside, corners)


@dataclass(frozen=True)
class Situation:
    """A policy at EACH points of each of B boxes of affine forms (n, n + 1, B) with errors (n, B)."""

    policy: Policy
    u_eq: tuple[Fraction, ...]
    x: Array
    x_error: Array
    d: Array  # (n, EACH, B)
    side: Array  # (n, B), -1 or 1: where within the error the state lies

    def state(self, k: int, b: int) -> list[arb]:
        d = [arb(v) for v in self.d[:, k, b].tolist()]
        error = (self.x_error * self.side)[:, b].tolist()
        return [
            sum((arb(s) * v for s, v in zip(row[1:], d, strict=True)), arb(row[0]) + arb(e))
            for row, e in zip(self.x[:, :, b].tolist(), error, strict=True)
        ]

    def judge(self, tally: Tally, truth: list[list[arb]], mid: Array, slopes: Array, error: Array) -> None:
        """`|u - mid - slopes.d| <= error` for each input, point and box."""
        rows = [slopes[:, :, b].tolist() for b in range(slopes.shape[2])]

        def residual(j: int, k: int, b: int, mid: float) -> arb:
            if ctx.prec == BITS:
                u = truth[k * len(rows) + b][j]
            else:
                u = policy_in_arb(self.policy, self.u_eq, self.state(k, b))[j]
            line = (arb(s) * arb(v) for s, v in zip(rows[b][j], self.d[:, k, b].tolist(), strict=True))
            return u - sum(line, arb(mid))

        shape = len(mid), EACH, len(rows)
        index = (v.ravel().tolist() for v in np.indices(shape))
        alone = ~np.any(self.x[:, 1:], axis=(0, 1)) & ~np.any(self.x_error, axis=0)
        mids, errors = (np.broadcast_to(v[:, None], shape).ravel() for v in (mid, error))
        tally.judge(residual, errors, np.broadcast_to(alone, shape).ravel(), *index, mids.tolist())


def situation(generator: Generator, squash: Squash, centre: Centre, wide: bool, count: int) -> Situation:
    """Boxes from points to huge, at the origin and far from it, along the axes or not, with and without errors.

    In one of four the first layer takes differences of states that agree to about 40 bits.
    """
    n, m = int(generator.integers(1, 7)), int(generator.integers(1, 4))
    scale = signs(generator, m) * powers(generator, m, -3, 5)
    offset = generator.choice([0.0, 1.0], m) * generator.standard_normal(m)
    inside = [Fraction(int(k), 7) if centre != "none" else Fraction(0) for k in generator.integers(-6, 7, m)]
    u_eq = tuple(Fraction(o) + Fraction(s) * q for o, s, q in zip(offset, scale, inside, strict=True))
    size = generator.choice(BOX_SIZES, count)
    x = generator.standard_normal((n, n + 1, count))
    x[:, 0] *= generator.choice([0.0, 1e-6, 1.0, 1.0, 10.0, 1e4], count)
    x[:, 1:] *= size * np.where(generator.random(count) < 0.5, np.eye(n)[:, :, None], 1.0)
    x_error = np.abs(generator.standard_normal((n, count))) * size * generator.choice([0.0, 1e-15, 1e-3], count)
    policy = random_policy(generator, n, scale, offset, squash, centre, wide)
    if generator.random() < 0.25:
        half, W = n // 2, plain.layers(policy.network)[0][0]
        W[:, half : 2 * half] = -W[:, :half]
        x[half : 2 * half, 0] = x[:half, 0] * (1 + 2.0**-40 * generator.standard_normal((half, count)))
    return Situation(
        policy,
        u_eq,
        x,
        x_error,
        points(generator, n, count),
        signs(generator, n * count).reshape(n, count),
    )


def producer_bounds(s: Situation, squash: Squash, centre: Centre, way: Way = "numpy") -> list[Array]:
    loop = ClosedLoop(still_system(len(s.x), s.u_eq), network_of(s.policy, squash, centre))
    with bounded(way):
        return list(policy_enclosure(loop)(s.x, s.x_error)[:3])


@sizes((40, 5), (2000, 50))
def test_policies_on_boxes(first: int, second: int, report: Report) -> None:
    """`first` networks, `second` boxes each; all enclosures against the same truth."""
    generator = np.random.default_rng(101)
    trusted, untrusted, fast = Tally(), Tally(), Tally()
    for number in range(first):
        squash, centre = FORMS[number % len(FORMS)]
        s = situation(generator, squash, centre, number % 20 == 19, second)
        truth = policies_in_arb(s.policy, s.u_eq, [s.state(k, b) for k in range(EACH) for b in range(second)])
        s.judge(trusted, truth, *plain.enclose_on_boxes(checker.fold(s.policy, s.u_eq), s.x, s.x_error))
        s.judge(untrusted, truth, *producer_bounds(s, squash, centre))
        s.judge(fast, truth, *producer_bounds(s, squash, centre, "compiled"))
    report("checker", trusted, 0.9)
    report("producer", untrusted, 0.9)
    report("producer, compiled", fast, 0.9)


@pytest.mark.parametrize(
    "who",
    ["checker", "numpy", "compiled"],
)
@pytest.mark.parametrize(("squash", "centre"), [form for form in FORMS if form[1] != "none"])
def test_errors_of_folding_are_enclosed(who: str, squash: Squash, centre: Centre) -> None:
    """Each layer magnifies the rounding errors of net(0) by its weight, yet far from the origin all is saturated."""
    h, weights, biases = 0.0, [np.ones((1, 1))], [np.full(1, 0.3)]
    for magnified in (300.0, 300.0, 300.0, 1.0):
        h = math.tanh(h * weights[-1].item() + biases[-1].item())
        weights.append(np.full((1, 1), magnified))
        biases.append(np.full(1, 0.3 - magnified * h))  # net(0) stays where tanh is steep
    tally, x = Tally(), np.array([[[5.0, 20.0, -7.0], [0.0, 0.0, 0.0]]])
    policy = Policy(plain.chain(weights, biases), np.ones(1), np.zeros(1), squash, centre)
    s = Situation(policy, (Fraction(0),), x, np.zeros((1, 3)), np.zeros((1, EACH, 3)), np.ones((1, 3)))
    truth = policies_in_arb(policy, s.u_eq, [s.state(k, b) for k in range(EACH) for b in range(3)])
    if who == "checker":
        s.judge(tally, truth, *plain.enclose_on_boxes(checker.fold(policy, s.u_eq), s.x, s.x_error))
    else:
        s.judge(tally, truth, *producer_bounds(s, squash, centre, "numpy" if who == "numpy" else "compiled"))
    assert tally.violations == 0, (tally.worst, tally.examples)


def test_the_oracle_agrees_with_the_closed_loops_own() -> None:
    """Two writings of the policy in ball arithmetic: their balls meet, and both are narrow."""
    generator = np.random.default_rng(102)
    for number in range(2 * len(FORMS)):
        squash, centre = FORMS[number % len(FORMS)]
        s = situation(generator, squash, centre, False, 3)
        loop = ClosedLoop(still_system(len(s.x), s.u_eq), network_of(s.policy, squash, centre))
        for b in range(3):
            x = s.x[:, 0, b]
            for u, v in zip(
                policy_in_arb(s.policy, s.u_eq, [arb(t) for t in x.tolist()]), evaluate_policy(loop, x), strict=True
            ):
                assert u.overlaps(v) and u.rad() < 1e-30 and v.rad() < 1e-30


# ---------------------------------------------------------------------------------------------------------------- Vdot


def crooked() -> System:
    """A plant that uses all of the grammar: quotients, powers, tan."""
    x, y, z, u, v = symbols("x y z u v")
    third = Fraction(1, 3)
    return System(
        name="crooked",
        states=(x, y, z),
        inputs=(u, v),
        parameters={},
        dynamics=(
            (u - third) * cos(x * y) / (2 + sin(z) ** 2),
            tan(y / 4) * (1 + x**2) ** -2 - v**3 / 7,
            (x - z) ** 3 + sin(u - third) * v + Fraction(-5, 11) * z / (3 + x),
        ),
        u_eq=(third, Number(0)),
        domain=box(2, 2, 2),
        input_bounds=box(9, 9),
    )


def integrator() -> System:
    """xdot = u: Vdot is 2 P x u, which a model of second order can bound without any slack."""
    x, u = symbols("x u")
    return System(
        name="integrator",
        states=(x,),
        inputs=(u,),
        parameters={},
        dynamics=(u,),
        u_eq=(Number(0),),
        domain=box(2),
        input_bounds=box(9),
    )


@cache
def plant(name: str) -> tuple[System, list[Any]]:
    own = {"crooked": crooked, "integrator": integrator}
    system = own[name]() if name in own else get_system(name)
    return system, [to_tree(e) for e in system.exact_dynamics()]


PLANTS = ["pendulum", "cartpole", "quadrotor2d", "crooked", "integrator"]


def random_ring(generator: Generator, name: str, squash: Squash, centre: Centre) -> Ring:
    """The leaf rule for a plant, a policy, P and T that are random; half of the T nearly annihilate (1, ..., 1)."""
    system, trees = plant(name)
    n, u_eq = system.n, system.exact_u_eq()
    near = np.array([float(q) for q in u_eq])
    scale = signs(generator, system.m) * powers(generator, system.m, -1, 4)
    offset = near if centre == "none" else near + scale * generator.uniform(-0.9, 0.9, system.m)
    policy = random_policy(generator, n, scale, offset, squash, centre, wide=False)
    root = generator.standard_normal((n, n)) * powers(generator, n, -4, 4)
    P = root @ root.T
    T = generator.standard_normal((n, n)) + 2 * np.eye(n)
    if generator.random() < 0.5:
        T[:, -1] = 2.0**-30 * T[:, -1] - T[:, :-1].sum(1)
    c = parse(make(
        trees,
        plain.layers(policy.network),
        P + P.T + np.diag(np.diag(P)) / 8,
        (1e-3, 1.0),
        states=[s.name for s in system.states],
        inputs=[s.name for s in system.inputs],
        u_eq=[str(q) for q in u_eq],
        domain=[("-9", "9")] * n,
        input_bounds=[("-9", "9")] * system.m,
        squash=squash,
        centre=centre,
        scale=scale.tolist(),
        offset=offset.tolist(),
        T=T,
        root=np.ones(n),
    ))  # fmt: skip
    return Ring.of(Case(c))


def vdot_bounds(ring: Ring, lo: Array, hi: Array) -> tuple[Array, Array, Array]:
    """Lower and upper bound of Vdot on boxes, and its upper bound on the part of each box that lies in the ring. `rise`
    is known from above alone: the lower bound is that of the negative F."""
    centre = 0.5 * lo + 0.5 * hi
    _, radius = middle(lo, hi)
    states, F, _ = on_boxes(ring, centre, radius)
    model, fall = ring.rise(states, F), ring.rise(states, [-f for f in F])
    return -upper_bound(fall), upper_bound(model), ring.bound(model, centre, radius)


def states_in_arb(T: Array, z: Array) -> list[list[arb]]:
    """T z for each row of z."""
    rows = [[arb(t) for t in row] for row in T.tolist()]
    columns = [[arb(v) for v in point] for point in z.tolist()]
    return [[sum((t * v for t, v in zip(row, point, strict=True)), arb(0)) for row in rows] for point in columns]


def levels_and_vdots(name: str, c: Certificate, z: Array) -> list[tuple[arb, arb]]:
    """`x'P x` and `2 x'P f(x, pi(x))` at x = T z for each row of z."""
    system, trees = plant(name)
    names = [s.name for s in (*system.states, *system.inputs)]
    states = states_in_arb(c.evidence.T, z)
    P = [[arb(p) for p in row] for row in c.P.tolist()]
    result = []
    for x, u in zip(states, policies_in_arb(c.policy, c.u_eq, states), strict=True):
        values = dict(zip(names, [*x, *u], strict=True))
        Px = [sum((p * v for p, v in zip(row, x, strict=True)), arb(0)) for row in P]
        f = [value_of(tree, values) for tree in trees]
        V, half = (sum((p * v for p, v in zip(Px, other, strict=True)), arb(0)) for other in (x, f))
        result.append((V, 2 * half))
    return result


@sizes((50, 6), (1000, 50))
def test_vdot_on_boxes(first: int, second: int, report: Report) -> None:
    """The checker's bounds of Vdot, all the way from boxes in z; `first` rings, `second` boxes each.

    The truth t lies between the bounds iff `|(2 t - lower - upper) / (upper - lower)| <= 1`, once lower < upper. The
    bound with multipliers takes the place of the upper one at points that certainly lie in the ring.
    """
    generator = np.random.default_rng(103)
    plain, multiplied = Tally(), Tally()
    for number in range(first):
        name = PLANTS[number % len(PLANTS)]
        squash, centre = FORMS[number // len(PLANTS) % len(FORMS)]
        if centre == "none" and name in ("quadrotor2d", "crooked"):  # u_eq is no binary64 number
            centre = "output"
        ring = random_ring(generator, name, squash, centre)
        n = ring.n
        even = generator.random(second) < 0.3
        middle = np.where(even, generator.standard_normal(second), generator.standard_normal((n, second)))
        middle *= generator.choice([0.0, 1e-6, 0.1, 1.0, 1.0], second)
        radius = generator.random((n, second)) * generator.choice(BOX_SIZES[:-3], second)
        lo, hi = middle - radius, middle + radius
        share = 0.5 + 0.5 * points(generator, n, second)
        z = np.clip(lo[:, None] + share * (hi - lo)[:, None], lo[:, None], hi[:, None])
        z = np.where(share == 1, hi[:, None], z).reshape(n, -1).T
        truth = levels_and_vdots(name, ring.c, z)
        c1, c2 = np.quantile([float(V) for V, _ in truth], [0.2, 0.8]).tolist()
        ring.c = replace(ring.c, levels={"local": c1, "roa": c2})

        def residual(
            row: int, low: float, high: float, name: str = name, c: Certificate = ring.c, z: Array = z,
            truth: list[tuple[arb, arb]] = truth,
        ) -> arb:  # fmt: skip
            _, vdot = truth[row] if ctx.prec == BITS else levels_and_vdots(name, c, z[row : row + 1])[0]
            return (2 * vdot - arb(low) - arb(high)) / (arb(high) - arb(low))

        lower, upper, in_ring = (np.tile(v, EACH) for v in vdot_bounds(ring, lo, hi))
        alone = np.tile(np.all(lo == hi, axis=0), EACH)
        inside = np.array([bool(arb(c1) <= V) and bool(arb(c2) >= V) for V, _ in truth])
        for tally, bound, rows in ((plain, upper, np.arange(len(z))), (multiplied, in_ring, np.flatnonzero(inside))):
            low, high = lower[rows], bound[rows]
            errors = np.where(np.isfinite(high - low), np.where(high > low, 1.0, -1.0), np.inf)
            tally.judge(residual, errors, alone[rows], rows.tolist(), low.tolist(), high.tolist())
    report("checker", plain, 0.7)
    report("checker, in the ring", multiplied, 0.7)
