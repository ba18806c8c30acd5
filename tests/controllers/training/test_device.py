"""The device of a run: everything lives there, and the run on the CPU is the one that it always was."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from certify.loop.plants import get_system
from controllers.cli import app
from controllers.options import preset
from controllers.training.device import CPU
from controllers.training.interface import Interface
from controllers.training.replay import Replay
from controllers.training.sac import SAC
from controllers.training.trainer import Trainer, train

META = torch.device("meta")
SHORT = {"steps": 300, "warm_up": 100, "n_A": 60, "n_B": 60, "batch": 16, "critic": (16, 16)}


def _run(device=CPU, **changes):
    trainer = Trainer(get_system("pendulum"), replace(preset("pendulum"), **{**SHORT, **changes}), device)
    return trainer, train(trainer)


@pytest.fixture(scope="module")
def whole():
    return _run(curvature_weight=0.1, rest_weight=0.1)


def test_a_run_creates_every_tensor_on_its_own_device(whole):
    # Whatever is created without a device is now on `meta`, has no numbers and mixes with no tensor that has.
    with META:
        trainer, policy = _run(curvature_weight=0.1, rest_weight=0.1)
        checkpoint = trainer.snapshot()
        trainer.restore(checkpoint)
    assert policy.network.sha256() == whole[1].network.sha256()
    assert checkpoint == whole[0].snapshot()


def test_a_learner_on_another_device_leaves_nothing_behind(monkeypatch):
    # The other way round: `meta` stands for the accelerator, and a tensor left on the CPU does not mix with it.
    monkeypatch.setattr(torch.optim, "Adam", lambda weights, rate, fused: _Adam(weights, rate))
    options = replace(preset("pendulum"), **SHORT, curvature_weight=0.1, rest_weight=0.1)
    generator = torch.Generator().manual_seed(0)
    sac = SAC(Interface(get_system("pendulum")), options, generator, META)
    replay = Replay(10, 2, 1, META)
    replay.add(np.zeros(2), np.zeros(1), 1.0, np.ones(2), False)
    batch = replay.sample(16, generator)
    before = generator.get_state()
    sac.update(batch, torch.zeros(1, 2, device=META), 1.0)
    assert not torch.equal(before, generator.get_state())
    moments = [part for state in sac.actor_optimiser.state.values() for name, part in state.items() if name != "step"]
    assert moments
    for tensor in (*sac.actor.parameters(), *sac.actor.buffers(), *sac.q.parameters(), *batch, *moments):
        assert tensor.device == META


_Adam = partial(torch.optim.Adam, fused=False)  # the fused kernels exist for real devices only


def test_the_random_stream_and_the_weights_are_those_before_there_was_a_device():
    # Made at the commit before: the generators' states are integers and must agree; weights may round otherwise.
    trainer, _ = _run(critic_scale=1.0)
    states = (
        trainer.generator.get_state().numpy().tobytes()
        + json.dumps(trainer.environment.np_random.bit_generator.state, sort_keys=True).encode()
    )
    assert hashlib.sha256(states).hexdigest() == STREAM
    found = [float(part.double().square().sum()) for part in trainer.sac.actor.state_dict().values()]
    np.testing.assert_allclose(found, WEIGHTS, rtol=1e-5)


STREAM = "94b98728ed670c604cca102335b55633ec487666bc01e1e2453b0c5fbb916bf8"
WEIGHTS = [
    36.0,
    0.0,
    0.0,
    0.06640625,
    0.0,
    5.14428125,
    3.03805852,
    5.16821129,
    0.184912431,
    0.420708237,
    0.0353047886,
    0.408676237,
    0.00858804395,
]


def test_a_device_that_is_not_there_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for device, message in (("cuda", "finds no CUDA device"), ("abacus", "must be cpu or cuda; found 'abacus'")):
        result = CliRunner().invoke(app, ["train", "pendulum", "--out", str(tmp_path / "p.pt"), "--device", device])
        assert result.exit_code == 2
        assert message in result.stderr and "Traceback" not in result.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_run_on_cuda_goes_on_on_the_cpu(whole):
    trainer, policy = _run(torch.device("cuda"), curvature_weight=0.1, rest_weight=0.1)
    assert policy.training["device"] == "cuda"
    np.testing.assert_allclose(policy.training["K"], whole[1].training["K"], rtol=1e-3)
    other = Trainer(trainer.system, trainer.options)
    other.restore(trainer.snapshot())
    assert other.policy().network.sha256() == policy.network.sha256()
