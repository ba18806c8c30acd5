"""The command line `controllers`: its commands, whose bodies are the files of `controllers.commands`.

Standard output carries the result, or exactly one JSON object with `--json`; progress goes to standard
error. Exit status: 0 done, 2 bad usage or input, 70 internal error; 130 after Ctrl-C or SIGTERM, 141 after a closed
pipe.
"""

from __future__ import annotations

import traceback

import typer

from certify.cli.ending import closed_pipe, end_by_sigterm, is_of_closed_pipe
from controllers.commands.compare import compare
from controllers.commands.distil import distil
from controllers.commands.evaluate import evaluate
from controllers.commands.flatten import flatten
from controllers.commands.history import history
from controllers.commands.theory import theory
from controllers.commands.train import train
from controllers.commands.train_baseline import train_baseline

app = typer.Typer(
    help="Train and evaluate the policies that `certify` proves things about.",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.command("train")(train)
app.command("flatten")(flatten)
app.command("distil")(distil)
app.command("evaluate")(evaluate)
app.command("theory")(theory)
app.command("train-baseline")(train_baseline)
app.command("compare")(compare)
app.command("history")(history)


def main() -> None:
    """Entry point of the `controllers` command; a fault of the program itself exits 70."""
    end_by_sigterm()
    try:
        app()
    except SystemExit as stop:
        if not is_of_closed_pipe(stop):
            raise
        raise SystemExit(closed_pipe()) from None
    except BrokenPipeError:
        raise SystemExit(closed_pipe()) from None
    except Exception:
        traceback.print_exc()
        raise SystemExit(70) from None


if __name__ == "__main__":
    main()
