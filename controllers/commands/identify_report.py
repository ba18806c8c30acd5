"""`controllers train --identify-report`: ranges of the learned A, B and K that the run's own transitions guarantee."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from inspect import Parameter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from certify.analysis.arguments import bound_or_bounds, linear_from
from certify.certificates import write_atomically
from certify.cli.options import parameter
from certify.errors import InputError, OptionError

if TYPE_CHECKING:
    from controllers.identification.report import Declared
    from controllers.training.trainer import Trainer

_SHOWN: dict[str, Any] = {"rich_help_panel": "Guaranteed ranges of A, B and K"}
OPTIONS: Mapping[str, Parameter] = {
    one.name: one
    for one in (
        parameter(
            "identify_report",
            "--identify-report",
            "File for ranges of A, B and K that the transitions guarantee; needs --noise.",
            Path,
            metavar="FILE.json",
            **_SHOWN,
        ),
        parameter(
            "second",
            "--second",
            "Bound of what a state's next value has beyond A x + B (u - u_eq), in deviations, as in "
            "theta_dot='0.2*theta**2'; repeatable. Without one it is linear.",
            list[str],
            metavar="NAME=BOUND",
            **_SHOWN,
        ),
        parameter(
            "noise",
            "--noise",
            "Bound of each state's error, of rounding too: one, or NAME=E,NAME=E, in its units.",
            metavar="E",
            **_SHOWN,
        ),
    )
}


@dataclass(frozen=True, slots=True)
class Reported:
    """The file of a report, and what it assumes."""

    path: Path
    declared: Declared

    def written(self, trainer: Trainer, as_json: bool) -> dict[str, Any]:
        """Write the report of a run; its entry in what the command prints."""
        import numpy as np

        from controllers.identification.report import identify_report
        from controllers.training.black_box import BlackBoxEnvironment

        learned, options, environment = trainer.gain.identified, trainer.options, trainer.environment
        if learned is None:
            raise OptionError("`identify_report` needs a run that identifies A and B.")
        rows, u_eq = trainer.gain.transitions_used(), trainer.interface.u_eq
        if isinstance(environment, BlackBoxEnvironment):
            rows = [(x, np.asarray(environment.acting(u_eq + v) - u_eq, dtype=np.float64), y) for x, v, y in rows]
        weights = np.diag(options.state_weights), np.diag(options.input_weights)
        try:
            report = identify_report(learned, rows, trainer.system, weights, self.declared)
        except InputError as error:  # a finding: the policy is trained all the same
            return {"identified": {"refuted": str(error)} if as_json else f"no ranges: {error}"}
        write_atomically(self.path, (json.dumps(report.to_dict(), indent=1) + "\n").encode())
        shown = report.to_dict() if as_json else "\n  ".join([str(self.path), *report.lines()])
        return {"identified": shown}


def report_of(given: Mapping[str, Any]) -> Reported | None:
    """The report that somebody asked for by the options that were given, or None.

    Raises
    ------
    InputError : one of the options needs another.
    """
    from controllers.identification.report import Declared

    path, noise, second = given["identify_report"], given["noise"], given["second"]
    if path is None:
        odd = next((name for name in ("second", "noise") if given[name]), None)
        if odd is not None:
            raise OptionError(f"`{odd}` is for the report of `identify_report`.")
        return None
    if noise is None:
        raise OptionError(
            "`identify_report` needs `noise`, a bound of each state's error; it has to cover rounding too."
        )
    linear = linear_from({"second": second})
    return Reported(path, Declared({} if linear is None else linear.second, bound_or_bounds(noise, "noise")))
