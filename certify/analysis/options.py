"""What a run is asked for; the fields are the command line's options."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from certify.errors import OptionError
from certify.lyapunov import BEYOND, Beyond, Candidate, Named, Neural, Polynomial, Symbolic

Array = NDArray[np.float64]
EngineName = Literal["bounds", "dreal", "both"]
_MOST_JOBS = 256  # of the checker
Asked = Literal["auto", "asymptotic", "practical", "nearby"]
Around = Literal["auto", "origin", "rest"]


@dataclass(frozen=True, slots=True)
class RoaOptions:
    """How to certify.

    Parameters
    ----------
    claim : `asymptotic`; `practical`, which asks for no equilibrium at the origin; `nearby`, which is that and, if it
        can be shown, that all trajectories converge to one equilibrium where what is uncertain is constant. `auto` is
        the first where the loop rests at the origin exactly, and the last where it does not.
    around : the point at which V is 0, under a claim that needs no equilibrium at the origin: the `origin`, or where
        the loop does `rest`, which then is the operating point, and states are deviations from there. `auto` is where
        it rests if that is a stable point and nothing is given in deviations from the origin: `P`, `level`, `lyapunov`.
    candidate : where P comes from, see `choose_candidate`, or `robust`, which chooses P with the local rule's own
        bounds, or `peak`, whose floor is small; `auto` tries several and keeps the one with which the largest volume is
        proved. `neural` and `polynomial` do that too, and learn a function N whose set reaches beyond the ellipsoid.
        With Q, R or a level it is `lyapunov`, or `lqr` if R is given.
    Q, R : diagonals of the weights, shapes (n,) and (m,); None means ones.
    P : a Lyapunov matrix of one's own, (n, n); overrides the candidate.
    level : prove exactly this level; None finds the largest.
    engine : `bounds`, `dreal` (its word is trusted, not checked), or `both`: bounds prove, dReal is asked as well.
    dreal_precision : dReal's delta.
    jobs : processes of the checker, and threads of dReal; None is one of these, and where there are many leaves as many
        of those as there are cores.
    cluster : whose workers grow boxes: `local:N` for N processes of this machine, or the address of a Dask scheduler,
        such as tcp://host:8786; None for the threads of this process.
    cluster_checks : the cluster's workers run the checker as well, each on a part of the leaves, and are believed.
    resume : go on with the search that an earlier run for the largest level left in the folder.
    enlarge : look for a tube of ellipsoids from a larger set into the proved one.
    box : half-widths by state; `enlarge` for the largest multiple of the ellipsoid with these half-axes. A state that
        is not named gets the smallest share of its domain that a named one has.
    reach_from : a state by the states' values, those that are not named at the operating point: look for a tube around
        the trajectory from there into the proved set, the widest multiple of an ellipsoid; of `box`, if it is given.
    lyapunov : a function N of the states beyond the ellipsoid: prove the largest {N <= n2} from which every trajectory
        enters {V <= c2}, in the domain box.
    lyapunov_level : prove exactly this n2; None finds the largest.
    hidden, degree : of what the candidates `neural` and `polynomial` learn: the widths of the layers between states and
        output, and the degree.
    seed : of that learning.
    time_limit : seconds for everything up to the verdict, the check included.
    max_boxes : boxes for the ring.
    rate : lambda in `D + 2 lambda V < 0`: V is to fall at least as exp(-2 lambda t), in units of time of the plant, or
        in discrete time at each step by the share 2 lambda.
    """

    claim: Asked = "auto"
    around: Around = "auto"
    candidate: Candidate = "auto"
    Q: tuple[float, ...] | None = None
    R: tuple[float, ...] | None = None
    P: Array | None = None
    level: float | None = None
    engine: EngineName = "bounds"
    dreal_precision: float = 1e-3
    jobs: int | None = None
    cluster: str | None = None
    cluster_checks: bool = False
    resume: bool = False
    enlarge: bool = False
    box: Mapping[str, float] | None = None
    reach_from: Mapping[str, Fraction | float] | None = None
    lyapunov: Neural | Polynomial | Symbolic | None = None
    lyapunov_level: float | None = None
    hidden: tuple[int, ...] = (16, 16)
    degree: int = 4
    seed: int = 0
    time_limit: float = 50.0
    max_boxes: int = 4_000_000
    rate: float = 0.0

    @property
    def enlarges(self) -> bool:
        """Whether a tube is looked for."""
        return self.enlarge or self.box is not None or self.reach_from is not None

    @property
    def _tube(self) -> str:
        """The option that asks for a tube."""
        return "reach_from" if self.reach_from is not None else "enlarge" if self.enlarge else "box"

    @property
    def learned(self) -> Beyond | None:
        """What is learned for a set beyond the ellipsoid, if anything is."""
        return next((name for name in BEYOND if name == self.candidate), None)

    @property
    def goes_beyond(self) -> bool:
        """Whether a set beyond the ellipsoid is looked for."""
        return self.lyapunov is not None or self.learned is not None

    @property
    def only(self) -> Named | None:
        """The one candidate that is asked for, if P is not given; None if several are tried."""
        if self.candidate != "auto" and self.candidate not in BEYOND:
            return cast(Named, self.candidate)
        return "lqr" if self.R is not None else "lyapunov" if self.Q is not None or self.level is not None else None

    def __post_init__(self) -> None:
        for name, known in (("claim", Asked), ("around", Around), ("candidate", Candidate), ("engine", EngineName)):
            if getattr(self, name) not in get_args(known):
                raise OptionError(
                    f"`{name}` must be one of {', '.join(get_args(known))}; found {getattr(self, name)!r}."
                )
        if not 0 < self.dreal_precision < 1:
            raise OptionError(f"`dreal_precision` must lie between 0 and 1; found {self.dreal_precision}.")
        if self.jobs is not None and not 1 <= self.jobs <= _MOST_JOBS:
            raise OptionError(f"`jobs` must be 1 to {_MOST_JOBS}; found {self.jobs}.")
        if self.cluster_checks and self.cluster is None:
            raise OptionError("`cluster_checks` must have a `cluster`; found none.")
        if self.cluster is not None and self.engine != "bounds":
            raise OptionError("`cluster` needs the engine bounds.")
        if self.resume and (self.engine != "bounds" or self.P is not None or self.only is not None):
            raise OptionError(
                "`resume` takes the candidate of the search; leave out `candidate`, `Q`, `R`, `level` and a P of your "
                "own, and use the engine bounds."
            )
        if self.around == "rest" and self.claim == "asymptotic":
            raise OptionError(
                "`around` rest needs another `claim` than asymptotic, under which the loop rests at the origin."
            )
        if self.level is not None and not (math.isfinite(self.level) and self.level > 0):
            raise OptionError(f"`level` must be a positive number; found {self.level}.")
        if self.box is not None and not all(math.isfinite(v) and v > 0 for v in self.box.values()):
            raise OptionError(f"`box` must have positive half-widths; found {_listed(self.box)}.")
        if self.reach_from is not None and not all(math.isfinite(v) for v in self.reach_from.values()):
            raise OptionError(f"`reach_from` must be a state of finite numbers; found {_listed(self.reach_from)}.")
        if self.enlarges and (self.engine == "dreal" or self.claim in ("practical", "nearby")):
            raise OptionError(
                f"`{self._tube}` looks for a tube, which needs the engine bounds and the claim asymptotic: it ends in "
                "a set that the checker can replay, and from which trajectories converge."
            )
        if not (math.isfinite(self.rate) and self.rate >= 0):
            raise OptionError(f"`rate` must be a number of at least 0; found {self.rate}.")
        if self.rate and (self.enlarges or self.engine != "bounds"):
            raise OptionError(
                "`rate` needs the engine bounds, and a claim without a tube: leave `enlarge` and `box` out."
            )
        if self.goes_beyond and (self.enlarges or self.rate or self.engine != "bounds"):
            what = "`lyapunov`" if self.learned is None else f"`candidate` {self.learned}"
            raise OptionError(f"{what} needs the engine bounds, and a claim without a tube and without a rate.")
        if self.lyapunov is not None and self.learned is not None:
            raise OptionError(
                f"`candidate` {self.learned} learns a function; leave `lyapunov` out, or name another candidate."
            )
        if any(width < 1 for width in self.hidden) or self.degree not in range(2, 13, 2):
            raise OptionError(
                "`hidden` must be widths of at least 1, and `degree` even, 2 to 12; "
                f"found {self.hidden}, {self.degree}."
            )
        if self.lyapunov_level is not None and not math.isfinite(self.lyapunov_level):
            raise OptionError(f"`lyapunov_level` must be a finite number; found {self.lyapunov_level}.")
        if not self.time_limit > 0:
            raise OptionError(f"`time_limit` must be positive; found {self.time_limit:g}.")
        if not self.max_boxes > 0:
            raise OptionError(f"`max_boxes` must be positive; found {self.max_boxes}.")


def _listed(values: Mapping[str, Fraction | float]) -> str:
    return ", ".join(f"{name}={float(value):g}" for name, value in values.items())
