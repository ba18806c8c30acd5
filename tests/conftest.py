"""One thread a process and its children, hypothesis profiles, checkers that start quickly, a fixture."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator

import pytest
from hypothesis import settings

from certify.certificates import checking
from certify.loop.plants import System, get_system
from tests.support.warm import WarmCheckers

# The suite runs one process a core: threads that wait for each other's cores take several times as long.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Neither later runs nor programs that tests start need to compile the sources again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

gc.disable()  # until all is collected: what tests are made of stays to the end, and is looked through in vain

settings.register_profile("ci", deadline=None, derandomize=True, max_examples=50)
settings.register_profile("fuzz", deadline=None, max_examples=5000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.set_threshold(700, 10, 50)  # what tests keep is looked through a fifth as often as by default
    gc.enable()


@pytest.fixture
def pendulum() -> System:
    return get_system("pendulum")


@pytest.fixture(scope="session", autouse=True)
def warm_checkers() -> Iterator[None]:
    """Checkers of `certify.certificates.checking` as forks of one process."""
    warm = WarmCheckers()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checking, "subprocess", warm)
        yield
    warm.close()
