"""Make the README's moving picture: the lines of two cameras, and two videos reconstructed from them.

    python tools/moving_picture.py [OUT.webp]

The two goldfish of the paper's Fig. 7, with an ordinary camera's noise (full well 10 000 e, read noise 10 e,
12 bits): 2.28 ms, 1313 lines of 54 pixels from each camera. The same lines are reconstructed once for
detail (162 × 162 pixels, five frames) and once for motion (54 × 54, 1025 frames).
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from acquire.config import load_rig, load_scene
from acquire.config.scene import SceneConfig
from acquire.evaluate.animation import write_webp
from acquire.lines import ARMS
from acquire.recon import reconstruct
from acquire.simulate import simulate
from acquire.store import open_recording

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon.result import Reconstruction

SCENE, RIG, LINES = "scene-goldfish", "rig-goldfish", 1313
DETAIL, MOTION = (1, 820), (3, 4)
FULL_WELL_E, READ_NOISE_E, TOP_DN = 1e4, 10.0, 3700.0
BUDGET_S = 60.0
FRAMES, FRAME_MS = 80, 70

PANEL_PX, STRIP_PX, GAP_PX, BAR_PX = 300, 108, 12, 30
PAPER, WORDS, SOFT, NOW = "#12181f", "#ffffff", "#cbd2d9", "#ffb000"
OUT = Path(__file__).parent / "pictures" / "goldfish.webp"


def noisy_scene() -> SceneConfig:
    """The scene, recorded by a camera whose brightest sample has `FULL_WELL_E` electrons."""
    effects = [{"kind": "shot_noise"}, {"kind": "read_noise", "sigma_e": READ_NOISE_E}]
    scene = load_scene(SCENE)
    noise = {"effects": effects, "system_gain_dn_per_e": TOP_DN / FULL_WELL_E}
    return type(scene).model_validate(scene.model_dump() | noise)


def recorded(lines: int, directory: Path) -> Segment:
    """Lines as recorded and cut."""
    rig = load_rig(RIG)
    simulate(rig, noisy_scene(), directory / "goldfish.zarr", lines)
    return open_recording(directory / "goldfish.zarr").cut(0, lines)


def draw(
    segment: Segment, detail: Reconstruction, motion: Reconstruction, frames: int = FRAMES
) -> list[Image.Image]:
    """Pictures of the loop, one per instant."""
    span_ns = detail.time_ns[0], motion.time_ns[motion.trusted][-1]
    strips = [_grey(segment.lines[arm], STRIP_PX, 1.0) for arm in range(len(ARMS))]
    still = [_grey(frame, PANEL_PX, 0.995) for frame in _shown(detail)]
    moving = _shown(motion)
    peak = float(np.quantile(moving, 0.9995))
    pictures = []
    for instant in np.linspace(0, 1, frames, endpoint=False):
        frame = moving[int(instant * len(moving))]
        fast = Image.fromarray(np.clip(frame * (255 / peak), 0, 255).astype(np.uint8))
        pictures.append(
            _compose(
                strips,
                still[int(instant * len(still))],
                fast.resize((PANEL_PX, PANEL_PX), Image.Resampling.NEAREST),
                float(instant),
                (span_ns[1] - span_ns[0]) * 1e-6,
            )
        )
    return pictures


def _shown(result: Reconstruction) -> NDArray[np.float32]:
    return np.asarray(result.video[result.trusted], np.float32)


def _grey(values: NDArray[np.generic], width: int, quantile: float) -> Image.Image:
    peak = float(np.quantile(values, quantile))
    grey = np.clip(np.asarray(values, np.float32) * (255 / peak), 0, 255).astype(np.uint8)
    return Image.fromarray(grey).resize((width, PANEL_PX), Image.Resampling.BOX)


def _compose(
    strips: list[Image.Image], detail: Image.Image, motion: Image.Image, instant: float, span_ms: float
) -> Image.Image:
    """One picture: the two line streams with a mark at the instant, then the two videos."""
    width = 2 * STRIP_PX + 2 * PANEL_PX + 4 * GAP_PX
    picture = Image.new("RGB", (width, PANEL_PX + 2 * BAR_PX), PAPER)
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(15)
    left = 0
    labels = ["camera A", "camera B", "for detail: 162 by 162, 5 frames", "for motion: 54 by 54, 1025 frames"]
    for number, (label, panel) in enumerate(zip(labels, [*strips, detail, motion], strict=True)):
        picture.paste(panel, (left, BAR_PX))
        pen.text((left + 4, BAR_PX / 2), label, fill=WORDS, font=font, anchor="lm")
        if number < len(strips):
            y = BAR_PX + round(instant * (PANEL_PX - 1))
            pen.line((left, y, left + STRIP_PX - 1, y), fill=NOW, width=2)
        left += panel.width + (2 * GAP_PX if number == len(strips) - 1 else GAP_PX)
    below = PANEL_PX + 1.5 * BAR_PX
    pen.text((4, below), "what is recorded: 1313 lines", fill=SOFT, font=font, anchor="lm")
    chosen = f"what is chosen afterwards, from the same lines          {instant * span_ms:.2f} ms"
    pen.text((2 * STRIP_PX + 3 * GAP_PX + 4, below), chosen, fill=SOFT, font=font, anchor="lm")
    return picture


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", nargs="?", type=Path, default=OUT)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        segment = recorded(LINES, Path(directory))
    detail, motion = (reconstruct(segment, *voxels, budget_s=BUDGET_S) for voxels in (DETAIL, MOTION))
    write_webp(options.out, draw(segment, detail, motion), FRAME_MS)
    print(f"{options.out}: {options.out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
