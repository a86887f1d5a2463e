"""One camera through Aravis: opening, settings, arming; its buffers become blocks of lines."""

from __future__ import annotations

import ctypes
import math
import time
from ctypes import byref, c_size_t, c_uint64
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.camera.aravis.bindings import errors, load
from acquire.camera.aravis.features import AravisFeatures
from acquire.camera.aravis.stream import StreamParameters, enlarge_sockets, usual_parameters
from acquire.camera.assembly import (
    STATISTICS,
    Assembly,
    Frame,
    FrameFormat,
    MissedTriggers,
    buffer_count,
    check_format,
    frame_format,
    read_settings,
)
from acquire.camera.base import CameraBlock, CameraIdentity
from acquire.camera.frames import FrameFacts
from acquire.camera.settings import apply_settings
from acquire.errors import CameraError, CameraLostError

if TYPE_CHECKING:
    from acquire.camera.settings import Features
    from acquire.camera.spec import GenicamSpec

FAKE = "Fake"
"""Interface of Aravis' own camera, for tests; off unless the spec's ``cti`` asks for it."""
_ALIVE_S = 0.5
"""How often a silent camera is checked."""
_SUCCESS, _ABORTED = 0, 7
"""Of ArvBufferStatus."""
_NO_ID = 2**64 - 1
"""Set in a buffer before it is filled. Only the first packet of a frame carries its number: without this, a
buffer whose frame lost that packet would still have the number of the previous frame."""
_NO_PACKET_SOCKET = 1
"""Aravis' packet socket, which it prefers where permitted, accepts packets of every other camera on the
interface until its filter is in place."""
_HEADERS_BYTES = 36
"""Headers of IP, UDP and GVSP in every packet of a frame."""
REACH = "check its cable, power and address, and that no other program controls it"


@dataclass(frozen=True, slots=True)
class AravisOpener:
    """Opens the camera in the process that calls it."""

    spec: GenicamSpec

    def __call__(self) -> AravisCamera:
        return AravisCamera(self.spec)


class AravisCamera:
    """One camera, opened and set; see `acquire.camera.base.Camera`."""

    def __init__(self, spec: GenicamSpec) -> None:
        self._spec = spec
        self._library = library = load()
        self._stream: int | None = None
        self._armed = False
        self._assembly: Assembly | None = None
        self._taken: set[int] = set()
        """Buffers that Aravis does not own: taken from its stream, and not yet queued again."""
        self._payload = 0
        self._camera: int | None = None
        device_id = spec.cti.encode() if spec.cti not in ("", FAKE) else _find(library, spec)
        with errors(f"open camera {spec.serial}", REACH) as error:
            self._camera = library.arv_camera_new(device_id, error)
        try:
            self._device = library.arv_camera_get_device(self._camera)
            if library.arv_camera_is_gv_device(self._camera):
                library.arv_camera_gv_set_stream_options(self._camera, _NO_PACKET_SOCKET)
            self._features = features = AravisFeatures(library, self._device)
            # Older cameras have the serial number as DeviceID.
            serial = _text(features, "DeviceSerialNumber") or _text(features, "DeviceID")
            firmware = _text(features, "DeviceFirmwareVersion") or _text(features, "DeviceVersion")
            vendor, model = _text(features, "DeviceVendorName"), _text(features, "DeviceModelName")
            self._identity = CameraIdentity(vendor, model, serial, firmware)
            _check_identity(self._identity, spec)
            self._parameters = StreamParameters(library, self._device, self._prepare, self._drop)
            apply_settings(spec.settings, self.features())
            check_format(self._format(), spec)
        except BaseException:
            self.close()
            raise

    def identify(self) -> CameraIdentity:
        """Return the identity that was read when the camera was opened."""
        return self._identity

    def settings(self) -> dict[str, Any]:
        """Return the settings of camera and stream as read back now, under their SFNC names."""
        return read_settings(self.features())

    def features(self) -> dict[str, Features]:
        """Return the features of the camera itself, and the parameters of Aravis' stream."""
        return {"remote": self._features, "stream": self._parameters}

    def _format(self) -> FrameFormat:
        return frame_format({"remote": self._features})

    def _prepare(self) -> int:
        """Return the stream of the next acquisition, whose new socket gets no packet of an earlier one."""
        if self._stream is None:
            found = self._format()
            with errors(f"stream of camera {self._spec.serial}", REACH) as error:
                self._stream = self._library.arv_camera_create_stream(self._camera, None, None, error)
            assert self._stream is not None
            self._parameters.furnish(self._stream, usual_parameters(found.height / self._spec.line_rate_hz))
        return self._stream

    def _drop(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            self._library.g_object_unref(stream)

    def arm(self) -> None:
        """Allocate buffers and start the acquisition, in a new stream, without frames of an earlier one."""
        self.disarm()
        library, found = self._library, self._format()
        self._missed = MissedTriggers(self.features())
        what = f"arm camera {self._spec.serial}"
        with errors(what, REACH) as error:
            self._payload = library.arv_camera_get_payload(self._camera, error)
        # USB3 Vision has frame IDs of 64 bits that do not skip 0; in GigE Vision they skip it.
        bits, skips_zero = 64, False
        if not library.arv_camera_is_uv_device(self._camera):
            # An option of GigE Vision 2, which a camera may have switched off, or not have at all.
            mode = self._features.find("GevGVSPExtendedIDMode")
            extended = mode is not None and mode.readable and mode.read() == "On"
            bits, skips_zero = 64 if extended else 16, True
        spec = replace(self._spec, frame_id_bits=self._spec.frame_id_bits or bits)
        buffers = buffer_count(self._spec, found)
        self._assembly = Assembly(found, spec, buffers, skips_zero)
        self._packets = 1
        if library.arv_camera_is_gv_device(self._camera):
            with errors(what, REACH) as error:
                size = library.arv_camera_gv_get_packet_size(self._camera, error)
            # A frame that finds no buffer is counted once for each of its packets, of which two more, leader
            # and trailer, have no lines.
            self._packets = 2 + math.ceil(self._payload / max(1, int(size) - _HEADERS_BYTES))
        stream = self._prepare()
        for _ in range(buffers):
            self._give(stream, library.arv_buffer_new_allocate(self._payload))
        # Set before the start, so that a start that fails half-way is stopped as well.
        self._armed = True
        enlarge_sockets()
        with errors(what, REACH) as error:
            library.arv_camera_start_acquisition(self._camera, error)
        self._heard_s = time.monotonic()

    def _give(self, stream: int, buffer: int) -> None:
        """Queue a buffer for Aravis to fill."""
        self._library.arv_buffer_set_frame_id(buffer, _NO_ID)
        self._library.arv_buffer_set_timestamp(buffer, 0)
        self._library.arv_stream_push_buffer(stream, buffer)

    def next_block(self, timeout_s: float) -> CameraBlock | None:
        """Return the next frame's lines; those of an incomplete frame are flagged."""
        if not self._armed:
            raise CameraError("a block was requested of a camera that is not armed", hint="arm it")
        assert self._assembly is not None
        block = self._assembly.next_block()
        if block is None:
            self._fetch(timeout_s)
            block = self._assembly.next_block()
        return block

    def _fetch(self, timeout_s: float) -> None:
        """Take the filled buffers, and assemble their frames to blocks."""
        # The next one, and all that wait already: the camera's counter of missed triggers is read over the
        # network, once for all of them. When it was read for each, a busy host ran out of buffers.
        buffers: list[int] = []
        buffer = self._library.arv_stream_timeout_pop_buffer(self._stream, round(timeout_s * 1e6))
        while buffer:
            buffers.append(buffer)
            buffer = self._library.arv_stream_try_pop_buffer(self._stream)
        if not buffers:
            self._check_alive()
            return
        self._heard_s = time.monotonic()
        assert self._stream is not None
        assert self._assembly is not None
        # Now, and not one by one: `disarm` has to free them also if the next lines find the camera gone.
        self._taken.update(buffers)
        try:
            missed = self._missed.count()
        except CameraError as error:
            raise self._gone(error.message) from error
        counts = c_uint64(), c_uint64(), c_uint64()
        self._library.arv_stream_get_statistics(self._stream, *map(byref, counts))
        # Of completed, failed and starved buffers. Rounded up: a frame may be counted only in part so far.
        underruns = math.ceil(counts[2].value / self._packets)
        for buffer in buffers:
            # The stream was ended before this buffer was filled: it stands for no frame.
            if self._library.arv_buffer_get_status(buffer) == _ABORTED:
                self._taken.remove(buffer)
                self._give(self._stream, buffer)
                continue
            for idle in self._assembly.take(self._frame(buffer, underruns, missed)):
                self._taken.remove(idle)
                self._give(self._stream, idle)

    def _frame(self, buffer: int, underruns: int, missed: int) -> Frame:
        library, size = self._library, c_size_t()
        address = library.arv_buffer_get_data(buffer, byref(size))
        memory = np.ctypeslib.as_array((ctypes.c_uint8 * self._payload).from_address(address))
        frame_id = library.arv_buffer_get_frame_id(buffer)
        complete = library.arv_buffer_get_status(buffer) == _SUCCESS and frame_id != _NO_ID
        facts = FrameFacts(
            # Also of an incomplete frame: a number other than the mark has come with this frame.
            None if frame_id == _NO_ID else frame_id,
            underruns,
            missed,
            library.arv_buffer_get_timestamp(buffer) or None,
        )
        # Aravis does not report how much of an incomplete frame has arrived.
        return Frame(buffer, memory, size.value if complete else self._payload, facts, complete)

    def _gone(self, why: str) -> CameraLostError:
        what = f"camera {self._spec.serial} is gone: {why}"
        return CameraLostError(what, hint="check its cable and power, then arm again")

    def _check_alive(self) -> None:
        """Raise CameraLostError if the silent camera is gone, or was away for a moment.

        In the latter case it answers, but is no longer controlled by this host, and sends nothing.
        """
        # Reading a feature takes a round trip on the network.
        if time.monotonic() - self._heard_s < _ALIVE_S:
            return
        self._heard_s = time.monotonic()
        try:
            self._format()
        except CameraError as error:
            raise self._gone(error.message) from error
        library = self._library
        if library.arv_camera_is_gv_device(self._camera) and not library.arv_gv_device_is_controller(
            self._device
        ):
            raise self._gone("it has restarted")

    def release(self, block: CameraBlock) -> None:
        """Give the block's buffer back to the stream; nothing, if the block is of an earlier acquisition."""
        # None of a block from before `disarm`, which has freed it.
        buffer = self._assembly.release(block) if self._assembly else None
        if buffer is not None and self._stream is not None:
            self._taken.remove(buffer)
            self._give(self._stream, buffer)

    def disarm(self) -> None:
        """Stop the acquisition and free its stream and buffers. Idempotent."""
        if not self._armed:
            return
        self._armed = False
        assert self._assembly is not None
        self._assembly.forget_buffers()
        while self._taken:  # buffers popped from the stream are ours; it frees the others itself
            self._library.g_object_unref(self._taken.pop())
        try:
            with errors("stop", REACH) as error:
                self._library.arv_camera_stop_acquisition(self._camera, error)
        except CameraError:
            return  # a camera that is gone has stopped
        finally:
            self._drop()

    def statistics(self) -> dict[str, int]:
        """Return the counters since arm; all 0 before the first one."""
        return self._assembly.statistics() if self._assembly else dict.fromkeys(STATISTICS, 0)

    def close(self) -> None:
        """Stop, and give up control of the device, so that others may open it. Idempotent."""
        self.disarm()
        self._drop()
        if self._camera is not None:
            self._library.g_object_unref(self._camera)
            self._camera = None


def list_cameras() -> list[tuple[str, str]]:
    """Return serial number and model of every camera that answers. Raises CameraError without Aravis."""
    library = load()
    library.arv_update_device_list()
    ask = (library.arv_get_device_serial_nbr, library.arv_get_device_model)
    found = [[(what(k) or b"").decode() for what in ask] for k in range(library.arv_get_n_devices())]
    return [(serial, model) for serial, model in found]


def _find(library: Any, spec: GenicamSpec) -> bytes:
    """Return the device ID of the camera with the serial number, among all that answer."""
    if spec.cti == FAKE:
        library.arv_enable_interface(FAKE.encode())
    library.arv_update_device_list()
    found = {
        (library.arv_get_device_serial_nbr(k) or b"").decode(): k for k in range(library.arv_get_n_devices())
    }
    if spec.serial not in found:
        raise CameraError(
            f"there is no camera with serial number {spec.serial!r}",
            possible=", ".join(found) or "no camera answers",
        )
    device_id: bytes = library.arv_get_device_id(found[spec.serial])
    return device_id


def _text(features: AravisFeatures, name: str) -> str:
    node = features.find(name)
    return str(node.read()) if node is not None and node.readable else ""


def _check_identity(found: CameraIdentity, spec: GenicamSpec) -> None:
    # An address may have been given to another camera, and swapped cameras would be noticed only in the
    # video.
    if found.serial != spec.serial:
        raise CameraError(
            f"the camera at {spec.cti} has serial number {found.serial!r}, not {spec.serial!r}",
            hint="change serial in the camera's table, or its cti, the address; acquire"
            " devices lists the cameras",
        )
    if spec.model and found.model != spec.model:
        raise CameraError(
            f"camera {spec.serial} is a {found.model!r}, not a {spec.model!r}",
            hint="change model in the camera's table, or serial, if another camera is meant",
        )
