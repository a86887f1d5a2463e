"""Compare the default with the best plain still: one frame, repeated. The default must never be worse.

    python tools/bench_still.py [--scenes spark flicker …] [--seeds 901 902 903] [--full-well 1e4 clean]
                                [--voxels 2x8 3x1] [--stages 32] [--lines 160] [--preset fast]

One row per scene, seed (of code, scene and noise), camera and voxels: PSNR of the trusted frames in dB, for

    mean      the truth's own mean over time, repeated: the best possible still, not computable from lines
    still     one frame, reconstructed from the same lines with the same preset, and repeated
    default   the result of `reconstruct`, with its prior, held-out error and processor seconds of one thread

Then, for every scene, the worst and the mean of "default minus still". Only this comparison uses the truth.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np

from acquire.cli.reconstruct_request import parse_voxels
from acquire.cores import limit_threads
from acquire.evaluate.cases import full_wells
from acquire.evaluate.metrics import psnr
from acquire.recon import reconstruct
from acquire.recon.segments import Voxels
from acquire.sim.procedural import CLEAN, SCENES, CameraNoise, record
from tools.results import add_option, recorded

NOT_WORSE_DB = -0.1
"""Tolerance: a still that the default has chosen is solved again and may differ by this much."""


@dataclass(frozen=True)
class Row:
    """PSNR in dB of each method, and details of the default."""

    mean_db: float
    still_db: float
    default_db: float
    prior: str
    held_out_error_percent: float
    processor_s: float

    @property
    def above_still_db(self) -> float:
        return self.default_db - self.still_db


def measure(scene: str, seed: int, full_well_e: float, voxels: Voxels, options: argparse.Namespace) -> Row:
    camera = CameraNoise(full_well_e) if np.isfinite(full_well_e) else CLEAN
    whole = record(scene, seed, stages=options.stages, lines=options.lines, camera=camera)
    merges = voxels.spatial_merge, voxels.temporal_merge
    segment, truth = whole.segment, whole.truth(*merges)
    still = reconstruct(segment, merges[0], segment.geometry.span, options.preset, check=False).video
    begun = time.process_time()
    result = reconstruct(segment, *merges, options.preset, check=False)
    processor_s = time.process_time() - begun
    facts = result.parameters
    patterns = f", {facts['patterns']} patterns" if "patterns" in facts else ""
    return Row(
        mean_db=psnr(np.broadcast_to(truth.mean(0), truth.shape), truth),
        still_db=psnr(np.broadcast_to(still, truth.shape), truth),
        default_db=psnr(result.video[result.trusted], truth),
        prior=facts["prior"] + (" × brightness" if facts.get("brightness") else "") + patterns,
        held_out_error_percent=100 * result.quality.prediction,
        processor_s=processor_s,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES), metavar="SCENE")
    parser.add_argument("--seeds", nargs="+", type=int, default=[901, 902, 903])
    parser.add_argument("--full-well", nargs="+", default=["1e4", "clean"], help="electrons, or clean")
    parser.add_argument("--voxels", nargs="+", type=parse_voxels, default=[Voxels(2, 8), Voxels(3, 1)])
    parser.add_argument("--stages", type=int, default=32)
    parser.add_argument("--lines", type=int, default=160)
    parser.add_argument("--preset", choices=["fast", "balanced", "best"], default="fast")
    add_option(parser)
    options = parser.parse_args()
    rows: dict[str, list[Row]] = {scene: [] for scene in options.scenes}
    print("scene     seed  camera  voxels   mean  still  default  above still   error    s   prior")
    with limit_threads(1), recorded("bench_still", keep=options.record) as run:
        for scene in options.scenes:
            for seed in options.seeds:
                for full_well_e in full_wells(options.full_well):
                    for voxels in options.voxels:
                        row = measure(scene, seed, full_well_e, voxels, options)
                        rows[scene].append(row)
                        camera = f"{full_well_e:.0e}" if np.isfinite(full_well_e) else "clean"
                        run.add(f"{scene}, seed {seed}, {camera}, {voxels}", **vars(row))
                        print(
                            f"{scene:9} {seed:4}  {camera:6}  {voxels!s:6}  {row.mean_db:5.1f}  "
                            f"{row.still_db:5.1f}  {row.default_db:7.1f}  {row.above_still_db:+11.1f}  "
                            f"{row.held_out_error_percent:5.1f}%  {row.processor_s:4.1f}  {row.prior}",
                            flush=True,
                        )
    print("\ndefault minus still, dB: worst, mean")
    for scene, found in rows.items():
        above = [row.above_still_db for row in found]
        print(f"{scene:9} {min(above):+5.1f}  {np.mean(above):+5.1f}")
    every = [row for found in rows.values() for row in found]
    below = sum(row.above_still_db < NOT_WORSE_DB for row in every)
    mean_db = np.mean([row.default_db for row in every])
    print(
        f"below it by more than {-NOT_WORSE_DB} dB: {below} of {len(every)}; default's mean {mean_db:.2f} dB"
    )


if __name__ == "__main__":
    main()
