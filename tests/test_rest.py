"""Where a loop rests that does not rest at the origin, and what is claimed then."""

from __future__ import annotations

import json
import shlex
from fractions import Fraction
from pathlib import Path

import mpmath
import numpy as np
import pytest
import sympy

from certify.cli import _run
from certify.closed_loop import ClosedLoop
from certify.errors import InputError
from certify.policies import TanhNetwork, load_policy
from certify.rest import find_rest
from certify.roa import RoaOptions, certify_roa
from certify.systems import System, get_system
from certify.verdict import Verdict
from tests.support.loops import box

PLAIN = Path(__file__).parent.parent / "examples" / "policies" / "without_gain" / "pendulum.pt"


def scalar(f: sympy.Expr, weight: float, bias: float, clip: tuple[float, float] | None = None) -> ClosedLoop:
    """xdot = f(x, u), u = clip(weight x + bias)."""
    x, u = sympy.symbols("x u")
    system = System("s", (x,), (u,), {}, (f,), (sympy.Integer(0),), box(3), box(9))
    bounds = None if clip is None else (np.array([clip[0]]), np.array([clip[1]]))
    network = TanhNetwork(
        (np.array([[weight]]),), (np.array([bias]),), np.ones(1), np.zeros(1), "identity", "none", clip=bounds
    )
    return ClosedLoop(system, network)


x, u = sympy.symbols("x u")


@pytest.mark.parametrize("bias", [0.25, -0.3, 1e-9])
def test_the_digits_are_the_roots(bias: float) -> None:
    """sin x - x/2 ... = 0 against fifty digits of another library."""
    found = find_rest(scalar(sympy.sin(x) / 2 + u, -1.0, bias))
    assert found is not None and found.stable
    mpmath.mp.dps = 50
    truth = mpmath.findroot(lambda v: mpmath.sin(v) / 2 - v + mpmath.mpf(bias), bias)
    assert abs(mpmath.mpf(found.x[0]) - truth) <= abs(truth) * mpmath.mpf(10) ** -11
    slope = mpmath.cos(truth) / 2 - 1
    assert abs(complex(found.eigenvalues[0]) - complex(slope)) < 1e-5
    assert abs(mpmath.mpf(found.u[0]) - (mpmath.mpf(bias) - truth)) <= mpmath.mpf(10) ** -11


def test_a_clip_that_acts_at_rest_leaves_the_plant_alone_there() -> None:
    """xdot = -x + u with u = clip(0.5 - x, 1/4, 1): the loop would rest at 1/4 exactly on the bound's edge; at 0.2 with
    a bound of 0.2, where the input is held and the only eigenvalue is the plant's."""
    found = find_rest(scalar(-x + u, -1.0, 0.5, (-1.0, 0.125)))
    assert found is not None and found.x == ("0.125000000000",) and found.eigenvalues == ("-1+0j",)
    edge = find_rest(scalar(-x + u, -1.0, 0.5, (-1.0, 0.25)))
    assert edge is None or edge.x == ("0.250000000000",)


def test_a_rest_that_is_not_stable_is_not_called_so() -> None:
    found = find_rest(scalar(x + u, 0.5, 0.25))
    assert found is not None and not found.stable and found.eigenvalues == ("1.5+0j",)


@pytest.mark.parametrize("f", [1 + x**2 + 0 * u, x**2 + u])
def test_what_is_not_shown_is_not_said(f: sympy.Expr) -> None:
    """No point of rest at all; and a double one, which the test cannot tell from none."""
    assert find_rest(scalar(f, 0.0, 0.0)) is None


def test_practical_stability_is_claimed_where_the_policy_is_not_centred(tmp_path: Path) -> None:
    policy = load_policy(PLAIN)
    system = get_system("pendulum").with_parameters(policy.parameters)
    result = certify_roa(system, policy.network, tmp_path, RoaOptions(candidate="lqr"))
    assert result.verdict is Verdict.PROVED and result.claim == "nearby"
    assert result.notice is not None and "not centred" in result.notice
    data = result.to_dict()
    assert data["claim"] == {"kind": "nearby"} and data["rest"]["stable"] is True
    theta = float(data["rest"]["x"][0])
    loop = ClosedLoop(system, policy.network)
    f = system.function()
    rest = np.array([theta, 0.0])
    assert np.abs(f(rest, loop.policy(rest[None])[0])).max() < 1e-9
    assert result.P is not None and result.levels.floor is not None
    assert rest @ result.P @ rest <= result.levels.floor  # what rests is inside the small set
    with pytest.raises(InputError, match="not centred"):
        certify_roa(system, policy.network, tmp_path, RoaOptions(claim="asymptotic"))


def test_the_command_centres_on_request_and_says_what_that_changes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["roa", "--policy", str(PLAIN), "--candidate", "lqr", "--out", str(tmp_path), "--json"]
    assert _run(command, True) == 0
    further = json.loads(capsys.readouterr().out)["diagnosis"]["next"]
    assert further["options"] == {"--centre": "preactivation"}
    assert _run(shlex.split(further["command"])[1:], True) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["claim"] == {"kind": "asymptotic"}
    assert "changes u by up to" in captured.err
    assert _run([*command, "--squash", "tanh"], True) == 2 and "must be left out" in capsys.readouterr().out
    shipped = str(PLAIN.parent.parent / "pendulum.pt")
    assert _run(["roa", "--policy", shipped, "--centre", "output", "--out", str(tmp_path)], False) == 2
    assert "must be left out" in capsys.readouterr().err


def test_a_loop_that_rests_at_the_origin_gets_the_stronger_claim(tmp_path: Path) -> None:
    loop = scalar(x / 2 + u, -1.0, 0.0)
    result = certify_roa(loop.system, loop.network, tmp_path, RoaOptions(candidate="lyapunov"))
    assert result.claim == "asymptotic" and result.rest is None and result.notice is None
    assert loop.system.domain == ((Fraction(-3), Fraction(3)),)
