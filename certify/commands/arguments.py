"""What a person writes, for commands: as `certify.arguments` reads it, with notices on standard error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from certify import arguments
from certify.arguments import ends_of, layers, numbers, region, state, widths, with_params
from certify.commands.terminal import tell

if TYPE_CHECKING:
    from certify.policies import Policy
    from certify.systems import System

__all__ = ["ends_of", "layers", "numbers", "plant_of", "region", "state", "widths", "with_params"]


def plant_of(
    stored: Policy,
    name: str | None,
    params: list[str],
    bounds: list[str],
    disturbances: Sequence[str] = (),
    error: str | None = None,
    period: str | None = None,
) -> System:
    """See `certify.arguments.plant_of`; what is to be known of the plant goes to standard error."""
    return arguments.plant_of(stored, name, params, bounds, disturbances, error, period, tell)
