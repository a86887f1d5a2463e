"""Models of the effects that a scene file may list: names and parameters, after EMVA 1288 where it has them.

EMVA Standard 1288, release 4.0: μ_e electrons, K system gain (DN/e⁻), σ_d temporal dark noise (e⁻), μ_I dark
current (e⁻/s), PRNU₁₂₈₈ and DSNU₁₂₈₈ (standard deviations over the pixels), μ_e.sat saturation capacity.
What an effect does stands with its stage, in `acquire.sim.effects`.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from acquire.config.base import MOST_DN, FrozenModel, Part, Positive


class CodeErrors(FrozenModel):
    """The light's code differs from the recorded one: bits flipped at random, or all of them late."""

    kind: Literal["code_errors"]
    flip_rate: Part = Field(default=0.0, description="probability that a bit is wrong")
    late_substeps: int = Field(default=0, ge=-64, le=64, description="by which the light is late")


class Pwm(FrozenModel):
    """The drivers really switch: duty cycles are held for a period of the carrier."""

    kind: Literal["pwm"]
    carrier_hz: Positive
    bits: int = Field(default=8, ge=1, le=16, description="resolution of the duty cycle")


class LedNonlinearity(FrozenModel):
    """Light of every LED = a·(1 − exp(−d/a)) for drive d."""

    kind: Literal["led_nonlinearity"]
    saturation: Positive = Field(description="a, in units of full drive")


class LedRiseFall(FrozenModel):
    """Light follows its drive exponentially, with one time constant up and one down."""

    kind: Literal["led_rise_fall"]
    rise_s: Positive
    fall_s: Positive


class TriggerJitter(FrozenModel):
    """Charge moves early or late: normal, independent from step to step."""

    kind: Literal["trigger_jitter"]
    sigma_s: Positive


class Misregistration(FrozenModel):
    """The image of one arm lies off by fractions of a fine pixel (bilinear), is turned, or is larger."""

    kind: Literal["misregistration"]
    arm: Literal["a", "b"] = "b"
    rows: float = Field(default=0.0, ge=-64, le=64, description="fine pixels downwards, in arm A's view")
    columns: float = Field(default=0.0, ge=-64, le=64, description="fine pixels to the right")
    turn_deg: float = Field(default=0.0, ge=-45, le=45, description="counter-clockwise about the centre")
    magnification: float = Field(default=1.0, ge=0.5, le=2, description="about the centre")
    beyond: Literal["dark", "edge"] = Field(
        default="dark", description="what lies beyond the field: nothing, or what is at its edge"
    )


class LensDistortion(FrozenModel):
    """The lens of one arm, or of both, is not true: radial, of the third order, bilinear."""

    kind: Literal["lens_distortion"]
    arm: Literal["a", "b", "both"] = "both"
    part: float = Field(
        ge=-0.2,
        le=0.2,
        description="of half the field, by which the middle of a side is seen too far out; below 0: in",
    )


class Vignetting(FrozenModel):
    """Less light far from the axis of an arm's lens."""

    kind: Literal["vignetting"]
    arm: Literal["a", "b", "both"] = "both"
    loss: Part = Field(description="of the light, as far from the axis as a corner is from the middle")
    rows: float = Field(
        default=0.0, ge=-1024, le=1024, description="fine pixels of the axis below the middle"
    )
    columns: float = Field(default=0.0, ge=-1024, le=1024, description="fine pixels to its right")


class PointSpread(FrozenModel):
    """A Gaussian point spread function."""

    kind: Literal["psf"]
    sigma_pixels: Positive = Field(description="standard deviation in fine pixels")


class StrayLight(FrozenModel):
    """Light where none belongs: a veil made of the scene's own, and steady light that no code switches."""

    kind: Literal["stray_light"]
    veil: Part = Field(default=0.0, description="part of the scene's light that is spread evenly")
    ambient: float = Field(default=0.0, ge=0, description="in units of the scene's light")


class BeamSplitter(FrozenModel):
    """Arm A gets ``part_a`` of the light, arm B the rest; 0.5 is what the responsivity is stated for."""

    kind: Literal["beam_splitter"]
    part_a: float = Field(gt=0, lt=1)


class ChargeTransfer(FrozenModel):
    """Every transfer leaves a part of the charge behind, to the next line."""

    kind: Literal["cti"]
    inefficiency: float = Field(gt=0, le=0.01, description="per transfer of a sub-step")


class Prnu(FrozenModel):
    """Photo response non-uniformity: gain 1 + N(0, prnu) per pixel of the line."""

    kind: Literal["prnu"]
    prnu: Positive = Field(le=1, description="PRNU₁₂₈₈ as a part of 1")


class Dsnu(FrozenModel):
    """Dark signal non-uniformity: N(0, dsnu_e) electrons per pixel of the line."""

    kind: Literal["dsnu"]
    dsnu_e: Positive = Field(description="DSNU₁₂₈₈")


class DarkCurrent(FrozenModel):
    """Thermal electrons: Poisson with mean μ_I·t over a line's exposure time."""

    kind: Literal["dark_current"]
    electrons_per_s: Positive = Field(description="μ_I per pixel")


class ShotNoise(FrozenModel):
    """The number of electrons is Poisson: σ_e² = μ_e."""

    kind: Literal["shot_noise"]


class FullWell(FrozenModel):
    """No more than the saturation capacity fits into a pixel."""

    kind: Literal["full_well"]
    capacity_e: Positive = Field(description="μ_e.sat")


class ColumnDefects(FrozenModel):
    """Columns that are hot (electrons that nothing lit) or dead (none), at places drawn by the seed."""

    kind: Literal["column_defects"]
    hot: int = Field(default=0, ge=0, le=2**16, description="columns of each arm")
    hot_e: float = Field(
        default=1000.0, gt=0, le=MOST_DN, description="mean electrons of a hot column's line"
    )
    dead: int = Field(default=0, ge=0, le=2**16, description="columns of each arm")


class ReadNoise(FrozenModel):
    """Temporal dark noise: N(0, σ_d) electrons per sample."""

    kind: Literal["read_noise"]
    sigma_e: Positive = Field(description="σ_d")


class ColumnOffsets(FrozenModel):
    """Every read-out channel adds its own offset."""

    kind: Literal["column_offsets"]
    sigma_dn: Positive
    channels: int = Field(default=4, ge=1, le=2**16, description="columns c, c + channels … share one")


class Drift(FrozenModel):
    """Offset and gain move with time, as a camera does that warms up."""

    kind: Literal["drift"]
    hours: float = Field(default=0.0, ge=0, le=1e5, description="since it was as configured, at line 0")
    offset_dn_per_hour: float = Field(default=0.0, ge=-MOST_DN, le=MOST_DN)
    gain_per_hour: float = Field(default=0.0, ge=-1, le=1, description="as a part of 1")


class AdcNonlinearity(FrozenModel):
    """A converter whose line bends: right at black and at white, off between."""

    kind: Literal["adc_nonlinearity"]
    bow: float = Field(
        ge=-0.2, le=0.2, description="of the range, by which the middle of it is read too high"
    )


class Adc(FrozenModel):
    """A converter of fewer bits, or one that ends below white."""

    kind: Literal["adc"]
    bits: int = Field(ge=1, le=16, description="of the range up to white")
    saturation_dn: float | None = Field(default=None, gt=0)


class DroppedLines(FrozenModel):
    """Lines that never arrive; the camera's count shows it."""

    kind: Literal["dropped_lines"]
    rate: float = Field(gt=0, lt=1, description="probability per line and arm")


class DuplicatedLines(FrozenModel):
    """Lines that come with the pixels of the line before; nothing shows it."""

    kind: Literal["duplicated_lines"]
    rate: float = Field(gt=0, lt=1, description="probability per line and arm")


EffectConfig = Annotated[
    CodeErrors
    | Pwm
    | LedNonlinearity
    | LedRiseFall
    | TriggerJitter
    | Misregistration
    | LensDistortion
    | Vignetting
    | PointSpread
    | StrayLight
    | BeamSplitter
    | ChargeTransfer
    | Prnu
    | Dsnu
    | DarkCurrent
    | ShotNoise
    | ColumnDefects
    | FullWell
    | ReadNoise
    | Drift
    | ColumnOffsets
    | AdcNonlinearity
    | Adc
    | DroppedLines
    | DuplicatedLines,
    Field(discriminator="kind"),
]
