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
    assert [p.name for p in NOTEBOOKS] == ["01_pendulum.ipynb"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebooks_are_stored_clean(path: Path) -> None:
    for cell in stored(path)["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None
        source = "".join(cell["source"])
        assert not re.search(r"(/home/|/root/|/work/|/Users/|[A-Z]:\\)", source)


def test_pendulum(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CERTIFY_NOTEBOOK_STEPS", "900")
    path = ROOT / "notebooks" / "01_pendulum.ipynb"
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook, timeout=240, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}
    )
    client.execute()
    text = text_of(notebook)
    assert "after 900 steps" in text
    assert "PROVED  pendulum" in text and "result: ACCEPTED" in text
    assert "simulated, not proved: the certified set covers" in text
    for what in ("level doubled", "another weight", "another leaf"):
        assert f"{what}: REJECTED rule=" in text
    images = [o for c in notebook.cells if c.cell_type == "code" for o in c.outputs if o.output_type == "display_data"]
    assert len(images) == 6  # the returns, and five figures of the certificate
