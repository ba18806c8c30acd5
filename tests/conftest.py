"""One thread a process and its children, hypothesis profiles, a fixture."""

from __future__ import annotations

import os

import pytest
from hypothesis import settings

from certify.loop.plants import System, get_system

# The suite runs one process a core: threads that wait for each other's cores take several times as long.
os.environ.setdefault("OMP_NUM_THREADS", "1")

settings.register_profile("ci", deadline=None, derandomize=True, max_examples=50)
settings.register_profile("fuzz", deadline=None, max_examples=5000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


@pytest.fixture
def pendulum() -> System:
    return get_system("pendulum")
