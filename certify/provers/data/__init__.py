"""Ranges of parameters that hold every plant with which measurements are consistent."""

from __future__ import annotations

from certify.provers.data.identify import Contradiction, Identified, identify

__all__ = ["Contradiction", "Identified", "identify"]
