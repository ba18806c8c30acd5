"""A plant of which no equation is known, `x' = A x + B u + r`, as a plant's file: the structure `linear`.

Every entry of A and B is a parameter with a prior range, and what is beyond the linear part is bounded by declared
functions: |r_i| <= sum_k |e_ik(x, u)|, where half of a bound of the second derivatives times the squares would do
(Taylor's theorem). Where a step has a time, a state NAME with a state NAME_dot beside it has that derivative.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from certify.analysis.identifying.reading import numbers
from certify.analysis.identifying.writing import pair_text
from certify.analysis.tables import NEXT, RUN, read_table
from certify.certificates import write_atomically
from certify.errors import InputError, OptionError
from certify.loop.expressions import Expression, Operation, numerical, symbols
from certify.loop.expressions.tree import text
from certify.loop.plants.equations import parse_expression
from certify.loop.plants.system import Interval
from certify.loop.plants.unknown import beyond_name

Array = NDArray[np.float64]
_DOT = "_dot"
_WIDER, _SHARE = 4, Fraction(1, 5)  # of what least squares leave, and of their values, which a prior reaches beyond
Range = Fraction | Interval


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearStructure:
    """A plant without a model: `x' = A x + B u + r`, in discrete time the next state.

    Parameters
    ----------
    second : by state, a bound of what its equation has beyond A x + B u, as text in states and inputs, such as
        "10*theta*theta". Each term of a sum is bounded separately; signs are ignored. A state without one is linear.
    prior : ranges of entries of A and B, half-widths or intervals, by the entry's name, such as A21, or by state those
        of its row. By default four times as wide as what bounded errors leave of least squares, and a fifth of the
        values more: an assumption all the same, which the claim says.
    domain, input_bounds : by name half-widths or intervals; by default as far as the data reach.
    without : states that the equations do not contain, such as a position.
    inputs : columns of inputs, where the file does not say: without columns NAME_next.
    states : names of the states of a file without names, .npz; x1 to xn by default.
    """

    second: Mapping[str, str]
    prior: Mapping[str, Range] = field(default_factory=dict)
    domain: Mapping[str, Range] = field(default_factory=dict)
    input_bounds: Mapping[str, Range] = field(default_factory=dict)
    without: Sequence[str] = ()
    inputs: Sequence[str] = ()
    states: Sequence[str] = ()


def structure_for(
    data: Path | None,
    structure: Path,
    linear: LinearStructure | None,
    out: Path,
    period: Range | None,
    noise: Fraction | Mapping[str, Fraction],
) -> Path:
    """The structure's file: the one that is named, or for `linear` one that is written beside `out`.

    Raises
    ------
    InputError : as `linear_structure` says, or options of the structure `linear` are given with another.
    """
    if structure != Path("linear"):
        if linear is not None:
            raise OptionError("`second` and what goes with it are for the `structure` linear.")
        return structure
    if data is None or linear is None:
        raise OptionError("the `structure` linear takes a file of measurements, and `second` for a state at least.")
    path = out.with_name(f"{out.stem}_structure.toml")
    write_atomically(path, linear_structure(data, linear, period, noise).encode())
    return path


def linear_structure(
    data: Path, given: LinearStructure, period: Range | None, noise: Fraction | Mapping[str, Fraction]
) -> str:
    """The text of a plant's file, TOML, for measurements in a file.

    Raises
    ------
    InputError : the file cannot be read, names nothing that is given, or a bound is no expression in states and inputs.
    """
    found = _columns(data, given)
    for option, names, known in (
        ("second", given.second, found.states),
        ("domain", given.domain, found.states),
        ("input_bounds", given.input_bounds, found.inputs),
        ("without", given.without, found.states),
    ):
        odd = next((name for name in names if name not in known), None)
        if odd is not None:
            raise OptionError(f"`{option}` names {odd!r}; {data.name} has {', '.join(known)}.")
    step = period if period is None or isinstance(period, Fraction) else period[1]
    return "\n".join(_lines(given, found, step, noise)) + "\n"


@dataclass(frozen=True, slots=True)
class _Columns:
    """Names, and the measured states (N, n), inputs (N, m) and next states (N, n) of all transitions."""

    states: list[str]
    inputs: list[str]
    x: Array
    u: Array
    x_next: Array

    @property
    def values(self) -> dict[str, Array]:
        return dict(zip([*self.states, *self.inputs], np.hstack([self.x, self.u]).T, strict=True))


def _lines(
    given: LinearStructure, data: _Columns, step: Fraction | None, noise: Fraction | Mapping[str, Fraction]
) -> Iterator[str]:
    states, inputs = data.states, data.inputs
    known = [] if step is None else [s for s in states if f"{s}{_DOT}" in states]
    rows = [s for s in states if s not in known or s in given.second]
    columns = [s for s in states if s not in given.without]
    entries = {s: _entries(k, columns, inputs, states) for k, s in enumerate(states) if s in rows}
    terms = {s: terms_of(given.second[s], [*states, *inputs], s) for s in given.second}
    priors = _priors(data, entries, terms, step, noise)
    odd = next((p for p in given.prior if p not in entries and p not in priors), None)
    if odd is not None:
        raise OptionError(f"`prior` names {odd!r}; there are {', '.join([*entries, *priors])}.")
    yield "# a plant of which no equation is known: every entry of A and B, and what is beyond them"
    yield 'name = "linear"'
    yield f'time = "{"discrete" if step is None else "continuous"}"'
    yield f"states = [{', '.join(map(_text, states))}]"
    yield f"inputs = [{', '.join(map(_text, inputs))}]"
    yield "\n[parameters] # priors"
    for s, own in entries.items():
        for name, by in own.items():
            prior = given.prior.get(name, given.prior.get(s, priors[name]))
            yield f"{name} = {pair_text(_interval(prior))} # of {s} by {by}"
    yield "\n[disturbances] # what is beyond A x + B u, as shares of its bound"
    yield from (f"{beyond_name(s, k)} = [-1, 1]" for s, of in terms.items() for k in range(1, len(of) + 1))
    yield "\n[dynamics]"
    for s in states:
        linear = [f"{name}*{by}" for name, by in entries.get(s, {}).items()]
        beyond = [f"{beyond_name(s, k)}*({text(e)})" for k, e in enumerate(terms.get(s, ()), 1)]
        yield f"{s} = {_text(' + '.join([*linear, *beyond]) if s in entries else s + _DOT)}"
    yield "\n[u_eq]"
    yield from (f"{u} = 0" for u in inputs)
    for table, names, bounds in (("domain", states, given.domain), ("input_bounds", inputs, given.input_bounds)):
        yield f"\n[{table}]"
        for name in names:
            reach = _above(float(np.max(np.abs(data.values[name]))))
            yield f"{name} = {pair_text(_interval(bounds.get(name, reach)))}"


def _priors(
    data: _Columns,
    entries: Mapping[str, Mapping[str, str]],
    terms: Mapping[str, Sequence[Expression]],
    step: Fraction | None,
    noise: Fraction | Mapping[str, Fraction],
) -> dict[str, Interval]:
    """Ranges of the entries around least squares.

    An error e of the targets, |e_k| <= w_k, moves the fit of `target = X a` by at most sum_k |X^+|_jk w_k in entry j,
    whatever it is: here w has the noise of both ends and what is declared beyond the linear part.
    """
    found, h = dict[str, Interval](), 1.0 if step is None else float(step)
    middle = data.x if step is None else (data.x + data.x_next) / 2
    values = dict(zip([*data.states, *data.inputs], np.hstack([middle, data.u]).T, strict=True))
    for s, own in entries.items():
        k = data.states.index(s)
        X = np.column_stack([values[by] for by in own.values()])
        if np.linalg.matrix_rank(X) < X.shape[1]:
            raise InputError(f"the data must move {', '.join(own.values())} in all directions; give `prior` for {s}.")
        target = data.x_next[:, k] if step is None else (data.x_next[:, k] - data.x[:, k]) / h
        inverse, w = np.linalg.pinv(X), 2 * float(noise[s] if isinstance(noise, Mapping) else noise) / h
        beyond = [np.abs(numerical([e], list(symbols(list(values))))(*values.values())[0]) for e in terms.get(s, ())]
        fit, left = inverse @ target, np.abs(inverse) @ (w + sum(beyond, np.zeros(len(X))))
        for name, a, r in zip(own, fit.tolist(), left.tolist(), strict=True):
            half = _above(_WIDER * r + float(_SHARE) * abs(a))
            middle_of = Fraction(round(Fraction(a) / half * 100), 100) * half
            found[name] = middle_of - half, middle_of + half
    return found


def _entries(row: int, columns: Sequence[str], inputs: Sequence[str], states: Sequence[str]) -> dict[str, str]:
    """Names of the entries of a row of A and B, by what they multiply."""
    between = "_" if max(len(states), len(inputs)) > 9 else ""
    of_A = {f"A{row + 1}{between}{states.index(s) + 1}": s for s in columns}
    return of_A | {f"B{row + 1}{between}{k + 1}": u for k, u in enumerate(inputs)}


def terms_of(bound: str, names: Sequence[str], state: str) -> list[Expression]:
    """The terms of a bound, without abs around factors, which have no corner then."""
    try:
        e = parse_expression(bound, dict(zip(names, symbols(list(names)), strict=True)))
    except InputError as error:
        raise OptionError(f"`second` of {state}: {error}") from error
    parts = e.operands if isinstance(e, Operation) and e.operator == "+" else (e,)
    return [_smooth(part) for part in parts]


def _smooth(e: Expression) -> Expression:
    """An expression of the same size at each point, with v instead of each factor abs(v)."""
    if isinstance(e, Operation) and e.operator == "abs":
        return _smooth(e.operands[0])
    if isinstance(e, Operation) and e.operator == "*":
        return Operation("*", *map(_smooth, e.operands))
    return e


def _columns(data: Path, given: LinearStructure) -> _Columns:
    table = read_table(data, given.states, given.inputs)
    own = [name for name in table.columns if name != RUN and not name.endswith(NEXT)]
    states = [name for name in own if f"{name}{NEXT}" in table.columns]
    if not (states or given.inputs or table.inputs):
        raise OptionError(f"`inputs` must say which columns of {data.name} are inputs, of {', '.join(own)}.")
    inputs = list(given.inputs or table.inputs) or [name for name in own if name not in states]
    odd = next((name for name in inputs if name not in own), None)
    if odd is not None:
        raise OptionError(f"`inputs` names {odd!r}; {data.name} has the columns {', '.join(own)}.")
    single, states = bool(states), states or [name for name in own if name not in inputs]
    x, u = numbers(table, states), numbers(table, inputs)
    if single:
        return _Columns(states, inputs, x, u, numbers(table, [f"{s}{NEXT}" for s in states]))
    kept = [k for first, last in table.stretches() for k in range(first, last - 1)]
    return _Columns(states, inputs, x[kept], u[kept], x[[k + 1 for k in kept]])


def _above(size: float) -> Fraction:
    """A number of three digits at or above a size."""
    if not 0 < size < np.inf:
        return Fraction(1)
    scale = Fraction(10) ** (int(np.floor(np.log10(size))) - 2)
    return -(-Fraction(size) // scale) * scale


def _interval(value: Range) -> Interval:
    return value if isinstance(value, tuple) else (-value, value)


def _text(of: str) -> str:
    return f'"{of}"'
