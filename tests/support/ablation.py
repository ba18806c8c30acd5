"""The checker with one rule disabled, to show that the rule is there for a reason."""

from __future__ import annotations

import ast
import importlib.util
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import certify.checker


class _Without(ast.NodeTransformer):
    """Removes every `raise Rejected(rule, ...)`."""

    def __init__(self, rule: str) -> None:
        self.rule, self.removed = rule, 0

    def visit_Raise(self, node: ast.Raise) -> ast.AST:
        call = node.exc
        if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "Rejected":
            first = call.args[0]
            if isinstance(first, ast.Constant) and first.value == self.rule:
                self.removed += 1
                return ast.copy_location(ast.Pass(), node)
        return node


@contextmanager
def checker_without(rule: str, folder: Path) -> Iterator[ModuleType]:
    """A copy of the checker in `folder`, loaded under another name, in which one rule never says no.

    `lyapunov` and `coordinates` also produce what later rules need; there the condition itself is taken out.
    """
    name = f"checker_without_{rule}"
    folder = folder / name
    shutil.copytree(Path(certify.checker.__file__).parent, folder, ignore=shutil.ignore_patterns("__pycache__"))
    remover = _Without(rule)
    for path in folder.glob("*.py"):
        path.write_text(ast.unparse(remover.visit(ast.parse(path.read_text()))))
    assert remover.removed > 0
    spec = importlib.util.spec_from_file_location(
        name, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    assert spec is not None and spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    sys.modules[name] = package
    try:
        spec.loader.exec_module(package)
        for module in ("document", "exact", "network", "rules"):
            importlib.import_module(f"{name}.{module}")
        if rule == "lyapunov":  # the symmetric part in place of an asymmetric matrix
            decide = package.exact.inverse_diagonal
            package.rules.inverse_diagonal = lambda A: decide(
                [[(v + w) / 2 for v, w in zip(row, column, strict=True)]
                 for row, column in zip(A, zip(*A, strict=True), strict=True)]
            )  # fmt: skip
        if rule == "coordinates":  # what remains is the ball's radius, taken from the diagonal
            package.rules.gershgorin_lower = lambda A: min(A[i][i] for i in range(len(A)))
        yield package
    finally:
        for module in [m for m in sys.modules if m.split(".")[0] == name]:
            del sys.modules[module]
