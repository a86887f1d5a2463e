"""Larger sensors: Fig. 9's lamps on M pixels, within a limit of processor time and memory.

    OMP_NUM_THREADS=1 python tools/bench_size.py [64 96 128 256] [--seeds 201 202] [--full-well 1e4]

One row per size and code: PSNR over the trusted frames in voxels of 3 × 1, the largest error of the three
frequencies, the resolved band, processor seconds of one thread and the largest memory. Each case runs in its
own process, so that its memory can be measured. Budgets are not used, since they are wall time, which
depends on other load: the solver is stopped at the size's processor seconds and returns the best so far.

    M = 64, 263 lines     64 × 64 × 980       40 s, 40 dB (clean)
    M = 96, 392 lines     96 × 96 × 1463      90 s, 42 dB (clean)
    M = 128, 520 lines    128 × 128 × 1943    180 s, 40 dB (clean)
    M = 256, 1024 lines   256 × 256 × 3839    1200 s, 35 dB, 6 GB: ten minutes of two cores

--full-well: electrons at the brightest sample, with 10 electrons of read noise; absent: rounding alone.
--device gpu: the iterations run there, and the seconds are those of the thread that waits for it.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import resource
import threading
import time
from dataclasses import dataclass, replace

import numpy as np

from acquire.arrays import DEVICES
from acquire.cores import limit_threads
from acquire.evaluate.metrics import psnr
from acquire.geometry import Geometry
from acquire.noise import Noise
from acquire.recon import reconstruct
from acquire.sim.leds import LedScene
from acquire.sim.voxels import truth
from tools.bench_reconstruct import CASES, FULL_SCALE_DN, Case, curves, record
from tools.results import add_option, recorded

READ_NOISE_E = 10.0


@dataclass(frozen=True)
class Size:
    """A sensor, and its goals."""

    lines: int
    limit_s: float
    goal_db: float


SIZES = {64: Size(263, 40, 40), 96: Size(392, 90, 42), 128: Size(520, 180, 40), 256: Size(1024, 1200, 35)}


@dataclass(frozen=True)
class Row:
    """Result of one case."""

    psnr_db: float
    curves: str
    prior: str
    cosines: int
    patterns: int
    prediction: float
    processor_s: float
    memory_gb: float
    ended: str


def case_of(stages: int) -> Case:
    return replace(CASES["fig9"], geometry=Geometry(stages, 3, SIZES[stages].lines))


def measure(stages: int, seed: int, full_well_e: float, limit_s: float, device: str) -> Row:
    case = case_of(stages)
    scene, segment = record(case, seed)
    assert isinstance(scene, LedScene)
    if math.isfinite(full_well_e):
        dn, rng = segment.lines.max() / full_well_e, np.random.default_rng([seed, stages])
        shot = rng.poisson(segment.lines / dn) + READ_NOISE_E * rng.standard_normal(segment.lines.shape)
        lines = np.clip(np.rint(shot * dn), 0, FULL_SCALE_DN).astype(np.uint16)
        noise = Noise((dn, dn), (dn * READ_NOISE_E,) * 2)
        segment = replace(segment, lines=lines, mask=lines < FULL_SCALE_DN, noise=noise)
    enough, began = threading.Event(), time.process_time()
    watch = threading.Thread(target=_watch, args=(enough, began + limit_s), daemon=True)
    watch.start()
    with limit_threads(1):
        result = reconstruct(segment, *case.merges, "best", stop=enough, device=device)
    processor_s = time.process_time() - began
    enough.set()
    watch.join()
    memory_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    first = case.geometry.substeps * case.first_line
    voxels = truth(scene, first, case.geometry.span, *case.merges)
    return Row(
        psnr_db=psnr(result.video[result.trusted], voxels[result.trusted]),
        curves=curves(case, scene, result).strip(),
        prior=str(result.parameters.get("prior")),
        cosines=int(result.parameters.get("temporal_coefficients", 0)),
        patterns=int(result.parameters.get("patterns", 0)),
        prediction=result.quality.prediction,
        processor_s=processor_s,
        memory_gb=memory_gb,
        ended=result.ended,
    )


def _watch(enough: threading.Event, until: float) -> None:
    """Set ``enough`` once this process has used its processor time."""
    while not enough.wait(0.2):
        if time.process_time() >= until:
            enough.set()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("stages", nargs="*", type=int, default=[96, 128], choices=list(SIZES), metavar="M")
    parser.add_argument("--seeds", type=int, nargs="+", default=[201, 202])
    parser.add_argument("--full-well", type=float, default=math.inf)
    parser.add_argument("--device", default="cpu", choices=list(DEVICES), help="where the iterations run")
    parser.add_argument("--seconds", type=float, help="processor seconds, instead of those of each size")
    add_option(parser)
    options = parser.parse_args()
    fresh = multiprocessing.get_context("spawn")
    with recorded("bench_size", keep=options.record) as run:
        for stages in options.stages:
            for seed in options.seeds:
                size = SIZES[stages]
                limit_s = options.seconds or size.limit_s
                with fresh.Pool(1) as pool:
                    row = pool.apply(measure, (stages, seed, options.full_well, limit_s, options.device))
                cost = f"{row.processor_s:.0f} of {limit_s:.0f} s, {row.memory_gb:.2f} GB, {row.ended}"
                how = f"{row.prior}, {row.cosines} cosines, {row.patterns} patterns"
                print(
                    f"M = {stages}, code {seed}: {row.psnr_db:.1f} dB of {size.goal_db:.0f}; {cost}; {how};"
                    f" blocks {row.prediction:.2%}; {row.curves}",
                    flush=True,
                )
                run.add(
                    f"{stages} × {stages} × {case_of(stages).geometry.span}, code {seed}",
                    psnr_db=row.psnr_db,
                    goal_db=size.goal_db,
                    processor_s=row.processor_s,
                    limit_s=limit_s,
                    memory_gb=row.memory_gb,
                    cosines=row.cosines,
                    patterns=row.patterns,
                    ended=row.ended,
                    curves=row.curves,
                )


if __name__ == "__main__":
    main()
