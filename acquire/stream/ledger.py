"""The account of every trigger pulse: what became of the lines of one arm since it was armed.

::

    issued = preroll + stored + discarded + Σ lost + waiting + pending

``issued``, ``lost`` and ``waiting`` are counted by different parties (trigger, camera and grabber, ring and
recorder), so that a line unaccounted for by all of them shows up as an imbalance.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

UNDELIVERED = "undelivered"
"""Loss at the end of a run: pulses whose lines belonged to a recording and were never delivered."""


@dataclass(frozen=True, slots=True)
class Counted:
    """Counts of one arm, in lines.

    Attributes
    ----------
    pulses : pulses that the trigger is known to have issued
    next_line : line after the last one that the camera delivered or lost
    depth : lines before the trigger's line 0
    stored, discarded : lines that the recorder took from the ring: into recordings, into none
    lost : cause → lines
    recorded_to : line after the last row of the latest recording, stored or missing
    room, block : capacity of the ring, and of one of its slots
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
    """The account; see the module. ``balanced``: no term is negative, or more than its place can hold."""

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
    """Return the account of an arm: exact once ``closed``; while running, counts are up to a block apart.

    A line that came proves its pulse, even before a tag reports it. Once closed, nothing waits, and pending
    lines will not come: they are lost if a recording has rows for them. The others were in a block that had
    not filled when the trigger stopped, and belong to no recording.
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
    # The counters are read one after the other, and a block may pass from one to the next meanwhile.
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
