"""``python -m acquire.web.worker COMMAND …``: run an `acquire` command at the lowest priority.

It gets only idle processor time, is the first to be killed when memory is short, and ends with the process
that started it. A calibration step is interrupted rather than killed, so that it can leave the instrument as
it was.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

from acquire.processes.rank import FIRST, stand_back

_NICE = 19
_PR_SET_PDEATHSIG = 1
OWNER = "ACQUIRE_OWNER"
"""Environment variable with the process number of the page; absent: whoever has started this process."""


def main() -> None:
    """Become the command in the arguments, which ends with the page that started this process."""
    stand_back(_NICE, FIRST)
    # The page may be killed, and then nobody else ends its jobs.
    final_signal = signal.SIGINT if sys.argv[1] == "calibrate" else signal.SIGKILL
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, final_signal, 0, 0, 0)  # holds beyond execv
    # Its death before this call is not reported any more, but has given this process another parent.
    if os.getppid() != int(os.environ.get(OWNER, os.getppid())):
        return
    # In this process, whose number the page has: its signals reach the command itself.
    os.execv(sys.executable, [sys.executable, "-m", "acquire", *sys.argv[1:]])  # noqa: S606 - ourselves


if __name__ == "__main__":
    main()
