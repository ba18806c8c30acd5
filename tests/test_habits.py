"""The files that say how the project is worked on agree with the project."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

import certify

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
BASE = certify.__version__.partition(".dev")[0]


def parsed(name: str) -> Any:
    return yaml.safe_load((ROOT / name).read_text("utf-8"))


def test_the_changelog_begins_with_this_version() -> None:
    """A version under development is unreleased; one that can be tagged has a date."""
    heads = re.findall(r"^## \[(.*?)\] - (.*)$", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.M)
    version, when = heads[0]
    assert version == BASE and re.fullmatch(r"\d+\.\d+\.\d+", BASE)
    assert (when == "unreleased") is (certify.__version__ != BASE)
    assert all(re.fullmatch(r"\d{4}-\d\d-\d\d", date) for _, date in heads[1:])
    numbers = [tuple(map(int, v.split("."))) for v, _ in heads]
    assert numbers == sorted(set(numbers), reverse=True)


@pytest.mark.parametrize("page", ["README.md", "docs/believe.md", "docs/comparison.md", "docs/how-to/coq.md"])
def test_a_page_says_how_many_lines_a_reviewer_reads(page: str) -> None:
    """The checker has so many, to a tenth: `cat certify/checker/*.py | wc -l`."""
    lines = sum(len(path.read_text("utf-8").splitlines()) for path in (ROOT / "certify" / "checker").glob("*.py"))
    found = re.search(r"some (\d),(\d{3}) lines", (ROOT / page).read_text("utf-8"))
    assert found is not None and abs(int(found[1] + found[2]) - lines) <= 0.1 * lines


def test_every_citation_says_the_same() -> None:
    found, page = parsed("CITATION.cff"), (ROOT / "docs" / "citing.md").read_text("utf-8")
    assert found["cff-version"] == "1.2.0" and found["license"] == "MIT"
    assert found["authors"] == PROJECT["authors"] and found["keywords"] == PROJECT["keywords"]
    assert f"title   = {{{found['title']}}}" in page and f"version = {{{BASE}}}" in page
    (paper,) = found["references"]
    assert f"{{{paper['title']}}}" in page and paper["identifiers"][0]["value"].removeprefix("arXiv:") in page
    names = [who["family-names"] for who in paper["authors"]]
    authors = " and ".join(f"{{{name}}}" if " " in name else name for name in names)
    assert f"{{{authors}}}" in page
    assert "version" not in found  # certify/__init__.py is its only place


def test_the_workflow_calls_the_projects_own_scripts_with_each_python() -> None:
    workflow = parsed(".github/workflows/ci.yml")
    jobs = workflow["jobs"]
    pythons = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if c.startswith("Programming Language")]
    assert PROJECT["requires-python"] == f">={pythons[0]}"
    for name in ("suite", "distributions"):
        assert jobs[name]["strategy"]["matrix"]["python"] == pythons
    runs = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert runs == [".ci/run", "make docs", "make dist"]
    assert workflow["env"]["PYTHON"] == "python"  # the Makefile asks for another by default
    assert all(job["runs-on"] == "ubuntu-latest" for job in jobs.values())


def test_the_hooks_run_in_the_projects_environment_and_download_nothing() -> None:
    (repository,) = parsed(".pre-commit-config.yaml")["repos"]
    assert repository["repo"] == "local"
    assert {hook["language"] for hook in repository["hooks"]} == {"system"}
    entries = [hook["entry"].split()[0] for hook in repository["hooks"]]
    assert entries == [".venv/bin/ruff", ".venv/bin/ruff", ".venv/bin/mypy", ".ci/fast"]


@pytest.mark.parametrize("name", ["run", "fast", "dist"])
def test_the_scripts_can_be_run_and_name_what_there_is(name: str) -> None:
    script = ROOT / ".ci" / name
    assert os.access(script, os.X_OK)
    text = script.read_text("utf-8")
    subprocess.run(["bash", "-n", str(script)], check=True)
    for path in re.findall(r"(?<![\w/$\"])(?:tests|examples)/[\w./-]+", text):
        assert (ROOT / path).exists(), path
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.M))
    assert set(re.findall(r"\bmake ([\w-]+)", text)) <= targets


@pytest.mark.parametrize("name", ["CONTRIBUTING.md", "CHANGELOG.md"])
def test_what_contributors_are_told_to_type_and_read_exists(name: str) -> None:
    text = (ROOT / name).read_text("utf-8")
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.M))
    gone = {"paper-keep"}
    assert set(re.findall(r"(?:^|`|; )(?:PYTHON=\S+ )?make ([a-z-]+)", text, re.M)) <= targets | gone
    for link in re.findall(r"\]\((?!https?:)([^)#]+)", text):
        assert (ROOT / link).exists(), link
    for path in re.findall(r"`((?:certify|tests|docs|\.github|\.ci)/[\w./-]+)`", text):
        assert (ROOT / path).exists(), path


def test_a_repository_that_has_a_public_address_says_it_everywhere_or_nowhere() -> None:
    """None is known yet, and a link that leads nowhere must not be invented."""
    urls = set(PROJECT.get("urls", {}).values())
    assert urls >= {parsed("CITATION.cff").get("repository-code")} - {None}
    assert bool(urls) is ("repository-code" in parsed("CITATION.cff"))


def lines_of_code(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """The lines of a function, without its docstring."""
    first = node.body[0]
    documented = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
    docstring = (first.end_lineno or 0) - first.lineno + 1 if documented else 0
    return (node.end_lineno or 0) - node.lineno + 1 - docstring


def test_classes_and_functions_are_short() -> None:
    """A class has 200 lines at most, a function 60; the checker reads by rules of its own."""
    large, long = [], []
    for path in [*ROOT.glob("certify/**/*.py"), *ROOT.glob("controllers/**/*.py")]:
        where = path.relative_to(ROOT).as_posix()
        if where.startswith("certify/checker/"):
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ClassDef) and (node.end_lineno or 0) - node.lineno + 1 > 200:
                large.append(f"{where} {node.name}")
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and lines_of_code(node) > 60:
                long.append(f"{where} {node.name}")
    assert not large and not long
