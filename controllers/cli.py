"""`controllers`: arguments, printing and exit statuses; no mathematics.

Standard output carries the result, or exactly one JSON object with `--json`; progress goes to standard
error. Exit status: 0 done, 2 bad usage or input, 70 internal error. The options of `train` are the fields
of `TrainingOptions`, read from the dataclass, so that an option cannot exist in one place only.
"""

from __future__ import annotations

import inspect
import json
import math
import os
import tempfile
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin, get_type_hints

import typer

from certify.errors import CertifyError, InputError
from controllers import comparison
from controllers.options import TrainingOptions, preset

if TYPE_CHECKING:
    from certify.policies import Policy
    from controllers.evaluate import Evaluation, Settling
    from controllers.training import Trainer

app = typer.Typer(
    help="Train and evaluate the policies that `certify` proves things about.",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
)

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]


def main() -> None:
    """Entry point of the `controllers` command; a fault of the program itself exits 70."""
    try:
        app()
    except Exception:
        traceback.print_exc()
        raise SystemExit(70) from None


def _train(
    plant: Annotated[str, typer.Argument(help="The plant, for instance pendulum.")],
    out: Annotated[Path, typer.Option("--out", help="The policy file to write.")],
    log: Annotated[Path | None, typer.Option("--log", help="CSV file of episodes and returns.")] = None,
    checkpoint_dir: Annotated[
        Path | None, typer.Option("--checkpoint-dir", help="Folder that keeps checkpoint.pt.")
    ] = None,
    checkpoint_every: Annotated[int, typer.Option("--checkpoint-every", help="Steps between checkpoints.")] = 10_000,
    evaluations: Annotated[
        Path | None, typer.Option("--evaluations", help="CSV file of the evaluations during the run.")
    ] = None,
    evaluate_every: Annotated[
        int, typer.Option("--evaluate-every", help="Steps between evaluations during the run; 0 means none.")
    ] = 10_000,
    device: Annotated[str, typer.Option("--device", help="Where the networks live: cpu or cuda.")] = "cpu",
    resume: Annotated[bool, typer.Option("--resume", help="Go on from checkpoint.pt in --checkpoint-dir.")] = False,
    as_json: Json = False,
    **chosen: Any,  # one optional value for each field of TrainingOptions; the signature below names them
) -> None:
    """Train a policy: soft actor-critic tied to a learned LQR gain.

    Options that are not given take the plant's preset; the policy file records them all.
    """
    with _errors(as_json):
        options = replace(preset(plant), **_given(chosen))
        from certify.systems import get_system
        from controllers.sac import find_device
        from controllers.training import Episode, Log, Monitored, Trainer, train

        if checkpoint_every < 1:
            raise InputError(f"`checkpoint_every` must be positive; found {checkpoint_every}.")
        if evaluate_every < 0:
            raise InputError(f"`evaluate_every` must be at least 0; found {evaluate_every}.")
        if evaluations is not None and not evaluate_every:
            raise InputError("`--evaluations` needs an `--evaluate-every` above 0.")
        for path in filter(None, (out, log, evaluations)):
            _require_writable(path)
        trainer = Trainer(get_system(plant), options, find_device(device))
        checkpoint = _checkpoint(checkpoint_dir, resume)
        if resume and checkpoint is not None:
            trainer.restore(_read(checkpoint))
        with ExitStack() as stack:
            episodes = None if log is None else stack.enter_context(Log(log, Episode))
            rows = None if evaluations is None else stack.enter_context(Log(evaluations, Monitored))
            show = stack.enter_context(_progress(trainer))

            def report(trainer: Trainer) -> None:
                if episodes is not None:
                    episodes.extend(trainer.episodes)
                if rows is not None:
                    rows.extend(trainer.monitored)
                show(trainer)

            policy = train(trainer, report, checkpoint, checkpoint_every, evaluate_every)
        _save(policy, out)
        _emit(_trained(policy, out), as_json)


def _train_signature() -> inspect.Signature:
    own = inspect.signature(_train, eval_str=True).parameters.values()
    parameters = [p for p in own if p.kind is not inspect.Parameter.VAR_KEYWORD]
    hints = get_type_hints(TrainingOptions, include_extras=True)
    for option in fields(TrainingOptions):
        kind, text = get_args(hints[option.name])
        plain: Any = kind if kind in (int, float) else str  # tuples and choices are text here
        flag = typer.Option("--" + option.name.replace("_", "-"), help=text)
        annotation = Annotated[plain | None, flag]
        parameters.append(
            inspect.Parameter(option.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
        )
    return inspect.Signature(parameters)


def _given(chosen: dict[str, Any]) -> dict[str, Any]:
    """The options that were given, tuples parsed from text such as `1,0.5`."""
    hints = get_type_hints(TrainingOptions)
    values = {name: value for name, value in chosen.items() if value is not None}
    for name, value in values.items():
        if get_origin(hints[name]) is tuple:
            number = get_args(hints[name])[0]
            try:
                values[name] = tuple(number(part) for part in value.split(","))
            except ValueError as error:
                raise InputError(
                    f"`{name}` must be numbers separated by commas, such as 1,2; found {value!r}."
                ) from error
    return values


_train.__signature__ = _train_signature()  # type: ignore[attr-defined]
_train.__annotations__ = {}
app.command("train")(_train)


@app.command("evaluate")
def _evaluate(
    policy: Annotated[Path, typer.Argument(help="The policy file.")],
    states: Annotated[int, typer.Option(help="Number of initial states.")] = 1000,
    seed: Annotated[int, typer.Option(help="Seed of the initial states.")] = 0,
    as_json: Json = False,
) -> None:
    """Simulate a policy from random initial states and compare it with its learned gain."""
    with _errors(as_json):
        from certify.policies import load_policy
        from controllers.evaluate import EvaluationOptions, evaluate

        options = EvaluationOptions(states=states, seed=seed)
        result = evaluate(load_policy(policy), options)
        _emit(result.as_json() if as_json else _table(result), as_json)


@contextmanager
def _errors(as_json: bool) -> Iterator[None]:
    """Bad input ends in one sentence and exit status 2."""
    try:
        yield
    except (CertifyError, OSError) as error:
        if as_json:
            typer.echo(json.dumps({"error": str(error)}))
        typer.echo(f"Error: {error}", err=True)
        raise typer.Exit(2) from error


def _emit(result: dict[str, Any], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(result))
        return
    width = max(map(len, result))
    for name, value in result.items():
        typer.echo(f"{name:<{width}}  {'-' if value is None else value}")


@contextmanager
def _progress(trainer: Trainer) -> Iterator[Callable[[Trainer], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("return {task.fields[mean]}  |J+K| {task.fields[distance]}  settled {task.fields[settled]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        steps = trainer.options.steps
        task = progress.add_task("", total=steps, completed=trainer.steps_done, mean="-", distance="-", settled="-")

        def show(trainer: Trainer) -> None:
            if trainer.steps_done % 200 and trainer.steps_done != steps:
                return
            totals = [e.total for e in trainer.episodes if e.kind == "training"][-10:]
            mean = f"{sum(totals) / len(totals):.1f}" if totals else "-"
            last = trainer.monitored[-1].settled if trainer.monitored else math.nan
            progress.update(
                task,
                completed=trainer.steps_done,
                mean=mean,
                distance=f"{trainer.distance()[0]:.1e}",
                settled="-" if math.isnan(last) else f"{last:.0%}",
            )

        yield show


def _trained(policy: Policy, out: Path) -> dict[str, Any]:
    training = policy.training
    return {
        "policy": str(out),
        "sha256": policy.network.sha256(),
        "layers": list(policy.network.layers),
        "steps": training["steps"],
        "seed": training["seed"],
        "K": training.get("K"),
        "distance": training.get("distance"),
        "curvature": training["curvature"],
    }


def _table(result: Evaluation) -> dict[str, Any]:
    def settling(s: Settling) -> str:
        return (
            f"{s.settled} of {s.states} settled (step {s.step:.4g} s), {s.left_domain} left the domain, "
            f"largest final norm {s.largest:.1e}, median cost {s.cost:.4g}"
        )

    A_error, B_error = 100 * result.A_relative_error, 100 * result.B_relative_error
    learned = not math.isnan(result.gain_relative)
    return {
        "system": result.system,
        "sha256": result.sha256,
        "||J+K||/||K||": f"{100 * result.gain_relative:.3g} %" if learned else None,
        "learned A, B": f"off by {A_error:.2g} % and {B_error:.2g} %" if learned else None,
        "curvature": None if math.isnan(result.curvature) else f"{result.curvature:.4g}",
        "eigenvalues": ", ".join(f"{e:.4g}" for e in result.eigenvalues),
        "continuous": settling(result.continuous),
        "held": settling(result.held),
    }


def _checkpoint(folder: Path | None, resume: bool) -> Path | None:
    if folder is None:
        if resume:
            raise InputError("`--resume` needs `--checkpoint-dir`, the folder that holds checkpoint.pt.")
        return None
    path = folder / "checkpoint.pt"
    if resume and not path.is_file():
        raise InputError(f"there is no checkpoint {path} to resume from; begin without `--resume`.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"the folder {folder} cannot be made: {error.strerror}.") from error
    _require_writable(path)
    return path


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error


def _require_writable(path: Path) -> None:
    """Refuse before hours of training, not after; an existing file is left as it is."""
    if path.is_dir():
        raise InputError(f"{path} must be a file to write; it is a folder.")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}.") from error


def _save(policy: Policy, out: Path) -> None:
    from certify.policies import save_policy

    temporary = out.with_name(out.name + ".partial")
    try:
        save_policy(temporary, policy)
        os.replace(temporary, out)
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror}.") from error


app.command("train-baseline")(comparison.train_baseline)
app.command("compare")(comparison.compare)

if __name__ == "__main__":
    main()
