"""Effects in the pixel, in electrons (EMVA 1288 release 4.0, Linear, ch. 2: μ_e, σ_e, K)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from acquire.config.base import MOST_DN, Positive
from acquire.sim.effects.base import TILE_LINES, Effect, Place, Setting, Stage, draws, pattern

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Prnu(Effect):
    """Photo response non-uniformity: gain 1 + N(0, prnu), not below 0, per pixel of the line."""

    kind: Literal["prnu"]
    place: ClassVar[Place] = "charge"
    rank: ClassVar[float] = 10
    prnu: Positive = Field(le=1, description="PRNU₁₂₈₈ as a fraction of 1")

    def stages(self, setting: Setting) -> list[Stage]:
        """μ_e ← μ_e·max(0, 1 + N(0, PRNU₁₂₈₈)), fixed per pixel of the line: TDI averages over the stages."""
        # A wide distribution reaches below 0, but no pixel has less charge the more light it gets.
        gain = np.maximum(1 + self.prnu * pattern("prnu", setting).standard_normal(setting.pixels), 0)

        def run(electrons: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
            return electrons * gain

        return [Stage("prnu", "charge", run)]


class ShotNoise(Effect):
    """The number of electrons is Poisson: σ_e² = μ_e."""

    kind: Literal["shot_noise"]
    place: ClassVar[Place] = "charge"
    rank: ClassVar[float] = 20

    def stages(self, setting: Setting) -> list[Stage]:
        """Electrons ~ Poisson(μ_e), so σ_e² = μ_e (EMVA 1288 Eq. 7)."""

        def run(electrons: NDArray[Any], first_line: int) -> NDArray[Any]:
            stream = draws("shot_noise", setting, first_line // TILE_LINES)
            # numpy refuses a mean below 0.
            counted: NDArray[Any] = stream.poisson(np.maximum(electrons, 0)).astype(np.float64)
            return counted

        return [Stage("shot_noise", "charge", run)]


class DarkCurrent(Effect):
    """Thermal electrons: Poisson with mean μ_I·t over a line's exposure time."""

    kind: Literal["dark_current"]
    place: ClassVar[Place] = "charge"
    rank: ClassVar[float] = 30
    electrons_per_s: Positive = Field(le=1e12, description="μ_I per pixel")

    def stages(self, setting: Setting) -> list[Stage]:
        """+ Poisson(μ_I·t_exp), with t_exp of M line periods (EMVA 1288 Eq. 17)."""
        mean = self.electrons_per_s * setting.exposure_s

        def run(electrons: NDArray[Any], first_line: int) -> NDArray[Any]:
            stream = draws("dark_current", setting, first_line // TILE_LINES)
            return electrons + stream.poisson(mean, electrons.shape)

        return [Stage("dark_current", "charge", run)]


class Dsnu(Effect):
    """Dark signal non-uniformity: N(0, dsnu_e) electrons per pixel of the line."""

    kind: Literal["dsnu"]
    place: ClassVar[Place] = "charge"
    rank: ClassVar[float] = 40
    dsnu_e: Positive = Field(description="DSNU₁₂₈₈")

    def stages(self, setting: Setting) -> list[Stage]:
        """+ N(0, DSNU₁₂₈₈) electrons, fixed per pixel of the line."""
        offset = self.dsnu_e * pattern("dsnu", setting).standard_normal(setting.pixels)

        def run(electrons: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
            return electrons + offset

        return [Stage("dsnu", "charge", run)]


class ColumnDefects(Effect):
    """Hot columns (electrons without light) and dead columns (no electrons), at positions from the seed."""

    kind: Literal["column_defects"]
    place: ClassVar[Place] = "charge"
    rank: ClassVar[float] = 50
    hot: int = Field(default=0, ge=0, le=2**16, description="columns of each arm")
    hot_e: float = Field(
        default=1000.0, gt=0, le=MOST_DN, description="mean electrons of a hot column's line"
    )
    dead: int = Field(default=0, ge=0, le=2**16, description="columns of each arm")

    def stages(self, setting: Setting) -> list[Stage]:
        """Hot columns: + Poisson(hot_e). Dead columns: μ_e ← 0. The columns are drawn once, and none is both.

        If more are requested than there are columns, hot ones come first and the excess is ignored.
        """
        order = pattern("column_defects", setting).permutation(setting.pixels)
        hot, dead = order[: self.hot], order[self.hot : self.hot + self.dead]

        def run(electrons: NDArray[Any], first_line: int) -> NDArray[Any]:
            marred = electrons.copy()
            stream = draws("column_defects", setting, first_line // TILE_LINES)
            marred[:, hot] += stream.poisson(self.hot_e, (len(electrons), len(hot)))
            marred[:, dead] = 0
            return marred

        return [Stage("column_defects", "charge", run)]


class FullWell(Effect):
    """A pixel holds at most its saturation capacity."""

    kind: Literal["full_well"]
    place: ClassVar[Place] = "charge"
    rank: ClassVar[float] = 60
    capacity_e: Positive = Field(description="μ_e.sat")

    def stages(self, setting: Setting) -> list[Stage]:  # noqa: ARG002
        """μ_e ← min(μ_e, μ_e.sat)."""

        def run(electrons: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
            held: NDArray[Any] = np.minimum(electrons, self.capacity_e)
            return held

        return [Stage("full_well", "charge", run)]


class ReadNoise(Effect):
    """Temporal dark noise: N(0, σ_d) electrons per sample."""

    kind: Literal["read_noise"]
    place: ClassVar[Place] = "charge"
    # after the full well: the amplifier's noise is not held in the pixel
    rank: ClassVar[float] = 70
    sigma_e: Positive = Field(description="σ_d")

    def stages(self, setting: Setting) -> list[Stage]:
        """+ N(0, σ_d) electrons per sample (EMVA 1288 Eq. 9)."""

        def run(electrons: NDArray[Any], first_line: int) -> NDArray[Any]:
            stream = draws("read_noise", setting, first_line // TILE_LINES)
            return electrons + self.sigma_e * stream.standard_normal(electrons.shape)

        return [Stage("read_noise", "charge", run)]
