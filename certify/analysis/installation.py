"""This installation: versions, the source of the checkers, and which `certify` an import finds here.

A verdict rests on the two checkers, the Python that runs them, and two packages. So they are named, and the checkers'
source by a hash that anybody can compute: `cd certify/checker; LC_ALL=C; sha256sum *.py | sha256sum`.
"""

from __future__ import annotations

import hashlib
import importlib.machinery
import sys
from importlib import metadata
from pathlib import Path
from typing import Literal

Program = Literal["checker", "reference"]
_HERE = Path(__file__).resolve().parent.parent  # the package
_PROVENANCE = ("certify", "numpy", "scipy", "numba", "sympy", "python-flint")


def version_of(package: str) -> str | None:
    """The version of an installed package; None if it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def versions() -> dict[str, str]:
    """Python's version and those of the packages that made a certificate, for its provenance."""
    found = {package: version for package in _PROVENANCE if (version := version_of(package)) is not None}
    return {"python": sys.version.split()[0], **found}


def source_sha256(program: Program) -> str:
    """The sha256 over the lines of `sha256sum *.py` in the folder of a checker."""
    digest = hashlib.sha256()
    for path in sorted((_HERE / program).glob("*.py"), key=lambda p: p.name.encode()):
        digest.update(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n".encode())
    return digest.hexdigest()


def found_by_import(folder: Path) -> str | None:
    """The place at which a script or notebook in `folder` finds `import certify`; None if it is this package.

    A folder named `certify`, or a file `certify.py`, beside a script comes before everything that is installed: Python
    looks there first. A folder without `__init__.py` comes behind a package that lies on the path. Nothing is run.
    """
    path = [str(folder), *(entry for entry in sys.path if entry not in ("", str(folder)))]
    spec = importlib.machinery.PathFinder.find_spec("certify", path)
    if spec is None:
        return None  # an installation that names its folder in another way, as some editable ones do
    places = [spec.origin] if spec.origin is not None else list(spec.submodule_search_locations or ())
    own = {str(_HERE), str(_HERE / "__init__.py")}
    found = [str(Path(place).resolve()) for place in places if place is not None]
    return None if own & set(found) else ", ".join(found)
