"""The set that is forecast to be proved: of policies as they were trained and as they were flattened."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from certify.loop.plants import get_system
from certify.loop.policies import load_policy
from controllers.evaluation.forecast import forecast_of
from controllers.options import get_plant

ROOT = Path(__file__).parents[3]


@pytest.mark.slow
def test_the_curved_quadrotor_has_less_than_its_box_and_the_flattened_one_more():
    """Proved at effort 1: 0.0088 of the one, 2,983 of the other, with a P that solves no Lyapunov equation."""
    box = get_plant("quadrotor2d").initial_states
    curved, flat = (
        forecast_of(load_policy(ROOT / path).network, get_system("quadrotor2d"), box)
        for path in ("tests/data/quadrotor2d_curved.pt", "examples/policies/quadrotor2d.pt")
    )
    assert 1e-4 < curved.volume < 0.1 and curved.size < 0.6
    assert flat.size > 1 and flat.volume > 10
    ellipsoid = np.pi**3 / 6 * np.prod(box)
    assert curved.size == pytest.approx((curved.volume / ellipsoid) ** (1 / 6))


def test_none_is_made_in_twelve_states():
    network = load_policy(ROOT / "tests/data/quadrotor3d_curved.pt").network
    assert forecast_of(network, get_system("quadrotor3d"), get_plant("quadrotor3d").initial_states) is None
