"""The learner of each kind of run, and its evaluation on the way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from certify.certificates import sole_writer
from certify.loop.plants import System
from controllers.comparison.finished_run import follow
from controllers.comparison.learning_curve import Measurement
from controllers.comparison.methods import OURS, Run
from controllers.comparison.options import CompareOptions
from controllers.comparison.our_learner import OurLearner
from controllers.comparison.run_files import ENDED
from controllers.comparison.stable_baselines.learner import Sb3Learner
from controllers.comparison.stable_baselines.model import ROLLOUT, budget
from controllers.comparison.stopping import Plan, Stopping
from controllers.comparison.table import Response, table
from controllers.options import TrainingOptions
from controllers.simulation.closed_loop import Action
from controllers.simulation.trajectories import initial_states, simulate
from controllers.training.trainer import Trainer


def without_gain(options: TrainingOptions) -> TrainingOptions:
    """The same SAC without the gain: no term of it in the actor's loss, no identification."""
    return replace(options, gain_weight=0.0, identification="never")


_JUDGED = CompareOptions(states=100, start_seed=1)  # during a run: other states than those of a table


def variant(run: Run, training: TrainingOptions) -> TrainingOptions:
    """The options of a run; of stable-baselines3 those of the preset."""
    if run == "sac":
        return without_gain(training)
    if run == "before":
        return replace(training, identification="before")
    return replace(training, centre="none") if run == "uncentred" else training


def train_run(
    run: Run, system: System, training: TrainingOptions, folder: Path, plan: Plan, tell: Callable[[int], None]
) -> None:
    """Train a run in its folder, from its beginning or its checkpoint to its end; one that is over is left alone."""
    with sole_writer(folder):
        if (folder / ENDED).is_file():  # another process has ended it since it was looked for
            return
        learner = learner_of(run, system, training, plan)
        follow(learner, plan, folder, lambda: measure(system, training, learner.trained().mean), tell)


def learner_of(run: Run, system: System, training: TrainingOptions, plan: Plan) -> OurLearner | Sb3Learner:
    """A run at its beginning."""
    training = run_options(run, training, plan)
    if run == "sb3-sac":
        return Sb3Learner("sac", system, training)
    if run == "sb3-ppo":
        rollout = ROLLOUT if isinstance(plan, Stopping) else budget("ppo", training.steps)[1]
        return Sb3Learner("ppo", system, training, rollout)
    return OurLearner(Trainer(system, training), whole=run == "sac")


def run_options(run: Run, training: TrainingOptions, plan: Plan) -> TrainingOptions:
    """The options with which a run is trained."""
    if isinstance(plan, Stopping):  # its own closing phase takes the place of the preset's
        most = plan.budget + round(plan.closing * plan.budget)
        training = replace(training, steps=most, anneal=0.0)
    return variant(run, training)


def measure(system: System, training: TrainingOptions, mean: Action) -> Measurement:
    """The figures of a policy on the way, from other states than those of the table."""
    x0 = initial_states(system, _JUDGED.states, _JUDGED.start_seed)
    x, cost = simulate(system, training, mean, x0, _JUDGED.span(system)[0])
    [row, _] = table(system, training.dt, [Response(OURS, 0, 0, x, cost)], _JUDGED)
    return Measurement(row.floor, row.cost_median, row.left_domain, row.trajectories)
