"""Forgeries of certificates whose policies have activations and steps of all kinds: each with the rule that must refuse
it, in both checkers. The bases are those of `network_loops.py`, claim `asymptotic`, unless a forgery says otherwise."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np

from tests.checker.test_networks import FUNCTIONS
from tests.support.certificates import LEAF, Document, decode, edited, encode, tree_of, with_tree
from tests.support.earlier import newer
from tests.support.network_loops import ACTIVATIONS, FORMS, GAIN, biases, hashed, honest, inputs, joined, mapped

Forgery = tuple[str, str, Document]  # the rule, what it is, and the document
Change = Callable[[Document], Any]
STEPS = "networks.0.steps"
UNKNOWN = (
    "swish",
    "leaky_relu",
    "RELU",
    "relu6",
    "hardtanh",
    "gelu_tanh",
    "selu",
    "softshrink",
    "abs",
    "tan",
    "1/",
    "",
)


def place(data: Document, kind: str) -> int:
    """The first step of that kind."""
    return next(k for k, step in enumerate(data["networks"][0]["steps"]) if step["kind"] == kind)


def step(data: Document, k: int, **values: Any) -> Document:
    """With other values of a step, the hash as it was."""
    return edited(data, f"{STEPS}.{k}", lambda old: {**old, **values})


def array(data: Document, k: int, key: str, change: Callable[[np.ndarray], Any]) -> Document:
    return edited(data, f"{STEPS}.{k}.{key}", lambda text: encode(change(decode(text))))


def steepness(data: Document) -> float:
    """The slope of the policy at the origin, in floats."""
    u, h = inputs(data), 1e-6
    return (u(h) - u(-h)) / (2 * h)


def unstable(data: Document) -> bool:
    """x' = x/2 + u moves away from 0."""
    return 0.5 + steepness(data) > 1e-3


def of_words(name: str, form: str) -> Iterator[Forgery]:
    """What the file says of steps is changed, and the hash is kept or not: `format` and `hash`."""
    data = newer(honest(name, form))
    own, count = data["networks"][0]["steps"], len(data["networks"][0]["steps"])
    at, last = place(data, "map"), count - (2 if own[-1]["kind"] == "sum" else 1)
    for other in (*ACTIVATIONS, "tanh", "sin", "exp"):
        if other != name:
            yield "hash", f"{other} in its place", step(data, at, function=other)
    for other in UNKNOWN:
        yield "format", f"a function {other!r}", hashed(step(data, at, function=other))
    yield "hash", "weights as good as the same", array(data, last, "weight", lambda a: a * (1 + 2.0**-50))
    yield "hash", "a bias as good as the same", array(data, place(data, "affine"), "bias", lambda a: np.nextafter(a, 9))
    yield "format", "a function that is null", step(data, at, function=None)
    yield "format", "a function in a list", step(data, at, function=[name])
    yield "format", "a map of itself", hashed(step(data, at, of=[at + 1]))
    yield "format", "a map of a later vector", hashed(step(data, at, of=[count]))
    yield "format", "a map of nothing", hashed(step(data, at, of=[]))
    yield "format", "a map of two", hashed(step(data, at, of=[at, at]))
    yield "format", "a map of the argument", hashed(step(data, at, of=[0]))  # of another width, or one is not read
    yield "format", "the activation is left out", hashed(left_out(data, at))
    yield (
        "format",
        "a step that nobody reads",
        hashed(edited(data, STEPS, lambda old: [*old[:-1], mapped(1, name), old[-1]])),
    )
    yield "format", "no number among the weights", hashed(array(data, last, "weight", lambda a: a * np.nan))
    yield "format", "a weight more", hashed(array(data, last, "weight", lambda a: np.append(a, 0.0)))
    yield "format", "axes exchanged", hashed(edited(data, f"{STEPS}.{last}.shape", lambda shape: shape[::-1]))
    yield "hash", "another squash", edited(data, "policy.squash", "tanh")
    yield "hash", "an activation twice", doubled(data, at, name)
    yield from {"clip": clips, "sum": sums, "concat": concats, "observe": observations, "chain": chains}[form](
        data, name
    )


def left_out(data: Document, k: int) -> Document:
    """Whoever reads step k reads the vector before it."""
    steps = [dict(step) for step in data["networks"][0]["steps"]]
    steps[k + 1] = {**steps[k + 1], "of": [i - (i == k + 1) for i in steps[k + 1]["of"]]}
    return edited(data, STEPS, steps)


def doubled(data: Document, k: int, name: str) -> Document:
    """The activation of the activation, under the hash of one."""
    steps = [dict(step) for step in data["networks"][0]["steps"]]
    moved = [{**step, "of": [i + (i > k) for i in step["of"]]} for step in steps[k + 1 :]]
    return edited(data, STEPS, [*steps[: k + 1], mapped(k + 1, name), *moved])


def chains(data: Document, name: str) -> Iterator[Forgery]:
    yield "hash", "a clip that never acts", edited(data, STEPS, lambda old: [
        *old, {"kind": "clip", "of": [3], "lo": encode([-99.0]), "hi": encode([99.0])}])  # fmt: skip
    yield "format", "a sum of one", hashed(edited(data, STEPS, lambda old: [*old, joined("sum", 3)]))
    yield "hash", "a sum with itself", edited(data, STEPS, lambda old: [*old, joined("sum", 3, 3)])


def clips(data: Document, name: str) -> Iterator[Forgery]:
    k = place(data, "clip")
    ends = data["networks"][0]["steps"][k]
    yield "format", "ends exchanged", hashed(step(data, k, lo=ends["hi"], hi=ends["lo"]))
    yield "format", "one end twice", hashed(step(data, k, lo=ends["hi"]))
    first = array(data, k, "lo", lambda a: np.append(a[0] + 1, a[1:]))
    yield "format", "one pair of ends exchanged", hashed(array(first, k, "hi", lambda a: np.append(a[0] - 1, a[1:])))
    yield "format", "an end less", hashed(array(data, k, "hi", lambda a: a[:-1]))
    yield "format", "an infinite end", hashed(array(data, k, "hi", lambda a: a * np.inf))
    yield "format", "ends null", step(data, k, lo=None, hi=None)
    yield "hash", "wider", array(data, k, "hi", lambda a: a + 2.0**-40)
    yield "hash", "narrower", array(data, k, "lo", lambda a: a + 2.0**-40)


def sums(data: Document, name: str) -> Iterator[Forgery]:
    k = place(data, "sum")
    yield "hash", "in another order", step(data, k, of=[4, 1])
    yield "hash", "one term twice", step(data, k, of=[1, 4, 4])
    yield "format", "of unequal vectors", hashed(step(data, k, of=[1, 4, 3]))
    yield "format", "of one", hashed(step(data, k, of=[4]))
    yield "format", "of itself", hashed(step(data, k, of=[1, 4, 5]))
    yield "format", "the same term in place of both", hashed(step(data, k, of=[4, 4]))
    yield "format", "a concat in its place", hashed(step(data, k, kind="concat"))


def concats(data: Document, name: str) -> Iterator[Forgery]:
    k = place(data, "concat")
    yield "hash", "in another order", step(data, k, of=[2, 0])
    yield "format", "one part more", hashed(step(data, k, of=[0, 2, 0]))
    yield "format", "of one", hashed(step(data, k, of=[2]))
    yield "format", "of itself", hashed(step(data, k, of=[0, 2, 3]))
    yield "format", "a sum in its place", hashed(step(data, k, kind="sum"))


def observations(data: Document, name: str) -> Iterator[Forgery]:
    def seen(tree: Any) -> Document:
        return hashed(edited(data, f"{STEPS}.0.expressions.0", tree))

    yield "hash", "cos in place of sin", edited(data, f"{STEPS}.0.expressions.0.0", "cos")
    yield "hash", "another name", edited(edited(data, f"{STEPS}.0.names", ["y"]), f"{STEPS}.0.expressions", [
        ["sin", "y"], ["*", "y", ["cos", "y"]], ["-", ["sqrt", ["+", "1", ["*", "1", "y"]]], "1"]])  # fmt: skip
    yield "hash", "the same in other words", edited(data, f"{STEPS}.0.expressions.0", ["+", ["sin", "x"]])
    yield "format", "a name that there is not", seen(["sin", "y"])
    yield "format", "an input", seen(["+", "x", "u"])
    yield "format", "a call", seen(["network", "policy", 0, "x"])
    yield "format", "an activation", seen([name, "x"])
    yield "format", "a decimal", hashed(edited(data, f"{STEPS}.0.expressions.0", ["*", "0.5", "x"]))
    yield "format", "one observation less", hashed(edited(data, f"{STEPS}.0.expressions", lambda old: old[:-1]))
    yield "format", "two names", hashed(edited(data, f"{STEPS}.0.names", ["x", "y"]))
    yield "format", "no names", hashed(edited(data, f"{STEPS}.0.names", []))


def of_loops(name: str, form: str) -> Iterator[Forgery]:
    """Another policy under its own hash, whose loop is not stable, or that no model has: `local` and others."""
    data = newer(honest(name, form))
    own = data["networks"][0]["steps"]
    at, first = place(data, "map"), place(data, "affine") if form != "sum" else 1
    last = len(own) - (2 if own[-1]["kind"] == "sum" else 1)
    swaps = [hashed(step(data, at, function=other)) for other in (*ACTIVATIONS, "tanh", "sin", "cos", "exp", "atan")]
    for other, forged in zip((*ACTIVATIONS, "tanh", "sin", "cos", "exp", "atan"), swaps, strict=True):
        if other != name and form != "clip" and unstable(forged):
            yield "local", f"{other} in its place, under its hash", forged
    flipped = array(data, last, "weight", lambda a: -a)
    yield "local", "the opposite weights", hashed(flipped)
    skips = (0, last) if form == "sum" else (last,)

    def scaled(by: float) -> Document:
        """The policy times a number."""
        found = data
        for k in skips:
            found = array(found, k, "weight", lambda a: by * a)
        return hashed(found)

    yield "local", "no weights", scaled(0.0)
    if form != "clip":
        yield "local", "a gain that is too small by a little", scaled(0.5 / GAIN - 1e-3)
    asleep = hashed(array(data, first, "bias", lambda a: a - 12.0))
    if form != "clip" and unstable(asleep):
        yield "local", "all units asleep", asleep
    if name == "relu" and form != "clip":
        yield "inputs", "kinks in the ball's middle", hashed(array(data, first, "bias", lambda a: 0 * a))
        near = hashed(array(data, first, "bias", lambda a: a * 0 - 2.0**-10))
        if unstable(near):
            yield "local", "kinks beside the ball's middle", near
    if form == "clip":
        k = place(data, "clip")
        phi = FUNCTIONS[name](biases(name))
        yield "inputs", "a clip that acts around the middle", hashed(
            array(array(data, k, "lo", lambda a: phi - 2.0**-20), k, "hi", lambda a: phi + 2.0**-20))  # fmt: skip
        low = array(data, k, "lo", lambda a: phi - 9)
        yield "local", "a clip below all", hashed(array(low, k, "hi", lambda a: phi - 8))
        yield "inputs", "a clip beside the middle", hashed(array(data, k, "hi", lambda a: phi + 2.0**-8))
    if form == "sum":
        k = place(data, "sum")
        other = hashed(step(data, k, of=[1, 4] + [4] * 2))
        if unstable(other):
            yield "local", "a term three times", other
        turned = hashed(array(array(data, 0, "weight", lambda a: -a), 3, "weight", lambda a: a * 0.5))
        yield "local", "the skip's other sign", turned
    if form == "concat":
        turned = hashed(array(data, last, "weight", lambda a: np.append(-a[0], a[1:] / 4)))
        yield "local", "the skip's other sign", turned
        yield "local", "weights in another order", hashed(array(data, last, "weight", lambda a: np.roll(a, 1)))
    if form == "observe":
        for what, tree in (
            ("a root beyond 0", ["sqrt", ["-", "x", "1"]]),
            ("a root of 0", ["sqrt", ["*", "x", "x"]]),
            ("a division by 0", ["/", "1", "x"]),
            ("a wild one", ["*", "x", "x", ["exp", ["*", "60", "x"]]]),
        ):
            yield "inputs", what, hashed(edited(data, f"{STEPS}.0.expressions.0", tree))
        yield "local", "a corner in the middle", hashed(edited(data, f"{STEPS}.0.expressions.0", ["abs", "x"]))
        yield "local", "what is seen turned round", hashed(
            edited(data, f"{STEPS}.0.expressions", lambda old: [["-", tree] for tree in old]))  # fmt: skip
    moved = array(data, last, "bias", lambda a: a + 2.0**-9)
    yield "centring", "no centring", hashed(edited(moved, "policy.centre", "none"))


def of_evidence(name: str, form: str) -> Iterator[Forgery]:
    """Levels, tree, ball and plant, for a policy that is as it was."""
    data = newer(honest(name, form))
    tree = tree_of(data)
    yield "levels", "c1 above c2", edited(data, "levels.local", (0.2).hex())
    yield "levels", "c1 = 0", edited(data, "levels.local", (0.0).hex())
    yield "domain", "c2 beyond the domain", edited(data, "levels.roa", (0.82).hex())
    yield "root", "c2 a little higher", edited(data, "levels.roa", (0.1 * (1 + 2.0**-40)).hex())
    yield "local", "c1 a little higher", edited(data, "levels.local", (0.01 * (1 + 1e-5)).hex())
    yield "tree", "a leaf less", with_tree(data, tree[:-1])
    yield "tree", "a leaf more", with_tree(data, tree + bytes([LEAF]))
    yield "tree", "another axis", with_tree(data, bytes([1]) + bytes([LEAF, LEAF]))
    yield "lyapunov", "-P", edited(data, "lyapunov.P", encode([-1.0]))
    yield "coordinates", "T = 0", edited(data, "evidence.T", encode([0.0]))
    yield "equilibrium", "a plant that moves", edited(data, "plant.dynamics.0", lambda old: [*old, "1/1000000"])
    yield "local", "a smaller ball", edited(data, "evidence.local.J", encode([0.0999]))
    yield "local", "a multiplier below 0", edited(data, "evidence.local.multipliers", encode([-1.0, 1.0, 1.0]))
    yield "inputs", "narrower inputs", edited(data, "plant.input_bounds", [["-1/100", "1/100"]])
    yield "local", "a plant that is faster", edited(data, "plant.dynamics.0", lambda old: [*old, "x"])
    high = edited(edited(data, "evidence.root", encode([1.25])), "plant.domain", [["-2", "2"]])
    beyond = edited(high, "levels.roa", (1.5).hex())
    yield "inputs" if form == "observe" else "ring", "beyond another equilibrium", beyond  # or of the root of 1 + x
    cube = ["*", "20", ["**", "x", 3]]
    yield "ring", "a push at the end of the ring", edited(data, "plant.dynamics.0", lambda old: [*old, cube])
    cube = ["*", "5", ["**", "x", 3]]  # the claim stays true
    yield "ring", "one leaf", edited(with_tree(data, bytes([LEAF])), "plant.dynamics.0", lambda old: [*old, cube])


def of_claims(name: str, form: str) -> Iterator[Forgery]:
    """The same with other claims: a little more than is true, or the activation of N for another."""

    def base(kind: str) -> Document:
        return newer(honest(name, form, kind))

    for rate in (1.0, 1.1, 50.0):
        yield "local", f"a rate of {rate}", edited(base("rate"), "claim.rate", rate.hex())
    for kind in ("practical", "nearby"):
        data = base(kind)
        for floor in (2.0**-12, 1e-5):
            yield "local", f"{kind}: a floor within reach of the disturbance, {floor}", edited(
                data, "levels.floor", floor.hex())  # fmt: skip
        yield "local", f"{kind}: five times the disturbance", edited(data, "plant.uncertain.0.range", ["-1/8", "1/8"])
        yield "format", f"{kind}: no floor", edited(data, "levels", lambda old: {k: old[k] for k in ("local", "roa")})
    data = base("nearby")
    yield "contraction", "a small ball", edited(data, "evidence.contraction.J", encode([0.09]))
    yield "contraction", "no weight", edited(data, "evidence.contraction.weights", encode([0.0]))
    yield "contraction", "a large weight", edited(data, "evidence.contraction.weights", encode([1.0]))
    data = base("sampled")
    yield "format", "order 9", edited(data, "evidence.order", 9)
    yield "flow", "a period of 3", edited(edited(data, "claim.sample", ["3", "3"]), "plant.domain", [["-99", "99"]])
    data = base("discrete")
    yield "local", "ten times the step", edited(data, "plant.dynamics.0.2.2", "2/5")
    data = base("ranges")
    yield "local", "a wider range", edited(data, "plant.uncertain.0.range", ["1/4", "7/4"])
    data = base("enlarged")
    yield "tube", "slabs too fast", edited(data, "evidence.tube", lambda old: [
        {**slab, "duration": (0.01).hex()} for slab in old])  # fmt: skip
    yield "tube", "a slab less", edited(data, "evidence.tube", lambda old: old[1:])
    yield "tube", "a larger start", edited(data, "claim.start", encode([1.0]))
    if form == "clip":
        return
    data = base("reached")
    yield "tube", "slabs along a path that are too fast", edited(data, "evidence.tube", lambda old: [
        {**slab, "duration": (0.02).hex()} for slab in old])  # fmt: skip
    yield "tube", "another centre", edited(data, "claim.centre", encode([0.4]))
    yield "tube", "a slab of the path less", edited(data, "evidence.tube", lambda old: old[:-9])
    data = base("outer")
    level = float.fromhex(data["claim"]["outer"]["level"])
    yield "faces", "N up to the domain", edited(data, "claim.outer.level", (level + 1.0).hex())
    yield "outer", "one leaf", edited(data, "evidence.outer.tree", "/w==")
    yield "outer", "a push beyond the ellipsoid", edited(
        data, "plant.dynamics.0", lambda old: [*old, ["*", "5", ["**", "x", 3]]])  # fmt: skip
    if level > 0:  # else there is no state where -N is as low as that
        yield "faces", "-N", edited(data, "networks.1.steps.2.weight", lambda text: encode(-decode(text)))


GROUPS = {"words": of_words, "loops": of_loops, "evidence": of_evidence, "claims": of_claims}


ALL = tuple((name, form) for name in ACTIVATIONS for form in FORMS)
FEW = {"words": ALL, "loops": ALL, "evidence": ALL[::6], "claims": ALL[3::20]}  # seven, with each form; two


@cache
def forgeries(group: str, few: bool) -> tuple[Forgery, ...]:
    """Those that are asked by default, or the others."""
    found = list[Forgery]()
    for name, form in ALL:
        if ((name, form) in FEW[group]) is few:
            found += [(rule, f"{name}, {form}: {what}", data) for rule, what, data in GROUPS[group](name, form)]
    return tuple(found)
