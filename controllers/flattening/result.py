"""The result of flattening, and the figures of a policy before and after."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

from certify.loop.policies import Policy

Ended = Literal["steps", "time limit"]


@dataclass(frozen=True, slots=True)
class Figures:
    """The figures of one policy: `departure` is what the hidden units may add, `bend` what they add on the box.

    `bend` is the root mean square of net(x) - net(0) - J x over states of the box, relative to that of J x; settled,
    states and cost are those of runs with inputs held, and cost is infinite where half of the runs diverge.
    """

    departure: float
    bend: float
    settled: int
    states: int
    cost: float


@dataclass(frozen=True, slots=True)
class Flattened:
    """The policy that was found, its figures before and after, and the change of the input on visited states.

    `rms` and `largest` are (m,), in the input's units, over the states that both closed loops visit; `gain_change` is
    the Jacobian's change at 0 on the box, relative to what it was; `factor` is the contraction that training began
    with. With curvature kept, `boxes` is the number of boxes that a set of this volume is forecast to take.
    """

    policy: Policy
    before: Figures
    after: Figures
    rms: tuple[float, ...]
    largest: tuple[float, ...]
    gain_change: float
    factor: float
    steps: int
    ended: Ended
    seconds: float
    boxes: float | None = None
    volume: float | None = None

    def as_json(self) -> dict[str, Any]:
        """Plain values; what is not finite becomes None."""

        def figures(found: Figures) -> dict[str, Any]:
            return {name: _finite(value) for name, value in asdict(found).items()}

        return {
            "system": self.policy.system,
            "sha256": self.policy.network.sha256(),
            "layers": list(self.policy.network.layers),
            "before": figures(self.before),
            "after": figures(self.after),
            "cost_change": _finite(self.after.cost / self.before.cost - 1) if self.before.cost else None,
            "input_change": {"rms": list(self.rms), "max": list(self.largest)},
            "gain_change": self.gain_change,
            "factor": self.factor,
            "forecast": None if self.boxes is None else {"volume": self.volume, "boxes": self.boxes},
            "steps": self.steps,
            "ended": self.ended,
            "seconds": {"total": self.seconds},
        }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
