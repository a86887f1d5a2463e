"""Compiled loops of the solvers, above all the isotropic 2-D total-variation prox.

    prox(b) = argmin_x ½‖x − b‖² + λ·TV(x),    TV(x) = Σ √((x_{r+1,c} − x_{r,c})² + (x_{r,c+1} − x_{r,c})²)

by fast gradient projection on the dual field (p, q), |(p, q)| ≤ 1 (Beck and Teboulle, IEEE Trans. Image
Process. 18, 2419 (2009)): x = b + λ·div(p, q). The caller keeps the dual field, so that successive calls on
slowly changing frames start where the last one ended. Frames are independent and run in parallel. Library
versions are several times slower (tools/bench_tv.py).

Frames k with edges in common have the prox of Σ √(Σ_k λ_k²·|∇x_k|²) (vectorial total variation, Bresson and
Chan, Inverse Probl. Imaging 2, 455 (2008)): x_k = b_k + λ_k·div(p_k, q_k), Σ_k |(p_k, q_k)|² ≤ 1.

Also those of the prox in three dimensions (`volume`), of the split of the sign (`sign`) and of a veil
(`band`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numba
import numpy as np

from acquire.loops import compiled

if TYPE_CHECKING:
    from numpy.typing import NDArray

SMALLEST_WEIGHT = 1e-12
"""Weight below which the prox is the identity: it changes no pixel by more than 4·λ, and 1/λ² would
overflow."""

SIGN_PIXELS = 1024
"""Pixels of all coefficients that are handled together: they stay in a core's nearest cache."""

# nnan and ninf are left out: solvers notice that they diverge by values that are not finite.
_FAST = {"contract", "reassoc", "nsz", "arcp"}


@compiled(parallel=True, fastmath=_FAST)
def tv_prox(
    frames: NDArray[Any],
    weights: NDArray[Any],
    dual: NDArray[Any],
    iterations: int,
    out: NDArray[Any],
) -> None:
    """out[k] = prox of weights[k]·TV at frames[k]; dual (k, 2, r, c) is updated."""
    for k in numba.prange(frames.shape[0]):
        if weights[k] < SMALLEST_WEIGHT:
            out[k] = frames[k]
            continue
        ahead = dual[k].copy()
        momentum = 1.0
        for _ in range(iterations):
            _primal(frames[k], ahead[0], ahead[1], weights[k], out[k])
            following = (1 + np.sqrt(1 + 4 * momentum * momentum)) / 2
            # It has the frames' dtype: with a float64, the loops would compute in double precision.
            push = out.dtype.type((momentum - 1) / following)
            _dual_step(out[k], weights[k], push, dual[k, 0], dual[k, 1], ahead[0], ahead[1])
            momentum = following
        _primal(frames[k], dual[k, 0], dual[k, 1], weights[k], out[k])


@compiled(fastmath=_FAST)
def _primal(b: NDArray[Any], p: NDArray[Any], q: NDArray[Any], weight: float, x: NDArray[Any]) -> None:
    """x = b + weight·div(p, q), the last row of p and the last column of q being 0."""
    rows, columns = b.shape
    for r in range(rows):
        x[r, 0] = b[r, 0] + weight * (p[r, 0] + q[r, 0])
        for c in range(1, columns):
            x[r, c] = b[r, c] + weight * (p[r, c] + q[r, c] - q[r, c - 1])
        if r > 0:
            for c in range(columns):
                x[r, c] -= weight * p[r - 1, c]


@compiled(fastmath=_FAST)
def _dual_step(
    x: NDArray[Any],
    weight: float,
    push: float,
    p: NDArray[Any],
    q: NDArray[Any],
    p_ahead: NDArray[Any],
    q_ahead: NDArray[Any],
) -> None:
    """One projected step of length 1/(8·weight) from the point ahead; (p, q) becomes the new point.

    The last row and column have no neighbour ahead; they are treated separately, so that the rest is free of
    branches and the compiler can use vector instructions.
    """
    rows, columns = x.shape
    # 8 bounds the squared norm of the differences along two axes: a longer step may diverge.
    one, step = x.dtype.type(1), x.dtype.type(1) / (x.dtype.type(8) * weight)
    for r in range(rows - 1):
        for c in range(columns - 1):
            new_p = p_ahead[r, c] + step * (x[r + 1, c] - x[r, c])
            new_q = q_ahead[r, c] + step * (x[r, c + 1] - x[r, c])
            shrink = one / max(one, np.sqrt(new_p * new_p + new_q * new_q))
            new_p *= shrink
            new_q *= shrink
            p_ahead[r, c] = new_p + push * (new_p - p[r, c])
            q_ahead[r, c] = new_q + push * (new_q - q[r, c])
            p[r, c] = new_p
            q[r, c] = new_q
    for r in range(rows - 1):
        new_p = p_ahead[r, -1] + step * (x[r + 1, -1] - x[r, -1])
        new_p /= max(one, abs(new_p))
        p_ahead[r, -1] = new_p + push * (new_p - p[r, -1])
        p[r, -1] = new_p
    for c in range(columns - 1):
        new_q = q_ahead[-1, c] + step * (x[-1, c + 1] - x[-1, c])
        new_q /= max(one, abs(new_q))
        q_ahead[-1, c] = new_q + push * (new_q - q[-1, c])
        q[-1, c] = new_q


@compiled(parallel=True, fastmath=_FAST)
def joint_tv_prox(
    frames: NDArray[Any],
    weights: NDArray[Any],
    dual: NDArray[Any],
    iterations: int,
    out: NDArray[Any],
) -> None:
    """out = prox at all frames together, with edges in common; dual (k, 2, r, c) is updated."""
    largest = weights.max()
    if largest < SMALLEST_WEIGHT:
        out[:] = frames
        return
    rows = frames.shape[1]
    # The gradient of the dual problem of all frames has a Lipschitz constant of 8·(largest weight)².
    steps = weights / (8 * largest * largest)
    ahead = dual.copy()
    momentum = 1.0
    for _ in range(iterations):
        # There are two loops: the dual step of a row needs the primal's next row, and the primal the dual's
        # row before.
        for r in numba.prange(rows):
            _joint_primal(frames, ahead, r, weights, out)
        following = (1 + np.sqrt(1 + 4 * momentum * momentum)) / 2
        push = out.dtype.type((momentum - 1) / following)
        for r in numba.prange(rows):
            _joint_dual_step(out, r, steps, push, dual, ahead)
        momentum = following
    for r in numba.prange(rows):
        _joint_primal(frames, dual, r, weights, out)


@compiled(fastmath=_FAST)
def _joint_primal(
    b: NDArray[Any], dual: NDArray[Any], r: int, weights: NDArray[Any], x: NDArray[Any]
) -> None:
    """Row r of every frame of x = b + weights·div(dual)."""
    count, _, columns = b.shape
    for k in range(count):
        weight, p, q, row = weights[k], dual[k, 0, r], dual[k, 1, r], x[k, r]
        row[0] = b[k, r, 0] + weight * (p[0] + q[0])
        for c in range(1, columns):
            row[c] = b[k, r, c] + weight * (p[c] + q[c] - q[c - 1])
        if r > 0:
            above = dual[k, 0, r - 1]
            for c in range(columns):
                row[c] -= weight * above[c]


@compiled(fastmath=_FAST)
def _joint_dual_step(
    x: NDArray[Any], r: int, steps: NDArray[Any], push: float, dual: NDArray[Any], ahead: NDArray[Any]
) -> None:
    """One projected step of row r of every frame; the last row and column have no neighbour ahead."""
    count, rows, columns = x.shape
    squares = np.zeros(columns, x.dtype)
    for k in range(count):
        step, p, q, row = steps[k], ahead[k, 0, r], ahead[k, 1, r], x[k, r]
        if r < rows - 1:
            below = x[k, r + 1]
            for c in range(columns):
                p[c] += step * (below[c] - row[c])
        for c in range(columns - 1):
            q[c] += step * (row[c + 1] - row[c])
        for c in range(columns):
            squares[c] += p[c] * p[c] + q[c] * q[c]
    one = x.dtype.type(1)
    for c in range(columns):
        squares[c] = one / max(one, np.sqrt(squares[c]))
    for k in range(count):
        for part in range(2):
            new, old = ahead[k, part, r], dual[k, part, r]
            for c in range(columns):
                at = new[c] * squares[c]
                new[c] = at + push * (at - old[c])
                old[c] = at


@compiled(parallel=True, fastmath=_FAST)
def tv_value(frames: NDArray[Any], out: NDArray[np.float64]) -> None:
    """out[k] = TV of frames[k], accumulated in float64."""
    rows, columns = frames.shape[1:]
    for k in numba.prange(frames.shape[0]):
        total = 0.0
        for r in range(rows):
            for c in range(columns):
                x = frames[k, r, c]
                # It is x − x and not 0.0, which would make both branches float64.
                down = frames[k, r + 1, c] - x if r < rows - 1 else x - x
                right = frames[k, r, c + 1] - x if c < columns - 1 else x - x
                total += np.sqrt(down * down + right * right)
        out[k] = total


def _volume_prox(
    volume: NDArray[Any],
    weight: float,
    pace: float,
    cyclic: bool,
    dual: NDArray[Any],
    iterations: int,
    out: NDArray[Any],
) -> None:
    """out = prox of weight·TV₃ at the volume (t, r, c); dual (3, t, r, c) is updated.

    TV₃(x) = Σ √(|∇x|² + (pace·∂x/∂t)²): the gradient's norm is at most √(8 + 4·pace²). In a ``cyclic``
    volume the first instant follows the last one.
    """
    instants = volume.shape[0]
    after_last = 0 if cyclic else instants - 1
    ahead = dual.copy()
    momentum = 1.0
    step = volume.dtype.type(1 / ((8 + 4 * pace * pace) * weight))
    for _ in range(iterations):
        for t in numba.prange(instants):
            _volume_primal(volume, ahead, t, weight, pace, out[t])
        following = (1 + np.sqrt(1 + 4 * momentum * momentum)) / 2
        push = volume.dtype.type((momentum - 1) / following)
        for t in numba.prange(instants):
            after = t + 1 if t + 1 < instants else after_last
            _volume_dual_step(out, t, after, step, pace, push, dual, ahead)
        momentum = following
    for t in numba.prange(instants):
        _volume_primal(volume, dual, t, weight, pace, out[t])


@compiled(fastmath=_FAST)
def _volume_primal(
    b: NDArray[Any], dual: NDArray[Any], t: int, weight: float, pace: float, x: NDArray[Any]
) -> None:
    """x = b + weight·div(dual) at one instant; duals of differences that leave the volume are 0."""
    _primal(b[t], dual[0, t], dual[1, t], weight, x)
    w = x.dtype.type(weight * pace)
    rows, columns = x.shape
    # At the first instant, the one before is the last: the difference across the ends of a cycle, otherwise
    # 0.
    before = dual[2, t - 1]
    for r in range(rows):
        for c in range(columns):
            x[r, c] += w * (dual[2, t, r, c] - before[r, c])


@compiled(fastmath=_FAST)
def _volume_dual_step(
    x: NDArray[Any],
    t: int,
    after: int,
    step: float,
    pace: float,
    push: float,
    dual: NDArray[Any],
    ahead: NDArray[Any],
) -> None:
    """One projected step from the point ahead, as `_dual_step` in three dimensions.

    ``after`` is the instant that follows ``t``: ``t`` itself where none does.
    """
    _, rows, columns = x.shape
    one, slow = x.dtype.type(1), x.dtype.type(step * pace)
    for r in range(rows):
        # Where there is no neighbour, it is the voxel itself: a difference of 0.
        here, below, later = x[t, r], x[t, min(r + 1, rows - 1)], x[after, r]
        p, q, s = dual[0, t, r], dual[1, t, r], dual[2, t, r]
        p_ahead, q_ahead, s_ahead = ahead[0, t, r], ahead[1, t, r], ahead[2, t, r]
        for c in range(columns - 1):
            new_p = p_ahead[c] + step * (below[c] - here[c])
            new_q = q_ahead[c] + step * (here[c + 1] - here[c])
            new_s = s_ahead[c] + slow * (later[c] - here[c])
            shrink = one / max(one, np.sqrt(new_p * new_p + new_q * new_q + new_s * new_s))
            new_p *= shrink
            new_q *= shrink
            new_s *= shrink
            p_ahead[c] = new_p + push * (new_p - p[c])
            q_ahead[c] = new_q + push * (new_q - q[c])
            s_ahead[c] = new_s + push * (new_s - s[c])
            p[c] = new_p
            q[c] = new_q
            s[c] = new_s
        new_p = p_ahead[-1] + step * (below[-1] - here[-1])
        new_s = s_ahead[-1] + slow * (later[-1] - here[-1])
        shrink = one / max(one, np.sqrt(new_p * new_p + new_s * new_s))
        p_ahead[-1] = new_p * shrink + push * (new_p * shrink - p[-1])
        s_ahead[-1] = new_s * shrink + push * (new_s * shrink - s[-1])
        p[-1] = new_p * shrink
        s[-1] = new_s * shrink


volume_prox = compiled(fastmath=_FAST)(_volume_prox)
volume_prox_parallel = compiled(parallel=True, fastmath=_FAST)(_volume_prox)
"""As `volume_prox`, for volumes so large that three synchronisations of threads per iteration pay off."""


@compiled(parallel=True, fastmath=_FAST)
def sign_advance(
    theta: NDArray[Any], grid: NDArray[Any], scale: float, signed: NDArray[Any], pulled: NDArray[Any]
) -> None:
    """signed[t] = Σ_k grid[k, t]·theta[k] + scale·min(signed[t], 0) for coefficients (k, r, c).

    ``pulled`` becomes what `sign_pull` would make of the result with a scale of 1.
    """
    count, instants = grid.shape
    rows, columns = theta.shape[1:]
    zero, scale = signed.dtype.type(0), signed.dtype.type(scale)
    at_once = max(1, SIGN_PIXELS // columns)
    for block in numba.prange(-(-rows // at_once)):
        first, last = block * at_once, min((block + 1) * at_once, rows)
        reflected = np.empty(columns, signed.dtype)
        pulled[:, first:last] = zero
        for t in range(instants):
            for r in range(first, last):
                values = signed[t, r]
                for c in range(columns):
                    values[c] = scale * min(values[c], zero)
                for k in range(count):
                    weight, light = grid[k, t], theta[k, r]
                    for c in range(columns):
                        values[c] += weight * light[c]
                for c in range(columns):
                    reflected[c] = abs(values[c])
                for k in range(count):
                    weight, total = grid[k, t], pulled[k, r]
                    for c in range(columns):
                        total[c] += weight * reflected[c]


@compiled(parallel=True, fastmath=_FAST)
def sign_pull(signed: NDArray[Any], scale: float, grid: NDArray[Any], out: NDArray[Any]) -> None:
    """out[k] = Σ_t grid[k, t]·(max(signed[t], 0) − scale·min(signed[t], 0)) for coefficients (k, r, c)."""
    count, instants = grid.shape
    rows, columns = out.shape[1:]
    zero, scale = signed.dtype.type(0), signed.dtype.type(scale)
    at_once = max(1, SIGN_PIXELS // columns)
    for block in numba.prange(-(-rows // at_once)):
        first, last = block * at_once, min((block + 1) * at_once, rows)
        reflected = np.empty(columns, signed.dtype)
        out[:, first:last] = zero
        for t in range(instants):
            for r in range(first, last):
                values = signed[t, r]
                for c in range(columns):
                    reflected[c] = max(values[c], zero) - scale * min(values[c], zero)
                for k in range(count):
                    weight, total = grid[k, t], out[k, r]
                    for c in range(columns):
                        total[c] += weight * reflected[c]


@compiled(fastmath=_FAST)
def add_outer(column: NDArray[Any], row: NDArray[Any], out: NDArray[Any]) -> None:
    """out[i, j] += column[i]·row[j]."""
    for i in range(out.shape[0]):
        value = column[i]
        for j in range(out.shape[1]):
            out[i, j] += value * row[j]
