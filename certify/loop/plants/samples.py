"""Functions of which nobody wrote down the equations: bounds of their second derivatives, and samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

Point = tuple[Fraction, ...]
Box = tuple[tuple[Fraction, Fraction], ...]


@dataclass(frozen=True, slots=True)
class Unknown:
    """A state whose derivative, in discrete time next value, is a function g of some variables that nobody wrote down.

    Parameters
    ----------
    state : its name.
    variables : names of the states and inputs that g depends on, and of no others.
    curvature : bounds of the absolute second derivatives of g on the box, (d, d), symmetric.
    box : the interval of each variable on which they hold; () before there are samples.
    error, slopes : names of the uncertain quantities r and a in the equation P + r E or a z + r E that stands for g;
        None and () where it has none.
    vanishes : True if g(0) = 0 is assumed.
    """

    state: str
    variables: tuple[str, ...]
    curvature: tuple[Point, ...]
    box: Box = ()
    error: str | None = None
    slopes: tuple[str, ...] = ()
    vanishes: bool = False


@dataclass(frozen=True, slots=True)
class Sampled:
    """Samples of g.

    Parameters
    ----------
    points : where they were taken, anywhere and in any order.
    values : of g there, each off by at most the noise.
    """

    points: tuple[Point, ...]
    values: Point

    def within(self, box: Box) -> Sampled:
        """The samples in a box."""
        kept = [k for k, z in enumerate(self.points) if all(lo <= v <= hi for v, (lo, hi) in zip(z, box, strict=True))]
        return Sampled(tuple(self.points[k] for k in kept), tuple(self.values[k] for k in kept))


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Unknown functions for which equations of a plant stand.

    Parameters
    ----------
    sha256 : of the file of samples, 64 hexadecimal digits.
    unknowns : the functions.
    noise : the bound of a sample's error, by the state's name.
    taken : the samples, by the state's name; empty where only the file is known.
    near_origin : how much more the error near the origin counted where a grid was chosen among the samples.
    """

    sha256: str
    unknowns: tuple[Unknown, ...]
    noise: Mapping[str, Fraction]
    taken: Mapping[str, Sampled]
    near_origin: float = 0.0


def slope_name(state: str, variable: str) -> str:
    """The name of the parameter that is a slope of an unknown function at the origin."""
    return f"slope_{state}_{variable}"
