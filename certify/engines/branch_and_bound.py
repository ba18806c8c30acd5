"""The ring: one best-first pass of branch and bound that finds the largest provable level as it goes.

Boxes are kept in the order of the lowest V on them. Everything below the lowest undecided box is proved, so the answer
is ready whenever the pass stops: for a witness, a budget, or because nothing is left. No trial level is ever
proved again from scratch.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sympy
import torch
from numpy.typing import NDArray
from torch import Tensor

from certify.enclosures import PolicyEnclosure, Taylor, evaluate, upper_bound
from certify.enclosures.taylor import EPS, TINY
from certify.obligations import Obligations

Array = NDArray[np.float64]
LEAF = 255
_SLACK = 1e-9  # relative distance kept from every level, so that the checker's own rounding agrees


@dataclass(frozen=True, slots=True)
class Budget:
    """What the pass may use; `least_width` is the smallest box, relative to the root box."""

    boxes: int = 4_000_000
    seconds: float = 600.0
    batch: int = 2048
    least_width: float = 2.0**-24


@dataclass(frozen=True, slots=True)
class RingProof:
    """`level` is proved from `inner` on (equal to it if the ring is empty); `reason` says what stopped the pass.

    `tree` is the partition in preorder: an axis for a split, 255 for a leaf; `root` its half-widths (n,) in z.
    `witness` (n,) is a point in z at which a claim fails, found along the way.
    """

    level: float
    reason: str
    tree: bytes
    root: Array
    boxes: int
    leaves: int
    witness: Array | None


@dataclass
class _Tree:
    """Nodes by number: split axis (or LEAF), first child (the second follows it), lowest V on the box."""

    axis: list[Array] = field(default_factory=list)
    lowest: list[Array] = field(default_factory=list)
    size: int = 0

    def add(self, lowest: Array) -> NDArray[np.int64]:
        numbers = np.arange(self.size, self.size + len(lowest))
        self.lowest.append(lowest)
        self.size += len(lowest)
        return numbers


def prove_ring(
    obligations: Obligations,
    inner: float,
    target: float,
    budget: Budget,
    device: torch.device,
    progress: Callable[[float, int], None] | None = None,
) -> RingProof:
    """Prove Vdot < 0 (and the input bounds) on `inner <= V <= level` for the largest level up to `target`.

    Parameters
    ----------
    inner, target : levels, 0 < inner <= target.
    progress : called with (level proved so far, boxes examined).
    """
    bound = _VdotBound(obligations, device)
    n = obligations.loop.system.n
    S = obligations.T.T @ obligations.P @ obligations.T
    root = np.sqrt(target * np.diag(np.linalg.inv(S))) * (1 + 1e-9)
    if inner >= target:  # the ring is empty
        return RingProof(target, "requested", bytes([LEAF]), root, 0, 1, None)
    start, target0 = time.monotonic(), target
    lo = torch.tensor(-root, dtype=torch.float64, device=device)[:, None]
    hi = -lo
    least_width = budget.least_width * torch.tensor(root, dtype=torch.float64, device=device)[:, None]
    lowest, _ = bound.levels(lo, hi)
    tree = _Tree()
    number = torch.tensor(tree.add(lowest.cpu().numpy()), device=device)
    splits: list[tuple[NDArray[Any], NDArray[np.uint8], NDArray[np.int64]]] = []  # parents, axes, first children
    boxes, reason = 0, "requested"
    witness: Array | None = None
    while lo.shape[1]:
        # Best first: the boxes with the lowest V.
        if lo.shape[1] > budget.batch:
            order = torch.argsort(lowest, stable=True)
            lo, hi, lowest, number = lo[:, order], hi[:, order], lowest[order], number[order]
        now, later = slice(0, budget.batch), slice(budget.batch, None)
        box_lo, box_hi, box_number = lo[:, now], hi[:, now], number[now]
        boxes += box_lo.shape[1]
        proved, score, centre_bad = bound(box_lo, box_hi)
        if bool(centre_bad.any()):  # a violation at a box's centre caps the level
            bad_centres = 0.5 * box_lo[:, centre_bad] + 0.5 * box_hi[:, centre_bad]
            at = bound.levels_at(bad_centres)
            if at.min().item() < target:
                target, reason = at.min().item() * (1 - 1e-3), "witness"
                witness = bad_centres[:, at.argmin()].cpu().numpy()
        open_ = ~proved
        box_lo, box_hi, box_number, score = box_lo[:, open_], box_hi[:, open_], box_number[open_], score[:, open_]
        width = box_hi - box_lo
        # An axis that is already much thinner than the others, or too thin to halve, is not split.
        relative = width / least_width
        score = torch.where(relative * 2.0**12 < relative.amax(0), -torch.inf, score)
        score = torch.where(width < 2 * least_width, -torch.inf, score)
        stuck = score.amax(0) == -torch.inf
        if bool(stuck.any()):
            bottom, _ = bound.levels(box_lo[:, stuck], box_hi[:, stuck])
            if bottom.min().item() < target:
                target, reason = bottom.min().item() * (1 - _SLACK), "boxes"
            box_lo, box_hi, box_number, score = (
                box_lo[:, ~stuck], box_hi[:, ~stuck], box_number[~stuck], score[:, ~stuck],
            )  # fmt: skip
        count = box_lo.shape[1]
        axis = score.argmax(0) if count else torch.zeros(0, dtype=torch.long, device=device)
        index = torch.arange(count, device=device)
        middle = 0.5 * box_lo[axis, index] + 0.5 * box_hi[axis, index]
        left_hi, right_lo = box_hi.clone(), box_lo.clone()
        left_hi[axis, index] = middle
        right_lo[axis, index] = middle
        new_lo = torch.stack([box_lo, right_lo], 2).reshape(n, 2 * count)
        new_hi = torch.stack([left_hi, box_hi], 2).reshape(n, 2 * count)
        new_lowest, new_highest = bound.levels(new_lo, new_hi)
        first = tree.add(new_lowest.cpu().numpy())
        splits.append((box_number.cpu().numpy(), axis.cpu().numpy().astype(np.uint8), first[::2]))
        keep = (new_lowest <= target * (1 + _SLACK)) & (new_highest >= inner * (1 - _SLACK))
        new_number = torch.tensor(first, device=device)[keep]
        lo = torch.cat([lo[:, later], new_lo[:, keep]], 1)
        hi = torch.cat([hi[:, later], new_hi[:, keep]], 1)
        lowest = torch.cat([lowest[later], new_lowest[keep]])
        number = torch.cat([number[later], new_number])
        if target < target0:
            keep = lowest <= target * (1 + _SLACK)
            lo, hi, lowest, number = lo[:, keep], hi[:, keep], lowest[keep], number[keep]
        if progress is not None:
            progress(float(lowest.min()) if len(lowest) else target, boxes)
        out_of_boxes, out_of_time = boxes >= budget.boxes, time.monotonic() - start > budget.seconds
        if len(lowest) and (out_of_boxes or out_of_time):
            target, reason = float(lowest.min()) * (1 - 2 * _SLACK), "time" if out_of_time else "boxes"
            break
    level = max(target, inner)
    preorder = _preorder(tree, splits, level)
    return RingProof(level, reason, preorder, root, boxes, preorder.count(bytes([LEAF])), witness)


def _preorder(
    tree: _Tree, splits: list[tuple[NDArray[Any], NDArray[np.uint8], NDArray[np.int64]]], level: float
) -> bytes:
    """The partition in preorder; a subtree that lies above the level altogether becomes one leaf."""
    lowest = np.concatenate(tree.lowest)
    axis, first = np.full(tree.size, LEAF, dtype=np.uint8), np.zeros(tree.size, dtype=np.int64)
    for parents, axes, children in splits:
        axis[parents], first[parents] = axes, children
    axis[lowest > level * (1 + _SLACK)] = LEAF
    result, stack = bytearray(), [0]
    axes_list, first_list = axis.tolist(), first.tolist()
    while stack:
        node = stack.pop()
        result.append(axes_list[node])
        if axes_list[node] != LEAF:
            stack.append(first_list[node] + 1)
            stack.append(first_list[node])
    return bytes(result)


class _VdotBound:
    """Upper bounds of Vdot, and of V, over batches of boxes in the coordinates z."""

    def __init__(self, obligations: Obligations, device: torch.device) -> None:
        loop = obligations.loop
        self.system, self.device = loop.system, device
        self.T = torch.tensor(obligations.T, dtype=torch.float64, device=device)
        self.P = obligations.P
        S = obligations.T.T @ obligations.P @ obligations.T
        cross = np.abs(S - np.diag(np.diag(S))) + 1e-13 * np.sqrt(np.outer(np.diag(S), np.diag(S)))
        self.S_diagonal = torch.tensor(np.diag(S).copy(), dtype=torch.float64, device=device)[:, None]
        self.S_cross = torch.tensor(cross, dtype=torch.float64, device=device)
        self.S = torch.tensor(S, dtype=torch.float64, device=device)
        self.policy = PolicyEnclosure(loop, device)
        self.dynamics: tuple[sympy.Expr, ...] = loop.system.exact_dynamics()
        self.check_inputs = not obligations.inputs_bounded_by_form

    def levels(self, lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor]:
        """Bounds of V from below and above on boxes (n, B)."""
        far = torch.maximum(lo.abs(), hi.abs())
        near = torch.where((lo <= 0) & (hi >= 0), 0.0, torch.minimum(lo.abs(), hi.abs()))
        cross = (far * (self.S_cross @ far)).sum(0)
        return (self.S_diagonal * near**2).sum(0) - cross, (self.S_diagonal * far**2).sum(0) + cross

    def levels_at(self, z: Tensor) -> Tensor:
        """V at points (n, B)."""
        return (z * (self.S @ z)).sum(0)

    def __call__(self, lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(proved (B,), score of each axis (n, B), centre violates (B,)) for boxes lo, hi (n, B)."""
        n, m = self.system.n, self.system.m
        batch = lo.shape[1]
        centre = 0.5 * lo + 0.5 * hi
        radius = torch.maximum(hi - centre, centre - lo) * (1 + EPS)
        slopes_x = self.T[:, :, None] * radius
        x = torch.cat([(self.T @ centre)[:, None], slopes_x], 1)
        error = 2 * (n + 4) * EPS * (self.T.abs() @ (centre.abs() + radius)) + TINY
        mid, slopes, wide, share = self.policy(x, error)
        zeros = torch.zeros(n + m, n + m, batch, dtype=lo.dtype, device=lo.device)
        none = torch.zeros(m, batch, dtype=lo.dtype, device=lo.device)
        values: dict[sympy.Symbol, Taylor] = {}
        for i, symbol in enumerate(self.system.states):
            values[symbol] = Taylor(x[i, 0], torch.cat([x[i, 1:], none]), zeros, error[i])
        for j, symbol in enumerate(self.system.inputs):
            own = none.clone()
            own[j] = wide[j]
            values[symbol] = Taylor(mid[j], torch.cat([slopes[j], own]), zeros, torch.zeros_like(mid[j]))
        known: dict[sympy.Expr, Taylor] = {}
        states = [values[s] for s in self.system.states]
        vdot: Taylor | None = None
        for i, expression in enumerate(self.dynamics):
            gradient = states[0].scaled(2 * float(self.P[i, 0]))
            for j in range(1, n):
                gradient = gradient + states[j].scaled(2 * float(self.P[i, j]))
            term = gradient * evaluate(expression, values, known)
            vdot = term if vdot is None else vdot + term
        if vdot is None:
            raise ValueError("a plant has at least one state")
        value, excess = upper_bound(vdot)
        # At the box's centre only the inputs' errors and the remainder are left.
        doubt = vdot.g[n:].abs().sum(0) + vdot.Q[n:, n:].abs().sum((0, 1)) + vdot.r
        proved, bad = value < 0, vdot.c - doubt >= 0
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
                proved, bad = proved & inside, bad | outside
                spread = slopes[j].abs() + share * wide[j]
                score = torch.where(inside, score, spread)
        return proved, score, bad
