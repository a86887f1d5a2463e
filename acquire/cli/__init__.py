"""The command line ``acquire COMMAND``: one file per group of commands, one place for errors.

A command prints its results to stdout (``--json`` for programs) and raises exceptions on failure. Only `main`
turns an AcquireError into a message on stderr and an exit code. Only the module of the requested command is
imported, and heavy libraries are imported inside the commands that need them, so that help and status appear
at once.

`main` also reports errors of the operating system (a name that is too long, a full disk behind stdout). If
the reader of a pipe goes away, the command ends without a message. Standard streams that are closed lead to
/dev/null.
"""

from __future__ import annotations

import errno
import os
import sys
from typing import TYPE_CHECKING, Any, TextIO

import acquire
from acquire.cli.interrupts import interrupts_handled
from acquire.cli.output import json_requested, print_error
from acquire.cli.usage import build, not_installed, run
from acquire.errors import EXIT_INTERRUPTED, AcquireError, DeviceError, UsageError

if TYPE_CHECKING:
    import typer

    app: typer.Typer

HOST_ERRORS = (errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.EMFILE, errno.ENFILE, errno.ENOMEM)
"""Errors caused by the host (a resource that ran out, a device that failed) and not by the request."""


_INCOMPLETE = AcquireError(
    "the installation is incomplete: acquire/__init__.py is missing, as after the removal of another "
    "distribution with a package `acquire`, such as acquire-imaging",
    hint="pip install --force-reinstall --no-deps tdi-acquire",
)


def __getattr__(name: str) -> Any:
    """Build ``app``, the Typer application with all commands, on first access."""
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return build()


def main() -> int:
    """Run the command line and return the exit code defined in `acquire.errors`."""
    # If a standard stream is missing, the next file to be opened, such as a recording's, would get the
    # descriptor to which every library prints.
    for fd, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            # It gets the lowest free descriptor: this one, unless something has been opened as it already.
            nowhere = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(nowhere, True)  # child processes need the streams, too
            setattr(sys, name, os.fdopen(nowhere, "w" if fd else "r", encoding="utf-8"))
    code = _carry_out() if acquire.__file__ else _failed(_INCOMPLETE)
    # Otherwise the interpreter would try to write the rest at exit, fail, and change the exit code.
    _is_full(sys.stderr)
    return code


def _carry_out() -> int:
    try:
        with interrupts_handled():
            return run(sys.argv[1:])
    except AcquireError as error:
        return _failed(error)
    # Extras are imported where they are needed: a missing one shows only now.
    except ModuleNotFoundError as error:
        return _failed(not_installed(error))
    except OSError as error:
        return _refused_by_the_system(error)
    # Without a message: `interrupts_handled` has acknowledged it.
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    # A defect: with its traceback, and with the name of whoever can mend it, if that is not us.
    except Exception as error:
        # In the body of a class, Python before 3.12 makes a RuntimeError of Ctrl-C, as during imports.
        if isinstance(error.__cause__, KeyboardInterrupt):
            return EXIT_INTERRUPTED
        from acquire.plugins import raised_by

        if module := raised_by(error):
            error.add_note(f"This error arose in a plug-in: {module}.")
        raise


def _refused_by_the_system(error: OSError) -> int:
    full = _is_full(sys.stdout)
    # As other programs end in `acquire ls | head`.
    if error.errno == errno.EPIPE:
        return 1
    if error.errno == errno.ENOENT and error.filename is None and not _is_somewhere():
        return _failed(
            UsageError("the current directory does not exist any more", hint="cd to a directory that exists")
        )
    where = error.filename or ("standard output" if full else "")
    kind = DeviceError if error.errno in HOST_ERRORS else UsageError
    text = f"{where}: {error.strerror or error}".removeprefix(": ")
    from acquire.plugins import raised_by

    module = raised_by(error)
    return _failed(kind(f"{module}: {text}" if module else text))


def _is_somewhere() -> bool:
    """Whether there is a current directory: it may have been removed since the shell entered it."""
    try:
        os.getcwd()  # noqa: PTH109
    except FileNotFoundError:
        return False
    return True


def _is_full(stream: TextIO) -> bool:
    """Whether a stream does not take what is left to be written; it then leads to /dev/null."""
    try:
        stream.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        return True
    return False


def _failed(error: AcquireError) -> int:
    # By the words themselves: the error may be that they cannot be parsed.
    print_error(error, as_json=json_requested())
    return error.exit_code
