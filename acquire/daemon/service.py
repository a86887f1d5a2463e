"""The capture service: carries out commands, supervises the capture path, and publishes its status.

One thread calls everything here except what is listed under "any thread" in `Service`, such as its status:
the device thread publishes an immutable `Status` after every change, and others read the latest.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from acquire import __version__
from acquire.daemon.disk_watch import disk_watch
from acquire.daemon.events import StandingOrder
from acquire.daemon.messages import ArmRequest, LastRecording, Status, fault_error, release_error
from acquire.daemon.news import NewsLog
from acquire.daemon.plan import default_path, recording_of
from acquire.daemon.report import Rates, arm_statuses, seconds_since, trigger_status
from acquire.daemon.salvage import Salvage
from acquire.daemon.states import Event, Situation, State, commands
from acquire.daemon.take import Take, and_then, in_words, log_event, with_cause
from acquire.daemon.troubles import Troubles
from acquire.daemon.uploads import Uploads
from acquire.errors import AcquireError, UsageError
from acquire.logs import EACH
from acquire.store import RunCondition
from acquire.stream import Begin, CaptureStatus, Note

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.config import RigConfig
    from acquire.daemon.disk_watch import DiskWatch
    from acquire.daemon.messages import CapacityStatus, RecoveryStatus, StartRequest
    from acquire.daemon.needs import OpenRun, Prove, ServiceRun
    from acquire.stream.ring import RingShape

RECOVERY_S = 20.0
"""How long the end of a recording waits for parts that are being recovered, which continues in any case."""
POLL_S = 0.05
ARM = ArmRequest()
NEWSWORTHY = ("mark", "input", "threshold")
"""Kinds of events that become news; those of the code check do not, since its verdict does."""

log = logging.getLogger("acquire.daemon")


class Service:
    """One instrument, at most one run at a time. See the module for threads."""

    def __init__(
        self,
        config: RigConfig,
        open_run: OpenRun,
        *,
        prove: Prove | None = None,
        salvage: Salvage | None = None,
        uploads: Uploads | None = None,
        troubles: Troubles | None = None,
        disk: DiskWatch | None = None,
    ) -> None:
        self.config = config
        self.origin = ""
        """The file that the configuration was read from."""
        self.news = NewsLog()
        self.armed_s = time.monotonic()
        self._open_run = open_run
        self._prove = prove
        self._salvage = salvage or Salvage(config.recording.directory.absolute())
        self._uploads = uploads or Uploads()
        self.troubles = troubles or Troubles()
        self._capacity: CapacityStatus | None = None
        self._hurried = threading.Event()
        self._born = time.monotonic()
        self._now = Situation()
        self._run: ServiceRun | None = None
        self._seen, self._rates = CaptureStatus(), Rates()
        self._disk = disk or disk_watch(config)
        self._order = StandingOrder(config)
        self._take: Take | None = None
        self._last: LastRecording | None = None
        self._published: tuple[State, str | None] = self._now.state, self._now.busy
        self._publish()

    # ---- any thread

    def status(self) -> Status:
        """Return the latest published status; never waits."""
        # These change even while the devices' thread waits for a device and publishes nothing.
        ages = {"uptime_s": seconds_since(self._born), "state_s": seconds_since(self._now.since_s)}
        trouble = self._disk.trouble
        disk = {"disk": self._disk.status, "disk_trouble": None if trouble is None else str(trouble)}
        return self._status.model_copy(update=ages | disk | {"troubles": self.troubles.statuses})

    def ring_places(self) -> tuple[str | None, dict[str, tuple[str, RingShape]]]:
        """Return the run's ID, and per arm the path and shape of its ring's memory."""
        # Read once: the devices' thread may set it to None at any moment.
        run = self._run
        return (None, {}) if run is None else (run.run_id, run.capture.ring_places())

    @property
    def patience_s(self) -> float:
        """Longest time for a step of a command, or without progress of a recording on disk."""
        return max(self.config.recording.seal_timeout_s + RECOVERY_S, self.config.stream.arm_timeout_s)

    @property
    def hurried(self) -> bool:
        """Whether `hurry` was called."""
        return self._hurried.is_set()

    def hurry(self) -> None:
        """Do not wait any more for lines on their way: seal the recording as it is."""
        self._hurried.set()

    # ---- commands

    def arm(self, request: ArmRequest = ARM) -> None:
        """idle → armed.

        Raises the devices' errors, and, unless forced, UsageError if the host is too slow or the store for
        uploads refuses; the state is idle then.
        """
        with self._doing(Event.ARM):
            # First end a recovery, which would disturb the measurement.
            self._recovered(self._salvage.poll(capturing=True))
            self._uploads.prove(force=request.force)
            if self._prove is not None:
                self._capacity = self._prove(force=request.force, progress=self._show)
            run = self._open_run(request)
            run.arm(self._show)
            # Only now: a run that could not be armed has undone everything itself.
            self._run, self._seen, self._rates = run, CaptureStatus(), Rates()
            self.armed_s = time.monotonic()  # not by the clock, which may be set
            self._order = StandingOrder(self.config)
            self._go(Event.ARM, run.run_id)
            if run.calibration is not None and not run.calibration.carried:
                log.warning("calibration: %s", run.calibration.text)
            self.supervise()

    def start(self, request: StartRequest) -> None:
        """armed → recording. Raises UsageError for an impossible path; the state is armed then."""
        with self._doing(Event.START):
            assert self._run is not None
            self._begin(recording_of(request, self.config, self._run.spec()))
            self.supervise()

    def mark(self, text: str) -> None:
        """Add an event at the newest line; the state changes if the event starts a recording."""
        with self._doing(Event.MARK):
            assert self._run is not None
            self._handle_event(Note(self._run.capture.note("mark", text), "mark", text))

    def stop(self) -> None:
        """recording → draining.

        `supervise` then follows the recording until its last lines are written and it is sealed; marks are
        possible in the meantime.
        """
        with self._doing(Event.STOP):
            self._stop("stopped")
            self.supervise()

    def disarm(self) -> None:
        """armed → idle; or clears a fault."""
        with self._doing(Event.DISARM):
            self._now.fault = None
            try:
                self._release()
            finally:
                # Whatever closing it raised, the run is gone: armed without one, every command would fail.
                self._go(Event.DISARM)

    def sign(self, command: str, who: str) -> None:
        """Record who gave a command, in the log and among the events of the current recording."""
        log.info("%s by %s", command, who, extra=EACH)
        if self._run is not None and self._now.state in (State.RECORDING, State.DRAINING):
            self._run.capture.note("operator", f"{command} by {who}")

    def measure(self) -> None:
        """Measure again what the host sustains; only while idle, since a run would disturb it."""
        state = self._now.state
        if state is not State.IDLE:
            raise self._now.refusal(f"measuring is impossible while {state}")
        if self._prove is None:
            raise UsageError("this rig's capacity cannot be measured", hint="acquire bench --config RIG")
        self._now.busy = "capacity"
        self._publish()
        try:
            # Forced: here an insufficient rate is the answer, and not a refusal.
            self._capacity = self._prove(force=True, fresh=True, progress=self._show)
        finally:
            self._now.busy = None
            self._publish()

    def reconfigure(self, config: RigConfig, text: str) -> None:
        """Use ``config``, of which only permitted keys differ; ``text`` tells the current recording which."""
        self.config = config
        self._disk.keep(config.recording.reserve_bytes)
        self._uploads.keep(config.recording.reserve_bytes)
        if self._run is not None:
            self._run.adopt(config.recording)
            if self._now.state in (State.RECORDING, State.DRAINING):
                self._run.capture.note("operator", text)
        self._publish()

    # ---- supervision

    def supervise(self) -> None:
        """Check the capture path once and act on the result. Any failure of it becomes a fault.

        Everything else, even a defect there, must not keep the capture path from being supervised.
        """
        beside: tuple[tuple[str, Callable[[], object]], ...] = (
            ("recoveries", lambda: self._recovered(self._salvage.poll(capturing=self._run is not None))),
            ("uploads", self._uploads.poll),
            ("disk", self._check_disk),
        )
        for what, work in beside:
            try:
                work()
            except Exception as error:  # noqa: BLE001 - shown in the status; the capture comes first
                self.troubles.note(what, error)
        published = self._status.uploads, self._status.upload_warning
        if (self._uploads.statuses, self._uploads.warning) != published:
            self._publish()
        # While idle nothing is published, but the disk fills, and there may be troubles.
        self.news.update(self.status())
        if self._run is None:
            return
        try:
            self._step()
        except (AcquireError, OSError) as error:
            self._fail(self._with_cause(str(error)))
        except Exception as error:  # noqa: BLE001 - otherwise the devices would be left unsupervised
            self.troubles.note("watching the capture", error)
            self._fail(self._with_cause(f"defect in the daemon: {error!r}"))
        self._publish()

    def _check_disk(self) -> None:
        self._disk.check(recording=self._now.state is State.RECORDING)
        if other := self._disk.other():
            self.news.add("disk", other, level="warning")
        if self._disk.came_back() or other:
            self._salvage.search()  # it may have brought recordings that were left open

    def shutdown(self) -> None:
        """Seal and release, whatever the state. Bounded in time; raises only errors of closing a run."""
        try:
            if self._now.state is State.RECORDING:
                self._stop("signal")
            while self._now.state is State.DRAINING:
                # A disk that makes no progress must not keep the daemon from ending: the next daemon recovers
                # the recording.
                if self._take is not None and self._seen.waiting and self._idles(self._take):
                    break
                self.supervise()
                if self._now.state is State.DRAINING:
                    self._hurried.wait(POLL_S)
            if self._now.state is State.ARMED:
                self.disarm()
        except (AcquireError, OSError) as error:
            log.error("while ending: %s", error)  # noqa: TRY400 - no traceback for users
        finally:
            try:
                self._release()
            finally:
                self._recovered(self._salvage.wait(RECOVERY_S))
                self._salvage.close()
                self._uploads.close()
                self._disk.close()

    def _idles(self, take: Take) -> bool:
        """Return whether the recording has made no progress for longer than allowed."""
        return take.idle_s(self._seen) > self.config.recording.seal_timeout_s

    def _stop(self, reason: str) -> None:
        assert self._run is not None
        self._run.capture.stop(reason)
        self._go(Event.STOP, reason)

    def _step(self) -> None:
        """Make one step of the state machine, according to the capture path."""
        seen = self._poll()
        if seen.fault is not None:
            self._fail(seen.fault)
            return
        assert self._run is not None
        for note in self._run.capture.take_events():
            self._try_event(note)
        if self._now.state is State.RECORDING and (seen.draining or seen.done):
            self._go(Event.FULL)
        if self._now.state is not State.DRAINING:
            return
        assert self._take is not None
        if seen.done or self.hurried:
            self._finish(self._take)
        elif self._idles(self._take) and not seen.waiting:  # a slow disk is waited for
            limit_s = self.config.recording.seal_timeout_s
            self._fail(f"the recording was not sealed: nothing more of it reached the disk for {limit_s:g} s")

    def _poll(self) -> CaptureStatus:
        assert self._run is not None
        before, self._seen = self._seen, self._run.capture.poll()
        if self._seen.recording and before.recording and before.path != self._seen.path:
            log.warning("%s continues in %s", before.path, self._seen.path)
        self._salvage.add(self._seen.orphans)
        if self._seen.path is not None:
            # Without a take, the path is that of a sealed recording, which would return to the journal.
            if self._take is not None:
                self._salvage.began(Path(self._seen.path))
            self._uploads.add(Path(self._seen.path))
        self._rates.update(self._seen)
        return self._seen

    def _begin(self, begin: Begin, *, by_event: bool = False) -> None:
        assert self._run is not None
        # First, so that a refused start leaves no trace in the journals.
        path, lines = begin.path, begin.budget_lines
        self._disk.refuse(path)
        self._run.capture.start(begin)
        self._salvage.began(path)
        self._uploads.forget(path)
        self._uploads.add(path)
        before = None if self._seen.path == str(path) else self._seen.path
        self._take = Take(path, lines, by_event, before=before)
        self._go(Event.START, self._take.in_words)

    def _try_event(self, note: Note) -> None:
        """Handle an event; if its recording cannot be created, the next event is still waited for."""
        try:
            self._handle_event(note)
        except AcquireError as error:
            self.troubles.note(f"event {note.kind} at line {note.line}", error)

    def _handle_event(self, note: Note) -> None:
        """Carry out the rig's action for an event."""
        assert self._run is not None
        log_event(note, self._take)
        if note.kind in NEWSWORTHY:
            self.news.add(note.kind, note.text or note.kind, line=note.line)
        if not self._order.covers(note):
            return
        take = self._take
        if take is None and self._order.waits:
            window = self._order.window(note)
            self._begin(Begin(default_path(self.config), self._run.spec(), window=window), by_event=True)
            # Only now: an event whose recording could not be created leaves the order to the next event.
            self._order.used = True
        elif take is None:
            log.info("the event starts no recording: another did since the instrument was armed")
        elif take.by_event and self._now.state is State.RECORDING:
            self._run.capture.extend(self._order.end_line(note))
        elif take.by_event and take.late is None:
            take.late = note

    def _finish(self, take: Take) -> None:
        """Finish a recording that is over: stay armed for the next, or release the devices."""
        aborted = self._seen.condition is RunCondition.ABORTED
        stays = self.config.recording.after == "armed" or (take.by_event and self._order.rearm)
        stays = stays and self._seen.done and not aborted and not self.hurried
        if stays:
            self._remember()
        else:
            self._release()
        # Before the state changes: who waits for "sealed" then sees the result of a recovery, too.
        self._recovered(self._salvage.wait(RECOVERY_S))
        if aborted:
            self._fail(f"the recording was aborted: {self._seen.end_reason}{take.marks_after(self._seen)}")
            return
        why = in_words(self._last) if self._last else ""
        self._go(Event.SEALED if stays else Event.RELEASED, why)
        # An event that came while the recording of its predecessor was being sealed was postponed.
        if stays and take.late is not None:
            self._try_event(take.late)

    def _with_cause(self, trouble: str) -> str:
        return with_cause(trouble, self._seen, ending=self._now.state in (State.RECORDING, State.DRAINING))

    def _fail(self, text: str) -> None:
        """Publish the fault at once, release the devices, and wait until it is read."""
        self._now.fault = text
        self._publish()
        try:
            self._release()
        except AcquireError as error:
            self._now.fault = and_then(text, str(error))
        self._go(Event.FAULT, self._now.fault)

    def _release(self) -> None:
        """Close the run and remember its recording. Raises errors of closing it, OSError as DeviceError."""
        if self._run is None:
            return
        # Cleared first, so that a run that cannot be closed is not closed a second time.
        run, self._run = self._run, None
        try:
            run.capture.close()
        except OSError as error:
            raise release_error(error) from error
        finally:
            self._seen, self._rates = run.capture.poll(), Rates()
            self._salvage.add(self._seen.orphans)
            # Nothing can be done about it any more, but it must not be discovered only a year later.
            for arm, account in self._seen.accounts.items():
                if not account.balanced:
                    log.error("the ledger of arm %s does not balance: %s", arm, account)
            self._remember()
            self._publish()

    def _remember(self) -> None:
        if self._take is not None:
            self._last, self._take = self._take.result(self._seen), None
            # Without a condition it was never sealed, and the journal must keep it.
            if self._last.condition is not None:
                self._salvage.ended(self._last.path)

    def _recovered(self, found: list[RecoveryStatus]) -> None:
        """Take the results of recoveries, one of which may be of the latest recording."""
        for one in found:
            if one.state == "recovered":
                self._uploads.recovered(one.path)
            if one.condition is not None and self._last is not None and self._last.path == one.path:
                update = {"lines": one.lines, "condition": one.condition, "end_reason": one.text}
                self._last = self._last.model_copy(update=update)
        if self._salvage.recoveries != self._status.recoveries:
            self._publish()

    # ---- state

    @contextlib.contextmanager
    def _doing(self, command: Event) -> Iterator[None]:
        """Refuse a command that the state does not allow, or mark it busy. Raises a fault that it ends in."""
        self._now.check(command)
        self._now.busy = command
        self._publish()
        try:
            yield
            if self._now.state is State.FAULTED:
                raise fault_error(self._now.fault)
        except AcquireError as error:
            log.error("%s: %s", command, error)  # noqa: TRY400 - no traceback for users
            raise
        finally:
            self._now.busy = None
            self._publish()

    def _show(self, what: str) -> None:
        """Show in the status what the current command is waiting for."""
        self._now.busy = f"{(self._now.busy or '').split(':')[0]}: {what}"
        self._publish()

    def _go(self, event: Event, why: str = "") -> None:
        before = self._now.state
        self._now.go(event)
        level = logging.ERROR if event is Event.FAULT else logging.INFO
        news = f"{event}: {why}" if why else str(event)
        log.log(level, "%s → %s (%s)", before, self._now.state, news, extra=EACH)
        path = self._take.path if self._take else self._last.path if self._last else None
        importance = "error" if event is Event.FAULT else "info"
        self.news.add("state", news, self._now.state, level=importance, path=path)
        self._publish()

    def _publish(self) -> None:
        # Progress, by which the watchdog tells a slow command from one that hangs.
        self.moved_s = time.monotonic()
        self._status = Status(
            state=self._now.state,
            since=self._now.since,
            possible=[str(command) for command in commands(self._now.state)],
            busy=self._now.busy,
            name=self.config.name,
            version=__version__,
            pid=os.getpid(),
            uptime_s=0.0,  # `status` has the time of the query
            run_id=None if self._run is None else self._run.run_id,
            recording=None if self._take is None else self._take.status(self._seen),
            arms=arm_statuses(self._seen, self._rates),
            trigger=None if self._run is None else trigger_status(self._seen),
            last=self._last,
            waiting=self._seen.waiting or None,
            fault=self._now.fault,
            capacity=self._capacity,
            calibration=None if self._run is None else self._run.calibration,
            light=None if self._run is None else self._run.light,
            processes={} if self._run is None else self._seen.pids,
            recoveries=self._salvage.recoveries,
            uploads=self._uploads.statuses,
            uploads_left=self._uploads.left,
            upload_warning=self._uploads.warning,
        )
        self.news.update(self.status())
        # Streams send a status whenever they are woken: clients see a new state or step at once.
        before, self._published = self._published, (self._now.state, self._now.busy)
        if before != self._published:
            self.news.wake()
