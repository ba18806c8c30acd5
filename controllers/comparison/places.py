"""The training of runs at a place: in processes of this machine or on a cluster.

A place changes nothing in a run: its files come back, and are read as any other.
"""

from __future__ import annotations

import io
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

from certify.certificates import sole_writer, write_atomically
from certify.errors import BackendError, InputError
from certify.loop.plants import System
from certify.provers.execution.tasks import Piece, Place, Processes
from controllers.comparison.learners import train_run
from controllers.comparison.methods import NAMES, Run
from controllers.comparison.run_files import ACTOR, CHECKPOINT, CURVE, ENDED, MODEL, POLICY, files_of, run_folder
from controllers.comparison.runs import RunProgress, WantedRun, read_run
from controllers.comparison.stopping import Plan
from controllers.options import TrainingOptions

_MOST_BYTES = 2**31  # size of a run's files that come back: a checkpoint with a full replay buffer has a tenth of it


def train_at(
    place: Place,
    wanted: Sequence[WantedRun],
    system: System,
    runs: Path,
    say: Callable[[str], None],
    watch: Callable[[RunProgress], None],
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
        if read_run(one.run, run_folder(runs, one.run, one.training), system, one.training, one.plan) is None
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
                    _keep(outcome.result, run, run_folder(runs, run, training), system, training, plan)
                found = read_run(run, run_folder(runs, run, training), system, training, plan)
            except InputError as error:  # an error of this run: the others continue
                lost[outcome.key] = str(error)
                continue
            steps = 0 if found is None else found.finished.steps
            done += 1
            say(f"{outcome.key}: {steps} of {steps} steps")
            watch(RunProgress(f"{NAMES[run]}, seed {training.seed}", done, len(wanted), steps, steps))
    if lost:
        what, why = next(iter(lost.items()))
        raise BackendError(
            f"{len(lost)} of {len(missing)} runs could not be trained, {what} among them: {why.rstrip('.')}. "
            "What was trained is kept; the same command resumes the others."
        )


def _pieces(place: Place, missing: dict[str, WantedRun], system: System, runs: Path) -> Iterator[Piece]:
    for key, one in missing.items():
        run, training, plan = one.run, one.training, one.plan
        folder = run_folder(runs, run, training)
        if isinstance(place, Processes):
            yield Piece(key, train_here, (run, system, training, folder, plan))
        else:
            begun = _packed(folder, (CHECKPOINT, *files_of(run)))  # the policy that is kept may be the best to the end
            yield Piece(key, train_elsewhere, (run, system, training, begun, plan))


def train_here(run: Run, system: System, training: TrainingOptions, folder: Path, plan: Plan) -> bytes:
    """Train a run in its folder; nothing is sent back."""
    train_run(run, system, training, folder, plan, lambda done: None)
    return b""


def train_elsewhere(run: Run, system: System, training: TrainingOptions, begun: bytes, plan: Plan) -> bytes:
    """Train a run from what was begun of it; its files, packed."""
    with tempfile.TemporaryDirectory(prefix="controllers-run-") as name:
        folder = Path(name)
        _unpack(begun, folder)
        train_run(run, system, training, folder, plan, lambda done: None)
        return _packed(folder, files_of(run))


def _keep(content: bytes, run: Run, folder: Path, system: System, training: TrainingOptions, plan: Plan) -> None:
    """Write what came back, once it was read as the run that was asked for.

    Raises
    ------
    InputError : it is none.
    """
    with tempfile.TemporaryDirectory(prefix="controllers-run-") as name:
        received = Path(name)
        _unpack(content, received)
        if read_run(run, received, system, training, plan) is None:
            raise InputError(f"what came back for {run}, seed {training.seed}, must be a run that is over; it is not.")
        with sole_writer(folder):
            for file in files_of(run):
                write_atomically(folder / file, (received / file).read_bytes())
            (folder / CHECKPOINT).unlink(missing_ok=True)


def _packed(folder: Path, names: Sequence[str]) -> bytes:
    """One archive of these files, as far as they exist."""
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
