"""`certify.certify_roa` and what a result says of itself: every kind of argument, and every mistake in one sentence."""

from __future__ import annotations

import dataclasses
import gc
import inspect
import json
import math
import os
import pydoc
import re
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import certify
from certify import ImportOptions, InputError, Policy, PolicyNetwork, RoaOptions, Verdict, certify_roa, get_system
from certify.analysis.api import _remove, in_python
from certify.analysis.results import RoaResult
from certify.certificates import parse_certificate
from certify.loop.expressions import Number, symbols
from certify.loop.policies import load_policy, save_policy
from certify.lyapunov import volume
from tests.support.foreign import mlp, plant
from tests.support.loops import pendulum_network, scalar_tanh

ROOT = Path(__file__).parent.parent.parent
SHIPPED = ROOT / "examples" / "policies" / "pendulum.pt"
BICYCLE = ROOT / "examples" / "plants" / "bicycle.toml"
QUICK = RoaOptions(candidate="lyapunov", level=0.05)
SAID = {"states": "x0,x1", "normaliser": "none", "action_scale": 1, "centre": "output"}


@pytest.fixture(scope="module")
def proved() -> RoaResult:
    return certify_roa("pendulum", SHIPPED, candidate="lyapunov")


@pytest.fixture(scope="module")
def away() -> RoaResult:
    """h' = 1 + (u - 1) - h/h0 around h0 = 1/10, a tenth that binary64 does not hold: {P d^2 <= c}."""
    h, u, h0 = symbols("h u h0")
    system = certify.System(
        name="away",
        states=(h,),
        inputs=(u,),
        parameters={"h0": Fraction(1, 10)},
        dynamics=(u - h,),
        u_eq=(Number(0),),
        domain=((Fraction(-1), Fraction(1)),),
        input_bounds=((Fraction(-1), Fraction(1)),),
        x_eq=(h0,),
    )
    network = PolicyNetwork.of_layers((np.zeros((1, 1)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    return certify_roa(system, network, P=[[1.0]], level=0.0625)


def test_strings_are_enough(tmp_path: Path) -> None:
    result = certify_roa("pendulum", str(SHIPPED), out=str(tmp_path / "o"), candidate="lyapunov", level=0.05)
    assert result.verdict is Verdict.PROVED and result.certificate == tmp_path / "o" / "certificate.json"
    assert result.notices == ()
    recorded = json.loads((result.raw or b"").decode())["provenance"]
    assert recorded["policy"] == "pendulum.pt" and recorded["python-flint"]


@pytest.mark.parametrize("named", ["text", "path"])
def test_a_plant_of_ones_own_by_its_file(named: str) -> None:
    policy = ROOT / "examples" / "policies" / "bicycle.pt"
    system = BICYCLE if named == "path" else str(BICYCLE)
    result = certify_roa(system, policy, None, RoaOptions(candidate="lyapunov", level=1e-3))
    assert result.verdict is Verdict.PROVED and result.system.name == "bicycle"


def test_a_plant_in_a_python_file_only_as_text(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("from certify import get_system\nplant = get_system('pendulum')\n")
    assert certify_roa(f"{file}:plant", pendulum_network((4,)), None, QUICK).verdict is Verdict.PROVED
    with pytest.raises(InputError, match=r"must end with \.toml"):
        certify_roa(file, pendulum_network((4,)))


def test_the_policy_names_its_plant_and_its_numbers(tmp_path: Path) -> None:
    policy = Policy(pendulum_network((8, 8)), "pendulum", {"m": "0.2"})
    save_policy(tmp_path / "p.pt", policy)
    for given in (policy, tmp_path / "p.pt"):
        for system in (None, "pendulum"):
            result = certify_roa(system, given, None, QUICK)
            assert result.system.parameters["m"] == Fraction(1, 5) and result.notices == ()
    result = certify_roa(get_system("pendulum"), policy, None, QUICK)
    assert result.system.parameters["m"] == Fraction(3, 20)
    assert "trained with m = 0.2" in result.notices[0] and "--" not in result.notices[0]


def test_a_tube_by_name(tmp_path: Path) -> None:
    result = certify_roa(*scalar_tanh(), tmp_path, level=0.25, enlarge=True, box={"x": 0.5})
    assert (result.verdict, result.claim) == (Verdict.PROVED, "enlarged") and result.tube is not None
    assert json.loads((result.raw or b"").decode())["claim"]["kind"] == "enlarged"


def test_a_state_by_name(tmp_path: Path) -> None:
    result = certify_roa(*scalar_tanh(), tmp_path, level=0.25, reach_from={"x": "1.3"}, box={"x": 0.1}, effort=0.2)
    x = Fraction(13, 10)
    assert (result.verdict, result.claim, result.reach_from) == (Verdict.PROVED, "reached", ((x, x),))
    assert result.contains([Fraction(13, 10)]) is True and result.contains([-1.3]) is False


FOR_PROGRAMS = {"network", "show", "tell", "keep"}  # what draws meanwhile, prints, or runs many


def test_what_the_core_takes_is_taken(tmp_path: Path) -> None:
    seen: list[str] = []
    result = certify_roa(
        *scalar_tanh(),
        tmp_path,
        RoaOptions(level=1.0),
        load_seconds=2.0,
        provenance={"mine": "yes"},
        progress=lambda stage, _: seen.append(stage),
    )
    assert result.verdict is Verdict.PROVED and result.seconds["load"] >= 2.0 and "check" in seen
    assert json.loads((result.raw or b"").decode())["provenance"] == {"mine": "yes"}
    core = inspect.signature(__import__("certify.analysis.run", fromlist=["certify_roa"]).certify_roa).parameters
    ours = list(inspect.signature(certify_roa).parameters)
    assert ours[:4] == ["system", "policy", "out", "options"]
    assert set(core) - FOR_PROGRAMS <= set(ours)


def test_a_notice_says_where_an_earlier_certificate_is(tmp_path: Path) -> None:
    certify_roa(*scalar_tanh(), tmp_path, level=0.5)
    refuted = certify_roa(*scalar_tanh(), tmp_path, level=3.9)
    assert refuted.verdict is Verdict.REFUTED and any("certificate.earlier.json" in n for n in refuted.notices)


def test_options_by_name_are_those_of_the_options() -> None:
    """Every field has a keyword; a typo is Python's own error; no keyword is forgotten on the way."""
    keywords = set(inspect.signature(certify_roa).parameters)
    assert {f.name for f in dataclasses.fields(RoaOptions)} <= keywords
    with pytest.raises(TypeError, match="time_limt"):
        certify_roa("pendulum", SHIPPED, time_limt=3)  # type: ignore[call-arg]
    bad = {
        "claim": "x",
        "around": "x",
        "candidate": "x",
        "engine": "x",
        "dreal_precision": 2.0,
        "jobs": 0,
        "level": -1.0,
    }
    bad |= {
        "effort": 0,
        "time_limit": 0,
        "max_boxes": 0,
        "rate": -1.0,
        "cluster": "nowhere",
        "resume": "yes",
        "enlarge": "yes",
        "ranks": "yes",
        "box": {"theta": -1.0},
        "reach_from": {"theta": float("nan")},
        "P": [[1.0, 2.0], [0.0, 1.0]],
        "Q": (1.0,),
        "R": (1.0, 2.0),
        "lyapunov": 3,
        "lyapunov_level": float("inf"),
        "hidden": (0,),
        "degree": 3,
        "seed": 0.5,
    }
    assert set(bad) == {f.name for f in dataclasses.fields(RoaOptions)}
    for name, value in bad.items():
        given: dict[str, Any] = {name: value}
        with pytest.raises(InputError, match=name):
            certify_roa("pendulum", SHIPPED, **given)
    for box in ([1.0, 2.0], {"theta": "1"}, {1: 1.0}):
        with pytest.raises(InputError, match="box"):
            certify_roa("pendulum", SHIPPED, box=box)  # type: ignore[arg-type]
    for at in (
        [1.0, 2.0],
        {"theta": None},
        {"theta": True},
        {"theta": "far"},
        {1: 1.0},
        {"phi": 1.0},
        {"theta": 99},
        {},
    ):
        with pytest.raises(InputError, match="reach_from"):
            certify_roa("pendulum", SHIPPED, reach_from=at)  # type: ignore[arg-type]


def test_options_at_once_or_by_name() -> None:
    with pytest.raises(InputError, match="not both; found `options` and level"):
        certify_roa("pendulum", SHIPPED, options=QUICK, level=1.0)
    with pytest.raises(InputError, match="found `options` and lyapunov"):
        certify_roa("pendulum", SHIPPED, options=QUICK, lyapunov="V.pt")
    one = certify_roa("pendulum", SHIPPED, options=QUICK)
    other = certify_roa("pendulum", SHIPPED, candidate="lyapunov", level=0.05)
    assert one.raw is not None and one.raw == other.raw


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"system": 3}, "`system` must be the name of a plant, .* found a int"),
        ({"system": "pendulun"}, "unknown system 'pendulun'"),
        ({"system": "p.toml"}, "p.toml"),
        ({"system": "mine.py"}, "must be followed by the name"),
        ({"system": "policy.pt"}, "looks like a policy file. The plant comes before the policy"),
        ({"system": b"pendulum"}, "found a bytes"),
        ({"system": None, "policy": pendulum_network((4,))}, "a PolicyNetwork does not say what it controls"),
        ({"system": None, "policy": mlp()}, "a module does not say what it controls"),
        ({"policy": 3}, "`policy` must be the path .* found a int"),
        ({"policy": None}, "`policy` must be the path .* found None"),
        ({"policy": "missing.pt"}, "missing.pt cannot be read"),
        ({"policy": torch.zeros(2)}, "found a Tensor"),
        ({"policy": {"a.0.weight": 3}}, r"\['a.0.weight'\] must be a tensor"),
        ({"policy": {3: torch.zeros(2, 2)}}, "the keys of the state_dict must be text; found 3, a int"),
        ({"policy": {"0.weight": torch.zeros(2, 2, device="meta")}}, "cannot be read as a tensor"),
        ({"policy": {"0.weight": np.zeros((2, 2), np.longdouble)}}, "cannot be read as a tensor"),
        ({"policy": {"0.weight": np.zeros((2, 2), bool)}}, "an array of floats"),
        ({"load_seconds": "1"}, "`load_seconds` must be a number"),
        ({"provenance": "mine"}, "`provenance` must be a mapping; found a str"),
        ({"progress": True}, "`progress` must be callable; found a bool"),
        ({"out": 3}, "`out` must be a path"),
        ({"out": ""}, "`out` must be a path in text that is not empty"),
        ({"options": {"level": 1}}, "`options` must be a RoaOptions; found a dict"),
        ({"level": "1"}, "`level` must be a number; found '1', a str"),
        ({"level": True}, "`level` must be a number"),
        ({"time_limit": "fast"}, "`time_limit` must be a number"),
        ({"jobs": 1.5}, "`jobs` must be a whole number"),
        ({"candidate": 4}, "`candidate` must be text"),
        ({"Q": 3}, "`Q` must be a sequence; found a int"),
        ({"Q": ["a", "b"]}, "`Q` must be a number"),
        ({"P": "identity"}, "`P` must be a matrix"),
        ({"P": [1.0, 2.0]}, r"`P` must be a matrix of numbers, \(n, n\); found shape"),
        ({"importing": 3}, "`importing` must be an ImportOptions or a mapping"),
        ({"importing": {"stats": "x"}}, "`importing` has no 'stats'.*states"),
        ({"importing": {"squash": "tanh"}}, "must be left out"),
        ({"importing": {"squash": 3}}, r"`importing\['squash'\]` must be text"),
        ({"importing": {"clip": 3}}, r"`importing\['clip'\]` must be a sequence"),
        ({"importing": {"clip": (1, 2, 3)}}, "must be a pair"),
        ({"importing": {"action_scale": "six"}}, "must be a finite number"),
        ({"importing": {"states": 3}}, "must be a sequence"),
    ],
)  # fmt: skip
def test_mistakes_are_named(arguments: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said) as caught:
        certify_roa(**{"system": "pendulum", "policy": SHIPPED, **arguments})
    assert "--" not in str(caught.value)


def test_messages_speak_of_python() -> None:
    assert in_python("Name its file, as in --system plant.toml.") == "Name its file, as in `system` plant.toml."
    assert in_python("nothing - or -- of that") == "nothing - or -- of that"
    assert in_python("--from must be one") == "`kind` must be one Say `kind` in `importing`, a mapping."


class Scaled(torch.nn.Module):
    """A module whose scaling is in its code and nowhere in its state_dict."""

    def __init__(self, net: torch.nn.Module, by: float) -> None:
        super().__init__()
        self.net, self.by = net, by

    def forward(self, x: torch.Tensor) -> Any:
        return self.by * torch.tanh(self.net(x))


def small(seed: int = 0) -> torch.nn.Sequential:
    net = mlp((2, 5, 1), seed=seed)
    with torch.no_grad():
        for p in net.parameters():
            p.mul_(0.1)
    return net


def test_a_module_is_read_by_what_it_computes() -> None:
    """Its code decides: the scale that no state_dict holds is in the network, and training mode stays as it was."""
    module = Scaled(small(), 3.0).train()
    result = certify_roa(plant(), module, importing=SAID, candidate="lyapunov", level=1e-4)
    assert result.verdict is Verdict.PROVED and module.training and all(p.requires_grad for p in module.parameters())
    assert result.network.scale.tolist() == [3.0] and result.network.squash == "tanh"
    x = np.random.default_rng(1).uniform(-1, 1, (50, 2))
    with torch.no_grad():
        wanted = module.double()(torch.tensor(x)).numpy()
    raw = dataclasses.replace(result.network, centre="none")
    assert np.max(np.abs(raw(x, [Fraction(0)]) - wanted)) < 1e-7 * np.max(np.abs(wanted))
    assert any("largest difference" in line for line in result.notices)


def test_a_module_and_its_state_dict_are_one_policy() -> None:
    module = small()
    of_module = certify_roa(plant(), module, None, QUICK, importing=SAID)
    said = SAID | {"activation": "tanh", "squash": "identity"}
    for given in (module.state_dict(), {k: v.numpy() for k, v in module.state_dict().items()}):
        of_tensors = certify_roa(plant(), given, None, QUICK, importing=said)
        assert of_tensors.network.sha256() == of_module.network.sha256()
    objects = ImportOptions(
        states=("x0", "x1"), normaliser="none", action_scale=(Fraction(1),), centre="output", clip=None
    )
    assert certify_roa(plant(), module, None, QUICK, importing=objects).network.sha256() == of_module.network.sha256()


def test_numbers_of_importing_are_exact() -> None:
    said = SAID | {"action_scale": "0.1", "clip": (-1, [1])}
    result = certify_roa(plant(), small(), importing=said, candidate="lyapunov", level=1e-4)
    inside = math.nextafter(0.1, 0)  # 0.1 is above 1/10
    assert result.network.scale.tolist() == [0.1] and np.max(np.abs(result.network.clip or 0)) == inside


class Branching(Scaled):
    def forward(self, x: torch.Tensor) -> Any:
        return self.net(x) if x.sum() > 0 else 2 * self.net(x)


class Sneaky(Scaled):
    """It computes something else from the second time on, of which its trace knows nothing."""

    calls = 0

    def forward(self, x: torch.Tensor) -> Any:
        self.calls += 1
        return self.net(x) if self.calls == 1 else 1.01 * self.net(x)


class Pair(Scaled):
    def forward(self, x: torch.Tensor) -> Any:
        return self.net(x), x


class Uncopied(Scaled):
    def __deepcopy__(self, memo: Any) -> Any:
        raise RuntimeError("no copies")


@pytest.mark.parametrize(
    ("module", "said"),
    [
        (Branching(small(), 1.0), "it branches, or hides a number from torch"),
        (Sneaky(small(), 1.0), "must agree with the framework's own evaluation"),
        (Pair(small(), 1.0), "the module Pair"),
        (Uncopied(small(), 1.0), "no copies"),
        (
            torch.nn.Sequential(torch.nn.Linear(2, 3), torch.nn.Softshrink(), torch.nn.Linear(3, 1)),
            "the module Sequential",
        ),
        (torch.nn.Linear(3, 1), "cannot be copied and traced"),
        (torch.nn.LSTM(2, 1), "the module LSTM"),
        (torch.nn.Sequential(torch.nn.Linear(2, 4), torch.nn.Softmax(1), torch.nn.Linear(4, 1)), "Sequential"),
    ],
    ids=["branch", "later", "pair", "copy", "softshrink", "states", "lstm", "softmax"],
)
def test_modules_that_are_no_chain_of_layers_are_refused(module: torch.nn.Module, said: str) -> None:
    with pytest.raises(InputError, match=said):
        certify_roa(plant(), module, importing=SAID)


def test_a_state_dict_is_asked_for_what_it_does_not_say() -> None:
    with pytest.raises(InputError) as caught:
        certify_roa(plant(), small().state_dict(), importing={"states": ["x0", "x1"]})
    assert all(f"`{name}`" in str(caught.value) for name in ("activation", "squash", "normaliser"))
    assert "`states`" not in str(caught.value) and "in `importing`" in str(caught.value)


def test_the_domain_is_cut_to_where_a_policy_is_valid() -> None:
    valid = np.array([[-0.5, 0.25], [-np.inf, np.inf]])
    policy = Policy(pendulum_network((8, 8)), "pendulum", valid=valid)
    result = certify_roa("pendulum", policy, candidate="lyapunov")
    assert result.system.domain[0] == (Fraction(-1, 2), Fraction(1, 4)) and "is cut to" in result.notices[0]
    assert parse_certificate(result.raw or b"", "c").system.domain[0] == (Fraction(-1, 2), Fraction(1, 4))
    assert not result.contains([0.26, 0.0])
    with pytest.raises(InputError, match="valid for 2 states"):
        certify_roa(scalar_tanh()[0], policy)


def test_a_policy_that_rests_beside_the_origin_gets_the_other_claim_and_says_so(tmp_path: Path) -> None:
    uncentred = Policy(dataclasses.replace(small_pendulum(), centre="none"), "pendulum")
    result = certify_roa("pendulum", uncentred, level=0.05)
    assert result.claim == "nearby" and " nearby; " in repr(result) and "nearby" in result._repr_html_()
    save_policy(tmp_path / "p.pt", uncentred)
    for given in (uncentred, tmp_path / "p.pt"):
        mended = certify_roa("pendulum", given, None, QUICK, importing={"centre": "preactivation"})
        assert mended.verdict is Verdict.PROVED and mended.claim == "asymptotic" and "changes u by" in mended.notices[0]
        assert "--" not in mended.notices[0] and " practical" not in repr(mended)
    with pytest.raises(InputError, match="`squash` must be left out"):
        certify_roa("pendulum", uncentred, importing={"squash": "tanh", "centre": "output"})
    with pytest.raises(InputError, match="the file's centring is preactivation"):
        certify_roa("pendulum", Policy(small_pendulum(), "pendulum"), importing={"centre": "output"})


def small_pendulum() -> PolicyNetwork:
    network = pendulum_network((4,))
    return network.with_layers(biases=tuple(b + 1e-3 for b in network.biases))


def test_a_beta_of_another_plant_is_refused() -> None:
    with pytest.raises(InputError, match="`beta` must be"):
        certify_roa("pendulum", Policy(pendulum_network((8, 8)), "pendulum", beta=np.array([0.3])))


def test_without_out_the_certificate_lives_as_long_as_the_result() -> None:
    result = certify_roa("pendulum", SHIPPED, None, QUICK)
    path = result.certificate
    assert path is not None and path.read_bytes() == result.raw
    again = dataclasses.replace(result, detail="copied")
    del result
    gc.collect()
    assert path.exists()
    del again
    gc.collect()
    assert not path.exists() and not path.parent.exists()


def test_a_fork_does_not_take_the_folder_away(tmp_path: Path) -> None:
    folder = tmp_path / "of a result"
    folder.mkdir()
    _remove(folder, os.getpid() + 1)  # as in a child, which ends with copies of all results
    assert folder.exists()
    _remove(folder, os.getpid())
    assert not folder.exists()


def test_contains_is_decided_in_rationals(away: RoaResult) -> None:
    """{(h - 1/10)^2 <= 1/16}: the end 0.35 is in the set, its binary64 neighbour above 7/20 is not."""
    assert away.verdict is Verdict.PROVED and away.system.exact_x_eq() == (Fraction(1, 10),)
    assert away.contains([Fraction(7, 20)]) is True and away.contains([Fraction(-3, 20)]) is True
    assert away.contains([Fraction(7, 20) + Fraction(1, 10**40)]) is False
    assert Fraction(0.35) < Fraction(7, 20) and away.contains([0.35]) is True
    assert away.contains([np.nextafter(0.35, 1)]) is False
    assert away.contains([0.25], deviations=True) is True
    assert away.contains([np.nextafter(0.25, 1)], deviations=True) is False
    assert away.contains([-0.2]) is False and away.contains([-0.2], deviations=True) is True
    assert away.contains([0]) is True and away.contains(np.float32([0.1])) is True
    assert away.contains([2**60 + 1]) is False


def test_contains_speaks_of_the_certificate(proved: RoaResult) -> None:
    certificate = parse_certificate(proved.raw or b"", "c")
    assert np.array_equal(certificate.P, proved.P) and certificate.roa == proved.levels.roa
    x = np.random.default_rng(0).uniform(-1, 1, (300, 2)) * [3.5, 22]
    P, level = [[Fraction(v) for v in row] for row in certificate.P.tolist()], Fraction(certificate.roa)
    wanted = []
    for row in x.tolist():
        a, b = map(Fraction, row)
        wanted.append(a * a * P[0][0] + 2 * a * b * P[0][1] + b * b * P[1][1] <= level)
    found = proved.contains(x)
    assert isinstance(found, np.ndarray) and found.dtype == bool and found.tolist() == wanted
    assert 0 < sum(wanted) < 300
    assert proved.contains(torch.tensor(x[:3])).tolist() == wanted[:3]  # type: ignore[union-attr]
    assert proved.contains(np.zeros((0, 2))).tolist() == []  # type: ignore[union-attr]


@pytest.mark.parametrize(
    "x",
    [
        0.0, [0.0], [0.0, 0.0, 0.0], [[[0.0, 0.0]]], [[0.0, 0.0], [0.0]], [np.nan, 0.0], [0.0, np.inf], ["0", "0"],
        [None, 0.0], [True, False], [1j, 0.0], {"theta": 0.0}, torch.zeros(2, requires_grad=True),
    ],
    ids=str,
)  # fmt: skip
def test_contains_refuses_what_is_no_state(proved: RoaResult, x: Any) -> None:
    with pytest.raises(InputError, match="`x` must"):
        proved.contains(x)


def test_nothing_contains_a_state_without_a_proof(proved: RoaResult) -> None:
    refuted = certify_roa("pendulum", SHIPPED, level=1e6)
    unknown = certify_roa("pendulum", pendulum_network((8, 8)), candidate="lyapunov", level=0.15, max_boxes=3)
    trusted = dataclasses.replace(proved, verdict=Verdict.TRUSTED)
    for result in (refuted, unknown, trusted):
        with pytest.raises(InputError, match=f"there must be a proved set.*{result.verdict.value}"):
            result.contains([0.0, 0.0])
    for result in (refuted, unknown):
        assert result.verdict in (Verdict.REFUTED, Verdict.UNKNOWN) and result.volume is None
        for ask in (result.report, result.plot):
            with pytest.raises(InputError, match="there must be a certificate"):
                ask()
        assert result.verdict.value in repr(result) and result.verdict.value in result._repr_html_()
        assert " <= " not in repr(result).split("reason")[0]


def test_the_volume_is_the_certain_one(proved: RoaResult) -> None:
    P, level = proved.P, proved.levels.roa
    assert P is not None and level is not None
    assert proved.volume == volume(P, level) == proved.to_dict()["volume"]
    shown = re.search(r"area ([0-9.]+) rad", repr(proved))
    assert shown is not None and 0 <= proved.volume - float(shown[1]) < 1e-3  # type: ignore[operator]


def test_a_result_shows_itself_in_a_line_and_a_table(proved: RoaResult, away: RoaResult) -> None:
    assert len(repr(proved)) < 120 and "\n" not in repr(proved)
    assert repr(proved).startswith("RoaResult(PROVED; pendulum; V <= ")
    assert repr(away) == "RoaResult(PROVED; away; V <= 0.0625; length 0.499999; limited by requested)"
    odd = dataclasses.replace(away, notices=("<script>alert(1)</script> & more",))
    html = odd._repr_html_()
    assert "<script>" not in html and "&lt;script&gt;alert(1)&lt;/script&gt; &amp; more" in html
    assert html.count("<tr>") == html.count("</tr>") == 9


def test_report_draws_what_was_checked(proved: RoaResult, tmp_path: Path) -> None:
    beside = proved.report()
    assert proved.certificate is not None and beside == proved.certificate.with_name("report.html")
    page = beside.read_text()
    assert page.startswith("<!DOCTYPE html>") and str((proved.checker or {})["certificate_sha256"]) in page
    assert proved.report(tmp_path / "mine.html").read_text() == page
    with pytest.raises(InputError, match="cannot be written"):
        proved.report(tmp_path / "missing" / "mine.html")
    forged = dataclasses.replace(proved, raw=(proved.raw or b"") + b" ")
    with pytest.raises(certify.CertifyError, match="the answer has"):
        forged.report()


def test_plot_draws_the_certified_set(proved: RoaResult, away: RoaResult, tmp_path: Path) -> None:
    from certify.lyapunov import extents

    figure = proved.plot()
    (axes,) = figure.axes
    P, level = proved.P, proved.levels.roa
    assert P is not None and level is not None
    line = next(one for one in axes.lines if len(one.get_xdata()) > 100)
    x = np.stack([line.get_xdata(), line.get_ydata()], -1)
    assert np.allclose(np.einsum("ki,ij,kj->k", x, P, x), level)
    assert np.all(np.max(np.abs(x), axis=0) <= extents(P, level) * (1 + 1e-9))
    figure.savefig(tmp_path / "set.png")
    assert (tmp_path / "set.png").read_bytes().startswith(b"\x89PNG")
    (texts,) = figure.legends
    assert any("proved set" in t.get_text() for t in texts.get_texts())
    (on_a_line,) = away.plot().axes
    assert on_a_line.get_xlabel() == "h − 0.1"


def test_a_set_of_four_states_is_drawn_in_planes() -> None:
    result = certify_roa("cartpole", ROOT / "examples/policies/cartpole.pt", candidate="lqr", level=1e-3)
    figure = result.plot()
    assert len(figure.axes) >= 2 and {a.get_xlabel()[:1] for a in figure.axes} >= {"p", "θ"}
    assert any("projection" in t.get_text() for t in figure.legends[0].get_texts())


def test_help_says_what_one_needs() -> None:
    text = pydoc.plain(pydoc.render_doc(certify_roa))
    for word in (
        "pendulum",
        "TOML",
        "state_dict",
        "temporary folder",
        "importing",
        "time_limit",
        "InputError",
        "PROVED",
    ):
        assert word in text
    methods = pydoc.plain(pydoc.render_doc(RoaResult))
    assert "decided in" in methods and "rationals" in methods and "deviations" in methods


def test_public_names_are_there_and_listed() -> None:
    assert set(certify.__all__) - {"__version__"} == set(certify._PUBLIC)
    for name in certify.__all__:
        assert name in dir(certify) and getattr(certify, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'certify_ro'"):
        certify.certify_ro  # noqa: B018


def test_loading_a_policy_by_hand_changes_nothing() -> None:
    by_hand = certify_roa(None, load_policy(SHIPPED), None, QUICK, provenance={})
    assert by_hand.raw == certify_roa(None, SHIPPED, None, QUICK, provenance={}).raw


def test_what_the_readme_and_the_reference_show_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    pages = (ROOT / "README.md", ROOT / "docs" / "reference" / "python.md")
    first, second = (code for page in pages for code in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL))
    exec(first, {})
    shown = capsys.readouterr().out.splitlines()
    assert shown[0].startswith("RoaResult(PROVED; pendulum; V <= ") and shown[0].startswith(first.split("# ")[1][:30])
    assert shown[1] == "True"
    torch.manual_seed(0)
    exec(second, {})
    assert (tmp_path / "heavy.html").exists() and (tmp_path / "out" / "heavy" / "certificate.json").exists()
    assert capsys.readouterr().out.startswith("RoaResult(")
