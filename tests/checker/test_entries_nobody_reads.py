"""What no expression reads must exist as well: arguments of calls, of jumps, and entries within networks, which
`observe` may leave out."""

from __future__ import annotations

from typing import Any

import pytest

from tests.reference.test_jumps import FIRST, H, document, found, on_unit, plus
from tests.support.certificates import Document, edited, verdict
from tests.support.rank_forgeries import by_checker, by_reference
from tests.support.ranked import Loop, affine, around_level, encode, mapped, raw, two_bytes, uniform
from tests.support.reference import judge
from tests.support.staying import base

POLES = (["/", "1", "x"], ["sqrt", "x"], ["*", "0", ["/", "1", "x"]])


def reading(names: list[str], *expressions: Any) -> Document:
    return {"kind": "observe", "of": [0], "names": names, "expressions": list(expressions)}


def calling(f: Any, steps: list[Document], lo: float, reads: int = 2) -> Document:
    """x+ = f stays in [lo, 1], f calling g."""
    data = document([f], [lo], [1.0])
    return edited(data, "networks", [*data["networks"], {"name": "g", "reads": reads, "steps": steps}])


@pytest.mark.parametrize("pole", POLES)
def test_an_argument_of_a_call_and_of_a_jump(pole: Any) -> None:
    """g(x/2 + 1/8, ...) = x/2 + 1/8 on [-1, 1] and on [1/16, 1], whatever its second argument is."""
    half = plus(["/", "x", "2"], "1/8")
    for second in (pole, H(pole), H(["-", H(pole), "1/2"]), ["network", "g", 0, "x", pole]):
        for lo, rule in ((-1.0, FIRST), (0.0625, None)):
            data = calling(["network", "g", 0, half, second], [reading(["p", "q"], "p")], lo)
            assert found(data) == rule
            assert by_checker(data) == (rule and rule[0])


@pytest.mark.parametrize("pole", POLES)
def test_an_entry_within_a_network(pole: Any) -> None:
    """The first step makes two entries, of which the second step reads one."""
    first, second = reading(["x"], plus(["/", "x", "2"], "1/8"), pole), reading(["p", "q"], "p") | {"of": [1]}
    for lo, rule in ((-1.0, FIRST), (0.0625, None)):
        data = calling(["network", "g", 0, "x"], [first, second], lo, 1)
        assert found(data) == rule
        assert by_checker(data) == (rule and rule[0])


@pytest.mark.parametrize("time", ["discrete", "continuous"])
def test_beyond_the_ball(time: str) -> None:
    """x/2, or -x/2, with V = x^2 on [-1/2, 1/2]: on the ring something is undefined from a number on."""
    f = ["/", "x", "2"] if time == "discrete" else ["-", ["/", "x", "2"]]
    for end, rule in (("1/4", "ring"), ("1", None)):
        for pole in (["sqrt", plus("x", end)], ["/", "1", plus("x", end)]):
            loop = Loop([["network", "g", 0, f, pole]], [affine([[0.0]])], ["x"])
            data = around_level(loop.document([-1.0], [1.0], b"\xff", two_bytes([1]), b"\1"), 1.0, 0.25)
            del data["claim"]["ranks"], data["evidence"]["ranks"]
            data["networks"].append({"name": "g", "reads": 2, "steps": [reading(["p", "q"], "p")]})
            data["plant"]["time"], data["levels"]["local"] = time, (0.01).hex()
            data["evidence"]["local"]["J"], data["evidence"]["tree"] = encode(0.101), raw(uniform([-1.0], [1.0], 4)[0])
            assert (by_checker(data), by_reference(data)) == (rule, rule)


def test_a_policy_that_the_equations_do_not_read() -> None:
    """tanh(sqrt(x)), which is in its bounds by form; with jumps too."""
    for f in (plus(["/", "x", "2"], "1/8"), plus("1/4", ["/", H(["-", "x", "1/2"]), "2"])):
        for lo, rule in ((-1.0, ("inputs", FIRST[1])), (0.0625, None)):
            data = on_unit(f, lo, network=[mapped("sqrt", 0)], squash="tanh")
            assert found(data) == rule
            assert by_checker(data) == (rule and rule[0])


def test_the_function_of_a_set() -> None:
    """N of a call that leaves out the root of x + 100, or of x + 1/10, on a domain with x < -1."""
    data = base("an interval")
    N, networks = data["claim"]["outer"]["expression"], data["networks"]
    known = edited(data, "networks", [*networks, {"name": "g", "reads": 2, "steps": [reading(["p", "q"], "p")]}])
    for end, rule in (("100", None), ("1/10", "faces")):
        found = edited(known, "claim.outer.expression", ["network", "g", 0, N, ["sqrt", plus("x", end)]])
        assert (verdict(found), judge(found)) == (rule or "ACCEPTED", rule)
