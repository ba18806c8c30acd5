"""Plants: symbolic equations with exact parameters, and the registry of the shipped plants."""

from __future__ import annotations

from certify.loop.plants.linear import Controllability, Matrix, controllability, in_floats, linearise
from certify.loop.plants.registry import available_systems, chosen_system, get_system, shipped_system
from certify.loop.plants.system import System, exact, in_deviations
from certify.loop.plants.toml import load_system

__all__ = [
    "Controllability",
    "Matrix",
    "System",
    "available_systems",
    "chosen_system",
    "controllability",
    "exact",
    "get_system",
    "in_deviations",
    "in_floats",
    "linearise",
    "load_system",
    "shipped_system",
]
