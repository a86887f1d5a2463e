"""The command line: ``acquire COMMAND``. One file per group of commands, one place for errors.

A command prints facts to stdout (``--json`` for programs) and raises what goes wrong; only `main` turns an
AcquireError into words on stderr and an exit code. Heavy libraries are imported inside the commands that
need them, and only the module of the command that is asked for, so that help and status come at once.

What the system refuses (a name too long, a full disk under stdout) becomes words there too; a reader that
goes away ends a command without any.
"""

from __future__ import annotations

import errno
import os
import sys
from typing import TYPE_CHECKING, Any

from acquire.cli.interrupts import interrupts_answered
from acquire.cli.output import json_asked, print_error
from acquire.cli.usage import build, not_installed, run
from acquire.errors import EXIT_INTERRUPTED, AcquireError, DeviceError, UsageError

if TYPE_CHECKING:
    import typer

    app: typer.Typer

HOST_ERRORS = (errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.EMFILE, errno.ENFILE, errno.ENOMEM)
"""What a host runs out of, or fails at, whatever is asked for."""


def __getattr__(name: str) -> Any:
    """``app``: all commands, made when somebody asks for them."""
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return build()


def main() -> int:
    """Entry point; the exit code is `acquire.errors`'."""
    try:
        with interrupts_answered():
            return run(sys.argv[1:])
    except AcquireError as error:
        return _failed(error)
    except ModuleNotFoundError as error:
        return _failed(not_installed(error))
    except OSError as error:
        # What stdout could not take is not tried again, with a traceback, when the interpreter ends.
        try:
            sys.stdout.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
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
