"""What is installed is what is in the tree, it works from any folder, and it says what it is."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from packaging.requirements import Requirement

import certify
from certify.analysis.installation import found_by_import, source_sha256, version_of
from certify.analysis.options import RoaOptions
from certify.certificates import checking
from certify.cli import doctor as doctor_command
from certify.cli.main import _run
from certify.errors import BackendError
from certify.provers.dreal import backend
from tests.support.marks import slow_after

ROOT = Path(__file__).parent.parent
POLICY = ROOT / "examples" / "policies" / "pendulum.pt"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def build(kind: str, tree: Path, folder: Path) -> None:
    code = f"import sys, setuptools.build_meta as b; b.build_{kind}(sys.argv[1])"
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder)], cwd=tree, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The source distribution of the tree, built in a copy."""
    folder = tmp_path_factory.mktemp("sdist")
    tree = folder / "tree"
    for name in ("certify", "controllers"):
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    (tree / "tests").mkdir()
    for name in (*(path.name for path in ROOT.iterdir() if path.is_file()), "tests/test_habits.py"):
        if name != ".git":  # of a worktree
            shutil.copy(ROOT / name, tree / name)
    build("sdist", tree, folder)
    (built,) = folder.glob("*.tar.gz")
    return built


@pytest.fixture(scope="module")
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built of nothing but the source distribution."""
    folder = tmp_path_factory.mktemp("wheel")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    (tree,) = folder.iterdir()
    build("wheel", tree, folder)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The `bin` of a fresh environment: the wheel, and beside it the packages of this one."""
    home = tmp_path_factory.mktemp("fresh")
    venv.create(home)
    into = ["--python", str(home / "bin" / "python")]
    pip = [sys.executable, "-m", "pip", *into, "install", "-q", "--no-deps", "--no-index", str(wheel)]
    subprocess.run(pip, check=True, capture_output=True)
    (packages,) = home.glob("lib/python*/site-packages")
    others = {str(Path(m.__file__ or "").resolve().parent.parent) for m in (np, pytest)}
    (packages / "shared.pth").write_text("\n".join(sorted(others)) + "\n")
    return home / "bin"


def say(command: Path | str, *arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    given = [str(command), *map(str, arguments)]
    return subprocess.run(given, cwd=cwd, env=environment, capture_output=True, text=True, check=False)


def test_the_wheel_holds_everything(wheel: Path) -> None:
    """Every module of the tree, and every file of another kind that a module reads."""
    files = set(zipfile.ZipFile(wheel).namelist())
    for name in ("certify", "controllers"):
        for path in (ROOT / name).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                assert path.relative_to(ROOT).as_posix() in files, path
    assert {"certify/checker/FORMAT.md", "certify/checker/format/ranges.md"} <= files
    assert {"certify/report/template.html", "certify/py.typed"} <= files
    assert {name.split("/")[0] for name in files if ".dist-info/" not in name} == {"certify", "controllers"}


def test_the_source_distribution_holds_what_a_wheel_needs_and_what_a_reader_wants(sdist: Path) -> None:
    with tarfile.open(sdist) as archive:
        files = {name.partition("/")[2] for name in archive.getnames()}
    wanted = {"README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "pyproject.toml", "constraints.txt"}
    wanted |= {"certify/checker/FORMAT.md", "certify/checker/format/ranges.md"}
    assert wanted | {"certify/certificates/coq/theory/_CoqProject"} <= files
    assert not any(name.startswith(("tests/", "docs/", "examples/")) for name in files)


def test_an_installed_certify_works_from_any_folder(installed: Path, tmp_path: Path) -> None:
    place = say(installed / "python", "-c", "import certify; print(certify.__file__)", cwd=tmp_path).stdout.strip()
    assert Path(place).is_relative_to(installed.parent)
    options = ("--candidate", "lyapunov", "--level", "0.05", "--json")
    shutil.copy(POLICY, tmp_path / "mine.pt")  # of the tree only this is used
    done = say(installed / "certify", "roa", "--policy", "mine.pt", "--out", "o", *options, cwd=tmp_path)
    assert done.returncode == 0 and json.loads(done.stdout)["checked"] == "ACCEPTED", done.stderr
    assert (tmp_path / "o" / "report.html").read_text().startswith("<!DOCTYPE html>")
    for more in ((), ("--reference",)):
        done = say(installed / "certify", "check", "o/certificate.json", *more, cwd=tmp_path)
        assert done.returncode == 0 and "ACCEPTED" in done.stdout, done.stderr
    assert "pendulum" in say(installed / "certify", "systems", cwd=tmp_path).stdout
    assert "train" in say(installed / "controllers", "--help", cwd=tmp_path).stdout
    done = say(installed / "certify", "doctor", "--json", cwd=tmp_path)
    found = json.loads(done.stdout)
    assert done.returncode == 0 and found["healthy"] is True
    assert {f["name"]: f["state"] for f in found["findings"]}["certify"] == "ok"


@pytest.mark.slow
def test_a_folder_of_that_name_beside_a_script_is_said(installed: Path, tmp_path: Path) -> None:
    """It hides the package from scripts there, and nothing but the doctor would say why; the command is not hidden."""
    (tmp_path / "script.py").write_text("import certify\nprint(certify.certify_roa)\n")
    assert say(installed / "python", "script.py", cwd=tmp_path).returncode == 0
    assert found_by_import(tmp_path) is None
    (tmp_path / "certify").mkdir()
    assert found_by_import(tmp_path) is None  # a folder without __init__.py comes behind an installed package
    assert say(installed / "python", "script.py", cwd=tmp_path).returncode == 0
    (tmp_path / "certify" / "__init__.py").write_text("raise SystemExit('this must not be run by the doctor')\n")
    assert found_by_import(tmp_path) == str(tmp_path / "certify" / "__init__.py")
    done = say(installed / "certify", "doctor", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (row,) = [f for f in json.loads(done.stdout)["findings"] if f["name"] == "import certify"]
    assert row["state"] == "warning" and str(tmp_path / "certify") in row["found"] and "Rename" in row["advice"]
    shutil.rmtree(tmp_path / "certify")
    (tmp_path / "certify.py").write_text("")
    assert found_by_import(tmp_path) == str(tmp_path / "certify.py")


def test_the_version_says_what_a_verdict_rests_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(["--version"], False) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"certify {certify.__version__}\n")
    for part in ("certify-certificate/9", "certify-policy/1", f"numpy {np.__version__}", "python-flint"):
        assert part in text
    for program in ("checker", "reference"):
        assert f"{program:<10} sha256 {source_sha256(program)}" in text  # type: ignore[arg-type]


@pytest.mark.parametrize("program", ["checker", "reference"])
def test_the_hash_of_a_checker_is_that_of_sha256sum(program: Any) -> None:
    line = "LC_ALL=C; sha256sum *.py | sha256sum"
    done = subprocess.run(
        ["bash", "-c", line], cwd=ROOT / "certify" / program, capture_output=True, text=True, check=True
    )
    assert done.stdout.split()[0] == source_sha256(program)
    assert not list((ROOT / "certify" / program).glob("*/*.py"))  # else the hash would leave something out


def test_every_byte_of_a_checker_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(ROOT / "certify" / "checker", tmp_path / "checker")
    monkeypatch.setattr("certify.analysis.installation._HERE", tmp_path)
    before = source_sha256("checker")
    assert before == hashlib.sha256(
        b"".join(
            f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.name}\n".encode()
            for p in sorted((tmp_path / "checker").glob("*.py"))
        )
    ).hexdigest()  # fmt: skip
    file = tmp_path / "checker" / "rules.py"
    file.write_bytes(file.read_bytes() + b"\n")
    assert source_sha256("checker") != before


def test_the_numbers_of_the_version_agree(wheel: Path, sdist: Path) -> None:
    """One place says it: `certify.__version__`."""
    assert "version" not in PROJECT["project"] and PROJECT["project"]["dynamic"] == ["version"]
    assert sdist.name == f"certify-{certify.__version__}.tar.gz"
    with zipfile.ZipFile(wheel) as archive:
        metadata = archive.read(f"certify-{certify.__version__}.dist-info/METADATA").decode()
    assert f"\nVersion: {certify.__version__}\n" in metadata and "The certify authors" in metadata
    assert PROJECT["project"]["requires-python"] == ">=3.11"
    assert PROJECT["tool"]["ruff"]["target-version"] == "py311"  # nothing newer than the oldest Python is written


def test_whatever_is_needed_is_declared_and_pinned() -> None:
    """The doctor asks for exactly what the project declares, and the extras it names exist and hold what it says."""
    bare = [_bare(d) for d in PROJECT["project"]["dependencies"]]
    assert sorted(bare) == sorted(doctor_command._CORE)
    extras = {name: [_bare(d) for d in of] for name, of in PROJECT["project"]["optional-dependencies"].items()}
    for package, (_, extra, _) in doctor_command._EXTRAS.items():
        assert package in extras[extra]
    pinned = {_bare(line) for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line}
    assert not {*bare, *(d for of in extras.values() for d in of)} - pinned - {"certify"}  # its own extra


@pytest.mark.parametrize(
    ("python", "machine", "asked"), [("3.11", "x86_64", True), ("3.12", "x86_64", False), ("3.11", "aarch64", False)]
)
def test_the_extra_of_dreal_asks_only_for_a_wheel_that_there_is(python: str, machine: str, asked: bool) -> None:
    """Elsewhere pip would build dReal from its source, or find no version of it, and the installation would fail."""
    (text,) = PROJECT["project"]["optional-dependencies"]["dreal"]
    wanted = Requirement(text)
    assert wanted.marker is not None
    where = {"python_version": python, "platform_machine": machine, "sys_platform": "linux"}
    assert wanted.marker.evaluate(where) is asked
    (pinned,) = (line for line in (ROOT / "constraints.txt").read_text().splitlines() if line.startswith("dreal=="))
    assert wanted.specifier.contains(pinned.removeprefix("dreal=="))


def test_the_doctor_says_what_dreal_is(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """With the extra's command, what pip does not bring, and that the default engine does without."""

    def missing() -> None:
        raise BackendError(f"dReal cannot be used: no module. {backend._INSTALL}")

    monkeypatch.setattr(backend, "find_backend", missing)
    status, found = findings(capsys)
    assert status == 0 and found["dReal"]["state"] == "missing"
    assert found["dReal"]["found"] == "--engine dreal and both; bounds, the default, needs no solver"
    for said in (
        "installs oneself",
        "pip install '.[dreal]'",
        "IBEX 2.7.4 (libibex.so)",
        "the default, needs neither",
    ):
        assert said in found["dReal"]["advice"]
    assert RoaOptions().engine == "bounds"


def _bare(requirement: str) -> str:
    return re.split(r"[\[<>=~!;]", requirement)[0].strip()


def findings(capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, dict[str, str]]]:
    status = _run(["doctor", "--json"], True)
    data = json.loads(capsys.readouterr().out)
    assert data["healthy"] is (status == 0)
    return status, {f["name"]: f for f in data["findings"]}


def test_the_doctor_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(["doctor"], False) == 0
    text = capsys.readouterr().out
    assert "The core works." in text and "a forgery REJECTED" in text and str(version_of("python-flint")) in text


def test_a_missing_extra_is_named_with_its_command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("certify.analysis.installation.version_of", lambda name: None if name == "onnx" else "1.0")
    status, found = findings(capsys)
    assert status == 0
    assert found["onnx"]["state"] == "missing" and found["onnx"]["advice"] == "pip install '.[onnx]'"
    assert found["safetensors"]["state"] == "ok"


@pytest.mark.parametrize("module", slow_after(1, ["gymnasium", "control"]))
def test_training_without_its_extra_ends_in_one_sentence(module: str, tmp_path: Path) -> None:
    code = f"import sys; sys.modules[{module!r}] = None; from controllers.cli import main; main()"
    given = ["train", "pendulum", "--steps", "1200", "--out", str(tmp_path / "p.pt"), "--json"]
    done = subprocess.run([sys.executable, "-c", code, *given], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert f"{module} is not installed" in json.loads(done.stdout)["error"]
    assert "pip install '.[controllers]'" in done.stderr


@pytest.mark.parametrize("module", ["flint", "numba", "cvxpy"])
def test_a_core_package_that_does_not_load_is_a_fault(
    module: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    load = importlib.import_module

    def broken(name: str, package: str | None = None) -> Any:
        if name == module:
            raise OSError("libsomething.so: cannot open shared object file")
        return load(name, package)

    monkeypatch.setattr("certify.cli.doctor.importlib.import_module", broken)
    status, found = findings(capsys)
    name = {"flint": "python-flint"}.get(module, module)
    assert status == 1 and found[name]["state"] == "fault" and "libsomething.so" in found[name]["found"]
    assert "pip install" in found[name]["advice"] and found["self-test"]["found"].startswith("not tried")


@pytest.mark.parametrize("says", slow_after(2, ["yes", "no", "nothing"]))
@pytest.mark.parametrize("program", ["checker", "reference"])
def test_a_checker_that_does_not_check_is_a_fault(
    says: str, program: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that accepts forgeries, one that refuses proofs, and one that does not start."""
    honest = checking.ask

    def ask(path: Path, asked: Any = "checker") -> tuple[int, dict[str, Any]]:
        if asked != program:
            return honest(path, asked)
        if says == "nothing":
            raise BackendError("it ended with status 70 and no verdict")
        return (0, {"result": "ACCEPTED"}) if says == "yes" else (1, {"result": "REJECTED"})

    monkeypatch.setattr("certify.certificates.checking.ask", ask)
    # The run itself asks the checker through this too, and then there is no proof to show to either.
    status, found = findings(capsys)
    assert status == 1
    assert "fault" in {found.get(program, {}).get("state"), found["proof"]["state"]}


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_commands_and_options(shell: str, tmp_path: Path) -> None:
    words = {"COMP_WORDS": "certify ro", "COMP_CWORD": "1", "_TYPER_COMPLETE_ARGS": "certify ro"}
    environment = (
        os.environ | words | {"_CERTIFY_COMPLETE": f"complete_{shell}", "_TYPER_COMPLETE_FISH_ACTION": "get-args"}
    )
    code = "from certify.cli.main import main; main([])"
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert "roa" in done.stdout and "report" not in done.stdout, done.stderr


def test_help_names_completion_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(["--help"], False) == 0
    text = capsys.readouterr().out
    for word in ("--install-completion", "--show-completion", "--version", "doctor", "roa"):
        assert word in text


def test_nothing_is_imported_that_is_not_needed_to_say_the_version() -> None:
    """Neither the hashes nor the doctor's own module wait for torch."""
    assert importlib.util.find_spec("torch") is not None
    code = "import certify.cli.doctor, certify.analysis.installation, sys; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
