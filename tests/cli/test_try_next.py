"""`try next`: the command that is printed can be typed, changes what it says, and nothing else; no advice is of options
that the question has not, or changes nothing."""

from __future__ import annotations

import ast
import io
import itertools
import json
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from certify.analysis import diagnosis, suggested
from certify.analysis.asked import require_one_that_knows
from certify.analysis.diagnosis import diagnose
from certify.analysis.facts import Diagnosis, SimulatedFacts, Step, Tried
from certify.analysis.options import RoaOptions
from certify.analysis.reaching import following
from certify.analysis.results import RoaResult
from certify.analysis.run import certify_roa
from certify.certificates.verdict import Stop, Verdict
from certify.cli.main import _run
from certify.effort import Effort
from certify.errors import InputError, OptionError
from certify.loop.plants import System
from certify.loop.policies import Policy, PolicyNetwork, save_policy
from certify.report.reached import summary
from tests.support.loops import chain
from tests.support.marks import slow_after

PLANT = """
name = "cart"
states = ["p", "v"]
inputs = ["F"]
[parameters]
m = 2
[dynamics]
p = "v"
v = "F/m"
[x_eq]
p = "1"
v = "0"
[u_eq]
F = 0
[domain]
p = [-1, 4]
v = [-3, 3]
[input_bounds]
F = [-20, 20]
"""
ADVICE = {
    "--effort": "4",
    "--from": "p=1.2..1.4,v=0",
    "--candidate": "auto",
    "--domain": "p=-2..5.5",
    "--enlarge": "",
    "--ranks": "",
    "--rate": "0.198",
    "--max-boxes": "30",
    "--time-limit": "100",
    "--resume": "",
    "--sample-time": "0.05",
    "--centre": "output",
    "--claim": "auto",
}
"""All options that an advice may have, with a value of its form."""


@dataclass(frozen=True)
class Asked:
    """What the command was about: its plant, network and options."""

    system: System
    network: PolicyNetwork
    options: RoaOptions


@pytest.fixture
def loop_words(tmp_path: Path) -> list[str]:
    network = PolicyNetwork.of_layers(
        (np.array([[-2.0, -3.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )
    save_policy(tmp_path / "a cart.pt", Policy(network, "cart", {"m": 2}))
    (tmp_path / "cart.toml").write_text(PLANT)
    plant, out = str(tmp_path / "cart.toml"), str(tmp_path / "out")
    return ["--policy", str(tmp_path / "a cart.pt"), "--system", plant, "--quiet", "--out", out]


@pytest.fixture
def printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[list[str], Step], tuple[Asked, str | None]]:
    """What a command asks for, and the command that it prints as the next one, if its run ends with a step."""

    def of(words: list[str], step: Step) -> tuple[Asked, str | None]:
        asked = list[Asked]()

        def ended(system: System, network: PolicyNetwork, out: Path, options: RoaOptions, **_: Any) -> RoaResult:
            asked.append(Asked(system, network, options))
            told = Diagnosis("", "", None, None, None, (), None, None, (), step)
            return RoaResult(Verdict.UNKNOWN, Stop.EFFORT, system, network, diagnosis=told)

        monkeypatch.setattr("certify.analysis.run.certify_roa", ended)
        capsys.readouterr()
        status = _run([*words, "--json"], True)
        out, error = capsys.readouterr()
        assert status == 3, out + error
        return asked[0], json.loads(out)["diagnosis"]["next"].get("command")

    return of


def follow(printed: Any, words: list[str], *options: str) -> tuple[Asked, Asked, str]:
    """What was asked for, what the printed command asks for, and that command."""
    step = Step(tuple((name, ADVICE[name]) for name in options), "")
    before, command = printed(words, step)
    assert command is not None
    after, again = printed(shlex.split(command)[1:], step)
    assert again == command + " --json" or again == command  # the next one after it is the same: nothing piles up
    return before, after, command


def names_in_steps() -> set[str]:
    """Names of options that stand in steps of the source."""
    found = set[str]()
    for module in (diagnosis, following, suggested):
        for node in ast.walk(ast.parse(Path(str(module.__file__)).read_text())):
            if isinstance(node, ast.Tuple) and node.elts and isinstance(node.elts[0], ast.Constant):
                first = node.elts[0].value
                found |= {first} if isinstance(first, str) and first.startswith("--") else set()
    return found


def test_every_option_of_an_advice_is_tried_here() -> None:
    assert names_in_steps() == set(ADVICE)


@pytest.mark.parametrize(
    ("more", "changed", "field", "value"),
    [
        (["--effort", "0.5"], ["--effort"], "effort", 4.0),
        (["--candidate", "lqr", "--R", "1"], ["--candidate"], "candidate", "auto"),
        ([], ["--candidate"], "candidate", "auto"),
        ([], ["--enlarge"], "enlarge", True),
        (["--rate", "0.4"], ["--rate"], "rate", 0.198),
        (["--max-boxes", "3"], ["--max-boxes"], "max_boxes", 30),
        (["--time-limit", "10"], ["--time-limit"], "time_limit", 100.0),
        (["--claim", "practical"], ["--claim"], "claim", "auto"),
        (["--sample-time", "0.1"], ["--ranks"], "ranks", True),
    ],
)
def test_an_option_is_added_or_replaced(
    printed: Any, loop_words: list[str], more: list[str], changed: list[str], field: str, value: object
) -> None:
    before, after, _ = follow(printed, ["roa", *loop_words, *more], *changed)
    assert getattr(after.options, field) == value
    assert replace(after.options, **{field: getattr(before.options, field)}) == before.options
    assert after.system == before.system


@pytest.mark.parametrize(
    "typed", [[], ["--domain", "v=2"], ["--domain", "v=2", "--domain", "p=0..2"], ["--domain", "p=0..2"]]
)
def test_a_side_of_the_domain_is_replaced_and_the_others_stay(
    printed: Any, loop_words: list[str], typed: list[str]
) -> None:
    """Values, not deviations: p = -2..5.5 around p = 1."""
    before, after, _ = follow(printed, ["roa", *loop_words, *typed, "--param", "m=3"], "--domain")
    assert after.system.domain == ((-3, Fraction(9, 2)), before.system.domain[1])
    assert replace(after.system, domain=before.system.domain) == before.system and after.options == before.options


def test_the_loop_is_changed(printed: Any, loop_words: list[str]) -> None:
    before, after, _ = follow(printed, ["roa", *loop_words, "--sample-time", "0.1"], "--sample-time")
    assert before.system.sample == (Fraction(1, 10),) * 2 and after.system.sample == (Fraction(1, 20),) * 2
    before, after, _ = follow(printed, ["roa", *loop_words], "--centre", "--claim")
    assert (before.network.centre, after.network.centre) == ("none", "output")


def test_a_resumed_search_has_its_own_candidate(printed: Any, loop_words: list[str]) -> None:
    _, after, command = follow(printed, ["roa", *loop_words, "--candidate", "lqr", "--R", "1"], "--effort", "--resume")
    assert after.options.resume and after.options.only is None and "--candidate" not in command


@pytest.mark.parametrize("name", sorted(ADVICE))
def test_a_command_that_has_no_such_option_is_not_printed(printed: Any, loop_words: list[str], name: str) -> None:
    """`certify reach` has fewer options than `certify roa`; the reason alone is said then."""
    words = ["reach", *loop_words, "--from", "p=1.5,v=0"]
    step = Step(((name, ADVICE[name]),), "so it is")
    before, command = printed(words, step)
    if command is None:
        assert name in ("--candidate", "--enlarge", "--ranks", "--rate", "--max-boxes", "--claim")
    elif name not in ("--from", "--sample-time"):  # a tube is one of continuous time
        after, _ = printed(shlex.split(command)[1:], step)
        assert after.options.reach_from == before.options.reach_from


def runs_of(system: System, network: PolicyNetwork, folder: Path) -> RoaResult:
    return certify_roa(system, network, folder, RoaOptions(effort=0.05, candidate="lyapunov"))


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, RoaResult]:
    """Results about loops in continuous time, with held inputs, and at rest beside the origin."""
    system, network = chain(2, [-1.0, -2.0])
    aside = PolicyNetwork.of_layers(network.weights, (np.array([0.01]),), np.ones(1), np.zeros(1), "identity", "none")
    held = system.with_sample((Fraction(1, 20), Fraction(1, 20)))
    loops = {"plain": (system, network), "held": (held, network), "aside": (system, aside)}
    return {name: runs_of(*loop, tmp_path_factory.mktemp(name)) for name, loop in loops.items()}


def asked_so() -> list[RoaOptions]:
    """Options that people may give."""
    P = np.array([[1.0, 0.2], [0.2, 0.3]])
    each: list[dict[str, Any]] = [
        {}, {"candidate": "ellipsoid"}, {"candidate": "lqr"}, {"candidate": "neural"}, {"candidate": "optimised"},
        {"Q": (1.0, 2.0)}, {"R": (1.0,)}, {"level": 0.1}, {"P": P}, {"rate": 0.1}, {"enlarge": True}, {"ranks": True},
        {"engine": "both"}, {"max_boxes": 1}, {"time_limit": 5.0}, {"resume": True}, {"reach_from": {"x1": 0.1}},
    ]  # fmt: skip
    found = list[RoaOptions]()
    for one, claim in itertools.product(each, ("auto", "asymptotic", "practical")):
        try:
            found.append(RoaOptions(claim=claim, effort=0.05, **one))  # type: ignore[arg-type]
        except OptionError:
            continue
    return found


def steps_of(result: RoaResult, options: RoaOptions, monkeypatch: pytest.MonkeyPatch) -> set[Step]:
    """What is advised after ends of all kinds; a tube is always found, so that it is advised wherever it may be."""
    monkeypatch.setattr(diagnosis, "_has_tube", lambda *_: True)
    monkeypatch.setattr(diagnosis, "_LOOK", 1.0)  # nothing is simulated or sampled for long
    monkeypatch.setattr(suggested, "_LOOK", 1.0)
    names = ("lqr", "optimised") if options.only is None else (options.only,)
    shares = (None, SimulatedFacts(100, 90, 20), SimulatedFacts(100, 90, 90))
    found = set[Step]()
    for stop, name, simulated in itertools.product(Stop, names, shares):
        if stop not in (Stop.UNSTABLE, Stop.SPECTRUM):
            tried = (Tried(name, 1.0, "", 1.0, True, 0.5),)
            ended = replace(result, stop=stop, tried=tried, simulated=simulated)
            found.add(diagnose(ended, options, None, effort=Effort(1.0)).next)
    return found


@pytest.mark.parametrize("name", slow_after(1, ["held", "plain", "aside"]))
def test_an_advice_can_be_followed_and_changes_something(
    results: Mapping[str, RoaResult], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For all options that a run may have had: the new ones fit together and fit the loop, and are not the old ones."""
    result, seen, steps = results[name], set[str](), dict[str, set[Step]]()
    assert result.verdict is Verdict.PROVED
    for options in asked_so():
        weaker = options.claim == "practical"
        try:
            require_one_that_knows(result.system, options)
        except InputError:
            continue
        if name == "aside" and (options.claim == "asymptotic" or options.enlarges):
            continue
        if options.ranks and not result.system.in_steps:
            continue
        ended = replace(result, claim="practical") if weaker else result
        resolved = replace(options, claim="asymptotic" if ended.claim == "asymptotic" else "practical")
        if repr(resolved) not in steps:
            steps[repr(resolved)] = steps_of(ended, resolved, monkeypatch)
        for step in steps[repr(resolved)]:
            seen |= {option for option, _ in step.options}
            require_followed(result.system, options, dict(step.options))
    assert {"--effort", "--domain", "--candidate"} <= seen or name == "held"
    assert ("--ranks" in seen) is (name == "held") and ("--enlarge" in seen) is (name == "plain")


def require_followed(system: System, options: RoaOptions, changed: Mapping[str, str]) -> None:
    new = options
    if "--resume" in changed:
        new = replace(new, candidate="auto", Q=None, R=None, level=None, resume=True)
    values: dict[str, Any] = {}
    for name, text in changed.items():
        kind = {"--effort": float, "--rate": float, "--time-limit": float, "--max-boxes": int}.get(name, str)
        if name in ("--enlarge", "--ranks"):
            values[name[2:]] = True
        elif name not in ("--domain", "--sample-time", "--centre", "--resume"):
            values[name[2:].replace("-", "_")] = kind(text)
    new = replace(new, **values)  # raises if the options do not go together
    require_one_that_knows(system, new)
    loop_changes = {"--domain", "--sample-time", "--centre"} & set(changed)
    same = all(getattr(new, f) is getattr(options, f) or getattr(new, f) == getattr(options, f) for f in values)
    assert not values or not same or loop_changes, (options.candidate, options.only, changed)
    if "--candidate" in changed and not loop_changes:
        assert (new.only, new.learned) != (options.only, options.learned) or new.goes_on != options.goes_on, changed


@pytest.mark.parametrize(
    ("more", "option", "better"),
    [
        (["--rate", "1.5", "--effort", "0.1"], "--rate", lambda old, new: new["verdict"] == "PROVED" != old["verdict"]),
        (
            ["--sample-time", "4", "--effort", "0.2"],
            "--sample-time",
            lambda old, new: new["verdict"] == "PROVED" != old["verdict"],
        ),
        pytest.param(
            ["--sample-time", "0.2", "--candidate", "ellipsoid", "--effort", "0.1"],
            "--ranks",
            lambda old, new: new["ranks"]["volume"] > 1.2 * old["volume"],
            marks=pytest.mark.slow,
        ),
        (
            ["--Q", "1,30", "--effort", "0.2"],
            "--candidate",
            lambda old, new: new["outer"]["volume"] > 1.2 * old["volume"],
        ),
    ],
)
def test_who_follows_it_gets_more(
    loop_words: list[str],
    capsys: pytest.CaptureFixture[str],
    more: list[str],
    option: str,
    better: Callable[[dict[str, Any], dict[str, Any]], bool],
) -> None:
    """Run for run, as typed: the command that a run prints proves what that run did not."""
    found, command = list[dict[str, Any]](), shlex.join(["certify", "roa", *loop_words, *more])
    for _ in range(2):
        capsys.readouterr()
        _run([*shlex.split(command)[1:], *([] if "--json" in command else ["--json"])], True)
        found.append(json.loads(capsys.readouterr().out))
        command = command if len(found) == 2 else found[0]["diagnosis"]["next"]["command"]
    assert option in command and better(*found), (command, found[1]["verdict"], found[0]["volume"], found[1]["volume"])


@pytest.mark.parametrize(
    ("more", "changed", "proves"),
    [
        (["--from", "p=1.6..3,v=0", "--effort", "0.003"], {"--effort": "0.03"}, True),
        pytest.param(
            ["--from", "p=1.6..3,v=0", "--effort", "1"],
            {"--from": "p=1.95..2.65,v=0"},
            True,
            marks=pytest.mark.slow,
        ),
        (["--from", "p=1.6..3,v=0", "--effort", "2", "--time-limit", "1e-9"], {"--time-limit": "1e-08"}, False),
        (["--effort", "1e-7"], {"--effort": "1e-06"}, False),
    ],
)
def test_a_search_whose_effort_ended_says_so_and_what_to_try(
    loop_words: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    more: list[str],
    changed: dict[str, str],
    proves: bool,
) -> None:
    """`certify reach --target`, run for run as typed: what it prints is the same command but for one option."""
    words = ["reach", *loop_words, "--sample-time", "0.1", "--target", "p <= 1.5", *more]
    short = float(more[-1]) >= 1
    with monkeypatch.context() as patch:
        if short:  # the search of an effort of 1 takes a minute
            patch.setattr("certify.analysis.reaching.run._FOR_SEARCH", 1e-9)
        status, before, said = told(capsys, words)
    assert status == 3 and before["reason"].endswith("proved to lead into the target: the effort is over")
    assert before["next"]["options"] == changed and "try next" in said
    assert f"nothing was proved yet when the {'time' if '--time-limit' in changed else 'effort'} ended" in said
    typed = shlex.split(before["next"]["command"])[1:]
    assert set(typed) - set(words) == {"--json", *changed.values()}
    if proves:
        status, after, _ = told(capsys, typed)
        assert status == 0 and after["verdict"] == "PROVED"


@pytest.mark.parametrize(
    ("more", "options", "why"),
    [
        ([], {}, "no box of the domain meets the target or leads there"),
        (["--from", "p=1.6,v=0"], {}, "a larger target asks for less"),
        (
            ["--from", "p=1.6..3,v=0"],
            {"--from": "p=1.95..2.65,v=0"},
            "whatever the effort; a smaller one asks for less",
        ),
    ],
)
def test_a_search_that_ends_without_a_box_says_what_to_try(
    loop_words: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    more: list[str],
    options: dict[str, str],
    why: str,
) -> None:
    monkeypatch.setattr("certify.analysis.reaching.run.prove_ranks", lambda *_: None)
    words = ["reach", *loop_words, "--sample-time", "0.1", "--target", "p <= 1.5", *more]
    status, found, said = told(capsys, words)
    assert status == 3 and found["reason"].endswith("proved to lead into the target")
    assert found["next"]["options"] == options and why in said


@pytest.mark.slow
def test_a_search_that_proves_boxes_says_where_more_effort_finds_more(
    loop_words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["reach", *loop_words, "--sample-time", "0.1", "--target", "p <= 1.5", "--effort", "0.01"]
    status, before, said = told(capsys, words)
    assert status == 0 and before["next"]["options"] == {"--effort": "0.04"} and "limited by" in said
    _, after, _ = told(capsys, shlex.split(before["next"]["command"])[1:])
    assert after["ranks"]["volume"] > before["ranks"]["volume"]


def told(capsys: pytest.CaptureFixture[str], words: list[str]) -> tuple[int, dict[str, Any], str]:
    """The status of a command, its JSON object, and its summary in one line."""
    capsys.readouterr()
    status = _run([*words, *([] if "--json" in words else ["--json"])], True)
    data = json.loads(capsys.readouterr().out)
    console = Console(file=io.StringIO(), width=1000)
    console.print(summary(data))
    return status, data, console.file.getvalue()  # type: ignore[attr-defined]
