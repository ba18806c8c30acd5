"""The result of distillation, and how far it is from its source."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from certify.loop.policies import Policy
from controllers.evaluation.settling import Settling


@dataclass(frozen=True, slots=True)
class Distilled:
    """The policy that was found, and its distance from its source.

    `largest` and `mean` are (m,), absolute differences of the inputs, in their units, over states that are uniform in
    the domain and were not imitated; `gain_error` is the Jacobian's difference at 0 on the domain, relative to the
    source's; `source` and `own` are runs of both from the same initial states, inputs held; `corner` is the share of
    the domain up to the nearest corner of a unit, infinite for smooth units.
    """

    policy: Policy
    states: int
    largest: tuple[float, ...]
    mean: tuple[float, ...]
    gain_error: float
    source: Settling
    own: Settling
    corner: float
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """Plain values; what is not finite becomes None."""

        def runs(found: Settling) -> dict[str, Any]:
            return {"settled": found.settled, "states": found.states, "cost": _finite(found.cost)}

        return {
            "system": self.policy.system,
            "sha256": self.policy.network.sha256(),
            "layers": list(self.policy.network.layers),
            "activation": self.policy.network.activation,
            "centre": self.policy.network.centre,
            "difference": {"max": list(self.largest), "mean": list(self.mean), "states": self.states},
            "gain_error": self.gain_error,
            "source": runs(self.source),
            "distilled": runs(self.own),
            "nearest_corner": _finite(self.corner),
            "seconds": {"total": self.seconds},
        }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
