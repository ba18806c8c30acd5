"""Policies of a run while it goes on, as they would ship: what a run's history is told from.

Checkpoints hold a run, to go on with it; what is asked of a history is what was there to prove at a step, and that is
the file that `controllers train` would have written then. Before there is a gain there is no such file.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from certify.errors import InputError
from certify.loop.policies import Policy, load_policy, save_policy
from controllers.files import make_folder, require_writable
from controllers.options import TrainingOptions

if TYPE_CHECKING:
    from controllers.training import Trainer


@dataclass(frozen=True, slots=True)
class Kept:
    """The policy after `step` steps of a run."""

    step: int
    policy: Policy

    def __post_init__(self) -> None:
        if self.step < 1:
            raise InputError(f"`step` must be at least 1; found {self.step}.")


class Keeper:
    """Writes the policy of a run to `NNNNNNN.pt`, the number of its steps, at each evaluation.

    Parameters
    ----------
    folder : made if it is not there.
    resumed : whether the run goes on from a checkpoint, so that its policies up to there are in the folder.

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
                "go on with that run by `--resume`."
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


def read_kept(folder: Path) -> list[Kept]:
    """The policies that a `Keeper` wrote, in the order of their steps, two or more.

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


def _read(path: Path) -> Kept:
    policy = load_policy(path)
    step = policy.training.get("steps_done")
    if not isinstance(step, int) or isinstance(step, bool):
        raise InputError(f"{path} must be a policy that `controllers train --keep` wrote; its record has no step.")
    return Kept(step, policy)


def _run(policy: Policy) -> dict[str, object]:
    """What all policies of a run have in common: the plant and the options, but not what was learned or measured."""
    options = {option.name: policy.training.get(option.name) for option in fields(TrainingOptions)}
    return {"system": policy.system, "parameters": dict(policy.parameters), **options}
