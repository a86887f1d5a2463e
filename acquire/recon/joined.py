"""Two kinds of coefficients in one solver: a volume in voxels (θ₁), and patterns in pixels (θ₂).

    lines = B₁·θ₁ + B₂·θ₂        θ = (s·θ₁, θ₂) in one array, each part with a prior and a sign of its own

The data step of `admm` is made in the space of the lines, where both parts meet in one residual. Solved in
turns instead, each part would first explain all lines alone, and neither would give up the other's share.
The scale s sets the ratio of both parts' penalties: s² for each voxel of as many pixels.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.arrays import namespace

if TYPE_CHECKING:
    from acquire.arrays import Array
    from acquire.recon.denoisers import Denoiser
    from acquire.recon.problem import Operator
    from acquire.recon.sign import SignSplit

    Shape = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class JoinedLayout:
    """Where both parts are in one array of a single axis; ``scale`` multiplies the volume."""

    volume: Shape
    patterns: Shape
    scale: float

    @property
    def shape(self) -> Shape:
        """Shape of the joined array."""
        return (math.prod(self.volume) + math.prod(self.patterns),)

    def joined(self, volume: Array, patterns: Array) -> Array:
        """Return both parts in one array; the opposite of `parts`."""
        xp = namespace(volume)
        return xp.concat([xp.reshape(self.scale * volume, (-1,)), xp.reshape(patterns, (-1,))])

    def parts(self, theta: Array) -> tuple[Array, Array]:
        """Return volume and patterns of a joined array; the opposite of `joined`."""
        xp, size = namespace(theta), math.prod(self.volume)
        volume, patterns = xp.reshape(theta[:size], self.volume), xp.reshape(theta[size:], self.patterns)
        return volume / self.scale, patterns


class JoinedOperator:
    """B₁·θ₁ + B₂·θ₂ and its transpose."""

    def __init__(self, layout: JoinedLayout, volume: Operator, patterns: Operator) -> None:
        self._layout, self._volume, self._patterns = layout, volume, patterns

    def forward(self, theta: Array) -> Array:
        """Return the lines (2, L_R, M) of volume and patterns together."""
        volume, patterns = self._layout.parts(theta)
        return self._volume.forward(volume) + self._patterns.forward(patterns)

    def adjoint(self, lines: Array) -> Array:
        """Return both parts of the transpose, the volume's in the scale in which it is stored."""
        # θ₁ is stored s times too large.
        volume = self._volume.adjoint(lines) / self._layout.scale**2
        return self._layout.joined(volume, self._patterns.adjoint(lines))


class JoinedSign:
    """Neither part is negative: a `SignSplit` of each."""

    def __init__(self, layout: JoinedLayout, volume: SignSplit, patterns: SignSplit) -> None:
        self._layout, self._volume, self._patterns = layout, volume, patterns

    def advance(self, theta: Array) -> None:
        """Advance each split with its own part of θ."""
        for split, part in zip((self._volume, self._patterns), self._layout.parts(theta), strict=True):
            split.advance(part)

    def pull(self) -> Array:
        """Return the pull of both splits in one array."""
        return self._layout.joined(self._volume.pull(), self._patterns.pull())

    def rescale(self, factor: float) -> None:
        """Rescale both: volume and patterns have the same ρ."""
        self._volume.rescale(factor)
        self._patterns.rescale(factor)

    def rebase(self, grid: Array, shape: Shape) -> None:  # noqa: ARG002 (the split's; both shapes are known)
        """Continue on another grid of the patterns, whose basis changes."""
        self._patterns.rebase(grid, self._layout.patterns)

    def resume(self, other: JoinedSign) -> None:
        """Take over both splits of another joined one."""
        self._volume.resume(other._volume)
        self._patterns.resume(other._patterns)

    def copied(self) -> JoinedSign:
        """Return one whose splits advance independently."""
        other = copy(self)
        other._volume, other._patterns = self._volume.copied(), self._patterns.copied()
        return other


class JoinedPrior:
    """A denoiser of each part; ``weights`` multiply λ/ρ of θ₁ (one) and of θ₂ (one for each frame)."""

    def __init__(
        self, layout: JoinedLayout, denoisers: tuple[Denoiser, Denoiser], weights: tuple[float, Array]
    ) -> None:
        self._layout, self._denoisers, self._weights = layout, denoisers, weights

    def prox(self, frames: Array, weight: float | Array) -> Array:
        """Apply each denoiser to its part: they have priors of different kinds, and weights of their own."""
        each = zip(self._denoisers, self._layout.parts(frames), self._weights, strict=True)
        volume, patterns = (denoiser.prox(part, weight * own) for denoiser, part, own in each)
        return self._layout.joined(volume, patterns)
