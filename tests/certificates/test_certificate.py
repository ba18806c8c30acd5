"""Certificates as the producer writes them: canonical, readable, and worthless once tampered with."""

from __future__ import annotations

import base64
import copy
import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import limits, read_certificate, run_checker
from certify.checker import document as checker_document
from certify.checker import exact as checker_exact
from certify.checker import expression as checker_expression
from certify.checker import networks as checker_networks
from certify.errors import CertificateFormatError
from certify.loop.expressions import Number, from_tree, symbols, tan, to_tree
from certify.loop.plants import available_systems, get_system
from tests.support.loops import pendulum_network, scalar_tanh

Document = dict[str, Any]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pendulum whose input may leave its bounds (centred at the output), so that every rule has work to do."""
    folder = tmp_path_factory.mktemp("certificate")
    result = certify_roa(
        get_system("pendulum"), pendulum_network(centre="output"), folder, RoaOptions(candidate="lyapunov")
    )
    assert result.certificate is not None and result.checker is not None
    return result.certificate


@pytest.fixture
def document(written: Path) -> Document:
    return dict(json.loads(written.read_text()))


def answer(tmp_path: Path, data: Document) -> Document:
    path = tmp_path / "certificate.json"
    path.write_text(json.dumps(data))
    return run_checker(path)


def floats(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype="<f8").copy()


def encode(array: np.ndarray) -> str:
    return base64.b64encode(array.astype("<f8").tobytes()).decode()


def scaled(*path: str | int, by: float) -> Callable[[Document], None]:
    def change(data: Document) -> None:
        inner: Any = data
        for key in path[:-1]:
            inner = inner[key]
        value = inner[path[-1]]
        inner[path[-1]] = (by * float.fromhex(value)).hex() if path[0] == "levels" else encode(by * floats(value))

    return change


def replaced(*path: str | int, to: Any) -> Callable[[Document], None]:
    def change(data: Document) -> None:
        inner: Any = data
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = to(inner[path[-1]]) if callable(to) else to

    return change


def tree(edit: Callable[[bytes], bytes]) -> Callable[[Document], None]:
    return replaced("evidence", "tree", to=lambda t: base64.b64encode(edit(base64.b64decode(t))).decode())


def asymmetric(data: Document) -> None:
    P = floats(data["lyapunov"]["P"])
    P[1] = np.nextafter(P[1], 1.0)
    data["lyapunov"]["P"] = encode(P)


def level_and_box(data: Document) -> None:
    scaled("levels", "roa", by=1.5)(data)
    scaled("evidence", "root", by=1.3)(data)


def constant(old: str, new: str) -> Callable[[Document], None]:
    return replaced("plant", "dynamics", to=lambda t: json.loads(json.dumps(t).replace(old, new)))


def singular(data: Document) -> None:
    data["evidence"]["T"] = encode(np.zeros(4))


TAMPERED: dict[str, tuple[Callable[[Document], None], str]] = {
    "level of the ring up": (scaled("levels", "roa", by=1.5), "root"),
    "level of the ring far up": (scaled("levels", "roa", by=100.0), "domain"),
    "level and box up": (level_and_box, "ring|inputs"),
    "local level up": (scaled("levels", "local", by=1.2), "local"),
    "local level down": (scaled("levels", "local", by=1e-6), "ring"),
    "local level negative": (scaled("levels", "local", by=-1.0), "levels"),
    "levels exchanged": (scaled("levels", "local", by=1e12), "levels"),
    "P asymmetric by one bit": (asymmetric, "lyapunov"),
    "P negative": (scaled("lyapunov", "P", by=-1.0), "lyapunov"),
    "T singular": (singular, "coordinates"),
    "root box smaller": (scaled("evidence", "root", by=0.99), "root"),
    "tree truncated": (tree(lambda t: t[:-1]), "tree"),
    "tree extended": (tree(lambda t: t + b"\xff"), "tree"),
    "tree of one leaf": (tree(lambda t: b"\xff"), "ring|inputs"),
    "tree splits an axis that is not there": (tree(lambda t: bytes([7]) + t[1:]), "tree"),
    "tree empty": (tree(lambda t: b""), "tree"),
    "tree over-deep": (tree(lambda t: bytes([0]) * 10_000), "tree"),
    "domain smaller": (replaced("plant", "domain", to=[["-1/2", "1/2"], ["-20", "20"]]), "domain"),
    "domain without the origin": (replaced("plant", "domain", to=[["1/2", "3"], ["-20", "20"]]), "domain"),
    "input bounds tighter": (replaced("plant", "input_bounds", to=[["-1", "1"]]), "inputs"),
    "equilibrium input": (replaced("plant", "u_eq", to=["1/1000000"]), "equilibrium"),
    "gravity": (constant("981/100", "981/10"), "local|ring"),
    "damping with the wrong sign": (constant('["-", ["*", ["/", "1/10",', '["-", ["*", ["/", "-1",'), "local|ring"),
    "weights": (scaled("networks", 0, "steps", 4, "weight", by=-1.0), "hash"),
    "scale": (scaled("policy", "scale", by=1.25), "hash"),
    "centring": (replaced("policy", "centre", to="none"), "hash"),
    "schema": (replaced("schema", to="certify-certificate/2"), "format"),
    "a key too many": (replaced("extra", to=1), "format"),
    "NaN": (replaced("levels", "roa", to=float("nan")), "format"),
    "a decimal": (replaced("levels", "roa", to=0.5), "format"),
    "evidence of another kind": (replaced("evidence", "kind", to="trust me"), "format"),
}  # fmt: skip


def test_the_original_is_accepted(written: Path) -> None:
    assert run_checker(written)["result"] == "ACCEPTED"


@pytest.mark.parametrize("name", TAMPERED)
def test_tampering_is_rejected_under_its_rule(tmp_path: Path, document: Document, name: str) -> None:
    change, rules = TAMPERED[name]
    data = copy.deepcopy(document)
    change(data)
    got = answer(tmp_path, data)
    assert got["result"] == "REJECTED" and got["rule"] in rules.split("|"), got


def test_harmless_edits_stay_accepted(tmp_path: Path, document: Document) -> None:
    document["provenance"] = {"anything": ["at", {"all": None}]}
    (tmp_path / "c.json").write_text(json.dumps(dict(reversed(document.items())), indent=3))
    assert run_checker(tmp_path / "c.json")["result"] == "ACCEPTED"


def test_reading_gives_back_what_was_written(written: Path) -> None:
    read = read_certificate(written)
    assert read.to_json() == written.read_text()
    system = get_system("pendulum")
    assert read.system.exact_dynamics() == system.exact_dynamics()
    assert read.system.domain == system.domain
    assert read.network.sha256() == pendulum_network(centre="output").sha256()


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"schema": "certify-certificate/3"}', "\xff", "[" * 100_000])
def test_unreadable_certificates(tmp_path: Path, text: str) -> None:
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(CertificateFormatError):
        read_certificate(tmp_path / "c.json")
    with pytest.raises(CertificateFormatError):
        read_certificate(tmp_path / "none.json")


def test_expressions_survive_the_round_trip() -> None:
    x, y = symbols("x y")
    extra = [tan(x / 3) ** -2, (x + y) ** 3 / (1 + x**2), -x, Number(Fraction(-7, 3))]
    for expression in extra:
        assert from_tree(json.loads(json.dumps(to_tree(expression))), {"x": x, "y": y}) == expression
    for name in available_systems():
        system = get_system(name)
        names = {s.name: s for s in (*system.states, *system.inputs)}
        for expression in system.exact_dynamics():
            assert from_tree(to_tree(expression), names) is expression


@pytest.mark.parametrize(
    ("edit", "detail"),
    [
        (lambda b: b[: len(b) // 2], "JSON"),
        (lambda b: b.replace(b'"levels":', b'"levels": {}, "levels":', 1), "duplicate"),
        (lambda b: b.replace(b'"provenance"', b'"proven\xffance"', 1), "JSON"),
        (lambda b: b"[" * 100_000, "JSON"),
        (lambda b: b"", "JSON"),
        (lambda b: b.replace(b'"0x1.', b'"0x01.', 1), "hex float"),
        (lambda b: b.replace(b'"shape": [16, 2]', b'"shape": [16, 99999999999999]', 1), "too long"),
        (lambda b: b.replace(b'"shape": [16, 2]', b'"shape": [true, 2]', 1), "must be an integer from 1 to 16384"),
        (lambda b: b.replace(b'"shape": [16, 2]', b'"shape": [16, 3]', 1), "must be [out, 2]"),
        (lambda b: b + b" " * (256 * 2**20), "larger"),
    ],
)
def test_bytes_that_are_no_certificate(
    tmp_path: Path, written: Path, edit: Callable[[bytes], bytes], detail: str
) -> None:
    edited = edit(written.read_bytes())
    assert edited != written.read_bytes()
    (tmp_path / "c.json").write_bytes(edited)
    got = run_checker(tmp_path / "c.json")
    assert (got["result"], got["rule"]) == ("REJECTED", "format")
    assert any(word in got["detail"] for word in detail.split("|")), got


def test_the_limits_are_the_checker_s() -> None:
    """The producer names what the checker would refuse; the two share no line, so the numbers are compared."""
    assert (limits.MOST_STATES, limits.MOST_STEPS, limits.MOST_ROWS) == (
        checker_document.MAX_STATES,
        checker_networks.MAX_STEPS,
        checker_networks.MAX_WIDTH,
    )
    assert (limits.MOST_NODES, limits.MOST_DEPTH, limits.MOST_EXPONENT) == (
        checker_expression.MAX_OPERATIONS,
        checker_expression.MAX_DEPTH,
        checker_expression.MAX_EXPONENT,
    )
    assert limits.MOST_MATRIX_BITS == checker_exact.MAX_MATRIX_BITS
    page = (Path(checker_document.__file__).parent / "FORMAT.md").read_text()
    assert f"at most {limits.MOST_DIGITS:,} digits" in page and f"at most {limits.MOST_NODES:,} nodes" in page


@pytest.mark.parametrize("of", [[9], []])
def test_a_step_of_no_vector_is_no_certificate(of: list[int], tmp_path: Path) -> None:
    from certify.certificates.reading import read_certificate
    from certify.errors import CertificateFormatError

    result = certify_roa(*scalar_tanh(), tmp_path)
    assert result.certificate is not None
    data = json.loads(result.certificate.read_text())
    data["networks"][0]["steps"][0]["of"] = of
    result.certificate.write_text(json.dumps(data))
    with pytest.raises(CertificateFormatError, match="is not a certificate"):
        read_certificate(result.certificate)
