"""Distillation: from any policy to a small network of layers that does the same.

The source may have observations, skip connections and branches; it is called as a function. The new policy keeps its
squash, scale, offset and clip, and has layers of the states with one function between them. It imitates the source's
inputs at states of three kinds: uniform in the domain, near the origin at all sizes, and on the way of the source's
closed loop. States near the origin weigh more, so that differences count relative to the state; the Jacobian at the
origin is a term of its own while Adam trains all layers. At the end the last layer is fitted by least squares under the
condition that the Jacobian at the origin is the source's.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from certify.errors import InputError, OptionError
from certify.loop.activations import activation
from certify.loop.networks import tangent_at
from certify.loop.plants import System
from certify.loop.policies import Policy, PolicyNetwork
from controllers.distillation.last_layer import fitted
from controllers.distillation.options import DistilOptions
from controllers.distillation.result import Distilled
from controllers.distillation.source import Source
from controllers.evaluation.corners import nearest_corner
from controllers.evaluation.curvature import curvature
from controllers.flattening.contraction import with_value_at_origin
from controllers.flattening.student import Student
from controllers.options import Plant
from controllers.training.units import Units, begin_away, keep_away

Array = NDArray[np.float64]
Report = Callable[[int, float], None]

GAIN = 100.0  # weight of the Jacobian's relative change beside the fit
CORNERS = 0.1  # share of the domain in which no unit may pass its corner
EXACT = 1e-3  # relative error of the Jacobian beyond which the units cannot have it
JUDGED = 10_000  # states on which the two policies are compared


def distil(
    policy: Policy,
    options: DistilOptions | None = None,
    chosen: tuple[System, Plant] | None = None,
    report: Report | None = None,
) -> Distilled:
    """Train a small network that imitates `policy`.

    Parameters
    ----------
    chosen : the plant and how it is judged, where it is not the one that ships under the policy's name.
    report : called as training goes with the steps done and the root mean square of the fit.

    Raises
    ------
    InputError : policy and plant do not fit each other; the source's clip may act at the origin; the centring does not
        go with its squash; or the new units cannot have its Jacobian at the origin.
    """
    options, began = options or DistilOptions(), time.monotonic()
    torch.set_num_threads(options.threads)
    source = Source(policy, options, chosen)
    network = _imitation(source, options, report)
    u_eq, half_widths = source.system.exact_u_eq(), source.half_widths
    change = (network.jacobian_at_origin(u_eq) - source.J) * half_widths
    gain_error = float(np.linalg.norm(change)) / max(float(np.linalg.norm(source.J * half_widths)), 1e-300)
    if not gain_error <= EXACT:
        raise OptionError(
            f"the new units cannot have the source's Jacobian at the origin: it is off by {100 * gain_error:.2g} %. "
            "Give more `hidden` units, or another `seed`."
        )
    states = source.uniform(JUDGED, options.seed + 1)
    off = np.abs(source.inputs(network, states) - source.inputs(source.network, states))
    corner = nearest_corner(network, source.system)
    return Distilled(
        policy=replace(policy, network=network, training=_record(source, network, options), beta=None),
        states=JUDGED,
        largest=tuple(off.max(axis=0).tolist()),
        mean=tuple(off.mean(axis=0).tolist()),
        gain_error=gain_error,
        source=source.runs(source.network),
        own=source.runs(network),
        corner=corner,
        seconds=time.monotonic() - began,
    )


def _imitation(source: Source, options: DistilOptions, report: Report | None) -> PolicyNetwork:
    """The new policy: a start by least squares, Adam on all layers, and least squares again.

    All of it reads states times powers of two, which bring the domain to order one; the first layer takes them in.
    """
    x, weights = source.samples()
    wanted = source.inputs(source.network, x)
    scaled, box = x * source.factors, source.half_widths * source.factors
    policy = _refitted(_start(source, options), source, scaled, wanted, weights)
    policy = _descended(policy, source, options, (scaled, wanted, weights), box, report)
    policy = _refitted(policy, source, scaled, wanted, weights)
    first, *others = policy.weights
    return _valued(policy.with_layers(weights=(first * source.factors, *others)), source)


def _start(source: Source, options: DistilOptions) -> PolicyNetwork:
    """Layers with torch's first numbers, corners away from the origin, and a last layer of zeros."""
    n, m, units = source.system.n, source.system.m, Units(options.activation)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        layers = [torch.nn.Linear(a, b) for a, b in pairwise((n, *options.hidden))]
    begin_away([(layer.weight, layer.bias) for layer in layers], units)
    weights = [layer.weight.detach().double().numpy() for layer in layers]
    biases = [layer.bias.detach().double().numpy() for layer in layers]
    old = source.network
    centre = options.centre or ("preactivation" if old.squash == "tanh" else "output")
    last = np.zeros((m, options.hidden[-1]))
    start = PolicyNetwork.of_layers(
        (*weights, last), (*biases, np.zeros(m)), old.scale, old.offset, old.squash, centre, old.clip,
        activation=options.activation,
    )  # fmt: skip
    return _valued(start, source)


def _valued(policy: PolicyNetwork, source: Source) -> PolicyNetwork:
    """The policy in single precision, with the source's net(0)."""
    weights, biases = ([a.astype(np.float32).astype(float) for a in of] for of in (policy.weights, policy.biases))
    single = policy.with_layers(weights=weights, biases=biases)
    return with_value_at_origin(single, source.folded.net(np.zeros(source.system.n)))


def _refitted(policy: PolicyNetwork, source: Source, x: Array, wanted: Array, weights: Array) -> PolicyNetwork:
    """The policy with the last layer that fits best and has the source's Jacobian at the origin."""
    u_eq, phi = source.system.exact_u_eq(), activation(policy.activation)
    form = policy.folded(u_eq)
    before = PolicyNetwork.of_layers(  # up to the last units' arguments
        policy.weights[:-1], policy.biases[:-1], np.ones(policy.weights[-1].shape[1]),
        np.zeros(policy.weights[-1].shape[1]), "identity", "none", activation=policy.activation,
    )  # fmt: skip
    at_0 = tangent_at(before.network, np.zeros(policy.n))
    h, slope = phi.pair(at_0.y)
    features = phi.pair(before.net(x))[0] - h
    squashed = form.squashed(form.net(np.zeros(policy.n)))
    J = source.J / source.factors / (form.scale * form.squash_slope(squashed))[:, None]
    last = fitted(policy.weights[-1], features, slope[:, None] * at_0.J, wanted, J, weights, form)
    return _valued(policy.with_layers(weights=(*policy.weights[:-1], last)), source)


def _descended(
    policy: PolicyNetwork,
    source: Source,
    options: DistilOptions,
    data: tuple[Array, Array, Array],
    box: Array,
    report: Report | None,
) -> PolicyNetwork:
    """The policy after Adam on all layers."""
    form = policy.folded(source.system.exact_u_eq())
    value = form.net(np.zeros(policy.n))
    student = Student(policy, value, form, trains_biases=True)
    optimiser = torch.optim.Adam(student.groups(data[0], options.rate))
    rates = [group["lr"] for group in optimiser.param_groups]
    x, wanted, weights = (torch.from_numpy(array).float() for array in data)
    slope = torch.from_numpy(form.scale * form.squash_slope(form.squashed(value)))[:, None]
    J, widths = torch.from_numpy(source.J / source.factors * box), torch.from_numpy(box)
    size = torch.from_numpy(source.size(data[1])).float()
    largest = J.square().sum().clamp_min(1e-12)
    hidden = list(zip(student.weights, student.biases, strict=True))[:-1]
    generator = torch.Generator().manual_seed(options.seed)
    for step in range(options.steps):
        for group, rate in zip(optimiser.param_groups, rates, strict=True):
            group["lr"] = rate * (1 - step / options.steps)
        rows = torch.randint(len(x), (options.batch,), generator=generator)
        off = (student(x[rows]) - wanted[rows]) / size
        fit = (weights[rows] * off.square().sum(1)).mean()
        gain = ((slope * student.jacobian()) * widths - J).square().sum() / largest
        optimiser.zero_grad()
        (fit + GAIN * gain).backward()
        optimiser.step()
        keep_away(hidden, student.units, CORNERS * widths.float())
        if report is not None:
            report(step + 1, fit.item() ** 0.5)
    numbers, biases = ([p.detach().double().numpy() for p in of] for of in (student.weights, student.biases))
    found = policy.with_layers(weights=numbers, biases=biases)
    if not all(np.all(np.isfinite(a)) for a in (*found.weights, *found.biases)):
        raise OptionError("the imitation has diverged: its weights are not finite. Try another `seed`.")
    return _valued(found, source)


def _record(source: Source, network: PolicyNetwork, options: DistilOptions) -> dict[str, Any]:
    """The source's record, with the figures that changed and those of the runs, and how the policy was distilled."""
    dt, Q, R = source.judging
    record = {"dt": dt, "state_weights": Q.tolist(), "input_weights": R.tolist(), **source.policy.training}
    record.pop("nearest_corner", None)
    u_eq, corner = source.system.exact_u_eq(), nearest_corner(network, source.system)
    if np.isfinite(corner):
        record["nearest_corner"] = corner
    if "K" in record:
        K = np.asarray(record["K"])
        if K.shape != (source.system.m, source.system.n):
            raise InputError(f"`training.K` must have shape {(source.system.m, source.system.n)}; found {K.shape}.")
        record["distance"] = float(np.linalg.norm(network.jacobian_at_origin(u_eq) + K))
    if "curvature" in record and isinstance(record.get("eta"), float):
        record["curvature"] = curvature(network, source.system, record["eta"])
    settings = {
        "sha256": source.network.sha256(),
        "activation": options.activation,
        "hidden": list(options.hidden),
        "samples": options.samples,
        "steps": options.steps,
        "batch": options.batch,
        "rate": options.rate,
        "seed": options.seed,
    }
    return record | {"distilled": settings}
