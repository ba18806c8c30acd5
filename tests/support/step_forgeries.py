"""Forgeries of certificates over steps, at a rate and around a level, by what they are made from: each with the rule
that must refuse it, in both checkers. What a reader must refuse comes first, then what a rule must."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np

from tests.support.balls import enlarged_from
from tests.support.certificates import LEAF, Document, decode, edited, encode, make, rehash, tree_of, with_tree
from tests.support.stepped_loops import WIDE, fitted, linear, saturated, turning

Edit = Callable[[Document], Document]
Forgery = tuple[str, str, Document]  # the rule, what it is, and the document
LOCAL = "evidence.local"


def _sampled(lo: str, hi: str) -> Document:
    """x' = x/2 - 3 x(t_k)."""
    return fitted(linear([["+", ["/", "x", "2"], "u"]], 3.0, sample=(lo, hi)), order=5)


def _discrete() -> Document:
    return fitted(linear([["+", ["*", "5/4", "x"], "u"]], 0.75, time="discrete"))


def _practical(kind: str) -> Document:
    """Around a level, with |w| <= 1/4, k = 1 and period 1/2 where there are steps: r > 1/4."""
    plant = [["+", "x", "u", "w"]] if kind == "discrete" else [["+", "u", "w"]]
    more: dict[str, Any] = {"sample": ("1/2", "1/2")} if kind == "held" else {"time": kind}
    k = 0.5 if kind == "discrete" else 1.0
    levels = (0.3, 0.5, 0.5) if kind == "discrete" else (0.08, 0.25, 0.25)
    data = linear(plant, k, levels, claim="practical", uncertain=[("w", "-1/4", "1/4")], **more)
    return fitted(data, edge=0.5 if kind == "discrete" else 1.0)


def _rated(kind: str) -> Document:
    """0.4 of a rate that may be 0.75 with a sample, 0.375 in discrete time and 1.5 in continuous time."""
    plant = [["+", "x", "u"]] if kind == "discrete" else ["u"]
    more: dict[str, Any] = {"sample": ("1/2", "1/2")} if kind == "held" else {"time": kind}
    return fitted(linear(plant, 3.0 if kind == "held" else 1.5, rate=0.3, **more))


def _ranges(kind: str) -> Document:
    """x' = q p x - x over ranges whose product is below 1, x+ = q p x - x/4, x' = q x(t_k) - x(t_k)."""
    if kind == "held":
        plant: list[Any] = [["+", ["*", "q", "x"], "u"]]
        return fitted(
            linear(plant, 1.0, uncertain=[("q", "0", "3/4")], cells=[2], sample=("1/8", "1/4")), order=4
        )  # fmt: skip
    term = ["*", "q", "p", "x"]
    ranges = [("q", "1/4", "1"), ("p", "-1/2", "3/4")]
    if kind == "discrete":
        return fitted(linear([["+", term, "u"]], 0.125, uncertain=ranges, cells=[2, 2], time="discrete"))
    return fitted(linear([["+", term, "u"]], 1.0, uncertain=ranges, cells=[2, 2]))


def _bent() -> Document:
    """x+ = x - tanh(x)/2 - x^3/8 in discrete time, on a ball alone."""
    plant = [["+", "x", ["*", "1/2", "u"], ["*", "-1/8", ["**", "x", 3]]]]
    return fitted(make(plant, [([[1.0]], [0.25])], 1.0, (0.25, 0.25), domain=WIDE, time="discrete"))


def _bent_held() -> Document:
    """x' = y, y' = sin(x) - y - 3 x(t_k) - y(t_k)."""
    plant = ["y", ["+", ["sin", "x"], ["-", "y"], "u"]]
    P = np.array([[2.0, 0.5], [0.5, 0.5]])
    return fitted(linear(plant, [[3.0, 1.0]], 0.0625, P=P, T=[[1.0, 0.0], [-1.0, 1.0]], sample=("1/8", "1/8")), order=4)


BASES: dict[str, Callable[[], Document]] = {
    "held": lambda: _sampled("1/8", "1/8"),
    "held, a range": lambda: _sampled("1/16", "1/8"),
    "held, from 0": lambda: _sampled("0", "1/8"),
    "discrete": _discrete,
    "practical": lambda: _practical("continuous"),
    "practical, held": lambda: _practical("held"),
    "practical, discrete": lambda: _practical("discrete"),
    "rate": lambda: _rated("continuous"),
    "rate, held": lambda: _rated("held"),
    "rate, discrete": lambda: _rated("discrete"),
    "ranges": lambda: _ranges("continuous"),
    "ranges, held": lambda: _ranges("held"),
    "ranges, discrete": lambda: _ranges("discrete"),
    "bent": _bent,
    "bent, held": _bent_held,
    "turning": lambda: turning(0.5).within(0.3),
    "ring, held": lambda: saturated("held").within(0.1),
    "ring, discrete": lambda: saturated("discrete").within(0.1),
}
HELD = tuple(name for name in BASES if "held" in name or name == "turning")
DISCRETE = tuple(name for name in BASES if "discrete" in name or name == "bent")
AROUND = tuple(name for name in BASES if "practical" in name)
RINGS = tuple(name for name in BASES if "ring" in name)


@cache
def base(name: str) -> Document:
    """An honest certificate. Shared between tests, which edit copies only."""
    return BASES[name]()


def at(path: str, value: Any) -> Edit:
    return lambda data: edited(data, path, value)


def without(path: str) -> Edit:
    section, key = path.rsplit(".", 1)
    return lambda data: edited(data, section, lambda old: {k: v for k, v in old.items() if k != key})


def array(path: str, change: Callable[[np.ndarray], Any]) -> Edit:
    return lambda data: edited(data, path, lambda text: encode(change(decode(text))))


def period(data: Document, factor: Fraction | int) -> Document:
    """The longest period times a factor, the shortest one too if it is the same."""
    lo, hi = (Fraction(q) for q in data["claim"]["sample"])
    return edited(data, "claim.sample", [str(hi * factor if lo == hi else lo), str(hi * factor)])


MALFORMED: dict[str, Edit] = {
    "rate below 0": at("claim.rate", (-(2.0**-60)).hex()),
    "infinite rate": at("claim.rate", "inf"),
    "rate that is no number": at("claim.rate", "nan"),
    "rate as a number": at("claim.rate", 0),
    "rate in decimals": at("claim.rate", "0.0"),
    "rate that is null": at("claim.rate", None),
    "no rate": without("claim.rate"),
    "rate as a rational": at("claim.rate", "1/2"),
    "no sample": without("claim.sample"),
    "sample of one number": at("claim.sample", ["1/8"]),
    "sample of three": at("claim.sample", ["1/8", "1/8", "1/8"]),
    "sample of none": at("claim.sample", []),
    "sample of 0": at("claim.sample", ["0", "0"]),
    "sample that falls": at("claim.sample", ["1/4", "1/8"]),
    "sample below 0": at("claim.sample", ["-1/8", "1/8"]),
    "sample of numbers": at("claim.sample", [0, 1]),
    "sample in decimals": at("claim.sample", ["0.125", "0.125"]),
    "sample as a number": at("claim.sample", "1/8"),
    "sample that is false": at("claim.sample", False),
    "time that is sampled": at("plant.time", "sampled"),
    "time that is null": at("plant.time", None),
    "time in capitals": at("plant.time", "Discrete"),
    "no time": without("plant.time"),
    "order 0": at("evidence.order", 0),
    "order 9": at("evidence.order", 9),
    "order below 0": at("evidence.order", -1),
    "order that is true": at("evidence.order", True),
    "order in words": at("evidence.order", "1"),
    "order that is null": at("evidence.order", None),
    "no order": without("evidence.order"),
    "order 0 on the ball": at(f"{LOCAL}.order", 0),
    "order 9 on the ball": at(f"{LOCAL}.order", 9),
    "order that is true on the ball": at(f"{LOCAL}.order", True),
    "no order on the ball": without(f"{LOCAL}.order"),
    "edge below 0": at(f"{LOCAL}.edge", (-0.5).hex()),
    "infinite edge": at(f"{LOCAL}.edge", "inf"),
    "edge that is no number": at(f"{LOCAL}.edge", "nan"),
    "edge that is null": at(f"{LOCAL}.edge", None),
    "no edge": without(f"{LOCAL}.edge"),
    "no level c1": without("levels.local"),
    "level c1 in decimals": at("levels.local", "0.25"),
    "a solver's word": at("evidence", {
        "kind": "trusted-solver", "solver": "s", "version": "1", "precision": "0x1.0000000000000p-10", "queries": []}),
    "a tube": lambda d: edited(d, "claim", lambda claim: enlarged_from([16.0]) | {"sample": claim["sample"]}),
}  # fmt: skip


def malformed() -> Iterator[Forgery]:
    for name in ("held", "discrete", "practical, held", "rate"):
        for what, edit in MALFORMED.items():
            yield "format", f"{name}: {what}", edit(base(name))
    for name in DISCRETE:
        yield "format", f"{name}: a sample", at("claim.sample", ["1/8", "1/8"])(base(name))
    for name in ("discrete", "rate", "ranges", "practical", "ring, discrete"):
        yield "format", f"{name}: order 2", at("evidence.order", 2)(base(name))
        yield "format", f"{name}: order 2 on the ball", at(f"{LOCAL}.order", 2)(base(name))
    for name in ("held", "discrete", "rate", "ranges", "ring, held"):
        yield "format", f"{name}: an edge", at(f"{LOCAL}.edge", (0.5).hex())(base(name))
        yield "format", f"{name}: a floor", at("levels", lambda v: {"floor": (0.01).hex(), **v})(base(name))
        yield "format", f"{name}: no ball", at(LOCAL, None)(base(name))
    for name in AROUND:
        yield "format", f"{name}: no floor", without("levels.floor")(base(name))
        yield "format", f"{name}: asymptotic", at("claim.kind", "asymptotic")(base(name))


def ruled() -> Iterator[Forgery]:
    """What a rule must refuse."""
    for name in BASES:
        data = base(name)
        n, c2 = len(data["plant"]["states"]), float.fromhex(data["levels"]["roa"])
        inner = "floor" if name in AROUND else "local"
        yield "hash", f"{name}: another gain", array("policy.layers.0.weight", lambda a: a * (1 + 2.0**-50))(data)
        yield "levels", f"{name}: level 0", at(f"levels.{inner}", (0.0).hex())(data)
        yield "levels", f"{name}: level above c2", at(f"levels.{inner}", (2 * c2).hex())(data)
        yield "lyapunov", f"{name}: -P", array("lyapunov.P", lambda a: -a)(data)
        yield "domain", f"{name}: a domain in {{V <= c2}}", at("plant.domain.0", ["-1/100", "99"])(data)
        yield "root", f"{name}: half a root box", array("evidence.root", lambda a: a / 2)(data)
        yield "coordinates", f"{name}: T of 0", array("evidence.T", lambda a: 0 * a)(data)
        yield "local", f"{name}: half a ball", array(f"{LOCAL}.J", lambda a: a / 2)(data)
        yield (
            "local",
            f"{name}: a multiplier below 0",
            array(f"{LOCAL}.multipliers", lambda a: np.append(-1.0, a[1:]))(data),
        )
        yield (
            "local", f"{name}: nothing divided by",
            array(f"{LOCAL}.multipliers", lambda a, n=n: np.append(a[:n], [0.0] * 2 * n))(data),
        )  # fmt: skip
        yield "local", f"{name}: multipliers of 10^100", array(f"{LOCAL}.multipliers", lambda a: 0 * a + 1e100)(data)
        yield "tree", f"{name}: a leaf behind", with_tree(data, tree_of(data) + bytes([LEAF]))
        if name not in AROUND:
            moved = at(f"plant.dynamics.{n - 1}", lambda tree: ["+", tree, "1/1000000"])(data)
            yield "equilibrium", f"{name}: moved", moved
            centred = data["policy"]["centre"] == "preactivation"
            change = at("policy.centre", "none") if centred else array("policy.offset", lambda a: a + 2.0**-60)
            yield "centring", f"{name}: moved input", rehash(change(data))
        if name == "ranges, discrete":  # where the input does little
            yield "local", f"{name}: a state more", at("plant.dynamics.0", lambda tree: ["+", tree, "x"])(data)
        else:
            yield "local", f"{name}: the other sign", rehash(array("policy.scale", lambda a: -a)(data))
        if name not in ("ranges, discrete", "practical, discrete"):
            yield (
                "local",
                f"{name}: no input",
                at("plant.dynamics", lambda trees: [_without_input(t) for t in trees])(data),
            )
        if data["policy"]["squash"] == "identity":
            yield "inputs", f"{name}: inputs within a hundredth", at("plant.input_bounds", [["-1/100", "1/100"]])(data)
    yield from _of_rates()
    yield from _of_samples()
    yield from _of_levels()
    yield from _of_ranges()
    yield from _of_rings()


def _without_input(tree: Any) -> Any:
    if tree == "u":
        return ["*", "0", "u"]
    return (
        tree
        if not isinstance(tree, list)
        else [tree[0], *(v if type(v) is int else _without_input(v) for v in tree[1:])]
    )


def _of_rates() -> Iterator[Forgery]:
    limits = {"rate": 1.5, "rate, held": 0.75, "rate, discrete": 0.375}
    for name, limit in limits.items():
        for factor in (1.0, 1.0001, 1.01, 1.04, 1.5, 10.0, 1e6, 1e300):
            yield "local", f"{name}: {factor} of the largest", at("claim.rate", (limit * factor).hex())(base(name))
    for name in ("held", "held, a range", "discrete", "ranges", "ranges, held", "bent", "bent, held", "turning"):
        for rate in (4.0, 100.0):
            yield "local", f"{name}: a rate of {rate}", at("claim.rate", rate.hex())(base(name))
    for name in AROUND:
        for rate in (1.0, 50.0):
            yield "local", f"{name}: a rate of {rate}", at("claim.rate", rate.hex())(base(name))
    for name in RINGS:
        for rate in (0.5, 3.0):
            yield "local", f"{name}: a rate of {rate}", at("claim.rate", rate.hex())(base(name))


def _of_samples() -> Iterator[Forgery]:
    for name in HELD:
        for factor in (50, 10**6, 10**300):  # the state of the last two does not move itself
            still = name == "practical, held" or (name, factor) == ("rate, held", 50)
            yield "local" if still else "flow", f"{name}: {float(factor)} times as long", period(base(name), factor)
        longer = edited(base(name), "claim.sample", lambda sample: [sample[0], str(10**4 * Fraction(sample[1]))])
        yield "local" if name == "practical, held" else "flow", f"{name}: up to 10^4 times as long", longer
        if name in RINGS:
            continue  # there f is known well enough: at the edge it points inwards
        half = Fraction(float(_reach(base(name)))) * Fraction(1000001, 1000000)
        near = [[str(-half), str(half)], *base(name)["plant"]["domain"][1:]]
        yield "flow", f"{name}: a domain that is as good as touched", at("plant.domain", near)(base(name))
    for name in ("held", "held, a range"):
        for factor in (Fraction(11, 2), 6, 7):  # e^(h/2) - 6 (e^(h/2) - 1) < -1 from h = 0.671 on
            yield "local", f"{name}: {factor} times as long", period(base(name), factor)
    for name in ("practical, held", "rate, held"):
        for factor in (5, 8):
            yield "local", f"{name}: {factor} times as long", period(base(name), factor)


def _reach(data: Document) -> float:
    """How far {V <= c2} goes along the first state."""
    P = decode(data["lyapunov"]["P"])
    n = round(len(P) ** 0.5)
    return float(np.sqrt(float.fromhex(data["levels"]["roa"]) * np.linalg.inv(P.reshape(n, n))[0, 0]))


def _of_levels() -> Iterator[Forgery]:
    """{|x| <= r} is kept for r > 1/4 (1/2 in discrete time), and an edge above 1/h says nothing of a step."""
    least = {"practical": 0.0625, "practical, held": 0.0625, "practical, discrete": 0.25}
    for name, level in least.items():
        for factor in (1.0, 0.9999, 0.99, 0.96, 0.8, 0.5, 1e-3, 1e-100):
            yield (
                "local",
                f"{name}: {factor} of the least floor",
                at("levels.floor", (level * factor).hex())(base(name)),
            )
        for edge in (0.0, 1e-9, 1e3, 1e300):
            yield "local", f"{name}: an edge of {edge}", at(f"{LOCAL}.edge", edge.hex())(base(name))
        yield "levels", f"{name}: no ball", at(LOCAL, None)(base(name))
        yield "levels", f"{name}: floor above c1", at("levels.floor", (0.6).hex())(base(name))
        ranges = edited(base(name), "plant.uncertain.0.range", ["-1/2", "1/4"])
        yield "local", f"{name}: more from below", ranges
        yield "local", f"{name}: more from above", edited(base(name), "plant.uncertain.0.range", ["-1/4", "3/4"])
        yield "local", f"{name}: moved", edited(base(name), "plant.dynamics.0", lambda tree: ["+", tree, "1/4"])
    for name, most in {"practical, held": 2.0, "practical, discrete": 1.0}.items():
        for edge in (np.nextafter(most, 9), most * 1.001, 2 * most):
            yield "local", f"{name}: an edge of {edge!r}, above 1/h", at(f"{LOCAL}.edge", float(edge).hex())(base(name))


def _of_ranges() -> Iterator[Forgery]:
    wider = {
        "ranges": (("0", ["1/4", "4/3"]), ("0", ["1/4", "2"]), ("1", ["-1/2", "1"]), ("1", ["-1/2", "101/100"]),
                   ("1", ["-1/2", "1" + "0" * 30]), ("0", ["1/4", "1" + "0" * 400])),
        "ranges, discrete": (("0", ["1/4", "3/2"]), ("1", ["-1/2", "9/8"]), ("1", ["-9/10", "3/4"]),
                             ("1", ["-7/8", "3/4"]),
                             ("0", ["-4", "1"]), ("1", ["-1" + "0" * 400, "3/4"])),
        "ranges, held": (("0", ["0", "1"]), ("0", ["0", "101/100"]), ("0", ["0", "5/4"]), ("0", ["0", "3/2"])),
    }  # fmt: skip
    for name, each in wider.items():
        for index, pair in each:
            yield (
                "local",
                f"{name}: {index} in {pair[0][:9]} to {pair[1][:9]}",
                edited(base(name), f"plant.uncertain.{index}.range", pair),
            )
    yield (
        "flow",
        "ranges, held: up to 10^30",
        edited(base("ranges, held"), "plant.uncertain.0.range", ["0", "1" + "0" * 30]),
    )
    yield (
        "flow",
        "ranges, held: from -10^400",
        edited(base("ranges, held"), "plant.uncertain.0.range", ["-1" + "0" * 400, "0"]),
    )


def _of_rings() -> Iterator[Forgery]:
    for name in RINGS:
        data = base(name)
        yield "ring", f"{name}: one leaf", with_tree(data, bytes([LEAF]))
        for share in (0.0001, 0.01, 0.04, 0.3):
            family = saturated(name.removeprefix("ring, "))
            yield "ring", f"{name}: beyond by {share}", family.beyond(share)
        for what, tree in {
            "no tree": b"",
            "cut": tree_of(data)[:-1],
            "another axis": bytes([1]) + tree_of(data),
        }.items():
            yield "tree", f"{name}: {what}", edited(data, "evidence.tree", base64.b64encode(tree).decode())


@cache
def forgeries() -> tuple[Forgery, ...]:
    return (*malformed(), *ruled())
