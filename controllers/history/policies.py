"""Policies of a run on the way, as they would ship.

A checkpoint holds a run, to resume it; a history is told from the policy files that `controllers train` would have
written at each evaluation. Before there is a gain there is no such file.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from certify.errors import InputError
from certify.loop.policies import Policy, load_policy, save_policy
from controllers.options import TrainingOptions
from controllers.storage import make_folder, require_writable

if TYPE_CHECKING:
    from controllers.training.trainer import Trainer


@dataclass(frozen=True, slots=True)
class RunPolicy:
    """The policy after `step` steps of a run."""

    step: int
    policy: Policy

    def __post_init__(self) -> None:
        if self.step < 1:
            raise InputError(f"`step` must be at least 1; found {self.step}.")


class PolicyWriter:
    """Writes the policy of a run to `NNNNNNN.pt`, the number of its steps, at each evaluation.

    Parameters
    ----------
    folder : made if it is not there.
    resumed : True for a run that is resumed from a checkpoint: its policies up to there are in the folder.

    Raises
    ------
    InputError : the folder cannot be written, or a new run would mix its policies with those that are there.
    """

    def __init__(self, folder: Path, resumed: bool) -> None:
        make_folder(folder)
        require_writable(folder / "0000000.pt")
        there = _files(folder)
        if there and not resumed:
            raise InputError(
                f"{folder} must hold no policy of another run; found {there[0].name}. Choose another folder, or "
                "resume that run with `--resume`."
            )
        self._folder = folder

    def __call__(self, trainer: Trainer) -> None:
        """Keep the policy if this step has been evaluated and there is one to ship."""
        evaluated = trainer.monitored and trainer.monitored[-1].step == trainer.steps_done
        if not evaluated or not trainer.ships:
            return
        policy, step = trainer.policy(), trainer.steps_done
        # `steps` of the record is what the run was to make, on which its annealing depends.
        save_policy(self._folder / f"{step:07d}.pt", replace(policy, training={**policy.training, "steps_done": step}))


def read_policies(folder: Path) -> list[RunPolicy]:
    """The policies that a `PolicyWriter` wrote, in the order of their steps, two or more.

    Raises
    ------
    InputError : there are none or only one, a file is no such policy, or they are of several runs.
    """
    found = [_read(path) for path in _files(folder)]
    if len(found) < 2:
        raise InputError(
            f"{folder} must hold two policies or more that `controllers train --keep` wrote; found {len(found)}."
        )
    first = _run(found[0].policy)
    for kept in found:
        theirs = _run(kept.policy)
        if theirs != first:
            name = next(name for name in (*first, *theirs) if first.get(name) != theirs.get(name))
            raise InputError(
                f"{folder} must hold policies of one run; `{name}` is {first.get(name)} after {found[0].step} steps "
                f"and {theirs.get(name)} after {kept.step}."
            )
    return sorted(found, key=lambda kept: kept.step)


def _files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.pt"))


def _read(path: Path) -> RunPolicy:
    policy = load_policy(path)
    step = policy.training.get("steps_done")
    if not isinstance(step, int) or isinstance(step, bool):
        raise InputError(f"{path} must be a policy that `controllers train --keep` wrote; its record has no step.")
    return RunPolicy(step, policy)


def _run(policy: Policy) -> dict[str, object]:
    """The plant and the options, which all policies of a run have in common."""
    options = {option.name: policy.training.get(option.name) for option in fields(TrainingOptions)}
    return {"system": policy.system, "parameters": dict(policy.parameters), **options}
