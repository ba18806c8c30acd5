"""Plants: symbolic equations with exact parameters, and the registry of the ones that ship."""

from __future__ import annotations

from certify.systems.registry import available_systems, get_system
from certify.systems.system import System, exact
from certify.systems.toml import load_system

__all__ = ["System", "available_systems", "exact", "get_system", "load_system"]
