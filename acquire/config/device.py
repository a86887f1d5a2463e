"""Models of a rig's ``[trigger]`` and ``[cameras]``: its devices and their settings."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from acquire.config.base import MOST_DN, FrozenModel
from acquire.config.variants import NameOf, OptionsOf
from acquire.plugins import CAMERAS, TRIGGERS

PIXEL_BITS = {"Mono8": 8, "Mono10": 10, "Mono12": 12, "Mono16": 16}
"""SFNC PixelFormat → significant bits of an (unpacked) pixel."""


GentlModule = Literal["remote", "interface", "device", "stream", "system"]
"""The module that has a feature: the camera itself ("remote"), or a module on the host's side."""


# Limits such as 2**24 and 255 are the widths of the trigger's registers.
class LineOutputConfig(FrozenModel):
    """The line trigger of one camera, in ticks of the trigger's clock."""

    enable: bool = True
    delay_ticks: int = Field(default=0, ge=0, lt=2**24, description="from the line's start to the pulse")
    # 90 ticks are 1 µs at the default clock.
    width_ticks: int | None = Field(
        default=None, ge=1, lt=2**24, description="absent: a third of the pulse period, at most 90"
    )
    active: Literal["high", "low"] = "high"
    direction: Literal["forward", "reverse"] = "forward"
    strobe: bool = Field(
        default=False, description="the camera answers every pulse, so that missed pulses can be counted"
    )


class LightOutputConfig(FrozenModel):
    """The LED output: code bit AND window AND scene gate."""

    enable: bool = True
    lead_ticks: int = Field(
        default=0, ge=0, le=255, description="ticks by which the light precedes its sub-step"
    )
    open_ticks: int = Field(
        default=0, ge=0, lt=2**24, description="tick of a sub-step at which the light may go on"
    )
    close_ticks: int | None = Field(
        default=None, ge=1, lt=2**24, description="tick at which it must be off; absent: the sub-step's end"
    )
    scene_gate: bool = Field(
        default=False, description="true: the light is on only while the scene gate input allows it"
    )
    active: Literal["high", "low"] = "high"


class TriggerConfig(FrozenModel):
    """The sync trigger and its timing."""

    driver: Annotated[str, NameOf(TRIGGERS)] = Field(
        default="simulated",
        description="'simulated'; 'rtl', the compiled gateware; 'serial', 'usb'; or one that "
        "`acquire plugins` lists",
    )
    options: Annotated[FrozenModel | None, OptionsOf(TRIGGERS)] = Field(
        default=None, validate_default=True, description="options of the driver"
    )
    url: str = Field(default="", description="driver 'serial': /dev/tty…, socket://host:port")
    baud: int = Field(default=3_000_000, ge=9600, le=10**9, description="driver 'serial'")
    flow_control: Literal["none", "rts-cts"] = Field(
        default="none", description="driver 'serial'; 'rts-cts' if the board has both lines wired"
    )
    serial: str = Field(default="", description="driver 'usb': serial number; absent: any")
    clock_hz: int = Field(default=90_000_000, ge=1_000_000, le=1_000_000_000)
    # 5 is the least of our gateware: the bit of a loaded code comes four clocks after its index.
    substep_ticks: int = Field(default=900, ge=5, lt=2**24, description="duration of a sub-step in ticks")
    tag_every_lines: int = Field(default=256, ge=1, le=65536)
    line_start: Literal["per-line", "per-substep"] = Field(
        default="per-line", description="when the cameras are triggered"
    )
    camera_min_period_ticks: int = Field(
        default=0, ge=0, lt=2**32, description="shortest pulse period that the cameras accept; 0: any"
    )
    line_budget: int = Field(
        default=0, ge=0, lt=2**48, description="lines after which a run ends; 0: endless"
    )
    watchdog_s: float = Field(
        default=10.0,
        ge=0,
        le=3600,
        description="silence of the host after which the trigger ends the run and switches the light off; "
        "0: never. At most 2^32 ticks, 47 s at 90 MHz",
    )
    external_start: Literal["off", "rising", "falling"] = "off"
    external_timeout_s: float = Field(default=10.0, gt=0, le=86400, description="wait for the external start")
    light: LightOutputConfig = LightOutputConfig()
    a: LineOutputConfig = LineOutputConfig()
    b: LineOutputConfig = LineOutputConfig()

    @property
    def watchdog_ticks(self) -> int:
        """``watchdog_s`` in ticks of the trigger, rounded up."""
        # A time of less than a tick rounded down would be 0, which turns the watchdog off.
        return math.ceil(self.watchdog_s * self.clock_hz)

    @property
    def settled_s(self) -> dict[str, float]:
        """Arm → delay (s) of a line's start after the light of its first sub-step is switched on."""
        ticks = {"a": self.a.delay_ticks, "b": self.b.delay_ticks}
        return {arm: (self.light.lead_ticks + delay) / self.clock_hz for arm, delay in ticks.items()}

    @property
    def lit_part(self) -> tuple[float, float]:
        """Begin and end of the light within a lit sub-step, as fractions of it."""
        closes = self.substep_ticks if self.light.close_ticks is None else self.light.close_ticks
        return self.light.open_ticks / self.substep_ticks, closes / self.substep_ticks

    @model_validator(mode="before")
    @classmethod
    def _convert_watchdog_ticks(cls, table: Any) -> Any:
        """Convert the watchdog of older recordings, which is in ticks, so that their rig stays readable."""
        if not isinstance(table, dict) or "watchdog_ticks" not in table or "watchdog_s" in table:
            return table
        ticks, clock_hz = table["watchdog_ticks"], table.get("clock_hz", cls.model_fields["clock_hz"].default)
        # Left as it is: validation refuses it, with the key in its message.
        if not isinstance(ticks, int) or not isinstance(clock_hz, int) or clock_hz <= 0:
            return table
        return {k: v for k, v in table.items() if k != "watchdog_ticks"} | {"watchdog_s": ticks / clock_hz}

    @model_validator(mode="after")
    def _port_known(self) -> TriggerConfig:
        # A board on USB is found by its vendor and product; a serial port by nothing but its name.
        if self.driver == "serial" and not self.url:
            raise ValueError("driver 'serial' needs a url, such as /dev/ttyUSB0 or socket://host:port")
        return self


class CameraConfig(FrozenModel):
    """One camera. DN = black level + responsivity · Y, with Y of Eq. (1)."""

    driver: Annotated[str, NameOf(CAMERAS)] = Field(
        default="simulated",
        description="'harvesters': through the maker's GenTL producer; 'aravis': GigE and USB3 Vision; "
        "'gentl-simulated', 'gige-simulated': simulated cameras through either; "
        "'pattern': stored lines in place of the scene, at any rate, for load tests; or one that "
        "`acquire plugins` lists",
    )
    options: Annotated[FrozenModel | None, OptionsOf(CAMERAS)] = Field(
        default=None, validate_default=True, description="options of the driver"
    )
    serial: str = "simulated"
    model: str = Field(default="", description="model that the camera must be; absent: any")
    cti: str = Field(
        default="",
        description="GenTL producer; absent: those of GENICAM_GENTL64_PATH. 'aravis': the camera's address",
    )
    # The order matters: in GenICam a selector decides which feature the name after it refers to.
    settings: tuple[tuple[GentlModule, str, bool | int | float | str], ...] = Field(
        default=(),
        description="[module, feature, value] in the order in which they are written; 'aravis': module "
        "'stream' has frame-retention, packet-timeout, packet-resend and other parameters of its stream",
    )
    # Not less: buffers for 10 ms were overrun on a loaded host.
    buffer_s: float = Field(
        default=0.5, ge=0.2, le=60, description="lines that the driver can buffer, in seconds"
    )
    first_column: int = Field(
        default=0, ge=0, le=2**16, description="layout 'compact': first column of the arm's image"
    )
    # Not always to be asked of the camera: GigE Vision counts in 16 bits, or in 64 with extended ids.
    frame_id_bits: int = Field(
        default=0, ge=0, le=64, description="bits of a frame id; 0: detected when the ids wrap around"
    )
    frame_id_first: Literal[0, 1] | None = Field(
        default=None, description="id of the first frame; absent: that of the first to arrive"
    )
    pixel_format: Literal["Mono8", "Mono10", "Mono12", "Mono16"] = "Mono12"
    black_level_dn: float = Field(default=0.0, ge=0, le=MOST_DN, description="value of a pixel without light")
    responsivity_dn: float = Field(
        default=1.0, gt=0, le=MOST_DN, description="DN per unit of scene light and sub-step"
    )
    dn_per_electron: float | None = Field(
        default=None,
        gt=0,
        le=MOST_DN,
        description="system gain K of EMVA 1288, if it is known and not in a calibration",
    )
    read_noise_e: float | None = Field(
        default=None, ge=0, le=MOST_DN, description="temporal dark noise of EMVA 1288, if it is known"
    )

    @model_validator(mode="after")
    def _noise_whole(self) -> CameraConfig:
        # Noise in DN is a product of both: one alone predicts nothing.
        if (self.dn_per_electron is None) != (self.read_noise_e is None):
            raise ValueError("dn_per_electron and read_noise_e must be given together, or not at all")
        return self

    @property
    def noise_facts(self) -> dict[str, float]:
        """The camera's noise, as stored in recordings; empty if it is not known."""
        if self.dn_per_electron is None or self.read_noise_e is None:
            return {}
        return {"dn_per_electron": self.dn_per_electron, "read_noise_e": self.read_noise_e}

    @property
    def bits(self) -> int:
        """Significant bits of a pixel."""
        return PIXEL_BITS[self.pixel_format]

    @property
    def white_dn(self) -> int:
        """The largest value a pixel can take; a pixel that has it is saturated."""
        return (1 << self.bits) - 1

    @property
    def dtype(self) -> Literal["uint8", "uint16"]:
        """Type of a pixel in memory and on disk, where 10 and 12 bits take 16."""
        return "uint8" if self.bits == 8 else "uint16"


class CamerasConfig(FrozenModel):
    """The cameras of both arms. One camera for both is opened as table a says; only the image is b's own."""

    layout: Literal["dual", "compact", "fibre"] = Field(
        default="dual",
        description="'dual': a camera for each arm; 'compact': one for both; 'fibre': a camera for each arm, "
        "behind the fibre that [fibre] describes",
    )
    a: CameraConfig
    b: CameraConfig

    def arm(self, name: str) -> CameraConfig:
        """Return the camera of an arm, ``"a"`` or ``"b"``."""
        return {"a": self.a, "b": self.b}[name]

    @model_validator(mode="after")
    def _alike(self) -> CamerasConfig:
        # Rings, recorder and code check have one type of sample and one white level for both arms.
        if self.a.pixel_format != self.b.pixel_format:
            raise ValueError(
                f"both arms need the same pixel_format, not {self.a.pixel_format} and {self.b.pixel_format}"
            )
        if self.layout == "compact" and (self.a.serial, self.a.driver) != (self.b.serial, self.b.driver):
            raise ValueError("layout 'compact' has one camera, so both arms need the same serial and driver")
        if (
            self.layout != "compact"
            and self.a.serial == self.b.serial
            # Simulated cameras are not found by their serial, which is the same by default.
            and (self.a.driver, self.b.driver) != ("simulated", "simulated")
        ):
            raise ValueError(f"both arms have the camera with serial {self.a.serial!r}")
        return self
