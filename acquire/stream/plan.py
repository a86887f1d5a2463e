"""What a capture is asked to do, and what it says about itself while it does it."""

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
"""Readers of a ring that nobody waits for: the watcher is the first, a preview can be the second."""

MAX_SUBSTEPS = 8
"""A line's code is recorded in one byte."""

TAG_DELAY_S = 0.5
"""How late a tag may come."""

END_S = 30.0
"""For what a capture has started to end in order, before it is ended by force."""

PATIENT_RINGS = 3
"""A recorder is given up once lines of so many rings have come since its last sign of life."""

SKEW_RINGS = 32
"""An arm that lags behind the other by the lines of so many rings is taken for stalled."""


@dataclass(frozen=True, slots=True)
class CapturePlan:
    """One run of the capture path. Picklable; refuses with UsageError what cannot work.

    Attributes
    ----------
    run : what the trigger is asked to do
    stages, pixels, dtype : M; pixels per line; "uint8" or "uint16"
    block_lines, ring_slots : lines per ring slot; slots per arm
    white_dn : a pixel that has this value is saturated
    openers : arm → how its camera is opened, in the grabber's process
    stall_timeout_s : an arm that delivers nothing for so long ends the recording; while nothing is
        recorded it is a fault
    patience_s : a recorder that waits for the disk for longer is a fault, and one that shows no life for
        another reason is replaced; None: the disk as long as it takes, the recorder for `PATIENT_RINGS` times
        what the rings hold, and for ``stall_timeout_s`` at least
    goes_on : a recording that ended since the disk was too slow goes on in a further segment
    seal_timeout_s : at the capture's end, a recording of which nothing more reaches the disk for so long is
        given up: it is left to be recovered
    tag_wait_s : how long lines wait for the tag that confirms them, once it is due, before they are flagged
    reopen_timeout_s : how long a camera that is gone is waited for; less than ``stall_timeout_s``, or the
        arm counts as stalled first
    line_period_ns : by the trigger's clock; 0: not told
    realtime : grabbers run before everything else on the host, where that is allowed
    columns : compact layout: arm → first column and the one after the last, on the one camera that
        ``openers["a"]`` opens; empty: a camera per arm
    ring_reserve : slots that hold no history: see `RingShape`
    watch : what is looked for in the lines while they pass; None: nothing
    disk : that is written to; another than the local one behaves as a test wants
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
    goes_on: bool = False
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
        # Lines wait for their tag in the ring, and no longer once half of it is full: a sixth is for a tag
        # that comes late on a busy host.
        most = self.ring_shape.slots * self.block_lines // 3
        if not 1 <= self.run.tag_every_lines <= most:
            raise UsageError(
                f"a capture cannot have a tag every {self.run.tag_every_lines} lines",
                possible=f"1 to {most}, a third of what a ring holds",
                hint="more tags, or more ring slots",
            )

    @property
    def depth_lines(self) -> int:
        """Lines that a camera delivers before the trigger's line 0."""
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
        """Seconds of lines that a ring holds at most; 0 where time is not told."""
        return self.ring_slots * self.block_lines * self.line_period_ns / 1e9

    @property
    def hung_after_s(self) -> float:
        """A recorder that shows no life for so long, and does not wait for the disk, is replaced."""
        if self.patience_s is not None:
            return self.patience_s
        return max(self.stall_timeout_s, PATIENT_RINGS * self.ring_s)

    @property
    def grabbers(self) -> dict[str, tuple[str, ...]]:
        """Name of a grabber → the arms that it serves."""
        return {"".join(ARMS): ARMS} if self.columns else {arm: (arm,) for arm in ARMS}

    @property
    def margin_lines(self) -> int | None:
        """Lines by which a camera may seem ahead of the trigger's tags; None where time is not told."""
        if not self.line_period_ns:
            return None
        return self.run.tag_every_lines + round(TAG_DELAY_S * 1e9 / self.line_period_ns)

    @property
    def max_skew_lines(self) -> int:
        """Lines by which one arm may be ahead of the other, and by which a camera's count may jump: after
        a larger jump the other arm would be taken for stalled, and its rows would be written in one go.
        """
        return SKEW_RINGS * self.ring_slots * self.block_lines


@dataclass(frozen=True, slots=True)
class CaptureStatus:
    """The capture at one moment; counts may be a few milliseconds apart. JSON, but for ``condition``.

    Attributes
    ----------
    recording : a recording is being written
    draining : its last line is known
    done : the latest recording is closed; ``condition``, ``end_reason`` and ``ledger`` are final
    path : of the latest recording; another than was asked for, when its recorder was killed and replaced
    first_line : the trigger's number of its row 0, or None before the first recording
    recorded_lines, committed_lines : rows that both arms have; rows that a reader finds
    ring : arm → slots, fill, peak, drops (blocks), dropped_lines, all since arm
    lines : arm → delivered, preroll, discarded (taken from the ring, but in no recording), and lost by
        cause, since arm, and ``saturated`` in a pixel at least; and of the latest recording ``recorded``
        rows, of which ``missing``. After `close`: delivered = preroll + lost["ring_full"] + discarded +
        recorded − missing. Also how often the camera was ``reopened``, and its ``clock``: the latest stamp
        (line, its time by the camera) and how much faster it runs than the trigger's, in parts per billion;
        all 0 where it tells no time. The ``check`` of the code, where it is made: verdict, shift, and the
        line after the last looked at
    accounts : arm → what became of every pulse since arm
    waiting : what is being waited for that takes longer than it should, in words; "" for nothing
    fault : what failed first, or None
    pids : process numbers: of the recorder, and of each grabber
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
