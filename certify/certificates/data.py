"""Measurements in a claim, and the evidence that they bound parameters."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from certify.certificates.encoding import decode, encode
from certify.loop.plants import Axis, Measurements, Run, System

Array = NDArray[np.float64]


class Round(NamedTuple):
    """Evidence that of a box of K parameters measurements leave another, `box` (2, K) of its lower and upper ends, by
    weights (2, K, T, n) of T transitions for the lower and the upper end of each parameter."""

    box: Array
    weights: Array


@dataclass(frozen=True, slots=True)
class DataBounds:
    """Evidence that measurements bound parameters.

    Parameters
    ----------
    order, pieces : of the series in time of a transition, which goes in so many equal pieces.
    tree : a partition of the box of priors in preorder, one byte for each node.
    leaves : rounds of each of its leaves.
    rounds : those of the box that has what the leaves' rounds leave.
    turned : weights (2, J, T, n) for the lower and the upper end of each axis in the last box; None without axes.
    """

    order: int
    pieces: int
    tree: bytes
    leaves: tuple[tuple[Round, ...], ...]
    rounds: tuple[Round, ...]
    turned: Array | None = None


def data_claim(measurements: Measurements, system: System) -> dict[str, Any]:
    """The entry `data` of a claim."""
    ranges = measurements.priors.items()
    axes = [{"name": name, "at": str(at), "by": list(map(str, by))} for name, at, by in measurements.axes]
    return ({"axes": axes} if axes else {}) | {
        "sha256": measurements.sha256,
        "parameters": [{"name": name, "range": [str(lo), str(hi)]} for name, (lo, hi) in ranges],
        "period": None if measurements.period is None else [str(h) for h in measurements.period],
        "origin": [str(q) for q in system.exact_x_eq()],
        "noise": [str(w) for w in measurements.noise],
        "runs": [
            {"steps": len(run.inputs), "states": encode(run.states), "inputs": encode(run.inputs)}
            for run in measurements.runs
        ],
    }


def data_evidence(bounds: DataBounds) -> dict[str, Any]:
    """The entry `data` of the evidence."""
    return {
        "order": bounds.order,
        "pieces": bounds.pieces,
        "tree": base64.b64encode(bounds.tree).decode("ascii"),
        "leaves": [list(map(_stored, rounds)) for rounds in bounds.leaves],
        "rounds": list(map(_stored, bounds.rounds)),
    } | ({} if bounds.turned is None else {"turned": encode(bounds.turned)})


def read_measurements(stated: Mapping[str, Any], n: int, m: int) -> Measurements:
    """The measurements of a claim's entry `data`."""
    priors = {each["name"]: _pair(each["range"]) for each in stated["parameters"]}
    period = None if stated["period"] is None else _pair(stated["period"])
    runs = tuple(
        Run(decode(run["states"], (run["steps"] + 1, n)), decode(run["inputs"], (run["steps"], m)))
        for run in stated["runs"]
    )
    axes = tuple(
        Axis(axis["name"], Fraction(axis["at"]), tuple(map(Fraction, axis["by"]))) for axis in stated.get("axes", ())
    )
    return Measurements(priors, period, tuple(map(Fraction, stated["noise"])), runs, str(stated["sha256"]), axes)


def read_data_bounds(data: Mapping[str, Any], measurements: Measurements) -> DataBounds:
    """The evidence of the entry `data`, about these measurements."""
    K, T, n = len(measurements.priors), measurements.transitions, len(measurements.noise)

    def rounds(stored: list[Mapping[str, str]]) -> tuple[Round, ...]:
        return tuple(Round(decode(each["box"], (2, K)), decode(each["weights"], (2, K, T, n))) for each in stored)

    tree, leaves = base64.b64decode(data["tree"]), tuple(map(rounds, data["leaves"]))
    J = len(measurements.axes)
    turned = decode(data["turned"], (2, J, T, n)) if J else None
    return DataBounds(int(data["order"]), int(data["pieces"]), tree, leaves, rounds(data["rounds"]), turned)


def _stored(each: Round) -> dict[str, str]:
    return {"box": encode(each.box), "weights": encode(each.weights)}


def _pair(stored: list[str]) -> tuple[Fraction, Fraction]:
    lo, hi = map(Fraction, stored)
    return lo, hi
