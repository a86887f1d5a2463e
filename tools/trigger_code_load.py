"""Time to load 64 kbit of code into the trigger's code memory at 3 Mbaud, with the device's check.

``python tools/trigger_code_load.py [LATENCY_MS]``: bytes are paced as on the line in both directions, and
answers come LATENCY_MS late, as from a USB adapter. The gateware, if it can be compiled, counts its own
clocks.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "trigger"))

from trigger_twins import CLOCK_HZ, wired_model

from acquire.codes import prbs
from acquire.sim.twin_links import Twin, TwinTransport
from acquire.trigger import registers as r
from acquire.trigger.device import Device
from acquire.trigger.link import Link
from firmware.cxxrtl import missing

BAUD = 3_000_000
BYTE_S = 10 / BAUD
BITS = 1 << 16
LIMIT_S = 0.060
_PIECE = 64


class PacedTransport(TwinTransport):
    """A stream in which no byte arrives sooner than the line can carry it."""

    def __init__(self, twin: Twin, latency_s: float) -> None:
        super().__init__(twin, f"{BAUD} baud")
        self.bytes_per_s = 1 / BYTE_S
        self.latency_s = latency_s
        self.way_free_s = {"out": 0.0, "back": 0.0}

    def write(self, data: bytes) -> None:
        for at in range(0, len(data), _PIECE):
            piece = data[at : at + _PIECE]
            self._carry("out", len(piece))
            super().write(piece)

    def read(self) -> bytes:
        data = super().read()
        if data:
            self._carry("back", len(data))
            time.sleep(self.latency_s)
        return data

    def _carry(self, way: str, count: int) -> None:
        self.way_free_s[way] = max(self.way_free_s[way], time.monotonic()) + count * BYTE_S
        while time.monotonic() < self.way_free_s[way]:
            time.sleep(0)


def load(device: Device) -> float:
    """Time in seconds on the host."""
    bits = prbs(23, 5, 0, BITS)
    begun_s = time.monotonic()
    device.load_code(bits)
    taken_s = time.monotonic() - begun_s
    assert np.array_equal(device.read_code(BITS), bits)
    return taken_s


def on_the_model(latency_s: float) -> float:
    """The best of five, because of other load on the machine."""
    with wired_model() as model:
        transport = PacedTransport(model, latency_s)
        link = Link(transport)
        device = Device(link)
        taken_s = min(load(device) for _ in range(5))
        link.close()
    return taken_s


def on_the_gateware() -> float:
    """Time by the gateware's own clock, independent of the speed of the simulation."""
    from firmware.device import RtlDevice
    from firmware.top import Build

    twin = RtlDevice(Build(clock_hz=CLOCK_HZ, baud=BAUD))
    link = Link(TwinTransport(twin), reply_s=5.0)
    device = Device(link)
    begun = device.read(r.TIME)
    device.load_code(prbs(23, 5, 0, BITS))
    ticks = device.read(r.TIME) - begun
    link.close()
    twin.close()
    return ticks / CLOCK_HZ


latency_ms = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
times_s = {f"host's clock, answers {latency_ms:g} ms late": on_the_model(latency_ms / 1000)}
if missing() is None:
    times_s["gateware's clock"] = on_the_gateware()
for name, taken_s in times_s.items():
    print(f"{BITS} bits at {BAUD} baud, {name}: {taken_s * 1000:.1f} ms (limit {LIMIT_S * 1000:g} ms)")
raise SystemExit(max(times_s.values()) > LIMIT_S)
