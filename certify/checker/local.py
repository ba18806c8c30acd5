"""Second-order models on the unit ball: what the local rule evaluates the plant and the policy in.

A jet of v over d in R^n says, for *all* ||d|| <= 1: `v(d) = v(0) + a.d + d'Q d + r(d)` with |r(d)| <= d'E d. It
holds on every smaller ball too. v(0) lies within `error` of c, and the true gradient within `slack` of a in the 2-norm;
Q is the matrix that is stored, and whatever it leaves out lies in E. E dominates a sum of positive semidefinite
matrices with weights >= 0, so it is one, and knows the directions in which v is far from its linearisation.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from .arithmetic import Number, carry, frobenius, is_ball, largest, lesser, norm, product, sin_cos, tanh, total, up
from .errors import Rejected
from .float64 import EPS, float_with_error, gamma
from .network import Folded

_MOST_NUMBERS = {"float64": 2**25, "arb": 2**22}  # in the matrices of all jets, or of a layer and the paths to it
_MOST_PRODUCTS = {"float64": 2**33, "arb": 2**28}  # in the sums over paths


def widen(E: Number, extra: Number, relative: float = EPS) -> Number:
    """E (..., n, n) enlarged by its own rounding errors, at most `relative` a term, and by `extra` ||d||^2.

    E sums semidefinite matrices with weights >= 0. The Frobenius norm of each is at most its trace, so the 2-norm of
    all rounding errors is at most `relative` times the trace of the sum.
    """
    trace = total(np.diagonal(E, axis1=-2, axis2=-1), -1)
    return E + _each(up(2 * relative * trace + extra)) * np.eye(E.shape[-1])


def _each(x: Number) -> Number:
    """Numbers (...,) as factors of matrices (..., n, n)."""
    return np.asarray(x)[..., None, None]


def _outer(a: Number, b: Number) -> Number:
    return a[..., :, None] * b[..., None, :]


@dataclass(frozen=True)
class Jet:
    """`c` +- `error`, gradient `a` (n,) +- `slack`, half the Hessian `Q` (n, n), remainder `E` (n, n); or a batch."""

    c: Number
    error: Number
    a: Number
    slack: Number
    Q: Number
    E: Number

    @property
    def size(self) -> Number:
        """Upper bound of |v(0)|."""
        return up(abs(self.c) + self.error)

    @property
    def slope(self) -> Number:
        """Upper bound of the gradient's 2-norm."""
        return up(norm(self.a, -1) + self.slack)

    @property
    def bend(self) -> Number:
        """Upper bound of ||Q||_2."""
        return frobenius(self.Q)

    @property
    def curve(self) -> Number:
        """Upper bound of |v(d) - v(0) - a.d| / ||d||^2, a being the true gradient."""
        return up(self.bend + frobenius(self.E))

    @property
    def radius(self) -> Number:
        """Upper bound of |v(d) - v(0)| / ||d|| on the unit ball."""
        return up(self.slope + self.curve)

    def __add__(self, other: Jet) -> Jet:
        x, y = self, other
        c = x.c + y.c
        error = up(x.error + y.error + EPS * abs(c))
        slack = up(x.slack + y.slack + EPS * (x.slope + y.slope))
        return Jet(c, error, x.a + y.a, slack, x.Q + y.Q, widen(x.E + y.E, EPS * (x.bend + y.bend)))

    def __neg__(self) -> Jet:
        return Jet(-self.c, self.error, -self.a, self.slack, -self.Q, self.E)

    def __mul__(self, other: Jet) -> Jet:
        x, y = self, other
        c = x.c * y.c
        error = up(x.size * y.error + y.size * x.error + EPS * abs(c))
        slack = up(
            x.size * y.slack + x.error * y.slope + y.size * x.slack + y.error * x.slope
            + EPS * (x.size * y.slope + y.size * x.slope)
        )  # fmt: skip
        outer = _outer(x.a, y.a)
        Q = x.c * y.Q + y.c * x.Q + (outer + outer.T) / 2
        # (x.a.d) s_y + (y.a.d) s_x + s_x s_y, s what each adds to its linearisation: |s| <= d'(bend I + E)d
        third = x.radius * y.bend + y.slope * x.bend
        wrong = x.error * y.bend + y.error * x.bend + x.slack * y.slope + y.slack * x.slope
        wrong = wrong + EPS * (x.size * y.bend + y.size * x.bend + x.slope * y.slope)
        E = widen((x.size + x.radius) * y.E + (y.size + y.slope) * x.E, third + wrong)
        return Jet(c, error, x.c * y.a + y.c * x.a, slack, Q, E)

    def beyond_tangent(self, half: Number, half_error: Number, third: Number) -> tuple[Number, Number]:
        """(H, R): phi(v) less its tangent at v(0) is d'H d within d'R d.

        half is phi''/2 at v(0), within half_error; third >= |phi'''| on the range. With delta = v - v(0) what is left
        is half delta^2 within third/6 |delta|^3, where |delta| <= radius and, a being the true gradient, |delta^2 -
        (a.d)^2| <= (2 slope + curve) d'(bend I + E)d.
        """
        cubic = up(third * self.radius / 6)
        square = up(np.abs(half) + half_error + cubic)
        spread = up(square * (2 * self.slope + self.curve))
        outer = _outer(self.a, self.a)
        wrong = up(half_error + EPS * np.abs(half)) * self.slope * self.slope + 2 * up(square * self.slope) * self.slack
        R = widen(_each(spread) * self.E + _each(cubic) * outer, spread * self.bend + wrong)
        return _each(half) * outer, R

    def _compose(self, f: tuple[Number, ...], errors: tuple[Number, ...], most: tuple[Number, ...]) -> Jet:
        """phi(v): phi, phi', phi'' at c within `errors`; |phi'|, |phi''|, |phi'''| at most `most` on the range of v."""
        x = self
        first_error, second_error = up(errors[1] + most[1] * x.error), up(errors[2] + most[2] * x.error)
        H, R = x.beyond_tangent(f[2] / 2, second_error / 2, most[2])
        slack = first_error * x.slope + abs(f[1]) * x.slack + EPS * (abs(f[1]) * x.slope)
        wrong = first_error * x.bend + EPS * (abs(f[1]) * x.bend + frobenius(H))
        Q, E = f[1] * x.Q + H, widen((abs(f[1]) + first_error) * x.E + R, wrong)
        return Jet(f[0], up(errors[0] + most[0] * x.error), f[1] * x.a, up(slack), Q, E)

    def inv(self) -> Jet:
        """1/v; NaN unless the range of v certainly excludes 0."""
        least = abs(self.c) - up(self.error + self.radius)
        least = least if least > 0 else np.float64(np.nan)
        f0 = 1 / self.c
        f = (f0, -f0 * f0, 2 * f0 * f0 * f0)
        first = up(1 / least * (1 / least))
        second = up(2 * first / least)
        return self._compose(f, tuple(EPS * abs(v) for v in f), (first, second, up(3 * second / least)))

    def sin(self) -> Jet:
        s, c, s_error, c_error = sin_cos(self.c)
        most = (1.0, self._most(s, s_error), self._most(c, c_error))
        return self._compose((s, c, -s), (s_error, c_error, s_error), most)

    def cos(self) -> Jet:
        s, c, s_error, c_error = sin_cos(self.c)
        most = (1.0, self._most(c, c_error), self._most(s, s_error))
        return self._compose((c, -s, -c), (c_error, s_error, c_error), most)

    def _most(self, value: Number, error: Number) -> Number:
        """Upper bound of |sin| or |cos| on the range, from its value at c."""
        return up(lesser(abs(value) + error + self.error + self.radius, 1.0))


def refuse_large(net: Folded, operations: int, n: int, arithmetic: str) -> None:
    """Raise `Rejected` if jets of so many operations in n states, or the network's, take too much memory or time."""
    if operations * n * n > _MOST_NUMBERS[arithmetic]:
        raise Rejected("local", "plant.dynamics", "the equations are too large for this rule")
    columns, products = n, 0
    for W in net.weights[1:]:
        products += len(W) * columns * W.shape[1]
        columns += W.shape[1]
        products += len(W) * columns * n * n
        if columns * (len(W) + n * n) > _MOST_NUMBERS[arithmetic] or products > _MOST_PRODUCTS[arithmetic]:
            raise Rejected("local", "policy.layers", "the network is too large for this rule")


def constant(q: Fraction, n: int) -> Jet:
    """A rational over R^n."""
    value, error = float_with_error(q)
    return Jet(np.float64(value), error, np.zeros(n), 0.0, np.zeros((n, n)), np.zeros((n, n)))


def enclose_at_origin(net: Folded, J: Number, slack: Number) -> tuple[Number, Number, Number, Number]:
    """The policy on the ball x = J d, ||d|| <= 1: `pi = u_eq + scale * (G d + d'Q d + r(d))` with |r_j(d)| <= d'E_j d.

    J (n, n) lies within `slack` of the true matrix in the 2-norm. Returns, all before scaling, G (m, n), the slack of
    each of its rows, Q and E (m, n, n).

    Every layer's value is y(d) = y(0) + J d + M A(d), where A_q is what a tanh of the layers before adds to its tangent
    at y_q(0), and M the product of weights and slopes with which that reaches y, so that errors cancel as they do in
    truth. With delta = y_q(d) - y_q(0), A_q is tanh'' / 2 delta^2 + at most |delta|^3 / 3, the third derivative of tanh
    being at most 2 in magnitude: d'(quad_q)d within d'(rest_q)d. Each column of X = [J, M] lies within `doubt` of the
    true one in the 2-norm.
    """
    n, arithmetic = J.shape[1], "arb" if is_ball(J) else "float64"
    y, error = 0 * J[:, :1], np.zeros((len(J), 1))
    X, doubt = J, slack + np.zeros(n)
    quad, rest, bends = np.zeros((n, n, n)), np.zeros((n, n, n)), np.zeros(n)  # of the states: nothing is added to them
    for layer, (W, b) in enumerate(zip(net.weights, net.biases, strict=True)):
        last, width = layer == len(net.weights) - 1, W.shape[1]
        error = total(np.abs(W) * error[:, 0], 1) + gamma(width) * norm(W, 1) * norm(y[:, 0], 0)
        Wy = product(W, y)[:, 0]
        error = up(error + EPS * (np.abs(Wy) + np.abs(b)) + (net.bias_error if last else 0.0))[:, None]
        doubt = up(net.norms[layer] * doubt + gamma(width) * frobenius(W) * norm(X, 0))
        y, X = (Wy + b)[:, None], product(W, X)
        if layer > 0:  # what the tanh just before has added arrives through W alone
            X, doubt = np.concatenate([X, carry(W, arithmetic)], 1), np.concatenate([doubt, np.zeros(width)])
        count = len(doubt)
        weight = np.abs(X) + doubt
        Q = product(X, quad.reshape(count, -1)).reshape(-1, n, n)
        E = product(weight, rest.reshape(count, -1)).reshape(-1, n, n)
        E = widen(E, total(doubt * bends + gamma(count) * (weight * bends), 1), gamma(count) + EPS)
        value = Jet(y[:, 0], error[:, 0], X[:, :n], norm(doubt[:n], 0), Q, E)
        if last and not net.squash:
            break
        t, e = tanh(y[:, 0])
        e = up(e + error[:, 0])
        slope = 1 - t * t
        slope_error = up(2 * e * (1 + e) + EPS)
        steepest = up(slope + slope_error)
        half = -t * slope
        half_error = up(e * steepest + np.abs(t) * slope_error + EPS * np.abs(half))
        added, beyond = value.beyond_tangent(half, half_error, 2.0)
        quad, rest = np.concatenate([quad, added]), np.concatenate([rest, beyond])
        bends = np.concatenate([bends, frobenius(added)])
        doubt = up(largest(steepest, 0) * doubt + (largest(slope_error, 0) + EPS) * norm(X, 0))
        y, error, X = t[:, None], e[:, None], slope[:, None] * X
    else:  # through the last layer's tanh as well
        wrong = slope_error * value.bend + EPS * (steepest * value.bend + bends[count:])
        E = widen(_each(steepest) * E + beyond, wrong)
        value = Jet(t, e, X[:, :n], norm(doubt[:n], 0), _each(slope) * Q + added, E)
    return net.scale[:, None] * value.a, value.slack, value.Q, value.E
