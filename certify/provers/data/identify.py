"""Rounds of bounds: each makes the box of parameters smaller, and models in the smaller box are better.

First every transition stands for itself, and programs have as many unknowns as there are parameters. Then transitions
in a row share the errors of what was measured between them: the true states are unknowns as well, which makes ranges of
long runs 3 to 30 times smaller.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.certificates.data import DataBounds, Round
from certify.certificates.tree import LEAF
from certify.errors import InputError
from certify.loop.plants import Measurements, System
from certify.loop.plants.system import Interval
from certify.provers.bounds.arrays import Array
from certify.provers.data.bounds import Program, bound, joint, miss, separate
from certify.provers.data.models import Flows, Rows

_LADDER = ((2, 1), (3, 1), (4, 1), (5, 2), (6, 4), (7, 8))  # orders of the series in time, and pieces
_WORSE = 1.1  # slack of a cheaper pair, relative to the best
_PROBES, _NARROW = 64, Fraction(1, 50)  # transitions, and the share of the priors, with which pairs are compared
_ROUNDS, _JOINT_ROUNDS, _FEW = 12, 4, 2
_SHRUNK = 0.97  # least shrinking of the best range in a round that pays for another
_JOINT_ROWS = 1200  # of a program whose rows share errors
_SLACK = Fraction(1, 10**6)  # of a range's half-width, by which a checker's may differ
_SURE = 1e-9  # of a contradiction, beyond all rounding
_FAR = 4.0  # half-widths of a box by which a contradiction moves an end, beyond the other
_ENOUGH = 0.5  # share of the transitions that must have an enclosure
_MOST_PARTS, _FOR_PARTS, _ROUNDS_OF_PARTS = 96, 64, 3
_WIDE, _NO_ROWS = 4.0, 1e6  # shares of the noise, in slack, that a part's width may have; of none with rows
Box = dict[str, Interval]
Numbers = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Identified:
    """Ranges that hold every parameter with which the measurements are consistent.

    Parameters
    ----------
    ranges : the box of parameters.
    history : the box before each round, and after the last.
    measurements : the transitions on which the ranges rest.
    bounds : multipliers that show it.
    used : those transitions of all that were given, (T,).
    rows : what all transitions say in the last box, and in its units.
    turned : the intervals of the axes, where the measurements have some.
    """

    ranges: Mapping[str, Interval]
    history: tuple[Mapping[str, Interval], ...]
    measurements: Measurements
    bounds: DataBounds
    used: NDArray[np.bool_]
    rows: Rows
    turned: Mapping[str, Interval]


class Contradiction(InputError):
    """No parameter within the priors is consistent with the measurements: transitions (T,) that show it."""

    def __init__(self, transitions: tuple[int, ...]) -> None:
        self.transitions = transitions
        some = ", ".join(map(str, transitions[:6])) + (", ..." if len(transitions) > 6 else "")
        super().__init__(
            "no plant of this structure is consistent with the measurements: transitions "
            f"{some} contradict one another, whatever the parameters within their priors are."
        )


class _Box:
    """A box of parameters that rounds make smaller; `empty` if nothing is left of it."""

    def __init__(self, data: _Data, flows: Flows, box: Box) -> None:
        self.data, self.flows, self.box = data, flows, box
        self.history, self.empty = [box], False
        self.rounds = list[tuple[Numbers, Array, Box]]()

    def separately(self, chosen: Numbers, most: int) -> None:
        """At most so many rounds in which every transition stands for itself."""
        for _ in range(most):
            some, rows = self._rows(chosen)
            if not len(some) or not self._round(rows, some, separate(rows, self.flows.noise)):
                break

    def jointly(self, chosen: Numbers) -> None:
        """Rounds in which transitions in a row share errors."""
        for _ in range(_JOINT_ROUNDS):
            some, rows = self._rows(chosen)
            if not len(some) or not self._round(rows, some, joint(rows, self.flows.noise, self.data.begins[some])):
                break

    def turned(self, chosen: Numbers) -> tuple[Numbers, Array, dict[str, Interval]]:
        """Transitions and weights (2, J, n, T) with which they bound each axis, and between what it then lies."""
        noise = self.flows.noise
        some, rows = self._rows(chosen)
        program = joint(rows, noise, self.data.begins[some]) if self.data.shares else separate(rows, noise)
        axes = self.flows.on_axes(self.box)
        weights, left = np.zeros((2, len(axes), *rows.alpha.shape)), dict[str, Interval]()
        for j, (name, (middle, a)) in enumerate(axes.items()):
            size = np.abs(a).sum()
            for side, sign in enumerate((1.0, -1.0)):
                found = program.extremes(a / size, sign)
                weights[side, j] = 0.0 if found is None else size * found.reshape(rows.alpha.shape)
            ends = [bound(rows, noise, self.data.begins[some], weights[side, j], a)[side] for side in (0, 1)]
            more = float(_SLACK) * (ends[1] - ends[0])
            left[name] = Fraction(middle + ends[0] - more), Fraction(middle + ends[1] + more)
        return some, weights, left

    def _rows(self, chosen: Numbers) -> tuple[Numbers, Rows]:
        """Transitions of those that have an enclosure, and what they say."""
        rows = self.flows.rows(self.box, chosen)
        good = np.flatnonzero(rows.exist)
        return chosen[good], rows.at(good)

    def _round(self, rows: Rows, chosen: Numbers, program: Program) -> bool:
        """A round; False if it gains too little for another."""
        names, shape = list(self.box), rows.alpha.shape
        weights = np.zeros((2, len(names), *shape))
        for k in range(len(names)):
            for side, sign in enumerate((1.0, -1.0)):
                found = program.extremes(np.eye(len(names))[k], sign)
                if found is None:
                    self._end(rows, chosen, program)
                    return False
                weights[side, k] = found.reshape(shape)
        box = {name: self._narrowed(rows, chosen, weights[:, k], k) for k, name in enumerate(names)}
        gain = min(_width(box[name]) / _width(self.box[name]) for name in names)
        if gain >= 1:
            return False
        self._keep(box, chosen, weights)
        return gain < _SHRUNK and not self.empty

    def _keep(self, box: Box, chosen: Numbers, weights: Array) -> None:
        self.rounds.append((chosen, weights, box))
        self.box, self.empty = box, any(lo > hi for lo, hi in box.values())
        self.history.append(box)

    def _end(self, rows: Rows, chosen: Numbers, program: Program) -> None:
        """Show that nothing is left, if a sum of rows that contradict one another does: with a large multiple of it, a
        parameter's lower end comes above its upper end."""
        weights = program.contradiction().reshape(rows.alpha.shape)
        excess = miss(rows, self.flows.noise, self.data.begins[chosen], weights)
        if not excess > _SURE * float(np.abs(weights * rows.slack).sum()):
            return
        sign = 1.0 if (weights * rows.alpha).sum() > 0 else -1.0
        whole = np.zeros((2, len(self.box), *rows.alpha.shape))
        whole[0, 0] = -sign * weights * (_FAR / excess)
        nothing = self._narrowed(rows, chosen, whole[:, 0], 0)
        stated = {name: _outward(pair) for name, pair in self.box.items()}  # of priors, which may be any rationals
        self._keep(stated | {next(iter(self.box)): nothing}, chosen, whole)
        self.data.note(chosen, weights)

    def _narrowed(self, rows: Rows, chosen: Numbers, weights: Array, k: int) -> Interval:
        """The interval of a parameter, a little wider than what the weights show."""
        noise, begins = self.flows.noise, self.data.begins[chosen]
        lo, hi = self.box[list(self.box)[k]]
        middle, reach = (lo + hi) / 2, (hi - lo) / 2
        unit = np.eye(len(self.box))[k]
        least, most = (bound(rows, noise, begins, weights[side], unit)[side] for side in (0, 1))
        low = middle + reach * (Fraction(least) - _SLACK) if -1 < least < np.inf else lo
        high = middle + reach * (Fraction(most) + _SLACK) if -np.inf < most < 1 else hi
        return _outward((max(lo, low), min(hi, high)))


class _Data:
    """The measurements, by the numbers of their transitions, and what was found of contradictions."""

    def __init__(self, system: System, measurements: Measurements) -> None:
        self.system, self.measurements = system, measurements
        lengths = [len(run.inputs) for run in measurements.runs]
        self.count = measurements.transitions
        self.run = np.repeat(np.arange(len(lengths)), lengths)
        self.place = np.concatenate([np.arange(length) for length in lengths])  # in its run
        self.begins = np.arange(self.count) + self.run
        self.shares = max(lengths) > 1
        self.against = set[int]()

    def spread(self, most: int) -> Numbers:
        """Some transitions, from everywhere."""
        return np.unique(np.linspace(0, self.count - 1, min(most, self.count)).astype(np.intp))

    def windows(self) -> Numbers:
        """Transitions for a joint program: the beginnings of runs, of equal length, as many as it may have."""
        most = max(2, _JOINT_ROWS // self.system.n)
        runs = min(len(self.measurements.runs), most // 2)
        return np.flatnonzero((self.place < most // runs) & (self.run < runs))

    def note(self, chosen: Numbers, weights: Array) -> None:
        """Remember transitions that contradict one another."""
        self.against |= set(chosen[np.abs(weights).sum(0) > 0].tolist())


def _fitting(data: _Data, narrow: Box) -> Flows:
    """Flows with the cheapest order and pieces that do about as well as any, in a small part of the priors."""
    system, measurements, probes = data.system, data.measurements, data.spread(_PROBES)
    if system.time == "discrete":
        return Flows(system, measurements, 1, 1)
    found = list[tuple[float, Flows]]()
    for order, pieces in _LADDER:
        flows = Flows(system, measurements, order, pieces)
        rows = flows.rows(narrow, probes)
        if np.mean(rows.exist) >= _ENOUGH:
            errors = np.abs(rows.slopes[:, : system.n]).sum(1) + flows.noise[:, None]
            found.append((float(np.nanmedian((rows.slack + errors).sum(0))), flows))
    if not found:
        raise InputError(
            "the flow over most transitions has no enclosure, even for narrow priors: look at the units of the "
            "measurements and at the period, or measure more often."
        )
    least = min(slack for slack, _ in found)
    return next(flows for slack, flows in found if slack <= _WORSE * least)


def _parts(data: _Data, flows: Flows, narrow: Box) -> tuple[bytes, list[_Box]]:
    """A partition of the priors into boxes that are narrow enough, or that their rounds make narrow enough, for rows
    in which the box's width counts little beside the noise; as far as there may be so many."""
    tree, found, waiting, probes = bytearray(), list[_Box](), [dict(data.measurements.priors)], data.spread(_PROBES)
    middle = flows.rows(narrow, probes)
    base = middle.slack + np.abs(middle.slopes[:, : data.system.n]).sum(1) + flows.noise[:, None]
    while waiting:
        box = waiting.pop()
        part = _Box(data, flows, box)
        part.separately(data.spread(_FOR_PARTS), _ROUNDS_OF_PARTS)
        left = 0.0 if part.empty else _width_counts(flows, part.box, probes, base)
        if left <= _WIDE or len(found) + len(waiting) >= _MOST_PARTS:
            tree.append(LEAF)
            found.append(part)
            continue
        halves = [_halved(box, name) for name in box]
        counts = [sum(_width_counts(flows, half, probes, base) for half in pair) for pair in halves]
        axis = min(range(len(halves)), key=lambda k: (counts[k], -_relative(list(box.values())[k])))
        tree.append(axis)
        waiting += reversed(halves[axis])
    return bytes(tree), found


def _width_counts(flows: Flows, box: Box, probes: Numbers, base: Array) -> float:
    """The share that a box's width has in the slack of most transitions, beside noise; large where there is none."""
    slack = flows.rows(box, probes).slack / base
    return min(_NO_ROWS, float(np.median(np.where(np.isfinite(slack), slack, np.inf).max(0))))


@dataclass(frozen=True)
class Search:
    """The rounds in the parts of the priors, and those about the box around what is left of them."""

    data: _Data
    flows: Flows
    tree: bytes
    parts: list[_Box]
    whole: _Box

    @classmethod
    def of(cls, system: System, measurements: Measurements) -> Search:
        """Bound the parameters.

        Raises
        ------
        Contradiction : no parameter within the priors is consistent with the measurements.
        InputError : measurements are not of this plant, or the flow over them has no enclosure.
        """
        require_measurable(system, measurements)
        data = _Data(system, measurements)
        narrow = {name: _shrunk(pair) for name, pair in measurements.priors.items()}
        flows = _fitting(data, narrow)
        tree, parts = _parts(data, flows, narrow)
        left = [part.box for part in parts if not part.empty]
        if not left:
            raise Contradiction(tuple(sorted(data.against)))
        hull = {name: (min(box[name][0] for box in left), max(box[name][1] for box in left)) for name in narrow}
        whole = _narrowed(data, flows, hull)
        if whole.empty:
            raise Contradiction(tuple(sorted(data.against)))
        return cls(data, flows, tree, parts, whole)


def _narrowed(data: _Data, flows: Flows, box: Box, most: int = _ROUNDS) -> _Box:
    """The rounds about a box, of all transitions; at most so many in which every transition stands for itself."""
    whole = _Box(data, flows, box)
    whole.separately(np.arange(data.count), most)
    if data.shares and not whole.empty:
        whole.jointly(data.windows())
    return whole


def refuted_in(measurements: Measurements, flows: Flows, box: Box) -> bool:
    """True if a few rounds show that the measurements contradict one another for all parameters in a box."""
    return _narrowed(_Data(flows.system, measurements), flows, box, _FEW).empty


def misses(system: System, measurements: Measurements) -> Array:
    """By how much a transition misses what equations and errors explain at the middle of the priors, at most, (n,)."""
    data, narrow = _Data(system, measurements), {name: _shrunk(pair) for name, pair in measurements.priors.items()}
    flows = _fitting(data, narrow)
    rows = flows.rows(narrow, np.arange(data.count))
    rows = rows.at(np.flatnonzero(rows.exist))
    miss = np.abs(rows.alpha) - rows.slack - np.abs(rows.slopes).sum(1) - flows.noise[:, None]
    most: Array = miss.max(1, initial=0.0)
    return most


def identify(system: System, measurements: Measurements, narrows: bool = True) -> Identified:
    """Bound the parameters of a plant by measurements, and their axes where the measurements have some.

    With `narrows` it is an error that no prior becomes smaller.

    Raises
    ------
    Contradiction : no parameter within the priors is consistent with the measurements.
    InputError : measurements are not of this plant, the flow over them has no enclosure, or they narrow no prior.
    """
    search = Search.of(system, measurements)
    same = all(_width(pair) >= _width(measurements.priors[name]) for name, pair in search.whole.box.items())
    if narrows and same and not measurements.axes:
        raise InputError(
            f"the measurements narrow no prior, in {len(search.parts)} parts of the priors: write the equations linear "
            "in the parameters, a quotient of two as one, narrow the priors, or measure more often."
        )
    return _found(search)


def require_measurable(system: System, measurements: Measurements) -> None:
    """Refuse measurements that are not of this plant.

    Raises
    ------
    InputError : a parameter has no range in the plant, states or inputs are not as many, there is no transition, one
        has no time in continuous time or one in discrete time, or equations call a network.
    """
    odd = [name for name in measurements.constants if name not in system.ranges]
    if odd:
        raise InputError(f"{system.name} must have a range for {', '.join(odd)}, which measurements are to determine.")
    shapes = {run.inputs.shape[1:] for run in measurements.runs}
    if len(measurements.noise) != system.n or shapes != {(system.m,)}:
        raise InputError(f"measurements must be transitions of {system.n} states and {system.m} inputs.")
    if (measurements.period is None) is not (system.time == "discrete"):
        raise InputError("a transition must have a period in continuous time, and none in discrete time.")
    if system.calls:
        raise InputError(f"equations of {system.name} must not call a network, where its parameters come from data.")


def _found(search: Search) -> Identified:
    """All that the rounds have found, with the transitions alone that they use."""
    data, flows, parts, whole = search.data, search.flows, search.parts, search.whole
    used = np.zeros(data.count, dtype=bool)
    along = whole.turned(data.windows() if data.shares else np.arange(data.count)) if data.measurements.axes else None
    of_axes = [] if along is None else [along]
    for chosen, weights, _ in (*of_axes, *(each for part in (*parts, whole) for each in part.rounds)):
        used[chosen[np.any(weights != 0, axis=(0, 1, 2))]] = True

    def stored(part: _Box) -> tuple[Round, ...]:
        return tuple(Round(_corners(box), _stored(chosen, weights, used)) for chosen, weights, box in part.rounds)

    turned = None if along is None else _stored(along[0], along[1], used)
    bounds = DataBounds(flows.order, flows.pieces, search.tree, tuple(map(stored, parts)), stored(whole), turned)
    rows, kept = flows.rows(whole.box, np.arange(data.count)), data.measurements.only(used)
    history = (dict(data.measurements.priors), *whole.history)
    return Identified(whole.box, history, kept, bounds, used, rows, {} if along is None else along[2])


def _stored(chosen: Numbers, weights: Array, used: NDArray[np.bool_]) -> Array:
    """Weights (2, K, n, T) of some transitions as those (2, K, T, n) of all that are used."""
    place, own = np.cumsum(used) - 1, used[chosen]
    whole = np.zeros((*weights.shape[:2], int(used.sum()), weights.shape[2]))
    whole[:, :, place[chosen[own]]] = weights[..., own].swapaxes(2, 3)
    return whole


def _corners(box: Box) -> Array:
    """Lower and upper ends, (2, K), which are binary64 numbers already."""
    return np.array([[float(end) for end in pair] for pair in box.values()]).T


def _width(pair: Interval) -> Fraction:
    return pair[1] - pair[0]


def _below(q: Fraction) -> Fraction:
    """The largest binary64 number that is not above a rational."""
    nearest = float(q)
    return Fraction(nearest if Fraction(nearest) <= q else np.nextafter(nearest, -np.inf))


def _outward(pair: Interval) -> Interval:
    """The least interval that holds this one and has binary64 ends."""
    return _below(pair[0]), -_below(-pair[1])


def _relative(pair: Interval) -> float:
    """The width relative to the size."""
    return float(_width(pair) / max(abs(pair[0]), abs(pair[1])))


def _shrunk(pair: Interval) -> Interval:
    middle, reach = (pair[0] + pair[1]) / 2, _width(pair) * _NARROW / 2
    return middle - reach, middle + reach


def _halved(box: Box, name: str) -> tuple[Box, Box]:
    lo, hi = box[name]
    return box | {name: (lo, (lo + hi) / 2)}, box | {name: ((lo + hi) / 2, hi)}
