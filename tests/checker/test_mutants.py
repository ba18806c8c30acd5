"""The attack on the checker: thousands of mutants of real certificates, and what each rule is needed for.

A mutant counts if `claim_oracle.py`, which shares no code with the checker, finds that it is malformed, that an exact
rule fails, that the claim is false at a point, or that a leaf or the local ball cannot support it; or, where points
show nothing, if the reference finds the evidence incomplete. Each that counts must be refused, by the rule named
beforehand. The others may be accepted.
"""

from __future__ import annotations

import importlib
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from certify.checker import document, rules
from certify.checker.errors import Rejected
from tests.support.ablation import checker_without
from tests.support.balls import with_ball
from tests.support.certificates import edited
from tests.support.claim_oracle import EXACT, faults, read
from tests.support.marks import slow_after
from tests.support.mutants import (
    BASES,
    FAMILIES,
    PRACTICAL,
    Mutant,
    base,
    dump,
    family,
    practical,
    practical_base,
    true_edits,
)
from tests.support.reference import judge, judge_bytes

ORDER = ("format", "hash", "levels", "lyapunov", "equilibrium", "domain", "coordinates", "root", "centring", "local",
         "tree", "ring", "inputs")  # fmt: skip
EVIDENCE = ("local", "ring", "inputs")

# family -> how many of its mutants count at least, and the rules by which they are refused
CAMPAIGN: dict[str, tuple[int, tuple[str, ...]]] = {
    "bits_of_the_policy": (150, ("format", "hash")),
    "hash_of_the_policy": (80, ("hash",)),
    "bits_of_the_policy_hashed": (80, EVIDENCE),
    "policies_rebuilt": (140, ("centring", *EVIDENCE)),
    "centring": (80, ("centring",)),
    "level_values": (100, ("levels",)),
    "claims_too_strong": (100, ("domain", "root", *EVIDENCE)),
    "lyapunov": (160, ("lyapunov",)),
    "other_lyapunov_functions": (40, ("local", "root", "domain")),
    "coordinates": (140, ("coordinates",)),
    "skewed_coordinates": (5, ("coordinates",)),
    "other_coordinates": (55, ("root", "ring")),
    "root_boxes": (130, ("root", "ring", "inputs")),
    "trees": (280, ("tree",)),
    "coarser_trees": (75, ("ring",)),
    "plants": (190, ("equilibrium", "local", "ring")),
    "domains": (180, ("domain",)),
    "input_bounds": (130, ("inputs",)),
    "numbers": (580, ("format",)),
    "structure": (560, ("format",)),
    "raw_bytes": (280, ("format",)),
    "sizes": (36, ("format", "tree")),
    "solvers": (20, ("format", "hash", "levels", "lyapunov", "equilibrium", "domain", "centring")),
    "holes": (20, ("root", "tree")),
    "grown_for_false_claims": (17, ("ring", "inputs")),
    "clips": (60, ("format", "hash", "centring", *EVIDENCE)),
}  # fmt: skip


@dataclass(frozen=True)
class Judged:
    """What the checker said, and what the oracle found."""

    verdict: str
    found: dict[str, str]


def verdict_on(path: Path, package_document: ModuleType = document, package_rules: ModuleType = rules) -> str:
    """What `python -m certify.checker` does with the file: `ACCEPTED`, `TRUSTED`, or the rule that failed."""
    try:
        certificate = package_document.read(str(path))
        package_rules.check(certificate)
    except Rejected as no:
        return no.rule
    trusted = importlib.import_module(f"{package_document.__package__}.sections").Trusted
    return "TRUSTED" if isinstance(certificate.evidence, trusted) else "ACCEPTED"


def judged(one: Mutant, path: Path) -> Judged:
    one.write(path)
    verdict = verdict_on(path)
    found = faults(path, one.hints)
    if not found and verdict not in ("ACCEPTED", "TRUSTED"):
        rule = judge(read(path))
        found = {rule: "the reference"} if rule not in (None, "TRUSTED") else {}
    return Judged(verdict, found)


def objections(one: Mutant, result: Judged) -> list[str]:
    """What is wrong with the checker's verdict on a mutant that counts; empty if nothing is."""
    verdict, found = result.verdict, result.found
    exact = [rule for rule in EXACT if rule in found]
    # the first exact rule that fails is the one to be named, unless a sampled one comes before it
    if verdict in one.rules and (not exact or exact[0] in (verdict, "tree")):
        return []
    return [f"{one.name}: {verdict} in place of {sorted(one.rules)}; {found}"]


def test_the_campaign_is_large_enough_and_meets_every_rule() -> None:
    assert set(CAMPAIGN) == set(FAMILIES)
    assert sum(count for count, _ in CAMPAIGN.values()) >= 3000
    assert sum(count for count, met in CAMPAIGN.values() if "format" not in met) >= 1500
    assert {rule for _, met in CAMPAIGN.values() for rule in met} == set(ORDER)


@pytest.mark.parametrize("name", BASES)
def test_the_originals_are_accepted(name: str, tmp_path: Path) -> None:
    result = judged(Mutant(name, base(name), frozenset()), tmp_path / "certificate.json")
    assert result == Judged("ACCEPTED", {})
    assert judge(base(name)) is None


@pytest.mark.parametrize("share", slow_after(1, [24, 1]), ids=["a twenty-fourth", "all"])
@pytest.mark.parametrize("name", FAMILIES)
def test_mutants_that_count_are_refused_by_the_expected_rule(name: str, share: int, tmp_path: Path) -> None:
    least, met = CAMPAIGN[name]
    path = tmp_path / "mutant.json"
    wrong, refused_by, accepted = [], [], []
    for one in family(name)[::share]:
        result = judged(one, path)
        if result.found:
            wrong += objections(one, result)
            refused_by.append(result.verdict)
        elif result.verdict == "ACCEPTED":
            accepted.append(one)
    assert not wrong, "\n".join([f"{len(wrong)} of {len(refused_by)}", *wrong])
    assert len(refused_by) >= least // share
    assert set(refused_by) >= set(met) if share == 1 else set(refused_by) & set(met)
    # what was accepted is true at every point that was looked at; the reference sees a few of them through
    chosen = np.random.default_rng(0).permutation(len(accepted))[:4]
    assert [accepted[k].name for k in chosen if judge(read(accepted[k].write(path))) is not None] == []


def test_names_are_used_once() -> None:
    names = [one.name for name in ("trees", "structure", "lyapunov", "domains") for one in family(name)]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("name", slow_after(4, sorted(BASES, key=lambda name: "rotor" in name)))
def test_true_edits_are_accepted(name: str, tmp_path: Path) -> None:
    """What is true and fully evidenced, by the oracle and the reference, stays accepted."""
    edits = [one for one in true_edits() if one.name.startswith(f"{name}: ")]
    assert len(edits) >= 18
    path = tmp_path / "edit.json"
    for one in edits:
        assert one.raw != dump(base(name)), one.name
        assert judged(one, path) == Judged("ACCEPTED", {}), one.name
        assert name == "pendulum" or judge(read(path)) is None, one.name


def test_a_solvers_word_is_never_accepted(tmp_path: Path) -> None:
    path = Mutant("trusted", base("trusted"), frozenset()).write(tmp_path / "trusted.json")
    assert verdict_on(path) == "TRUSTED" and judge(base("trusted")) == "TRUSTED"
    for name in BASES:
        data = {**base(name), "evidence": base("trusted")["evidence"]}
        assert verdict_on(Mutant(name, data, frozenset()).write(path)) == "TRUSTED"


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads the peak of the resident set")
def test_no_size_takes_a_gigabyte(tmp_path: Path) -> None:
    paths = [str(one.write(tmp_path / f"{k}.json")) for k, one in enumerate(family("sizes"))]
    code = (
        "import sys; from certify.checker.__main__ import main\n"
        "assert all(main([p]) == 1 for p in sys.argv[1:])\n"
        "print(next(l for l in open('/proc/self/status') if l.startswith('VmHWM')).split()[1])"
    )
    done = subprocess.run([sys.executable, "-I", "-c", code, *paths], capture_output=True, text=True, check=True)
    assert int(done.stdout.split()[-1]) < 2**20  # KiB


# ------------------------------------------------------------------------------------------------------ another claim


@pytest.mark.parametrize("name", PRACTICAL)
def test_honest_practical_certificates_are_accepted(name: str, tmp_path: Path) -> None:
    """The origin is no equilibrium of any of them."""
    path = Mutant(name, practical_base(name), frozenset()).write(tmp_path / "certificate.json")
    assert (verdict_on(path), faults(path), judge(read(path))) == ("ACCEPTED", {}, None)
    tally = rules.check(document.read(str(path)))
    assert tally.rules["equilibrium"] == tally.rules["local"] == 0 and tally.margins["local"] is None
    assert tally.rules["tree"] >= tally.rules["ring"] > 0
    kind, levels = practical_base(name)["claim"]["kind"], practical_base(name)["levels"]
    asymptotic = edited(practical_base(name), "claim.kind", "asymptotic")
    asymptotic["levels"] = {key: levels[key] for key in ("local", "roa")}
    assert kind == "practical"
    assert verdict_on(Mutant(name, asymptotic, frozenset()).write(path)) == "format"  # a ball is missing
    asymptotic = with_ball(asymptotic)
    assert verdict_on(Mutant(name, asymptotic, frozenset()).write(path)) in ("equilibrium", "centring")


def test_forged_practical_certificates_are_refused_by_the_expected_rule_in_both(tmp_path: Path) -> None:
    """Each is shown to be false, malformed or incomplete without the checkers."""
    path, wrong, met, count = tmp_path / "mutant.json", [], set(), 0
    for one in practical():
        verdict, found = verdict_on(one.write(path)), faults(path, one.hints)
        count += 1
        met.add(verdict)
        second = judge_bytes(path.read_bytes())
        if not {verdict, second} <= one.rules or not found:
            wrong.append(f"{one.name}: {verdict} and {second} in place of {sorted(one.rules)}; {found}")
    assert not wrong, "\n".join([f"{len(wrong)} of {count}", *wrong])
    assert count >= 100
    assert met == set(ORDER) - {"equilibrium", "local"}


# ------------------------------------------------------------------------------------- each rule is there for a reason


@cache
def candidates(rule: str) -> tuple[Mutant, ...]:
    """The mutants that the rule is expected to refuse; of families that this rule refuses alone, first."""
    names = sorted((name for name in CAMPAIGN if rule in CAMPAIGN[name][1]), key=lambda name: len(CAMPAIGN[name][1]))
    return tuple(one for name in names for one in family(name) if rule in one.rules)


@pytest.mark.parametrize("rule", ORDER)
def test_without_the_rule_a_mutant_gets_through(rule: str, tmp_path: Path) -> None:
    path = tmp_path / "mutant.json"
    with checker_without(rule, tmp_path) as package:
        for one in candidates(rule):
            if not accepted_by(package, one.write(path)):
                continue
            result = judged(one, path)
            if result.found and result.verdict == rule:
                return
    raise AssertionError(f"{rule} is dead: without it none of {len(candidates(rule))} mutants is accepted")


def accepted_by(package: ModuleType, path: Path) -> bool:
    """Another rule's refusal, or a stumble over what the missing rule would have kept away, is no acceptance."""
    try:
        certificate = package.document.read(str(path))
        package.rules.check(certificate)
    except Exception:
        return False
    return isinstance(certificate.evidence, package.document.Partition)


# -------------------------------------------------------------------------------------------------------- the long run


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_the_reference_refuses_what_counts_and_accepts_what_is_accepted(name: str, tmp_path: Path) -> None:
    path = tmp_path / "mutant.json"
    against = []
    for one in family(name):
        result = judged(one, path)
        if set(result.found) & {"format"}:
            continue  # most are no document at all
        rule = judge(read(path))
        if result.found and rule is None:
            against.append(f"{one.name}: {result.found}, the reference accepts it")
        if result.verdict == "ACCEPTED" and rule is not None:
            against.append(f"{one.name}: accepted, the reference refuses it by {rule}")
    assert not against, "\n".join(against)


@pytest.mark.slow
def test_mutants_of_the_largest_certificate(tmp_path: Path) -> None:
    path = tmp_path / "cartpole.json"
    assert judged(Mutant("cartpole", base("cartpole"), frozenset()), path) == Judged("ACCEPTED", {})
    for one in family("cartpole"):
        result = judged(one, path)
        assert result.found and not objections(one, result), (one.name, result)
