"""Nothing but Coq's yes on known axioms is a proof: whatever else a compiler says, prints or leaves undone is none."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import time
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import pytest

from certify.certificates import sole_writer
from certify.certificates.coq import kernel
from certify.certificates.coq.kernel import (
    AXIOMS,
    THEORY,
    axioms_in,
    compile_apart,
    compile_folder,
    find_coqc,
    theory_files,
    theory_sha256,
    write_folder,
)
from certify.certificates.coq.proving import CoqOptions, CoqResult, prove_in_coq
from certify.certificates.coq.text import ASSUMPTIONS
from certify.certificates.verdict import Verdict
from certify.cli import doctor
from certify.cli.main import _run
from certify.errors import BackendError, InputError
from tests.certificates.coq_cases import pendulum, raw, scalar
from tests.support.certificates import edited

GOOD = """Axioms:
PrimFloat.sub : PrimFloat.float -> PrimFloat.float -> PrimFloat.float
ClassicalDedekindReals.sig_forall_dec
  : forall P : nat -> Prop,
    (forall n : nat, {P n} + {~ P n}) ->
    {n : nat | ~ P n} + {forall n : nat, P n}
FloatAxioms.sub_spec
  : forall x y : PrimFloat.float,
    FloatOps.Prim2SF (PrimFloat.sub x y) = x
"""
FAKE = """#!/bin/sh
[ "$1" = --version ] && { echo "The Coq Proof Assistant, version 8.16.1"; exit 0; }
[ "$1" = -q ] || exit 9
for file in "$@"; do :; done
[ "$file" = Probe.v ] && PROBE
echo "$file" >> "${0%/*}/order"
LATER
echo compiled > "${file%.v}.vo"
"""
Prove = Callable[..., CoqResult]


@pytest.fixture
def proving(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Prove:
    """Prove the scalar loop with a compiler that does as the script says."""

    def prove(later: str, probe: str = "exit 0", **options: object) -> CoqResult:
        script = tmp_path / "coqc"
        script.write_text(FAKE.replace("PROBE", probe).replace("LATER", later))
        script.chmod(0o755)
        monkeypatch.setenv("CERTIFY_COQC", str(script))
        given = CoqOptions(**options)  # type: ignore[arg-type]
        return prove_in_coq(raw(scalar()), tmp_path / "out", given)

    return prove


def printing(text: str) -> str:
    """A script that prints for the last file."""
    return f"""[ "$file" = Assumptions.v ] && cat << 'END'\n{text}END\n"""


def test_a_proof(proving: Prove, tmp_path: Path) -> None:
    result = proving(printing(GOOD) + "echo a warning >&2")
    assert result.verdict is Verdict.PROVED and not result.reason
    assert result.axioms == ("PrimFloat.sub", "ClassicalDedekindReals.sig_forall_dec", "FloatAxioms.sub_spec")
    assert (result.coq, result.rate) == ("8.16.1", Fraction(1, 40)) and result.boxes > 2
    names = [*theory_files(), "Claim.v", "Evidence.v", "Proof.v", "Assumptions.v"]
    out = tmp_path / "out"
    assert (tmp_path / "order").read_text().split() == names == (out / "_CoqProject").read_text().split()
    assert {p.name for p in out.iterdir()} == {*names, "_CoqProject", "check.sh"}
    for name, data in theory_files().items():
        assert (out / name).read_bytes() == data
    assert result.theory_sha256 == theory_sha256(theory_files())
    assert f"sha256 of the certificate: {result.certificate_sha256}" in (out / "Claim.v").read_text()


NO_PROOF = {
    "another axiom": (printing(GOOD + "Check.lucky : False\n"), r"axioms that are not those.*'Check\.lucky'"),
    "an axiom without its module": (printing("Axioms:\nsub : nat\n"), "axioms that are not those"),
    "an axiom of a like name": (printing("Axioms:\nPrimFloat.sub' : nat\n"), "axioms that are not those"),
    "a recursion that is not guarded": (printing(GOOD + "f is assumed to be guarded.\n"), "is not understood"),
    "universes that collapse": (printing("Type hierarchy is collapsed (logic is inconsistent)\n"), "not understood"),
    "nothing": ("", "is not understood: "),
    "no axioms after their heading": (printing("Axioms:\n"), "is not understood"),
    "a type before any axiom": (printing("Axioms:\n  : False\nPrimFloat.sub : x\n"), "is not understood"),
    "types alone": (printing("Axioms:\n  : False\n"), "is not understood"),
    "another heading": (printing("Section Variables:\nPrimFloat.sub : x\n"), "is not understood"),
    "an axiom twice": (printing("Axioms:\nPrimFloat.sub : x\nPrimFloat.sub : y\n"), "is not understood"),
    "two answers": (printing("Closed under the global context\n" + GOOD), "is not understood"),
    "words before": (printing("Hello\n" + GOOD), "is not understood"),
    "an empty line": (printing(GOOD + "\nCheck.lucky : False\n"), "is not understood"),
    "a failure": ('[ "$file" = Proof.v ] && { echo out; echo no >&2; exit 1; }', r"refuses Proof\.v \(status 1\).*no"),
    "a failure behind good words": (printing(GOOD) + '[ "$file" = Assumptions.v ] && exit 3', r"status 3"),
    "a failure that leaves something compiled": (
        '[ "$file" = Proof.v ] && { echo x > Proof.vo; exit 1; }', r"refuses Proof\.v \(status 1\)",
    ),
    "a crash": ('[ "$file" = Claim.v ] && kill -SEGV $$', r"refuses Claim\.v \(status -11\)"),
    "nothing compiled": ('[ "$file" = Proof.v ] && exit 0', r"refuses Proof\.v \(status 0\)"),
    "a folder instead of a compiled file": (
        '[ "$file" = Proof.v ] && { mkdir Proof.vo; exit 0; }', r"refuses Proof\.v \(status 0\)",
    ),
    "what is compiled beforehand": ('[ "$file" = Claim.v ] && echo x > Proof.vo', r"Proof\.vo is there before"),
}  # fmt: skip


@pytest.mark.parametrize("name", NO_PROOF)
def test_what_is_no_proof(proving: Prove, name: str) -> None:
    later, reason = NO_PROOF[name]
    result = proving(later)
    assert result.verdict is Verdict.UNKNOWN and result.axioms == ()
    assert re.search(reason, result.reason, re.S), result.reason


def test_what_hangs_is_ended_with_all_that_it_started(proving: Prove, tmp_path: Path) -> None:
    start = time.monotonic()
    result = proving('[ "$file" = Spec.v ] && { sleep 60 & echo $! > "${0%/*}/child"; wait; }', time_limit=0.8)
    assert time.monotonic() - start < 10
    assert result.verdict is Verdict.UNKNOWN and result.reason == "the time ended in Spec.v"
    child = int((tmp_path / "child").read_text())
    for _ in range(50):
        if not _alive(child):
            break
        time.sleep(0.1)
    assert not _alive(child)


def _alive(process: int) -> bool:
    state = Path(f"/proc/{process}/stat")
    return state.exists() and state.read_text().rpartition(")")[2].split()[0] != "Z"


def test_the_time_is_that_of_all_files(proving: Prove) -> None:
    result = proving("sleep 0.2\n" + printing(GOOD), time_limit=0.9)
    assert result.verdict is Verdict.UNKNOWN and result.reason.startswith("the time ended in")


def test_what_an_earlier_run_compiled_counts_for_nothing(proving: Prove) -> None:
    assert proving(printing(GOOD)).verdict is Verdict.PROVED
    result = proving('[ "$file" = Proof.v ] && exit 0\n' + printing(GOOD))
    assert result.verdict is Verdict.UNKNOWN and "refuses Proof.v" in result.reason
    assert proving(printing(GOOD)).verdict is Verdict.PROVED


def test_what_lies_in_the_folder_is_not_what_coq_sees(proving: Prove, tmp_path: Path) -> None:
    """Coq prefers a `.vio` that is newer than the `.vo`, and follows links; what is there counts for nothing."""
    out = tmp_path / "out"
    out.mkdir()
    (tmp_path / "elsewhere").write_text("Definition certificate := 0.")
    (out / "Claim.v").symlink_to(tmp_path / "elsewhere")
    for name in ("Spec.vio", "Spec.vo", "Reals.vo", "Extra.v"):
        (out / name).write_text("of somebody else")
        os.utime(out / name, (2**31, 2**31))
    result = proving('[ "$file" = Vectors.v ] && ls -A > "${0%/*}/seen"\n' + printing(GOOD))
    assert result.verdict is Verdict.PROVED, result.reason
    assert set((tmp_path / "seen").read_text().split()) == {
        *(out / "_CoqProject").read_text().split(),
        "_CoqProject",
        "check.sh",
    }
    assert (tmp_path / "elsewhere").read_text() == "Definition certificate := 0."
    assert not (out / "Claim.v").is_symlink() and (out / "Extra.v").exists() and not (out / "Spec.vio").exists()


def test_what_is_proved_is_what_was_read(proving: Prove, tmp_path: Path) -> None:
    """Whoever changes the folder's files while Coq is at work does not change what it compiles."""
    out = tmp_path / "out"
    change = f'[ "$file" = Vectors.v ] && for f in "{out}"/*.v; do echo "(* other *)" > "$f"; done\n'
    result = proving(change + 'cp "$file" "${0%/*}/"\n' + printing(GOOD))
    assert result.verdict is Verdict.PROVED
    assert (out / "Claim.v").read_text() == "(* other *)\n"
    assert f"sha256 of the certificate: {result.certificate_sha256}" in (tmp_path / "Claim.v").read_text()
    for name, data in theory_files().items():
        assert (tmp_path / name).read_bytes() == data


def test_a_folder_has_one_run_at_a_time(proving: Prove, tmp_path: Path) -> None:
    with sole_writer(tmp_path / "out"), pytest.raises(InputError, match="another run is writing"):
        proving(printing(GOOD))
    assert not (tmp_path / "out" / "Claim.v").exists()
    assert proving(printing(GOOD)).verdict is Verdict.PROVED


def test_without_the_library_or_a_version(proving: Prove, tmp_path: Path) -> None:
    result = proving("exit 0", probe="{ echo 'Cannot find Interval' >&2; exit 1; }")
    assert result.verdict is Verdict.UNKNOWN and "must have the library Interval" in result.reason
    assert "apt install coq libcoq-interval" in result.reason and "Coq's files are written" in result.reason
    (tmp_path / "coqc").write_text("#!/bin/sh\necho hello\n")
    with pytest.raises(BackendError, match="must say its version"):
        find_coqc()


def test_without_coq_the_files_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("CERTIFY_COQC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    path = tmp_path / "certificate.json"
    path.write_bytes(raw(scalar()))
    assert _run(["prove-in-coq", str(path), "--out", str(tmp_path / "out")], False) == 3
    out = capsys.readouterr().out
    assert out.startswith("UNKNOWN") and "apt install coq libcoq-interval" in out.replace("\n", " ")
    assert (tmp_path / "out" / "Proof.v").is_file()


def test_the_doctor_says_whether_coq_is_there(proving: Prove, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    proving("exit 0")
    (found,) = (f for f in doctor._optional() if f.name == "Coq")
    assert (found.state, found.found) == ("ok", "8.16.1 with its library Interval")
    monkeypatch.setenv("CERTIFY_COQC", str(tmp_path / "none"))
    (found,) = (f for f in doctor._optional() if f.name == "Coq")
    assert (found.state, found.found) == ("missing", "certify prove-in-coq") and "opam install" in found.advice


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], proving: Prove) -> None:
    path = tmp_path / "certificate.json"
    path.write_bytes(raw(scalar()))
    proving(printing(GOOD))  # leaves its compiler behind
    arguments = ["prove-in-coq", str(path), "--out", str(tmp_path / "new"), "--rate", "1/50"]
    assert _run(arguments, False) == 0
    out = capsys.readouterr().out
    assert out.startswith("PROVED IN COQ  plant: {V <= 1} is invariant, and V decays at the rate 1/50\n")
    for said in ("8.16.1", theory_sha256(theory_files())):
        assert said in out
    assert _run([*arguments, "--json"], True) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["verdict"] == "PROVED" and data["rate"] == "1/50" and data["axioms"] and data["boxes"] > 0
    assert _run([*arguments, "--no-run", "--quiet"], False) == 3
    assert capsys.readouterr().out.startswith("UNKNOWN  plant: Coq was not asked")
    assert not (tmp_path / "new" / "Proof.vo").exists()
    assert _run([*arguments[:4], "--rate", "2"], False) == 3
    assert "UNKNOWN  plant: the search found nothing at the rate 2" in capsys.readouterr().out


REALS = "those of Coq's real numbers"
PROCESSOR = "the processor's floats and integers are as Coq's libraries say"


@pytest.mark.parametrize(
    ("printed", "lines"),
    [
        (
            GOOD + "FloatAxioms.add_spec : x\nPrimInt63.add : x\n",
            [
                f"{REALS}; {PROCESSOR}",
                "ClassicalDedekindReals: sig_forall_dec",
                "PrimFloat: sub",
                "FloatAxioms: add_spec sub_spec",
                "PrimInt63: add",
            ],
        ),
        ("Axioms:\nUint63.add_spec : x\n", [PROCESSOR, "Uint63: add_spec"]),
        ("Axioms:\nClassical_Prop.classic : x\n", [REALS, "Classical_Prop: classic"]),
        ("Closed under the global context\n", ["none"]),
    ],
)
def test_axioms_are_shown_by_module(
    proving: Prove, tmp_path: Path, capsys: pytest.CaptureFixture[str], printed: str, lines: list[str]
) -> None:
    """All of them, and what they are in words."""
    path = tmp_path / "certificate.json"
    path.write_bytes(raw(scalar()))
    proving(printing(printed))
    assert _run(["prove-in-coq", str(path), "--out", str(tmp_path / "new"), "--quiet"], False) == 0
    shown = re.search(r"^axioms +(.*?)^time", capsys.readouterr().out, re.M | re.S)
    assert shown is not None
    assert " ".join(shown[1].split()) == " ".join(lines)


def test_a_level_is_shown_rounded_down(proving: Prove, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "certificate.json"
    path.write_bytes(raw(edited(scalar(), "levels.roa", (1 - 1e-9).hex())))
    proving(printing(GOOD))
    assert _run(["prove-in-coq", str(path), "--out", str(tmp_path / "new"), "--quiet"], False) == 0
    assert capsys.readouterr().out.startswith("PROVED IN COQ  plant: {V <= 0.999999} is invariant")


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--rate", "fast"], "`--rate` must be a finite number"),
        (["--rate", "1/0"], "`--rate` must be a finite number"),
        (["--rate", "1e400000000"], "`--rate` must be a finite number"),
        (["--rate", "-1"], "--rate must be positive"),
        (["--time-limit", "0"], "--time-limit must be positive"),
        (["--boxes", "0"], "boxes"),
    ],
)
def test_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], message: str) -> None:
    path = tmp_path / "certificate.json"
    path.write_bytes(raw(scalar()))
    assert _run(["prove-in-coq", str(path), "--out", str(tmp_path / "out"), *more], False) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_claimed_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "certificate.json"
    path.write_bytes(raw(edited(scalar(), "plant.time", "discrete")))
    assert _run(["prove-in-coq", str(path), "--out", str(tmp_path / "out")], False) == 2
    assert "found plants in discrete time" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        write_folder(tmp_path / "file", {"Claim.v": b""})


def test_the_script_says_what_the_command_does(proving: Prove, tmp_path: Path) -> None:
    """For a reader without Python: the same files in the same order, and it ends with the first failure."""
    proving(printing(GOOD))
    out, folder = tmp_path / "out", tmp_path / "bin"
    folder.mkdir()
    shutil.copy(tmp_path / "coqc", folder / "coqc")
    environment = os.environ | {"PATH": f"{folder}:{os.environ['PATH']}"}
    (out / "Spec.vio").write_text("newer than what is compiled, and Coq would take it")
    done = subprocess.run(["sh", str(out / "check.sh")], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stdout == GOOD and not (out / "Spec.vio").exists()
    assert (folder / "order").read_text() == (out / "_CoqProject").read_text()
    (folder / "coqc").write_text('#!/bin/sh\n[ "$7" != Proof.v ]\n')
    assert subprocess.run(["sh", str(out / "check.sh")], env=environment, check=False).returncode == 1


# The theory


THEORIES = {
    "a file twice": ({"A.v": ""}, "A.v\nA.v\n", "each once"),
    "a file of another folder": ({"A.v": ""}, "../A.v\n", "each once"),
    "the claim": ({"Claim.v": ""}, "Claim.v\n", "each once"),
    "a file that is missing": ({}, "A.v\n", "must be beside this package"),
    "an axiom": ({"A.v": "Lemma a : True. Axiom b : False."}, "A.v\n", r"found Axiom in A\.v"),
    "a lemma that is admitted": ({"A.v": "Lemma a : False.\nAdmitted.\n"}, "A.v\n", "found Admitted"),
    "a check switched off": ({"A.v": "Unset Guard Checking."}, "A.v\n", "found Unset"),
}


@pytest.mark.parametrize("name", THEORIES)
def test_a_theory_that_is_none(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files, project, message = THEORIES[name]
    monkeypatch.setattr(kernel, "THEORY", tmp_path)
    (tmp_path / "_CoqProject").write_text(project)
    for file, text in files.items():
        (tmp_path / file).write_text(text)
    with pytest.raises(BackendError, match=message):
        theory_files()


def test_the_theory_that_ships() -> None:
    """Every file of the folder is in the list, and what it requires of its own stands before it."""
    files = theory_files()
    assert {path.name for path in kernel.THEORY.glob("*.v")} == set(files)
    before: set[str] = set()
    for name, data in files.items():
        for words in re.findall(r"^(?:.*\. )?Require Import ([\w ]+)\.", data.decode(), re.M):
            if f"From Coq Require Import {words}" not in data.decode() and "Coq" not in words:
                assert set(words.split()) <= before, name
        before.add(name.removesuffix(".v"))


def test_the_hash_is_that_of_sha256sum(tmp_path: Path) -> None:
    files = {"B.v": b"one", "A.v": b"two"}
    write_folder(tmp_path, files)
    done = subprocess.run("sha256sum B.v A.v | sha256sum", shell=True, cwd=tmp_path, capture_output=True, check=True)
    assert done.stdout.decode().split()[0] == theory_sha256(files)


# Coq itself

needs_coq = pytest.mark.skipif(shutil.which("coqc") is None, reason="needs coqc")


@pytest.mark.slow
@needs_coq
def test_the_axioms_are_those_that_coq_prints(tmp_path: Path) -> None:
    """Of a lemma about each function in intervals of primitive floats, and of one that rests on more."""
    (tmp_path / "A.v").write_text(
        "From Coq Require Import Reals.\nFrom Interval Require Import Tactic.\nOpen Scope R_scope.\nTheorem a : "
        "exp 1 <= 3 /\\ sin 1 <= 0.9 /\\ atan 1 <= 0.8 /\\ sqrt 2 <= 1.5 /\\ ln 2 <= 0.7 /\\ cos 1 <= 0.6.\n"
        "Proof. repeat split; interval. Qed.\n"
        "Axiom more : False.\nTheorem b : 1 = 2. destruct more. Qed.\nTheorem c : True. exact I. Qed.\n"
        "Unset Guard Checking.\nFixpoint d (n : nat) : False := d n.\n"
    )
    found = {}
    for name in "abcd":
        (tmp_path / f"{name.upper()}0.v").write_text(f"Require A.\nPrint Assumptions A.{name}.\n")
    coqc = find_coqc()
    subprocess.run([coqc.path, "-q", "A.v"], cwd=tmp_path, check=True, capture_output=True)
    for name in "abcd":
        done = subprocess.run([coqc.path, "-q", f"{name.upper()}0.v"], cwd=tmp_path, check=True, capture_output=True)
        found[name] = axioms_in(done.stdout.decode())
    assert found["a"] is not None and len(found["a"]) > 40 and set(found["a"]) <= AXIOMS
    assert found["b"] is not None and set(found["b"]) - AXIOMS == {"A.more"}
    assert found["c"] == () and found["d"] is None


@pytest.mark.slow
@needs_coq
def test_coq_takes_its_own_folders_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Others of the same names may be where Coq looks as well, as the folder of an earlier proof in COQPATH, where it
    looks first by itself: compiled ones come after its own, and half compiled ones that are newer are an error."""
    coqc, files = (
        find_coqc(),
        {
            "Spec.v": b"Definition claim := 1 = 2.",
            "Proof.v": b"Require Spec.\nTheorem proved : Spec.claim.\nexact I.\nQed.",
            "Assumptions.v": ASSUMPTIONS.encode(),
        },
    )
    other = files | {"Spec.v": b"Definition claim := True."}
    assert compile_apart(coqc, other, 60).axioms == ()
    (tmp_path / "Spec.v").write_bytes(other["Spec.v"])
    monkeypatch.setenv("COQPATH", str(tmp_path))
    for flag, reason in (("-q", 'expected to have type "Spec.claim"'), ("-vio", "several-object-files")):
        subprocess.run([coqc.path, flag, "Spec.v"], cwd=tmp_path, check=True, capture_output=True)
        for compiled in tmp_path.glob("Spec.v*o"):
            os.utime(compiled, (2**31, 2**31))
        found = compile_apart(coqc, files, 60)
        assert found.axioms is None and "refuses Proof.v" in found.reason and reason in found.reason
        (tmp_path / "Spec.vo").unlink(missing_ok=True)
    write_folder(tmp_path / "out", files)
    done = subprocess.run(["sh", str(tmp_path / "out" / "check.sh")], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "several-object-files" in done.stderr


needs_theory = pytest.mark.skipif(not (kernel.THEORY / "Soundness.v").exists(), reason="needs the whole theory")


@pytest.mark.slow
@needs_coq
@needs_theory
def test_coq_proves_the_pendulum(tmp_path: Path) -> None:
    result = prove_in_coq(raw(pendulum()), tmp_path)
    assert result.verdict is Verdict.PROVED, result.reason
    assert set(result.axioms) <= AXIOMS and result.boxes <= 140


FORGERIES = {  # in the evidence: what is written, what is put there
    "a core that is too large": (r"(core_widths : list float := \[)[^\]]*\]", r"\g<1>0x1p+0%float; 0x1p+0%float]"),
    "a root box that is too small": (r"(half_widths : list float := \[)[^\]]*\]", r"\g<1>0x1p-1%float; 0x1p-1%float]"),
    "another inverse": (r"(inverse : list \(list rational\) := \[\s*\[)Ratio \S+ \S+", r"\g<1>Ratio 1 7;"),
    "no partition": (r"(partition : tree :=).*?(\n\n)", r"\1 Leaf 0x0p+0%float.\2"),
    "a negative multiplier": (r"Leaf 0x1[^%]*%float", "Leaf (-0x1p-1)%float"),
}


@pytest.mark.slow
@needs_coq
@needs_theory
def test_coq_refuses_forgeries(tmp_path: Path) -> None:
    """Of the evidence, and a claim that is false whatever leads its proof."""
    coqc = find_coqc()
    result = prove_in_coq(raw(pendulum()), tmp_path, CoqOptions(run=False))
    assert result.boxes
    names = (tmp_path / "_CoqProject").read_text().split()
    claim, evidence = ((tmp_path / name).read_text() for name in ("Claim.v", "Evidence.v"))
    theory = len(theory_files())
    for name in names[:theory]:
        subprocess.run([coqc.path, "-q", name], cwd=tmp_path, check=True, capture_output=True)
    forged = {name: (claim, re.sub(*edit, evidence, count=1, flags=re.S)) for name, edit in FORGERIES.items()}
    higher = re.sub(r"(level : dyadic := )Dyadic \S+ \S+\.", r"\1Dyadic 3 0.", claim)
    forged["a level that reaches out of the domain"] = (higher, evidence)
    forged["another plant"] = (claim.replace("Ratio 981 50", "Ratio 9810 50"), evidence)
    forged["another policy"] = (claim.replace("Channel (Dyadic 3 1)", "Channel (Dyadic (-3) 1)"), evidence)
    for name, (one, other) in forged.items():
        assert (one, other) != (claim, evidence), name
        files = {"Claim.v": one, "Evidence.v": other, "Proof.v": (tmp_path / "Proof.v").read_text()}
        write_folder(tmp_path, {file: text.encode() for file, text in files.items()})
        compiled = compile_folder(coqc, tmp_path, list(files), 120)
        assert compiled.axioms is None and "refuses Proof.v" in compiled.reason, (name, compiled.reason)
    write_folder(tmp_path, {"Claim.v": claim.encode(), "Evidence.v": evidence.encode()})


def test_the_theory_is_not_written_over() -> None:
    before = (THEORY / "_CoqProject").read_bytes()
    with pytest.raises(InputError, match="another than the theory's own"):
        write_folder(THEORY, {"Claim.v": b""})
    assert (THEORY / "_CoqProject").read_bytes() == before and not (THEORY / "Claim.v").exists()
