"""Cost of a calibration in the model: reconstructions without it, with each part alone, and with all parts.

Usage: OMP_NUM_THREADS=1 python -m tools.bench_model [--iterations 80]

It uses 263 lines of the practice instrument in front of its lamps (voxels 3 x 1, 64 x 64 x 598), with a
calibration of offsets, gains, balance, an excluded column, the cameras' curves and an alignment. All trials
have the same bandwidth and number of iterations. Columns: processor seconds, which depend little on other
load, and their ratio to a reconstruction without a calibration; the smaller of two runs.
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
from acquire.simulate import simulate
from acquire.store import open_recording
from tools.results import Run, add_option, recorded

LINES = 263
COLUMNS = ("offset_dn", "gain", "balance", "dn_per_electron", "read_noise_e")


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
    parts = {"curves": curve, "columns and balance": columns, "alignment": aligned, "everything": whole}
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
    bare = 0.0
    for name, segment in segments.items():
        reconstruct(segment, 3, 1, iterations=1, bandwidth=bandwidth)  # compiles what it needs
        times = []
        for _ in range(2):
            began = time.process_time()
            reconstruct(segment, 3, 1, iterations=iterations, bandwidth=bandwidth)
            times.append(time.process_time() - began)
        bare = bare or min(times)
        print(f"{name:20}  {min(times):6.2f} s  {min(times) / bare:5.2f}", flush=True)
        run.add(name, cpu_s=min(times), ratio=min(times) / bare)


if __name__ == "__main__":
    main()
