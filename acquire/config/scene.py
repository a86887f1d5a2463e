"""What scene files have in common: what stands before a scene, and which effects its simulation has.

::

    scene = one kind  (leds, usaf, digits, sprites, video, function, sum of parts, or anybody's)
            seen through shutters (window, chopper), in order
            + optics (which layout, how each arm is turned)
            + effects (`acquire.config.effect`), each absent unless listed

What a kind shows, and its own keys, are a class that an entry point names (`acquire.sim.scene.SceneModel`).

Positions and sizes are fractions of the scene's side unless their name says otherwise.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, RootModel, model_validator

from acquire.config.base import MOST_LINES, SEED_END, FrozenModel, Seconds
from acquire.config.effect import EffectConfig
from acquire.config.variants import OneOf
from acquire.plugins import EFFECTS, SCENES

Fraction = Annotated[float, Field(ge=0, le=1)]


class SineDrive(FrozenModel):
    """Duty cycle low + (high − low)·(1 + sin(2π·f·t + phase))/2; the PWM is far faster than a sub-step."""

    waveform: Literal["sine"]
    frequency_hz: float = Field(gt=0)
    low: float = Field(default=0.0, ge=0, le=1)
    high: float = Field(default=1.0, ge=0, le=1)
    phase_deg: float = 0.0


class ConstantDrive(FrozenModel):
    """A fixed duty cycle."""

    waveform: Literal["constant"]
    level: float = Field(default=1.0, ge=0, le=1)


class PulseDrive(FrozenModel):
    """``high`` for the first ``duty`` of each period, ``low`` for the rest (Fig. 6d, e)."""

    waveform: Literal["pulse"]
    frequency_hz: float = Field(gt=0)
    duty: float = Field(default=0.5, gt=0, lt=1)
    low: float = Field(default=0.0, ge=0, le=1)
    high: float = Field(default=1.0, ge=0, le=1)
    phase_deg: float = 0.0


class TriangleDrive(FrozenModel):
    """From ``low`` up to ``high`` in the middle of each period and back."""

    waveform: Literal["triangle"]
    frequency_hz: float = Field(gt=0)
    low: float = Field(default=0.0, ge=0, le=1)
    high: float = Field(default=1.0, ge=0, le=1)
    phase_deg: float = 0.0


DriveConfig = Annotated[
    SineDrive | ConstantDrive | PulseDrive | TriangleDrive, Field(discriminator="waveform")
]


class WindowPhase(FrozenModel):
    """A stretch of time of a window: open, or a slit that slides along ``axis`` from ``begin`` to ``end``."""

    duration_s: Seconds = Field(gt=0)
    axis: Literal["row", "column", "open"] = "open"
    begin: float = Field(default=0.0, ge=-1, le=2, description="middle of the slit")
    end: float = Field(default=1.0, ge=-1, le=2)
    width: float = Field(default=0.2, gt=0, le=2)


class WindowConfig(FrozenModel):
    """A window before the scene, phase after phase in a loop (Fig. 8)."""

    kind: Literal["window"]
    phases: tuple[WindowPhase, ...] = Field(min_length=1)


class ChopperConfig(FrozenModel):
    """A wheel whose blades pass before the scene (Fig. 11); turns counter-clockwise for positive rates."""

    kind: Literal["chopper"]
    row: float = Field(default=1.6, ge=-100, le=100, description="the axle")
    column: float = Field(default=0.5, ge=-100, le=100, description="the axle")
    blades: int = Field(default=10, ge=1, le=1000)
    open_part: float = Field(default=0.5, gt=0, lt=1, description="of the circle that is not blade")
    rotation_hz: float = Field(description="turns per second")
    phase_deg: float = Field(default=0.0, description="where blade 0 begins at sub-step 0")


ShutterConfig = Annotated[WindowConfig | ChopperConfig, Field(discriminator="kind")]


class ArmOptics(FrozenModel):
    """How one arm sees the scene: mirrored left to right if so, then turned counter-clockwise."""

    turn_deg: Literal[0, 90, 180, 270] = 0
    mirror: bool = False


class OpticsConfig(FrozenModel):
    """The layout of the instrument.

    ``dual``        two cameras of M stages with S intra-line steps each
    ``compact``     one camera, the images of both arms on two ranges of its columns (Fig. 2b)
    ``emulated``    two cameras of n = M·S stages with whole steps, lines then merged S × S (Sect. 5.1)
    ``interline``   the baseline: M stages with whole steps, S = 1, the scene finer by ``baseline_factor``
    """

    layout: Literal["dual", "compact", "emulated", "interline"] = "dual"
    a: ArmOptics = ArmOptics()
    b: ArmOptics = ArmOptics(turn_deg=90)
    sensor_pixels: int = Field(default=256, ge=2, le=65536, description="compact: columns of the camera")
    column_a: int = Field(default=0, ge=0, le=2**16, description="compact: first column of arm A")
    column_b: int | None = Field(default=None, ge=0, le=2**16, description="compact: absent: half-way")
    raw_bits: int = Field(
        default=12, ge=1, le=16, description="emulated: of the lines before they are merged"
    )
    baseline_factor: int = Field(default=3, ge=1, le=16, description="interline: fine sub-steps per step")


class SceneBase(FrozenModel):
    """What every scene file may say. ``kind`` is the name of the scene's entry point."""

    kind: str
    title: str = ""
    rig: str = Field(default="rig-demo", description="the rig that `acquire simulate` takes for it")
    lines: int = Field(default=33_334, ge=1, le=MOST_LINES, description="that `acquire simulate` writes")
    shutters: tuple[ShutterConfig, ...] = ()
    optics: OpticsConfig = OpticsConfig()
    seed: int = Field(default=0, ge=0, lt=SEED_END, description="of the effects' random streams")
    system_gain_dn_per_e: float = Field(
        default=0.1, gt=0, description="K of EMVA 1288, for effects that count electrons"
    )
    effects: tuple[Annotated[EffectConfig, OneOf(EFFECTS, EffectConfig)], ...] = ()

    @property
    def sources(self) -> int:
        """About how many pictures it holds at once: what its memory is foreseen by."""
        return 4

    def anchored(self, directory: Path) -> Self:  # noqa: ARG002
        """The scene with its files named from ``directory`` on, so that any process finds them."""
        return self

    @model_validator(mode="after")
    def _effects_differ(self) -> SceneBase:
        kinds = [effect.kind for effect in self.effects]
        if len(set(kinds)) < len(kinds):
            raise ValueError(f"an effect is listed once, not {', '.join(kinds)}")
        return self


SceneConfig = Annotated[SceneBase, OneOf(SCENES, SceneBase)]
"""Any scene that is installed, by its ``kind``."""


class SceneFile(RootModel[SceneConfig]):
    """The whole of a scene file."""
