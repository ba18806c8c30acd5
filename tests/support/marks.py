"""Which cases of a test are run by default, and which on demand."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def slow_after(count: int, cases: Iterable[Any]) -> list[Any]:
    """Cases of `parametrize`, a tuple where there are several parameters: all but the first `count` are `slow`."""
    every = [case if isinstance(case, tuple) else (case,) for case in cases]
    return [pytest.param(*case, marks=[pytest.mark.slow] if k >= count else []) for k, case in enumerate(every)]
