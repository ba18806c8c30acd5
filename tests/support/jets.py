"""Jets for the checker's tests: models that somebody writes down, as plain numbers, and what they say at a point, in
ball arithmetic."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import combinations_with_replacement
from types import SimpleNamespace
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from flint import arb, fmpq, fmpq_mat

from certify.checker import ball, jets, pairs, ranges, tube
from certify.checker.decrease import Inequality, Level, Models, Multipliers
from certify.checker.jets import Units
from certify.checker.near import ZERO, Above, Cubic, Near, Square, Tensor, Vector
from certify.checker.network import Folded
from certify.checker.sections import Path
from certify.checker.stepping import OfStep
from tests.support.oracle import quadratic
from tests.support.plain import top


def bound(x: Any) -> Above:
    """An upper bound, exact where it is 0."""
    return ZERO if np.all(np.asarray(x) == 0) else Above(np.asarray(x, dtype=np.float64))


_FAMILIES: WeakValueDictionary[tuple[Any, ...], Units] = WeakValueDictionary()


def family(U: Any) -> Units:
    """The errors within U (m, k, k): those of one family for equal bounds, as long as some jet has them."""
    if isinstance(U, Units):
        return U
    U = np.ascontiguousarray(U, dtype=np.float64)
    return _FAMILIES.setdefault((U.shape, U.tobytes()), Units(np.moveaxis(U, 0, -1)))


class Jet:
    """A jet of the checker as numbers: `c` +- `error`, `a` (k,) +- `slack`, `Q` (k, k), `K` as triples, remainder `E`
    (k, k), `B` (m,) of the errors within `U` (m, k, k), or of a family, `c_y` (N,) and `a_y` (N, k), and `lip`."""

    def __init__(
        self, c: Any, error: Any, a: Any, slack: Any, Q: Any, K: Any, E: Any, B: Any, U: Any, c_y: Any, a_y: Any,
        lip: Any = 0.0,
    ) -> None:  # fmt: skip
        Q, E, a_y = (np.asarray(v, dtype=np.float64) for v in (Q, E, a_y))
        self.model: jets.Jet = jets.Jet(
            Near(np.float64(c), bound(error)), Vector(np.asarray(a, dtype=np.float64), bound(slack)), Square(Q),
            Cubic(np.asarray(K, dtype=np.float64)), Square(E), Near(np.asarray(B, dtype=np.float64)), family(U),
            bound(lip),
        )  # fmt: skip
        if len(c_y):
            self.model = ranges.Swayed.of(self.model, Near(np.asarray(c_y, dtype=np.float64)), Vector(a_y.T))

    @classmethod
    def of(cls, model: jets.Jet) -> Jet:
        made = cls.__new__(cls)
        made.model = model
        return made

    def __getattr__(self, name: str) -> Any:
        """`error`, `slack`, `lip`, `radius`, `curve`, `twist`, `bend`, `sway`, `tilt` as numbers."""
        if name == "model":
            raise AttributeError(name)
        with np.errstate(all="ignore"):
            nothing = ZERO if name in ("sway", "tilt") else None  # of what knows nothing of y
            found = top(getattr(self.model, "lipschitz" if name == "lip" else name, nothing))
        return found if np.ndim(found) else float(found)

    @property
    def c(self) -> Any:
        return self.model.c.value

    @property
    def a(self) -> Any:
        return self.model.a.value

    @property
    def Q(self) -> Any:
        return self.model.Q.value

    @property
    def K(self) -> Any:
        return self.model.K.value

    @property
    def B(self) -> Any:
        return self.model.B.value

    @property
    def U(self) -> Any:
        return np.moveaxis(self.model.units.U, -1, 0)

    @property
    def c_y(self) -> Any:
        return self.model.c_y.value if isinstance(self.model, ranges.Swayed) else np.zeros(0)

    @property
    def a_y(self) -> Any:
        return self.model.a_y.value.T if isinstance(self.model, ranges.Swayed) else np.zeros((0, len(self.a)))

    @property
    def E(self) -> Any:
        with np.errstate(all="ignore"):
            return self.model.remainder

    @property
    def whole(self) -> Any:
        """A bound of the remainder and of sum_j B_j e_j, as a matrix."""
        with np.errstate(all="ignore"):
            return self.model.whole.wider(self.model.Q.error + self.model.K.error).majorant

    @property
    def size(self) -> Any:
        return top(self.model.v0.size)

    def __add__(self, other: Jet) -> Jet:
        return Jet.of(self.model + other.model)

    def __neg__(self) -> Jet:
        return Jet.of(-self.model)

    def __mul__(self, other: Jet) -> Jet:
        return Jet.of(self.model * other.model)

    def function(self, name: str) -> Jet:
        return Jet.of(self.model.function(name))


def seen(models: Iterable[jets.Jet]) -> list[Jet]:
    """Jets of the checker as numbers."""
    return [Jet.of(model) for model in models]


def members(batch: jets.Jet) -> list[Jet]:
    """The jets of a batch as numbers."""
    count = len(batch.c.value)
    parts = (batch.c, batch.a, batch.Q, batch.K, batch.E)
    return [
        Jet.of(jets.Jet(*(part[j] for part in parts), batch.B[..., j], batch.units, batch.lip[j])) for j in range(count)
    ]


def enclose_on_ball(net: Folded, states: Sequence[jets.Jet]) -> jets.Jet:
    """The network's value on a ball, centred, and squashed if the policy is, as a batch of jets."""
    h = ball.OnBall(len(states[0].a.value)).value(net.network, states, net.origin, net.shift)
    return h.function("tanh") if net.squash else h


def constant(q: Fraction, U: Any, count: int) -> Jet:
    return Jet.of(ranges.in_y(jets.constant(q, family(U)), count) if count else jets.constant(q, family(U)))


def uncertain(lo: Fraction, hi: Fraction, U: Any, number: int, count: int) -> Jet:
    return Jet.of(ranges.uncertain(lo, hi, family(U), number, count))


def between(lo: Fraction, hi: Fraction, U: Any, count: int) -> Jet:
    return Jet.of(ranges.in_y(ranges.between(lo, hi, family(U)), count))


def plain(c: Any, error: Any, a: Any, slack: Any, Q: Any, E: Any, K: Any = None) -> Jet:
    """A model without the errors of inputs, and, if no K is given, without one."""
    k = len(a)
    thirds = np.zeros(k * (k + 1) * (k + 2) // 6) if K is None else np.array(K, float)
    return Jet(c, error, a, slack, Q, thirds, E, np.zeros(1), np.zeros((1, k, k)), np.zeros(0), np.zeros((0, k)))


def given(jet: Jet, y: Sequence[Any]) -> Jet:
    """The model where what is uncertain has these y: v(0) and the gradient in binary64, and that rounding apart."""
    y = [float(v) for v in y]
    c, a = jet.c + np.dot(y, jet.c_y), jet.a + np.tensordot(y, jet.a_y, 1)
    lost = (len(y) + 4) * 2.0**-50
    error = jet.error + lost * (abs(jet.c) + np.abs(jet.c_y).sum())
    slack = jet.slack + lost * (np.linalg.norm(jet.a) + np.linalg.norm(jet.a_y))
    nothing = np.zeros(0), np.zeros((0, len(a)))
    return Jet(c, error, a, slack, jet.Q, jet.K, jet.E, jet.B, jet.model.units, *nothing, jet.lip)


def units_of(L: Any, R: Any) -> Units:
    """Remainders R (N, k, k), and how they reach the inputs."""
    return Units(np.moveaxis(np.asarray(R), 0, -1), np.asarray(L))


def no_units(k: int) -> Units:
    """Of one input that no tanh reaches."""
    return units_of(np.zeros((1, 0)), np.zeros((0, k, k)))


def curved(jet: Jet, d: Sequence[Any]) -> arb:
    """d'Q d + K[d]; K has its entries h <= i <= j, each as often as its indices have orders."""
    value, times = quadratic(jet.Q.tolist(), d), {1: 1, 2: 3, 3: 6}
    kept = combinations_with_replacement(range(len(jet.a)), 3)
    for (h, i, j), entry in zip(kept, jet.K.tolist(), strict=True):
        value += times[len({h, i, j})] * arb(entry) * arb(d[h]) * arb(d[i]) * arb(d[j])
    return value


def changed(jet: Jet, **parts: Any) -> Jet:
    """The same jet but for these parts."""
    parts.setdefault("U", jet.model.units)
    names = ("c", "error", "a", "slack", "Q", "K", "E", "B", "U", "c_y", "a_y", "lip")
    return Jet(*(parts.get(name, getattr(jet, name)) for name in names))


def models_of(J: Any, F: Iterable[Jet], units: Units, rest: bool, velocity: Sequence[Any] = ()) -> Models:
    """The models of these jets in the inequality, their errors being sums over these units."""
    return Models(J, [replace(f.model, units=units) for f in F], rest, velocity)


def inequality(
    models: Models,
    P: fmpq_mat,
    R: fmpq_mat,
    by: Multipliers,
    path: Path | None = None,
    h: fmpq | None = None,
    beyond: fmpq | None = None,
    level: Level | None = None,
) -> Inequality:
    """The checker's inequality of models: of a step of length h, whose Gamma is `beyond`, if that is positive."""
    if path is not None:
        return tube.inequality(models, P, R, by, path)
    if not h:
        return Inequality(models, P, R, by, level)
    made = OfStep(models, P, R, by, level)
    made.h, models.beyond = h, beyond or fmpq(0)
    return made


def sides(*parts: Any) -> tuple[fmpq_mat, fmpq_mat]:
    """The decay and the rest of such an inequality."""
    return inequality(*parts).sides()


def shows(*parts: Any) -> bool:
    """Whether it holds."""
    return inequality(*parts).holds


def remainders(units: Units) -> Any:
    """R (N, k, k) of the units."""
    return np.moveaxis(units.R, -1, 0)


def bound_of_pairs(p: Any, wrong: Any, T: Any, wrong_T: Any, weight: Any) -> Any:
    """S for p (N, k) and T (N, r, k), each within its error."""
    return pairs.bound_of_pairs(Vector(p.T, Above(wrong)), Tensor(T.transpose(2, 1, 0), Above(wrong_T)), weight)


def beyond_tangent(jet: Jet, f: Sequence[float], third: float, fourth: float) -> tuple[Any, Any, Any]:
    """H, C and R (a matrix) of a function whose expansion is given."""
    phi = SimpleNamespace(f=[Near(np.float64(v)) for v in f], third=Above(third), fourth=Above(fourth), last=Above(0.0))
    H, C, R = jet.model.beyond_tangent(phi)
    return H.value, C.value, R.wider(H.error + C.error).majorant
