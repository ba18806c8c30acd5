"""Samples of unknown functions in a claim, and the evidence that equations stand for all these functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from certify.errors import InputError
from certify.loop.plants import Sampled, Samples, Unknown

Weights = tuple[tuple[int, Fraction], ...]
"""Numbers of samples, and the weight of each."""


@dataclass(frozen=True, slots=True)
class Standing:
    """Evidence that an equation P + r E stands for an unknown function.

    Parameters
    ----------
    axes : of a grid over the box, without slopes.
    weights : of samples that bound each slope, or g at each point of the grid, from below and from above.
    """

    axes: tuple[tuple[Fraction, ...], ...] = ()
    weights: tuple[tuple[Weights, Weights], ...] = ()


SampleBounds = tuple[Standing, ...]
"""The evidence of each of the functions, in their order."""


def samples_claim(samples: Samples) -> dict[str, Any]:
    """The entry `samples` of a claim."""
    return {"sha256": samples.sha256, "functions": [_function(one, samples) for one in samples.unknowns]}


def _function(one: Unknown, samples: Samples) -> dict[str, Any]:
    taken = samples.taken[one.state]
    return {
        "state": one.state,
        "variables": list(one.variables),
        "box": list(map(_texts, one.box)),
        "curvature": list(map(_texts, one.curvature)),
        "noise": str(samples.noise[one.state]),
        "vanishes": one.vanishes,
        "points": list(map(_texts, taken.points)),
        "values": _texts(taken.values),
    }


def _texts(numbers: Sequence[Fraction]) -> list[str]:
    return list(map(str, numbers))


def samples_evidence(samples: Samples, bounds: SampleBounds) -> list[dict[str, Any]]:
    """The entry `samples` of the evidence."""
    return [
        {
            "error": one.error,
            "slopes": list(one.slopes),
            "axes": list(map(_texts, by.axes)),
            "weights": [[[[k, str(v)] for k, v in weights] for weights in ends] for ends in by.weights],
        }
        for one, by in zip(samples.unknowns, bounds, strict=True)
    ]


def read_samples(claim: Mapping[str, Any], evidence: Sequence[Mapping[str, Any]]) -> tuple[Samples, SampleBounds]:
    """The samples of both entries, and what shows that equations stand for the functions."""
    unknowns, taken = list[Unknown](), dict[str, Sampled]()
    for f, by in zip(claim["functions"], evidence, strict=True):
        taken[f["state"]] = Sampled(tuple(map(_numbers, f["points"])), _numbers(f["values"]))
        box = tuple((Fraction(lo), Fraction(hi)) for lo, hi in f["box"])
        curvature, of = tuple(map(_numbers, f["curvature"])), (by["error"], tuple(by["slopes"]), f["vanishes"])
        unknowns.append(Unknown(f["state"], tuple(f["variables"]), curvature, box, *of))
    noise = {f["state"]: Fraction(f["noise"]) for f in claim["functions"]}
    if len(taken) != len(unknowns):
        raise InputError("samples must have functions of different states.")
    bounds = tuple(Standing(tuple(map(_numbers, e["axes"])), tuple(map(_ends, e["weights"]))) for e in evidence)
    return Samples(str(claim["sha256"]), tuple(unknowns), noise, taken), bounds


def _numbers(texts: Sequence[str]) -> tuple[Fraction, ...]:
    return tuple(map(Fraction, texts))


def _ends(stored: Sequence[Sequence[tuple[int, str]]]) -> tuple[Weights, Weights]:
    lower, upper = (tuple((int(k), Fraction(v)) for k, v in weights) for weights in stored)
    return lower, upper
