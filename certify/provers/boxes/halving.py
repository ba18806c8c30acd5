"""Halving boxes that a rule leaves undecided, along the axes that add most to its bound."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from certify.provers.boxes.partition import Partition


class Undecided(Protocol):
    """What is asked of a rule's answer for boxes: `proved` (B,), `bound` (B,), and `score` (n, B), what each axis adds
    to the bound."""

    @property
    def proved(self) -> Tensor: ...

    @property
    def bound(self) -> Tensor: ...

    @property
    def score(self) -> Tensor: ...


class Halves(NamedTuple):
    """Corners (n, H), numbers (H,) and `origin` (H,), the place in the batch of the box that each is a part of; and
    which boxes of the batch (B,) are too small to be halved."""

    lo: Tensor
    hi: Tensor
    number: Tensor
    origin: Tensor
    small: Tensor


def split(
    partition: Partition, lo: Tensor, hi: Tensor, number: Tensor, found: Undecided, least_width: Tensor
) -> Halves:
    """Halve the boxes that are not proved.

    A half whose bound would stay positive if the split took away three quarters of its axis's share is halved
    again at once, along the next axis.
    """
    undecided = ~found.proved
    lo, hi, number, origin = lo[:, undecided], hi[:, undecided], number[undecided], torch.nonzero(undecided)[:, 0]
    bound, score = found.bound[undecided], found.score[:, undecided]
    # An axis that is already much thinner than the others, or too thin to halve, is not split.
    width = hi - lo
    relative = width / least_width
    score = torch.where((relative * 2.0**12 < relative.amax(0)) | (relative < 2), -torch.inf, score)
    best = score.amax(0)
    stuck = best == -torch.inf
    small = undecided.clone()
    small[undecided] = stuck
    if bool(stuck.any()):
        lo, hi, number, origin, bound, score, best = (
            a[..., ~stuck] for a in (lo, hi, number, origin, bound, score, best)
        )
    order = score.argsort(dim=0, descending=True, stable=True)
    lo, hi, number = halve(partition, lo, hi, number, order[0])
    origin = origin.repeat_interleave(2)
    if len(order) > 1:
        second = score.gather(0, order[1:2])[0]
        again = ((bound - 0.75 * best > 0) & (second > -torch.inf)).repeat_interleave(2)
        axis = order[1].repeat_interleave(2)[again]
        quarters = halve(partition, lo[:, again], hi[:, again], number[again], axis)
        halves = lo[:, ~again], hi[:, ~again], number[~again]
        lo, hi, number = (torch.cat(pair, -1) for pair in zip(halves, quarters, strict=True))
        origin = torch.cat([origin[~again], origin[again].repeat_interleave(2)])
    return Halves(lo, hi, number, origin, small)


def halve(partition: Partition, lo: Tensor, hi: Tensor, number: Tensor, axis: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Corners (n, 2B) and numbers (2B,) of the halves along `axis` (B,), lower and upper in turn."""
    n, count = lo.shape
    index = torch.arange(count, device=lo.device)
    middle = 0.5 * lo[axis, index] + 0.5 * hi[axis, index]
    lower_hi, upper_lo = hi.clone(), lo.clone()
    lower_hi[axis, index] = middle
    upper_lo[axis, index] = middle
    halves = partition.split(number.cpu().numpy(), axis.cpu().numpy())
    return (
        torch.stack([lo, upper_lo], 2).reshape(n, 2 * count),
        torch.stack([lower_hi, hi], 2).reshape(n, 2 * count),
        torch.tensor(halves, device=lo.device),
    )
