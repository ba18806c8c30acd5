"""The share of the learning rate that the actor's step has, as a run comes to its end."""

from __future__ import annotations


def closing_share(closing: tuple[int, int], step: int) -> float:
    """The share that falls linearly from 1 to 0 between the two steps of `closing`.

    >>> closing_share((100, 200), 50), closing_share((100, 200), 150), closing_share((100, 100), 100)
    (1.0, 0.5, 0.0)
    """
    begin, end = closing
    return min(1.0, max(0.0, (end - step) / max(1, end - begin)))


def annealed_share(anneal: float, steps: int, step: int) -> float:
    """The share that falls linearly to 0 over the last share `anneal` of a run of `steps` steps.

    >>> annealed_share(0.2, 1000, 800), annealed_share(0.2, 1000, 900), annealed_share(0.0, 1000, 999)
    (1.0, 0.5, 1.0)
    """
    falling = anneal * steps
    return min(1.0, (steps - step) / falling) if falling > 0 else 1.0
