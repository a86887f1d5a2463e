"""Time a reconstruction alone and beside programs that use the cores.

    python -m tools.bench_neighbours [--stages 32 64] [--busy 0 1 2] [--record]

Wall and processor seconds of the same reconstruction, without a budget: as it is (one thread of BLAS, the
arms side by side), and for comparison with as many threads of BLAS as there are cores. The neighbours are
busy loops that begin before it, one process each.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING
from unittest.mock import patch

from acquire.cores import limit_blas, usable_cores
from acquire.recon import api, band, reconstruct
from acquire.sim.procedural import record
from tools.results import add_option, recorded

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.lines import Segment

SCENE, SEED = "flicker", 53
LINES_PER_STAGE = 4


@contextmanager
def neighbours(count: int) -> Iterator[None]:
    """So many busy loops, until the end."""
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


@contextmanager
def blas_on_all_cores() -> Iterator[None]:
    """Threads of BLAS in place of the arms side by side, whatever else runs."""
    with ExitStack() as stack:
        stack.enter_context(patch.object(api, "idle_cores", usable_cores))
        stack.enter_context(patch.object(api, "limit_blas", lambda _: limit_blas(usable_cores())))
        stack.enter_context(patch.object(band, "granted_threads", lambda: 1))
        yield


def seconds(segment: Segment) -> tuple[float, float]:
    """Wall and processor seconds of a reconstruction."""
    wall, processor = time.monotonic(), time.process_time()
    reconstruct(segment, 3, 1, "fast", check=False, error=False)
    return time.monotonic() - wall, time.process_time() - processor


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--stages", nargs="+", type=int, default=[32, 64])
    parser.add_argument("--busy", nargs="+", type=int, default=[0, 1, 2], help="numbers of neighbours")
    add_option(parser)
    options = parser.parse_args()
    print("stages  busy programs  as it is: wall, processor s   BLAS on all cores: wall, processor s")
    with recorded("bench_neighbours", keep=options.record) as run:
        for stages in options.stages:
            segment = record(SCENE, SEED, stages=stages, lines=LINES_PER_STAGE * stages).segment
            seconds(segment)  # compile, load
            for count in options.busy:
                with neighbours(count):
                    ours = seconds(segment)
                    with blas_on_all_cores():
                        theirs = seconds(segment)
                figures = "  ".join(f"{wall:16.1f} {processor:8.1f}" for wall, processor in (ours, theirs))
                print(f"{stages:6}  {count:13}  {figures}", flush=True)
                run.add(
                    f"{stages} stages beside {count} busy programs",
                    wall_s=ours[0],
                    processor_s=ours[1],
                    wall_s_with_blas_threads=theirs[0],
                    processor_s_with_blas_threads=theirs[1],
                )


if __name__ == "__main__":
    main()
