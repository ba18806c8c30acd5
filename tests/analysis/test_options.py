"""Options of a run and changes of a plant: declared once, and the same whichever way they come."""

from __future__ import annotations

import inspect
import json
import typing
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from itertools import cycle
from pathlib import Path
from types import UnionType
from typing import Any

import numpy as np
import pytest

from certify import InputError, RoaOptions, certify_roa, get_system, lyapunov
from certify.analysis.api import Keywords, in_python
from certify.analysis.arguments import changes_of, options_of
from certify.analysis.changes import PlantChanges
from certify.analysis.declaration import Option, declared
from certify.analysis.studies.case import OPTIONS, PLANT_OPTIONS, TABLES
from certify.analysis.studies.study import KNOWN, read_study
from certify.analysis.values import changes_in
from certify.cli.main import _run, command_line
from certify.cli.options import FIRST
from certify.loop.plants import System
from certify.loop.plants.system import Interval
from certify.loop.policies import load_policy
from docs.hooks import on_page_markdown

ROOT = Path(__file__).parent.parent.parent
SHIPPED = ROOT / "examples" / "policies" / "pendulum.pt"
DECLARED = {**declared(RoaOptions), **declared(PlantChanges)}
BY_NAME = pytest.mark.parametrize("option", DECLARED.values(), ids=DECLARED)


def parameters(command: str) -> dict[str, Any]:
    """The parameters of a command by their names."""
    commands = command_line().commands
    return {one.name: one for one in commands[command].params}


@BY_NAME
def test_each_option_says_what_it_is_in_sentences(option: Option) -> None:
    for said in (option.help, option.written, option.python):
        assert not said or (said.strip() == said and said.endswith("."))
    assert len(option.help) > 20 and option.group in ("loop", "claim", "candidate", "effort")
    assert option.typed or option.keyword


@BY_NAME
def test_the_command_line_is_made_of_the_declarations(option: Option) -> None:
    if not option.typed:
        assert option.name == "P"
        return
    one = parameters("reach" if option.name == "reach_from" else "roa")[option.name]
    assert one.opts == [option.typed] and one.help.startswith(option.help) and one.rich_help_panel
    assert (one.rich_help_panel == FIRST) == option.first


def test_python_is_made_of_the_declarations() -> None:
    keywords = {option.keyword: option for option in DECLARED.values() if option.keyword}
    assert keywords.keys() == Keywords.__annotations__.keys()  # the types alone are written a second time
    signature, doc = inspect.signature(certify_roa), inspect.getdoc(certify_roa) or ""
    said = " ".join(doc.split())
    assert typing.get_type_hints(Keywords)["level"] == (float | None)
    for keyword, option in keywords.items():
        assert signature.parameters[keyword].default == option.default
        assert f"{keyword} : {in_python(option.help)}" in said
    assert "<options>" not in doc and "`--" not in doc


NAMED = {
    **{name: getattr(lyapunov, name) for name in ("Candidate", "Neural", "Polynomial", "Symbolic")},
    "Interval": Interval,
    "Changes": Mapping[str, Fraction | Interval],
    "Array": np.ndarray,
    "System": System,
}
"""Types that the fields name for type checkers alone."""
WIDER = {"reach_from", "lyapunov", "Q", "R", "hidden", "disturbances", "input_error", "sample_time", "keep", "avoid"}
"""Options that Python takes in more forms than their fields hold."""
APART = {"P", "ranges"}
"""Options whose forms no rule compares: all that numpy makes an array of; and ranges without the plant's values."""


def accepts(wide: Any, narrow: Any) -> bool:
    """True if each value of the second type is one of the first."""
    if wide == narrow:
        return True
    if typing.get_origin(narrow) in (UnionType, typing.Union):
        return all(accepts(wide, one) for one in typing.get_args(narrow))
    if typing.get_origin(wide) in (UnionType, typing.Union):
        return any(accepts(one, narrow) for one in typing.get_args(wide))
    outer, inner = typing.get_origin(wide), typing.get_origin(narrow)
    if not (isinstance(outer, type) and isinstance(inner, type) and issubclass(inner, outer)):
        return False
    given = [one for one in typing.get_args(narrow) if one is not ...]
    return all(map(accepts, cycle(typing.get_args(wide)), given))


@pytest.mark.parametrize("of", [RoaOptions, PlantChanges])
def test_pythons_keywords_have_the_types_of_the_fields(of: type) -> None:
    """Type checkers read `Keywords` as it is written, so that it cannot be made of the fields."""
    keywords, fields = typing.get_type_hints(Keywords), typing.get_type_hints(of, localns=NAMED)
    for name, one in declared(of).items():
        if one.keyword and one.keyword not in APART:
            asked, held = keywords[one.keyword], fields[name] | None
            assert accepts(asked, held), name
            assert accepts(held, asked) == (name not in WIDER), name


def test_a_study_is_made_of_the_declarations() -> None:
    fixed = {"candidate", "P", "reach_from", "jobs", "cluster", "resume"}
    assert set(OPTIONS.values()) == declared(RoaOptions).keys() - fixed
    assert {*TABLES, *PLANT_OPTIONS} == declared(PlantChanges).keys()
    page = on_page_markdown((ROOT / "docs" / "how-to" / "sweeps.md").read_text("utf-8"))
    assert ", ".join(f"`{key}`" for key in KNOWN) in page and "precision" in KNOWN and "effort" in KNOWN


@pytest.mark.parametrize("columns", [80, 100])
def test_help_shows_panels_and_first_what_is_needed_first(
    columns: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    assert _run(["roa", "--help"], False) == 0
    lines = capsys.readouterr().out.splitlines()
    titles = [line for line in lines if line.endswith(":") and not line.startswith(" ")]
    panels = ["To begin with", "The loop", "The claim", "The candidate", "Effort and engine", "Output"]
    assert titles == [f"{panel}:" for panel in ["Arguments", *panels, "Policies of other programs"]]
    first = lines[lines.index("To begin with:") : lines.index("The loop:")]
    assert sum(line.startswith("  --") for line in first) == 10
    assert columns - 15 < max(map(len, lines)) <= columns


TEXTS: dict[str, Any] = {
    "parameters": ["b=0.05..0.2"],
    "input_error": "u=1/1000",
    "sample_time": "0.001..0.002",
    "keep": ["wall: theta <= 1; abs(u) <= 5"],
    "avoid": ["theta**2 > 9"],
}
VALUES: dict[str, Any] = {
    "ranges": {"b": ("0.05", Fraction(1, 5))},
    "input_error": {"u": Fraction(1, 1000)},
    "sample_time": ("0.001", "0.002"),
    "keep": ["wall: theta <= 1", "abs(u) <= 5"],
    "avoid": "theta**2 > 9",
}


def test_a_changed_plant_is_the_same_whichever_way_it_comes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """From the command line, from Python and from a study, up to the pipeline, which gets plant and options."""
    seen: list[tuple[Any, Any]] = []

    class Reached(InputError):
        pass

    def reached(system: Any, network: Any, out: Path, options: RoaOptions, **_: Any) -> None:
        seen.append((system, options))
        raise Reached("reached")

    for module in ("run", "api"):
        monkeypatch.setattr(f"certify.analysis.{module}.{'run' if module == 'api' else 'certify_roa'}", reached)
    typed = ["--param", "b=0.05..0.2", "--input-error", "u=1/1000", "--sample-time", "0.001..0.002", "--level", "0.1"]
    typed += ["--keep", "wall: theta <= 1", "--keep", "abs(u) <= 5", "--avoid", "theta**2 > 9"]
    assert _run(["roa", str(SHIPPED), *typed, "--effort", "1/2", "--out", str(tmp_path)], False) == 2
    with pytest.raises(InputError, match="reached"):
        certify_roa(None, SHIPPED, tmp_path, level=0.1, effort=0.5, **VALUES)
    study = tmp_path / "s.toml"
    study.write_text(
        f'policies = "{SHIPPED}"\n[parameters]\nb = "0.05..0.2"\n[options]\ninput_error = "u=1/1000"\n'
        'sample_time = "0.001..0.002"\nlevel = 0.1\neffort = "1/2"\nkeep = "wall: theta <= 1; abs(u) <= 5"\n'
        'avoid = "theta**2 > 9"\n'
    )
    (case,) = read_study(study).cases()
    _, plant, options = case.loop(tmp_path, lambda _: None)
    assert len(seen) == 2 and seen[0] == seen[1] == (plant, options)
    assert plant == changes_of(TEXTS).of(get_system("pendulum")) == changes_in(VALUES).of(get_system("pendulum"))
    assert dict(plant.ranges) == {
        "b": (Fraction(1, 20), Fraction(1, 5)),
        "error_u": (Fraction(-1, 1000), Fraction(1, 1000)),
    }
    assert list(plant.constraints) == ["wall", "keep", "avoid"]
    assert plant.sample == (Fraction(1, 1000), Fraction(1, 500)) and (options.level, options.effort) == (0.1, 0.5)


def test_changes_are_put_in_in_one_order() -> None:
    """The domain is about the operating point of the changed parameters, and a range moves a value that it lacks."""
    changes = changes_of({"parameters": ["m=0.2..0.4"], "domain": ["theta=1"], "disturbances": []})
    plant = changes.of(get_system("pendulum"))
    assert plant.parameters["m"] == Fraction(3, 10) and plant.domain[0] == (-1, 1)
    assert PlantChanges().of(get_system("pendulum")) == get_system("pendulum")


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        ({"parameters": ["m"]}, "`parameters` takes NAME=VALUE"),
        ({"parameters": ["m=x=1"]}, "`parameters` takes a finite number such as m=0.15"),
        ({"input_error": "0.1..0.2"}, "`input_error` must be a finite number"),
        ({"sample_time": "u=1"}, "`sample_time` must be a finite number"),
    ],
)
def test_texts_that_are_no_changes(texts: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        changes_of(texts)


def test_the_effort_is_read_and_the_clock_is_not_limited() -> None:
    plant = get_system("pendulum")
    assert options_of({"effort": "0.1"}, plant, print) == RoaOptions(effort=0.1)
    assert RoaOptions(effort=2.0).time_limit is None
    assert RoaOptions(effort=2.0, time_limit=3.0).time_limit == 3.0
    for bad in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(InputError, match="`effort` must be a positive number"):
            RoaOptions(effort=bad)


def test_help_names_each_import_option_once(capsys: pytest.CaptureFixture[str]) -> None:
    for command, kind in (("roa", "--from"), ("reach", "--kind"), ("learn-lyapunov", "--from"), ("import", "--from")):
        found = parameters(command)
        assert found["kind"].opts == [kind]
        assert len({one for each in found.values() for one in each.opts}) == len(found), json.dumps(command)


def test_the_p_of_a_policys_training_is_tried_where_nothing_else_is_said() -> None:
    """It is a hint: a candidate, weights or a claim outrank it, and a record that says nonsense says nothing."""
    plant, told = get_system("pendulum"), list[str]()
    stored = load_policy(SHIPPED)
    P = [[2.0, 0.5], [0.5, 1.0]]

    def read(texts: dict[str, str], record: object) -> object:
        policy = replace(stored, training={"flattened": record})
        return options_of(texts, plant, told.append, policy).P

    np.testing.assert_array_equal(read({}, {"P": P}), np.array(P))
    assert "--candidate auto tries others" in told[0]
    for texts in ({"candidate": "auto"}, {"Q": "1,1"}, {"level": "0.1"}, {"claim": "practical"}):
        assert read(texts, {"P": P}) is None
    for record in (None, {}, {"P": "nonsense"}, {"P": [[1.0]]}, {"P": [[1.0, 0.0], [1.0, 1.0]]}):
        assert read({}, record) is None
    assert options_of({}, plant, told.append).P is None
