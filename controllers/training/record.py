"""The record of a training that its policy file carries."""

from __future__ import annotations

import math
import platform
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import torch

from certify.errors import OptionError
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from controllers.evaluation.corners import nearest_corner
from controllers.evaluation.curvature import curvature
from controllers.identification.gain_learner import Identified
from controllers.options import TrainingOptions


def parameters_of(system: System) -> dict[str, str]:
    """A plant's parameters as text, which stands for the exact value: decimal where that is exact, else a fraction."""
    texts = {}
    for name, value in system.parameters.items():
        decimal = str(Decimal(value.numerator) / Decimal(value.denominator))
        texts[name] = decimal if Fraction(decimal) == value else str(value)
    return texts


def require_slope(network: PolicyNetwork, system: System) -> None:
    """Refuse a policy that has no Jacobian at the origin.

    Raises
    ------
    InputError : a unit's corner lies there.
    """
    if not nearest_corner(network, system) > 0:
        raise OptionError(
            f"a unit of {network.activation} has its corner at the origin, where the policy then has no slope; train "
            "for more `steps` or with another `seed`."
        )


def training_record(
    options: TrainingOptions,
    system: System,
    network: PolicyNetwork,
    identified: Identified | None,
    off: tuple[float, float],
    device: torch.device,
) -> dict[str, Any]:
    """The options of a run, the plant and gain that it learned, and the versions that it was made with.

    Parameters
    ----------
    off : ||J_mu(0) + K|| and ||mu(0) - u_eq|| of the actor.
    """
    learned: dict[str, Any] = {}
    corner = nearest_corner(network, system)
    bent = {"nearest_corner": corner} if math.isfinite(corner) else {}
    if identified is not None:
        learned = {name: getattr(identified, name).tolist() for name in ("A", "B", "K")} | {"distance": off[0]}
    return {
        **options.record(),
        **learned,
        "offset_before_centring": off[1],
        "curvature": curvature(network, system, options.eta),
        **bent,
        "versions": {
            "python": platform.python_version(),
            "torch": torch.__version__.split("+")[0],
            "numpy": np.__version__,
        },
        "device": device.type,
    }
