"""Which lines a recording takes around an event, and how they are taken back from what the rings still hold.

::

            pre_lines           post_lines
       ├──────────────────┼────────────────────┤
       first line         at                   end            (``lines`` in all, post_lines, or endless)

While armed, the recorder lets lines go as soon as they have come; they stay in the ring until it comes round.
Everything else that a line's row needs (code, ticks, time) follows from its number and from what was fixed
when the run was armed, so that a line from before the event is recorded as any other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from acquire.stream.ring import Ring, RingBlock


@dataclass(frozen=True, slots=True)
class Window:
    """Lines around the line ``at``: an event's, or None for the newest line when the recorder is told.

    Attributes
    ----------
    pre_lines : to be recorded before that line
    post_lines : to be recorded from that line on; None: as many as the recording's budget says
    exact : refuse where not all of ``pre_lines`` can be had; otherwise take those that there are
    padded : begin there all the same; lines that the rings do not hold any more are missing
    kind, text : what happened at the line, for the recording's events; "" where nothing did
    """

    at: int | None = None
    pre_lines: int = 0
    post_lines: int | None = None
    exact: bool = True
    padded: bool = False
    kind: str = ""
    text: str = ""

    def __post_init__(self) -> None:
        if self.pre_lines < 0 or (self.post_lines is not None and self.post_lines < 1):
            raise UsageError(
                f"a recording cannot have {self.pre_lines} lines before an event and {self.post_lines} after",
                possible="0 or more before, 1 or more after",
            )

    @property
    def is_now(self) -> bool:
        """From the next line on, whichever that will be."""
        return self.at is None and not self.pre_lines and self.post_lines is None


NOW = Window()
"""From the next line on."""


@dataclass(frozen=True, slots=True)
class Held:
    """What the rings hold for a window at line ``at``: everything ``from_line`` on; blocks ``taken`` back."""

    at: int
    from_line: int
    taken: dict[str, list[range]]


@dataclass(frozen=True, slots=True)
class Span:
    """Lines ``first_line .. end_line - 1`` around ``at``; end None: until told."""

    first_line: int
    end_line: int | None
    at: int


def hold(window: Window, rings: Mapping[str, Ring]) -> Held:
    """Take back what the window asks for, as far as it is there, in another recording or in none.

    Nothing is taken where `span` will refuse, as far as that can be seen before.
    """
    at = min(ring.newest_line for ring in rings.values()) if window.at is None else window.at
    there = _whole_from(window, rings, {name: ring.oldest_block for name, ring in rings.items()})
    if window.exact and at - window.pre_lines < there:
        return Held(at, there, {})
    wanted = max(at - window.pre_lines, 0)
    taken = {name: ring.lease(wanted) for name, ring in rings.items()}
    whole_from = _whole_from(window, rings, {name: ring.acquire() for name, ring in rings.items()})
    return Held(at, whole_from, taken)


def span(window: Window, lines: int | None, held: Held, line_rate_hz: float) -> Span:
    """The lines to record, ``lines`` in all where that is given.

    UsageError, with what there is, for an exact window that reaches further back than what is held.
    """
    wanted = held.at - window.pre_lines
    if wanted < held.from_line and window.exact:
        has = max(0, held.at - held.from_line)
        raise UsageError(
            f"start: the rings do not hold {window.pre_lines} lines from before "
            f"({window.pre_lines / line_rate_hz:.3g} s)",
            possible=f"up to {has} lines ({has / line_rate_hz:.3g} s), which both rings hold now",
            hint="wait until the ring is full, or configure a longer one (stream.ring_seconds)",
        )
    first = wanted if window.padded else max(wanted, held.from_line)
    ends = [first + lines] if lines is not None else []
    ends += [held.at + window.post_lines] if window.post_lines is not None else []
    return Span(first, max(min(ends), first + 1) if ends else None, held.at)


def _whole_from(window: Window, rings: Mapping[str, Ring], first: Mapping[str, RingBlock | None]) -> int:
    """The line from which on everything is in the rings, or known to be lost, if these blocks come first."""
    lines = [0]
    for name, ring in rings.items():
        block = first[name]
        lost = 0 if block is None else sum(loss.count for loss in block.losses)
        lines.append(ring.newest_line if block is None else block.first_line - lost)
        if not window.padded:  # else what found its ring full is missing, as what the ring holds no more
            lines.append(ring.dropped_end)
    return max(lines)
