"""Learn second functions N for sets beyond an ellipsoid, in floats; the provers prove them."""

from __future__ import annotations

from certify.lyapunov.learning.learned import Learned, Round, fit_polynomial, learn

__all__ = ["Learned", "Round", "fit_polynomial", "learn"]
