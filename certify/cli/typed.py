"""Options as they are typed: what messages call by the names of Python, shown to whoever works on the command line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any


def options_of(command: Any) -> dict[str, str]:
    """The options of a command of click by the names that Python has for them."""
    return {one.name: max(one.opts, key=len) for one in command.params if one.param_type_name == "option"}


def as_typed(message: str, options: Mapping[str, str]) -> str:
    """A message with each option in backquotes as it is typed.

    >>> as_typed("`time_limit` must be positive, unlike `P`.", {"time_limit": "--time-limit"})
    '--time-limit must be positive, unlike `P`.'
    """
    return re.sub(r"`([A-Za-z_]+)`", lambda found: options.get(found[1], found[0]), message)
