"""Compiled loops of the isotropic 2-D total-variation prox, frame by frame.

    prox(b) = argmin_x ½‖x − b‖² + λ·TV(x),    TV(x) = Σ √((x_{r+1,c} − x_{r,c})² + (x_{r,c+1} − x_{r,c})²)

by fast gradient projection on the dual field (p, q), |(p, q)| ≤ 1 (Beck and Teboulle, IEEE Trans. Image
Process. 18, 2419 (2009)): x = b + λ·div(p, q). The dual field is kept by the caller, so that successive
calls on slowly changing frames start where the last one ended. Frames are independent and run in parallel.
An own kernel because library versions are several times slower (tools/bench_tv.py).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numba
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_FAST = {"contract", "reassoc", "nsz", "arcp"}


@numba.njit(parallel=True, cache=True, fastmath=_FAST)
def tv_prox(
    frames: NDArray[Any],
    weights: NDArray[Any],
    dual: NDArray[Any],
    iterations: int,
    out: NDArray[Any],
) -> None:
    """out[k] = prox of weights[k]·TV at frames[k]; dual (k, 2, r, c) is updated."""
    for k in numba.prange(frames.shape[0]):
        weight = weights[k]
        if weight <= 0:  # the prox is the identity; 1/λ would not be finite
            out[k] = frames[k]
            continue
        ahead = dual[k].copy()
        momentum = 1.0
        for _ in range(iterations):
            _primal(frames[k], ahead, weight, out[k])
            following = (1 + np.sqrt(1 + 4 * momentum * momentum)) / 2
            _dual_step(out[k], weight, (momentum - 1) / following, dual[k], ahead)
            momentum = following
        _primal(frames[k], dual[k], weight, out[k])


@numba.njit(cache=True, fastmath=_FAST)
def _primal(b: NDArray[Any], dual: NDArray[Any], weight: float, x: NDArray[Any]) -> None:
    """x = b + weight·div(p, q), the last row of p and the last column of q being 0."""
    p, q = dual
    rows, columns = b.shape
    for r in range(rows):
        for c in range(columns):
            x[r, c] = b[r, c] + weight * (p[r, c] + q[r, c])
        if r > 0:
            for c in range(columns):
                x[r, c] -= weight * p[r - 1, c]
        for c in range(1, columns):
            x[r, c] -= weight * q[r, c - 1]


@numba.njit(cache=True, fastmath=_FAST)
def _dual_step(x: NDArray[Any], weight: float, push: float, dual: NDArray[Any], ahead: NDArray[Any]) -> None:
    """One projected step of length 1/(8·weight) from ``ahead``; ``dual`` becomes the new point."""
    p, q = dual
    rows, columns = x.shape
    step = x.dtype.type(1 / (8 * weight))
    push = x.dtype.type(push)
    one = x.dtype.type(1)
    zero = x.dtype.type(0)
    for r in range(rows):
        last_row = r == rows - 1
        below = x[r] if last_row else x[r + 1]
        for c in range(columns):
            right = x[r, c + 1] if c < columns - 1 else x[r, c]
            new_p = ahead[0, r, c] + step * (below[c] - x[r, c])
            new_q = ahead[1, r, c] + step * (right - x[r, c])
            shrink = one / max(one, np.sqrt(new_p * new_p + new_q * new_q))
            new_p = zero if last_row else new_p * shrink
            new_q = zero if c == columns - 1 else new_q * shrink
            ahead[0, r, c] = new_p + push * (new_p - p[r, c])
            ahead[1, r, c] = new_q + push * (new_q - q[r, c])
            p[r, c] = new_p
            q[r, c] = new_q


@numba.njit(parallel=True, cache=True, fastmath=_FAST)
def tv_value(frames: NDArray[Any], out: NDArray[np.float64]) -> None:
    """out[k] = TV of frames[k], accumulated in float64."""
    rows, columns = frames.shape[1:]
    for k in numba.prange(frames.shape[0]):
        total = 0.0
        for r in range(rows):
            for c in range(columns):
                x = frames[k, r, c]
                down = frames[k, r + 1, c] - x if r < rows - 1 else x - x
                right = frames[k, r, c + 1] - x if c < columns - 1 else x - x
                total += np.sqrt(down * down + right * right)
        out[k] = total
