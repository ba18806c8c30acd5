"""The trained runs of a comparison: read from a folder of runs, trained if they are missing.

Ours and its ablations make the steps of the preset. A baseline learns until its evaluation stops improving, by the
rules of `RULES`, unless one number of steps is asked for all: a baseline that was stopped early proves nothing.

A run that is there is used if it was made with the options that are asked for, and a run that was cut off is resumed
from its checkpoint, in one process at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.policies import load_policy
from controllers.comparison.finished_run import FinishedRun, read_finished_run
from controllers.comparison.learners import run_options, train_run, variant
from controllers.comparison.methods import Run
from controllers.comparison.options import CompareOptions
from controllers.comparison.run_files import CHECKPOINT, ENDED, POLICY, POLICY_FILES, run_folder
from controllers.comparison.stable_baselines.file import read_sb3
from controllers.comparison.stable_baselines.model import ROLLOUT, budget
from controllers.comparison.stopping import Fixed, Plan, Stopping
from controllers.comparison.trained import Trained, from_checkpoint, from_policy, require_plant
from controllers.options import TrainingOptions, default_record
from controllers.storage import read

RULES: dict[Run, Stopping] = {
    "sac": Stopping(budget=150_000, every=5_000),
    "sb3-sac": Stopping(budget=150_000, every=5_000),
    "sb3-ppo": Stopping(budget=500_000, every=10 * ROLLOUT, patience=10),
}
"""The rule by which a baseline has reached its floor."""


_NO_MATTER = frozenset({"steps", "seed"})  # options in which a record may differ: both are asked for elsewhere


_GAIN = frozenset(
    {
        *("identification", "eta", "n_A", "n_B", "refresh", "identification_starts", "transitions", "terms_A"),
        *("gain_weight", "gain_norm", "centre"),
    }
)


_OUR_LEARNER = frozenset(
    {
        *("reward_scale", "critic_scale", "log_std", "anneal"),
        *("curvature_weight", "rest_weight", "proof_weight", "proof_box"),
    }
)


_UNUSED: dict[Run, frozenset[str]] = {"sac": _GAIN, "sb3-sac": _GAIN | _OUR_LEARNER, "sb3-ppo": _GAIN | _OUR_LEARNER}
"""Options that change nothing in a run of this kind."""


_EVERY = 5_000  # steps between evaluations of a run of a fixed number of steps


@dataclass(frozen=True, slots=True)
class RunProgress:
    """The progress of a comparison.

    Parameters
    ----------
    what : the run in words.
    run, runs : its number, from 1 on, and how many there are.
    done, steps : of its training; equal once it is trained.
    """

    what: str
    run: int
    runs: int
    done: int
    steps: int


@dataclass(frozen=True, slots=True)
class WantedRun:
    """A run that a comparison needs: its kind, the options with its seed, and when it ends."""

    run: Run
    training: TrainingOptions
    plan: Plan


@dataclass(frozen=True, slots=True)
class ObtainedRun:
    """A run that is over, and its policy."""

    trained: Trained
    finished: FinishedRun


def obtain(
    run: Run,
    system: System,
    training: TrainingOptions,
    runs: Path,
    plan: Plan | None = None,
    say: Callable[[str], None] = lambda line: None,
    tell: Callable[[int, int], None] = lambda done, steps: None,
) -> ObtainedRun:
    """The run of `training.seed` from its folder in `runs`, trained first, or to its end, if it is not over.

    Parameters
    ----------
    plan : when it ends; None for the steps of `training`.

    Raises
    ------
    InputError : what is there is of another plant, seed, plan or other options, or damaged, or the folder cannot be
        written, or another process is at work in it.
    """
    plan = plan or fixed(run, training)
    folder = run_folder(runs, run, training)
    found = read_run(run, folder, system, training, plan)
    if found is None:
        most = plan.steps if isinstance(plan, Fixed) else plan.budget
        train_run(run, system, training, folder, plan, _progress(f"{run} seed {training.seed}", most, say, tell))
        found = read_run(run, folder, system, training, plan)
    if found is None:
        raise InputError(f"{folder} must hold a run that is over; it does not.")
    return found


def fixed(run: Run, training: TrainingOptions) -> Fixed:
    """The plan of a run with the steps of `training`, of which PPO makes as many whole rollouts as fit."""
    return Fixed(steps=budget("ppo" if run == "sb3-ppo" else "sac", training.steps)[0], every=_EVERY)


def plan_of(run: Run, training: TrainingOptions, options: CompareOptions) -> Plan:
    """The plan of a run of this comparison."""
    if not options.to_floor or run not in RULES:
        return fixed(run, training)
    chosen = {"budget": options.budget, "patience": options.patience}
    return replace(RULES[run], **{name: value for name, value in chosen.items() if value is not None})


def read_run(run: Run, folder: Path, system: System, training: TrainingOptions, plan: Plan) -> ObtainedRun | None:
    """The run in the folder, if it is over.

    Raises
    ------
    InputError : it is another one, or the folder holds a policy and nothing that says where it is from.
    """
    finished, path = read_finished_run(folder, plan), folder / POLICY_FILES[run]
    if finished is None:
        if path.is_file() and not (folder / CHECKPOINT).is_file():
            raise InputError(
                f"{path} would be written over: {folder} holds neither {ENDED} nor {CHECKPOINT} of a run. Move it "
                "away, or compare in another folder of runs."
            )
        return None
    trained = _load(run, path, system, training)
    if (trained.steps, trained.seed) != (finished.kept, training.seed):
        raise InputError(
            f"{path} must be of a run with seed {training.seed} after {finished.kept} steps; it is of {trained.steps} "
            f"steps with seed {trained.seed}. Compare in another folder of runs."
        )
    _require_asked(run, folder / POLICY, system, training, plan)
    return ObtainedRun(trained, finished)


def _require_asked(run: Run, path: Path, system: System, training: TrainingOptions, plan: Plan) -> None:
    """Refuse a run by the record of its policy file: one that a changed preset or plant would have led elsewhere.

    Raises
    ------
    InputError : its plant has other parameters, or an option that matters to this kind of run was another one.
    """
    policy = load_policy(path)
    require_plant(str(path), policy.system, policy.parameters, system)
    asked = run_options(run, training, plan).full_record()
    used = {**default_record(), **policy.training}  # a run had no options that came later
    for name in sorted(asked.keys() - _NO_MATTER - _UNUSED.get(run, frozenset())):
        if used.get(name) != asked[name]:
            raise InputError(
                f"{path} must be of a run with the options that are asked for; its `{name}` was {used.get(name)}, and "
                f"{asked[name]} is asked for. Compare in another folder of runs, or move {path.parent} away and it is "
                "trained again."
            )


def _load(run: Run, path: Path, system: System, training: TrainingOptions) -> Trained:
    if run in ("ours", "before", "uncentred"):
        policy = load_policy(path)
        for name in ("identification", "centre"):  # the options that tell these runs apart
            asked, found = getattr(variant(run, training), name), policy.training.get(name)
            if found != asked:
                raise InputError(f"{path}: `{name}` must be {asked!r} for the run {run}; it is {found!r}.")
        return from_policy(policy, system)
    content = read(path)
    return from_checkpoint(content, system) if run == "sac" else read_sb3(content, system, training)


def _progress(
    what: str, steps: int, say: Callable[[str], None], tell: Callable[[int, int], None]
) -> Callable[[int], None]:
    """A callback for every step, which says ten times in a run how many are done."""
    every = max(1, steps // 10)

    def report(done: int) -> None:
        tell(done, steps)
        if done % every == 0:
            say(f"{what}: {done} of {steps} steps")

    return report
