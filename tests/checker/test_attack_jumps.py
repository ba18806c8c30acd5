"""Jumps in many leaves and images at once: what a checker must not lose, mix up or keep."""

from __future__ import annotations

import json
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from certify.checker import document as read
from certify.checker import rules
from certify.checker.case import Case
from certify.checker.errors import Rejected
from certify.checker.near import Array, Form
from certify.checker.ranks import Steps
from tests.reference.test_jumps import APART, H, document, found, on_unit, plus, times
from tests.support.rank_forgeries import by_checker
from tests.support.ranked import Document, dumped


def place(data: Document) -> str | None:
    """Where the checker refuses a document; None if it accepts."""
    try:
        rules.check(read.certificate(json.loads(dumped(data)), "0" * 64))
    except Rejected as no:
        return no.at
    return None


def test_the_last_image_of_the_last_leaf_counts() -> None:
    """x/2 + (H(w) + H(w - 1/2))/8 on 32 leaves of [-1, 1] has 128 images; only the last leaf may also lead to 5."""
    either = [times(Fraction(1, 8), H(["-", "w", shift])) for shift in ("0", "1/2")]
    for end, rule in (("1000001/1000000", None), ("1", ("ranks", "ranks leaf 31"))):
        f = plus(times(5, H(["-", "x", end])), ["/", "x", "2"], *either)
        data = document([f], [-1.0], [1.0], 5, [1] * 32, uncertain=[("w", "-1", "1")])
        assert found(data) == rule
        assert by_checker(data) == (rule and rule[0])


@pytest.mark.parametrize("size", [1, 2, 3, 4096])
def test_each_image_counts_for_its_own_leaf(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """x + 17/16 - H(5/2 - x)/2 on eight leaves of [0, 8] leads from the third in two steps to the fourth to sixth, of
    ranks 4, 3 and 2, but to the fourth by the last image alone; from the others too, and at last beyond 69/10."""
    f = plus("x", "17/16", times(Fraction(-1, 2), H(["-", "5/2", "x"])))
    monkeypatch.setattr(Steps, "batch", size)
    for third, at in ((6, None), (5, "rank leaf 2")):
        ranks, steps = [10, 8, third, 4, 3, 2, 1, 0], [2] * 6 + [1, 0]
        assert place(document([f], [0.0], [8.0], 3, ranks, steps, target=[["-", "69/10", "x"]])) == at


def test_constraints_and_jumps_have_the_states_in_their_order() -> None:
    """On x in [0, 1] and y in [2, 3], with H(y - x) = 1."""
    f = [plus(["/", "x", "2"], "1/4", ["-", "1", H(["-", "y", "x"])]), plus("5/4", ["/", "y", "2"])]
    for keep, rule in ((["-", "x", "3/2"], None), (["-", "y", "3/2"], "keep"), (["-", "3/2", "y"], None)):
        data = document(f, [0.0, 2.0], [1.0, 3.0], keep=[keep])
        assert (found(data) or [None])[0] == rule
        assert by_checker(data) == rule


def test_the_checker_excludes_a_value_whatever_the_others_are() -> None:
    """H(x - 2) is 0 on [0, 1], before and after another that may be 0 and 1."""
    never, either = times(5, H(["-", "x", "2"])), times(Fraction(1, 4), H(APART))
    for terms in ((never, either), (either, never)):
        assert by_checker(on_unit(plus("1/2", *terms))) is None


def test_the_checker_takes_sixty_four_images() -> None:
    """Of each leaf."""
    f = plus(["/", "x", "2"], *(times(Fraction(1, 2), H(times(k, "x"))) for k in range(1, 7)))
    assert by_checker(document([f], [-8.0], [8.0], 1, [1, 1])) is None


def test_a_state_that_does_not_matter_to_the_target_must_exist_too() -> None:
    """y+ = 1/y beside a jump of x, on leaves with y in [0, 1] and [1, 2]; the first leaf is named."""
    f = [plus("x", "7", H(APART)), ["/", "1", "y"]]
    beyond: dict[str, Any] = {"target": [["-", "6", "x"]], "ranks": [1] * 4}
    assert found(document(f, [0.0, 0.0], [1.0, 2.0], 2, **beyond)) == ("ranks", "ranks leaf 0")
    assert by_checker(document(f, [0.0, 0.25], [1.0, 2.0], 2, **beyond)) is None


def test_the_checker_names_the_leaf_whose_step_is_undefined() -> None:
    """1/(x - 3/8) on the third of four leaves of [-1/2, 3/4]; the first has two images, the others one."""
    f = plus(["*", "0", ["/", "1", ["-", "x", "3/8"]]], times(Fraction(1, 4), H(plus("x", "1/2"))))
    assert place(document([f], [-0.5], [0.75], 2, [1] * 4)) == "rank leaf 2"


@pytest.mark.parametrize("late", [False, True])
def test_images_do_not_wait_for_each_other(late: bool) -> None:
    """Five states that a jump may raise and a clock: a leaf has 32 images after a step, and 1,024 after two, which are
    in the target or too many."""
    names, lo, hi = ("x", "y", "z", "p", "q"), [-1.0] * 5 + [0.0], [1.0] * 6
    f = [*(plus(v, H(v)) for v in names), plus("t", "1")]
    data = document(f, lo, hi, ranks=[2], steps=[2], states=(*names, "t"))
    data["claim"] |= {"kind": "reaches", "target": [["-", "5/2" if late else "3/2", "t"]]}
    sizes = list[int]()

    class Watched(Steps):
        batch = 32

        def is_in_target(self, x: Form) -> Array:
            sizes.append(x.value.shape[-1])
            return super().is_in_target(x)

    steps = Watched(Case(read.certificate(json.loads(dumped(data)), "0" * 64)))
    course = steps.examine(0, *np.array([lo, hi])[:, :, None])
    assert (list(course.failed), max(sizes)) == (["ranks"] * late, 32)
