"""A closed loop with the V of its Lyapunov equation and coordinates for boxes: what the engines are tried on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certify.certificates.claims import Problem
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import diagonalising_coordinates, solve_lyapunov
from certify.lyapunov.function import Quadratic


@dataclass(frozen=True)
class Case:
    """T (n, n): x = T z."""

    problem: Problem
    T: np.ndarray

    @property
    def loop(self) -> ClosedLoop:
        return self.problem.loop

    @property
    def P(self) -> np.ndarray:
        return self.problem.V.P


def case_of(system: System, network: PolicyNetwork, P: np.ndarray | None = None) -> Case:
    """V from the Lyapunov equation with Q = I, unless P is given."""
    loop = ClosedLoop(system, network)
    A, _, _ = loop.linearise()
    P = solve_lyapunov(A, np.eye(system.n)) if P is None else P
    return Case(Problem(loop, Quadratic(P)), diagonalising_coordinates(P, A))
