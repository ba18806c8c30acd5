"""Modules of `controllers` import each other in one direction, imports inside functions included."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[2]


def _modules():
    files = sorted((ROOT / "controllers").rglob("*.py"))
    return {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in files}


def _graph():
    modules, graph = _modules(), {}
    for name, path in modules.items():
        found = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0 and node.module is not None, f"{name} imports relatively"
                members = {f"{node.module}.{alias.name}" for alias in node.names}
                found |= {member if member in modules else node.module for member in members}
        graph[name] = found & modules.keys()
    return graph


def test_no_module_imports_itself_on_any_way_around():
    graph = _graph()
    assert graph["controllers.cli"] and graph["controllers.training"]
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the modules


def test_nothing_imports_the_commands_but_the_command_line():
    importers = {
        name for name, found in _graph().items() if any(other.startswith("controllers.commands") for other in found)
    }
    assert {name for name in importers if not name.startswith("controllers.commands")} == {"controllers.cli"}
