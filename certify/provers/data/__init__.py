"""Ranges of parameters that hold every plant with which measurements are consistent."""

from __future__ import annotations

from certify.provers.data.identify import Contradiction, Identified, identify
from certify.provers.data.least import Least, least_factors, least_of_refuted, residual_states

__all__ = ["Contradiction", "Identified", "Least", "identify", "least_factors", "least_of_refuted", "residual_states"]
