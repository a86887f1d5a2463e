"""Cost of a solver's iterations by device, dtype and BLAS threads: Fig. 9, the same code everywhere.

Usage: python -m tools.bench_devices [--devices cpu gpu] [--dtypes float32 float64] [--threads 1 2]

All cases run in turn, three times, and the best of each counts: wall-clock and processor time, also as a
multiple of the first case. PSNR is that after these few iterations: it shows the effect of the dtype on the
video, not the final quality. Only the iterations differ between devices; lines are made on the host.
"""

from __future__ import annotations

import argparse
import itertools
import time
from typing import Any

from acquire.arrays import DEVICES, DTYPES
from acquire.cores import idle_cores, limit_blas, usable_cores
from acquire.evaluate.metrics import psnr
from acquire.recon import reconstruct
from acquire.sim.voxels import truth
from tools.bench_reconstruct import CASES, record
from tools.results import Run, add_option, recorded

ITERATIONS = {"admm": 30, "twist-band": 20, "twist": 8}
BANDWIDTH = 0.13
ROUNDS = 3


def measure(segment: Any, solver: str, device: str, dtype: str, threads: int) -> tuple[float, float, Any]:
    """Wall-clock and processor time of a whole call, and its result."""
    began, busy = time.perf_counter(), time.process_time()
    with limit_blas(threads):
        result = reconstruct(
            segment,
            *CASES["fig9"].merges,
            solver=solver,
            iterations=ITERATIONS[solver],
            bandwidth=None if solver == "twist" else BANDWIDTH,
            device=device,
            dtype=dtype,
        )
    return time.perf_counter() - began, time.process_time() - busy, result


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--devices", nargs="+", default=["cpu"], choices=list(DEVICES))
    parser.add_argument("--dtypes", nargs="+", default=list(DTYPES), choices=list(DTYPES))
    parser.add_argument("--threads", nargs="+", type=int, default=[usable_cores()])
    parser.add_argument("--solvers", nargs="+", default=list(ITERATIONS), choices=list(ITERATIONS))
    add_option(parser)
    options = parser.parse_args()
    with recorded("bench_devices", keep=options.record) as run:
        table(options, run)


def table(options: argparse.Namespace, run: Run) -> None:
    """Print a line per solver, device, dtype and number of threads."""
    case = CASES["fig9"]
    scene, segment = record(case, 1)
    true = truth(scene, case.geometry.substeps * case.first_line, case.geometry.span, *case.merges)
    print(f"{usable_cores()} cores may be used, {idle_cores()} idle now")
    print(f"{'solver':11}{'device':>7}{'dtype':>9}{'threads':>8}{'wall s':>8}{'CPU s':>7}", end="")
    print(f"{'wall ×':>8}{'CPU ×':>7}{'PSNR dB':>10}")
    for solver in options.solvers:
        cases = list(itertools.product(options.devices, options.dtypes, options.threads))
        runs: dict[tuple[str, str, int], list[tuple[float, float, Any]]] = {each: [] for each in cases}
        measure(segment, solver, *cases[0])  # compiles
        for _, each in itertools.product(range(ROUNDS), cases):
            runs[each].append(measure(segment, solver, *each))
        first = [min(run[i] for run in runs[cases[0]]) for i in (0, 1)]
        for device, dtype, threads in cases:
            done = runs[device, dtype, threads]
            wall, busy = (min(run[i] for run in done) for i in (0, 1))
            result = done[0][2]
            decibel = psnr(result.video[result.trusted], true[result.trusted])
            print(
                f"{solver:11}{device:>7}{dtype:>9}{threads:8}{wall:8.2f}{busy:7.2f}"
                f"{wall / first[0]:8.2f}{busy / first[1]:7.2f}{decibel:10.4f}",
                flush=True,
            )
            run.add(
                f"{solver}, {device}, {dtype}, {threads} threads",
                wall_s=wall,
                cpu_s=busy,
                wall_ratio=wall / first[0],
                cpu_ratio=busy / first[1],
                psnr_db=decibel,
            )


if __name__ == "__main__":
    main()
