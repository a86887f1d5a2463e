"""``python -m acquire.web.worker COMMAND …``: a command of ours that stands back for everything else.

It gets what the processors leave, is the first to go where memory is short, and ends with who started it; a
step of a calibration is asked to, since it has an instrument to leave as it was.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

from acquire.processes.rank import FIRST, stand_back

_NICE = 19
_PR_SET_PDEATHSIG = 1


def main() -> None:
    stand_back(_NICE, FIRST)
    last = signal.SIGINT if sys.argv[1] == "calibrate" else signal.SIGKILL
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, last, 0, 0, 0)
    os.execv(sys.executable, [sys.executable, "-m", "acquire", *sys.argv[1:]])  # noqa: S606 - ours


if __name__ == "__main__":
    main()
