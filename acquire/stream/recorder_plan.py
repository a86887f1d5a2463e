"""The recorder's settings, and the counters that it publishes in shared memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.store.files import DISK

if TYPE_CHECKING:
    from acquire.store.files import Disk
    from acquire.trigger.base import TriggerRun

COUNTERS = (
    *("recorded", "committed", "draining", "rows_a", "rows_b", "missing_a", "missing_b", "beyond_bytes"),
    *("discarded_a", "discarded_b", "stored_a", "stored_b", "turns", "awaited_a", "awaited_b"),
    *("unsaved_a", "unsaved_b", "overrun_a", "overrun_b", "overrun_to_a", "overrun_to_b"),
    *("disk_since_ns", "store_since_ns", "state"),
)
"""Of the latest recording: rows in both arms (``recorded``), rows that a reader finds (``committed``),
whether its last line is known (``draining``), and per arm the rows written and how many of them are missing;
and by how much held lines exceed the limit of retention (``beyond_bytes``).

Since arm, per arm: the lines taken from its ring into no recording (``discarded``), into one (``stored``),
and those that a failed disk did not keep (``unsaved``); lines that found their ring full and are a gap in a
recording (``overrun``), and the line after the last of these. ``turns`` of the loop stand still when it hangs
or waits for the disk.

``disk_since_ns``, ``store_since_ns``: since when, by the monotonic clock, the loop has been waiting for the
disk, and the thread that creates and seals recordings has been at work; 0 while they do not. ``state``:
index in `recorder_states.STATES`. ``awaited`` alone is written by the owner: how often it found an arm's new
grabber still starting, in which case the arm's silence means nothing."""


@dataclass(frozen=True, slots=True)
class RecorderPlan:
    """The recorder's settings; see `CapturePlan`. Picklable."""

    run: TriggerRun
    stages: int
    stall_timeout_s: float
    tag_wait_s: float
    max_skew_lines: int
    realtime: bool = False
    disk: Disk = DISK
    continues: bool = False
