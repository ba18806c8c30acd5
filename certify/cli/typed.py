"""Translate options in messages from their Python names to the form typed on the command line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

_OTHERWISE = {"--precision": "dreal_precision", "--from": "reach_from"}  # options with another name in Python


def options_of(command: Any) -> dict[str, str]:
    """The options of a click command by their Python names."""
    options = [max(one.opts, key=len) for one in command.params if one.param_type_name == "option"]
    named = {option.removeprefix("--").replace("-", "_"): option for option in options}
    return named | {_OTHERWISE[option]: option for option in options if option in _OTHERWISE}


def as_typed(message: str, options: Mapping[str, str]) -> str:
    """Rewrite each option in backquotes as it is typed.

    >>> as_typed("`time_limit` must be positive, unlike `P`.", {"time_limit": "--time-limit"})
    '--time-limit must be positive, unlike `P`.'
    """
    return re.sub(r"`([A-Za-z_]+)`", lambda found: options.get(found[1], found[0]), message)
