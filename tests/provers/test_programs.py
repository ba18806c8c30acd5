"""Networks of any steps: bounds on boxes and balls hold, are the checker's, and prove loops."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from certify import certify_roa
from certify.certificates.claims import Asymptotic
from certify.certificates.claims.conditions import conditions
from certify.certificates.claims.queries import query
from certify.certificates.reading import read_certificate
from certify.certificates.verdict import Verdict
from certify.checker.near import Above, Form
from certify.checker.network import enclose_on_boxes
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.float32 import float_error
from certify.loop.plants import get_system
from certify.loop.policies import PolicyNetwork
from certify.loop.policies.exact import raw_at_origin
from certify.loop.rigorous import evaluate_policy, policy_on
from certify.lyapunov.function import Quadratic
from certify.provers.ball.models import paths
from certify.provers.base import Problem
from certify.provers.bounds.policy import LayersEnclosure, StepsEnclosure, policy_enclosure
from tests.provers.test_activations import boxes, folded
from tests.provers.test_activations import policy as layers
from tests.provers.test_models import beyond
from tests.support.marks import slow_after
from tests.support.programs import PROGRAMS, policy

PLANT = get_system("pendulum")


def loop(name: str, **changes: Any) -> ClosedLoop:
    return ClosedLoop(PLANT, replace(policy(name), **changes))


def moved(name: str) -> ClosedLoop:
    """Looked at from another state."""
    return loop(name, centre="none", origin=np.array([0.3, -0.2]))


@np.errstate(all="ignore")
@pytest.mark.parametrize("size", [1e-6, 0.05, 0.5])
@pytest.mark.parametrize("where", [loop, moved])
@pytest.mark.parametrize("name", PROGRAMS)
def test_policies_on_boxes(name: str, where: Any, size: float) -> None:
    """They hold samples and corners, and the checker is as tight."""
    closed, (x, error) = where(name), boxes(100, size)
    mid, slopes, wide, share = policy_enclosure(closed)(x, error)
    generator = np.random.default_rng(4)
    for _ in range(60):
        d = np.sign(generator.normal(size=(2, 100))) * generator.random((2, 100)) ** 0.1
        u = closed.policy((x[:, 0] + (x[:, 1:] * d).sum(1)).T).T
        away = np.abs(u - mid - (slopes * d).sum(1))
        assert np.all(away <= wide + 1e-13 * (1 + np.abs(u)))
    assert np.all(share > 0) and np.allclose(share.sum(0), 1)
    if where is loop:
        theirs = enclose_on_boxes(folded(closed), Form(x.transpose(1, 0, 2), Above(error)))
        assert np.all(theirs.error.top <= wide * (1 + 1e-6) + 1e-11)


@np.errstate(all="ignore")
@pytest.mark.parametrize("size", [1e-3, 0.3, 1.0])
@pytest.mark.parametrize("centre", ["output", "none"])
@pytest.mark.parametrize("name", PROGRAMS)
def test_inputs_lie_between_the_ends_of_their_squash(name: str, centre: str, size: float) -> None:
    """Samples do, within what the checker finds; so an input keeps its bounds for both programs."""
    closed, (x, error) = loop(name, centre=centre, squash="tanh"), boxes(100, size)
    least, most = policy_enclosure(closed).between(x, error)
    generator = np.random.default_rng(4)
    for _ in range(60):
        d = np.sign(generator.normal(size=(2, 100))) * generator.random((2, 100)) ** 0.1
        u = closed.policy((x[:, 0] + (x[:, 1:] * d).sum(1)).T).T
        assert np.all((least <= u + 1e-13) & (u - 1e-13 <= most))
    theirs = [end.ends for end in folded(closed).ends(Form(x.transpose(1, 0, 2), Above(error)))]
    room = 1e-11 * np.abs(closed.network.scale).max()
    assert np.all(np.min([lo for lo, _ in theirs], axis=0) >= least - room)
    assert np.all(np.max([hi for _, hi in theirs], axis=0) <= most + room)


@pytest.mark.parametrize("size", [1e-3, 0.3])
def test_a_part_of_a_batch_has_the_same_bounds(size: float) -> None:
    x, error = boxes(300, size)
    for name in PROGRAMS:
        enclosure = policy_enclosure(loop(name))
        for whole, part in zip(enclosure(x, error), enclosure(x[..., 7:9], error[:, 7:9]), strict=True):
            assert np.array_equal(whole[..., 7:9], part)


@pytest.mark.parametrize("size", [1e-6, 0.05, 1.0])
@pytest.mark.parametrize("function", ["tanh", "relu", "gelu"])
def test_layers_are_bounded_alike_as_layers_and_as_steps(function: str, size: float) -> None:
    closed, (x, error) = ClosedLoop(PLANT, layers(function)), boxes(100, size)
    first = policy_enclosure(closed)
    assert isinstance(first, LayersEnclosure)
    second = StepsEnclosure(closed.network, (first.shift, first.shift_error, first.offset, first.offset_error))
    one, other = first(x, error), second(x, error)
    assert np.allclose(one[0], other[0]) and np.allclose(one[1], other[1])
    assert np.allclose(one[2], other[2], rtol=1e-3, atol=3e-11)


@np.errstate(all="ignore")
@pytest.mark.parametrize("name", PROGRAMS)
def test_what_is_not_finite_has_no_bounds(name: str) -> None:
    x, error = boxes(4, 0.1)
    x[0, 0], x[1, 1, 0], error[0, 1] = [np.nan, np.inf, 0.0, 1e300], np.nan, np.inf
    mid, slopes, wide, _ = policy_enclosure(loop(name, squash="identity", centre="none"))(x, error)
    whole = mid + slopes.sum(1) + wide
    assert not np.any(np.isfinite(whole[:, :2]))


@pytest.mark.parametrize("away", [False, True])
@pytest.mark.parametrize("name", PROGRAMS)
def test_models_on_balls(name: str, away: bool) -> None:
    """At points of balls; a ball of a tenth has less than a thousandth of the error, but for kinks."""
    closed, generator = loop(name), np.random.default_rng(1)
    middle = np.array([0.2, -0.1]) if away else np.zeros(2)
    known = paths(closed, middle) if away else paths(closed)
    J = np.diag([0.02, 0.06]) @ (0.6 * np.eye(2, 2 + away) + 0.2 * generator.standard_normal((2, 2 + away)))
    d = generator.standard_normal((2000, 2 + away))
    d *= generator.random((2000, 1)) ** 0.1 / np.linalg.norm(d, axis=1, keepdims=True)
    sizes = []
    for at in (J, J / 10):
        models = known.models(at)
        error, bound = beyond(closed, models, middle + d @ at.T, d)
        assert models.finite and np.all(error <= bound * (1 + 1e-9) + 1e-12)
        sizes.append(np.max(bound))
    assert sizes[1] <= sizes[0] / 500


@pytest.mark.parametrize("name", PROGRAMS)
def test_points_and_slopes_in_arb_and_in_floats(name: str) -> None:
    closed, generator = loop(name, centre="none"), np.random.default_rng(2)
    for _ in range(20):
        x = generator.normal(size=2) * [1, 3]
        exact = [float(v.mid()) for v in evaluate_policy(closed, x)]
        assert exact == pytest.approx(closed.policy(x).tolist(), rel=1e-12, abs=1e-12)
    gain = np.array([[float(v) for v in row] for row in policy_on(closed, [_point(0)] * 2)[1].tolist()])
    assert np.allclose(gain, closed.network.jacobian_at_origin(closed.u_eq))
    step = 1e-6
    by_differences = [(closed.policy(step * e) - closed.policy(-step * e)) / (2 * step) for e in np.eye(2)]
    assert np.allclose(np.transpose(by_differences), gain, rtol=1e-6, atol=1e-8)


def _point(value: float) -> Any:
    import flint

    return flint.arb(value)


def test_rationals_know_what_steps_make_of_0() -> None:
    assert raw_at_origin(policy("skip", "identity", "output")) == (None,)  # elu of a negative bias
    clipped = raw_at_origin(policy("residual", "identity", "output"))[0]
    assert clipped is not None and float(clipped) == pytest.approx(
        policy("residual", "identity", "output").net(np.zeros(2))[0] * 6
    )
    late = raw_at_origin(policy("late", "identity", "output"))
    assert late == (None,)  # sqrt(1.01)


@pytest.mark.parametrize("name", slow_after(1, PROGRAMS))
def test_they_prove_loops_that_both_checkers_accept(name: str) -> None:
    result = certify_roa(PLANT, policy(name), effort=0.1, candidate="ellipsoid")
    assert result.verdict is Verdict.PROVED and result.volume is not None and result.volume > 30
    assert result.certificate is not None
    kept = read_certificate(result.certificate)
    assert kept.network.sha256() == policy(name).sha256() == result.network.sha256()
    assert [step.kind for step in kept.network.network.steps] == [step.kind for step in PROGRAMS[name]().steps]
    for which in ("certify.checker", "certify.reference"):
        assert _accepts(result.certificate, which)


def _accepts(path: Any, module: str) -> bool:
    import subprocess
    import sys

    done = subprocess.run([sys.executable, "-m", module, str(path)], capture_output=True, text=True, check=False)
    return done.returncode == 0 and "ACCEPTED" in done.stdout


@pytest.mark.slow
def test_a_practical_claim_of_an_observed_policy() -> None:
    law = replace(policy("observed"), centre="none", offset=np.array([0.05]))
    result = certify_roa(PLANT, law)
    assert result.verdict is Verdict.PROVED and result.network.is_moved
    assert result.certificate is not None and _accepts(result.certificate, "certify.reference")


def test_a_corner_at_rest_has_no_model() -> None:
    network = policy("residual").network
    first = replace(network.steps[0], bias=np.zeros(2))
    closed = loop("residual", network=replace(network, steps=(first, *network.steps[1:])))
    assert not paths(closed).models(1e-3 * np.eye(2)).finite


def test_no_program_is_proved_that_lets_go() -> None:
    away = policy("skip")
    steps = list(away.network.steps)
    steps[3] = replace(steps[3], weight=-steps[3].weight)
    broken = PolicyNetwork(replace(away.network, steps=tuple(steps)), away.scale, away.offset, "tanh", "preactivation")
    assert certify_roa(PLANT, broken, effort=0.1).verdict is not Verdict.PROVED


@pytest.mark.parametrize("name", PROGRAMS)
def test_what_reads_layers_alone_refuses_other_networks(name: str) -> None:
    """Else another policy would be judged: dReal's formulas, binary32, and whoever asks for weights."""
    law = policy(name)
    for read in ("weights", "biases", "activation"):
        with pytest.raises(InputError, match="needs a policy of layers"):
            getattr(law, read)
    problem = Problem(ClosedLoop(PLANT, law), Quadratic(np.eye(2)))
    for condition in conditions(Asymptotic(1.0, 0.1), problem):
        with pytest.raises(InputError):
            query(condition, problem)
    with pytest.raises(InputError, match="needs a policy of layers"):
        float_error(law, PLANT)
