"""Both arms: the sensing matrix Λ′ of Eq. (4) as an operator.

Camera B looks at the scene turned by 90° counter-clockwise: its rows are the scene's columns from right to
left, its pixels the scene's rows. So its lines come from the frames transposed, with the rows flipped.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.arrays import Arrays
from acquire.errors import NumericsError, UsageError
from acquire.forward.blurring import blurring
from acquire.forward.kernels import add_transposed_frames, transpose_frames
from acquire.forward.registration import registration
from acquire.forward.tdi import TdiArm

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.alignment import Alignment
    from acquire.blur import Blur
    from acquire.geometry import Geometry


class DualArm:
    """Y_V = Λ′·X′_V (Eq. 4): video (time, row, column) → lines (arm, line, pixel), and the transpose.

    Parameters
    ----------
    geometry : M, S, L_R
    code : (T,) exposure bits E of the sub-steps touched
    spatial_merge, temporal_merge : N_m, T_m ≥ 1; a voxel's value is held over its block
    dtype : float32 or float64, of voxels and lines
    alignment : where arm B's image lies beside arm A's; absent: on it
    blur : of either arm's optics; absent: none
    """

    def __init__(
        self,
        geometry: Geometry,
        code: NDArray[np.uint8],
        spatial_merge: int = 1,
        temporal_merge: int = 1,
        dtype: type[np.floating[Any]] = np.float32,
        alignment: Alignment | None = None,
        blur: Blur | None = None,
    ) -> None:
        if np.dtype(dtype) not in (np.dtype(np.float32), np.dtype(np.float64)):
            raise UsageError(f"an operator cannot have dtype {np.dtype(dtype)}", possible="float32, float64")
        self.geometry = geometry
        self.spatial_merge = spatial_merge
        self.temporal_merge = temporal_merge
        self.dtype = np.dtype(dtype)
        self.video_shape = geometry.video_shape(spatial_merge, temporal_merge)
        self.lines_shape = geometry.lines_shape
        self._a = TdiArm(geometry, code, spatial_merge, temporal_merge, dtype=dtype)
        self._b = TdiArm(geometry, code, spatial_merge, temporal_merge, flipped=True, dtype=dtype)
        self._turned = np.empty(self.video_shape, dtype)
        arrays = Arrays(dtype="float32" if self.dtype == np.float32 else "float64")
        self._registration = registration(alignment, geometry, spatial_merge, arrays)
        self._blurring = blurring(blur, geometry, spatial_merge, arrays)

    def forward(self, video: NDArray[Any]) -> NDArray[Any]:
        """Λ′·X′: (⌈T/T_m⌉, ⌈n/N_m⌉, ⌈n/N_m⌉) → (2, L_R, M)."""
        video = self._checked(video, self.video_shape, "video")
        seen = video if self._registration is None else self._registration.forward(video)
        if self._blurring is not None:
            video, seen = self._blurring.forward(0, video), self._blurring.forward(1, seen)
        transpose_frames(seen, self._turned)
        return np.stack([self._a.forward(video), self._b.forward(self._turned)])

    def adjoint(self, lines: NDArray[Any]) -> NDArray[Any]:
        """Λ′ᵀ·Y: (2, L_R, M) → (⌈T/T_m⌉, ⌈n/N_m⌉, ⌈n/N_m⌉)."""
        lines = self._checked(lines, self.lines_shape, "lines")
        video = self._a.adjoint(lines[0])
        seen = self._b.adjoint(lines[1])
        if self._registration is None and self._blurring is None:
            add_transposed_frames(seen, video)
            return video
        transpose_frames(seen, self._turned)
        back = self._turned
        if self._blurring is not None:
            video, back = self._blurring.adjoint(0, video), self._blurring.adjoint(1, back)
        video += back if self._registration is None else self._registration.adjoint(back)
        return video

    def norm_bound(self, steps: int = 10) -> float:
        """A rigorous upper bound of ‖Λ′‖₂ (Collatz–Wielandt: max_i (ΛᵀΛv)_i / v_i for a non-negative Λ).

        Voxels that no line sees (E = 0 in all their sub-steps) have no say. Within a percent after ten steps.

        Raises
        ------
        NumericsError : the code leaves every voxel dark (E ≡ 0); nothing can be measured
        """
        v = np.ones(self.video_shape, self.dtype)
        seen = self.adjoint(np.ones(self.lines_shape, self.dtype)) > 0
        if not seen.any():
            raise NumericsError(
                "the exposure code is dark for the whole segment", hint="another code or segment"
            )
        v[~seen] = 0
        bound = np.inf
        for _ in range(steps):
            w = self.adjoint(self.forward(v))
            bound = min(bound, float((w[seen] / v[seen]).max()))
            v = w / w.max()
            v[seen] = np.maximum(v[seen], np.finfo(self.dtype).tiny ** 0.5)
        return float(np.sqrt(bound * (1 + 8 * np.finfo(self.dtype).eps)))

    def _checked(self, array: NDArray[Any], shape: tuple[int, ...], what: str) -> NDArray[Any]:
        if array.shape != shape:
            raise UsageError(f"{what} of shape {array.shape} does not fit the operator", possible=f"{shape}")
        return np.ascontiguousarray(array, dtype=self.dtype)
