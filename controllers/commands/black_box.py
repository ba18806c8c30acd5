"""`controllers train --env`: the options of an environment without equations, its run and its data."""

from __future__ import annotations

from collections.abc import Mapping
from inspect import Parameter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from certify.analysis.arguments import state
from certify.cli.options import parameter
from certify.errors import OptionError

if TYPE_CHECKING:
    from controllers.plants.black_box import BlackBox
    from controllers.training.trainer import Trainer

_SHOWN: dict[str, Any] = {"rich_help_panel": "An environment, without equations"}
OPTIONS: Mapping[str, Parameter] = {
    one.name: one
    for one in (
        parameter(
            "env", "--env", "Environment of Gymnasium in place of PLANT, or FILE.py:NAME.", metavar="ID", **_SHOWN
        ),
        parameter(
            "observed",
            "--observed",
            "What it shows, by states: 'cos(theta),sin(theta),theta_dot'. By default the states x1, x2, ...",
            metavar="LIST",
            **_SHOWN,
        ),
        parameter("inputs", "--inputs", "Names of its actions. By default u, or u1, u2, ...", metavar="LIST", **_SHOWN),
        parameter(
            "domain",
            "--domain",
            "Half-widths of the domain, NAME=D,NAME=D. By default the bounds of what it shows, of an angle 3.14.",
            metavar="LIST",
            **_SHOWN,
        ),
        parameter("rest", "--rest", "State at which it rests, NAME=V,NAME=V. [default: 0]", metavar="LIST", **_SHOWN),
        parameter("rest_input", "--rest-input", "Input there. [default: 0]", metavar="LIST", **_SHOWN),
        parameter(
            "write_data",
            "--write-data",
            "File for the transitions that A and B were fitted to, which `certify identify` reads.",
            Path,
            metavar="FILE.csv",
            **_SHOWN,
        ),
    )
}


def named_environment(given: Mapping[str, Any], dt: float | None) -> BlackBox:
    """The environment that somebody named, by the options that were given."""
    from controllers.plants.black_box import Told, black_box

    numbers = {
        name: {} if given[name] is None else state(given[name], name) for name in ("domain", "rest", "rest_input")
    }
    return black_box(Told(name=given["env"], observed=given["observed"], inputs=given["inputs"], dt=dt, **numbers))


def refuse(options: Mapping[str, Any], why: str) -> None:
    """Refuse options that were given, which are not for what is trained."""
    odd = next((name for name, value in options.items() if value), None)
    if odd is not None:
        raise OptionError(f"`{odd}` {why}.")


def write_data(path: Path, trainer: Trainer, box: BlackBox) -> int:
    """Write the transitions that A and B were fitted to, as the states' and inputs' own values; return their number."""
    import numpy as np

    from certify.analysis.identifying.environments import write_transitions
    from controllers.training.black_box import BlackBoxEnvironment

    environment, system = trainer.environment, box.system
    if not isinstance(environment, BlackBoxEnvironment):
        raise OptionError("`write_data` is for an environment, with `env`.")
    x_eq = np.array([float(q) for q in system.exact_x_eq()])
    rows = [
        [*(x_eq + x), *environment.acting(trainer.interface.u_eq + v), *(x_eq + x_next)]
        for x, v, x_next in trainer.gain.transitions_used()
    ]
    write_transitions(path, [s.name for s in system.states], [u.name for u in system.inputs], rows)
    return len(rows)
