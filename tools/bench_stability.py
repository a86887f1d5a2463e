"""How far a result moves if the lines change by what no camera could tell: 1 DN in one of 200 samples.

    python -m tools.bench_stability [--scenes leds disc …] [--seeds 811 812] [--full-well 1e4] [--versions 3]

One row per scene and seed (of scene, code and noise): PSNR in dB of the trusted frames in voxels of 3 × 3, of
the lines as recorded and of versions of them, without a limit of time; 32 stages, 160 lines of 12 bits.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from acquire.cores import limit_threads
from acquire.evaluate.metrics import psnr
from acquire.recon import reconstruct
from acquire.sim.procedural import CLEAN, SCENES, CameraNoise, record
from tools.results import add_option, recorded

if TYPE_CHECKING:
    from acquire.lines import Segment

VOXEL, FULL_SCALE_DN = 3, 4095
CHANGED = 0.005
"""Share of the samples that are one DN more or less in another version."""


def version(segment: Segment, number: int) -> Segment:
    """Return the segment with a few samples changed by 1 DN; version 0 is as recorded."""
    if number == 0:
        return segment
    rng = np.random.default_rng(number)
    changed = rng.random(segment.lines.shape) < CHANGED
    lines = segment.lines + changed * rng.choice((-1, 1), segment.lines.shape)
    return replace(segment, lines=lines.clip(0, FULL_SCALE_DN).astype(segment.lines.dtype))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES), metavar="SCENE")
    parser.add_argument("--seeds", nargs="+", type=int, default=[811, 812])
    parser.add_argument("--full-well", type=float, default=1e4, help="electrons at the brightest; inf: clean")
    parser.add_argument("--versions", type=int, default=3)
    add_option(parser)
    options = parser.parse_args()
    camera = CameraNoise(options.full_well) if np.isfinite(options.full_well) else CLEAN
    with limit_threads(1), recorded("bench_stability", keep=options.record) as run:
        for scene in options.scenes:
            for seed in options.seeds:
                taken = record(scene, seed, stages=32, lines=160, camera=camera)
                truth = taken.truth(VOXEL, 1)
                results = [
                    reconstruct(version(taken.segment, number), VOXEL, 1)
                    for number in range(options.versions)
                ]
                db = [psnr(each.video[each.trusted], truth) for each in results]
                run.add(f"{scene}, seed {seed}", lowest_db=min(db), highest_db=max(db))
                listed = " ".join(f"{each:.1f}" for each in db)
                print(f"{scene:9} {seed}  spread {np.ptp(db):4.2f} dB  {listed}", flush=True)


if __name__ == "__main__":
    main()
