"""Parameters of Aravis' stream as features of the module "stream": timeouts of packets and frames, requests
for lost packets, size of the socket's buffer.

They are properties of GObjects, under Aravis' own names (``frame-retention``, in microseconds), and exist
only with a stream: `StreamParameters` keeps the written values, and applies them to every new stream.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import socket
from ctypes import byref, c_double, c_int, c_uint, c_void_p
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from acquire.camera.settings import Kind, Value

_READ_WRITE, _CONSTRUCT_ONLY = 3, 8
_KINDS: dict[bytes, Kind] = {
    b"gboolean": "boolean",
    b"gint": "integer",
    b"guint": "integer",
    b"gdouble": "float",
    b"GEnum": "enumeration",
}
_BASES = (b"ArvStream", b"ArvDevice")
"""Classes whose properties are internal to Aravis."""


class _ParamSpec(ctypes.Structure):
    """GParamSpec, its public part, and GObject's own after it."""

    _fields_ = (
        ("instance", c_void_p),
        ("name", ctypes.c_char_p),
        ("flags", c_uint),
        ("value_type", ctypes.c_size_t),
        ("owner_type", ctypes.c_size_t),
        ("private", c_void_p * 3),
        ("counts", c_uint * 2),
    )


class _EnumValue(ctypes.Structure):
    _fields_ = (("value", c_int), ("name", ctypes.c_char_p), ("nick", ctypes.c_char_p))


class _EnumClass(ctypes.Structure):
    _fields_ = (
        ("type", ctypes.c_size_t),
        ("minimum", c_int),
        ("maximum", c_int),
        ("count", c_uint),
        ("values", ctypes.POINTER(_EnumValue)),
    )


class _Data(ctypes.Union):
    _fields_ = (("v_int", c_int), ("v_uint", c_uint), ("v_double", c_double), ("all", ctypes.c_uint64 * 2))


class _GValue(ctypes.Structure):
    _fields_ = (("type", ctypes.c_size_t), ("data", _Data))


@dataclass(frozen=True, slots=True)
class _Property:
    """One property of a GObject: its type, and its possible values."""

    name: str
    kind: Kind
    value_type: int
    field: str
    limits: tuple[float, float]
    entries: dict[str, int]


class StreamParameters:
    """`acquire.camera.settings.Features` of the module "stream".

    Parameters
    ----------
    device : device, whose own properties determine the size of packets
    stream : returns the current stream, created if there is none
    drop : removes the current stream; the packets of the next one are sized again
    """

    def __init__(
        self, library: Any, device: int, stream: Callable[[], int], drop: Callable[[], None]
    ) -> None:
        self._library, self._device, self._stream, self._drop = library, device, stream, drop
        self._of_device = _properties(library, device)
        self._written: dict[str, Value] = {}
        self._no_resend = False

    def furnish(self, stream: int, usual: Mapping[str, Value]) -> None:
        """Apply the written values, and the ``usual`` parameters, to a new stream, as far as it has them."""
        known = _properties(self._library, stream)
        resend = known.get("packet-resend")
        self._no_resend = resend is not None and self._get(stream, resend) == "never"
        for name, value in {**usual, **self._written}.items():
            if name in known:
                self._put(stream, known[name], value)

    def find(self, name: str) -> StreamNode | None:
        """Return the parameter of that name, of the device or of its stream; None if there is none."""
        found = self._of_device.get(name) or _properties(self._library, self._stream()).get(name)
        return StreamNode(self, found) if found else None

    def names(self) -> list[str]:
        """Return the names of all parameters, which takes a stream: one is made if there is none."""
        return [*self._of_device, *_properties(self._library, self._stream())]

    def categories(self) -> dict[str, list[str]]:
        """Return all parameters in one category."""
        return {"StreamControl": names} if (names := self.names()) else {}

    def read(self, wanted: _Property) -> Value:
        """Return the value from the object that has the property."""
        owner = self._device if wanted.name in self._of_device else self._stream()
        return self._get(owner, wanted)

    def write(self, wanted: _Property, value: Value) -> None:
        """Set the value, and keep it for the streams of later acquisitions."""
        if wanted.name in self._of_device:
            self._put(self._device, wanted, value)
            self._drop()  # its packets have been sized already
        else:
            self._put(self._stream(), wanted, value)
            self._written[wanted.name] = value

    def entries(self, wanted: _Property) -> list[str]:
        """Return the possible values; Aravis disables packet requests if the camera does not answer them."""
        self._stream()
        return ["never"] if wanted.name == "packet-resend" and self._no_resend else list(wanted.entries)

    def _get(self, owner: int, wanted: _Property) -> Value:
        place = _GValue()
        self._library.g_value_init(byref(place), wanted.value_type)
        self._library.g_object_get_property(owner, wanted.name.encode(), byref(place))
        number: int | float = getattr(place.data, wanted.field)
        if wanted.kind == "enumeration":
            return next(nick for nick, value in wanted.entries.items() if value == number)
        return bool(number) if wanted.kind == "boolean" else number

    def _put(self, owner: int, wanted: _Property, value: Value) -> None:
        place = _GValue()
        self._library.g_value_init(byref(place), wanted.value_type)
        setattr(place.data, wanted.field, wanted.entries[str(value)] if wanted.entries else value)
        self._library.g_object_set_property(owner, wanted.name.encode(), byref(place))


class StreamNode:
    """`acquire.camera.settings.Node` of a parameter."""

    def __init__(self, parameters: StreamParameters, of: _Property) -> None:
        self._parameters, self._property = parameters, of
        self.name, self.kind = of.name, of.kind

    readable = writable = True
    selected = False

    def read(self) -> Value:
        """Return the value of the parameter."""
        return self._parameters.read(self._property)

    def write(self, value: Value) -> None:
        """Set the value, for this stream and those that follow."""
        self._parameters.write(self._property, value)

    def limits(self) -> tuple[float, float, float]:
        """Return minimum, maximum and increment; Aravis states none for a float."""
        return *self._property.limits, 1 if self.kind == "integer" else 0

    def entries(self) -> list[str]:
        """Return the names of the values that are possible with this camera."""
        return self._parameters.entries(self._property)


def _properties(library: Any, owner: int) -> dict[str, _Property]:
    """Return the readable and writable properties of an object, without those of every stream or device."""
    count = c_uint()
    # A GObject begins with the pointer to its class.
    specs = library.g_object_class_list_properties(c_void_p.from_address(owner).value, byref(count))
    found: dict[str, _Property] = {}
    for k in range(count.value):
        spec = _ParamSpec.from_address(specs[k])
        kind = _KINDS.get(library.g_type_name(library.g_type_fundamental(spec.value_type)))
        usable = spec.flags & (_READ_WRITE | _CONSTRUCT_ONLY) == _READ_WRITE
        if kind and usable and library.g_type_name(spec.owner_type) not in _BASES:
            found[spec.name.decode()] = _describe(library, specs[k], spec, kind)
    library.g_free(specs)
    return found


def _describe(library: Any, at: int, spec: _ParamSpec, kind: Kind) -> _Property:
    # The fields behind the common part of a GParamSpec depend on its type.
    behind = at + ctypes.sizeof(_ParamSpec)
    entries: dict[str, int] = {}
    limits = (0.0, 0.0)
    # GObject keeps a boolean as an int, and an enumeration as a long: of that, the low half is read here.
    field = "v_int"
    if kind == "enumeration":
        known = _EnumClass.from_address(c_void_p.from_address(behind).value or 0)
        for k in range(known.count):
            if known.values[k].value not in entries.values():  # not another name for the same value
                entries[known.values[k].nick.decode()] = known.values[k].value
    elif kind != "boolean":
        field, number = _NUMBERS[library.g_type_name(spec.value_type)]
        low, high = (number * 2).from_address(behind)
        limits = (low, min(high, _largest_socket())) if spec.name == b"socket-buffer-size" else (low, high)
    return _Property(
        name=spec.name.decode(),
        kind=kind,
        value_type=spec.value_type,
        field=field,
        limits=limits,
        entries=entries,
    )


def _receive_bytes() -> int:
    return int(min(RECEIVE_BYTES, _largest_socket()))


def _largest_socket() -> float:
    """Return the largest socket buffer of the kernel, which silently reduces larger ones."""
    try:
        return float(_RMEM_MAX.read_text())
    except (OSError, ValueError):
        return math.inf


RECEIVE_BYTES = 32 * 2**20
"""Size of a socket's buffer: part of the packets of a tenth of a second at 10 Gbit/s."""
_RMEM_MAX = Path("/proc/sys/net/core/rmem_max")
_NUMBERS: dict[bytes, tuple[str, Any]] = {
    b"gint": ("v_int", c_int),
    b"guint": ("v_uint", c_uint),
    b"gdouble": ("v_double", c_double),
}


def enlarge_sockets() -> None:
    """Give this process's UDP sockets, which are Aravis', a large buffer at once.

    Aravis does so with the first packet. Until then a buffer holds a few frames, or 2 ms at 1 Gbit/s, and a
    busy host that gets round to the first packet later than that loses lines at the beginning of a run.
    """
    for descriptor in Path("/proc/self/fd").iterdir():
        if not descriptor.is_socket():
            continue
        # Another thread may have closed it by now. A copy, since the socket object closes its descriptor, and
        # Aravis' must stay open.
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(int(descriptor.name))) as opened:
            if opened.family == socket.AF_INET and opened.type == socket.SOCK_DGRAM:
                opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _receive_bytes())


def usual_parameters(frame_period_s: float) -> dict[str, Value]:
    """Return timeouts for the frame period, and a large socket buffer.

    At a slow line rate a frame takes longer than Aravis waits for its packets by default: it would be given
    up half-way, or requested before it is sent. Its socket buffer is by default as large as the kernel's
    usual one, or as a frame. Frames of few lines are small, and a busy host may leave several of them there.
    """
    period_us = round(frame_period_s * 1e6)
    return {
        "socket-buffer": "fixed",
        "socket-buffer-size": _receive_bytes(),
        "packet-timeout": min(max(_PACKET_TIMEOUT_US, period_us), _MOST_US),
        "frame-retention": min(max(_FRAME_RETENTION_US, 4 * period_us), _MOST_US),
    }


_PACKET_TIMEOUT_US, _FRAME_RETENTION_US = 20_000, 100_000
"""Aravis' defaults."""
_MOST_US = 2**32 - 1
"""Aravis holds both in 32 bits, without a sign."""
