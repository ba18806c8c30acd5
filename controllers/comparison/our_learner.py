"""Our trainer as a learner: ours, its ablations, and the same SAC without the gain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from certify.certificates import write_atomically
from certify.loop.policies import Policy, save_policy
from controllers.comparison.run_files import ACTOR, POLICY
from controllers.comparison.trained import Trained, from_checkpoint
from controllers.training.checkpoint import CHECKPOINT_FORMAT, written_checkpoint
from controllers.training.record import parameters_of
from controllers.training.trainer import Trainer

Array = NDArray[np.float64]


class OurLearner:
    """A run of our trainer; a `controllers.comparison.finished_run.Learner`.

    Parameters
    ----------
    trainer : the run.
    whole : keep the whole actor, as it is sampled and not centred; False keeps the policy as it ships.
    """

    def __init__(self, trainer: Trainer, whole: bool) -> None:
        self.trainer, self.whole = trainer, whole

    @property
    def steps_done(self) -> int:
        """Environment steps so far."""
        return self.trainer.steps_done

    @property
    def closing(self) -> tuple[int, int] | None:
        """The two steps of `close`; None before it."""
        return self.trainer.closing

    def advance(self, steps: int, tell: Callable[[int], None] = lambda done: None) -> None:
        """Take steps until so many are made in all; `tell` gets the number after each."""
        torch.set_num_threads(self.trainer.options.threads)
        while self.trainer.steps_done < steps:
            self.trainer.advance()
            tell(self.trainer.steps_done)

    def close(self, begin: int, end: int) -> None:
        """Let the actor's step fall linearly to zero between these two steps."""
        self.trainer.close(begin, end)

    def trained(self) -> Trained:
        """The policy as it is."""
        if self.whole:
            return from_checkpoint(self.actor(), self.trainer.system)
        network, u_eq = self.trainer.sac.actor.network(), self.trainer.system.exact_u_eq()
        folded, options = network.folded(u_eq), self.trainer.options
        return Trained(self.trainer.system.name, self.steps_done, options.seed, lambda x: np.asarray(folded(x, u_eq)))

    def keep(self, folder: Path) -> None:
        """Write `policy.pt`, the mean action as a policy file, and if the actor is kept whole `actor.pt`."""
        trainer = self.trainer
        if not self.whole:
            save_policy(folder / POLICY, trainer.policy())
            return
        write_atomically(folder / ACTOR, self.actor())
        mean = replace(trainer.sac.actor.network(), centre="none")
        record = {**trainer.options.record(), "steps": trainer.steps_done, "centre": "none"}
        save_policy(folder / POLICY, Policy(mean, trainer.system.name, parameters_of(trainer.system), training=record))

    def actor(self) -> bytes:
        """A checkpoint without all that a run needs to be resumed: `from_checkpoint` reads it."""
        trainer = self.trainer
        state = {
            "format": CHECKPOINT_FORMAT,
            "system": [trainer.system.name, parameters_of(trainer.system)],
            "options": trainer.options.record(),
            "steps_done": trainer.steps_done,
            "sac": {"actor": trainer.sac.actor.state_dict()},
        }
        return written_checkpoint(state)

    def snapshot(self) -> bytes:
        """The bytes of a checkpoint, with everything that the rest of the run depends on."""
        return self.trainer.snapshot()

    def restore(self, checkpoint: bytes) -> None:
        """Continue from `snapshot()`; raises as `Trainer.restore`."""
        self.trainer.restore(checkpoint)
