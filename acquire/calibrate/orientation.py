"""Which of eight views of the scene arm B has beside arm A's, and what puts its lines right.

A view is the scene mirrored left to right if so, then turned counter-clockwise, as the scene files say it.
The dual arm needs B's charge to move across A's: a turn of 90 or 270 degrees.

    turn 90             the model's own
    turn 270            the arms are swapped: B is what the model calls A
    turn 270, mirrored  B's pixels are in the wrong order
    turn 90, mirrored   both
    turn 0 or 180       both cameras transfer along the same axis: nothing can put that right
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import Segment

CLEAR = 1.5
"""Ratio of the best view's correlation to the next one's from which on it is the answer."""
LEAST_CORRELATION = 0.25
FARTHEST = 0.25
"""Of the field: the largest shift that is looked at."""


@dataclass(frozen=True, slots=True)
class View:
    """How one arm sees the scene, in words and as a map of frames."""

    turn_deg: int
    mirrored: bool

    @property
    def name(self) -> str:
        return f"turn {self.turn_deg}" + (", mirrored" if self.mirrored else "")

    @property
    def crosses(self) -> bool:
        """Whether the charge moves across arm A's."""
        return self.turn_deg in (90, 270)

    @property
    def swapped(self) -> bool:
        """Whether camera B is what the model calls A, once its pixels are in order."""
        return self.crosses and (self.turn_deg == 270) != self.mirrored

    def seen(self, frames: NDArray[Any]) -> NDArray[Any]:
        """The scene (…, row, column) in this view."""
        shown = frames[..., ::-1] if self.mirrored else frames
        return np.rot90(shown, self.turn_deg // 90, axes=(-2, -1))

    def unseen(self, frames: NDArray[Any]) -> NDArray[Any]:
        """The scene of what is seen in this view."""
        turned = np.rot90(frames, -(self.turn_deg // 90), axes=(-2, -1))
        return turned[..., ::-1] if self.mirrored else turned


VIEWS = tuple(View(turn, mirrored) for mirrored in (False, True) for turn in (90, 270, 0, 180))
MODEL = VIEWS[0]
"""What arm B sees in Eq. (4)."""


def view_named(name: str) -> View:
    """UsageError for a name that none has."""
    found = {view.name: view for view in VIEWS}
    if name not in found:
        raise UsageError(f"there is no orientation {name!r}", possible="; ".join(found))
    return found[name]


def oriented(segment: Segment, view: View) -> Segment:
    """The lines as the model expects them, of an instrument whose arm B has ``view``.

    Where the arms are swapped, the video is what camera B sees. UsageError where both cameras transfer along
    the same axis.
    """
    if view == MODEL:
        return segment
    if not view.crosses:
        raise UsageError(
            f"arm B sees the scene with {view.name}: both cameras transfer along the same axis, and a single "
            "arm does not show a scene",
            possible="turn 90 or 270",
            hint="turn one of the cameras by 90 degrees",
        )
    if view.mirrored:
        segment = segment.mirrored(1)
    return segment.swapped() if view.swapped else segment


def correlations(a: NDArray[Any], b: NDArray[Any]) -> dict[View, tuple[float, tuple[float, float]]]:
    """How well camera B's image fits camera A's in each view, and at which shift, in pixels of the images.

    Both are (M, M) in their camera's own rows and columns; of each the mean is taken away, and what is
    smooth: two views of one lamp are alike too.
    """
    left = _whitened(a)
    return {view: _peak(left, _whitened(view.unseen(b))) for view in VIEWS}


def _whitened(image: NDArray[Any]) -> NDArray[np.float64]:
    from scipy.ndimage import gaussian_filter

    rough: NDArray[np.float64] = image - gaussian_filter(image.astype(np.float64), 4.0, mode="nearest")
    window = np.hanning(len(image) + 2)[1:-1]
    flat: NDArray[np.float64] = (rough - rough.mean()) * np.sqrt(np.outer(window, window))
    return flat / max(float(np.linalg.norm(flat)), 1e-30)


def _peak(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[float, tuple[float, float]]:
    """Largest normalised cross-correlation, and the shift of ``b`` beside ``a``."""
    size = 2 * len(a)
    product = np.conj(np.fft.rfft2(a, (size, size))) * np.fft.rfft2(b, (size, size))
    found = np.fft.irfft2(product, (size, size))
    shift = np.fft.fftfreq(size, 1 / size)
    far = np.abs(shift) > FARTHEST * len(a)
    found[far, :], found[:, far] = -1, -1
    row, column = np.unravel_index(found.argmax(), found.shape)
    return float(found[row, column]), (float(shift[row]), float(shift[column]))
