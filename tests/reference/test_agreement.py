"""Both checkers accept a certificate or both refuse it: many certificates, of every kind of claim, by their origin.

Trees are grown with the checker's own leaf rule and hints fitted to its models, so that a certificate is seldom near a
limit that the reference has and the checker has not; where it is, the two may differ, and `MOST_APART` says how often.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.analysis.run import RoaOptions, certify_roa
from certify.checker import document, networks
from certify.checker.networks import Affine, Clip, Map, Observe, Step
from certify.loop.plants import get_system, load_system
from certify.loop.policies import load_policy
from tests.checker.test_networks import a_network, checked
from tests.checker.test_rules import FALSE, HONEST, MUTANTS
from tests.checker.test_rules import honest as of_rules
from tests.reference import test_path, test_tube
from tests.support import network_loops, outer_loops, step_forgeries, stepped_loops
from tests.support.balls import with_ball
from tests.support.certificates import Document, edited, encode, grow, make
from tests.support.earlier import newer
from tests.support.marks import slow_after
from tests.support.network_loops import ACTIVATIONS, FORMS, KINDS
from tests.support.reference import judge_bytes
from tests.support.uncertain import random_plant

Named = tuple[str, Callable[[], Document]]
EXAMPLES = Path(__file__).parents[2] / "examples"


def of_networks() -> Iterator[Named]:
    """Each activation in each step, with each kind of claim."""
    for name in (*ACTIVATIONS, "tanh"):
        for form in FORMS:
            for kind in (*KINDS, "planar"):
                yield f"{name}, {form}, {kind}", lambda a=(name, form, kind): network_loops.honest(*a)


def of_rules_and_steps() -> Iterator[Named]:
    """The bases of forgeries, and loops to both sides of what is true of them."""
    for name in HONEST:
        yield name, lambda name=name: of_rules(name)
    for _, base, what, edit in MUTANTS:
        yield f"{base}: {what}", lambda base=base, edit=edit: edit(of_rules(base))
    for _, what, data, _ in FALSE:
        yield what, lambda data=data: data
    for name in step_forgeries.BASES:
        yield name, lambda name=name: step_forgeries.base(name)
    for family in stepped_loops.families():
        for share in (0.002, 0.02, 0.1, 0.3):
            yield f"{family.name}, within {share}", lambda f=family, s=share: f.within(s)
            yield f"{family.name}, beyond {share}", lambda f=family, s=share: f.beyond(s)


def of_sets_and_tubes() -> Iterator[Named]:
    for module, kind in ((test_tube, "enlarged"), (test_path, "reached")):
        for name in module.NAMES:
            yield f"{kind}, {name}", lambda module=module, name=name: module.honest(name)
            yield f"{kind}, {name}, faster", lambda m=module, name=name: faster(m.honest(name))
    for family in outer_loops.families():
        yield f"{family.name}, within", lambda f=family: f.within(f.near)
        yield f"{family.name}, beyond", lambda f=family: f.beyond(0.02)


def faster(data: Document) -> Document:
    """In half of the time."""
    half = [slab | {"duration": (float.fromhex(slab["duration"]) / 2).hex()} for slab in data["evidence"]["tube"]]
    return edited(data, "evidence.tube", half)


def of_chance() -> Iterator[Named]:
    """Random plants, and random networks beside a linear policy."""
    for seed in range(150):
        yield f"plant {seed}", lambda seed=seed: grow(random_plant(seed), max_leaves=300, depth=14)
    for seed in range(150, 200):
        yield f"plant {seed}, practical", lambda s=seed: grow(random_plant(s, practical=True), max_leaves=300, depth=14)
    for seed in range(200):
        yield f"network {seed}", lambda seed=seed: random_network(seed)


def written(step: Step) -> Document:
    """A step as it stands in a file."""
    made: Document = {"kind": type(step).__name__.lower(), "of": list(step.of)}
    match step:
        case Affine():
            made |= {"shape": list(step.weight.shape), "weight": encode(step.weight), "bias": encode(step.bias)}
        case Map():
            made |= {"function": step.function}
        case Clip():
            made |= {"lo": encode(step.lo), "hi": encode(step.hi)}
        case Observe():
            made |= {"names": list(step.names), "expressions": step.tape.trees}
    return made


def random_network(seed: int) -> Document:
    """x' = y, y' = -sin(x)/2 + u, or one state, under K x and a share of a random network."""
    rng = np.random.default_rng([5, seed])
    n = int(rng.integers(1, 3))
    net = a_network(seed, n, 1)
    share, last = float(rng.choice([1e-3, 0.01, 0.05, 0.3])), net.steps[-1]
    assert isinstance(last, Affine)
    small = replace(last, weight=share * last.weight, bias=share * last.bias)
    K = [[-1.0, -1.5]] if n == 2 else [[-1.5]]
    count = len(net.steps)
    steps = [*map(written, [*net.steps[:-1], small]), network_loops.affine(0, K), network_loops.joined("sum", count, count + 1)]
    dynamics = ["y", ["+", ["*", "-1/2", ["sin", "x"]], "u"]] if n == 2 else [["+", ["/", "x", "2"], ["**", "x", 3], "u"]]
    P = np.array([[1.8, 0.5], [0.5, 0.9]]) if n == 2 else np.eye(1)
    c2 = float(rng.choice([0.01, 0.05, 0.2]))
    data = make(
        dynamics, [(np.zeros((1, n)), [0.0])], P, (c2 / float(rng.choice([1, 4, 16])), c2), states="xy"[:n],
        domain=[("-3", "3")] * n, **network_loops.PLAIN,
    )  # fmt: skip
    return grow(with_ball(network_loops.with_policy(data, steps)), max_leaves=300, depth=14)


def verdicts(data: Document) -> tuple[str, str]:
    """The rule at which each program stops, or ACCEPTED: the checker's, then the reference's."""
    raw = json.dumps(newer(data)).encode()
    return checked(raw) or "ACCEPTED", judge_bytes(raw) or "ACCEPTED"


ORIGINS: dict[str, tuple[Callable[[], Iterator[Named]], int]] = {  # and how often the two may differ
    "networks": (of_networks, 0),
    "rules and steps": (of_rules_and_steps, 0),
    "sets and tubes": (of_sets_and_tubes, 0),
    "chance": (of_chance, 0),
}


def compared(origin: str) -> Counter[str]:
    """How many both accept, how many both refuse, and on how many they differ."""
    found, apart = Counter[str](), list[str]()
    for name, data in ORIGINS[origin][0]():
        mine, theirs = verdicts(data())
        same = (mine == "ACCEPTED") == (theirs == "ACCEPTED")
        found["apart" if not same else "accepted" if mine == "ACCEPTED" else "refused"] += 1
        found["another rule"] += same and mine != theirs
        if not same:
            apart.append(f"{name}: {mine}, {theirs}")
    if apart:
        print("\n".join(apart))
    return found
