"""Sweeps: every combination of policies, plants, values and candidates certified, into a table with certificates."""

from __future__ import annotations

from certify.analysis.studies.rows import Row
from certify.analysis.studies.study import Study, read_study
from certify.analysis.studies.sweep import Sweep, run_sweep

__all__ = ["Row", "Study", "Sweep", "read_study", "run_sweep"]
