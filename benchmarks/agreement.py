"""The checker and the reference on many certificates: how many both accept, both refuse, and where they differ.

`python benchmarks/agreement.py FILE_OR_FOLDER ... --seconds 100` asks both about every certificate of format 9 that is
named or lies in a folder (`*.json`, the same bytes once) and prints a table by kind of claim: `same rule` counts those
of the refused that both refuse under one name, `late` those on which a program took longer than it may. Seconds are of
processor time, on certificates that both decide. The status is 1 if the programs differ on any.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import resource
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from certify.certificates.checking import Program, command

_SCHEMA, _LATE = "certify-certificate/9", "late"


def files(names: Sequence[Path]) -> Iterator[tuple[Path, dict[str, Any]]]:
    """The certificates under these names, and each as an object; no bytes twice."""
    seen = set[str]()
    for name in names:
        for path in sorted(name.rglob("*.json")) if name.is_dir() else [name]:
            raw = path.read_bytes()
            sha256 = hashlib.sha256(raw).hexdigest()
            if sha256 in seen or _SCHEMA.encode() not in raw:
                continue
            seen.add(sha256)
            data = json.loads(raw)
            if isinstance(data, dict) and data.get("schema") == _SCHEMA:
                yield path, data


def kind(data: dict[str, Any]) -> str:
    """The claim in a few words: its kind, and what it has of features."""
    claim, plant = data["claim"], data["plant"]
    features = {
        "held": claim.get("sample") is not None,
        "discrete": plant["time"] == "discrete",
        "ranges": bool(plant["uncertain"]),
        "outer": claim["kind"] != "invariant" and claim.get("outer") is not None,
        **{name: name in claim for name in ("ranks", "keep", "data")},
        "then": "then" in data,
    }
    return ", ".join([claim["kind"], *(name for name, has in features.items() if has)])


@dataclass(frozen=True)
class Answer:
    """The rule that refuses, `accepted`, or that it took too long; and processor time in seconds."""

    said: str
    at: str
    seconds: float


def asked(program: Program, path: Path, seconds: float) -> Answer:
    def used() -> float:
        mine = resource.getrusage(resource.RUSAGE_CHILDREN)
        return mine.ru_utime + mine.ru_stime

    start = used()
    try:
        done = subprocess.run(
            command(program, ["--json", "--", str(path)]), capture_output=True, text=True, check=False, timeout=seconds
        )
    except subprocess.TimeoutExpired:
        return Answer(_LATE, "", used() - start)
    answer = json.loads(done.stdout)
    said = answer.get("rule") or answer.get("result") or "error"
    at = f"{answer.get('at', '')}: {answer.get('detail') or answer.get('error', '')}"
    return Answer(said.lower(), at, used() - start)


def row(name: str, pairs: list[tuple[Answer, Answer]]) -> str:
    decided = [pair for pair in pairs if _LATE not in (pair[0].said, pair[1].said)]
    fine = [(one.said in ("accepted", "trusted"), other.said in ("accepted", "trusted")) for one, other in decided]
    refused = [(one.said, other.said) for (one, other), both in zip(decided, fine, strict=True) if not any(both)]
    counts = [len(pairs), sum(map(all, fine)), len(refused), sum(a == b for a, b in refused)]
    counts += [sum(a != b for a, b in fine), len(pairs) - len(decided)]
    times = [f"{sum(pair[i].seconds for pair in decided):.1f}" for i in range(2)]
    return f"| {' | '.join([name, *map(str, counts), *times])} |"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", type=Path, metavar="FILE_OR_FOLDER")
    parser.add_argument("--seconds", type=float, default=100.0, help="the most that one check may take")
    options = parser.parse_args()
    found, apart = defaultdict[str, list[tuple[Answer, Answer]]](list), list[str]()
    for path, data in files(options.names):
        one, other = (asked(program, path, options.seconds) for program in ("checker", "reference"))
        found[kind(data)].append((one, other))
        if one.said != other.said:
            apart.append(f"{path}: {one.said} {one.at}; {other.said} {other.at}")
            print(apart[-1], file=sys.stderr, flush=True)
    print("| claim | certificates | accepted | refused | same rule | differ | late | checker, s | reference, s |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name in sorted(found):
        print(row(name, found[name]))
    whole = [pair for pairs in found.values() for pair in pairs]
    print(row("all", whole))
    decided = [(a.said, b.said) for a, b in whole if _LATE not in (a.said, b.said)]
    return int(any((a == "accepted") != (b == "accepted") for a, b in decided))


if __name__ == "__main__":
    sys.exit(main())
