"""Fig. 7: selective reconstruction of the same lines, once for detail and once for motion."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import map_coordinates

from acquire.evaluate.metrics import psnr, ssim
from acquire.evaluate.paper.comparison import Row, same, statement
from acquire.evaluate.paper.drawing import compared, show
from acquire.evaluate.paper.studio import PaperFigure, Picture, true_voxels
from acquire.evaluate.themed import SOLVER_COLOURS, THEORY, canvas

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from acquire.evaluate.paper.studio import Studio

LINES = 1313
NARROW_TRAJECTORY_IN = 2.6
DETAIL, MOTION = (1, 820), (3, 4)
PROFILE = 0.2
"""Half the length of the line across the stripes, relative to the scene's side."""


def figure(studio: Studio) -> PaperFigure:
    """Reconstruct two goldfish, one fast and one with fine stripes."""
    recording = studio.record("scene-goldfish", LINES)
    segment = recording.cut(0, LINES)
    span = segment.geometry.span
    detail = studio.solve(segment, *DETAIL, "detail").video
    motion = studio.solve(segment, *MOTION, "motion").video
    true_detail, true_motion = (true_voxels(recording, 0, span, *kind) for kind in (DETAIL, MOTION))
    frame_ms = [segment.substep_ns * merge * 1e-6 for _, merge in (DETAIL, MOTION)]
    # the same moment, in the middle of 5 and of 1025 frames
    profiles = _profiles(true_detail[2], detail[2], motion[512])
    depth = {name: float(np.std(values) / np.mean(values)) for name, values in profiles.items()}
    numbers = {
        "detail_psnr_db": psnr(detail, true_detail, 1.0),
        "motion_psnr_db": psnr(motion, true_motion, 1.0),
        "detail_ssim": ssim(detail, true_detail, 1.0),
        "motion_ssim": ssim(motion, true_motion, 1.0),
    }
    return PaperFigure(
        name="fig7",
        title="Selective reconstruction: two goldfish",
        text="1313 lines of 54 pixels per camera, 2.28 ms at 1.8 million sub-steps per second. The "
        "broad-finned fish swims in a fast circle, the zebra fish turns slowly. The same lines are "
        "reconstructed twice.",
        pictures=(
            Picture(
                "trajectory",
                _trajectory(true_motion, motion),
                "(a) all positions at once: the truth and our reconstruction.",
                narrow_in=NARROW_TRAJECTORY_IN,
            ),
            compared(
                "detail",
                "(b) N_m = 1, T_m = 820: the stripes are clear, the fast fish is blurred along its path.",
                detail,
                truth=true_detail,
                picks=range(5),
                frame_ms=frame_ms[0],
            ),
            compared(
                "motion",
                "(d) N_m = 3, T_m = 4: the fast fish is sharp, the stripes have lost contrast.",
                motion,
                truth=true_motion,
                # The middles of the five frames above: one of 820 sub-steps is as long as 205 of 4.
                picks=range(102, 1025, 205),
                frame_ms=frame_ms[1],
            ),
            Picture(
                "stripes",
                _stripes(profiles),
                "(c) light along a line across the stripes, relative to its mean.",
            ),
        ),
        rows=(
            statement(
                "N_m = 1, T_m = 820",
                "stripes clearly discerned",
                _quality(numbers, "detail", studio),
                f"{depth['N_m = 1'] / depth['truth']:.0%} of the stripes' true swing; 50% is required",
                hold=depth["N_m = 1"] >= depth["truth"] / 2,
            ),
            Row("N_m = 3, T_m = 4", "fast fish clearly captured", _quality(numbers, "motion", studio)),
            statement(
                "swing across the stripes, relative to their mean",
                "higher with N_m = 1",
                ", ".join(f"{value:.2f} ({name})" for name, value in depth.items()),
                f"× {depth['N_m = 1'] / depth['N_m = 3']:.2f}",
                hold=depth["N_m = 1"] > depth["N_m = 3"],
            ),
            same(
                "voxels",
                "162×162×5 and 54×54×1025",
                f"{_shape(detail)} and {_shape(motion)}",
                equal=(detail.shape, motion.shape) == ((5, 162, 162), (1025, 54, 54)),
            ),
        ),
        seconds=dict(studio.seconds),
        numbers=numbers,
        movie={"ours": motion[::10], "truth": true_motion[::10]},
        movie_ms=10 * frame_ms[1],
    )


def _shape(video: NDArray[Any]) -> str:
    frames, rows, columns = video.shape
    return f"{rows}×{columns}×{frames}"


def _quality(numbers: dict[str, float], kind: str, studio: Studio) -> str:
    decibel, similarity = numbers[f"{kind}_psnr_db"], numbers[f"{kind}_ssim"]
    return f"{decibel:.1f} dB, SSIM {similarity:.3f} in {studio.seconds[kind]:.1f} s"


def _profiles(
    truth: NDArray[Any], detail: NDArray[Any], motion: NDArray[Any]
) -> dict[str, NDArray[np.float64]]:
    """Return the light along the central line on which the truth varies most, relative to its mean."""
    reach = np.linspace(-PROFILE, PROFILE, 160)

    def along(picture: NDArray[Any], angle: float) -> NDArray[np.float64]:
        # Rows count downwards, so the sine of the angle has a minus.
        place = 0.5 + np.stack([-np.sin(angle) * reach, np.cos(angle) * reach])
        return map_coordinates(picture.astype(np.float64), place * len(picture) - 0.5, order=1)

    # the stripes turn with their fish: where they are is taken from the truth
    angles = np.linspace(0, np.pi, 60, endpoint=False)
    angle = max(angles, key=lambda each: float(np.abs(np.diff(along(truth, each))).sum()))
    pictures = {"truth": truth, "N_m = 1": detail, "N_m = 3": motion}
    return {name: along(each, angle) / along(each, angle).mean() for name, each in pictures.items()}


def _trajectory(truth: NDArray[Any], video: NDArray[Any]) -> Figure:
    drawing = canvas(3.4)
    axes = drawing.subplots(1, 2)
    show(axes[0], truth.max(axis=0), title="truth, brightest over time")
    show(axes[1], video.max(axis=0), title="ours, 54 × 54")
    return drawing


def _stripes(profiles: dict[str, NDArray[np.float64]]) -> Figure:
    drawing = canvas(2.6)
    ax = drawing.subplots()
    colours = {"truth": THEORY, "N_m = 1": SOLVER_COLOURS[0], "N_m = 3": SOLVER_COLOURS[1]}
    place = np.linspace(-PROFILE, PROFILE, 160)
    for name, values in profiles.items():
        ax.plot(place, values, color=colours[name], lw=3 if name == "truth" else 1.4, label=name)
    ax.set(xlabel="position along the line (side of the scene = 1)", ylabel="light relative to mean")
    drawing.legend(ncols=3, loc="outside upper right")
    return drawing
