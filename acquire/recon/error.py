"""How far a video is from the truth, without it: an estimate, calibrated on scenes whose truth is known.

Lines leave part of a scene open, so that a small residual proves little (`judge.frame_error`). What goes with
the error, and needs no truth:

    missed  what held-out blocks of the lines are missed by, as that error of every voxel, independent of the
            others, which would be missed by as much
    moved   how far the picture moves when a further quarter of the lines is withheld, and it goes on from
            where it is: what few lines decide is what is least sure
    change  where it changes in time, and edge, where in space: priors give way there

    log error = b₀ + log of a product of powers of these, of degree 1: in the video's own unit

So by lines that are withheld. What was cut, what was fitted as patterns with a few curves, and what rests in
voxels that are smaller than a camera's pixel explain the lines long before the picture is right, fewer of
them as well as all. Such are judged by their prior, with powers of their own:

    missed  is what is missed of held-out blocks or of those used, whichever is more
    moved   is how far the picture moves under a prior some times heavier: what the prior decides, not the
            lines. It says more where it is more than missed: the lines of a still hang together, so that they
            are explained by what is wrong
    drifts  whether it moves on as it is, farther and farther: what was cut does
    fine    whether it is for its voxels that it is judged so: clean lines are explained to a part in a
            thousand where they are some percent off

The powers, and how far estimates are off in nine of ten cases, are found by ``tools/bench_error.py --fit`` on
scenes of motion, lamps, photographs and stills, each estimated by powers fitted to the others. No estimate
is made of light beyond the band, nor of lines that are not what their description says: neither shows in
these.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.showing import error_in_words

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

REGIONS = 8
"""Along rows and along columns, of equal size."""
BRIGHT = 0.999
"""Quantile of the voxels that is the full scale."""


@dataclass(frozen=True, slots=True)
class Powers:
    """Of what an error is estimated from: of the whole video's, and of each region's beside the whole's."""

    constant: float
    moved: float
    beyond: float
    """Of what the picture moved by, as far as that is more than what the lines are missed by."""
    drifts: float
    fine: float
    fine_beyond: float
    moved_here: float
    change_here: float
    edge_here: float
    moved_now: float
    """Of a frame's beside the whole's."""
    faint: float
    """Of the full scale: what a region is at least taken to move or change by."""
    factors: tuple[float, float]
    """By which the whole's error is smaller and larger than its estimate at the ends of nine of ten cases."""
    region_factors: tuple[float, float]
    frame_factors: tuple[float, float]

    @property
    def whole(self) -> NDArray[np.float64]:
        powers = (self.constant, self.moved, self.beyond, self.drifts, self.fine, self.fine_beyond)
        return np.array(powers)


BY_LINES = Powers(
    constant=-0.002,
    moved=0.49,
    beyond=0.0,
    drifts=0.0,
    fine=0.0,
    fine_beyond=0.0,
    moved_here=0.244,
    change_here=0.237,
    edge_here=0.224,
    moved_now=0.129,
    faint=1e-3,
    factors=(0.59, 1.96),
    region_factors=(0.42, 2.13),
    frame_factors=(0.51, 1.74),
)
"""Fitted to 195 cases of 24 scenes (``tools/bench_error.py --fit``), which count alike. The factors are those
of scenes that were left out of the fit."""
BY_PRIOR = Powers(
    constant=0.156,
    moved=0.616,
    beyond=0.281,
    drifts=0.324,
    fine=0.144,
    fine_beyond=0.112,
    moved_here=0.651,
    change_here=0.117,
    edge_here=0.187,
    moved_now=0.373,
    faint=2e-4,
    factors=(0.47, 2.45),
    region_factors=(0.262, 2.26),
    frame_factors=(0.42, 1.94),
)
"""Fitted likewise to 67 cases of 11 scenes. The whole's factors are not the fit's 0.64 and 1.65: codes that
came later reached 0.47 and 2.41."""


@dataclass(frozen=True, slots=True, eq=False)
class Clues:
    """What an error is estimated from, in the video's unit: RMS of frames and regions (time, 8, 8).

    ``powers`` are for clues found like these. ``drifts`` is the power of the iterations made with which the
    picture goes on to move: 1 for steady, 0 and less for what has ended.
    """

    powers: Powers
    missed: float
    scale: float
    moved: NDArray[np.float64]
    change: NDArray[np.float64]
    edge: NDArray[np.float64]
    drifts: float = 0.0
    fine: bool = False


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


def find_clues(
    video: NDArray[Any],
    moved: NDArray[Any],
    missed: float,
    trusted: slice,
    powers: Powers,
    *,
    grown: float = 1.0,
    drifts: float = 0.0,
    fine: bool = False,
) -> Clues | None:
    """From a video, and what it moved to; ``grown`` times as far had no budget ended it.

    None for one that is dark or explained without any error.
    """
    shown = video[trusted]
    scale = full_scale(shown)
    if not (scale > 0 and missed > 0):
        return None
    faint = powers.faint * scale
    change, edge = shown - shown.mean(0), np.zeros_like(shown)
    edge[:, :-1] += np.square(np.diff(shown, axis=1))
    edge[:, :, :-1] += np.square(np.diff(shown, axis=2))
    return Clues(
        powers,
        missed,
        scale,
        np.sqrt(grown**2 * in_regions(np.square(moved - video)) + faint**2),
        np.sqrt(in_regions(np.square(change)).mean(0) + faint**2),
        np.sqrt(in_regions(edge).mean(0) + faint**2),
        drifts,
        fine,
    )


def from_clues(clues: Clues, trusted: slice, powers: Powers | None = None) -> VideoError:
    """What the clues amount to; with other powers than theirs, where given."""
    powers = powers or clues.powers
    here = np.sqrt(np.square(clues.moved[trusted]).mean(0))
    whole, change, edge = (rms_of(each) for each in (here, clues.change, clues.edge))
    off = np.exp(signs(whole, clues) @ powers.whole) * clues.missed
    beside = (
        (here / whole) ** powers.moved_here
        * (clues.change / change) ** powers.change_here
        * (clues.edge / edge) ** powers.edge_here
    )
    regions = off * beside / rms_of(beside)
    now = (np.sqrt(np.square(clues.moved).mean((1, 2))) / whole) ** powers.moved_now
    now /= rms_of(now[trusted])
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


def signs(moved: float, clues: Clues) -> NDArray[np.float64]:
    """Of the whole: logarithms beside what the lines are missed by, each to one of ``Powers.whole``."""
    more = np.log(moved / clues.missed)
    beyond = max(more, 0.0)
    return np.array([1.0, more, beyond, clues.drifts, clues.fine, clues.fine * beyond])


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


def rms_of(values: NDArray[Any]) -> float:
    return float(np.sqrt(np.square(values, dtype=np.float64).mean()))


def full_scale(video: NDArray[Any]) -> float:
    return float(np.quantile(video[:, :: _thin(video), :: _thin(video)], BRIGHT))


def _thin(video: NDArray[Any]) -> int:
    """Every how many rows and columns are enough to find a quantile: some millions of voxels."""
    return max(1, int((video.size / 4e6) ** 0.5))
