"""Learn second functions N for sets beyond an ellipsoid, or that are never left, in floats; the provers prove them."""

from __future__ import annotations

from certify.lyapunov.learning.learned import (
    Learned,
    Learner,
    Round,
    fit_polynomial,
    learn,
    learn_staying,
    learner_of,
)
from certify.lyapunov.learning.models import Network, Terms

__all__ = ["Learned", "Learner", "Network", "Round", "Terms", "fit_polynomial", "learn", "learn_staying", "learner_of"]
