"""Keep the runs that are over beside the page: `make paper-keep RUNS=runs`.

A run takes up to an hour, and the page's tables and pictures are made of runs: those that lie in `docs/paper/runs` make
them again without training (`make paper`). What is kept of a run are its curve, why it ended, and its policy, of a
baseline's file all but the optimisers, which are two thirds of it. Runs that are not over stay where they are.
"""

from __future__ import annotations

import io
import shutil
import sys
import zipfile
from pathlib import Path

from certify.certificates import write_atomically
from controllers.course import CURVE, ENDED
from controllers.sb3 import MODEL

KEPT = Path(__file__).parent / "runs"
FILES = (CURVE, ENDED, "policy.pt", "actor.pt")


def lean(content: bytes) -> bytes:
    """A baseline's file without its optimisers; the same bytes each time."""
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as out:
        for name in archive.namelist():
            if "optimizer" not in name:
                out.writestr(zipfile.ZipInfo(name), archive.read(name), zipfile.ZIP_DEFLATED)
    return packed.getvalue()


def main(runs: Path) -> None:
    for ended in sorted(runs.glob(f"*/*/seed-*/{ENDED}")):
        source, target = ended.parent, KEPT / ended.parent.relative_to(runs)
        if target.is_dir():
            continue
        target.mkdir(parents=True)
        for name in FILES:
            if (source / name).is_file():
                shutil.copyfile(source / name, target / name)
        if (source / MODEL).is_file():
            write_atomically(target / MODEL, lean((source / MODEL).read_bytes()))
        print(target.relative_to(KEPT))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs"))
