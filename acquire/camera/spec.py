"""Specification of a GenICam camera, for any library that opens it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.camera.settings import Setting

if TYPE_CHECKING:
    from acquire.config import RigConfig


@dataclass(frozen=True, slots=True)
class GenicamSpec:
    """Which camera to open, its settings, and its expected format. Picklable.

    Attributes
    ----------
    serial, model : required identity; an empty model matches any
    settings : settings in order, usually with Width, PixelFormat and the stream's BufferHeight
    pixels, bits : required format of lines; 0: any
    line_rate_hz, buffer_s : buffers for this time at this rate are announced
    cti : the producer; empty: those of GENICAM_GENTL64_PATH. For Aravis: the camera's network address;
        empty: any camera with the serial number
    frame_id_bits, frame_id_first : see `acquire.camera.frames.FrameCount`
    """

    serial: str
    model: str = ""
    settings: tuple[Setting, ...] = ()
    pixels: int = 0
    bits: int = 0
    line_rate_hz: float = 10_000.0
    buffer_s: float = 0.5
    cti: str = ""
    frame_id_bits: int = 0
    frame_id_first: int | None = None


def spec_of(config: RigConfig, arm: str, cti: str | None = None) -> GenicamSpec:
    """Return the camera of an arm by the rig's file; ``cti`` replaces the file's producer."""
    camera = config.cameras.arm(arm)
    return GenicamSpec(
        serial=camera.serial,
        model=camera.model,
        settings=tuple(Setting(*setting) for setting in camera.settings),
        # In the compact layout lines are as wide as the sensor, of which each arm takes its columns.
        pixels=0 if config.columns else config.pixels,
        bits=camera.bits,
        line_rate_hz=config.line_rate_hz,
        buffer_s=camera.buffer_s,
        cti=camera.cti if cti is None else cti,  # "" is a choice as well: any producer
        frame_id_bits=camera.frame_id_bits,
        frame_id_first=camera.frame_id_first,
    )
