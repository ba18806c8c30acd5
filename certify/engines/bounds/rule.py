"""The rule for a box: an upper bound of Vdot on the part of the ring that lies in it.

Where a box sticks out of the ring, Vdot need not be negative on all of it. For any multiplier >= 0,
`Vdot < 0` on {V <= c2} follows from `Vdot + multiplier (c2 - V) < 0`, and on {V >= c1} from
`Vdot + multiplier (V - c1) < 0` (the S-procedure: Boyd, El Ghaoui, Feron, Balakrishnan 1994, section 2.6.3). Near the
point where {V <= c2} touches {Vdot >= 0} the two gradients are parallel, and the right multiplier cancels the first
order: close to the largest level this saves tenfold in boxes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import sympy
import torch
from numpy.typing import NDArray
from torch import Tensor

from certify.claims import Problem
from certify.enclosures import Models, PolicyEnclosure, Taylor, upper_bound
from certify.enclosures.taylor import EPS, TINY
from certify.expressions import evaluate
from certify.policies import bounded_by_form

Array = NDArray[np.float64]
_SLACK = 1e-9  # relative distance from the inner level at which a box counts as inside


class BoxBounds(NamedTuple):
    """What is known of each box: `proved` (B,), `bound` of Vdot (B,), `score` (n, B): what each axis adds to the bound,
    `violated` (B,): a condition fails at the centre; `smooth` (B,): F is enclosed on the box and the inputs keep their
    bounds there."""

    proved: Tensor
    bound: Tensor
    score: Tensor
    violated: Tensor
    smooth: Tensor


class VdotBound:
    """Upper bounds of Vdot, and bounds of V, over batches of boxes in the coordinates z.

    With `inside`, a box on which V is below the inner level is proved if F is enclosed there and the inputs keep their
    bounds; otherwise such a box is nobody's concern here.
    """

    def __init__(self, problem: Problem, T: Array, device: torch.device, inside: bool = False) -> None:
        self.inside = inside
        loop = problem.loop
        self.system = loop.system
        self.T = torch.tensor(T, dtype=torch.float64, device=device)
        self.P = problem.V.P
        S = T.T @ self.P @ T
        cross = np.abs(S - np.diag(np.diag(S))) + 1e-13 * np.sqrt(np.outer(np.diag(S), np.diag(S)))
        self.S_diagonal = torch.tensor(np.diag(S).copy(), dtype=torch.float64, device=device)[:, None]
        self.S_cross = torch.tensor(cross, dtype=torch.float64, device=device)
        self.S = torch.tensor(S, dtype=torch.float64, device=device)
        self.policy = PolicyEnclosure(loop, device)
        self.dynamics: tuple[sympy.Expr, ...] = loop.system.uncertain_dynamics()
        self.check_inputs = not bounded_by_form(loop.network, loop.system.input_bounds)

    def levels(self, lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor]:
        """Bounds of V from below and above on boxes (n, B)."""
        far = torch.maximum(lo.abs(), hi.abs())
        near = torch.where((lo <= 0) & (hi >= 0), 0.0, torch.minimum(lo.abs(), hi.abs()))
        cross = (far * (self.S_cross @ far)).sum(0)
        return (self.S_diagonal * near**2).sum(0) - cross, (self.S_diagonal * far**2).sum(0) + cross

    def levels_at(self, z: Tensor) -> Tensor:
        """V at points (n, B)."""
        return (z * (self.S @ z)).sum(0)

    def __call__(self, lo: Tensor, hi: Tensor, inner: float, outer: float) -> BoxBounds:
        """Bounds on inner <= V <= outer within boxes lo, hi (n, B)."""
        n = self.system.n
        centre = 0.5 * lo + 0.5 * hi
        radius = torch.maximum(hi - centre, centre - lo) * (1 + EPS)
        slopes_x = self.T[:, :, None] * radius
        x = torch.cat([(self.T @ centre)[:, None], slopes_x], 1)
        error = 2 * (n + 4) * EPS * (self.T.abs() @ (centre.abs() + radius)) + TINY
        mid, slopes, wide, share = self.policy(x, error)
        vdot = self._vdot(x, error, mid, slopes, wide)
        bound, excess = upper_bound(vdot)
        smooth = torch.isfinite(bound)  # a component of F that is not enclosed leaves a NaN in the sum over all
        # At the box's centre, and for the worst values of what is uncertain, only the inputs' errors, what is of second
        # order in all these, and the remainder are left.
        known = n + self.system.m
        doubt = vdot.g[n:known].abs().sum(0) + vdot.Q[n:, n:].abs().sum((0, 1)) + vdot.r
        violated = vdot.c + vdot.g[known:].abs().sum(0) - doubt >= 0
        bound = self._within_ring(bound, vdot, lo, hi, centre, radius, inner, outer)
        proved = bound < 0
        if self.inside:
            proved = smooth & (proved | (self.levels(lo, hi)[1] < inner * (1 - _SLACK)))
        # What the inputs' errors and the remainder add is charged to the axes that spread the network.
        extra = excess[n:].sum(0) + vdot.r
        score = excess[:n] + share * extra
        score = torch.where(torch.isfinite(score), score, slopes_x.abs().sum(0))
        if self.check_inputs:
            reach = slopes.abs().sum(1) + wide + 1e-11 * mid.abs()
            for j, (low, high) in enumerate(self.system.input_bounds):
                slack = 1e-11 * (abs(float(low)) + abs(float(high)))
                inside = (mid[j] - reach[j] > float(low) + slack) & (mid[j] + reach[j] < float(high) - slack)
                outside = (mid[j] - wide[j] > float(high) + slack) | (mid[j] + wide[j] < float(low) - slack)
                proved, violated, smooth = proved & inside, violated | outside, smooth & inside
                spread = slopes[j].abs() + share * wide[j]
                score = torch.where(inside, score, spread)
        return BoxBounds(proved, bound, score, violated, smooth)

    def _vdot(self, x: Tensor, error: Tensor, mid: Tensor, slopes: Tensor, wide: Tensor) -> Taylor:
        """Vdot = (2 P x)'f(x, u, q); symbols: n box coordinates, m input errors, k uncertain quantities."""
        n, m, batch, k = self.system.n, self.system.m, x.shape[2], len(self.system.uncertain)
        zeros = torch.zeros(n + m + k, n + m + k, batch, dtype=x.dtype, device=x.device)
        none = zeros[0, : m + k]
        values: dict[sympy.Symbol, Taylor] = {}
        for i, symbol in enumerate(self.system.states):
            values[symbol] = Taylor(x[i, 0], torch.cat([x[i, 1:], none]), zeros, error[i])
        for j, symbol in enumerate(self.system.inputs):
            own = none.clone()
            own[j] = wide[j]
            values[symbol] = Taylor(mid[j], torch.cat([slopes[j], own]), zeros, zeros[0, 0])
        for j, (symbol, (lo, hi)) in enumerate(self.system.uncertain):
            middle, reach = float((lo + hi) / 2), float((hi - lo) / 2)
            own = zeros[0].clone()
            own[n + m + j] = reach
            rounding = EPS * (abs(middle) + reach) + TINY
            values[symbol] = Taylor(zeros[0, 0] + middle, own, zeros, zeros[0, 0] + rounding)
        known: dict[sympy.Expr, Taylor] = {}
        models = Models(values[self.system.states[0]])
        states = [values[s] for s in self.system.states]
        terms = []
        for i, expression in enumerate(self.dynamics):
            gradient = states[0].scaled(2 * float(self.P[i, 0]))
            for j in range(1, n):
                gradient = gradient + states[j].scaled(2 * float(self.P[i, j]))
            terms.append(gradient * evaluate(expression, values, models, known))
        result = terms[0]
        for term in terms[1:]:
            result = result + term
        return result

    def _within_ring(
        self,
        bound: Tensor,
        vdot: Taylor,
        lo: Tensor,
        hi: Tensor,
        centre: Tensor,
        radius: Tensor,
        inner: float,
        outer: float,
    ) -> Tensor:
        """The bound, made tighter by the S-procedure where it is not negative and the box sticks out of the ring."""
        n = len(centre)
        lowest, highest = self.levels(lo, hi)
        for level, sign, outside in ((outer, 1.0, highest > outer), (inner, -1.0, lowest < inner)):
            index = torch.nonzero(outside & ~(bound < 0))[:, 0]
            if not len(index):
                continue
            # gap = sign (level - V), as a model in the box coordinates; it is >= 0 in the ring
            z, r = centre[:, index], radius[:, index]
            far = z.abs() + r
            g = torch.zeros_like(vdot.g[:, index])
            Q = torch.zeros_like(vdot.Q[:, :, index])
            g[:n] = -2 * sign * self.S_diagonal * z * r
            torch.diagonal(Q, dim1=0, dim2=1)[:, :n] = -sign * (self.S_diagonal * r * r).T
            size = (self.S_diagonal * far * far).sum(0)
            gap = Taylor(
                sign * (level - (self.S_diagonal * z * z).sum(0)),
                g,
                Q,
                (far * (self.S_cross @ far)).sum(0) + n * EPS * (size + level) + TINY,
            )
            scale = gap.r + EPS * size
            for each in _multipliers(vdot.g[:n, index], g[:n], gap.c):
                left = torch.nonzero(~(bound[index] < 0) & (each > 0))[:, 0]
                k, still = each[left], index[left]
                c = k * gap.c[left]
                added = Taylor(c, k * g[:, left], k * Q[:, :, left], k * scale[left] + EPS * c.abs() + TINY)
                here = Taylor(vdot.c[still], vdot.g[:, still], vdot.Q[:, :, still], vdot.r[still])
                tighter, _ = upper_bound(here + added)
                bound = bound.index_put((still,), torch.fmin(bound[still], tighter))
        return bound


def _multipliers(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """The k at which a term of `c k + sum_i |a_i + k b_i|` vanishes, or 0 where it is negative: (n, B), best first."""
    k = torch.nan_to_num(torch.where(b != 0, -a / b, 0.0), 0.0, 0.0, 0.0).clamp(min=0.0)
    value = c * k + (a[:, None] + k * b[:, None]).abs().sum(0)
    return k.gather(0, value.argsort(dim=0, stable=True))
