"""The ways to act that are compared: kinds of trained runs, by their mean action or by samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from certify.errors import OptionError

Run = Literal["ours", "sac", "before", "uncentred", "sb3-sac", "sb3-ppo"]


NAMES: dict[Run, str] = {
    "ours": "ours",
    "sac": "SAC without gain",
    "before": "identified before",
    "uncentred": "not centred",
    "sb3-sac": "SB3 SAC",
    "sb3-ppo": "SB3 PPO",
}
"""Names of the kinds of trained runs, for people."""


@dataclass(frozen=True, slots=True)
class Method:
    """A way to act: a kind of run, by its mean action or by a sampled one."""

    run: Run
    sampled: bool

    @property
    def name(self) -> str:
        """The name in the table: `ours`, `sac mean`, `sac stochastic`, ..."""
        return self.run if self.run == "ours" else f"{self.run} {'stochastic' if self.sampled else 'mean'}"

    @property
    def label(self) -> str:
        """The name for people."""
        return NAMES[self.run] + ("" if self.run == "ours" else ", stochastic" if self.sampled else ", mean")


OURS = Method("ours", False)


_OTHERS: tuple[Run, ...] = ("sac", "sb3-sac", "sb3-ppo")


BASELINES: tuple[Method, ...] = (OURS, *(Method(run, sampled) for run in _OTHERS for sampled in (False, True)))
"""Ours beside the same SAC without the gain and beside stable-baselines3."""


ABLATIONS: tuple[Method, ...] = (OURS, *(Method(run, False) for run in ("sac", "before", "uncentred")))
"""Ours with one part changed: no gain; A and B learned once before training; the mean not centred."""


def remaining(methods: Sequence[Method], without: Sequence[str]) -> tuple[Method, ...]:
    """`methods` less those of the kinds of runs in `without`.

    Raises
    ------
    InputError : a name is of none of them, or ours.
    """
    kinds = {method.run for method in methods} - {"ours"}
    for name in without:
        if name not in kinds:
            raise OptionError(f"`without` must be one of {', '.join(sorted(kinds))}; found {name!r}.")
    return tuple(method for method in methods if method.run not in without)
