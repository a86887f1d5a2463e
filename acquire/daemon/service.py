"""The capture service: carries the commands out, watches the capture path, and says what it sees.

One thread calls everything here except `Service.status` and `Service.hurry`, which any thread may call:
the device thread publishes an immutable `Status` after every change, and others read the latest.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from acquire import __version__
from acquire.daemon.disk_watch import disk_watch
from acquire.daemon.events import StandingOrder
from acquire.daemon.messages import ArmRequest, LastRecording, Status, fault_error
from acquire.daemon.news import NewsLog
from acquire.daemon.plan import default_path, recording_of
from acquire.daemon.report import Rates, arm_statuses, trigger_status
from acquire.daemon.salvage import Salvage
from acquire.daemon.states import Event, State, after, commands, possible
from acquire.daemon.take import Take
from acquire.daemon.troubles import Troubles
from acquire.daemon.uploads import Uploads
from acquire.errors import AcquireError, DeviceError, StateError, UsageError
from acquire.store import RunCondition
from acquire.stream import Begin, CaptureStatus, Note

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.config import RigConfig
    from acquire.daemon.messages import CapacityStatus, RecoveryStatus, StartRequest
    from acquire.daemon.needs import OpenRun, Prove, Run
    from acquire.stream.ring import RingShape

RECOVERY_S = 20.0
"""How long the end of a recording waits for parts of it that are being recovered; they are in any case."""
POLL_S = 0.05
ARM = ArmRequest()
TOLD = ("mark", "input", "threshold")
"""Kinds of events that are news; what the check of the code notes is told by its verdict."""

log = logging.getLogger("acquire.daemon")


class Service:
    """One instrument, at most one run at a time. See the module for who may call what."""

    def __init__(
        self,
        config: RigConfig,
        open_run: OpenRun,
        prove: Prove | None = None,
        salvage: Salvage | None = None,
        uploads: Uploads | None = None,
        troubles: Troubles | None = None,
    ) -> None:
        self.config = config
        self.origin = ""
        """The file that the configuration was read from."""
        self.news = NewsLog()
        self.armed_since = datetime.now(UTC)
        self._open_run = open_run
        self._prove = prove
        self._salvage = salvage or Salvage(config.recording.directory.absolute())
        self._uploads = uploads or Uploads()
        self.troubles = troubles or Troubles()
        self._capacity: CapacityStatus | None = None
        self._hurried = threading.Event()
        self._born = time.monotonic()
        self._state = State.IDLE
        self._since = datetime.now(UTC)
        self._busy: str | None = None
        self._run: Run | None = None
        self._seen = CaptureStatus()
        self._rates = Rates()
        self._disk = disk_watch(config)
        self._order = StandingOrder(config)
        self._take: Take | None = None
        self._last: LastRecording | None = None
        self._fault: str | None = None
        self._told: tuple[State, str | None] = self._state, None
        self._publish()

    # ---- any thread

    def status(self) -> Status:
        """What was published last; never waits."""
        uptime_s = round(time.monotonic() - self._born, 3)
        told = {"uptime_s": uptime_s, "troubles": self.troubles.statuses, "disk": self._disk.status}
        return self._status.model_copy(update=told)

    def ring_places(self) -> tuple[str | None, dict[str, tuple[str, RingShape]]]:
        """The run, and arm → path and shape of the memory through which its lines pass."""
        run = self._run
        return (None, {}) if run is None else (run.run_id, run.capture.ring_places())

    @property
    def patience_s(self) -> float:
        """Longest step of a command, or time in which nothing more of a recording reaches the disk."""
        return max(self.config.recording.seal_timeout_s + RECOVERY_S, self.config.stream.arm_timeout_s)

    @property
    def hurried(self) -> bool:
        return self._hurried.is_set()

    def hurry(self) -> None:
        """Do not wait for lines on the way any more: seal what there is."""
        self._hurried.set()

    # ---- commands

    def arm(self, request: ArmRequest = ARM) -> None:
        """idle → armed. Raises what the devices refuse with, and UsageError where the host is too slow for
        them, or where recordings are to be copied is refused, and that is not forced; the state is idle then.
        """
        with self._doing(Event.ARM):
            self._recovered(self._salvage.poll(capturing=True))  # what is under way would be measured, too
            self._uploads.prove(force=request.force)
            if self._prove is not None:
                self._capacity = self._prove(force=request.force, tell=self._tell)
            run = self._open_run(request)
            run.arm(self._tell)
            self._run, self._seen, self._rates = run, CaptureStatus(), Rates()
            self.armed_since = datetime.now(UTC)
            self._order = StandingOrder(self.config)
            self._go(Event.ARM, run.run_id)
            if run.calibration is not None and not run.calibration.carried:
                log.warning("calibration: %s", run.calibration.text)
            self.supervise()

    def start(self, request: StartRequest) -> None:
        """armed → recording. Raises UsageError for a path that cannot be; the state is armed then."""
        with self._doing(Event.START):
            assert self._run is not None
            self._begin(recording_of(request, self.config, self._run.spec()))
            self.supervise()

    def mark(self, text: str) -> None:
        """An event at the newest line; the state changes where it starts a recording."""
        with self._doing(Event.MARK):
            assert self._run is not None
            self._heed(Note(self._run.capture.note("mark", text), "mark", text))

    def stop(self) -> None:
        """recording → draining. What is on the way is written and sealed while `supervise` looks after it:
        marks can be taken meanwhile.
        """
        with self._doing(Event.STOP):
            self._stop("stopped")
            self.supervise()

    def disarm(self) -> None:
        """armed → idle; or clears a fault."""
        with self._doing(Event.DISARM):
            self._fault = None
            try:
                self._release()
            finally:
                self._go(Event.DISARM)

    def sign(self, command: str, who: str) -> None:
        """Write down who gave a command: in the log, and among the events of the recording under way."""
        log.info("%s by %s", command, who)
        if self._run is not None and self._state in (State.RECORDING, State.DRAINING):
            self._run.capture.note("operator", f"{command} by {who}")

    def measure(self) -> None:
        """What the host sustains, anew; nothing may be armed, since that would be measured, too."""
        if self._state is not State.IDLE:
            raise StateError(f"cannot measure while {self._state}", possible=possible(self._state))
        if self._prove is None:
            raise UsageError("this rig's capacity cannot be measured", hint="acquire bench --config RIG")
        self._busy = "capacity"
        self._publish()
        try:
            self._capacity = self._prove(force=True, anew=True, tell=self._tell)
        finally:
            self._busy = None
            self._publish()

    def reconfigure(self, config: RigConfig, told: str) -> None:
        """Work with ``config`` from now on; it differs where that does no harm (`acquire.daemon.reload`).

        ``told``: who has changed what, for the recording under way.
        """
        self.config = config
        self._disk.keep(round(config.recording.reserve_gb * 1e9))
        if self._run is not None:
            self._run.adopt(config.recording)
            if self._state in (State.RECORDING, State.DRAINING):
                self._run.capture.note("operator", told)
        self._publish()

    # ---- supervision

    def supervise(self) -> None:
        """Look at the capture path once and act on what is seen. Any failure of it becomes a fault.

        What happens beside it, a defect there included, must not keep the capture path from being watched.
        """
        for name, look in (("recoveries", self._look_at_salvage), ("uploads", self._look_at_uploads)):
            try:
                look()
            except Exception as error:  # noqa: BLE001 - told in the status; the capture comes first
                self.troubles.note(name, error)
        self._disk.check(recording=self._state is State.RECORDING)
        self.news.update(self.status())
        if self._run is None:
            return
        try:
            self._look()
        except (AcquireError, OSError) as error:
            self._fail(self._with_cause(str(error)))
        except Exception as error:  # noqa: BLE001 - nobody would watch the devices otherwise
            self.troubles.note("watching the capture", error)
            self._fail(self._with_cause(f"defect in the daemon: {error!r}"))
        self._publish()

    def _look_at_salvage(self) -> None:
        self._recovered(self._salvage.poll(capturing=self._run is not None))

    def _look_at_uploads(self) -> None:
        self._uploads.poll()
        told = self._status.uploads, self._status.upload_warning
        if (self._uploads.statuses, self._uploads.warning) != told:
            self._publish()

    def shutdown(self) -> None:
        """Whatever the state: seal, release. Bounded in time; raises only what closing a run raises."""
        try:
            if self._state is State.RECORDING:
                self._stop("signal")
            while self._state is State.DRAINING and not self._waits_too_long():
                self.supervise()
                if self._state is State.DRAINING:
                    self._hurried.wait(POLL_S)
            if self._state is State.ARMED:
                self.disarm()
        except (AcquireError, OSError) as error:
            log.error("while ending: %s", error)  # noqa: TRY400 - users get no traceback
        finally:
            try:
                self._release()
            finally:
                self._recovered(self._salvage.wait(RECOVERY_S))
                self._salvage.close()
                self._uploads.close()
                self._disk.close()

    def _idles(self, take: Take) -> bool:
        """Nothing more of the recording has reached the disk for as long as is allowed."""
        return take.idle_s(self._seen) > self.config.recording.seal_timeout_s

    def _waits_too_long(self) -> bool:
        """A disk that does not answer must not keep the daemon from ending; the next one recovers."""
        return self._take is not None and bool(self._seen.waiting) and self._idles(self._take)

    def _stop(self, reason: str) -> None:
        assert self._run is not None
        self._run.capture.stop(reason)
        self._go(Event.STOP, reason)

    def _look(self) -> None:
        """One step of the state table, as the capture path dictates it."""
        seen = self._poll()
        if seen.fault is not None:
            self._fail(seen.fault)
            return
        assert self._run is not None
        for note in self._run.capture.take_events():
            self._heed_unasked(note)
        if self._state is State.RECORDING and (seen.draining or seen.done):
            self._go(Event.FULL)
        if self._state is not State.DRAINING:
            return
        assert self._take is not None
        if seen.done or self.hurried:
            self._finish(self._take)
        elif self._idles(self._take) and not seen.waiting:  # a disk may take its time
            limit_s = self.config.recording.seal_timeout_s
            self._fail(f"the recording was not sealed: nothing more of it reached the disk for {limit_s:g} s")

    def _poll(self) -> CaptureStatus:
        assert self._run is not None
        before, self._seen = self._seen, self._run.capture.poll()
        if self._seen.waiting and not before.waiting:
            log.warning("%s", self._seen.waiting)
        elif before.waiting and not self._seen.waiting:
            log.warning("over: %s", before.waiting)
        if self._seen.recording and before.recording and before.path != self._seen.path:
            log.warning("%s goes on in %s", before.path, self._seen.path)
        self._salvage.add(self._seen.orphans)
        if self._seen.path is not None:
            if self._take is not None:
                self._salvage.began(Path(self._seen.path))
            self._uploads.add(Path(self._seen.path))
        self._rates.update(self._seen)
        return self._seen

    def _begin(self, begin: Begin, *, by_event: bool = False) -> None:
        assert self._run is not None
        # Before anything is written down of it: a start that is refused leaves no trace.
        self._run.capture.start(begin)
        path, lines = begin.path, begin.budget_lines
        self._salvage.began(path)
        self._uploads.forget(path)
        self._uploads.add(path)
        self._take = Take(path, lines, by_event)
        self._go(Event.START, f"{path}, {'until stopped' if lines is None else f'{lines} lines'}")

    def _heed_unasked(self, note: Note) -> None:
        """A disk that does not create a recording must not end the watch for the next event."""
        try:
            self._heed(note)
        except AcquireError as error:
            self.troubles.note(f"event {note.kind} at line {note.line}", error)

    def _heed(self, note: Note) -> None:
        """Do at an event what the rig asks for."""
        assert self._run is not None
        log.info("event: %s at line %d%s", note.kind, note.line, f": {note.text}" if note.text else "")
        if note.kind in TOLD:
            self.news.tell(note.kind, note.text or note.kind, line=note.line)
        if not self._order.covers(note):
            return
        take = self._take
        if take is None and self._order.waits:
            window = self._order.window(note)
            self._begin(Begin(default_path(self.config), self._run.spec(), window=window), by_event=True)
            self._order.used = True
        elif take is None:
            log.info("the event starts no recording: another did since the instrument was armed")
        elif take.by_event and self._state is State.RECORDING:
            self._run.capture.extend(self._order.end_line(note))
        elif take.by_event and take.late is None:
            take.late = note

    def _finish(self, take: Take) -> None:
        """The recording is over: stay armed for the next, or release the devices."""
        aborted = self._seen.condition is RunCondition.ABORTED
        stays = self.config.recording.after == "armed" or (take.by_event and self._order.rearm)
        stays = stays and self._seen.done and not aborted and not self.hurried
        if stays:
            self._remember()
        else:
            self._release()
        self._recovered(self._salvage.wait(RECOVERY_S))
        if aborted:
            self._fail(f"the recording was aborted: {self._seen.end_reason}")
            return
        last = self._last
        why = f"{last.path}, {last.lines} lines, {last.condition}, {last.end_reason}" if last else ""
        self._go(Event.SEALED if stays else Event.RELEASED, why)
        # An event that came while its predecessor's recording was being sealed was put off, not forgotten.
        if stays and take.late is not None:
            self._heed_unasked(take.late)

    def _with_cause(self, trouble: str) -> str:
        """What went wrong while ending often follows from what ended it: that comes first."""
        seen, cause = self._seen, self._seen.fault
        ending = self._state in (State.RECORDING, State.DRAINING)
        if cause is None and ending and seen.condition is not RunCondition.GOOD:
            cause = seen.end_reason
        return f"{cause}; then, while ending: {trouble}" if cause else trouble

    def _fail(self, text: str) -> None:
        """Tell the fault at once, release the devices, then wait to be read."""
        self._fault = text
        self._publish()
        try:
            self._release()
        except AcquireError as error:
            self._fault = f"{text}; then, while ending: {error}"
        self._go(Event.FAULT, self._fault)

    def _release(self) -> None:
        """Close the run and remember its recording. Raises what closing raises, OSError as DeviceError."""
        if self._run is None:
            return
        # Forgotten first: whatever closing comes to, it is not tried a second time.
        run, self._run = self._run, None
        try:
            run.capture.close()
        except OSError as error:
            raise DeviceError(f"the devices could not be released in order: {error}") from error
        finally:
            self._seen, self._rates = run.capture.poll(), Rates()
            self._salvage.add(self._seen.orphans)
            # Nothing can be done about it any more, and nobody may find out a year later.
            for arm, account in self._seen.accounts.items():
                if not account.balanced:
                    log.error("the ledger of arm %s does not balance: %s", arm, account)
            self._remember()
            self._publish()

    def _remember(self) -> None:
        if self._take is not None:
            self._last, self._take = self._take.result(self._seen), None
            if self._last.condition is not None:
                self._salvage.ended(self._last.path)

    def _recovered(self, found: list[RecoveryStatus]) -> None:
        """The latest recording may have been among what its recorder did not seal."""
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
        """Refuse what the state does not allow, before anything is touched; say what is under way.

        A command that ends in a fault raises it.
        """
        after(self._state, command)
        self._busy = command
        self._publish()
        try:
            yield
            if self._state is State.FAULTED:
                raise fault_error(self._fault)
        except AcquireError as error:
            log.error("%s: %s", command, error)  # noqa: TRY400
            raise
        finally:
            self._busy = None
            self._publish()

    def _tell(self, what: str) -> None:
        """What the command under way is waiting for; for the status."""
        self._busy = f"{(self._busy or '').split(':')[0]}: {what}"
        self._publish()

    def _go(self, event: Event, why: str = "") -> None:
        before, self._state = self._state, after(self._state, event)
        self._since = datetime.now(UTC)
        level = logging.ERROR if event is Event.FAULT else logging.INFO
        log.log(level, "%s → %s (%s%s)", before, self._state, event, f": {why}" if why else "")
        path = self._take.path if self._take else self._last.path if self._last else None
        news = f"{event}: {why}" if why else str(event)
        importance = "error" if event is Event.FAULT else "info"
        self.news.tell("state", news, self._state, level=importance, path=path)
        self._publish()

    def _publish(self) -> None:
        self.moved_s = time.monotonic()
        self._status = Status(
            state=self._state,
            since=self._since,
            possible=[str(command) for command in commands(self._state)],
            busy=self._busy,
            name=self.config.name,
            version=__version__,
            pid=os.getpid(),
            uptime_s=0.0,
            run_id=None if self._run is None else self._run.run_id,
            recording=None if self._take is None else self._take.status(self._seen),
            arms=arm_statuses(self._seen, self._rates),
            trigger=None if self._run is None else trigger_status(self._seen),
            last=self._last,
            waiting=self._seen.waiting or None,
            fault=self._fault,
            capacity=self._capacity,
            calibration=None if self._run is None else self._run.calibration,
            processes={} if self._run is None else self._seen.pids,
            recoveries=self._salvage.recoveries,
            uploads=self._uploads.statuses,
            uploads_left=self._uploads.left,
            upload_warning=self._uploads.warning,
        )
        self.news.update(self.status())
        told, self._told = self._told, (self._state, self._busy)
        if told != self._told:
            self.news.wake()
