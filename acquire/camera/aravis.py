"""Cameras through Aravis: GigE Vision and USB3 Vision without a maker's software. Optional.

The only file that knows Aravis, and it asks for nothing but its shared library (Debian: libaravis-0.8-0),
which is loaded when a camera is opened. Calls through ctypes release the interpreter's lock, and a buffer's
memory is seen without a copy. Aravis has no CoaXPress.
"""

from __future__ import annotations

import ctypes
import functools
import time
from contextlib import contextmanager
from ctypes import (
    POINTER,
    byref,
    c_bool,
    c_char_p,
    c_double,
    c_int,
    c_int64,
    c_size_t,
    c_uint,
    c_uint64,
    c_void_p,
)
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.camera.assembly import (
    STATISTICS,
    Assembly,
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
    from collections.abc import Iterator

    from acquire.camera.settings import Kind, Value
    from acquire.camera.spec import GenicamSpec

LIBRARIES = ("libaravis-0.8.so.0", "libaravis-0.10.so.0")
FAKE = "Fake"
"""Interface of Aravis' own camera, for tests; off unless the spec's ``cti`` asks for it."""
_ALIVE_S = 0.5
_SUCCESS, _ABORTED = 0, 7
_KINDS: dict[str, Kind] = {
    "ArvGcIntegerNode": "integer",
    "ArvGcIntRegNode": "integer",
    "ArvGcMaskedIntRegNode": "integer",
    "ArvGcFloatNode": "float",
    "ArvGcFloatRegNode": "float",
    "ArvGcConverter": "float",
    "ArvGcIntConverterNode": "integer",
    "ArvGcSwissKnifeNode": "float",
    "ArvGcIntSwissKnifeNode": "integer",
    "ArvGcEnumeration": "enumeration",
    "ArvGcBoolean": "boolean",
    "ArvGcStringNode": "text",
    "ArvGcStringRegNode": "text",
    "ArvGcCommand": "command",
}
_SIGNATURES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_enable_interface": (None, (c_char_p,)),
    "arv_update_device_list": (None, ()),
    "arv_get_n_devices": (c_uint, ()),
    "arv_get_device_id": (c_char_p, (c_uint,)),
    "arv_get_device_serial_nbr": (c_char_p, (c_uint,)),
    "arv_get_device_model": (c_char_p, (c_uint,)),
    "arv_camera_new": (c_void_p, (c_char_p, c_void_p)),
    "arv_camera_get_device": (c_void_p, (c_void_p,)),
    "arv_camera_get_payload": (c_uint, (c_void_p, c_void_p)),
    "arv_camera_create_stream": (c_void_p, (c_void_p, c_void_p, c_void_p, c_void_p)),
    "arv_camera_start_acquisition": (None, (c_void_p, c_void_p)),
    "arv_camera_stop_acquisition": (None, (c_void_p, c_void_p)),
    "arv_device_get_feature": (c_void_p, (c_void_p, c_char_p)),
    "arv_device_is_feature_available": (c_bool, (c_void_p, c_char_p, c_void_p)),
    "arv_device_execute_command": (None, (c_void_p, c_char_p, c_void_p)),
    "arv_device_get_integer_feature_bounds": (
        None,
        (c_void_p, c_char_p, POINTER(c_int64), POINTER(c_int64), c_void_p),
    ),
    "arv_device_get_integer_feature_increment": (c_int64, (c_void_p, c_char_p, c_void_p)),
    "arv_device_get_float_feature_bounds": (
        None,
        (c_void_p, c_char_p, POINTER(c_double), POINTER(c_double), c_void_p),
    ),
    "arv_device_dup_available_enumeration_feature_values_as_strings": (
        POINTER(c_char_p),
        (c_void_p, c_char_p, POINTER(c_uint), c_void_p),
    ),
    "arv_gc_feature_node_get_actual_access_mode": (c_int, (c_void_p,)),
    "arv_gc_feature_node_is_locked": (c_bool, (c_void_p, c_void_p)),
    "arv_gc_category_get_features": (c_void_p, (c_void_p,)),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
    "arv_stream_get_statistics": (
        None,
        (c_void_p, POINTER(c_uint64), POINTER(c_uint64), POINTER(c_uint64)),
    ),
    "arv_buffer_new_allocate": (c_void_p, (c_size_t,)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_buffer_get_frame_id": (c_uint64, (c_void_p,)),
    "arv_buffer_get_timestamp": (c_uint64, (c_void_p,)),
    "g_type_name_from_instance": (c_char_p, (c_void_p,)),
    "g_object_unref": (None, (c_void_p,)),
    "g_error_free": (None, (c_void_p,)),
    "g_free": (None, (c_void_p,)),
    **{
        f"arv_device_{way}_{kind}_feature_value": (
            value if way == "get" else None,
            (c_void_p, c_char_p, *((value,) if way == "set" else ()), c_void_p),
        )
        for way in ("get", "set")
        for kind, value in (
            ("string", c_char_p),
            ("integer", c_int64),
            ("float", c_double),
            ("boolean", c_bool),
        )
    },
}


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
        self._assembly: Assembly | None = None
        self._buffers: set[int] = set()
        self._held: dict[CameraBlock, int] = {}
        self._camera: int | None = None
        device_id = spec.cti.encode() if spec.cti not in ("", FAKE) else _find(library, spec)
        with _errors(f"open camera {spec.serial}") as error:
            self._camera = library.arv_camera_new(device_id, error)
        try:
            self._device = library.arv_camera_get_device(self._camera)
            self._features = _Features(library, self._device)
            self._identity = _identify(self._features)
            _check_identity(self._identity, spec)
            apply_settings(spec.settings, self.features())
            check_format(frame_format(self.features()), spec)
        except BaseException:
            self.close()
            raise

    def identify(self) -> CameraIdentity:
        return self._identity

    def settings(self) -> dict[str, Any]:
        return read_settings(self.features())

    def features(self) -> dict[str, _Features]:
        """Aravis shows the camera itself only: module "remote"."""
        return {"remote": self._features}

    def arm(self) -> None:
        self.disarm()
        library, found = self._library, frame_format(self.features())
        self._missed = MissedTriggers(self.features())
        self._assembly = Assembly(found, self._spec)
        what = f"arm camera {self._spec.serial}"
        with _errors(what) as error:
            size = library.arv_camera_get_payload(self._camera, error)
        with _errors(what) as error:
            self._stream = library.arv_camera_create_stream(self._camera, None, None, error)
        for _ in range(buffer_count(self._spec, found)):
            library.arv_stream_push_buffer(self._stream, library.arv_buffer_new_allocate(size))
        with _errors(what) as error:
            library.arv_camera_start_acquisition(self._camera, error)
        self._heard_s = time.monotonic()

    def next_block(self, timeout_s: float) -> CameraBlock | None:
        """The next frame's lines; those of an incomplete frame are flagged."""
        if self._stream is None:
            raise CameraError("a block was asked of a camera that is not armed", hint="arm it")
        buffer = self._library.arv_stream_timeout_pop_buffer(self._stream, round(timeout_s * 1e6))
        if not buffer:
            self._ask_alive()
            return None
        self._heard_s = time.monotonic()
        status = self._library.arv_buffer_get_status(buffer)
        if status == _ABORTED:
            self._library.arv_stream_push_buffer(self._stream, buffer)
            return None
        block = self._read_out(buffer, complete=status == _SUCCESS)
        self._held[block] = buffer
        return block

    def _read_out(self, buffer: int, *, complete: bool) -> CameraBlock:
        library, size = self._library, c_size_t()
        address = library.arv_buffer_get_data(buffer, byref(size))
        memory = np.ctypeslib.as_array((ctypes.c_uint8 * size.value).from_address(address))
        counts = c_uint64(), c_uint64(), c_uint64()
        library.arv_stream_get_statistics(self._stream, *map(byref, counts))
        facts = FrameFacts(
            library.arv_buffer_get_frame_id(buffer),
            counts[2].value,
            self._missed.count(),
            library.arv_buffer_get_timestamp(buffer) or None,
        )
        assert self._assembly is not None
        return self._assembly.block(memory, size.value, 0, facts, complete=complete)

    def _ask_alive(self) -> None:
        if time.monotonic() - self._heard_s > _ALIVE_S:
            self._heard_s = time.monotonic()
            try:
                frame_format(self.features())
            except CameraError as error:
                raise CameraLostError(f"camera {self._spec.serial} is gone: {error.message}") from error

    def release(self, block: CameraBlock) -> None:
        buffer = self._held.pop(block, None)
        if buffer is not None:
            self._library.arv_stream_push_buffer(self._stream, buffer)

    def disarm(self) -> None:
        if self._stream is None:
            return
        stream, self._stream = self._stream, None
        for buffer in self._held.values():
            self._library.arv_stream_push_buffer(stream, buffer)
        self._held.clear()
        try:
            with _errors("stop") as error:
                self._library.arv_camera_stop_acquisition(self._camera, error)
        except CameraError:
            return  # a camera that is gone has stopped
        finally:
            self._library.g_object_unref(stream)

    def statistics(self) -> dict[str, int]:
        return self._assembly.statistics() if self._assembly else dict.fromkeys(STATISTICS, 0)

    def close(self) -> None:
        self.disarm()
        if self._camera is not None:
            self._library.g_object_unref(self._camera)
            self._camera = None


@functools.cache
def load() -> Any:
    """Aravis' shared library. Raises CameraError where there is none."""
    for name in LIBRARIES:
        try:
            library = ctypes.CDLL(name)
        except OSError:
            continue
        for function, (result, arguments) in _SIGNATURES.items():
            entry = getattr(library, function)
            entry.restype, entry.argtypes = result, arguments
        return library
    raise CameraError(
        "Aravis is not installed", possible=", ".join(LIBRARIES), hint="apt install libaravis-0.8-0"
    )


def list_cameras() -> list[tuple[str, str]]:
    """Serial number and model of every camera that answers. Raises CameraError where there is no Aravis."""
    library = load()
    library.arv_update_device_list()
    ask = (library.arv_get_device_serial_nbr, library.arv_get_device_model)
    found = [[(what(k) or b"").decode() for what in ask] for k in range(library.arv_get_n_devices())]
    return [(serial, model) for serial, model in found]


def _find(library: Any, spec: GenicamSpec) -> bytes:
    """The device with the serial number, of all that answer."""
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


def _identify(features: _Features) -> CameraIdentity:
    """By the camera's own features; older ones have the serial number as DeviceID."""
    serial = _text(features, "DeviceSerialNumber") or _text(features, "DeviceID")
    firmware = _text(features, "DeviceFirmwareVersion") or _text(features, "DeviceVersion")
    return CameraIdentity(
        _text(features, "DeviceVendorName"), _text(features, "DeviceModelName"), serial, firmware
    )


def _text(features: _Features, name: str) -> str:
    node = features.find(name)
    return str(node.read()) if node is not None and node.readable else ""


def _check_identity(found: CameraIdentity, spec: GenicamSpec) -> None:
    if found.serial != spec.serial:
        raise CameraError(f"the camera at {spec.cti} has serial number {found.serial!r}, not {spec.serial!r}")
    if spec.model and found.model != spec.model:
        raise CameraError(f"camera {spec.serial} is a {found.model!r}, not a {spec.model!r}")


class _Features:
    """`acquire.camera.settings.Features` of a device."""

    def __init__(self, library: Any, device: int) -> None:
        self._library, self._device = library, device

    def find(self, name: str) -> _Node | None:
        node = self._library.arv_device_get_feature(self._device, name.encode())
        kind = self._kind(node) if node else None
        return _Node(self._library, self._device, node, name, kind) if kind else None

    def _kind(self, node: int) -> Kind | None:
        return _KINDS.get(self._library.g_type_name_from_instance(node).decode())

    def names(self) -> list[str]:
        return [name for names in self.categories().values() for name in names]

    def categories(self) -> dict[str, list[str]]:
        found: dict[str, list[str]] = {}
        self._collect("Root", found)
        return {name: names for name, names in found.items() if names}

    def _collect(self, category: str, found: dict[str, list[str]]) -> None:
        node = self._library.arv_device_get_feature(self._device, category.encode())
        names = found.setdefault(category, [])
        for name in _strings(self._library.arv_gc_category_get_features(node)) if node else ():
            below = self._library.arv_device_get_feature(self._device, name.encode())
            if below and self._library.g_type_name_from_instance(below) == b"ArvGcCategory":
                if name not in found:
                    self._collect(name, found)
            elif below:
                names.append(name)


def _strings(node: int | None) -> Iterator[str]:
    """The texts of a GSList."""
    while node:
        data, node = (c_void_p * 2).from_address(node)
        if data:
            yield ctypes.string_at(data).decode()


class _Node:
    """`acquire.camera.settings.Node` of an Aravis feature."""

    def __init__(self, library: Any, device: int, node: int, name: str, kind: Kind) -> None:
        self._library, self._device, self._node = library, device, node
        self.name, self.kind = name, kind
        self._key = name.encode()
        self._word = {"enumeration": "string", "text": "string"}.get(kind, kind)

    @property
    def readable(self) -> bool:
        return self.kind != "command" and self._available and self._access in (0, 2)

    @property
    def writable(self) -> bool:
        return self._available and self._access in (1, 2)

    @property
    def _available(self) -> bool:
        with _errors(self.name) as error:
            return bool(self._library.arv_device_is_feature_available(self._device, self._key, error))

    @property
    def _access(self) -> int:
        mode: int = self._library.arv_gc_feature_node_get_actual_access_mode(self._node)
        return mode

    @property
    def selected(self) -> bool:
        """Aravis does not say: what a selector points at is read back when it is written."""
        return True

    def read(self) -> Value:
        with _errors(f"read {self.name}") as error:
            get = getattr(self._library, f"arv_device_get_{self._word}_feature_value")
            value = get(self._device, self._key, error)
        return value.decode() if isinstance(value, bytes) else value or (0 if value is not None else "")

    def write(self, value: Value) -> None:
        with _errors(f"set {self.name} to {value!r}") as error:
            if self.kind != "command":
                given = value.encode() if isinstance(value, str) else value
                put = getattr(self._library, f"arv_device_set_{self._word}_feature_value")
                put(self._device, self._key, given, error)
            elif value:
                self._library.arv_device_execute_command(self._device, self._key, error)

    def limits(self) -> tuple[float, float, float]:
        number = c_int64 if self.kind == "integer" else c_double
        low, high, step = number(), number(), 0
        with _errors(self.name) as error:
            bounds = getattr(self._library, f"arv_device_get_{self.kind}_feature_bounds")
            bounds(self._device, self._key, byref(low), byref(high), error)
        if self.kind == "integer":
            with _errors(self.name) as error:
                step = self._library.arv_device_get_integer_feature_increment(self._device, self._key, error)
        return low.value, high.value, step

    def entries(self) -> list[str]:
        count = c_uint()
        with _errors(self.name) as error:
            found = self._library.arv_device_dup_available_enumeration_feature_values_as_strings(
                self._device, self._key, byref(count), error
            )
        names = [found[k].decode() for k in range(count.value)]
        self._library.g_free(found)
        return names


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", c_int), ("message", c_char_p))


@contextmanager
def _errors(what: str) -> Iterator[Any]:
    """Gives a place for a GError; raises CameraError when one was put there."""
    place = POINTER(_GError)()
    yield byref(place)
    if ctypes.cast(place, c_void_p).value:
        message = (place.contents.message or b"").decode(errors="replace")
        load().g_error_free(place)
        raise CameraError(f"{what}: {message}")
