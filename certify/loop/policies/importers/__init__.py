"""Policies of other programs: read without executing anything, folded exactly, compared with the file's own program.

Public names are resolved on first use (PEP 562): a policy of this program needs no reader of another's.
"""

from __future__ import annotations

from importlib import import_module as _module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from certify.loop.policies.importers.importing import Imported, centring_changes, import_bytes, import_policy
    from certify.loop.policies.importers.memory import import_module, import_state_dict
    from certify.loop.policies.importers.options import ImportOptions
    from certify.loop.policies.importers.recognising import content_of, read_bytes
    from certify.loop.policies.importers.steps import Clip

_PUBLIC = {
    "Clip": "steps",
    "ImportOptions": "options",
    "Imported": "importing",
    "centring_changes": "importing",
    "content_of": "recognising",
    "import_bytes": "importing",
    "import_module": "memory",
    "import_policy": "importing",
    "import_state_dict": "memory",
    "read_bytes": "recognising",
}
__all__ = [
    "Clip",
    "ImportOptions",
    "Imported",
    "centring_changes",
    "content_of",
    "import_bytes",
    "import_module",
    "import_policy",
    "import_state_dict",
    "read_bytes",
]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(_module(f"{__name__}.{_PUBLIC[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
