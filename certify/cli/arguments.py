"""Read what a person typed by `certify.analysis.arguments`, and print its notices on standard error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from certify.analysis import arguments
from certify.analysis.arguments import ends_of, layers, numbers, region, state, widths, with_params
from certify.cli.terminal import tell

if TYPE_CHECKING:
    from certify.loop.plants import System
    from certify.loop.policies import Policy

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
    """See `certify.analysis.arguments.plant_of`; notices about the plant go to standard error."""
    return arguments.plant_of(stored, name, params, bounds, disturbances, error, period, tell)
