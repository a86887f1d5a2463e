"""Cost of fibre bands that are displaced from their nominal positions, and the gain from aligning each tile.

    python tools/bench_fibre_bands.py

A binary texture of 128 x 192 behind a fibre on sensors of 64 stages, S = 1; full well 10 000 electrons, 10 of
read noise; bands shifted by normally distributed deviations along both axes. 1024 lines of the scene itself,
at rest, are the target (`acquire.calibrate.target.tile_alignments`), and 300 of them make a still of each
tile. A tile is compared with the truth at the position where arm A sees it: that shift, which only the truth
reveals, is found by least squares, also for tiles without shifts. Prints the mean PSNR of six tiles, with a
peak of full light.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import shift
from scipy.optimize import minimize

from acquire.calibrate import Calibration, calibrated
from acquire.calibrate.exposure import open_exposure
from acquire.calibrate.target import tile_alignments
from acquire.config import load_rig
from acquire.config.scene import SceneFile
from acquire.recon import reconstruct
from acquire.sim.canvas import Canvas
from acquire.sim.procedural import still
from acquire.simulate import simulate

ROWS, COLUMNS, STAGES, LINES, SHOWN, RIM = 128, 192, 64, 1024, 300, 6
K, TOP_DN = 0.36, 3600.0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of texture, code, noise and shifts")
    parser.add_argument("--shifts", type=float, nargs="*", default=[0.0, 0.5, 1.0, 2.0], metavar="PIXELS")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as home:
        for pixels in options.shifts:
            print(json.dumps(measured(Path(home), options.seed, pixels)), flush=True)


def measured(home: Path, seed: int, pixels: float) -> dict[str, object]:
    """Measure with this deviation of the bands: uncorrected and aligned."""
    picture = np.clip(still(Canvas(COLUMNS, 2, seed))(0, 0.0)[:ROWS], 0, 1)
    Image.fromarray(np.rint(255 * picture).astype(np.uint8)).save(home / "still.png")
    light = STAGES * 0.5 * 0.6  # for a mostly white texture that is lit half of the time
    camera = {"responsivity_dn": TOP_DN / light / 1.6, "dn_per_electron": K, "read_noise_e": 10.0}
    camera |= {"black_level_dn": 100.0, "pixel_format": "Mono12"}
    changes = {f"cameras.{arm}.{key}": value for arm in "ab" for key, value in camera.items()}
    sizes = {"rows": ROWS, "columns": COLUMNS, "sensor_pixels": 2 * COLUMNS + 16}
    rig = load_rig(
        "rig-demo",
        {"geometry.stages": STAGES, "geometry.substeps": 1, "cameras.layout": "fibre", "code.seed": seed}
        | {f"fibre.{key}": value for key, value in sizes.items()}
        | changes,
    )
    effects: list[dict[str, object]] = [{"kind": "shot_noise"}, {"kind": "read_noise", "sigma_e": 10.0}]
    effects += [{"kind": "fibre_bands", "shift_pixels": pixels}] if pixels else []
    table = {"kind": "video", "path": str(home / "still.png"), "fit": "pad", "effects": effects}
    table |= {"system_gain_dn_per_e": K, "seed": seed}
    place = home / f"run-{pixels}.zarr"
    simulate(rig, SceneFile.model_validate(table).root, place, LINES)
    exposure = open_exposure(place, 0, LINES)
    known = Calibration(exposure.instrument).with_step(
        found := tile_alignments(exposure, Calibration(exposure.instrument))
    )
    figures: dict[str, list[tuple[float, float]]] = {"raw": [], "aligned": []}
    for tile in exposure.recording.fibre.tiles:
        lines = exposure.recording.cut(0, SHOWN, tile)
        row, column = STAGES * tile.row, STAGES * tile.column
        for name, segment in (("raw", lines), ("aligned", calibrated(lines, known))):
            result = reconstruct(segment, 1, segment.geometry.span, "fast", check=False)
            figures[name].append(
                (where_it_lies(result.video[0], picture, row, column), result.quality.prediction)
            )
    moved = np.array([(each.found.alignment.rows, each.found.alignment.columns) for each in found.tiles])
    facts: dict[str, object] = {"bands_px": pixels, "tiles_aligned": len(found.tiles)}
    facts["b_beside_a_px_rms"] = round(float(np.sqrt(np.square(moved).mean())), 3)
    for name, each in figures.items():
        reached, missed = np.array(each).T
        facts[f"{name}_db"], facts[f"{name}_worst_db"] = round(reached.mean(), 2), round(reached.min(), 2)
        facts[f"{name}_unseen_missed"] = round(float(missed.mean()), 4)
    return facts


def where_it_lies(image: np.ndarray, picture: np.ndarray, row: int, column: int) -> float:
    """PSNR of a tile's inner part, with the truth shifted to where it fits best."""
    inner = np.s_[RIM:-RIM, RIM:-RIM]
    part = np.s_[row : row + STAGES, column : column + STAGES]

    def mse(off: np.ndarray) -> float:
        moved = shift(picture, off, order=1, mode="nearest")[part]
        return float(np.square(image[inner] - moved[inner]).mean())

    starts = [(r, c) for r in range(-4, 5) for c in range(-4, 5)]
    best = min(starts, key=lambda start: mse(np.array(start, float)))
    found = minimize(mse, np.array(best, float), method="Nelder-Mead", options={"xatol": 0.005})
    return -10 * float(np.log10(found.fun))


if __name__ == "__main__":
    main()
