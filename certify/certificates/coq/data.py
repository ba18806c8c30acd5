"""Read a certificate's claim from its bytes for Coq: exact numbers, and nothing that Coq's statement cannot express.

The reader is strict and separate: the Coq file's statement follows from the same bytes as the hash at its head. An
unknown key might change the claim, so it is rejected. The only evidence that is read is the search's coordinates, which
nobody has to trust.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from certify.certificates.coq.expression import Expression, from_tree, rational
from certify.certificates.encoding import network_named
from certify.certificates.formats import SCHEMA, other_version
from certify.errors import CertificateFormatError, InputError
from certify.loop.policies import PolicyNetwork

Array = NDArray[np.float64]
Interval = tuple[Fraction, Fraction]
_MOST = 64  # states, inputs
_MOST_STEPS, _MOST_ROWS = 256, 2**14  # of a network, of a layer
_LONGEST = 10  # characters of an integer
_KEYS = {
    "certificate": ("schema", "claim", "networks", "plant", "policy", "lyapunov", "levels", "evidence", "provenance"),
    "claim": ("kind", "rate", "sample", "outer"),
    "plant": ("name", "time", "states", "inputs", "uncertain", "dynamics", "u_eq", "domain", "input_bounds"),
    "policy": ("network", "squash", "centre", "scale", "offset", "clip", "origin", "sha256"),
    "lyapunov": ("kind", "P"),
    "levels": ("local", "roa"),
}
_NETWORK_KEYS = ("name", "reads", "steps")
_STEP_KEYS = ({"kind", "of", "shape", "weight", "bias"}, {"kind", "of", "function"})  # of a layer, of a tanh
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}", re.ASCII)
_WHAT_IS = (
    "a proof in Coq is there for claims of kind asymptotic in continuous time, nothing of the plant uncertain, no "
    "input held over a period, no clip, no set beyond the ellipsoid, no constraints, no network but the policy's, "
    "V = x'Px"
)


@dataclass(frozen=True, slots=True)
class Claimed:
    """A certificate's claim about a plant under a policy.

    Parameters
    ----------
    sha256 : hash of the certificate's bytes.
    name : the plant's name, an identifier; for people.
    field : xdot = f(x, u), one expression per state.
    domain, u_eq, bounds : the domain of the states, and u_eq and the bounds of the inputs.
    network : the policy.
    P, level : V = x'Px, (n, n), and c2.
    rate : the certificate's lambda, 0 if it claims none.
    coordinates : T of its evidence, (n, n), from which a search may start.
    """

    sha256: str
    name: str
    field: tuple[Expression, ...]
    domain: tuple[Interval, ...]
    u_eq: tuple[Fraction, ...]
    bounds: tuple[Interval, ...]
    network: PolicyNetwork
    P: Array
    level: float
    rate: float
    coordinates: Array | None

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.field)


def read_claim(raw: bytes) -> Claimed:
    """Read the claim from the bytes of a certificate.

    Raises
    ------
    CertificateFormatError : they are no certificate.
    InputError : Coq's statement cannot express the claim.
    """
    try:
        data = json.loads(
            raw.decode("utf-8"),
            object_pairs_hook=_once,
            parse_int=_integer,
            parse_float=_decimal,
            parse_constant=_decimal,
        )
    except (ValueError, RecursionError) as error:
        if isinstance(error, CertificateFormatError):
            raise
        raise CertificateFormatError(f"a certificate must be JSON in UTF-8; found {error}.") from error
    try:
        return _claimed(data, hashlib.sha256(raw).hexdigest())
    except (KeyError, TypeError, IndexError, RecursionError) as error:
        raise CertificateFormatError(f"a certificate must be as FORMAT.md has it; found {error!r}.") from error


def _claimed(data: Any, sha256: str) -> Claimed:
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        known = other_version(data.get("schema")) if isinstance(data, dict) else None
        raise CertificateFormatError(
            f"a certificate must have the schema {SCHEMA!r}; found another.{f' {known}' if known else ''}"
        )
    claim, plant, policy, lyapunov, levels = (data[k] for k in ("claim", "plant", "policy", "lyapunov", "levels"))
    _require_supported(claim, data["networks"], plant, policy, lyapunov)
    for name, section in {"certificate": data, **{k: data[k] for k in _KEYS if k != "certificate"}}.items():
        if not isinstance(section, dict) or set(section) != set(_KEYS[name]):
            raise CertificateFormatError(
                f"`{name}` must have exactly the keys {', '.join(_KEYS[name])}; found {str(sorted(section))[:200]}."
            )
    if not isinstance(data["provenance"], dict):
        raise CertificateFormatError(f"provenance must be an object; found {str(data['provenance'])[:40]!r}.")
    states, inputs = _names(plant["states"], "states"), _names(plant["inputs"], "inputs")
    if states.keys() & inputs.keys():
        raise CertificateFormatError(f"names must differ; found {sorted(states.keys() & inputs.keys())[0]} twice.")
    n, m = len(states), len(inputs)
    if np.any(_array(policy["origin"], (n,), "origin") != 0):
        raise InputError(f"the policy's network must read x itself; found another origin. {_WHAT_IS}.")
    network = _network(policy, network_named(data["networks"], policy["network"]), n, m)
    if policy["sha256"] != network.sha256():
        raise CertificateFormatError(f"the policy's sha256 must be {network.sha256()}; found {policy['sha256']!r}.")
    P = _array(lyapunov["P"], (n, n), "P")
    level, rate = _binary64(levels["roa"], "levels.roa"), _binary64(claim["rate"], "claim.rate")
    _binary64(levels["local"], "levels.local")  # nothing is claimed of it
    if not np.array_equal(P, P.T):
        raise InputError("`P` must be symmetric; found one that is not.")
    if not (level > 0 and rate >= 0):
        raise InputError(f"the level must be positive and the rate at least 0; found {level} and {rate}.")
    return Claimed(
        sha256=sha256,
        name=_name(plant["name"], "the plant's name"),
        field=tuple(from_tree(tree, states, inputs) for tree in _list(plant["dynamics"], n, "dynamics")),
        domain=_intervals(plant["domain"], n, "domain"),
        u_eq=tuple(rational(u, "u_eq") for u in _list(plant["u_eq"], m, "u_eq")),
        bounds=_intervals(plant["input_bounds"], m, "input_bounds"),
        network=network,
        P=P,
        level=level,
        rate=rate,
        coordinates=_coordinates(data["evidence"], n),
    )


def _require_supported(claim: Any, networks: Any, plant: Any, policy: Any, lyapunov: Any) -> None:
    if claim["kind"] != "asymptotic":  # others have other entries, and some no V
        raise _unsupported(f"claims of kind {claim['kind']}")
    found = {
        "an outer set": claim["outer"] is not None,
        "boxes with ranks": "ranks" in claim,
        "constraints": "keep" in claim,
        "ranges that measurements bound": "data" in claim,
        "functions known by samples": "samples" in claim,
        "an input that is held over a period": claim["sample"] is not None,
        f"plants in {plant['time']} time": plant["time"] != "continuous",
        "more than one network": len(networks) > 1,
        "uncertain quantities": plant["uncertain"] != [],
        "a clip": policy["clip"] is not None,
        f"functions V of kind {lyapunov['kind']}": lyapunov["kind"] != "quadratic",
    }
    for what, there in found.items():
        if there:
            raise _unsupported(what)


def _unsupported(what: str) -> InputError:
    return InputError(f"the certificate must be one that Coq's statement covers; found {what[:80]}. {_WHAT_IS}.")


def _network(policy: Mapping[str, Any], stated: Mapping[str, Any], n: int, m: int) -> PolicyNetwork:
    layers, steps = _layers(stated), stated["steps"]
    if set(stated) != set(_NETWORK_KEYS) or not isinstance(steps, list) or len(steps) > _MOST_STEPS:
        raise CertificateFormatError(
            f"the policy's network must have exactly the keys {', '.join(_NETWORK_KEYS)}, and a list of at most "
            f"{_MOST_STEPS} steps; found {str(sorted(stated))[:200]} and {len(steps)}."
        )
    _name(stated["name"], "a network's name")
    if stated["reads"] != n or type(stated["reads"]) is not int:
        raise CertificateFormatError(f"the policy's network must read {n} states; found {str(stated['reads'])[:40]}.")
    for k, step in enumerate(steps):
        if set(step) != _STEP_KEYS[k % 2] or type(step["of"][0]) is not int:
            raise CertificateFormatError(
                f"a step must have a kind, the number of a vector in `of`, and a function or a shape [out, in], a "
                f"weight and a bias, nothing else; found the keys {str(sorted(step))[:200]}."
            )
    shapes = [tuple(layer["shape"]) for layer in layers]
    for shape in shapes:
        if len(shape) != 2 or any(type(k) is not int or k < 1 for k in shape):
            raise CertificateFormatError(f"a layer must have a shape [out, in]; found {shape}.")
    if any(shape[0] > _MOST_ROWS for shape in shapes):
        raise CertificateFormatError(f"a layer must have at most {_MOST_ROWS} rows; found the shapes {shapes}.")
    if shapes[0][1] != n or shapes[-1][0] != m or any(b[1] != a[0] for a, b in pairwise(shapes)):
        raise CertificateFormatError(f"the layers must lead from {n} states to {m} inputs; found the shapes {shapes}.")
    return PolicyNetwork.of_layers(
        tuple(_array(layer["weight"], shape, "a weight") for layer, shape in zip(layers, shapes, strict=True)),
        tuple(_array(layer["bias"], shape[:1], "a bias") for layer, shape in zip(layers, shapes, strict=True)),
        scale=_array(policy["scale"], (m,), "scale"),
        offset=_array(policy["offset"], (m,), "offset"),
        squash=policy["squash"],
        centre=policy["centre"],
    )


def _layers(network: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The affine steps of a network that has tanh between them, each of the vector just before."""
    kinds = [(step["kind"], step["of"], step.get("function")) for step in network["steps"]]
    expected = [(("affine", "map")[k % 2], [k], (None, "tanh")[k % 2]) for k in range(len(kinds))]
    if kinds != expected or len(kinds) % 2 == 0:
        raise CertificateFormatError(
            f"the network {network['name']} must be of affine steps with tanh between them, each of the vector just "
            "before; found others, which the checkers read but Coq's statement does not yet."
        )
    return list(network["steps"][::2])


def _names(value: Any, name: str) -> dict[str, int]:
    if not isinstance(value, list) or not 1 <= len(value) <= _MOST:
        raise CertificateFormatError(f"`{name}` must be a list of 1 to {_MOST} names; found another.")
    for one in value:
        _name(one, f"each of `{name}`")
    if len(set(value)) != len(value):
        raise CertificateFormatError(f"`{name}` must be different names; found one twice.")
    return {one: place for place, one in enumerate(value)}


def _name(value: Any, whose: str) -> str:
    if not isinstance(value, str) or _NAME.fullmatch(value) is None:
        raise CertificateFormatError(f"{whose} must be an identifier; found {str(value)[:70]!r}.")
    return value


def _list(value: Any, length: int, name: str) -> list[Any]:
    if not isinstance(value, list) or len(value) != length:
        raise CertificateFormatError(f"`{name}` must be a list of {length}; found {str(value)[:60]!r}.")
    return value


def _intervals(value: Any, length: int, name: str) -> tuple[Interval, ...]:
    pairs = [_list(pair, 2, name) for pair in _list(value, length, name)]
    found = tuple((rational(lo, name), rational(hi, name)) for lo, hi in pairs)
    for lo, hi in found:
        if not lo < hi:
            raise CertificateFormatError(f"`{name}` must be pairs lo < hi; found {lo} and {hi}.")
    return found


def _binary64(text: Any, name: str) -> float:
    try:
        value = float.fromhex(text)
    except (ValueError, TypeError, OverflowError) as error:
        raise CertificateFormatError(f"`{name}` must be a hex float; found {str(text)[:40]!r}.") from error
    if not np.isfinite(value) or value.hex() != text:
        raise CertificateFormatError(f"`{name}` must be a finite hex float in canonical form; found {text[:40]!r}.")
    return value


def _array(text: Any, shape: tuple[int, ...], name: str) -> Array:
    """Finite little-endian binary64 from canonical base64."""
    try:
        raw = base64.b64decode(text, validate=True)
    except (ValueError, TypeError) as error:
        raise CertificateFormatError(f"{name} must be base64; found {str(text)[:40]!r}.") from error
    if base64.b64encode(raw).decode("ascii") != text or len(raw) != 8 * math.prod(shape):
        raise CertificateFormatError(f"{name} must be canonical base64 of {shape} numbers; found {len(raw)} bytes.")
    array = np.frombuffer(raw, dtype="<f8").reshape(shape).astype(np.float64)
    if not np.all(np.isfinite(array)):
        raise CertificateFormatError(f"{name} must be finite; found NaN or infinity.")
    return array


def _coordinates(evidence: Any, n: int) -> Array | None:
    """T of the evidence if there is one: a hint to the search, so an invalid one is ignored."""
    if not isinstance(evidence, dict) or "T" not in evidence:
        return None
    try:
        return _array(evidence["T"], (n, n), "T")
    except CertificateFormatError:
        return None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise CertificateFormatError("a certificate must have each key once; found one twice.")
    return found


def _integer(text: str) -> int:
    if len(text) > _LONGEST:
        raise CertificateFormatError(f"integers must have at most {_LONGEST} characters; found {text[:40]}.")
    return int(text)


def _decimal(text: str) -> NoReturn:
    raise CertificateFormatError(f"numbers of a certificate must not be decimal; found {text[:40]}.")
