"""The options of a run: each is declared here, once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

from certify.analysis.declaration import declared, option
from certify.errors import OptionError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from certify.lyapunov import Beyond, Candidate, Named, Neural, Polynomial, Symbolic

    Array = NDArray[np.float64]

EngineName = Literal["bounds", "dreal", "both"]
Asked = Literal["auto", "asymptotic", "practical", "nearby", "invariant"]
Around = Literal["auto", "origin", "rest"]
Place = Fraction | float | tuple[Fraction | float, Fraction | float]
"""A number, or the ends (lo, hi) of an interval."""
_MOST_JOBS = 256  # processes of the checker


def interval(place: Place) -> tuple[Fraction | float, Fraction | float]:
    """The ends of an interval, which are equal for a number."""
    return place if isinstance(place, tuple) else (place, place)


_POSITIVE = ("be a positive number", lambda value: math.isfinite(value) and value > 0)
_FROM_0 = ("be a number of at least 0", lambda value: 0 <= value < math.inf)
_ABOVE_0 = ("be positive", lambda value: value > 0)
_HALF_WIDTHS = ("have positive half-widths", lambda value: all(map(_POSITIVE[1], value.values())))
_PLACES = (
    "be a state of finite numbers, or a box with pairs (lo, hi), lo <= hi",
    lambda value: all(lo <= hi and math.isfinite(hi - lo) for lo, hi in map(interval, value.values())),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class RoaOptions:
    """The options of a run; `certify.certify_roa` takes them one by one as well."""

    # fmt: off
    claim: Asked = option("auto", "claim", "word", first=True, help=(
        "asymptotic: trajectories converge to the origin. practical: they enter a small set and stay there. nearby: "
        "they also converge to one equilibrium in it, if that can be shown. auto: asymptotic if the origin is "
        "exactly an equilibrium of the loop, else nearby. invariant: no trajectory leaves a set, and no "
        "equilibrium is needed. The set is {N <= n2}; N is given, or learned: a network, or a polynomial if that is "
        "the candidate. In steps it is one of boxes."))
    around: Around = option("auto", "claim", "word", metavar="POINT", help=(
        "The centre of V if the origin is no equilibrium: the origin, or rest, the loop's equilibrium, which then is "
        "the operating point. auto: rest if that is a stable point and nothing is given around the origin."))
    level: float | None = option(None, "claim", "number", _POSITIVE, first=True, help=(
        "Prove exactly V <= LEVEL; a smaller set counts as UNKNOWN. By default the largest level is looked for. V is "
        "that of the candidate, of lyapunov if none is named."))
    rate: float = option(0.0, "claim", "number", _FROM_0, help=(
        "Prove that V falls at least as exp(-2 RATE t), in discrete time by the share 2 RATE at each step. The "
        "condition is strict: of a V that falls exactly so, only smaller rates are proved."),
        written="max: the largest rate for which the set that is proved without one is still proved.")
    enlarge: bool = option(False, "claim", "flag", help=(
        "Look for a tube that leads from a larger set into the proved one."))
    box: Mapping[str, float] | None = option(None, "claim", "widths", _HALF_WIDTHS, metavar="HALF-AXES", help=(
        "Let the tube start from the largest multiple of the ellipsoid with these half-axes; a state that is not named "
        "gets the smallest fraction of its domain among those that are."),
        written="As in x=0.4,phi=0.2.", python="Half-axes by state.")
    reach_from: Mapping[str, Place] | None = option(
        None, "claim", "box", _PLACES, typed="--from", metavar="STATE|BOX", varies=False, first=True, help=(
        "Prove that this state converges too, with what lies around it, or all of this box: a tube around a trajectory "
        "leads into the proved set. A state that is not named is at the operating point."),
        written="As in x=0.5,y=-0.2 or x=0.4..0.6,y=-0.2.", python="Values by state, or pairs (lo, hi).")
    ranks: bool = option(False, "claim", "flag", help=(
        "In discrete time and with held inputs: prove from which boxes of the domain every trajectory reaches the "
        "proved set, in how many steps at most; angles of the plant count modulo 2 pi."))
    lyapunov: Neural | Polynomial | Symbolic | None = option(None, "claim", "file", metavar="N", help=(
        "A second function N, by its file or as an expression of the states' values: prove the largest outer set "
        "{N <= n2} in the domain, from which every trajectory enters the proved ellipsoid."),
        written="If the file (certify-lyapunov/1) says with which ellipsoid N was learned, that ellipsoid is proved, "
        "unless a candidate, weights or a level are given.",
        python="A function of deviations from the operating point, or the path of its file.")
    lyapunov_level: float | None = option(
        None, "claim", "number", ("be a finite number", math.isfinite), metavar="LEVEL", help=(
        "Prove exactly N <= LEVEL; a smaller outer set counts as UNKNOWN. By default the largest is looked for."))
    candidate: Candidate = option("auto", "candidate", "word", first=True, varies=False, help=(
        "Where the matrix P comes from: lyapunov, scaled, lqr, optimised, robust, or peak, which makes the floor of a "
        "practical claim small. ellipsoid: try several and keep the largest proved set; only lyapunov if Q or a level "
        "is given, only lqr if R is. auto: as ellipsoid; and if that is not most of what converges in simulation, in "
        "up to three states learn a second function for an outer set, or give ranks to boxes where time goes in steps. "
        "neural, polynomial: as ellipsoid, and learn this kind of second function in any case."))
    Q: tuple[float, ...] | None = option(None, "candidate", "row", metavar="NUMBERS", written="As in 1,1.", help=(
        "Diagonal of the weights Q, a positive number for each state; ones by default."))
    R: tuple[float, ...] | None = option(None, "candidate", "row", metavar="NUMBERS", written="As in 1.", help=(
        "Diagonal of the weights R of the candidate lqr, a positive number for each input; ones by default."))
    P: Array | None = option(None, "candidate", "matrix", typed="", varies=False, python="Shape (n, n).", help=(
        "A matrix P of your own, symmetric and positive definite, instead of a candidate."))
    hidden: tuple[int, ...] = option(
        (16, 16), "candidate", "layers", ("be widths of at least 1", lambda widths: min(widths, default=1) >= 1),
        metavar="WIDTHS", help="Widths of the hidden layers of the network that is learned for N.")
    degree: int = option(4, "candidate", "whole", ("be even, 2 to 12", range(2, 13, 2).__contains__), help=(
        "Degree of the polynomial that is learned for N, even."))
    seed: int = option(0, "candidate", "whole", help="Seed of the learning: the same seed learns the same N.")
    effort: float = option(1.0, "effort", "number", _POSITIVE, first=True, help=(
        "Scale the counted work of every stage: 1 is what two quiet cores do in about 50 s, 0.1 and 10 are quicker and "
        "more thorough. The same effort gives the same certificate, however fast or busy the machine is."))
    time_limit: float | None = option(None, "effort", "number", _ABOVE_0, metavar="SECONDS", help=(
        "Stop after SECONDS at the latest; what was found until then is checked and kept for --resume. Off by "
        "default."))
    max_boxes: int = option(4_000_000, "effort", "whole", _ABOVE_0, metavar="BOXES", help=(
        "Stop the search in the ring after this number of boxes."))
    engine: EngineName = option("bounds", "effort", "word", variable="CERTIFY_ENGINE", help=(
        "The prover of V's decrease between the local set and the boundary. bounds: branch and bound. dreal: a solver, "
        "whose word is trusted and not checked. both: bounds prove, and dReal is asked as well."))
    dreal_precision: float = option(
        1e-3, "effort", "number", ("lie between 0 and 1", lambda delta: 0 < delta < 1),
        typed="--precision", metavar="DELTA", help="The precision delta of dReal.")
    jobs: int | None = option(
        None, "effort", "whole", (f"be 1 to {_MOST_JOBS}", lambda jobs: 1 <= jobs <= _MOST_JOBS), varies=False, help=(
        "Processes of the checker, and threads of dReal. By default dReal has one thread, and the checker a process "
        "for each core where there are many leaves."))
    cluster: str | None = option(None, "effort", "word", metavar="ADDRESS", varies=False, help=(
        "Have the workers of a Dask cluster split boxes: local:N for N processes of this machine, or a scheduler's "
        "address, such as tcp://host:8786. By default the threads of this process do."))
    resume: bool = option(False, "effort", "flag", varies=False, help=(
        "Resume the search that an earlier run saved in the folder."))
    # fmt: on

    @property
    def enlarges(self) -> bool:
        """True if a tube is looked for."""
        return self.enlarge or self.box is not None or self.reach_from is not None

    @property
    def tube(self) -> str:
        """The option that asks for a tube."""
        return "reach_from" if self.reach_from is not None else "enlarge" if self.enlarge else "box"

    @property
    def learned(self) -> Beyond | None:
        """The kind of function that is learned for an outer set, if any is."""
        from certify.lyapunov import BEYOND

        return next((name for name in BEYOND if name == self.candidate), None)

    @property
    def goes_beyond(self) -> bool:
        """True if an outer set is looked for."""
        return self.lyapunov is not None or self.learned is not None

    @property
    def goes_on(self) -> bool:
        """True if the run may go on beyond the ellipsoid by itself: nothing is asked for that the ellipsoid answers."""
        asked = self.only is not None or self.P is not None or bool(self.rate) or self.engine != "bounds"
        return self.candidate == "auto" and not (asked or self.enlarges or self.goes_beyond or self.ranks)

    @property
    def beyond(self) -> str:
        """The option that asks for an outer set."""
        return "`lyapunov`" if self.learned is None else f"`candidate` {self.learned}"

    @property
    def only(self) -> Named | None:
        """The one candidate that is asked for, if P is not given; None if several are tried."""
        if self.candidate not in ("auto", "ellipsoid") and self.learned is None:
            return cast("Named", self.candidate)
        return "lqr" if self.R is not None else "lyapunov" if self.Q is not None or self.level is not None else None

    def __post_init__(self) -> None:
        for name, known in _choices().items():
            if getattr(self, name) not in known:
                raise OptionError(f"`{name}` must be one of {', '.join(known)}; found {getattr(self, name)!r}.")
        for name, one in declared(RoaOptions).items():
            one.require(getattr(self, name), OptionError)
        for breaks, why in _RULES:
            if breaks(self):
                raise OptionError(why.format(self))


def _choices() -> Mapping[str, tuple[Any, ...]]:
    from certify.lyapunov import Candidate

    kinds = {"claim": Asked, "around": Around, "candidate": Candidate, "engine": EngineName}
    return {name: get_args(kind) for name, kind in kinds.items()}


def _is_odd(o: RoaOptions) -> bool:
    """True if an option is set that says nothing of a set that is never left."""
    unset = (o.level, o.box, o.reach_from, o.Q, o.R, o.P, o.cluster)
    plain = not (o.rate or o.enlarge or o.ranks or o.resume) and o.engine == "bounds" and o.around != "rest"
    return not plain or any(v is not None for v in unset) or (o.candidate != "auto" and o.learned is None)


_Rule = tuple[Callable[[RoaOptions], bool], str]
_RULES: tuple[_Rule, ...] = (
    (
        lambda o: o.claim == "invariant" and _is_odd(o),
        "`claim` invariant has no ellipsoid: leave out what is about one (`level`, `rate`, `Q`, `R`, `enlarge`, `box`, "
        "`ranks`, `around`, `engine`, `cluster`, `resume`); the candidate is neural, polynomial or none.",
    ),
    (lambda o: o.cluster is not None and o.engine != "bounds", "`cluster` needs the engine bounds."),
    (
        lambda o: o.resume and (o.engine != "bounds" or o.P is not None or o.only is not None),
        "`resume` takes the candidate of the search; leave out `candidate`, `Q`, `R`, `level` and a P of your own, and "
        "use the engine bounds.",
    ),
    (
        lambda o: o.around == "rest" and o.claim == "asymptotic",
        "`around` rest needs another `claim` than asymptotic, under which the origin is an equilibrium.",
    ),
    (
        lambda o: o.enlarges and (o.engine == "dreal" or o.claim in ("practical", "nearby")),
        "`{0.tube}` looks for a tube, which needs the engine bounds and the claim asymptotic: it ends in a set that "
        "the checker can replay, and from which trajectories converge.",
    ),
    (
        lambda o: bool(o.rate) and (o.enlarges or o.engine != "bounds"),
        "`rate` needs the engine bounds, and a claim without a tube: leave `enlarge` and `box` out.",
    ),
    (
        lambda o: o.goes_beyond and (o.enlarges or bool(o.rate) or o.engine != "bounds"),
        "{0.beyond} needs the engine bounds, and a claim without a tube and without a rate.",
    ),
    (
        lambda o: o.ranks and (o.enlarges or o.goes_beyond or o.engine != "bounds"),
        "`ranks` needs the engine bounds, and a claim without a tube and without an outer set.",
    ),
    (
        lambda o: o.lyapunov is not None and o.learned is not None,
        "`candidate` {0.learned} learns a function; leave `lyapunov` out, or name another candidate.",
    ),
)
"""The rules between options: a test that is true if the rule is broken, and the sentence that says so."""
