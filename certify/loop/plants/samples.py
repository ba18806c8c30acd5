"""Functions of which nobody wrote down the equations: bounds of their second derivatives, and samples on a grid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

Point = tuple[Fraction, ...]


@dataclass(frozen=True, slots=True)
class Unknown:
    """A state whose derivative, in discrete time next value, is a function g of some variables that nobody wrote down.

    Parameters
    ----------
    state : its name.
    variables : names of the states and inputs that g depends on, and of no others.
    curvature : bounds of the absolute second derivatives of g wherever the grid of samples reaches, (d, d), symmetric.
    """

    state: str
    variables: tuple[str, ...]
    curvature: tuple[Point, ...]


@dataclass(frozen=True, slots=True)
class Grid:
    """Samples of g at all points of a grid.

    Parameters
    ----------
    axes : the values of each variable, ascending.
    values : g at each point, by the point; each is off by at most the noise.
    """

    axes: tuple[Point, ...]
    values: Mapping[Point, Fraction]


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Unknown functions for which equations of a plant stand.

    Parameters
    ----------
    sha256 : of the file of samples, 64 hexadecimal digits.
    unknowns : the functions.
    noise : the bound of a sample's error, by the state's name.
    grids : the samples, by the state's name; empty where only the file is known.
    """

    sha256: str
    unknowns: tuple[Unknown, ...]
    noise: Mapping[str, Fraction]
    grids: Mapping[str, Grid]


def slope_name(state: str, variable: str) -> str:
    """The name of the parameter that is a slope of an unknown function at the origin."""
    return f"slope_{state}_{variable}"
