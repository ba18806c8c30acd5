"""Small plants that are odd in one way each: what a run must make of them."""

from __future__ import annotations

import dataclasses
import io
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates.verdict import Verdict
from certify.errors import InputError
from certify.loop.expressions import Number, Symbol
from certify.loop.plants import System
from certify.loop.plants.toml import parse_expression
from certify.loop.policies import PolicyNetwork
from certify.reference.rules import judge
from certify.report import summary
from tests.support.certificates import dump, grow, make, verdict


def plant(dynamics: dict[str, str], half: float = 2, bound: int = 6) -> System:
    names = {name: Symbol(name) for name in (*dynamics, "u")}
    return System(
        name="p",
        states=tuple(names[s] for s in dynamics),
        inputs=(names["u"],),
        parameters={},
        dynamics=tuple(parse_expression(e, names) for e in dynamics.values()),
        u_eq=(Number(0),),
        domain=((Fraction(-half), Fraction(half)),) * len(dynamics),
        input_bounds=((Fraction(-bound), Fraction(bound)),),
    )


def gain(*row: float) -> PolicyNetwork:
    """u = tanh(row x)."""
    return PolicyNetwork.of_layers((np.array([row]),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")


@pytest.mark.parametrize("bias, size", [(0.3, 1.0), (0.1, 2.0)])
def test_what_was_proved_with_an_earlier_floor_is_accepted_with_the_last(
    tmp_path: Path, bias: float, size: float
) -> None:
    weights = np.array([[size, 0.5], [-0.5, size]]), np.array([[-0.5, -0.5]])
    network = PolicyNetwork.of_layers(
        weights, (np.array([bias, -bias]), np.array([bias / 2])), np.ones(1), np.zeros(1), "tanh", "none"
    )
    options = RoaOptions(claim="practical", level=0.3, max_boxes=20_000)
    result = certify_roa(plant({"x": "y", "y": "-x - 2*y + 1/20 + u"}), network, tmp_path, options)
    assert result.verdict is Verdict.PROVED


@pytest.mark.slow
def test_progress_survives_a_level_that_falls_below_zero(tmp_path: Path) -> None:
    options = RoaOptions(claim="practical", effort=0.02)
    system = plant({"x": "-x + u + tan(x)/100"}, half=3, bound=10)
    certify_roa(system, gain(-1.0), tmp_path, options, progress=lambda stage, state: None)


def test_a_constant_sine_in_an_equation(tmp_path: Path) -> None:
    system = plant({"x": "-x + u + sin(1)/100"}, bound=10)
    assert certify_roa(system, gain(-1.0), tmp_path, RoaOptions(claim="practical")).verdict is Verdict.PROVED


def test_a_refutation_speaks_of_V_and_not_of_trajectories(tmp_path: Path) -> None:
    """With W = x^2 + y^2: W' = -2 W + 2 y tanh(-y/1000) < 0 on W = 1, so {W <= 1} is invariant, y decays, and then x.

    In between V grows for a while: that is a condition of the claim, and its failure says nothing about trajectories.
    """
    system = plant({"x": "-x + 20*y*(x**2 + y**2)*(1 - x**2 - y**2)", "y": "-y + u"}, bound=10)
    options = RoaOptions(P=np.eye(2), level=1.0)
    result = certify_roa(system, gain(0.0, -1e-3), tmp_path, options)
    assert result.verdict is Verdict.REFUTED and result.witness is not None
    console = Console(width=200, file=io.StringIO())
    console.print(summary(result.to_dict()))
    text = console.file.getvalue()
    assert "condition of the claim fails" in text and "another V may" in text and "false" not in text


def test_the_reference_accepts_a_quotient_that_the_checker_accepts() -> None:
    dynamics = [["+", ["*", "-2", "x"], ["/", "1/100", ["+", "x", "11/20"]], "u"]]
    data = grow(make(dynamics, [([[1.0]], [0.0])], 1.0, (0.01, 0.25), claim="practical", centre="none"))
    assert verdict(data) == "ACCEPTED"
    assert judge(dump(data)).result == "ACCEPTED"


@pytest.mark.parametrize("claim", ["asymptotic", "practical"])
@pytest.mark.parametrize("half", [Fraction(1, 10**170), Fraction(10**170)])
def test_domains_of_extreme_size_are_named(tmp_path: Path, claim: str, half: Fraction) -> None:
    system = dataclasses.replace(plant({"x": "-x + u"}), domain=((-half, half),))
    with pytest.raises(InputError, match="Scale the states"):
        certify_roa(system, gain(-1.0), tmp_path, RoaOptions(claim=claim))  # type: ignore[arg-type]


def test_levels_of_extreme_size_are_named(tmp_path: Path) -> None:
    for claim in ("asymptotic", "practical"):
        with pytest.raises(InputError, match="levels of V must lie between"):
            certify_roa(plant({"x": "-x + u"}), gain(-1.0), tmp_path, RoaOptions(claim=claim, level=1e-320))  # type: ignore[arg-type]


def test_a_pole_at_the_origin_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"divide(s)? by (0|zero)"):
        certify_roa(plant({"x": "1/x + u"}), gain(-1.0), tmp_path, RoaOptions(claim="practical"))


def test_numbers_beyond_binary64_are_named(tmp_path: Path) -> None:
    for system in (
        plant({"x": f"-x + u + {10**400}*x**3"}),
        dataclasses.replace(plant({"x": "-x + u"}), input_bounds=((Fraction(-(10**400)), Fraction(10**400)),)),
    ):
        with pytest.raises(InputError, match="range of binary64"):
            certify_roa(system, gain(-1.0), tmp_path, RoaOptions(claim="practical"))
