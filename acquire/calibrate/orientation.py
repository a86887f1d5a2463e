"""Arm B's orientation: which of eight views of the scene it has, and the correction of its lines.

A view is the scene, optionally mirrored left to right, then turned counter-clockwise, as in scene files. The
dual arm needs B's charge to move across A's: a turn of 90 or 270 degrees.

    turn 90             the model's own
    turn 270            the arms are swapped: B is what the model calls A
    turn 270, mirrored  B's pixels are in the wrong order
    turn 90, mirrored   both
    turn 0 or 180       both cameras transfer along the same axis, which cannot be corrected
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
"""Least ratio of the best view's correlation to the next one's for a clear result."""
LEAST_CORRELATION = 0.25
FARTHEST = 0.25
"""Largest shift that is tried, relative to the field."""


@dataclass(frozen=True, slots=True)
class View:
    """One arm's view of the scene, by name and as a map of frames."""

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
        """Return the scene (…, row, column) in this view."""
        shown = frames[..., ::-1] if self.mirrored else frames
        return np.rot90(shown, self.turn_deg // 90, axes=(-2, -1))

    def restored(self, frames: NDArray[Any]) -> NDArray[Any]:
        """Return the scene of frames in this view: the inverse of `seen`."""
        turned = np.rot90(frames, -(self.turn_deg // 90), axes=(-2, -1))
        return turned[..., ::-1] if self.mirrored else turned


# the model's own first: sorting by correlation leaves it in front of an equal one
VIEWS = tuple(View(turn, mirrored) for mirrored in (False, True) for turn in (90, 270, 0, 180))
MODEL = VIEWS[0]
"""Arm B's view in Eq. (4)."""


def view_named(name: str) -> View:
    """Return the view of that name. Raises UsageError if there is none."""
    views = {view.name: view for view in VIEWS}
    if name not in views:
        raise UsageError(f"there is no orientation {name!r}", possible="; ".join(views))
    return views[name]


def oriented(segment: Segment, view: View) -> Segment:
    """Convert the lines of an instrument whose arm B has ``view`` to those that the model expects.

    If the arms are swapped, the video shows camera B's view. Raises UsageError if both cameras transfer along
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
    """Return for each view the largest correlation of camera B's image with camera A's, and its shift there.

    The shift is that of B relative to A, in pixels. Both images are (M, M) in their camera's own rows and
    columns. Mean and smooth parts are removed, because different views of one lamp are alike in these.
    """
    # padded to twice the size, so that shifted images do not wrap around
    size = 2 * len(a)
    shift = np.fft.fftfreq(size, 1 / size)
    far = np.abs(shift) > FARTHEST * len(a)
    # By the correlation theorem: the transform of a cross-correlation is conj(A)·B.
    left = np.conj(np.fft.rfft2(_whitened(a), (size, size)))
    found = {}
    for view in VIEWS:
        product = left * np.fft.rfft2(_whitened(view.restored(b)), (size, size))
        correlation = np.fft.irfft2(product, (size, size))
        correlation[far, :], correlation[:, far] = -1, -1
        row, column = np.unravel_index(correlation.argmax(), correlation.shape)
        found[view] = float(correlation[row, column]), (float(shift[row]), float(shift[column]))
    return found


def _whitened(image: NDArray[Any]) -> NDArray[np.float64]:
    from scipy.ndimage import gaussian_filter  # scipy, which a capture host lacks

    rough: NDArray[np.float64] = image - gaussian_filter(image.astype(np.float64), 4.0, mode="nearest")
    # without the window's zeros at either end
    window = np.hanning(len(image) + 2)[1:-1]
    # the root, because two images are multiplied
    flat: NDArray[np.float64] = (rough - rough.mean()) * np.sqrt(np.outer(window, window))
    return flat / max(float(np.linalg.norm(flat)), 1e-30)
