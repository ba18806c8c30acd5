"""The judgement of a certificate that came back, and of a row that an earlier sweep has left.

Whoever did the work is not believed. A row says PROVED only if the checker of this machine, asked about the file that
lies in the case's folder, accepted it, and if what that file claims is about the very plant and policy of the case; its
levels and sizes are taken from the file's bytes, and a sampled limit is one at which the violation that was met is
shown again. Neither is a row believed that an earlier sweep has left, because anybody may have edited it: it is kept if
all that can be found out again is what it says. What a worker, or the earlier sweep, says of the reason, of boxes and
of seconds is its word.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from certify.analysis.facts import Levels
from certify.analysis.outcome import by_spectrum
from certify.analysis.studies.case import Case
from certify.analysis.studies.rows import ANSWERS, FILE, SCHEMA, Row, failed, folder_of
from certify.analysis.studies.work import Answer
from certify.certificates import (
    Certificate,
    PartitionTree,
    parse_certificate,
    run_checker,
    set_aside,
    write_atomically,
    write_beside,
)
from certify.certificates.claims import Problem
from certify.certificates.membership import region_of
from certify.certificates.verdict import Verdict
from certify.errors import BackendError, CertificateFormatError, CertifyError, InputError, SoundnessError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import with_origin
from certify.lyapunov import domain_limit, extents, semi_axes, volume
from certify.lyapunov.function import Quadratic
from certify.provers.falsify import Kind, Witness, confirm
from certify.report.words import volume_unit

if TYPE_CHECKING:
    from certify.analysis.options import RoaOptions
    from certify.loop.plants import System
    from certify.loop.policies import Policy

Array = NDArray[np.float64]
_LEAF = bytes([255])  # of a tree in preorder
_CERTIFICATE = "certificate.json"
_OF_WITNESS = ("x", "kind", "values", "constraint")


def kept(out: Path, case: Case) -> Row | None:
    """The row of a case that is done: with the same inputs, without an error, and saying what is found out again here.

    A certificate is asked about anew, which takes as long as its check; that no Lyapunov function exists is shown again
    by the spectrum, and any other refutation is not kept. Anything else, whatever is wrong with it, is a case that is
    to be done.
    """
    folder = out / "cases" / case.name
    try:
        data = json.loads((folder / FILE).read_bytes())
        if data.pop("schema") != SCHEMA:
            return None
        data |= {"verdict": Verdict(data["verdict"]), "levels": Levels(**data["levels"])}
        data |= {name: tuple(data[name]) for name in ("semi_axes", "extents", "states")}
        row = replace(Row(**data), coordinates=case.coordinates)  # files may be called otherwise by now
        if (row.inputs, row.case, row.failed) != (case.inputs, case.name, False):
            return None
        raw = None if row.certificate is None else (folder / _CERTIFICATE).read_bytes()
        return row if row == _found_again(row, case, raw, out) else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError, RecursionError, CertifyError):
        return None


def forget(out: Path, case: Case) -> None:
    """Set aside what lies in the folder of a case that is to be done: it is of other inputs, or is not to be believed.

    Raises
    ------
    InputError : it cannot be.
    """
    folder = out / "cases" / case.name
    set_aside(folder)
    (folder / FILE).unlink(missing_ok=True)


def _found_again(row: Row, case: Case, raw: bytes | None, out: Path) -> Row | None:
    """Find out again what a row of an earlier sweep says, but for what rests on that sweep's word.

    Raises
    ------
    CertifyError : the certificate is refused, is about something else, or the checker failed.
    """
    with tempfile.TemporaryDirectory(prefix="certify-case-") as temporary:
        loop = case.loop(Path(temporary), lambda _: None)
    if raw is None and row.verdict is Verdict.REFUTED and not _is_refuted_again(loop):
        return None
    levels = row.levels.to_dict()
    said = {
        "verdict": row.verdict.value,
        "stop": row.stop,
        "reason": row.reason,
        "claim": {"kind": row.claim},
        "levels": {name: levels[name] for name in ("sampled_limit", "domain_limit")},
        "lyapunov": {"candidate": row.candidate, "notice": row.notice or None},
        "witness": row.witness,
        "boxes": row.boxes,
        "leaves": row.leaves,
        "seconds": {"total": row.seconds},
    }
    answer = Answer("result", data=said, raw=raw)
    found = _stated(case, answer, loop[1])
    return found if raw is None else _checked(found, answer, loop, out)


def _is_refuted_again(loop: tuple[Policy, System, RoaOptions]) -> bool:
    """True if the loop's enclosed eigenvalues show that it is not stable where it rests."""
    closed, claim = ClosedLoop(loop[1], loop[0].network), loop[2].claim
    if claim not in ("auto", "asymptotic"):
        return False
    closed.require_rest()
    found = by_spectrum(closed)
    return found is not None and found[0] is Verdict.REFUTED


def judged(case: Case, answer: Answer, out: Path, *, own: bool) -> Row:
    """The row of an answer; writes its certificate into the case's folder and asks the checker about that file.

    Parameters
    ----------
    own : whether this program did the work on this machine: then a certificate that is refused here is a contradiction.

    Raises
    ------
    SoundnessError : the worker met a contradiction, which is written beside the row, or `own` and the checker refuses.
    """
    if answer.kind == "contradiction":
        folder = folder_of(out, case.name)
        for name, content in answer.files.items():
            write_atomically(folder / f"contradiction-{name}", content)
        raise SoundnessError(f"case {case.name}: {answer.message} What shows it lies in {folder}.")
    if answer.kind == "error":
        return failed(case, answer.message)
    try:
        with tempfile.TemporaryDirectory(prefix="certify-case-") as temporary:
            loop = case.loop(Path(temporary), lambda _: None)
        row = _stated(case, answer, loop[1])
        return row if answer.raw is None else _checked(row, answer, loop, out)
    except (CertificateFormatError, InputError, _Refused) as error:
        if own:
            raise SoundnessError(f"case {case.name}: what was proved is refused here: {error}") from error
        return failed(case, f"what the worker sent is refused here: {error}")
    except BackendError as error:
        return failed(case, str(error))
    except Exception as error:  # whatever a file that somebody made to that end can raise
        if own:
            raise
        return failed(case, f"what the worker sent cannot be read: {type(error).__name__}: {error}")


class _Refused(CertifyError):
    """A certificate does not show what was said of it."""


def _stated(case: Case, answer: Answer, plant: System) -> Row:
    """The row by a worker's word, without what only a certificate may say.

    Raises
    ------
    InputError : something is missing or of another kind.
    """
    data, names = answer.data, [s.name for s in (*plant.states, *plant.disturbances)]
    try:
        used, verdict, witness = data["lyapunov"]["candidate"], Verdict(data["verdict"]), data["witness"]
        notices = [*answer.notices, data["lyapunov"]["notice"]]
        row = Row(
            case.name,
            case.coordinates,
            case.inputs,
            Verdict.UNKNOWN if verdict in ANSWERS else verdict,  # the checker has not spoken
            _text(data["stop"]),
            _text(data["reason"]),
            claim=_text(data["claim"]["kind"]),
            candidate=None if used is None else _text(used),
            volume_unit=volume_unit([plant.units.get(s.name, "") for s in plant.states]),
            states=tuple(s.name for s in plant.states),
            units={name: plant.units.get(name, "") for name in (*names, *plant.parameters)},
            witness=None if witness is None else {name: witness[name] for name in _OF_WITNESS if name in witness},
            boxes=int(data["boxes"]),
            leaves=0 if answer.raw is None else int(data["leaves"]),
            seconds=_optional(data["seconds"]["total"]),
            notice="; ".join(_text(notice) for notice in notices if notice is not None),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"what came back is no result: {type(error).__name__}: {error}.") from error
    if verdict in ANSWERS and answer.raw is None:
        raise InputError(f"what came back says {verdict.value}, and has no certificate.")
    return row


def _checked(row: Row, answer: Answer, loop: tuple[Policy, System, RoaOptions], out: Path) -> Row:
    """The row with what the checker, asked here, lets be said of the certificate's bytes; they get their name, as they
    do in a run, if it does not refuse them.

    Raises
    ------
    CertificateFormatError, _Refused : they are no certificate, are about something else, or the checker refuses them.
    BackendError : the checker failed.
    """
    stored, plant, options = loop
    raw = answer.raw or b""
    sha256 = hashlib.sha256(raw).hexdigest()
    certificate = parse_certificate(raw, f"the certificate of {row.case}")
    network, at = stored.network, certificate.network.origin
    if certificate.network.is_moved:  # it is about the same loop in deviations from another point
        plant = with_origin(plant, [Fraction(v) for v in at.tolist()], certificate.system.exact_u_eq())
        network = replace(network, origin=at)
    _require_about(certificate, raw, replace(certificate, system=plant, network=network))
    folder = folder_of(out, row.case)
    unchecked = write_beside(folder / _CERTIFICATE, raw, ".unchecked.json")
    try:
        said = run_checker(unchecked)
        if said.get("certificate_sha256") != sha256 or said.get("result") not in ANSWERS.values():
            raise _Refused(f"the checker says {said}")
        unchecked.replace(folder / _CERTIFICATE)
    finally:
        unchecked.unlink(missing_ok=True)
    verdict = Verdict(answer.data["verdict"])
    if verdict in ANSWERS:
        if said["result"] != ANSWERS[verdict]:
            raise _Refused(f"{verdict.value} was said, and the checker says {said['result']}")
        _require_asked(certificate, options)
    claim, tree = certificate.claim, certificate.evidence
    P, level = _ellipsoid(certificate)
    limit = domain_limit(certificate.P, certificate.system.domain)
    sampled = _sampled_limit(certificate, row.witness)
    return replace(
        row,
        verdict=verdict,
        claim=claim.kind,
        levels=replace(Levels(sampled_limit=sampled, domain_limit=limit), **claim.levels),
        leaves=tree.tree.count(_LEAF) if isinstance(tree, PartitionTree) else 0,
        witness=None if sampled is None else row.witness,
        volume=volume(P, level),
        semi_axes=tuple(semi_axes(P, level).tolist()),
        extents=tuple(extents(P, level).tolist()),
        certificate=f"cases/{row.case}/{_CERTIFICATE}",
        certificate_sha256=sha256,
        checked=said["result"],
    )


def _sampled_limit(certificate: Certificate, said: Mapping[str, Any] | None) -> float | None:
    """V at a violation that is shown again in balls; None if none is."""
    if said is None:
        return None
    system, x = certificate.system, np.array(said["x"], dtype=np.float64)
    problem = Problem(ClosedLoop(system, certificate.network), Quadratic(certificate.P), certificate.claim.rate)
    values = {str(name): Fraction(text) for name, text in said["values"].items()}
    if x.shape != (system.n,) or not np.all(np.isfinite(x)) or said["kind"] not in get_args(Kind):
        return None
    if not all(name in system.ranges and _is_in(q, system.ranges[name]) for name, q in values.items()):
        return None
    if said["kind"] == "vdot" and set(values) != set(system.ranges):
        return None
    periods = [None] if system.sample is None or said["kind"] != "vdot" else list(system.sample)
    level, named = float(problem.V(x)), str(said.get("constraint", ""))
    shown = (confirm(problem, Witness(x, level, said["kind"], values, period, named)) for period in periods)
    return level if any(shown) else None


def _is_in(q: Fraction, ends: tuple[Fraction, Fraction]) -> bool:
    return ends[0] <= q <= ends[1]


def _require_about(certificate: Certificate, raw: bytes, expected: Certificate) -> None:
    """Refuse a certificate whose plant, policy or claim is not written as the case's own would be.

    Raises
    ------
    _Refused : one is another.
    """
    found, wanted = json.loads(raw), json.loads(expected.to_json())
    for section in ("claim", "plant", "policy"):
        if found[section] != wanted[section]:
            raise _Refused(f"the certificate's section `{section}` is not that of this case")


def _require_asked(certificate: Certificate, options: RoaOptions) -> None:
    """Refuse a certificate that claims less than was asked for.

    Raises
    ------
    _Refused : it does.
    """
    claim, outer = certificate.claim, certificate.claim.outer
    less = {
        "claim": options.claim == "asymptotic" and not claim.at_rest,
        "around": options.around == "origin" and certificate.network.is_moved,
        "rate": claim.rate < options.rate,
        "level": options.level is not None and claim.roa < options.level,
        "lyapunov_level": options.lyapunov_level is not None
        and (outer is None or outer.level < options.lyapunov_level),
    }
    short = [name for name, is_less in less.items() if is_less]
    if short:
        raise _Refused(f"the certificate claims less than was asked for: {', '.join(short)}")


def _ellipsoid(certificate: Certificate) -> tuple[Array, float]:
    """The larger one of those around the operating point, as `RoaResult.ellipsoid` has it."""
    largest = region_of(certificate).largest
    return largest.P, largest.level


def _optional(value: Any) -> float | None:
    return None if value is None else float(value)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"text was expected; found a {type(value).__name__}")
    return value
