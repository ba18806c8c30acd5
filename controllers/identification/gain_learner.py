"""The LQR gain of an unknown plant: A, then B, by least squares on transitions near the origin; then K.

Near the equilibrium `x+ = A x + B (u - u_eq)`. Transitions with zero action, u = u_eq, show A alone; B is
then fitted to what A leaves unexplained. In a ball of radius eta the linear fit of A is wrong by what the plant's
second-order terms look like on the states that were seen, of the order of eta; fitted along, they take that error
with them, and what is left is of the order of eta^2. A step is that of the training, for a plant in discrete time its
own. K solves the *discrete* Riccati equation, and
the control law is `u = u_eq - K x`: the Jacobian of a matching policy is -K (the paper writes +K, with the
other sign in K).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from certify.errors import OptionError
from controllers.identification.least_squares import fit_A, fit_B
from controllers.identification.riccati import riccati_gain
from controllers.options import Terms, Transitions

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Identified:
    """The plant as it was learned, `x+ = A x + B (u - u_eq)`, and the gain K for it."""

    A: Array
    B: Array
    K: Array


Phase = Literal["A", "B", "idle"]
Row = tuple[Array, Array, Array]


class GainLearner:
    """Collects transitions in the ball ||x|| <= eta and keeps the gain up to date: A always before B.

    A round first asks for `n_A` new transitions with zero action, then for `n_B` with the actor's actions;
    `refresh` starts the next round, and the gain of the last complete round stays in force until then. A is fitted to
    the transitions with zero action of all rounds so far, and B, given the newest A, to the others of all rounds: each
    round improves the estimate, whose random part falls with the number of transitions.

    Parameters
    ----------
    eta : radius of the ball, in the units of the states.
    n_A, n_B : transitions that fit A and B.
    Q, R : LQR weights, shapes (n, n) and (m, m).
    phase : what it asks for first; `idle` waits for a `refresh`.
    transitions : "latest" forgets those of earlier rounds, for a plant that changes.
    terms_A : what A is fitted with.
    """

    def __init__(
        self,
        eta: float,
        n_A: int,
        n_B: int,
        Q: Array,
        R: Array,
        phase: Phase = "A",
        transitions: Transitions = "all",
        terms_A: Terms = "linear",
    ) -> None:
        n, m = len(Q), len(R)
        least = n if terms_A == "linear" else n + n * (n + 1) // 2
        if n_A < least or n_B < m:
            raise OptionError(f"`n_A` and `n_B` must be at least {least} and {m}; found {n_A} and {n_B}.")
        self.eta, self.n_A, self.n_B, self.Q, self.R = eta, n_A, n_B, Q, R
        self.phase: Phase = phase
        self.transitions, self.terms_A = transitions, terms_A
        self.identified: Identified | None = None
        self._A: Array | None = None
        self._wanted: dict[Phase, int] = {"A": n_A, "B": n_B, "idle": 0}
        self._rows: dict[Phase, list[Row]] = {"A": [], "B": []}
        self._missing = self._wanted[phase]  # transitions that the phase still asks for

    def inside(self, x: Array) -> bool:
        """True if x lies in the ball."""
        return bool(x @ x <= self.eta**2)

    def observe(self, x: Array, v: Array, x_next: Array) -> None:
        """Take one transition, v = u - u_eq; it counts when x is in the ball and the phase asks for it."""
        if self.phase == "idle" or not self.inside(x) or (self.phase == "A" and np.any(v != 0)):
            return
        self._rows[self.phase].append((x, v, x_next))
        self._missing -= 1
        if self._missing > 0:
            return
        states, inputs, successors = (np.array(part) for part in zip(*self._rows[self.phase], strict=True))
        if self.phase == "A":
            self._A = fit_A(states, successors, self.terms_A)
            self._begin("B")
        elif self._A is not None:
            B = fit_B(states, inputs, successors, self._A)
            self.identified = Identified(self._A, B, riccati_gain(self._A, B, self.Q, self.R))
            self._begin("idle")

    def refresh(self) -> None:
        """Start a new round with A; a round that is under way continues."""
        if self.phase == "idle":
            self._begin("A")

    def transitions_used(self) -> list[Row]:
        """The transitions (x, v, x+) that A and B are fitted to, in rounds that are complete or under way."""
        return [*self._rows["A"], *self._rows["B"]]

    def state(self) -> dict[str, Any]:
        """Plain values for a checkpoint."""
        found = self.identified
        return {
            "phase": self.phase,
            "A": None if self._A is None else self._A.tolist(),
            "rows": {phase: [[part.tolist() for part in row] for row in rows] for phase, rows in self._rows.items()},
            "missing": self._missing,
            "identified": None if found is None else [found.A.tolist(), found.B.tolist(), found.K.tolist()],
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`, or from that of a run before `transitions`: the rows of the phase alone."""
        self.phase = state["phase"]
        self._A = None if state["A"] is None else np.array(state["A"])
        rows = state["rows"]
        if isinstance(rows, list):
            rows, missing = {self.phase: rows}, self._wanted[self.phase] - len(rows)
        else:
            missing = state["missing"]
        self._rows = {"A": [], "B": []}
        for phase in self._rows:
            self._rows[phase] = [(np.array(x), np.array(v), np.array(y)) for x, v, y in rows.get(phase, [])]
        self._missing = missing
        found = state["identified"]
        self.identified = None if found is None else Identified(*(np.array(part) for part in found))

    def _begin(self, phase: Phase) -> None:
        self.phase, self._missing = phase, self._wanted[phase]
        if self.transitions == "latest":
            self._rows = {"A": [], "B": []}
