"""Draw every scene: its truth, its light over time, and the lines of both arms.

    python tools/scene_pictures.py OUT_DIRECTORY [SCENE …]

One PNG per scene. Scenes without an end are shown where the paper cuts them, 263 lines from 52 ms on.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np

from acquire.config import builtin_directory, load_rig, load_scene
from acquire.config.scene import SceneBase
from acquire.lines import ARMS
from acquire.sim.scenes import build_scene
from acquire.sim.voxels import truth
from acquire.simulate import bench_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FRAMES = 6
LONG = SceneBase().lines
"""A scene of this many lines has no end of its own."""


def picture(name: str) -> Figure:
    """Draw truth, light and lines of one scene."""
    scene = load_scene(name)
    rig = load_rig(scene.rig)
    bench, code = bench_of(rig, scene), rig.code.build()
    first, count = (round(0.052 * rig.line_rate_hz), 263) if scene.lines == LONG else (0, scene.lines)
    stages, substeps, dt = rig.geometry.stages, rig.geometry.substeps, bench.substep_s
    shown = build_scene(scene, bench.fine_scene().size, dt)
    begin, span = substeps * first, substeps * (count - stages)
    times = begin + (np.arange(FRAMES) + 0.5) * span / FRAMES
    figure = new_figure(f"{name}: {scene.title} ({stages} stages, S = {substeps}, {scene.optics.layout})")
    grid = figure.add_gridspec(3, FRAMES, height_ratios=(3, 1.2, 3))
    for column, t in enumerate(times.astype(int)):
        axes = figure.add_subplot(grid[0, column])
        axes.imshow(shown.frames(int(t), 1)[0], cmap="gray", vmin=0, vmax=1)
        axes.set_title(f"{t * dt * 1e3:.3f} ms", fontsize=8)
        axes.set_axis_off()
    merge = max(1, span // 1000)
    light = truth(shown, begin, span, shown.size // 4, merge)
    axes = figure.add_subplot(grid[1, :])
    axes.plot(
        (begin + (np.arange(len(light)) + 0.5) * merge) * dt * 1e3, light[:, :4, :4].reshape(len(light), -1)
    )
    axes.set_xlabel("time, ms", fontsize=8)
    axes.set_ylabel("light of 4 × 4 areas", fontsize=8)
    for number, arm in enumerate(ARMS):
        axes = figure.add_subplot(grid[2, number * FRAMES // 2 : (number + 1) * FRAMES // 2])
        pixels = bench.camera(arm, code).read(first, count).pixels
        axes.imshow(pixels, cmap="gray", aspect="auto", interpolation="nearest")
        axes.set_title(f"arm {arm.upper()}", fontsize=8)
        axes.set_xlabel("pixel", fontsize=8)
        axes.set_ylabel("line", fontsize=8)
    return figure


def new_figure(title: str) -> Figure:
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(12, 9), layout="constrained")
    figure.suptitle(title, fontsize=10)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("scenes", nargs="*", help="names or files; absent: all scenes of the program")
    options = parser.parse_args()
    mpl.use("Agg")
    options.out.mkdir(parents=True, exist_ok=True)
    everything = sorted(path.stem for path in builtin_directory().glob("scene-*.toml"))
    for name in options.scenes or everything:
        path = options.out / f"{Path(name).stem}.png"
        picture(name).savefig(path, dpi=80)
        print(path)


if __name__ == "__main__":
    main()
