"""The table of a collection of agents: what is read, what is not, and what a copy lacks."""

from __future__ import annotations

import runpy
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.loop.test_stable_baselines_files import rewritten, state_of, steep
from tests.support.foreign import ROOT, Several, sb3

SCRIPT: dict[str, Any] = runpy.run_path(str(ROOT / "benchmarks" / "agents.py"))
METHODS, agents, row, table = (SCRIPT[name] for name in ("METHODS", "agents", "row", "table"))
SMALL: dict[str, Any] = {"net_arch": [16, 8]}


def placed(folder: Path, method: str, name: str, model: Path | None, normaliser: Path | None, **said: str) -> Path:
    """An agent in the folders of rl-baselines3-zoo."""
    place = folder / method / f"{name}_1"
    (place / name).mkdir(parents=True)
    pairs = {"policy": "MlpPolicy", **said}.items()
    (place / name / "config.yml").write_text(
        "!!python/object/apply:collections.OrderedDict\n- " + "\n  ".join(f"- - {k}\n    - {v}" for k, v in pairs)
    )
    if model is not None:
        shutil.copy(model, place / f"{name}.zip")
    if normaliser is not None:
        shutil.copy(normaliser, place / name / "vecnormalize.pkl")
    return place / f"{name}.zip"


def test_agents_are_read_and_compared(tmp_path: Path) -> None:
    _, _, path, normaliser = sb3("PPO", tmp_path, activation_fn=torch.nn.ELU, **SMALL)
    placed(tmp_path, "ppo", "A-v1", path, normaliser, policy_kwargs="dict(activation_fn=nn.ELU)")
    model, _, path, normaliser = sb3("SAC", tmp_path, sde=True, **SMALL)
    steep(model, path)
    placed(tmp_path, "sac", "A-v1", path, None, use_sde="true")
    placed(tmp_path, "tqc", "A-v1", rewritten(path, policy="TQC"), normaliser, use_sde="true")
    placed(tmp_path, "td3", "B-v1", sb3("TD3", tmp_path, Several, **SMALL)[2], tmp_path / "normaliser.pkl")
    placed(tmp_path, "ddpg", "C-v1", None, None, policy_kwargs="dict(net_arch=[400, 300])")
    placed(tmp_path, "a2c", "D-v1", None, None)  # nobody knows whether its actions are continuous
    found = agents(tmp_path, METHODS)
    assert [(a.method, a.environment) for a in found] == [
        *(("ppo", "A-v1"), ("ddpg", "C-v1"), ("td3", "B-v1"), ("sac", "A-v1"), ("tqc", "A-v1"))
    ]
    rows = [row(agent) for agent in found]
    assert [each.read for each in rows] == [True, False, True, True, True]
    assert all(float(each.cells[-1]) < 1e-12 for each in rows if each.read)
    text = table(rows)
    assert text.startswith(
        "5 agents have continuous actions, and 4 of their files are in this copy. 4 of these are read"
    )
    assert "| ppo | A-v1 | 2-16-8-1 | elu | clipped |  | clip 10 | yes |" in text
    assert "| sac | A-v1 | 2-16-8-1 | relu | squashed by tanh, their means clipped to 2 before it | yes |" in text
    assert "| ddpg | C-v1 | net_arch=[400, 300] (MlpPolicy) |  |  |  |  | the copy lacks the file |  |" in text


@pytest.mark.parametrize("said", [{"policy_kwargs": "dict(activation_fn=nn.ReLU)"}, {"policy": "CnnPolicy"}])
def test_a_file_that_is_not_what_is_said_of_it_is_not_read(said: dict[str, str], tmp_path: Path) -> None:
    _, _, path, _ = sb3("PPO", tmp_path)
    if "policy" in said:
        rewritten(path, tensors=state_of(path) | {"scale": torch.ones(1)})
    placed(tmp_path, "ppo", "A-v1", path, None, **said)
    (only,) = (row(agent) for agent in agents(tmp_path, METHODS))
    assert not only.read
    assert ("could belong" if "policy" in said else "differ from torch's") in only.cells[-2]


def test_a_normaliser_of_another_size_is_said(tmp_path: Path) -> None:
    _, environment, path, normaliser = sb3("PPO", tmp_path)
    environment.obs_rms.mean, environment.obs_rms.var = np.zeros(3), np.ones(3)
    environment.save(str(normaliser))
    placed(tmp_path, "ppo", "A-v1", path, normaliser)
    (only,) = (row(agent) for agent in agents(tmp_path, METHODS))
    assert not only.read and "has 3 numbers, and the network reads 2" in only.cells[-2]
