"""A policy that is looked at from another point: both checkers against ball arithmetic, and forgeries of `origin`.

The layers of a moved policy read `origin + x`. The oracle is written here once more, by the words of FORMAT.md: sums
and products in Arb at a precision at which whatever binary64 numbers are drawn cannot cancel unseen. Enclosures may
become infinite or NaN where numbers are huge, which rules read as a failure, but never too small.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat, ctx, fmpq, fmpq_mat
from hypothesis import example, given, settings
from hypothesis import strategies as st

from certify.checker import document
from certify.checker.ball import Ball
from certify.checker.case import Case
from certify.checker.errors import Rejected
from certify.checker.rules import check
from certify.reference import rules as reference
from certify.reference.document import read
from certify.reference.leaves import Leaves
from tests.support.certificates import LEAF, Document, decode, dump, encode
from tests.support.certificates import make as stated
from tests.support.earlier import newer
from tests.support.jets import seen
from tests.support.models import inputs_on
from tests.support.oracle import value_of
from tests.support.plain import enclose_on_boxes

EXACTLY = 6000  # bits: more than any sum of products of two binary64 numbers spans


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    """As in `rules.check`: overflow becomes infinity or NaN."""
    with np.errstate(all="ignore"):
        yield


# ---------------------------------------------------------------------------------------------------------- documents


def halved(depth: int) -> bytes:
    """An interval cut into 2^depth equal parts, in preorder."""
    return bytes([LEAF]) if depth == 0 else b"\0" + 2 * halved(depth - 1)


def looked_at(
    layers: Sequence[tuple[Any, Any]],
    origin: Any,
    dynamics: Sequence[Any] | None = None,
    *,
    depth: int = 0,
    root: float = 1.0,
    **changes: Any,
) -> Document:
    """A document about n states and a policy whose layers read origin + x; V = x'x."""
    settings = {
        "scale": (1.0,), "offset": (0.0,), "levels": (0.01, 1.0), "claim": "practical", "centre": "none",
    } | changes  # fmt: skip
    n, m = len(origin), len(settings["scale"])
    states, inputs = [f"x{i}" for i in range(n)], [f"u{j}" for j in range(m)]
    rates = list(dynamics or [["+", x, inputs[0]] for x in states])
    return stated(
        rates, layers, np.eye(n), origin=origin, states=states, inputs=inputs, u_eq=["0"] * m,
        domain=[("-3", "3")] * n, input_bounds=[("-9", "9")] * m, root=[root] * n, tree=halved(depth), **settings,
    )  # fmt: skip


def of_checker(data: Document, jobs: int = 1) -> str:
    """ACCEPTED, or the rule that refuses the document; what the process says, without the process."""
    raw = dump(data)
    try:
        c = document.certificate(json.loads(raw), hashlib.sha256(raw).hexdigest())
        check(c, jobs=jobs)
    except Rejected as no:
        return no.rule
    return "ACCEPTED"


def of_reference(data: Document) -> str:
    verdict = reference.judge(dump(data))
    return verdict.rule or verdict.result


def verdicts(data: Document) -> tuple[str, str]:
    return of_checker(data), of_reference(data)


# -------------------------------------------------------------------------------------------------------- containment


def policy_in_balls(data: Document, x: Sequence[arb]) -> list[arb]:
    """pi(x), the layers reading origin + x, at the precision in hand."""
    policy = data["policy"]
    h = [arb(float(o)) + v for o, v in zip(decode(policy["origin"]), x, strict=True)]
    for k, layer in enumerate(policy["layers"]):
        h = [v.tanh() for v in h] if k else h
        W, b = decode(layer["weight"]).reshape(layer["shape"]), decode(layer["bias"])
        h = [
            sum((arb(float(w)) * v for w, v in zip(row, h, strict=True)), arb(float(c)))
            for row, c in zip(W, b, strict=True)
        ]
    h = [v.tanh() for v in h] if policy["squash"] == "tanh" else h
    each = zip(decode(policy["scale"]).tolist(), h, decode(policy["offset"]).tolist(), strict=True)
    u = [arb(s) * v + arb(o) for s, v, o in each]
    if policy["clip"] is not None:
        lo, hi = (decode(end).tolist() for end in policy["clip"])
        u = [v.max(arb(a)).min(arb(b)) for v, a, b in zip(u, lo, hi, strict=True)]
    return u


MAGNITUDES = st.one_of(st.just(0.0), st.just(-0.0), st.floats(-4, 4), st.floats(-1e-30, 1e-30), st.floats(-1e30, 1e30),
                       st.floats(allow_nan=False, allow_infinity=False))  # fmt: skip
MILD = st.floats(-3, 3)


@st.composite
def policies(draw: st.DrawFn, numbers: st.SearchStrategy[float] = MAGNITUDES, clips: bool = True) -> Document:
    """A moved policy of one to three layers; now and then the bias undoes what the origin adds, but for rounding."""
    n, m, depth = draw(st.integers(1, 3)), draw(st.integers(1, 2)), draw(st.integers(1, 3))
    sizes = [n, *(draw(st.integers(1, 3)) for _ in range(depth - 1)), m]
    origin = np.array(draw(st.lists(numbers, min_size=n, max_size=n)))
    layers = []
    for k, (into, out) in enumerate(pairwise(sizes)):
        source = draw(st.sampled_from([numbers, MILD]))
        W = np.array(draw(st.lists(source, min_size=into * out, max_size=into * out))).reshape(out, into)
        b = np.array(draw(st.lists(source, min_size=out, max_size=out)))
        if k == 0 and draw(st.booleans()):
            undone = -(W @ origin)
            b = np.where(np.isfinite(undone), undone, b)
        layers.append((W, b))
    squash = draw(st.sampled_from(["tanh", "identity"]))
    scale = np.array(draw(st.lists(st.floats(0.25, 2), min_size=m, max_size=m)))
    clip = (np.full(m, -0.5), np.full(m, 0.25)) if clips and draw(st.booleans()) else None
    return looked_at(layers, origin, squash=squash, scale=scale, offset=np.full(m, 0.125), clip=clip)


def points(n: int, seed: int) -> np.ndarray:
    """In [-1, 1]^n: the corners' and the middle's neighbours, and some between."""
    generator = np.random.default_rng(seed)
    return np.concatenate([np.zeros((1, n)), np.ones((1, n)), -np.ones((1, n)), generator.uniform(-1, 1, (4, n))])


BOXES = st.tuples(st.floats(-2, 2), st.sampled_from([2.0**-1074, 2.0**-60, 2.0**-20, 0.125, 1.0]), st.integers(0, 99))


def within(u: arb, mid: arb, slopes: Sequence[arb], error: arb, d: Sequence[float]) -> bool:
    line = sum((s * arb(float(v)) for s, v in zip(slopes, d, strict=True)), mid)
    return bool(abs(u - line) <= error)


CANCELS = looked_at([([[1e16, 1.0]], [-1e16]), ([[1.0]], [0.0])], [1.0, 3.0], squash="identity")
LOST = looked_at([([[1.0]], [0.0]), ([[3.0]], [0.0])], [2.0**-53], squash="identity")
ROUNDS = looked_at([([[0.1, 0.7, 1 / 3]], [0.0])], [0.1, 0.3, 1e15], squash="identity")


@settings(max_examples=100, deadline=None)
@given(policies(), BOXES)
@example(CANCELS, (0.0, 2.0**-1074, 0))
@example(LOST, (0.0, 2.0**-1074, 0))
@example(ROUNDS, (0.0, 2.0**-1074, 0))
def test_the_checker_encloses_a_moved_policy_on_boxes(data: Document, box: tuple[float, float, int]) -> None:
    at, radius, seed = box
    c = document.certificate(newer(data), "")
    n = len(c.states)
    x = np.zeros((n, n + 1, 1))
    x[:, 0, 0], x[:, 1:, 0] = at, radius * np.eye(n)
    mid, slopes, error = (v[..., 0] for v in enclose_on_boxes(Case(c).net, x, np.zeros((n, 1))))
    with ctx.workprec(EXACTLY):
        for d in points(n, seed):
            state = [arb(at) + arb(radius) * arb(float(v)) for v in d]
            for u, m, s, e in zip(policy_in_balls(data, state), mid, slopes, error, strict=True):
                known = np.isfinite(e) and np.isfinite(m) and np.all(np.isfinite(s))
                assert not known or within(u, arb(float(m)), [arb(float(v)) for v in s], arb(float(e)), d)


@settings(max_examples=100, deadline=None)
@given(policies(), BOXES)
@example(CANCELS, (0.0, 2.0**-1074, 0))
@example(LOST, (0.0, 2.0**-1074, 0))
@example(ROUNDS, (0.0, 2.0**-1074, 0))
def test_the_reference_encloses_a_moved_policy_on_boxes(data: Document, box: tuple[float, float, int]) -> None:
    at, radius, seed = box
    with ctx.workprec(128):
        c = read(dump(data))
        n = c.n
        identity = fmpq_mat(n, n, [int(i == j) for i in range(n) for j in range(n)])
        entries = []
        for i in range(n):
            for centre in (at, -at):  # two leaves: which column belongs to which leaf is part of it
                entries += [arb(centre), *(arb(radius if j == i else 0) for j in range(n))]
        found = Leaves(c, identity, identity).policy(arb_mat(n, 2 * (n + 1), entries), 2)
    with ctx.workprec(EXACTLY):
        for leaf, centre in enumerate((at, -at)):
            for d in points(n, seed):
                state = [arb(centre) + arb(radius) * arb(float(v)) for v in d]
                for u, affine in zip(policy_in_balls(data, state), found, strict=True):
                    mid, slopes, error = affine[leaf].form
                    known = error.is_finite() and mid.is_finite() and all(s.is_finite() for s in slopes)
                    assert not known or not certainly_outside(u, mid, slopes, error, d)


def certainly_outside(u: arb, mid: arb, slopes: Sequence[arb], error: arb, d: Sequence[float]) -> bool:
    """Whether u is certain to lie outside of all that the balls allow."""
    line = sum((s * arb(float(v)) for s, v in zip(slopes, d, strict=True)), mid)
    return bool(abs(u - line) > error)


@settings(max_examples=100, deadline=None)
@given(policies(clips=False), st.sampled_from([2.0**-60, 2.0**-20, 0.125, 1.0]), st.integers(0, 99))
@example(CANCELS, 2.0**-60, 0)
@example(LOST, 2.0**-60, 0)
@example(ROUNDS, 2.0**-60, 0)
def test_both_checkers_model_a_moved_policy_on_balls(data: Document, radius: float, seed: int) -> None:
    """|u - v(0) - a.d| is at most curve ||d||^2 at points x = radius d of the ball."""
    n = len(decode(data["policy"]["origin"]))
    J = radius * np.eye(n)
    jets = seen(Ball(Case(document.certificate(newer(data), "")), J, "").inputs)
    with ctx.workprec(128):
        exact = fmpq_mat(n, n, [fmpq(*float(v).as_integer_ratio()) for v in J.ravel()])
        models = inputs_on(read(dump(data)), exact)
    with ctx.workprec(EXACTLY):
        for corner in points(n, seed):
            d = corner / max(1.0, float(np.linalg.norm(corner)) * (1 + 1e-9))
            exact_d = [arb(v) for v in d.tolist()]
            square = sum((v * v for v in exact_d), arb(0))
            true = policy_in_balls(data, [arb(radius) * v for v in exact_d])
            for u, jet, model in zip(true, jets, models, strict=True):
                numbers = jet.c, jet.error, jet.slack, jet.curve, *np.atleast_1d(jet.a)
                if all(np.isfinite(v) for v in numbers):
                    c, error, slack, curve, *a = (arb(float(v)) for v in numbers)
                    assert within(u, c, a, error + slack * square.sqrt() + curve * square, d)
                column = model.a.entries()
                if all(v.is_finite() for v in (model.v, model.curve, *column)):
                    assert not certainly_outside(u, model.v, column, model.curve * square, d)


# ---------------------------------------------------------------------------------------------------------- forgeries

AT = 171 / 512  # near the rest of ydot = y / 2 + u, u = -2 tanh(y - 1/4)
MOVED = [["+", ["/", ["+", "171/512", "x0"], "2"], "u0"]]


def honest(**changes: Any) -> Document:
    """ydot = y/2 - 2 tanh(y - 1/4), seen from 171/512: all |x| <= 1 come to |x| <= 1/100."""
    given = {"layers": [([[1.0]], [-0.25])], "origin": [AT], "dynamics": MOVED, "scale": [-2.0], "offset": [0.0]}
    return looked_at(**{**given, "levels": (1e-4, 1.0), "depth": 8, **changes})


def two_layers(**changes: Any) -> Document:
    """The same law but for a bend, by a hidden tanh and an identity behind it; it rests elsewhere by a little."""
    given = {"layers": [([[1.0]], [-0.25]), ([[-2.0]], [0.0])], "squash": "identity", "scale": [1.0]}
    return honest(**{**given, **changes})


def stepping(**changes: Any) -> Document:
    """x+ = x + (y/2 + u)/4, the same law in steps."""
    step = ["+", "x0", ["*", "1/4", MOVED[0]]]
    return honest(**{"dynamics": [step], "time": "discrete", "levels": (4e-4, 1.0), **changes})


def held(**changes: Any) -> Document:
    """The same law, its input held for 1/20."""
    return honest(**{"sample": ["1/20", "1/20"], "levels": (4e-4, 1.0), **changes})


def shaken(**changes: Any) -> Document:
    """The same law and a disturbance."""
    by = [["+", MOVED[0], "q"]]
    return honest(**{"dynamics": by, "uncertain": [("q", "-1/1000", "1/1000")], "levels": (4e-4, 1.0), **changes})


def clipped(**changes: Any) -> Document:
    """The same law within [-7/4, 7/4]."""
    return honest(**{"clip": ([-1.75], [1.75]), **changes})


HONEST = [honest, two_layers, stepping, held, shaken, clipped]


def rises(data: Document) -> bool:
    """Whether V certainly does not fall at some state of the ring: then the claim is false."""
    (floor, roa), plant = (float.fromhex(data["levels"][name]) for name in ("floor", "roa")), data["plant"]
    pieces = [x for x in np.linspace(-1, 1, 401) if floor <= x * x <= roa]
    for x in pieces:
        names = {"x0": arb(float(x)), "u0": policy_in_balls(data, [arb(float(x))])[0], "q": arb(0)}
        F = value_of(plant["dynamics"][0], names)
        if plant["time"] == "discrete":
            F = (F - names["x0"]) * (F + names["x0"]) / (2 * names["x0"])
        if bool(names["x0"] * F > 0):
            return True
    return False


@pytest.mark.parametrize("make", HONEST)
def test_an_honest_certificate_with_an_origin_is_accepted(make: Any) -> None:
    assert not rises(make())
    assert verdicts(make()) == ("ACCEPTED", "ACCEPTED")


@pytest.mark.parametrize("origin", [0.0, -AT, AT + 1 / 16, AT - 1 / 16, 2.0, 5e-324])
@pytest.mark.parametrize("make", HONEST)
def test_another_origin_under_the_same_hash_is_refused(make: Any, origin: float) -> None:
    forged = make(origin=[origin])
    assert forged["policy"]["sha256"] == make()["policy"]["sha256"]
    assert rises(forged)
    assert verdicts(forged) == ("ring", "ring")


@pytest.mark.parametrize(
    ("make", "rule"), [(honest, "ring"), (two_layers, "inputs"), (held, "flow"), (clipped, "ring")]
)
@pytest.mark.parametrize("origin", [1e300, -1e300, 1.7e308])
def test_an_origin_of_which_nothing_can_be_said_is_refused(make: Any, rule: str, origin: float) -> None:
    """Overflow is no number to the checker; the reference has numbers of any size, and finds the claim false."""
    forged = make(origin=[origin])
    assert rises(forged)
    assert verdicts(forged) == (rule, "ring")


def test_a_plant_that_was_not_moved_with_the_policy_is_refused() -> None:
    forged = honest(dynamics=[["+", ["/", "x0", "2"], "u0"]])
    assert rises(forged)
    assert verdicts(forged) == ("ring", "ring")


def test_processes_see_the_origin_too() -> None:
    assert of_checker(honest(), jobs=2) == "ACCEPTED"
    assert of_checker(honest(origin=[0.0]), jobs=2) == "ring"


@pytest.mark.parametrize(
    "origin", [[np.nan], [np.inf], [-np.inf], [AT, 0.0], []], ids=["nan", "inf", "-inf", "two", "none"]
)
def test_an_origin_that_is_no_state_is_refused(origin: list[float]) -> None:
    forged = honest()
    forged["policy"]["origin"] = encode(origin)
    assert verdicts(forged) == ("format", "format")


@pytest.mark.parametrize("value", [None, [AT], AT, "0x1.0p+0", "AAAA"])
def test_an_origin_that_is_no_array_is_refused(value: Any) -> None:
    forged = honest()
    forged["policy"]["origin"] = value
    assert verdicts(forged) == ("format", "format")


def test_an_origin_has_to_be_stated() -> None:
    forged = honest()
    del forged["policy"]["origin"]
    assert verdicts(forged) == ("format", "format")
    forged["schema"] = "certify-certificate/7"
    assert verdicts(forged) == ("format", "format")


@pytest.mark.parametrize("centre", ["output", "preactivation"])
@pytest.mark.parametrize("origin", [AT, 5e-324])
def test_a_centred_policy_has_no_other_origin(centre: str, origin: float) -> None:
    """What is centred would be centred around another point."""
    assert verdicts(honest(centre=centre, origin=[origin])) == ("format", "format")
    assert "format" not in verdicts(honest(centre=centre, origin=[-0.0]))


@pytest.mark.parametrize("origin", [1.0, 5e-324])
def test_a_claim_about_the_origin_has_no_other_one(origin: float) -> None:
    """Not even where pi(0) = u_eq would hold from there as well."""
    given = {"squash": "identity", "scale": [1.0], "dynamics": [["+", ["/", "x0", "2"], "u0"]]}

    def resting(origin: float) -> Document:
        law = [([[-2.0]], [2.0 * origin])]  # u = -2 x, whatever the origin is
        return honest(**given, claim="asymptotic", layers=law, origin=[origin], levels=(0.01, 1.0))

    assert verdicts(resting(0.0)) == verdicts(resting(-0.0)) == ("ACCEPTED", "ACCEPTED")
    assert verdicts(resting(origin)) == ("format", "format")
