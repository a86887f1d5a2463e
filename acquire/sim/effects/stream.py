"""Effects on the way from the camera: lines that are lost or duplicated."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from acquire.sim.effects.base import TILE_LINES, Effect, Place, Setting, Stage, draws

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray


class DroppedLines(Effect):
    """Lines that never arrive; the camera's line count reveals them."""

    kind: Literal["dropped_lines"]
    place: ClassVar[Place] = "stream"
    rank: ClassVar[float] = 10
    rate: float = Field(gt=0, lt=1, description="probability per line and arm")

    def stages(self, setting: Setting) -> list[Stage]:
        """Lose every line with probability ``rate``; the camera's line count skips it."""

        def run(
            pixels: NDArray[Any],
            first_line: int,
            before: Callable[[], NDArray[Any]],  # noqa: ARG001
        ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
            drawn = draws("dropped_lines", setting, first_line // TILE_LINES).random(len(pixels))
            return pixels, drawn < self.rate

        return [Stage("dropped_lines", "stream", run)]


class DuplicatedLines(Effect):
    """Lines that arrive with the pixels of the line before; nothing reveals them."""

    kind: Literal["duplicated_lines"]
    place: ClassVar[Place] = "stream"
    rank: ClassVar[float] = 20
    rate: float = Field(gt=0, lt=1, description="probability per line and arm")

    def stages(self, setting: Setting) -> list[Stage]:
        """With probability ``rate``, replace a line's pixels by those of the line read out before it."""

        def run(
            pixels: NDArray[Any], first_line: int, before: Callable[[], NDArray[Any]]
        ) -> tuple[NDArray[Any], None]:
            drawn = draws("duplicated_lines", setting, first_line // TILE_LINES).random(len(pixels))
            duplicated = drawn < self.rate
            if duplicated.any():
                # ``before`` computes another tile, so it is called only if the first line needs it.
                shifted = np.concatenate([before() if duplicated[0] else pixels[:1], pixels[:-1]])
                pixels = np.where(duplicated[:, None], shifted, pixels)
            return pixels, None

        return [Stage("duplicated_lines", "stream", run)]
