"""From a run and the rig's configuration to the values of the trigger's registers, or to a refusal.

Everything that the device would refuse when armed is refused here first, with an explanation: what was
requested, what is possible, what to try.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from acquire.codes import TAPS, register_state
from acquire.errors import TriggerError
from acquire.trigger import registers as r

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from acquire.config.device import LightOutputConfig, LineOutputConfig, TriggerConfig
    from acquire.trigger.base import Delays, LightWindow, TriggerRun

_DEFAULT_WIDTH = 90  # 1 µs at 90 MHz
_TWINS = (r.Board.NONE, r.Board.MODEL)
"""Boards with simulated light."""
_TAG_FRAME_BYTES = r.TAG_BYTES + 10
"""Size on the wire, with header, CRC, COBS and delimiter."""
_TAGS_SHARE = 0.5
"""Share of the link for tags; the rest is for answers, and for emptying a FIFO that has filled up."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadedCode:
    """The repeating contents of the code memory, as a run's code. Bits are 0 or 1 each."""

    loaded: NDArray[np.uint8]

    def bits(self, start: int, length: int) -> NDArray[np.uint8]:
        index = np.arange(start, start + length)
        # A run has no code before its first line; a negative index would find the end of the loaded one.
        return np.where(index < 0, 0, self.loaded[index % len(self.loaded)]).astype(np.uint8)

    def to_attrs(self) -> dict[str, Any]:
        return {"kind": "memory", "length": len(self.loaded), "start": 0}


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Capabilities stated by a device. Ticks are clocks of the device."""

    clock_hz: int
    serial: str
    firmware: str
    board: str
    code_bits: int
    substep_ticks_min: int
    substep_ticks_max: int
    lead_margin_ticks: int
    substeps: tuple[int, ...]
    start_latency_ticks: int
    tag_room: int
    rx_bytes: int
    inputs: tuple[str, ...]
    light_active: Literal["high", "low", "any"]
    """Active level for which the output is dark from power-up on; any if no light is connected."""

    @classmethod
    def read(cls, values: Mapping[r.Register, int]) -> Capabilities:
        """Return the capabilities from the constant registers."""
        version, limits = r.VERSION.unpack(values[r.VERSION]), r.LIMITS.unpack(values[r.LIMITS])
        can, queues = r.CAPABILITIES.unpack(values[r.CAPABILITIES]), r.QUEUES.unpack(values[r.QUEUES])
        boards = {int(board): board.name.lower() for board in r.Board}
        return cls(
            clock_hz=values[r.CLOCK_HZ],
            serial=f"{values[r.SERIAL]:016x}",
            firmware=f"{version['firmware_major']}.{version['firmware_minor']}",
            board=boards.get(version["board"], f"board {version['board']}"),
            code_bits=values[r.CODE_BITS],
            substep_ticks_min=limits["substep_min"],
            substep_ticks_max=(1 << limits["substep_max_log2"]) - 1,
            lead_margin_ticks=limits["lead_margin"],
            substeps=tuple(S for S in range(8) if can["substeps"] >> S & 1),
            start_latency_ticks=can["start_latency"],
            tag_room=queues["tags"],
            rx_bytes=queues["rx_bytes"],
            inputs=tuple(name for name in ("strobes", "pps", "scene_gate", "external_arm") if can[name]),
            light_active="any" if version["board"] in _TWINS else "low" if can["light_low"] else "high",
        )


GATEWARE = Capabilities(
    clock_hz=90_000_000,
    serial="",
    firmware="",
    board="",
    code_bits=1 << 19,
    substep_ticks_min=5,
    substep_ticks_max=(1 << 24) - 1,
    lead_margin_ticks=1,
    substeps=(1, 2, 3, 6),
    start_latency_ticks=0,
    tag_room=1024,
    rx_bytes=2048,
    inputs=("strobes", "pps", "scene_gate", "external_arm"),
    light_active="any",
)
"""Maximal capabilities of a device with this program's firmware, used before one is connected."""


def register_values(
    run: TriggerRun, config: TriggerConfig, device: Capabilities, bytes_per_s: float
) -> dict[r.Register, int]:
    """Return every config register's value.

    Raises TriggerError if the device or its link do not support it.
    """
    if run.delays is not None:
        config = with_delays(config, run.delays)
    if run.window is not None:
        config = with_window(config, run.window)
    distance = run.substep_ticks if config.line_start == "per-substep" else run.line_period_ticks
    _check_timing(run, config, device, distance)
    _check_tags(run, device, bytes_per_s)
    most = (1 << r.WATCHDOG.width) - 1
    if config.watchdog_ticks > most:
        raise TriggerError(
            f"the watchdog cannot wait for {config.watchdog_s:g} s",
            possible=f"up to {most / config.clock_hz:.4g} s at {config.clock_hz} Hz; 0: never",
            hint="change trigger.watchdog_s",
        )
    return {
        **_code(run.code.to_attrs(), device),
        r.SUBSTEP_CLOCKS: run.substep_ticks,
        r.LINE: r.LINE.pack(
            substeps=run.substeps,
            mode=r.LineMode.PER_SUBSTEP if config.line_start == "per-substep" else r.LineMode.PER_LINE,
            direction=config.a.direction == "reverse",
        ),
        r.PHASE_CLOCKS: run.line_period_ticks // 6,  # six sub-phases per line, for any S
        **_light(config.light, run.substep_ticks, device),
        **_output(config.a, "A", distance, device),
        **_output(config.b, "B", distance, device),
        r.CAMERA_MIN_PERIOD: config.camera_min_period_ticks,
        r.LINE_BUDGET: config.line_budget,
        r.TAG_INTERVAL: run.tag_every_lines,
        r.WATCHDOG: config.watchdog_ticks,
        r.EXTERNAL_ARM: r.EXTERNAL_ARM.pack(
            enable=config.external_start != "off", invert=config.external_start == "falling"
        ),
    }


def with_delays(config: TriggerConfig, delays: Delays) -> TriggerConfig:
    """Return the configuration with other delays."""
    return config.model_copy(
        update={
            "light": config.light.model_copy(update={"lead_ticks": delays.light_lead_ticks}),
            "a": config.a.model_copy(update={"delay_ticks": delays.a_ticks}),
            "b": config.b.model_copy(update={"delay_ticks": delays.b_ticks}),
        }
    )


def with_window(config: TriggerConfig, window: LightWindow) -> TriggerConfig:
    """Return the configuration with another window of the light."""
    light = {"open_ticks": window.open_ticks, "close_ticks": window.close_ticks}
    return config.model_copy(update={"light": config.light.model_copy(update=light)})


def _check_timing(run: TriggerRun, config: TriggerConfig, device: Capabilities, distance: int) -> None:
    # The clock first: everything else is in its ticks.
    if config.clock_hz != device.clock_hz:
        raise TriggerError(
            f"trigger.clock_hz is {config.clock_hz} Hz, which is not the clock of this device",
            possible=f"{device.clock_hz} Hz, the clock of this device",
            hint="set trigger.clock_hz, and substep_ticks with it",
        )
    if not device.substep_ticks_min <= run.substep_ticks <= device.substep_ticks_max:
        raise TriggerError(
            f"the trigger cannot make a sub-step of {run.substep_ticks} ticks",
            possible=f"{device.substep_ticks_min} to {device.substep_ticks_max}",
            hint="change trigger.substep_ticks",
        )
    if run.substeps not in device.substeps:
        raise TriggerError(
            f"the trigger cannot make {run.substeps} sub-steps per line",
            possible=", ".join(map(str, device.substeps)),
            hint="change geometry.substeps",
        )
    if config.external_start != "off" and "external_arm" not in device.inputs:
        raise TriggerError(
            "this device has no input for an external start",
            possible="start by command",
            hint="trigger.external_start='off'",
        )
    if distance < config.camera_min_period_ticks:
        raise TriggerError(
            f"the camera pulses are only {distance} ticks apart",
            possible=f"{config.camera_min_period_ticks} or more (trigger.camera_min_period_ticks)",
            hint="a longer trigger.substep_ticks",
        )


def _check_tags(run: TriggerRun, device: Capabilities, bytes_per_s: float) -> None:
    if run.tag_every_lines < 1:
        raise TriggerError(
            f"the trigger cannot send a tag every {run.tag_every_lines} lines", possible="1 or more"
        )
    line_rate = device.clock_hz / run.line_period_ticks
    fewest = int(line_rate * _TAG_FRAME_BYTES / (bytes_per_s * _TAGS_SHARE)) + 1
    if run.tag_every_lines < fewest and bytes_per_s != float("inf"):
        raise TriggerError(
            f"the link cannot carry a tag every {run.tag_every_lines} lines at {line_rate:g} lines/s",
            possible=f"every {fewest} lines over a link of {bytes_per_s:g} bytes/s",
            hint="raise trigger.tag_every_lines or trigger.baud",
        )


def _code(attrs: Mapping[str, Any], device: Capabilities) -> dict[r.Register, int]:
    """Return the registers of the code; those that its source does not need are as after power-up."""
    # Also those that the source does not need: every register of the configuration is written and compared.
    values = {r.CODE_SOURCE: 0, r.CODE_LENGTH: 0, r.PRBS_MASK: 0, r.PRBS_SEED: 0}
    kind = attrs.get("kind")
    if kind == "constant":
        value = int(attrs["value"])
        return values | {r.CODE_SOURCE: r.CODE_SOURCE.pack(kind=r.Source.CONSTANT, value=value)}
    if kind == "memory" and 0 < int(attrs["length"]) <= device.code_bits:
        source = r.CODE_SOURCE.pack(kind=r.Source.MEMORY)
        return values | {r.CODE_SOURCE: source, r.CODE_LENGTH: int(attrs["length"])}
    if kind == "prbs" and tuple(attrs["taps"]) == TAPS.get(int(attrs["degree"])):
        # Not the attribute `seed`, which is the user's number: the state of the register was made from it.
        mask, state = sum(1 << tap - 1 for tap in attrs["taps"]), register_state(attrs)
        if 0 < state < 1 << attrs["degree"]:  # a register of zeros would stay 0 for ever
            source = r.CODE_SOURCE.pack(kind=r.Source.PRBS)
            return values | {r.CODE_SOURCE: source, r.PRBS_MASK: mask, r.PRBS_SEED: state}
    raise TriggerError(
        f"the trigger cannot generate the code: {dict(attrs)}",
        possible=f"prbs with known taps and a state, constant, memory of 1 to {device.code_bits} bits",
    )


def _light(light: LightOutputConfig, substep_ticks: int, device: Capabilities) -> dict[r.Register, int]:
    closes = substep_ticks if light.close_ticks is None else light.close_ticks
    if not light.open_ticks < closes <= substep_ticks:
        raise TriggerError(
            f"the light cannot be on from tick {light.open_ticks} to {closes} of a sub-step",
            possible=f"within 0 to {substep_ticks}",
            hint="change trigger.light.open_ticks and close_ticks",
        )
    if device.light_active not in {"any", light.active}:
        raise TriggerError(
            f"the light cannot be lit by a {light.active} level",
            possible=f"{device.light_active}, for which this board was built: others light it at power-up",
            hint=f"trigger.light.active, or firmware.build with --light-active {light.active}",
        )
    most = substep_ticks - device.lead_margin_ticks
    if light.lead_ticks > most:
        raise TriggerError(
            f"the light cannot be {light.lead_ticks} ticks ahead",
            possible=f"at most {most} with this sub-step",
        )
    if light.scene_gate and "scene_gate" not in device.inputs:
        raise TriggerError(
            "this device has no scene gate for the light", possible="trigger.light.scene_gate = false"
        )
    led = r.LED.pack(
        enable=light.enable,
        gate_enable=light.scene_gate,
        invert=light.active == "low",
        lead=light.lead_ticks,
    )
    return {r.LED: led, r.WINDOW_OPEN: light.open_ticks, r.WINDOW_CLOSE: closes}


def pulse_width_ticks(configured: int | None, distance: int) -> int:
    """Return the pulse width of a line trigger whose pulses are ``distance`` ticks apart."""
    return configured or max(1, min(_DEFAULT_WIDTH, distance // 3))


def _output(output: LineOutputConfig, arm: str, distance: int, device: Capabilities) -> dict[r.Register, int]:
    width = pulse_width_ticks(output.width_ticks, distance)
    # A pulse that lasts until the next one begins is one long pulse to the camera.
    if output.enable and output.delay_ticks + width >= distance:
        raise TriggerError(
            f"the pulse of camera {arm} is {width} ticks wide and {output.delay_ticks} late: too much",
            possible=f"delay + width below the {distance} ticks between pulses",
            hint=f"change trigger.{arm.lower()}.delay_ticks and width_ticks",
        )
    if output.strobe and "strobes" not in device.inputs:
        raise TriggerError(
            f"this device cannot watch the strobes of camera {arm}",
            possible=f"trigger.{arm.lower()}.strobe = false",
        )
    control = r.TRIGGER_A.pack(
        enable=output.enable,
        invert=output.active == "low",
        direction=output.direction == "reverse",
        strobe=output.strobe,
    )
    names = {name: getattr(r, f"TRIGGER_{arm}{name}") for name in ("", "_DELAY", "_WIDTH")}
    return {names[""]: control, names["_DELAY"]: output.delay_ticks, names["_WIDTH"]: width}
