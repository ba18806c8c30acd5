"""The gradient descent of flattening: Adam on fit, gain and departure, and states that are added on the way."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from certify.loop.policies import PolicyNetwork
from controllers.flattening.result import Ended
from controllers.flattening.selection import GAIN, Selection
from controllers.flattening.student import Student
from controllers.flattening.task import SMALLEST, Task

Array = NDArray[np.float64]
Report = Callable[[int, float, float], None]

CHECKS = 8
"""Number of times that the iterate is judged by simulation; as often the states that it visits are added."""


class Descent:
    """A descent from one policy, with the states (N, n) that policies have visited so far.

    Parameters
    ----------
    selection : gets each iterate that is judged.
    began : time, as of `time.monotonic`, from which the limit counts.
    """

    def __init__(self, task: Task, selection: Selection, began: float) -> None:
        self.task, self.selection, self.began = task, selection, began
        self.states = selection.states
        self._generator = torch.Generator().manual_seed(task.options.seed)

    def run(self, start: PolicyNetwork, report: Report | None) -> tuple[int, Ended]:
        """Take gradient steps from `start`; their number, and why they ended."""
        options, every = self.task.options, max(1, self.task.options.steps // CHECKS)
        student = Student(start, self.task.value, self.task.folded, trains_biases=not self.task.exactly_centred)
        optimiser = torch.optim.Adam(student.groups(self.states, options.rate))
        rates = [group["lr"] for group in optimiser.param_groups]
        loss_of = self._loss(student)
        self._add(start)
        states, wanted = self._data()
        for step in range(options.steps):
            if time.monotonic() - self.began > options.time_limit:
                if step % every:  # not judged yet
                    self.selection.keep(self._exported(student))
                return step, "time limit"
            for group, rate in zip(optimiser.param_groups, rates, strict=True):
                group["lr"] = rate * (1 - step / options.steps)
            rows = torch.randint(len(states), (options.batch,), generator=self._generator)
            loss, fit, bends = loss_of(states[rows], wanted[rows])
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            if report is not None:
                report(step + 1, fit.item(), bends.item())
            if (step + 1) % every == 0 or step + 1 == options.steps:
                network = self._exported(student)
                self.selection.keep(network)
                self._add(network)
                states, wanted = self._data()
        return options.steps, "steps"

    def _loss(self, student: Student) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]:
        """The loss of a batch of states and the goal's inputs there, with its parts fit and departure."""
        task = self.task
        box = torch.from_numpy(task.box)
        J, size = torch.from_numpy(task.J * task.box), torch.from_numpy(self.selection.size).float()
        largest = J.square().sum().clamp_min(SMALLEST)
        slope = torch.from_numpy(task.slope())

        def loss(states: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            change = (student(states) - wanted) / size
            fit = change.square().sum(1).mean()
            gain = ((slope[:, None] * student.jacobian()) * box - J).square().sum() / largest
            bends = student.departure(box)
            return fit + GAIN * gain + task.options.weight * bends, fit, bends

        return loss

    def _add(self, network: PolicyNetwork) -> None:
        self.states = np.concatenate([self.states, self.task.visited(network)])

    def _data(self) -> tuple[Tensor, Tensor]:
        """The states visited so far and the goal's inputs there, in single precision."""
        inputs = self.task.inputs(self.task.goal, self.states)
        return torch.from_numpy(self.states).float(), torch.from_numpy(inputs).float()

    def _exported(self, student: Student) -> PolicyNetwork:
        weights, biases = (
            tuple(p.detach().double().numpy() for p in parameters) for parameters in (student.weights, student.biases)
        )
        return self.task.with_layers(weights, biases)
