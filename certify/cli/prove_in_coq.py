"""`certify prove-in-coq`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.cli.shared import Json, Quiet
from certify.cli.terminal import say, show, tell

if TYPE_CHECKING:
    from certify.certificates.coq.proving import CoqResult


def prove_in_coq(
    certificate: Annotated[Path, typer.Argument(help="Certificate file.")],
    out: Annotated[Path, typer.Option(help="Folder for Coq's files: theory, claim, proof, and check.sh.")],
    rate: Annotated[
        str | None,
        typer.Option(metavar="P/Q", help="Rate at which V must fall; default: a small one that costs little."),
    ] = None,
    time_limit: Annotated[float, typer.Option(help="Seconds for the search and Coq together.")] = 600.0,
    boxes: Annotated[int, typer.Option(min=1, help="Most boxes of the partition.")] = 20_000,
    no_run: Annotated[bool, typer.Option("--no-run", help="Only write Coq's files.")] = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Prove a certificate's claim again in the Coq proof assistant, which trusts nothing of this program."""
    from certify.certificates import read_raw
    from certify.certificates.coq.proving import CoqOptions, prove_in_coq
    from certify.loop.plants import exact

    options = CoqOptions(None if rate is None else exact(rate, "--rate"), time_limit, boxes, not no_run)
    result = prove_in_coq(read_raw(certificate), out, options, None if quiet or as_json else tell)
    if as_json:
        say(json.dumps(_plain(result)))
    else:
        _print(result)
    raise typer.Exit(result.verdict.exit_status)


def _plain(result: CoqResult) -> dict[str, Any]:
    from dataclasses import asdict

    folder = None if result.folder is None else str(result.folder)
    return asdict(result) | {"verdict": result.verdict.value, "rate": str(result.rate), "folder": folder}


def _by_module(axioms: tuple[str, ...]) -> str:
    """Describe the axioms in words, then list them, one line per module.

    >>> print(_by_module(("PrimFloat.sub", "Classical_Prop.classic", "PrimFloat.add")))
    those of Coq's real numbers; the processor's floats and integers are as Coq's libraries say
    Classical_Prop: classic
    PrimFloat: add sub
    """
    from certify.certificates.coq.kernel import MODULES, REALS

    names: dict[str, list[str]] = {}
    for axiom in sorted(axioms, key=lambda axiom: (MODULES.index(axiom.rpartition(".")[0]), axiom)):
        module, _, name = axiom.rpartition(".")
        names.setdefault(module, []).append(name)
    kinds = {
        "those of Coq's real numbers": any(module in REALS for module in names),
        "the processor's floats and integers are as Coq's libraries say": any(module not in REALS for module in names),
    }
    said = "; ".join(kind for kind, there in kinds.items() if there) or "none"
    return "\n".join([said, *(f"{module}: {' '.join(of)}" for module, of in names.items())])


def _print(result: CoqResult) -> None:
    from rich.table import Table
    from rich.text import Text

    from certify.certificates.verdict import Verdict
    from certify.report.words import below

    if result.verdict is Verdict.PROVED:
        shown = f"{{V <= {below(result.level)}}} is invariant, and V decays at the rate {result.rate}"
        say(f"PROVED IN COQ  {result.plant}: {shown}")
    else:
        say(f"{result.verdict.value}  {result.plant}: {result.reason}")
    rows = {
        "certificate": result.certificate_sha256,
        "its policy": result.policy_sha256,
        "theory": result.theory_sha256,
        "partition": f"{result.boxes} boxes, {result.looked_at} looked at" if result.boxes else "",
        "axioms": _by_module(result.axioms) if result.verdict is Verdict.PROVED else "",
        "time": f"search {result.search_seconds:.2f} s" + (f", Coq {result.coq_seconds:.1f} s" if result.coq else ""),
        "Coq": result.coq or "",
        "files": "" if result.folder is None else str(result.folder),
    }
    table = Table.grid(padding=(0, 2))
    for name, value in rows.items():
        if value:
            table.add_row(Text(name), Text(value))
    say("")
    show(table)
