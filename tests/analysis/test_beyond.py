"""`certify roa --lyapunov`: a set of another function beyond the ellipsoid, from the options to the accepted file.

The plant is x' = -x + x^3 under no input, whose region of attraction is |x| < 1 by inspection.
"""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify import Neural, PolicyNetwork, Polynomial, System, certify_roa, save_lyapunov
from certify.analysis.acceptance import Clerk
from certify.analysis.results import RoaResult
from certify.certificates import Certificate, PartitionTree
from certify.certificates.verdict import Stop, Verdict
from certify.errors import InputError
from certify.loop.expressions import Expression, Number, Symbol, cos
from certify.lyapunov import Symbolic
from certify.provers.outer import Rise

x, u = Symbol("x"), Symbol("u")
SQUARE = Polynomial(np.array([[2]]), np.array([1.0]))
REST = PolicyNetwork.of_layers((np.zeros((1, 1)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
HALF = 0.125  # of V = x^2/2: the ellipsoid is |x| <= 1/2


def plant(rates: Expression = -x + x**3 + u) -> System:
    return System(
        name="cubic",
        states=(x,),
        inputs=(u,),
        parameters={},
        dynamics=(rates,),
        u_eq=(Number(0),),
        domain=((Fraction(-2), Fraction(3)),),
        input_bounds=((Fraction(-1), Fraction(1)),),
    )


def proved(tmp_path: Path, **options: object) -> RoaResult:
    given: dict[str, object] = {"level": HALF, "P": [[0.5]], "lyapunov": SQUARE, "effort": 0.4} | options
    return certify_roa(plant(), REST, tmp_path, **given)  # type: ignore[arg-type]


def test_the_largest_level_ends_where_the_function_rises(tmp_path: Path) -> None:
    result = proved(tmp_path)
    assert result.verdict is Verdict.PROVED and result.outer is not None
    assert 0.99 < result.outer.level < 1 and result.outer.limit == "witness"
    assert result.outer.witness is not None and 0.99 < abs(result.outer.witness[0]) < 1.01
    assert abs(result.outer.volume - 2) < 5 * result.outer.deviation + 0.01
    data = json.loads((tmp_path / "certificate.json").read_text())
    stated = data["claim"]["outer"]
    assert stated["expression"] == ["**", "x", 2] and [one["name"] for one in data["networks"]] == ["policy"]
    assert float.fromhex(stated["level"]) == result.outer.level
    assert result.checker is not None and result.checker["outer"]["level"] == result.outer.level


def test_the_set_is_that_of_the_certificate(tmp_path: Path) -> None:
    result = proved(tmp_path)
    assert result.contains([[0.4], [0.9], [-0.9], [1.1], [2.9]]).tolist() == [True, True, True, False, False]


def test_a_network_and_a_formula_of_the_same_shape(tmp_path: Path) -> None:
    """tanh(x - 1) - tanh(x + 1) rises with |x|, as 1 - cos(x) does up to pi."""
    network = Neural((np.ones((2, 1)), np.array([[1.0, -1.0]])), (np.array([-1.0, 1.0]), np.zeros(1)))
    for N, at_1 in ((network, -np.tanh(2.0)), (Symbolic(1 - cos(x), (x,)), 1 - np.cos(1.0))):
        result = proved(tmp_path, lyapunov=N)
        assert result.outer is not None and abs(result.outer.level - at_1) < 0.01
        assert result.outer.level < at_1


def test_a_level_that_is_asked_for(tmp_path: Path) -> None:
    less = proved(tmp_path, lyapunov_level=0.81)
    assert less.verdict is Verdict.PROVED and less.outer is not None
    assert (less.outer.level, less.outer.limit) == (0.81, "requested")
    more = proved(tmp_path, lyapunov_level=1.21)
    assert (more.verdict, more.stop) == (Verdict.UNKNOWN, Stop.BEYOND)
    assert more.outer is not None and "not 1.21" in more.detail and "shown in Arb" in more.detail
    assert more.checker is not None and more.checker["result"] == "ACCEPTED"  # of the lower level


def test_a_function_that_falls_nowhere_leaves_the_ellipsoid(tmp_path: Path) -> None:
    result = proved(tmp_path, lyapunov=Polynomial(np.array([[2]]), np.array([-1.0])))
    assert result.verdict is Verdict.PROVED and result.outer is None
    assert result.notice is not None and "no set of the function" in result.notice


def test_what_the_checker_refuses_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A claim beyond the ellipsoid that is false, as if the engine had been wrong."""
    ask = Clerk.ask

    def wrong(clerk: Clerk, certificate: Certificate, **_: object) -> object:
        outer = certificate.claim.outer
        if outer is not None:
            claim = replace(certificate.claim, outer=replace(outer, level=1.1))
            certificate = replace(certificate, claim=claim)
        return ask(clerk, certificate)

    monkeypatch.setattr(Clerk, "ask", wrong)
    result = proved(tmp_path)
    assert result.verdict is Verdict.PROVED and result.outer is None
    assert result.notice is not None and "left out" in result.notice


def test_a_leaf_that_is_refused_is_split_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first file that is asked about has too coarse a tree; the next one has a leaf cut into eight."""
    ask, asked = Clerk.ask, []

    def coarse(clerk: Clerk, certificate: Certificate, **_: object) -> object:
        evidence = certificate.evidence
        assert isinstance(evidence, PartitionTree)
        if evidence.outer is not None and not asked:
            outer = replace(evidence.outer, tree=bytes([255]))
            certificate = replace(certificate, evidence=replace(evidence, outer=outer))
        data, answer = ask(clerk, certificate)
        asked.append(answer)
        return data, answer

    monkeypatch.setattr(Clerk, "ask", coarse)
    result = proved(tmp_path, lyapunov_level=0.3)
    assert asked[0]["at"] == "outer leaf 0" and asked[-1]["result"] == "ACCEPTED"
    assert result.verdict is Verdict.PROVED and result.outer is not None and result.outer.level == 0.3


def test_a_file_of_another_plant_is_said(tmp_path: Path) -> None:
    path = tmp_path / "V.pt"
    save_lyapunov(path, SQUARE, "other")
    result = proved(tmp_path, lyapunov=path)
    assert result.outer is not None and any("of other" in text for text in result.notices)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"lyapunov": Polynomial(np.array([[1, 1]]), np.ones(1))}, "1 states"),
        ({"lyapunov": None, "lyapunov_level": 1.0}, "give one"),
        ({"lyapunov_level": float("nan")}, "finite"),
        ({"sample_time": "1/100"}, "steps"),
        ({"rate": 0.1}, "without a rate"),
        ({"enlarge": True}, "without a tube"),
        ({"engine": "dreal"}, "engine bounds"),
        ({"lyapunov": "no file"}, "cannot be read"),
    ],
)
def test_what_cannot_be_asked_for(options: dict[str, object], said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said):
        proved(tmp_path, **options)


def test_a_witness_in_words() -> None:
    assert Rise(np.array([1.0]), 1.0, "rise").describe(plant()) == "N does not fall at x = 1 with N = 1"


def test_a_later_notice_takes_none_away(tmp_path: Path) -> None:
    """The loop rests beside the origin, and N falls nowhere: both are said."""
    pushed = plant(-x + x**3 + u + Fraction(1, 1000))
    falls = Polynomial(np.array([[2]]), np.array([-1.0]))
    result = certify_roa(pushed, REST, tmp_path, P=[[0.5]], lyapunov=falls, effort=0.4)
    assert result.verdict is Verdict.PROVED and result.notice is not None
    said = result.notice.split("; ")
    assert [text.split(",")[0] for text in said[:1]] == ["practical stability is claimed"]
    assert any(text.startswith("no set of the function `lyapunov` is proved") for text in said[1:])
