"""Run Coq: compile the files in order, and judge the axioms of the theorem.

A theorem is proved if every file was compiled, in a new folder with nothing else, and Coq prints only axioms that are
known here. Any other, missing, late or unreadable output is no proof.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from certify.certificates import write_atomically
from certify.errors import BackendError, InputError

THEORY = Path(__file__).resolve().parent / "theory"
PROJECT = "_CoqProject"
WRITTEN = ("Claim.v", "Evidence.v", "Proof.v", "Assumptions.v")  # beside the theory, in this order
INSTALL = (
    "Debian: apt install coq libcoq-interval; opam: opam install coq coq-interval. CERTIFY_COQC names a coqc that is "
    "not on the PATH."
)
_LIBRARY = {  # module of Coq's library: its axioms and primitives
    # the real numbers, and what they bring along
    "ClassicalDedekindReals": "sig_not_dec sig_forall_dec",
    "FunctionalExtensionality": "functional_extensionality_dep",
    "Classical_Prop": "classic",
    # numbers of the processor: their operations, and that these are those of IEEE 754 and of integers mod 2^63
    "PrimFloat": (
        "float classify abs sqrt opp eqb ltb leb compare mul add sub div of_uint63 normfr_mantissa frshiftexp "
        "ldshiftexp next_up next_down"
    ),
    "FloatAxioms": (
        "Prim2SF_valid SF2Prim_Prim2SF Prim2SF_SF2Prim opp_spec abs_spec eqb_spec ltb_spec leb_spec compare_spec "
        "classify_spec mul_spec add_spec sub_spec div_spec sqrt_spec of_uint63_spec normfr_mantissa_spec "
        "frshiftexp_spec ldshiftexp_spec next_up_spec next_down_spec"
    ),
    "PrimInt63": (
        "int lsl lsr land lor lxor asr add sub mul mulc div mod eqb ltb leb addc addcarryc subc subcarryc diveucl "
        "diveucl_21 addmuldiv compare head0 tail0"
    ),
    "Uint63": (
        "of_to_Z lsl_spec lsr_spec land_spec lor_spec lxor_spec add_spec sub_spec mul_spec mulc_spec div_spec mod_spec "
        "eqb_correct eqb_refl ltb_spec leb_spec compare_def_spec head0_spec tail0_spec addc_def_spec "
        "addcarryc_def_spec subc_def_spec subcarryc_def_spec diveucl_def_spec diveucl_21_spec addmuldiv_def_spec"
    ),
}
AXIOMS = frozenset(f"{module}.{name}" for module, names in _LIBRARY.items() for name in names.split())
"""On which a theorem may rest, as Coq prints them where nothing is imported."""
MODULES = tuple(_LIBRARY)
REALS = frozenset({"ClassicalDedekindReals", "FunctionalExtensionality", "Classical_Prop"})
"""The modules among these that the real numbers need; the others are about the processor."""
_ASSUMING = re.compile(  # words by which a theory could assume something, or switch off a check
    r"\b(Axioms?|Conjectures?|Parameters?|Admitted|admit|Primitive|Declare|bypass_check|Unset|Load|Redirect)\b",
    re.ASCII,
)
_FILE = re.compile(r"[A-Z][A-Za-z0-9_]*\.v", re.ASCII)
_AXIOM = re.compile(r"([A-Za-z_][A-Za-z0-9_'.]*)(?: : \S.*)?", re.ASCII)
_CLOSED = "Closed under the global context"
_TAIL = 1500
_COMPILED = (".vo", ".vio", ".vos", ".vok", ".glob")
_HOW = ("-q", "-R", ".", "", "-w", "+several-object-files")
"""Nothing of the user's is loaded first. The folder's own files come before others of their names: without `-R` Coq
takes what it finds in COQPATH. A half compiled `.vio` instead of a `.vo` is an error: Coq takes the newer one."""
_PROBE = "From Interval Require Import Interval.Interval.\n"


@dataclass(frozen=True, slots=True)
class Coqc:
    """Coq's compiler."""

    path: str
    version: str


@dataclass(frozen=True, slots=True)
class Compiled:
    """The result of compiling a folder of files.

    Parameters
    ----------
    axioms : the axioms that the theorem uses, as Coq prints them; None if it is not proved.
    seconds : the time for all files.
    reason : why it is not proved, with the end of Coq's output; empty if it is.
    """

    axioms: tuple[str, ...] | None
    seconds: float
    reason: str = ""


def find_coqc() -> Coqc:
    """Coq's compiler with the library Interval.

    Raises
    ------
    BackendError : there is none, or it lacks the library; with what installs it.
    """
    named = os.environ.get("CERTIFY_COQC")
    path = shutil.which(named or "coqc")
    if path is None:
        raise BackendError(f"coqc must be there; found no {named or 'coqc'}. {INSTALL}")
    path = os.path.abspath(path)
    with tempfile.TemporaryDirectory(prefix="certify-coq-") as name:
        status, said = _run([path, "--version"], Path(name), 60.0)
        version = re.search(r"version (\S+)", said)
        if status != 0 or version is None:
            raise BackendError(f"{path} must say its version; it ended with {status} and said {said[-200:]!r}.")
        Path(name, "Probe.v").write_text(_PROBE, encoding="ascii")
        status, said = _run([path, *_HOW, "Probe.v"], Path(name), 120.0)
        if status != 0:
            raise BackendError(f"Coq {version[1]} must have the library Interval; it said {said[-300:]!r}. {INSTALL}")
    return Coqc(path, version[1])


def theory_files() -> dict[str, bytes]:
    """The theory's files by their names, in the order in which they are compiled.

    Raises
    ------
    BackendError : the list or a file is missing, the list has something else than names of files, or a file has a word
        that assumes something.
    """
    try:
        lines = [line.strip() for line in (THEORY / PROJECT).read_text(encoding="utf-8").splitlines()]
        names = [line for line in lines if line and not line.startswith(("#", "-"))]
        if len(set(names)) != len(names) or any(_FILE.fullmatch(n) is None or n in WRITTEN for n in names):
            raise BackendError(f"{PROJECT} of the theory must list its files, each once; found {names}.")
        files = {name: (THEORY / name).read_bytes() for name in names}
        for name, data in files.items():
            if (found := _ASSUMING.search(data.decode("utf-8"))) is not None:
                raise BackendError(f"the theory must take nothing for granted; found {found[1]} in {name}.")
        return files
    except (OSError, ValueError) as error:
        raise BackendError(f"the theory must be beside this package; found {error}.") from error


def theory_sha256(files: dict[str, bytes]) -> str:
    """The sha256 over the lines of `sha256sum` of the files in their order."""
    lines = (f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in files.items())
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def write_folder(folder: Path, files: dict[str, bytes]) -> None:
    """Write what Coq compiles, in its order, with a list of it and the commands for a reader who needs no Python.

    What an earlier run compiled under these names is removed.

    Raises
    ------
    InputError : the folder cannot be written, or is the theory's own.
    """
    if folder.resolve() == THEORY:
        raise InputError(f"the folder for Coq's files must be another than the theory's own; found {folder}.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in files:
            for suffix in _COMPILED:
                (folder / name).with_suffix(suffix).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be written: {error.strerror}.") from error
    for name, data in files.items():
        write_atomically(folder / name, data)
    write_atomically(folder / PROJECT, "".join(f"{name}\n" for name in files).encode())
    write_atomically(folder / "check.sh", _script(list(files)).encode())


def compile_apart(coqc: Coqc, files: dict[str, bytes], seconds: float) -> Compiled:
    """Compile the files in their order, and judge Coq's output for the last one.

    A new folder that nobody else can write to is used: no other file, link or run can influence the answer.
    """
    with tempfile.TemporaryDirectory(prefix="certify-coq-") as name:
        write_folder(Path(name), files)
        return compile_folder(coqc, Path(name), list(files), seconds)


def compile_folder(coqc: Coqc, folder: Path, names: list[str], seconds: float) -> Compiled:
    """Compile the files in their order, and judge Coq's output for the last one.

    Parameters
    ----------
    names : names of the files in the folder; no compiled form of them may exist.
    seconds : the time limit for all of them.
    """
    start = time.monotonic()
    for name in names:
        compiled = (folder / name).with_suffix(".vo")
        if compiled.exists():
            return Compiled(None, time.monotonic() - start, f"{compiled.name} is there before {name} is compiled")
        status, said = _run([coqc.path, *_HOW, name], folder, start + seconds - time.monotonic())
        if status is None:
            return Compiled(None, time.monotonic() - start, f"the time ended in {name}")
        if status != 0 or not compiled.is_file():
            return Compiled(None, time.monotonic() - start, f"coqc refuses {name} (status {status}): {said[-_TAIL:]}")
    found = axioms_in(said)
    took = time.monotonic() - start
    if found is None:
        return Compiled(None, took, f"what Coq prints of the theorem is not understood: {said[-_TAIL:]}")
    if unknown := sorted(set(found) - AXIOMS):
        return Compiled(None, took, f"the theorem rests on axioms that are not those of Coq's libraries: {unknown}")
    return Compiled(found, took)


def axioms_in(printed: str) -> tuple[str, ...] | None:
    """The axioms that `Print Assumptions` has printed; None if it printed anything else.

    >>> axioms_in("Closed under the global context\\n")
    ()
    >>> axioms_in("Axioms:\\nClassical_Prop.classic : forall P : Prop, P \\\\/ ~ P\\n")
    ('Classical_Prop.classic',)
    >>> axioms_in("Axioms:\\n") is None
    True
    """
    lines = printed.splitlines()
    if lines == [_CLOSED]:
        return ()
    if len(lines) < 2 or lines[0] != "Axioms:":
        return None
    found: list[str] = []
    for line in lines[1:]:
        if line.startswith("  ") and line.strip() and found:
            continue  # a type goes on
        name = _AXIOM.fullmatch(line)
        if name is None or name[1] in found:
            return None
        found.append(name[1])
    return tuple(found)


def _script(names: list[str]) -> str:
    words = " ".join(name.removesuffix(".v") for name in names)
    return f"""#!/bin/sh
# Compiles the theory, the claim and its proof with Coq alone. At the end it prints the axioms of the theorem.
set -e
cd "$(dirname "$0")"
for file in {words}; do
  rm -f "$file.vo" "$file.vio"
done
for file in {words}; do
  coqc {shlex.join(_HOW)} "$file.v"
done
"""


def _run(command: list[str], folder: Path, seconds: float) -> tuple[int | None, str]:
    """Exit status, None if the time ended, and what was printed: all of standard output, or where it failed of both.

    The program and whatever it started are ended with the time.
    """
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
        try:
            process = subprocess.Popen(
                command, cwd=folder, stdin=subprocess.DEVNULL, stdout=out, stderr=errors, start_new_session=True
            )
        except OSError as error:
            return -1, f"{command[0]} cannot be run: {error.strerror}"
        status: int | None = None
        try:
            status = process.wait(max(seconds, 0.01))
        except BaseException as stop:  # also where the user ends it
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if not isinstance(stop, subprocess.TimeoutExpired):
                raise
        out.seek(0)
        errors.seek(0)
        printed = out.read().decode("utf-8", "replace")
        return status, printed if status == 0 else printed + errors.read().decode("utf-8", "replace")
