"""Certificates of sets that are never left: four small loops, forgeries of their certificates by what they are made
from, and violations planted into loops whose sets are else true."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np

from certify.certificates import InvariantCertificate
from certify.certificates.claims import Invariant
from certify.effort import WHOLE, Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, Number, exp, symbols
from certify.loop.plants.system import System, exact
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import Neural, Symbolic
from certify.provers.base import Budget
from certify.provers.execution import ThreadRunner
from certify.provers.outer import Nothing, StayProof, prove_staying
from tests.support.certificates import LEAF, Document, decode, edited, encode, rehash
from tests.support.outer import packed, unpacked

X, Y, U, Q = symbols(["x", "y", "u", "q"])
RADIUS = X**2 + Y**2
ANNULUS = (RADIUS - 1) ** 2
Edit = Callable[[Document], Document]
Forgery = tuple[str, str, Document]  # the rule, what it is, and the document
OUTER, EVIDENCE = "claim.outer", "evidence.outer"


def plant(
    dynamics: Sequence[Expression],
    half: Sequence[str],
    keep: Sequence[Expression] = (),
    bounds: tuple[str, str] = ("-1", "1"),
    ranges: dict[str, tuple[Fraction, Fraction]] | None = None,
) -> System:
    """A plant of x, or of x and y, with the input u."""
    return System(
        name="staying",
        states=(X, Y)[: len(dynamics)],
        inputs=(U,),
        parameters={},
        dynamics=tuple(dynamics),
        u_eq=(Number(0),),
        domain=tuple((exact(f"-{h}"), exact(h)) for h in half),
        input_bounds=((exact(bounds[0]), exact(bounds[1])),),
        disturbances=(Q,) if ranges else (),
        ranges=ranges or {},
        constraints={f"c{k}": g for k, g in enumerate(keep)},
    )


def policy(row: Sequence[float], squash: Any = "tanh") -> PolicyNetwork:
    """u = tanh of a linear function of the states, or that itself."""
    return PolicyNetwork.of_layers([[list(row)]], [[0.0]], [1.0], [0.0], squash=squash, centre="none")


def ring(
    keep: Sequence[Expression] = (), more: Sequence[Expression] = (Number(0), Number(0)), half: str = "2"
) -> System:
    """x' = y + x (1 - r^2), y' = -x + y (1 - r^2) + u/10 and more: to the unit circle."""
    inwards = 1 - RADIUS
    f = (Y + X * inwards + more[0], -X + Y * inwards + U / 10 + more[1])
    return plant(f, (half, half), keep)


def proof(
    system: System, network: PolicyNetwork, N: Expression | Neural, level: float | None, effort: float = 0.2
) -> StayProof | Nothing:
    """The search's answer for one level, or for any."""
    function = N if isinstance(N, Neural) else Symbolic(N, system.states)
    keep = tuple(system.constraints.values())
    return prove_staying(
        ClosedLoop(system, network), keep, function, level, Budget(Effort(effort * WHOLE)), ThreadRunner()
    )


def document(system: System, network: PolicyNetwork, found: StayProof | Nothing) -> Document:
    """The certificate of what was found, as JSON has it."""
    assert isinstance(found, StayProof), found
    claim = Invariant(found.outer, tuple(system.constraints.values()))
    data: Document = json.loads(InvariantCertificate(system, network, claim, found.evidence).to_json())
    return data


WELL = Neural(
    (np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]), np.ones((1, 4))), (-np.ones(4), np.zeros(1))
)
"""The sum of tanh(x - 1), tanh(-x - 1) and the same of y: least at 0."""


def _annulus() -> Document:
    system, network = ring([Number(Fraction(1, 20)) - RADIUS]), policy([0.0, -1.0])
    return document(system, network, proof(system, network, ANNULUS, 0.5))


def _interval() -> Document:
    system = plant(
        [-X + Q + U], ["2"], [X - Number(Fraction(3, 4)), U * Q - 1], ranges={"q": (Fraction(-1, 4), Fraction(1, 4))}
    )
    return document(system, policy([-0.5]), proof(system, policy([-0.5]), X**2, 0.25))


def _network() -> Document:
    system, network = plant([-X + Y / 4 + U, -Y - X / 4], ["3", "3"]), policy([-0.25, 0.0])
    return document(system, network, proof(system, network, WELL, -2.0))


def _unbounded() -> Document:
    """u = -x/2 itself, whose bounds 1 and -1 its enclosure shows."""
    system, network = plant([X / 4 + U], ["2"], bounds=("-1", "1")), policy([-0.5], "identity")
    return document(system, network, proof(system, network, X**2, 1.0))


BASES: dict[str, Callable[[], Document]] = {
    "an annulus": _annulus,
    "an interval": _interval,
    "a network": _network,
    "inputs enclosed": _unbounded,
}


@cache
def _made(name: str) -> str:
    return json.dumps(BASES[name]())


def base(name: str) -> Document:
    """A fresh copy of an honest certificate."""
    data: Document = json.loads(_made(name))
    return data


# ------------------------------------------------------------------------------------------------------- the forgeries


def at(path: str, value: Any) -> Edit:
    return lambda data: edited(data, path, value)


def without(path: str) -> Edit:
    def edit(data: Document) -> Document:
        result = json.loads(json.dumps(data))
        *way, last = path.split(".")
        place = result
        for key in way:
            place = place[int(key)] if isinstance(place, list) else place[key]
        del place[last]
        return dict(result)

    return edit


def malformed(data: Document) -> Iterator[tuple[str, str, Edit]]:
    """What a reader must refuse."""
    n, leaf = len(data["plant"]["states"]), packed(bytes([LEAF]))
    outer = data["claim"]["outer"]
    more = {"rate": (0.0).hex(), "sample": None, "target": ["x"], "start": "", "other": 1}
    for key, value in {**more, "ranks": {"angles": [], "steps": 1}}.items():
        yield "format", f"claim with {key}", at(f"claim.{key}", value)
    for kind in ("reaches", "asymptotic", "practical", "Invariant", "", None, 1, ["invariant"]):
        yield "format", f"kind {kind!r}", at("claim.kind", kind)
    yield "format", "no set", at(OUTER, None)
    yield "format", "set missing", without(OUTER)
    for level in ("0x1.0p+0", "1.0", "inf", "nan", 1.0, None, (1e308).hex().replace("p", "p+9"), "-0x0.0p+0 "):
        yield "format", f"level {level!r}", at(f"{OUTER}.level", level)
    for tree in ("u", "z", ["+"], ["sin"], ["network", "missing", 0, "x"], None, 1.5, ["**", "x", 65], ["max", "x"]):
        yield "format", f"expression {tree!r}", at(f"{OUTER}.expression", tree)
    yield "format", "level missing", without(f"{OUTER}.level")
    yield "format", "a set with more", at(f"{OUTER}.more", 0)
    for keep in ([], ["x"] * 65, "x", [["network", "policy", 0, *data["plant"]["states"]]], [["-", "z"]], None):
        yield "format", f"keep {keep!s:.20}", at("claim.keep", keep)
    yield "format", "a V", at("lyapunov", {"kind": "quadratic", "P": encode(np.eye(n))})
    yield "format", "levels", at("levels", {"local": (1.0).hex(), "roa": (1.0).hex()})
    yield "format", "a level", at("levels", {"roa": (1.0).hex()})
    for kind in ("partition-tree", "ranks", "trusted-solver", "invariant", None):
        yield "format", f"evidence {kind}", at("evidence.kind", kind)
    yield "format", "an order", at("evidence.order", 1)
    yield "format", "no evidence", at(EVIDENCE, None)
    for key in ("T", "root", "tree", "faces"):
        yield "format", f"no {key}", without(f"{EVIDENCE}.{key}")
    faces = data["evidence"]["outer"]["faces"]
    yield "format", "a face less", at(f"{EVIDENCE}.faces", faces[:-1])
    yield "format", "a face more", at(f"{EVIDENCE}.faces", [*faces, leaf])
    yield "format", "T of another shape", at(f"{EVIDENCE}.T", encode(np.eye(n + 1)))
    yield "format", "T not finite", at(f"{EVIDENCE}.T", encode(np.full((n, n), np.nan)))
    yield "format", "a root less", at(f"{EVIDENCE}.root", encode(np.ones(n - 1)))
    yield "format", "no base64", at(f"{EVIDENCE}.tree", "?")
    yield "format", "discrete time", at("plant.time", "discrete")
    yield "format", "an origin", at("policy.origin", encode(np.full(n, 0.5)))
    yield "hash", "another weight", at("policy.scale", encode([0.5]))
    if outer["expression"][:1] == ["network"]:
        yield "format", "another entry", at(f"{OUTER}.expression.2", 1)
        yield "format", "an argument less", at(f"{OUTER}.expression", outer["expression"][:-1])


def _first(data: Document) -> str:
    """The rule that comes first on a leaf on which nothing can be shown."""
    return "inputs" if data["policy"]["squash"] == "identity" else "keep" if "keep" in data["claim"] else "outer"


def uncovered(data: Document) -> Iterator[tuple[str, str, Edit]]:
    """Trees, coordinates and roots that do not cover what they must."""
    n, evidence = len(data["plant"]["states"]), data["evidence"]["outer"]
    tree = unpacked(evidence["tree"])
    yield _first(data), "a tree of one leaf", at(f"{EVIDENCE}.tree", packed(bytes([LEAF])))
    for what, octets in {
        "truncated": tree[:-1], "with a leaf more": tree + bytes([LEAF]), "empty": b"",
        "with an unknown axis": bytes([n]) + tree[1:], "of deep splits": bytes([0]) * 5000,
    }.items():  # fmt: skip
        yield "outer", f"a tree {what}", at(f"{EVIDENCE}.tree", packed(octets))
    T, root = decode(evidence["T"]).reshape(n, n), decode(evidence["root"])
    yield "outer", "T singular", at(f"{EVIDENCE}.T", encode(np.zeros((n, n))))
    yield "outer", "a root too small", at(f"{EVIDENCE}.root", encode(root * 0.999))
    yield "outer", "a root of 0", at(f"{EVIDENCE}.root", encode(root * 0))
    yield "outer", "a negative root", at(f"{EVIDENCE}.root", encode(-root))
    yield "outer", "T shrunk", at(f"{EVIDENCE}.T", encode(T * 0.5))
    for k, face in enumerate(evidence["faces"]):
        own = unpacked(face)
        yield "faces", f"face {k} with a leaf more", at(f"{EVIDENCE}.faces.{k}", packed(own + bytes([LEAF])))
        yield "faces", f"face {k} empty", at(f"{EVIDENCE}.faces.{k}", packed(b""))
        across = bytes([k // 2, LEAF, LEAF])
        yield "faces", f"face {k} split along itself", at(f"{EVIDENCE}.faces.{k}", packed(across))


def raised(level: float) -> Edit:
    return at(f"{OUTER}.level", float(level).hex())


def added(entry: int, tree: Any) -> Edit:
    """More in an equation."""
    return lambda data: edited(data, f"plant.dynamics.{entry}", ["+", data["plant"]["dynamics"][entry], tree])


def false_annulus() -> Iterator[tuple[str, str, Edit]]:
    """N is (x^2 + y^2 - 1)^2, the level 1/2."""
    yield "faces", "a level beyond the domain", raised(9.5)
    yield "faces", "a level that touches a face", raised(9.0)
    yield "outer", "the origin at the level", lambda d: without("claim.keep")(raised(1.0)(d))
    yield "outer", "the circle alone", raised(0.0)
    yield "outer", "outwards", lambda d: edited(d, "plant.dynamics.0", ["+", "y", "x"])
    yield (
        "outer",
        "a leak at the right",
        added(0, ["exp", ["*", "-40", ["+", ["**", ["-", "x", "13/10"], 2], ["**", "y", 2]]]]),
    )
    yield "outer", "a pole in the set", added(0, ["/", "0", ["-", "x", "1"]])
    yield "outer", "a root in the set", added(1, ["*", "0", ["sqrt", ["-", "1", "x"]]])
    yield (
        "outer",
        "N with a corner",
        at(f"{OUTER}.expression", ["abs", ["-", ["+", ["**", "x", 2], ["**", "y", 2]], "1"]]),
    )
    more = ["*", "0", ["sqrt", ["-", "x", "1"]]]
    yield (
        "faces",
        "N without a value",
        lambda d: edited(d, f"{OUTER}.expression", ["+", d["claim"]["outer"]["expression"], more]),
    )
    yield "faces", "N low", at(f"{OUTER}.expression", "0")
    yield "faces", "N a state", at(f"{OUTER}.expression", "x")
    for share in ("33/100", "3/10", "35/100"):
        yield "keep", f"a hole of {share}", at("claim.keep.0", ["-", share, ["+", ["**", "x", 2], ["**", "y", 2]]])
    edge = Fraction(*float(np.sqrt(1 + np.sqrt(0.5))).as_integer_ratio())
    touching = ["-", ["**", str(Fraction(1, 2) + Fraction(1, 10**6)), 2],
                ["+", ["**", ["-", "x", str(edge + Fraction(1, 2))], 2], ["**", "y", 2]]]  # fmt: skip
    yield "keep", "an obstacle that is touched by 1e-6", at("claim.keep.0", touching)
    yield "keep", "a wall", at("claim.keep.0", ["-", "x", "1"])
    yield "keep", "the input", at("claim.keep.0", ["-", "u", "1/2"])
    yield "keep", "a pole", at("claim.keep.0", ["-", ["/", "0", "x"], "1"])
    yield "keep", "0", at("claim.keep.0", "0")
    yield "outer", "a disc with a hole", lambda d: without("claim.keep")(raised(1.2)(d))


def false_interval() -> Iterator[tuple[str, str, Edit]]:
    """x' = -x + q + u, u = -tanh(x/2), |q| <= 1/4, N = x^2, the level 1/4."""
    yield "faces", "a level at the domain's end", raised(4.0)
    yield "outer", "a level that q carries over", raised(0.02)
    yield "outer", "q larger", at("plant.uncertain.0.range", ["-1/4", "8/10"])
    yield "outer", "q below", at("plant.uncertain.0.range", ["-8/10", "1/4"])
    yield "keep", "a wall in the set", at("claim.keep.0", ["-", "x", "2/5"])
    yield "keep", "a wall touched by 1e-6", at("claim.keep.0", ["-", "x", "499999/1000000"])
    yield "keep", "what q violates", at("claim.keep.1", ["-", "q", "249999/1000000"])
    yield "keep", "what u violates", at("claim.keep.1", ["-", "u", "1/5"])
    yield "outer", "no policy", lambda d: rehash(edited(d, "policy.scale", encode([-2.0])))
    yield "outer", "the origin alone", raised(0.0)


def false_network() -> Iterator[tuple[str, str, Edit]]:
    """N is the sum of four tanh, the level -2."""
    yield "faces", "a level that a face has", raised(-1.0)
    yield "faces", "a high level", raised(10.0)
    yield "outer", "outwards", lambda d: edited(d, "plant.dynamics.1", "y")
    yield "outer", "no motion", at("plant.dynamics", ["0", "0"])
    yield "outer", "sideways", lambda d: edited(d, "plant.dynamics.0", ["*", "8", "y"])
    yield "keep", "a wall", at("claim.keep", [["-", "x", "1/2"]])
    yield "outer", "a low level", raised(-3.04)


def false_inputs() -> Iterator[tuple[str, str, Edit]]:
    """x' = x/4 + u, u = -x/2, N = x^2, the level 1."""
    yield "inputs", "bounds that are exceeded", at("plant.input_bounds.0", ["-1/2", "4999/10000"])
    yield "inputs", "bounds below", at("plant.input_bounds.0", ["-2/5", "1"])
    yield "outer", "a gain too small", lambda d: rehash(edited(d, "policy.scale", encode([0.4])))
    yield "outer", "a gain of the other sign", lambda d: rehash(edited(d, "policy.scale", encode([-0.4])))
    yield "inputs", "a gain too large", lambda d: rehash(edited(d, "policy.scale", encode([2.5])))
    clip = at("policy.clip", [encode([-0.2]), encode([0.2])])
    yield "outer", "a clip", lambda d: rehash(clip(d))
    centred = at("policy.centre", "output")
    off = at("policy.clip", [encode([0.5]), encode([0.75])])
    yield "centring", "u_eq beyond the clip", lambda d: rehash(off(centred(d)))


_FALSE: dict[str, Callable[[], Iterator[tuple[str, str, Edit]]]] = {
    "an annulus": false_annulus,
    "an interval": false_interval,
    "a network": false_network,
    "inputs enclosed": false_inputs,
}


@cache
def forgeries() -> tuple[Forgery, ...]:
    """Each with the rule that must refuse it."""
    found = []
    for name in BASES:
        data = base(name)
        of = itertools.chain(
            malformed(data) if name in ("an annulus", "a network") else (), uncovered(data), _FALSE[name]()
        )
        found += [(rule, f"{name}: {what}", edit(base(name))) for rule, what, edit in of]
    return tuple(found)


# ----------------------------------------------------------------------------------------------------- what is planted

BY = 1e-6  # by how much a planted violation violates


def radius_at(level: float) -> float:
    """The outer radius of the annulus."""
    return float(np.sqrt(1 + np.sqrt(level)))


def obstacle(angle: float, by: float = BY) -> System:
    """The annulus up to 1/2, and a round obstacle that reaches into it by so much."""
    far = radius_at(0.5) + 0.3
    a, b = (Number(Fraction(float(far * v))) for v in (np.cos(angle), np.sin(angle)))
    return ring([Number(Fraction(0.3 + by)) ** 2 - ((X - a) ** 2 + (Y - b) ** 2)])


def leak(angle: float, by: float = BY) -> System:
    """The same with a gust that blows outwards at one place of the boundary, where x'F is `by`; u = tanh(-y)."""
    r = radius_at(0.5)
    p = r * np.array([np.cos(angle), np.sin(angle)])
    size = (r**2 * (r**2 - 1) - p[1] * np.tanh(-p[1]) / 10 + by) / r
    a, b = (Number(Fraction(float(v))) for v in p)
    gust = exp(-30 * ((X - a) ** 2 + (Y - b) ** 2))
    x, y = (Number(Fraction(float(size * v / r))) * gust for v in p)
    return ring(more=(x, y))


def steered(angle: float, by: float = BY) -> tuple[System, PolicyNetwork]:
    """The same with an input that is out of its bounds by so much at one place of the boundary."""
    row = [float(np.cos(angle)), float(np.sin(angle))]
    most = str(Fraction(radius_at(0.5) - by))
    system = plant(ring().dynamics, ("2", "2"), bounds=("-2", most))
    return system, policy(row, "identity")


def narrow(level: float, by: float = BY) -> System:
    """The same in a domain whose faces cut off so much of the set."""
    return ring(half=str(Fraction(radius_at(level) - by)))


def planted(by: float = BY) -> Iterator[tuple[str, System, PolicyNetwork, float]]:
    """Loops with what the search is asked for; false if `by` is positive."""
    brake = policy([0.0, -1.0])
    for k in range(12):
        angle = 0.1 + 2 * np.pi * k / 12
        yield f"obstacle {k}", obstacle(angle, by), brake, 0.5
        yield f"leak {k}", leak(angle, by), brake, 0.5
        yield f"input {k}", *steered(angle, by), 0.5
        level = 0.3 + 0.04 * k
        yield f"domain {k}", narrow(level, by), brake, level
