"""PSNR and SSIM of a video against the truth, for the whole video and per frame, in float64.

Both compare ``(time, row, column)`` arrays; one picture ``(row, column)`` is a video of one frame. The peak,
the brightest value that the scene can have, is the truth's maximum unless it is given.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import gaussian_filter

from acquire.errors import NumericsError, UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

SSIM_SIGMA = 1.5
"""Standard deviation of the Gaussian window in pixels (Wang et al. 2004, Section III.C)."""
# Gives a window of 11 × 11 pixels, that of Wang et al.
SSIM_TRUNCATE = 3.5
SSIM_RADIUS = int(SSIM_TRUNCATE * SSIM_SIGMA + 0.5)
"""The window extends 5 pixels to each side; a border of that width is left out of the mean."""
SSIM_K1, SSIM_K2 = 0.01, 0.03


def psnr(video: NDArray[Any], truth: NDArray[Any], peak: float | None = None) -> float:
    """Return 10·log10(peak² / mean squared error) in dB over all voxels; ``inf`` for equal arrays.

    ``peak`` is the truth's maximum unless given. Raises UsageError for different shapes or a peak that is not
    positive, NumericsError for values that are not finite.
    """
    video, truth = check_pair(video, truth)
    error = _mean_squared_error(video, truth, checked_peak(truth, peak))
    return float(_decibel(np.array([error]))[0])


def psnr_per_frame(
    video: NDArray[Any], truth: NDArray[Any], peak: float | None = None
) -> NDArray[np.float64]:
    """Return the PSNR of each frame (t,) in dB, all with the same peak; raises as :func:`psnr`."""
    video, truth = check_pair(video, truth)
    # one peak for all frames: relative to its own, a dark frame would look bad
    pairs, peak = zip(video, truth, strict=True), checked_peak(truth, peak)
    return _decibel(np.array([_mean_squared_error(frame, true_frame, peak) for frame, true_frame in pairs]))


def ssim(video: NDArray[Any], truth: NDArray[Any], data_range: float | None = None) -> float:
    """Return the mean structural similarity of the frames, 1 for equal frames (Wang et al. 2004).

    ``data_range`` is the truth's maximum unless given. Raises as :func:`psnr`, and UsageError for frames
    smaller than the 11 x 11 window.
    """
    return float(ssim_per_frame(video, truth, data_range).mean())


def ssim_per_frame(
    video: NDArray[Any], truth: NDArray[Any], data_range: float | None = None
) -> NDArray[np.float64]:
    """Return the structural similarity of each frame (t,); raises as :func:`ssim`."""
    video, truth = check_pair(video, truth)
    window = 2 * SSIM_RADIUS + 1
    if min(video.shape[1:]) < window:
        raise UsageError(
            f"frames {video.shape[1:]} are too small for an SSIM",
            possible=f"at least {window} x {window} pixels",
        )
    peak = checked_peak(truth, data_range)
    c1, c2 = SSIM_K1**2, SSIM_K2**2
    found = []
    # frame by frame, because the five filtered moments of a whole video would need five times its memory
    for frame, true_frame in zip(video, truth, strict=True):
        # in units of the range, so that c1 and c2 need no factor, and no square overflows
        x, y = frame.astype(np.float64) / peak, true_frame.astype(np.float64) / peak
        mx, my = _local_mean(x), _local_mean(y)
        var_x, var_y = _local_mean(x * x) - mx * mx, _local_mean(y * y) - my * my
        cov = _local_mean(x * y) - mx * my
        luminance = (2 * mx * my + c1) / (mx * mx + my * my + c1)
        # Eq. (13) of Wang et al., where c3 = c2 / 2 makes one factor of contrast and structure.
        contrast_structure = (2 * cov + c2) / (var_x + var_y + c2)
        found.append(np.mean(luminance * contrast_structure))
    return np.array(found, np.float64)


def check_pair(video: NDArray[Any], truth: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return both as (time, row, column).

    Raises UsageError if the shapes differ, NumericsError if a value is not finite.
    """
    video, truth = np.asarray(video), np.asarray(truth)
    if video.shape != truth.shape or video.ndim not in {2, 3} or video.size == 0:
        raise UsageError(
            f"a video {video.shape} cannot be compared with a truth {truth.shape}",
            possible="two arrays of the same shape, (time, row, column) or (row, column)",
        )
    check_finite(video, "the video")
    check_finite(truth, "the truth")
    return (video, truth) if video.ndim == 3 else (video[None], truth[None])


def check_finite(values: NDArray[Any], what: str) -> None:
    """Raise NumericsError if values are not finite; its message counts them."""
    bad = values.size - np.count_nonzero(np.isfinite(values))
    if bad:
        raise NumericsError(f"{bad} of {values.size} values of {what} are not finite")


def checked_peak(truth: NDArray[Any], peak: float | None = None) -> float:
    """Return ``peak``, or the truth's maximum. Raises UsageError unless it is positive and finite."""
    value = float(np.max(truth)) if peak is None else float(peak)
    if not (np.isfinite(value) and value > 0):
        raise UsageError(f"the peak of a comparison cannot be {value}", possible="a positive number")
    return value


def _mean_squared_error(video: NDArray[Any], truth: NDArray[Any], peak: float) -> float:
    """Return the error in units of the peak, whose square may be too large or too small for a number."""
    # As doubles from the first step: the difference of unsigned integers would wrap around.
    return float(np.mean(np.square(np.subtract(video, truth, dtype=np.float64) / peak)))


def _decibel(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    with np.errstate(divide="ignore"):  # equal arrays give inf
        decibel: NDArray[np.float64] = -10 * np.log10(errors)
    return decibel


def _local_mean(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the Gaussian-weighted mean around each pixel whose window lies inside the image."""
    smooth: NDArray[np.float64] = gaussian_filter(image, SSIM_SIGMA, truncate=SSIM_TRUNCATE)
    return smooth[SSIM_RADIUS:-SSIM_RADIUS, SSIM_RADIUS:-SSIM_RADIUS]
