"""`controllers train`: its options are the fields of `TrainingOptions`, so that none can exist in one place only."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin, get_type_hints

import typer

from certify.cli.options import parameter
from certify.errors import OptionError
from controllers.commands import black_box
from controllers.commands.identify_report import OPTIONS as REPORTED
from controllers.commands.identify_report import report_of
from controllers.commands.shared import Json, beside_a_gain, emit, errors
from controllers.options import Plant, TrainingOptions, overridden
from controllers.storage import make_folder, read, require_writable, set_aside

if TYPE_CHECKING:
    from certify.loop.plants import System
    from certify.loop.policies import Policy
    from controllers.history.policies import PolicyWriter
    from controllers.plants.black_box import BlackBox
    from controllers.training.trainer import Trainer


def train(
    context: typer.Context,
    plant: Annotated[
        str | None, typer.Argument(help="A plant that ships, FILE.toml, or FILE.py:NAME, whose code is run.")
    ] = None,
    *,
    out: Annotated[Path, typer.Option("--out", help="The policy file to write.")],
    preset: Annotated[
        str,
        typer.Option("--preset", help="Values of options not given: ours, or paper, as the paper has them."),
    ] = "ours",
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
    keep: Annotated[
        Path | None,
        typer.Option("--keep", help="Folder that gets the policy as it would ship at each of these evaluations."),
    ] = None,
    device: Annotated[str, typer.Option("--device", help="Device of the networks: cpu or cuda.")] = "cpu",
    resume: Annotated[bool, typer.Option("--resume", help="Resume from checkpoint.pt in --checkpoint-dir.")] = False,
    as_json: Json = False,
    **chosen: Any,  # one optional value for each field of TrainingOptions; the signature below names them
) -> None:
    """Train a policy: soft actor-critic tied to a learned LQR gain.

    Options that are not given take the plant's preset; for a plant of one's own they come from the table [training] of
    its file, and else from its domain and input bounds. The policy file records them all, and the plant's name. An
    environment, --env, is a plant without equations: no evaluations, no checkpoints.
    """
    with errors(context, as_json):
        if checkpoint_every < 1:
            raise OptionError(f"`checkpoint_every` must be positive; found {checkpoint_every}.")
        if evaluate_every < 0:
            raise OptionError(f"`evaluate_every` must be at least 0; found {evaluate_every}.")
        of_environment = {name: chosen.pop(name) for name in black_box.OPTIONS}
        data = of_environment["write_data"]
        reported = report_of({name: chosen.pop(name) for name in REPORTED})
        made = {"checkpoint_dir": checkpoint_dir, "resume": resume, "evaluations": evaluations, "keep": keep}
        task = _task(plant, of_environment, preset, _given(chosen), made)
        for option, path in (("evaluations", evaluations), ("keep", keep)):
            if path is not None and not evaluate_every:
                raise OptionError(f"`{option}` needs an `evaluate_every` above 0.")
        for path in filter(None, (out, log, evaluations, data, reported and reported.path)):
            require_writable(path)
        if reported is not None:
            reported.declared.terms(task.system)
        trainer = task.trainer(device)
        checkpoint = _checkpoint(checkpoint_dir, resume)
        writer = None if keep is None else _policy_writer(keep, resume)
        if resume and checkpoint is not None:
            trainer.restore(read(checkpoint))
        set_aside(out)
        plan = checkpoint, checkpoint_every, 0 if task.box else evaluate_every
        policy = _run(trainer, log, evaluations, writer, plan)
        _save(out, policy)
        found = {} if reported is None else reported.written(trainer, as_json)
        emit(_summary(policy, out) | task.prospects(policy, out, data, trainer, as_json) | found, as_json)


@dataclass(frozen=True, slots=True)
class _Task:
    """The plant that somebody typed, or the environment that stands for it, and how it is trained."""

    named: str
    system: System
    plant: Plant
    options: TrainingOptions
    box: BlackBox | None = None

    def trainer(self, device: str) -> Trainer:
        """A new run."""
        from controllers.training.black_box import BlackBoxEnvironment
        from controllers.training.device import find_device
        from controllers.training.trainer import Trainer

        environment = None if self.box is None else BlackBoxEnvironment(self.box, self.options)
        return Trainer(self.system, self.options, find_device(device), self.plant, environment)

    def prospects(
        self, policy: Policy, out: Path, data: Path | None, trainer: Trainer, as_json: bool
    ) -> dict[str, Any]:
        """The data that are written, how the policy is, and the command to type next."""
        found = _prospects(policy, out, self.system, self.named, self.plant, as_json)
        if self.box is None:
            return _provable(policy, out, self.system, self.plant, found)
        if data is None:
            return found | {"next": "again with --write-data data.csv, for certify identify: there are no equations"}
        count = black_box.write_data(data, trainer, self.box)
        bounds = " ".join(f"--second '{s}=BOUND'" for s in self.system.states)
        following = f"certify identify {data} --structure linear {bounds} --noise E"
        return {"data": f"{data}, {count} transitions"} | found | {"next": following}


def _task(plant: str | None, given: dict[str, Any], preset: str, chosen: dict[str, Any], made: dict[str, Any]) -> _Task:
    """The task that somebody typed.

    Parameters
    ----------
    given : the options of an environment, None where they were not given.
    made : options that need a plant with equations.
    """
    if (plant is None) is (given["env"] is None):
        raise OptionError("name a plant, or an environment with `env`; one of the two.")
    if plant is None:
        black_box.refuse(made, "must be left out with `env`: an environment has no equations, and is not stored")
        box = black_box.named_environment(given, chosen.get("dt"))
        return _Task(given["env"], box.system, box.plant, overridden(box.plant.named(preset), chosen), box)
    black_box.refuse(given, "is for an environment, with `env`")
    from certify.loop.plants import require_equilibrium
    from controllers.plants.choice import chosen_plant

    system, plant_options = chosen_plant(plant)
    options = overridden(plant_options.named(preset), chosen)
    require_equilibrium(system)
    return _Task(plant, system, plant_options, options)


def _policy_writer(keep: Path, resume: bool) -> PolicyWriter:
    from controllers.history.policies import PolicyWriter

    return PolicyWriter(keep, resume)


def _save(out: Path, policy: Policy) -> None:
    from certify.loop.policies import save_policy

    save_policy(out, policy)


def _run(
    trainer: Trainer,
    log: Path | None,
    evaluations: Path | None,
    writer: PolicyWriter | None,
    plan: tuple[Path | None, int, int],
) -> Policy:
    """Take a run to its end, with its logs, its policies on the way and its progress.

    Parameters
    ----------
    plan : the checkpoint's file, and the steps between checkpoints and between evaluations.
    """
    from controllers.training.log import Episode, Log, Monitored
    from controllers.training.trainer import train as run

    with ExitStack() as stack:
        episodes = None if log is None else stack.enter_context(Log(log, Episode))
        rows = None if evaluations is None else stack.enter_context(Log(evaluations, Monitored))
        show = stack.enter_context(_progress(trainer))

        def report(trainer: Trainer) -> None:
            if episodes is not None:
                episodes.extend(trainer.episodes)
            if rows is not None:
                rows.extend(trainer.monitored)
            if writer is not None:
                writer(trainer)
            show(trainer)

        return run(trainer, report, *plan)


def _signature() -> inspect.Signature:
    own = inspect.signature(train, eval_str=True).parameters.values()
    parameters = [p for p in own if p.kind is not inspect.Parameter.VAR_KEYWORD]
    parameters += [*black_box.OPTIONS.values(), *REPORTED.values()]
    hints = get_type_hints(TrainingOptions, include_extras=True)
    for option in fields(TrainingOptions):
        kind, text = get_args(hints[option.name])
        plain: Any = kind if kind in (int, float) else str  # tuples and choices are text here
        parameters.append(parameter(option.name, "--" + option.name.replace("_", "-"), text, plain))
    return inspect.Signature(parameters)


def _given(chosen: dict[str, Any]) -> dict[str, Any]:
    """The options that were given, tuples parsed from text such as `1,0.5`."""
    hints = get_type_hints(TrainingOptions)
    values = {name: value for name, value in chosen.items() if value is not None}
    for name, value in values.items():
        if get_origin(hints[name]) is tuple:
            number = get_args(hints[name])[0]
            try:
                values[name] = () if value == "none" else tuple(number(part) for part in value.split(","))
            except ValueError as error:
                raise OptionError(
                    f"`{name}` must be numbers separated by commas, such as 1,2, or none; found {value!r}."
                ) from error
    return values


def _checkpoint(folder: Path | None, resume: bool) -> Path | None:
    if folder is None:
        if resume:
            raise OptionError("`resume` needs `checkpoint_dir`, the folder that holds checkpoint.pt.")
        return None
    path = folder / "checkpoint.pt"
    if resume and not path.is_file():
        raise OptionError(f"there is no checkpoint {path} to resume from; begin without `resume`.")
    make_folder(folder)
    require_writable(path)
    return path


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


def _summary(policy: Policy, out: Path) -> dict[str, Any]:
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
    } | {name: training[name] for name in ("nearest_corner",) if name in training}


def _prospects(policy: Policy, out: Path, system: System, named: str, plant: Plant, as_json: bool) -> dict[str, Any]:
    """The departure and nonlinearity of the policy on its box of initial states, and the command to type next."""
    from controllers.evaluation.curvature import nonlinearity_on
    from controllers.training.departure import WORTH_FLATTENING, departure_of

    departure = departure_of(policy.network, plant.initial_states)
    found = nonlinearity_on(policy.network, system.exact_u_eq(), plant.initial_states)
    prove = f"certify roa --policy {out}" + ("" if named == system.name else f" --system {named}")
    if departure > WORTH_FLATTENING:
        flat = out.with_name(f"{out.stem}_flat.pt")
        prove = (
            f"controllers flatten {out} --out {flat}, since hidden units may add {departure:.2g} times its linear part "
            "on its box, and bounds add up all of that: it says what this costs; or train with a larger --proof-weight"
        )
    shown = {"nonlinearity": found.to_dict()} if as_json else {"linear part": beside_a_gain(found)}
    return {"departure": departure, **shown, "next": prove}


def _provable(policy: Policy, out: Path, system: System, plant: Plant, found: dict[str, Any]) -> dict[str, Any]:
    """The prospects found so far, with the set that is forecast to be proved before the command to type next."""
    from controllers.evaluation.forecast import forecast_of

    forecast = forecast_of(policy.network, system, plant.initial_states)
    if forecast is None:
        return found
    said = (
        f"volume {forecast.volume:.2g} at effort 1, by a forecast: {forecast.size:.2g} times the box of initial states"
    )
    following = found.pop("next")
    if forecast.size < 1 and following.startswith("certify"):
        flat = out.with_name(f"{out.stem}_flat.pt")
        following = f"controllers flatten {out} --out {flat}, since less than its box is in reach"
    return found | {"provable": said, "next": following}


train.__signature__ = _signature()  # type: ignore[attr-defined]
train.__annotations__ = {}
