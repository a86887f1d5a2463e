"""Expected pins of a run, derived from the registers' documentation with numpy alone."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from acquire.trigger import registers as r
from firmware.cxxrtl import Pin

PATTERN = (1, 3, 2, 6, 4, 5)


def pins(
    config: Mapping[r.Register, int], code: NDArray[np.uint8], lines: int, before: int, after: int
) -> NDArray[np.uint16]:
    """Pins from ``before`` clocks ahead of line 0 to ``after`` clocks behind the last line's end."""
    line, clocks = r.LINE.unpack(config[r.LINE]), config[r.SUBSTEP_CLOCKS]
    steps = lines * line["substeps"]
    out = np.zeros(before + steps * clocks + after, np.uint16)
    every = 1 if line["mode"] == r.LineMode.PER_SUBSTEP else line["substeps"]
    starts = before + clocks * np.arange(0, steps, every)
    for arm, pin, direction in (("A", Pin.TRIGGER_A, Pin.DIRECTION_A), ("B", Pin.TRIGGER_B, Pin.DIRECTION_B)):
        output = r.TRIGGER_A.unpack(config[getattr(r, f"TRIGGER_{arm}")])
        delay, width = (config[getattr(r, f"TRIGGER_{arm}_{what}")] for what in ("DELAY", "WIDTH"))
        if output["enable"]:
            _raise(out, pin, starts + delay, width)
        out ^= np.uint16(pin * output["invert"] | direction * output["direction"])
    _raise(out, Pin.LINE, before + clocks * np.arange(0, steps, line["substeps"]), 1)
    _raise(out, Pin.SUBSTEP, before + clocks * np.arange(steps), 1)
    led = r.LED.unpack(config[r.LED])
    lit = before - led["lead"] + clocks * np.flatnonzero(code[:steps])
    if led["enable"]:
        _raise(out, Pin.LED, lit + config[r.WINDOW_OPEN], config[r.WINDOW_CLOSE] - config[r.WINDOW_OPEN])
    out ^= np.uint16(Pin.LED * led["invert"])
    out[before : before + steps * clocks] |= _phases(config, steps)
    return out


def _raise(out: NDArray[np.uint16], pin: Pin, starts: NDArray[np.int64], width: int) -> None:
    at = starts[:, None] + np.arange(width)
    out[at[at < len(out)]] |= np.uint16(pin)


def _phases(config: Mapping[r.Register, int], steps: int) -> NDArray[np.uint16]:
    line, clocks, each = r.LINE.unpack(config[r.LINE]), config[r.SUBSTEP_CLOCKS], config[r.PHASE_CLOCKS]
    if each == 0:
        return np.zeros(steps * clocks, np.uint16)
    per_step = 6 // line["substeps"]
    within = np.minimum(np.arange(clocks) // each, per_step - 1)
    phase = (np.arange(steps)[:, None] % line["substeps"]) * per_step + within
    pattern = np.array(PATTERN[::-1] if line["direction"] else PATTERN, np.uint16)
    return (pattern[phase.ravel()] * np.uint16(Pin.PHASE_1)).astype(np.uint16)
