"""Compiled loops of the shear.

One line sums the voxels along a staircase in (time, row): at fixed row block q, with fine rows
``start .. start + length - 1``, line ``i`` meets the sub-steps ``t = i·S + start + d`` with multiplicity

    m(d) = #{(r, u): r + u = d, r < length, u < S} = min(d + 1, length, S, length + S - 1 - d)

and weight ``m(d)·E(t)``. Weights that fall into the same frame (T_m > 1) are summed before the row of
voxels is touched. The kernels are our own because sparse libraries need the matrix in memory, tens to
hundreds of MB per arm, to be as fast (tools/bench_operator.py). Elements are addressed one by one, because a
slice of an array costs a reference count, which is more than the work on a short row.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numba
import numpy as np

from acquire.loops import compiled

if TYPE_CHECKING:
    from numpy.typing import NDArray


@compiled(inline="always")
def _multiplicity(d: int, length: int, S: int) -> int:
    return min(d + 1, length, S, length + S - 1 - d)


# without nnan and ninf: solvers notice that they diverge by values that are not finite
@compiled(parallel=True, fastmath={"contract", "reassoc", "nsz"})
def shear(
    voxels: NDArray[Any],
    code: NDArray[np.uint8],
    starts: NDArray[np.int64],
    lengths: NDArray[np.int64],
    S: int,
    T_m: int,
    out: NDArray[Any],
) -> None:
    """out[i, c] = Σ_q Σ_d m(d)·E(t)·voxels[t // T_m, q, c]."""
    # No two threads write the same element, so the order of the sums does not depend on their number.
    for i in numba.prange(out.shape[0]):
        out[i, :] = 0
        for q in range(len(starts)):
            first = i * S + starts[q]
            steps = lengths[q] + S - 1
            weight, frame = 0, first // T_m
            for d in range(steps):
                t = first + d
                if t // T_m != frame:
                    if weight:
                        scale = out.dtype.type(weight)
                        for c in range(out.shape[1]):
                            out[i, c] += scale * voxels[frame, q, c]
                    weight, frame = 0, t // T_m
                if code[t]:
                    weight += _multiplicity(d, lengths[q], S)
            if weight:
                scale = out.dtype.type(weight)
                for c in range(out.shape[1]):
                    out[i, c] += scale * voxels[frame, q, c]


@compiled(parallel=True, fastmath={"contract", "reassoc", "nsz"})
def unshear(
    lines: NDArray[Any],
    code: NDArray[np.uint8],
    starts: NDArray[np.int64],
    lengths: NDArray[np.int64],
    S: int,
    T_m: int,
    out: NDArray[Any],
) -> None:
    """The transpose of `shear`: out[f, q, c] = Σ_i Σ_{d: t in frame f} m(d)·E(t)·lines[i, c]."""
    # Parallel over frames although the sum is over lines: a line contributes to all frames that it met, so
    # threads with one line each would have to take turns.
    for f in numba.prange(out.shape[0]):
        # the last frame may have fewer than T_m sub-steps
        t_first, t_end = f * T_m, min((f + 1) * T_m, len(code))
        for q in range(len(starts)):
            out[f, q, :] = 0
            steps = lengths[q] + S - 1
            # Lines with at least one of their sub-steps first .. first + steps - 1, first = i·S + start, in
            # the frame.
            i_first = max(0, -((steps - 1 + starts[q] - t_first) // S))
            i_end = min(lines.shape[0], (t_end - 1 - starts[q]) // S + 1)
            for i in range(i_first, i_end):
                first = i * S + starts[q]
                weight = 0
                for t in range(max(first, t_first), min(first + steps, t_end)):
                    if code[t]:
                        weight += _multiplicity(t - first, lengths[q], S)
                if weight:
                    scale = out.dtype.type(weight)
                    for c in range(out.shape[2]):
                        out[f, q, c] += scale * lines[i, c]


@compiled()
def blocks_to_pixels(blocks: NDArray[Any], n: int, S: int, N_m: int) -> NDArray[Any]:
    """Return blocks·C_N, (L_R, n/N_m) → (L_R, M): every fine column adds its block's value to its pixel."""
    # Column by column, because a block can straddle two pixels if N_m does not divide S.
    pixels = np.zeros((blocks.shape[0], n // S), blocks.dtype)
    for i in range(blocks.shape[0]):
        for column in range(n):
            pixels[i, column // S] += blocks[i, column // N_m]
    return pixels


@compiled()
def pixels_to_blocks(pixels: NDArray[Any], n: int, S: int, N_m: int) -> NDArray[Any]:
    """Return pixels·C_Nᵀ: (L_R, M) → (L_R, n/N_m)."""
    blocks = np.zeros((pixels.shape[0], (n + N_m - 1) // N_m), pixels.dtype)
    for i in range(pixels.shape[0]):
        for column in range(n):
            blocks[i, column // N_m] += pixels[i, column // S]
    return blocks


@compiled(parallel=True)
def transpose_frames(video: NDArray[Any], out: NDArray[Any]) -> None:
    """out[t] = video[t].T, frame by frame, so that both arms read contiguous rows."""
    for t in numba.prange(video.shape[0]):
        for r in range(video.shape[1]):
            for c in range(video.shape[2]):
                out[t, c, r] = video[t, r, c]


@compiled(parallel=True)
def add_transposed_frames(video: NDArray[Any], out: NDArray[Any]) -> None:
    """out[t] += video[t].T."""
    for t in numba.prange(video.shape[0]):
        for r in range(video.shape[1]):
            for c in range(video.shape[2]):
                out[t, c, r] += video[t, r, c]


@compiled(fastmath={"contract", "nsz"})
def move_frame(
    frame: NDArray[Any],
    first: NDArray[np.uint64],
    source: NDArray[np.uint64],
    begins: NDArray[np.uint64],
    weight: NDArray[Any],
    out: NDArray[Any],
) -> None:
    """out[first[i] + j] += weight[begins[i] + j]·frame[source[i] + j] for all runs i: a sparse matrix."""
    for i in range(np.uint64(len(first))):
        # unsigned indices, since the compiler would test whether each of others counts from the end
        to, at, begin = first[i], source[i], begins[i]
        for j in range(begins[i + np.uint64(1)] - begin):
            out[to + j] += weight[begin + j] * frame[at + j]


@compiled(parallel=True)
def move_frames(
    frames: NDArray[Any],
    first: NDArray[np.uint64],
    source: NDArray[np.uint64],
    begins: NDArray[np.uint64],
    weight: NDArray[Any],
    out: NDArray[Any],
) -> None:
    """Apply `move_frame` to many frames in parallel."""
    for k in numba.prange(out.shape[0]):
        move_frame(frames[k], first, source, begins, weight, out[k])


@compiled(parallel=True, fastmath={"contract", "nsz"})
def blur_frames(
    frames: NDArray[Any],
    along: NDArray[np.int64],
    row_weights: NDArray[Any],
    across: NDArray[np.int64],
    column_weights: NDArray[Any],
    out: NDArray[Any],
) -> None:
    """Add to out[k] what matrices on the rows and columns of frames[k] make of it, given as diagonals.

    Diagonal ``along[i]`` has the weight row_weights[i, r] in row r, where it is inside the matrix.
    """
    n = frames.shape[1]
    for k in numba.prange(frames.shape[0]):
        line = np.empty(n, out.dtype)
        for r in range(n):
            line[:] = 0
            for i in range(len(along)):
                if 0 <= r + along[i] < n:
                    weight, source = row_weights[i, r], frames[k, r + along[i]]
                    for c in range(n):
                        line[c] += weight * source[c]
            for i in range(len(across)):
                first, last = max(0, -across[i]), min(n, n - across[i])
                length = last - first
                to, at = out[k, r, first:last], line[first + across[i] : last + across[i]]
                each = column_weights[i, first:last]
                for c in range(length):
                    to[c] += each[c] * at[c]
