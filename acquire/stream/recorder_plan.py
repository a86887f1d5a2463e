"""What the recorder is told when it is started, and what it publishes in shared memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.store.files import DISK

if TYPE_CHECKING:
    from acquire.store.files import Disk
    from acquire.trigger.base import TriggerRun

COUNTERS = (
    *("recorded", "committed", "draining", "rows_a", "rows_b", "missing_a", "missing_b"),
    *("discarded_a", "discarded_b", "stored_a", "stored_b", "turns", "awaited_a", "awaited_b"),
    *("unsaved_a", "unsaved_b", "overrun_a", "overrun_b", "overrun_to_a", "overrun_to_b"),
    *("disk_since_ns", "store_since_ns", "state"),
)
"""Of the latest recording: rows in both arms, rows that a reader finds, whether its last line is known; per
arm the rows written and those of them that are missing. Since armed: per arm the lines taken from its ring
that no recording holds, those that one does, and those that a disk which failed did not keep; those that
found their ring full and are a gap in a recording, and the line after the last of these; turns of the loop,
which stand still when it hangs or waits for the disk. Since when, by the monotonic clock, the loop waits for
the disk, and the thread that creates and seals recordings is at work; 0 while they do not. What the recorder
does: its place in `recorder_states.STATES`. The owner alone counts how often it has seen that an arm's next
grabber is only starting: its silence means nothing then."""


@dataclass(frozen=True, slots=True)
class RecorderPlan:
    """What the recorder needs to know. Picklable."""

    run: TriggerRun
    stages: int
    stall_timeout_s: float
    tag_wait_s: float
    max_skew_lines: int
    realtime: bool = False
    disk: Disk = DISK
    goes_on: bool = False
