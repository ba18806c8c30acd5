"""Learning of Lyapunov functions beyond an ellipsoid, in floats: what is learned here is proved elsewhere."""

from __future__ import annotations

from certify.lyapunov.learning.learned import Learned, Round, fit_polynomial, learn

__all__ = ["Learned", "Round", "fit_polynomial", "learn"]
