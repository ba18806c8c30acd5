"""Flattening that keeps curvature: the forecast in torch beside that of the proof's candidate, and what is trained."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from certify.analysis.candidates.economical import Forecast
from certify.errors import OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import get_system
from certify.loop.policies import Policy, PolicyNetwork
from certify.loop.policies.nonlinearity import nonlinearity
from certify.lyapunov import domain_limit, volume
from certify.provers.bounds import policy_enclosure
from controllers.flattening import keeping
from controllers.flattening.contraction import contracted
from controllers.flattening.flattening import flatten
from controllers.flattening.options import FlattenOptions
from controllers.flattening.provable import ProvableSet
from controllers.flattening.student import Student
from tests.controllers.flattening.test_flattening import curved
from tests.controllers.flattening.test_other_units import _curved, _skipping

PENDULUM = get_system("pendulum")
ORIGIN = PENDULUM.exact_u_eq()
QUICK = FlattenOptions(curvature="kept", steps=80, states=20, volume=20.0)


def _student(network: PolicyNetwork) -> Student:
    folded = network.folded(ORIGIN)
    return Student(network, np.asarray(folded.net(np.zeros(2))), folded, trains_biases=True)


@pytest.mark.parametrize("network", [curved(), _curved("silu"), _curved("elu"), _skipping()], ids=lambda n: n.words)
def test_errors_on_boxes_are_those_of_the_proofs_bounds(network):
    """Small boxes, so that what bounds add of higher order, and what a smooth form leaves out, are small too."""
    generator, side = np.random.default_rng(0), 0.02
    x = generator.uniform(-1, 1, (50, 2))
    u, errors = _student(network).on_boxes(torch.tensor(x).float(), side * torch.eye(2).expand(50, 2, 2))
    boxes = np.concatenate([x.T[:, None], np.repeat(side * np.eye(2)[:, :, None], 50, axis=2)], 1)
    wide = policy_enclosure(ClosedLoop(PENDULUM, network))(boxes, np.zeros((2, 50)))[2]
    np.testing.assert_allclose(u.detach().numpy(), network(x, ORIGIN), atol=1e-4)
    ratio = errors.detach().numpy().sum() / wide.sum()
    assert 0.6 < ratio < 1.1


def test_boxes_are_those_that_the_candidate_forecasts():
    loop = ClosedLoop(PENDULUM, curved())
    found = ProvableSet(loop, 2.0, 0.1)
    assert volume(found.P(), 1.0) == pytest.approx(2.0, rel=1e-5)
    size, short = found.log_boxes(_student(curved()), torch.Generator().manual_seed(0), 2000)
    assert short.item() == 0.0
    assert np.exp(size.item()) == pytest.approx(Forecast(loop, states=2000).boxes(found.P(), 1.0), rel=0.3)


def test_less_curvature_takes_fewer_boxes_and_a_set_beyond_the_domain_is_told():
    found = ProvableSet(ClosedLoop(PENDULUM, curved()), 20.0, 0.25)
    sizes = [
        found.log_boxes(_student(contracted(curved(), f)), torch.Generator().manual_seed(0), 500)[0].item()
        for f in (1.0, 0.5, 0.25)
    ]
    assert sizes[0] > sizes[1] > sizes[2]
    inside = ProvableSet(ClosedLoop(PENDULUM, curved()), 1.0, 0.25)
    assert inside.outside().item() == 0.0 and domain_limit(inside.P(), PENDULUM.domain) > 1
    beyond = ProvableSet(ClosedLoop(PENDULUM, curved()), 1000.0, 0.25)
    assert beyond.outside().item() > 0.0 and domain_limit(beyond.P(), PENDULUM.domain) < 1


@pytest.fixture(scope="module")
def result():
    return flatten(Policy(curved(), "pendulum"), QUICK)


@pytest.mark.slow
def test_it_costs_no_more_and_takes_fewer_boxes(result):
    before = ProvableSet(ClosedLoop(PENDULUM, curved()), 20.0, 0.25)
    size, _ = before.log_boxes(_student(curved()), torch.Generator().manual_seed(0), 500)
    assert result.after.settled == result.before.settled == 20 and result.after.cost <= result.before.cost
    assert result.boxes < 0.5 * np.exp(size.item())
    assert result.steps == QUICK.steps // 4 and result.gain_change < 0.1
    record = result.policy.training["flattened"]
    P = np.array(record["P"])
    assert volume(P, 1.0) == pytest.approx(20.0, rel=1e-5) and record["boxes"] == result.boxes
    assert record["curvature"] == "kept" and result.volume == record["volume"] == 20.0
    assert result.as_json()["forecast"] == {"volume": 20.0, "boxes": result.boxes}


def test_a_distance_goes_with_curvature_that_is_kept():
    with pytest.raises(OptionError, match='`distance` must be left out unless `curvature` is "kept"'):
        FlattenOptions(distance=0.1)
    assert FlattenOptions(curvature="kept", distance=0.1).distance == 0.1


def test_the_distance_in_training_is_that_which_is_reported():
    x = np.random.default_rng(0).uniform(-1, 1, (500, 2))
    found = _student(curved()).distance(torch.tensor(x).float()).item()
    assert found == pytest.approx(nonlinearity(curved(), ORIGIN, x).rms, rel=1e-4)


@pytest.mark.slow
def test_equal_options_give_equal_policies(result):
    assert flatten(Policy(curved(), "pendulum"), QUICK).policy.network.sha256() == result.policy.network.sha256()


def test_the_set_is_by_default_that_of_twice_the_box():
    assert keeping.volume_of(FlattenOptions(), np.array([0.5, 2.0])) == pytest.approx(4 * np.pi)
    with pytest.raises(OptionError, match='`volume` must be left out unless `curvature` is "kept"'):
        FlattenOptions(volume=1.0)


def test_a_policy_that_nothing_centres_is_refused():
    *others, last = curved("none").biases
    beside = curved("none").with_layers(biases=(*others, last - 0.01))
    with pytest.raises(OptionError, match="`curvature` kept needs a plant in continuous time"):
        flatten(Policy(beside, "pendulum"), replace(QUICK, max_cost_change=1.0))
