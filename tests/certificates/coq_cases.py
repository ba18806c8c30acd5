"""Certificates for the tests of the proofs in Coq: plain dictionaries in the format of the file, format 9."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from certify.certificates import loop_sections
from certify.certificates.encoding import network_section
from certify.loop.plants import get_system, load_system
from certify.loop.policies import PolicyNetwork, load_policy
from tests.support.certificates import dump, make
from tests.support.earlier import newer

Document = dict[str, Any]
ROOT = Path(__file__).parent.parent.parent
PENDULUM_P = "PIjdZck4uj/6t0yNNBlaP/q3TI00GVo/Aj4q09SuZD8="
NOTHING: Document = {"kind": "trusted-solver", "solver": "s", "version": "1", "precision": (1e-3).hex(), "queries": []}


def pendulum(level: float = 0.999999) -> Document:
    """The pendulum under the policy that ships, with the largest set that is proved of it."""
    network = load_policy(ROOT / "examples" / "policies" / "pendulum.pt").network
    return {
        "schema": "certify-certificate/9",
        "claim": {"kind": "asymptotic", "rate": (0.0).hex(), "sample": None, "outer": None},
        "networks": _networks(network),
        **loop_sections(get_system("pendulum"), network),
        "lyapunov": {"kind": "quadratic", "P": PENDULUM_P},
        "levels": {"local": (0.1).hex(), "roa": level.hex()},
        "evidence": NOTHING,
        "provenance": {},
    }


def van_der_pol() -> Document:
    """Van der Pol's oscillator in reversed time under the policy of the examples; just beyond the level V increases
    somewhere."""
    network = load_policy(ROOT / "examples" / "policies" / "van_der_pol.pt").network
    sections = loop_sections(load_system(ROOT / "examples" / "plants" / "van_der_pol.toml"), network)
    # How many boxes are needed depends on the order of a product: in this one they were counted.
    product = ["*", "-1", "x2", ["+", "1", ["*", "-1", ["**", "x1", 2]]]]
    sections["plant"]["dynamics"][1] = ["+", "u", "x1", product]
    return pendulum(float.fromhex("0x1.0195ba0d914e0p+0")) | {
        **sections,
        "networks": _networks(network),
        "lyapunov": {"kind": "quadratic", "P": "QIsBytoP4z9YzrRRitjJv1jOtFGK2Mm/CacyC7q61z8="},
    }


def _networks(network: PolicyNetwork) -> list[Document]:
    return [network_section("policy", network.network)]


def scalar() -> Document:
    """xdot = x/2 + u, u = -tanh(x), on {x^2 <= 1}, by hand: it decays as |x| < 1.915."""
    layers = [([[1.0]], [0.0])]
    return newer(make([["+", ["*", "1/2", "x"], "u"]], layers, [[1.0]], (0.5, 1.0), centre="none", scale=(-1.0,)))


def everything() -> Document:
    """Two states, two inputs, every operator of the format, numbers of all kinds, centring at the output."""
    first = [
        "+", ["-", "y"], ["*", "-8/3", "x", ["sin", "x"], ["cos", "y"]], ["-", ["exp", "x"], "1"], ["tan", "x"],
        ["/", "x", ["+", "3", ["*", "x", "y"]]], ["**", ["+", "x", "2"], 3], ["-", "8"],
    ]  # fmt: skip
    second = [
        "+", ["tanh", "y"], ["atan", ["*", "x", "y"]], ["-", ["sqrt", ["+", "1", ["**", "x", 2]]], "1"],
        ["-", ["**", ["+", "y", "2"], -2], "1/4"], ["-", "u", "1/7"], ["*", "981/50", "w"],
    ]  # fmt: skip
    rng = np.random.default_rng(3)
    layers = [
        (rng.standard_normal((3, 2)), rng.standard_normal(3)),
        (rng.standard_normal((2, 3)), np.array([0.0, -0.5])),
    ]
    return newer(make(
        [first, second], layers, [[1.0, 0.125], [0.125, 0.3]], (0.001, 0.01), states=("x", "y"), inputs=("u", "w"),
        u_eq=("1/7", "0"), domain=(("-1/2", "157/50"), ("-1", "1")), input_bounds=(("-1", "3/2"), ("-2", "2")),
        centre="output", scale=(0.1, -0.7), offset=(1e-300, 3.0),
    ))  # fmt: skip


def raw(data: Document) -> bytes:
    """The bytes of a certificate; a document of format 8 becomes one of today."""
    return dump(data)
