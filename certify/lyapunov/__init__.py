"""Quadratic Lyapunov functions `V(x) = x'Px`: candidates, coordinates, level sets."""

from __future__ import annotations

from certify.lyapunov.candidates import slowest_decay, solve_lyapunov
from certify.lyapunov.choice import SOLVED, Candidate, Chosen, Named, choose_candidate
from certify.lyapunov.level_sets import (
    are_inside,
    diagonalising_coordinates,
    domain_limit,
    extents,
    inverse,
    is_positive_definite,
    leaves_domain,
    semi_axes,
    volume,
)
from certify.lyapunov.optimised import optimise_candidate, optimise_repeatedly

__all__ = [
    "SOLVED",
    "Candidate",
    "Chosen",
    "Named",
    "are_inside",
    "choose_candidate",
    "diagonalising_coordinates",
    "domain_limit",
    "extents",
    "inverse",
    "is_positive_definite",
    "leaves_domain",
    "optimise_candidate",
    "optimise_repeatedly",
    "semi_axes",
    "slowest_decay",
    "solve_lyapunov",
    "volume",
]
