"""The page on the paper's figures says of which runs it was made; `make paper` compares a folder of runs with that."""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "paper"
PLANTS = ("pendulum", "cartpole", "quadrotor2d", "quadrotor3d")


@pytest.fixture
def scripts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, ModuleType]:
    """The page's scripts, with a page, a manifest and results of their own."""
    monkeypatch.syspath_prepend(str(PAGE))
    found = {}
    for name in ("manifest", "draw", "proved"):
        monkeypatch.delitem(sys.modules, name, raising=False)
        found[name] = import_module(name)
    page = tmp_path / "page"
    page.mkdir()
    for module in found.values():
        monkeypatch.setattr(module, "MANIFEST", page / "manifest.txt")
    for name in ("draw", "proved"):
        monkeypatch.setattr(found[name], "PAGE", page)
        monkeypatch.setattr(found[name], "OUT", tmp_path / "out")
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "manifest")
    return found


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Runs that are over: two seeds of ours, one of SAC, and one that is not over."""
    folder = tmp_path / "runs"
    for name in ("ours/seed-0", "ours/seed-1", "sac/seed-0", "sb3-ppo/seed-0"):
        run = folder / "pendulum" / name
        run.mkdir(parents=True)
        (run / "curve.csv").write_text(f"steps,floor\n{name},1\n")
        (run / "policy.pt").write_bytes(name.encode())
        (run / "checkpoint.pt").write_bytes(b"not what the page is made of")
        if "ppo" not in name:
            (run / "course.json").write_text("{}")
    return folder


@pytest.fixture
def drawn(scripts: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """The commands that drawing runs, each of which leaves a table only."""
    commands: list[tuple[str, ...]] = []

    def run(command: Any) -> None:
        commands.append(command.words)
        out = Path(command.words[command.words.index("--out") + 1])
        out.mkdir(parents=True, exist_ok=True)
        table = {"system": command.words[2], "runs": [], "files": {"cost": str(out / "cost.png")}}
        (out / f"{command.words[2]}-table.json").write_text(json.dumps(table))

    monkeypatch.setattr(scripts["draw"].Command, "run", run)
    return commands


def paper(scripts: dict[str, ModuleType], folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["draw.py", str(folder)])
    scripts["draw"].main()


def test_the_manifest_lists_each_file_of_the_runs_of_the_tables_once_and_in_order() -> None:
    lines = (PAGE / "manifest.txt").read_text("utf-8").splitlines()
    matches = [re.fullmatch(r"[0-9a-f]{64}  (\w+/[\w-]+/seed-\d+)/([\w.]+)", line) for line in lines]
    assert all(matches), [line for line, match in zip(lines, matches, strict=True) if match is None]
    names = [line[66:] for line in lines]
    assert names == sorted(set(names))
    files: dict[str, set[str]] = {}
    for match in matches:
        assert match is not None
        files.setdefault(match[1], set()).add(match[2])
    tables = {plant: json.loads((PAGE / f"{plant}-table.json").read_text("utf-8")) for plant in PLANTS}
    of_tables = {f"{plant}/{run['run']}/seed-{run['seed']}" for plant in PLANTS for run in tables[plant]["runs"]}
    assert set(files) == of_tables
    needed = {"ours": set(), "sac": {"actor.pt"}, "sb3-ppo": {"model.zip"}}
    for run, found in files.items():
        assert found == {"curve.csv", "course.json", "policy.pt"} | needed[run.split("/")[1]], run


def test_the_tables_of_the_page_name_no_path_of_a_machine() -> None:
    for plant in PLANTS:
        assert '"/' not in (PAGE / f"{plant}-table.json").read_text("utf-8")


def test_what_is_proved_is_said_of_as_many_runs_as_the_manifest_has() -> None:
    names = [line[66:] for line in (PAGE / "manifest.txt").read_text("utf-8").splitlines()]
    kinds = {"ours": "ours", "SAC without gain, mean": "sac", "SB3 PPO, mean": "sb3-ppo"}
    rows = re.findall(r"^\| (\w+) \| ([^|]+) \| \d of (\d) \|", (PAGE / "proved.txt").read_text("utf-8"), re.M)
    assert len(rows) == 12
    for plant, method, count in rows:
        policies = [n for n in names if n.startswith(f"{plant}/{kinds[method]}/") and n.endswith("/policy.pt")]
        assert len(policies) == int(count), (plant, method)


def test_no_runs_lie_in_the_tree() -> None:
    assert not (PAGE / "runs").exists()
    assert sum(path.stat().st_size for path in PAGE.rglob("*") if path.is_file()) < 5_000_000


def test_drawing_writes_the_manifest_of_what_it_drew_and_nothing_differs_then(
    scripts: dict[str, ModuleType],
    runs: Path,
    drawn: list[tuple[str, ...]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """One seed of each method is compared, so the second of ours is not in it, nor a run that is not over."""
    paper(scripts, runs, monkeypatch)
    assert capsys.readouterr().out.count("not in the manifest") == 6
    page = runs.parent / "page"
    expected = [
        f"{hashlib.sha256((runs / name).read_bytes()).hexdigest()}  {name}\n"
        for run in ("ours", "sac")
        for name in (f"pendulum/{run}/seed-0/{file}" for file in ("course.json", "curve.csv", "policy.pt"))
    ]
    assert (page / "manifest.txt").read_text() == "".join(expected)
    done = subprocess.run(
        ["sha256sum", "--check", "--quiet", str(page / "manifest.txt")], cwd=runs, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert scripts["manifest"].main(runs) == 0 and "All 6 files" in capsys.readouterr().out
    paper(scripts, runs, monkeypatch)
    assert "manifest" not in capsys.readouterr().out and len(drawn) == 2
    assert json.loads((page / "pendulum-table.json").read_text()) == {"system": "pendulum", "runs": []}


def test_files_that_differ_are_named_before_anything_is_drawn(
    scripts: dict[str, ModuleType],
    runs: Path,
    drawn: list[tuple[str, ...]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    paper(scripts, runs, monkeypatch)
    (runs / "pendulum" / "ours" / "seed-0" / "policy.pt").write_bytes(b"another")
    (runs / "pendulum" / "sac" / "seed-0" / "curve.csv").unlink()
    (runs / "pendulum" / "sac" / "seed-0" / "actor.pt").write_bytes(b"new")
    capsys.readouterr()
    assert scripts["manifest"].main(runs) == 1
    said = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in said] == [
        "pendulum/ours/seed-0/policy.pt",
        "pendulum/sac/seed-0/curve.csv",
    ]

    class Stop(Exception):
        pass

    def stop(command: Any) -> None:
        raise Stop

    monkeypatch.setattr(scripts["draw"].Command, "run", stop)
    before = (runs.parent / "page" / "manifest.txt").read_bytes()
    with pytest.raises(Stop):
        paper(scripts, runs, monkeypatch)
    text = capsys.readouterr().out
    assert "pendulum/ours/seed-0/policy.pt: sha256 " in text and "the manifest says" in text
    assert "pendulum/sac/seed-0/curve.csv: missing; the manifest has it" in text
    assert "pendulum/sac/seed-0/actor.pt: not in the manifest" in text
    assert (runs.parent / "page" / "manifest.txt").read_bytes() == before  # nothing was drawn


def test_what_was_not_drawn_again_stays_in_the_manifest(
    scripts: dict[str, ModuleType], runs: Path, drawn: list[tuple[str, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other plants, and histories, whose files stand for themselves."""
    stays = {"cartpole/ours/seed-0/policy.pt": "a" * 64, "pendulum/history.csv": "b" * 64}
    path = runs.parent / "page" / "manifest.txt"
    scripts["manifest"].write(path, stays | {"pendulum/sb3-ppo/seed-0/policy.pt": "c" * 64})
    paper(scripts, runs, monkeypatch)
    found = scripts["manifest"].read(path)
    assert stays.items() <= found.items() and "pendulum/sb3-ppo/seed-0/policy.pt" not in found
    history = runs / "pendulum" / "history"
    history.mkdir()
    (history / "step-1000.pt").write_bytes(b"a policy")
    paper(scripts, runs, monkeypatch)
    found = scripts["manifest"].read(path)
    assert "pendulum/history/step-1000.pt" in found and "pendulum/history.csv" not in found
    assert "pendulum/ours/seed-0/policy.pt" in found and drawn[-1][1] == "history"


@pytest.mark.parametrize("line", ["", "abc  pendulum/x", "a" * 64 + "  /etc/passwd", "a" * 64 + "  policy.pt"])
def test_a_manifest_that_is_none_is_said(scripts: dict[str, ModuleType], tmp_path: Path, line: str) -> None:
    path = tmp_path / "manifest.txt"
    path.write_text(f"{'a' * 64}  pendulum/ours/seed-0/policy.pt\n{line}\n")
    with pytest.raises(SystemExit, match=r"line 2, must be 'SHA256  PATH'"):
        scripts["manifest"].read(path)


def test_the_table_of_what_is_proved_is_of_the_manifests_policies(
    scripts: dict[str, ModuleType], runs: Path, drawn: list[tuple[str, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    paper(scripts, runs, monkeypatch)
    script, asked = scripts["proved"], list[Path]()
    monkeypatch.setattr(sys, "argv", ["proved.py", str(runs)])
    monkeypatch.setattr(script, "proved", lambda plant, folder: asked.append(folder))
    script.main()
    assert asked == [runs / "pendulum" / "ours" / "seed-0", runs / "pendulum" / "sac" / "seed-0"]
    table = runs.parent / "page" / "proved.txt"
    before = table.read_bytes()
    (runs / "pendulum" / "sac" / "seed-0" / "policy.pt").write_bytes(b"another")
    with pytest.raises(SystemExit, match=r"sac/seed-0/policy.pt: sha256 [^\n]*\n.*first `make paper RUNS="):
        script.main()
    assert table.read_bytes() == before


@pytest.mark.parametrize("name", ["manifest", "draw"])
def test_a_folder_of_runs_that_is_none_is_said(
    name: str, scripts: dict[str, ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["x", str(tmp_path / "none")])
    with pytest.raises(SystemExit, match=r"RUNS must be a folder of runs; .*none is none"):
        scripts[name].main(*([tmp_path / "none"] if name == "manifest" else []))
