"""Write pictures of the procedural scenes (`acquire.sim.procedural`).

python tools/trust_scenes.py --pictures DIRECTORY        frames of every scene
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from acquire.sim.canvas import Canvas
from acquire.sim.procedural import CLEAN, SCENES, CameraNoise, Recorded, expose, light, record

__all__ = ["CLEAN", "SCENES", "CameraNoise", "Canvas", "Recorded", "expose", "light", "record"]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pictures", type=Path, required=True, metavar="DIRECTORY")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    import matplotlib as mpl

    mpl.use("agg")
    from acquire.evaluate.paper.drawing import strips
    from acquire.evaluate.themed import DPI, STYLE

    options.pictures.mkdir(parents=True, exist_ok=True)
    for name in SCENES:
        video = light(name, options.seed, 192, 980)
        picks = np.linspace(191, 788, 6).astype(int)
        with mpl.rc_context(STYLE):
            sheet = strips([(name, video[picks])], [f"{pick}" for pick in picks], float(video.max()))
            sheet.savefig(options.pictures / f"{name}.png", dpi=DPI)
            print(options.pictures / f"{name}.png")


if __name__ == "__main__":
    main()
