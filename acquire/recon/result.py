"""Result of a reconstruction: the video, its provenance, and its quality without knowledge of the truth."""

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
"""Residuals, in units of the noise, below which the video's own error is below 0.75 and 1.7 σ of a sample."""


Standing = Literal["explained", "nearly explained", "over-fitted", "not explained", "unknown"]


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a reconstruction after an iteration; ``stage`` names the present stage."""

    iteration: int
    iterations: int
    seconds: float
    stage: str = "solve"


@dataclass(frozen=True, slots=True)
class Look:
    """State of a reconstruction after an iteration, with its wall and processor time so far.

    ``video`` computes the answer as if it ended there; call it immediately or not at all.
    """

    iteration: int
    seconds: float
    processor_s: float
    stage: str
    video: Callable[[], NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Quality:
    """Quality without knowledge of the truth.

    ``misfit`` is the relative RMS residual of the used samples, ``prediction`` that of the held-out samples
    (NaN without any), ``coverage`` the share of usable samples. ``noise`` is the relative residual that the
    cameras' noise alone causes; NaN if it is unknown.
    """

    misfit: float
    prediction: float
    coverage: float
    noise: float = float("nan")

    @property
    def standing(self) -> Standing:
        """The residuals compared with the noise: those of the held-out samples, else of the used ones.

        explained : the residual is noise
        nearly explained : the residual is mostly noise
        over-fitted : the used samples are met more closely than their noise allows, the held-out ones are
            missed: a good part of the video is noise
        not explained : even the residual of the used samples is more than noise
        unknown : the noise is unknown
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
    """A reconstructed video with its provenance and quality.

    Attributes
    ----------
    video : (time, row, column) in scene units and the requested dtype, over the whole span; only the frames
        in ``trusted`` were sampled in full (Fig. 5)
    trusted : the longest run of these frames without one of which an arm has no usable sample. Neither the
        code nor the residual is considered: see ``believed``, ``ended`` and ``quality``
    time_ns : the beginning of each frame
    seconds : wall time without ``compiled_s``, the time of compilation, once after an installation
    processor_s : processor time of all threads
    solver : its name
    denoiser : name of the one that replaced total variation, or of its class if it was given as an object;
        None without
    iterations : number of all iterations, trials included; those limited by ``iterations_asked`` may be fewer
        if the budget, ``stop`` or the data ended them (``ended``)
    frame_error : (time,) relative RMS residual of the samples that saw each frame; NaN if none did. It is not
        the error of the frame, which may be many times larger; see `acquire.recon.judge.frame_error`
    error : estimated error of the video, of every frame and of 8 × 8 regions, in the video's own unit, or a
        sentence on why there is none; see `acquire.recon.error`
    believed : False if the lines contradict the segment's code, geometry or orientation: no frame is to be
        trusted then, and ``warnings`` names the contradiction
    masked : number of masked samples, by cause
    warnings : sentences that a user should know before trusting the video
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
    error: VideoError | str = "it was not requested"
    ended: str = "done"
    believed: bool = True
    masked: dict[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    compiled_s: float = 0.0
    processor_s: float = 0.0
    denoiser: str | None = None
    parameters: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return in_words("Reconstruction", **self._holds(), warnings=len(self.warnings))

    def _repr_html_(self) -> str:
        """The result as a table, with the frame in the middle of the trusted ones."""
        shown = range(len(self.video))[self.trusted] or range(len(self.video))
        number = shown[len(shown) // 2]
        words = {**self._holds(), "warnings": "; ".join(self.warnings) or None}
        return as_table("Reconstruction", words, as_picture(self.video[number], f"frame {number}"))

    def _holds(self) -> dict[str, str]:
        """Its properties in words."""
        frames, rows, columns = self.video.shape
        trusted = range(frames)[self.trusted] if self.believed else range(0)
        return {
            "frames": f"{frames} of {rows} x {columns} {self.video.dtype.name}",
            "trusted": f"frames {trusted.start} to {trusted.stop - 1}" if trusted else "none",
            "solver": f"{self.solver}, {self.iterations} iterations, {self.seconds:.3g} s ({self.ended})",
            "misfit": f"{self.quality.misfit:.2%}",
            "error": f"unknown: {self.error}" if isinstance(self.error, str) else self.error.sentence,
        }
