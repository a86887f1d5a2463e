"""A volume before a still ground: a prior for motion, to which what never moves costs little.

    R(x) = min over G of  TV₃(x − G) + β·√K·TV(G)        G a still, x on K instants

Total variation of a volume counts the edges of a still texture once at every instant, √K times those of its
coefficient, so that a weight that holds back the noise of what moves erases the ground behind it. Here it is
moved to G, of which every line shows all. Nothing has to be known of the ground: it is part of the minimum
(an infimal convolution; Chambolle and Lions, Numer. Math. 76, 167 (1997)). The ground is at rest, even if
the volume drifts or turns.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.arrays import namespace
from acquire.recon.tv import FrameTv
from acquire.recon.volume import VolumeTv

if TYPE_CHECKING:
    from acquire.arrays import Array

ITERATIONS = 6
"""Of the ground's total variation in each call, as many as of the volume's."""


class GroundedTv(VolumeTv):
    """R as a denoiser of the coefficients; ``ground`` is β, which is below 1.

    Volume and ground are minimised over in turn, once in each call, from where the last one ended: the
    solver's iterations are theirs, too.
    """

    def __init__(
        self,
        pace: float,
        ground: float,
        *,
        cyclic: bool = False,
        drift: tuple[float, ...] = (),
        rotation: tuple[float, ...] = (),
        rise: float = 0.0,
    ) -> None:
        super().__init__(pace, cyclic=cyclic, drift=drift, rotation=rotation, rise=rise)
        self.ground = ground
        self._still_tv = FrameTv(ITERATIONS)
        self._still: Array = None

    def resume(self, other: VolumeTv) -> None:
        super().resume(other)
        if isinstance(other, GroundedTv):
            self._still = other._still  # which a call replaces
            self._still_tv.resume(other._still_tv)

    def prox(self, frames: Array, weight: float | Array) -> Array:
        xp = namespace(frames)
        # At first, all that does not change is the ground's.
        still = frames[:1, ...] if self._still is None else self._still
        moving = super().prox(xp.concat([frames[:1, ...] - still, frames[1:, ...]]), weight)
        detail = self.ground * frames.shape[0] ** 0.5
        self._still = self._still_tv.prox(frames[:1, ...] - moving[:1, ...], weight * detail)
        return xp.concat([moving[:1, ...] + self._still, moving[1:, ...]])
