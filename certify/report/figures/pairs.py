"""Choose the states to draw against each other, when there are more than two.

A coordinate is paired with its rate, which the equations show whatever the names are; any other state is paired with
the one that P couples it with most. The state that reaches furthest into its domain binds the set first, so its pair
comes first.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.expressions import differentiate, symbols_of, value_if_rational
from certify.loop.plants import System

Array = NDArray[np.float64]
Pair = tuple[int, int]
MOST = 6
"""Pairs that are chosen at most."""


def rates(system: System) -> list[Pair]:
    """(coordinate, rate) by index: the equation of the one has no input and, near the origin, only the other in it.

    Each state is in one pair at most: in a chain of integrators the second is a rate, and no coordinate as well.
    """
    origin = dict.fromkeys(system.states, Fraction(0))
    inputs = set(system.inputs)
    taken: set[int] = set()
    found: list[Pair] = []
    for i, equation in enumerate(system.exact_dynamics()):
        if i in taken or symbols_of(equation) & inputs:
            continue
        try:
            slopes = [value_if_rational(differentiate(equation, symbol), origin) for symbol in system.states]
        except InputError:
            continue
        felt = [j for j, slope in enumerate(slopes) if slope != 0]
        if len(felt) == 1 and felt[0] not in (i, *taken):
            found.append((i, felt[0]))
            taken |= {i, felt[0]}
    return found


def coupling(P: Array) -> Array:
    """The coupling of two states by P, `|P_ij| / sqrt(P_ii P_jj)` in [0, 1), shape (n, n); 0 on the diagonal."""
    scale = np.sqrt(np.diag(P))
    coupled = np.abs(P) / np.outer(scale, scale)
    np.fill_diagonal(coupled, 0.0)
    return np.asarray(coupled)


def pairs_of(system: System, P: Array, shares: Array) -> list[Pair]:
    """Pairs of states to show, at most `MOST`, that of the binding state first.

    Parameters
    ----------
    P : of `V = x'Px`, (n, n).
    shares : how far the set reaches into the domain along each state, (n,).
    """
    n = system.n
    if n == 2:
        return [(0, 1)]
    coupled = coupling(P)
    pairs = rates(system)
    for i in np.argsort(-shares, kind="stable").tolist():
        if not any(i in pair for pair in pairs):
            j = int(np.argmax(np.where(np.arange(n) == i, -1.0, coupled[i])))  # another state, also if P couples none
            pairs.append((min(i, j), max(i, j)))
    pairs = sorted(dict.fromkeys(pairs), key=lambda pair: -max(shares[list(pair)]))[:MOST]
    # Then the states that P couples most, until rows of two are full.
    others = sorted(combinations(range(n), 2), key=lambda pair: -coupled[pair])
    wanted = min(max(4, len(pairs) + len(pairs) % 2), MOST)
    for i, j in others:
        if len(pairs) >= wanted:
            break
        if (i, j) not in pairs and (j, i) not in pairs:
            pairs.append((i, j))
    return pairs


def named_pairs(system: System, texts: Sequence[str]) -> list[Pair]:
    """Pairs by names such as `x,x_dot`, in their order.

    Raises
    ------
    InputError : a text is not two different states of the plant.
    """
    names = [s.name for s in system.states]
    pairs = []
    for text in texts:
        given = [part.strip() for part in text.split(",")]
        if len(given) != 2 or given[0] == given[1] or not set(given) <= set(names):
            raise InputError(
                f"a pair must be two different states of {system.name}, as in {names[0]},{names[-1]}; found {text!r}. "
                f"Its states are {', '.join(names)}."
            )
        pairs.append((names.index(given[0]), names.index(given[1])))
    return pairs
