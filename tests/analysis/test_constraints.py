"""Constraints of a run: how they are given, what is refused at once, and what both checkers accept."""

from __future__ import annotations

import dataclasses
import json
from fractions import Fraction
from pathlib import Path

import pytest

from certify import certify_roa, load_policy
from certify.analysis.arguments import changes_of
from certify.analysis.changes import PlantChanges
from certify.analysis.run import RoaOptions
from certify.analysis.run import certify_roa as run
from certify.analysis.values import changes_in
from certify.certificates import parse_certificate, run_checker
from certify.certificates.verdict import Stop, Verdict
from certify.errors import InputError, OptionError
from certify.loop.plants import System, constraints_of_values, get_system, kept_constraints, load_system
from certify.loop.policies import PolicyNetwork
from tests.provers.test_steps import alone
from tests.support.loops import pendulum_network
from tests.support.marks import slow_after

ROOT = Path(__file__).parents[2]
OSCILLATOR = ROOT / "examples" / "plants" / "van_der_pol.toml"
QUICK = RoaOptions(candidate="lyapunov", effort=0.05)


def oscillator() -> tuple[System, PolicyNetwork]:
    return load_system(OSCILLATOR), load_policy(ROOT / "examples" / "policies" / "van_der_pol.pt").network


def test_text_and_python_say_the_same() -> None:
    typed = changes_of({"keep": ["wall: x1 <= 0.8; x2 < 2"], "avoid": ["(x1 + 1)**2 + x2**2 < 0.25"]})
    given = changes_in({"keep": ["wall: x1 <= 0.8", "x2 < 2"], "avoid": "(x1 + 1)**2 + x2**2 < 0.25"})
    assert typed == given
    plant = typed.of(load_system(OSCILLATOR))
    assert {name: str(g) for name, g in constraints_of_values(plant).items()} == {
        "wall": "x1 - 0.8",
        "keep": "x2 - 2",
        "avoid": "0.25 - ((x1 + 1)**2 + x2**2)",
    }
    assert PlantChanges(keep=("x1 < 1",)).of(plant).constraints.keys() == {"wall", "keep", "avoid", "keep2"}


def test_they_are_of_values_and_of_what_acts(tmp_path: Path) -> None:
    """States are deviations inside, and with an input error the input that acts is meant."""
    path = tmp_path / "moved.toml"
    path.write_text(
        'name = "moved"\nstates = ["h"]\ninputs = ["q"]\n[dynamics]\nh = "3 - h + q"\n[x_eq]\nh = 3\n[u_eq]\nq = 0\n'
        "[domain]\nh = [1, 5]\n[input_bounds]\nq = [-1, 1]\n"
    )
    changes = PlantChanges(keep=("h <= 4", "q <= 0.5"), input_error=Fraction(1, 10))
    kept = [str(g) for g in kept_constraints(changes.of(load_system(path))).values()]
    assert kept == ["3 + h - 4", "q + error_q - 0.5"]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"keep": ("x1",)}, "`keep` takes a comparison by <=, <, >= or >, such as 'p <= 1.5'; found 'x1'"),
        ({"keep": ("x3 < 1",)}, "'x3' is no state, input, parameter or disturbance"),
        ({"avoid": ("x1 == 1",)}, "must compare two expressions"),
        ({"keep": ("0 < x1 < 1",)}, "write two constraints"),
        ({"keep": ("mu < 2",)}, "`keep` must be of states and inputs, x1, x2, u; found 'mu < 2'"),
        ({"keep": ("x1 <= (1",)}, "takes a comparison"),
        ({"keep": ("a: x1 < 1", "a: x2 < 1")}, "has a constraint a already"),
    ],
)
def test_nonsense_is_refused(changes: dict[str, tuple[str, ...]], said: str) -> None:
    with pytest.raises(OptionError) as refused:
        PlantChanges(**changes).of(load_system(OSCILLATOR))
    assert said in str(refused.value)
    with pytest.raises(OptionError, match="found nothing"):
        changes_of({"keep": ["x1 < 1;"]})


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (RoaOptions(engine="dreal"), "`engine` must be bounds where constraints are to be kept"),
        (RoaOptions(engine="both"), "`engine` must be bounds where constraints are to be kept"),
    ],
)
def test_what_says_nothing_of_constraints_is_refused(options: RoaOptions, said: str, tmp_path: Path) -> None:
    plant, network = oscillator()
    plant = PlantChanges(keep=("wall: x1 <= 0.8",)).of(plant)
    with pytest.raises(InputError) as refused:
        run(plant, network, tmp_path, options)
    assert said in str(refused.value) and "found wall" in str(refused.value)


@pytest.mark.parametrize(
    "changes", [{"keep": ("x1 >= 0.1",)}, {"avoid": ("x1**2 + x2**2 <= 1",)}, {"keep": ("u < 0",)}]
)
def test_a_constraint_that_does_not_hold_at_the_origin_is_refused_at_once(
    changes: dict[str, tuple[str, ...]], tmp_path: Path
) -> None:
    plant, network = oscillator()
    with pytest.raises(InputError, match="must hold where V is 0, at x1 = 0, x2 = 0"):
        run(PlantChanges(**changes).of(plant), network, tmp_path, QUICK)


def both_accept(path: Path | None) -> bool:
    assert path is not None
    return all(run_checker(path, program=p)["result"] == "ACCEPTED" for p in ("checker", "reference"))  # type: ignore[arg-type]


WALL = PlantChanges(keep=("wall: x1 <= 0.6", "abs(u) <= 0.9"), avoid=("(x1 + 0.9)**2 + x2**2 < 0.09",))
CHANGED = {
    "at once": (WALL, QUICK),
    "rate": (WALL, dataclasses.replace(QUICK, rate=0.05)),
    "held": (dataclasses.replace(WALL, sample_time=Fraction(1, 50)), QUICK),
    "jitter": (dataclasses.replace(WALL, sample_time=(Fraction(1, 100), Fraction(1, 50))), QUICK),
    "practical": (WALL, RoaOptions(claim="practical", candidate="lyapunov", effort=0.02)),
    "uncertain": (
        dataclasses.replace(WALL, parameters={"mu": (Fraction(9, 10), Fraction(11, 10))}),
        dataclasses.replace(QUICK, effort=0.05),
    ),
    "erring": (
        dataclasses.replace(WALL, input_error=Fraction(1, 100)),
        RoaOptions(claim="nearby", candidate="lyapunov", effort=0.02),
    ),
}


@pytest.mark.parametrize("name", slow_after(4, CHANGED))
def test_both_checkers_accept_what_is_proved(name: str, tmp_path: Path) -> None:
    plant, network = oscillator()
    changes, options = CHANGED[name]
    result = run(changes.of(plant), network, tmp_path, options)
    assert result.verdict is Verdict.PROVED and result.raw is not None and both_accept(result.certificate)
    certificate = parse_certificate(result.raw, "it")
    assert len(certificate.claim.keep) == 4 and list(certificate.constraints) == list(result.constraints)
    assert list(result.constraints) == ["wall", "keep_1", "keep_2", "avoid"]
    assert result.to_dict()["constraints"] == dict(result.constraints)
    assert result.diagnosis is not None and result.stop is Stop.KEEP and "x1 - 0.6 = 0" in result.diagnosis.binds
    assert json.dumps(result.to_dict()["witness"]["constraint"]) == '"wall"'


def test_in_discrete_time_too(tmp_path: Path) -> None:
    plant, network = alone("x/2 - tanh(x)/4")
    result = run(PlantChanges(keep=("x <= 0.7",)).of(plant), network, tmp_path, QUICK)
    assert result.verdict is Verdict.PROVED and both_accept(result.certificate)
    assert not result.contains([0.7]) and result.contains([-0.69])


@pytest.mark.parametrize("which", slow_after(1, ["oscillator", "pendulum"]))
def test_a_constraint_that_never_binds_changes_nothing_but_the_claim(which: str, tmp_path: Path) -> None:
    plant, network = oscillator() if which == "oscillator" else (get_system("pendulum"), pendulum_network())
    name = plant.states[0].name
    found = []
    for changes in (PlantChanges(), PlantChanges(keep=(f"{name} <= 100",))):
        result = run(changes.of(plant), network, tmp_path / str(len(found)), QUICK)
        assert result.raw is not None
        found.append(json.loads(result.raw))
    plain, kept = found
    assert kept["claim"].pop("keep") and kept["provenance"].pop("constraints") == ["keep"]
    assert "keep" not in plain["claim"] and kept == plain


def test_a_level_beyond_a_constraint_is_refuted(tmp_path: Path) -> None:
    """V at the violation is decided in rationals, g in balls."""
    plant, network = oscillator()
    plant = PlantChanges(keep=("wall: x1 <= 0.6",)).of(plant)
    for claim in ("asymptotic", "practical"):
        options = RoaOptions(claim=claim, candidate="lyapunov", level=0.6, effort=0.05)  # type: ignore[arg-type]
        result = run(plant, network, tmp_path, options)
        assert result.verdict is Verdict.REFUTED and "the constraint wall is violated at x1 = 0.6" in result.detail


def test_python_takes_them_by_keyword(tmp_path: Path) -> None:
    result = certify_roa(
        OSCILLATOR, ROOT / "examples" / "policies" / "van_der_pol.pt", tmp_path, keep="x1 <= 0.6", candidate="lyapunov",
        effort=0.05,
    )  # fmt: skip
    assert result.verdict is Verdict.PROVED and dict(result.constraints) == {"keep": "x1 - 0.6 < 0"}
