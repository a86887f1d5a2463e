"""The command line: ``acquire COMMAND``. One file per group of commands, one place for errors.

A command prints facts to stdout (``--json`` for programs) and raises what goes wrong; only `main` turns an
AcquireError into words on stderr and an exit code. Heavy libraries are imported inside the commands that
need them, so that help and status come at once.

What the system refuses (a name too long, a full disk under stdout) becomes words there too; a reader that
goes away ends a command without any.
"""

from __future__ import annotations

import os
import sys

import typer

from acquire.cli import (
    bench,
    camera,
    config,
    control,
    demo,
    devices,
    paper,
    reconstruct,
    recordings,
    render,
    replay,
    serve,
    simulate,
    tradeoff,
    trigger,
)
from acquire.cli.output import print_error, say
from acquire.errors import EXIT_INTERRUPTED, AcquireError, UsageError

MODULES = (
    demo,
    serve,
    control,
    recordings,
    reconstruct,
    render,
    simulate,
    paper,
    tradeoff,
    replay,
    config,
    devices,
    trigger,
    camera,
    bench,
)
"""Modules of commands, in the order of the help; each has ``register(app)``. New groups are added here."""

app = typer.Typer(
    name="acquire",
    help="Record and reconstruct with TDI-based compressed video.",
    epilog="Example: [bold]acquire serve --config rig-demo[/], then in another terminal "
    "[bold]acquire arm[/], [bold]acquire start --lines 100000[/]",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)

for module in MODULES:
    module.register(app)


def main() -> int:
    """Entry point; the exit code is `acquire.errors`'."""
    try:
        app()
    except AcquireError as error:
        print_error(error, as_json="--json" in sys.argv)
        return error.exit_code
    except OSError as error:
        _give_up_stdout()
        where = f"{error.filename}: " if error.filename else ""
        refused = UsageError(f"{where}{error.strerror or error}")
        print_error(refused, as_json="--json" in sys.argv)
        return refused.exit_code
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return 0


def _give_up_stdout() -> None:
    """What stdout could not take is not tried again, with a traceback, when the interpreter ends."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@app.callback(invoke_without_command=True)
def _options(
    version: bool = typer.Option(False, "--version", help="Print the version and end."),
) -> None:
    if version:
        from acquire import __version__

        say(__version__)
        raise typer.Exit
