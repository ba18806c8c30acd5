"""The arrows of the design: who may import whom, and what start-up loads."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ARROWS = {  # package -> what of the project it may import, besides errors and verdict
    "certify.systems": set(),
    "certify.policies": set(),
    "certify.closed_loop": {"certify.systems", "certify.policies"},
    "certify.obligations": {"certify.closed_loop", "certify.systems"},
    "certify.lyapunov": {"certify.closed_loop", "certify.systems", "certify.policies"},
    "certify.enclosures": {"certify.closed_loop", "certify.systems", "certify.policies"},
    "certify.engines": {
        "certify.obligations", "certify.lyapunov", "certify.enclosures", "certify.closed_loop", "certify.systems",
        "certify.policies",
    },
    "certify.certificate": {"certify.obligations", "certify.lyapunov", "certify.systems", "certify.policies"},
    "certify.report": {
        "certify.certificate", "certify.lyapunov", "certify.closed_loop", "certify.systems", "certify.policies",
        "certify.obligations",
    },
    "controllers": {"certify.systems", "certify.policies"},
}  # fmt: skip


def imports(path: Path) -> set[str]:
    """Absolute names of the modules that a file imports, at any depth of the code."""
    found = set()
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = list(package[: len(package) - node.level + 1]) if node.level else []
            found.add(".".join([*base, *(node.module.split(".") if node.module else [])]))
    return found


def modules(name: str) -> list[Path]:
    place = ROOT.joinpath(*name.split("."))
    return sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]


@pytest.mark.parametrize("name", sorted(ARROWS))
def test_arrows(name: str) -> None:
    allowed = {name, "certify.errors", "certify.verdict", *ARROWS[name]}
    for path in modules(name):
        for imported in imports(path):
            if imported.split(".")[0] in ("certify", "controllers"):
                assert any(imported == a or imported.startswith(a + ".") for a in allowed), f"{path}: {imported}"


def test_the_checker_stands_alone() -> None:
    standard = sys.stdlib_module_names | {"numpy", "flint", "certify"}
    for path in modules("certify.checker"):
        for imported in imports(path):
            assert imported.split(".")[0] in standard
            assert not imported.startswith("certify") or imported.startswith("certify.checker"), f"{path}: {imported}"


def test_the_reference_stands_alone() -> None:
    """The second checker shares nothing with the first, and has no floats but the numbers of a file."""
    found = modules("certify.reference")
    assert len(found) > 5
    for path in found:
        for imported in imports(path):
            assert imported.split(".")[0] in sys.stdlib_module_names | {"flint", "certify"}, f"{path}: {imported}"
            assert not imported.startswith("certify") or imported.startswith("certify.reference"), f"{path}: {imported}"


@pytest.mark.parametrize("name", ["checker", "reference"])
def test_nobody_imports_the_checkers(name: str) -> None:
    for path in [*ROOT.glob("certify/**/*.py"), *ROOT.glob("controllers/**/*.py")]:
        if name not in path.parts:
            assert not any(i.startswith(f"certify.{name}") for i in imports(path)), path


def test_certify_never_imports_controllers() -> None:
    for path in ROOT.glob("certify/**/*.py"):
        assert not any(i.startswith("controllers") for i in imports(path)), path


@pytest.mark.parametrize(
    ("statement", "absent"),
    [
        ("import certify", ["torch", "sympy", "scipy", "numpy", "matplotlib"]),
        ("import certify.cli", ["torch", "sympy", "scipy", "matplotlib"]),
        ("import certify.checker.rules, certify.checker.__main__", ["torch", "sympy", "scipy", "matplotlib"]),
        ("import certify.reference.__main__", ["torch", "sympy", "scipy", "matplotlib", "numpy", "certify.checker"]),
        ("import certify.systems", ["torch", "scipy", "matplotlib"]),
        ("import certify.report", ["matplotlib", "jinja2"]),
    ],
)
def test_start_up_is_light(statement: str, absent: list[str]) -> None:
    code = f"{statement}; import sys; sys.exit(' '.join(set({absent}) & set(sys.modules)) or 0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_no_checks_by_assert_and_no_bare_except() -> None:
    for path in [*ROOT.glob("certify/**/*.py"), *ROOT.glob("controllers/**/*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            assert not isinstance(node, ast.Assert), path
            assert not (isinstance(node, ast.ExceptHandler) and node.type is None), path
