"""Plants: symbolic equations with exact parameters, and the registry of the shipped plants."""

from __future__ import annotations

from certify.loop.plants.constraints import in_parts, kept_constraints, with_constraints
from certify.loop.plants.deviations import (
    constraints_of_values,
    domain_of_values,
    dynamics_of_values,
    in_deviations,
    with_origin,
)
from certify.loop.plants.floating_point import mean_rate
from certify.loop.plants.linear import Controllability, Matrix, controllability, corners_at_rest, in_floats, linearise
from certify.loop.plants.measurements import Axis, Measurements, Run
from certify.loop.plants.operating_point import clocks, moves_off, require_equilibrium, residuals, rests_where
from certify.loop.plants.registry import available_systems, chosen_system, get_system, shipped_system
from certify.loop.plants.samples import Sampled, Samples, Unknown
from certify.loop.plants.system import System, exact
from certify.loop.plants.toml import load_system
from certify.loop.plants.uncertainty import at_values, corners, input_errors, kind_of, with_input_errors
from certify.loop.plants.validation import require_no_jumps, require_origin_inside

__all__ = [
    "Axis",
    "Controllability",
    "Matrix",
    "Measurements",
    "Run",
    "Sampled",
    "Samples",
    "System",
    "Unknown",
    "at_values",
    "available_systems",
    "chosen_system",
    "clocks",
    "constraints_of_values",
    "controllability",
    "corners",
    "corners_at_rest",
    "domain_of_values",
    "dynamics_of_values",
    "exact",
    "get_system",
    "in_deviations",
    "in_floats",
    "in_parts",
    "input_errors",
    "kept_constraints",
    "kind_of",
    "linearise",
    "load_system",
    "mean_rate",
    "moves_off",
    "require_equilibrium",
    "require_no_jumps",
    "require_origin_inside",
    "residuals",
    "rests_where",
    "shipped_system",
    "with_constraints",
    "with_input_errors",
    "with_origin",
]
