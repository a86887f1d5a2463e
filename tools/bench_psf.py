"""The optics' blur: measured from slanted edges on random instruments, and its value for a reconstruction.

Usage: OMP_NUM_THREADS=1 python -m tools.bench_psf [--instruments 4] [--seed 1] [--no-video] [--target sheet]

The instruments are those of `bench_calibrate`, with a random blur of 0 to 1.5 fine pixels for each arm. Dark,
flat, target and a checkerboard turned by 3 to 20 degrees are recorded with 1024 lines each and calibrated as
`acquire calibrate` does; with --target sheet, the target is the sheet, and shows the blur itself. Then random
lamps are reconstructed from 263 lines (voxels 3 x 1): calibrated without the blur, with it, and from lines
with only the same noise. Columns: measured minus true widths (fine pixels, along and across the transfer,
arms A and B; arm B's includes the simulator's bilinear interpolation), their standard uncertainty,
rms_in_sigma (errors of the variances in their own uncertainties: 1 if these are right), PSNR in dB, seconds.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.alignment import Alignment
from acquire.calibrate import calibrated
from acquire.calibrate.exposure import open_exposure
from acquire.calibrate.psf import psf, without_blur
from acquire.forward import interpolation_variance, merge_video
from acquire.recon import reconstruct
from acquire.sim.scenes import build_scene
from acquire.store import open_recording
from tools.bench_calibrate import NOISE, SEGMENT, SIZE, Drawn, calibrate
from tools.results import Run, add_option, recorded

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import Segment


class Blurred(Drawn):
    """An instrument whose arms have different blurs."""

    @property
    def widths(self) -> tuple[float, float]:
        """σ of arms A and B."""
        # 0.01 is the simulator's least
        a, b = np.random.default_rng(self.seed + 3000).uniform(0, 1.5, 2).clip(0.01).tolist()
        return a, b

    @property
    def effects(self) -> list[dict[str, Any]]:
        sharp = [each for each in super().effects if each["kind"] != "psf"]
        a, b = self.widths
        return [*sharp, {"kind": "psf", "sigma_pixels": a, "sigma_b_pixels": b}]


def true_widths(drawn: Blurred) -> NDArray[np.float64]:
    """Blur (arm, axis) of the simulator: kernels at whole pixels, and arm B's interpolation between them."""
    variances = []
    for sigma in drawn.widths:
        at = np.arange(-int(4 * sigma + 0.5), int(4 * sigma + 0.5) + 1)
        weights = np.exp(-0.5 * (at / sigma) ** 2)
        variances.append(float((weights * at**2).sum() / weights.sum()))
    off = Alignment(drawn.rows, drawn.columns, drawn.turn_deg, drawn.magnification)
    rows, columns = interpolation_variance(off, SIZE)
    a, b = variances
    return np.sqrt([[a, a], [b + columns, b + rows]])


def pictures(drawn: Blurred, known: Any, directory: Path) -> dict[str, float]:
    noise = [effect for effect in drawn.effects if effect["kind"] in NOISE]
    raw = open_recording(drawn.record("scene", directory, 400)).cut(70, SEGMENT)
    plain = open_recording(drawn.record("scene", directory, 400, noise)).cut(70, SEGMENT)
    scene = build_scene(drawn.scene("scene", [], directory), SIZE, 1e-5)
    truth = merge_video(scene.frames(3 * 70, raw.geometry.span), 3, 1)
    cases = {"without": calibrated(raw, without_blur(known)), "with": calibrated(raw, known), "noise": plain}
    found = {}
    for name, segment in cases.items():
        began = time.process_time()
        found[f"{name}_db"] = psnr(segment, truth)
        found[f"{name}_cpu_s"] = time.process_time() - began
    return found


def psnr(segment: Segment, truth: NDArray[np.float32]) -> float:
    result = reconstruct(segment, 3, 1)
    at = result.trusted
    return float(10 * np.log10(truth[at].max() ** 2 / np.mean((result.video[at] - truth[at]) ** 2)))


def instrument(seed: int, *, target: str, video: bool, run: Run) -> None:
    drawn = Blurred.at_random(seed)
    assert isinstance(drawn, Blurred)
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        known = calibrate(drawn, directory, 1024, target="sheet" if target == "sheet" else "dots")
        found = psf(open_exposure(drawn.record(target, directory, 1024)), known)
        measured, truth = found.quantities["blur_px"], true_widths(drawn)
        # σ² has the error that is alike for narrow and wide blurs
        names = "variance_px2", "variance_uncertainty_px2"
        variances, doubts = (np.array(found.facts[name]) for name in names)
        row = {
            "edges_a": found.facts["a"]["edges"],
            "edges_b": found.facts["b"]["edges"],
            "largest_error_px": float(np.abs(measured.value - truth).max()),
            "errors_in_sigma": float((np.abs(measured.value - truth) / measured.uncertainty).max()),
            "rms_in_sigma": float(np.sqrt(np.mean(np.square((variances - truth**2) / doubts)))),
        }
        if video:
            row |= pictures(drawn, known.with_step(found), directory)
    facts = "  ".join(f"{key} {value:.3g}" for key, value in row.items())
    print(f"{seed:4} is {np.round(truth.ravel(), 3)} found {np.round(measured.value.ravel(), 3)}  {facts}")
    run.add(f"seed {seed}", **row)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--instruments", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--no-video", action="store_true")
    parser.add_argument("--target", choices=("edges", "sheet"), default="edges")
    add_option(parser)
    options = parser.parse_args()
    with recorded("bench_psf", keep=options.record) as run:
        for number in range(options.instruments):
            instrument(options.seed + number, target=options.target, video=not options.no_video, run=run)


if __name__ == "__main__":
    main()
