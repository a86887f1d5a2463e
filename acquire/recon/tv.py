"""Total variation of coefficient frames, with a prox that keeps its dual field between calls.

Numpy arrays use the compiled loops of `kernels`, other arrays the same algorithm on all frames at once.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from array_api_compat import is_numpy_array

from acquire.arrays import namespace
from acquire.errors import UsageError
from acquire.recon.kernels import SMALLEST_WEIGHT, joint_tv_prox, tv_prox, tv_value

if TYPE_CHECKING:
    from acquire.arrays import Array

FLATTENING_WEIGHT = 1e6
"""Limit of the weights, at which every frame has long been flat and 1/λ is still representable."""


class FrameTv:
    """Isotropic 2-D TV, frame by frame (Section 4 of the paper); ``joint``: of frames with common edges.

    ``prox`` is approximate: ``iterations`` of fast gradient projection from where the last call ended.
    """

    def __init__(self, iterations: int, *, joint: bool = False) -> None:
        if iterations < 1:
            raise UsageError(f"the TV prox cannot have {iterations} iterations", possible="1 or more")
        self.iterations = iterations
        self._joint = joint
        self._dual: Array = None

    def resume(self, other: FrameTv) -> None:
        """Start from the dual field of another."""
        self._dual = None if other._dual is None else namespace(other._dual).asarray(other._dual, copy=True)

    def value(self, frames: Array) -> float:
        """Σ_k TV(frames[k]); if joint, Σ over the pixels of √(Σ_k |∇frames[k]|²)."""
        if is_numpy_array(frames) and not self._joint:
            values = np.empty(len(frames))
            tv_value(frames, values)
            return float(values.sum())
        xp = namespace(frames)
        squares = self._together(ahead(frames, 1) ** 2 + ahead(frames, 2) ** 2)
        return float(xp.sum(xp.sqrt(squares), dtype=xp.float64))

    def prox(self, frames: Array, weight: float | Array) -> Array:
        """argmin_x ½‖x − frames‖² + Σ_k weight_k·TV(x_k); ``weight`` is one number or (K,).

        If joint, the second term is the `value` of weight_k·x_k. All calls need frames of the same shape.
        """
        xp = namespace(frames)
        capped = (
            min(weight, FLATTENING_WEIGHT)
            if isinstance(weight, float)
            else xp.minimum(weight, FLATTENING_WEIGHT)
        )
        # (K,) in the frames' dtype, whether one number was given or K.
        weights = xp.zeros_like(frames[:, 0, 0]) + capped
        if self._dual is None:
            self._dual = xp.stack([xp.zeros_like(frames)] * 2, axis=1)
        if not is_numpy_array(frames):
            return self._prox_of_all(frames, weights)
        out = np.empty_like(frames)
        (joint_tv_prox if self._joint else tv_prox)(frames, weights, self._dual, self.iterations, out)
        return out

    def _together(self, squares: Array) -> Array:
        """(k, r, c) of each frame, or (1, r, c) of all if they are joint."""
        return namespace(squares).sum(squares, axis=0, keepdims=True) if self._joint else squares

    def _prox_of_all(self, frames: Array, weights: Array) -> Array:
        """As the compiled loops; p is the dual's part along the rows' axis, q that along the columns'."""
        xp, scale = namespace(frames), weights[:, None, None]
        # The weight is not 0, by which the dual step would be divided; the last line makes such frames the
        # identity.
        used = xp.maximum(scale, SMALLEST_WEIGHT)
        step = used / (8 * (xp.max(used) if self._joint else used) ** 2)
        p, q = self._dual[:, 0, ...], self._dual[:, 1, ...]
        p_ahead, q_ahead, momentum = p, q, 1.0
        for _ in range(self.iterations):
            x = frames + used * _divergence(p_ahead, q_ahead)
            # `ahead` is 0 at the ends, so that p and q stay 0 there, as `_divergence` requires.
            new_p, new_q = p_ahead + step * ahead(x, 1), q_ahead + step * ahead(x, 2)
            length = xp.maximum(xp.sqrt(self._together(new_p**2 + new_q**2)), 1)
            new_p, new_q = new_p / length, new_q / length
            following = (1 + math.sqrt(1 + 4 * momentum**2)) / 2
            push, momentum = (momentum - 1) / following, following
            p_ahead, q_ahead = new_p + push * (new_p - p), new_q + push * (new_q - q)
            p, q = new_p, new_q
        self._dual = xp.stack([p, q], axis=1)
        return xp.where(scale < SMALLEST_WEIGHT, frames, frames + used * _divergence(p, q))


def ahead(x: Array, axis: int) -> Array:
    """x_{i+1} − x_i along one of three axes, 0 at its end."""
    return namespace(x).diff(x, axis=axis, append=x[layer(axis, -1)])


def layer(axis: int, at: int) -> tuple[slice, ...]:
    """The first (0) or last (−1) layer along an axis of a volume."""
    return tuple(slice(at, at + 1 or None) if each == axis else slice(None) for each in range(3))


def _divergence(p: Array, q: Array) -> Array:
    """The negative transpose of `ahead` along both axes, for p and q that are 0 at their ends."""
    xp = namespace(p)
    return xp.diff(p, axis=1, prepend=xp.zeros_like(p[:, :1, :])) + xp.diff(
        q, axis=2, prepend=xp.zeros_like(q[:, :, :1])
    )
