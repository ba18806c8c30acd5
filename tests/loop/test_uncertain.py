"""Plants with ranges and disturbances: what is nominal, what is free, what is refused."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from certify.errors import InputError
from certify.loop.expressions import Number, Symbol, symbols, symbols_of
from certify.loop.plants import System, at_values, corners, get_system, with_input_errors
from tests.support.algebra import same
from tests.support.loops import box

X, U, M, W = symbols("x u m w")
RANGE = {"m": (Fraction(1, 2), Fraction(3, 2))}


def lift(**changes: object) -> System:
    settings: dict[str, object] = {
        "name": "lift", "states": (X,), "inputs": (U,), "parameters": {"m": Fraction(1), "k": Fraction(2)},
        "dynamics": (-X / M + U + W * Symbol("k"),), "u_eq": (Number(0),), "domain": box(3),
        "input_bounds": box(5), "disturbances": (W,), "positive": frozenset({"m"}), "units": {"u": "N"},
    }  # fmt: skip
    return System(**{**settings, **changes})  # type: ignore[arg-type]


def test_what_has_no_range_is_nominal() -> None:
    plain = lift()
    assert plain.uncertain == () and plain.uncertain_dynamics() == plain.exact_dynamics()
    assert plain.exact_dynamics() == (-X / Number(1) + U + Number(0) * Number(2),)  # as it was written
    assert corners(plain) == ({},)


def test_a_range_frees_a_parameter_and_lets_a_disturbance_act() -> None:
    system = lift().with_ranges(RANGE | {"w": (Fraction(-1, 5), Fraction(1, 5))})
    assert [s.name for s, _ in system.uncertain] == ["m", "w"]
    assert same(system.exact_dynamics()[0], -X + U)
    assert same(system.uncertain_dynamics()[0], -X / M + U + 2 * W)
    x, u = np.array([[0.5]]), np.array([[0.25]])
    assert system.uncertain_function()(x, u, [0.5, 0.1]) == pytest.approx(np.array([[-1.0 + 0.25 + 0.2]]))
    assert system.function()(x, u) == pytest.approx(np.array([[-0.25]]))


def test_ranges_are_added_and_replaced() -> None:
    system = lift().with_ranges(RANGE).with_ranges({"k": (Fraction(1), Fraction(3))})
    assert list(system.ranges) == ["m", "k"]
    assert system.with_ranges({"m": (Fraction(1), Fraction(2))}).ranges["m"] == (1, 2)
    with pytest.raises(TypeError):
        system.ranges["m"] = (Fraction(0), Fraction(1))  # type: ignore[index]


def test_a_nominal_value_outside_of_its_range_moves_to_the_middle() -> None:
    system = lift().with_ranges({"m": (Fraction(2), Fraction(3)), "k": (Fraction(2), Fraction(5))})
    assert system.parameters == {"m": Fraction(5, 2), "k": Fraction(2)}


@pytest.mark.parametrize(
    ("ranges", "said"),
    [
        ({"m": (Fraction(3, 2), Fraction(1, 2))}, "lo < hi"),
        ({"m": (Fraction(1), Fraction(1))}, "lo < hi"),
        ({"m": (Fraction(0), Fraction(2))}, "must be positive"),
        ({"m": (Fraction(-2), Fraction(2))}, "must be positive"),
        ({"r": (Fraction(0), Fraction(2))}, "no parameter or disturbance 'r'"),
        ({"x": (Fraction(0), Fraction(2))}, "no parameter or disturbance 'x'"),
        ({"u": (Fraction(0), Fraction(2))}, "no parameter or disturbance 'u'"),
        ({"w": (Fraction(1), Fraction(2))}, "hold its nominal value 0"),
    ],
)
def test_ranges_that_are_refused(ranges: dict[str, tuple[Fraction, Fraction]], said: str) -> None:
    with pytest.raises(InputError, match=said):
        lift().with_ranges(ranges)


def test_the_operating_point_may_not_be_uncertain() -> None:
    system = lift(x_eq=(M,), domain=((Fraction(-3), Fraction(3)),))
    with pytest.raises(InputError, match="operating point"):
        system.with_ranges(RANGE)


def test_at_has_the_equations_at_those_values_and_nothing_uncertain() -> None:
    system = lift().with_ranges(RANGE | {"w": (Fraction(-1, 5), Fraction(1, 5))})
    held = at_values(system, {"m": Fraction(1, 2), "w": Fraction(1, 10)})
    assert same(held.exact_dynamics()[0], -2 * X + U + Fraction(1, 5))
    assert held.ranges == {} and held.disturbances == () and held.uncertain == ()
    assert at_values(system, {}).exact_dynamics() == system.exact_dynamics()


def test_at_leaves_u_eq_where_it_is() -> None:
    """The policy applies u_eq, and does not know the values."""
    system = lift(dynamics=(U - M,), u_eq=(M,)).with_ranges(RANGE)
    held = at_values(system, {"m": Fraction(3, 2)})
    assert held.exact_u_eq() == system.exact_u_eq() == (Fraction(1),)
    assert same(held.exact_dynamics()[0], U - Fraction(3, 2))


def test_corners() -> None:
    system = lift().with_ranges(RANGE | {"w": (Fraction(-1, 5), Fraction(1, 5))})
    four = corners(system)
    assert len(four) == 4 and four[0] == {"m": Fraction(1, 2), "w": Fraction(-1, 5)}
    assert len({tuple(c.values()) for c in four}) == 4
    names = [f"p{i}" for i in range(9)]
    many = lift(parameters={"m": Fraction(1), "k": Fraction(2)} | dict.fromkeys(names, Fraction(0)))
    many = many.with_ranges({name: (Fraction(-1), Fraction(1)) for name in names})
    assert len(corners(many)) == 64 and corners(many) == corners(many)
    assert all(abs(v) == 1 for corner in corners(many) for v in corner.values())
    assert {corner["p0"] for corner in corners(many)} == {-1, 1} == {corner["p8"] for corner in corners(many)}


def test_input_errors_stand_beside_the_inputs() -> None:
    system = with_input_errors(lift(dynamics=(U**2 - X * U,)), {"u": Fraction(1, 100)})
    error = Symbol("error_u")
    assert system.ranges == {"error_u": (Fraction(-1, 100), Fraction(1, 100))} and system.units["error_u"] == "N"
    assert same(system.uncertain_dynamics()[0], (U + error) ** 2 - X * (U + error))
    assert same(system.exact_dynamics()[0], U**2 - X * U)
    assert system.inputs == (U,) and system.input_bounds == box(5)


@pytest.mark.parametrize("bounds", [{"u": Fraction(0)}, {"u": Fraction(-1)}, {"v": Fraction(1)}, {"x": Fraction(1)}])
def test_input_errors_that_are_refused(bounds: dict[str, Fraction]) -> None:
    with pytest.raises(InputError, match="positive bound for one of u"):
        with_input_errors(lift(), bounds)


def test_input_errors_twice_are_refused() -> None:
    with pytest.raises(InputError):
        with_input_errors(with_input_errors(lift(), {"u": Fraction(1)}), {"u": Fraction(1)})


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "quadrotor2d", "quadrotor3d"])
def test_disturbances_of_the_plants_are_nothing_unless_they_act(name: str) -> None:
    system = get_system(name)
    assert system.disturbances
    free = {s.name for s in symbols_of(*system.exact_dynamics())}
    assert not free & {s.name for s in system.disturbances}
    acting = system.with_ranges({s.name: (Fraction(-1, 10), Fraction(1, 10)) for s in system.disturbances})
    moved = {s.name for s in symbols_of(*acting.uncertain_dynamics())}
    assert moved >= {s.name for s in system.disturbances}
    assert acting.exact_dynamics() == system.exact_dynamics()
