"""Equations that jump: boxes whose steps are followed for both values wherever a jump may have either.

Every certificate is JSON by hand: plants of one or two states whose images are known. H(a) is ["heaviside", a].
"""

from __future__ import annotations

import json
import random
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import product
from typing import Any

import pytest

from certify.checker.ranks import Steps
from certify.reference import rules
from certify.reference.document import read
from tests.support.certificates import edited
from tests.support.marks import slow_after
from tests.support.rank_forgeries import by_checker
from tests.support.ranked import UNRANKED, Document, Loop, affine, around_level, dumped, mapped, two_bytes, uniform

NO, HAIR = UNRANKED, Fraction(1, 10**9)
FIRST = ("ranks", "ranks leaf 0")
Ends = Sequence[float]


def H(a: Any) -> list[Any]:
    return ["heaviside", a]


def plus(*terms: Any) -> list[Any]:
    return ["+", *terms]


def times(k: Fraction | int, v: Any) -> list[Any]:
    return ["*", str(k), v]


def document(
    dynamics: list[Any],
    lo: Ends,
    hi: Ends,
    depth: int = 0,
    ranks: Sequence[int] = (1,),
    steps: Sequence[int] | None = None,
    **more: Any,
) -> Document:
    """A claim to reach a target, or without one to remain; the policy is 0 if nothing else is said."""
    known: dict[str, Any] = {"network": [affine([[0.0] * len(lo)])], "states": ("x", "y")[: len(lo)], "target": None}
    loop = Loop(**{"dynamics": dynamics, **known, **more})
    counts = [int(0 < r < NO) for r in ranks] if steps is None else steps
    data = loop.document(lo, hi, uniform(lo, hi, depth)[0], two_bytes(ranks), bytes(counts))
    if loop.target is None:
        claim = {key: value for key, value in data["claim"].items() if key != "target"}
        data["claim"] = claim | {"kind": "remains"}
    return data


def found(data: Document) -> tuple[str, str] | None:
    """The rule by which the reference refuses it, and where; then the checker refuses it as well."""
    verdict = rules.judge(dumped(data))
    if verdict.result == "ACCEPTED":
        return None
    assert by_checker(data) is not None
    return str(verdict.rule), str(verdict.at)


def on_unit(f: Any, lo: float = 0.0, hi: float = 1.0, **more: Any) -> Document:
    """One leaf, [0, 1] if nothing else is said."""
    return document([f], [lo], [hi], **more)


def saw(ranks: Sequence[int], by: Fraction | int = 0) -> Document:
    """x+ = x/2 + 1/4 H(x - 1/2 - by) on four leaves of [0, 1]."""
    jump = H(["-", "x", str(Fraction(1, 2) + by)])
    return document([plus(["/", "x", "2"], times(Fraction(1, 4), jump))], [0.0], [1.0], 2, ranks)


APART = ["-", "x", "1/2"]
GROWS = plus(["/", "x", "2"], H("x"))  # from around 0, at any step, to 1 and then to 2

# --------------------------------------------------------------------------------------------------------- both values


@pytest.mark.parametrize("sign", [1, -1])
def test_a_branch_that_leads_out_by_a_hair(sign: int) -> None:
    """x/2 + 1/2 from [0, 1] to [1/2, 1], and x/2 - 1/2 from [-1, 0] to [-1, -1/2]."""
    for by, rule in ((Fraction(0), None), (-HAIR, None), (HAIR, FIRST)):
        lift = sign * (Fraction(1, 2) + by)
        for jump in (H(times(sign, ["-", "x", str(Fraction(sign, 2))])), ["-", "1", H(["-", "x", "1/3"])]):
            f = plus(["/", "x", "2"], times(lift, jump))
            assert found(on_unit(f, min(0.0, sign), max(0.0, sign))) == rule


@pytest.mark.parametrize(("by", "rule"), [(HAIR, None), (Fraction(0), FIRST), (-HAIR, FIRST)])
def test_either_value_exactly_where_the_argument_is_0(by: Fraction, rule: Any) -> None:
    """One end of [0, 1] alone has an argument of 0: there the other value must be followed, too, which leads to 5."""
    never, always = ["-", "x", str(1 + by)], plus("x", str(by))
    for wrong in (H(never), ["-", "1", H(["-", never])], ["-", "1", H(always)], H(["-", always])):
        assert found(on_unit(plus(["/", "x", "2"], times(5, wrong)))) == rule


def test_an_end_that_is_0_within_rounding() -> None:
    """Three thirds of x less 1, at x = 1."""
    third = ["/", "x", "3"]
    for by, rule in (("-1000000001/1000000000", None), ("-1", FIRST)):
        never = plus(third, third, third, by)
        for wrong in (H(never), ["-", "1", H(["-", never])]):
            assert found(on_unit(plus(["/", "x", "2"], times(5, wrong)))) == rule


@pytest.mark.parametrize(("by", "rule"), [(HAIR, None), (Fraction(0), FIRST), (-HAIR, FIRST)])
def test_a_sign_that_terms_of_second_order_show(by: Fraction, rule: Any) -> None:
    """(x - 1/2)^2 + by on [0, 1]."""
    positive = plus(["**", APART, 2], str(by))
    for wrong in (["-", "1", H(positive)], H(["-", positive])):
        assert found(on_unit(plus(["/", "x", "2"], times(5, wrong)))) == rule


def test_jumps_of_numbers() -> None:
    for k, rule in (("0", FIRST), ("1", None), ("1/1000000000", None), ("-1", FIRST), ("-1/1000000000", FIRST)):
        assert found(on_unit(plus("1/2", times(5, ["-", "1", H(k)])))) == rule
        assert found(on_unit(plus("1/2", times(5, H(["-", k]))))) == rule


def test_each_leaf_by_itself() -> None:
    """The second leaf leads to [1/8, 1/4], and from its end 1/2 also to 1/2, which is the third leaf's, too."""
    assert (
        found(saw([1, 1, 1, 1])) is None and found(saw([1, 1, 1, NO])) is None and found(saw([1, NO, NO, NO])) is None
    )
    assert found(saw([NO, 1, 1, 1])) == ("ranks", "ranks leaf 1")
    assert found(saw([1, 1, NO, NO])) == ("ranks", "ranks leaf 1")
    assert found(saw([1, 1, NO, NO], HAIR)) is None
    assert found(saw([1, 1, NO, 1])) == ("ranks", "ranks leaf 1")
    assert found(saw([NO, NO, NO, 1])) == ("ranks", "ranks leaf 3")


def test_what_is_uncertain_and_inputs_decide_with_the_state() -> None:
    f = plus(["/", "x", "4"], times(5, H(["-", plus("x", "q"), "3/2"])))
    for end, rule in (("499999999/1000000000", None), ("1/2", FIRST)):
        assert found(on_unit(f, uncertain=[("q", "-1", end)])) == rule
    f = plus(["/", "x", "4"], times(5, H(["-", "u", "3/2"])))
    for gain, rule in ((1.5 - 1e-9, None), (1.5, FIRST)):
        assert found(on_unit(f, network=[affine([[gain]])])) == rule


# ------------------------------------------------------------------------------------------------ one inside of another


def test_a_jump_in_the_argument_of_another_counts_with_its_value() -> None:
    """k = H(x - 1/2); H(2 k - 1) is k, but H(k) may be 1 where k is 0, and H(k - 1) may be 0 where k is 1."""
    k = H(APART)
    for a in (["-", times(2, k), "1"], plus(k, str(-HAIR)), plus(["-", k, "1"], str(HAIR))):
        assert found(on_unit(plus("1/2", k, ["-", H(a)]))) is None
    for a in (k, ["-", k, "1"], plus(k, str(HAIR)), ["-", ["-", k, "1"], str(HAIR)]):
        assert found(on_unit(plus("1/2", k, ["-", H(a)]))) == FIRST


def test_three_deep() -> None:
    """k, 1 - k, and k again."""
    k = H(APART)
    other = H(["-", "1/2", k])
    again = H(["-", "1/2", other])
    assert found(on_unit(["-", plus(k, other), "1/2"])) is None
    assert found(on_unit(plus("1/2", k, ["-", again]))) is None
    assert found(on_unit(plus("1/2", k, ["-", other]))) == FIRST
    assert found(on_unit(plus("1/2", k, ["-", H(times(0, other))]))) == FIRST


def test_a_value_that_is_excluded_excludes_others() -> None:
    """H(x + k - 3/2) is 0 where k = H(x - 2) is, but not at x = 1 with k = H(x - 1)."""
    for far, rule in (("2", None), ("1000000001/1000000000", None), ("1", FIRST)):
        f = plus("1/2", times(5, H(["-", plus("x", H(["-", "x", far])), "3/2"])))
        assert found(on_unit(f)) == rule


def test_products_of_jumps() -> None:
    """j = H(x - 1/2) and k = H(y - 1/2) on [0, 1]^2."""
    j, k, square = H(APART), H(["-", "y", "1/2"]), ([0.0, 0.0], [1.0, 1.0])
    for lift, rule in ((Fraction(1), None), (1 + HAIR, FIRST)):
        assert found(document([times(lift, ["*", j, k]), ["*", j, "y"]], *square)) == rule
        assert found(document(["y", plus(["*", j, k], times(lift, ["-", "1", j]))], *square)) == rule
    half = times(Fraction(1, 2), ["-", "1", k])
    assert found(document([plus(["*", j, k], half), "x"], *square)) is None
    assert found(document([plus(j, half), "x"], *square)) == FIRST


# ----------------------------------------------------------------------------------------------------------- on the way


def far(**more: Any) -> Document:
    """x+ = x + 1/2 + 6 H(x - 1/4) leads [0, 1/2] to [1/2, 1] and to [13/2, 7], the former to [7, 15/2] and the latter
    beyond 13; the target is x >= 1, the tree's box is [0, 1]."""
    f = plus("x", "1/2", times(6, H(["-", "x", "1/4"])))
    known: dict[str, Any] = {"target": [["-", "1", "x"]], "ranks": [2, NO], "steps": [2, 0]}
    return document([more.pop("dynamics", f)], [0.0], [1.0], 1, **{**known, **more})


def test_what_is_in_the_target_goes_no_further() -> None:
    assert found(far()) is None and found(far(target=[["-", "13/2", "x"]])) is None
    assert found(far(domain=("-1", "2"), keep=[["-", "x", "3/2"]])) is None
    assert found(far(ranks=[1, NO], steps=[1, 0])) == FIRST  # [1/2, 1] is not in the target
    assert found(far(target=None)) == FIRST
    with_input = far(network=[affine([[1.0]])], bound="1")
    assert found(with_input) is None
    assert found(edited(with_input, "plant.input_bounds.0", ["-1", "3/4"])) == ("inputs", "ranks leaf 0")


def test_what_is_not_in_the_target_goes_on() -> None:
    """Of [13/2, 7] all of it must be there."""
    late: dict[str, Any] = {"target": [["-", str(Fraction(13, 2) + HAIR), "x"]]}
    assert found(far(**late)) is None
    assert found(far(**late, domain=("-1", "7"))) == FIRST
    assert found(far(**late, keep=[["-", "x", "7"]])) == ("keep", "ranks leaf 0")
    assert found(far(**late, network=[affine([[1.0]])], bound="6")) == ("inputs", "ranks leaf 0")
    assert found(far(keep=[["-", "x", "1"]])) == ("keep", "ranks leaf 0")  # [1/2, 1]
    assert found(far(domain=("-1", "1"))) == FIRST and found(far(domain=("-1", "10001/10000"))) is None


def test_without_jumps_all_steps_are_taken() -> None:
    """x + 7 is in the target after the first of two steps."""
    for f, rule in ((plus("x", "7"), FIRST), (plus("x", times(7, H(plus("x", "1")))), None)):
        assert found(far(domain=("-1", "2"), dynamics=f)) == rule


def test_a_target_that_may_not_exist_on_an_image_does_not_hold_it() -> None:
    """On [1/2, 1], which goes on, but not beyond 13/2."""
    for nothing in (["/", "1", ["-", "x", "3/4"]], ["sqrt", ["-", "x", "3/4"]], ["exp", ["/", "1", ["-", "x", "1"]]]):
        aim = plus(["-", "1", "x"], ["*", "0", nothing])
        assert found(far(target=[aim])) is None
        assert found(far(target=[aim], ranks=[1, NO], steps=[1, 0])) == FIRST
    assert found(far(target=[["-", "1", "x"], ["*", "0", ["sqrt", ["-", "7", "x"]]]])) == FIRST


def test_each_image_is_asked_for_the_same() -> None:
    """x+ = x - 1/2 + H(x) leads [-1/8, 1/8] to +-[3/8, 5/8], and these to +-[7/8, 9/8], where |x| >= 3/4."""
    f = plus(["-", "x", "1/2"], H("x"))
    known: dict[str, Any] = {"target": [["-", "3/4", ["abs", "x"]]], "ranks": [2], "steps": [2]}
    data = on_unit(f, -0.125, 0.125, **known)
    assert found(data) is None
    for sign in (1, -1):
        for most, rule in (("5/8", ("keep", "ranks leaf 0")), ("626/1000", None)):
            assert found(on_unit(f, -0.125, 0.125, keep=[["-", times(sign, "x"), most]], **known)) == rule
        for end, by in (("5/8", FIRST), ("626/1000", None)):
            assert found(edited(data, "plant.domain.0", ["-9", end] if sign == 1 else [f"-{end}", "9"])) == by
        aim = [["-", "3/4", times(sign, "x")]]
        assert found(on_unit(f, -0.125, 0.125, **{**known, "target": aim})) == FIRST


def test_leaves_with_different_numbers_of_steps() -> None:
    """16 leaves of [-4, 4], one to three steps: from [-1/2, 0], leaf 7, to [-1/4, 0], and from its end to [3/4, 1]."""
    steps = [1, 2, 3, 1] * 4
    assert found(document([GROWS], [-4.0], [4.0], 4, [3] * 16, steps)) is None
    for first, at in ((12, 11), (11, 9), (10, 7), (9, 7)):
        left = [k if i < first else 0 for i, k in enumerate(steps)]
        data = document([GROWS], [-4.0], [4.0], 4, [3 if k else NO for k in left], left)
        assert found(data) == ("ranks", f"ranks leaf {at}")


def test_all_of_a_batch_may_be_there_early() -> None:
    """After one of three steps."""
    for target, rule in ((["-", "x", "2"], None), (["-", "1/2", "x"], FIRST)):
        assert found(document([GROWS], [-1.0], [1.0], 1, [3, 3], [3, 3], target=[target])) == rule


def test_at_every_step_anew() -> None:
    """From [-1/8, 1/8] to around 0, 1 and 3/2 in two steps, the second by a jump after none: the target is below 3/64
    and above an end."""
    for end, rule in (("7/8", None), ("5/4", FIRST)):
        target = [["*", ["-", "x", "3/64"], ["-", end, "x"]]]
        assert found(on_unit(GROWS, -0.125, 0.125, ranks=[2], steps=[2], target=target)) == rule


@pytest.mark.parametrize(("count", "many"), [(63, False), (64, True)])
def test_sixty_four_images_at_once(count: int, many: bool) -> None:
    """After each step there is one more."""
    verdict = rules.judge(dumped(on_unit(GROWS, -0.125, 2.125, ranks=[count], steps=[count])))
    assert (verdict.rule, "64 images" in str(verdict.detail)) == (("ranks", True) if many else (None, False))


def test_images_in_the_target_do_not_count() -> None:
    """Six jumps make 64 images at a step, of which 63 are beyond 7/16."""
    f = plus(["/", "x", "2"], *(times(Fraction(1, 2), H(times(k, "x"))) for k in range(1, 7)))
    target = [["*", ["-", "x", "3/64"], ["-", "7/16", "x"]]]
    assert found(on_unit(f, -0.125, 0.125, ranks=[2], steps=[2], target=target)) is None
    assert found(on_unit(f, -0.125, 8.0)) is None
    assert found(document([f], [-8.0], [8.0], 1, [1, 1])) is None  # 64 of each leaf
    verdict = rules.judge(dumped(on_unit(f, -0.125, 8.0, ranks=[2], steps=[2])))
    assert verdict.rule == "ranks" and "64 images" in str(verdict.detail)


# -------------------------------------------------------------------------------------------------- what may not exist


def test_an_argument_that_may_not_exist() -> None:
    """1/x, 0/x and the root of x, also in a network that is called, on [-1, 1]."""
    root = {"name": "g", "reads": 1, "steps": [mapped("sqrt", 0)]}
    for a in (["/", "1", "x"], ["*", "0", ["/", "1", "x"]], ["sqrt", "x"], ["network", "g", 0, "x"]):
        for jump in (["*", "0", H(a)], H(plus(a, "9")), H(times(0, H(a)))):
            for lo, rule in ((-1.0, FIRST), (0.0625, None)):
                data = on_unit(plus("1/4", times(Fraction(1, 2), jump)), lo)
                assert found(edited(data, "networks", [*data["networks"], root])) == rule


def test_an_argument_without_a_finite_model() -> None:
    tower = times(1000, "x")
    for _ in range(6):
        tower = ["exp", tower]
    for a in (tower, ["-", tower], ["-", tower, tower]):
        assert found(on_unit(plus("1/4", times(Fraction(1, 4), H(a))))) == FIRST


def test_a_next_state_that_may_not_exist_with_one_of_the_values() -> None:
    for a, rule in (("x", FIRST), (plus("x", str(HAIR)), None)):
        assert found(on_unit(["/", "1/2", H(a)])) == rule
        assert found(on_unit(plus("1/2", ["*", "0", ["sqrt", ["-", H(a), "1/2"]]]))) == rule


# ------------------------------------------------------------------------------------------------------ what has a form


def different(count: int) -> list[list[Any]]:
    """All are 0 on [0, 1]."""
    return [H(["-", "x", str(k + 2)]) for k in range(count)]


def test_six_different_jumps() -> None:
    nested: Any = "x"
    for _ in range(6):
        nested = H(["-", nested, "2"])
    same = [H(["-", "x", "2"]), H(plus("x", "-2")), H(plus("x", ["-", "2"])), H(plus("x", ["-", "1", "3"]))]
    for sums in (
        [different(6)],
        [different(6) * 2],
        [different(3), different(6)],
        [[nested]],
        [[*same, *different(6)]],
    ):
        more = [*sums[:-1], [*sums[-1], H(plus("-9", "x"))]]
        for each, rule in ((sums, None), (more, ("format", "plant.dynamics"))):
            dynamics: list[Any] = [plus("1/2", *terms) for terms in each]
            assert found(document(dynamics, [0.0] * len(sums), [1.0] * len(sums))) == rule


def test_the_same_jump_has_one_value() -> None:
    assert found(on_unit(plus("1/2", H(APART), ["-", H(plus("x", "-1/2"))]))) is None
    assert found(on_unit(plus("1/2", H(APART), ["-", H(plus("-1/2", "x"))]))) == FIRST


@pytest.mark.parametrize("bad", [["heaviside"], ["heaviside", "x", "x"], ["heaviside", "z"], ["Heaviside", "x"], H([])])
def test_what_is_no_jump(bad: Any) -> None:
    assert found(on_unit(plus("1/2", bad))) == ("format", "plant.dynamics.0")


def elsewhere() -> Iterator[tuple[str, Document]]:
    """Certificates with a jump where none is expected, and where that is."""
    jump, half = H(["-", "x", "2"]), ["/", "x", "2"]
    f = plus(half, jump)
    yield "claim.keep.0", on_unit(half, keep=[["-", jump, "2"]])
    yield "claim.target.0", on_unit(half, target=[jump])
    for sample in (("1/2", "1/2"), ("1/4", "1/2")):
        yield "plant.dynamics.0", on_unit(f, sample=sample)
        yield "plant.dynamics.0", on_unit(f, sample=sample, target=["x"])
    yield "plant.dynamics.0", edited(on_unit(f), "plant.time", "continuous")
    watching = {"kind": "observe", "of": [0], "names": ["x"], "expressions": [jump]}
    data = on_unit(half)
    yield "networks.0.steps.0.expressions.0", edited(data, "networks.0.steps", [watching])
    g = {"name": "g", "reads": 1, "steps": [watching]}
    yield "networks.1.steps.0.expressions.0", edited(data, "networks", [*data["networks"], g])
    around = around_level(on_unit(f, -1.0, target=["x"]), 1.0, 0.25)
    yield "plant.dynamics.0", around
    for kind in ("practical", "nearby"):
        yield "plant.dynamics.0", edited(around, "claim.kind", kind)
    timed: Document = {key: value for key, value in around["claim"].items() if key != "ranks"}
    yield "plant.dynamics.0", edited(around, "claim", timed)
    yield "plant.dynamics.0", edited(around, "claim", timed | {"kind": "enlarged", "start": ""})
    yield "plant.dynamics.0", edited(around, "claim", timed | {"kind": "reached", "start": "", "centre": ""})
    still = edited(around_level(on_unit(half, -1.0, target=["x"]), 1.0, 0.25), "plant.time", "continuous")
    outer = {"outer": {"expression": jump, "level": (0.5).hex()}}
    yield "claim.outer.expression.0", edited(still, "claim", timed | outer)
    yield "claim.outer.expression.0", edited(still, "claim", {"kind": "invariant"} | outer)
    yield "plant.dynamics.0", edited(around, "claim", {"kind": "invariant"} | outer)


@pytest.mark.parametrize(("at", "data"), list(elsewhere()))
def test_elsewhere(at: str, data: Document) -> None:
    assert found(data) == ("format", at)
    assert found(json.loads(dumped(data).replace(b"heaviside", b"sin"))) != ("format", at)


def test_an_angle() -> None:
    """A jump of a number that winds is not periodic, one of its sine is."""
    for f, rule in (
        (plus("x", H(["-", ["sin", "x"], "1/2"])), None),
        (plus("x", H(APART)), "angles"),
        (plus("x", ["*", "0", H("x")]), "angles"),
        (["*", "x", H(["+", ["sin", "x"], "2"])], "angles"),
    ):
        by = found(on_unit(f, -3.25, 3.25, angles=("x",)))
        assert (by and by[0]) == rule


def test_jumps_are_operations() -> None:
    c = read(dumped(on_unit(plus("1/2", H(H("x")), ["*", H("x"), H("u")]))))
    assert c.plant.dynamics.jumps == 3


# --------------------------------------------------------------------------------------------------------------- chance

Row = list[Fraction]  # of a number that is affine in symbols of [-1, 1]: its middle, and the slopes


def value(tree: Any, names: dict[str, Row], chosen: dict[str, int]) -> Row:
    """An expression with these values of the jumps that it has."""
    if isinstance(tree, str):
        return names[tree] if tree in names else [Fraction(tree), *[Fraction(0)] * (len(names["x"]) - 1)]
    if tree[0] == "heaviside":
        return value(str(chosen[str(tree)]), names, chosen)
    first, *others = (value(part, names, chosen) for part in tree[1:])
    for other in others:
        if tree[0] == "+":
            first = [a + b for a, b in zip(first, other, strict=True)]
        else:
            a, b = (first, other) if any(other[1:]) else (other, first)
            first = [a[0] * v for v in b]
    return first


def ends(row: Row) -> tuple[Fraction, Fraction]:
    reach = sum(map(abs, row[1:]), Fraction(0))
    return row[0] - reach, row[0] + reach


def images(trees: list[Any], jumps: list[Any], x: list[Row]) -> Iterator[list[Row]]:
    """The rule in rationals, by all choices."""
    names = dict(zip(("x", "y"), x, strict=False))
    for choice in product((0, 1), repeat=len(jumps)):
        chosen = {str(jump): v for jump, v in zip(jumps, choice, strict=True)}
        sides = [(v, *ends(value(jump[1], names, chosen))) for v, jump in zip(choice, jumps, strict=True)]
        if all(hi >= 0 if v else lo <= 0 for v, lo, hi in sides):
            yield [value(tree, names, chosen) for tree in trees]


def stays(data: Document, jumps: list[Any], box: Sequence[tuple[float, float]], steps: int, kept: list[Any]) -> bool:
    """True if all images of a box lie in the tree's box, and meet no leaf but those that are kept."""
    sides = [(Fraction(a), Fraction(b)) for a, b in box]
    now = [[[(a + b) / 2, *((b - a) / 2 * (k == i) for k in range(len(box)))] for i, (a, b) in enumerate(sides)]]
    for _ in range(steps):
        now = [image for x in now for image in images(data["plant"]["dynamics"], jumps, x)]
    for each in now:
        at = [ends(row) for row in each]
        if any(a < -1 or b > 1 for a, b in at):
            return False
        for leaf, keeps in kept:
            if not keeps and all(a <= q and p <= b for (a, b), (p, q) in zip(at, leaf, strict=True)):
                return False
    return True


def drawn(chance: random.Random, n: int) -> tuple[list[Any], list[Any]]:
    """Affine equations with one to three jumps, of which some are in arguments or products of others."""

    def number(most: int, of: int = 16) -> str:
        return str(Fraction(chance.randint(-most, most), of))

    jumps = list[Any]()
    for _ in range(chance.randint(1, 3)):
        inner = [["*", number(8), chance.choice(jumps)]] if jumps and chance.random() < 0.5 else []
        jumps.append(H(["+", *(["*", number(8), name] for name in ("x", "y")[:n]), number(8), *inner]))
    trees = [
        [
            "+",
            *(["*", number(6), name] for name in ("x", "y")[:n]),
            *(["*", number(5), jump] for jump in jumps),
            ["*", number(4), chance.choice(jumps), chance.choice(jumps)],
        ]
        for _ in range(n)
    ]
    return trees, jumps


def in_pieces(chance: random.Random) -> tuple[Document, list[Any], list[list[tuple[float, float]]], list[int]]:
    """A claim to remain in leaves, the jumps, the leaves, and how many steps each takes."""
    n = chance.randint(1, 2)
    trees, jumps = drawn(chance, n)
    depth = chance.choice([0, 1, 2, 3])
    _, leaves = uniform([-1.0] * n, [1.0] * n, depth)
    steps = [chance.choice([1, 1, 2, 2, 0]) if depth else chance.randint(1, 2) for _ in leaves]
    return document(trees, [-1.0] * n, [1.0] * n, depth, [2 if k else NO for k in steps], steps), jumps, leaves, steps


def test_affine_pieces_as_rationals_have_them() -> None:
    """All coefficients are multiples of 1/16, so that many edges coincide exactly, and nothing is rounded."""
    chance, count = random.Random(5), {True: 0, False: 0}
    for _ in range(120):
        data, jumps, leaves, steps = in_pieces(chance)
        kept = list(zip(leaves, map(bool, steps), strict=True))
        good = all(stays(data, jumps, leaf, k, kept) for leaf, k in zip(leaves, steps, strict=True) if k)
        assert (found(data) is None) == good
        count[good] += 1
    assert min(count.values()) > 20


# --------------------------------------------------------------------------------------------------------- the checker


def within(lift: Fraction) -> Iterator[tuple[str, Document]]:
    """Certificates that hold by so much, or do not where it is negative, by the rule that refuses them then."""
    half, edge = ["/", "x", "2"], str(Fraction(1, 2) - lift)
    yield "ranks", on_unit(plus(half, ["*", edge, H(["-", "x", "1/3"])], str(lift / 2)))
    yield "ranks", on_unit(plus(half, times(5, H(["-", "x", str(1 + lift)])), "1/8"))
    yield "ranks", on_unit(plus(half, times(5, ["-", "1", H(plus("x", str(lift)))]), "1/8"))
    yield "ranks", on_unit(plus(["/", "x", "4"], times(5, H(plus(["-", APART, APART], str(-lift)))), "1/8"))
    yield "ranks", on_unit(plus("1/2", times(5, H(["-", plus("x", H(["-", "x", str(1 + lift)])), "3/2"]))))
    late: dict[str, Any] = {"target": [["-", str(Fraction(13, 2) + HAIR), "x"]]}
    yield "ranks", far(domain=("-1", str(1 + lift)))
    yield "keep", far(keep=[["-", "x", str(1 + lift)]])
    yield "ranks", far(**late, domain=("-1", str(7 + lift)))
    yield "keep", far(**late, keep=[["-", "x", str(7 + lift)]])
    yield "inputs", edited(far(network=[affine([[1.0]])], bound="1"), "plant.input_bounds.0", ["-1", str(1 + lift)])


@pytest.mark.parametrize("k", range(10))
def test_the_checker_sees_small_margins(k: int) -> None:
    for lift in (Fraction(1, 10**6), Fraction(-1, 10**6), Fraction(1, 10**10), Fraction(-1, 10**10)):
        rule, data = list(within(lift))[k]
        assert by_checker(data) == (None if lift > 0 else rule)


def test_the_checker_has_the_same_limits() -> None:
    for count, rule in ((40, None), (64, "ranks")):
        assert by_checker(on_unit(GROWS, -0.125, 2.5, ranks=[count], steps=[count])) == rule
    for count, rule in ((6, None), (7, "format")):
        assert by_checker(on_unit(plus("1/2", *different(count)))) == rule
    assert by_checker(document([GROWS], [-1.0], [1.0], 1, [3, 3], [3, 3], target=[["-", "x", "2"]])) is None
    assert by_checker(document([GROWS], [-4.0], [4.0], 4, [3] * 16, [1, 2, 3, 1] * 4)) is None
    assert by_checker(on_unit(plus("1/2", H(APART), ["-", H(plus("x", "-1/2"))]))) is None
    assert by_checker(on_unit(plus("x", H(["-", ["sin", "x"], "1/2"])), -3.25, 3.25, angles=("x",))) is None


@pytest.mark.slow
@pytest.mark.parametrize("size", slow_after(1, [2, 1, 3]))
def test_the_checker_says_the_same_in_small_batches(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A leaf may then have more images than a batch has places, and all leaves must keep their own."""
    chance = random.Random(11)
    every = [in_pieces(chance)[0] for _ in range(30)]
    every += [document([GROWS], [-4.0], [4.0], 4, [3] * 16, [1, 2, 3, 1] * 4), *(d for _, d in within(HAIR))]
    for first in (12, 11, 10):
        left = [k if i < first else 0 for i, k in enumerate([1, 2, 3, 1] * 4)]
        every.append(document([GROWS], [-4.0], [4.0], 4, [3 if k else NO for k in left], left))
    said = [by_checker(data) for data in every]
    assert None in said and any(said)
    monkeypatch.setattr(Steps, "batch", size)
    assert [by_checker(data) for data in every] == said
