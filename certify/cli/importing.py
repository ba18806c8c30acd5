"""Options for policy files of other programs, declared once for all commands that take them."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from certify.analysis.inputs import policy_in
from certify.cli.arguments import ends_of, plant_of, with_params
from certify.cli.terminal import tell
from certify.errors import InputError

if TYPE_CHECKING:
    from certify.loop.plants import System
    from certify.loop.policies import Policy
    from certify.loop.policies.importers import Imported, ImportOptions
    from certify.lyapunov import ImportedLyapunov

_PANEL = "Policies of other programs"


def _option(help_: str, *names: str, of: Any = str) -> Any:
    return Annotated[of | None, typer.Option(*names, help=help_, rich_help_panel=_PANEL)]


_KINDS = "state-dict, torchscript, onnx, sb3, safetensors or two-stage; auto looks at the file."
_OPTIONS: dict[str, Any] = {
    "kind": _option(_KINDS, "--from"),
    "states": _option("The plant's states in the order in which the network reads them, as in x,theta."),
    "prefix": _option("Keys of a state_dict's layers up to their numbers, as in actor.pi_net.fcs."),
    "activation": _option("Function between the layers of a state_dict: tanh."),
    "squash": _option("Function after the last layer of a state_dict: identity, tanh or relu-tanh."),
    "normaliser": _option("File of the observations' normaliser (VecNormalize, rsl_rl), or none."),
    "epsilon": _option("Number that rsl_rl's normaliser adds to the standard deviation; default: 0.01."),
    "action_scale": _option("u = scale * action + offset: one number or one for each input."),
    "action_offset": _option("See --action-scale."),
    "clip": _option("Bounds LO..HI of the action before scale and offset, one pair or one for each input."),
    "centre": _option("Make pi(0) = u_eq: output or preactivation; by default the policy is not changed."),
    "observes": _option("absolute: the network reads the states' values; deviation: from the operating point."),
    "ignore": _option("Tensor that is no part of the policy, * and ? as in names of files; repeatable.", of=list[str]),
    "output": _option("Output of an ONNX graph that is the action, where there are several."),
}


def takes_import_options(command: Callable[..., None], kind_is: str = "--from") -> Callable[..., None]:
    """Give a command the options of policy files of other programs; it receives them as `importing`.

    `kind_is` is the name of the option for the kind of file, where the command has a `--from` of its own.
    """
    hints = get_type_hints(command, localns={"ImportOptions": object}, include_extras=True)
    own = inspect.signature(command)
    kept = [p.replace(annotation=hints[name]) for name, p in own.parameters.items() if name != "importing"]
    kind = inspect.Parameter.KEYWORD_ONLY
    options = _OPTIONS | {"kind": _option(_KINDS, kind_is)}
    added = [inspect.Parameter(name, kind, default=None, annotation=option) for name, option in options.items()]

    @functools.wraps(command)
    def wrapped(**given: Any) -> None:
        texts = {name: given.pop(name) for name in _OPTIONS}
        with kind_called(kind_is):
            importing = _parsed(texts)
        command(**given, importing=importing)

    parameters = [*(p.replace(kind=kind) for p in kept), *added]
    wrapped.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]
    wrapped.__annotations__ = {p.name: p.annotation for p in parameters}
    return wrapped


@contextmanager
def kind_called(option: str) -> Iterator[None]:
    """Rename --from in error messages to the command's own option for the kind of file."""
    try:
        yield
    except InputError as error:
        said = re.sub(r"--from\b", option, str(error))
        raise error if said == str(error) else InputError(said) from error


def policy_of(path: Path, importing: ImportOptions, system: str | None, params: list[str]) -> Policy:
    """Read a policy from this program's file, or from another program's for the plant that `system` names.

    Raises
    ------
    InputError : the file cannot be read or imported, or is another program's and `system` is None.
    """
    return policy_in(
        path,
        importing,
        lambda: _plant_for(path, system, params),
        lambda stored: plant_of(stored, system, params, []),
        tell,
    )


def imported_policy(
    path: Path, importing: ImportOptions, system: str | None, params: list[str], beside: str | None
) -> Imported:
    """Import another program's policy for the plant that `system` names.

    `beside` is the prefix of the Lyapunov network that is imported with it.
    """
    from certify.loop.policies.importers import import_policy

    return import_policy(path, _plant_for(path, system, params), importing, beside)


def imported_lyapunov(
    path: Path, importing: ImportOptions, system: str | None, params: list[str], prefix: str | None
) -> ImportedLyapunov:
    """Import another program's Lyapunov network for the plant that `system` names."""
    from certify.lyapunov import import_lyapunov

    return import_lyapunov(path, _plant_for(path, system, params), importing, prefix)


def _plant_for(path: Path, system: str | None, params: list[str]) -> System:
    """The plant given for a file to import, since the file does not name it."""
    from certify.loop.plants import chosen_system

    if system is None:
        raise InputError(
            f"importing the policy file {path} takes the plant that it controls: name the plant with --system."
        )
    return with_params(chosen_system(system), params)


def _parsed(texts: dict[str, Any]) -> ImportOptions:
    from certify.loop.plants import exact
    from certify.loop.policies.importers import ImportOptions

    def rationals(name: str, option: str) -> tuple[Fraction, ...] | None:
        text = texts[name]
        return None if text is None else tuple(exact(part.strip(), option) for part in text.split(","))

    states, normaliser, epsilon = texts["states"], texts["normaliser"], rationals("epsilon", "--epsilon")
    if epsilon is not None and len(epsilon) != 1:
        raise InputError(f"--epsilon takes one number; found {texts['epsilon']!r}.")
    return ImportOptions(
        kind=texts["kind"] or "auto",
        prefix=texts["prefix"],
        activation=texts["activation"],
        squash=texts["squash"],
        states=None if states is None else tuple(name.strip() for name in states.split(",")),
        normaliser=None if normaliser is None else "none" if normaliser == "none" else Path(normaliser),
        epsilon=None if epsilon is None else epsilon[0],
        action_scale=rationals("action_scale", "--action-scale"),
        action_offset=rationals("action_offset", "--action-offset"),
        clip=_clip(texts["clip"]),
        centre=texts["centre"],
        observes=texts["observes"],
        ignore=tuple(texts["ignore"] or ()) or None,
        output=texts["output"],
    )


def _clip(text: str | None) -> Any:
    from certify.loop.plants import exact
    from certify.loop.policies.importers import Clip

    if text is None:
        return None
    pairs = [ends_of(part) for part in text.split(",")]
    if any(len(pair) != 2 for pair in pairs):
        raise InputError(f"--clip takes LO..HI, or LO..HI,LO..HI with a pair for each input; found {text!r}.")
    lo, hi = ([exact(pair[k], "--clip") for pair in pairs] for k in (0, 1))
    return Clip(tuple(lo), tuple(hi))
