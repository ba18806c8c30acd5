"""Trajectories of a scene: where they start, and how they go on."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from certify.report.figures.geometry import PARTS, circle, over_level, refine
from certify.report.figures.pairs import Pair
from certify.report.figures.scene import PATH_STEP, Scene
from certify.report.sampling import Runs, quadratic, runs_of

Array = NDArray[np.float64]
_ALONG = 400  # points of a ray, of which the last one in the sets is where a trajectory starts
_MOST_SHORT = 8  # times as many where a period is shorter than a step would be


def runs_from(scene: Scene, begin: ArrayLike, steps: int | None = None) -> Runs:
    """Trajectories with their fates, over the tube and the time that the scene says; smooth for pictures."""
    wanted = PATH_STEP * scene.step
    step = scene.flow.fitting(wanted)
    every = min(max(int(wanted / step), 1), _MOST_SHORT) if scene.flow.period else 1  # of short periods some are kept
    count = steps or min(int((scene.duration + scene.drawn) / step) + 1, every * scene.detail.steps)
    starts, target = np.asarray(begin, dtype=np.float64), scene.settling_level
    begins = scene.start, scene.centre, scene.in_more
    runs = runs_of(scene.flow, starts, scene.P, scene.outer, target, step, count, scene.effort, *begins)
    if not scene.timing.is_plain:  # the rate of change jumps where the input does
        return Runs(runs.path[::every], every * step, runs.settled, runs.left)
    return Runs(refine(runs.path, scene.flow.field, step), step / PARTS, runs.settled, runs.left)


def starts(scene: Scene) -> Array:
    """Starting points: around the outline of a set in each plane and, for two states, along the domain's edge.

    The set is that of a tube's start if there is one, wherever it lies, else {V <= c2}; with an outer set it is the
    union of the two, and its outline that in the plane through the origin.
    """
    count = scene.detail.starts
    P, level = (scene.P, scene.outer) if scene.start is None else (scene.start, 1.0)
    middle = 0.0 if scene.centre is None else scene.centre
    blocks = [middle + over_level(P, pair, circle(count), 0.999 * level) for pair in scene.pairs]
    if scene.beyond is not None:
        blocks = [farthest(scene, pair, count) for pair in scene.pairs]
    if scene.n == 2:
        edge = 2 * np.pi * (np.arange(22) + 0.25) / 22
        ring = np.stack([np.cos(edge), np.sin(edge)], -1)
        ring /= np.max(np.abs(ring), axis=1, keepdims=True)
        centre, half = (scene.lo + scene.hi) / 2, (scene.hi - scene.lo) / 2
        blocks.append(centre + 0.985 * half * ring)
    return np.concatenate(blocks)


def farthest(scene: Scene, pair: Pair, count: int) -> Array:
    """The last state of the outer set, or of {V <= c2}, along rays from the origin in a plane, (count, n)."""
    directions = np.zeros((count, scene.n))
    directions[:, list(pair)] = circle(count)
    with np.errstate(divide="ignore"):
        far = np.min(
            np.maximum(scene.lo / directions, scene.hi / directions), axis=1, where=directions != 0, initial=np.inf
        )
    x = far[:, None, None] * np.linspace(0, 1, _ALONG)[:, None] * directions[:, None]
    inside = scene.in_outer(x) | (quadratic(scene.P, x) <= scene.outer)
    last = _ALONG - 1 - np.argmax(inside[:, ::-1], axis=1)
    return np.asarray(x[np.arange(count), last])
