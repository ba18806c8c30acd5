"""Which cases of a test are run by default, and which on demand."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def slow_after(count: int, cases: Iterable[Any]) -> list[Any]:
    """Values of one parameter: all after the first `count` bear the mark `slow`."""
    return [case if k < count else pytest.param(case, marks=pytest.mark.slow) for k, case in enumerate(cases)]
