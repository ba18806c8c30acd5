"""The trained runs of a comparison: what each kind is, when it ends, where its files lie, where it is trained.

Ours and its ablations make the steps of the preset. A baseline learns until its evaluation stops improving, by the
rules of `RULES`, unless one number of steps is asked for all: a baseline that was stopped early proves nothing.

A folder of runs holds `<run>/seed-<k>/` with what `controllers.course` writes, and the policy: `policy.pt`, the mean
action as `controllers train` writes it; in `sac`, the same SAC without the gain, beside it `actor.pt`, the whole actor;
in `sb3-sac` and `sb3-ppo` `model.zip`, the library's own file. What is missing is trained, what is there is used if it
was made with the options that are asked for, and a run that was cut off goes on from its checkpoint, in one process at
a time. Where a run is trained, in this process, in others of this machine or
on a cluster, changes nothing in it: what comes back are its files, which are read as any other.
"""

from __future__ import annotations

import io
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from certify.certificates import sole_writer
from certify.errors import BackendError, InputError
from certify.loop.plants import System
from certify.loop.policies import load_policy
from certify.provers.execution.tasks import Piece, Place, Processes
from controllers.baselines import ACTOR, OwnRun, Trained, from_checkpoint, from_policy, require_plant, without_gain
from controllers.course import (
    CHECKPOINT,
    CURVE,
    ENDED,
    Course,
    Fixed,
    Judged,
    Plan,
    Stopping,
    follow,
    read_course,
)
from controllers.files import read, write_atomically
from controllers.options import TrainingOptions, default_record
from controllers.responses import NAMES, OURS, CompareOptions, Response, Run, table
from controllers.sb3 import MODEL, ROLLOUT, Reference, budget, from_reference
from controllers.simulation import Action, initial_states, simulate
from controllers.training import Trainer

POLICY = "policy.pt"

_FILES: dict[Run, str] = {
    "ours": "policy.pt",
    "sac": ACTOR,
    "before": "policy.pt",
    "uncentred": "policy.pt",
    "sb3-sac": MODEL,
    "sb3-ppo": MODEL,
}
RULES: dict[Run, Stopping] = {
    "sac": Stopping(budget=150_000, every=5_000),
    "sb3-sac": Stopping(budget=150_000, every=5_000),
    "sb3-ppo": Stopping(budget=500_000, every=10 * ROLLOUT, patience=10),
}
"""When a baseline has reached its floor."""

_NO_MATTER = frozenset({"steps", "seed"})  # what a run's record may differ in: both are asked for elsewhere
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

_MOST_BYTES = 2**31  # of a run's files that come back: a checkpoint with a full replay buffer has a tenth of it
_EVERY = 5_000  # steps between evaluations of a run of a fixed number of steps
_JUDGED = CompareOptions(states=100, start_seed=1)  # during a run: other states than those of a table


@dataclass(frozen=True, slots=True)
class Doing:
    """What a comparison is doing.

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
class Wanted:
    """A run that a comparison needs: its kind, the options with its seed, and when it ends."""

    run: Run
    training: TrainingOptions
    plan: Plan


@dataclass(frozen=True, slots=True)
class Obtained:
    """A run that is over: its policy, and how it went."""

    trained: Trained
    course: Course


def obtain(
    run: Run,
    system: System,
    training: TrainingOptions,
    runs: Path,
    plan: Plan | None = None,
    say: Callable[[str], None] = lambda line: None,
    tell: Callable[[int, int], None] = lambda done, steps: None,
) -> Obtained:
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
    folder = _folder(runs, run, training)
    found = _there(run, folder, system, training, plan)
    if found is None:
        most = plan.steps if isinstance(plan, Fixed) else plan.budget
        _train(run, system, training, folder, plan, _progress(f"{run} seed {training.seed}", most, say, tell))
        found = _there(run, folder, system, training, plan)
    if found is None:
        raise InputError(f"{folder} must hold a run that is over; it does not.")
    return found


def fixed(run: Run, training: TrainingOptions) -> Fixed:
    """The plan of a run with the steps of `training`, of which PPO makes as many whole rollouts as fit."""
    return Fixed(steps=budget("ppo" if run == "sb3-ppo" else "sac", training.steps)[0], every=_EVERY)


def plan_of(run: Run, training: TrainingOptions, options: CompareOptions) -> Plan:
    """When a run of this comparison ends."""
    if not options.to_floor or run not in RULES:
        return fixed(run, training)
    chosen = {"budget": options.budget, "patience": options.patience}
    return replace(RULES[run], **{name: value for name, value in chosen.items() if value is not None})


def _folder(runs: Path, run: Run, training: TrainingOptions) -> Path:
    return runs / run / f"seed-{training.seed}"


def _there(run: Run, folder: Path, system: System, training: TrainingOptions, plan: Plan) -> Obtained | None:
    """The run in the folder, if it is over.

    Raises
    ------
    InputError : it is another one, or the folder holds a policy and nothing that says where it is from.
    """
    course, path = read_course(folder, plan), folder / _FILES[run]
    if course is None:
        if path.is_file() and not (folder / CHECKPOINT).is_file():
            raise InputError(
                f"{path} would be written over: {folder} holds neither {ENDED} nor {CHECKPOINT} of a run. Move it "
                "away, or compare in another folder of runs."
            )
        return None
    trained = _load(run, path, system, training)
    if (trained.steps, trained.seed) != (course.kept, training.seed):
        raise InputError(
            f"{path} must be of a run with seed {training.seed} after {course.kept} steps; it is of {trained.steps} "
            f"steps with seed {trained.seed}. Compare in another folder of runs."
        )
    _require_asked(run, folder / POLICY, system, training, plan)
    return Obtained(trained, course)


def _require_asked(run: Run, path: Path, system: System, training: TrainingOptions, plan: Plan) -> None:
    """Refuse a run by the record of its policy file: one that a changed preset or plant would have led elsewhere.

    Raises
    ------
    InputError : its plant has other parameters, or an option that matters to this kind of run was another one.
    """
    policy = load_policy(path)
    require_plant(str(path), policy.system, policy.parameters, system)
    asked = _options_of(run, training, plan).record()
    used = {**default_record(), **policy.training}  # a run had no options that came later
    for name in sorted(asked.keys() - _NO_MATTER - _UNUSED.get(run, frozenset())):
        if used.get(name) != asked[name]:
            raise InputError(
                f"{path} must be of a run with the options that are asked for; its `{name}` was {used.get(name)}, and "
                f"{asked[name]} is asked for. Compare in another folder of runs, or move {path.parent} away and it is "
                "trained again."
            )


def train_at(
    place: Place,
    wanted: Sequence[Wanted],
    system: System,
    runs: Path,
    say: Callable[[str], None],
    watch: Callable[[Doing], None],
) -> None:
    """Train the runs that are missing at a place.

    Processes of this machine work in the folder of runs, and leave checkpoints there; a cluster gets the checkpoint
    that is there, and what its worker wrote is written here.

    Raises
    ------
    BackendError : one could not be trained, or what came back is no such run; the others are kept.
    InputError : what is there is another run.
    """
    missing = {
        f"{one.run} seed {one.training.seed}": one
        for one in wanted
        if _there(one.run, _folder(runs, one.run, one.training), system, one.training, one.plan) is None
    }
    done, lost = len(wanted) - len(missing), dict[str, str]()
    with closing(place.run(_pieces(place, missing, system, runs))) as outcomes:
        for outcome in outcomes:
            if outcome is None:
                continue
            if outcome.result is None:
                lost[outcome.key] = outcome.reason
                continue
            one = missing[outcome.key]
            run, training, plan = one.run, one.training, one.plan
            try:
                if outcome.result:
                    _keep(outcome.result, run, _folder(runs, run, training), system, training, plan)
                found = _there(run, _folder(runs, run, training), system, training, plan)
            except InputError as error:  # of this run: those that are under way go on
                lost[outcome.key] = str(error)
                continue
            steps = 0 if found is None else found.course.steps
            done += 1
            say(f"{outcome.key}: {steps} of {steps} steps")
            watch(Doing(f"{NAMES[run]}, seed {training.seed}", done, len(wanted), steps, steps))
    if lost:
        what, why = next(iter(lost.items()))
        raise BackendError(
            f"{len(lost)} of {len(missing)} runs could not be trained, {what} among them: {why.rstrip('.')}. "
            "What was trained is kept; the same command goes on."
        )


def _pieces(place: Place, missing: dict[str, Wanted], system: System, runs: Path) -> Iterator[Piece]:
    for key, one in missing.items():
        run, training, plan = one.run, one.training, one.plan
        folder = _folder(runs, run, training)
        if isinstance(place, Processes):
            yield Piece(key, train_here, (run, system, training, folder, plan))
        else:
            begun = _packed(
                folder, (CHECKPOINT, *_all_files(run))
            )  # the policy that is kept may be the best to the end
            yield Piece(key, train_elsewhere, (run, system, training, begun, plan))


def train_here(run: Run, system: System, training: TrainingOptions, folder: Path, plan: Plan) -> bytes:
    """Train a run in its folder; nothing is sent back."""
    _train(run, system, training, folder, plan, lambda done: None)
    return b""


def train_elsewhere(run: Run, system: System, training: TrainingOptions, begun: bytes, plan: Plan) -> bytes:
    """Train a run from what was begun of it; its files, packed."""
    with tempfile.TemporaryDirectory(prefix="controllers-run-") as name:
        folder = Path(name)
        _unpack(begun, folder)
        _train(run, system, training, folder, plan, lambda done: None)
        return _packed(folder, _all_files(run))


def _keep(content: bytes, run: Run, folder: Path, system: System, training: TrainingOptions, plan: Plan) -> None:
    """Write what came back, once it was read as the run that was asked for.

    Raises
    ------
    InputError : it is none.
    """
    with tempfile.TemporaryDirectory(prefix="controllers-run-") as name:
        received = Path(name)
        _unpack(content, received)
        if _there(run, received, system, training, plan) is None:
            raise InputError(f"what came back for {run}, seed {training.seed}, must be a run that is over; it is not.")
        with sole_writer(folder):
            for file in _all_files(run):  # what says that the run is over comes last
                write_atomically(folder / file, (received / file).read_bytes())
            (folder / CHECKPOINT).unlink(missing_ok=True)


def _all_files(run: Run) -> tuple[str, ...]:
    return tuple(dict.fromkeys((_FILES[run], POLICY, CURVE, ENDED)))


def _packed(folder: Path, names: Sequence[str]) -> bytes:
    """Those of the files that are there, as one archive."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name in names:
            if (folder / name).is_file():
                archive.write(folder / name, name)
    return content.getvalue()


def _unpack(content: bytes, folder: Path) -> None:
    """Write the files of an archive that have the name of a run's file, whatever else is in it.

    Raises
    ------
    InputError : it is no archive, or more than any run.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            wanted = [
                entry
                for entry in archive.infolist()
                if entry.filename in (CHECKPOINT, CURVE, ENDED, POLICY, ACTOR, MODEL)
            ]
            size = sum(entry.file_size for entry in wanted)  # no more of an entry is read than it says of itself
            if size > _MOST_BYTES:
                raise InputError(
                    f"the files of a run must have at most {_MOST_BYTES} bytes; what came back has {size}."
                )
            for entry in wanted:
                (folder / entry.filename).write_bytes(archive.read(entry))
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError) as error:
        raise InputError(f"the files of a run that came back cannot be read: {error}.") from error


def variant(run: Run, training: TrainingOptions) -> TrainingOptions:
    """The options of a run; of stable-baselines3 those of the preset."""
    if run == "sac":
        return without_gain(training)
    if run == "before":
        return replace(training, identification="before")
    return replace(training, centre="none") if run == "uncentred" else training


def _train(
    run: Run, system: System, training: TrainingOptions, folder: Path, plan: Plan, tell: Callable[[int], None]
) -> None:
    with sole_writer(folder):
        if (folder / ENDED).is_file():  # another process has ended it since it was looked for
            return
        learner = learner_of(run, system, training, plan)
        follow(learner, plan, folder, lambda: judged(system, training, learner.trained().mean), tell)


def learner_of(run: Run, system: System, training: TrainingOptions, plan: Plan) -> OwnRun | Reference:
    """A run at its beginning."""
    training = _options_of(run, training, plan)
    if run == "sb3-sac":
        return Reference("sac", system, training)
    if run == "sb3-ppo":
        rollout = ROLLOUT if isinstance(plan, Stopping) else budget("ppo", training.steps)[1]
        return Reference("ppo", system, training, rollout)
    return OwnRun(Trainer(system, training), whole=run == "sac")


def _options_of(run: Run, training: TrainingOptions, plan: Plan) -> TrainingOptions:
    """What a run is trained with."""
    if isinstance(plan, Stopping):  # its own closing phase takes the place of the preset's
        most = plan.budget + round(plan.closing * plan.budget)
        training = replace(training, steps=most, anneal=0.0)
    return variant(run, training)


def judged(system: System, training: TrainingOptions, mean: Action) -> Judged:
    """What is found of a policy while its run goes on, from other states than those of the table."""
    x0 = initial_states(system, _JUDGED.states, _JUDGED.start_seed)
    x, cost = simulate(system, training, mean, x0, _JUDGED.span(system)[0])
    [row, _] = table(system, training.dt, [Response(OURS, 0, 0, x, cost)], _JUDGED)
    return Judged(row.floor, row.cost_median, row.left_domain, row.trajectories)


def _load(run: Run, path: Path, system: System, training: TrainingOptions) -> Trained:
    if run in ("ours", "before", "uncentred"):
        policy = load_policy(path)
        for name in ("identification", "centre"):  # what tells these runs apart
            asked, found = getattr(variant(run, training), name), policy.training.get(name)
            if found != asked:
                raise InputError(f"{path}: `{name}` must be {asked!r} for the run {run}; it is {found!r}.")
        return from_policy(policy, system)
    content = read(path)
    return from_checkpoint(content, system) if run == "sac" else from_reference(content, system, training)


def _progress(
    what: str, steps: int, say: Callable[[str], None], tell: Callable[[int, int], None]
) -> Callable[[int], None]:
    """Tells of every step, and says ten times in a run how far it is."""
    every = max(1, steps // 10)

    def report(done: int) -> None:
        tell(done, steps)
        if done % every == 0:
            say(f"{what}: {done} of {steps} steps")

    return report
