"""Cost of a long range: seconds and the largest memory of any process, by the length of the stream.

Usage: python tools/bench_segments.py [--lines 1000 4000] [--iterations 10]

Scene #1 at N_m = 3, T_m = 1, in sub-segments on all cores. Memory is bounded by a sub-segment, so its peak
must not grow with the length; seconds must grow no faster than it.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import tempfile
import time
from pathlib import Path

from acquire.config import load_rig, load_scene
from acquire.recon.segments import Voxels
from acquire.reconstruct import Monitor, Options, by_lines, combine, in_voxels, open_pool
from acquire.simulate import simulate
from acquire.store import open_recording
from tools.results import add_option, recorded


def measure(path: Path, lines: int, iterations: int, answer: multiprocessing.queues.Queue) -> None:
    """Reconstruct the first lines; seconds, sub-segments, and peak MB of this process and of its workers."""
    recording = open_recording(path)
    request = in_voxels(by_lines(recording, 0, lines), Voxels(3, 1))
    tasks = len(request.stretches)
    monitor, began = Monitor(tasks), time.perf_counter()
    with open_pool(tasks, watch=monitor) as pool:
        options, out = Options(iterations=iterations), path.with_name(f"{lines}.zarr")
        combine(recording, request, out, options=options, pool=pool, monitor=monitor)
    seconds = time.perf_counter() - began
    peaks = [
        resource.getrusage(who).ru_maxrss / 1024 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    ]
    answer.put((seconds, tasks, *peaks))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--lines", type=int, nargs="+", default=[1000, 4000])
    parser.add_argument("--iterations", type=int, default=10)
    add_option(parser)
    options = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as directory, recorded("bench_segments", keep=options.record) as run:
        path = Path(directory) / "stream.zarr"
        simulate(load_rig("rig-demo"), load_scene("scene-leds"), path, max(options.lines))
        print(f"{'lines':>8}{'frames/s':>10}{'pieces':>8}{'s':>8}{'MB here':>9}{'MB worker':>11}")
        for lines in options.lines:
            answer = context.Queue()
            process = context.Process(target=measure, args=(path, lines, options.iterations, answer))
            process.start()
            seconds, tasks, here, worker = answer.get()
            process.join()
            print(f"{lines:8}{3 * lines / seconds:10.0f}{tasks:8}{seconds:8.1f}{here:9.0f}{worker:11.0f}")
            run.add(
                f"{lines} lines",
                frames_per_s=3 * lines / seconds,
                pieces=tasks,
                s=seconds,
                peak_here_mb=here,
                peak_worker_mb=worker,
            )


if __name__ == "__main__":
    main()
