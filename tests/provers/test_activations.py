"""Policies with other activations than tanh: bounds on boxes and balls hold, are the checker's, and prove loops."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify import certify_roa
from certify.analysis.results import RoaResult
from certify.certificates.checking import Program, run_checker
from certify.certificates.claims.conditions import conditions
from certify.certificates.claims.queries import query
from certify.certificates.coq.data import read_claim
from certify.certificates.model import Certificate
from certify.certificates.reading import read_certificate
from certify.certificates.verdict import Verdict
from certify.checker.activations import add as add_activations
from certify.checker.functions import FUNCTIONS
from certify.checker.near import Above, Form
from certify.checker.network import enclose_on_boxes, fold
from certify.checker.smooth import add as add_smooth
from certify.errors import CertificateFormatError, InputError
from certify.loop.activations import ACTIVATIONS
from certify.loop.closed_loop import ClosedLoop
from certify.loop.networks import Affine, Map, Network, Sum
from certify.loop.plants import get_system
from certify.loop.policies import PolicyNetwork
from certify.loop.policies.exact import at_origin
from certify.loop.rigorous import evaluate_policy
from certify.lyapunov import domain_limit
from certify.provers.ball.local import prove_local
from certify.provers.ball.models import meets_corner, paths
from certify.provers.bounds.lines import LINES
from certify.provers.bounds.policy import policy_enclosure
from tests.provers.test_models import beyond
from tests.support.cases import case_of
from tests.support.certificates import parse
from tests.support.loops import saturated_lqr, scalar_tanh
from tests.support.marks import slow_after
from tests.support.ways import WAYS, Way, bounded

add_activations()
add_smooth()


NEW = [name for name in ACTIVATIONS if name != "tanh"]
BENT = [name for name in NEW if not ACTIVATIONS[name].is_smooth]
PLANT = get_system("pendulum")


def policy(name: str, widths: tuple[int, ...] = (8, 8), seed: int = 0) -> PolicyNetwork:
    """One that stabilises the pendulum."""
    K, spread = np.array([[2.8, 0.95]]), [2.0, 8.0]
    return saturated_lqr(K, 6.0, 0.0, spread, widths, "preactivation", seed, name)


def loop(name: str, **changes: Any) -> ClosedLoop:
    return ClosedLoop(PLANT, replace(policy(name), **changes))


# --------------------------------------------------------------------------------------------------------------- boxes


def ranges(count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Across 0, beside it, tiny, wide, and far."""
    generator = np.random.default_rng(0)
    middle = generator.normal(size=count) * 10.0 ** generator.uniform(-6, 2, count)
    half = 10.0 ** generator.uniform(-12, 2, count)
    lo, hi = middle - half, middle + half
    half = half[:20]
    lo[:20], hi[:20] = 0.0, 2 * half
    lo[20:40], hi[20:40] = -2 * half, 0.0
    lo[40:60], hi[40:60] = -half, half
    return lo, hi


@pytest.mark.parametrize("name", NEW)
@np.errstate(all="ignore")
def test_lines_hold_and_are_not_tighter_than_the_checkers(name: str) -> None:
    lo, hi = ranges()
    s, m, gap = LINES[name](lo, hi)
    phi = ACTIVATIONS[name]
    for share in np.concatenate([np.linspace(0, 1, 41), [1e-9, 1 - 1e-9]]):
        v = np.minimum(np.maximum(lo + share * (hi - lo), lo), hi)
        for at in (v, np.clip(share * 1e-3, lo, hi), np.clip(-share, lo, hi)):
            away = np.abs(phi.pair(at)[0] - s * at - m)
            assert np.all(away <= gap + 1e-14 * (1 + np.abs(at)))
    centre = (lo + hi) / 2
    theirs = FUNCTIONS[name].lines(centre, Above(np.maximum(hi - centre, centre - lo)))
    assert np.all(theirs[2].top <= gap * (1 + 1e-4) + 1e-13 * (1 + np.abs(centre)))
    tight = 0.25 * (hi - lo) ** 2 * phi.bend if phi.bend else (hi - lo) / 4
    assert np.all(gap <= tight * (1 + 1e-6) + 1e-12 * (1 + np.abs(lo) + np.abs(hi)))


@pytest.mark.parametrize("name", NEW)
@np.errstate(all="ignore")
def test_what_is_not_finite_has_no_lines(name: str) -> None:
    for lo, hi in ((-math.inf, 1.0), (-1.0, math.inf), (-math.inf, math.inf), (math.nan, math.nan)):
        s, m, gap = LINES[name](np.array([lo]), np.array([hi]))
        assert not np.isfinite(s + m + gap).any()


def boxes(count: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(3)
    x = np.zeros((2, 3, count))
    x[:, 0] = generator.normal(size=(2, count)) * np.array([[1.0], [3.0]])
    x[0, 1], x[1, 2] = size * generator.random(count), size * generator.random(count)
    return x, np.zeros((2, count))


@pytest.mark.parametrize("size", slow_after(2, [1e-6, 0.05, 1.0, 10.0]))
@pytest.mark.parametrize("name", NEW)
def test_policies_on_boxes(name: str, size: float) -> None:
    """They hold samples and corners, both ways of computing agree to the bit, and the checker is as tight."""
    closed, (x, error) = loop(name), boxes(200, size)
    found = []
    for way in WAYS:
        with bounded(way):
            found.append(policy_enclosure(closed)(x, error))
    for a, b in zip(*found, strict=True):
        assert np.array_equal(a, b)
    mid, slopes, wide, _ = found[0]
    generator = np.random.default_rng(4)
    for _ in range(40):
        d = np.sign(generator.normal(size=(2, 200))) * generator.random((2, 200)) ** 0.1
        u = closed.policy((x[:, 0] + x[:, 1:].transpose(0, 1, 2)[np.arange(2), np.arange(2)] * d).T).T
        away = np.abs(u - mid - (slopes * d).sum(1))
        assert np.all(away <= wide + 1e-13 * (1 + np.abs(u)))
    theirs = enclose_on_boxes(folded(closed), Form(x.transpose(1, 0, 2), Above(error)))
    assert np.all(theirs.error.top <= wide * (1 + 1e-3) + 1e-11)


def folded(closed: ClosedLoop) -> Any:
    """The checker's policy, from a certificate's own sections."""
    return fold(parse(json.loads(certificate(closed))).policy, tuple(closed.u_eq))


@cache
def proved() -> Certificate:
    """That of a tanh policy."""
    found = certify_roa(PLANT, policy("tanh"), level=1e-3)
    assert found.certificate is not None
    return read_certificate(found.certificate)


def certificate(closed: ClosedLoop) -> str:
    """The same about another policy."""
    return replace(proved(), network=closed.network).to_json()


@pytest.mark.parametrize("name", BENT)
@pytest.mark.parametrize("way", WAYS)
def test_a_box_with_a_corner_in_it_has_no_smaller_error_than_the_corner(name: str, way: Way) -> None:
    """A unit that reads x itself: the lines around relu are half its height apart."""
    one, none = np.eye(1), np.zeros(1)
    law = PolicyNetwork.of_layers((one, one), (none, none), np.ones(1), none, "identity", "none", activation=name)
    closed = ClosedLoop(scalar_tanh()[0], law)
    with bounded(way):
        mid, slopes, error, _ = policy_enclosure(closed)(np.array([[[0.0], [0.5]]]), np.zeros((1, 1)))
    ends = np.array([-0.5, 0.0, 0.5])
    away = np.abs(ACTIVATIONS[name].pair(ends)[0] - mid[0, 0] - slopes[0, 0, 0] * ends / 0.5)
    assert np.all(away <= error[0, 0]) and (name != "relu" or error[0, 0] == pytest.approx(0.125))


# --------------------------------------------------------------------------------------------------------------- balls


@pytest.mark.parametrize("name", NEW)
@pytest.mark.parametrize("moved", [False, True])
def test_models_on_balls(name: str, moved: bool) -> None:
    """At points of balls; a ball of a tenth has less than a thousandth of the error."""
    closed, generator = loop(name), np.random.default_rng(1)
    middle = np.array([0.3, -0.7]) if moved else np.zeros(2)
    known = paths(closed, middle) if moved else paths(closed)
    J = np.diag([0.2, 0.6]) @ (0.6 * np.eye(2, 2 + moved) + 0.2 * generator.standard_normal((2, 2 + moved)))
    with np.errstate(all="ignore"):
        while not known.models(J).finite:
            J = J / 1.5
    d = generator.standard_normal((2000, 2 + moved))
    d *= generator.random((2000, 1)) ** 0.1 / np.linalg.norm(d, axis=1, keepdims=True)
    for at in (J, J / 10):
        models = known.models(at)
        error, bound = beyond(closed, models, middle + d @ at.T, d)
        assert models.finite and np.all(error <= bound * (1 + 1e-9) + 1e-12)


@pytest.mark.parametrize("name", BENT)
def test_a_ball_that_meets_corners_has_tangents_and_a_level_beyond_them(name: str) -> None:
    case, generator = case_of(PLANT, policy(name)), np.random.default_rng(5)
    known, limit, first = paths(case.loop), domain_limit(case.P, PLANT.domain), case.loop.network
    corner = np.min(np.abs(first.biases[0]) / np.linalg.norm(first.weights[0] @ case.T, axis=1))
    d = generator.standard_normal((4000, 2))
    d *= generator.random((4000, 1)) ** 0.1 / np.linalg.norm(d, axis=1, keepdims=True)
    for far in (1.01, 1.5, 3.0):
        J = far * corner * case.T
        models = known.models(J)
        error, bound = beyond(case.loop, models, d @ J.T, d)
        assert models.finite and np.all(error <= bound * (1 + 1e-9) + 1e-12)
    level = prove_local(case.problem, case.T, limit)
    assert level is not None and level > (0.9 if name == "softsign" else 1.0) * corner**2


def free_of_biases(law: PolicyNetwork, units: int) -> PolicyNetwork:
    """So many units of the first layer at their corners at the origin."""
    first = law.biases[0] * (np.arange(len(law.biases[0])) >= units)
    return law.with_layers(biases=(first, *law.biases[1:]))


def without_biases(name: str) -> PolicyNetwork:
    """Every unit of the policy at its corner at the origin."""
    law = policy(name)
    return replace(law.with_layers(biases=tuple(0 * b for b in law.biases)), centre="none")


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_after(1, ["elu", "softsign"]))
def test_a_corner_with_a_tangent_at_the_operating_point_is_proved(name: str, tmp_path: Path) -> None:
    result = certify_roa(PLANT, without_biases(name), tmp_path, effort=0.04, candidate="ellipsoid")
    assert result.verdict is Verdict.PROVED and result.claim == "asymptotic" and result.levels.floor is None
    assert result.volume is not None and result.volume > 10
    programs: tuple[Program, ...] = ("checker", "reference")
    for program in programs:
        assert run_checker(tmp_path / "certificate.json", program=program)["result"] == "ACCEPTED"


def test_a_corner_of_elu_beside_one_of_relu_has_directions_for_the_relu() -> None:
    """As in selu, which is a sum of both."""
    law = free_of_biases(policy("elu"), 1)
    first, middle, end = (Affine((of,), law.weights[k], law.biases[k]) for k, of in ((0, 0), (1, 4), (2, 6)))
    units = Map((1,), "elu"), Map((1,), "relu"), Sum((2, 3))
    net = Network(2, (first, *units, middle, Map((5,), "elu"), end))
    case = case_of(PLANT, PolicyNetwork(net, law.scale, law.offset, law.squash, law.centre))
    assert meets_corner(paths(case.loop))
    result = certify_roa(PLANT, case.loop.network, effort=0.02, candidate="ellipsoid")
    assert result.verdict is Verdict.PROVED and result.claim == "asymptotic"


@pytest.mark.slow
def test_a_relu_with_its_corner_at_the_operating_point_has_directions(tmp_path: Any) -> None:
    """A kink at the origin, and an unstable loop on one side of it."""
    result = certify_roa(PLANT, free_of_biases(policy("relu"), 1), tmp_path, effort=0.1, candidate="ellipsoid")
    assert result.verdict is Verdict.PROVED and result.volume is not None and result.volume > 10
    local = json.loads((tmp_path / "certificate.json").read_text("utf-8"))["evidence"]["local"]
    assert len(local["directions"]) == 4
    assert decreases(result, result.levels.roa or 0.0)
    read = read_certificate(tmp_path / "certificate.json")
    assert read.to_json().encode() == result.raw


@pytest.mark.parametrize("share", [1.0, 0.2])
def test_a_relu_network_without_biases_is_proved_where_it_stabilises(share: float, tmp_path: Any) -> None:
    """u = -Kx by two relus; with a fifth of one of them the pendulum falls over to that side."""
    K = np.array([[2.8, 0.95]])
    law = PolicyNetwork.of_layers(
        (np.vstack([-K, K]), np.array([[1.0, -share]])), (np.zeros(2), np.zeros(1)), np.ones(1), np.zeros(1),
        "identity", "none", activation="relu", clip=(np.array([-6.0]), np.array([6.0])),
    )  # fmt: skip
    result = certify_roa(PLANT, law, out=tmp_path, effort=0.1)
    assert (result.verdict is Verdict.PROVED) is (share == 1.0)
    if share == 1.0:
        assert result.volume is not None and result.volume > 100 and decreases(result, result.levels.roa or 0.0)


# --------------------------------------------------------------------------------------------------------------- proofs


@pytest.mark.parametrize("name", slow_after(4, NEW))
def test_a_loop_is_proved_and_accepted(name: str, tmp_path: Any) -> None:
    result = certify_roa(PLANT, policy(name), out=tmp_path, candidate="lyapunov", effort=0.02)
    assert result.verdict is Verdict.PROVED and result.levels.roa is not None and result.volume is not None
    assert result.volume > 80 and result.raw is not None
    assert result.checker is not None and result.checker["reference"]["result"] == "ACCEPTED"
    assert decreases(result, result.levels.roa)
    read = read_certificate(tmp_path / "certificate.json")
    assert read.network.activation == name and read.network.sha256() == policy(name).sha256()
    assert read.to_json().encode() == result.raw


def decreases(result: RoaResult, level: float) -> bool:
    """Vdot < 0 at samples of {V <= level}."""
    generator = np.random.default_rng(0)
    assert result.P is not None
    z = generator.standard_normal((20_000, 2))
    z *= (level * generator.random((20_000, 1))) ** 0.5 / np.linalg.norm(z, axis=1, keepdims=True)
    x = np.linalg.solve(np.linalg.cholesky(result.P).T, z.T).T
    closed = ClosedLoop(PLANT, result.network)
    F = PLANT.function()(x, closed.policy(x))
    return bool(np.all(2 * np.sum((x @ result.P) * F, axis=1) < 0))


@pytest.mark.parametrize("name", slow_after(3, NEW))
def test_planted_violations_are_never_proved(name: str) -> None:
    """A law that pushes away is refuted; one with a spike in the middle of its set is proved below that alone."""
    law = policy(name)
    away = law.with_layers(weights=(*law.weights[:-1], -law.weights[-1]))
    assert certify_roa(PLANT, away, effort=0.1).verdict is not Verdict.PROVED
    weak = replace(law, scale=law.scale * 0.02)
    result = certify_roa(PLANT, weak, effort=0.1)
    if result.verdict is Verdict.PROVED:
        assert result.levels.roa is not None and decreases(result, result.levels.roa)


@pytest.mark.parametrize("name", NEW)
def test_the_policy_in_balls_is_the_one_in_floats(name: str) -> None:
    closed = loop(name)
    for x in np.random.default_rng(5).normal(size=(20, 2)):
        (u,) = evaluate_policy(closed, x)
        assert float(u.rad()) < 1e-40 and float(u.mid()) == pytest.approx(closed.policy(x)[0], abs=1e-12)


def test_what_is_for_tanh_alone_says_so() -> None:
    case = case_of(PLANT, policy("relu"))
    (first, *_) = conditions(proved().claim, case.problem)
    with pytest.raises(InputError, match="must be about tanh policies; this one has relu"):
        query(first, case.problem)
    with pytest.raises(CertificateFormatError, match="affine steps with tanh between them"):
        read_claim(certificate(loop("relu")).encode())


def test_a_rational_policy_at_rest() -> None:
    """pi(0) of a relu policy without centring is decided exactly."""
    one = np.eye(1)
    law = PolicyNetwork.of_layers((one, -one), (np.ones(1), np.ones(1)), np.ones(1), np.zeros(1), "identity", "none")
    assert at_origin(law.with_layers(activation="relu")) == (Fraction(0),) and at_origin(law) == (None,)
