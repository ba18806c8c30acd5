"""Certificates of sets that are never left, in both checkers: honest ones, forgeries, multipliers of both signs."""

from __future__ import annotations

import json
from fractions import Fraction

import numpy as np
import pytest

from certify.certificates import InvariantCertificate, OuterTree, parse_any
from certify.certificates.claims import Invariant, Outer
from certify.checker import invariant, words
from certify.checker.boxes import Boxes
from certify.loop.plants.system import System
from certify.lyapunov import Symbolic
from tests.support.certificates import LEAF, Document, dump, edited, parse, verdict
from tests.support.marks import slow_after
from tests.support.outer import packed, unpacked
from tests.support.reference import judge
from tests.support.staying import (
    ANNULUS,
    BASES,
    RADIUS,
    Q,
    U,
    X,
    Y,
    base,
    document,
    forgeries,
    plant,
    planted,
    policy,
    proof,
    ring,
)


@pytest.mark.parametrize("name", BASES)
def test_honest_certificates_are_accepted_by_both(name: str) -> None:
    data = base(name)
    assert verdict(data) == "ACCEPTED" and judge(data) is None


@pytest.mark.parametrize("name", BASES)
def test_a_certificate_is_read_and_written_as_it_is(name: str) -> None:
    data = base(name)
    again = json.loads(parse_any(dump(data), "file").to_json())
    assert again | {"provenance": {}} == data | {"provenance": {}}


def test_there_are_many_forgeries() -> None:
    made = forgeries()
    assert len(made) >= 200 and len({what for _, what, _ in made}) == len(made)
    assert {rule for rule, *_ in made} == {"format", "hash", "centring", "faces", "outer", "inputs", "keep"}


@pytest.mark.parametrize("name", BASES)
def test_each_forgery_is_refused_by_its_rule_in_both(name: str) -> None:
    own = [(rule, what, data) for rule, what, data in forgeries() if what.startswith(f"{name}: ")]
    assert own
    found = {what: (verdict(data), judge(data)) for _, what, data in own}
    assert found == {what: (rule, rule) for rule, what, _ in own}


def test_the_words_say_the_set_and_nothing_of_v() -> None:
    said = " ".join(words.claim(parse(base("an annulus"))))
    assert "starts in a state of the domain with N(x) <= 0.5 exists and is in such a state at all times" in said
    assert "at all times: ((1/20) + (-((x ** 2) + (y ** 2)))) < 0" in said and "V" not in said.replace("V-", "")


def _two_wells(tree: bytes) -> Document:
    """x' = x - x^3, N = x^2 up to 2: N rises inside of |x| < 1."""
    system, network = plant([X - X**3], ["2"]), policy([0.5])
    data = document(system, network, proof(system, network, X**2, 2.0))
    return edited(data, "evidence.outer.tree", packed(tree))


COARSE = bytes([0, 0, LEAF, LEAF, 0, LEAF, LEAF])
"""Leaves from -2 to -1, 0, 1 and 2, about."""


def test_n_may_rise_inside_and_multipliers_may_be_negative(monkeypatch: pytest.MonkeyPatch) -> None:
    data = _two_wells(COARSE)
    assert verdict(data) == "ACCEPTED" and judge(data) is None
    own = Boxes.least_bound
    monkeypatch.setattr(Boxes, "least_bound", lambda self, rise, gaps, least=0.0: own(self, rise, gaps))
    assert verdict(data) == "outer"


def test_a_leaf_below_the_level_needs_no_fall(monkeypatch: pytest.MonkeyPatch) -> None:
    data = _two_wells(COARSE)
    monkeypatch.setattr(invariant.Staying, "examine", _without_is_below(invariant.Staying.examine))
    assert verdict(data) == "outer"


def _without_is_below(examine):  # type: ignore[no-untyped-def]
    def changed(self, first, lo, hi):  # type: ignore[no-untyped-def]
        self.function.is_below = lambda x, level: np.zeros(x.value.shape[2], dtype=bool)
        return examine(self, first, lo, hi)

    return changed


def test_what_rises_at_the_level_is_refused_though_it_falls_below() -> None:
    """x' = x^3 - x: N falls inside, and rises from 1 on."""
    data = edited(_two_wells(COARSE), "plant.dynamics.0", ["-", ["**", "x", 3], "x"])
    assert verdict(data) == judge(data) == "outer"


@pytest.mark.parametrize("share", slow_after(1, ["1/1000000", "1/1000"]))
def test_evidence_of_another_loop_does_not_cover_what_is_planted(share: str) -> None:
    """Trees that the search makes for the sets without what is planted."""
    by = float(share.partition("/")[0]) / float(share.partition("/")[2])
    honest = ring()
    evidence = document(honest, policy([0.0, -1.0]), proof(honest, policy([0.0, -1.0]), ANNULUS, 0.5))["evidence"]
    refused = dict[str, tuple[str, str | None]]()
    for what, system, network, level in planted(by):
        if not what.startswith("domain"):
            data = document(system, network, _as_if(level, honest))
            data["evidence"] = evidence
            refused[what] = verdict(data), judge(data)
    # with another policy N need not be shown to fall either, on whatever leaf comes first
    rules = {"obstacle": {"keep"}, "leak": {"outer"}, "input": {"inputs", "outer"}}
    assert len(refused) == 36 and all(set(found) <= rules[what.split()[0]] for what, found in refused.items())


def _as_if(level: float, system):  # type: ignore[no-untyped-def]
    return proof(system, policy([0.0, -1.0]), ANNULUS, level)


@pytest.mark.slow
def test_both_say_the_same_of_levels_and_trees() -> None:
    """Of one loop at many levels with many trees; accepted are only levels at which N falls."""
    generator, accepted, system, network = np.random.default_rng(3), 0, ring(), policy([0.0, -1.0])
    for level in np.linspace(0.05, 0.9, 8):
        data = document(system, network, proof(system, network, ANNULUS, float(level)))
        for other, share in ((level, 0.0), (level, 0.01), (level * 1.01, 0.0), (level * 1.2, 0.01)):
            one = edited(data, "claim.outer.level", float(other).hex())
            tree = _pruned(unpacked(data["evidence"]["outer"]["tree"]), share, generator)
            one = edited(one, "evidence.outer.tree", packed(tree))
            mine = verdict(one)
            assert (mine == "ACCEPTED") is (judge(one) is None)
            accepted += mine == "ACCEPTED"
    assert 8 <= accepted < 32


def _pruned(tree: bytes, share: float, generator: np.random.Generator) -> bytes:
    """The tree without some of its last splits."""
    out, position = bytearray(), 0
    while position < len(tree):
        last = tree[position] != LEAF and tree[position + 1 : position + 3] == bytes([LEAF, LEAF])
        if last and generator.random() < share:
            out.append(LEAF)
            position += 3
        else:
            out.append(tree[position])
            position += 1
    return bytes(out)


def test_the_set_may_be_empty() -> None:
    """A claim of no trajectory is true, and the checkers say so; no command makes one."""
    data = edited(base("an interval"), "claim.outer.level", (-1.0).hex())
    assert verdict(data) == "ACCEPTED" and judge(data) is None


def test_a_rest_is_not_needed() -> None:
    """x' = 1 + u - x, N about 1: nothing is at rest at the origin."""
    system, network = plant([1 + U - X], ["3"], [X - 2, -X]), policy([0.0])
    data = document(system, network, proof(system, network, (X - 1) ** 2, 0.5))
    assert verdict(data) == "ACCEPTED" and judge(data) is None
    assert RADIUS == X**2 + Y**2


def _of_chance(generator: np.random.Generator) -> tuple[Document, bool]:
    """A loop, N, a level and a tree of chance, and if no sample of the domain refutes the claim."""
    a, b, c, d, e, q = (Fraction(round(float(v), 2)).limit_denominator(100) for v in generator.uniform(-1, 1, 6))
    f = (Y + a * X * (b - RADIUS) + e / 2, -X + c * Y * (1 + d - RADIUS) + U / 5)
    wide = {"q": (-abs(q) - Fraction(1, 50), abs(q) + Fraction(1, 50))}
    system = plant((f[0] + Q / 4, f[1]), ("2", "2"), [X - Fraction(17, 10)], ranges=wide)
    N = (RADIUS - (1 + d / 2)) ** 2 + e * X * Y / 3
    level, tree = float(generator.uniform(0.05, 1.5)), bytes([LEAF])
    for k in range(10):
        tree = bytes([k % 2]) + 2 * tree
    evidence = OuterTree(np.eye(2), np.full(2, 2.0), tree, (_line(1), _line(1), _line(0), _line(0)))
    claim = Invariant(Outer(Symbolic(N, (X, Y)), level), tuple(system.constraints.values()))
    data: Document = json.loads(InvariantCertificate(system, policy([0.0, -1.0]), claim, evidence).to_json())
    return data, _holds(system, Symbolic(N, (X, Y)), level)


def _line(axis: int) -> bytes:
    tree = bytes([LEAF])
    for _ in range(6):
        tree = bytes([axis]) + 2 * tree
    return tree


def _holds(system: System, N: Symbolic, level: float) -> bool:
    """At points of the curve N = n2, of the set and of the faces, all of them dense."""
    side = np.linspace(-2, 2, 801)
    x = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    value = N(x)
    on_faces = np.any(np.abs(x) == 2, axis=-1)
    near = x[np.abs(value - level) < 1e-3]
    u = np.tanh(-near[:, 1:])
    f = system.uncertain_function()
    falls = [(N.gradient(near) * f(near, u, [float(end)])).sum(-1).max(initial=-1.0) for end in system.ranges["q"]]
    kept = x[value <= level][:, 0].max(initial=-1.0) < 1.7
    return bool(value[on_faces].min() > level and max(falls) < 0.05 and kept)


@pytest.mark.slow
def test_accepted_claims_of_chance_are_true() -> None:
    """And of those that hold by a margin many are accepted, by both."""
    generator, accepted, true = np.random.default_rng(11), 0, 0
    for _ in range(120):
        data, holds = _of_chance(generator)
        true += holds
        if verdict(data) == "ACCEPTED":
            accepted += 1
            assert holds and judge(data) is None
    assert accepted >= 5 and true >= accepted
