"""Checkpoints: a whole run as plain tensors and values, so that a resumed run equals an uninterrupted one."""

from __future__ import annotations

import io
from typing import Any

import torch

from certify.errors import InputError, OptionError
from certify.loop.plants import System
from controllers.options import TrainingOptions, default_record
from controllers.training.record import parameters_of

CHECKPOINT_FORMAT = "controllers-checkpoint/2"


def written_checkpoint(state: dict[str, Any]) -> bytes:
    """The bytes of a checkpoint file."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


def read_checkpoint(content: bytes, form: str = CHECKPOINT_FORMAT) -> dict[str, Any]:
    """The state in the bytes of a checkpoint of this format, on the CPU; its values are not looked at.

    Raises
    ------
    InputError : the bytes are no such checkpoint.
    """
    try:
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load has no closed list of what it raises on a damaged file
        raise InputError(f"the checkpoint cannot be read: {error}.") from error
    if not isinstance(state, dict) or state.get("format") != form:
        raise InputError(f"the checkpoint must have the format {form!r}.")
    return state


def require_same_run(state: dict[str, Any], system: System, options: TrainingOptions) -> None:
    """Refuse the checkpoint of another plant or of other options.

    Raises
    ------
    InputError : it is one.
    """
    if state.get("system") != [system.name, parameters_of(system)]:
        raise InputError(f"the checkpoint must be of {system.name}; it is of {state['system']}.")
    mine = options.full_record()
    theirs = {**default_record(), **state.get("options", {})}  # a run had no options that came later
    changed = sorted(name for name in mine.keys() | theirs.keys() if mine.get(name) != theirs.get(name))
    if changed:
        name = changed[0]
        raise OptionError(
            f"a run is resumed with the options it began with; `{name}` was {theirs.get(name)}, "
            f"now it is {mine.get(name)}."
        )
