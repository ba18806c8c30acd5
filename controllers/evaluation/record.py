"""The `training` record of a policy file, read with suspicion: anybody can have written it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.policies import Policy
from controllers.options import held_over


def recorded_step(policy: Policy, system: System) -> float:
    """The time step of the record, or the nearest of those that the plant has, whatever the record says: 1 in discrete
    time, else where inputs are held over given times one of these.

    Raises
    ------
    InputError : the record has no time step that is positive, and needs one.
    """
    if system.time == "discrete":
        return 1.0
    dt = float(recorded(policy, "dt", ()))
    if not dt > 0:
        raise InputError(f"`training.dt` of the policy must be positive; found {dt}.")
    return held_over(system, dt)


def recorded(policy: Policy, name: str, shape: Sequence[int]) -> Any:
    """`training[name]` as finite numbers of the given shape; raises InputError if it holds anything else."""
    try:
        value = np.array(policy.training[name], dtype=np.float64)
    except KeyError as error:
        raise InputError(f"the policy's `training` record must have {name!r}.") from error
    except (TypeError, ValueError) as error:
        raise InputError(f"`training.{name}` of the policy must hold numbers.") from error
    if value.shape != tuple(shape) or not np.all(np.isfinite(value)):
        raise InputError(f"`training.{name}` must hold finite numbers of shape {tuple(shape)}.")
    return float(value) if not shape else value
