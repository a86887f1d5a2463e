"""Estimate of a video's error without the truth, calibrated on scenes whose truth is known.

The lines leave part of a scene undetermined, so that a small residual proves little (`judge.frame_error`).
These indicators need no truth and vary with the error:

    residual     RMS residual of the held-out blocks, expressed as the error of every voxel, independent of
                 the others, that would cause it
    sensitivity  change of the video when another quarter of the lines is held out and the solver continues
                 from where it is: what few lines determine is least certain
    change       contrast of the video in time, and edge, in space: priors fail there first

    log error = b₀ + log of a product of powers of these, of degree 1: in the video's own unit

Three kinds of video explain the lines long before the picture is right, with fewer lines as well as with all:
those that were cut short, those fitted as patterns with a few curves, and stills in voxels smaller than a
camera's pixel. They are judged by their prior instead, with exponents of their own:

    residual     the residual of the held-out blocks or of those used, whichever is larger
    sensitivity  change of the video under a prior several times heavier: what the prior determines, not the
                 lines. It counts more where it exceeds the residual: neighbouring lines of a still are so
                 alike that a wrong still explains them, too
    drift        whether the video moves farther and farther as its solver continues, as one cut short does
    fine         whether small voxels are the reason for judging by the prior: they explain clean lines to a
                 part in a thousand while they are a few percent off

The exponents, and the factors within which nine of ten estimates lie, are fitted by
``tools/bench_error.py --fit`` to scenes of motion, lamps, photographs and stills, each estimated with
exponents fitted to the others. No error is estimated where light is faster than the band or where the lines
contradict their description: neither shows in these indicators.
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
"""Number of regions along rows and along columns, of equal size."""
FRAMES_AT_ONCE = 64
BRIGHT = 0.999
"""Quantile of the voxels that defines the full scale."""


@dataclass(frozen=True, slots=True)
class Exponents:
    """Exponents of the indicators: of the whole video, and of a region or a frame relative to the whole."""

    constant: float
    sensitivity: float
    excess: float
    """Of the sensitivity over the residual, where it is larger."""
    drift: float
    fine: float
    fine_excess: float
    local_sensitivity: float
    local_change: float
    local_edge: float
    frame_sensitivity: float
    """Of a frame relative to the whole."""
    floor: float
    """Smallest sensitivity, change and edge of a region, as a share of the full scale."""
    factors: tuple[float, float]
    """Interval of the whole's error, relative to its estimate, that holds nine of ten cases."""
    region_factors: tuple[float, float]
    frame_factors: tuple[float, float]

    @property
    def whole(self) -> NDArray[np.float64]:
        """The exponents of the whole video's error, in the order of the indicators."""
        exponents = (
            self.constant,
            self.sensitivity,
            self.excess,
            self.drift,
            self.fine,
            self.fine_excess,
        )
        return np.array(exponents)


BY_LINES = Exponents(
    constant=-0.002,
    sensitivity=0.49,
    excess=0.0,
    drift=0.0,
    fine=0.0,
    fine_excess=0.0,
    local_sensitivity=0.244,
    local_change=0.237,
    local_edge=0.224,
    frame_sensitivity=0.129,
    floor=1e-3,
    factors=(0.59, 1.96),
    region_factors=(0.42, 2.13),
    frame_factors=(0.51, 1.74),
)
"""Fitted to 195 cases of 24 scenes of equal weight (``tools/bench_error.py --fit``). The factors are those of
scenes that were left out of the fit."""
BY_PRIOR = Exponents(
    constant=0.156,
    sensitivity=0.616,
    excess=0.281,
    drift=0.324,
    fine=0.144,
    fine_excess=0.112,
    local_sensitivity=0.651,
    local_change=0.117,
    local_edge=0.187,
    frame_sensitivity=0.373,
    floor=2e-4,
    factors=(0.47, 2.45),
    region_factors=(0.262, 2.26),
    frame_factors=(0.42, 1.94),
)
"""Fitted likewise to 67 cases of 11 scenes. The whole's factors are wider than the fit's 0.64 and 1.65,
because codes tried later reached 0.47 and 2.41."""


@dataclass(frozen=True, slots=True, eq=False)
class Indicators:
    """What an error is estimated from, in the video's unit: RMS of frames and regions (time, 8, 8).

    ``exponents`` are those for indicators measured in this way. ``drift`` is the exponent with which the
    change of the video grows with the number of further iterations: 1 for a steady drift, 0 or less for a
    solver that has converged.
    """

    exponents: Exponents
    residual: float
    scale: float
    sensitivity: NDArray[np.float64]
    change: NDArray[np.float64]
    edge: NDArray[np.float64]
    drift: float = 0.0
    fine: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class VideoError:
    """The estimated RMS error of a video, in its own unit.

    Attributes
    ----------
    rms : over all voxels of the trusted frames; ``low`` and ``high`` enclose it in nine of ten scenes
    full_scale : the brightest voxels, to express errors as shares
    regions : (time, 8, 8), of each frame's regions, rows and columns in equal parts; calibrated for the
        trusted frames only. The error of a region is within ``region_factors`` times it in nine of ten cases,
        that of a frame within ``frame_factors``. It ranks frames poorly.
    indicators : what it was estimated from; ``processor_s`` is the processor time of that
    """

    rms: float
    low: float
    high: float
    full_scale: float
    regions: NDArray[np.float32]
    region_factors: tuple[float, float]
    frame_factors: tuple[float, float]
    indicators: Indicators
    processor_s: float = 0.0

    @property
    def frames(self) -> NDArray[np.float32]:
        """Error of each frame (time,)."""
        return np.asarray(np.sqrt(np.square(self.regions).mean((1, 2))), np.float32)

    @property
    def sentence(self) -> str:
        """The error in words, as ``about 3 % of full scale (2 to 5 % in nine of ten)``."""
        return error_in_words(self.facts())

    def facts(self) -> dict[str, Any]:
        """The error as JSON, without the frames."""
        whole = {"rms": self.rms, "low": self.low, "high": self.high, "full_scale": self.full_scale}
        return whole | {"region_factors": self.region_factors, "frame_factors": self.frame_factors}


def error_facts(error: VideoError | str) -> dict[str, Any]:
    """The error as JSON; ``unknown`` is the reason why there is no estimate."""
    return {"unknown": error} if isinstance(error, str) else error.facts()


def regions_of(error: VideoError | str, frames: int) -> NDArray[np.float32]:
    """Errors (time, 8, 8) of every frame's regions; NaN if there is no estimate."""
    if isinstance(error, str):
        return np.full((frames, REGIONS, REGIONS), np.nan, np.float32)
    return error.regions


def combined_facts(parts: Sequence[Mapping[str, Any]], weights: Sequence[float]) -> dict[str, Any]:
    """The facts of a video of several sub-segments with these ``weights``; unknown if that of one is."""
    for part in parts:
        if "unknown" in part:
            return dict(part)
    # Mean squares add up, RMS errors do not.
    found = {
        key: float(np.sqrt(np.average([part[key] ** 2 for part in parts], weights=weights)))
        for key in ("rms", "low", "high")
    }
    return {**parts[0], **found, "full_scale": max(part["full_scale"] for part in parts)}


def measure_indicators(
    video: NDArray[Any],
    changed: NDArray[Any],
    residual: float,
    trusted: slice,
    exponents: Exponents,
    *,
    growth: float = 1.0,
    drift: float = 0.0,
    fine: bool = False,
) -> Indicators | None:
    """Measure the indicators of a video and of what it ``changed`` to.

    ``growth`` is the factor by which the change would be larger if no budget had cut the iterations. None if
    the video is dark or its residual is 0.
    """
    shown = video[trusted]
    scale = full_scale(shown)
    if not (scale > 0 and residual > 0):
        return None
    # What follows enters ratios and logarithms, so that none of it may be 0.
    floor, mean = exponents.floor * scale, shown.mean(0)
    change, edge = np.zeros(mean.shape), np.zeros(mean.shape)
    for part in _parts(shown):
        change += np.square(part - mean, dtype=np.float64).sum(0)
        edge[:-1] += np.square(np.diff(part, axis=1), dtype=np.float64).sum(0)
        edge[:, :-1] += np.square(np.diff(part, axis=2), dtype=np.float64).sum(0)
    pairs = zip(_parts(changed), _parts(video), strict=True)
    distance = np.concatenate([in_regions(np.square(one - other)) for one, other in pairs])
    return Indicators(
        exponents,
        residual,
        scale,
        sensitivity=np.sqrt(growth**2 * distance + floor**2),
        change=np.sqrt(in_regions(change[None] / len(shown))[0] + floor**2),
        edge=np.sqrt(in_regions(edge[None] / len(shown))[0] + floor**2),
        drift=drift,
        fine=fine,
    )


def _parts(frames: NDArray[Any]) -> list[NDArray[Any]]:
    """Frames some at a time: a video of a large sensor is a gigabyte, and so would each intermediate be."""
    return [frames[first : first + FRAMES_AT_ONCE] for first in range(0, len(frames), FRAMES_AT_ONCE)]


def error_from(indicators: Indicators, trusted: slice, exponents: Exponents | None = None) -> VideoError:
    """Estimate the error from its indicators, with their own exponents unless others are given."""
    exponents = exponents or indicators.exponents
    sensitivity = np.sqrt(np.square(indicators.sensitivity[trusted]).mean(0))
    whole, change, edge = (rms_of(each) for each in (sensitivity, indicators.change, indicators.edge))
    error = np.exp(log_indicators(whole, indicators) @ exponents.whole) * indicators.residual
    relative = (
        (sensitivity / whole) ** exponents.local_sensitivity
        * (indicators.change / change) ** exponents.local_change
        * (indicators.edge / edge) ** exponents.local_edge
    )
    # Regions share out the whole's error: their RMS is `error`, as is that of the trusted frames below.
    regions = error * relative / rms_of(relative)
    frame_rms = np.sqrt(np.square(indicators.sensitivity).mean((1, 2)))
    frames = (frame_rms / whole) ** exponents.frame_sensitivity
    frames /= rms_of(frames[trusted])
    low, high = exponents.factors
    return VideoError(
        rms=float(error),
        low=float(low * error),
        high=float(high * error),
        full_scale=indicators.scale,
        regions=(frames[:, None, None] * regions).astype(np.float32),
        region_factors=exponents.region_factors,
        frame_factors=exponents.frame_factors,
        indicators=indicators,
    )


def log_indicators(sensitivity: float, indicators: Indicators) -> NDArray[np.float64]:
    """Logarithms of the whole video's indicators over the residual, one for each of ``Exponents.whole``."""
    # It is relative to the residual, by which the product is multiplied: its degree is 1 whatever the
    # exponents.
    log_ratio = np.log(sensitivity / indicators.residual)
    excess = max(log_ratio, 0.0)
    fine = indicators.fine
    return np.array([1.0, log_ratio, excess, indicators.drift, fine, fine * excess])


def in_regions(frames: NDArray[Any]) -> NDArray[np.float64]:
    """Means (time, 8, 8) of frames (time, row, column); a voxel in two regions counts with its shares."""
    side = frames.shape[1]
    # (region, voxel): length of each voxel's overlap with each region, since 8 need not divide the side.
    edges, voxel = np.linspace(0, side, REGIONS + 1), np.arange(side)
    overlap = np.minimum(edges[1:, None], voxel + 1) - np.maximum(edges[:-1, None], voxel)
    held = np.maximum(overlap, 0)
    share = np.asarray(held / held.sum(1, keepdims=True))
    return np.asarray(np.einsum("ay,tyx,bx->tab", share, frames, share, optimize=True), np.float64)


def rms_of(values: NDArray[Any]) -> float:
    """Return the root mean square of all values, summed in float64 part by part."""
    total = sum(float(np.square(part, dtype=np.float64).sum()) for part in _parts(values))
    return float(np.sqrt(total / values.size))


def full_scale(video: NDArray[Any]) -> float:
    """Brightness of the brightest voxels: a quantile of some millions of them, which is enough."""
    step = max(1, int((video.size / 4e6) ** 0.5))
    return float(np.quantile(video[:, ::step, ::step], BRIGHT))
