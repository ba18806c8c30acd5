"""Options for policy files of other programs, declared once for all commands that take them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from certify.analysis.arguments import ends_of
from certify.cli.options import Bundle, parameter
from certify.errors import InputError

if TYPE_CHECKING:
    from certify.loop.policies.importers import ImportOptions

_PANEL = "Policies of other programs"


_KINDS = "state-dict, torchscript, onnx, sb3, safetensors or two-stage; auto looks at the file."
_HELP = {
    "kind": _KINDS,
    "states": "What the network reads, in its order: states, or expressions as in 'cos(theta),sin(theta),theta_dot'.",
    "prefix": "Keys of a state_dict's layers up to their numbers, as in actor.pi_net.fcs; several, or layers, as in "
    "pi.net,pi.mu.",
    "activation": "Between the layers of a state_dict: tanh, relu, leaky_relu:0.1 and others; docs/import.md has all.",
    "norm": "Layer normalisation between the layers of a state_dict: layer-before or layer-after the activation.",
    "norm_epsilon": "What it adds to the variance; 1e-5 if nothing is said.",
    "squash": "After the last layer of a state_dict: identity, tanh or relu-tanh.",
    "normaliser": "File of the observations' normaliser (VecNormalize, rsl_rl), or none.",
    "epsilon": "What rsl_rl's normaliser adds to the standard deviation; 0.01 if nothing is said.",
    "action_scale": "u = scale * action + offset: one number or one for each input.",
    "action_offset": "See --action-scale.",
    "clip": "Bounds LO..HI of the action before scale and offset, one pair or one for each input.",
    "centre": "Make pi(0) = u_eq, as your code may do itself: output or preactivation; nothing is centred unless this "
    "asks for it.",
    "observes": "Whether the network reads absolute states or their deviation from the operating point.",
    "ignore": "Tensor that is no part of the policy, * and ? as in names of files; repeatable.",
    "output": "Output that is the action, where there are several: for ONNX its name, else its place, 0 for the first; "
    "for a state_dict mean, if its last layer gives the actions' mean and then their spread, or places as in 0,2.",
}


def import_options(kind_is: str = "--from") -> Bundle:
    """The options of policy files of other programs; a command receives them as `ImportOptions`.

    `kind_is` is the name of the option for the kind of file, where the command has a `--from` of its own.
    """
    parameters = {}
    for name, help_ in _HELP.items():
        typed = kind_is if name == "kind" else f"--{name.replace('_', '-')}"
        of: Any = list[str] if name == "ignore" else str
        metavar = name.rpartition("_")[2].upper()
        parameters[name] = parameter(name, typed, help_, of, rich_help_panel=_PANEL, metavar=metavar)

    def read(texts: Mapping[str, Any]) -> ImportOptions:
        with kind_called(kind_is):
            return _parsed(texts)

    return Bundle(parameters, read)


@contextmanager
def kind_called(option: str) -> Iterator[None]:
    """Rename --from in error messages to the command's own option for the kind of file."""
    try:
        yield
    except InputError as error:
        said = re.sub(r"--from\b", option, str(error))
        raise error if said == str(error) else InputError(said) from error


def _parsed(texts: Mapping[str, Any]) -> ImportOptions:
    from certify.loop.plants import exact
    from certify.loop.policies.importers import ImportOptions

    def rationals(name: str, option: str) -> tuple[Fraction, ...] | None:
        text = texts.get(name)
        return None if text is None else tuple(exact(part.strip(), option) for part in text.split(","))

    def rational(name: str, option: str) -> Fraction | None:
        found = rationals(name, option)
        if found is not None and len(found) != 1:
            raise InputError(f"{option} takes one number; found {texts[name]!r}.")
        return None if found is None else found[0]

    states, normaliser = texts.get("states"), texts.get("normaliser")
    return ImportOptions(
        kind=texts.get("kind", "auto"),
        prefix=texts.get("prefix"),
        activation=texts.get("activation"),
        squash=texts.get("squash"),
        states=None if states is None else tuple(_parts(states)),
        normaliser=None if normaliser is None else "none" if normaliser == "none" else Path(normaliser),
        epsilon=rational("epsilon", "--epsilon"),
        norm=texts.get("norm"),
        norm_epsilon=rational("norm_epsilon", "--norm-epsilon"),
        action_scale=rationals("action_scale", "--action-scale"),
        action_offset=rationals("action_offset", "--action-offset"),
        clip=_clip(texts.get("clip")),
        centre=texts.get("centre"),
        observes=texts.get("observes"),
        ignore=tuple(texts.get("ignore") or ()) or None,
        output=texts.get("output"),
    )


def _parts(text: str) -> Iterator[str]:
    """The parts between commas that stand in no brackets."""
    part, depth = "", 0
    for letter in text:
        depth += (letter == "(") - (letter == ")")
        if letter == "," and depth == 0:
            yield part.strip()
            part = ""
        else:
            part += letter
    yield part.strip()


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
