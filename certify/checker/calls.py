"""Calls of networks in equations: on boxes each entry that is used has a symbol for its error, on a ball an error of
its own in the family of those of the inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .ball import reached, rows
from .expression import Call, evaluate
from .jets import Jet, Units
from .near import ZERO, Above, Cubic, Form, Near, Square
from .network import OnBoxes
from .networks import Network
from .taylor import Taylor, affine, forms

if TYPE_CHECKING:
    from .ball import Ball


# ------------------------------------------------------------------------------------------------------------- on boxes


def enclose(network: Network, x: Form, entries: Sequence[int]) -> Form:
    """Some entries of the network's value on boxes, x (k + 1, reads, B) being the argument."""
    boxes, rows = OnBoxes(network, x), np.zeros((len(entries), network.gives))
    rows[range(len(entries)), list(entries)] = 1.0
    return Form(boxes.last.h.value[:, list(entries)], boxes.backwards(rows))


def entries(call: Call, arguments: Sequence[Taylor], first: int) -> list[Taylor]:
    """The entries that a call in equations uses, as models: the error of each has a symbol of its own, from `first` on,
    which no argument knows."""
    u, found = enclose(call.network, forms(arguments), call.entries), list[Taylor]()
    for j in range(len(call.entries)):
        g = u.value[1:, j].copy()
        own = first + call.first + j
        g[own] = np.where(g[own] == 0, u.error.top[j], np.nan)
        found.append(affine(u.value[0, j], g))
    return found


# ------------------------------------------------------------------------------------------------------------ on a ball


def on_ball(ball: Ball, variables: Sequence[Jet]) -> list[Jet]:
    """The components of f, all in one family of errors: the inputs', and then those of each call."""
    units = ball.units

    def called(call: Call, arguments: list[Jet]) -> list[Jet]:
        nonlocal units
        h = at(ball.algebra(len(units.R)).value(call.network, arguments), list(call.entries))
        first, units = units.count, joined(units, reached(h, h.B.value, np.ones(len(call.entries))))
        plain = replace(
            h,
            a=h.a.wider(h.units.tilt(h.B.error)),
            Q=Square(h.Q.value),
            K=Cubic(h.K.value),
            E=Square(np.zeros_like(h.E.value)),
            lip=h.lipschitz,
        )
        return ball.of_y(rows(plain, range(len(call.entries)), units, first))

    F = evaluate(ball.case.c.dynamics, ball.constant, variables, called)
    return [f if f.units is units else among(f, units) for f in F]


def at(x: Jet, of: list[int]) -> Jet:
    """Some members of a batch, whose B means itself."""
    return Jet(x.c[of], x.a[of], x.Q[of], x.K[of], x.E[of], Near(x.B.value[:, of]), x.units, x.lip[of])


def joined(units: Units, more: Units) -> Units:
    """The family with further errors, of units of their own."""
    if units.L is None or more.L is None:
        raise TypeError("the errors of each of these families must be sums")
    (m, N), (others, own) = units.L.shape, more.L.shape
    return units.beside(more, np.block([[units.L, np.zeros((m, own))], [np.zeros((others, N)), more.L]]))


def in_one_family(x: Jet, y: Jet) -> tuple[Jet, Jet]:
    """Two jets in the larger one of their families."""
    if is_made_of(x.units, y.units):
        return x, among(y, x.units)
    if is_made_of(y.units, x.units):
        return among(x, y.units), y
    raise ValueError("two jets must have errors in common")


def is_made_of(units: Units, other: Units) -> bool:
    """True if the other family is this one or one of its bases."""
    return units is other or (units.base is not None and is_made_of(units.base, other))


def among(x: Jet, units: Units) -> Jet:
    """The same among further errors, which it does not have."""
    more = np.zeros(units.count - len(x.B.value))
    error = x.B.error if x.B.error is ZERO else x.B.error.beside(Above(more))
    return replace(x, B=Near(np.concatenate([x.B.value, more]), error), units=units)
