"""The command `controllers train-baseline`: arguments and printing, no mathematics.

`controllers.cli` registers it; what it shares with its own commands it takes from there when it is called.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, cast

import typer

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]
Plant = Annotated[str, typer.Argument(help="The plant, for instance pendulum.")]
Steps = Annotated[int | None, typer.Option("--steps", help="Environment steps of a run; default: the preset's.")]


def train_baseline(
    algorithm: Annotated[str, typer.Argument(help="ppo or sac, of stable-baselines3.")],
    plant: Plant,
    out: Annotated[Path, typer.Option("--out", help="The zip file to write.")],
    seed: Annotated[int, typer.Option(help="Seed of everything random.")] = 0,
    steps: Steps = None,
    as_json: Json = False,
) -> None:
    """Train PPO or SAC of stable-baselines3 on a plant, for comparison."""
    from controllers import cli

    with cli._errors(as_json):
        options = _options(plant, seed, steps)
        from certify.systems import get_system
        from controllers.baselines import Algorithm, train_reference

        cli._require_writable(out)
        system = get_system(plant)
        made = train_reference(cast(Algorithm, algorithm), system, options, out)
        result = {"baseline": str(out), "algorithm": algorithm, "system": plant, "steps": made, "seed": seed}
        cli._emit(result, as_json)


def _options(plant: str, seed: int, steps: int | None) -> Any:
    from controllers.options import preset

    options = replace(preset(plant), seed=seed)
    return options if steps is None else replace(options, steps=steps)
