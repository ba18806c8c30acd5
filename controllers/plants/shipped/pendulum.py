"""The inverted pendulum, trained."""

from __future__ import annotations

import math

from controllers.options import Plant, TrainingOptions
from controllers.plants.paper_preset import as_in_paper

PRESET = TrainingOptions(
    steps=40_000,
    dt=0.02,
    horizon=250,
    reward_offset=1.0,
    reward_weights=(1.0, 0.1),
    penalty=100.0,
    actor=(16, 16),
    critic=(64, 64),
    eta=0.1,
    n_A=200,
    n_B=200,
    refresh=10_000,
    gain_weight=3.0,
    state_weights=(1.0, 0.5),
    input_weights=(1.0,),
)


PLANT = Plant(
    preset=PRESET,
    paper=as_in_paper(PRESET),
    initial_states=(math.pi / 2, 2.0),
    positions=("theta",),
)
