"""Compare the default with simple references, on scenes on which nothing was tuned, with a camera's noise.

    python tools/bench_trust.py [--scenes bullet splash …] [--seeds 21 22] [--full-well 1e4] [--twist]
                                [--speed-changes 0.1 0.05] [--budget 10]

One row per scene and seed (of code, scene and noise): PSNR of the trusted frames in voxels of 3 × 3, in dB,
for

    mean      the truth's own mean over time, repeated: an oracle without resolution in time
    still     one frame, reconstructed from the same lines and repeated
    cosines   32 cosines with total variation, without any choice
    TwIST     the paper's solver, 200 iterations (--twist)
    default   the result of `reconstruct`, with its prior, held-out error and processor seconds of one thread

Only this comparison uses the truth. "worse" counts rows in which the default is more than 0.3 dB below the
still.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np

from acquire.cores import limit_threads
from acquire.evaluate.metrics import psnr, ssim
from acquire.recon import reconstruct
from acquire.sim.procedural import CLEAN, SCENES, CameraNoise, record
from tools.results import add_option, recorded

VOXEL = 3
COSINES = 32
SLACK_DB = 0.3


@dataclass(frozen=True)
class Row:
    """PSNR in dB of each method, and details of the default."""

    scene: str
    mean: float
    still: float
    cosines: float
    twist: float
    default: float
    ssim: float
    prior: str
    error: float
    processor_s: float


def measure(
    scene: str,
    seed: int,
    camera: CameraNoise,
    speed_changes: list[float],
    budget_s: float | None,
    *,
    twist: bool,
) -> Row:
    recorded = record(scene, seed, camera=camera, speed_changes=speed_changes)
    segment, truth = recorded.segment, recorded.truth(VOXEL, 1)
    still = reconstruct(segment, VOXEL, segment.geometry.span).video
    cosines = reconstruct(segment, VOXEL, 1, bandwidth=COSINES / segment.geometry.span)
    begun = time.process_time()
    result = reconstruct(segment, VOXEL, 1, budget_s=budget_s)
    processor_s = time.process_time() - begun
    by_twist = reconstruct(segment, VOXEL, 1, solver="twist") if twist else None
    return Row(
        scene=scene,
        mean=psnr(np.broadcast_to(truth.mean(0), truth.shape), truth),
        still=psnr(np.broadcast_to(still, truth.shape), truth),
        cosines=psnr(cosines.video[cosines.trusted], truth),
        twist=psnr(by_twist.video[by_twist.trusted], truth) if by_twist else float("nan"),
        default=psnr(result.video[result.trusted], truth),
        ssim=ssim(result.video[result.trusted], truth),
        prior=result.parameters["prior"] + (" × brightness" if result.parameters.get("brightness") else ""),
        error=result.quality.prediction,
        processor_s=processor_s,
    )


def figures(row: Row) -> dict[str, float | str]:
    """Figures to keep."""
    ways = {f"{name}_db": getattr(row, name) for name in ("mean", "still", "cosines", "twist", "default")}
    error = {"ssim": row.ssim, "held_out_error_percent": 100 * row.error}
    return ways | error | {"processor_s": row.processor_s, "prior": row.prior}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES), metavar="SCENE")
    parser.add_argument("--seeds", nargs="+", type=int, default=[21])
    parser.add_argument("--full-well", type=float, default=1e4, help="electrons at the brightest; inf: clean")
    parser.add_argument(
        "--speed-changes",
        nargs="+",
        type=float,
        default=[],
        help="coefficients of Legendre's polynomials P₁, P₂, … over the span, relative to the mean speed",
    )
    parser.add_argument("--budget", type=float, metavar="SECONDS", help="time that the default may take")
    parser.add_argument("--twist", action="store_true", help="also run the paper's solver (minutes)")
    add_option(parser)
    options = parser.parse_args()
    camera = CameraNoise(options.full_well) if np.isfinite(options.full_well) else CLEAN
    print("scene      mean  still  cosines  TwIST  default  SSIM  error   s   prior")
    rows = []
    with limit_threads(1), recorded("bench_trust", keep=options.record) as run:
        for scene in options.scenes:
            for seed in options.seeds:
                row = measure(scene, seed, camera, options.speed_changes, options.budget, twist=options.twist)
                rows.append(row)
                run.add(f"{scene}, seed {seed}", **figures(row))
                yardsticks = f"{row.mean:5.1f}  {row.still:5.1f}  {row.cosines:7.1f}  {row.twist:5.1f}"
                details = f"{row.ssim:4.2f}  {row.error:5.1%}  {row.processor_s:3.0f}   {row.prior}"
                print(f"{row.scene:9} {yardsticks}  {row.default:7.1f}  {details}", flush=True)
    worse = [row.scene for row in rows if row.default < row.still - SLACK_DB]
    print(f"default below the still by more than {SLACK_DB} dB: {len(worse)} of {len(rows)} {worse or ''}")


if __name__ == "__main__":
    main()
