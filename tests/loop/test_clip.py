"""Clipped policies: every enclosure holds against exact rationals, and claims are proved up to the edge of the truth.

Three programs enclose a clip, each in its own way: the producer, the checker and the reference. What they are asked
here is the same, on ranges that meet none, one or both of the corners.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from flint import arb, ctx
from hypothesis import given
from hypothesis import strategies as st

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import read_certificate, run_checker
from certify.certificates.claims import Asymptotic, conditions
from certify.certificates.claims.queries import query
from certify.certificates.verdict import Verdict
from certify.checker.near import Form
from certify.checker.network import fold
from certify.checker.wiring import clip_forms
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number
from certify.loop.plants import System, get_system
from certify.loop.policies import Policy, PolicyNetwork, bounded_by_form, load_policy, require_centred, save_policy
from certify.loop.rigorous import eigenvalues, evaluate_policy
from certify.provers.ball.local import prove_local
from certify.provers.bounds import policy as producer
from certify.provers.falsify import falsify
from certify.reference import affine as reference
from certify.reference import rules as reference_rules
from certify.report import render_html
from tests.support import plain
from tests.support.cases import case_of
from tests.support.certificates import edited, encode, grow, make, rehash, verdict
from tests.support.loops import box, pendulum_network, scalar_clip
from tests.support.marks import slow_after
from tests.support.oracle import certainly_within, policy_in_arb
from tests.support.reference import judge

# ---------------------------------------------------------------------------------------------- two lines around a clip

Enclosure = tuple[float, list[float], float]


def by_checker(mid: float, slopes: list[float], error: float, lo: float, hi: float) -> Enclosure:
    ends = np.array([lo]), np.array([hi])
    with np.errstate(all="ignore"):
        a, b, c = plain.clipped(np.array([[mid]]), np.array([slopes])[:, :, None], np.array([[error]]), *ends)
    return float(a[0, 0]), b[0, :, 0].tolist(), float(c[0, 0])


def by_producer(mid: float, slopes: list[float], error: float, lo: float, hi: float) -> Enclosure:
    ends = np.array([[lo]]), np.array([[hi]])
    with np.errstate(all="ignore"):
        a, b, c = producer.clipped(np.array([[mid]]), np.array([slopes])[:, :, None], np.array([[error]]), *ends)
    return float(a[0, 0]), b[0, :, 0].tolist(), float(c[0, 0])


def by_reference(mid: float, slopes: list[float], error: float, lo: float, hi: float) -> tuple[arb, list[arb], arb]:
    return reference.clip((arb(mid), [arb(v) for v in slopes], arb(error)), arb(lo), arb(hi))


ENCLOSURES: dict[str, Callable[..., Any]] = {"checker": by_checker, "producer": by_producer, "reference": by_reference}


def exactly_clipped(v: Fraction, lo: float, hi: float) -> Fraction:
    return min(max(v, Fraction(lo)), Fraction(hi))


def require_enclosed(who: str, mid: float, slopes: list[float], error: float, lo: float, hi: float) -> None:
    """At the corners, on the corners of the clip, and elsewhere: in rationals."""
    form = ENCLOSURES[who](mid, slopes, error, lo, hi)
    reach = sum(abs(Fraction(s)) for s in slopes) + Fraction(error)
    shares = {Fraction(-1), Fraction(1), Fraction(0), Fraction(1, 3), Fraction(-7, 8)}
    for corner in (lo, hi):  # the share of the reach at which v meets the corner
        if reach and abs(Fraction(corner) - Fraction(mid)) <= reach:
            shares.add((Fraction(corner) - Fraction(mid)) / reach)
    for share in shares:
        d = [share if s >= 0 else -share for s in slopes]
        v = Fraction(mid) + sum(Fraction(s) * t for s, t in zip(slopes, d, strict=True)) + share * Fraction(error)
        u = exactly_clipped(v, lo, hi)
        if who == "reference":
            line = form[0] + sum(
                (s * arb(t.numerator) / t.denominator for s, t in zip(form[1], d, strict=True)), arb(0)
            )
            off = abs(arb(u.numerator) / u.denominator - line)
            assert off <= form[2] + arb(2) ** -100 * (1 + abs(form[0]) + form[2])
        else:
            line = Fraction(form[0]) + sum(Fraction(s) * t for s, t in zip(form[1], d, strict=True))
            assert abs(u - line) <= Fraction(form[2])


NUMBERS = st.floats(-4, 4, allow_nan=False)


@pytest.mark.parametrize("who", ENCLOSURES)
@given(
    mid=NUMBERS, slopes=st.lists(NUMBERS, min_size=1, max_size=3), error=st.floats(0, 3), lo=NUMBERS,
    width=st.floats(1e-9, 5), exponent=st.sampled_from([0, 0, 0, -300, -40, 60, 200]),
)  # fmt: skip
def test_a_clipped_form_contains_what_is_clipped(
    who: str, mid: float, slopes: list[float], error: float, lo: float, width: float, exponent: int
) -> None:
    scale = 2.0**exponent
    hi = lo + width
    if hi * scale > lo * scale:
        with ctx.workprec(200):
            require_enclosed(who, mid * scale, [s * scale for s in slopes], error * scale, lo * scale, hi * scale)


@pytest.mark.parametrize("who", ENCLOSURES)
@pytest.mark.parametrize(
    ("mid", "spread", "error"),
    [
        (0.0, 0.5, 0.25), (0.25, 0.5, 0.25), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0),  # inside, at the ends
        (0.5, 1.0, 0.0), (-0.5, 1.0, 0.25), (0.0, 4.0, 1.0), (0.1, 2.0, 0.0), (3.0, 1.0, 0.5), (-3.0, 0.0, 1.0),
        (1.0, 1e-300, 0.0), (1.0, 0.0, 1e-17), (np.nextafter(1.0, 2.0), 0.0, 0.0), (1e300, 1e300, 0.0),
        (0.0, 1e12, 1e12),
    ],
)  # fmt: skip
def test_ranges_that_meet_none_one_or_both_corners(who: str, mid: float, spread: float, error: float) -> None:
    with ctx.workprec(1200):
        require_enclosed(who, mid, [spread], error, -1.0, 1.0)
        require_enclosed(who, mid, [-spread / 2, spread / 2], error, -1.0, 1.0)


def own_of_a_clip(mid: float, slopes: list[float], error: float) -> tuple[float, float, float]:
    """What the checker's clip to [-1, 1] makes of a form whose own error is elsewhere: the slope by which that counts,
    how far the clip is from this line, and what has been rounded."""
    v = plain.form(np.array([[mid, *slopes]])[:, :, None], np.array([[error]]))
    cut, slope, gap = clip_forms(Form(v.value), v.range.error, np.array([-1.0]), np.array([1.0]))
    return float(slope[0, 0]), float(gap.top[0, 0]), float(cut.error.top[0, 0])


@pytest.mark.parametrize("who", ENCLOSURES)
def test_nothing_changes_inside_and_all_is_known_beyond(who: str) -> None:
    mid, slopes, error = ENCLOSURES[who](0.25, [0.5, -0.125], 0.0625, -1.0, 1.0)
    if who == "checker":  # it multiplies the error by a slope of 1, which rounds upwards
        assert 0.0625 <= error < 0.0625 * (1 + 2**-48) and own_of_a_clip(0.25, [0.5, -0.125], 0.0625) == (1.0, 0.0, 0.0)
        error = 0.0625
    assert (mid, slopes, error) == (0.25, [0.5, -0.125], 0.0625)
    mid, slopes, error = ENCLOSURES[who](7.0, [0.5, -0.125], 0.0625, -1.0, 1.0)
    assert abs(float(mid) - 1) < 1e-11 and slopes == [0.0, 0.0] and 0 <= float(error) < 1e-11
    _, slopes, error = ENCLOSURES[who](0.0, [2.0], 0.0, -1.0, 1.0)  # the chord: from (-2, -1) to (2, 1)
    assert abs(float(slopes[0]) - 1) < 1e-11 and abs(float(error) - 0.5) < 1e-11


@pytest.mark.parametrize("who", ENCLOSURES)
@pytest.mark.parametrize("bad", [(np.nan, 1.0, 0.0), (0.0, np.nan, 0.0), (0.0, 1.0, np.nan), (0.0, np.inf, 0.0)])
def test_what_is_not_finite_is_never_made_finite(who: str, bad: tuple[float, float, float]) -> None:
    mid, _, error = ENCLOSURES[who](bad[0], [bad[1]], bad[2], -1.0, 1.0)
    assert not np.isfinite(float(mid) + float(error))


FORMS = [("tanh", "preactivation"), ("tanh", "output"), ("tanh", "none"), ("identity", "output"), ("identity", "none")]


def clipped_pendulum(squash: str, centre: str, reach: float, offset: float = 0.25) -> PolicyNetwork:
    base = pendulum_network((6, 5))
    biases = (*base.biases[:-1], 0.1 + base.biases[-1] - base.net(np.zeros(2)))  # raw is not saturated at 0
    ends = np.array([-reach]), np.array([1.5 * reach])
    return PolicyNetwork.of_layers(base.weights, biases, base.scale, np.array([offset]), squash, centre, ends)  # type: ignore[arg-type]


@pytest.mark.parametrize(("squash", "centre"), FORMS)
def test_the_policy_on_boxes_and_at_points(squash: str, centre: str) -> None:
    """The producer's and the checker's enclosures against ball arithmetic, and the policy in four arithmetics."""
    network = clipped_pendulum(squash, centre, 2.0)
    loop = ClosedLoop(get_system("pendulum"), network)
    theirs = plain.policy(network)
    generator, active = np.random.default_rng(3), 0
    for size in (1e-3, 0.05, 0.4, 3.0):
        x = generator.standard_normal((2, 3, 6)) * np.array([1.0, size, size])[None, :, None]
        nothing = np.zeros((2, 6))
        forms = [plain.enclose_on_boxes(fold(theirs, loop.u_eq), x, nothing)]
        forms.append(producer.policy_enclosure(loop)(x, nothing)[:3])
        with ctx.workprec(300):
            for b, d in itertools.product(range(6), [*itertools.product([-1.0, 1.0], repeat=2), (0.25, -0.5)]):
                state = [
                    sum((arb(float(x[i, 1 + k, b])) * arb(v) for k, v in enumerate(d)), arb(float(x[i, 0, b])))
                    for i in range(2)
                ]
                [u] = policy_in_arb(theirs, loop.u_eq, state)
                active += u == arb(-2) or u == arb(3)
                for mid, slopes, error in forms:
                    line = sum((arb(float(slopes[0, k, b])) * arb(v) for k, v in enumerate(d)), arb(0))
                    assert certainly_within(u - line, mid[0, b], error[0, b])
        points = x[:, 0].T
        exact = [policy_in_arb(theirs, loop.u_eq, [arb(float(v)) for v in p])[0] for p in points]
        for p, u in zip(points, exact, strict=True):
            assert evaluate_policy(loop, p)[0].overlaps(u)
        for found in (network(points, loop.u_eq), network(torch.tensor(points), loop.u_eq).numpy()):
            np.testing.assert_allclose(found[:, 0], [float(u.mid()) for u in exact], rtol=1e-12, atol=1e-12)
    assert active > 5


# ------------------------------------------------------------------------------------------------------ what is refused


def test_a_clip_must_be_a_pair_of_ends_for_each_input() -> None:
    base = pendulum_network((3,))
    one = np.ones(1)
    for clip, message in (
        ((one, one), "lo < hi"), ((one, -one), "lo < hi"), ((-one, np.full(1, np.nan)), "finite"),
        ((-one, np.full(1, np.inf)), "finite"), ((-np.ones(2), np.ones(2)), "shape"), ((-one,), "pair"), (1.0, "pair"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            dataclasses.replace(base, clip=clip)


@pytest.mark.parametrize("centre", ["preactivation", "output"])
@pytest.mark.parametrize(("lo", "hi"), [(1 / 3 + 1e-9, 2.0), (-1.0, 0.3), (1 / 3, 2.0), (-1.0, 1 / 3), (0.25, 0.5)])
def test_the_centre_must_lie_strictly_inside(centre: str, lo: float, hi: float) -> None:
    network = clipped_pendulum("tanh", centre, 2.0)
    u_eq = (Fraction(1, 3),)
    require_centred(network, u_eq)
    network.jacobian_at_origin(u_eq)
    other = dataclasses.replace(network, clip=(np.array([lo]), np.array([hi])))
    inside = Fraction(lo) < u_eq[0] < Fraction(hi)  # binary64's 1/3 lies below 1/3
    for act in (lambda: require_centred(other, u_eq), lambda: other.jacobian_at_origin(u_eq)):
        if inside:
            act()
        else:
            with pytest.raises(InputError, match="strictly inside"):
                act()


def test_without_centring_the_origin_is_decided_after_the_clip() -> None:
    network = PolicyNetwork.of_layers(
        (np.array([[1.0]]),), (np.array([3.0]),), np.ones(1), np.zeros(1), "identity", "none", (-np.ones(1), np.ones(1))
    )
    require_centred(network, (Fraction(1),))
    with pytest.raises(InputError, match="not centred"):
        require_centred(network, (Fraction(3),))
    with pytest.raises(InputError, match="clip must not act"):
        network.jacobian_at_origin((Fraction(1),))
    x, u = get_system("pendulum").states[0], get_system("pendulum").inputs[0]
    plant = System("p", (x,), (u,), {}, (x + u - 1,), (Number(1),), box(3), ((Fraction(-2), Fraction(2)),))
    loop = ClosedLoop(plant, network)
    assert eigenvalues(loop) is None
    with pytest.raises(InputError, match="clip must not act"):
        loop.linearise()


def test_bounds_by_form() -> None:
    wide, narrow = ((Fraction(-7), Fraction(7)),), ((Fraction(-2), Fraction(3)),)
    for squash, centre in FORMS:
        network = clipped_pendulum(squash, centre, 2.0)
        assert bounded_by_form(network, narrow) and bounded_by_form(network, wide)
        assert not bounded_by_form(network, ((Fraction(-2), Fraction(3) - Fraction(1, 10**30)),))
        loose = dataclasses.replace(network, clip=(np.array([-20.0]), np.array([20.0])))
        assert bounded_by_form(loose, wide) is (squash == "tanh" and centre != "output")


def test_the_local_proof_stops_where_the_clip_begins_to_act() -> None:
    case = case_of(*scalar_clip())
    scale = float(case.P[0, 0])
    level = prove_local(case.problem, case.T, 10.0)
    assert level is not None and 0.9 * scale / 4 < level < scale / 4


def test_the_falsifier_knows_the_clip() -> None:
    case = case_of(*scalar_clip())
    witness = falsify(case.problem, case.T, 2.25**2 * float(case.P[0, 0]))
    assert witness is not None and witness.kind == "vdot" and 2 <= abs(witness.x[0]) < 2 + 1e-5
    assert falsify(case.problem, case.T, 1.99**2 * float(case.P[0, 0])) is None


def test_the_queries_ask_that_the_clip_does_not_act_on_the_local_level() -> None:
    case = case_of(*scalar_clip())
    found = conditions(Asymptotic(roa=1.0, local=0.05), case.problem)
    names = [c.name for c in found]
    assert names.index("clip-u-below") < names.index("local") and "clip-u-above" in names
    asked = query(next(c for c in found if c.name == "clip-u-above"), case.problem)
    assert asked.constraints[-1] == ("b.0", ">=", "1/2")
    assert ("u", ["min", ["max", "b.0", "-1/2"], "1/2"]) in asked.definitions


# ------------------------------------------------------------------------------------------------------------- the file


def test_a_file_with_a_clip_is_version_2_and_without_stays_version_1(tmp_path: Path) -> None:
    network = clipped_pendulum("tanh", "output", 2.0)
    unclipped = dataclasses.replace(network, clip=None)
    assert network.sha256() != unclipped.sha256()
    assert network.sha256() != dataclasses.replace(network, clip=(network.clip[0], network.clip[1] * 2)).sha256()  # type: ignore[index]
    assert plain.policy(network).sha256() == network.sha256()
    for policy, version in ((network, "certify-policy/2"), (unclipped, "certify-policy/1")):
        save_policy(tmp_path / "a.pt", Policy(policy, "pendulum"))
        stored = torch.load(tmp_path / "a.pt", weights_only=True)
        assert stored["format"] == version and ("clip" in stored["output"]) is (policy.clip is not None)
        assert load_policy(tmp_path / "a.pt").network.sha256() == policy.sha256()


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d["output"].pop("clip"), "output"),
        (lambda d: d.update(format="certify-policy/1"), "output"),
        (lambda d: d["output"].update(clip=[torch.ones(1)]), "two tensors"),
        (lambda d: d["output"].update(clip=None), "two tensors"),
        (lambda d: d["output"].update(clip=[torch.ones(1), torch.zeros(1)]), "lo < hi"),
        (lambda d: d["output"].update(clip=[torch.zeros(1), torch.ones(2)]), "shape"),
        (lambda d: d["output"].update(clip=[0.0, 1.0]), "tensor"),
    ],
)
def test_files_with_a_wrong_clip_are_refused(tmp_path: Path, edit: Callable[[Any], Any], message: str) -> None:
    save_policy(tmp_path / "a.pt", Policy(clipped_pendulum("tanh", "output", 2.0), "pendulum"))
    data = torch.load(tmp_path / "a.pt", weights_only=True)
    edit(data)
    torch.save(data, tmp_path / "b.pt")
    with pytest.raises(InputError, match=message):
        load_policy(tmp_path / "b.pt")


# ------------------------------------------------------------------------------------------------- through the pipeline


def accepted_by_both(path: Path) -> dict[str, Any]:
    raw = path.read_bytes()
    assert run_checker(path)["result"] == "ACCEPTED"
    assert reference_rules.judge(raw).result == "ACCEPTED"
    return dict(json.loads(raw))


@pytest.mark.slow
def test_a_saturated_loop_is_proved_up_to_the_edge_of_its_region(tmp_path: Path) -> None:
    system, network = scalar_clip()
    result = certify_roa(system, network, tmp_path)
    assert result.verdict is Verdict.PROVED and result.P is not None and result.levels.roa is not None
    edge = 4 * float(result.P[0, 0])
    assert 0.998 * edge < result.levels.roa < edge
    data = accepted_by_both(tmp_path / "certificate.json")
    assert data["policy"]["clip"] == [encode([-0.5]), encode([0.5])]
    assert read_certificate(tmp_path / "certificate.json").network.sha256() == network.sha256()
    path = tmp_path / "certificate.json"
    page = render_html(read_certificate(path), run_checker(path), None, path)
    assert "clipped to" in page and "u in [−0.5, 0.5]" in page
    narrower = rehash(edited(data, "policy.clip", [encode([-0.499]), encode([0.499])]))
    assert verdict(narrower) == "ring" and judge(narrower) == "ring"
    beyond = certify_roa(system, network, tmp_path / "beyond", RoaOptions(level=1.0001 * edge))
    assert beyond.verdict is Verdict.REFUTED


@pytest.mark.slow
def test_a_rectified_tanh_is_a_clip(tmp_path: Path) -> None:
    """u = 2 relu(tanh(net(x) - net(0) + beta)), u_eq = 1: it reaches 0 on part of the set, and never 2."""
    x, u = get_system("pendulum").states[0], get_system("pendulum").inputs[0]
    system = System("lift", (x,), (u,), {}, (u - 1,), (Number(1),), box(4), ((Fraction(0), Fraction(2)),))
    network = PolicyNetwork.of_layers(
        (np.array([[-0.5]]),), (np.array([0.7]),), np.array([2.0]), np.zeros(1), "tanh", "preactivation",
        (np.zeros(1), np.array([2.0])),
    )  # fmt: skip
    assert network(np.array([[3.5]]), (Fraction(1),))[0, 0] == 0.0
    result = certify_roa(system, network, tmp_path)
    assert result.verdict is Verdict.PROVED and result.reason == "domain"
    accepted_by_both(tmp_path / "certificate.json")


@pytest.mark.parametrize("claim", slow_after(1, ["asymptotic", "practical"]))
def test_a_clipped_pendulum(tmp_path: Path, claim: str) -> None:
    """The clip acts on the proved set: some state of it has an input at the clip's end."""
    network = dataclasses.replace(clipped_pendulum("identity", "output", 3.0, 0.0), scale=np.array([6.0]))
    result = certify_roa(get_system("pendulum"), network, tmp_path, RoaOptions(claim=claim))  # type: ignore[arg-type]
    assert result.verdict is Verdict.PROVED and result.levels.roa is not None and result.P is not None
    accepted_by_both(tmp_path / "certificate.json")
    angle = np.linspace(0, 2 * np.pi, 400)
    L = np.linalg.inv(np.linalg.cholesky(result.P)).T
    edge = (np.sqrt(result.levels.roa) * (L @ np.array([np.cos(angle), np.sin(angle)]))).T
    u = network(edge, (Fraction(0),))
    assert u.min() == -3.0 and u.max() <= 4.5


def test_a_practical_claim_where_the_clip_acts_at_the_origin() -> None:
    """xdot = -x + u, u = clip(3 + x, -1, 1), which is 1 near 0: 1 <= V <= 9 is left inwards, and 0 is at no rest."""
    document = make(
        [["+", ["-", "x"], "u"]], [([[1.0]], [3.0])], [[1.0]], (1.125, 9.0), domain=[("-5", "5")], squash="identity",
        centre="none", scale=[1.0], clip=([-1.0], [1.0]), claim="practical",
    )  # fmt: skip
    document = grow(document)
    assert verdict(document) == "ACCEPTED" and judge(document) is None
    too_low = edited(edited(document, "levels.floor", (0.875).hex()), "levels.local", (0.875).hex())
    assert verdict(too_low) == "ring" and judge(too_low) == "ring"


# ------------------------------------------------------------------------------------------------- the inputs by form


@pytest.mark.parametrize(
    ("squash", "clip"), [("tanh", ([5.0], [6.0])), ("tanh", ([-6.0], [-5.0])), ("identity", ([5.0], [6.0]))]
)
def test_a_clip_beyond_the_range_of_the_squash_does_not_keep_the_input_there(squash: str, clip: Any) -> None:
    """tanh(x) lies in [-2, 2], but clipped to [5, 6] the input is 5: condition 5 is false, whatever the squash."""
    split = bytes([0, 255, 255])
    data = make(
        [["+", ["-", "x"], ["/", "u", "1000"]]], [([[1.0]], [0.0])], [[1.0]], (0.01, 1.0), claim="practical",
        centre="none", squash=squash, scale=(1.0,), offset=(0.0,), clip=clip, input_bounds=(("-2", "2"),), tree=split,
    )  # fmt: skip
    data = grow(data, max_leaves=100)
    assert verdict(data) == judge(data) == "inputs"
    data["plant"]["input_bounds"] = [["-7", "7"]]
    assert verdict(data) == "ACCEPTED" and judge(data) is None


@given(
    scale=st.floats(0.1, 4),
    offset=st.floats(-4, 4),
    low=st.floats(-6, 5),
    width=st.floats(0.1, 4),
    squash=st.booleans(),
)
def test_what_holds_by_form_holds_at_every_state(
    scale: float, offset: float, low: float, width: float, squash: bool
) -> None:
    """Against the policy's values from one end of its range to the other, for bounds just wide enough and just not."""
    network = PolicyNetwork.of_layers(
        (np.array([[1.0]]),), (np.zeros(1),), np.array([scale]), np.array([offset]), "tanh" if squash else "identity",
        "none", clip=(np.array([low]), np.array([low + width])),
    )  # fmt: skip
    values = network(np.linspace(-1, 1, 201)[:, None] * (40 if squash else 1e6), (Fraction(0),))
    least, most = Fraction(float(values.min())), Fraction(float(values.max()))
    hair = Fraction(1, 10**9)
    assert bounded_by_form(network, ((least - hair, most + hair),))
    assert not bounded_by_form(network, ((least + hair, most + hair),))
    assert not bounded_by_form(network, ((least - hair, most - hair),))
