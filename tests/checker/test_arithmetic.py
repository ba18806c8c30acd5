"""The checker's second arithmetic: the same verdicts, and balls that never lose their radius on the way.

A ball that silently became its midpoint would leave the reference with nothing but binary64's roundings. So the numbers
with which the rules start are given wide balls here, and what comes out must hold for members drawn from them.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

from certify.checker import arithmetic, local, network, rules
from certify.checker.arithmetic import carry, is_ball
from certify.checker.errors import Rejected
from certify.checker.local import Jet
from certify.checker.taylor import Taylor, affine, constant, upper_bound
from certify.policies import load_policy
from certify.roa import certify_roa
from certify.systems import get_system
from tests.checker.test_rules import HONEST, MUTANTS, honest
from tests.support.certificates import Document, make, parse, verdict
from tests.support.oracle import ball, policy_in_arb, quadratic, value_of

POLICY = Path(__file__).parents[2] / "examples" / "policies" / "pendulum.pt"


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    with np.errstate(all="ignore"):
        yield


def verdict_in_balls(data: Document) -> str:
    try:
        rules.check(parse(data), "arb")
    except Rejected as no:
        return no.rule
    return "ACCEPTED"


# ---------------------------------------------------------------------------------------------------- the same verdicts


@pytest.mark.parametrize("name", HONEST)
def test_honest_certificates_are_accepted_in_both(name: str) -> None:
    binary, balls = rules.check(parse(honest(name))), rules.check(parse(honest(name)), "arb")
    assert binary.rules == balls.rules
    assert balls.local_margin == pytest.approx(binary.local_margin, rel=1e-6)
    assert (balls.ring_margin is None) == (binary.ring_margin is None)
    if binary.ring_margin is not None and balls.ring_margin is not None:
        assert balls.ring_margin == pytest.approx(binary.ring_margin, rel=1e-6)


@pytest.mark.parametrize("rule", sorted({rule for rule, *_ in MUTANTS} - {"format", "hash"}))
def test_mutants_are_rejected_by_the_same_rule_in_both(rule: str) -> None:
    for expected, base, _, edit in MUTANTS:
        if expected == rule:
            data = edit(honest(base))
            assert verdict(data) == verdict_in_balls(data) == rule


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> Path:
    policy = load_policy(POLICY)
    system = get_system(policy.system).with_parameters(policy.parameters)
    result = certify_roa(system, policy.network, tmp_path_factory.mktemp("pendulum"))
    assert result.certificate is not None
    return result.certificate


def test_the_pendulum_is_replayed_in_full(pendulum: Path) -> None:
    command = [sys.executable, "-I", "-m", "certify.checker", str(pendulum), "--json"]
    answers = [
        json.loads(subprocess.run([*command, "--arithmetic", name], capture_output=True, text=True, check=True).stdout)
        for name in ("float64", "arb")
    ]
    assert [a["result"] for a in answers] == ["ACCEPTED", "ACCEPTED"]
    assert answers[0]["rules"] == answers[1]["rules"] and answers[0]["rules"]["ring"] > 20
    assert [a["arithmetic"] for a in answers] == ["float64", "arb"]
    for margin in ("local", "ring"):
        assert answers[0]["margins"][margin] == pytest.approx(answers[1]["margins"][margin], rel=1e-6)


def test_a_claim_just_beyond_the_truth_is_rejected_in_balls(pendulum: Path) -> None:
    data = json.loads(pendulum.read_bytes())
    data["levels"]["roa"] = (1.001 * float.fromhex(data["levels"]["roa"])).hex()
    assert verdict_in_balls(data) == verdict(data) != "ACCEPTED"


# -------------------------------------------------------------------------------------------------- balls stay balls


def wide(values: Any, radius: float) -> Any:
    """Balls of a relative radius around binary64 numbers."""
    return np.vectorize(lambda v: arb(v, abs(v) * radius), otypes=[object])(np.asarray(values, dtype=np.float64))


def members(values: Any, radius: float, generator: np.random.Generator) -> np.ndarray:
    values = np.asarray(values, dtype=np.float64)
    return values * (1 + 0.999 * radius * generator.choice([-1.0, 1.0], values.shape))


def holds(model: Taylor, b: int, d: np.ndarray, value: arb) -> bool:
    """`value` certainly lies in what the model says of the point d."""
    at = [arb(float(x)) for x in d]
    said = arb(model.c[b]) + sum((arb(g) * x for g, x in zip(model.g[:, b], at, strict=True)), arb(0))
    for i, x in enumerate(at):
        said += sum((arb(model.Q[i, j, b]) * x * y for j, y in enumerate(at)), arb(0))
    return bool((said + arb(0, 1) * arb(model.r[b])).contains(value))


@pytest.mark.parametrize("radius", [0.0, 1e-9, 1e-3])
@pytest.mark.parametrize("operation", ["add", "mul", "neg", "inv", "sin", "cos", "scaled"])
def test_taylor_models_of_balls_hold_their_members(operation: str, radius: float) -> None:
    generator = np.random.default_rng(17)
    c, g = generator.uniform(0.5, 1, 6), generator.uniform(-0.1, 0.1, (2, 6))
    x, y = affine(wide(c, radius), wide(g, radius)), affine(wide(c[::-1], radius), wide(g, radius))
    result = {
        "add": lambda: x + y, "mul": lambda: x * y, "neg": lambda: -x, "inv": x.inv, "sin": x.sin, "cos": x.cos,
        "scaled": lambda: x.scaled(wide(c, radius), 0.0),
    }[operation]()  # fmt: skip
    assert is_ball(result.c) and is_ball(result.g) and (is_ball(result.r) or not np.any(result.r))
    bound = upper_bound(result)
    assert is_ball(bound)
    with ctx.workprec(300):
        for _ in range(40):
            v, w, slopes, k = (members(a, radius, generator) for a in (c, c[::-1], g, c))
            d = generator.choice([-1.0, 1.0, 0.3], 2)
            for b in range(6):
                offset = arb(slopes[0, b]) * arb(d[0]) + arb(slopes[1, b]) * arb(d[1])
                p, q = arb(v[b]) + offset, arb(w[b]) + offset
                true = {
                    "add": p + q, "mul": p * q, "neg": -p, "inv": 1 / p, "sin": p.sin(), "cos": p.cos(),
                    "scaled": arb(k[b]) * p,
                }[operation]  # fmt: skip
                assert holds(result, b, d, true), (b, d)
                assert true <= arb(bound[b]).upper() + arb(2.0) ** -250


@pytest.mark.parametrize("radius", [1e-9, 1e-3])
def test_jets_of_balls_hold_their_members(radius: float) -> None:
    generator = np.random.default_rng(23)
    c, a = 0.7, np.array([0.2, -0.1])
    Q, E = wide(np.array([[0.1, -0.05], [-0.05, 0.2]]), radius), 0.01 * np.eye(2)
    x = Jet(wide(c, radius).item(), 0.0, wide(a, radius), 0.0, Q, E)
    for result, f, slope in (
        (x.sin(), arb.sin, arb.cos),
        (x.cos(), arb.cos, lambda v: -v.sin()),
        (x.inv(), lambda v: 1 / v, lambda v: -1 / (v * v)),
        (x * x, lambda v: v * v, lambda v: 2 * v),
        (x + -x * x, lambda v: v - v * v, lambda v: 1 - 2 * v),
    ):
        assert is_ball(result.c) and is_ball(result.a)
        with ctx.workprec(300):
            for _ in range(20):
                v, slopes = arb(float(members(c, radius, generator))), members(a, radius, generator)
                assert (arb(result.c) + arb(0, 1) * arb(result.error)).contains(f(v))
                for said, s in zip(result.a, slopes, strict=True):
                    assert (arb(said) + arb(0, 1) * arb(result.slack)).contains(slope(v) * arb(s))


@pytest.mark.parametrize("name", ["rotor", "rotor, preactivation", "linear"])
@pytest.mark.parametrize("radius", [0.0, 1e-6, 1e-3])
def test_vdot_of_a_wide_transformation_holds_its_members(name: str, radius: float) -> None:
    """The leaf rule from end to end: T, the corners and hence x are balls; Vdot at members of them."""
    generator = np.random.default_rng(29)
    data = honest(name)
    c = parse(data)
    T, root = np.asarray(c.evidence.T), np.asarray(c.evidence.root)
    S = rules.congruence(rules.rational(T), rules.rational(c.P))
    ring = rules._Ring(c, wide(T, radius), network.fold(c.policy, c.u_eq, "arb"), S, True, "arb")
    centres = generator.uniform(-0.5, 0.5, (len(root), 5)) * root[:, None] * [1, 1, 1, 0, 0]
    radii = np.full_like(centres, 0.05) * root[:, None] * [1, 0.1, 0.01, 0.01, 1e-4]
    x, error = ring._states(carry(centres, "arb"), carry(radii, "arb"))
    mid, slopes, wide_error = network.enclose_on_boxes(ring.net, x, error)
    assert all(is_ball(v) for v in (x, mid, slopes, wide_error))
    vdot = ring._vdot(x, error, mid, slopes, wide_error)
    bound = upper_bound(vdot)
    with ctx.workprec(200):
        for b in range(5):
            for _ in range(10):
                member, d = members(T, radius, generator), generator.choice([-1.0, 1.0, 0.4], len(root))
                z = [arb(p) + arb(q) * arb(t) for p, q, t in zip(centres[:, b], radii[:, b], d, strict=True)]
                point = [sum((arb(t) * v for t, v in zip(row, z, strict=True)), arb(0)) for row in member]
                u = policy_in_arb(c.policy, c.u_eq, point)
                for j, value in enumerate(u):
                    linear = sum((arb(s) * arb(t) for s, t in zip(slopes[j, :, b], d, strict=True)), arb(mid[j, b]))
                    assert (linear + arb(0, 1) * arb(wide_error[j, b])).contains(value)
                names = dict(zip((*c.states, *c.inputs), (*point, *u), strict=True))
                F = [value_of(tree, names) for tree in data["plant"]["dynamics"]]
                P = [[arb(float(v)) for v in row] for row in c.P]
                gradient = [2 * sum((p * v for p, v in zip(row, point, strict=True)), arb(0)) for row in P]
                true = sum((p * f for p, f in zip(gradient, F, strict=True)), arb(0))
                assert true <= arb(bound[b]).upper() + arb(2.0) ** -100


@pytest.mark.parametrize("name", ["rotor", "rotor, preactivation", "linear"])
@pytest.mark.parametrize("radius", [1e-9, 1e-3])
def test_the_policy_on_a_wide_ball_holds_its_members(name: str, radius: float) -> None:
    """`|pi_j - u_eq_j - G_j d - scale_j d'Q_j d| <= |scale_j| d'E_j d` at x = J d, for all J that G was made from."""
    generator = np.random.default_rng(31)
    c = parse(honest(name))
    J = generator.standard_normal((len(c.states),) * 2) * 0.05
    gradient, slack, Q, E = local.enclose_at_origin(network.fold(c.policy, c.u_eq, "arb"), wide(J, radius), 0.0)
    assert is_ball(gradient)
    with ctx.workprec(200):
        for _ in range(20):
            member, d = members(J, radius, generator), generator.standard_normal(len(J))
            d *= generator.choice([0.999, 1e-3]) / np.linalg.norm(d)
            square = sum((arb(v) ** 2 for v in d), arb(0))
            point = [sum((arb(p) * arb(v) for p, v in zip(row, d, strict=True)), arb(0)) for row in member]
            inputs = policy_in_arb(c.policy, c.u_eq, point)
            for row, u, q, scale, half, rest in zip(gradient, inputs, c.u_eq, c.policy.scale, Q, E, strict=True):
                said = sum((arb(g) * arb(v) for g, v in zip(row, d, strict=True)), ball(q))
                said += arb(float(scale)) * quadratic(half, d)
                wide_enough = abs(arb(float(scale))) * (quadratic(rest, d) + arb(slack) * square.sqrt())
                assert (said + arb(0, 1) * wide_enough).contains(u)


@pytest.mark.parametrize(
    "name",
    [
        "up",
        "total",
        "norm",
        "frobenius",
        "spectral",
        "maximum",
        "largest",
        "lesser",
        "product",
        "tanh",
        "sin_cos",
        "ends",
    ],
)
def test_primitives_keep_the_radius(name: str) -> None:
    """Each on overlapping balls, against the ends of what they may hold."""
    x = np.array([[arb(1, 0.5)], [arb(1.1, 0.1)]], dtype=object)
    y = np.array([[arb(1.2, 0.5)], [arb(-1, 0.1)]], dtype=object)
    with ctx.workprec(60):
        if name in ("up", "total", "norm"):
            result = np.ravel(arithmetic.up(x) if name == "up" else getattr(arithmetic, name)(x, 0))
            least = {"up": 1.5, "total": 2.7, "norm": (1.5**2 + 1.2**2) ** 0.5}[name]
            assert all(v.is_exact() for v in result) and result[0] >= least * (1 - 1e-15)
        elif name in ("frobenius", "spectral"):
            result = getattr(arithmetic, name)(x)
            assert (1.5**2 + 1.2**2) ** 0.5 * (1 - 1e-15) <= result <= 2.0
        elif name == "maximum":
            for result in (arithmetic.maximum(x, y), arithmetic.maximum(y, x)):
                assert result[0, 0].contains(arb(1.7)) and result[1, 0].contains(arb(1.2)) and result[1, 0] > 0
        elif name == "largest":
            assert arithmetic.largest(x, 0)[0].contains(arb(1.5)) and arithmetic.largest(x, 0)[0].contains(arb(1.2))
        elif name == "lesser":
            assert arithmetic.lesser(x, y)[1, 0].contains(arb(-1.1))
        elif name == "product":
            assert arithmetic.product(x, y.T)[0, 0].contains(arb(1.5) * arb(1.7))
        elif name == "tanh":
            assert arithmetic.tanh(x)[0][0, 0].contains(arb(1.5).tanh()) and arithmetic.tanh(x)[1] == 0
        elif name == "sin_cos":
            assert arithmetic.sin_cos(x)[1][0, 0].contains(arb(1.5).cos())
        else:
            lo, hi = arithmetic.ends(x, y)
            assert lo[0, 0] <= arb(0.5) - arb(1.7) and hi[0, 0] >= arb(1.5) + arb(1.7)
            assert lo[0, 0].is_exact() and hi[0, 0].is_exact()


def test_a_decay_below_every_binary64_number_is_no_accident() -> None:
    """Balls do not underflow, but the scaling in the local rule does: this decay is less than any binary64 number."""
    far = "1" + "0" * 400
    data = make(
        [["+", "u", ["-", ["tan", "x1"]]], ["-", ["+", ["**", "x2", 3], "x2"]]], [([[1.0, 1.0]], [0.0])], np.eye(2),
        (2.0**-1020, 2.0**-1018), states=("x1", "x2"), domain=[(f"-{far}", far)] * 2, input_bounds=[("-1000", "1000")],
        centre="none", scale=(-4.9e-91,), T=np.eye(2) * 8.9e-308, root=[6.8e153, 6.8e153],
    )  # fmt: skip
    assert (verdict(data), verdict_in_balls(data)) == ("local", "local")


def test_a_number_that_is_no_number_proves_nothing() -> None:
    nan, one = arb("nan"), np.array([arb(1)], dtype=object)
    for value in (arithmetic.maximum(one, nan), arithmetic.up(one * nan), arithmetic.tanh(one * nan)[0]):
        assert not value[0] < 10 and not value[0] > -10
    model = Taylor(one * nan, np.zeros((1, 1)), np.zeros((1, 1, 1)), np.zeros(1))
    assert not upper_bound(model)[0] < 0
    assert not upper_bound(constant(Fraction(-1), 1, 1) * model)[0] < 0
