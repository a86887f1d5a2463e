"""The command line: ``acquire COMMAND``. One file per group of commands, one place for errors.

A command prints facts to stdout (``--json`` for programs) and raises what goes wrong; only `main` turns an
AcquireError into words on stderr and an exit code. Heavy libraries are imported inside the commands that
need them, so that help and status come at once.

What the system refuses (a name too long, a full disk under stdout) becomes words there too; a reader that
goes away ends a command without any.
"""

from __future__ import annotations

import errno
import os
import sys

import typer

from acquire.cli import (
    bench,
    calibrate,
    camera,
    config,
    control,
    demo,
    devices,
    diagnose,
    doctor,
    export,
    import_lines,
    install_service,
    paper,
    plugins,
    reconstruct,
    recordings,
    render,
    replay,
    serve,
    simulate,
    tradeoff,
    trigger,
    web,
)
from acquire.cli.interrupts import interrupts_answered
from acquire.cli.output import json_asked, print_error, say
from acquire.cli.usage import not_installed, run
from acquire.errors import EXIT_INTERRUPTED, AcquireError, DeviceError, UsageError

MODULES = (
    demo,
    serve,
    web,
    control,
    recordings,
    reconstruct,
    diagnose,
    render,
    export,
    import_lines,
    simulate,
    paper,
    tradeoff,
    replay,
    config,
    devices,
    doctor,
    plugins,
    install_service,
    trigger,
    camera,
    calibrate,
    bench,
)
"""Modules of commands, in the order of the help; each has ``register(app)``. New groups are added here."""

HOST_ERRORS = (errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.EMFILE, errno.ENFILE, errno.ENOMEM)
"""What a host runs out of, or fails at, whatever is asked for."""

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
        with interrupts_answered():
            return run(app)
    except AcquireError as error:
        return _failed(error)
    except ModuleNotFoundError as error:
        return _failed(not_installed(error))
    except OSError as error:
        _give_up_stdout()
        if error.errno == errno.EPIPE:
            return 1
        return _failed(_refused(error))
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED


def _failed(error: AcquireError) -> int:
    print_error(error, as_json=json_asked())
    return error.exit_code


def _refused(error: OSError) -> AcquireError:
    """What the system refuses: a path or a right is the user's matter, all else is the host's."""
    where = f"{error.filename}: " if error.filename else ""
    kind = DeviceError if error.errno in HOST_ERRORS else UsageError
    return kind(f"{where}{error.strerror or error}")


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
