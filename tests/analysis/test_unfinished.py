"""The file of a search: exactly the saved search is resumed, and anything else is refused in one sentence."""

from __future__ import annotations

import base64
import dataclasses
import json
import math
import pkgutil
import time
import zlib
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from certify.analysis import saved_search as unfinished
from certify.analysis.candidates.trials import Trial
from certify.analysis.run import RoaOptions, RoaResult, certify_roa
from certify.analysis.saved_search import Unfinished, load, save
from certify.certificates import run_checker
from certify.certificates.verdict import Stop, Verdict
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import get_system
from certify.lyapunov import domain_limit, volume
from certify.provers.base import Budget, SearchState, Task
from certify.provers.boxes.engine import BoundsEngine
from certify.provers.execution import ThreadRunner
from certify.provers.falsify import Witness, falsify
from tests.support.cases import case_of
from tests.support.loops import box, pendulum_network, scalar_tanh
from tests.support.marks import slow_after

WIDE = dataclasses.replace(get_system("pendulum"), domain=box(7, 30))
LOOP = ClosedLoop(WIDE, pendulum_network())
CASE = case_of(WIDE, pendulum_network())
LIMIT = domain_limit(CASE.P, WIDE.domain) * (1 - 1e-9)
VIOLATION = falsify(CASE.problem, CASE.T, LIMIT)
RUNNER = ThreadRunner()


def searched(boxes: int, target: float = 9.0, witness: Witness | None = VIOLATION) -> Unfinished:
    """A search after so many boxes."""
    task = Task(CASE.problem, "asymptotic", target, False, witness)
    attempt = BoundsEngine(CASE.T, RUNNER).begin(task)
    attempt.advance(Budget(boxes=boxes, batch=8))
    state = attempt.state()
    assert state is not None
    return Unfinished(Trial("lyapunov", task, CASE.T, LIMIT, "sampled", volume(CASE.P, target)), state)


def same(one: Unfinished, other: Unfinished) -> bool:
    """Whether two searches are the same to the last bit."""
    a, b = one.trial, other.trial
    numbers = (a.name, a.task.target, a.task.exactly, a.limit, a.limited_by, a.volume, a.T.tobytes(), a.P.tobytes())
    others = (b.name, b.task.target, b.task.exactly, b.limit, b.limited_by, b.volume, b.T.tobytes(), b.P.tobytes())
    s, t = one.state, other.state
    state = (s.inner, s.outer, s.boxes, s.proved, s.tree, s.keys.tobytes())
    return (
        numbers == others
        and state == (t.inner, t.outer, t.boxes, t.proved, t.tree, t.keys.tobytes())
        and told(s.witness) == told(t.witness)
        and told(a.task.witness) == told(b.task.witness)
    )


def told(witness: Witness | None) -> Any:
    if witness is None:
        return None
    return witness.x.tobytes(), witness.level, witness.kind, dict(witness.values), witness.period


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> tuple[Unfinished, bytes]:
    path = tmp_path_factory.mktemp("kept") / "search.json"
    search = searched(60)
    save(path, search)
    return search, path.read_bytes()


@given(boxes=st.integers(10, 200), target=st.floats(1.0, 10.0), violated=st.booleans())
@settings(max_examples=4, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_loaded_is_what_was_saved(boxes: int, target: float, violated: bool, tmp_path: Path) -> None:
    search = searched(boxes, target, VIOLATION if violated else None)
    path = tmp_path / "search.json"
    save(path, search)
    found = load(path, LOOP, 0.0)
    assert same(found, search)
    save(path, found)
    assert same(load(path, LOOP, 0.0), search)


@given(
    nodes=st.lists(st.sampled_from([0, 1, 253, 254, 255]), min_size=1, max_size=50),
    keys=st.lists(st.floats(allow_nan=False), max_size=20),
    boxes=st.integers(0, 2**40),
    share=st.floats(1e-3, 1.0),
)
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_so_it_is_of_any_tree_and_keys(
    kept: tuple[Unfinished, bytes], nodes: list[int], keys: list[float], boxes: int, share: float, tmp_path: Path
) -> None:
    """A search that does not fit is refused where it is resumed."""
    trial = kept[0].trial
    state = SearchState(share, 5.0, boxes, boxes // 2, VIOLATION, bytes(nodes), np.array(keys))
    path = tmp_path / "search.json"
    save(path, Unfinished(trial, state))
    if len(keys) > len(nodes):
        with pytest.raises(InputError, match="damaged"):
            load(path, LOOP, 0.0)
        return
    found = load(path, LOOP, 0.0)
    assert same(found, Unfinished(trial, state))
    attempt = BoundsEngine(trial.T, RUNNER).begin(trial.task)
    try:
        attempt.restore(found.state)
    except InputError as error:
        assert "cannot be resumed" in str(error)
    else:
        assert nodes.count(254) == len(keys)


@given(data=st.data())
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_damaged_file_is_refused_or_is_the_search_that_was_saved(
    kept: tuple[Unfinished, bytes], data: st.DataObject, tmp_path: Path
) -> None:
    search, raw = kept
    at, kind = data.draw(st.integers(0, len(raw) - 1)), data.draw(st.sampled_from(["flip", "cut", "insert", "swap"]))
    if kind == "flip":
        damaged = raw[:at] + bytes([raw[at] ^ (1 << data.draw(st.integers(0, 7)))]) + raw[at + 1 :]
    elif kind == "cut":
        damaged = raw[:at]
    elif kind == "insert":
        damaged = raw[:at] + data.draw(st.binary(min_size=1, max_size=4)) + raw[at:]
    else:
        other = data.draw(st.integers(0, len(raw) - 1))
        damaged = raw[:at] + raw[other : other + 8] + raw[at + 8 :]
    path = tmp_path / "search.json"
    path.write_bytes(damaged)
    try:
        assert same(load(path, LOOP, 0.0), search)
    except InputError as error:
        assert "run without --resume" in str(error).lower() or "must be of the format" in str(error)


def packed(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 9)).decode()


def numbers(*values: float) -> str:
    return base64.b64encode(np.array(values, dtype="<f8").tobytes()).decode()


VALID = {"x": numbers(2.0, 0.0), "level": (1.0).hex(), "kind": "vdot", "values": {}, "period": None}
HOSTILE: dict[str, dict[str, Any]] = {
    "no number": {"inner": "nan"},
    "an infinite level": {"target": "inf"},
    "a level of another kind": {"outer": 3},
    "levels in another order": {"inner": (8.0).hex(), "outer": (1.0).hex()},
    "a level beyond binary64": {"limit": "0x1p99999"},
    "a level beyond the domain": {"target": (1e6).hex(), "limit": (1e7).hex()},
    "no positive definite P": {"P": numbers(1.0, 2.0, 2.0, 1.0)},
    "no symmetric P": {"P": numbers(1.0, 0.5, 0.0, 1.0)},
    "P of another size": {"P": numbers(1.0)},
    "P that is no number": {"P": numbers(math.nan, 0.0, 0.0, 1.0)},
    "singular coordinates": {"T": numbers(1.0, 1.0, 1.0, 1.0)},
    "coordinates without end": {"T": numbers(math.inf, 0.0, 0.0, 1.0)},
    "a volume that is no number": {"volume": "nan"},
    "counts below 0": {"boxes": -5},
    "counts beyond all": {"boxes": 10**300},
    "counts that are text": {"boxes": "12"},
    "a flag that is text": {"exactly": "no"},
    "a name with control characters": {"candidate": "\x1b[2J"},
    "a name of a megabyte": {"candidate": "x" * 2**20},
    "a limit of another kind": {"limited_by": ["domain"]},
    "a tree that is no text": {"tree": 7},
    "a tree that is not packed": {"tree": base64.b64encode(b"abc").decode()},
    "a tree without its end": {"tree": base64.b64encode(zlib.compress(bytes(1000))[:-4]).decode()},
    "more after the tree": {"tree": base64.b64encode(zlib.compress(bytes(10)) + b"x").decode()},
    "keys that are cut off": {"keys": packed(b"1234567")},
    "more keys than nodes": {"keys": packed(bytes(2**22))},
    "a violation that is text": {"witness": "vdot"},
    "a violation without values": {"witness": VALID | {"values": [1, 2]}},
    "a violation of no kind": {"met": VALID | {"kind": "both"}},
    "a violation that is none": {"met": VALID},
    "a violation at infinity": {"met": VALID | {"x": numbers(math.inf, 0.0)}},
    "a violation over nothing": {"met": VALID | {"values": {"m": "1/0"}}},
    "a quantity beyond all": {"met": VALID | {"values": {"m": "1e999999999"}}},
    "a quantity that is not uncertain": {"met": VALID | {"values": {"m": "1/7"}}},
    "a period of no samples": {"met": VALID | {"period": "1/7"}},
}


def rewritten(raw: bytes, change: dict[str, Any]) -> bytes:
    """With other entries and the hash of these, as by somebody who knows how the file is made."""
    data = json.loads(raw)
    data.pop("sha256")
    data |= change
    return json.dumps(data | {"sha256": unfinished._digest(data)}).encode()


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_refused(name: str, kept: tuple[Unfinished, bytes], tmp_path: Path) -> None:
    path = tmp_path / "search.json"
    path.write_bytes(rewritten(kept[1], {}))
    assert same(load(path, LOOP, 0.0), kept[0])
    path.write_bytes(rewritten(kept[1], HOSTILE[name]))
    begin = time.monotonic()
    with pytest.raises(InputError, match=r"is damaged.*run without --resume"):
        load(path, LOOP, 0.0)
    assert time.monotonic() - begin < 2


def test_a_violation_that_is_lower_than_it_is_is_refused(kept: tuple[Unfinished, bytes], tmp_path: Path) -> None:
    """Else a file could say of a set that it ends at a violation that lies elsewhere."""
    path = tmp_path / "search.json"
    true = json.loads(kept[1])["witness"]
    assert VIOLATION is not None and true is not None
    path.write_bytes(rewritten(kept[1], {"witness": true | {"level": (VIOLATION.level / 2).hex()}}))
    with pytest.raises(InputError, match="a violation that is none"):
        load(path, LOOP, 0.0)


@pytest.mark.parametrize(
    "raw", [b"", b"null", b"[]", b"7", b'"x"', b"{}", b"\xff\xfe", b"[" * 10**6, b'{"format": "x"}']
)
def test_what_is_no_search_is_refused(raw: bytes, tmp_path: Path) -> None:
    (tmp_path / "search.json").write_bytes(raw)
    with pytest.raises(InputError, match=r"search\.json"):
        load(tmp_path / "search.json", LOOP, 0.0)


def test_what_is_not_there_or_no_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no search to resume"):
        load(tmp_path / "search.json", LOOP, 0.0)
    with pytest.raises(InputError, match="cannot be read"):
        load(tmp_path, LOOP, 0.0)


def test_a_tree_that_unpacks_without_end_is_refused(
    kept: tuple[Unfinished, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two hundred mebibytes in one; no more of it is unpacked than a certificate can hold."""
    packer = zlib.compressobj(1)
    bomb = b"".join(packer.compress(bytes(2**20)) for _ in range(200)) + packer.flush()
    path = tmp_path / "search.json"
    path.write_bytes(rewritten(kept[1], {"tree": base64.b64encode(bomb).decode()}))
    assert path.stat().st_size < 2**21
    with pytest.raises(InputError, match="too large"):
        load(path, LOOP, 0.0)
    monkeypatch.setattr(unfinished, "_LARGEST", 1000)
    with pytest.raises(InputError, match="larger than"):
        load(path, LOOP, 0.0)


OTHERS: dict[str, Callable[[], tuple[ClosedLoop, float]]] = {
    "policy": lambda: (ClosedLoop(WIDE, pendulum_network(seed=1)), 0.0),
    "plant": lambda: (ClosedLoop(WIDE.with_parameters({"m": Fraction(1, 7)}), pendulum_network()), 0.0),
    "domain": lambda: (ClosedLoop(dataclasses.replace(WIDE, domain=box(7, 31)), pendulum_network()), 0.0),
    "range": lambda: (ClosedLoop(WIDE.with_ranges({"m": (Fraction(1, 7), Fraction(1, 6))}), pendulum_network()), 0.0),
    "period": lambda: (ClosedLoop(WIDE.with_sample((Fraction(1, 50), Fraction(1, 50))), pendulum_network()), 0.0),
    "periods": lambda: (ClosedLoop(WIDE.with_sample((Fraction(0), Fraction(1, 50))), pendulum_network()), 0.0),
    "rate": lambda: (LOOP, 0.25),
}


@pytest.mark.parametrize("what", OTHERS)
def test_a_search_of_something_else_is_refused(what: str, kept: tuple[Unfinished, bytes], tmp_path: Path) -> None:
    (tmp_path / "search.json").write_bytes(kept[1])
    with pytest.raises(InputError, match="about another policy, plant, domain, period or rate"):
        load(tmp_path / "search.json", *OTHERS[what]())


# ------------------------------------------------------------------------------------------------------------ resumed


def begun(kept_: Unfinished) -> Any:
    return BoundsEngine(kept_.trial.T, RUNNER).begin(kept_.trial.task)


def test_a_search_in_pieces_is_the_search_in_one(tmp_path: Path) -> None:
    """The tree is the same if the search is kept and resumed again and again, as long as no level moves."""
    whole = begun(searched(10))
    whole.advance(Budget(batch=8))
    expected = whole.proof()
    search, levels = searched(10), []
    for _ in range(100):
        save(tmp_path / "search.json", search)
        found = load(tmp_path / "search.json", LOOP, 0.0)
        attempt = begun(found)
        attempt.restore(found.state)
        levels.append(attempt.level)
        attempt.advance(Budget(boxes=40, batch=8))
        if attempt.done:
            break
        state = attempt.state()
        assert state is not None
        search = Unfinished(found.trial, state)
    assert attempt.done and len(levels) > 3 and levels == sorted(levels)
    assert attempt.proof().claim == expected.claim and attempt.proof().evidence.tree == expected.evidence.tree


@pytest.mark.parametrize("factor", [1.5, 0.99, 30.0, 1e4])
def test_a_local_set_of_another_size(factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A larger one is made use of, however large; from a smaller one the search does not reach inwards."""
    search = searched(90)
    before = search.state
    task = search.trial.task
    old = begun(search)
    old.restore(before)
    level = old.level
    inner = min(factor * before.inner, task.target)
    monkeypatch.setattr("certify.provers.boxes.engine.prove_local", lambda *args: inner)
    attempt = begun(search)
    if factor < 1:
        with pytest.raises(InputError, match="local set is smaller"):
            attempt.restore(before)
        return
    attempt.restore(before)
    assert attempt.level >= level and attempt.level >= inner
    attempt.advance(Budget(batch=8))
    claim = attempt.proof().claim
    assert claim.local == inner <= claim.roa == pytest.approx(task.target)


def result_of(folder: Path, **more: Any) -> RoaResult:
    options = RoaOptions(**({"effort": 0.24} | more))
    return certify_roa(WIDE, pendulum_network(), folder, options)


@pytest.mark.slow
def test_a_run_out_of_boxes_is_gone_on_with_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for place in ("certify.analysis.stages.candidate", "certify.analysis.stages.ring", "certify.analysis.selection"):
        plain = Budget
        monkeypatch.setattr(
            f"{place}.Budget", lambda *args, plain=plain, **more: plain(*args, **({"batch": 16} | more))
        )
    monkeypatch.setattr("certify.analysis.stages.candidate._HEAT", 1e-9)
    found = [result_of(tmp_path, Q=(1.0, 1.0), max_boxes=150)]
    assert found[0].stop is Stop.BOXES and found[0].search == tmp_path / "search.json"
    found.append(result_of(tmp_path, resume=True, max_boxes=250))
    assert found[1].stop is Stop.BOXES and found[1].search is not None
    found.append(result_of(tmp_path, resume=True))
    assert found[2].search is None and not (tmp_path / "search.json").exists()
    levels = [one.levels.roa for one in found]
    assert None not in levels and levels == sorted(levels)  # type: ignore[type-var]
    for one in found:
        assert one.verdict is Verdict.PROVED
    assert found[2].certificate is not None and run_checker(found[2].certificate)["result"] == "ACCEPTED"
    with pytest.raises(InputError, match="no search to resume"):
        result_of(tmp_path, resume=True)


@pytest.mark.slow
def test_leaves_that_a_file_calls_proved_are_not_believed(kept: tuple[Unfinished, bytes], tmp_path: Path) -> None:
    """Everything is proved up to above a violation, says a file that is in order: the checker does not agree."""
    assert VIOLATION is not None
    lie = {"tree": packed(b"\xff"), "keys": packed(b""), "target": (1.05 * VIOLATION.level).hex()}
    lie |= {"outer": lie["target"], "inner": (0.05).hex(), "witness": None, "met": None}
    (tmp_path / "search.json").write_bytes(rewritten(kept[1], lie))
    found = result_of(tmp_path, resume=True)
    assert found.levels.roa is not None and found.levels.roa < VIOLATION.level
    assert found.verdict is Verdict.PROVED and found.stop is Stop.REFUSED and "refused" in (found.notice or "")


def test_another_problem_is_another_search() -> None:
    """Of what a search is about nothing is left out: the identity moves with each of its parts."""
    seen = {unfinished.identity(WIDE, pendulum_network(), 0.0)}
    for make in OTHERS.values():
        loop, rate = make()
        seen.add(unfinished.identity(loop.system, loop.network, rate))
    assert len(seen) == 1 + len(OTHERS)


# -------------------------------------------------------------------------------------------------------- interrupted

PLACES = {  # where Ctrl-C comes, and on which call: from the first candidate to the last check
    "candidates": ("certify.analysis.stages.candidate.solutions", 1),
    "the first one": ("certify.analysis.stages.candidate.optimised", 1),
    "a local proof": ("certify.provers.boxes.engine.prove_local", 1),
    "a heat": ("certify.provers.boxes.rule.VdotBound.__call__", 1),
    "the search": ("certify.provers.boxes.rule.VdotBound.__call__", 3),
    "the first check": ("certify.analysis.acceptance.run_checker", 1),
    "the end": ("certify.analysis.stages.acceptance.limited", 1),
}


@pytest.mark.parametrize("place", slow_after(2, PLACES))
def test_a_run_that_is_interrupted_anywhere_is_resumed_to_its_end(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, call = PLACES[place]
    calls = 0

    def counted(*args: Any, **more: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == call:
            raise KeyboardInterrupt
        return original(*args, **more)

    owner, _, attribute = name.rpartition(".")
    original = pkgutil.resolve_name(name)
    monkeypatch.setattr(pkgutil.resolve_name(owner), attribute, counted)
    monkeypatch.setattr("certify.analysis.stages.candidate._HEAT", 1e-9)
    system, network = scalar_tanh()
    with pytest.raises(KeyboardInterrupt):
        certify_roa(system, network, tmp_path, RoaOptions(effort=0.2))
    left = {path.name for path in tmp_path.iterdir()}
    assert "search.json" in left and left <= {"search.json", "certificate.json"}
    end = certify_roa(system, network, tmp_path, RoaOptions(effort=0.2, resume=True))
    assert end.verdict is Verdict.PROVED and run_checker(tmp_path / "certificate.json")["result"] == "ACCEPTED"
    assert not (tmp_path / "search.json").exists()
    assert end.volume is not None and end.volume > 3.8  # of the 3.83 that the origin attracts


@pytest.mark.parametrize(("options", "stop"), [({"effort": 1e-6}, Stop.EFFORT), ({"time_limit": 1e-3}, Stop.TIME)])
def test_a_run_that_is_over_at_once_leaves_a_search(tmp_path: Path, options: dict[str, float], stop: Stop) -> None:
    """Whatever it proves is accepted, it says what ended it, and what is left is resumed."""
    system, network = scalar_tanh()
    first = certify_roa(system, network, tmp_path, RoaOptions(**options))  # type: ignore[arg-type]
    assert first.verdict in (Verdict.PROVED, Verdict.UNKNOWN) and first.stop is stop
    assert first.search == tmp_path / "search.json"
    assert certify_roa(system, network, tmp_path, RoaOptions(resume=True)).verdict is Verdict.PROVED
