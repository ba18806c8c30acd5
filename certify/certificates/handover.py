"""Two certificates in one file: where the first, of a practical claim, ends, the second takes over.

The file is the first one with the second as its entry `then`, both as they were. What this module says of the two is a
help for people; whether the claim holds is for the checkers.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from certify.certificates.claims import Asymptotic, Nearby, Practical
from certify.certificates.evidence import PartitionTree
from certify.certificates.model import Certificate
from certify.errors import InputError

TAKING_OVER = (Asymptotic.kind, Nearby.kind)


def require_joinable(outer: Certificate, inner: Certificate) -> None:
    """Reject two certificates of which the second cannot take over from the first, whatever their levels are.

    Raises
    ------
    InputError : one has a claim or evidence that cannot be joined, or the two are not about the same loop.
    """
    if outer.kind != Practical.kind or outer.then is not None:
        raise InputError(
            f"the first certificate must have a practical claim, whose floor the second takes over; found {outer.kind}"
            f"{'' if outer.then is None else ' with one that takes over already'}. certify roa writes such a one where "
            "the origin need not be an equilibrium, and with --claim practical."
        )
    if inner.kind not in TAKING_OVER:
        raise InputError(
            f"the second certificate must be {' or '.join(TAKING_OVER)}; found {inner.kind}. Name the two in the order "
            "OUTER INNER."
        )
    for name, one in (("first", outer), ("second", inner)):
        if one.claim.ranks is not None or not isinstance(one.evidence, PartitionTree):
            raise InputError(f"the {name} certificate must have neither ranks nor a solver's word; found one of them.")
    differ = [what for what, value in _loop(outer).items() if value != _loop(inner)[what]]
    if differ:
        raise InputError(
            f"the two certificates must be about the same policy, states, inputs and times; they differ in "
            f"{', '.join(differ)}. Make both with the same policy file and options."
        )


def _loop(c: Certificate) -> dict[str, Any]:
    """The parts of a loop that must be the same, by what people call them."""
    s = c.system
    return {
        "time": s.time,
        "sample time": s.sample,
        "states": [x.name for x in s.states],
        "inputs": [u.name for u in s.inputs],
        "operating point": s.exact_x_eq(),
        "u_eq": s.exact_u_eq(),
        "policy": c.network.sha256(),
        "origin of the policy": c.network.origin.tolist(),
    }


def share(outer: Certificate, inner: Certificate) -> float:
    """The largest V'/c2' on {V <= c0}: below 1 the floor lies in the set that takes over. In floating point."""
    to_ball = np.linalg.inv(np.linalg.cholesky(outer.P)) * np.sqrt(outer.claim.levels["floor"])
    return float(np.linalg.eigvalsh(to_ball @ inner.P @ to_ball.T)[-1]) / inner.roa


def joined(outer: bytes, inner: bytes) -> bytes:
    """The file of both, from their bytes, which have been read as certificates."""
    first, second = json.loads(outer), json.loads(inner)
    lines = [f"{json.dumps(k)}: {json.dumps(v)}" for k, v in {**first, "then": second}.items()]
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()
