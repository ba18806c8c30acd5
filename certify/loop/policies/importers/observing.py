"""The inputs that a network of another program expects: states or expressions of them, measured from which point.

A policy and a Lyapunov network in one file read the same inputs. This module also samples the states of the domain at
which a network is compared with its framework.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import flint
import numpy as np

from certify.errors import InputError
from certify.loop.expressions import Expression, Number, Symbol, evaluate, substitute
from certify.loop.networks import Observe
from certify.loop.networks.floats import evaluated
from certify.loop.plants.equations import parse_expression
from certify.loop.plants.system import observations_of
from certify.loop.policies.importers.comparing import SAMPLES
from certify.loop.policies.importers.folding import Bounds
from certify.loop.policies.importers.options import ImportOptions
from certify.loop.policies.importers.reading import Reading
from certify.loop.policies.importers.steps import Diagonal, Step
from certify.loop.policies.network import Array
from certify.loop.rigorous import BallAlgebra, ball

if TYPE_CHECKING:
    from certify.loop.plants import System


@dataclass(frozen=True, slots=True)
class Observed:
    """The observations of a network: states of the plant by their numbers, `index`, or `expressions` of them."""

    plant: System
    index: tuple[int, ...] | None
    expressions: tuple[Expression, ...]

    @property
    def step(self) -> Observe:
        """The step that makes the observations of the states."""
        return Observe((0,), self.plant.states, self.expressions)

    def __call__(self, x: Array) -> Array:
        """The observations at states x (k, n), (k, reads)."""
        if self.index is not None:
            return np.asarray(x[:, list(self.index)])
        return np.asarray(evaluated(self.expressions, self.plant.states, x))

    @property
    def at_origin(self) -> tuple[Fraction | None, ...]:
        """Their exact values at the operating point; None for one that is no rational."""
        nothing = dict.fromkeys(self.plant.states, flint.arb(0))
        values = [evaluate(expression, nothing, BallAlgebra()) for expression in self.expressions]
        known = [v.is_exact() and v.is_finite() for v in values]
        return tuple(Fraction(str(v.fmpq())) if is_known else None for v, is_known in zip(values, known, strict=True))

    @property
    def count(self) -> int:
        """The number of observations."""
        return len(self.expressions)

    @property
    def words(self) -> str:
        """For people."""
        return ", ".join(map(str, self.expressions))

    @property
    def is_inexact(self) -> bool:
        """True if an observation of a number of single precision need not be one."""
        return self.index is None

    def may_leave(self, bounds: Sequence[Bounds]) -> bool:
        """True if an observation may leave its bounds somewhere, whatever the states."""
        anywhere = dict.fromkeys(self.plant.states, flint.arb(0, math.inf))
        for expression, (lo, hi) in zip(self.expressions, bounds, strict=True):
            value = evaluate(expression, anywhere, BallAlgebra())
            if (lo is not None and not value > ball(lo)) or (hi is not None and not value < ball(hi)):
                return True
        return False


def observed(states: tuple[str, ...] | None, plant: System, options: ImportOptions) -> Observed:
    """The observations that `--states` names; if it names none, those of the plant, or else its states. A parameter in
    them is its number: the policy's own, whatever the plant's is later.

    Raises
    ------
    InputError : one is no state of the plant, and no expression of its states and of parameters without a range.
    """
    known = {s.name: s for s in plant.states}
    if states is None and plant.observations:
        return Observed(plant, None, observations_of(plant))
    states = tuple(known) if states is None else states
    if all(name in known for name in states):
        if len(set(states)) != len(states):
            raise InputError(f"--states must name each state once; found {','.join(states)}.")
        return Observed(plant, tuple(list(known).index(name) for name in states), tuple(known[n] for n in states))
    expressions = []
    fixed = {Symbol(name): Number(q) for name, q in plant.parameters.items() if name not in plant.ranges}
    for text in states:
        if text.isidentifier() and text not in known:
            raise InputError(
                f"the network must read states of {plant.name}, {', '.join(known)}, or expressions of them, such as "
                f"cos({plant.states[0]}); --states names {text!r}."
            )
        try:
            found = parse_expression(text, known | {p.name: p for p in fixed}, f"state or parameter of {plant.name}")
            expressions.append(substitute(found, fixed))
        except InputError as error:
            raise InputError(f"--states must name states of {plant.name}, or expressions of them: {error}") from error
    x_eq = dict(zip(plant.states, plant.exact_x_eq(), strict=True))
    if options.observes == "absolute" and any(x_eq.values()):
        expressions = [substitute(e, {s: s + q for s, q in x_eq.items()}) for e in expressions]
    return Observed(plant, None, tuple(expressions))


def shift(x_eq: list[Fraction], options: ImportOptions) -> tuple[Step, ...]:
    """The step from deviations to the states' values, for a network that reads values; else none."""
    return (Diagonal((Fraction(1),), tuple(x_eq)),) if options.observes == "absolute" and any(x_eq) else ()


def require_equilibrium(reading: Reading, x_eq: list[Fraction]) -> None:
    """Refuse a network that is centred at another point than the plant's.

    Raises
    ------
    InputError : it is.
    """
    if reading.equilibrium is None:
        return
    wanted = np.array([float(v) for v in x_eq])
    if np.any(np.float32(wanted) != np.float32(reading.equilibrium)):
        raise InputError(
            f"a two-stage policy must be centred at the plant's operating point, {wanted.tolist()} as it observes it; "
            f"its x_equilibrium is {reading.equilibrium.tolist()}."
        )


def over_states(weight: Array, index: Sequence[int], n: int) -> Array:
    """The first layer's weight over all n states of the plant, (out, n); 0 where the network does not read a state."""
    whole = np.zeros((len(weight), n))
    whole[:, list(index)] = weight
    return whole


def sample(plant: System, valid: Array | None) -> Array:
    """States in the domain where no observation is clipped, as numbers of single precision, (k, n).

    Raises
    ------
    InputError : every observation of a state is clipped in the domain.
    """
    box = np.array([[float(lo), float(hi)] for lo, hi in plant.domain])
    if valid is not None:
        box = np.stack([np.maximum(box[:, 0], valid[:, 0]), np.minimum(box[:, 1], valid[:, 1])], axis=1)
        empty = np.flatnonzero(~(box[:, 0] < box[:, 1]))
        if empty.size:
            state, (lo, hi) = plant.states[empty[0]], valid[empty[0]]
            raise InputError(
                f"the domain of {state} must have a part where its observation is not clipped, [{lo:.6g}, {hi:.6g}]; "
                "it has none."
            )
    lo, hi = box.T
    # Single precision must not round a state out of the box, where a clip begins to act.
    margin = 1e-6 * np.maximum(hi - lo, np.maximum(np.abs(lo), np.abs(hi)))
    inner = np.where(2 * margin < hi - lo, margin, 0)
    x = np.random.default_rng(0).uniform(lo + inner, hi - inner, (SAMPLES, plant.n))
    return x.astype(np.float32).astype(np.float64)
