"""Features of a camera's own description, through Aravis."""

from __future__ import annotations

import ctypes
import sys
from ctypes import byref, c_double, c_int64, c_uint, c_void_p
from typing import TYPE_CHECKING, Any

from acquire.camera.aravis.bindings import errors
from acquire.camera.settings import await_done
from acquire.errors import CameraError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.camera.settings import Kind, Value

_KINDS: tuple[tuple[bytes, Kind], ...] = (
    (b"ArvGcCommand", "command"),
    (b"ArvGcBoolean", "boolean"),
    (b"ArvGcEnumeration", "enumeration"),
    (b"ArvGcString", "text"),
    (b"ArvGcFloat", "float"),
    (b"ArvGcInteger", "integer"),
)
"""GObject types and interfaces, of which the first that matches counts: there are more classes of nodes than
ways to read one, and some match several (an enumeration is also an integer)."""

_MOST = sys.float_info.max
FEATURE = (
    "acquire camera features SERIAL lists what the camera accepts now, which other features may decide "
    "(a mode, a selector, whether lines are running); if none can be read, check its cable and power"
)
"""Advice where one feature fails: only the camera's manual says why."""


class AravisFeatures:
    """`acquire.camera.settings.Features` of a device."""

    def __init__(self, library: Any, device: int) -> None:
        self._library, self._device = library, device

    def find(self, name: str) -> AravisNode | None:
        """Return the feature; None for a category, or if there is none of that name."""
        library = self._library
        node = library.arv_device_get_feature(self._device, name.encode())
        if not node or self._is_category(node):
            return None
        # The kind determines how the node is read and written.
        # GObject knows a type by its name only once there was an object of it, of this camera or another.
        kinds: Iterator[Kind] = (
            kind
            for name, kind in _KINDS
            if (known := library.g_type_from_name(name)) and library.g_type_check_instance_is_a(node, known)
        )
        return AravisNode(library, self._device, node, name, next(kinds, "other"))

    def _is_category(self, node: int) -> bool:
        return bool(self._library.g_type_name_from_instance(node) == b"ArvGcCategory")

    def names(self) -> list[str]:
        """Return the features of all categories."""
        return [name for names in self.categories().values() for name in names]

    def categories(self) -> dict[str, list[str]]:
        """Return category → its features, in the order of the description; empty ones are left out."""
        found: dict[str, list[str]] = {}
        self._collect("Root", found)
        return {name: names for name, names in found.items() if names}

    def _collect(self, category: str, found: dict[str, list[str]]) -> None:
        node = self._library.arv_device_get_feature(self._device, category.encode())
        names = found.setdefault(category, [])
        for name in _strings(self._library.arv_gc_category_get_features(node)) if node else ():
            below = self._library.arv_device_get_feature(self._device, name.encode())
            if below and self._is_category(below):
                if name not in found:  # it may be listed in several, and even within itself
                    self._collect(name, found)
            elif below:
                names.append(name)


def _strings(node: int | None) -> Iterator[str]:
    """Yield the texts of a GSList."""
    while node:
        # An element of it is two pointers: to its data, and to the next element.
        data, node = (c_void_p * 2).from_address(node)
        if data:
            yield ctypes.string_at(data).decode()


class AravisNode:
    """`acquire.camera.settings.Node` of an Aravis feature."""

    def __init__(self, library: Any, device: int, node: int, name: str, kind: Kind) -> None:
        self._library, self._device, self._node = library, device, node
        self.name, self.kind = name, kind
        self._key = name.encode()
        self._word = {"enumeration": "string", "text": "string"}.get(kind, kind)

    # ArvGcAccessMode: 0 can only be read, 1 only be written, 2 both; what is left cannot be accessed now.

    @property
    def readable(self) -> bool:
        """Whether it is available now, and its access mode allows reading."""
        return self.kind not in ("command", "other") and self._available and self._access in (0, 2)

    @property
    def writable(self) -> bool:
        """Whether it is available now, and its access mode allows writing."""
        return self.kind != "other" and self._available and self._access in (1, 2)

    @property
    def _available(self) -> bool:
        with errors(self.name, FEATURE) as error:
            return bool(self._library.arv_device_is_feature_available(self._device, self._key, error))

    @property
    def _access(self) -> int:
        mode: int = self._library.arv_gc_feature_node_get_actual_access_mode(self._node)
        return mode

    @property
    def selected(self) -> bool:
        """True for all features: whether a selector changes its value is unknown."""
        # Aravis does not report it. True means that the value is read back only when it is written.
        return True

    def read(self) -> Value:
        """Return the value; a text that is missing is an empty one."""
        with errors(f"read {self.name}", FEATURE) as error:
            get = getattr(self._library, f"arv_device_get_{self._word}_feature_value")
            value = get(self._device, self._key, error)
        # ctypes returns None for a text that is empty or missing.
        return value.decode() if isinstance(value, bytes) else value or (0 if value is not None else "")

    def write(self, value: Value) -> None:
        with errors(f"set {self.name} to {value!r}", FEATURE) as error:
            if self.kind != "command":
                given = value.encode() if isinstance(value, str) else value
                put = getattr(self._library, f"arv_device_set_{self._word}_feature_value")
                put(self._device, self._key, given, error)
            elif value:
                self._library.arv_device_execute_command(self._device, self._key, error)
        if self.kind == "command" and value:
            await_done(self.name, self._is_done)

    def _is_done(self) -> bool:
        """Return whether the command's register holds another value again; Aravis does not say it itself.

        A register that cannot be read says nothing, and the command counts as done (GenApi).
        """
        library = self._library
        register = wanted = None
        child = library.arv_dom_node_get_first_child(self._node)
        while child:
            kind = library.arv_dom_node_get_node_name(child)
            if kind == b"pValue":
                register = library.arv_gc_property_node_get_linked_node(child)
            elif kind in (b"CommandValue", b"pCommandValue"):
                with errors(self.name, FEATURE) as error:
                    wanted = library.arv_gc_property_node_get_int64(child, error)
            child = library.arv_dom_node_get_next_sibling(child)
        if not register or wanted is None:
            return True
        if library.arv_gc_feature_node_get_actual_access_mode(register) not in (0, 2):
            return True
        with errors(self.name, FEATURE) as error:
            name = library.arv_gc_feature_node_get_name(register)
            return bool(library.arv_device_get_integer_feature_value(self._device, name, error) != wanted)

    def limits(self) -> tuple[float, float, float]:
        """Return minimum, maximum, increment; computed nodes may have none: then those of the type."""
        whole = self.kind == "integer"
        number = c_int64 if whole else c_double
        low, high = number(), number()
        try:
            with errors(self.name, FEATURE) as error:
                bounds = getattr(self._library, f"arv_device_get_{self.kind}_feature_bounds")
                bounds(self._device, self._key, byref(low), byref(high), error)
        except CameraError:
            low, high = (
                (c_int64(-(2**63)), c_int64(2**63 - 1)) if whole else (c_double(-_MOST), c_double(_MOST))
            )
        step = 0
        if whole:
            try:
                with errors(self.name, FEATURE) as error:
                    increment = self._library.arv_device_get_integer_feature_increment
                    step = int(increment(self._device, self._key, error))
            except CameraError:
                step = 1  # a masked register has no increment, and can be written nevertheless
        return low.value, high.value, step

    def entries(self) -> list[str]:
        count = c_uint()
        with errors(self.name, FEATURE) as error:
            found = self._library.arv_device_dup_available_enumeration_feature_values_as_strings(
                self._device, self._key, byref(count), error
            )
        names = [found[k].decode() for k in range(count.value)]
        self._library.g_free(found)  # the list only: its texts belong to the node
        return names
