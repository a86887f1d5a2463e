"""One arm: Y = A·M_T·M_N·X′·C_N of Eq. (3) and its transpose, without forming any of the matrices."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError
from acquire.forward.kernels import blocks_to_pixels, pixels_to_blocks, shear, unshear
from acquire.forward.merge import block_bounds

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.geometry import Geometry


class TdiArm:
    """The lines of one TDI sensor that looks at voxels (frame, row block, column block).

    ``flipped`` reverses the order of the rows on their way to the register: A_B = fliplr(A_A) by group of n.
    The rows are then blocks of the scene's columns, in the scene's order.
    """

    def __init__(
        self,
        geometry: Geometry,
        code: NDArray[np.uint8],
        spatial_merge: int = 1,
        temporal_merge: int = 1,
        *,
        flipped: bool = False,
        dtype: type[np.floating[Any]] = np.float32,
    ) -> None:
        self.voxels_shape = geometry.video_shape(spatial_merge, temporal_merge)
        self.lines_shape = (geometry.lines, geometry.stages)
        self.dtype = np.dtype(dtype)
        code = np.asarray(code)
        if code.shape != (geometry.span,):
            raise UsageError(
                f"an exposure code of shape {code.shape} does not fit",
                possible=f"({geometry.span},): T = S·(M + L_R) − 1 bits",
            )
        if not np.isin(code, (0, 1)).all():
            raise UsageError("the exposure code has values other than 0 and 1", possible="E ∈ {0, 1}")
        self._code = np.ascontiguousarray(code, dtype=np.uint8)
        self._starts, self._lengths = block_bounds(geometry.size, spatial_merge)
        if flipped:
            self._starts = geometry.size - self._starts - self._lengths
        self._n, self._S = geometry.size, geometry.substeps
        self._N_m, self._T_m = spatial_merge, temporal_merge

    def forward(self, voxels: NDArray[Any]) -> NDArray[Any]:
        """Return the lines of voxels: (T/T_m, n/N_m, n/N_m) → (L_R, M)."""
        # `np.empty`, because the loops write every element before they add to it
        sheared = np.empty((self.lines_shape[0], self.voxels_shape[2]), self.dtype)
        shear(voxels, self._code, self._starts, self._lengths, S=self._S, T_m=self._T_m, out=sheared)
        pixels: NDArray[Any] = blocks_to_pixels(sheared, self._n, self._S, self._N_m)
        return pixels

    def adjoint(self, lines: NDArray[Any]) -> NDArray[Any]:
        """Apply the transpose: (L_R, M) → (T/T_m, n/N_m, n/N_m)."""
        voxels = np.empty(self.voxels_shape, self.dtype)
        spread = pixels_to_blocks(lines, self._n, self._S, self._N_m)
        unshear(spread, self._code, self._starts, self._lengths, S=self._S, T_m=self._T_m, out=voxels)
        return voxels
