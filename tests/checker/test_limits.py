"""The rule `limits`: no small file keeps a checker busy for hours or fills its memory, and both count the same."""

from __future__ import annotations

import base64
import json
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.certificates.checking import command
from certify.checker import document, limits, rules
from certify.checker.case import Case
from certify.checker.errors import Rejected
from certify.checker.outer import Beyond
from certify.checker.ranks import Steps
from certify.checker.ring import Ring
from certify.reference import document as reference_document
from certify.reference import limits as reference_limits
from certify.reference import rules as reference_rules
from tests.checker.test_networks import hash_of
from tests.checker.test_uncertain_tube import decay
from tests.support.certificates import LEAF, Document, dump, edited, encode, make
from tests.support.earlier import newer
from tests.support.ranked import Loop, affine

PROGRAMS = ("checker", "reference")
CHAPTER = (Path(document.__file__).parent / "format" / "limits.md").read_text()


def loop(
    n: int = 2, m: int = 1, k: int = 0, leaves: int = 1, terms: int = 0, hidden: tuple[int, ...] = (), **more: Any
) -> Document:
    """xdot = -x and a term that is 0 but takes `terms` powers to say, V = x'x, k ranges, and a tree that is a comb."""
    x, u, q = ([f"{letter}{i}" for i in range(count)] for letter, count in (("x", n), ("u", m), ("q", k)))
    rows = [["-", name] for name in x]
    if terms:
        powers = [["**", ["+", x[i % n], u[i % m], f"1/{i + 2}"], 63] for i in range(terms)]
        rows[0] = ["+", rows[0], ["*", "0", ["+", *powers]]]
    sizes, random = (n, *hidden, m), np.random.default_rng(0)
    layers = [(0.01 * random.standard_normal((b, a)), np.zeros(b)) for a, b in pairwise(sizes)]
    stated: dict[str, Any] = {
        "states": x,
        "inputs": u,
        "u_eq": ["0"] * m,
        "domain": [("-3", "3")] * n,
        "input_bounds": [("-2", "2")] * m,
        "centre": "none",
        "scale": np.ones(m),
        "offset": np.zeros(m),
        "claim": "practical",
        "uncertain": [(name, "-1", "1") for name in q],
        "tree": bytes([0, LEAF] * (leaves - 1) + [LEAF]),
    }
    levels = more.pop("levels", (0.25, 1.0))
    return make(rows, layers, np.eye(n), levels, **stated | more)


def with_outer(kind: str = "network") -> Document:
    data = loop()
    layers = [
        {"shape": shape, "weight": encode(np.ones(shape)), "bias": encode(np.zeros(shape[0]))}
        for shape in ([5, 2], [1, 5])
    ]
    N = {"kind": "network", "layers": layers} if kind == "network" else {"kind": kind, "expression": ["*", "x0", "x1"]}
    tree = base64.b64encode(bytes([0, LEAF, LEAF])).decode()
    faces = [base64.b64encode(bytes([LEAF])).decode()] * 4
    data["evidence"]["outer"] = {"T": encode(np.eye(2)), "root": encode([4.0, 4.0]), "tree": tree, "faces": faces}
    return edited(data, "claim.outer", {**N, "level": (9.0).hex()})


def with_tube(claim: str) -> Document:
    """Of two slabs; whether they hold is not asked here."""
    data = loop(claim="asymptotic")
    data["claim"] |= {"kind": claim, "start": encode(np.eye(2))}
    path, k = None, 2
    if claim == "reached":
        data["claim"]["centre"] = encode(np.zeros(2))
        path = {"centre": encode(np.zeros(2))} | dict.fromkeys(("share", "edge", "motion", "joint"), (0.5).hex())
        k = 3
    slab = {"middle": encode(np.eye(2) / 3), "end": encode(np.eye(2)), "duration": (1.0).hex(), "J": encode(np.eye(2))}
    slab |= {"multipliers": encode(np.ones(6)), "weight": encode(np.eye(k)), "path": path}
    return edited(data, "evidence.tube", [slab, slab])


def nearby(k: int = 2, cells: Sequence[int] = (3, 2)) -> Document:
    data = loop(k=k, cells=cells, claim="nearby", levels=(0.25, 0.5, 1.0))
    ball = {"J": encode(np.eye(2)), "weights": encode([1.0, 1.0]), "weight": encode(np.eye(2))}
    return edited(data, "evidence.contraction", ball)


def on_a_ball(data: Document) -> Document:
    """With a local ball, on which nothing holds."""
    n = len(data["plant"]["states"])
    ball = {"J": encode(np.eye(n)), "multipliers": encode(np.ones(3 * n)), "weight": encode(np.eye(n))}
    return edited(data, "evidence.local", {**ball, "edge": (0.0).hex(), "order": 1})


def calling(base: Document) -> Document:
    """The equations call a network of all kinds of steps, twice with the same arguments, and the policy's network,
    which observes its last vector."""
    data = newer(base)
    g = [
        {"kind": "affine", "of": [0], "shape": [3, 1], "weight": encode(np.ones(3)), "bias": encode(np.zeros(3))},
        {"kind": "observe", "of": [1], "names": ["a", "b", "c"], "expressions": [["*", "a", ["sin", "b"]], "c"]},
        {"kind": "concat", "of": [2, 1, 0]},
        {"kind": "clip", "of": [3], "lo": encode(-np.ones(6)), "hi": encode(np.ones(6))},
        {"kind": "sum", "of": [3, 4]},
        {"kind": "affine", "of": [5], "shape": [2, 6], "weight": encode(np.ones(12)), "bias": encode(np.zeros(2))},
    ]
    data["networks"].append({"name": "g", "reads": 1, "steps": g})
    own = data["networks"][0]["steps"]
    own.append({"kind": "observe", "of": [len(own)], "names": ["v"], "expressions": [["exp", ["-", "v"]]]})
    data["policy"]["sha256"] = hash_of(data)
    calls = [["network", "g", 0, "x1"], ["network", "g", 1, "x1"], ["network", "g", 1, ["sin", "x0"]]]
    data["plant"]["dynamics"][0] = ["+", ["-", "x0"], *calls, ["network", "policy", 0, "x0", "x1"]]
    return data


def calling_beyond(base: Document) -> Document:
    data = calling(base)
    data["claim"]["outer"]["expression"] = ["+", ["network", "g", 1, "x0"], ["network", "policy", 0, "x0", "x1"]]
    return data


SAMPLE = ("1/100", "1/50")
BOMBS: dict[str, tuple[Callable[[], Document], str]] = {
    "operations, symbols and order": (lambda: loop(n=4, m=2, k=60, terms=600, sample=SAMPLE, order=8), "numbers"),
    "operations and symbols": (lambda: loop(n=60, m=2, k=60, terms=600), "numbers"),
    "order and leaves": (lambda: loop(terms=60, leaves=2000, sample=SAMPLE, order=8), "operations"),
    "cells and corners": (lambda: on_a_ball(loop(n=1, k=4, cells=[8, 8, 8, 8])), "operations"),
    "cells and six corners": (lambda: on_a_ball(loop(n=8, k=40, cells=[64, 64, *[1] * 38])), "operations"),
    "corners": (lambda: nearby(40, [1] * 40), "operations"),
    "leaves and states": (lambda: loop(n=40, m=8, leaves=8000), "operations"),
    "leaves and units": (lambda: loop(leaves=40_000, hidden=(1024, 1024)), "operations"),
    "units and units": (lambda: on_a_ball(loop(hidden=(256,) * 17)), "numbers"),
    "states of a ball": (lambda: on_a_ball(loop(n=60, terms=300)), "numbers"),
    "bits of P": (lambda: edited(loop(n=64), "lyapunov.P", encode(np.diag(np.logspace(-300, 300, 64)))), "operations"),
    "deep trees": (lambda: loop(n=64, m=64, leaves=3000), "operations"),
}


def told(program: str, path: Path, *options: str) -> tuple[int, dict[str, Any]]:
    line = command(program, ["--json", *options, str(path)])  # type: ignore[arg-type]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=30)
    return done.returncode, json.loads(done.stdout)


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("name", BOMBS)
def test_a_file_that_asks_for_too_much_is_refused_at_once(name: str, program: str, tmp_path: Path) -> None:
    build, at = BOMBS[name]
    path = tmp_path / "bomb.json"
    path.write_bytes(dump(build()))
    status, answer = told(program, path)
    assert (status, answer["result"], answer["rule"], answer["at"]) == (1, "REJECTED", "limits", at)


def with_ranks(data: Document) -> Document:
    lo, hi = encode([-1.0, -1.0]), encode([1.0, 1.0])
    octets = {"tree": b"\0\xff\xff", "ranks": b"\0\0\2\0", "steps": b"\0\2"}
    found = {name: base64.b64encode(of).decode() for name, of in octets.items()}
    data = edited(data, "claim.ranks", {"angles": [], "steps": 5})
    return edited(data, "evidence.ranks", {"lo": lo, "hi": hi, **found})


HONEST: dict[str, Callable[[], Document]] = {
    "leaves": lambda: loop(leaves=7, hidden=(5, 3), terms=2),
    "sampled": lambda: loop(leaves=3, sample=SAMPLE, order=3, k=1),
    "held for one time": lambda: loop(sample=("1/100", "1/100"), order=2),
    "discrete": lambda: loop(time="discrete"),
    "ball": lambda: loop(k=2, cells=[3, 2], hidden=(4, 4), levels=(0.25, 0.5, 1.0)),
    "sampled ball": lambda: loop(sample=SAMPLE, order=2, levels=(0.25, 0.5, 1.0)),
    "ball alone": lambda: loop(claim="asymptotic", levels=(1.0, 1.0)),
    "centred by its form": lambda: loop(claim="asymptotic", centre="preactivation"),
    "nearby": nearby,
    "enlarged": lambda: with_tube("enlarged"),
    "reached": lambda: with_tube("reached"),
    "outer network": with_outer,
    "outer expression": lambda: with_outer("expression"),
    "ranks": lambda: with_ranks(loop(leaves=3, time="discrete")),
    "ranks in a frame": lambda: edited(
        with_ranks(loop(leaves=3, time="discrete")), "evidence.ranks.frame", encode([1.0, 2.0**-90, -3e-20, 2.0])
    ),
    "ranks with a memory": lambda: edited(
        with_ranks(loop(leaves=3, sample=SAMPLE, order=2)), "evidence.ranks.memory", 5
    ),
    "ranks beside a ball of another order": lambda: edited(
        with_ranks(loop(leaves=3, sample=SAMPLE, order=2, levels=(0.25, 0.5, 1.0))), "evidence.local.order", 4
    ),
}  # fmt: skip


CALLING: dict[str, Callable[[], Document]] = {
    "calls on leaves": lambda: calling(loop(leaves=7, hidden=(5,))),
    "calls on a ball": lambda: calling(loop(k=1, cells=[3], levels=(0.25, 0.5, 1.0))),
    "calls in periods": lambda: calling(loop(leaves=3, sample=SAMPLE, hidden=(4,))),
    "calls in periods on a ball": lambda: calling(loop(sample=("1/100", "1/100"), levels=(0.25, 0.5, 1.0))),
    "calls nearby": lambda: calling(nearby()),
    "calls in a tube": lambda: calling(with_tube("reached")),
    "calls beyond": lambda: calling_beyond(with_outer()),
}  # fmt: skip


def counts(data: Document, folder: Path) -> tuple[int, int]:
    """Numbers and operations, as both programs count them."""
    raw, path = dump(data), folder / "certificate.json"
    path.write_bytes(raw)
    sizes, other = limits.Sizes(document.read(str(path))), reference_document.read(raw)
    own = sizes.numbers(), sizes.work()
    assert own == (reference_limits.numbers(other), reference_limits.operations(other))
    return own


def long(count: int) -> Any:
    """A constraint of some four times so many operations, which is -1."""
    return ["-", ["*", "0", ["+", *(["*", "x0", ["+", "x0", str(k + 1)]] for k in range(count))]], "1"]


@pytest.mark.parametrize("count", [100, 1000, 3000])
@pytest.mark.parametrize("what", ["ring", "outer", "constraints of ranks", "target"])
def test_constraints_count_where_leaves_are_examined_together(what: str, count: int) -> None:
    """All values of an expression are held on all leaves of a batch: 4096 leaves made 2,000 operations a gigabyte."""
    keep, comb = [long(count)], bytes([0, LEAF] * 4999 + [LEAF])
    if what in ("ring", "outer"):
        data = edited(with_outer("expression") if what == "outer" else loop(), "claim", lambda c: c | {"keep": keep})
        for at in ("evidence", "evidence.outer")[: 1 + (what == "outer")]:
            data = edited(data, f"{at}.tree", base64.b64encode(comb).decode())
    else:
        target, kept = (keep, None) if what == "target" else ([["-", "x0", "1"]], keep)
        stepping = Loop([["*", "1/2", "x0"]], [affine([[0.0]])], target, ("x0",), keep=kept)
        data = stepping.document([-1.0], [1.0], comb, bytes(10_000), bytes(5000))
    case = Case(document.certificate(json.loads(dump(data)), "0" * 64))
    boxes = Ring(case) if what == "ring" else Beyond(case) if what == "outer" else Steps(case)
    _, lo, _ = next(boxes.leaves())
    assert (2 if count == 100 else 1) <= lo.shape[1] <= limits.MOST_NUMBERS // (4 * count * (boxes.symbols + 1) ** 2)


@pytest.mark.parametrize("name", HONEST)
def test_both_programs_count_the_same(name: str, tmp_path: Path) -> None:
    numbers, work = counts(HONEST[name](), tmp_path)
    assert numbers < limits.MOST_NUMBERS / 100 and work < reference_limits.MAX_OPERATIONS / 20


@pytest.mark.parametrize("name", CALLING)
def test_both_programs_count_calls_the_same(name: str, tmp_path: Path) -> None:
    numbers, work = counts(CALLING[name](), tmp_path)
    assert numbers < limits.MOST_NUMBERS / 3 and work < reference_limits.MAX_OPERATIONS


def test_the_numbers_are_those_of_the_page() -> None:
    found = re.findall(r"(?:(\d+) )?2\^(\d+)", CHAPTER.split("Under the rule")[0].replace("2^25 here", "2^25"))
    stated = [int(factor or 1) * 2 ** int(power) for factor, power in found]
    assert stated == [limits.MOST_NUMBERS, limits.MOST_WORK, reference_limits.MAX_OPERATIONS, limits.MOST_IN_PATIENCE]
    assert limits.MOST_NUMBERS == reference_limits.MAX_NUMBERS
    assert limits.MOST_IN_PATIENCE == reference_limits.MAX_IN_PATIENCE


def test_the_counts_are_those_of_the_page(tmp_path: Path) -> None:
    """A loop counted by hand, after the page's lines, with none of either program's."""
    data = loop(k=1, leaves=5, hidden=(3,), cells=[2], levels=(0.25, 0.5, 1.0))
    n, m, y, s, d, a, t = 2, 1, 1, 4, 2, 4, 2 * 4 + 2 * 3 * 4 // 6
    layers = [(3, 2, 0), (1, 3, 3)]
    H, W, steps = 3, 3, 3
    numbers = 4 * 9 + (a + 2 * n + 8) * (s + 1) ** 2 + 2**14 * (n + m + steps)
    numbers += (a + 2 * n + 8) * (t + d * y + m) + d**4 // 4 + sum(4 * p * (d + g) for p, _, g in layers) + 3 * H * t
    X = n**5 * 1 // 2**13 + 2**10 * n**3
    of_S = n**5 * (2 + 1 + 16) ** 2 // 2**13 + 2**10 * n**3
    F = sum(p * q * (2**9 + 8 * min(p, q)) for p, q, _ in layers)
    M, V, C, A = a + n**2 + 4 * n, 2 * a, n * s**2 + 160 * steps, (s + 4) ** 2
    B = 5 * (8 * A * M + A * (V + 4) * (32 * M + C) // 2**9 + 2**11 + 2**7 * n + n**3)
    R = 5 * sum(p * (q * (s + 2) + 5 * g + 64 * s + 7 * 2**9) for p, q, g in layers) // 8
    R += (1 + 5 * W // 2**14) * (sum(p * g * (q + 3 * 2**6) for p, q, g in layers) // 8)
    K = sum(p * (q * (d + g) + g * t) + 2**21 for p, q, g in layers) + 64 * H * t
    Z = a * (2**17 + 64 * t + 16 * d**2 * (m + y))
    inequality = 2**23 + 2**12 * 3**4 + 8 * d**5 + 4 * H * d**3 + 2**14 * 3**3
    inequality += 2**8 * y * n * (d + 1) ** 2
    work = 2**15 * a + F + X + of_S + 2**8 * 9 + B + R + K + 2 * Z + 2 * 2 * inequality + 2**14 * n**3
    assert counts(data, tmp_path) == (numbers, work)


def refusal(data: Document, folder: Path, patient: bool = False) -> tuple[str | None, str | None]:
    """The rules under which both refuse."""
    path = folder / "certificate.json"
    path.write_bytes(dump(data))
    try:
        rules.check(document.read(str(path)), patient=patient)
        own = None
    except Rejected as no:
        own = no.rule
    return own, reference_rules.judge(dump(data), *([reference_limits.MAX_IN_PATIENCE] if patient else [])).rule


@pytest.mark.parametrize("what", ["NUMBERS", "WORK"])
def test_the_last_that_is_allowed(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a certificate that is accepted, with each limit at its count, and one below."""
    data = loop(levels=(1.0, 1.0), leaves=3)
    allowed = counts(data, tmp_path)[what == "WORK"]
    for most, rule in ((allowed, None), (allowed - 1, "limits")):
        monkeypatch.setattr(limits, f"MOST_{what}", most)
        monkeypatch.setattr(reference_limits, {"NUMBERS": "MAX_NUMBERS", "WORK": "MAX_OPERATIONS"}[what], most)
        assert refusal(data, tmp_path) == (rule, rule)


def test_the_limits_as_they_are(tmp_path: Path) -> None:
    """Leaf after leaf up to the limit, and beyond it only with patience."""
    few, more = (counts(loop(leaves=count, hidden=(256,) * 3), tmp_path)[1] for count in (1, 64_001))
    for most, module in ((limits.MOST_WORK, limits), (reference_limits.MAX_OPERATIONS, reference_limits)):
        last = 1 + (most - few) * 64_000 // (more - few)
        for leaves, fits in ((int(0.999 * last), True), (int(1.001 * last) + 1, False)):
            data = loop(leaves=leaves, hidden=(256,) * 3)
            assert (counts(data, tmp_path)[1] <= most) is fits
            path = tmp_path / "certificate.json"
            c = document.read(str(path))
            if module is limits:
                assert (not list(limits.is_bearable(Case(c)))) is fits
                assert not list(limits.is_bearable(Case(c, patient=True)))
            elif fits:
                reference_limits.limits(reference_document.read(path.read_bytes()))
            else:
                with pytest.raises(Exception, match=r"rule=limits at=operations.*the reference allows .*--patient"):
                    reference_limits.limits(reference_document.read(path.read_bytes()))
                reference_limits.limits(reference_document.read(path.read_bytes()), reference_limits.MAX_IN_PATIENCE)


@pytest.mark.parametrize("program", PROGRAMS)
def test_patience_is_an_option(program: str, tmp_path: Path) -> None:
    path = tmp_path / "certificate.json"
    path.write_bytes(dump(loop(levels=(1.0, 1.0), leaves=3)))
    assert told(program, path, "--patient")[0] == 0
    path.write_bytes(dump(BOMBS["corners"][0]()))
    status, answer = told(program, path, "--patient")
    assert (status, answer["rule"]) == (1, "limits")


@pytest.mark.parametrize(("cells", "y"), [(1, 1), (5, 1), (1, 5), (2, 6), (1, 8)])
def test_a_slab_counts_the_cells_and_corners_of_what_is_uncertain(cells: int, y: int, tmp_path: Path) -> None:
    """By the page's line for a slab, in one state, less what its matrices take."""
    data = decay("67/100", "1", cells)
    names = ["q", *(f"q{k}" for k in range(1, y))]
    data["plant"]["uncertain"] = [{"name": name, "range": ["67/100", "1"]} for name in names]
    data["evidence"]["cells"] = [cells] + [1] * (y - 1)
    fewer = edited(data, "evidence.tube", data["evidence"]["tube"][:1])
    path = tmp_path / "written.json"
    path.write_bytes(dump(data))
    a, n, d, m = limits.Sizes(document.read(str(path))).a, 1, 1, 1
    t, bits = 2 + 1, (Fraction(3, 4).numerator.bit_length(), Fraction(17, 16).numerator.bit_length())
    K, Z = 1 + 2**21, a * (2**17 + 64 * t + 16 * (m + y))
    I, Y = 2**23 + 2**12 * 2**4 + 8 + 2**14 * 2**3, 2**14  # noqa: E741
    slab = K + cells * Z + 3 * cells * 2 ** min(y, 6) * (I + Y + 2**8 * y * n * (d + 1) ** 2)
    slab += sum(b**2 // 2**13 + 2**10 for b in bits)
    assert counts(data, tmp_path)[1] - counts(fewer, tmp_path)[1] == slab


if __name__ == "__main__":  # sizes of the bombs
    for name, (build, _) in BOMBS.items():
        sys.stdout.write(f"{name}: {len(dump(build())):,} bytes\n")
