"""The display of ``acquire camera live``: bars for the light, a sparkline for the focus, and advice."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from rich.console import Group
from rich.table import Table
from rich.text import Text

from acquire.cli.output import quantity
from acquire.text import counted, visible

if TYPE_CHECKING:
    from rich.console import RenderableType

    from acquire.camera.gauge import Reading

BAR, LABEL = 32, 9
TURNS = 32
"""Number of focus values in the sparkline."""
_BLOCKS = "▁▂▃▄▅▆▇█"
_EIGHTHS = " ▏▎▍▌▋▊▉█"
STEADY = 0.02
"""Relative spread of the focus number below which the sparkline stays flat, because it would show noise."""
SATURATED, DIM, BRIGHT = 1e-4, 0.05, 0.85
"""Share of saturated pixels, and levels, at which advice is given."""
DARK = 0.01


class Screen:
    """A rich renderable of the latest readings, which `show` sets."""

    def __init__(self, names: dict[str, str], where: str, turn_s: float) -> None:
        self._names, self._where, self._turn_s = names, where, turn_s
        self._readings: dict[str, Reading] = {}
        self._focus: dict[str, deque[float]] = {name: deque(maxlen=TURNS) for name in names}
        self._best = dict.fromkeys(names, 0.0)

    def show(self, readings: dict[str, Reading]) -> None:
        self._readings = readings
        for name, reading in readings.items():
            if reading.focus is not None:
                self._focus[name].append(reading.focus)
                self._best[name] = max(self._best[name], reading.focus)

    def __rich__(self) -> RenderableType:
        parts: list[RenderableType] = []
        for name, serial in self._names.items():
            parts.append(self._rows(name, serial))
            if hint := advice(self._readings.get(name)):
                parts.append(Text(" " * (LABEL + 2) + hint, style="yellow"))
            parts.append(Text(""))
        return Group(*parts, Text(f"source: {visible(self._where)}; press Ctrl-C to end", style="dim"))

    def _rows(self, name: str, serial: str) -> Table:
        grid = Table.grid(padding=(0, 2))
        grid.add_column(width=LABEL)
        grid.add_column(width=BAR, no_wrap=True)
        grid.add_column(justify="right", no_wrap=True, width=9)
        grid.add_column(no_wrap=True)
        reading = self._readings.get(name)
        lines_hz = reading.lines / self._turn_s if reading else 0.0
        title = Text(name if name == "camera" else f"camera {name}", style="bold")
        # A rig file, perhaps somebody else's, may have anything in this place.
        grid.add_row(title, Text(visible(serial)), quantity(lines_hz, "Hz"), "lines")
        if reading is None or reading.level is None or reading.brightest is None:
            return grid
        style = "red" if (reading.saturated or 0.0) > SATURATED else "green"
        grid.add_row("level", Text(bar(reading.level), style), f"{reading.level:.1%}", "of white, mean")
        grid.add_row("brightest", Text(bar(reading.brightest), style), f"{reading.brightest:.1%}")
        grid.add_row("saturated", "", f"{reading.saturated or 0.0:.2%}", "of the pixels")
        now, best = reading.focus, self._best[name]
        line = Text(sparkline(list(self._focus[name])), "cyan")
        grid.add_row("focus", line, "–" if now is None else f"{now:.2%}", f"best {best:.2%}" if best else "")
        return grid


def bar(part: float) -> str:
    """Draw a bar that is filled to ``part`` (0 to 1)."""
    eighths = round(min(max(part, 0.0), 1.0) * BAR * 8)
    full, rest = divmod(eighths, 8)
    return ("█" * full + (_EIGHTHS[rest] if rest else "")).ljust(BAR, "·")


def sparkline(values: list[float]) -> str:
    """Draw values as heights between their minimum and maximum, with the newest last."""
    if not values:
        return ""
    low, high = min(values), max(values)
    middle = (low + high) / 2
    span = max(high - low, STEADY * middle)
    low = middle - span / 2
    steps = len(_BLOCKS) - 1
    # The span is 0 only if all values are, as of a camera in the dark.
    return "".join(_BLOCKS[round((value - low) / span * steps) if span else 0] for value in values)


def advice(reading: Reading | None) -> str:
    """Return the problem with a reading and what to do about it; empty if there is none."""
    if reading is None:
        return "no reading yet: the camera is starting, or does not respond"
    if reading.level is None:
        return "no lines are arriving: is the trigger running, and its cable connected to the camera's input?"
    # In the order of urgency: the first that applies is shown.
    for wrong, text in (
        (
            reading.lost > 0,
            f"{counted(reading.lost, 'line', 'was')} lost: check acquire status and the camera's settings",
        ),
        ((reading.saturated or 0.0) > SATURATED, "saturated: use less light or a smaller aperture"),
        (reading.level < DARK, "dark: is the light on and the lens open?"),
        (reading.level < DIM, "dim: use more light or a larger aperture"),
        (reading.level > BRIGHT, "very bright: use less light or a smaller aperture"),
    ):
        if wrong:
            return text
    return ""


def reading_text(reading: Reading | None) -> str:
    """Format a reading on one line."""
    if reading is None or reading.level is None:
        return advice(reading)
    focus = "–" if reading.focus is None else f"{reading.focus:.2%}"
    hint = advice(reading)
    return f"level {reading.level:.1%}, saturated {reading.saturated:.2%}, focus {focus}" + (
        f" ({hint})" if hint else ""
    )
