"""Samples of unknown functions in a claim, and the evidence that equations stand for all these functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from certify.errors import CertificateFormatError, InputError
from certify.loop.plants import Sampled, Samples, System, Unknown
from certify.loop.plants.unknown import residual_name, standing_names

Weights = tuple[tuple[int, Fraction], ...]
"""Numbers of samples, and the weight of each."""


@dataclass(frozen=True, slots=True)
class Standing:
    """The quantities of an equation P + r E that stands for an unknown function.

    Parameters
    ----------
    error : the name of r; None where E is 0.
    slopes : names of the slopes at the origin of which P is made, one for each variable; none where P is of variables.
    axes : of a grid over the box, without slopes.
    weights : of samples that bound each slope, or g at each point of the grid, from below and from above.
    """

    error: str | None
    slopes: tuple[str, ...] = ()
    axes: tuple[tuple[Fraction, ...], ...] = ()
    weights: tuple[tuple[Weights, Weights], ...] = ()


SampleBounds = tuple[Standing, ...]
"""The equations' quantities for each of the functions, in their order."""


def samples_claim(samples: Samples, bounds: SampleBounds) -> dict[str, Any]:
    """The entry `samples` of a claim."""
    each = zip(samples.unknowns, bounds, strict=True)
    return {"sha256": samples.sha256, "functions": [_function(one, samples, bool(by.slopes)) for one, by in each]}


def _function(one: Unknown, samples: Samples, vanishes: bool) -> dict[str, Any]:
    taken = samples.taken[one.state]
    return {
        "state": one.state,
        "variables": list(one.variables),
        "box": list(map(_texts, one.box)),
        "curvature": list(map(_texts, one.curvature)),
        "noise": str(samples.noise[one.state]),
        "vanishes": vanishes,
        "points": list(map(_texts, taken.points)),
        "values": _texts(taken.values),
    }


def _texts(numbers: Sequence[Fraction]) -> list[str]:
    return list(map(str, numbers))


def samples_evidence(bounds: SampleBounds) -> list[dict[str, Any]]:
    """The entry `samples` of the evidence."""
    return [
        {
            "error": by.error,
            "slopes": list(by.slopes),
            "axes": list(map(_texts, by.axes)),
            "weights": [[[[k, str(v)] for k, v in weights] for weights in ends] for ends in by.weights],
        }
        for by in bounds
    ]


def read_samples(
    claim: Mapping[str, Any], evidence: Sequence[Mapping[str, Any]], system: System
) -> tuple[Samples, SampleBounds]:
    """The samples of both entries, and what stands for the functions.

    Raises
    ------
    CertificateFormatError : the equations' quantities have other names than those by which pages know them.
    """
    unknowns, taken = list[Unknown](), dict[str, Sampled]()
    for f in claim["functions"]:
        taken[f["state"]] = Sampled(tuple(map(_numbers, f["points"])), _numbers(f["values"]))
        box = tuple((Fraction(lo), Fraction(hi)) for lo, hi in f["box"])
        unknowns.append(Unknown(f["state"], tuple(f["variables"]), tuple(map(_numbers, f["curvature"])), box))
    noise = {f["state"]: Fraction(f["noise"]) for f in claim["functions"]}
    bounds = tuple(
        Standing(e["error"], tuple(e["slopes"]), tuple(map(_numbers, e["axes"])), tuple(map(_ends, e["weights"])))
        for e in evidence
    )
    if len(bounds) != len(unknowns) or len(taken) != len(unknowns):
        raise InputError("samples must have an entry of the evidence for each function, of different states.")
    for one, by in zip(unknowns, bounds, strict=True):
        if (by.error, by.slopes) != standing_names(one, system.ranges) or any(system.exact_x_eq()):
            raise CertificateFormatError(
                f"the samples of {one.state} can be shown only around 0, with quantities by the names that certify fit "
                f"gives them, such as {residual_name(one.state)}. certify check takes this certificate."
            )
    return Samples(str(claim["sha256"]), tuple(unknowns), noise, taken), bounds


def _numbers(texts: Sequence[str]) -> tuple[Fraction, ...]:
    return tuple(map(Fraction, texts))


def _ends(stored: Sequence[Sequence[tuple[int, str]]]) -> tuple[Weights, Weights]:
    lower, upper = (tuple((int(k), Fraction(v)) for k, v in weights) for weights in stored)
    return lower, upper
