"""Bindings of Aravis' shared library: the functions used here, and its errors."""

from __future__ import annotations

import ctypes
import functools
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
from typing import TYPE_CHECKING, Any

from acquire.errors import CameraError

if TYPE_CHECKING:
    from collections.abc import Iterator

LIBRARIES = ("libaravis-0.8.so.0", "libaravis-0.10.so.0")
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
    "arv_gc_feature_node_get_name": (c_char_p, (c_void_p,)),
    "arv_gc_property_node_get_linked_node": (c_void_p, (c_void_p,)),
    "arv_gc_property_node_get_int64": (c_int64, (c_void_p, c_void_p)),
    "arv_dom_node_get_first_child": (c_void_p, (c_void_p,)),
    "arv_dom_node_get_next_sibling": (c_void_p, (c_void_p,)),
    "arv_dom_node_get_node_name": (c_char_p, (c_void_p,)),
    "arv_gc_category_get_features": (c_void_p, (c_void_p,)),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
    "arv_stream_try_pop_buffer": (c_void_p, (c_void_p,)),
    "arv_stream_get_statistics": (
        None,
        (c_void_p, POINTER(c_uint64), POINTER(c_uint64), POINTER(c_uint64)),
    ),
    "arv_buffer_new_allocate": (c_void_p, (c_size_t,)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_buffer_get_frame_id": (c_uint64, (c_void_p,)),
    "arv_buffer_get_timestamp": (c_uint64, (c_void_p,)),
    "arv_buffer_set_frame_id": (None, (c_void_p, c_uint64)),
    "arv_buffer_set_timestamp": (None, (c_void_p, c_uint64)),
    "arv_camera_is_gv_device": (c_bool, (c_void_p,)),
    "arv_camera_is_uv_device": (c_bool, (c_void_p,)),
    "arv_camera_gv_set_stream_options": (None, (c_void_p, c_int)),
    "arv_gv_device_is_controller": (c_bool, (c_void_p,)),
    "arv_camera_gv_get_packet_size": (c_uint, (c_void_p, c_void_p)),
    "g_type_name_from_instance": (c_char_p, (c_void_p,)),
    "g_type_name": (c_char_p, (c_size_t,)),
    "g_type_from_name": (c_size_t, (c_char_p,)),
    "g_type_fundamental": (c_size_t, (c_size_t,)),
    "g_type_check_instance_is_a": (c_bool, (c_void_p, c_size_t)),
    "g_object_class_list_properties": (POINTER(c_void_p), (c_void_p, POINTER(c_uint))),
    "g_object_get_property": (None, (c_void_p, c_char_p, c_void_p)),
    "g_object_set_property": (None, (c_void_p, c_char_p, c_void_p)),
    "g_value_init": (c_void_p, (c_void_p, c_size_t)),
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


@functools.cache
def load() -> Any:
    """Load Aravis' shared library. Raises CameraError if there is none."""
    for name in LIBRARIES:
        try:
            library = ctypes.CDLL(name)
        except OSError:
            continue
        for function, (result, arguments) in _SIGNATURES.items():
            entry = getattr(library, function, None)
            if entry is None:
                raise CameraError(
                    f"{name} is too old: it has no {function}", possible="Aravis 0.8.3 or later"
                )
            # Without them ctypes would take every pointer for an int of 32 bits.
            entry.restype, entry.argtypes = result, arguments
        return library
    raise CameraError(
        "Aravis is not installed", possible=", ".join(LIBRARIES), hint="apt install libaravis-0.8-0"
    )


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", c_int), ("message", c_char_p))


@contextmanager
def errors(what: str, hint: str) -> Iterator[Any]:
    """Yield a place for a GError; raise CameraError, with the hint, if one was stored there."""
    place = POINTER(_GError)()  # NULL: GLib reports no error into a place that seems to have one
    yield byref(place)
    if ctypes.cast(place, c_void_p).value:
        message = (place.contents.message or b"").decode(errors="replace")
        load().g_error_free(place)
        raise CameraError(f"{what}: {message}", hint=hint)
