"""What procedural scenes are drawn on: coordinates, random texture and simple shapes with soft edges."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import gaussian_filter

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Image = NDArray[Any]


class Canvas:
    """Coordinates (0 to 1) and random texture of an n × n picture, on which a scene is drawn."""

    def __init__(self, n: int, span: int, seed: int) -> None:
        self.n, self.span, self.rng = n, span, np.random.default_rng(seed)
        self.y, self.x = np.meshgrid(*[(np.arange(n) + 0.5) / n] * 2, indexing="ij")

    def texture(self, *scales: float) -> Image:
        """Return smooth noise of several scales (fractions of the picture), from 0 to 1."""
        total = sum(
            # the wider noise is smoothed, the weaker it is: the factor makes all scales alike
            gaussian_filter(self.rng.standard_normal((self.n, self.n)), scale * self.n, mode="wrap") * scale
            for scale in scales
        )
        # quantiles, so that single bright or dark grains do not take the contrast
        low, high = np.quantile(np.asarray(total), [0.01, 0.99])
        return np.asarray(np.clip((total - low) / (high - low), 0, 1), np.float32)

    def inside(self, distance: Any) -> Image:
        """Return 1 where a signed distance (fractions of the picture) is negative, with a one-pixel edge."""
        return np.asarray(np.clip(0.5 - distance * self.n, 0, 1), np.float32)

    def ball(self, y: float, x: float, radius: float) -> Image:
        """Return a disc with the centre (y, x)."""
        return self.inside(np.hypot(self.y - y, self.x - x) - radius)

    def box(self, y: float, x: float, height: float, width: float) -> Image:
        """Return a rectangle with the centre (y, x)."""
        return self.inside(np.maximum(abs(self.y - y) - height / 2, abs(self.x - x) - width / 2))

    def limb(self, y: float, x: float, angle: float, length: float, width: float) -> Image:
        """Return a rounded stroke that starts at (y, x), at ``angle`` from straight down."""
        dy, dx = self.y - y, self.x - x
        along = np.clip(dy * np.cos(angle) + dx * np.sin(angle), 0, length)
        return self.inside(np.hypot(dy - along * np.cos(angle), dx - along * np.sin(angle)) - width / 2)

    @cached_property
    def ground(self) -> Image:
        """A texture for the background."""
        # drawn when it is first used, after a scene's own numbers: in another order they would be other
        # scenes
        return np.asarray(0.35 + 0.65 * self.texture(0.008, 0.03, 0.1))
