"""Effects of trigger and light sources: how bright each sub-step really is."""

from __future__ import annotations

from dataclasses import replace
from math import ceil, floor
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from acquire.config.base import Part, Positive
from acquire.errors import UsageError
from acquire.sim.effects.base import Effect, Place, Setting, Stage, draws
from acquire.sim.light import Illumination, Tiled
from acquire.sim.scene import SeparableScene

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray


_TILE = 1024
"""Sub-steps whose random numbers are drawn at once."""
Delay = Annotated[float, Field(ge=0, le=0.01)]
"""Of a wire, an isolator, a driver (s)."""
_FORGOTTEN = 40.0
"""Time constants after which a beginning is forgotten: e⁻⁴⁰ is nothing beside 1 in double precision."""


class CodeErrors(Effect):
    """The light's code differs from the recorded one: bits flipped at random, or all of them late."""

    kind: Literal["code_errors"]
    place: ClassVar[Place] = "light"
    rank: ClassVar[float] = 10
    flip_rate: Part = Field(default=0.0, description="probability that a bit is wrong")
    late_substeps: int = Field(default=0, ge=-64, le=64, description="by which the light is late")

    def stages(self, setting: Setting) -> list[Stage]:
        """E′(t) = E(t − late), each bit flipped with probability ``flip_rate``; the same for both arms."""

        def flips(first: int, count: int) -> NDArray[np.uint8]:
            drawn = draws("code_errors", setting, first // _TILE, arm="light").random(count)
            return (drawn < self.flip_rate).astype(np.uint8) * (np.arange(first, first + count) >= 0)

        tiled = Tiled(flips, _TILE)

        def wrap(light: Illumination) -> Illumination:
            def bits(first: int, count: int) -> NDArray[Any]:
                late = light.bits(first - self.late_substeps, count)
                return late ^ tiled(first, count) if self.flip_rate else late

            return Illumination.gated(bits, light.drives)

        return [Stage("code_errors", "light", wrap)]


class Pwm(Effect):
    """The drivers really switch: duty cycles are held for a period of the carrier."""

    kind: Literal["pwm"]
    place: ClassVar[Place] = "light"
    rank: ClassVar[float] = 20
    carrier_hz: Positive
    bits: int = Field(default=8, ge=1, le=16, description="resolution of the duty cycle")

    def stages(self, setting: Setting) -> list[Stage]:
        """Drive d becomes full light for round(d·2^bits)/2^bits of every carrier period, from its beginning.

        A duty cycle is the mean of the drive over the carrier period; a sub-step gets what of the on-times
        falls into it, exactly. A scene in steady light of one source is not changed: its duty cycle is 1.
        """
        scene, period_s, levels = setting.scene, 1 / self.carrier_hz, 2**self.bits
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


class LedNonlinearity(Effect):
    """Light of every LED = a·(1 − exp(−d/a)) for drive d."""

    kind: Literal["led_nonlinearity"]
    place: ClassVar[Place] = "light"
    rank: ClassVar[float] = 30
    saturation: Positive = Field(description="a, in units of full drive")

    def stages(self, setting: Setting) -> list[Stage]:  # noqa: ARG002
        """d → a·(1 − exp(−d/a)): slope 1 for small drives, never more than a (near saturation: Fig. 9c)."""
        a = self.saturation
        return [_shaped("led_nonlinearity", lambda light: lambda *at: -a * np.expm1(-light.light(*at) / a))]


class LedRiseFall(Effect):
    """Light follows its drive exponentially, with one time constant up and one down."""

    kind: Literal["led_rise_fall"]
    place: ClassVar[Place] = "light"
    rank: ClassVar[float] = 40
    rise_s: Positive
    fall_s: Positive

    def stages(self, setting: Setting) -> list[Stage]:
        """dL/dt = (d − L)/τ with τ = rise where L < d, else fall; a sub-step gets the mean of L, exactly."""
        _refuse_pulses(self.kind, setting)
        from acquire.sim.kernels import follow  # compiled code, which reading a scene file does without

        rise, fall = self.rise_s / setting.substep_s, self.fall_s / setting.substep_s
        warm_up = ceil(_FORGOTTEN * max(rise, fall))

        def lagged(light: Illumination) -> Callable[[int, int], NDArray[Any]]:
            def compute(first: int, count: int) -> NDArray[Any]:
                target = np.asarray(light.light(first - warm_up, count + warm_up), np.float64)
                out = np.empty_like(target)
                follow(target, rise, fall, np.zeros(len(target)), out)
                return out[:, warm_up:]

            return Tiled(compute, _TILE)

        return [_shaped("led_rise_fall", lagged)]


class Delays(Effect):
    """Light and charge come late on their wires, less what the trigger's lead and delays take back."""

    kind: Literal["delays"]
    place: ClassVar[Place] = "light"
    rank: ClassVar[float] = 45
    light_s: Delay = Field(default=0.0, description="from the trigger's output to the light")
    a_s: Delay = Field(default=0.0, description="from the line trigger to camera A's charge")
    b_s: Delay = Field(default=0.0, description="to camera B's")

    def stages(self, setting: Setting) -> list[Stage]:
        """The light of a sub-step comes δ sub-steps after the charge: g(t) ← g(t − δ), of two neighbours'.

        δ = (light's delay − camera's − what the trigger leads the light by and delays the line start by) /
        sub-step; below 0 the light is early. Of one sensor with both images camera A's delays count. A light
        that is on for a part of a sub-step, from o to c, is shared as [o + δ, c + δ] lies in the two.
        """
        camera_s = self.b_s if setting.arm == "b" else self.a_s
        late = (self.light_s - camera_s - setting.settled_s) / setting.substep_s
        begin, end = (late + edge for edge in setting.lit_part)
        whole = floor(begin)
        part = max(0.0, end - whole - 1) / (end - begin)

        def moved(light: Illumination) -> Callable[[int, int], NDArray[Any]]:
            def compute(first: int, count: int) -> NDArray[Any]:
                g = light.light(first - whole - 1, count + 1)
                shared: NDArray[Any] = (1 - part) * g[:, 1:] + part * g[:, :-1]
                return shared

            return compute

        return [_shaped("delays", moved)]


class TriggerJitter(Effect):
    """Charge moves early or late: normal, independent from step to step."""

    kind: Literal["trigger_jitter"]
    place: ClassVar[Place] = "light"
    rank: ClassVar[float] = 50
    sigma_s: Positive

    def stages(self, setting: Setting) -> list[Stage]:
        """Step t of the charge comes δ_t ~ N(0, σ) late, in sub-steps, cut off at half of one.

        Between two steps a row gathers light of its own sub-step, and of a neighbour for as long as it is
        early or late::

            g(t) ← max(0, −δ_t)·g(t−1) + (1 − max(0, δ_t) − max(0, −δ_{t+1}))·g(t) + max(0, δ_{t+1})·g(t+1)
        """
        _refuse_pulses(self.kind, setting)
        delay = jitter(self, setting)

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


def jitter(effect: TriggerJitter, setting: Setting) -> Tiled:
    """δ_t by sub-step, in sub-steps."""
    sigma = effect.sigma_s / setting.substep_s

    def compute(first: int, count: int) -> NDArray[Any]:
        drawn = draws("trigger_jitter", setting, first // _TILE).standard_normal(count)
        return np.clip(sigma * drawn, -0.5, 0.5)

    return Tiled(compute, _TILE)


def _refuse_pulses(effect: str, setting: Setting) -> None:
    """UsageError for light in part of a sub-step, of which the effect's formula knows nothing."""
    if setting.lit_part != (0.0, 1.0):
        raise UsageError(
            f"effect {effect} cannot be simulated with a light that is on for a part of each sub-step",
            possible="trigger.light.open_ticks and close_ticks absent; or a scene without the effect",
        )


def _shaped(effect: str, shape: Callable[[Illumination], Callable[[int, int], NDArray[Any]]]) -> Stage:
    """A stage that changes the light alone."""
    return Stage(effect, "light", lambda light: replace(light, light=shape(light)))
