"""Policies of other programs: read without executing anything, folded exactly, compared with the file's own program."""

from __future__ import annotations

from certify.loop.policies.importers.importing import (
    Imported,
    centring_changes,
    import_bytes,
    import_policy,
    read_bytes,
)
from certify.loop.policies.importers.memory import import_module, import_state_dict
from certify.loop.policies.importers.options import ImportOptions
from certify.loop.policies.importers.recognising import content_of
from certify.loop.policies.importers.steps import Clip

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
