"""The planar quadrotor, trained.

The LQR weights keep the closed loop's rates between 0.7 and 7 per second, and with them the condition of P: what is
proved shrinks with it. The preset `paper` keeps what decides where episodes begin: without a gain none would pass the
ball in which A and B are learned.
"""

from __future__ import annotations

from controllers.options import Plant, TrainingOptions
from controllers.plants.paper_preset import as_in_paper

PRESET = TrainingOptions(
    steps=20_000,
    dt=0.02,
    horizon=250,
    start=0.35,
    reward_offset=1.0,
    reward_weights=(1.0, 1.0, 1.0, 0.1, 0.1, 0.1),
    penalty=100.0,
    actor=(256,) * 4,
    critic=(128, 128),
    curvature_weight=0.5,
    rest_weight=1.0,
    eta=0.1,
    n_A=600,
    n_B=600,
    refresh=10_000,
    gain_weight=3.0,
    state_weights=(1.0, 1.0, 1.0, 0.1, 0.1, 0.1),
    input_weights=(10.0,) * 2,
)


PLANT = Plant(
    preset=PRESET,
    paper=as_in_paper(PRESET, but=("start", "ball")),
    initial_states=(1.0, 1.0, 0.5, 1.0, 1.0, 1.0),
    positions=("x", "y", "theta"),
)
