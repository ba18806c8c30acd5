"""The notebooks run from top to bottom, and are stored without outputs."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def stored(path: Path) -> dict[str, Any]:
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert isinstance(notebook, dict)
    return notebook


def text_of(notebook: Any) -> str:
    """What the cells printed."""
    outputs = [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]
    text = "".join(o.get("text", "") for o in outputs if o.output_type == "stream")
    return re.sub(r"\x1b\[[0-9;]*m", "", text)  # colours


def test_there_are_notebooks() -> None:
    assert [p.stem for p in NOTEBOOKS] == [
        "01_pendulum",
        "02_certificates",
        "03_own_plant",
        "04_more_states",
        "05_unknown_plant",
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebooks_are_stored_clean(path: Path) -> None:
    for cell in stored(path)["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None
        source = "".join(cell["source"])
        assert not re.search(r"(/home/|/root/|/work/|/Users/|[A-Z]:\\)", source)


def executed(name: str) -> Any:
    """The notebook after a run from top to bottom."""
    path = ROOT / "notebooks" / f"{name}.ipynb"
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook, timeout=240, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}
    )
    client.execute()
    return notebook


def images_of(notebook: Any) -> list[str]:
    """The pictures that the cells drew, as base64."""
    outputs = [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]
    return [o.data["image/png"] for o in outputs if o.output_type == "display_data" and "image/png" in o.data]


def test_pendulum(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CERTIFY_NOTEBOOK_STEPS", "500")
    notebook = executed("01_pendulum")
    text = text_of(notebook)
    assert "after 500 steps" in text
    assert "PROVED  pendulum" in text and "result: ACCEPTED" in text
    assert "simulated, not proved: the proved set covers" in text
    for what in ("level doubled", "another weight", "another leaf"):
        assert f"{what}: REJECTED rule=" in text
    images = [o for c in notebook.cells if c.cell_type == "code" for o in c.outputs if o.output_type == "display_data"]
    assert len(images) == 6  # the returns, and five figures of the certificate


@pytest.mark.slow
def test_certificates() -> None:
    notebook = executed("02_certificates")
    lines = text_of(notebook).splitlines()
    attacks = {line[:34].strip(): line[34:].split() for line in lines if re.match(r".{34} (ACCEPTED|REJECTED) ", line)}
    assert len(attacks) == 22
    harmless = {"nothing changed", "c2 half as large"}
    assert {name for name, said in attacks.items() if "ACCEPTED" in said} == harmless
    for name, said in attacks.items():
        assert said[: len(said) // 2] == said[len(said) // 2 :], f"{name}: the two checkers differ, {said}"
    rules = {said[1] for name, said in attacks.items() if name not in harmless}
    wanted = "domain root ring local equilibrium hash inputs tree coordinates lyapunov format"
    assert rules == {f"rule={name}" for name in wanted.split()}
    assert sum(map(len, images_of(notebook))) < 100_000 and len(images_of(notebook)) == 1


@pytest.mark.slow
def test_own_plant() -> None:
    text = text_of(executed("03_own_plant"))
    assert "the input reaches 3 of 3 directions" in text
    assert len(re.findall(r"^(first|deeper|gentle) PROVED", text, re.M)) == 3
    assert "k = 2: PROVED" in text and "checked: ACCEPTED" in text


@pytest.mark.slow
def test_more_states() -> None:
    notebook = executed("04_more_states")
    text = text_of(notebook)
    for name in ("cartpole", "quadrotor2d", "quadrotor3d"):
        assert f"{name}: PROVED" in text
    assert sum(map(len, images_of(notebook))) < 150_000 and len(images_of(notebook)) == 2


@pytest.mark.slow
def test_unknown_plant() -> None:
    notebook = executed("05_unknown_plant")
    text = text_of(notebook)
    assert "data         mine.csv, 400 transitions" in text and "off by at most" in text and "K12" in text
    assert "IDENTIFIED  linear: 400 transitions" in text
    assert "PROVED  linear: for every constant A₁₁" in text and re.search(r"^checker +ACCEPTED", text, re.M)
    assert "40 of 40 runs of the environment settle" in text
    assert sum(map(len, images_of(notebook))) < 150_000 and len(images_of(notebook)) == 1
