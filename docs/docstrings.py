"""How this project writes docstrings, told to the parser of the site.

Parameters stand as `name : what it is`, because types are annotations already; numpydoc takes what follows the colon
for the type. Here each such line becomes a name and, below it, its description. A docstring that is completed when its
module is loaded is taken from there.
"""

from __future__ import annotations

import inspect
import re
from importlib import import_module
from typing import Any

import griffe

MADE = "<options>"  # in the source, where a docstring is completed
_SECTION = re.compile(r"^(Parameters|Raises|Attributes)\n-+\n(.*?)(?=\n\n\S|\Z)", re.M | re.S)
_ENTRY = re.compile(r"^(\w[\w., *]*?) ?: (\S.*)$", re.M)


def described(text: str) -> str:
    """The docstring with descriptions where a parser of numpydoc looks for them."""
    return _SECTION.sub(lambda section: _ENTRY.sub(r"\1\n    \2", section[0]), text)


class Described(griffe.Extension):
    """Applies `described` to every object's docstring as it is loaded."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            if MADE in obj.docstring.value:
                thing = getattr(import_module(obj.module.path), obj.name)
                obj.docstring.value = inspect.cleandoc(thing.__doc__ or "")
            obj.docstring.value = described(obj.docstring.value)
