"""Options of an environment of Gymnasium, whose transitions are written into a file that commands then read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from certify.cli.options import Bundle, parameter
from certify.errors import InputError

if TYPE_CHECKING:
    from certify.analysis.inputs import Tell
    from certify.loop.plants import System


def of_environment() -> Bundle:
    """The options of an environment; the command receives those that are given, by name."""
    shown: dict[str, Any] = {"rich_help_panel": "An environment"}
    options = (
        parameter(
            "env",
            "--env",
            "Environment of Gymnasium, or FILE.py:NAME, to take the data from; they are written beside the plant.",
            metavar="ID",
            **shown,
        ),
        parameter("episodes", "--episodes", "Episodes. [default: 10]", int, min=1, **shown),
        parameter(
            "policy", "--policy", "Policy that acts; by default actions are random.", Path, metavar="FILE", **shown
        ),
        parameter(
            "observed",
            "--observed",
            "What the environment shows, by states: 'cos(theta),sin(theta),theta_dot'. By default the states.",
            metavar="LIST",
            **shown,
        ),
        parameter("seed", "--seed", "Seed of episodes and actions. [default: 0]", int, **shown),
    )
    return Bundle({one.name: one for one in options}, dict)


def recorded(
    data: Path | None, environment: Mapping[str, Any], plant: Callable[[], System], path: Path, note: Tell
) -> Path:
    """The file of measurements: the one that is given, or `path` with those of an environment, written first.

    Raises
    ------
    InputError : both are given, or neither, or the environment shows other numbers than the plant's states.
    """
    if (data is None) is ("env" not in environment):
        raise InputError("name a file of data, or an environment with --env; one of the two.")
    if data is not None:
        if environment:
            raise InputError(f"--{next(iter(environment))} must be left out: it is for an environment, with --env.")
        return data
    from certify.analysis.identifying.environments import Black, record

    found = {"episodes": 10} | dict(environment)
    black = Black(found.pop("env"), **found)
    system = plant()
    path.parent.mkdir(parents=True, exist_ok=True)
    record(black, system, path)
    note(f"data     {path}, from {black.episodes} episodes of {black.name}")
    return path
