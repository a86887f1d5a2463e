"""Which lines a recording takes around an event, and how they are taken back from the rings' history.

::

            pre_lines           post_lines
       ├──────────────────┼────────────────────┤
       first line         at                   end            (``lines`` in all, post_lines, or endless)

While armed, the recorder releases lines as soon as they come; they stay in the ring until it comes round.
Everything else that a line's row needs (code, ticks, time) follows from its number and from the settings of
the armed run, so that a line from before the event is recorded like any other.
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
    """Lines around the line ``at``: an event's, or None for the newest when the recorder gets the request.

    Attributes
    ----------
    pre_lines : lines to be recorded before ``at``
    post_lines : lines to be recorded from ``at`` on; None: according to the recording's budget
    exact : refuse if not all ``pre_lines`` are available; otherwise take those that are
    padded : begin at the wanted line in any case; lines that the rings no longer hold are missing
    kind, text : the event at the line, for the recording's list of events; "" for none
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
        """Whether the recording is to begin with the next line, whichever that will be."""
        return self.at is None and not self.pre_lines and self.post_lines is None


NOW = Window()
"""From the next line on."""


@dataclass(frozen=True, slots=True)
class Held:
    """The rings' lines for a window at ``at``: all from ``from_line`` on; arm → blocks ``taken`` back."""

    at: int
    from_line: int
    taken: dict[str, list[range]]


@dataclass(frozen=True, slots=True)
class Span:
    """Lines ``first_line .. end_line - 1`` around ``at``; ``end_line`` None: until `End`."""

    first_line: int
    end_line: int | None
    at: int


def hold(window: Window, rings: Mapping[str, Ring]) -> Held:
    """Take back the window's lines as far as the rings hold them, also those that a recording has already.

    Nothing is taken if it can be foreseen that `span` will refuse.
    """
    at = min(ring.newest_line for ring in rings.values()) if window.at is None else window.at
    there = _whole_from(window, rings, {name: ring.oldest_block for name, ring in rings.items()})
    if window.exact and at - window.pre_lines < there:
        return Held(at, there, {})
    wanted = max(at - window.pre_lines, 0)
    taken = {name: ring.lease(wanted) for name, ring in rings.items()}
    # Once more: until they were taken back, the cameras could overwrite the oldest blocks.
    whole_from = _whole_from(window, rings, {name: ring.acquire() for name, ring in rings.items()})
    return Held(at, whole_from, taken)


def span(window: Window, lines: int | None, held: Held, line_rate_hz: float) -> Span:
    """Return the lines to record, ``lines`` in all if given.

    Raises UsageError, stating what is available, if an exact window reaches further back than the rings do.
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
    # At least one line, even if the whole window has passed out of the rings.
    return Span(first, max(min(ends), first + 1) if ends else None, held.at)


def _whole_from(window: Window, rings: Mapping[str, Ring], first: Mapping[str, RingBlock | None]) -> int:
    """Return the line from which on every line is in the rings, or known as lost.

    ``first``: arm → oldest block.
    """
    lines = [0]
    for name, ring in rings.items():
        block = first[name]
        lost = 0 if block is None else sum(loss.count for loss in block.losses)
        # Lines that the oldest block reports as lost need not be in the ring: they are known to be missing.
        lines.append(ring.newest_line if block is None else block.first_line - lost)
        if not window.padded:  # a padded window records lines that found their ring full as missing
            lines.append(ring.dropped_end)
    return max(lines)
