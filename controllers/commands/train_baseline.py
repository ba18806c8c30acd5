"""`controllers train-baseline`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast

import typer

from controllers.commands.shared import Json, PlantName, Steps, emit, errors, options_of
from controllers.files import require_writable


def train_baseline(
    algorithm: Annotated[str, typer.Argument(help="ppo or sac, of stable-baselines3.")],
    plant: PlantName,
    out: Annotated[Path, typer.Option("--out", help="The zip file to write.")],
    seed: Annotated[int, typer.Option(help="Seed of everything random.")] = 0,
    steps: Steps = None,
    as_json: Json = False,
) -> None:
    """Train PPO or SAC of stable-baselines3 on a plant, for comparison."""
    with errors(as_json):
        options = options_of(plant, seed=seed, steps=steps)
        from certify.loop.plants import get_system
        from controllers.sb3 import Algorithm, train_reference

        require_writable(out)
        system = get_system(plant)
        made = train_reference(cast(Algorithm, algorithm), system, options, out)
        result = {"baseline": str(out), "algorithm": algorithm, "system": plant, "steps": made, "seed": seed}
        emit(result, as_json)
