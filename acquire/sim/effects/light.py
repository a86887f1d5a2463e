"""Effects of trigger and light sources: how bright each sub-step really is."""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.sim.effects.base import Setting, Stage, draws
from acquire.sim.kernels import follow
from acquire.sim.light import Illumination, Tiled
from acquire.sim.scene import SeparableScene

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.config import effect as config

_TILE = 1024
"""Sub-steps whose random numbers are drawn at once."""
_FORGOTTEN = 40.0
"""Time constants after which a beginning is forgotten: e⁻⁴⁰ is nothing beside 1 in double precision."""


def code_errors(effect: config.CodeErrors, setting: Setting) -> list[Stage]:
    """E′(t) = E(t − late), each bit flipped with probability ``flip_rate``; the same for both arms."""

    def flips(first: int, count: int) -> NDArray[np.uint8]:
        drawn = draws("code_errors", setting, first // _TILE, arm="light").random(count)
        return (drawn < effect.flip_rate).astype(np.uint8) * (np.arange(first, first + count) >= 0)

    tiled = Tiled(flips, _TILE)

    def wrap(light: Illumination) -> Illumination:
        def bits(first: int, count: int) -> NDArray[Any]:
            late = light.bits(first - effect.late_substeps, count)
            return late ^ tiled(first, count) if effect.flip_rate else late

        return Illumination.gated(bits, light.drives)

    return [Stage("code_errors", "light", wrap)]


def pwm(effect: config.Pwm, setting: Setting) -> list[Stage]:
    """Drive d becomes full light for round(d·2^bits)/2^bits of every carrier period, from its beginning.

    A duty cycle is the mean of the drive over the carrier period; a sub-step gets what of the on-times falls
    into it, exactly. A scene in steady light of one source is not changed: its duty cycle is 1.
    """
    scene, period_s, levels = setting.scene, 1 / effect.carrier_hz, 2**effect.bits
    periods = setting.substep_s / period_s

    def wrap(light: Illumination) -> Illumination:
        if not isinstance(scene, SeparableScene):
            return light

        def drives(first: int, count: int) -> NDArray[Any]:
            begin = int(np.floor(first * periods))
            edges = np.arange(first, first + count + 1) * periods - begin
            cycles = ceil(edges[-1]) + 1
            duty = np.rint(scene.intensity(begin, cycles, period_s) * levels) / levels
            before = np.concatenate([np.zeros((len(duty), 1)), np.cumsum(duty, axis=1)], axis=1)
            whole = np.floor(edges).astype(np.int64)
            area = before[:, whole] + np.minimum(edges - whole, duty[:, whole])
            mean: NDArray[Any] = np.diff(area, axis=1) / periods
            return mean

        return Illumination.gated(light.bits, Tiled(drives, _TILE))

    return [Stage("pwm", "light", wrap)]


def led_nonlinearity(effect: config.LedNonlinearity, setting: Setting) -> list[Stage]:  # noqa: ARG001
    """d → a·(1 − exp(−d/a)): slope 1 for small drives, never more than a (near saturation: Fig. 9c)."""
    a = effect.saturation
    return [_shaped("led_nonlinearity", lambda light: lambda *at: -a * np.expm1(-light.light(*at) / a))]


def led_rise_fall(effect: config.LedRiseFall, setting: Setting) -> list[Stage]:
    """dL/dt = (d − L)/τ with τ = rise where L < d, else fall; a sub-step gets the mean of L, exactly."""
    rise, fall = effect.rise_s / setting.substep_s, effect.fall_s / setting.substep_s
    warm_up = ceil(_FORGOTTEN * max(rise, fall))

    def lagged(light: Illumination) -> Callable[[int, int], NDArray[Any]]:
        def compute(first: int, count: int) -> NDArray[Any]:
            target = np.asarray(light.light(first - warm_up, count + warm_up), np.float64)
            out = np.empty_like(target)
            follow(target, rise, fall, np.zeros(len(target)), out)
            return out[:, warm_up:]

        return Tiled(compute, _TILE)

    return [_shaped("led_rise_fall", lagged)]


def trigger_jitter(effect: config.TriggerJitter, setting: Setting) -> list[Stage]:
    """Step t of the charge comes δ_t ~ N(0, σ) late, in sub-steps, cut off at half of one.

    Between two steps a row gathers light of its own sub-step, and of a neighbour for as long as it is early
    or late: g(t) ← max(0, −δ_t)·g(t−1) + (1 − max(0, δ_t) − max(0, −δ_{t+1}))·g(t) + max(0, δ_{t+1})·g(t+1).
    """
    delay = delays(effect, setting)

    def moved(light: Illumination) -> Callable[[int, int], NDArray[Any]]:
        def compute(first: int, count: int) -> NDArray[Any]:
            g, step = light.light(first - 1, count + 2), delay(first, count + 1)
            begin, end = step[:-1], step[1:]
            own = 1 - np.maximum(0, begin) - np.maximum(0, -end)
            early, late = np.maximum(0, -begin) * g[:, :-2], np.maximum(0, end) * g[:, 2:]
            gathered: NDArray[Any] = early + own * g[:, 1:-1] + late
            return gathered

        return compute

    return [_shaped("trigger_jitter", moved)]


def delays(effect: config.TriggerJitter, setting: Setting) -> Tiled:
    """δ_t by sub-step, in sub-steps."""
    sigma = effect.sigma_s / setting.substep_s

    def compute(first: int, count: int) -> NDArray[Any]:
        drawn = draws("trigger_jitter", setting, first // _TILE).standard_normal(count)
        return np.clip(sigma * drawn, -0.5, 0.5)

    return Tiled(compute, _TILE)


def _shaped(effect: str, shape: Callable[[Illumination], Callable[[int, int], NDArray[Any]]]) -> Stage:
    """A stage that changes the light alone."""
    return Stage(effect, "light", lambda light: replace(light, light=shape(light)))
