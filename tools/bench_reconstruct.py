"""What accuracy costs in time: Scene #1 at the sizes of Fig. 9, by solver, preset and exposure code.

Usage: python tools/bench_reconstruct.py [--seeds 1 2 3] [--twist-seconds 30]

For every code: PSNR over the trusted interval, the largest error of the three fitted frequencies, the ratio
of fitted to true amplitude at 5 kHz, iterations and seconds. Lines come from the streaming simulator, rounded
to 12 bits.
"""

from __future__ import annotations

import argparse

import numpy as np

from acquire.codes import PrbsCode, mix_seed
from acquire.config import load_scene
from acquire.evaluate.curves import compare_curve, region_mean
from acquire.evaluate.metrics import psnr
from acquire.geometry import Geometry
from acquire.lines import ARMS, Segment
from acquire.recon import Reconstruction, reconstruct
from acquire.sim.leds import LedScene
from acquire.sim.lines import StreamingArm
from acquire.sim.scenes import build_scene
from acquire.sim.voxels import truth

GEOMETRY = Geometry(64, 3, 263)
SUBSTEP_S = 1e-5
FIRST_LINE = 1733
GAIN_DN = 6.0
N_M = 3


def cut(scene: LedScene, seed: int) -> Segment:
    """The segment of Fig. 9 as a 12-bit camera would have recorded it."""
    code = PrbsCode(64, mix_seed(seed, 64))
    arms = [StreamingArm(scene, code, GEOMETRY.stages, GEOMETRY.substeps, arm) for arm in ARMS]
    light = np.stack([arm.lines(FIRST_LINE, GEOMETRY.lines) for arm in arms])
    lines = np.clip(np.rint(GAIN_DN * light), 0, 4095).astype(np.uint16)
    return Segment(
        lines=lines,
        mask=lines < 4095,
        code=code.bits(GEOMETRY.substeps * FIRST_LINE, GEOMETRY.span),
        geometry=GEOMETRY,
        time_ns=np.arange(GEOMETRY.lines, dtype=np.int64) * 30_000,
        substep_ns=SUBSTEP_S * 1e9,
        responsivity_dn=GAIN_DN,
    )


def score(scene: LedScene, result: Reconstruction, voxels: np.ndarray) -> str:
    """One row of the table."""
    video, first = result.video[result.trusted], GEOMETRY.substeps * FIRST_LINE + result.trusted.start
    light = scene.intensity(first, len(video))
    masks = scene.masks.reshape(len(scene.leds), GEOMETRY.stages, N_M, GEOMETRY.stages, N_M).mean(axis=(2, 4))
    curves = [
        compare_curve(led.name, curve, region_mean(video, mask > 0.9), SUBSTEP_S)
        for led, mask, curve in zip(scene.leds, masks, light, strict=True)
    ]
    errors = [abs(curve.frequency_error_hz) for curve in curves if not curve.constant]
    return (
        f"{psnr(video, voxels):8.2f}{max(errors):10.1f}{curves[0].amplitude_ratio:10.2f}"
        f"{result.iterations:8d}{result.seconds:8.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--twist-seconds", type=float, default=30.0)
    asked = parser.parse_args()
    scene = build_scene(load_scene("scene-leds"), GEOMETRY.size, SUBSTEP_S)
    assert isinstance(scene, LedScene)
    reconstruct(cut(scene, 0), N_M, 1, iterations=1)  # compiles
    print(f"{'code':>5} {'solver':18}{'PSNR dB':>8}{'Hz off':>10}{'5 kHz ×':>10}{'steps':>8}{'s':>8}")
    for seed in asked.seeds:
        segment = cut(scene, seed)
        voxels = truth(scene, GEOMETRY.substeps * FIRST_LINE, GEOMETRY.span, N_M)[GEOMETRY.trusted]
        for label, options in (
            ("ADMM fast", {"preset": "fast"}),
            ("ADMM balanced", {"preset": "balanced"}),
            ("TwIST", {"solver": "twist", "budget_s": asked.twist_seconds}),
        ):
            result = reconstruct(segment, N_M, 1, **options)
            print(f"{seed:>5} {label:18}" + score(scene, result, voxels), flush=True)


if __name__ == "__main__":
    main()
