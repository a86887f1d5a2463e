"""A program that records until it is killed: ``doomed_owner.py PATH`` prints its processes' numbers."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

from wired_devices import make_bench, make_spec

from acquire.stream import Begin, Capture


def main(path: Path) -> None:
    bench = make_bench()
    capture = Capture(bench.plan, bench.trigger)
    capture.arm()
    capture.start(Begin(path, make_spec()))
    while capture.poll().committed_lines < 2000:
        time.sleep(0.005)
    sys.stdout.write(json.dumps(capture.pids) + "\n")
    sys.stdout.flush()
    time.sleep(600)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
