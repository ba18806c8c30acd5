"""Equations as a page shows them."""

from __future__ import annotations

import pytest

from certify.loop.expressions import Number, Operation, Symbol
from certify.loop.plants import get_system
from certify.report.mathml import multiplied_out, typeset

x, u = Symbol("x"), Symbol("u")
ZERO = Operation("/", Number(0), Number(3))


@pytest.mark.parametrize(
    "given, shown",
    [
        (Operation("+", x, u, ZERO), Operation("+", x, u)),
        (Operation("+", x, ZERO), x),
        (Operation("*", Number(2), Operation("+", ZERO, x, Number(1))), Operation("*", Number(2), x + 1)),
        (Operation("*", x, ZERO), Operation("*", x, Number(0))),  # a factor is no term
        (Operation("+", ZERO, ZERO), Number(0)),
        (Operation("+", x, Operation("/", Number(0), ZERO)), Operation("+", x, Operation("/", Number(0), Number(0)))),
    ],
)
def test_terms_that_are_0_are_left_out(given: Operation, shown: Operation) -> None:
    assert multiplied_out(given) is shown


def test_the_pendulum_has_no_term_for_a_disturbance_that_does_not_act() -> None:
    """It is 0 in the certificate's equations, where it stays."""
    (_, fall) = get_system("pendulum").uncertain_dynamics()
    assert "<mn>0</mn>" not in typeset("", fall) and "0/(" in str(fall)
