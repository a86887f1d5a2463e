"""Fig. 6: the limits in space and time of intra-line and inter-line TDI."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.evaluate.metrics import psnr
from acquire.evaluate.paper.bars import THRESHOLD, contrasts, last_resolved, place_of
from acquire.evaluate.paper.comparison import Row, captured, finer, in_elements, statement
from acquire.evaluate.paper.drawing import correlation, show
from acquire.evaluate.paper.studio import PaperFigure, Picture, scene_of
from acquire.evaluate.themed import SOFT, SOLVER_COLOURS, THEORY, canvas
from acquire.recon import reconstruct
from acquire.sim.scene import SeparableScene

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from acquire.evaluate.paper.studio import Studio
    from acquire.store import Recording

LINES, FIRST = 263, 70
# As in configs/scene-usaf.toml; its groups 4 and 5 are finer than a fine pixel can show.
GROUPS, FIELD_MM = (2, 3), 6.4
SHOWN_US = 20.0
NARROW_STATIC_IN = 2.0
INTRA, INTER = "intra-line", "inter-line"
COLOUR = {INTRA: SOLVER_COLOURS[0], INTER: SOLVER_COLOURS[1]}
PULSES_KHZ = (300, 900)
KNOWN, NOISY = "true picture, no noise", "true picture, camera noise"
FOUND = "reconstructed picture, camera noise"
"""The picture with which the light is reconstructed: the true one, which is unknown in practice, or one
reconstructed from noisy lines; and the noise of the lines."""
TAG = {KNOWN: "", NOISY: "_camera_noise", FOUND: "_found"}
NOT_CAPTURED = "not captured"
PAPER_RESOLVES = "3/5"
PAPER = {
    (300, INTRA): "captured with high fidelity",
    (900, INTRA): "even captured",
    (300, INTER): NOT_CAPTURED,
    (900, INTER): NOT_CAPTURED,
}


@dataclass(frozen=True, slots=True, eq=False)
class Curves:
    """Light over time: reconstructed (NaN where the code is dark) and true."""

    times_us: NDArray[np.float64]
    found: NDArray[np.float64]
    true: NDArray[np.float64]


def figure(studio: Studio) -> PaperFigure:
    """Reconstruct a static target with both kinds of TDI, and pulses with the true and a found picture."""
    pictures, noisy, gains, still = {}, {}, {}, None
    for kind in (INTER, INTRA):
        recording = studio.record("scene-usaf", LINES + FIRST, interline=kind == INTER)
        segment = recording.cut(FIRST, LINES)
        result = studio.solve(segment, 1, segment.geometry.span, f"static, {kind}")
        pictures[kind] = in_scene_units(result.video[0], recording)
        gains[kind] = studio.gain(segment)
        shot = studio.record(
            "scene-usaf", LINES + FIRST, interline=kind == INTER, gain_dn_per_e=gains[kind]
        ).cut(FIRST, LINES)
        noisy[kind] = studio.solve(shot, 1, shot.geometry.span, f"static, {kind}, camera noise").video[0]
        if kind == INTRA:
            still = scene_of(recording).frames(0, 1)[0]
    assert still is not None
    contrast = {kind: contrasts(picture, FIELD_MM, GROUPS) for kind, picture in pictures.items()}
    contrast["truth"] = contrasts(still, FIELD_MM, GROUPS)
    reached = {kind: place_of(last_resolved(contrast[kind])) for kind in (INTRA, INTER)}
    cases = [(khz, kind, way) for khz in PULSES_KHZ for kind in (INTRA, INTER) for way in TAG]
    curves: dict[tuple[int, str, str], Curves] = {}
    for khz, kind in dict.fromkeys(case[:2] for case in cases):
        curves[khz, kind, KNOWN] = _pulses(studio, khz, kind)
        shown = _pulses(studio, khz, kind, gains[kind]), _pulses(studio, khz, kind, gains[kind], noisy[kind])
        curves[khz, kind, NOISY], curves[khz, kind, FOUND] = shown
    agreement = {case: correlation(curve.found, curve.true) for case, curve in curves.items()}
    quality, noisy_quality = (psnr(each[INTRA], still, 1.0) for each in (pictures, noisy))
    return PaperFigure(
        name="fig6",
        title="Spatial and temporal resolution",
        text="The stationary USAF 1951 target, 192 × 192 fine pixels from 263 lines of 64 pixels per camera, "
        "and the same target in pulsed light. Inter-line TDI moves its charge by whole pixels, which gives "
        "64 × 64.",
        pictures=(
            Picture(
                "static",
                _static(pictures, still),
                "(a), (b) the stationary target, and the truth.",
                narrow_in=NARROW_STATIC_IN,
            ),
            Picture(
                "contrast", _contrast(contrast), "(c) contrast of the bars of groups 2 and 3; dashed: 0.1."
            ),
            Picture(
                "pulses",
                _pulse_curves(curves, KNOWN),
                "(d), (e) true light over time (grey), and the light reconstructed with the true still "
                "picture from lines without noise. It is unknown where the code is dark. The pulses of 300 "
                "kHz are in step with the 600 kHz of inter-line TDI here.",
            ),
            Picture(
                "pulses-found",
                _pulse_curves(curves, FOUND),
                "The same without the true picture: the still picture is also reconstructed, from lines with "
                "the noise of an ordinary camera (10 000 electrons in the brightest sample, read noise of "
                "10).",
            ),
        ),
        rows=(
            finer(
                "intra-line resolves up to",
                "group 3, element 5",
                _element(contrast[INTRA]),
                reached[INTRA] - place_of(PAPER_RESOLVES),
            ),
            statement(
                "inter-line resolves up to",
                "a mosaic",
                _element(contrast[INTER]),
                f"{in_elements(reached[INTER] - reached[INTRA])} than intra-line",
                hold=reached[INTER] < reached[INTRA],
            ),
            *(
                captured(
                    f"{khz} kHz pulses, {kind}; {way}",
                    PAPER[khz, kind],
                    agreement[khz, kind, way],
                    expected=PAPER[khz, kind] != NOT_CAPTURED,
                )
                for khz, kind, way in cases
            ),
            Row("static picture", "–", f"{quality:.1f} dB in {studio.seconds['static, intra-line']:.1f} s"),
            Row("static picture, camera noise", "–", f"{noisy_quality:.1f} dB"),
        ),
        seconds=dict(studio.seconds),
        numbers={
            "static_psnr_db": quality,
            "static_psnr_db_camera_noise": noisy_quality,
            **{f"r_{khz}_khz_{kind}{TAG[way]}": agreement[khz, kind, way] for khz, kind, way in cases},
        },
    )


def in_scene_units(picture: NDArray[Any], recording: Recording) -> NDArray[Any]:
    """Return a still picture in units of the scene, whose light a coarse sensor sums over k³ fine voxels."""
    # Two axes of the picture and one of time are coarser by this factor.
    coarse = scene_of(recording).size // recording.geometry_for(1).size
    return picture / coarse**3


def _element(contrast: dict[str, float]) -> str:
    last = last_resolved(contrast)
    if last == "–":
        return "not even group 2, element 1"
    group, element = last.split("/")
    return f"group {group}, element {element} (contrast {contrast[last]:.2f})"


def _pulses(
    studio: Studio,
    khz: int,
    kind: str,
    gain_dn_per_e: float | None = None,
    picture: NDArray[Any] | None = None,
) -> Curves:
    """Reconstruct pulsed light; both curves are on the fine sub-steps of the scene.

    The reconstructed light is constant over a step of the sensor. ``gain_dn_per_e`` is that of a noisy
    camera; ``picture`` is the still picture to use instead of the true one.
    """
    recording = studio.record(
        f"scene-pulses-{khz}khz", LINES + FIRST, interline=kind == INTER, gain_dn_per_e=gain_dn_per_e
    )
    segment = recording.cut(FIRST, LINES)
    scene, geometry = scene_of(recording), segment.geometry
    assert isinstance(scene, SeparableScene)
    factor = scene.size // geometry.size
    # a pixel of a coarse sensor sums the light of its fine pixels
    binned = scene.masks[0].reshape(geometry.size, factor, geometry.size, factor).sum(axis=(1, 3))
    image = binned if picture is None else picture
    # one voxel as large as the field: only its light over time is of interest
    result = reconstruct(segment, geometry.size, 1, static_image=image)
    level = factor * binned.mean()  # a coarse step collects the light of its fine sub-steps
    # Lines hold nothing of the light while the code is dark.
    light = np.where(segment.code > 0, result.video[:, 0, 0] / level, np.nan)
    found = light[geometry.trusted]
    first = factor * (geometry.substeps * FIRST + geometry.trusted.start)
    count = factor * len(found)
    times = (first + np.arange(count)) * segment.substep_ns / factor * 1e-3
    return Curves(times, np.repeat(found, factor), scene.intensity(first, count)[0])


def _static(pictures: dict[str, NDArray[Any]], still: NDArray[Any]) -> Figure:
    drawing = canvas(3.8)
    axes = drawing.subplots(1, 3)
    show(axes[0], pictures[INTER], title="(a) inter-line\n64 × 64")
    show(axes[1], pictures[INTRA], title="(b) intra-line\n192 × 192")
    show(axes[2], still, title="truth\n192 × 192")
    return drawing


def _contrast(contrast: dict[str, dict[str, float]]) -> Figure:
    drawing = canvas(2.9)
    ax = drawing.subplots()
    names = sorted(contrast[INTRA])
    for kind in (INTER, INTRA):
        values = [contrast[kind][name] for name in names]
        ax.plot(names, values, "o-", color=COLOUR[kind], lw=1.4, ms=5, label=kind)
    truth = [contrast["truth"][name] for name in names]
    ax.plot(names, truth, color=THEORY, lw=1.2, label="truth at 192 × 192", zorder=1)
    ax.axhline(THRESHOLD, color=SOFT, ls="--", lw=1)
    ax.set(xlabel="group / element", ylabel="contrast", ylim=(min(0, ax.get_ylim()[0]), 1.05))
    drawing.legend(ncols=3, loc="outside upper right")
    return drawing


def _pulse_curves(curves: dict[tuple[int, str, str], Curves], way: str) -> Figure:
    drawing = canvas(4.0)
    axes = drawing.subplots(2, 2, sharex=True, sharey=True)
    origin = max(curves[PULSES_KHZ[0], kind, way].times_us[0] for kind in (INTER, INTRA))
    for line, kind in zip(axes, (INTER, INTRA), strict=True):
        for ax, khz in zip(line, PULSES_KHZ, strict=True):
            curve = curves[khz, kind, way]
            times = curve.times_us - origin
            step_us = np.diff(times).mean()
            shown = (times > -step_us) & (times < SHOWN_US + step_us)  # keeps the file small
            times, found = times[shown], curve.found[shown]
            ax.step(times, curve.true[shown], where="post", color=THEORY, lw=1.0)
            ax.hlines(found, times, times + step_us, color=COLOUR[kind], lw=3.0)
            ax.set_title(f"{kind}, {khz} kHz", fontsize=9.5)
            ax.set(xlim=(0, SHOWN_US), ylim=(-0.25, 1.3))
        line[0].set_ylabel("light")
    for ax in axes[-1]:
        ax.set_xlabel("time (µs)")
    return drawing
