"""Plants whose equations jump: images hold what trajectories do, and what is proved is accepted by both checkers."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify import heaviside
from certify.analysis.reaching import ReachOptions, ReachResult, certify_reach
from certify.certificates import run_checker
from certify.certificates.verdict import Verdict
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, Number, from_sympy, jumping, maximum, symbols
from certify.loop.plants import System, load_system, require_no_jumps
from certify.loop.policies import PolicyNetwork
from certify.loop.rigorous import states_after
from certify.provers.ranks.images import Course
from certify.provers.ranks.targets import Nothing
from certify.report.drawn import page_of
from tests.support.loops import box
from tests.support.reference import judge_bytes

TENTH = Number(Fraction(1, 10))


def plant(*dynamics: Expression, half: int = 2) -> System:
    states = symbols("x y z")[: len(dynamics)]
    return System(
        name="jumping",
        states=states,
        inputs=symbols("u"),
        parameters={},
        dynamics=dynamics,
        u_eq=(Number(0),),
        domain=box(*[half] * len(dynamics)),
        input_bounds=box(3),
        time="discrete",
    )


def gain(*row: float) -> PolicyNetwork:
    return PolicyNetwork.of_layers((np.array([row]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")


def bouncing() -> System:
    """A point whose speed falls by a tenth in each step and that a wall at y = 0 throws back."""
    x, y, u = symbols("x y u")
    back = heaviside(-x - y)
    return plant(maximum(x + y, 0), (y - (2 * y) * back) * 9 * TENTH + u / 100, half=3)


def nested() -> System:
    """Jumps in arguments and products of others."""
    x, y, u = symbols("x y u")
    j = heaviside(x - y / 2)
    k = heaviside(y + j / 2 - Fraction(1, 4))
    return plant(x / 2 + j * k / 2 - u / 8, y / 2 - k / 4 + j * x / 4)


@pytest.mark.parametrize("system", [bouncing(), nested()], ids=["bouncing", "nested"])
def test_every_run_is_in_an_image_of_its_box(system: System) -> None:
    loop, random = ClosedLoop(system, gain(-0.5, 0.25)), np.random.default_rng(0)
    course = Course(loop, Nothing(), (), (), np.full(2, 6.0), (1, 2, 3, 4), memory=2)
    centre = random.uniform(-0.9, 0.9, (2, 60)) + np.array([[0.2], [0.0]])
    radius = random.uniform(1e-3, 0.05, (2, 60))
    found = course(centre - radius, centre + radius, 0.0, 0.0)
    f, held = system.function(), 0
    assert (~np.isnan(found.lo[:, :, 0])).sum(1).max() > 1  # some have several images
    for _ in range(40):
        state = (centre + radius * random.uniform(-1, 1, (2, 60))).T
        for k in range(4):
            state = f(state, loop.policy(state))
            inside = (found.lo[k] <= state.T) & (found.hi[k] >= state.T)
            known = found.known[k]
            assert np.all(inside.all(1).any(0)[known])
            held += int(known.sum())
    assert held > 2000


def asked(system: System, out: Path, *target: str, **options: Any) -> ReachResult:
    return certify_reach(system, gain(*[0.0] * system.n), out, ReachOptions(target=target, effort=0.1, **options))


def saw(out: str = "0") -> System:
    """x+ = x/2, but x/2 + out where x >= 1."""
    (x,) = symbols("x")
    return plant(x / 2 + Number(Fraction(out)) * heaviside(x - 1))


def test_what_a_jump_leads_to_is_proved_and_accepted_by_both(tmp_path: Path) -> None:
    """From 3/2 by 1.05 to 0.9; the other value leads beyond the domain only where a state has it."""
    begin = ((Fraction(-3, 2), Fraction(3, 2)),)
    result = asked(saw("3/10"), tmp_path, "x**2 <= 0.01", begin=begin)
    assert result.verdict is Verdict.PROVED and result.raw is not None
    assert result.checker["result"] == "ACCEPTED"
    assert judge_bytes(result.raw) is None


@pytest.mark.slow
def test_a_jump_that_throws_out_is_not_proved(tmp_path: Path) -> None:
    """At x = 1 alone one of the values leads to 11/2, beyond the domain, and floats take the other one."""
    (x,) = symbols("x")
    system = plant(x / 2 + 5 * (1 - heaviside(1 - x)))
    result = asked(system, tmp_path, "x**2 <= 0.01", begin=((Fraction(0), Fraction(1)),))
    assert result.verdict is Verdict.UNKNOWN
    assert (
        asked(system, tmp_path, "x**2 <= 0.01", begin=((Fraction(0), Fraction(999, 1000)),)).verdict is Verdict.PROVED
    )


def test_a_run_through_a_jump_that_is_certain_refutes(tmp_path: Path) -> None:
    result = asked(saw("3/4"), tmp_path, "x**2 <= 0.01", begin=((Fraction(3, 2), Fraction(3, 2)),), within=3)
    assert result.verdict is Verdict.REFUTED


def test_where_either_value_is_possible_arb_knows_none() -> None:
    loop = ClosedLoop(saw("1/4"), gain(0.0))
    for start, known in ((Fraction(1), False), (Fraction(9, 10), True)):
        *_, (x, _) = (next(states) for states in [states_after(loop, (start,))] for _ in range(2))
        assert bool(x[0].is_finite()) is known


def test_only_equations_in_discrete_time_may_jump() -> None:
    x, y = symbols("x y")
    good = plant(x / 2 + heaviside(y), y / 2)
    assert len(jumping(*good.dynamics)) == 1
    with pytest.raises(InputError, match=r"may jump in discrete time alone.*\(1 \+ tanh\(50\*\(y\)\)\)/2"):
        replace(good, time="continuous")
    with pytest.raises(InputError, match="at most 6 different heavisides; it has 7"):
        plant(sum((heaviside(x - k) for k in range(7)), x), y)
    for key, value in (
        ("constraints", {"wall": heaviside(x) - 2}),
        ("observations", (heaviside(x), y)),
        ("u_eq", (heaviside(Number(1)),)),
    ):
        with pytest.raises(InputError, match="heaviside"):
            replace(good, **{key: value})  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"the equations of jumping jump, at heaviside\(y\).*certify reach"):
        require_no_jumps(good)


def test_it_is_read_as_it_is_written(tmp_path: Path) -> None:
    import sympy

    (x,) = symbols("x")
    assert from_sympy(sympy.Heaviside(sympy.Symbol("x"))) == heaviside(x)
    text = """
name = "stopped"
time = "discrete"
states = ["x"]
inputs = ["u"]
[dynamics]
x = "x/2*heaviside(x + 1)"
[u_eq]
u = 0
[domain]
x = [-2, 2]
[input_bounds]
u = [-1, 1]
"""
    path = tmp_path / "stopped.toml"
    path.write_text(text)
    (f,) = load_system(path).dynamics
    assert f == x / 2 * heaviside(x + 1)
    for wrong, right in (
        ("np.heaviside(x, 1)", "for np.heaviside(x, 1) write heaviside(x, 1)"),
        ("step(x)", "heaviside"),
    ):
        path.write_text(text.replace("heaviside(x + 1)", wrong))
        with pytest.raises(InputError) as error:
            load_system(path)
        assert right in str(error.value)


def test_pages_and_both_checkers_say_what_a_jump_is(tmp_path: Path) -> None:
    path = asked(saw("3/10"), tmp_path, "x**2 <= 0.01", begin=((Fraction(0), Fraction(3, 2)),)).certificate
    assert path is not None
    assert "where v = 0 it may be either, at each step anew" in page_of(path.read_bytes(), path, None, None)
    assert "0 where v < 0, either where v = 0" in "\n".join(run_checker(path)["text"])
    assert "a heaviside of 0 being 0 or 1 at each step anew" in str(run_checker(path, program="reference"))
