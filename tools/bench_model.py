"""Cost of a calibration in the model: reconstructions without it, with each part alone, and with all parts.

Usage: OMP_NUM_THREADS=1 python -m tools.bench_model [--iterations 80]

It uses 263 lines of the practice instrument in front of its lamps (voxels 3 x 1, 64 x 64 x 598), with a
calibration of offsets, gains, balance, an excluded column, the cameras' curves, an alignment, and the optics'
blur and veil. All trials have the same bandwidth and number of iterations. Columns: processor seconds, which
depend little on other load, and their ratio to a reconstruction without a calibration; the smaller of two
runs, in turns. Then an operator's forward and transpose alone, in milliseconds and with their ratio: medians
of seven, in turns, for voxels 3 x 1 and 100 cosines, and for voxels 1 x 1 and 4 curves.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from acquire.alignment import Alignment
from acquire.calibrate import AlignmentFound, Calibration, Measured, calibrated
from acquire.calibrate.calibration import KNOTS
from acquire.calibrate.exposure import instrument_of
from acquire.config import load_rig, load_scene
from acquire.lines import Segment
from acquire.recon import reconstruct
from acquire.recon.band import segment_operator
from acquire.recon.basis import TemporalBasis
from acquire.simulate import simulate
from acquire.store import open_recording
from tools.results import Run, add_option, recorded

LINES = 263
OPERATORS, REPEATS = ((3, 100), (1, 4)), 7
COLUMNS = ("offset_dn", "gain", "balance", "dn_per_electron", "read_noise_e")
OPTICS = ("blur_px", "veil")


def held(instrument_stages: int) -> dict[str, Measured]:
    """Every quantity that changes samples."""
    rng = np.random.default_rng(0)

    def columns(mean: float, sigma: float) -> Measured:
        values = mean + sigma * rng.standard_normal((2, instrument_stages))
        return Measured(values, np.full_like(values, sigma / 50))

    x = np.linspace(0, 1, KNOTS)
    return {
        "offset_dn": columns(50.0, 1.5),
        "gain": columns(1.0, 0.01),
        "balance": Measured(np.array([0.96, 1.04]), np.full(2, 1e-4)),
        "dn_per_electron": Measured(np.full(2, 0.1), np.full(2, 1e-3)),
        "read_noise_e": Measured(np.full(2, 25.0), np.full(2, 0.1)),
        "excess_dn": Measured(np.stack([60 * x * (1 - x)] * 2), np.zeros((2, KNOTS))),
        "blur_px": Measured(np.array([[0.6, 0.55], [0.7, 0.75]]), np.full((2, 2), 0.02)),
        "veil": Measured(np.array([0.012, 0.011]), np.full(2, 1e-4)),
    }


def cases(directory: Path) -> dict[str, Segment]:
    rig = load_rig("rig-practice").model_copy(update={"calibration": None})
    simulate(rig, load_scene("scene-practice-lamps"), directory / "run.zarr", LINES)
    recording = open_recording(directory / "run.zarr")
    segment = replace(recording.cut(0, LINES), balanced=True)
    instrument = instrument_of(recording)
    quantities = held(instrument.stages)
    usable = np.ones((2, instrument.stages), np.bool_)
    usable[0, 5] = False
    found = AlignmentFound(Alignment(0.35, -0.25, 0.2), dict.fromkeys(Alignment().facts(), 0.01))
    whole = Calibration(instrument, quantities, usable, None, found)
    curve = Calibration(instrument, {"excess_dn": quantities["excess_dn"]})
    columns = Calibration(instrument, {name: quantities[name] for name in COLUMNS}, usable)
    aligned = Calibration(instrument, alignment=found)
    optics = Calibration(instrument, {name: quantities[name] for name in OPTICS})
    parts = {"curves": curve, "columns and balance": columns, "alignment": aligned}
    parts |= {"blur and veil": optics, "everything": whole}
    return {"nothing": segment} | {name: calibrated(segment, each) for name, each in parts.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--iterations", type=int, default=80)
    add_option(parser)
    options = parser.parse_args()
    with recorded("bench_model", keep=options.record) as run:
        measure(options.iterations, run)


def measure(iterations: int, run: Run) -> None:
    """Run every case with the same bandwidth and number of iterations."""
    with tempfile.TemporaryDirectory() as directory:
        segments = cases(Path(directory))
    frames = segments["nothing"].geometry.video_shape(3, 1)[0]
    chosen = reconstruct(segments["nothing"], 3, 1, iterations=20).parameters["temporal_coefficients"]
    bandwidth = int(chosen) / frames
    for segment in segments.values():
        reconstruct(segment, 3, 1, iterations=1, bandwidth=bandwidth)  # compiles what it needs
    times: dict[str, list[float]] = {name: [] for name in segments}
    for _ in range(2):
        for name, segment in segments.items():
            began = time.process_time()
            reconstruct(segment, 3, 1, iterations=iterations, bandwidth=bandwidth)
            times[name].append(time.process_time() - began)
    bare = min(times["nothing"])
    for name, each in times.items():
        print(f"{name:20}  {min(each):6.2f} s  {min(each) / bare:5.2f}", flush=True)
        run.add(name, cpu_s=min(each), ratio=min(each) / bare)
    for merge, count in OPERATORS:
        operators(segments, merge, count, run)


def operators(segments: dict[str, Segment], merge: int, count: int, run: Run) -> None:
    """Time the operators of all cases alone."""
    frames = segments["nothing"].geometry.video_shape(merge, 1)[0]
    basis, rng = TemporalBasis(frames, count), np.random.default_rng(1)
    made = {name: segment_operator(segment, basis, merge, 1) for name, segment in segments.items()}
    theta = rng.standard_normal(made["nothing"].theta_shape).astype(np.float32)
    lines = rng.standard_normal(segments["nothing"].lines.shape).astype(np.float32)
    times: dict[str, list[float]] = {name: [] for name in made}
    for _ in range(REPEATS):
        for name, operator in made.items():
            began = time.process_time()
            for _ in range(10):
                operator.forward(theta)
                operator.adjoint(lines)
            times[name].append((time.process_time() - began) / 10)
    bare = float(np.median(times["nothing"]))
    for name, each in times.items():
        middle = float(np.median(each))
        print(
            f"operator {merge} x 1, {count:3}: {name:20}  {1e3 * middle:6.2f} ms  {middle / bare:5.2f}",
            flush=True,
        )
        run.add(f"operator {merge} x 1, {count}: {name}", cpu_s=middle, ratio=middle / bare)


if __name__ == "__main__":
    main()
