"""Pictures that move through a scene: two goldfish (Fig. 7), or the user's files.

A picture is a square of texels with more resolution than the scene; every frame samples it at the fish's
position at the middle of the sub-step.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from pydantic import Field

from acquire.config.base import FrozenModel
from acquire.config.scene import Fraction
from acquire.sim.scene import SceneModel

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Grid = NDArray[Any]
    Picture = tuple[Grid, Grid]

_TEXELS = 256


class SpriteConfig(FrozenModel):
    """A moving picture: its centre follows a circle while it rotates. Positive is counter-clockwise."""

    picture: str = Field(description='"broad-finned" or "zebra" goldfish, or an image file')
    row: Fraction = Field(description="centre of the orbit")
    column: Fraction = Field(description="centre of the orbit")
    size: float = Field(gt=0, le=1, description="side of the picture's square")
    orbit_radius: float = Field(default=0.0, ge=0, le=1)
    orbit_hz: float = 0.0
    orbit_phase_deg: float = Field(default=0.0, description="at sub-step 0; 0 is right, 90 above the centre")
    turn_hz: float | None = Field(
        default=None, description="rotation of the picture; absent: it heads along its orbit"
    )
    turn_phase_deg: float = 0.0
    level: float = Field(default=1.0, gt=0, le=1)

    def anchored(self, directory: Path) -> Self:
        """Return the sprite with its picture's path resolved from ``directory``."""
        if self.picture in _GOLDFISH:
            return self
        return self.model_copy(update={"picture": str((directory / self.picture).resolve())})


class SpritesSceneConfig(SceneModel):
    """Moving pictures, each drawn over the ones before it (Fig. 7)."""

    kind: Literal["sprites"]
    background: Fraction = 0.0
    sprites: tuple[SpriteConfig, ...] = Field(min_length=1)

    def build(self, size: int, substep_s: float) -> SpriteScene:
        return SpriteScene(self.sprites, self.background, size, substep_s)

    def anchored(self, directory: Path) -> Self:
        return self.model_copy(update={"sprites": tuple(one.anchored(directory) for one in self.sprites)})


class SpriteScene:
    """Moving pictures over a uniform background."""

    def __init__(
        self, sprites: tuple[SpriteConfig, ...], background: float, size: int, substep_s: float
    ) -> None:
        self.size = size
        self._background = background
        self._sprites = [_Sprite(sprite, size, substep_s) for sprite in sprites]

    def frames(self, first: int, count: int) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        return self.frames_at(np.arange(first, first + count))

    def frames_at(self, substeps: NDArray[np.int64]) -> NDArray[np.float32]:
        """(count, row, column) float32."""
        frames = np.full((len(substeps), self.size, self.size), self._background, np.float32)
        for sprite in self._sprites:
            sprite.draw(frames, substeps)
        return frames


class _Sprite:
    def __init__(self, config: SpriteConfig, size: int, substep_s: float) -> None:
        self._config, self._size, self._substep_s = config, size, substep_s
        picture, alpha = _picture(config.picture)
        self._picture = (picture * config.level).astype(np.float32)
        self._alpha = alpha.astype(np.float32)
        covered = np.argwhere(alpha > 0) - (len(alpha) - 1) / 2
        # A picture that is transparent throughout covers nothing, of which there is no maximum.
        # a texel more, to which interpolation reaches
        self._reach_texels = float(np.hypot(*covered.T).max(initial=0)) + 1

    def draw(self, frames: NDArray[np.float32], substeps: NDArray[np.int64]) -> None:
        from acquire.sim.kernels import paste  # compiled code, which is not needed to read a scene file

        config = self._config
        # in turns, counter-clockwise; rows count downwards, hence the sign of the sine below
        orbit = self._turns(substeps, config.orbit_hz, config.orbit_phase_deg)
        if config.turn_hz is None:
            # On a circle, the direction of motion is a quarter of a turn from that of the position.
            ahead = 0.25 if config.orbit_hz >= 0 else -0.25
            heading = orbit + ahead + config.turn_phase_deg / 360
        else:
            heading = self._turns(substeps, config.turn_hz, config.turn_phase_deg)
        row = config.row - config.orbit_radius * np.sin(2 * np.pi * orbit)
        column = config.column + config.orbit_radius * np.cos(2 * np.pi * orbit)
        angle = 2 * np.pi * heading
        places = np.stack([row * self._size, column * self._size, np.cos(angle), np.sin(angle)], axis=1)
        scale = len(self._picture) / (config.size * self._size)
        paste(frames, self._picture, self._alpha, places, scale=scale, reach=self._reach_texels / scale)

    def _turns(self, substeps: NDArray[np.int64], rate_hz: float, phase_deg: float) -> Grid:
        # Without whole turns, beside which the fraction would lose its digits in a long run.
        turns: Grid = ((substeps + 0.5) * (rate_hz * self._substep_s) + phase_deg / 360) % 1.0
        return turns


def _picture(name: str) -> Picture:
    """Return light (premultiplied by alpha) and alpha, both (texel, texel); the fish face to the right."""
    draw = _GOLDFISH.get(name)
    if draw is None:
        from acquire.sim.media import read_picture

        return read_picture(Path(name), _TEXELS)
    axis = (np.arange(_TEXELS) + 0.5) / _TEXELS * 2 - 1
    return draw(axis[:, None], axis[None, :])


def _broad_finned(y: Grid, x: Grid) -> Picture:
    """A goldfish with a round body, and with tail and fins like veils."""
    body = _inside(_ellipse(y, x, turn=0.0, centre=0.38, height=0.24, width=0.4))
    tail = _inside(np.maximum(np.abs(y) - (0.12 - 0.85 * (x + 0.0)), np.maximum(x + 0.05, -x - 0.92)))
    tail = tail * _inside(np.hypot(x - 0.05, y) - 0.95) * (1 - _inside(np.abs(y) - 0.25 * (-x - 0.45)))
    veil = 0.55 + 0.25 * np.cos(26 * np.arctan2(y, 0.25 - x))
    dorsal = _inside(_ellipse(y + 0.34, x - 0.22, turn=0.5, centre=0.0, height=0.16, width=0.3)) * (y < 0)
    pectoral = _inside(_ellipse(y - 0.36, x - 0.32, turn=-0.6, centre=0.0, height=0.12, width=0.24))
    light = np.maximum(0.7 * np.maximum(dorsal, pectoral), veil * tail)
    light = light * (1 - body) + body * (0.95 - 0.25 * np.abs(y) / 0.24)
    return _with_eye(light, np.maximum.reduce([body, tail, dorsal, pectoral]), y, x, 0.64)


def _zebra(y: Grid, x: Grid) -> Picture:
    """A goldfish with a slender body, stripes across it and a forked tail."""
    body = _inside(_ellipse(y, x, turn=0.0, centre=0.15, height=0.27, width=0.72))
    tail = _inside(np.maximum(np.abs(y) - 0.75 * (-x - 0.42), np.maximum(x + 0.45, -x - 0.92)))
    tail = tail * (1 - _inside(np.abs(y) - 0.9 * (-x - 0.7)))
    dorsal = _inside(_ellipse(y + 0.26, x - 0.1, turn=0.25, centre=0.0, height=0.14, width=0.34)) * (y < 0)
    stripes = 0.5 + 0.5 * np.tanh(5 * np.cos(2 * np.pi * x / 0.2))
    light = np.maximum(0.75 * tail, 0.6 * dorsal) * (1 - body) + body * (0.12 + 0.88 * stripes)
    return _with_eye(light, np.maximum.reduce([body, tail, dorsal]), y, x, 0.72)


def _with_eye(light: Grid, alpha: Grid, y: Grid, x: Grid, at: float) -> Picture:
    eye = _inside(np.hypot(y + 0.07, x - at) - 0.05)
    return light * (1 - eye), alpha


def _ellipse(y: Grid, x: Grid, *, turn: float, centre: float, height: float, width: float) -> Grid:
    """Return the approximate signed distance to an ellipse, negative inside."""
    u = np.cos(turn) * (x - centre) - np.sin(turn) * y
    v = np.sin(turn) * (x - centre) + np.cos(turn) * y
    distance: Grid = (np.hypot(u / width, v / height) - 1) * min(height, width)
    return distance


def _inside(distance: Grid) -> Grid:
    """Return 1 inside and 0 outside, with an edge that is smooth over two texels."""
    # distances are in half sides, of 128 texels
    return np.clip(0.5 - distance * _TEXELS / 4, 0, 1)


_GOLDFISH: dict[str, Callable[[Grid, Grid], Picture]] = {"broad-finned": _broad_finned, "zebra": _zebra}
