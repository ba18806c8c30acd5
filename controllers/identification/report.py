"""The plant that a trainer learned, beside the ranges that its own transitions guarantee of A, B and the gain K.

Least squares and the Riccati equation have no bound of their errors. Where the errors of states, and what a step has
beyond `A x + B (u - u_eq)`, are bounded, the same finite number of transitions leaves ranges of the true A and B, and
these leave a range of the gain that the true plant would have. No chance is in them, and no prior.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.analysis.identifying.linear import terms_of
from certify.errors import InputError, OptionError
from certify.loop.expressions import Expression
from certify.loop.plants import System
from certify.report.words import above, below
from controllers.identification.enclosed_gain import Box, enclosed_gain
from controllers.identification.gain_learner import Identified, Row
from controllers.identification.guaranteed import guaranteed_ranges, residual_bounds

Array = NDArray[np.float64]
SCHEMA = "controllers-identify/1"
_MOST_ENTRIES = 30  # of A and B, which a table has


@dataclass(frozen=True, slots=True)
class Declared:
    """The assumptions of the ranges.

    Parameters
    ----------
    second : by state, a bound of what its next value has beyond the linear part, as text in deviations of states and
        inputs, such as "0.2*theta**2"; a state without one is linear.
    noise : a bound of the errors of measured states, of rounding too: one for all, or by state; positive.
    """

    second: Mapping[str, str]
    noise: Fraction | Mapping[str, Fraction]

    def terms(self, system: System) -> dict[str, list[Expression]]:
        """The terms of each bound `second`.

        Raises
        ------
        InputError : something names no state, a bound is no expression in states and inputs, or noise is not positive.
        """
        states, names = [s.name for s in system.states], [s.name for s in (*system.states, *system.inputs)]
        given = self.noise_of(system)
        for option, named in (("second", self.second), ("noise", given)):
            odd = next((name for name in named if name not in states), None)
            if odd is not None:
                raise OptionError(f"`{option}` names {odd!r}; {system.name} has {', '.join(states)}.")
        if not all(given.get(s, 0) > 0 for s in states):
            raise OptionError("`noise` must be a positive bound of each state's error; it has to cover rounding too.")
        return {s: terms_of(text, names, s) for s, text in self.second.items()}

    def noise_of(self, system: System) -> Mapping[str, Fraction]:
        """The bounds of the errors by state."""
        return self.noise if isinstance(self.noise, Mapping) else {s.name: self.noise for s in system.states}


@dataclass(frozen=True, slots=True)
class IdentifyReport:
    """Learned matrices, and ranges that hold those of the true plant if what is declared holds.

    Parameters
    ----------
    learned : A, B and K of the trainer; they need not lie in the ranges, as least squares asks for no consistency.
    A, B, K : the ranges; K is None where no enclosure of the Riccati equation was found.
    shares : by state, the least share of the declared bounds that the transitions allow, by linear programs.
    second, noise : what was declared, by state.
    transitions : how many there were.
    """

    learned: Identified
    A: Box
    B: Box
    K: Box | None
    shares: Mapping[str, float]
    second: Mapping[str, str]
    noise: Mapping[str, Fraction]
    transitions: int

    def to_dict(self) -> dict[str, Any]:
        """Plain values; ranges are rounded outwards."""
        found: dict[str, Any] = {
            "schema": SCHEMA,
            "transitions": self.transitions,
            "second": dict(self.second),
            "noise": {s: str(w) for s, w in self.noise.items()},
            "least_share": dict(self.shares),
        }
        for name, box in (("A", self.A), ("B", self.B), ("K", self.K)):
            ends = None if box is None else {"lo": box.lo.tolist(), "hi": box.hi.tolist()}
            found[name] = {"learned": getattr(self.learned, name).tolist(), "range": ends}
        return found

    def lines(self) -> Iterator[str]:
        """A table for people: of each entry the learned value, its range, and how far the value is off at most."""
        small = self.A.lo.size + self.B.lo.size <= _MOST_ENTRIES
        shown = [("A", self.A), ("B", self.B), ("K", self.K)] if small else [("K", self.K)]
        yield f"from {self.transitions} transitions; the data allow {_share(self.shares)} of the declared bounds"
        if not small:
            yield f"A and B     off by at most {above(_farthest(self.learned.A, self.A), 3)} and " + above(
                _farthest(self.learned.B, self.B), 3
            )
        yield f"{'entry':<6}{'learned':>12}  {'range':<32}off by at most"
        for name, box in shown:
            learned = getattr(self.learned, name)
            if box is None:
                yield "K     no enclosure: the ranges of A and B are too wide; more transitions, or a smaller eta"
                continue
            for (i, k), value in np.ndenumerate(learned):
                lo, hi = float(box.lo[i, k]), float(box.hi[i, k])
                most = above(max(hi - value, value - lo), 3)
                yield f"{f'{name}{i + 1}{k + 1}':<6}{value:>12.6g}  {f'{below(lo, 7)} to {above(hi, 7)}':<32}{most}"


def identify_report(
    learned: Identified, rows: Sequence[Row], system: System, weights: tuple[Array, Array], declared: Declared
) -> IdentifyReport:
    """Bound A, B and K by the transitions to which they were fitted.

    Parameters
    ----------
    rows : transitions (x, v, x+), deviations from the operating point, the input as it acted.
    weights : Q (n, n) and R (m, m) of the Riccati equation.

    Raises
    ------
    InputError : as `Declared.terms` says, the transitions do not determine A and B, no A and B are consistent with them
        and with what is declared, or a weight is 0.
    """
    terms, given, names = (
        declared.terms(system),
        declared.noise_of(system),
        [*map(str, (*system.states, *system.inputs))],
    )
    states = names[: system.n]
    noise = np.array([np.nextafter(float(given[s]), np.inf) for s in states])
    x, v, x_next = (np.array(part) for part in zip(*rows, strict=True))
    errors, beyond = np.concatenate([noise, np.zeros(system.m)]), np.zeros(x.shape)
    for s, of in terms.items():
        beyond[:, states.index(s)] = residual_bounds(of, names, np.hstack([x, v]), errors)
    A, B, shares = guaranteed_ranges(x, v, x_next, beyond, noise)
    by_state = dict(zip(states, shares.tolist(), strict=True))
    worst = max(by_state, key=lambda s: by_state[s])
    if not by_state[worst] <= 1:
        raise InputError(
            f"no A and B are consistent with the {len(rows)} transitions: of {worst} the bounds must be at least "
            f"{above(by_state[worst], 3)} times those that `noise` and `second` declare."
        )
    return IdentifyReport(learned, A, B, enclosed_gain(A, B, *weights), by_state, declared.second, given, len(rows))


def _farthest(learned: Array, box: Box) -> float:
    return float(np.max(np.maximum(box.hi - learned, learned - box.lo)))


def _share(shares: Mapping[str, float]) -> str:
    return ", ".join(f"{100 * share:.3g} % ({s})" for s, share in shares.items())
