"""Lyapunov functions: quadratic, neural, polynomial; candidates, coordinates and sublevel sets of quadratic ones."""

from __future__ import annotations

from certify.lyapunov.candidates import increment_matrix, slowest_decay, solve_lyapunov
from certify.lyapunov.choice import BEYOND, SOLVED, Beyond, Candidate, Chosen, Named, choose_candidate
from certify.lyapunov.file import StoredLyapunov, load_lyapunov, save_lyapunov
from certify.lyapunov.function import LyapunovFunction, Quadratic
from certify.lyapunov.importing import ImportedLyapunov, import_lyapunov
from certify.lyapunov.level_sets import (
    are_inside,
    ball_volume,
    diagonalising_coordinates,
    domain_limit,
    extents,
    inverse,
    is_positive_definite,
    leaves_domain,
    semi_axes,
    volume,
)
from certify.lyapunov.neural import Neural
from certify.lyapunov.optimised import optimise_candidate, optimise_repeatedly
from certify.lyapunov.polynomial import Polynomial
from certify.lyapunov.sampled import sampled_volume
from certify.lyapunov.symbolic import Symbolic, of_polynomial

__all__ = [
    "BEYOND",
    "SOLVED",
    "Beyond",
    "Candidate",
    "Chosen",
    "ImportedLyapunov",
    "LyapunovFunction",
    "Named",
    "Neural",
    "Polynomial",
    "Quadratic",
    "StoredLyapunov",
    "Symbolic",
    "are_inside",
    "ball_volume",
    "choose_candidate",
    "diagonalising_coordinates",
    "domain_limit",
    "extents",
    "import_lyapunov",
    "increment_matrix",
    "inverse",
    "is_positive_definite",
    "leaves_domain",
    "load_lyapunov",
    "of_polynomial",
    "optimise_candidate",
    "optimise_repeatedly",
    "sampled_volume",
    "save_lyapunov",
    "semi_axes",
    "slowest_decay",
    "solve_lyapunov",
    "volume",
]
