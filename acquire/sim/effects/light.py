"""Effects of trigger and light sources on the actual brightness of each sub-step."""

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
"""Delay of a wire, an isolator or a driver (s)."""
_SETTLED = 40.0
"""Time constants after which the initial state has no influence: e⁻⁴⁰ is negligible in double precision."""


class CodeErrors(Effect):
    """The light's code differs from the recorded one: bits are flipped at random, or all are late."""

    kind: Literal["code_errors"]
    place: ClassVar[Place] = "light"
    rank: ClassVar[float] = 10
    flip_rate: Part = Field(default=0.0, description="probability that a bit is wrong")
    late_substeps: int = Field(default=0, ge=-64, le=64, description="sub-steps by which the light is late")

    def stages(self, setting: Setting) -> list[Stage]:
        """E′(t) = E(t − late), each bit flipped with probability ``flip_rate``; the same for both arms."""

        def flips(first: int, count: int) -> NDArray[np.uint8]:
            # One light for both arms, and so the same wrong bits; none before the run, where it is off.
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
    """Drivers that switch: duty cycles are constant for a period of the carrier."""

    kind: Literal["pwm"]
    place: ClassVar[Place] = "light"
    rank: ClassVar[float] = 20
    carrier_hz: float = Field(ge=1, le=1e9)
    bits: int = Field(default=8, ge=1, le=16, description="resolution of the duty cycle")

    def stages(self, setting: Setting) -> list[Stage]:
        """Turn drive d into full light for the first round(d·2^bits)/2^bits of every carrier period.

        A duty cycle is the mean of the drive over the carrier period; a sub-step gets exactly the part of the
        on-times that falls into it. The single steady source of other scenes does not change, because its
        duty cycle is 1.
        """
        scene, period_s, levels = setting.scene, 1 / self.carrier_hz, 2**self.bits
        periods = setting.substep_s / period_s

        def wrap(light: Illumination) -> Illumination:
            if not isinstance(scene, SeparableScene):
                return light

            def drives(first: int, count: int) -> NDArray[Any]:
                begin = int(np.floor(first * periods))
                # relative to the block: hours into a run the fraction of a carrier period would be lost
                edges = np.arange(first, first + count + 1) * periods - begin
                cycles = ceil(edges[-1]) + 1
                duty = np.rint(scene.intensity(begin, cycles, period_s) * levels) / levels
                before = np.concatenate([np.zeros((len(duty), 1)), np.cumsum(duty, axis=1)], axis=1)
                whole = np.floor(edges).astype(np.int64)
                # light up to each edge: whole periods, and of the one it lies in what the duty cycle has lit
                # by then
                area = before[:, whole] + np.minimum(edges - whole, duty[:, whole])
                mean: NDArray[Any] = np.diff(area, axis=1) / periods
                return mean

            return Illumination.gated(light.bits, Tiled(drives, _TILE))

        return [Stage("pwm", "light", wrap)]


class LedNonlinearity(Effect):
    """Saturating LEDs: their light is a·(1 − exp(−d/a)) for drive d."""

    kind: Literal["led_nonlinearity"]
    place: ClassVar[Place] = "light"
    rank: ClassVar[float] = 30
    saturation: float = Field(ge=1e-6, description="a, in units of full drive")

    def stages(self, setting: Setting) -> list[Stage]:  # noqa: ARG002
        """d → a·(1 − exp(−d/a)): slope 1 for small drives, never more than a (near saturation: Fig. 9c)."""
        a = self.saturation
        # expm1, since 1 − exp(−x) loses its digits for small drives.
        return [_shaped("led_nonlinearity", lambda light: lambda *at: -a * np.expm1(-light.light(*at) / a))]


class LedRiseFall(Effect):
    """Light follows its drive exponentially, with one time constant up and one down."""

    kind: Literal["led_rise_fall"]
    place: ClassVar[Place] = "light"
    rank: ClassVar[float] = 40
    rise_s: Positive = Field(le=0.1)
    fall_s: Positive = Field(le=0.1)

    def stages(self, setting: Setting) -> list[Stage]:
        """dL/dt = (d − L)/τ with τ = rise if L < d, else fall; a sub-step gets the exact mean of L."""
        _refuse_pulses(self.kind, setting)
        from acquire.sim.kernels import follow  # compiled code, which is not needed to read a scene file

        rise, fall = self.rise_s / setting.substep_s, self.fall_s / setting.substep_s
        # every tile starts dark and this much earlier, so that it does not depend on the tile before
        warm_up = ceil(_SETTLED * max(rise, fall))

        def lagged(light: Illumination) -> Callable[[int, int], NDArray[Any]]:
            def compute(first: int, count: int) -> NDArray[Any]:
                target = np.asarray(light.light(first - warm_up, count + warm_up), np.float64)
                out = np.empty_like(target)
                follow(target, rise, fall, np.zeros(len(target)), out)
                return out[:, warm_up:]

            return Tiled(compute, _TILE)

        return [_shaped("led_rise_fall", lagged)]


class Delays(Effect):
    """Delays of light and charge on their wires, which the trigger's lead and delays compensate in part."""

    kind: Literal["delays"]
    place: ClassVar[Place] = "light"
    rank: ClassVar[float] = 45
    light_s: Delay = Field(default=0.0, description="from the trigger's output to the light")
    a_s: Delay = Field(default=0.0, description="from the line trigger to camera A's charge")
    b_s: Delay = Field(default=0.0, description="from the line trigger to camera B's charge")

    def stages(self, setting: Setting) -> list[Stage]:
        """Delay light by δ sub-steps after the charge: g(t) ← g(t − δ), a mixture of two neighbours.

        δ = (delay of the light − delay of the camera − the trigger's lead and line delay) / sub-step; below 0
        the light is early. On one sensor with both images, camera A's delay applies. Light that is on for
        part of a sub-step, from o to c, is divided between the two as [o + δ, c + δ] overlaps them.
        """
        camera_s = self.b_s if setting.arm == "b" else self.a_s
        late = (self.light_s - camera_s - setting.settled_s) / setting.substep_s
        begin, end = (late + edge for edge in setting.lit_part)
        whole = floor(begin)
        # of the light of a sub-step, what falls into the sub-step after the one in which it begins
        part = max(0.0, end - whole - 1) / (end - begin)

        def delayed(light: Illumination) -> Callable[[int, int], NDArray[Any]]:
            def compute(first: int, count: int) -> NDArray[Any]:
                # The light of sub-step t falls into sub-step t + whole, and a part of it into the next one.
                g = light.light(first - whole - 1, count + 1)
                shared: NDArray[Any] = (1 - part) * g[:, 1:] + part * g[:, :-1]
                return shared

            return compute

        return [_shaped("delays", delayed)]


class TriggerJitter(Effect):
    """Charge transfers that are early or late, with a normal distribution, independently of each other."""

    kind: Literal["trigger_jitter"]
    place: ClassVar[Place] = "light"
    rank: ClassVar[float] = 50
    sigma_s: Positive

    def stages(self, setting: Setting) -> list[Stage]:
        """Transfer t is late by δ_t ~ N(0, σ) sub-steps, clipped to half a sub-step.

        Between two transfers a row collects light of its own sub-step, and of a neighbouring one for as long
        as a transfer is early or late::

            g(t) ← max(0, −δ_t)·g(t−1) + (1 − max(0, δ_t) − max(0, −δ_{t+1}))·g(t) + max(0, δ_{t+1})·g(t+1)
        """
        _refuse_pulses(self.kind, setting)
        delay = jitter(self, setting)

        def jittered(light: Illumination) -> Callable[[int, int], NDArray[Any]]:
            def compute(first: int, count: int) -> NDArray[Any]:
                g, delays = light.light(first - 1, count + 2), delay(first, count + 1)
                begin, end = delays[:-1], delays[1:]
                own = 1 - np.maximum(0, begin) - np.maximum(0, -end)
                early, late = np.maximum(0, -begin) * g[:, :-2], np.maximum(0, end) * g[:, 2:]
                gathered: NDArray[Any] = early + own * g[:, 1:-1] + late
                return gathered

            return compute

        return [_shaped("trigger_jitter", jittered)]


def jitter(effect: TriggerJitter, setting: Setting) -> Tiled:
    """Return the delay δ_t of each transfer, in sub-steps."""
    sigma = effect.sigma_s / setting.substep_s

    def compute(first: int, count: int) -> NDArray[Any]:
        drawn = draws("trigger_jitter", setting, first // _TILE).standard_normal(count)
        # Clipped, so that transfers stay in their order, and a row's light comes from its neighbours at most.
        return np.clip(sigma * drawn, -0.5, 0.5)

    return Tiled(compute, _TILE)


def _refuse_pulses(effect: str, setting: Setting) -> None:
    """Raise UsageError if the light is on for only part of a sub-step: the formula assumes all of it."""
    if setting.lit_part != (0.0, 1.0):
        raise UsageError(
            f"effect {effect!r} cannot be simulated with light that is on for only part of each sub-step",
            possible="a rig without trigger.light.open_ticks and close_ticks; or a scene without the effect",
        )


def _shaped(effect: str, shape: Callable[[Illumination], Callable[[int, int], NDArray[Any]]]) -> Stage:
    """Return a stage that changes only the light, not bits or drives."""
    return Stage(effect, "light", lambda light: replace(light, light=shape(light)))
