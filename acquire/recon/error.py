"""How far a video is from the truth, without it: an estimate, calibrated on scenes whose truth is known.

Lines leave part of a scene open, so that a small residual proves little (`judge.frame_error`). What goes with
the error, and needs no truth:

    blocks  what held-out blocks of the lines are missed by, as that error of every voxel, independent of the
            others, which would be missed by as much
    moved   how far the picture moves when a further quarter of the lines is withheld, and it goes on from
            where it is: what few lines decide is what is least sure
    change  where it changes in time, and edge, where in space: priors give way there

    log error = b₀ + log of a product of powers of these, of degree 1: in the video's own unit

The powers, and how far estimates are off in nine of ten cases, are found by ``tools/bench_error.py --fit`` on
scenes of motion, lamps, photographs and stills, each estimated by powers fitted to the others. No estimate
is made of light beyond the band, nor of lines that are not what their description says: neither shows in
these.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.forward import DualArm
from acquire.recon.estimates import GoesOn
from acquire.recon.holdout import held_out_blocks
from acquire.showing import error_in_words

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon.clock import IterationClock
    from acquire.recon.estimates import Estimate
    from acquire.recon.problem import Problem

REGIONS = 8
"""Along rows and along columns, of equal size."""
WITHHELD, WITHHELD_SEED = 0.25, 101
"""Share of the samples that are withheld, in blocks, and what draws these."""
ITERATIONS, FEWEST = 15, 4
"""With which a video goes on without them, and at least where a budget ends."""
GROWS = 0.25
"""Power of the number of iterations with which a picture moves, for those that were left out: 5 moved it by
0.6 to 1.1 of what 15 do."""
AS_LONG_AS = 18.0
"""Iterations of the solver's, which all of this takes: that is kept of a budget for it."""
FAINT = 1e-3
"""Of the full scale: what a region is at least taken to move or change by."""
BRIGHT = 0.999
"""Quantile of the voxels that is the full scale."""


@dataclass(frozen=True, slots=True)
class Powers:
    """Of what an error is estimated from: of the whole video's, and of each region's beside the whole's."""

    constant: float
    moved: float
    moved_here: float
    change_here: float
    edge_here: float
    moved_now: float
    """Of a frame's beside the whole's."""
    factors: tuple[float, float]
    """By which the whole's error is smaller and larger than its estimate at the ends of nine of ten cases."""
    region_factors: tuple[float, float]
    frame_factors: tuple[float, float]


POWERS = Powers(
    constant=0.035,
    moved=0.494,
    moved_here=0.269,
    change_here=0.182,
    edge_here=0.27,
    moved_now=0.148,
    factors=(0.6, 2.4),
    region_factors=(0.41, 2.5),
    frame_factors=(0.51, 2.2),
)
"""Fitted to 213 cases of 24 scenes (``tools/bench_error.py --fit``), which count alike. The factors are those
of scenes that were left out of the fit. Stills with clean lines are far beyond: their lines are explained to
a part in a thousand where a picture of 2 × 8 voxels is some percent off."""


@dataclass(frozen=True, slots=True, eq=False)
class Clues:
    """What an error is estimated from, in the video's unit: RMS of frames and regions (time, 8, 8)."""

    blocks: float
    scale: float
    moved: NDArray[np.float64]
    change: NDArray[np.float64]
    edge: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class VideoError:
    """The estimated RMS error of a video, in its own unit.

    Attributes
    ----------
    rms : of all voxels of the trusted frames; ``low`` and ``high`` hold it in nine of ten scenes
    full_scale : the brightest voxels, for shares
    regions : (time, 8, 8) of each frame's regions, rows and columns in equal parts; calibrated for the
        trusted frames alone. One region's error is within ``region_factors`` times it in nine of ten, that
        of a frame within ``frame_factors``: which frame is worse than another is hardly told.
    clues : what it was estimated from; ``processor_s`` what that took
    """

    rms: float
    low: float
    high: float
    full_scale: float
    regions: NDArray[np.float32]
    region_factors: tuple[float, float]
    frame_factors: tuple[float, float]
    clues: Clues
    processor_s: float = 0.0

    @property
    def frames(self) -> NDArray[np.float32]:
        """(time,) of each frame."""
        return np.asarray(np.sqrt(np.square(self.regions).mean((1, 2))), np.float32)

    @property
    def sentence(self) -> str:
        """As ``about 3 % of full scale (2 to 5 % in nine of ten)``."""
        return error_in_words(self.facts())

    def facts(self) -> dict[str, Any]:
        """As JSON, without the frames."""
        whole = {"rms": self.rms, "low": self.low, "high": self.high, "full_scale": self.full_scale}
        return whole | {"region_factors": self.region_factors, "frame_factors": self.frame_factors}


def error_facts(error: VideoError | str) -> dict[str, Any]:
    """As JSON; ``unknown`` is why it cannot be told."""
    return {"unknown": error} if isinstance(error, str) else error.facts()


def in_frames(error: VideoError | str, frames: int) -> NDArray[np.float32]:
    """(time, 8, 8) of every frame's regions; NaN where it cannot be told."""
    if isinstance(error, str):
        return np.full((frames, REGIONS, REGIONS), np.nan, np.float32)
    return error.regions


def together(parts: Sequence[Mapping[str, Any]], weights: Sequence[float]) -> dict[str, Any]:
    """The facts of a video of several sub-segments, which count with ``weights``; unknown where one's is."""
    for part in parts:
        if "unknown" in part:
            return dict(part)
    found = {
        key: float(np.sqrt(np.average([part[key] ** 2 for part in parts], weights=weights)))
        for key in ("rms", "low", "high")
    }
    return {**parts[0], **found, "full_scale": max(part["full_scale"] for part in parts)}


def estimate_error(
    segment: Segment,
    problem: Problem,
    estimate: Estimate,
    video: NDArray[Any],
    prediction: float,
    merges: tuple[int, int],
    clock: IterationClock,
) -> VideoError | str:
    """The error of ``video`` (T/T_m, n/N_m, n/N_m) in scene units, or why it cannot be told."""
    trusted = segment.geometry.trusted_frames(merges[1])
    if not range(len(video))[trusted]:
        return "no frame is sampled in full"
    if not (isinstance(estimate, GoesOn) and problem.held_out.any()):
        return "its solver gives nothing to tell it by"
    began_s, made = clock.processor_s, 0

    def steps() -> Iterator[int]:
        nonlocal made
        for made, _ in enumerate(clock.afterwards(ITERATIONS), 1):
            yield made

    withheld = held_out_blocks(problem.usable, WITHHELD, WITHHELD_SEED)
    moved = estimate.gone_on(problem.keeping(withheld), steps())
    if moved is None:
        return "its solver gives nothing to tell it by"
    if clock.asked:
        return "the reconstruction was stopped"
    if made < FEWEST:
        return "the budget left no time for it"
    moved = np.maximum(moved * problem.scale, 0)
    if made < ITERATIONS:
        moved = video + (moved - video) * (ITERATIONS / made) ** GROWS
    blocks = white_error(segment, problem, prediction, merges)
    clues = find_clues(video, moved, blocks, trusted)
    found = "the video is dark" if clues is None else from_clues(clues, trusted)
    return found if isinstance(found, str) else replace(found, processor_s=clock.processor_s - began_s)


def white_error(segment: Segment, problem: Problem, prediction: float, merges: tuple[int, int]) -> float:
    """The RMS of independent errors of all voxels, in scene units, that lines miss by ``prediction``."""
    operator = DualArm(
        segment.geometry, segment.code, *merges, alignment=segment.alignment, blur=segment.blur
    )
    signs = np.random.default_rng(0).integers(0, 2, operator.video_shape, np.int8).astype(np.float32)
    signs *= 2
    signs -= 1
    of_one = float(np.sqrt(np.square(operator.forward(signs)[problem.usable], dtype=np.float64).mean()))
    level = float(np.sqrt(np.square(problem.samples[problem.held_out], dtype=np.float64).mean()))
    return prediction * level * problem.norm * problem.scale / max(of_one, 1e-30)


def find_clues(video: NDArray[Any], moved: NDArray[Any], blocks: float, trusted: slice) -> Clues | None:
    """From a video, and what it moved to; None for one that is dark or explained without any error."""
    shown = video[trusted]
    scale = float(np.quantile(shown[:, :: _thin(shown), :: _thin(shown)], BRIGHT))
    if not (scale > 0 and blocks > 0):
        return None
    faint = FAINT * scale
    change, edge = shown - shown.mean(0), np.zeros_like(shown)
    edge[:, :-1] += np.square(np.diff(shown, axis=1))
    edge[:, :, :-1] += np.square(np.diff(shown, axis=2))
    return Clues(
        blocks,
        scale,
        np.sqrt(in_regions(np.square(moved - video)) + faint**2),
        np.sqrt(in_regions(np.square(change)).mean(0) + faint**2),
        np.sqrt(in_regions(edge).mean(0) + faint**2),
    )


def from_clues(clues: Clues, trusted: slice, powers: Powers = POWERS) -> VideoError:
    """What the clues amount to."""
    here = np.sqrt(np.square(clues.moved[trusted]).mean(0))
    whole, change, edge = (_rms(each) for each in (here, clues.change, clues.edge))
    off = np.exp(powers.constant) * clues.blocks * (whole / clues.blocks) ** powers.moved
    beside = (
        (here / whole) ** powers.moved_here
        * (clues.change / change) ** powers.change_here
        * (clues.edge / edge) ** powers.edge_here
    )
    regions = off * beside / _rms(beside)
    now = (np.sqrt(np.square(clues.moved).mean((1, 2))) / whole) ** powers.moved_now
    now /= _rms(now[trusted])
    low, high = powers.factors
    return VideoError(
        float(off),
        float(low * off),
        float(high * off),
        clues.scale,
        (now[:, None, None] * regions).astype(np.float32),
        powers.region_factors,
        powers.frame_factors,
        clues,
    )


def in_regions(frames: NDArray[Any]) -> NDArray[np.float64]:
    """Means (time, 8, 8) of frames (time, row, column); voxels that two share count with their shares."""
    share = _shares(frames.shape[1])
    return np.asarray(np.einsum("ay,tyx,bx->tab", share, frames, share, optimize=True), np.float64)


def _shares(side: int) -> NDArray[np.float64]:
    """Of each voxel in each region (8, side), summing to 1."""
    edges, voxel = np.linspace(0, side, REGIONS + 1), np.arange(side)
    overlap = np.minimum(edges[1:, None], voxel + 1) - np.maximum(edges[:-1, None], voxel)
    held = np.maximum(overlap, 0)
    return np.asarray(held / held.sum(1, keepdims=True))


def _rms(values: NDArray[Any]) -> float:
    return float(np.sqrt(np.square(values, dtype=np.float64).mean()))


def _thin(video: NDArray[Any]) -> int:
    """Every how many rows and columns are enough to find a quantile: some millions of voxels."""
    return max(1, int((video.size / 4e6) ** 0.5))
