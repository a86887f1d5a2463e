"""Cameras through harvesters: any camera whose maker gives a GenTL producer (.cti).

The only file that imports harvesters, and only when a camera is opened: importing it changes warning filters,
opening takes over SIGINT (both are restored), and a producer must never be forked. The binding holds the
interpreter's lock while it waits, so a camera needs a separate process.

harvesters is used to find producers and devices, load the node maps, announce buffers, start and stop. It is
not used to fetch buffers, because it silently requeues incomplete ones: they are taken from its NewBuffer
monitor directly. A buffer is announced once, accessed as an array without a copy, and queued again by
`release`.
"""

from __future__ import annotations

import logging
import signal
import threading
import time
import warnings
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.camera.assembly import (
    STATISTICS,
    Assembly,
    Frame,
    MissedTriggers,
    buffer_count,
    check_format,
    frame_format,
    read_settings,
)
from acquire.camera.base import CameraIdentity
from acquire.camera.frames import FrameFacts, Tally
from acquire.camera.genapi import GenapiFeatures, Words, is_gone, translated
from acquire.camera.producers import find_producers
from acquire.camera.settings import apply_settings
from acquire.camera.spec import spec_of
from acquire.camera.variant import CameraVariant
from acquire.errors import CameraError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from acquire.camera.base import CameraBlock, CameraOpener
    from acquire.camera.spec import GenicamSpec
    from acquire.config import RigConfig

_ALIVE_S = 0.5
"""How often a silent camera is checked."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A camera that a producer lists; ``access`` is "free", or why it cannot be opened."""

    serial: str
    model: str
    vendor: str
    firmware: str
    access: str
    cti: str


@dataclass(frozen=True, slots=True)
class HarvestersOpener:
    """Opens the camera in the process that calls it."""

    spec: GenicamSpec

    def __call__(self) -> HarvestersCamera:
        return HarvestersCamera(self.spec)


class HarvestersCameras(CameraVariant):
    """Any GenICam camera, through its maker's GenTL producer (.cti)."""

    def opener(self, config: RigConfig, arm: str, bench: Any) -> CameraOpener:  # noqa: ARG002
        return HarvestersOpener(spec_of(config, arm))


def list_cameras(cti: str = "") -> list[FoundCamera]:
    """Return every camera that the producers list now. Raises CameraError if there is no producer."""
    with _Library(cti) as library:
        return library.found()


class HarvestersCamera:
    """One camera, opened and set; see `acquire.camera.base.Camera`."""

    def __init__(self, spec: GenicamSpec) -> None:
        self._spec = spec
        self._library = _Library(spec.cti)
        self._acquirer: Any = None
        self._armed = False
        self._assembly: Assembly | None = None
        self._views: dict[int, Any] = {}
        try:
            self._found = self._library.pick(spec.serial, spec.model)
            self._acquirer = self._library.create(self._found)
            streams: Sequence[Any] = self._acquirer.data_streams
            # Producers may lack some of the modules.
            maps = {
                "remote": self._acquirer.remote_device.node_map,
                "interface": _map_of(self._acquirer.interface),
                "device": _map_of(self._acquirer.device),
                "stream": _map_of(streams[0]) if streams else None,
                "system": _map_of(self._acquirer.system),
            }
            self._features = {
                name: GenapiFeatures(found) for name, found in maps.items() if found is not None
            }
            apply_settings(spec.settings, self._features)
            # After the settings: they may have changed width, height and pixel format.
            check_format(frame_format(self._features), spec)
        except BaseException:
            self.close()
            raise

    def identify(self) -> CameraIdentity:
        """Return the identity by which the camera was found."""
        found = self._found
        return CameraIdentity(found.vendor, found.model, found.serial, found.firmware)

    def settings(self) -> dict[str, Any]:
        """Return the settings of all modules as read back now, under their SFNC names."""
        return read_settings(self._features)

    def features(self) -> dict[str, GenapiFeatures]:
        """Return, per module, all its features (`acquire.camera.settings.Features`)."""
        return self._features

    def arm(self) -> None:
        """Allocate buffers and start the acquisition."""
        self.disarm()
        found = frame_format(self._features)
        self._views.clear()
        self._missed = MissedTriggers(self._features)
        buffers = buffer_count(self._spec, found)
        self._assembly = Assembly(found, self._spec, buffers)
        with translated(f"arm camera {self._spec.serial}"), _signals_kept():
            acquirer = self._acquirer
            acquirer.num_buffers = buffers
            # harvesters' monitors are private, but the only way to learn of incomplete buffers.
            self._stream = acquirer.data_streams[0]
            self._monitor = acquirer._new_buffer_event_monitor_dict[self._stream]
            # GenTL counts STREAM_INFO_NUM_UNDERRUN since the stream was opened, not since it was started.
            self._underruns = Tally(self._read_underruns())
            # Without harvesters' own thread, which kept only the last of ten frames and counted no underrun.
            acquirer.start()
            self._armed = True
        self._heard_s = time.monotonic()

    def next_block(self, timeout_s: float) -> CameraBlock | None:
        """Return the next frame's lines; those of an incomplete one are flagged, absent ones are losses."""
        if not self._armed:
            raise CameraError("a block was requested of a camera that is not armed", hint="arm it")
        assert self._assembly is not None
        block = self._assembly.next_block()
        if block is None:
            buffer = self._await_buffer(timeout_s)
            if buffer is None:
                # Some producers do not report that their camera is gone; reading a register does.
                if time.monotonic() - self._heard_s > _ALIVE_S:
                    self._heard_s = time.monotonic()
                    remote = self._features["remote"]
                    node = remote.find("AcquisitionMode") or remote.find("Width")
                    if node is not None:
                        node.read_afresh()
                return None
            self._heard_s = time.monotonic()
            with translated(f"camera {self._spec.serial}"):
                self._take(buffer)
            block = self._assembly.next_block()
        return block

    def _await_buffer(self, timeout_s: float) -> Any:
        from genicam import gentl

        try:
            with translated(f"camera {self._spec.serial}"):
                # In whole ms, GenTL's unit; 0 would not wait at all, and the caller's loop would spin.
                self._monitor.update_event_data(max(1, round(timeout_s * 1000)))
                return self._monitor.buffer
        except CameraError as error:
            if isinstance(error.__cause__, gentl.TimeoutException):
                return None
            raise

    def _take(self, buffer: Any) -> None:
        """Take a filled buffer, and assemble its frame to blocks."""
        complete = bool(buffer.is_complete())
        # A producer without time stamps may refuse the query, or return 0.
        time_ns = _or(lambda: int(buffer.timestamp_ns), 0) or None
        # Buffers are announced once and reused: each becomes an array once, without a copy.
        key = buffer.context
        if key not in self._views:
            self._views[key] = np.frombuffer(buffer.raw_buffer, np.uint8)
        frame = Frame(
            buffer,
            self._views[key],
            int(buffer.size_filled),
            FrameFacts(  # producers differ in the facts of an incomplete frame
                int(buffer.frame_id) if complete else None,
                self._underruns.note(self._read_underruns()),
                self._missed.count(),
                time_ns if complete else None,
            ),
            complete,
            padding=_or_zero(lambda: buffer.padding_x),
            rows=_or_zero(lambda: buffer.delivered_image_height),
        )
        assert self._assembly is not None
        for idle in self._assembly.take(frame):
            self._stream.module.queue_buffer(idle, False)

    def _read_underruns(self) -> int:
        return _or_zero(lambda: self._stream.module.num_underrun)

    def release(self, block: CameraBlock) -> None:
        """Queue the block's buffer again, unless its acquisition has ended."""
        buffer = self._assembly.release(block) if self._assembly else None
        # A stopped stream has its buffers back: queueing one of them again is an error.
        if buffer is not None and self._armed:
            with translated(f"camera {self._spec.serial}"):
                self._stream.module.queue_buffer(buffer, False)

    def disarm(self) -> None:
        """Stop, in any state of the camera."""
        if not self._armed:
            return
        self._armed = False  # first: `release` must not queue a buffer of a stream that is being stopped
        assert self._assembly is not None
        self._assembly.forget_buffers()
        self._views.clear()  # before their memory is freed
        with suppress(CameraError), translated("stop"):
            self._acquirer.stop()
            return
        from genicam import gentl

        # harvesters stops half-way if the camera is gone: the other half is done here.
        acquirer, stream = self._acquirer, self._acquirer.data_streams[0]
        for step in (
            lambda: stream.stop_acquisition(gentl.ACQ_STOP_FLAGS_LIST.ACQ_STOP_FLAGS_KILL),
            acquirer._release_buffers,
            lambda: [each.flush_event_queue() for each in acquirer._new_buffer_event_monitor_dict.values()],
        ):
            with suppress(CameraError), translated("stop"):
                step()

    def statistics(self) -> dict[str, int]:
        """Return the counters since arm; all 0 before the first one."""
        return self._assembly.statistics() if self._assembly else dict.fromkeys(STATISTICS, 0)

    def close(self) -> None:
        """Stop, and close device, producer and library. Idempotent."""
        self.disarm()
        self._features = {}
        self._acquirer = None
        self._library.close()


class _Library:
    """harvesters with its producers loaded: one per camera, closed with it."""

    def __init__(self, cti: str) -> None:
        self._producers = find_producers(cti)
        self._words = Words()
        with warnings.catch_warnings(), translated("load harvesters"):
            warnings.simplefilter("ignore")
            try:
                from harvesters.core import Harvester, ParameterKey, ParameterSet
            except ImportError as error:
                raise CameraError(
                    f"harvesters cannot be imported: {error}", hint="pip install harvesters genicam"
                ) from error
            # Outside the tree of loggers, so that it gets the messages of this camera alone.
            logger = logging.Logger("harvesters", logging.WARNING)
            logger.addHandler(self._words)
            self._harvester = Harvester(config=ParameterSet({ParameterKey.LOGGER: logger}))
            for path in self._producers:
                self._harvester.add_file(str(path))
            # Once, before a camera is opened: it must not be called while one streams.
            self._harvester.update()

    def found(self) -> list[FoundCamera]:
        return [_describe(info) for info in self._harvester.device_info_list]

    def pick(self, serial: str, model: str) -> FoundCamera:
        """Return the camera with this serial number. Raises CameraError that lists the cameras found."""
        found = self.found()
        chosen = next((camera for camera in found if serial in (camera.serial, "")), None)
        if chosen is None:
            there = ", ".join(f"{camera.serial} ({camera.model})" for camera in found)
            raise CameraError(
                f"there is no camera with serial number {serial!r}",
                possible=there or "no camera answers",
                hint=self._words.last or "check cable and power, then acquire devices",
            )
        if model and chosen.model != model:
            raise CameraError(
                f"camera {serial} is a {chosen.model!r}, not a {model!r}",
                hint="check whether the cameras are swapped",
            )
        if chosen.access != "free":
            raise CameraError(f"camera {serial} is {chosen.access}", hint="end the program that holds it")
        return chosen

    def create(self, camera: FoundCamera) -> Any:
        infos = self._harvester.device_info_list
        index = next(k for k, info in enumerate(infos) if _describe(info) == camera)
        with translated(f"open camera {camera.serial}", self._words), _signals_kept():
            acquirer = self._harvester.create(index)
        node_map = acquirer.remote_device.node_map
        # A description that cannot be parsed is only logged; each access would then fail for another reason.
        if node_map is None or GenapiFeatures(node_map).find("Width") is None:
            raise CameraError(
                f"camera {camera.serial}: its description cannot be used", hint=self._words.last
            )
        return acquirer

    def close(self) -> None:
        """Close the library, ignoring errors of a camera that is gone. Idempotent."""
        # `reset`, not only the acquirer's `destroy`: harvesters keeps destroyed objects until then.
        with suppress(CameraError), translated("close"), _signals_kept():
            self._harvester.reset()

    def __enter__(self) -> _Library:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _map_of(module: Any) -> Any:
    # harvesters also creates node maps of modules without a description, which have no root.
    node_map = module.node_map
    return node_map if node_map is not None and GenapiFeatures(node_map).find("Root") is not None else None


def _describe(info: Any) -> FoundCamera:
    texts = [_or(lambda name=name: str(getattr(info, name)), "") for name in _IDENTITY]
    # A producer need not know serial numbers; its own ID of the camera then stands for one.
    if not texts[0]:
        texts[0] = _or(lambda: str(info.id_), "")
    status = _or(lambda: int(info.access_status), 0)
    cti = _or(lambda: str(info.parent.parent.parent.path_name), "")
    return FoundCamera(
        serial=texts[0],
        model=texts[1],
        vendor=texts[2],
        firmware=texts[3],
        access=_ACCESS.get(status, "free"),
        cti=cti,
    )


_IDENTITY = ("serial_number", "model", "vendor", "version")
# DEVICE_ACCESS_STATUS of GenTL. 0 is unknown and 1 is free for reading and writing.
_ACCESS = {2: "open for reading only", 3: "not accessible", 4: "in use by another program", 5: "in use here"}


def _or(ask: Any, otherwise: Any) -> Any:
    """Return a producer's answer, or ``otherwise`` if it does not support the query."""
    from genicam import gentl

    try:
        return ask()
    except gentl.GenericException as error:
        if is_gone(error):
            raise
        return otherwise


def _or_zero(ask: Any) -> int:
    return int(_or(ask, 0))


@contextmanager
def _signals_kept() -> Iterator[None]:
    """Restore the handler of SIGINT, which harvesters replaces in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    kept = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, kept)
