"""Both checkers accept a certificate or both refuse it: many certificates, of every kind of claim, by their origin.

Trees are grown with the checker's own leaf rule and hints fitted to its models, so that a certificate is seldom near a
limit that one program has and the other has not. Where it is, the two may differ: `APART` has those that are known.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from fractions import Fraction
from itertools import islice
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest

from certify.analysis.run import RoaOptions, certify_roa
from certify.checker.networks import Affine, Map, Step
from certify.checker.wiring import Clip, Observe
from certify.loop.plants import System, get_system, load_system
from certify.loop.policies import PolicyNetwork, load_policy
from certify.loop.policies.importers import ImportOptions, import_policy
from tests.checker.test_networks import a_network, checked
from tests.checker.test_rules import FALSE, HONEST, MUTANTS
from tests.checker.test_rules import honest as of_rules
from tests.reference import test_path, test_tube
from tests.support import network_loops, outer_loops, step_forgeries, stepped_loops
from tests.support.balls import with_ball
from tests.support.certificates import Document, edited, encode, grow, make
from tests.support.earlier import newer
from tests.support.foreign import TWO_STAGE, external
from tests.support.loops import saturated_lqr
from tests.support.network_loops import ACTIVATIONS, FORMS, KINDS
from tests.support.reference import judge_bytes
from tests.support.uncertain import random_plant

Named = tuple[str, Callable[[], Document | None]]  # None where nothing is proved
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
    steps = [
        *map(written, [*net.steps[:-1], small]),
        network_loops.affine(0, K),
        network_loops.joined("sum", count, count + 1),
    ]
    dynamics = (
        ["y", ["+", ["*", "-1/2", ["sin", "x"]], "u"]] if n == 2 else [["+", ["/", "x", "2"], ["**", "x", 3], "u"]]
    )
    P = np.array([[1.8, 0.5], [0.5, 0.9]]) if n == 2 else np.eye(1)
    c2 = float(rng.choice([0.01, 0.05, 0.2]))
    data = make(
        dynamics, [(np.zeros((1, n)), [0.0])], P, (c2 / float(rng.choice([1, 4, 16])), c2), states="xy"[:n],
        domain=[("-3", "3")] * n, **network_loops.PLAIN,
    )  # fmt: skip
    return grow(with_ball(network_loops.with_policy(data, steps)), max_leaves=300, depth=14)


def of_producer(folder: Path) -> Iterator[Named]:
    """Policies that ship, policies that were fitted, and policies that somebody else trained, as they are proved."""
    for path in sorted((EXAMPLES / "policies").glob("*.pt")):
        if path.stem not in LARGE:
            yield path.stem, lambda path=path: produced(folder, *example(path))
    system = get_system("pendulum")
    for name in (*ACTIVATIONS, "tanh"):
        for centre in ("preactivation", "output"):
            net = saturated_lqr(np.array([[2.8, 0.95]]), 6.0, 0.0, [2.0, 8.0], (8, 8), centre, 1, name)
            yield f"fitted, {name}, {centre}", lambda net=net: produced(folder, system, net)
    for what, options in OPTIONS.items():
        for name in ("pendulum", "van_der_pol"):
            read = example(EXAMPLES / "policies" / f"{name}.pt")
            yield f"{name}, {what}", lambda read=read, options=options: produced(folder, *read, **options)
    path, (plant, states, squash, scale, more) = external("two_stage", FOREIGN), TWO_STAGE[FOREIGN]
    if path is not None:
        system = get_system(plant).with_parameters(more)
        kept = ImportOptions(states=tuple(states.split(",")), squash=squash, action_scale=(Fraction(scale),))  # type: ignore[arg-type]
        network = import_policy(path, system, kept).policy.network
        yield f"external, {plant}", lambda: produced(folder, system, network)


FOREIGN = "pendulum_bigtorque_seed_0.pth"
OPTIONS: dict[str, dict[str, Any]] = {
    "practical": {"claim": "practical"},
    "nearby": {"claim": "nearby"},
    "a rate": {"rate": 0.01},
    "a level": {"level": 0.05, "candidate": "lyapunov"},
    "enlarged": {"level": 0.05, "candidate": "lyapunov", "enlarge": True},
}
LARGE = ("bicycle", "cartpole", "furuta", "quadrotor2d", "quadrotor3d")  # these take minutes


def example(path: Path) -> tuple[System, PolicyNetwork]:
    """A policy of `examples/` and its plant."""
    policy, plant = load_policy(path), EXAMPLES / "plants" / f"{path.stem}.toml"
    system = load_system(plant) if plant.exists() else get_system(path.stem)
    return system.with_parameters(policy.parameters), policy.network


def produced(folder: Path, system: System, network: PolicyNetwork, **options: Any) -> Document | None:
    """The certificate that a short run ends with, if any."""
    result = certify_roa(system, network, Path(mkdtemp(dir=folder)), RoaOptions(effort=0.1, **options))
    return None if result.certificate is None else dict(json.loads(result.certificate.read_text()))


def verdicts(data: Document) -> tuple[str, str]:
    """The rule at which each program stops, or ACCEPTED: the checker's, then the reference's."""
    raw = json.dumps(newer(data)).encode()
    return checked(raw) or "ACCEPTED", judge_bytes(raw) or "ACCEPTED"


ORIGINS: dict[str, Callable[[Path], Iterator[Named]]] = {
    "networks": lambda _: of_networks(),
    "rules and steps": lambda _: of_rules_and_steps(),
    "sets and tubes": lambda _: of_sets_and_tubes(),
    "chance": lambda _: of_chance(),
    "producer": of_producer,
}
APART: dict[str, tuple[str, str]] = {  # all of them true
    "range, held, k = 1.0, 1 cells, within 0.1": ("local", "ACCEPTED"),
    "plant 55": ("local", "ACCEPTED"),
    "network 9": ("local", "ACCEPTED"),  # corners of min, max and clip at rest, within a sum
    "network 138": ("local", "ACCEPTED"),
    "atan, c = 0.5, within": ("ACCEPTED", "outer"),  # a margin of a thousandth
}


def compared(origin: str, folder: Path, every: int = 1) -> Counter[str]:
    """How many both accept, how many both refuse, and those on which they differ; one of `every` is asked."""
    found = Counter[str]()
    for name, data in islice(ORIGINS[origin](folder), 0, None, every):
        made = data()
        if made is None:
            found["not proved"] += 1
            continue
        mine, theirs = verdicts(made)
        if (mine == "ACCEPTED") == (theirs == "ACCEPTED"):
            found["accepted" if mine == "ACCEPTED" else "refused"] += 1
            found["under another rule"] += mine != theirs
        else:
            found[f"{name}: {mine}, {theirs}"] += 1
    return found


FEW = {"networks": 25, "rules and steps": 19, "sets and tubes": 10, "chance": 30}
LEAST = {"networks": (480, 5), "rules and steps": (180, 400), "sets and tubes": (60, 59), "chance": (320, 60)}


@pytest.mark.parametrize("origin", FEW)
def test_some_certificates_have_one_verdict(origin: str, tmp_path: Path) -> None:
    found = compared(origin, tmp_path, FEW[origin])
    assert set(found) <= {"accepted", "refused", "under another rule"} and not found["under another rule"]
    assert found["accepted"] > 5


@pytest.mark.slow
@pytest.mark.parametrize("origin", ORIGINS)
def test_certificates_have_one_verdict(origin: str, tmp_path: Path) -> None:
    """More than 1,600 in all, of every kind of claim; where both refuse, under the same rule."""
    found = compared(origin, tmp_path)
    found.pop("not proved", 0)
    accepted, refused = found.pop("accepted"), found.pop("refused", 0)
    assert not found.pop("under another rule", 0)
    assert set(found) <= {f"{name}: {mine}, {theirs}" for name, (mine, theirs) in APART.items()}
    least = LEAST.get(origin, (25, 0))
    assert accepted >= least[0] and refused >= least[1]


def test_every_kind_of_claim_is_among_them() -> None:
    """And each is accepted by both, of networks that are no layers."""
    for kind in KINDS:
        data = newer(network_loops.honest("silu", "concat", kind))
        assert verdicts(data) == ("ACCEPTED", "ACCEPTED")
        stated = "outer" if data["claim"]["outer"] else "sampled" if data["claim"]["sample"] else data["claim"]["kind"]
        assert stated == kind or kind in ("rate", "discrete", "ranges")
