"""What a reconstruction gives back: the video, how it came about, and what can be said without the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from acquire.showing import as_picture, as_table, in_words

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from acquire.recon.error import VideoError


EXPLAINED, NEARLY = 1.25, 2.0
"""Residuals, in units of the noise, up to which the video's own error is below 0.75 and 1.7 σ of a sample."""


Standing = Literal["explained", "nearly explained", "over-fitted", "not explained", "unknown"]


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a reconstruction stands after an iteration; ``stage`` says what it is doing."""

    iteration: int
    iterations: int
    seconds: float
    stage: str = "solve"


@dataclass(frozen=True, slots=True)
class Look:
    """A reconstruction after an iteration, with its wall and processor time so far.

    ``video`` makes what would be the answer if it ended there; it is to be called at once or not at all.
    """

    iteration: int
    seconds: float
    processor_s: float
    stage: str
    video: Callable[[], NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Quality:
    """What can be said without the truth.

    ``misfit`` is the relative RMS residual of the samples used, ``prediction`` that of samples kept from the
    solver (NaN where none were), ``coverage`` the share of samples that were usable. ``noise`` is what the
    cameras' noise alone gives of a residual, relative likewise; NaN where nothing is known of it.
    """

    misfit: float
    prediction: float
    coverage: float
    noise: float = float("nan")

    @property
    def standing(self) -> Standing:
        """What the residuals are beside the noise. Samples that were kept from the solver judge; without any,
        those that it was given.

        explained : what is left is noise
        nearly explained : what is left is noise for the greater part
        over-fitted : the samples given are met more closely than their noise allows, those kept are missed:
            a good part of the video is noise
        not explained : more than noise is left even where the solver was given the samples
        unknown : nothing is known of the noise
        """
        judged = self.misfit if math.isnan(self.prediction) else self.prediction
        if not self.noise > 0 or math.isnan(judged):
            return "unknown"
        if judged <= EXPLAINED * self.noise:
            return "explained"
        if judged <= NEARLY * self.noise:
            return "nearly explained"
        return "over-fitted" if self.misfit < self.noise else "not explained"


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """A reconstructed video and how it came about.

    Attributes
    ----------
    video : (time, row, column) in scene units and the dtype asked for, over the whole span; only the frames
        in ``trusted`` were sampled in full (Fig. 5). That interval is nominal: it follows from the geometry
        alone, whatever lines were lost, samples masked, or the code does; ``quality`` says how well it went.
    time_ns : the begin of each frame
    seconds : wall time, without ``compiled_s``, which compiling took: once after an installation
    processor_s : of all threads
    iterations : all that were made, of trials too; those that ``iterations_asked`` limits may be fewer, where
        the budget, ``stop`` or the data ended it (``ended``)
    frame_error : (time,) relative RMS residual of the samples that saw each frame; NaN where none did. It is
        no error of the frame, which may be many times larger; see `acquire.recon.judge.frame_error`
    error : an estimate of how far the video is from the truth, of every frame and of 8 × 8 regions, in the
        video's own unit, or a sentence on why it cannot be told; see `acquire.recon.error`
    believed : False where the lines say that code, geometry or orientation are not the segment's: then no
        frame is to be trusted, and ``warnings`` says what is wrong
    masked : samples left out, by cause
    warnings : what a user should know before believing the video, in sentences
    """

    video: NDArray[np.floating[Any]]
    time_ns: NDArray[np.int64]
    trusted: slice
    seconds: float
    iterations: int
    iterations_asked: int
    solver: str
    quality: Quality
    frame_error: NDArray[np.float32]
    error: VideoError | str = "it was not asked for"
    ended: str = "done"
    believed: bool = True
    masked: dict[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    compiled_s: float = 0.0
    processor_s: float = 0.0
    parameters: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return in_words("Reconstruction", **self._holds(), warnings=len(self.warnings))

    def _repr_html_(self) -> str:
        """With the frame in the middle of those that are trusted."""
        shown = range(len(self.video))[self.trusted] or range(len(self.video))
        number = shown[len(shown) // 2]
        words = {**self._holds(), "warnings": "; ".join(self.warnings) or None}
        return as_table("Reconstruction", words, as_picture(self.video[number], f"frame {number}"))

    def _holds(self) -> dict[str, str]:
        """What it holds, in words."""
        frames, rows, columns = self.video.shape
        trusted = range(frames)[self.trusted] if self.believed else range(0)
        return {
            "frames": f"{frames} of {rows} x {columns} {self.video.dtype.name}",
            "trusted": f"frames {trusted.start} to {trusted.stop - 1}" if trusted else "none",
            "solver": f"{self.solver}, {self.iterations} iterations, {self.seconds:.3g} s ({self.ended})",
            "misfit": f"{self.quality.misfit:.2%}",
            "error": f"cannot be told: {self.error}" if isinstance(self.error, str) else self.error.sentence,
        }
