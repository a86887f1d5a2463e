"""A scene of 768 x 1536 through a fibre with an ordinary camera's noise, reconstructed: dB by tile.

    python tools/bench_fibre.py still                          # N_m = 1, a minute of a core for a tile
    python tools/bench_fibre.py video --tiles 1,3 --nm 8       # T_m = 16, 64 frames and more

Stills are binary textures at two scales: on the left, features in proportion to the whole scene; on the
right, features as fine as those of a scene of one tile, which is unfavourable. Videos show `scene-fibre`,
in which some tiles hold little but darkness; these are easy and can be recognised by their low contrast.
The brightest sample has 10 000 electrons, and the read noise is 10. PSNR has a peak of 1, full light. The
printed line of JSON has dB and contrast (standard deviation of the truth) of each tile.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image

from acquire.cli.tiles import tiles_of
from acquire.config import load_rig, load_scene
from acquire.config.scene import SceneFile
from acquire.recon.segments import Voxels
from acquire.reconstruct import Monitor, Options, by_lines, combine, in_tiles, in_voxels, open_pool
from acquire.sim.canvas import Canvas
from acquire.sim.procedural import still
from acquire.sim.scene import frames_at
from acquire.sim.scenes import build_scene
from acquire.simulate import bench_of, simulate
from acquire.store import open_recording, open_video

FULL_WELL_E, TOP_DN, READ_E = 1e4, 3600.0, 10.0
K = TOP_DN / FULL_WELL_E
NOISE = [{"kind": "shot_noise"}, {"kind": "read_noise", "sigma_e": READ_E}]
EFFECTS = {"effects": NOISE, "system_gain_dn_per_e": K}
BLOCK = 16
"""Number, or nearly so, of the sub-steps of a frame whose mean is the true frame."""


def still_scene(home: Path, seed: int) -> dict[str, object]:
    """A picture twice as wide as high: coarse texture on the left, fine on the right."""
    coarse = still(Canvas(1536, 2, seed))(0, 0.0)[:768, :768]
    fine = np.empty((768, 768), np.float32)
    for number in range(9):
        i, j = divmod(number, 3)
        fine[256 * i : 256 * i + 256, 256 * j : 256 * j + 256] = still(Canvas(256, 2, 100 * seed + number))(
            0, 0.0
        )
    picture = np.rint(255 * np.clip(np.hstack([coarse, fine]), 0, 1)).astype(np.uint8)
    Image.fromarray(picture).save(home / "still.png")
    return {"kind": "video", "path": str(home / "still.png"), "fit": "pad"}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("still", "video"))
    parser.add_argument("--seed", type=int, default=1, help="seed of texture, code and noise")
    parser.add_argument("--lines", type=int, help="lines; absent: 600 for a still, 1344 for a video")
    parser.add_argument("--tiles", help="tiles, as for acquire reconstruct; absent: all")
    parser.add_argument("--nm", type=int, help="N_m; absent: 1 for a still, 4 for a video")
    parser.add_argument("--tm", type=int, help="T_m; absent: all sub-steps for a still, 16 for a video")
    parser.add_argument("--preset", default="fast")
    parser.add_argument(
        "--search", choices=("shared", "each"), default="shared", help="search, as for acquire reconstruct"
    )
    parser.add_argument("--workers", type=int)
    parser.add_argument("--keep", type=Path, help="directory in which recording and video are kept")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        home = options.keep or Path(scratch)
        home.mkdir(exist_ok=True, parents=True)
        measure(options, home)


def measure(options: argparse.Namespace, home: Path) -> None:
    """Simulate, reconstruct, compare; print a line of JSON."""
    resting = options.what == "still"
    table = still_scene(home, options.seed) if resting else load_scene("scene-fibre").model_dump(mode="json")
    scene = SceneFile.model_validate({**table, **EFFECTS, "seed": options.seed}).root
    lines = options.lines or (600 if resting else 1344)
    rig = load_rig("rig-fibre", {"code.seed": options.seed})
    bare = bench_of(rig, scene).without("shot_noise", "read_noise")
    black = rig.cameras.a.black_level_dn
    brightest = max(
        int(bare.camera(arm, rig.code.build()).read(256, 64 if not resting else lines - 256).pixels.max())
        for arm in "ab"
    )
    responsivity = rig.cameras.a.responsivity_dn * TOP_DN / (brightest - black)
    cameras = {"responsivity_dn": responsivity, "dn_per_electron": K, "read_noise_e": READ_E}
    changes = {f"cameras.{arm}.{key}": value for arm in "ab" for key, value in cameras.items()}
    rig = load_rig("rig-fibre", {"code.seed": options.seed, **changes})
    recording = home / f"{options.what}-{options.seed}.zarr"
    began = time.monotonic()
    if not recording.exists():
        simulate(rig, scene, recording, lines)
    simulated_s = time.monotonic() - began
    opened = open_recording(recording)
    tiles = tiles_of(opened, options.tiles)
    span = opened.geometry_for(lines).span
    voxels = Voxels(options.nm or (1 if resting else 4), options.tm or (span if resting else 16))
    request = in_tiles(in_voxels(by_lines(opened), voxels), tiles)
    tasks = len(request.stretches) * len(tiles)
    monitor = Monitor(tasks, lambda done, of: print(f"{done:.1f} of {of}", end="\r", flush=True))
    out = home / f"{options.what}-{options.seed}-{time.time_ns()}-video.zarr"
    began = time.monotonic()
    with open_pool(tasks, options.workers, None, monitor) as pool:
        how = Options(options.preset, shared=options.search == "shared")
        outcome = combine(opened, request, out, options=how, pool=pool, monitor=monitor)
    seconds = time.monotonic() - began
    video, side = open_video(out), request.grid.side
    found = np.asarray(video.video[:])
    kept = range(len(found)) if resting else video.trusted
    truth = truth_of(rig, scene, request, kept)
    fibre = opened.fibre
    top, left = tiles[0].row * side, tiles[0].column * side
    truth = truth[:, top : top + found.shape[1], left : left + found.shape[2]]
    error, by_tile = np.square(found[kept.start : kept.stop] - truth), {}
    for tile in tiles:
        row, column = (tile.row - tiles[0].row) * side, (tile.column - tiles[0].column) * side
        part = np.s_[:, row : row + side, column : column + side]
        by_tile[str(tile)] = [decibels(error[part].mean()), round(float(truth[part].std()), 3)]
    facts = {
        "what": options.what,
        "seed": options.seed,
        "lines": lines,
        "voxels": str(voxels),
        "frames": [len(kept), *found.shape[1:]],
        "scene": [fibre.rows, fibre.columns],
        "psnr_db": decibels(error.mean()),
        "tiles_db_contrast": by_tile,
        "simulated_s": round(simulated_s, 1),
        "seconds": round(seconds, 1),
        "processor_s": round(sum(part["processor_s"] for part in outcome.provenance["segments"]), 1),
        "processor_s_by_tile": {
            part["tile"]: round(part["processor_s"], 1) for part in outcome.provenance["segments"]
        },
        "choice": outcome.provenance["choice"],
        "warnings": outcome.provenance["warnings"],
    }
    print(json.dumps(facts))


def truth_of(rig, scene, request, kept: range) -> np.ndarray:  # type: ignore[no-untyped-def]
    """True voxels of the whole scene in the compared frames."""
    fibre, grid = rig.laid_out, request.grid
    rows, columns = fibre.field()
    shown = build_scene(scene, fibre.side, rig.trigger.substep_ticks / rig.trigger.clock_hz)
    N_m = grid.voxels.spatial_merge
    frames = np.empty((len(kept), fibre.rows // N_m, fibre.columns // N_m), np.float32)
    for number, (begin, end) in enumerate(
        zip(*(edges := grid.edges(slice(kept.start, kept.stop)), edges[1:]), strict=False)
    ):
        at = np.array([begin]) if N_m == 1 else np.arange(begin, end, max(1, (end - begin) // BLOCK))
        mean = frames_at(shown, at)[:, rows, columns].mean(axis=0)
        frames[number] = mean.reshape(len(mean) // N_m, N_m, -1, N_m).mean(axis=(1, 3))
    return frames


def decibels(mse: float) -> float:
    return round(float(-10 * np.log10(mse)), 2)


if __name__ == "__main__":
    main()
