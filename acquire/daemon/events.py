"""Recordings that start automatically: the rig's ``[events]``, in lines."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from acquire.stream import Window

if TYPE_CHECKING:
    from acquire.config import RigConfig
    from acquire.daemon.messages import StartRequest
    from acquire.stream.messages import Note


def budget_lines(request: StartRequest, line_rate_hz: float) -> int | None:
    """Return the total lines of the recording; None: until stopped, or according to its window."""
    if request.duration_s is None:
        return request.lines
    return math.ceil(request.duration_s * line_rate_hz)


def window_of(request: StartRequest, line_rate_hz: float) -> Window:
    """Return the lines around the moment of the request; an exact window, refused if the ring lacks lines."""
    post_lines = None if request.post_s is None else max(1, math.ceil(request.post_s * line_rate_hz))
    window = Window(None, math.ceil(request.pre_s * line_rate_hz), post_lines)
    return window if window.is_now else replace(window, kind="mark", text="acquire start")


class StandingOrder:
    """The action at an event, from one arming to the next.

    Attributes
    ----------
    rearm : every event starts a recording, not only the first
    used : an event has started a recording
    """

    def __init__(self, config: RigConfig) -> None:
        self._events = config.events
        self._rate_hz = config.line_rate_hz
        self.rearm = config.events.rearm
        self.used = False

    @property
    def waits(self) -> bool:
        """Whether the next event starts a recording."""
        return self.rearm or not self.used

    def covers(self, note: Note) -> bool:
        """Return whether the event starts a recording, or prolongs one that an event started."""
        return note.kind in self._events.sources

    def window(self, note: Note) -> Window:
        """Return the lines around the event; not exact, since an event cannot be repeated."""
        pre_lines = math.ceil(self._events.pre_s * self._rate_hz)
        return Window(note.line, pre_lines, self._post_lines, exact=False)

    def end_line(self, note: Note) -> int:
        """Return the line before which the recording must not end."""
        return note.line + self._post_lines

    @property
    def _post_lines(self) -> int:
        return max(1, math.ceil(self._events.post_s * self._rate_hz))
