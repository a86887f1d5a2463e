"""Effects in the pixel, counted in electrons (EMVA 1288 release 4.0, Linear, ch. 2: μ_e, σ_e, K)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.sim.effects.base import TILE_LINES, Setting, Stage, draws, pattern

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.config import effect as config


def prnu(effect: config.Prnu, setting: Setting) -> list[Stage]:
    """μ_e ← μ_e·(1 + N(0, PRNU₁₂₈₈)), fixed per pixel of the line: TDI averages over the stages."""
    gain = 1 + effect.prnu * pattern("prnu", setting).standard_normal(setting.pixels)

    def run(electrons: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
        return electrons * gain

    return [Stage("prnu", "charge", run)]


def shot_noise(effect: config.ShotNoise, setting: Setting) -> list[Stage]:  # noqa: ARG001
    """Electrons ~ Poisson(μ_e), so σ_e² = μ_e (EMVA 1288 Eq. 7)."""

    def run(electrons: NDArray[Any], first_line: int) -> NDArray[Any]:
        stream = draws("shot_noise", setting, first_line // TILE_LINES)
        counted: NDArray[Any] = stream.poisson(np.maximum(electrons, 0)).astype(np.float64)
        return counted

    return [Stage("shot_noise", "charge", run)]


def dark_current(effect: config.DarkCurrent, setting: Setting) -> list[Stage]:
    """+ Poisson(μ_I·t_exp), with t_exp of M line periods (EMVA 1288 Eq. 17)."""
    mean = effect.electrons_per_s * setting.exposure_s

    def run(electrons: NDArray[Any], first_line: int) -> NDArray[Any]:
        stream = draws("dark_current", setting, first_line // TILE_LINES)
        return electrons + stream.poisson(mean, electrons.shape)

    return [Stage("dark_current", "charge", run)]


def dsnu(effect: config.Dsnu, setting: Setting) -> list[Stage]:
    """+ N(0, DSNU₁₂₈₈) electrons, fixed per pixel of the line."""
    offset = effect.dsnu_e * pattern("dsnu", setting).standard_normal(setting.pixels)

    def run(electrons: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
        return electrons + offset

    return [Stage("dsnu", "charge", run)]


def column_defects(effect: config.ColumnDefects, setting: Setting) -> list[Stage]:
    """Hot columns: + Poisson(hot_e). Dead columns: μ_e ← 0. Which ones is drawn once; a column is one of
    either. With more than there are columns, all are hot, and what is left over is forgotten.
    """
    order = pattern("column_defects", setting).permutation(setting.pixels)
    hot, dead = order[: effect.hot], order[effect.hot : effect.hot + effect.dead]

    def run(electrons: NDArray[Any], first_line: int) -> NDArray[Any]:
        marred = electrons.copy()
        stream = draws("column_defects", setting, first_line // TILE_LINES)
        marred[:, hot] += stream.poisson(effect.hot_e, (len(electrons), len(hot)))
        marred[:, dead] = 0
        return marred

    return [Stage("column_defects", "charge", run)]


def full_well(effect: config.FullWell, setting: Setting) -> list[Stage]:  # noqa: ARG001
    """No more than μ_e.sat electrons."""

    def run(electrons: NDArray[Any], first_line: int) -> NDArray[Any]:  # noqa: ARG001
        held: NDArray[Any] = np.minimum(electrons, effect.capacity_e)
        return held

    return [Stage("full_well", "charge", run)]


def read_noise(effect: config.ReadNoise, setting: Setting) -> list[Stage]:
    """+ N(0, σ_d) electrons per sample (EMVA 1288 Eq. 9)."""

    def run(electrons: NDArray[Any], first_line: int) -> NDArray[Any]:
        stream = draws("read_noise", setting, first_line // TILE_LINES)
        return electrons + effect.sigma_e * stream.standard_normal(electrons.shape)

    return [Stage("read_noise", "charge", run)]
