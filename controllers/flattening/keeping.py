"""Flattening that keeps the curvature which lowers the cost of runs: certified training.

The departure knows no V and no set: it removes all curvature, useful or not. Here the loss is the logarithm of the
cost of simulated runs, differentiated through the plant, plus a multiple of the logarithm of the boxes that a proof of
a set of a given volume is forecast to take (`provable`), whose P is trained together with the policy. Bends that change
the cost little would go in time, so a distance from the linear feedback may be asked for: then they become those that
a proof absorbs most cheaply.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from certify.errors import OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import ball_volume, solve_lyapunov
from controllers.evaluation.curvature import nonlinearity_on
from controllers.flattening.contraction import contracted
from controllers.flattening.descent import CHECKS, Report
from controllers.flattening.options import FlattenOptions
from controllers.flattening.provable import ProvableSet
from controllers.flattening.result import Ended
from controllers.flattening.selection import Selection
from controllers.flattening.student import Student
from controllers.flattening.task import Task
from controllers.simulation.stepping import Stepper

Array = NDArray[np.float64]
FACTORS = tuple(math.pow(2.0, -k / 2) for k in range(13))
"""Contractions that training may begin with."""

BOXES = 0.05
"""Weight of the boxes' logarithm: e times fewer count like 5 % of the cost."""

_STAGES = ((2 / 3, 0.1), (1.0, 0.25))  # each half of the steps: share of the volume, size of boxes by their distance
_GAIN, _OUTSIDE, _LINEAR = 20.0, 2.0, 5.0  # weights: change of J(0), what passes the domain, distance that is missing
_SPARE = 1.1  # times the distance that is asked for
_NEAR = 256  # states on which a gradient step takes it
_RUNS, _STEPS = 32, 50  # runs of a gradient step, and their steps
_RESOLUTION = 0.5  # length of such a step, as a multiple of the loop's shortest time constant; at least the time step
_BOXES, _JUDGED = 128, 512  # boxes of a gradient step, and of a judgement
_STATES = 2000  # initial states to draw from
_RATE, _SET_RATE = 3e-3, 1e-2  # first steps of Adam, of a layer's weights and of L
_ALONE = 200  # steps of P alone
_EACH = 4  # steps of the options for one here, which is as much dearer


@dataclass(frozen=True, slots=True)
class Kept:
    """A judged policy's set, P (n, n) with {x'Px <= 1}, and the number of boxes that it is forecast to take."""

    P: Array
    boxes: float


def require_forecast(task: Task) -> None:
    """Reject a loop that no forecast can be made of.

    Raises
    ------
    OptionError : the plant is in discrete time, holds its input, has something uncertain, or the loop does not rest
        at the origin.
    """
    centred = task.old.centre != "none" or task.exactly_centred
    if task.system.in_steps or task.system.uncertain or not centred:
        raise OptionError(
            "`curvature` kept needs a plant in continuous time whose input follows at once, nothing uncertain, and a "
            "policy that is centred: the boxes of a proof can be forecast there only. Use `curvature` removed."
        )


def volume_of(options: FlattenOptions, box: Array) -> float:
    """The volume of the set to be proved: by default that of the ellipsoid of twice the box of initial states."""
    return options.volume if options.volume is not None else float(ball_volume(len(box)) * np.prod(2 * box))


class Keeping:
    """The descent.

    Parameters
    ----------
    selection : gets each iterate that is judged.
    began : time, as of `time.monotonic`, from which the limit counts.
    """

    def __init__(self, task: Task, selection: Selection, began: float) -> None:
        require_forecast(task)
        self.task, self.selection, self.began = task, selection, began
        self.generator = torch.Generator().manual_seed(task.options.seed)
        half_widths = np.array(task.plant.initial_states)
        drawn = np.random.default_rng(task.options.seed).uniform(-half_widths, half_widths, (_STATES, task.system.n))
        self.x0 = torch.from_numpy(drawn).float()
        loop = self._loop(task.goal)
        self.volume, self.box = volume_of(task.options, task.box), torch.from_numpy(half_widths).float()
        self.set = ProvableSet(loop, *self._stage(-1))
        asked = task.J.T @ np.diag(task.R) @ task.J
        worth = solve_lyapunov(loop.mean_rate(), np.diag(task.Q + 1e-9) + (asked + asked.T) / 2)
        self.worth = torch.from_numpy(worth).float()  # of a state where a run ends
        fastest = np.abs(np.linalg.eigvals(loop.mean_rate())).max()
        self.h = task.dt * max(1.0, math.floor(_RESOLUTION / (fastest * task.dt)))
        self.step = Stepper(task.system, self.h)
        self.found: dict[str, Kept] = {}  # by the hash of each judged policy

    def run(self, report: Report | None) -> tuple[float, int, Ended]:
        """Take gradient steps: the contraction that they began with, their number, and why they ended."""
        options, factor = self.task.options, self._first()
        start = contracted(self.task.goal, factor)
        student, steps, done = self._student(start), -(-options.steps // _EACH), 0
        self.selection.bound = 1 + self._provable(self.task.old)[1]
        self._judge(start)
        for stage, end in ((0, steps // 2), (1, steps)):
            self.set.aim(*self._stage(stage))
            taken, over = self._descend(student, end - done, stage == 1, done, report)
            done += taken
            if over:
                self.set.aim(*self._stage(-1))
                self._judge(self._exported(student))
                return factor, done, "time limit"
        return factor, done, "steps"

    def _stage(self, stage: int) -> tuple[float, float]:
        """The volume and the size of boxes that the set aims at."""
        of_volume, share = _STAGES[stage]
        return of_volume * self.volume, share

    def _descend(
        self, student: Student, steps: int, judged: bool, before: int, report: Report | None
    ) -> tuple[int, bool]:
        """Take so many gradient steps: those taken, and True if the time limit ended them."""
        groups = student.groups(self.x0.double().numpy(), _RATE)
        optimiser = torch.optim.Adam([*groups, {"params": list(self.set.parameters()), "lr": _SET_RATE}])
        rates, loss_of = [group["lr"] for group in optimiser.param_groups], self._loss(student)
        every = max(1, steps // CHECKS)
        for step in range(steps):
            if time.monotonic() - self.began > self.task.options.time_limit:
                return step, True
            for group, rate in zip(optimiser.param_groups, rates, strict=True):
                group["lr"] = rate * (1 - step / steps)
            loss, cost, size = loss_of()
            optimiser.zero_grad()
            if torch.isfinite(loss):  # else a run has diverged
                loss.backward()  # type: ignore[no-untyped-call]
                optimiser.step()
            if report is not None:
                report(_EACH * (before + step + 1), math.exp(cost.item()), math.exp(size.item()))
            if (step + 1) % every == 0 or step + 1 == steps:
                network = self._exported(student)
                self.set.turn(self._loop(network))
                if judged:
                    self._judge(network)
        return steps, False

    def _first(self) -> float:
        """The contraction to begin with, after P was trained for the smallest one.

        The smallest that leaves the distance asked for; else the largest of which every box that is drawn may be
        proved, and the smallest if none is.
        """
        student = self._student(contracted(self.task.goal, FACTORS[-1]))
        optimiser = torch.optim.Adam(self.set.parameters(), lr=_SET_RATE)
        for _ in range(_ALONE):
            size, short = self.set.log_boxes(student, self.generator, _BOXES)
            optimiser.zero_grad()
            (size + short + _OUTSIDE / BOXES * self.set.outside()).backward()  # type: ignore[no-untyped-call]
            optimiser.step()
        self.set.turn(self._loop(self.task.goal))
        wanted = self.task.options.distance
        if wanted:
            far = (
                factor for factor in reversed(FACTORS) if self._distance(contracted(self.task.goal, factor)) >= wanted
            )
            return next(far, FACTORS[0])
        for factor in FACTORS:
            _, short = self.set.log_boxes(self._student(contracted(self.task.goal, factor)), self._fixed(), _JUDGED)
            if short.item() == 0:
                return factor
        return FACTORS[-1]

    def _loss(self, student: Student) -> Callable[[], tuple[Tensor, Tensor, Tensor]]:
        """The loss of a gradient step, with its parts cost and logarithm of the boxes."""
        task = self.task
        box, J = torch.from_numpy(task.box), torch.from_numpy(task.J * task.box)
        slope = torch.from_numpy(task.slope())
        with torch.no_grad():
            before = self._costs(student, self.x0)
        wanted = _SPARE * task.options.distance

        def loss() -> tuple[Tensor, Tensor, Tensor]:
            rows = torch.randint(len(self.x0), (_RUNS,), generator=self.generator)
            cost = (self._costs(student, self.x0[rows]) / before[rows]).log().mean()
            gain = ((slope[:, None] * student.jacobian()) * box - J).square().sum() / J.square().sum()
            size, short = self.set.log_boxes(student, self.generator, _BOXES)
            provable = BOXES * task.options.weight * (size + short)
            total = cost + _GAIN * gain + provable + _OUTSIDE * self.set.outside()
            if wanted:
                x = (2 * torch.rand(_NEAR, task.system.n, generator=self.generator) - 1) * self.box
                total = total + _LINEAR * (wanted - student.distance(x)).clamp_min(0)
            return total, cost, size

        return loss

    def _costs(self, student: Student, x: Tensor) -> Tensor:
        """The costs (N,) of runs from states (N, n), of what is left at their end by the linearisation."""
        Q, R = (torch.from_numpy(diagonal).float() for diagonal in (self.task.Q, self.task.R))
        at_rest = torch.tensor([float(u) for u in self.task.u_eq])
        total = x.new_zeros(len(x))
        for _ in range(_STEPS):
            u = student(x)
            running = (Q * x * x).sum(1) + (R * (u - at_rest).square()).sum(1)
            total, x = total + self.h * running, self.step(x, u)
        costs: Tensor = total + ((x @ self.worth) * x).sum(1)
        return costs

    def _judge(self, network: PolicyNetwork) -> None:
        """Give a policy to the selection, with its cost and boxes as its objective, unless it is too nearly linear."""
        if self._distance(network) < self.task.options.distance:
            return
        boxes, provable = self._provable(network)
        self.found[network.sha256()] = Kept(self.set.P(), boxes)
        self.selection.keep(network, lambda figures: figures.cost / self.selection.before.cost + provable)

    def _provable(self, network: PolicyNetwork) -> tuple[float, float]:
        """The number of boxes of a policy with the present P, and the part of the objective that follows from P."""
        size, short = self.set.log_boxes(self._student(network), self._fixed(), _JUDGED)
        part = BOXES * self.task.options.weight * (size + short + 100 * self.set.outside())
        return math.exp(size.item()), part.item()

    def _distance(self, network: PolicyNetwork) -> float:
        return nonlinearity_on(network, self.task.u_eq, self.task.plant.initial_states).rms

    def _student(self, network: PolicyNetwork) -> Student:
        task = self.task
        return Student(network, task.value, task.folded, trains_biases=not task.exactly_centred)

    def _loop(self, network: PolicyNetwork) -> ClosedLoop:
        return ClosedLoop(self.task.system, network)

    def _fixed(self) -> torch.Generator:
        return torch.Generator().manual_seed(self.task.options.seed)

    def _exported(self, student: Student) -> PolicyNetwork:
        weights, biases = ([p.detach().double().numpy() for p in of] for of in (student.weights, student.biases))
        return self.task.with_layers(tuple(weights), tuple(biases))
