"""The departures from the paper, as changes of a preset that undo them, and the preset `paper`.

The paper is Quartz, Zhou, De Sterck, Liu, "Stochastic Reinforcement Learning with Stability Guarantees for Control of
Unknown Nonlinear Systems" (AAAI 2025, arXiv 2409.08382). Each departure was made for a reason, and each can be undone:
alone, to see what it costs, or with all others, which is the preset `paper`. A number that the paper leaves open has no
entry: there a preset named after it has ours. `docs/departures.md` gives the reasons and the measurements.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from certify.errors import InputError
from controllers.options import TrainingOptions


@dataclass(frozen=True, slots=True)
class Departure:
    """One thing that is done otherwise here.

    Parameters
    ----------
    name : a word for commands and tables.
    paper : what the paper has.
    undoing : the options, of those of a preset, that do as the paper does, with their values.
    """

    name: str
    paper: str
    undoing: Callable[[TrainingOptions], Mapping[str, Any]]

    def undone(self, options: TrainingOptions) -> TrainingOptions:
        """The options with this departure undone; equal to `options` where they do not depart in it."""
        return replace(options, **self.undoing(options))


DEPARTURES = (
    Departure("critics", "value and Q networks as wide and deep as the actor", lambda ours: {"critic": ours.actor}),
    Departure("critic-scale", "values are the networks' outputs", lambda ours: {"critic_scale": 1.0}),
    Departure("gain-weight", "the gain's term has the weight 1", lambda ours: {"gain_weight": 1.0}),
    Departure("gain-norm", "the spectral norm ties the Jacobian to the gain", lambda ours: {"gain_norm": "spectral"}),
    Departure("centring", "pi(x) = mu(x) - mu(0) + u_eq, after the squash", lambda ours: {"centre": "output"}),
    Departure("annealing", "a constant learning rate", lambda ours: {"anneal": 0.0}),
    Departure("warm-up", "the policy acts and learns from the first step on", lambda ours: {"warm_up": 0}),
    Departure("log-std", "no bounds on the standard deviation", lambda ours: {"log_std": ()}),
    Departure("reward", "the reward of (x, u) is that of x", lambda ours: {"reward_at": "current"}),
    Departure(
        "ball", "A and B are fitted to what passes near the origin", lambda ours: {"identification_starts": "domain"}
    ),
    Departure("start", "episodes start in the whole domain", lambda ours: {"start": 1.0}),
    Departure(
        "terms-for-proofs",
        "no other term in the actor's loss",
        lambda ours: {"curvature_weight": 0.0, "rest_weight": 0.0, "proof_weight": 0.0},
    ),
)
"""All of them, in the order of the table in `docs/departures.md`."""


def as_in_paper(options: TrainingOptions, but: Sequence[str] = ()) -> TrainingOptions:
    """The options with every departure undone.

    Parameters
    ----------
    options : a preset of ours.
    but : names of departures that stay.

    Raises
    ------
    InputError : a name in `but` is none of a departure.
    """
    names = [departure.name for departure in DEPARTURES]
    unknown = [name for name in but if name not in names]
    if unknown:
        raise InputError(f"departures from the paper must be among {', '.join(names)}; found {unknown[0]!r}.")
    for departure in DEPARTURES:
        if departure.name not in but:
            options = departure.undone(options)
    return options
