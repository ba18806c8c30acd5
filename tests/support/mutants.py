"""Mutants of real certificates, by family: seeded, and each with the rule that must refuse it, named beforehand.

The originals are the shipped pendulum's certificate, as the bounds engine produces it, and small closed loops written
by hand: a network centred by its output, one centred before its last tanh, a linear policy without centring, a scalar
plant, and a certificate with c1 = c2. A mutant is not thereby a bad certificate: whether it counts is for
`claim_oracle.py` to say.
"""

from __future__ import annotations

import base64
import json
import re
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tests.checker.test_rules import honest, linear_claim, rotor_claim, scalar_claim
from tests.support.balls import with_ball
from tests.support.certificates import (
    LEAF,
    Document,
    decode,
    dump,
    edited,
    encode,
    grow,
    least_root,
    make,
    rehash,
    tree_of,
    with_tree,
)
from tests.support.claim_oracle import EXACT, LARGEST_FILE, Loop, bounded_by_form, exact_faults, local_fault
from tests.support.earlier import earlier, newer

POLICIES = Path(__file__).parents[2] / "examples" / "policies"
BASES = ("pendulum", "rotor", "rotor, preactivation", "linear", "local only", "scalar", "clipped rotor")
BY_FORM = ("pendulum", "scalar")  # offset +- scale lies in the input bounds
NETWORKS = ("pendulum", "rotor", "rotor, preactivation")


@dataclass(frozen=True)
class Mutant:
    """`rules` may refuse it. `hints`: points where the claim may be false. `size`: the file is filled up with zeros."""

    name: str
    content: Document | bytes
    rules: frozenset[str]
    hints: tuple[tuple[float, ...], ...] = ()
    size: int = 0

    @property
    def raw(self) -> bytes:
        return self.content if isinstance(self.content, bytes) else dump(self.content)

    def write(self, path: Path) -> Path:
        path.write_bytes(self.raw)
        if self.size:
            with path.open("r+b") as stream:
                stream.truncate(self.size)  # sparse
        return path


def mutant(name: str, content: Document | bytes, *rules: str, **more: Any) -> Mutant:
    return Mutant(name, content, frozenset(rules), **more)


@cache
def base(name: str) -> Document:
    """An accepted certificate. Callers edit copies."""
    if name in ("pendulum", "cartpole"):
        return produced(name)
    if name == "trusted":
        evidence = {
            "kind": "trusted-solver", "solver": "dReal", "version": "4.21.06.2", "precision": (0.001).hex(),
            "queries": [["roa", "unsat"], ["local", "unsat"]],
        }  # fmt: skip
        return edited(base("rotor, preactivation"), "evidence", evidence)
    return honest(name)


def produced(name: str) -> Document:
    """The certificate of a shipped policy, by the bounds engine."""
    from certify.analysis.run import RoaOptions, certify_roa
    from certify.loop.plants import get_system
    from certify.loop.policies import load_policy

    policy = load_policy(POLICIES / f"{name}.pt")
    with tempfile.TemporaryDirectory() as folder:
        result = certify_roa(
            get_system(name).with_parameters(policy.parameters),
            policy.network,
            Path(folder),
            RoaOptions(candidate="lyapunov"),
        )
        assert result.certificate is not None
        return earlier(json.loads(result.certificate.read_bytes()))


# ------------------------------------------------------------------------------------------------------------ the tools


def get(data: Any, path: str) -> Any:
    for key in path.split("."):
        data = data[int(key) if key.isdigit() else key]
    return data


def array(data: Document, path: str, change: Callable[[np.ndarray], Any]) -> Document:
    return edited(data, path, lambda text: encode(change(decode(text))))


def policy_arrays(data: Document) -> list[str]:
    layers = [f"policy.layers.{k}.{part}" for k in range(len(data["policy"]["layers"])) for part in ("weight", "bias")]
    ends = [] if data["policy"]["clip"] is None else ["policy.clip.0", "policy.clip.1"]
    return [*layers, "policy.scale", "policy.offset", *ends]


def at_index(index: int, value: Callable[[float], float]) -> Callable[[np.ndarray], np.ndarray]:
    def change(a: np.ndarray) -> np.ndarray:
        a[index] = value(float(a[index]))
        return a

    return change


def flipped(value: float, bit: int) -> float:
    return float((np.array([value]).view(np.uint64) ^ np.uint64(1 << bit)).view(np.float64)[0])


def with_level(data: Document, name: str, value: float) -> Document:
    return edited(data, f"levels.{name}", float(value).hex())


def with_inner(data: Document, value: float) -> Document:
    """Both levels that a practical claim without a ball has for its inner one."""
    return with_level(with_level(data, "floor", value), "local", value)


def levels(data: Document) -> tuple[float, float]:
    return float.fromhex(data["levels"]["local"]), float.fromhex(data["levels"]["roa"])


def places(value: Any, path: str = "") -> list[str]:
    """The path of every section and value."""
    below = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [p for k, v in below for p in (f"{path}{k}", *places(v, f"{path}{k}."))]


def predicted(name: str, data: Document) -> Mutant:
    """The rule is found from exact facts, the linearisation and the sampled local ball.

    Where these leave three rules open, the bounds of the inputs are opened, so that Vdot alone decides.
    """
    rules = prediction(data)
    if len(rules) == 3:
        data = edited(data, "plant.input_bounds", [["-1000000000", "1000000000"]] * len(data["plant"]["inputs"]))
        name, rules = f"{name}, inputs free", rules - {"inputs"}
    return Mutant(name, data, frozenset(rules))


def prediction(data: Document) -> set[str]:
    exact = exact_faults(data)
    for rule in EXACT:
        if rule in exact and rule != "tree":
            return {rule}
    loop, (c1, c2) = Loop(data), levels(data)
    by_form = all(bounded_by_form(loop, j) for j in range(loop.m))
    if c1 == c2:
        return {"local"} if by_form else {"inputs", "local"}
    if "tree" in exact:
        return {"tree"}
    with np.errstate(all="ignore"):
        M = loop.P @ loop.slope()
    indefinite = not np.isfinite(M).all() or np.linalg.eigvalsh(M + M.T)[-1] > 1e-6 * np.abs(M).max()
    if indefinite or local_fault(data):
        return {"local"} if by_form else {"inputs", "local"}  # the input on the local ball comes first
    return {"local", "ring"} if by_form else {"inputs", "local", "ring"}


def outer_rules(data: Document) -> tuple[str, ...]:
    """What a leaf can fail by: the input comes first."""
    loop = Loop(data)
    return ("ring",) if all(bounded_by_form(loop, j) for j in range(loop.m)) else ("inputs", "ring")


# --------------------------------------------------------------------------------------------------------- the policy


def bits_of_the_policy() -> Iterator[Mutant]:
    """One bit of one number, by somebody who does not know of the hash."""
    generator = np.random.default_rng(1)
    for name in BASES:
        data = base(name)
        paths = policy_arrays(data)
        for _ in range(60 if name == "pendulum" else 20):
            path = paths[generator.integers(len(paths))]
            index = int(generator.integers(len(decode(get(data, path)))))
            bit = int(generator.integers(64))
            value = flipped(float(decode(get(data, path))[index]), bit)
            lost = not np.isfinite(value) or (path.endswith("scale") and value == 0)
            rule = "format" if lost else "hash"
            change = at_index(index, lambda v, bit=bit: flipped(v, bit))
            yield mutant(f"{name}: {path}[{index}], bit {bit}", array(data, path, change), rule)


def hash_of_the_policy() -> Iterator[Mutant]:
    generator = np.random.default_rng(2)
    for name in BASES:
        data = base(name)
        sha = data["policy"]["sha256"]
        for k in generator.choice(64, 6, replace=False):
            other = sha[:k] + "0123456789abcdef"[(int(sha[k], 16) + int(generator.integers(1, 16))) % 16] + sha[k + 1 :]
            yield mutant(f"{name}: digit {k} of the hash", edited(data, "policy.sha256", other), "hash")
        for what, value in {"empty": "", "null": None, "number": 7, "list": [sha], "capitals": sha.upper()}.items():
            yield mutant(f"{name}: hash, {what}", edited(data, "policy.sha256", value), "hash")
        yield mutant(f"{name}: hash with a blank", edited(data, "policy.sha256", sha + " "), "hash")
        for centre in ("none", "output"):
            if data["policy"]["centre"] != centre:
                yield mutant(f"{name}: centre {centre}, hash kept", edited(data, "policy.centre", centre), "hash")
        if data["policy"]["centre"] != "preactivation" and data["policy"]["squash"] == "tanh":
            yield mutant(f"{name}: identity, hash kept", edited(data, "policy.squash", "identity"), "hash")
        other_name = "rotor" if name != "rotor" else "scalar"
        other_sha = base(other_name)["policy"]["sha256"]
        yield mutant(f"{name}: hash of {other_name}", edited(data, "policy.sha256", other_sha), "hash")


def bits_of_the_policy_hashed() -> Iterator[Mutant]:
    """High bits of the numbers, by somebody who hashes again: another policy, for which the evidence was not made."""
    generator = np.random.default_rng(3)
    for name in (*BASES, "pendulum"):
        data = base(name)
        paths = [p for p in policy_arrays(data) if "bias" not in p and "offset" not in p]
        for _ in range(25):
            path = paths[generator.integers(len(paths))]
            index = int(generator.integers(len(decode(get(data, path)))))
            bit = int(generator.integers(53, 64))
            value = flipped(float(decode(get(data, path))[index]), bit)
            change = rehash(array(data, path, at_index(index, lambda v, bit=bit: flipped(v, bit))))
            title = f"{name}: {path}[{index}], bit {bit}, hashed"
            if not np.isfinite(value) or (path.endswith("scale") and value == 0):
                yield mutant(title, change, "format")
            else:
                yield predicted(title, change)


def policies_rebuilt() -> Iterator[Mutant]:
    """Layers erased, scaled, transposed, turned round; scale, offset, centre and squash changed; all hashed again."""
    for name in BASES:
        data = base(name)
        depth = len(data["policy"]["layers"])
        for k in range(depth):
            path = f"policy.layers.{k}.weight"
            rows, columns = data["policy"]["layers"][k]["shape"]
            changes: dict[str, Callable[[np.ndarray], np.ndarray]] = {
                "erased": lambda a: 0 * a,
                "negative": lambda a: -a,
                "halved": lambda a: a / 2,
                "a tenth": lambda a: a / 10,
                "reversed": lambda a: a[::-1],
                "ten times": lambda a: a * 10,
                "subnormal": lambda a: np.sign(a) * 5e-324,
            }
            if rows == columns:
                changes["transposed"] = lambda a, s=(rows, columns): a.reshape(s).T
            for what, change in changes.items():
                new = rehash(array(data, path, change))
                if new != data:
                    yield predicted(f"{name}: layer {k} {what}", new)
        for factor in (-1, -0.5, 1e-3, 0.3, 0.6, 5e-324):
            new = rehash(array(data, "policy.scale", lambda a, f=factor: a * f))
            yield predicted(f"{name}: scale times {factor}", new)
        for factor in (1.5, 3, 1e100, 1e300):
            new = rehash(array(data, "policy.scale", lambda a, f=factor: a * f))
            yield predicted(f"{name}: scale times {factor}", new)
        for shift in (-1e3, -7, 7, 1e3, 1e308):
            new = rehash(array(data, "policy.offset", lambda a, s=shift: a + s))
            if data["policy"]["centre"] != "output":  # there the offset means nothing
                yield predicted(f"{name}: offset plus {shift}", new)
        for centre in ("none", "output", "preactivation"):
            for squash in ("tanh", "identity"):
                new = rehash(edited(edited(data, "policy.centre", centre), "policy.squash", squash))
                if new != data and (centre, squash) != ("preactivation", "identity"):
                    yield predicted(f"{name}: centred by {centre}, squash {squash}", new)


def centring() -> Iterator[Mutant]:
    for name in ("linear", "local only", "scalar, no centring"):
        data = base(name)
        for value in (5e-324, -5e-324, 1e-300, 1e-12, 0.25, -1e3):
            for part in ("policy.layers.0.bias", "policy.offset"):
                new = rehash(array(data, part, lambda a, v=value: a + v))
                yield mutant(f"{name}: {part} plus {value}", new, "centring")
    for name in NETWORKS:
        data = base(name)
        new = rehash(edited(data, "policy.centre", "none"))
        yield mutant(f"{name}: no centring", new, "centring")
        for value in (1e-3, -1e-3, 1e9):
            for k in range(len(data["policy"]["layers"])):
                shifted = rehash(array(new, f"policy.layers.{k}.bias", lambda a, v=value: a + v))
                yield mutant(f"{name}: no centring, bias {k} plus {value}", shifted, "centring")
    for name in ("pendulum", "rotor, preactivation", "scalar"):
        data = base(name)
        s, q = float(decode(data["policy"]["scale"])[0]), float(Fraction(data["plant"]["u_eq"][0]))
        for value in (q + s, q - s, q + 2 * s, q - 1.0000001 * s, 1e308, -1e308):
            new = rehash(array(data, "policy.offset", lambda a, v=value: 0 * a + v))
            yield mutant(f"{name}: offset {value}", new, "centring")
        offset = float(decode(data["policy"]["offset"])[0])
        if q != offset:
            for value in (q - offset, offset - q, (q - offset) / 2, 5e-324):
                new = rehash(array(data, "policy.scale", lambda a, v=value: 0 * a + v))
                yield mutant(f"{name}: scale {value}", new, "centring")


def clips() -> Iterator[Mutant]:
    """The clip left out, narrowed, moved and turned round, by somebody who hashes again or does not."""
    for name in ("clipped", "clipped rotor"):
        data = base(name)
        lo, hi = (float(decode(end)[0]) for end in data["policy"]["clip"])
        u_eq = float(Fraction(data["plant"]["u_eq"][0]))
        yield mutant(f"{name}: no clip, hash kept", edited(data, "policy.clip", None), "hash")
        open_bounds = edited(data, "plant.input_bounds", [[str(Fraction(lo)), str(Fraction(hi))]])
        yield mutant(f"{name}: bounds that only the clip keeps, no clip", clipped(open_bounds, None), "inputs")
        narrow = [(u_eq + s * (lo - u_eq), u_eq + t * (hi - u_eq)) for s in (1, 0.6, 0.3, 0.01) for t in (1, 0.6, 0.01)]
        for a, b in narrow[1:]:
            yield predicted(f"{name}: clip [{a}, {b}]", clipped(data, (a, b)))
            yield mutant(f"{name}: clip [{a}, {b}], hash kept", unhashed(data, (a, b)), "hash")
        for a, b in ((u_eq, hi), (lo, u_eq), (u_eq + 2.0**-40, hi), (lo, u_eq - 2.0**-40), (-9e300, lo), (hi, 9e300)):
            yield mutant(f"{name}: clip [{a}, {b}] without u_eq", clipped(data, (a, b)), "centring")
        for a, b in (
            (hi, lo),
            (lo, lo),
            (hi, hi),
            (lo, np.nan),
            (np.nan, hi),
            (-np.inf, hi),
            (lo, np.inf),
            (0.0, -0.0),
        ):
            yield mutant(f"{name}: clip [{a}, {b}]", clipped(data, (a, b)), "format")
    for name in BASES:
        if base(name)["policy"]["clip"] is None:
            yield mutant(f"{name}: clip far out, hash kept", unhashed(base(name), (-1e9, 1e9)), "hash")


def unhashed(data: Document, clip: tuple[float, float] | None) -> Document:
    return edited(data, "policy.clip", clip and [encode([v]) for v in clip])


def clipped(data: Document, clip: tuple[float, float] | None) -> Document:
    return rehash(unhashed(data, clip))


# --------------------------------------------------------------------------------------------------- levels, P, T, root


def level_values() -> Iterator[Mutant]:
    for name in BASES:
        data = base(name)
        c1, c2 = levels(data)
        for value in (0.0, -0.0, -5e-324, -c1, -c2, -1e308):
            yield mutant(f"{name}: local {value}", with_level(data, "local", value), "levels")
        for value in (0.0, -0.0, 5e-324, -5e-324, -c2, -1e308, np.nextafter(c1, 0)):
            yield mutant(f"{name}: roa {value}", with_level(data, "roa", value), "levels")
        for value in (np.nextafter(c2, np.inf), 1.01 * c2, 2 * c2, 1e308, np.finfo(float).max):
            yield mutant(f"{name}: local {value} above roa", with_level(data, "local", value), "levels")
        both = with_level(with_level(data, "local", -c2), "roa", -c1)
        yield mutant(f"{name}: both negative", both, "levels")


def claims_too_strong() -> Iterator[Mutant]:
    """c2 beyond the root box or the domain, c1 beyond the local rule, or below what the leaves reach."""
    for name in BASES:
        data = base(name)
        c1, c2 = levels(data)
        for factor in (1.001, 1.01, 1.1, 1.5, 2, 10, 1e6, 1e200, 1.7e308 / max(c2, 1)):
            new = with_level(data, "roa", c2 * factor)
            if name == "local only":
                yield predicted(f"{name}: roa times {factor:.4g}", new)
                new = with_level(new, "local", c2 * factor)
            yield predicted(f"{name}: levels up {factor:.4g}", new)
        for factor in (1.05, 1.3, 2, 4):  # with a root box for it, and a domain
            new = wider(with_level(data, "roa", c2 * factor), factor)
            yield predicted(f"{name}: roa times {factor} with its root box", new)
        if name != "local only":
            for t in (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 0.99, 1):
                value = c1 ** (1 - t) * c2**t
                new = with_level(data, "local", value)
                yield mutant(f"{name}: local up to {value:.4g} with the old ball", new, "local")
                new = with_ball(new)
                rules = ("ring",) if name == "linear" else ("local",) if name in BY_FORM else ("inputs", "local")
                yield mutant(f"{name}: local up to {value:.4g}", new, *rules)
            for factor in (0.5, 0.1, 1e-2, 1e-3, 1e-6, 1e-12, 1e-100, 1e-300, 5e-324 / c1):
                new = with_level(data, "local", max(c1 * factor, 5e-324))
                rules = ("ring",) if factor > 1e-200 else ("local", "ring")  # at last the ball cannot be named
                yield mutant(f"{name}: local down to {c1 * factor:.3g}", new, *rules)
        else:
            for factor in (0.5, 0.1, 1e-3, 1e-300):
                lower = with_level(data, "local", c1 * factor)
                rules = ("ring",) if factor > 1e-200 else ("local", "ring")
                yield mutant(f"{name}: local down to {c1 * factor:.3g}", lower, *rules)


def wider(data: Document, factor: float) -> Document:
    """Root box and domain widened for c2 times `factor`."""
    grown = array(data, "evidence.root", lambda a: a * (np.sqrt(factor) * 1.0001))
    domain = [[str(Fraction(q) * 100) for q in pair] for pair in data["plant"]["domain"]]
    return edited(grown, "plant.domain", domain)


def lyapunov() -> Iterator[Mutant]:
    generator = np.random.default_rng(4)
    for name in BASES:
        data = base(name)
        P = decode(data["lyapunov"]["P"])
        n = round(len(P) ** 0.5)
        variants: dict[str, np.ndarray] = {
            "negative": -P, "zero": 0 * P, "minus zero": -0.0 * P, "of ones": np.ones_like(P) * (1 if n > 1 else -1),
            "smallest subnormal": P * 0 - 5e-324,
        }  # fmt: skip
        for k in range(n):
            signs = np.eye(n)
            signs[k, k] = -1
            variants[f"axis {k} negative"] = (signs @ P.reshape(n, n)).ravel()
            variants[f"diagonal {k} negative"] = P * (1 - 2 * np.eye(n).ravel() * (np.arange(n * n) // n == k))
            variants[f"diagonal {k} zero"] = P * (1 - np.eye(n).ravel() * (np.arange(n * n) // n == k))
        if n == 2:
            for k in (1, 2):
                for step in (0.0, 1e300, -1e300):
                    changed = P.copy()
                    changed[k] = np.nextafter(changed[k], step)
                    variants[f"entry {k} one bit towards {step}"] = changed
                for value in (0.0, 1e-3, 5e-324, -P[k], 1e308):
                    changed = P.copy()
                    changed[k] = value
                    variants[f"entry {k} = {value:.4g}"] = changed
            edge = np.sqrt(P[0] * P[3])
            for q in (1.0001, 1.5, 3.0):
                variants[f"indefinite {q}"] = np.array([P[0], q * edge, q * edge, P[3]])
            variants["singular"] = np.array([1.0, 0.5, 0.5, 0.25])
            for _ in range(6):
                index, bit = int(generator.integers(1, 3)), int(generator.integers(0, 62))
                changed = P.copy()
                changed[index] = flipped(changed[index], bit)
                if np.isfinite(changed).all():
                    variants[f"entry {index}, bit {bit}"] = changed
        for what, value in variants.items():
            yield mutant(f"{name}: P {what}", edited(data, "lyapunov.P", encode(value)), "lyapunov")


def other_lyapunov_functions() -> Iterator[Mutant]:
    """P symmetric, definite, and another one: the evidence is not for it."""
    for name in (*NETWORKS, "linear"):
        data = base(name)
        P = decode(data["lyapunov"]["P"]).reshape(2, 2)
        others = {"identity": np.eye(2), "diagonal": np.diag(np.diag(P)), "transposed axes": P[::-1, ::-1].copy()}
        for angle in (0.1, 0.5, 1.0):
            R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            Q = R @ P @ R.T
            others[f"turned by {angle}"] = (Q + Q.T) / 2
        for what, Q in others.items():
            new = edited(data, "lyapunov.P", encode(Q))
            yield predicted(f"{name}: P {what}", new)
            fitted = adapted(new)
            yield predicted(f"{name}: P {what}, T and root adapted", fitted)


def adapted(data: Document) -> Document:
    """T = L^-T of P = LL', its root box, c2 inside the domain."""
    P = decode(data["lyapunov"]["P"]).reshape(2, 2)
    T = np.linalg.inv(np.linalg.cholesky(P)).T
    limit = min(
        min(-Fraction(lo), Fraction(hi)) ** 2 / Fraction(float(p))
        for (lo, hi), p in zip(data["plant"]["domain"], np.diag(np.linalg.inv(P)), strict=True)
    )
    c2 = min(levels(data)[1], 0.99 * float(limit))
    new = edited(with_level(data, "roa", c2), "evidence.T", encode(T))
    new = with_level(new, "local", min(levels(data)[0], c2 / 100))
    return edited(new, "evidence.root", encode(np.full(2, np.sqrt(c2) * 1.0001)))


def coordinates() -> Iterator[Mutant]:
    generator = np.random.default_rng(5)
    for name in BASES:
        data = base(name)
        T = decode(data["evidence"]["T"])
        n = round(len(T) ** 0.5)
        T = T.reshape(n, n)
        variants = {"zero": 0 * T, "minus zero": -0.0 * T}
        if n == 2:
            variants |= {
                "rank 1": np.outer(T[:, 0], [1.0, 2.0]), "first column zero": T * [0, 1],
                "second column zero": T * [1, 0],
                "first row zero": T * [[0], [1]], "columns equal": T[:, [0, 0]],
                "first column 3e-324": np.stack([T[:, 1], T[:, 1] * 5e-324], 1),
            }  # fmt: skip
            for shear in (1.2, -1.4, 1.5, 2.0, -3.0, 10.0, 1e3, 1e10, -1e100):
                variants[f"sheared by {shear}"] = T @ np.array([[1.0, shear], [0.0, 1.0]])
                variants[f"sheared the other way by {shear}"] = T @ np.array([[1.0, 0.0], [shear, 1.0]])
            for _ in range(4):
                v = generator.standard_normal(2)
                variants[f"nearly of rank 1, {v[0]:.3f}"] = np.outer(v, [1, 1.0]) + 1e-9 * generator.standard_normal(
                    (2, 2)
                )
        for what, value in variants.items():
            yield mutant(f"{name}: T {what}", edited(data, "evidence.T", encode(value)), "coordinates")


def skewed_coordinates() -> Iterator[Mutant]:
    """xdot = -Nx with T'NT = I: T serves Vdot, but T'T is not dominated by its diagonal."""
    for s in (1.25, 1.5, 2.0, 3.0, 5.0):
        T = np.array([[1.0, s], [0.0, 1.0]])
        rows = [[Fraction(1), -Fraction(s)], [-Fraction(s), Fraction(s) ** 2 + 1]]
        dynamics = [
            ["-", ["*", "0", "u"], ["+", *(["*", str(q), x] for q, x in zip(row, ("x1", "x2"), strict=True))]]
            for row in rows
        ]
        good = np.linalg.eigh(np.array([[float(q) for q in row] for row in rows]))[1]
        data = make(
            dynamics,
            [([[0.0, 0.0]], [0.0])],
            np.eye(2),
            (1.0, 1.0),
            states=("x1", "x2"),
            domain=[("-2", "2")] * 2,
            T=good,
        )
        root = encode(least_root(np.eye(2), T, 1.0))
        new = edited(edited(data, "evidence.T", encode(T)), "evidence.root", root)
        yield mutant(f"skewed by {s}", new, "coordinates")


def other_coordinates() -> Iterator[Mutant]:
    """T good in itself, and not the one for which the root box and the tree were made."""
    for name in (*NETWORKS, "linear", "local only"):
        data = base(name)
        T = decode(data["evidence"]["T"]).reshape(2, 2)
        for factor in (0.999, 0.9, 0.5, 1e-3, 1e-100, 1e-170):
            yield predicted(f"{name}: T times {factor}", edited(data, "evidence.T", encode(T * factor)))
        for factor in (1.5, 2.0, 5.0):
            new = edited(data, "evidence.T", encode(T * factor))
            yield predicted(f"{name}: T times {factor}", new)
        for what, other in {
            "first column halved": T * [0.5, 1], "second column halved": T * [1, 0.5], "row halved": T * [[0.5], [1]],
            "identity": np.eye(2), "transposed": T.T.copy(), "slightly sheared": T @ np.array([[1.0, 0.3], [0.0, 1.0]]),
        }.items():  # fmt: skip
            yield predicted(f"{name}: T {what}", edited(data, "evidence.T", encode(other)))


def root_boxes() -> Iterator[Mutant]:
    for name in BASES:
        data = base(name)
        n = len(decode(data["evidence"]["root"]))
        for k in range(n):
            values: dict[str, Callable[[float], float]] = {
                "one bit less": lambda b: float(np.nextafter(b, 0)), "0.999999 of it": lambda b: b * 0.999999,
                "0.99 of it": lambda b: b * 0.99, "half": lambda b: b / 2, "zero": lambda b: 0.0, "-0": lambda b: -0.0,
                "negative": lambda b: -b, "subnormal": lambda b: 5e-324, "tiny": lambda b: 1e-200,
                "minus huge": lambda b: -1e308, "exponent bit": lambda b: flipped(b, 53),
            }  # fmt: skip
            for what, value in values.items():
                new = array(data, "evidence.root", at_index(k, value))
                if what == "exponent bit":
                    yield predicted(f"{name}: root {k}, {what}", new)
                else:
                    yield mutant(f"{name}: root {k}, {what}", new, "root")
            for factor in (3.0, 100.0, 1e100, 1e308):
                new = array(data, "evidence.root", at_index(k, lambda b, f=factor: min(b * f, 1.7e308)))
                if name != "local only":
                    yield mutant(f"{name}: root {k} times {factor:.3g}", new, *outer_rules(data))


# ----------------------------------------------------------------------------------------------------------- the tree


def trees() -> Iterator[Mutant]:
    """Form: every byte has its box, and every box its byte."""
    generator = np.random.default_rng(6)
    for name in BASES:
        data = base(name)
        tree = tree_of(data)
        n = len(data["plant"]["states"])
        cuts = range(len(tree)) if len(tree) < 20 else sorted(generator.choice(len(tree), 25, replace=False))
        for k in cuts:
            yield mutant(f"{name}: tree cut at {k}", with_tree(data, tree[:k]), "tree")
        for more in (b"\xff", b"\0", tree, b"\xff" * 1000):
            yield mutant(f"{name}: tree and {len(more)} bytes, {more[:1].hex()}", with_tree(data, tree + more), "tree")
        leaf_places = [k for k, b in enumerate(tree) if b == LEAF]
        for k in generator.choice(leaf_places, min(8, len(leaf_places)), replace=False):
            yield mutant(f"{name}: leaf {k} dropped", with_tree(data, tree[:k] + tree[k + 1 :]), "tree")
            yield mutant(f"{name}: leaf {k} split", with_tree(data, tree[:k] + b"\0" + tree[k + 1 :]), "tree")
            wrong = tree[:k] + bytes([int(generator.integers(n, LEAF))]) + tree[k + 1 :]
            yield mutant(f"{name}: leaf {k} on no axis", with_tree(data, wrong), "tree")
        split_places = [k for k, b in enumerate(tree) if b != LEAF]
        for k in generator.choice(split_places, min(6, len(split_places)), replace=False):
            yield mutant(f"{name}: split {k} dropped", with_tree(data, tree[:k] + tree[k + 1 :]), "tree")
            yield mutant(f"{name}: split {k} a leaf", with_tree(data, tree[:k] + b"\xff" + tree[k + 1 :]), "tree")
            for axis in (n, 254):
                wrong = tree[:k] + bytes([axis]) + tree[k + 1 :]
                yield mutant(f"{name}: split {k} on axis {axis}", with_tree(data, wrong), "tree")
        for depth in (5000, 100_000):
            deep = b"\0" * depth + b"\xff" * (depth + 1)
            yield mutant(f"{name}: {depth} boxes open", with_tree(data, deep), "tree")
        yield mutant(f"{name}: {10**6} splits", with_tree(data, b"\0" * 10**6), "tree")


def subtree(tree: bytes, k: int) -> int:
    """Where the subtree that begins at k ends."""
    missing = 1
    while missing:
        missing += 1 if tree[k] != LEAF else -1
        k += 1
    return k


def coarser_trees() -> Iterator[Mutant]:
    """Well-formed trees that were not made for this claim: splits collapsed, subtrees exchanged, axes changed."""
    generator = np.random.default_rng(7)
    for name in BASES:
        if name == "local only":
            continue
        data, rules = base(name), outer_rules(base(name))
        tree = tree_of(data)
        splits = [k for k, b in enumerate(tree) if b != LEAF]
        variants = {}
        for k in generator.choice(splits, min(14, len(splits)), replace=False):
            variants[f"collapsed at {k}"] = tree[:k] + b"\xff" + tree[subtree(tree, k) :]
        if len(data["plant"]["states"]) == 2:
            for k in generator.choice(splits, min(6, len(splits)), replace=False):
                variants[f"axis of {k} changed"] = tree[:k] + bytes([1 - tree[k]]) + tree[k + 1 :]
            variants["axes exchanged"] = tree.translate(bytes([1, 0, *range(2, 256)]))
        for k in generator.choice(splits, min(6, len(splits)), replace=False):
            middle, end = subtree(tree, k + 1), subtree(tree, k)
            variants[f"halves of {k} exchanged"] = tree[: k + 1] + tree[middle:end] + tree[k + 1 : middle] + tree[end:]
            variants[f"upper half of {k} in both"] = tree[: k + 1] + 2 * tree[middle:end] + tree[end:]
        for other in BASES:
            if other != name and (other == "scalar") == (name == "scalar"):
                variants[f"of {other}"] = tree_of(base(other))
        for what, value in variants.items():
            if value != tree:
                yield mutant(f"{name}: tree {what}", with_tree(data, value), *rules)


# ---------------------------------------------------------------------------------------------------------- the plant


def constants(data: Document) -> list[str]:
    names = {*data["plant"]["states"], *data["plant"]["inputs"]}
    operators = {"+", "-", "*", "/", "**", "sin", "cos", "tan"}
    paths = [f"plant.dynamics.{p}" for p in places(data["plant"]["dynamics"])]
    texts = [(p, get(data, p)) for p in paths]
    return [p for p, v in texts if isinstance(v, str) and v not in names and v not in operators]


def divides(data: Document, path: str) -> bool:
    """True if the number is a factor of a divisor that is a number, which has no value where this one is 0."""
    parts = path.split(".")
    for k in range(2, len(parts)):
        node = get(data, ".".join(parts[:k]))
        if node[:1] == ["/"] and parts[k] == "2":
            return all(re.fullmatch(r"[*/]+|-?\d[\d/]*", text) for text in leaves(node[2]))
    return False


def leaves(tree: Any) -> Iterator[str]:
    """The texts of a tree."""
    for node in tree if isinstance(tree, list) else [tree]:
        yield from leaves(node) if isinstance(node, list) else [str(node)]


def plants() -> Iterator[Mutant]:
    """Constants, signs and operators of the equations; each with a ball that suits the new ones."""
    for name in BASES:
        data = base(name)
        for path in constants(data):
            q = Fraction(get(data, path))
            for factor in (-1, 0, Fraction(1, 2), 2, 10, Fraction(101, 100), 10**300, Fraction(1, 10**300), -(10**9)):
                if q * factor == q or (factor == 0 and divides(data, path)):
                    continue
                new = edited(data, path, str(q * factor))
                title = f"{float(factor):.4g}" if abs(factor) < 1e300 else "huge"
                yield predicted(f"{name}: {path} times {title}", with_ball(new))
        plant = data["plant"]
        state, control = plant["states"][-1], plant["inputs"][0]
        last = len(plant["states"]) - 1
        extra = {
            "a constant 1e-9": "1/1000000000", "a constant 1e-300": "1/" + "1" + "0" * 300, "a constant 1": "1",
            "0/0": ["/", state, state], "cosine": ["cos", state], "sine of 1": ["-", ["sin", "1"], ["sin", "1"]],
            "pole at 0": ["/", "1", state], "power -1": ["**", state, -1], "tan of 1": ["tan", "1"],
            "tan of 1 over a state": ["*", state, ["/", ["tan", "1"], state]],
            "0 times a pole": ["*", "0", ["/", "1", state]], "0 times a root": ["*", "0", ["sqrt", state]],
        }  # fmt: skip
        for what, node in extra.items():
            new = edited(data, f"plant.dynamics.{last}", lambda old, node=node: ["+", old, node])
            yield mutant(f"{name}: {what} added", new, "equilibrium")
        for q in ("1/1000", "-1/1000", "1/1" + "0" * 100, "100"):
            value = str(Fraction(plant["u_eq"][0]) + Fraction(q))
            new = edited(data, "plant.u_eq", [value])
            wanted = "equilibrium"
            yield mutant(f"{name}: u_eq plus {float(Fraction(q)):.3g}", new, wanted)
        for what, node in {
            "strong unstable term": ["*", "1000", state], "weak unstable term": ["*", "20", state],
            "input reversed": ["*", "-1000", control] if plant["u_eq"] == ["0"] else ["*", "1000", state, control],
        }.items():  # fmt: skip
            new = edited(data, f"plant.dynamics.{last}", lambda old, node=node: ["+", old, node])
            yield predicted(f"{name}: {what}", with_ball(new))
        new = edited(data, "plant.dynamics", lambda d: [["-", e] for e in d])
        yield predicted(f"{name}: time reversed", with_ball(new))
        for power in (3, 5):
            grown = ["*", "1000000", ["**", state, power]]
            new = edited(data, f"plant.dynamics.{last}", lambda old, g=grown: ["+", old, g])
            yield predicted(f"{name}: {power}rd power added", with_ball(new))
        yield from poles(name, data, last, state)
        if last:
            yield predicted(f"{name}: equations exchanged", edited(data, "plant.dynamics", lambda d: d[::-1]))
            swapped = edited(data, "plant.states", lambda s: s[::-1])
            yield predicted(f"{name}: names exchanged", swapped)


def poles(name: str, data: Document, last: int, state: str) -> Iterator[Mutant]:
    """x^2 / (10^6 (x - a)), with a inside the set but off the origin: F is undefined at x = a."""
    c1, c2 = levels(data)
    P = decode(data["lyapunov"]["P"]).reshape(last + 1, last + 1)
    edge = np.sqrt(c2 / P[last, last])  # along this axis
    for share in (0.3, -0.5, 0.9):
        a = Fraction(float(np.float32(edge * share)))
        node = ["/", ["*", "1/1000000", state, state], ["-", state, str(a)]]
        new = edited(data, f"plant.dynamics.{last}", lambda old, node=node: ["+", old, node])
        hint = ((0.0,) * last + (float(a),),)
        inner = float(a) ** 2 * P[last, last] <= 0.5 * c1
        rules = ("local",) if inner or name == "local only" else ("local", "ring")
        yield mutant(f"{name}: pole at {float(a):.4g}", with_ball(new), *rules, hints=hint)
        hidden = ["*", "0", node]
        new = edited(data, f"plant.dynamics.{last}", lambda old, node=hidden: ["+", old, node])
        yield mutant(f"{name}: hidden pole at {float(a):.4g}", with_ball(new), *rules, hints=hint)


def domains() -> Iterator[Mutant]:
    for name in BASES:
        data = base(name)
        n, c2 = len(data["plant"]["states"]), levels(data)[1]
        inverse = np.linalg.inv(decode(data["lyapunov"]["P"]).reshape(n, n))
        for k in range(n):
            edge = Fraction(float(np.sqrt(c2 * inverse[k, k])))
            lo, hi = data["plant"]["domain"][k]
            small = [
                edge * f for f in (Fraction(9999999, 10000000), Fraction(99, 100), Fraction(1, 2), Fraction(1, 10**300))
            ]
            for value in small:
                pairs = [(str(-value), hi), (lo, str(value)), (str(-value), str(value))]
                for side, pair in zip(("left", "right", "both"), pairs, strict=True):
                    new = edited(data, f"plant.domain.{k}", list(pair))
                    yield mutant(f"{name}: domain {k} {side} at {float(value):.4g}", new, "domain")
            odd = {"0 at its left": ["0", hi], "0 at its right": [lo, "0"], "right of 0": ["1/1000", hi],
                   "left of 0": [lo, "-1/1000"], "far away": ["1000", "1001"]}  # fmt: skip
            for what, pair in odd.items():
                yield mutant(f"{name}: domain {k}, {what}", edited(data, f"plant.domain.{k}", pair), "domain")


def input_bounds() -> Iterator[Mutant]:
    for name in BASES:
        data = base(name)
        lo, hi = (Fraction(q) for q in data["plant"]["input_bounds"][0])
        q = Fraction(data["plant"]["u_eq"][0])
        for share in (
            Fraction(1, 10**6),
            Fraction(1, 1000),
            Fraction(1, 20),
            Fraction(1, 10),
            Fraction(1, 5),
            Fraction(2, 5),
        ):
            sides = {
                "above": (lo, q + share * (hi - q)), "below": (q - share * (q - lo), hi),
                "both": (q - share * (q - lo), q + share * (hi - q)),
            }  # fmt: skip
            for side, (a, b) in sides.items():
                new = edited(data, "plant.input_bounds", [[str(a), str(b)]])
                yield mutant(f"{name}: inputs bounded {side} at {float(share):.3g}", new, "inputs")
        tiny = Fraction(1, 10**1000)
        odd = {"without u_eq": (q + Fraction(1, 100), hi + 1), "u_eq at the left": (q, hi),
               "u_eq at the right": (lo, q),
               "around u_eq alone": (q - tiny, q + tiny), "far away": (hi + 1000, hi + 1001),
               "beyond binary64": (Fraction(10) ** 400, Fraction(10) ** 401)}  # fmt: skip
        for what, (a, b) in odd.items():
            yield mutant(f"{name}: inputs, {what}", edited(data, "plant.input_bounds", [[str(a), str(b)]]), "inputs")


# --------------------------------------------------------------------------------------------------------- the format


def numbers() -> Iterator[Mutant]:
    """Numbers that are not, or are not written as they must be, in every field that has one."""
    rational = ["", "NaN", "inf", "0.5", "1e3", "1/0", "01", "+1", "1 ", "0x1", "1" * 1202, "1/" + "7" * 1202, "1/-2",
                "\u0661", None, 1, True, [], {}]  # fmt: skip
    binary64 = ["", "inf", "-inf", "nan", "1.5", "0x1p+0", "0x1.8p+1", "0X1.8000000000000P+1",
                "0x1.8000000000000p+1024",
                "0x1.8000000000000p-1030", "0x0.8000000000000p-1021", "0x0.0p+00", "0x1.80000000000000p+1", None, 3, [],
                True, " 0x1.8000000000000p+1"]  # fmt: skip
    generator = np.random.default_rng(8)
    for name in BASES:
        data = base(name)
        plain = [
            "plant.u_eq.0",
            "plant.domain.0.0",
            "plant.domain.0.1",
            "plant.input_bounds.0.0",
            "plant.input_bounds.0.1",
        ]
        for path in plain:
            for value in generator.choice(len(rational), 4, replace=False):
                text = rational[value]
                yield mutant(f"{name}: {path} = {text!r:.20}", edited(data, path, text), "format")
        for path in ("levels.local", "levels.roa"):
            for value in generator.choice(len(binary64), 6, replace=False):
                text = binary64[value]
                yield mutant(f"{name}: {path} = {text!r:.30}", edited(data, path, text), "format")
        for path in (*policy_arrays(data), "lyapunov.P", "evidence.T", "evidence.root"):
            for value in (np.nan, np.inf, -np.inf):
                size = len(decode(get(data, path)))
                change = at_index(int(generator.integers(size)), lambda v, value=value: value)
                yield mutant(f"{name}: {path} with {value}", array(data, path, change), "format")
            for what, change in {"a number less": lambda a: a[:-1], "a number more": lambda a: [*a, 1.0]}.items():
                yield mutant(f"{name}: {path}, {what}", array(data, path, change), "format")
            text = get(data, path)
            odd = {"a byte less": base64.b64encode(base64.b64decode(text)[:-1]).decode(), "a blank": text + " ",
                   "unpadded": text.rstrip("=") + "A", "padded twice": text + "====", "null": None, "list": [1.0],
                   "empty": ""}  # fmt: skip
            for what in generator.choice(sorted(odd), 3, replace=False):
                yield mutant(f"{name}: {path}, {what}", edited(data, path, odd[what]), "format")


def structure() -> Iterator[Mutant]:
    """Keys missing, unknown, misspelt; values of another type; counts that do not agree."""
    generator = np.random.default_rng(9)
    values = [None, False, 0, 3, [], [[]], {}, {"a": []}, [1, 2, 3]]
    for name in BASES:
        data = base(name)
        sections = ["", *(p for p in places(data) if isinstance(get(data, p), dict) and p != "provenance")]
        for path in sections:
            section = get(data, path) if path else data
            keys = sorted(section)
            for key in keys if name == "pendulum" else generator.choice(keys, min(2, len(keys)), replace=False):
                rest = {k: v for k, v in section.items() if k != key}
                other = {f"{k}_" if k == key else k: v for k, v in section.items()}
                for what, new in (("missing", rest), ("misspelt", other)):
                    content = edited(data, path, new) if path else new
                    yield mutant(f"{name}: {path or 'file'}, {key} {what}", content, "format")
            unknown = {**section, "comment": "trust me"}
            yield mutant(
                f"{name}: {path or 'file'}, unknown key", edited(data, path, unknown) if path else unknown, "format"
            )
        typed = [
            p for p in places(data) if p not in ("policy.sha256", "policy.clip") and not p.startswith("provenance")
        ]
        for path in generator.choice(typed, 25, replace=False):
            value = values[int(generator.integers(len(values)))]
            yield mutant(f"{name}: {path} = {value!r}", edited(data, str(path), value), "format")
        for what, path, change in (
            ("an equation more", "plant.dynamics", lambda d: [*d, "0"]),
            ("no equations", "plant.dynamics", lambda d: []),
            ("a domain less", "plant.domain", lambda d: d[:-1]),
            ("an input bound more", "plant.input_bounds", lambda d: d * 2),
            ("u_eq twice", "plant.u_eq", lambda d: d * 2), ("no states", "plant.states", lambda d: []),
            ("state named as the input", "plant.inputs", lambda d, name=data["plant"]["states"][0]: [name]),
            ("inverted domain", "plant.domain", lambda d: [pair[::-1] for pair in d]),
            ("inverted bounds", "plant.input_bounds", lambda d: [pair[::-1] for pair in d]),
            ("unknown name", "plant.dynamics.0", lambda e: ["+", e, "wind"]),
            ("unknown operator", "plant.dynamics.0", lambda e: ["log", e]),
            ("no operand", "plant.dynamics.0", lambda e: ["+"]),
            ("power 0", "plant.dynamics.0", lambda e: ["**", e, 0]),
            ("power 65", "plant.dynamics.0", lambda e: ["**", e, 65]),
            ("power 1/2", "plant.dynamics.0", lambda e: ["**", e, "1/2"]),
            ("sine of two", "plant.dynamics.0", lambda e: ["sin", e, e]),
            ("quotient of one", "plant.dynamics.0", lambda e: ["/", e]),
            ("no layers", "policy.layers", lambda d: []), ("last layer left out", "policy.layers", lambda d: d[1:]),
            ("layer twice", "policy.layers", lambda d: [d[0], d[0], d[0], *d[1:]] if d[0]["shape"] != [1, 1] else []),
            ("shape turned", "policy.layers.0.shape", lambda s: s[::-1] if s[0] != s[1] else [s[0]]),
            ("shape with 0", "policy.layers.0.shape", lambda s: [0, s[1]]),
            ("negative shape", "policy.layers.0.shape", lambda s: [-s[0], s[1]]),
            ("shape of booleans", "policy.layers.0.shape", lambda s: [True, True]),
            ("squash", "policy.squash", lambda s: "relu"), ("centre", "policy.centre", lambda s: "input"),
            ("schema", "schema", lambda s: "certify-certificate/2"), ("kind", "evidence.kind", lambda s: "trust-me"),
            ("zero scale", "policy.scale", lambda s: encode([0.0])),
            ("scale -0", "policy.scale", lambda s: encode([-0.0])),
            ("kind of a solver", "evidence.kind", lambda s: "trusted-solver"),
        ):  # fmt: skip
            yield mutant(f"{name}: {what}", edited(data, path, change), "format")


def raw_bytes() -> Iterator[Mutant]:
    """Files that are no JSON document, or not this one: encodings, duplicates, literals, cuts."""
    generator = np.random.default_rng(10)
    for name in BASES:
        data = base(name)
        raw = dump(data)
        for k in generator.choice(len(raw) - 1, 12, replace=False):
            yield mutant(f"{name}: cut after {k} bytes", raw[:k], "format")
        for bad in (b"\xff", b"\xc0\xa0", b"\xed\xa0\x80", b"\x80", b"\xf4\x90\x80\x80", b"\0", b'\n"', b"\xfe\xff"):
            k = int(generator.integers(1, len(raw) - 1))
            yield mutant(f"{name}: {bad!r} at {k}", raw[:k] + bad + raw[k:], "format")
        for key in generator.choice([p for p in places(data) if not p.split(".")[-1].isdigit()], 8, replace=False):
            last = str(key).rsplit(".", 1)[-1]
            new = raw.replace(f'"{last}":'.encode(), f'"{last}": 0, "{last}":'.encode())
            yield mutant(f"{name}: {key} twice", new, "format")
        sure = raw.replace(b'"levels": {', b'"levels": {"local": "0x0.0p+0", "roa": "0x0.0p+0"}, "levels": {')
        escaped = raw.replace(b'"roa":', b'"r\\u006fa": "0x0.0p+0", "roa":')
        for what, new in {
            "two levels": sure, "roa twice, escaped": escaped, "two documents": raw + raw, "nothing": b"",
            "a byte behind": raw + b"\0",
            "UTF-16": raw.decode().encode("utf-16"), "UTF-32": raw.decode().encode("utf-32"),
            "byte order mark": b"\xef\xbb\xbf" + raw,
            "a comma more": raw[:-1] + b",}", "single quotes": raw.replace(b'"', b"'"), "a list": b"[" + raw + b"]",
            "a comment": b"// certificate\n" + raw, "a text": json.dumps(raw.decode()).encode(),
            "null": b"null", "NaN": b"NaN", "a number": b"1", "gzip": b"\x1f\x8b\x08\0" + raw,
        }.items():  # fmt: skip
            yield mutant(f"{name}: {what}", new, "format")
        for literal in (
            "NaN",
            "Infinity",
            "-Infinity",
            "0.5",
            "1e999",
            "1E3",
            "-0.0",
            "1" * 11,
            "-" + "1" * 10,
            "1" * 5000,
        ):
            path = ("plant.u_eq.0", "levels.roa", "provenance")[int(generator.integers(3))]
            marked = dump(edited(data, path, {"x": "@"} if path == "provenance" else "@"))
            yield mutant(f"{name}: {literal[:12]} in {path}", marked.replace(b'"@"', literal.encode()), "format")


def sizes() -> Iterator[Mutant]:
    """Small files that ask for much, and large ones."""
    for name in ("pendulum", "linear"):
        data = base(name)
        raw = dump(data)
        shape = get(data, "policy.layers.0.shape")
        for rows in (2**14, 2**31, 10**9):
            new = edited(data, "policy.layers.0.shape", [rows, shape[1]])
            yield mutant(f"{name}: {rows} rows stated", rehash_or_keep(new), "format")
        yield mutant(f"{name}: long shape", raw.replace(b'"shape": [', b'"shape": [' + b"9" * 100_000 + b","), "format")
        for count in (65, 5000):
            states = [f"x{k}" for k in range(count)]
            plant = {**data["plant"], "states": states, "dynamics": ["0"] * count, "domain": [["-1", "1"]] * count}
            yield mutant(f"{name}: {count} states", edited(data, "plant", plant), "format")
        for depth in (1000, 100_000):
            text = b"[" * depth + b"]" * depth
            yield mutant(f"{name}: {depth} lists deep", spliced(data, "plant.dynamics.0", text), "format")
        objects = b'{"a":' * 100_000 + b"1" + b"}" * 100_000
        yield mutant(f"{name}: 100000 objects deep", spliced(data, "plant.u_eq", objects), "format")
        yield mutant(f"{name}: unclosed lists", b"[" * 10**6, "format")
        operands = 10**6 if name == "linear" else 10**4
        wrong = spliced(data, "plant.dynamics.0", b'["+"' + b",[]" * operands + b"]")
        yield mutant(f"{name}: {operands} wrong operands", wrong, "format")
        yield mutant(
            f"{name}: integer of 10^6 digits", spliced(data, "provenance", b'{"n":' + b"9" * 10**6 + b"}"), "format"
        )
        yield mutant(f"{name}: rational of 10^6 digits", edited(data, "plant.u_eq.0", "9" * 10**6), "format")
        yield mutant(f"{name}: fraction of 10^6 digits", edited(data, "plant.domain.0.1", "1/" + "3" * 10**6), "format")
        yield mutant(f"{name}: 16 MiB of weights", edited(data, "policy.layers.0.weight", "A" * 2**24), "format")
        yield mutant(f"{name}: 16 MiB of root", edited(data, "evidence.root", "A" * 2**24), "format")
        yield mutant(f"{name}: 16 MiB of open boxes", edited(data, "evidence.tree", "A" * 2**24), "tree")
        for size in (LARGEST_FILE + 1, 2**33, 2**40):
            yield mutant(f"{name}: a file of {size} bytes", raw, "format", size=size)
        yield mutant(f"{name}: 2^20 zeros behind", raw + b"\0" * 2**20, "format")


def spliced(data: Document, path: str, text: bytes) -> bytes:
    return dump(edited(data, path, "@@")).replace(b'"@@"', text)


def rehash_or_keep(data: Document) -> Document:
    return rehash(data)


def solvers() -> Iterator[Mutant]:
    """A solver's word in place of a tree: the exact rules still hold it."""
    data = base("trusted")
    c2 = levels(data)[1]
    for rule, what, new in (
        ("format", "solver missing", edited(data, "evidence", lambda e: {k: v for k, v in e.items() if k != "solver"})),
        ("format", "a tree as well", edited(data, "evidence", lambda e: {**e, "tree": "/w=="})),
        ("format", "precision in decimal", edited(data, "evidence.precision", "0.001")),
        ("format", "precision a number", spliced(data, "evidence.precision", b"0.001")),
        ("format", "precision infinite", edited(data, "evidence.precision", "inf")),
        ("format", "query of three", edited(data, "evidence.queries.0", ["a", "b", "c"])),
        ("format", "queries a text", edited(data, "evidence.queries", "unsat")),
        ("format", "version a list", edited(data, "evidence.version", ["4"])),
        ("format", "solver with line breaks", edited(data, "evidence.solver", "x\nACCEPTED")),
        ("format", "empty answer", edited(data, "evidence.queries.0.1", "")),
        ("hash", "weight", array(data, "policy.layers.0.weight", at_index(0, lambda v: v * 2))),
        ("levels", "no local", with_level(data, "local", 0.0)),
        ("levels", "local above roa", with_level(data, "local", 2 * c2)),
        ("lyapunov", "P negative", array(data, "lyapunov.P", lambda a: -a)),
        ("lyapunov", "P asymmetric", array(data, "lyapunov.P", at_index(1, lambda v: v * 1.5))),
        ("equilibrium", "u_eq", edited(data, "plant.u_eq", ["3/5"])),
        ("domain", "roa up", with_level(data, "roa", 1e6 * c2)),
        ("domain", "shrunk", edited(data, "plant.domain.0", ["-1/1000", "3"])),
        ("centring", "scale", rehash(array(data, "policy.scale", lambda a: a / 5))),
        ("centring", "none", rehash(edited(data, "policy.centre", "none"))),
    ):
        yield mutant(f"trusted: {what}", new, rule)


def holes() -> Iterator[Mutant]:
    """Claims that are false for the certificate's own closed loop, with evidence that leaves the place out."""
    for factor, shrink in ((1.2, 0.99), (1.5, 0.9), (4, 0.5), (1.05, 0.97)):
        false = linear_claim(c2=3.0 * factor, domain=[("-100", "100")] * 2, input_bounds=[("-500", "500")])
        small = array(grow(false), "evidence.root", lambda a, s=shrink: a * s)
        yield mutant(f"linear: root box {shrink} of what {factor} needs", small, "root")
    for name in ("pendulum", "rotor", "rotor, preactivation"):
        data = base(name)
        for axis in (0, 1):
            for depth in (1, 2, 3):
                half = bytes([axis]) * depth + tree_of(data)
                yield mutant(f"{name}: tree on the lower part of axis {axis}, {depth}", with_tree(data, half), "tree")


def grown_for_false_claims() -> Iterator[Mutant]:
    """The best that the leaf rule can do for a claim false by little: a tree grown by the checker's own rule."""
    for over in (1.915009, 1.9151, 1.92, 1.95):
        new = grow(scalar_claim(c2=over**2), max_leaves=800, depth=40)
        yield mutant(f"scalar: beyond its region of attraction, x = {over}", new, "ring", hints=((over - 5e-7,),))
    for over in (3.0, 5.0, 8.0):
        new = grow(rotor_claim(c2=0.3 * over, input_bounds=[("-100", "100")]), max_leaves=800, depth=18)
        yield mutant(f"rotor: roa times {over}, grown", new, "ring")
    for name in ("rotor", "rotor, preactivation"):
        data = base(name)
        loop = Loop(data)
        L = np.linalg.inv(np.linalg.cholesky(loop.P)).T
        angle = 2 * np.pi * np.arange(720) / 720
        with np.errstate(all="ignore"):
            u = loop.inputs(L @ np.stack([np.cos(angle), np.sin(angle)]) * np.sqrt(loop.c2) * (1 - 1e-12))[0]
        for share in (0.999, 0.99, 0.9):
            top, bottom = 0.5 + share * (u.max() - 0.5), 0.5 + share * (u.min() - 0.5)
            for side, pair in (("above", ["-100", str(Fraction(top))]), ("below", [str(Fraction(bottom)), "100"])):
                new = grow(edited(data, "plant.input_bounds", [pair]), max_leaves=800, depth=18)
                yield mutant(f"{name}: inputs bounded {side} at {share} of their reach, grown", new, "inputs")


FAMILIES: dict[str, Callable[[], Iterator[Mutant]]] = {
    f.__name__: f
    for f in (
        bits_of_the_policy, hash_of_the_policy, bits_of_the_policy_hashed, policies_rebuilt, centring, level_values,
        claims_too_strong, lyapunov, other_lyapunov_functions, coordinates, skewed_coordinates, other_coordinates,
        root_boxes, trees, coarser_trees, plants, domains, input_bounds, numbers, structure, raw_bytes, sizes, solvers,
        holes, grown_for_false_claims, clips,
    )
}  # fmt: skip


# ----------------------------------------------------------------------------------- another claim: practical stability

DRIFT = "1/100"  # no equilibrium at the origin


@cache
def practical_base(name: str) -> Document:
    """Honest practical certificates, of loops whose origin is no equilibrium."""
    if name == "scalar":
        data = scalar_claim(0.02, 3.0, claim="practical")
    elif name == "linear":
        data = linear_claim(0.5, 3.0, claim="practical", offset=[1 / 64])
    else:
        data = rotor_claim(0.02, 0.2 if "pre" in name else 0.3, name.removeprefix("rotor, "), claim="practical")
    drift = lambda trees: [*trees[:-1], ["+", trees[-1], DRIFT]]  # noqa: E731
    return grow(edited(data, "plant.dynamics", drift))


PRACTICAL = ("scalar", "linear", "rotor, output", "rotor, preactivation")


def asymptotic_levels(data: Document) -> dict[str, str]:
    return {key: data["levels"][key] for key in ("local", "roa")}


def practical() -> Iterator[Mutant]:
    """Forgeries of practical certificates; those of what lies inside of the ring have no counterpart elsewhere."""
    for name in PRACTICAL:
        data, last = practical_base(name), len(practical_base(name)["plant"]["states"]) - 1
        tree, n = tree_of(data), last + 1
        c0, c2 = (float.fromhex(data["levels"][k]) for k in ("floor", "roa"))
        state = data["plant"]["states"][last]
        width = np.sqrt(c0 / decode(data["lyapunov"]["P"])[-1])  # of {V <= c0} along the last axis

        def with_pole(at: float, data: Document = data, state: str = state, last: int = last) -> Document:
            pole = ["/", "1/1000000000", ["-", state, str(Fraction(at))]]
            return grow(edited(data, f"plant.dynamics.{last}", lambda e: ["+", e, pole]), max_leaves=600, depth=14)

        for rule, what, new, *hints in (
            ("format", "claim asymptotic", edited(data, "claim.kind", "asymptotic")),
            ("format", "claim in capitals", edited(data, "claim.kind", "Practical")),
            ("format", "claim of nothing", edited(data, "claim", {})),
            ("format", "floor missing", edited(data, "levels", asymptotic_levels(data))),
            ("format", "local missing", edited(data, "levels", lambda v: {k: v[k] for k in ("floor", "roa")})),
            ("format", "roa missing", edited(data, "levels", lambda v: {k: v[k] for k in ("floor", "local")})),
            ("levels", "local above floor, without a ball", with_level(data, "local", np.nextafter(c0, 9))),
            ("hash", "bit of a weight", array(data, "policy.layers.0.weight", at_index(0, lambda v: flipped(v, 3)))),
            ("levels", "floor 0", with_level(data, "floor", 0.0)),
            ("levels", "floor -0", with_level(data, "floor", -0.0)),
            ("levels", "floor above roa", with_level(data, "floor", float(np.nextafter(c2, 9)))),
            ("lyapunov", "P negative", array(data, "lyapunov.P", lambda a: -a)),
            ("domain", "roa up", with_level(data, "roa", 1e4 * c2)),
            ("domain", "shrunk", edited(data, "plant.domain.0", ["-1/1000", "3"])),
            ("coordinates", "T of 0", array(data, "evidence.T", lambda a: 0 * a)),
            ("root", "less by a hundredth", array(data, "evidence.root", lambda a: 0.99 * a)),
            ("root", "roa up by a hundredth", with_level(data, "roa", 1.01 * c2)),
            ("tree", "cut", with_tree(data, tree[:-1])),
            ("tree", "leaf behind", with_tree(data, tree + b"\xff")),
            ("tree", "no such axis", with_tree(data, bytes([n]) + tree)),
            ("tree", "lower half alone", with_tree(data, bytes([0]) + tree)),
            ("ring", "floor far below the drift", with_inner(data, 1e-9), (1e-4,) if n == 1 else None),
            ("ring", "drift times 1000", edited(data, f"plant.dynamics.{last}.2", "10")),
            ("ring", "other sign", edited(data, "plant.dynamics", lambda d: [["-", e] for e in d])),
            *[
                ("ring", f"pole inside, at {share}", with_pole(at), (0.0,) * last + (at,))
                for share in (0.75, 0.5, -0.25, -0.75)
                for at in (float(Fraction(round(share * width * 2**12), 2**12)),)
            ],
            ("ring", "pole in the ring", with_pole(at := 1.5 * 2.0 ** np.floor(np.log2(width))), (0.0,) * last + (at,)),
        ):  # fmt: skip
            yield mutant(f"practical {name}: {what}", new, rule, hints=tuple(h for h in hints if h))
        if name != "linear":
            out = rehash(array(data, "policy.scale", lambda a: a * 0 + 2.0**-20))
            out = edited(out, "plant.u_eq", ["3/4"])
            if "pre" in name:
                yield mutant(f"practical {name}: u_eq out of reach", out, "centring")
    for name in ("linear", "rotor, output", "rotor, preactivation"):
        data = practical_base(name)
        n, (lo, hi) = len(data["plant"]["states"]), map(Fraction, data["plant"]["input_bounds"][0])
        u = Loop(data).inputs(np.zeros((n, 1)))[0, 0]  # at the origin, which only what lies inside contains
        close = tuple([2.0**-60] * n)
        for what, pair in {
            "lower bound above pi(0)": (Fraction(u) + Fraction(1, 10**6), hi),
            "upper bound below pi(0)": (lo, Fraction(u) - Fraction(1, 10**6)),
        }.items():
            new = edited(data, "plant.input_bounds", [[str(v) for v in pair]])
            yield mutant(f"practical {name}: {what}", new, "inputs", hints=(close,))


# ------------------------------------------------------------------------------------ edits that leave the claim true


def true_edits() -> Iterator[Mutant]:
    """Edits after which the claim is true and fully evidenced: they may be accepted, and are."""
    for name in BASES:
        data = base(name)
        plant, tree, (c1, c2) = data["plant"], tree_of(data), levels(data)
        n = len(plant["states"])
        yield mutant(f"{name}: provenance", edited(data, "provenance", {"author": "\u00e9", "of": [None, True, 7]}))
        yield mutant(f"{name}: no provenance", edited(data, "provenance", {} if data["provenance"] else {"": ""}))
        yield mutant(f"{name}: name of the plant", edited(data, "plant.name", "another"))
        yield mutant(f"{name}: white space", b"\r\n\t " + json.dumps(newer(data), indent=7).encode() + b"\n" * 1000)
        yield mutant(f"{name}: order of keys", json.dumps(turned_round(newer(data))).encode())
        yield mutant(f"{name}: escaped letters", dump(data).replace(b'"levels"', b'"\\u006c\\u0065vels"'))
        yield mutant(
            f"{name}: raw UTF-8",
            json.dumps(newer(edited(data, "provenance", {"a": "\u017d"})), ensure_ascii=False).encode(),
        )
        wide = [[str(Fraction(q) * 7) for q in pair] for pair in plant["domain"]]
        yield mutant(f"{name}: domain widened", edited(data, "plant.domain", wide))
        wide = [[str(Fraction(lo) - 1), str(Fraction(hi) + 1000)] for lo, hi in plant["input_bounds"]]
        yield mutant(f"{name}: input bounds widened", edited(data, "plant.input_bounds", wide))
        doubled = [
            [f"{Fraction(q).numerator * 2}/{Fraction(q).denominator * 2}" for q in pair] for pair in plant["domain"]
        ]
        yield mutant(f"{name}: fractions not in lowest terms", edited(data, "plant.domain", doubled))
        yield mutant(
            f"{name}: equations negated twice", edited(data, "plant.dynamics", lambda d: [["-", ["-", e]] for e in d])
        )
        yield mutant(
            f"{name}: 0 u added", edited(data, "plant.dynamics", lambda d: [["+", e, ["*", "0", "u"]] for e in d])
        )
        for what, node in {"0 tan(1)": ["*", "0", ["tan", "1"]], "tan(1) u": ["*", "u", ["tan", "1"]]}.items():
            if what == "0 tan(1)" or plant["u_eq"] == ["0"]:
                times = ["*", "1/1000000000", node] if what == "tan(1) u" else node
                new = edited(data, "plant.dynamics", lambda d, node=times: [["+", e, node] for e in d])
                yield mutant(f"{name}: {what} added", new)
        for step in (1e-12, 1e-10):
            new = array(with_level(data, "roa", c2 * (1 + step)), "evidence.root", lambda a, s=step: a * (1 + s))
            new = with_level(new, "local", c1 * (1 + step)) if c1 == c2 else new
            yield mutant(f"{name}: roa and root box up by {step}", new)
        if c1 < c2:
            yield mutant(f"{name}: roa down by a millionth", with_level(data, "roa", c2 * (1 - 1e-6)))
            wider_ball = array(data, "evidence.local.J", lambda a: a * (1 + 1e-6))
            yield mutant(f"{name}: local up by a millionth", with_level(wider_ball, "local", c1 * (1 + 1e-6)))
        k = int(np.flatnonzero(np.frombuffer(tree, np.uint8) == LEAF)[-1])
        if name != "linear":  # the multiplier is a choice, and there the choice for the half is worse
            yield mutant(f"{name}: last leaf halved", with_tree(data, tree[:k] + bytes([n - 1, LEAF, LEAF])))
        yield mutant(f"{name}: root box one bit wider", array(data, "evidence.root", lambda a: np.nextafter(a, np.inf)))
        scaled = array(data, "lyapunov.P", lambda a: a * 2.0**40)
        weights = np.repeat([2.0**-40, 2.0**-40, 2.0**40], n)  # of P against the models, which stay
        scaled = array(scaled, "evidence.local.multipliers", lambda a, w=weights: a * w)
        yield mutant(
            f"{name}: P and levels times 2^40",
            with_level(with_level(scaled, "local", c1 * 2.0**40), "roa", c2 * 2.0**40),
        )
        halved = array(array(data, "evidence.T", lambda a: a / 2), "evidence.root", lambda a: a * 2)
        yield mutant(f"{name}: T halved, root box doubled", halved)
        if data["policy"]["centre"] != "none":
            last = len(data["policy"]["layers"]) - 1
            if data["policy"]["centre"] == "preactivation":
                moved = rehash(array(data, f"policy.layers.{last}.bias", lambda a: a + 0.125))
                yield mutant(f"{name}: a last bias that centring removes", moved)
            else:
                moved = rehash(array(data, "policy.offset", lambda a: a + 0.125))
                yield mutant(f"{name}: an offset that centring removes", moved)


def turned_round(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: turned_round(v) for k, v in reversed(value.items())}
    return [turned_round(v) for v in value] if isinstance(value, list) else value


def cartpole() -> Iterator[Mutant]:
    """The largest certificate: 256 x 256 weights, four states, thousands of leaves."""
    generator = np.random.default_rng(11)
    data = base("cartpole")
    tree, (_, c2) = tree_of(data), levels(data)
    for k in range(3):
        index, bit = int(generator.integers(256 * 256)), int(generator.integers(52))
        change = at_index(index, lambda v, bit=bit: flipped(v, bit))
        yield mutant(f"cartpole: weight {index}, bit {bit}, {k}", array(data, "policy.layers.1.weight", change), "hash")
    erased = rehash(array(data, "policy.layers.2.weight", lambda a: 0 * a))
    for rule, what, new in (
        ("local", "last layer erased", erased),
        ("local", "last layer negative", rehash(array(data, "policy.layers.2.weight", lambda a: -a))),
        ("format", "NaN among the weights", array(data, "policy.layers.1.weight", at_index(65535, lambda v: np.nan))),
        ("format", "unknown key", {**data, "comment": "trust me"}),
        ("levels", "local above roa", with_level(data, "local", 2 * c2)),
        ("lyapunov", "P asymmetric by one bit", array(data, "lyapunov.P", at_index(1, lambda v: np.nextafter(v, 9)))),
        ("lyapunov", "P indefinite", array(data, "lyapunov.P", at_index(15, lambda v: v / 2))),
        ("equilibrium", "a constant added", edited(data, "plant.dynamics.2", lambda e: ["+", e, "1/1000000000"])),
        ("domain", "pole angle", edited(data, "plant.domain.1", ["-1/10", "1/10"])),
        ("domain", "roa up", with_level(data, "roa", 100 * c2)),
        ("coordinates", "T of rank 3", array(data, "evidence.T", lambda a: a * np.tile([1, 1, 1, 0], 4))),
        ("root", "a thousandth less", array(data, "evidence.root", at_index(2, lambda v: 0.999 * v))),
        ("root", "roa up within the domain", with_level(data, "roa", 1.01 * c2)),
        ("centring", "offset out of reach", rehash(array(data, "policy.offset", lambda a: a + 31))),
        ("local", "local up", with_level(data, "local", c2)),
        ("tree", "cut", with_tree(data, tree[:-1])), ("tree", "leaf behind", with_tree(data, tree + b"\xff")),
        ("tree", "axis 4", with_tree(data, tree.replace(b"\x03", b"\x04", 1))),
        ("ring", "one leaf", with_tree(data, b"\xff")),
        ("inputs", "input bounds", edited(data, "plant.input_bounds", [["-1", "1"]])),
    ):  # fmt: skip
        yield mutant(f"cartpole: {what}", new, rule)


@cache
def family(name: str) -> tuple[Mutant, ...]:
    """The mutants of a family, each once, none equal to an original."""
    seen = {dump(base(b)) for b in (*BASES, "trusted", "scalar, no centring")}
    result = []
    for one in (cartpole if name == "cartpole" else FAMILIES[name])():
        if one.size or one.raw not in seen:
            seen.add(b"" if one.size else one.raw)
            result.append(one)
    return tuple(result)
