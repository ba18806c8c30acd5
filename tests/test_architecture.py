"""The arrows of the design: who imports whom, and what start-up loads."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from graphlib import TopologicalSorter
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.support.marks import slow_after

ROOT = Path(__file__).parent.parent
LEAVES = {"effort", "errors"}  # anybody may import these, and they import nothing
ENTRY = {"cli", "__main__"}  # these may import anything of certify
EDGES = {  # who imports whom, besides these: exactly the arrows that exist
    "analysis": "certificates loop lyapunov provers report",
    "certificates": "loop lyapunov",
    "lyapunov": "loop",
    "provers": "certificates loop lyapunov",
    "report": "certificates loop lyapunov",
    "controllers": "analysis certificates cli loop lyapunov provers report",
}
TRAINER = {  # who imports whom within controllers, besides what is open there
    "commands": "comparison distillation evaluation figures flattening history identification plants training",
    "comparison": "simulation training",
    "distillation": "evaluation flattening plants simulation training",
    "evaluation": "identification plants simulation",
    "figures": "comparison history",
    "flattening": "evaluation identification plants simulation training",
    "history": "evaluation identification training",
    "identification": "simulation",
    "plants": "identification",
    "training": "evaluation identification plants simulation",
}
OPEN = {"cli", "options", "storage"}  # of controllers: its entry, and modules that anybody there may import
ROOMS = {"analysis", "certificates", "checker", "cli", "loop", "lyapunov", "provers", "reference", "report"} | LEAVES


def unit(module: str) -> str:
    """The module or package just below `certify` that a module belongs to; `controllers` is one unit."""
    parts = module.split(".")
    return parts[0] if parts[0] == "controllers" else ".".join(parts[1:2]) or "certify"


def units() -> dict[str, list[Path]]:
    """Every unit with its files."""
    found: dict[str, list[Path]] = {}
    for path in [*ROOT.glob("certify/**/*.py"), *ROOT.glob("controllers/**/*.py")]:
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        found.setdefault(unit(name), []).append(path)
    return found


class Source(NamedTuple):
    """A file's absolute names of the modules that it imports, at any depth of the code; those that it needs when it is
    loaded or run, each with a name that it takes from there; and its checks by assert and bare excepts."""

    imports: frozenset[str]
    needed: frozenset[tuple[str, str]]
    faults: int


@cache
def source(path: Path) -> Source:
    found, needed, faults = set[str](), set[tuple[str, str]](), 0
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    tree = ast.parse(path.read_text())
    hidden = {id(n) for block in ast.walk(tree) if _for_types_only(block) for n in ast.walk(block)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = list(package[: len(package) - node.level + 1]) if node.level else []
            found.add(".".join([*base, *(node.module.split(".") if node.module else [])]))
            if node.module and id(node) not in hidden and not node.level:
                needed |= {(node.module, alias.name) for alias in node.names}
        faults += isinstance(node, ast.Assert) or (isinstance(node, ast.ExceptHandler) and node.type is None)
    return Source(frozenset(found), frozenset(needed), faults)


def _for_types_only(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def imports(path: Path) -> frozenset[str]:
    return source(path).imports


def modules(name: str) -> list[Path]:
    place = ROOT.joinpath(*name.split("."))
    return sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]


def arrows() -> dict[str, set[str]]:
    """Unit to the units of the project that it imports, at any depth of the code."""
    found = {}
    for name, paths in units().items():
        names = {i for path in paths for i in imports(path) if i.split(".")[0] in ("certify", "controllers")}
        found[name] = {unit(i) for i in names} - {name}
    return found


def test_the_arrows_are_exactly_these() -> None:
    found = {name: " ".join(sorted(to - LEAVES)) for name, to in arrows().items() if name not in ENTRY | {"__init__"}}
    assert {name: to for name, to in found.items() if to} == EDGES


def test_the_arrows_of_the_trainer_are_exactly_these() -> None:
    found: dict[str, set[str]] = {}
    for path in ROOT.glob("controllers/**/*.py"):
        inner = {i.split(".")[1] for i in imports(path) if i.startswith("controllers.")}
        found.setdefault(path.relative_to(ROOT).with_suffix("").parts[1], set()).update(inner)
    arrows = {name: " ".join(sorted(to - OPEN - {name})) for name, to in found.items() if name not in OPEN}
    assert {name: to for name, to in arrows.items() if to} == TRAINER
    tuple(TopologicalSorter({name: to.split() for name, to in TRAINER.items()}).static_order())


def test_there_are_nine_rooms_and_two_modules() -> None:
    assert {name for name in units() if name not in ("__init__", "__main__", "controllers")} == ROOMS


@pytest.mark.parametrize(("number", "edges"), [(1, EDGES), (2, TRAINER)], ids=["certify", "controllers"])
def test_the_pictures_show_these_arrows(number: int, edges: dict[str, str]) -> None:
    """Of `docs/house.md`: all but those that follow from others, and what `cli` may see anyway."""
    picture = (ROOT / "docs" / "house.md").read_text("utf-8").split("```mermaid")[number].split("```")[0]
    shown: dict[str, set[str]] = {}
    for line in picture.splitlines():
        units = [[name.strip() for name in part.split("&")] for part in line.split("-->")]
        for sources, targets in pairwise(units):
            for source in sources:
                shown.setdefault(source, set()).update(targets)
    direct = {name: set(to.split()) for name, to in edges.items()}

    def beyond(name: str) -> set[str]:
        return {far for to in direct.get(name, ()) for far in (to, *beyond(to))}

    needed = {name: to - {far for near in to for far in beyond(near)} for name, to in direct.items()}
    assert {name: to for name, to in shown.items() if name not in ENTRY} == needed


def module_arrows() -> dict[str, set[str]]:
    """Module to the modules of the project that it imports when it is loaded or run; not what only types need."""
    paths = {path for found in units().values() for path in found}
    names = {".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): p for p in paths}
    found = {}
    for name, path in names.items():
        inner = ((module, f"{module}.{taken}") for module, taken in source(path).needed)
        found[name] = ({i if i in names else module for module, i in inner} & names.keys()) - {name}
    return found


@pytest.mark.parametrize("graph", [arrows, module_arrows])
def test_there_are_no_circles(graph: Callable[[], dict[str, set[str]]]) -> None:
    tuple(TopologicalSorter(graph()).static_order())  # raises CycleError, which names one


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
        ("import certify.cli.main", ["torch", "sympy", "scipy", "matplotlib"]),
        ("import certify.checker.rules, certify.checker.__main__", ["torch", "sympy", "scipy", "matplotlib"]),
        ("import certify.reference.__main__", ["torch", "sympy", "scipy", "matplotlib", "numpy", "certify.checker"]),
        ("import certify.loop.plants", ["torch", "scipy", "matplotlib"]),
        ("import certify.loop.policies.importers", ["torch", "onnx", "safetensors", "stable_baselines3"]),
        ("import certify.report", ["matplotlib", "jinja2"]),
        ("import certify.certificates.checking", ["numpy", "sympy", "scipy", "torch", "flint"]),
    ],
)
def test_start_up_is_light(statement: str, absent: list[str]) -> None:
    code = f"{statement}; import sys; sys.exit(' '.join(set({absent}) & set(sys.modules)) or 0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


SHIPPED = ROOT / "examples" / "policies" / "pendulum.pt"
NOT_FOR_A_VERDICT = [
    *("matplotlib", "jinja2", "cvxpy", "onnx", "safetensors", "distributed", "numba", "pyarrow"),
    *("scipy.optimize", "scipy.stats", "scipy.ndimage", "scipy.interpolate", "scipy.spatial"),
    *("torch", "certify.provers.dreal", "certify.lyapunov.learning", "certify.analysis.maximise"),
    *("certify.report.page", "certify.report.figures"),
]


QUICK = ["--effort", "0.1"]


@pytest.mark.parametrize("arguments", slow_after(1, [[], ["--candidate", "lyapunov"]]))
def test_a_proof_loads_no_more_than_it_needs(arguments: list[str], tmp_path: Path) -> None:
    """The whole command as a user has it: what draws its report comes after the proof, what checks it is elsewhere."""
    code = (
        "import sys\nfrom certify.cli.main import _run\nfrom certify.report.drawing import Drawing\n"
        "seen, begin = [], Drawing.begin\n"
        "def noted(*given): seen.append(set(sys.modules)); begin(*given)\n"
        "Drawing.begin = noted\nstatus = _run(sys.argv[1:], False)\n"
        "checkers = {'certify.checker', 'certify.reference'} & set(sys.modules)\n"
        f"sys.exit(' '.join(set({NOT_FOR_A_VERDICT}) & seen[0] | checkers) or status)"
    )
    command = [
        sys.executable,
        "-c",
        code,
        "roa",
        "--policy",
        str(SHIPPED),
        "--out",
        str(tmp_path),
        "--effort",
        "0.02",
        *arguments,
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("PROVED") and "Figures" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize("command", [["--help"], ["roa", "--help"], ["check", "no such file"]])
def test_help_and_a_check_load_no_arithmetic(command: list[str]) -> None:
    """A check's is in the checker's own process."""
    code = (
        "import sys\nfrom certify.cli.main import _run\nstatus = _run(sys.argv[1:], False)\n"
        "print(' '.join({'numpy', 'sympy', 'scipy', 'torch', 'flint'} & set(sys.modules)) or 'none', status)"
    )
    done = subprocess.run([sys.executable, "-c", code, *command], capture_output=True, text=True, check=False)
    assert done.stdout.splitlines()[-1] == f"none {2 if 'check' in command else 0}", done.stderr


def test_no_checks_by_assert_and_no_bare_except() -> None:
    for path in [*ROOT.glob("certify/**/*.py"), *ROOT.glob("controllers/**/*.py")]:
        assert not source(path).faults, path
