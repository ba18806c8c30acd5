"""Rule `local`: Vdot < 0 on a ball that contains {V <= c1}, without a hole at the origin."""

from __future__ import annotations

from flint import fmpq_mat

from .decrease import contains, decreases, sound_multipliers
from .document import Certificate
from .evidence import Ball
from .fields import exact
from .loop import Loop
from .rational import identity
from .refusal import require


def local(loop: Loop, ball: Ball) -> None:
    """What the file says of the ball comes first, then rule `inputs` on it, and then what decreases."""
    c: Certificate = loop.c
    holds = contains(ball, c.P, exact(c.inner) * identity(c.n))
    require(holds, "local", "ball", "it does not contain {V <= c1}: J'PJ - c1 I is not positive definite")
    sound_multipliers(ball, "local", "ball")
    F = loop.on(ball.J, "local", "ball")
    falls = decreases(ball, c.P, fmpq_mat(c.n, c.n), F)
    require(falls, "local", "ball", "Vdot < 0 does not follow: the matrix that is left is not positive definite")
