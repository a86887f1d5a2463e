"""Models of scene files: what a scene shows, what stands before it, and which effects its simulation has.

::

    scene = one kind  (leds, usaf, digits, sprites, video, function, sum of parts)
            seen through shutters (window, chopper), in order
            + optics (which layout, how each arm is turned)
            + effects (`acquire.config.effect`), each absent unless listed

Positions and sizes are fractions of the scene's side unless their name says otherwise.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, RootModel, model_validator

from acquire.config.base import MOST_LINES, SEED_END, FilePath, FrozenModel, Seconds
from acquire.config.effect import EffectConfig
from acquire.config.variants import OneOf
from acquire.plugins import EFFECTS

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


class LedConfig(FrozenModel):
    """One LED behind a mask. Positions and sizes are fractions of the scene's side."""

    name: str
    shape: Literal["x", "triangle", "circle", "equals", "square"]
    row: float = Field(ge=0, le=1, description="centre")
    column: float = Field(ge=0, le=1, description="centre")
    size: float = Field(gt=0, le=1, description="side of the bounding square")
    drive: DriveConfig
    saturation: float | None = Field(
        default=None,
        gt=0,
        description="drive at which the LED gives 1 − 1/e of its asymptote; absent: linear",
    )


class DisplayConfig(FrozenModel):
    """One seven-segment display: a digit per period, its intensity a triangle 0 → 1 → 0."""

    digits: str = Field(pattern=r"^[0-9]+$", description="shown one after the other, in a loop")
    row: Fraction = 0.5
    column: Fraction
    height: float = Field(default=0.7, gt=0, le=1, description="of the digit; it is 0.58 as wide")
    phase_deg: float = Field(default=0.0, description="of the display's period")


class SpriteConfig(FrozenModel):
    """A picture that moves: its centre on a circle, itself turning. Positive is counter-clockwise."""

    picture: str = Field(description='"broad-finned" or "zebra" goldfish, or an image file')
    row: Fraction = Field(description="centre of the orbit")
    column: Fraction = Field(description="centre of the orbit")
    size: float = Field(gt=0, le=1, description="side of the picture's square")
    orbit_radius: float = Field(default=0.0, ge=0, le=1)
    orbit_hz: float = 0.0
    orbit_phase_deg: float = Field(default=0.0, description="at sub-step 0; 0 is right, 90 above the centre")
    turn_hz: float | None = Field(default=None, description="absent: it heads along its orbit")
    turn_phase_deg: float = 0.0
    level: float = Field(default=1.0, gt=0, le=1)


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
    """What every scene file may say."""

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

    @model_validator(mode="after")
    def _effects_differ(self) -> SceneBase:
        kinds = [effect.kind for effect in self.effects]
        if len(set(kinds)) < len(kinds):
            raise ValueError(f"an effect is listed once, not {', '.join(kinds)}")
        return self


class LedSceneConfig(SceneBase):
    """LEDs behind masks, each with its own drive (Fig. 9)."""

    kind: Literal["leds"]
    leds: tuple[LedConfig, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _names_differ(self) -> LedSceneConfig:
        names = [led.name for led in self.leds]
        if len(set(names)) < len(names):
            raise ValueError(f"LEDs need different names, not {', '.join(names)}")
        return self


class UsafSceneConfig(SceneBase):
    """USAF 1951 target (MIL-STD-150A): bars of 1/(2·2^(g + (e − 1)/6)) mm, bright on dark (Fig. 6, 8, 11)."""

    kind: Literal["usaf"]
    field_mm: float = Field(default=6.4, gt=0, description="side of the scene in the target's plane")
    groups: tuple[int, ...] = Field(
        default=(2, 3, 4, 5), min_length=1, description="pairs of groups, the outermost even one first"
    )
    dark: float = Field(default=0.0, ge=0, le=1, description="light between the bars")
    drive: DriveConfig = ConstantDrive(waveform="constant")

    @model_validator(mode="after")
    def _pairs(self) -> UsafSceneConfig:
        first = self.groups[0]
        if first % 2 or list(self.groups) != list(range(first, first + len(self.groups))):
            raise ValueError("groups count upwards from an even one, as 2, 3, 4, 5")
        return self


class DigitsSceneConfig(SceneBase):
    """Seven-segment displays whose digits come and go with triangular intensity (Fig. 10)."""

    kind: Literal["digits"]
    period_s: float = Field(default=1.28e-3, gt=0)
    displays: tuple[DisplayConfig, ...] = Field(min_length=1)


class SpritesSceneConfig(SceneBase):
    """Moving pictures, a later one over an earlier one (Fig. 7)."""

    kind: Literal["sprites"]
    background: Fraction = 0.0
    sprites: tuple[SpriteConfig, ...] = Field(min_length=1)


class VideoSceneConfig(SceneBase):
    """A file of the user: a picture, a video, or an array (time, row, column) of 0 to 1 as .npy."""

    kind: Literal["video"]
    path: FilePath = Field(description="relative to the scene file")
    frame_rate_hz: float | None = Field(default=None, gt=0, description="absent: the file's own")
    fit: Literal["fill", "pad", "stretch"] = Field(default="fill", description="how it becomes square")
    between: Literal["hold", "blend"] = Field(default="blend", description="light between two frames")
    end: Literal["loop", "last"] = "loop"
    gamma: float = Field(default=1.0, gt=0, le=5, description="light = (pixel / white)^gamma")


class FunctionSceneConfig(SceneBase):
    """A Python function of the user: (time_s (k,), row (n, 1), column (n,)) → light (k, n, n).

    Rows and columns are the pixels' centres, 0 to 1. ``file.py:name`` is relative to the scene file.
    """

    kind: Literal["function"]
    function: str = Field(pattern=r"^.+:[A-Za-z_]\w*$", description="module:name or file.py:name")


class SumSceneConfig(SceneBase):
    """The light of several scenes added; optics and effects are those of the sum."""

    kind: Literal["sum"]
    parts: tuple[SceneConfig, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _parts_are_only_light(self) -> SumSceneConfig:
        for part in self.parts:
            if part.effects or part.optics != OpticsConfig():
                raise ValueError("effects and optics belong to the sum, not to a part of it")
        return self


SceneConfig = Annotated[
    LedSceneConfig
    | UsafSceneConfig
    | DigitsSceneConfig
    | SpritesSceneConfig
    | VideoSceneConfig
    | FunctionSceneConfig
    | SumSceneConfig,
    Field(discriminator="kind"),
]
SumSceneConfig.model_rebuild()


class SceneFile(RootModel[SceneConfig]):
    """The whole of a scene file."""


GOLDFISH = ("broad-finned", "zebra")
"""Pictures that come with the program."""


def anchored(scene: SceneConfig, directory: Path) -> SceneConfig:
    """The scene with its files named from ``directory`` on, so that any process finds them."""
    match scene:
        case VideoSceneConfig():
            return scene.model_copy(update={"path": (directory / scene.path).resolve()})
        case FunctionSceneConfig():
            place, _, name = scene.function.rpartition(":")
            if place.endswith(".py"):
                return scene.model_copy(update={"function": f"{(directory / place).resolve()}:{name}"})
        case SpritesSceneConfig():
            sprites = tuple(_anchored_sprite(sprite, directory) for sprite in scene.sprites)
            return scene.model_copy(update={"sprites": sprites})
        case SumSceneConfig():
            return scene.model_copy(
                update={"parts": tuple(anchored(part, directory) for part in scene.parts)}
            )
    return scene


def _anchored_sprite(sprite: SpriteConfig, directory: Path) -> SpriteConfig:
    if sprite.picture in GOLDFISH:
        return sprite
    return sprite.model_copy(update={"picture": str((directory / sprite.picture).resolve())})
