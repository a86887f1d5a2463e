"""Every pulse of the trigger has a place: what became of the lines of one arm since it was armed.

::

    issued = preroll + stored + discarded + Σ lost + waiting + pending

``issued``, ``lost`` and ``waiting`` are counted by different parties (trigger, camera and grabber, ring and
recorder), so that a line which none of them knows of shows.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

UNDELIVERED = "undelivered"
"""Loss at the end of a run: pulses whose lines a recording wanted, and the camera never gave."""


@dataclass(frozen=True, slots=True)
class Counted:
    """What was counted of one arm, in lines.

    Attributes
    ----------
    pulses : that the trigger is known to have issued
    next_line : after the last line that came out of the camera, or was lost before it
    depth : lines that come before the trigger's line 0
    stored, discarded : what the recorder took from the ring: in recordings, in none
    lost : cause → lines
    recorded_to : line after the last row of the latest recording, there or missing
    room, block : lines that the ring and one of its slots hold at most
    """

    pulses: int
    next_line: int
    depth: int
    stored: int
    discarded: int
    lost: Mapping[str, int]
    room: int
    block: int
    recorded_to: int = 0


@dataclass(frozen=True, slots=True)
class ArmLedger:
    """The account; see the module. ``balanced``: no place holds less than nothing, or more than it can."""

    issued: int
    preroll: int
    stored: int
    discarded: int
    lost: dict[str, int]
    waiting: int
    pending: int
    balanced: bool

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def account(counted: Counted, *, closed: bool) -> ArmLedger:
    """The account of a running arm, whose counts are up to a block apart, or of a ``closed`` one: exact.

    A line that came proves its pulse, whatever tags have told so far. Once closed, nothing waits, and what
    is pending will not come: it is lost as far as a recording has rows for it. The rest was under way when
    the trigger stopped, as a block that did not fill, and belongs to no recording.
    """
    read = max(0, counted.next_line + counted.depth)
    issued = counted.pulses if closed else max(counted.pulses, read)
    preroll = min(read, counted.depth)
    lost = {cause: lines for cause, lines in counted.lost.items() if lines}
    waiting = read - preroll - counted.stored - counted.discarded - sum(lost.values())
    pending = issued - read
    if closed:
        balanced = waiting == 0 and pending >= 0
        owed = max(0, min(pending, counted.recorded_to - max(counted.next_line, 0)))
        lost |= {UNDELIVERED: owed} if owed else {}
        pending -= owed
        return ArmLedger(
            issued=issued,
            preroll=preroll,
            stored=counted.stored,
            discarded=counted.discarded,
            lost=lost,
            waiting=waiting,
            pending=pending,
            balanced=balanced,
        )
    balanced = -counted.block <= waiting <= counted.room + counted.block
    return ArmLedger(
        issued=issued,
        preroll=preroll,
        stored=counted.stored,
        discarded=counted.discarded,
        lost=lost,
        waiting=max(0, waiting),
        pending=pending,
        balanced=balanced,
    )
