"""The work on a case, at its place: the run of `certify roa`, in a temporary folder.

One line of JSON and the certificate's bytes come back. An error is an answer too, so that it ends the case and not the
sweep; one that says that two rigorous results contradict each other comes back with the files that show it.
"""

from __future__ import annotations

import base64
import json
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from certify.analysis.installation import versions
from certify.analysis.run import certify_roa
from certify.analysis.studies.case import Case
from certify.errors import CertifyError, InputError, SoundnessError

_MOST_BYTES = 16 * 2**20  # size of a file that shows a contradiction


@dataclass(frozen=True, slots=True)
class Answer:
    """A worker's answer about a case.

    Parameters
    ----------
    kind : `result`; `error`, the case could not be run; `contradiction`, two rigorous results are at odds.
    data : `RoaResult.to_dict()` of a result.
    message : the sentence of an error.
    notices : facts about plant and policy that had to be known.
    raw : the certificate's bytes, None without one.
    files : the files that show a contradiction.
    """

    kind: Literal["result", "error", "contradiction"]
    data: dict[str, Any] = field(default_factory=dict)
    message: str = ""
    notices: tuple[str, ...] = ()
    raw: bytes | None = None
    files: dict[str, bytes] = field(default_factory=dict)


def work(case: Case) -> bytes:
    """Do a case."""
    with tempfile.TemporaryDirectory(prefix="certify-case-") as temporary:
        folder, out = Path(temporary), Path(temporary) / "out"
        notices: list[str] = []
        raw, files = b"", dict[str, str]()
        said: dict[str, Any]
        try:
            stored, plant, options = case.loop(folder, notices.append)
            provenance = {"policy": case.policy.name, **versions()}
            result = certify_roa(plant, stored.network, out, options, provenance=provenance)
            said = {"kind": "result", "data": result.to_dict()}
            raw = result.raw or b""
        except SoundnessError as error:
            said = {"kind": "contradiction", "message": str(error)}
            files = {path.name: base64.b64encode(path.read_bytes()).decode() for path in _shown(out)}
        except CertifyError as error:
            said = {"kind": "error", "message": str(error)}
        except Exception as error:  # a fault of this program in one case must not end the others
            said = {"kind": "error", "message": f"internal error: {type(error).__name__}: {error}"}
        line = json.dumps({**said, "notices": notices, "files": files})
        return line.replace(f"{temporary}/", "").encode() + b"\n" + raw


def answer_in(sent: bytes) -> Answer:
    """The answer that `work` sent.

    Raises
    ------
    InputError : it is something else.
    """
    line, _, raw = sent.partition(b"\n")
    try:
        said = json.loads(line)
        kind, data, message = said["kind"], said.get("data", {}), said.get("message", "")
        notices = tuple(str(notice) for notice in said["notices"])
        files = {Path(str(name)).name: base64.b64decode(text) for name, text in said["files"].items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"what came back is no answer: {type(error).__name__}.") from error
    if kind not in ("result", "error", "contradiction") or not isinstance(data, dict) or not isinstance(message, str):
        raise InputError(f"what came back is no answer: kind {kind!r:.40}.")
    return Answer(kind, data, message, notices, raw or None, files)


def _shown(out: Path) -> list[Path]:
    files = sorted(out.glob("*")) if out.is_dir() else []
    return [path for path in files if path.is_file() and path.stat().st_size <= _MOST_BYTES]
