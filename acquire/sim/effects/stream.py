"""Effects on the way from the camera: lines that do not come, or come twice."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.sim.effects.base import TILE_LINES, Setting, Stage, draws

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.config import effect as config


def dropped_lines(effect: config.DroppedLines, setting: Setting) -> list[Stage]:
    """Every line is lost with probability ``rate``; the camera's count jumps over it."""

    def run(
        pixels: NDArray[Any],
        first_line: int,
        before: Callable[[], NDArray[Any]],  # noqa: ARG001
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        drawn = draws("dropped_lines", setting, first_line // TILE_LINES).random(len(pixels))
        return pixels, drawn < effect.rate

    return [Stage("dropped_lines", "stream", run)]


def duplicated_lines(effect: config.DuplicatedLines, setting: Setting) -> list[Stage]:
    """With probability ``rate`` a line has the pixels of the line that was read out before it."""

    def run(
        pixels: NDArray[Any], first_line: int, before: Callable[[], NDArray[Any]]
    ) -> tuple[NDArray[Any], None]:
        twice = draws("duplicated_lines", setting, first_line // TILE_LINES).random(len(pixels)) < effect.rate
        if twice.any():
            shifted = np.concatenate([before() if twice[0] else pixels[:1], pixels[:-1]])
            pixels = np.where(twice[:, None], shifted, pixels)
        return pixels, None

    return [Stage("duplicated_lines", "stream", run)]
