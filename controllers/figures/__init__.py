"""Figures of training and of comparisons, one a file, drawn as PNG with matplotlib's object-oriented interface."""

from __future__ import annotations

from controllers.figures.curves import draw_curves
from controllers.figures.gain import draw_gain
from controllers.figures.growth import draw_growth
from controllers.figures.over_time import draw_over_time
from controllers.figures.positions import draw_positions
from controllers.figures.space import draw_space
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
