"""``python -m acquire`` and the command ``acquire``: the command line, and the end of its process."""

import atexit
import contextlib
import os
import sys

from acquire.cli import main


def run() -> None:
    """Run the command line and end the process with its exit code."""
    codes: list[int] = []
    # Before anything else is registered, so that it is called after all of that.
    atexit.register(_leave, codes)
    codes.append(main())
    sys.exit(codes[0])


def _leave(codes: list[int]) -> None:
    """End the process without finalizing the interpreter, if obstore is loaded.

    Its threads may still let go of a Python object after the last result has arrived. In a finalizing
    interpreter that aborts the process: 5 of 285 uploads beside a busy neighbour, all of them complete, ended
    by SIGABRT instead of exit code 0.
    """
    if codes and "obstore" in sys.modules:
        for stream in (sys.stdout, sys.stderr):
            # `main` has reported what cannot be written
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        os._exit(codes[0])


if __name__ == "__main__":
    run()
