"""Plants with ranges: how they are given, what is made of them in floats, what a run says, and what is refused."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify import certify_roa
from certify.analysis.changes import PlantChanges
from certify.analysis.results import RoaResult
from certify.certificates import Certificate, PartitionTree, parse_certificate, read_certificate
from certify.certificates.claims import Asymptotic, Problem, conditions
from certify.certificates.claims.queries import query
from certify.certificates.verdict import Stop, Verdict
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, sin, sqrt, symbols, symbols_of
from certify.loop.plants import (
    System,
    at_values,
    available_systems,
    get_system,
    input_errors,
    kind_of,
    load_system,
    with_input_errors,
)
from certify.loop.policies import PolicyNetwork
from certify.lyapunov.function import Quadratic
from certify.provers.falsify import Witness
from tests.support.algebra import same

F = Fraction
SPRING = """
name = "spring"
states = ["p", "v"]
inputs = ["F"]
positive = ["c"]
[parameters]
k = 1
c = 2
[disturbances]
wind = {wind}
[dynamics]
p = "v"
v = "-k*p + p**3/4 - c*v + F + wind"
[u_eq]
F = 0
[domain]
p = [-2, 2]
v = [-2, 2]
[input_bounds]
F = [-1, 1]
[units]
p = "m"
v = "m/s"
F = "N"
k = "N/m"
c = "N s/m"
wind = "N"
"""
K = {"k": ("0.9", "1.1")}


def spring(folder: Path, wind: str = "0") -> System:
    path = folder / "spring.toml"
    path.write_text(SPRING.format(wind=wind))
    return load_system(path)


def soft() -> PolicyNetwork:
    """One tanh, with which the spring rests at the origin."""
    return PolicyNetwork.of_layers((np.array([[-0.3, -0.2]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")


@pytest.fixture(scope="module")
def proved(tmp_path_factory: pytest.TempPathFactory) -> RoaResult:
    folder = tmp_path_factory.mktemp("spring")
    result = certify_roa(spring(folder), soft(), folder / "o", candidate="lyapunov", level=0.5, ranges=K)
    assert result.verdict is Verdict.PROVED
    return result


# plants


@pytest.mark.parametrize(
    ("wind", "ends"), [("0", None), ("0.05", (F(-1, 20), F(1, 20))), ('[-0.1, "1/3"]', (F(-1, 10), F(1, 3)))]
)
def test_a_file_says_which_disturbances_act(tmp_path: Path, wind: str, ends: tuple[Fraction, Fraction] | None) -> None:
    system = spring(tmp_path, wind)
    assert [w.name for w in system.disturbances] == ["wind"]
    assert dict(system.ranges) == ({} if ends is None else {"wind": ends})


@pytest.mark.parametrize(
    ("wind", "part"),
    [
        ("-0.1", "must be a half-width that is not negative, or a pair [lo, hi]"),
        ("[1, -1]", "must satisfy lo < hi"),
        ("[0.1, 0.2]", "hold its nominal value 0"),
        ('"much"', "must be a finite number"),
        ("true", "must be a number"),
    ],
)
def test_a_range_of_a_file_that_is_none_is_refused_with_its_line(tmp_path: Path, wind: str, part: str) -> None:
    with pytest.raises(InputError, match=r"spring\.toml") as found:
        spring(tmp_path, wind)
    assert part in str(found.value)


def test_a_disturbance_has_a_name_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text(SPRING.format(wind="0").replace("[disturbances]\nwind", "[disturbances]\nk"))
    with pytest.raises(InputError, match="disturbances must differ; found 'k' twice"):
        load_system(tmp_path / "p.toml")


@pytest.mark.parametrize("name", available_systems())
def test_disturbances_of_what_ships_are_in_its_equations_and_nowhere_else(name: str) -> None:
    """They push with their unit's sign: the nominal plant does not know them, and each moves some state."""
    system = get_system(name)
    assert system.disturbances and not system.ranges
    known = symbols_of(*system.dynamics)
    for w in system.disturbances:
        assert w in known and w.name in system.units
        moved = system.with_ranges({w.name: (F(-1), F(1))})
        pushed, still = at_values(moved, {w.name: F(1)}).exact_dynamics(), system.exact_dynamics()
        assert not all(map(same, pushed, still))
    assert not symbols_of(*system.exact_dynamics()) & set(system.disturbances)


def test_a_force_on_the_cart_acts_as_the_input_does() -> None:
    system = get_system("cartpole").with_ranges({"force": (F(-1), F(1))})
    f, x = system.uncertain_function(), np.random.default_rng(0).uniform(-0.5, 0.5, (5, 4))
    u = np.full((5, 1), 0.25)
    np.testing.assert_allclose(f(x, u, [0.5]), system.function()(x, u + 0.5), rtol=1e-13)


def test_the_range_of_a_parameter_holds_its_value_or_moves_it(tmp_path: Path) -> None:
    system = spring(tmp_path)
    inside = system.with_ranges({"k": (F(1, 2), F(5, 4))})
    assert inside.parameters["k"] == 1
    moved = system.with_ranges({"k": (F(2), F(3))})
    assert moved.parameters["k"] == F(5, 2)
    assert dict(moved.with_ranges({"k": None}).ranges) == {}
    for name, ends, part in (
        ("c", (F(-1), F(3)), "must be positive; found -1 in its range"),
        ("k", (F(1), F(1)), "must satisfy lo < hi"),
        ("q", (F(0), F(1)), "no parameter or disturbance 'q'"),
        ("p", (F(0), F(1)), "no parameter or disturbance 'p'"),
    ):
        with pytest.raises(InputError, match=part):
            system.with_ranges({name: ends})


def test_a_range_of_what_the_operating_point_depends_on_is_refused() -> None:
    maglev = load_system(Path(__file__).parent.parent.parent / "examples" / "plants" / "maglev.toml")
    with pytest.raises(
        InputError, match=r"h0 must have one value, because the operating point of maglev depends on it"
    ):
        maglev.with_ranges({"h0": (F(9, 1000), F(11, 1000))})
    assert maglev.with_ranges({"g": (F(9), F(10)), "shake": (F(-1), F(1))}).exact_x_eq() == maglev.exact_x_eq()


@pytest.mark.parametrize("module", ["numpy", "torch"])
def test_equations_take_values_of_what_is_uncertain(tmp_path: Path, module: str) -> None:
    """Also where an equation is a power, or a function, of nothing else: torch has none of a plain number."""
    import torch

    x, u, m = symbols("x u m")
    f = (-x / m + sin(m) * u + sqrt(m),)
    box = ((F(-1), F(1)),)
    system = System("s", (x,), (u,), {"m": F(2)}, f, (Number(0),), box, box, ranges={"m": (F(1), F(3))})
    state, held = np.array([[0.5], [-0.25]]), np.array([[0.1], [0.2]])
    given = (torch.tensor(state), torch.tensor(held)) if module == "torch" else (state, held)
    found = np.asarray(system.uncertain_function(module)(*given, [1.5]))
    np.testing.assert_allclose(found, -state / 1.5 + np.sin(1.5) * held + np.sqrt(1.5), rtol=1e-15)


def test_an_error_of_an_input_is_what_only_moves_the_input(tmp_path: Path) -> None:
    """Decided by the equations: a name says nothing, since a file may give it to anything."""
    system = with_input_errors(spring(tmp_path), {"F": F(1, 1000)})
    assert dict(input_errors(system)) == {"F": "error_F"} and system.units["error_F"] == "N"
    assert kind_of(system, "error_F") == "input error"
    p, v, u, e = symbols("p v F error_F")
    for dynamics in ((v, u + e * p), (v + e, u), (v, u + 2 * e), (v, u + e + p * e), (v + u, e - p)):
        other = System(
            "s", (p, v), (u,), {}, dynamics, (Number(0),), ((F(-1), F(1)),) * 2, ((F(-1), F(1)),),
            disturbances=(e,), ranges={"error_F": (F(-1), F(1))},
        )  # fmt: skip
        assert not input_errors(other) and kind_of(other, "error_F") == "disturbance", dynamics


@pytest.mark.parametrize("name", available_systems())
def test_errors_of_inputs_are_recognised_in_a_certificate(name: str) -> None:
    plant = get_system(name)
    system = PlantChanges(input_error=F(1, 100)).of(plant)
    n, m = system.n, system.m
    network = PolicyNetwork.of_layers((np.zeros((m, n)),), (np.zeros(m),), np.ones(m), np.zeros(m), "tanh", "none")
    evidence = PartitionTree(np.eye(n), np.ones(n), bytes([255]), cells=(1,) * m)
    written = Certificate(system, network, Quadratic(np.eye(n)), Asymptotic(roa=1.0, local=1.0), evidence)
    read = parse_certificate(written.to_json().encode(), "c").system
    assert dict(input_errors(read)) == {u.name: f"error_{u}" for u in plant.inputs}
    assert {name: read.units.get(name) for name in read.ranges} == {
        f"error_{u}": system.units.get(u.name) for u in plant.inputs
    }


@pytest.mark.parametrize(
    ("bounds", "part"),
    [({"F": F(0)}, "must be a positive bound"), ({"G": F(1)}, "for one of F"), (F(-1), "must be a positive bound")],
)
def test_an_error_that_is_no_bound_of_an_input_is_refused(tmp_path: Path, bounds: Any, part: str) -> None:
    with pytest.raises(InputError, match=part):
        PlantChanges(input_error=bounds).of(spring(tmp_path))


def test_only_disturbances_act_and_only_parameters_are_uncertain(tmp_path: Path) -> None:
    system = spring(tmp_path)
    with pytest.raises(InputError, match="spring has no disturbance 'k'; it has: wind"):
        PlantChanges(disturbances={"k": F(1)}).of(system)
    with pytest.raises(InputError, match="spring has no parameter 'wind'; it has: k, c"):
        PlantChanges(parameters={"wind": (F(-1), F(1))}).of(system)
    with pytest.raises(InputError, match="wind must have a half-width that is not negative"):
        PlantChanges(disturbances={"wind": F(-1)}).of(system)
    assert dict(PlantChanges(disturbances={"wind": F(1, 2)}).of(system).ranges) == {"wind": (F(-1, 2), F(1, 2))}
    assert not PlantChanges(disturbances={"wind": F(0)}).of(spring(tmp_path, "0.1")).ranges


# runs


def test_a_result_says_for_what_it_holds(proved: RoaResult) -> None:
    data = proved.to_dict()
    assert data["uncertain"] == [{"name": "k", "kind": "parameter", "lo": "9/10", "hi": "11/10", "unit": "N/m"}]
    assert json.loads(json.dumps(data))["parameters"]["k"] == "1"  # the nominal value
    assert "k(t) in [0.9, 1.1] N/m" in proved._repr_html_()
    assert proved.contains([0.1, 0.1])


def test_the_certificate_has_the_ranges_with_their_units(proved: RoaResult) -> None:
    assert proved.certificate is not None
    system = read_certificate(proved.certificate).system
    assert dict(system.ranges) == {"k": (F(9, 10), F(11, 10))} and system.units["k"] == "N/m"


@pytest.mark.parametrize(
    ("said", "read"), [("19/20", F(19, 20)), ("1/2", F(1)), ("0.95", F(1)), ("1/0", F(1)), (3, F(1)), (None, F(1))]
)
def test_nominal_values_of_a_file_are_for_people(proved: RoaResult, said: object, read: Fraction) -> None:
    """At which value a picture is drawn: what the file says if it lies in the range, else the middle."""
    assert proved.raw is not None and b'"nominal": {"k": "1"}' in proved.raw
    data = json.loads(proved.raw)
    data["provenance"]["nominal"] = {"k": said}
    certificate = parse_certificate(json.dumps(data).encode(), "c")
    assert certificate.system.parameters["k"] == read and dict(certificate.system.ranges) == {"k": (F("0.9"), F("1.1"))}
    data["provenance"]["nominal"] = {"k": "19/20", "p": "1", "unknown": "2"}  # one that is odd: none is believed
    assert parse_certificate(json.dumps(data).encode(), "c").system.parameters["k"] == 1


def test_all_kinds_at_once_are_claimed_for_a_line(tmp_path: Path) -> None:
    """What pushes at the origin leaves practical stability; the three ways in give one plant."""
    p, u, k, w = symbols("p F k wind")
    line = System(
        "line", (p,), (u,), {"k": F(1)}, (-k * p + p**3 / 4 + u + w,), (Number(0),), ((F(-2), F(2)),),
        ((F(-1), F(1)),), disturbances=(w,),
    )  # fmt: skip
    law = PolicyNetwork.of_layers((np.array([[-0.3]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", "none")
    result = certify_roa(
        line, law, tmp_path, candidate="lyapunov", ranges=K, disturbances={"wind": "0.05"}, input_error="0.001"
    )
    assert result.verdict is Verdict.PROVED and result.claim == "nearby"
    assert [(q["name"], q["kind"], q["lo"], q["hi"]) for q in result.to_dict()["uncertain"]] == [
        ("k", "parameter", "9/10", "11/10"),
        ("wind", "disturbance", "-1/20", "1/20"),
        ("error_F", "input error", "-1/1000", "1/1000"),
    ]
    # what the worst constant disturbance holds in place lies in the inner set: p + tanh(0.3 p) - p^3/4 = 0.051
    floor, roa = result.levels.floor, result.levels.roa
    assert floor is not None and roa is not None and result.P is not None
    resting = 0.051 / (0.9 + 0.3)
    assert float(result.P[0, 0]) * resting**2 < floor < roa


def test_a_witness_has_its_values(proved: RoaResult) -> None:
    from dataclasses import replace

    x = np.array([1.5, 0.0])
    for kind, values in (("vdot", {"k": "9/10"}), ("input", {})):
        witness = Witness(x, 1.0, kind, {"k": F(9, 10)})  # type: ignore[arg-type]
        found = replace(proved, witness=witness, stop=Stop.WITNESS).to_dict()["witness"]
        assert found == {"x": [1.5, 0.0], "V": 1.0, "kind": kind, "values": values}


@pytest.mark.parametrize(
    ("options", "part"),
    [
        ({"engine": "dreal"}, "`engine` must be bounds where something is uncertain"),
        ({"engine": "both"}, "`engine` must be bounds where something is uncertain"),
        ({"reach_from": {"p": 0.1}}, "a tube around a path must be of exact equations"),
    ],
)
def test_what_is_about_exact_equations_is_refused(tmp_path: Path, options: dict[str, Any], part: str) -> None:
    with pytest.raises(InputError, match=part) as found:
        certify_roa(spring(tmp_path), soft(), tmp_path / "o", ranges=K, **options)
    assert "found ranges of k in spring" in str(found.value)
    assert not (tmp_path / "o" / "certificate.json").exists()


def test_queries_for_solvers_are_refused(tmp_path: Path) -> None:
    """They would be about the nominal plant, and say so nowhere."""
    exact, claim = spring(tmp_path), Asymptotic(roa=0.5, local=0.1)
    for system in (exact, exact.with_ranges({"k": (F(9, 10), F(11, 10))})):
        problem = Problem(ClosedLoop(system, soft()), Quadratic(np.eye(2)))
        ring = next(c for c in conditions(claim, problem) if c.name == "ring")
        if system is exact:
            assert query(ring, problem).name == "ring"
        else:
            with pytest.raises(InputError, match="must be about exact equations; spring has ranges of k"):
                query(ring, problem)


@pytest.mark.parametrize(
    ("given", "part"),
    [
        ({"ranges": {"k": 0.1}}, r"`ranges\['k'\]` must be a sequence"),
        ({"ranges": {"k": (1, 2, 3)}}, r"must be a pair \(lo, hi\)"),
        ({"ranges": [("k", 1, 2)]}, "`ranges` must be a mapping from names to pairs"),
        ({"ranges": {"k": ("little", "much")}}, "must be a finite number"),
        ({"ranges": {"wind": (-1, 1)}}, "spring has no parameter 'wind'"),
        ({"disturbances": {"wind": True}}, "must be a sequence|must be a number"),
        ({"disturbances": {"wind": (1, -1)}}, "must satisfy lo < hi"),
        ({"disturbances": {"gust": 1}}, "spring has no disturbance 'gust'; it has: wind"),
        ({"input_error": {"G": 1}}, "for one of F"),
        ({"input_error": float("nan")}, "`input_error` must be a finite number"),
        ({"input_error": [1]}, "`input_error` must be a number"),
    ],
)
def test_ranges_that_are_none_are_refused_in_python(tmp_path: Path, given: dict[str, Any], part: str) -> None:
    with pytest.raises(InputError, match=part):
        certify_roa(spring(tmp_path), soft(), tmp_path / "o", **given)


def test_the_thrust_of_a_quadrotor_is_nominal() -> None:
    """A mass that is off moves the point of rest, so that only practical stability can be claimed."""
    system = get_system("quadrotor2d")
    lift = PlantChanges(parameters={"m": (F(476, 1000), F(496, 1000))}).of(system)
    assert lift.exact_u_eq() == system.exact_u_eq()
    offset = np.array([float(q) for q in system.exact_u_eq()])
    law = PolicyNetwork.of_layers((np.zeros((2, 6)),), (np.zeros(2),), np.ones(2), offset, "identity", "output")
    ClosedLoop(system, law).require_rest()
    with pytest.raises(InputError, match="whatever m may be; y_dot' depends on that"):
        ClosedLoop(lift, law).require_rest()
