"""Claims with `data`: runs of a plant in floats with noise at its bound, and multipliers from linear programs.

The programs take the reference's residuals as they are; multipliers are hints, which decide how narrow a box is and
never whether it is true.
"""

from __future__ import annotations

import base64
import json
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from flint import arb, ctx, fmpq
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import linprog

from certify.reference.balls import ON_LEAVES
from certify.reference.data import Box, Measured, Residual, Transition, hull, leaves, transitions
from certify.reference.document import Certificate, Data, read
from certify.reference.evidence import Fit, Tree
from certify.reference.leaves import LEAF
from certify.reference.refusal import Refused
from tests.support.certificates import Document, dump, encode

Array = NDArray[np.float64]
Rate = Callable[[Array, Array, Array], Sequence[Any]]  # f(x, u, p); in discrete time the next state
Claim = Callable[[Sequence[tuple[str, str]]], Document]  # with these ranges of the parameters
SHA256, HAIR = "0123456789abcdef" * 4, 1e-6


@dataclass(frozen=True)
class Experiment:
    """True parameters of a plant, their priors, and how it is measured; `drift` adds to f what another quantity may."""

    f: Rate
    names: tuple[str, ...]
    truth: tuple[float, ...]
    priors: tuple[tuple[str, str], ...]
    starts: tuple[tuple[float, ...], ...]
    steps: int
    period: tuple[str, str] | None
    noise: tuple[str, ...]
    origin: tuple[str, ...]
    order: int = 8
    pieces: int = 1
    rounds: int = 2
    size: float = 1.0  # of the inputs
    drift: float = 0.0
    seed: int = 0
    tree: bytes = bytes([LEAF])
    axes: tuple[tuple[str, str, tuple[str, ...]], ...] = ()

    def runs(self) -> list[Document]:
        chance, n = np.random.default_rng(self.seed), len(self.noise)
        noise, origin = (np.array([float(fmpq_of(q)) for q in each]) for each in (self.noise, self.origin))
        found = []
        for start in self.starts:
            x, rows, inputs = np.array(start, dtype=float), [], []
            for _ in range(self.steps):
                u = self.size * chance.uniform(-1, 1, 1)
                rows.append(x)
                inputs.append(u)
                x = self.after(x, u, chance)
            rows.append(x)
            signs = chance.choice([-1.0, 1.0, 0.3], (len(rows), n))
            measured = np.array(rows) + origin + (1 - 1e-6) * noise * signs
            found.append({"steps": self.steps, "states": encode(measured), "inputs": encode(inputs)})
        return found

    def after(self, x: Array, u: Array, chance: np.random.Generator) -> Array:
        p, w = np.array(self.truth), self.drift * chance.choice([-1.0, 1.0, 0.0], len(x))
        if self.period is None:
            return np.array(self.f(x, u, p)) + w
        lo, hi = (float(fmpq_of(q)) for q in self.period)
        h = chance.choice([lo, hi, (lo + hi) / 2])
        sol = solve_ivp(lambda t, y: np.array(self.f(y, u, p)) + w, (0, h), x, rtol=1e-12, atol=1e-13)
        return np.array(sol.y[:, -1])

    def stated(self) -> Document:
        """The claim's key."""
        parameters = [{"name": q, "range": list(ends)} for q, ends in zip(self.names, self.priors, strict=True)]
        axes = [{"name": name, "at": at, "by": list(by)} for name, at, by in self.axes]
        return {
            "sha256": SHA256, "parameters": parameters, "period": self.period and list(self.period),
            "origin": list(self.origin), "noise": list(self.noise), "runs": self.runs(),
        } | ({"axes": axes} if axes else {})  # fmt: skip


def fmpq_of(text: str) -> fmpq:
    numerator, _, denominator = text.partition("/")
    return fmpq(int(numerator), int(denominator or 1))


def claimed(experiment: Experiment, claim: Claim) -> Document:
    """The claim for the ranges that the multipliers give, where there are axes of these."""
    open_ = with_data(claim(experiment.priors), experiment)
    box, leaves, rounds = derived(open_, experiment.rounds)
    ranges, turned = on_axes(open_, box) if experiment.axes else (box, None)
    result = with_data(claim([(str(lo), str(hi)) for lo, hi in ranges]), experiment)
    result["evidence"]["data"] |= {"leaves": leaves, "rounds": rounds} | ({"turned": turned} if turned else {})
    return result


def on_axes(data: Document, box: Box) -> tuple[Box, str]:
    """Ranges of the axes for the parameters that are left in a box, and the multipliers that show them."""
    with ctx.workprec(ON_LEAVES):
        c = read(dump(data))
        assert c.data is not None and isinstance(c.evidence, Tree) and c.evidence.fit is not None
        now = Measured(c, c.data, c.evidence.fit, box, "tests")
        residuals = [r for t in transitions(c.data) for r in residuals_of(now, t)]
        symbols = now.K + c.n * sum(len(run.states) for run in c.data.runs)
        aims = np.array([[float(by[j].mid()) for j in range(now.K)] for _, by in now.axes])
        w = multipliers(residuals, aims, symbols)
        bounds = now.bounds(array("d", w.ravel().tolist()), [by for _, by in now.axes])
        found = []
        for (middle, _), (below, above) in zip(now.axes, bounds, strict=True):
            lo, hi = float((middle + below).mid()), float((middle + above).mid())
            found.append(tuple(fmpq(*end.as_integer_ratio()) for end in (lo - HAIR * (hi - lo), hi + HAIR * (hi - lo))))
        return found, encode(w)


def with_data(data: Document, experiment: Experiment) -> Document:
    """A document of today's format with measurements, and no multipliers."""
    result: Document = json.loads(dump(data))
    result["claim"]["data"] = experiment.stated()
    tree = experiment.tree
    result["evidence"]["data"] = {
        "order": experiment.order, "pieces": experiment.pieces, "tree": base64.b64encode(tree).decode(),
        "leaves": [[] for byte in tree if byte == LEAF], "rounds": [],
    }  # fmt: skip
    if experiment.axes:
        size = 2 * len(experiment.axes) * experiment.steps * len(experiment.starts) * len(experiment.noise)
        result["evidence"]["data"]["turned"] = encode([1.0] + [0.0] * (size - 1))
    return result


def derived(data: Document, rounds: int) -> tuple[Box, list[list[Document]], list[Document]]:
    """The box that is left after so many rounds on each leaf and on their hull, and all these rounds."""
    with ctx.workprec(ON_LEAVES):
        c = read(dump(data))
        assert c.data is not None and isinstance(c.evidence, Tree) and c.evidence.fit is not None
        here, made, left = Narrowing(c, c.data, c.evidence.fit), list[list[Document]](), list[Box]()
        for part in leaves(c.data.priors, c.evidence.fit.tree):
            box, found = here.all_of(part, rounds if len(c.evidence.fit.leaves) > 1 else 0)
            left += [] if box is None else [box]
            made.append(found)
        last, found = here.all_of(hull(left), rounds)
        assert last is not None
        return last, made, found


@dataclass(frozen=True)
class Narrowing:
    """Rounds of boxes by multipliers of their own."""

    c: Certificate
    data: Data
    fit: Fit

    def all_of(self, box: Box, rounds: int) -> tuple[Box | None, list[Document]]:
        made = list[Document]()
        for _ in range(rounds):
            now = Measured(self.c, self.data, self.fit, box, "tests")
            residuals = [r for t in transitions(self.data) for r in residuals_of(now, t)]
            w = multipliers(residuals, np.eye(now.K), now.K + self.c.n * sum(len(run.states) for run in self.data.runs))
            if not w.any():
                break
            units = now.bounds(array("d", w.ravel().tolist()), [{j: arb(1)} for j in range(now.K)])
            ends = np.array([outward(*old, *scaled(old, pair)) for old, pair in zip(box, units, strict=True)])
            made.append({"box": encode(ends.T), "weights": encode(w)})
            box = [(fmpq(*lo.as_integer_ratio()), fmpq(*hi.as_integer_ratio())) for lo, hi in ends.tolist()]
            if any(lo > hi for lo, hi in box):
                return None, made
        return box, made


def residuals_of(now: Measured, t: Transition) -> list[Residual]:
    """Where the flow has no enclosure ones that say nothing."""
    try:
        return list(now.residuals(t))
    except Refused:
        return [Residual(arb(0), {}, arb(0))] * now.n


def scaled(old: tuple[fmpq, fmpq], pair: tuple[arb, arb]) -> list[arb]:
    """Bounds of a symbol as those of the parameter."""
    (lo, hi), (below, above) = old, pair
    return [arb((lo + hi) / 2) + arb((hi - lo) / 2) * end for end in (below, above)]


def outward(lo: fmpq, hi: fmpq, below: arb, above: arb) -> tuple[float, float]:
    """The part of an interval between two bounds, wider by a millionth of it."""
    ends = float(max(arb(lo).mid(), below.mid())), float(min(arb(hi).mid(), above.mid()))
    more = HAIR * abs(ends[1] - ends[0])
    return ends[0] - more, ends[1] + more


def multipliers(residuals: Sequence[Residual], aims: Array, symbols: int) -> Array:
    """(2, J, T n): the duals of the least and of the largest values of sums of d, (J, K), that the residuals allow."""
    A, alpha, slack = np.zeros((len(residuals), symbols)), np.zeros(len(residuals)), np.zeros(len(residuals))
    for k, residual in enumerate(residuals):
        alpha[k], slack[k] = float(residual.alpha.mid()), float(residual.slack.upper())
        for symbol, slope in residual.slopes.items():
            A[k, symbol] += float(slope.mid())
    found = np.zeros((2, len(aims), len(residuals)))
    rows, bound = np.vstack([A, -A]), np.concatenate([slack - alpha, slack + alpha])
    for j, aim in enumerate(aims):
        for end, sign in enumerate((1.0, -1.0)):
            cost = np.zeros(symbols)
            cost[: len(aim)] = sign * aim
            least = linprog(cost, rows, bound, bounds=[(-1, 1)] * symbols, method="highs")
            if least.status == 2:
                return impossible(rows, bound, found)
            if least.status == 0:
                above, below = np.split(least.ineqlin.marginals, 2)
                found[end, j] = sign * (above - below)
    return found


def impossible(rows: Array, bound: Array, found: Array) -> Array:
    """The same where no symbols fit: the duals of by how much residuals must be wider, so large that d_0 exceeds 1."""
    symbols = rows.shape[1]
    wider, cost = np.hstack([rows, -np.ones((len(rows), 1))]), np.eye(symbols + 1)[-1]
    least = linprog(cost, wider, bound, bounds=[(-1, 1)] * symbols + [(0, None)], method="highs")
    above, below = np.split(least.ineqlin.marginals, 2)
    found[:] = 0
    if least.fun > 1e-6:  # beyond the tolerance of the program
        found[0, 0] = (above - below) * 4 / least.fun
    return found
