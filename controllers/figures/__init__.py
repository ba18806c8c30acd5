"""Figures of training and of comparisons, one a file, drawn as PNG with matplotlib's object-oriented interface."""

from __future__ import annotations

from controllers.figures.cost_and_norm import draw_over_time
from controllers.figures.gain_distance import draw_gain
from controllers.figures.learning_curves import draw_curves
from controllers.figures.paths import draw_space
from controllers.figures.positions import draw_positions
from controllers.figures.proved_sets import draw_growth
from controllers.figures.states import draw_states

__all__ = [
    "draw_curves",
    "draw_gain",
    "draw_growth",
    "draw_over_time",
    "draw_positions",
    "draw_space",
    "draw_states",
]
