"""Streaming forward simulation: any range of one arm's lines by Eq. (1), in bounded memory.

A line sums the scene along the shear, ``t = S·ℓ + r + u`` with row r and ``u < S``; for the arm that sees the
scene rotated it is the same sum over the rotated scene. Light need not be on or off: E is its brightness.
There are two methods, and the scene selects one:

`SeparableLines`   X = Σ_k s_k(t)·mask_k. With h_k(t) = Σ_u s_k(t + u)·E(t + u) the sum over u and time is
                   done once per LED, and a line is the matrix product with a window that slides by S::

                       Y(ℓ, j) = Σ_k Σ_r h_k(S·ℓ + r) · W_k(r, j)       W_k = mask_k, S columns per pixel

`FrameLines`       any scene, frame by frame: row r of the frame at t belongs only to the fine packet of
                   charge q = t − r, and line ℓ consists of the packets S·ℓ … S·ℓ + S − 1. Incomplete
                   packets are carried over to the next call.

Both return bit-identical lines however the stream is split into calls: the first computes whole tiles at
fixed positions, the second adds in the order of time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from acquire.config.scene import ArmOptics, OpticsConfig
from acquire.errors import NumericsError, UsageError
from acquire.lines import ARMS
from acquire.sim.light import Illumination
from acquire.sim.optics import laid_out
from acquire.sim.scene import SeparableScene, frames_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.codes import Code
    from acquire.fibre import Fibre
    from acquire.sim.scene import Scene

TILE_LINES = 256
"""Lines per matrix product: enough for BLAS, few enough for the cache (windows of 0.3 MB at n = 192)."""
_BLOCK_BYTES = 8 << 20
"""Size of the block of frames held in memory."""
_GATHERED_LINES = 512
"""Lines whose packets are summed together."""


class StreamingArm:
    """The lines that one camera reads out of a scene lit by a code.

    Parameters
    ----------
    scene : of size n = M·S
    code : E, dark before sub-step 0; or light that already includes the code
    stages, substeps : M and S
    arm : "a", or "b", which sees the scene rotated by 90° counter-clockwise
    optics : the arm's view of the scene, if it differs from that
    fibre : the fibre that lays out the middle of a larger scene, instead of optics; None: no fibre

    Raises
    ------
    UsageError
        The scene is not M·S wide, or not of the size that the fibre needs, or there is no such arm.
    """

    def __init__(
        self,
        scene: Scene,
        code: Code | Illumination,
        stages: int,
        substeps: int,
        arm: str,
        *,
        optics: ArmOptics | None = None,
        fibre: Fibre | None = None,
    ) -> None:
        required = stages * substeps if fibre is None else fibre.side
        if scene.size != required:
            raise UsageError(
                f"a scene of size {scene.size} does not fit {stages} stages of {substeps} sub-steps",
                possible=f"n = {required}",
            )
        if arm not in ARMS:
            raise UsageError(f"there is no arm {arm!r}", possible=", ".join(ARMS))
        optics = optics or getattr(OpticsConfig(), arm)
        light = code if isinstance(code, Illumination) else Illumination.of(scene, code)
        width = scene.size
        if fibre is not None:  # it lays the scene out as the arm sees it, so that nothing is left to rotate
            scene, optics = laid_out(scene, fibre, arm), ArmOptics()
            width = substeps * fibre.sensor_pixels
        self._lines: _Lines = (
            SeparableLines(scene, light, substeps, optics)
            if isinstance(scene, SeparableScene)
            else FrameLines(scene, light, substeps, optics, width)
        )

    def lines(self, first_line: int, count: int) -> NDArray[np.float32]:
        """Return Y of lines ``first_line .. first_line + count - 1``, (count, M); preroll is below 0.

        Raises NumericsError if the scene's light is not a number, which a camera would round to some DN.
        """
        lines = self._lines.lines(first_line, count)
        if np.isnan(lines).any():
            raise NumericsError("the scene gave back values that are not numbers (NaN)")
        return lines


class _Lines(Protocol):
    def lines(self, first_line: int, count: int) -> NDArray[np.float32]: ...


class SeparableLines:
    """Lines of a separable scene, in tiles; the last tile is kept, because the next call continues in it."""

    def __init__(self, scene: SeparableScene, light: Illumination, substeps: int, optics: ArmOptics) -> None:
        self._size, self._source, self._substeps = scene.size, light, substeps
        masks = arm_view(scene.masks, optics)
        pixels: NDArray[np.float32] = masks[:, :, ::substeps].copy()
        for column in range(1, substeps):
            pixels += masks[:, :, column::substeps]
        # A mask covers few rows, and the others would add nothing to the product.
        self._rows = []
        for mask in pixels:
            covered = np.flatnonzero(mask.any(axis=1))
            rows = slice(int(covered[0]), int(covered[-1]) + 1) if len(covered) else slice(0, 1)
            self._rows.append(rows)
        self._weights = np.concatenate([mask[rows] for mask, rows in zip(pixels, self._rows, strict=True)])
        self._windows = np.empty((TILE_LINES, len(self._weights)), np.float32)
        self._tile_index: int | None = None
        self._tile = np.empty((TILE_LINES, self._weights.shape[1]), np.float32)

    def lines(self, first_line: int, count: int) -> NDArray[np.float32]:
        out = np.empty((count, self._tile.shape[1]), np.float32)
        done = 0
        while done < count:
            index, skip = divmod(first_line + done, TILE_LINES)
            if index != self._tile_index:
                S, start = self._substeps, 0
                # h of every sub-step at which a line of the tile meets a row: the sum of S sub-steps of light
                span = S * (TILE_LINES - 1) + self._size
                lit = self._source.light(index * TILE_LINES * S, span + S - 1)
                light: NDArray[np.float64] = sum(lit[:, u : u + span] for u in range(1, S)) + lit[:, :span]
                for h, rows in zip(light.astype(np.float32), self._rows, strict=True):
                    width = rows.stop - rows.start
                    # Line i meets row r at sub-step S·i + r: lines are the product of windows of h, S apart,
                    # with the mask.
                    windows = sliding_window_view(h[rows.start :], width)[::S]
                    self._windows[:, start : start + width] = windows[:TILE_LINES]
                    start += width
                np.matmul(self._windows, self._weights, out=self._tile)
                self._tile_index = index
            part = self._tile[skip : skip + count - done]
            out[done : done + len(part)] = part
            done += len(part)
        return out


class FrameLines:
    """Lines of any scene; the charge of unfinished packets is kept for the next call.

    ``width`` is that of the frames: a scene laid out by a fibre is wider than it is high.
    """

    def __init__(
        self, scene: Scene, light: Illumination, substeps: int, optics: ArmOptics, width: int
    ) -> None:
        from acquire.sim import kernels  # needs a compiler, which separable scenes do without

        self._kernels = kernels
        self._scene, self._source, self._substeps = scene, light, substeps
        n, self._width = scene.size, width
        self._block = max(1, _BLOCK_BYTES // (4 * n * width))
        self._along_rows = optics.turn_deg % 180 == 0
        # scene pixel → its row and column on the sensor
        place = np.empty(n * width, np.int64)
        place[arm_view(np.arange(n * width).reshape(1, n, width), optics).ravel()] = np.arange(n * width)
        row, column = (place // width).reshape(n, width), (place % width).reshape(n, width)
        # The sensor's row for each row of the scene, or for each column if charge moves along the columns;
        # and the sensor's column for each index of the other axis.
        self._rows = row[:, 0] if self._along_rows else row[0]
        self._columns = column[0] if self._along_rows else column[:, 0]
        self._unfinished = np.zeros((n, width))
        self._next_line: int | None = None

    def lines(self, first_line: int, count: int) -> NDArray[np.float32]:
        parts = [
            self._some_lines(first, min(_GATHERED_LINES, first_line + count - first))
            for first in range(first_line, first_line + count, _GATHERED_LINES)
        ]
        return np.concatenate(parts) if parts else np.empty((0, self._width // self._substeps), np.float32)

    def _some_lines(self, first_line: int, count: int) -> NDArray[np.float32]:
        S, n = self._substeps, self._scene.size
        # ``packets`` is laid out as the kernel traverses the frames; ``gathered`` is a view of it that is
        # always (along the moving charge, across it).
        # n more than the lines need: the last frames also begin packets of the next lines.
        packets = np.zeros((S * count + n, self._width) if self._along_rows else (n, S * count + n))
        gathered = packets if self._along_rows else packets.T
        begin, end = S * first_line, S * (first_line + count) + n - 1
        if first_line == self._next_line:
            gathered[:n] = self._unfinished
            # Earlier frames were added by the last call, also to the packets that it left unfinished.
            begin += n - 1
        for first in range(begin, end, self._block):
            self._gather(packets, S * first_line, first, min(self._block, end - first))
        self._unfinished = gathered[S * count :].copy()
        self._next_line = first_line + count
        # An arm that sees the scene mirrored counts its columns the other way.
        whole = gathered[: S * count, :: 1 if self._columns[0] <= self._columns[-1] else -1]
        merged = np.zeros((count, self._width // S))
        for u, c in np.ndindex(S, S):
            merged += whole[u::S, c::S]
        return merged.astype(np.float32)

    def _gather(self, packets: NDArray[np.float64], first_packet: int, first: int, count: int) -> None:
        """Add the frames from sub-step ``first``; packet i of ``packets`` is number first_packet + i."""
        light = self._source.light(first, count).sum(axis=0)
        lit = np.flatnonzero(light)
        if not len(lit):
            return
        frames = frames_at(self._scene, first + lit)
        # The compiled loops look at no bounds.
        if frames.shape != (len(lit), self._scene.size, self._width):
            raise UsageError(
                f"the scene gave back shape {frames.shape} for {len(lit)} frames",
                possible=f"shape {(len(lit), self._scene.size, self._width)}",
            )
        newest = first + lit - first_packet
        if self._along_rows:
            self._kernels.add_along_rows(frames, light[lit], newest, self._rows, packets)
        else:
            if self._rows[0] < self._rows[-1]:
                # The kernel knows only one direction of the charge: from the last column to the first.
                frames = frames[:, :, ::-1]
            self._kernels.add_along_columns(frames, light[lit], newest - (self._scene.size - 1), packets)


def arm_view(video: NDArray[Any], optics: ArmOptics) -> NDArray[Any]:
    """Return frames (…, row, column) as an arm sees them: mirrored, then rotated counter-clockwise."""
    mirrored = video[:, :, ::-1] if optics.mirror else video
    return np.rot90(mirrored, optics.turn_deg // 90, axes=(1, 2))
