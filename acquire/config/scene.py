"""The keys that all scene files share: shutters and optics before the scene, and simulated effects.

::

    scene = one kind  (leds, usaf, digits, sprites, video, function, sum of parts, or a plug-in's)
            behind shutters (window, chopper), in order
            + optics (the layout, and the rotation of each arm)
            + effects (`acquire.config.effect`), each absent unless listed

The class of a kind, with its own keys, is named by an entry point (`acquire.sim.scene.SceneModel`).

Positions and sizes are fractions of the scene's side unless their names state otherwise.
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
    """Rises from ``low`` to ``high`` in the middle of each period and falls back."""

    waveform: Literal["triangle"]
    frequency_hz: float = Field(gt=0)
    low: float = Field(default=0.0, ge=0, le=1)
    high: float = Field(default=1.0, ge=0, le=1)
    phase_deg: float = 0.0


DriveConfig = Annotated[
    SineDrive | ConstantDrive | PulseDrive | TriangleDrive, Field(discriminator="waveform")
]


class WindowPhase(FrozenModel):
    """One phase of a window: open, or a slit that slides along ``axis`` from ``begin`` to ``end``."""

    duration_s: Seconds = Field(gt=0)
    axis: Literal["row", "column", "open"] = "open"
    # Beyond the edges as well: in Fig. 8 the slit comes into the field at 1.1 and leaves it at -0.1.
    begin: float = Field(default=0.0, ge=-1, le=2, description="middle of the slit")
    end: float = Field(default=1.0, ge=-1, le=2)
    width: float = Field(default=0.2, gt=0, le=2)


class WindowConfig(FrozenModel):
    """A window before the scene, with its phases in a loop (Fig. 8)."""

    kind: Literal["window"]
    phases: tuple[WindowPhase, ...] = Field(min_length=1)


class ChopperConfig(FrozenModel):
    """A wheel whose blades pass before the scene (Fig. 11); positive rates are counter-clockwise."""

    kind: Literal["chopper"]
    row: float = Field(default=1.6, ge=-100, le=100, description="position of the axle")
    column: float = Field(default=0.5, ge=-100, le=100, description="position of the axle")
    blades: int = Field(default=10, ge=1, le=1000)
    open_part: float = Field(default=0.5, gt=0, lt=1, description="fraction of the circle without blades")
    rotation_hz: float = Field(description="rotations per second")
    phase_deg: float = Field(default=0.0, description="angle at which blade 0 begins at sub-step 0")


ShutterConfig = Annotated[WindowConfig | ChopperConfig, Field(discriminator="kind")]


class ArmOptics(FrozenModel):
    """How one arm sees the scene: mirrored left to right if ``mirror``, then rotated counter-clockwise."""

    turn_deg: Literal[0, 90, 180, 270] = 0
    mirror: bool = False


class OpticsConfig(FrozenModel):
    """The layout of the instrument.

    ``dual``        two cameras of M stages with S sub-steps per line
    ``compact``     one camera with the images of both arms on two ranges of its columns (Fig. 2b)
    ``emulated``    two cameras of n = M·S stages without sub-steps, whose lines are merged S × S (Sect. 5.1)
    ``interline``   the baseline: M stages, S = 1, and a scene that is finer by ``baseline_factor``
    """

    layout: Literal["dual", "compact", "emulated", "interline"] = "dual"
    a: ArmOptics = ArmOptics()
    b: ArmOptics = ArmOptics(turn_deg=90)
    sensor_pixels: int = Field(default=256, ge=2, le=65536, description="compact: columns of the camera")
    column_a: int = Field(default=0, ge=0, le=2**16, description="compact: first column of arm A")
    column_b: int | None = Field(
        default=None, ge=0, le=2**16, description="compact: first column of arm B; absent: the middle"
    )
    raw_bits: int = Field(
        default=12, ge=1, le=16, description="emulated: bits of the lines before they are merged"
    )
    # With as many as a line of the paper's instrument has, both kinds of TDI see the same fine pixels (Fig.
    # 6).
    baseline_factor: int = Field(
        default=3, ge=1, le=16, description="interline: the scene's sub-steps per transfer of the sensor"
    )


class SceneBase(FrozenModel):
    """The keys of every scene file. ``kind`` is the name of the scene's entry point."""

    kind: str
    title: str = ""
    rig: str = Field(default="rig-demo", description="the rig that `acquire simulate` uses for it")
    # The default is a second of rig-demo.
    lines: int = Field(
        default=33_334, ge=1, le=MOST_LINES, description="number of lines that `acquire simulate` writes"
    )
    shutters: tuple[ShutterConfig, ...] = ()
    optics: OpticsConfig = OpticsConfig()
    seed: int = Field(default=0, ge=0, lt=SEED_END, description="seed of the effects' random streams")
    system_gain_dn_per_e: float = Field(
        default=0.1, gt=0, description="K of EMVA 1288, for effects that count electrons"
    )
    effects: tuple[Annotated[EffectConfig, OneOf(EFFECTS, EffectConfig)], ...] = ()

    @property
    def sources(self) -> int:
        """Approximate number of pictures that it holds at once, from which its memory is estimated."""
        return 4

    def anchored(self, directory: Path) -> Self:  # noqa: ARG002
        """Return the scene with paths resolved from ``directory``, so that any process finds its files."""
        return self

    @model_validator(mode="after")
    def _effects_differ(self) -> SceneBase:
        kinds = [effect.kind for effect in self.effects]
        # The random stream of an effect is that of its kind: a second one would repeat its draws.
        if len(set(kinds)) < len(kinds):
            raise ValueError(f"each effect can be listed only once, not {', '.join(kinds)}")
        return self


SceneConfig = Annotated[SceneBase, OneOf(SCENES, SceneBase)]
"""Any scene that is installed, by its ``kind``."""


class SceneFile(RootModel[SceneConfig]):
    """The whole of a scene file."""
