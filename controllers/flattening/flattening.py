"""Flattening: from a policy to one that does the same and is easier to prove.

The size of a proof is decided when the policy is trained: bounds see every hidden unit's bend, whether the closed loop
needs it or not. Flattening lowers

    fit + GAIN * gain + weight * departure

where fit is the mean squared change of the input on states that the closed loops of both policies visit, relative to
the mean square of the inputs, gain that of the Jacobian at 0, and `departure` is what bounds see of the hidden units on
a box. Without the gain's term a policy that must be flat copies the old inputs far out by smaller gains at the origin,
where what is proved begins: it then costs more and is harder to prove, both. First the best of the policies between the
old one and its linearisation is taken (`contraction`), then Adam starts from there (`descent`). Both have to stay
within bounds on the settled share and the median cost of simulated runs, and the best iterate that does is the result
(`selection`). It has the same layers, squash, centring, scale, offset and clip, and the same value before the squash at
the origin.

A policy whose gain at the origin is the trouble is another matter: bounds cannot be large where the loop saturates at a
hundredth of its box. With `gain` "lqr" the policy to be copied is the old one with the gain that minimises the
judged cost near the origin (`gain_change`), and the bounds are still those of the old one.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from certify.errors import OptionError
from certify.loop.plants import System
from certify.loop.policies import Policy, PolicyNetwork
from controllers.evaluation.curvature import curvature
from controllers.flattening.contraction import contracted
from controllers.flattening.descent import Descent, Report
from controllers.flattening.keeping import Keeping, volume_of
from controllers.flattening.options import FlattenOptions
from controllers.flattening.result import Figures, Flattened
from controllers.flattening.selection import Selection
from controllers.flattening.task import Task
from controllers.options import Plant

FACTORS = tuple(2.0**-k for k in range(7))
"""Contractions that are tried: powers of two, which round no weight. Beyond the last one nothing is left to gain."""


def flatten(
    policy: Policy,
    options: FlattenOptions | None = None,
    chosen: tuple[System, Plant] | None = None,
    report: Report | None = None,
) -> Flattened:
    """Flatten `policy`: find one that does the same and is easier to prove.

    Parameters
    ----------
    chosen : the plant and how it is judged, where it is not the one that ships under the policy's name.
    report : called as training goes with the steps done, the fit and the departure.

    Raises
    ------
    InputError : policy, box and plant do not fit each other; the policy has no hidden units, or other steps than
        layers; its closed loop has no finite cost to compare with; there is no LQR gain, or the policy cannot have it,
        where that is asked for; or no iterate has a lower departure within the bounds.
    """
    options, began = options or FlattenOptions(), time.monotonic()
    if options.gain == "lqr":
        policy.network.require_layers("another gain")
    torch.set_num_threads(options.threads)
    task = Task(policy, options, chosen)
    selection = Selection(task, task.visited(task.goal))
    descent, keeping = Descent(task, selection, began), None
    if options.curvature == "kept":
        keeping = Keeping(task, selection, began)
        factor, steps, ended = keeping.run(report)
    else:
        factor, start = _contracted(task, selection)
        steps, ended = descent.run(start, report)
    if selection.best is None:
        before = selection.before
        raise OptionError(
            f"no policy within the bounds is easier to prove: as many of {before.states} runs must settle as "
            f"before, {before.settled}, and the median cost may rise from {before.cost:.4g} by "
            f"{100 * options.max_cost_change:g} % at most. Nothing is written. Allow more with "
            "`max_cost_change`, or ask for less with a smaller `weight`."
        )
    network, after = selection.best
    states = descent.states if task.goal is task.old else np.concatenate([descent.states, task.visited(task.old)])
    change = task.inputs(network, states) - task.inputs(task.old, states)
    settings = _settings(task, selection.before, after, factor, steps)
    kept = None if keeping is None else keeping.found[network.sha256()]
    if kept is not None:
        settings |= {
            "curvature": "kept",
            "volume": volume_of(options, task.box),
            "distance": options.distance,
            "boxes": kept.boxes,
            "P": kept.P.tolist(),
        }
    return Flattened(
        policy=replace(policy, network=network, training=_record(task, network) | {"flattened": settings}),
        before=selection.before,
        after=after,
        rms=tuple(np.sqrt((change**2).mean(axis=0)).tolist()),
        largest=tuple(np.abs(change).max(axis=0).tolist()),
        gain_change=task.gain_change(network, task.old.jacobian_at_origin(task.u_eq)),
        factor=factor,
        steps=steps,
        ended=ended,
        seconds=time.monotonic() - began,
        boxes=None if kept is None else kept.boxes,
        volume=None if kept is None else volume_of(options, task.box),
    )


def _contracted(task: Task, selection: Selection) -> tuple[float, PolicyNetwork]:
    """The best contraction within the bounds; the goal itself if there is none."""
    candidates = [contracted(task.goal, factor) for factor in FACTORS]
    ranked = sorted(range(len(FACTORS)), key=lambda k: selection.objective(candidates[k]))
    for k in ranked:
        as_it_was = k == 0 and task.goal is task.old  # no result, though rounded to float32 it may look flatter
        if as_it_was or selection.keep(candidates[k]):
            return FACTORS[k], candidates[k]
    return FACTORS[0], candidates[0]


def _record(task: Task, network: PolicyNetwork) -> dict[str, Any]:
    """The old record with the figures that changed."""
    record = dict(task.policy.training)
    if task.K is not None and "K" in record:
        record["K"] = task.K.tolist()
    if "K" in record:
        record["distance"] = float(np.linalg.norm(network.jacobian_at_origin(task.u_eq) + np.asarray(record["K"])))
    if "curvature" in record and isinstance(record.get("eta"), float):
        record["curvature"] = curvature(network, task.system, record["eta"])
    return record


def _settings(task: Task, before: Figures, after: Figures, factor: float, steps: int) -> dict[str, Any]:
    """The entry `flattened` of the record: from which policy, with which options, and its figures before and after."""
    options = task.options
    settings: dict[str, Any] = {
        "sha256": task.old.sha256(),
        "gain": options.gain,
        "weight": options.weight,
        "box": task.box.tolist(),
        "steps": steps,
        "batch": options.batch,
        "rate": options.rate,
        "seed": options.seed,
        "max_cost_change": options.max_cost_change,
        "factor": factor,
        "departure": [before.departure, after.departure],
        "cost": [before.cost, after.cost],
    }
    if task.K is not None:
        Q, R = task.lqr_weights()
        settings |= {"K": task.K.tolist(), "Q": Q.tolist(), "R": R.tolist()}
    return settings
