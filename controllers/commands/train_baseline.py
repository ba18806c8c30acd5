"""`controllers train-baseline`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast

import typer

from controllers.commands.shared import Json, PlantName, Steps, emit, errors, preset_options
from controllers.storage import require_writable, set_aside


def train_baseline(
    context: typer.Context,
    algorithm: Annotated[str, typer.Argument(help="ppo or sac, of stable-baselines3.")],
    plant: PlantName,
    out: Annotated[Path, typer.Option("--out", help="The zip file to write.")],
    seed: Annotated[int, typer.Option(help="Seed of everything random.")] = 0,
    steps: Steps = None,
    as_json: Json = False,
) -> None:
    """Train PPO or SAC of stable-baselines3 on a plant, for comparison."""
    with errors(context, as_json):
        options = preset_options(plant, seed=seed, steps=steps)
        from certify.loop.plants import get_system
        from controllers.comparison.stable_baselines.file import train_sb3
        from controllers.comparison.stable_baselines.model import Algorithm

        require_writable(out)
        system = get_system(plant)
        set_aside(out)
        made = train_sb3(cast(Algorithm, algorithm), system, options, out)
        result = {"baseline": str(out), "algorithm": algorithm, "system": plant, "steps": made, "seed": seed}
        emit(result, as_json)
