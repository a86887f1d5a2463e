"""The settings of a capture, and its status."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from acquire.errors import UsageError
from acquire.geometry import Geometry
from acquire.lines import ARMS
from acquire.store.files import DISK, Disk
from acquire.stream.ring import RingShape

if TYPE_CHECKING:
    from acquire.camera.base import CameraOpener
    from acquire.store import RunCondition
    from acquire.stream.ledger import ArmLedger
    from acquire.stream.succession import Orphan
    from acquire.stream.watcher import WatchPlan
    from acquire.trigger.base import TriggerRun

OBSERVERS = 2
"""Number of observers of a ring: the watcher is the first, a preview can be the second."""

MAX_SUBSTEPS = 8
"""A line's code is recorded in one byte."""

TAG_DELAY_S = 0.5
"""Longest delay of a tag."""

END_S = 30.0
"""Time for a capture's processes and trigger to end in order, before they are killed."""

PATIENT_RINGS = 3
"""A recorder is given up once this many rings of lines have come since its last sign of life."""

SKEW_RINGS = 32
"""An arm that lags behind the other by this many rings of lines counts as stalled."""


@dataclass(frozen=True, slots=True)
class CapturePlan:
    """Settings of one run of the capture path. Picklable; raises UsageError for settings that cannot work.

    Attributes
    ----------
    run : settings of the trigger
    stages, pixels, dtype : M; pixels per line; "uint8" or "uint16"
    block_lines, ring_slots : lines per ring slot; slots per arm
    white_dn : value from which on a pixel is saturated
    openers : arm → how its camera is opened, in the grabber's process
    stall_timeout_s : an arm that delivers nothing for this long ends the recording; while nothing is
        recorded it is a fault
    patience_s : a recorder that waits longer for the disk is a fault, and one that shows no life for
        another reason is replaced; None: wait for the disk without limit, and for the recorder
        `PATIENT_RINGS` times as long as the rings hold lines, at least ``stall_timeout_s``
    continues : whether a recording that ended because the disk was too slow has a further segment
    seal_timeout_s : when the capture is closed, a recording of which nothing more reaches the disk for this
        long is given up, and left to be recovered
    tag_wait_s : how long lines wait for the tag that confirms them, once it is due, before they are flagged;
        the time in which the host kept the process waiting that passes tags on does not count
    reopen_timeout_s : how long a camera that is gone is waited for; less than ``stall_timeout_s``, or the
        arm counts as stalled first
    line_period_ns : line period by the trigger's clock; 0: unknown
    realtime : grabbers run ahead of everything else on the host, where that is allowed
    columns : compact layout: arm → first column and the one after the last, on the one camera that
        ``openers["a"]`` opens; empty: a camera per arm
    ring_reserve : slots that hold no history: see `RingShape`
    watch : checks of the lines while they pass; None: none
    disk : file system that is written to; tests pass one that fails or is slow
    """

    run: TriggerRun
    stages: int
    pixels: int
    dtype: str
    block_lines: int
    ring_slots: int
    white_dn: int
    openers: dict[str, CameraOpener]
    stall_timeout_s: float = 3.0
    tag_wait_s: float = 1.0
    reopen_timeout_s: float = 2.0
    line_period_ns: float = 0.0
    columns: dict[str, tuple[int, int]] = field(default_factory=dict)
    realtime: bool = False
    ring_reserve: int = 2
    watch: WatchPlan | None = None
    disk: Disk = DISK
    patience_s: float | None = None
    continues: bool = False
    seal_timeout_s: float = END_S

    def __post_init__(self) -> None:
        if tuple(sorted(self.openers)) != ARMS:
            raise UsageError(
                f"a capture cannot have the cameras {', '.join(self.openers)}", possible=", ".join(ARMS)
            )
        if not 1 <= self.run.substeps <= MAX_SUBSTEPS:
            raise UsageError(
                f"a capture cannot have S = {self.run.substeps}", possible=f"1 to {MAX_SUBSTEPS}"
            )
        if self.dtype not in ("uint8", "uint16"):
            raise UsageError(f"a capture cannot have {self.dtype!r} samples", possible="uint8, uint16")
        # Lines wait in the ring for their tag until half of the ring is full. Of that half, a third of the
        # ring is for the distance of tags, and a sixth for a tag that comes late on a busy host.
        most = self.ring_shape.slots * self.block_lines // 3
        if not 1 <= self.run.tag_every_lines <= most:
            raise UsageError(
                f"a capture cannot have a tag every {self.run.tag_every_lines} lines",
                possible=f"1 to {most}, a third of what a ring holds",
                hint="more tags, or more ring slots",
            )

    @property
    def depth_lines(self) -> int:
        """Number of lines that a camera delivers before the trigger's line 0."""
        return Geometry(self.stages, self.run.substeps, 1).depth_lines

    @property
    def ring_shape(self) -> RingShape:
        return RingShape(
            slots=self.ring_slots,
            rows=self.block_lines,
            width=self.pixels,
            dtype=self.dtype,
            observers=OBSERVERS,
            reserve=self.ring_reserve,
        )

    @property
    def ring_s(self) -> float:
        """Seconds of lines that a ring holds at most; 0 if the line period is unknown."""
        return self.ring_slots * self.block_lines * self.line_period_ns / 1e9

    @property
    def hung_after_s(self) -> float:
        """Seconds without a sign of life after which a recorder is replaced, unless it waits for the disk."""
        if self.patience_s is not None:
            return self.patience_s
        return max(self.stall_timeout_s, PATIENT_RINGS * self.ring_s)

    @property
    def grabbers(self) -> dict[str, tuple[str, ...]]:
        """Name of a grabber → the arms that it serves."""
        return {"".join(ARMS): ARMS} if self.columns else {arm: (arm,) for arm in ARMS}

    @property
    def margin_lines(self) -> int | None:
        """Lines by which a camera may be ahead of the trigger's tags; None if the line period is unknown."""
        if not self.line_period_ns:
            return None
        return self.run.tag_every_lines + round(TAG_DELAY_S * 1e9 / self.line_period_ns)

    @property
    def max_skew_lines(self) -> int:
        """Lines by which one arm may be ahead of the other, and by which a camera's count may jump.

        After a larger jump the other arm would count as stalled, and its rows would be written in one go.
        """
        return SKEW_RINGS * self.ring_slots * self.block_lines


@dataclass(frozen=True, slots=True)
class CaptureStatus:
    """The state of the capture at one moment; counts may be a few milliseconds apart.

    All of it is JSON except ``condition``.

    Attributes
    ----------
    recording : a recording is being written
    draining : its last line is known
    done : the latest recording is closed; ``condition``, ``end_reason`` and ``ledger`` are final
    path : path of the latest recording; not the one requested if its recorder was killed and replaced
    first_line : the trigger's number of its row 0, or None before the first recording
    recorded_lines, committed_lines : rows that both arms have; rows that a reader finds
    beyond_bytes : bytes by which held lines exceed the limit of retention
    ring : arm → slots, fill, peak, drops (blocks), dropped_lines, all since arm
    lines : arm → delivered, preroll, discarded (taken from the ring, but in no recording), lost by cause,
        and ``saturated`` (in at least one pixel), all since arm; of the latest recording ``recorded`` rows,
        of which ``missing``. After `close`: delivered = preroll + lost["ring_full"] + discarded +
        recorded − missing. Also how often the camera was ``reopened``, and its ``clock``: the latest stamp
        (line, its time by the camera) and how much faster it runs than the trigger's, in parts per billion;
        all 0 if it has no time stamps. The ``check`` of the code, if one is made: verdict, shift, and the
        line after the last one checked
    accounts : arm → what became of every pulse since arm
    waiting : an operation that takes longer than it should, in words; "" for none
    fault : the first failure, or None
    pids : process numbers of the recorder and of each grabber
    orphans : recordings that their recorder did not live to seal: to be recovered
    trigger : clock_hz, uncertainty_ns of its relation to UTC, pulses, and silent_s since it last answered
    """

    recording: bool = False
    draining: bool = False
    done: bool = False
    path: str | None = None
    first_line: int | None = None
    recorded_lines: int = 0
    committed_lines: int = 0
    beyond_bytes: int = 0
    ring: dict[str, dict[str, int]] = field(default_factory=dict)
    lines: dict[str, dict[str, Any]] = field(default_factory=dict)
    waiting: str = ""
    fault: str | None = None
    pids: dict[str, int] = field(default_factory=dict)
    condition: RunCondition | None = None
    end_reason: str | None = None
    ledger: dict[str, Any] = field(default_factory=dict)
    accounts: dict[str, ArmLedger] = field(default_factory=dict)
    orphans: tuple[Orphan, ...] = ()
    trigger: dict[str, float] = field(default_factory=dict)
