"""Say of which runs the page's tables and pictures were made: `manifest.txt`, the sha256 of each of their files.

Runs take hours and megabytes, so they are not in the tree. `make paper RUNS=runs` compares a folder of runs with the
manifest, names every file that differs, draws, and writes the manifest anew for what it has drawn: the manifest always
describes what the page shows. `sha256sum -c`, run in the folder of runs, reads the same file.

`python docs/paper/manifest.py RUNS` only compares. It ends with 1 where a file differs.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

from controllers.comparison.run_files import CURVE, ENDED, MODEL

MANIFEST = Path(__file__).parent / "manifest.txt"
FILES = (CURVE, ENDED, "policy.pt", "actor.pt", MODEL)  # of a run, whatever of these it has
_LINE = re.compile(r"([0-9a-f]{64})  ([\w.-]+(?:/[\w.-]+)+)")


def read(path: Path) -> dict[str, str]:
    """The sha256 of each file, by its path in the folder of runs."""
    found: dict[str, str] = {}
    for number, line in enumerate(path.read_text("utf-8").splitlines() if path.is_file() else (), 1):
        match = _LINE.fullmatch(line)
        if match is None or match[2] in found:
            raise SystemExit(f"{path}, line {number}, must be 'SHA256  PATH' with a new path; it is {line!r}.")
        found[match[2]] = match[1]
    return found


def write(path: Path, digests: Mapping[str, str]) -> None:
    """Write a manifest, sorted by path."""
    path.write_text("".join(f"{digests[name]}  {name}\n" for name in sorted(digests)), "utf-8")


def digests(runs: Path, files: Iterable[Path]) -> dict[str, str]:
    """The sha256 of files below a folder of runs."""
    return {file.relative_to(runs).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def run_files(folders: Iterable[Path]) -> list[Path]:
    """The files of runs on which the page depends."""
    return [folder / name for folder in folders for name in FILES if (folder / name).is_file()]


def of_parts(listed: Mapping[str, str], parts: Collection[str]) -> dict[str, str]:
    """The entries of some parts of a folder of runs, a part being PLANT/METHOD or PLANT/HISTORY."""
    return {name: digest for name, digest in listed.items() if _part(name) in parts}


def replaced(listed: Mapping[str, str], parts: Collection[str], drawn: Mapping[str, str]) -> dict[str, str]:
    """The manifest after these parts have been drawn anew."""
    return {name: digest for name, digest in listed.items() if _part(name) not in parts} | drawn


def differences(listed: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    """One line per file that is not as the manifest says."""
    lines = []
    for name in sorted({*listed, *found}):
        if name not in found:
            lines.append(f"{name}: missing; the manifest has it")
        elif name not in listed:
            lines.append(f"{name}: not in the manifest")
        elif listed[name] != found[name]:
            lines.append(f"{name}: sha256 {found[name][:12]}…; the manifest says {listed[name][:12]}…")
    return lines


def _part(name: str) -> str:
    return "/".join(name.split("/")[:2]).removesuffix(".csv")


def main(runs: Path) -> int:
    """Compare the files that the manifest lists with a folder of runs."""
    if not runs.is_dir():
        raise SystemExit(f"RUNS must be a folder of runs; {runs} is none. docs/paper.md says how to get one.")
    listed = read(MANIFEST)
    lines = differences(listed, digests(runs, (runs / name for name in listed if (runs / name).is_file())))
    print("\n".join(lines) or f"All {len(listed)} files are those that the page was made of.")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs")))
