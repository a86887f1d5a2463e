"""Effects between the pixel and the number, in DN."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.sim.effects.base import Setting, Stage, pattern

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.config import effect as config


SECONDS_PER_HOUR = 3600.0


def drift(effect: config.Drift, setting: Setting) -> list[Stage]:
    """DN ← black + (DN − black)·(1 + g·t) + o·t, t in hours: ``hours`` at line 0, and the lines' time."""
    black, line_s = setting.black_level_dn, setting.substeps * setting.substep_s

    def run(dn: NDArray[Any], first_line: int) -> NDArray[Any]:
        line = first_line + np.arange(len(dn))[:, None]
        hours = effect.hours + line * line_s / SECONDS_PER_HOUR
        gain = 1 + effect.gain_per_hour * hours
        moved: NDArray[Any] = black + (dn - black) * gain + effect.offset_dn_per_hour * hours
        return moved

    return [Stage("drift", "readout", run)]


def column_offsets(effect: config.ColumnOffsets, setting: Setting) -> list[Stage]:
    """+ N(0, σ) DN, fixed per read-out channel; pixel c is read by channel c modulo their number."""
    channel = effect.sigma_dn * pattern("column_offsets", setting).standard_normal(effect.channels)
    offset = channel[np.arange(setting.pixels) % effect.channels]

    def run(dn: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
        return dn + offset

    return [Stage("column_offsets", "readout", run)]


def adc_nonlinearity(effect: config.AdcNonlinearity, setting: Setting) -> list[Stage]:
    """DN ← DN + 4·bow·w·x·(1 − x), with x = (DN − black)/w inside the range w from black to white."""
    black, white = setting.black_level_dn, setting.white_dn - setting.black_level_dn

    def run(dn: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
        part = np.clip((dn - black) / white, 0, 1)
        bent: NDArray[Any] = dn + 4 * effect.bow * white * part * (1 - part)
        return bent

    return [Stage("adc_nonlinearity", "readout", run)]


def adc(effect: config.Adc, setting: Setting) -> list[Stage]:
    """DN in steps of (white + 1)/2^bits, rounded, and no more than ``saturation_dn``."""
    step = max(1.0, (setting.white_dn + 1) / 2**effect.bits)
    top = setting.white_dn if effect.saturation_dn is None else min(effect.saturation_dn, setting.white_dn)

    def run(dn: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
        coarse: NDArray[Any] = np.minimum(np.rint(dn / step) * step, top)
        return coarse

    return [Stage("adc", "readout", run)]
