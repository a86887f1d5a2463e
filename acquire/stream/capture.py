"""The owner of one armed run: its processes, its thread, and the order in which they start and end.

::

    arm     memory → recorder, grabbers → cameras armed → trigger → tags flow
    close   recording → tags → trigger → grabbers → recorder → memory

The first failure is the one raised, and its message names later ones. A capture is used once: armed, then
closed.
"""

from __future__ import annotations

import threading
import time
from dataclasses import asdict, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from acquire.errors import AcquireError, DataError, StateError, UsageError, add_failure
from acquire.lines import ARMS
from acquire.processes.messages import Quit, Ready
from acquire.processes.shared import Counters
from acquire.processes.worker import Worker
from acquire.stream import grabber, recorder, recorder_plan, recorder_states, watcher
from acquire.stream.external_counts import RECORDER, TAG_READER_COUNTERS, TRIGGER, TRIGGER_COUNTERS, WATCHER
from acquire.stream.kept import Kept
from acquire.stream.ledger import Counted, account
from acquire.stream.lifecycle import MEANINGS, Stage
from acquire.stream.losses import Cause
from acquire.stream.messages import Note, RunStarted
from acquire.stream.plan import END_S, CaptureStatus
from acquire.stream.ring import Ring, RingShape
from acquire.stream.succession import Succession
from acquire.stream.supervisor import Supervisor
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.clock import ClockFit
    from acquire.stream.ledger import ArmLedger
    from acquire.stream.messages import Begin
    from acquire.stream.plan import CapturePlan
    from acquire.trigger.base import Trigger

_TAG_RING = RingShape(slots=64, rows=256, width=3, dtype="uint64")
REPORTED_S = 1.0
"""Waits longer than this are reported in the status."""
_UNDO_S = 5.0
"""Time to undo an arming that failed, when there is no recording to be sealed."""
_LEAST_END_S = 5.0
"""Least time for the processes to end, even when time is up: a killed grabber leaves its camera running."""


class Capture:
    """One armed run of the capture path.

    `start`, `stop` and `close` are for one thread at a time; `poll` may be called by any and never waits.
    The caller keeps ownership of the trigger, which is started and stopped here, but not closed.

    Attributes
    ----------
    clock : the fit of the trigger's clock to UTC, once armed
    cameras : arm → settings as read back, with ``identity``, once armed
    """

    clock: ClockFit
    cameras: dict[str, dict[str, Any]]

    def __init__(self, plan: CapturePlan, trigger: Trigger) -> None:
        self._plan = plan
        self._trigger = trigger
        self._trigger_used = False
        self._rings: dict[str, Ring] = {}
        self._tags: Ring | None = None
        self._counters: dict[str, Counters] = {}
        self._left_over = dict.fromkeys(ARMS, 0)
        self._pulses: int | None = None
        self._workers: dict[str, Worker] = {}
        self._supervisor: Supervisor | None = None
        self._memory = threading.Lock()  # held by `poll` while it reads, and to unmap
        self._final: CaptureStatus | None = None
        self._used = self._closed = self._emptied = False

    def arm(self, timeout_s: float = 120.0, progress: Callable[[str], object] = lambda _: None) -> None:
        """Start everything; lines flow and are discarded. ``progress`` is called with each awaited step.

        On failure everything is undone and the first error raised: the camera's or trigger's own, or
        DeviceError for a process that dies, or does not answer within ``timeout_s`` of the one before it.
        """
        if self._used or self._closed:
            raise StateError("arm: this capture has been used", hint="make another")
        self._used = True
        try:
            self._begin(timeout_s, progress)
        except BaseException as error:
            try:
                self.close(_UNDO_S)
            except (AcquireError, OSError) as second:
                add_failure(error, "while undoing it", second)
            raise

    def start(self, begin: Begin) -> None:
        """Begin a recording; return once it exists.

        Raises UsageError or DataError if it cannot be created, or if the rings do not hold the window's
        lines; nothing has changed then.
        """
        supervisor = self._running("start")
        if supervisor.fault:
            raise StateError(f"start: the capture has failed ({supervisor.fault})", hint="arm again")
        if begin.lines is not None and begin.lines < 1:
            raise UsageError(f"start: a recording cannot have {begin.lines} lines", possible="1 or more")
        supervisor.begin(begin)

    def note(self, kind: str, text: str, line: int | None = None) -> int:
        """List an event at ``line``, or at the newest one, in every recording that holds the line.

        Return the line. A recording that begins later can still hold it: see `Window`.
        """
        supervisor = self._running("note")
        if line is None:
            line = max(ring.newest_line for ring in self._rings.values())
        supervisor.send(Note(line, kind, text))
        return line

    def take_events(self) -> list[Note]:
        """Return the events of the trigger's inputs and of the lines since the last call, without marks."""
        return self._running("take_events").take_events()

    def extend(self, line: int) -> None:
        """Do not let the current recording end before ``line``, unless it is ending already."""
        self._running("extend").extend(line)

    def stop(self, reason: str = "stopped") -> None:
        """End the recording at the newest line; `poll` reports when it is sealed. Idempotent."""
        supervisor = self._running("stop")  # first: the rings of a capture that is closed are unmapped
        supervisor.end_recording(reason, max(ring.newest_line for ring in self._rings.values()))

    def poll(self) -> CaptureStatus:
        """Return the current status; after `close`, the final one."""
        with self._memory:
            if self._final is not None:
                return self._final
            return self._status(self._supervisor) if self._supervisor else CaptureStatus()

    def ring_places(self) -> dict[str, tuple[str, RingShape]]:
        """Return, per arm, its ring's path and shape, for observers in other processes; empty once closed."""
        return {} if self._closed else {arm: (ring.path, ring.shape) for arm, ring in self._rings.items()}

    @property
    def pids(self) -> dict[str, int | None]:
        """Process numbers of the recorder and of each grabber."""
        return {name: worker.pid for name, worker in self._workers.items()}

    def close(self, timeout_s: float = END_S) -> None:
        """End everything, in the module's order; a current recording is sealed as interrupted. Idempotent.

        Processes that have not ended in ``timeout_s`` are killed. Sealing may take that time, or the plan's
        ``seal_timeout_s`` if shorter, again after each commit. Raises the first error.
        """
        if self._closed:
            return
        self._closed = True
        deadline = time.monotonic() + timeout_s
        _run_all(
            lambda: self._end_recording(min(timeout_s, self._plan.seal_timeout_s)),
            self._end_tags,
            self._end_trigger,
            lambda: self._end_workers(deadline),
            self._empty_rings,
            self._end_memory,
        )

    # ---- begin

    def _begin(self, timeout_s: float, progress: Callable[[str], object]) -> None:
        progress("memory for the rings")
        self._tags = Ring("tags", _TAG_RING)
        self._counters[RECORDER] = Counters(recorder_plan.COUNTERS)
        self._counters[TRIGGER] = Counters(TRIGGER_COUNTERS + TAG_READER_COUNTERS)
        if self._plan.watch is not None:
            self._counters[WATCHER] = Counters(watcher.COUNTERS)
        for arm in ARMS:
            self._rings[arm] = Ring(arm, self._plan.ring_shape)
            self._counters[arm] = Counters(grabber.COUNTERS)
        # Start all before waiting for any: a camera takes seconds to open.
        self._workers[RECORDER] = self._new_recorder()
        if self._plan.watch is not None:
            self._workers[WATCHER] = self._new_watcher()
        for name in self._plan.grabbers:
            self._workers[name] = self._new_grabber(name)
        facts: dict[str, dict[str, Any]] = {}
        for name, worker in self._workers.items():
            cameras = self._plan.grabbers.get(name, ())
            progress(f"{worker.name}: {'the camera is being opened' if cameras else 'starting'}")
            facts |= dict.fromkeys(cameras, worker.expect(Ready, time.monotonic() + timeout_s).facts)
        self.cameras = facts
        progress("trigger")
        self._trigger_used = True  # from now on it has to be stopped, even if `prepare` fails
        # The trigger starts last: both cameras wait for it by now, and count from its first pulse.
        self._trigger.prepare(self._plan.run)
        self.clock = self._trigger.start()
        self._workers[RECORDER].post(RunStarted(self.clock))
        self._supervisor = Supervisor(
            self._trigger,
            self._workers,
            self._tags,
            counters=self._counters,
            plan=self._plan,
            succession=Succession(
                {RECORDER: self._next_recorder, WATCHER: self._new_watcher}
                | {name: partial(self._next_grabber, name) for name in self._plan.grabbers}
            ),
        )
        self._supervisor.start()

    def _new_recorder(self) -> Worker:
        plan = self._plan
        what = recorder_plan.RecorderPlan(
            run=plan.run,
            stages=plan.stages,
            stall_timeout_s=plan.stall_timeout_s,
            tag_wait_s=plan.tag_wait_s + plan.run.tag_every_lines * plan.line_period_ns / 1e9,
            max_skew_lines=plan.max_skew_lines,
            realtime=plan.realtime,
            disk=plan.disk,
            continues=plan.continues,
        )
        return Worker(RECORDER, recorder.record, what, self._rings, self._tags, self._counters)

    def _new_watcher(self) -> Worker:
        counters = self._counters[WATCHER]
        # A successor finds its predecessor's counters, and has not judged anything yet.
        for arm in ARMS:
            counters[f"verdict_{arm}"] = 0
        return Worker(WATCHER, watcher.watch, self._plan.watch, self._rings, counters)

    def _new_grabber(self, name: str, *, successor: bool = False) -> Worker:
        plan, tasks = self._plan, []
        for arm in plan.grabbers[name]:
            what = grabber.GrabberPlan(
                arm=arm,
                opener=plan.openers[arm],
                depth_lines=plan.depth_lines,
                white_dn=plan.white_dn,
                max_jump_lines=plan.max_skew_lines,
                reopen_timeout_s=plan.reopen_timeout_s,
                line_period_ns=plan.line_period_ns,
                columns=plan.columns.get(arm),
                realtime=plan.realtime,
                successor=successor,
            )
            tasks.append((what, self._rings[arm], self._counters[arm]))
        return Worker(f"grabber {name}", grabber.grab, *tasks)

    def _next_recorder(self) -> Worker:
        """Return a successor. Lines that the dead recorder had released, but not counted, count as stored."""
        counters = self._counters[RECORDER]
        # The ring's own count is exact at any instant. A block that the dead recorder counted, but did not
        # live to release, is taken and counted again by its successor.
        for arm, ring in self._rings.items():
            others = counters[f"discarded_{arm}"] + counters[f"unsaved_{arm}"]
            counters[f"stored_{arm}"] = ring.released_lines - others
        worker = self._new_recorder()
        assert self._supervisor is not None
        kept = {arm: self._supervisor.life.kept(arm, ring.released_line) for arm, ring in self._rings.items()}
        worker.post(RunStarted(self.clock, kept))
        return worker

    def _next_grabber(self, name: str) -> Worker | None:
        """Return a successor, or None: without time stamps, a camera's lines cannot be numbered again."""
        arms = self._plan.grabbers[name]
        self._settle_books(arms)
        if not all(self._counters[arm]["stamp_ns"] for arm in arms):
            return None
        return self._new_grabber(name, successor=True)

    def _running(self, command: str) -> Supervisor:
        if self._supervisor is None or self._closed:
            raise StateError(f"{command}: this capture is not armed", possible="arm, once")
        return self._supervisor

    # ---- status

    def _status(self, supervisor: Supervisor) -> CaptureStatus:
        began, sealed, counters = supervisor.life.began, supervisor.life.sealed, self._counters[RECORDER]
        rings = {arm: asdict(self._rings[arm].statistics()) for arm in ARMS}
        for counts in rings.values():
            counts["drops"] = counts.pop("dropped_blocks")  # its name in the status, which clients read
        status = CaptureStatus(
            accounts={arm: self._account(arm, supervisor) for arm in ARMS},
            ring=rings,
            lines={arm: self._line_counts(arm, began=began is not None) for arm in ARMS},
            waiting=self._waiting(supervisor),
            fault=supervisor.fault,
            pids={name: pid for name, pid in self.pids.items() if pid is not None},
            orphans=supervisor.life.orphans,
            trigger={
                "clock_hz": self.clock.clock_hz,
                "uncertainty_ns": self.clock.uncertainty_ns,
                "pulses": max(supervisor.pulses, self._counters[TRIGGER]["pulses"]),
                "silent_s": supervisor.trigger_silent_s,
            },
        )
        if began is None:
            return status
        return replace(
            status,
            recording=supervisor.recording,
            draining=supervisor.recording and bool(counters["draining"]),
            done=sealed is not None,
            path=None if supervisor.life.path is None else str(supervisor.life.path),
            first_line=began.first_line,
            recorded_lines=counters["recorded"],
            committed_lines=counters["committed"],
            beyond_bytes=counters["beyond_bytes"],
            condition=sealed.condition if sealed else None,
            end_reason=sealed.end_reason if sealed else None,
            ledger=sealed.ledger if sealed else {},
        )

    def _waiting(self, supervisor: Supervisor) -> str:
        """Return what takes longer than it should, and for how long the rings can make up for it."""
        if supervisor.still_s > REPORTED_S:  # then nothing else would be noticed, not even a process's death
            return f"the supervisor has shown no life for {supervisor.still_s:.0f} s"
        if supervisor.silent_s > REPORTED_S:
            who = "disk has not answered" if supervisor.waits_for_disk else "recorder has shown no life"
            room = f"; {self._room()}" if supervisor.recording else ""
            return f"the {who} for {supervisor.silent_s:.0f} s{room}"
        since_ns = self._counters[RECORDER]["store_since_ns"]
        if since_ns and (store_s := time.monotonic() - since_ns / 1e9) > REPORTED_S:
            doing = recorder_states.MEANINGS[recorder_states.STATES[self._counters[RECORDER]["state"]]]
            return f"the disk has been at work for {store_s:.0f} s: {doing}"
        if why := supervisor.life.resumption.why:
            return f"{MEANINGS[Stage.PAUSED]}: {why}"
        return ""

    def _room(self) -> str:
        """Return for how long the rings can still take lines."""
        rings, period_ns = self._rings.values(), self._plan.line_period_ns
        if any(ring.fill == ring.shape.slots for ring in rings):
            return "the rings are full: lines that come now belong to no recording"
        lines = min(ring.room_lines for ring in rings)
        more = f"{lines * period_ns / 1e9:.0f} s" if period_ns else counted(lines, "line")
        return f"the rings hold {more} more"

    def _lost(self, arm: str) -> dict[str, int]:
        grabbed, recorded = self._counters[arm], self._counters[RECORDER]
        unsaved = recorded[f"unsaved_{arm}"]
        return {
            str(Cause.CAMERA): grabbed[Cause.CAMERA],
            str(Cause.RING_FULL): recorded[f"overrun_{arm}"],
            **{
                str(cause): grabbed[cause]
                for cause in (*grabber.CAMERA_CAUSES[1:], Cause.GRABBER_LOST)
                if grabbed[cause]
            },
            **({str(Cause.WRITE_ERROR): unsaved} if unsaved else {}),
        }

    def _discarded(self, arm: str) -> int:
        """Return the arm's lines in no recording."""
        # A recording ends before lines that found their ring full, unless they are a gap in it.
        recorded = self._counters[RECORDER]
        dropped = self._rings[arm].statistics().dropped_lines - recorded[f"overrun_{arm}"]
        return recorded[f"discarded_{arm}"] + self._left_over[arm] + dropped

    def _account(self, arm: str, supervisor: Supervisor) -> ArmLedger:
        """Return the arm's ledger."""
        # The counts advance while they are read. They are read against the flow of the lines (recorder, ring,
        # grabber), so that a line may appear to be waiting, but never to come from nowhere.
        recorded, ring, began = self._counters[RECORDER], self._rings[arm], supervisor.life.began
        stored, discarded = recorded[f"stored_{arm}"], self._discarded(arm)
        lost = self._lost(arm)
        next_line = max(self._counters[arm]["next_line"], ring.newest_line)
        depth = self._plan.depth_lines
        # Before the first line, the counter's 0 is no line number.
        next_line = next_line if self._counters[arm]["delivered"] else -depth
        known = max(supervisor.pulses, self._counters[TRIGGER]["pulses"], next_line + depth)
        counted = Counted(
            pulses=known if self._pulses is None else self._pulses,
            next_line=next_line,
            depth=depth,
            stored=stored,
            discarded=discarded,
            lost=lost,
            recorded_to=began.first_line + recorded[f"rows_{arm}"] if began else 0,
            room=ring.shape.slots * ring.shape.rows,
            block=ring.shape.rows,
        )
        return account(counted, closed=self._emptied)

    def _line_counts(self, arm: str, *, began: bool) -> dict[str, Any]:
        grabbed, recorded = self._counters[arm], self._counters[RECORDER]
        check: dict[str, Any] = {}
        if WATCHER in self._counters:
            seen = self._counters[WATCHER]
            # The verdict first, which is written last.
            check = {"verdict": str(watcher.VERDICTS[seen[f"verdict_{arm}"]])}
            check |= {name: seen[f"{name}_{arm}"] for name in ("shift", "checked_line", "lapped")}
        return {
            "delivered": grabbed["delivered"],
            "preroll": grabbed["preroll"],
            "discarded": self._discarded(arm),
            "lost": self._lost(arm),
            "check": check,
            "recorded": recorded[f"rows_{arm}"] if began else 0,
            "missing": recorded[f"missing_{arm}"] if began else 0,
            "saturated": grabbed["saturated"],
            "reopened": grabbed["reopened"],
            "clock": {name: grabbed[name] for name in ("stamp_line", "stamp_ns", "drift_ppb")},
        }

    # ---- end

    def _end_recording(self, timeout_s: float) -> None:
        supervisor = self._supervisor
        if supervisor is None or not supervisor.recording:
            return
        supervisor.interrupt_recording("the capture was closed")
        # The recorder may still have to write seconds of lines from the rings: it is given up only when a
        # whole timeout has passed without a commit.
        committed = self._counters[RECORDER]["committed"]
        while not supervisor.wait_sealed(time.monotonic() + timeout_s):
            if committed == (committed := self._counters[RECORDER]["committed"]):
                raise DataError("the recording could not be sealed in time", hint="recover it")

    def _end_tags(self) -> None:
        if self._supervisor is not None:
            self._supervisor.end()

    def _end_trigger(self) -> None:
        if self._trigger_used:
            self._pulses = self._trigger.stop()

    def _end_workers(self, deadline: float) -> None:
        least = time.monotonic() + _LEAST_END_S
        deadlines = dict.fromkeys(self._workers, max(deadline, least))
        if self._supervisor is not None and self._supervisor.recording:
            deadlines[RECORDER] = least  # it has had its time to seal
        for worker in self._workers.values():
            worker.post(Quit())
        # All get Quit before any is waited for, so that they end in parallel. The recorder comes last: it
        # empties the rings that the grabbers fill.
        order = sorted(self._workers, key=RECORDER.__eq__)
        _run_all(*(partial(_end, self._workers[name], deadlines[name]) for name in order))

    def _settle_books(self, arms: tuple[str, ...]) -> None:
        for arm in arms:
            grabber.settle_books(self._rings[arm], self._counters[arm])

    def _empty_rings(self) -> None:
        """Account for the blocks that no recorder will take; another recording may have some of them."""
        for name in self._supervisor.dead if self._supervisor else ():
            self._settle_books(self._plan.grabbers.get(name, ()))
        for arm, ring in self._rings.items():
            kept = Kept(self._supervisor.life.kept(arm, ring.released_line) if self._supervisor else ())
            blocks = ring.empty()
            stored = sum(kept.count(lines.start, lines.stop) for lines in blocks)
            self._counters[RECORDER].add(f"stored_{arm}", stored)
            self._left_over[arm] = sum(map(len, blocks)) - stored
        self._emptied = True

    def _end_memory(self) -> None:
        if self._supervisor is not None:
            self._supervisor.mark_unsealed()
        # Under the lock of `poll`, which must not read unmapped memory from another thread.
        with self._memory:
            self._final = self._status(self._supervisor) if self._supervisor else CaptureStatus()
            for counters in self._counters.values():
                counters.close()
            for lines in self._rings.values():
                lines.discard()
            for ring in (*self._rings.values(), self._tags):
                if ring is not None:
                    ring.close()


def _end(worker: Worker, deadline: float) -> None:
    """End a process. Raises what it reported while ending, or DeviceError if it had to be killed."""
    if (error := worker.end(deadline)) is not None:
        raise error


def _run_all(*steps: Callable[[], None]) -> None:
    """Take every step, even if earlier ones fail; then raise the first error, with the later ones in it."""
    first: AcquireError | OSError | None = None
    for step in steps:
        try:
            step()
        except (AcquireError, OSError) as error:
            if first is None:
                first = error
            else:
                add_failure(first, "while ending", error)
    if first is not None:
        raise first
