"""Which agents of a collection of rl-baselines3-zoo are read without loss, as a table.

`python benchmarks/agents.py FOLDER --out agents.md` wants a copy of such a collection, `METHOD/ENV_1/ENV.zip` with
`METHOD/ENV_1/ENV/config.yml` and `vecnormalize.pkl`, as DLR-RM/rl-trained-agents has it. It takes every agent with
continuous actions. *Read* means three things: the importer names every tensor of `policy.pth`; the layers among its
steps have the file's numbers bit for bit; and normaliser, layers, squash and clip together give what torch computes
from the same tensors, at observations far within and far beyond the normaliser's clip. Torch's side follows
`config.yml` and the names of the tensors, and shares no code with the importer but the numbers of the normaliser.

No plant is needed, and nothing in a file is executed.
"""

from __future__ import annotations

import argparse
import io
import json
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from certify.errors import InputError
from certify.loop.policies.importers.comparing import apply
from certify.loop.policies.importers.normalisers import load_normaliser
from certify.loop.policies.importers.options import ImportOptions
from certify.loop.policies.importers.reading import Reading
from certify.loop.policies.importers.recognising import read_kind
from certify.loop.policies.importers.steps import Affine, Normalise
from certify.loop.policies.network import Array

METHODS = ("a2c", "ppo", "trpo", "ddpg", "td3", "sac", "tqc")
CONTINUOUS_ONLY = {"ddpg", "td3", "sac", "tqc"}
SAMPLES, ROUNDING = 2000, 1e-11
_ACTOR = re.compile(
    r"(mlp_extractor\.(shared_net|policy_net)\.\d+|actor\.(latent_pi|mu)\.\d+|actor\.mu|action_net(\.\d+)?)"
)
_COLUMNS = "| method | environment | network | between | actions | gSDE | normaliser | read | largest difference |"


@dataclass(frozen=True, slots=True)
class Agent:
    """A folder of the collection.

    Parameters
    ----------
    method, environment : by the names of the folders.
    file : the policy, which a copy may lack.
    said : `config.yml`, as text by its keys.
    normaliser : `vecnormalize.pkl`, if there is one.
    """

    method: str
    environment: str
    file: Path
    said: dict[str, str]
    normaliser: Path | None

    @property
    def continuous(self) -> bool:
        """True if its actions are a box; where the file is missing, if its method knows no others."""
        if not self.file.is_file():
            return self.method in CONTINUOUS_ONLY
        return "spaces.box.Box" in str(_data(self.file)["action_space"][":type:"])


@dataclass(frozen=True, slots=True)
class Row:
    """An agent's row: whether it is read, the largest difference, or why it is not."""

    agent: Agent
    read: bool
    cells: tuple[str, ...]


def agents(folder: Path, methods: tuple[str, ...]) -> list[Agent]:
    """The agents of these methods with continuous actions, one for each folder."""
    found = []
    for method in methods:
        for place in sorted((folder / method).glob("*")):
            name = place.name.rpartition("_")[0]
            beside = place / name
            if not (beside / "config.yml").is_file():
                continue
            said = dict(re.findall(r"- - (\w+)\n    - (.*)", (beside / "config.yml").read_text("utf-8")))
            pickle = beside / "vecnormalize.pkl"
            found.append(Agent(method, name, place / f"{name}.zip", said, pickle if pickle.is_file() else None))
    return [agent for agent in found if agent.continuous]


def row(agent: Agent) -> Row:
    """Read an agent and compare."""
    sde = "yes" if agent.said.get("use_sde") == "true" else ""
    if not agent.file.is_file():
        said = re.search(r"net_arch=\[[^\]]*\]", agent.said.get("policy_kwargs", ""))
        network = f"{said.group()} ({agent.said['policy']})" if said else agent.said["policy"]
        return Row(agent, False, (network, "", "", sde, "", "the copy lacks the file", ""))
    try:
        reading = read_kind("sb3", agent.file.read_bytes(), agent.file.name, ImportOptions(), 0, 0, None, None)
        difference, clip = compare(agent, reading)
    except InputError as error:
        return Row(agent, False, ("", "", "", sde, "", f"no: {error}".replace("|", "/"), ""))
    layers = [step for step in reading.steps if isinstance(step, Affine)]
    network = "-".join(str(v) for v in (reading.n, *(len(layer.bias) for layer in layers)))
    said_actions = reading.words.partition("actions ")[2]
    return Row(agent, True, (network, reading.assumed.split()[0], said_actions, sde, clip, "yes", f"{difference:.1e}"))


def compare(agent: Agent, reading: Reading) -> tuple[float, str]:
    """The largest difference from torch, and the normaliser in words.

    Raises
    ------
    InputError : a tensor is not named, a number differs, or the actions differ by more than rounding.
    """
    with zipfile.ZipFile(agent.file) as archive:
        raw = archive.read("policy.pth")
    state = torch.load(io.BytesIO(raw), weights_only=True, map_location="cpu")
    used = [name for name in state if _ACTOR.fullmatch(name.rpartition(".")[0])]
    if set(state) != {*used, *(name for name in reading.unread if "/" not in name)}:
        raise InputError(f"the tensors are {sorted(state)}; named are {sorted((*used, *reading.unread))}.")
    layers = [step for step in reading.steps if isinstance(step, Affine)]
    weights = [state[name].numpy() for name in used if name.endswith(".weight")]
    biases = [state[name].numpy() for name in used if name.endswith(".bias")]
    for stored, got in ((weights, [v.weight for v in layers]), (biases, [v.bias for v in layers][: len(biases)])):
        if len(stored) != len(got) or not all(np.array_equal(a, b) for a, b in zip(stored, got, strict=True)):
            raise InputError("the layers must have the numbers of the file, bit for bit.")

    normaliser = load_normaliser(agent.normaliser, None) if agent.normaliser else None
    rng = np.random.default_rng(0)
    x = rng.normal(size=(SAMPLES, reading.n)) * 10 ** rng.uniform(-2, 2, (SAMPLES, 1))
    seen: Array = x
    words = "none"
    if isinstance(normaliser, Normalise):
        mean = np.array([float(v) for v in normaliser.mean])
        divisor = np.sqrt(np.array([float(v) for v in normaliser.square]))
        if len(mean) != reading.n:
            raise InputError(f"the normaliser has {len(mean)} numbers, and the network reads {reading.n}.")
        limit = np.inf if normaliser.limit is None else float(normaliser.limit)
        x, words = mean + divisor * x, f"clip {limit:g}"
        seen = np.clip((x - mean) / divisor, -limit, limit)
    elif normaliser is not None:
        words = "of rewards"
    ours = apply((*([] if normaliser is None else [normaliser]), *reading.steps), x)
    theirs = plain(agent, state, used, seen)
    difference = float(np.max(np.abs(ours - theirs)))
    single = float(np.median(np.abs(reading.evaluate(seen.astype(np.float32), False) - theirs)))
    if not difference <= ROUNDING * (1 + np.max(np.abs(theirs))) or not single <= 1e-4:
        raise InputError(f"the actions differ from torch's by {difference:.3g}, the median in float32 by {single:.3g}.")
    return difference, words


def plain(agent: Agent, state: dict[str, torch.Tensor], used: list[str], seen: Array) -> Array:
    """The deterministic actions by `config.yml` and the tensors' names, in double precision."""
    squashed = used[0].startswith("actor.") or (agent.method == "ars" and agent.said["policy"] == "MlpPolicy")
    given = re.search(r"activation_fn=nn\.(\w+)", agent.said.get("policy_kwargs", ""))
    default = torch.nn.Tanh if agent.method in ("a2c", "ppo", "trpo") else torch.nn.ReLU
    phi = getattr(torch.nn, given.group(1))() if given else default()
    exploring = agent.said.get("use_sde") == "true"
    space = _data(agent.file)["action_space"]
    # The text rounds what is stored in single precision.
    low, high = (
        np.array([float(v) for v in re.findall(r"[-+.\de]+", space[key])], dtype=np.float32).astype(np.float64)
        for key in ("low", "high")
    )

    h = torch.tensor(seen, dtype=torch.float64)
    for k, name in enumerate(name for name in used if name.endswith(".weight")):
        bias = state.get(f"{name.removesuffix('weight')}bias")
        h = torch.nn.functional.linear(
            phi(h) if k else h, state[name].double(), None if bias is None else bias.double()
        )
    if not squashed:
        return np.asarray(np.clip(h.numpy(), low, high))
    h = torch.nn.functional.hardtanh(h, -2.0, 2.0) if exploring else h
    return np.asarray(low + 0.5 * (torch.tanh(h).numpy() + 1) * (high - low))


def table(rows: list[Row]) -> str:
    """The rows as Markdown, with the counts before them."""
    held = [row for row in rows if row.agent.file.is_file()]
    read = [row for row in held if row.read]
    lines = [
        f"{len(rows)} agents have continuous actions, and {len(held)} of their files are in this copy. "
        f"{len(read)} of these are read without loss, {len(read) / max(len(held), 1):.0%}.",
        "",
        "| method | agents | files | read |",
        "|---|---|---|---|",
    ]
    for method in dict.fromkeys(row.agent.method for row in rows):
        of = [row for row in rows if row.agent.method == method]
        files = sum(row.agent.file.is_file() for row in of)
        lines.append(f"| {method} | {len(of)} | {files} | {sum(row.read for row in of)} |")
    lines += ["", _COLUMNS, "|" + "---|" * (_COLUMNS.count("|") - 1)]
    lines += [f"| {row.agent.method} | {row.agent.environment} | {' | '.join(row.cells)} |" for row in rows]
    return "\n".join(lines) + "\n"


def _data(file: Path) -> dict[str, Any]:
    with zipfile.ZipFile(file) as archive:
        found: dict[str, Any] = json.loads(archive.read("data"))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a copy of the collection")
    parser.add_argument("--methods", default=",".join(METHODS), help="folders of the collection")
    parser.add_argument("--out", type=Path, help="write the table there")
    given = parser.parse_args()
    text = table([row(agent) for agent in agents(given.folder, tuple(given.methods.split(",")))])
    if given.out is not None:
        given.out.write_text(text, "utf-8")
    print(text, end="")


if __name__ == "__main__":
    main()
