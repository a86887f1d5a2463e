"""Compiled loops of the simulation: they draw moving objects and add frames to lines.

These are kernels because numpy would pass over every frame several times, and a frame of 192 × 192 pixels has
to be drawn and added for both arms in 20 µs to keep up with the built setup.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.loops import compiled

if TYPE_CHECKING:
    from numpy.typing import NDArray


# Without the interpreter's lock: `acquire simulate` reads each arm in a thread of its own.
@compiled(nogil=True)
def add_along_rows(
    frames: NDArray[Any], light: NDArray[Any], newest: NDArray[Any], rows: NDArray[Any], out: NDArray[Any]
) -> None:
    """Add charge moving along the scene's rows: out[newest[i] − rows[r], c] += light[i]·frames[i, r, c]."""
    for i in range(frames.shape[0]):
        for r in range(frames.shape[1]):
            q = newest[i] - rows[r]
            # at its ends a range of frames also lights packets of other calls
            if 0 <= q < out.shape[0]:
                for c in range(frames.shape[2]):
                    out[q, c] += light[i] * frames[i, r, c]


@compiled(nogil=True)
def add_along_columns(
    frames: NDArray[Any], light: NDArray[Any], oldest: NDArray[Any], out: NDArray[Any]
) -> None:
    """Add charge moving from the last column to the first: out[r, oldest[i] + c] += light[i]·frames[i, r, c].

    ``out`` is (row of the scene, packet of charge), so that both arrays are traversed in memory order. Frames
    are taken in groups small enough for the cache, next to a row of packets. Slices are used because numba
    would otherwise check every index for being negative.
    """
    for chunk in range(0, frames.shape[0], 8):
        for r in range(frames.shape[1]):
            for i in range(chunk, min(chunk + 8, frames.shape[0])):
                begin = max(0, -oldest[i])
                end = min(frames.shape[2], out.shape[1] - oldest[i])
                to, source = out[r, oldest[i] + begin : oldest[i] + end], frames[i, r, begin:end]
                for c in range(end - begin):
                    to[c] += light[i] * source[c]


@compiled(nogil=True)
def chop(
    frames: NDArray[Any],
    angle: NDArray[Any],
    radius: NDArray[Any],
    turned: NDArray[Any],
    blades: int,
    open_part: float,
) -> None:
    """Multiply frames by the open fraction of each pixel; angles are in turns, the radius in pixels.

    The pitch of the wheel is 1/blades turn, of which ``open_part`` is open. An edge within half a pixel of a
    pixel's centre covers the pixel in part.
    """
    for i in range(frames.shape[0]):
        for r in range(frames.shape[1]):
            for c in range(frames.shape[2]):
                # nothing to cover, and the angle takes far longer than the comparison
                if frames[i, r, c] == 0:
                    continue
                x = (angle[r, c] - turned[i]) * blades
                x -= np.floor(x)
                # distance to the nearest edge in pitches, negative on a spoke
                inside = min(x, open_part - x) if x < open_part else -min(x - open_part, 1 - x)
                # an arc from the nearest edge, in pixels
                distance = inside / blades * 2 * np.pi * radius[r, c]
                frames[i, r, c] *= min(1.0, max(0.0, 0.5 + distance))


@compiled(nogil=True)
def paste(
    frames: NDArray[Any],
    picture: NDArray[Any],
    alpha: NDArray[Any],
    place: NDArray[Any],
    scale: float,
    reach: float,
) -> None:
    """Draw a rotated picture over frames with bilinear interpolation: frame ← frame·(1 − alpha) + picture.

    ``picture`` is premultiplied by ``alpha``. ``place`` holds row and column (pixels), cosine and sine for
    each frame, ``scale`` is texels per pixel, ``reach`` the picture's extent from its centre in pixels.
    """
    n, side = frames.shape[1], picture.shape[0]
    for i in range(frames.shape[0]):
        row, column, cosine, sine = place[i, 0], place[i, 1], place[i, 2], place[i, 3]
        for r in range(max(0, int(row - reach)), min(n, int(row + reach) + 2)):
            for c in range(max(0, int(column - reach)), min(n, int(column + reach) + 2)):
                dy, dx = r + 0.5 - row, c + 0.5 - column
                # texel k is centred at k + ½, like the pixels above
                v = (cosine * dy + sine * dx) * scale + side / 2 - 0.5
                u = (cosine * dx - sine * dy) * scale + side / 2 - 0.5
                if 0 <= v < side - 1 and 0 <= u < side - 1:
                    y, x = int(v), int(u)
                    a, b = v - y, u - x
                    cover = (1 - a) * ((1 - b) * alpha[y, x] + b * alpha[y, x + 1]) + a * (
                        (1 - b) * alpha[y + 1, x] + b * alpha[y + 1, x + 1]
                    )
                    light = (1 - a) * ((1 - b) * picture[y, x] + b * picture[y, x + 1]) + a * (
                        (1 - b) * picture[y + 1, x] + b * picture[y + 1, x + 1]
                    )
                    frames[i, r, c] = frames[i, r, c] * (1 - cover) + light


@compiled(nogil=True)
def follow(target: NDArray[Any], rise: float, fall: float, level: NDArray[Any], out: NDArray[Any]) -> None:
    """Compute the mean over each step of light that follows its target with a first-order lag: (K, count).

    ``rise`` and ``fall`` are time constants in steps; ``level`` (K,) is the light at the beginning, and is
    updated to the light at the end.
    """
    for k in range(target.shape[0]):
        for t in range(target.shape[1]):
            tau = rise if target[k, t] > level[k] else fall
            # the target is constant within a step: this is the exact solution and its mean, at any tau
            left = np.exp(-1 / tau)
            out[k, t] = target[k, t] + (level[k] - target[k, t]) * tau * (1 - left)
            level[k] = target[k, t] + (level[k] - target[k, t]) * left
