"""Streaming forward simulation: the lines of one arm by Eq. (1), whichever are asked for, in bounded memory.

A line sums the scene along the shear, ``t = S·ℓ + r + u`` with row r and ``u < S``; the arm that sees the
scene turned is the same sum over the turned scene. Two ways, chosen by the scene:

`SeparableLines`   X = Σ_k s_k(t)·mask_k. With h_k(t) = Σ_u s_k(t + u)·E(t + u) the sum over u and time is
                   done once per LED, and a line is a matrix product of a window that slides by S::

                       Y(ℓ, j) = Σ_k Σ_r h_k(S·ℓ + r) · W_k(r, j)       W_k = mask_k, S columns per pixel

`FrameLines`       any scene, frame by frame: row r of the frame at t belongs to line (t − r) // S alone, so
                   a frame is added to M + 1 unfinished lines, which are carried to the next call.

Both give bit for bit the same lines however the stream is split into calls: the first computes whole tiles
at fixed places, the second adds in the order of time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from acquire.errors import UsageError
from acquire.lines import ARMS
from acquire.sim.scenes import SeparableScene

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.codes import Code
    from acquire.sim.scenes import Scene

_TILE_LINES = 256
"""Lines of one matrix product: enough for BLAS, few enough for the cache (windows of 0.3 MB at n = 192)."""
_BLOCK_BYTES = 8 << 20
"""Frames of a scene held at once."""


class StreamingArm:
    """The lines that one camera reads out of a scene lit by a code.

    Parameters
    ----------
    scene : of size n = M·S
    code : E, dark before sub-step 0
    stages, substeps : M and S
    arm : "a", or "b", which sees the scene turned by 90° counter-clockwise

    Raises
    ------
    UsageError
        The scene is not M·S wide, or there is no such arm.
    """

    def __init__(self, scene: Scene, code: Code, stages: int, substeps: int, arm: str) -> None:
        if scene.size != stages * substeps:
            raise UsageError(
                f"scene of size {scene.size} for {stages} stages of {substeps} sub-steps",
                possible=f"n = {stages * substeps}",
            )
        if arm not in ARMS:
            raise UsageError(f"arm {arm!r}", possible=", ".join(ARMS))
        turns = ARMS.index(arm)
        self._lines: _Lines = (
            SeparableLines(scene, code, substeps, turns)
            if isinstance(scene, SeparableScene)
            else FrameLines(scene, code, substeps, turns)
        )

    def lines(self, first_line: int, count: int) -> NDArray[np.float32]:
        """Y of lines ``first_line .. first_line + count - 1`` (count, M); numbers below 0 are preroll."""
        return self._lines.lines(first_line, count)


class _Lines(Protocol):
    def lines(self, first_line: int, count: int) -> NDArray[np.float32]: ...


class SeparableLines:
    """Lines of a separable scene, by tiles; the last tile is kept for the call that continues in it."""

    def __init__(self, scene: SeparableScene, code: Code, substeps: int, turns: int) -> None:
        self._scene, self._code, self._substeps = scene, code, substeps
        pixels = _merge_columns(scene.masks, substeps, turns)
        # A mask covers few rows: the others add nothing to the product.
        self._rows = [_covered_rows(mask) for mask in pixels]
        self._weights = np.concatenate([mask[rows] for mask, rows in zip(pixels, self._rows, strict=True)])
        self._windows = np.empty((_TILE_LINES, len(self._weights)), np.float32)
        self._tile_index: int | None = None
        self._tile = np.empty((_TILE_LINES, self._weights.shape[1]), np.float32)

    def lines(self, first_line: int, count: int) -> NDArray[np.float32]:
        out = np.empty((count, self._tile.shape[1]), np.float32)
        done = 0
        while done < count:
            index, skip = divmod(first_line + done, _TILE_LINES)
            self._compute(index)
            part = self._tile[skip : skip + count - done]
            out[done : done + len(part)] = part
            done += len(part)
        return out

    def _compute(self, index: int) -> None:
        if index != self._tile_index:
            light = self._light(index * _TILE_LINES * self._substeps)
            start = 0
            for h, rows in zip(light, self._rows, strict=True):
                width = rows.stop - rows.start
                windows = sliding_window_view(h[rows.start :], width)[:: self._substeps]
                self._windows[:, start : start + width] = windows[:_TILE_LINES]
                start += width
            np.matmul(self._windows, self._weights, out=self._tile)
            self._tile_index = index

    def _light(self, first: int) -> NDArray[np.float32]:
        """h_k(first + i) for every sub-step i at which a line of a tile meets a row: (K, i)."""
        S = self._substeps
        count = S * (_TILE_LINES - 1) + self._scene.size
        lit = self._scene.intensity(first, count + S - 1) * self._code.bits(first, count + S - 1)
        h: NDArray[np.float64] = sum(lit[:, u : u + count] for u in range(1, S)) + lit[:, :count]
        return h.astype(np.float32)


class FrameLines:
    """Lines of any scene; what unfinished lines have gathered is kept for the call that continues."""

    def __init__(self, scene: Scene, code: Code, substeps: int, turns: int) -> None:
        self._scene, self._code, self._substeps, self._turns = scene, code, substeps, turns
        self._stages = scene.size // substeps
        self._block = max(1, _BLOCK_BYTES // (4 * scene.size**2))
        # Rows of a frame at phase t mod S that belong to one line, newest line first: where each run begins.
        self._runs = [[0, *range(phase + 1, scene.size, substeps)] for phase in range(substeps)]
        self._unfinished = np.zeros((self._stages, self._stages))
        self._next_line: int | None = None

    def lines(self, first_line: int, count: int) -> NDArray[np.float32]:
        S, n = self._substeps, self._scene.size
        gathered = np.zeros((count + self._stages, self._stages))
        begin, end = S * first_line, S * (first_line + count) + n - 1
        if first_line == self._next_line:
            gathered[: self._stages] = self._unfinished
            begin += n - 1
        for first in range(begin, end, self._block):
            self._gather(gathered, first_line, first, min(self._block, end - first))
        self._unfinished = gathered[count:]
        self._next_line = first_line + count
        return gathered[:count].astype(np.float32)

    def _gather(self, gathered: NDArray[np.float64], first_line: int, first: int, count: int) -> None:
        """Add the frames from sub-step ``first``; row i of ``gathered`` is line first_line + i."""
        lit = np.flatnonzero(self._code.bits(first, count))
        if not len(lit):
            return
        frames = _merge_columns(self._scene.frames(first, count)[lit], self._substeps, self._turns)
        for t, rows in zip((first + lit).tolist(), frames, strict=True):
            newest = t // self._substeps - first_line
            by_line = np.add.reduceat(rows, self._runs[t % self._substeps], axis=0, dtype=np.float64)
            by_line = by_line[: newest + 1][::-1]
            gathered[newest + 1 - len(by_line) : newest + 1] += by_line


def _merge_columns(video: NDArray[np.float32], substeps: int, turns: int) -> NDArray[np.float32]:
    """(…, row, pixel): the sum of S columns per pixel, as the arm sees them; one column after the other."""
    turned = np.rot90(video, turns, axes=(1, 2))
    merged: NDArray[np.float32] = turned[:, :, ::substeps].copy()
    for column in range(1, substeps):
        merged += turned[:, :, column::substeps]
    return merged


def _covered_rows(mask: NDArray[np.float32]) -> slice:
    """The rows of (row, pixel) from the first to the last that is not all 0; one row of an empty mask."""
    covered = np.flatnonzero(mask.any(axis=1))
    return slice(int(covered[0]), int(covered[-1]) + 1) if len(covered) else slice(0, 1)
