"""Total variation of coefficient frames, with a prox that remembers its dual field between calls."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import UsageError
from acquire.recon.kernels import tv_prox, tv_value

if TYPE_CHECKING:
    from numpy.typing import NDArray

LARGEST_WEIGHT = 1e6
"""Weights are capped here: every frame is flat long before, and 1/λ stays representable."""


class FrameTv:
    """Isotropic 2-D TV, frame by frame (Section 4 of the paper).

    ``prox`` is approximate: ``iterations`` of fast gradient projection from where the last call ended.
    """

    def __init__(self, shape: tuple[int, int, int], iterations: int, dtype: np.dtype[Any]) -> None:
        if iterations < 1:
            raise UsageError(f"{iterations} iterations of the TV prox", possible="1 or more")
        self.iterations = iterations
        self._dual = np.zeros((shape[0], 2, *shape[1:]), dtype)

    def value(self, frames: NDArray[Any]) -> float:
        """Σ_k TV(frames[k])."""
        values = np.empty(len(frames))
        tv_value(frames, values)
        return float(values.sum())

    def prox(self, frames: NDArray[Any], weight: float | NDArray[Any]) -> NDArray[Any]:
        """argmin_x ½‖x − frames‖² + Σ_k weight_k·TV(x_k); ``weight`` is one number or (K,)."""
        out = np.empty_like(frames)
        weights = np.empty(len(frames), frames.dtype)
        weights[:] = np.minimum(weight, LARGEST_WEIGHT)
        tv_prox(frames, weights, self._dual, self.iterations, out)
        return out
