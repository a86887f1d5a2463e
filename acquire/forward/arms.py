"""Both arms: the sensing matrix Λ′ of Eq. (4) as an operator.

Camera B looks at the scene turned by 90° counter-clockwise: its rows are the scene's columns from right to
left, its pixels the scene's rows. Its lines therefore come from the transposed frames, with the rows flipped.
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
    code : (T,) exposure bits E of the sub-steps that the lines touch
    spatial_merge, temporal_merge : N_m, T_m ≥ 1; a voxel's value is held over its block
    dtype : float32 or float64, of voxels and lines
    alignment : position of arm B's image relative to arm A's; None if they coincide
    blur : of each arm's optics; None if there is none
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
        self._transposed = np.empty(self.video_shape, dtype)  # reused: a video can be large
        arrays = Arrays(dtype="float32" if self.dtype == np.float32 else "float64")
        self._registration = registration(alignment, geometry, spatial_merge, arrays)
        self._blurring = blurring(blur, geometry, spatial_merge, arrays)

    def forward(self, video: NDArray[Any]) -> NDArray[Any]:
        """Λ′·X′: (⌈T/T_m⌉, ⌈n/N_m⌉, ⌈n/N_m⌉) → (2, L_R, M)."""
        video = self._checked(video, self.video_shape, "video")
        # registration first, then blur: each arm blurs the view that it gets; `adjoint` goes back in reverse
        view_b = video if self._registration is None else self._registration.forward(video)
        if self._blurring is not None:
            video, view_b = self._blurring.forward(0, video), self._blurring.forward(1, view_b)
        transpose_frames(view_b, self._transposed)
        return np.stack([self._a.forward(video), self._b.forward(self._transposed)])

    def adjoint(self, lines: NDArray[Any]) -> NDArray[Any]:
        """Λ′ᵀ·Y: (2, L_R, M) → (⌈T/T_m⌉, ⌈n/N_m⌉, ⌈n/N_m⌉)."""
        lines = self._checked(lines, self.lines_shape, "lines")
        video = self._a.adjoint(lines[0])
        from_b = self._b.adjoint(lines[1])
        if self._registration is None and self._blurring is None:
            add_transposed_frames(from_b, video)
            return video
        transpose_frames(from_b, self._transposed)
        view_b = self._transposed
        if self._blurring is not None:
            video, view_b = self._blurring.adjoint(0, video), self._blurring.adjoint(1, view_b)
        video += view_b if self._registration is None else self._registration.adjoint(view_b)
        return video

    def norm_bound(self, steps: int = 10) -> float:
        """Return a rigorous upper bound of ‖Λ′‖₂, within a percent of it after ten steps.

        By Collatz–Wielandt, max_i (ΛᵀΛv)_i / v_i is a bound for a non-negative Λ and any positive v. Voxels
        that no line samples (E = 0 in all their sub-steps) are left out.

        Raises
        ------
        NumericsError : the code leaves every voxel dark (E ≡ 0), so that nothing can be measured
        """
        v = np.ones(self.video_shape, self.dtype)
        sampled = self.adjoint(np.ones(self.lines_shape, self.dtype)) > 0
        if not sampled.any():
            raise NumericsError(
                "the exposure code is dark for the whole segment", hint="another code or segment"
            )
        v[~sampled] = 0
        bound = np.inf
        for _ in range(steps):
            # every v gives a bound; power iteration turns v into the one for which it is tight
            w = self.adjoint(self.forward(v))
            # frame by frame and in place: a video of a large sensor is a gigabyte
            ratios = (
                float((a[lit] / b[lit]).max(initial=0)) for a, b, lit in zip(w, v, sampled, strict=True)
            )
            bound = min(bound, max(ratios))
            w /= w.max()
            v = w
            # v must stay positive for the bound to hold; it could underflow.
            np.maximum(v, np.finfo(self.dtype).tiny ** 0.5, out=v, where=sampled)
        return float(np.sqrt(bound * (1 + 8 * np.finfo(self.dtype).eps)))  # rounding must not undercut it

    def _checked(self, array: NDArray[Any], shape: tuple[int, ...], what: str) -> NDArray[Any]:
        if array.shape != shape:
            raise UsageError(f"{what} of shape {array.shape} does not fit the operator", possible=f"{shape}")
        return np.ascontiguousarray(array, dtype=self.dtype)
