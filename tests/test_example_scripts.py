"""The scripts of `examples/`: they run as they stand, prove what their pages say, and end with a file that both
checkers accept."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from certify import RoaResult, load_policy
from certify.certificates.checking import ask
from certify.certificates.verdict import Verdict
from certify.loop.closed_loop import ClosedLoop

EXAMPLES = Path(__file__).parent.parent / "examples"
SCRIPTS = sorted(EXAMPLES.glob("*.py"))


def script(name: str) -> ModuleType:
    """A script as a module of its own name, so that `pendulum` is not taken for anything else."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def ends_with_its_certificate(printed: str, folder: Path) -> Path:
    """The file that the last line names, which lies in the folder and which both checkers accept."""
    word, name = printed.splitlines()[-1].split(maxsplit=1)
    path = Path(name)
    assert word == "certificate" and path.is_relative_to(folder)
    assert [ask(path, program)[1]["result"] for program in ("checker", "reference")] == ["ACCEPTED"] * 2
    return path


def test_each_is_one_screen_and_named_in_the_page() -> None:
    page = (EXAMPLES / "README.md").read_text("utf-8")
    assert [path.stem for path in SCRIPTS] == [
        "candidates",
        "invariant_sets",
        "output_feedback",
        "own_policy",
        "pendulum",
        "swing_up",
        "van_der_pol",
    ]
    for path in SCRIPTS:
        text = path.read_text("utf-8")
        assert len(text.splitlines()) <= 60
        assert f"python examples/{path.name} [FOLDER]" in text and f"]({path.name})" in page


def test_the_papers_pendulum_with_its_printed_function(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """V <= 8.5065: up to the domain, whose edge 20 rad/s the printed V meets at 400 (p22 - p12^2 / p11)."""
    result: RoaResult = script("pendulum").main(tmp_path)
    assert result.verdict is Verdict.PROVED and result.claim == "asymptotic"
    p11, p12, p22 = 1.025121, 0.0379687 / 2, 0.0216179
    assert np.array_equal(np.asarray(result.P), [[p11, p12], [p12, p22]])
    edge = 400 * (p22 - p12**2 / p11)
    assert result.levels.roa is not None and 8.5065 <= result.levels.roa < edge < 8.50654
    assert result.reason == "domain" and result.levels.local is not None and result.levels.local > 0.85
    printed = capsys.readouterr().out
    assert "    V(x) = x'Px with P = 1.025121 0.01898435; 0.01898435 0.0216179" in printed.splitlines()
    ends_with_its_certificate(printed, tmp_path)


def test_a_policy_of_ones_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What is proved is the module that was trained, but for the shift that centring makes."""
    module = script("own_policy")
    result: RoaResult = module.main(tmp_path)
    assert result.verdict is Verdict.PROVED and result.claim == "asymptotic"
    assert result.volume is not None and result.volume > 150
    net = module.trained().double()
    weights = [layer.weight.detach().numpy() for layer in net if hasattr(layer, "weight")]
    assert all(np.array_equal(mine, its) for mine, its in zip(result.network.weights, weights, strict=True))
    assert result.network.centre == "preactivation" and result.network.scale.tolist() == [6.0]
    ends_with_its_certificate(capsys.readouterr().out, tmp_path)


@pytest.mark.slow
def test_candidates_are_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """For the bicycle the choice of V is worth a factor of 70 at least; the file named last is the best one's."""
    found = script("candidates").main(tmp_path)
    assert list(found) == ["lyapunov", "scaled", "lqr", "optimised"]
    assert all(result.verdict is Verdict.PROVED and result.candidate == name for name, result in found.items())
    volume = {name: result.volume for name, result in found.items()}
    assert volume["optimised"] > 5.19 and volume["optimised"] > 70 * volume["lyapunov"] > 0
    printed = capsys.readouterr().out
    assert [line.split()[0] for line in printed.splitlines()[1:5]] == sorted(found, key=lambda name: volume[name])
    assert ends_with_its_certificate(printed, tmp_path) == tmp_path / "optimised" / "certificate.json"


def test_van_der_pol_is_proved_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result: RoaResult = script("van_der_pol").main(tmp_path)
    assert result.verdict is Verdict.PROVED and result.system.name == "van_der_pol_reversed"
    assert result.volume is not None and result.volume > 7.37  # of examples/README.md
    assert (tmp_path / "set.png").read_bytes().startswith(b"\x89PNG") and (
        tmp_path / "report.html"
    ).stat().st_size > 10**4
    printed = capsys.readouterr().out
    assert (
        "x = [1.0, 1.0] is in the proved set: True" in printed
        and "x = [2.0, 2.0] is in the proved set: False" in printed
    )
    ends_with_its_certificate(printed, tmp_path)


def test_the_network_swings_up_from_a_box_from_which_no_gain_does() -> None:
    """Simulated: from all of the box the network settles, and its own gain, the LQR's and others from none."""
    module = script("swing_up")
    loop = ClosedLoop(module.PLANT, load_policy(EXAMPLES / "policies" / "gymnasium" / "swing_up.pt").network)
    x0 = np.random.default_rng(0).uniform(*np.array(module.BOX).T, (50, 2))
    assert module.settled(loop.policy, x0).all()
    laws = module.laws(loop.linearise()[2])
    assert list(laws) == ["its own gain", "the LQR"]
    for K in ([6.0, 2.0], [12.0, 3.0], [40.0, 10.0]):
        laws[f"{K}"] = lambda x, K=K: np.clip(-x @ np.array([K]).T, -2, 2)
    for law in laws.values():
        assert not module.settled(law, x0).any()
        assert module.settled(law, np.array([[0.02, 0.0], [2 * np.pi - 0.02, 0.0]])).all()  # upright it holds


@pytest.mark.slow
def test_the_swing_up_is_proved_on_its_box(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From 98.5 % of all angles and speeds, the box among them; minutes, most of them for the reference."""
    result: RoaResult = script("swing_up").main(tmp_path)
    assert result.verdict is Verdict.PROVED and result.ranks is not None and result.ranks.covered > 0.985
    assert result.nonlinearity is not None and result.nonlinearity.rms > 0.5
    printed = capsys.readouterr().out
    assert "the network settles from 441 of 441" in printed and "the LQR settles from 0 of 441" in printed
    assert "its own gain settles from 0 of 441" in printed and "the box is contained in the proved set" in printed
    ends_with_its_certificate(printed, tmp_path)


def test_as_a_command_it_takes_a_folder(tmp_path: Path) -> None:
    """From another folder, with warnings as errors; what is printed goes to standard output alone."""
    line = [sys.executable, "-W", "error", str(EXAMPLES / "pendulum.py"), "found"]
    done = subprocess.run(line, cwd=tmp_path, env=os.environ.copy(), capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[-1].split() == ["certificate", str(Path("found") / "certificate.json")]
    assert [path.name for path in tmp_path.iterdir()] == ["found"] and (
        tmp_path / "found" / "certificate.json"
    ).is_file()


@pytest.mark.slow
def test_output_feedback_with_an_observer_that_is_trained_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From rest the angle alone may be 2.1 rad, and the estimates as far off; both checkers take the file."""
    result: RoaResult = script("output_feedback").main(tmp_path)
    assert result.verdict is Verdict.PROVED and result.claim == "asymptotic"
    assert result.volume is not None and result.volume > 10_000
    assert result.contains([[2.1, 0, 0, 0], [0, 0, 2.1, 0]]).all()
    assert [s.name for s in result.system.inputs] == ["u", "observer_0"]
    assert ends_with_its_certificate(capsys.readouterr().out, tmp_path).exists()


@pytest.mark.slow
def test_sets_that_are_never_left(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A ring around the limit cycle, of at least 36 in area, and the car's set up to the obstacle, N = 0.1467."""
    cycle, course = script("invariant_sets").main(tmp_path)
    for result in (cycle, course):
        assert result.verdict is Verdict.PROVED and result.certificate.is_relative_to(tmp_path)
        assert ask(result.certificate, "checker")[1]["result"] == "ACCEPTED"
        assert ask(result.certificate, "reference")[1]["result"] == "ACCEPTED"
    assert cycle.outer.volume > 36 and 0.14 < course.outer.level < 0.1468
    ends_with_its_certificate(capsys.readouterr().out, tmp_path)
