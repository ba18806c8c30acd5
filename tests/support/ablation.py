"""The checker with one rule disabled, to show that the rule is there for a reason."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import certify.checker

TABLES = {
    "rules": ("STATED", "ON_THE_BALL", "OF_THE_TREE", "ON_LEAVES"),
    "tube": ("OF_THE_TUBE", "ON_SLABS"),
    "contraction": ("OF_CONTRACTION",),
    "outer": ("ON_FACES", "OF_OUTER_TREE", "ON_OUTER_LEAVES"),
}


@contextmanager
def checker_without(rule: str, folder: Path) -> Iterator[ModuleType]:
    """A copy of the checker in `folder`, loaded under another name, in which one rule never says no.

    Its rows are taken out of the tables. `format` and `hash` are rules of the reader: there, what says no is silenced.
    `lyapunov` also vouches for what later rules use; there the condition itself is taken out.
    """
    name = f"checker_without_{rule}"
    folder = folder / name
    shutil.copytree(Path(certify.checker.__file__).parent, folder, ignore=shutil.ignore_patterns("__pycache__"))
    spec = importlib.util.spec_from_file_location(
        name, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    assert spec is not None and spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    sys.modules[name] = package
    try:
        spec.loader.exec_module(package)
        for module in ("case", "document", "exact", "rules", "strict"):
            importlib.import_module(f"{name}.{module}")
        removed = 0
        for module, tables in TABLES.items():
            place = importlib.import_module(f"{name}.{module}")
            for table in tables:
                rows = getattr(place, table)
                kept = tuple(row for row in rows if row[0] != rule)
                setattr(place, table, kept)
                removed += len(rows) - len(kept)
        if rule == "format":
            package.strict.fail = lambda at, detail: None
        elif rule == "hash":
            package.document.check_hash = lambda policy, stated: None
        else:
            assert removed > 0
        if rule == "lyapunov":  # the symmetric part in place of an asymmetric matrix
            decide = package.exact.inverse_diagonal
            package.case.inverse_diagonal = lambda A: decide((A + A.transpose()) / 2)
        yield package
    finally:
        for module in [m for m in sys.modules if m.split(".")[0] == name]:
            del sys.modules[module]
