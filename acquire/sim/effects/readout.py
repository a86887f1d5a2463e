"""Effects between the pixel and its digital number, in DN."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from acquire.config.base import MOST_DN, Positive
from acquire.sim.effects.base import Effect, Place, Setting, Stage, pattern

if TYPE_CHECKING:
    from numpy.typing import NDArray


SECONDS_PER_HOUR = 3600.0


class Drift(Effect):
    """Offset and gain drift with time, as in a camera that warms up."""

    kind: Literal["drift"]
    place: ClassVar[Place] = "readout"
    rank: ClassVar[float] = 10
    hours: float = Field(
        default=0.0, ge=0, le=1e5, description="age of the drift at line 0: hours since the configured values"
    )
    offset_dn_per_hour: float = Field(default=0.0, ge=-MOST_DN, le=MOST_DN)
    gain_per_hour: float = Field(default=0.0, ge=-1, le=1, description="as a fraction of the gain")

    def stages(self, setting: Setting) -> list[Stage]:
        """DN ← black + (DN − black)·(1 + g·t) + o·t, with t: ``hours`` plus the hours since line 0."""
        black, line_s = setting.black_level_dn, setting.substeps * setting.substep_s

        def run(dn: NDArray[Any], first_line: int) -> NDArray[Any]:
            line = first_line + np.arange(len(dn))[:, None]
            hours = self.hours + line * line_s / SECONDS_PER_HOUR
            gain = 1 + self.gain_per_hour * hours
            drifted: NDArray[Any] = black + (dn - black) * gain + self.offset_dn_per_hour * hours
            return drifted

        return [Stage("drift", "readout", run)]


class ColumnOffsets(Effect):
    """Each read-out channel adds its own offset."""

    kind: Literal["column_offsets"]
    place: ClassVar[Place] = "readout"
    rank: ClassVar[float] = 20
    sigma_dn: Positive
    channels: int = Field(default=4, ge=1, le=2**16, description="columns c, c + channels … share one")

    def stages(self, setting: Setting) -> list[Stage]:
        """+ N(0, σ) DN, fixed per read-out channel; pixel c is read by channel c mod ``channels``."""
        channel = self.sigma_dn * pattern("column_offsets", setting).standard_normal(self.channels)
        offset = channel[np.arange(setting.pixels) % self.channels]

        def run(dn: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
            return dn + offset

        return [Stage("column_offsets", "readout", run)]


class AdcNonlinearity(Effect):
    """A converter with a bowed characteristic: correct at black and at white, wrong in between."""

    kind: Literal["adc_nonlinearity"]
    place: ClassVar[Place] = "readout"
    rank: ClassVar[float] = 30
    bow: float = Field(
        ge=-0.2, le=0.2, description="excess in the middle of the range, as a fraction of the range"
    )

    def stages(self, setting: Setting) -> list[Stage]:
        """DN ← DN + 4·bow·w·x·(1 − x), with x = (DN − black)/w inside the range w from black to white."""
        black, white = setting.black_level_dn, setting.white_dn - setting.black_level_dn

        def run(dn: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
            part = np.clip((dn - black) / white, 0, 1)
            # 4·x·(1 − x) is 0 at both ends and 1 in the middle.
            bent: NDArray[Any] = dn + 4 * self.bow * white * part * (1 - part)
            return bent

        return [Stage("adc_nonlinearity", "readout", run)]


class Adc(Effect):
    """A converter with fewer bits, or one that saturates below white."""

    kind: Literal["adc"]
    place: ClassVar[Place] = "readout"
    rank: ClassVar[float] = 40
    bits: int = Field(ge=1, le=16, description="bits of the range up to white")
    saturation_dn: float | None = Field(default=None, gt=0)

    def stages(self, setting: Setting) -> list[Stage]:
        """Round DN to steps of (white + 1)/2^bits and clip it at ``saturation_dn``."""
        # Not finer than 1 DN, to which the camera rounds in any case.
        step = max(1.0, (setting.white_dn + 1) / 2**self.bits)
        top = setting.white_dn if self.saturation_dn is None else min(self.saturation_dn, setting.white_dn)

        def run(dn: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
            coarse: NDArray[Any] = np.minimum(np.rint(dn / step) * step, top)
            return coarse

        return [Stage("adc", "readout", run)]
