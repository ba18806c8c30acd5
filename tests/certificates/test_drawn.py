"""States drawn from the set of a certificate: they lie in it and fill it, and the policy is compared on them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from certify import certify_roa, load_policy
from certify.certificates import drawn as module
from certify.certificates import parse_certificate
from certify.certificates.drawn import nonlinearity_of, states_in
from certify.certificates.ellipsoids import sublevel_set, tube_start
from certify.certificates.membership import Region
from certify.loop.policies.nonlinearity import nonlinearity
from certify.lyapunov.sublevel import Sublevel
from certify.report.words import above

PENDULUM = Path(__file__).parents[2] / "examples" / "policies" / "pendulum.pt"
P = np.array([[3.0, 1.0], [1.0, 0.5]])
BOX = (np.full(2, -9.0), np.full(2, 9.0))


def test_states_are_uniform_in_the_ellipsoid():
    """Half of the area lies within 1 / sqrt(2) of the boundary's V, and the mean of x x' is level P^-1 / (n + 2)."""
    x = states_in(Region((sublevel_set(P, 2.0),)), BOX)
    V = np.einsum("bi,ij,bj->b", x, P, x)
    assert V.max() <= 2.0 and abs((V <= 1.0).mean() - 0.5) < 0.05
    np.testing.assert_allclose(x.T @ x / len(x), 2.0 * np.linalg.inv(P) / 4, rtol=0.15)
    np.testing.assert_array_equal(x, states_in(Region((sublevel_set(P, 2.0),)), BOX))


def test_a_tube_is_asked_about_where_it_starts():
    inner, centre = sublevel_set(P, 0.01), (4.0, -1.0)
    x = states_in(Region((inner, tube_start(P, centre))), BOX)
    assert tube_start(P, centre).holds(x.tolist()) == [True] * len(x)


def test_a_result_its_file_and_its_page_say_the_same(tmp_path):
    result = certify_roa("pendulum", PENDULUM, tmp_path, effort=0.1)
    found = nonlinearity_of(parse_certificate(result.raw, "x"))
    assert found == result.nonlinearity and result.to_dict()["nonlinearity"] == found.to_dict()
    assert 0.005 < found.rms < found.largest < 0.1 and found.states == 1000 and not found.fitted
    system, network = result.system, load_policy(PENDULUM).network
    x = states_in(Region((sublevel_set(result.P, result.levels.roa),)), BOX)
    assert found == nonlinearity(network, system.exact_u_eq(), x)
    said = f"{above(100 * found.largest, 2)} % of its saturated linear part on the set"
    assert said in result.report().read_text("utf-8")


def test_an_ellipsoid_that_is_none_has_no_states(tmp_path):
    """A rejected file need not make sense: its page then has no row on this."""
    result = certify_roa("pendulum", PENDULUM, tmp_path, effort=0.1)
    certificate = parse_certificate(result.raw, "x")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "region_of", lambda _: Region((sublevel_set(-P, 1.0),)))
        assert nonlinearity_of(certificate) is None


@pytest.mark.parametrize("level", [1e-6, 2.0])
def test_few_draws_from_a_box_fall_back_on_the_ellipsoid(level):
    """An outer set that is too small for draws from the domain: the ellipsoid stands for it."""

    class Bowl:
        n = 2

        def __call__(self, x):
            return (x**2).sum(axis=1)

    ends = ((-9, 9), (-9, 9))
    x = states_in(Region((sublevel_set(P, level),), Sublevel(Bowl(), level, ends)), BOX)  # type: ignore[arg-type]
    assert len(x) == 1000 if level < 1 else 100 <= len(x) < 1000
