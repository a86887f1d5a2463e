"""The thread of an armed run: it moves tags to the recorder (`TagFeed`), reads the processes' messages, and
notices when they fall silent.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import TYPE_CHECKING

from acquire.clock import NS_PER_S
from acquire.errors import DeviceError, TriggerError
from acquire.lines import ARMS
from acquire.processes.messages import Failed, Ready
from acquire.stream.external_counts import RECORDER, TRIGGER, WATCHER
from acquire.stream.lifecycle import UNDER_WAY, Lifecycle, Stage
from acquire.stream.losses import Cause
from acquire.stream.messages import Began, Cancel, Checked, End, Extend, Interrupt, Note, Refused, Sealed
from acquire.stream.stalls import Excess, Heartbeat, HoldUps
from acquire.stream.succession import Succession, replacement_note
from acquire.stream.tag_feed import TagFeed

if TYPE_CHECKING:
    from acquire.processes.shared import Counters
    from acquire.processes.worker import Worker
    from acquire.stream.messages import Begin
    from acquire.stream.plan import CapturePlan
    from acquire.stream.ring import Ring
    from acquire.trigger.base import Trigger

# The thread waits for tags only, and checks everything else in between: a death is noticed this much later.
_TAG_WAIT_S = 0.02
_ANSWER_S = 120.0
"""Time for a recording to be created. A recorder that hangs, rather than waits for the disk, is replaced
sooner."""
_JOIN_S = 30.0
# Kept between two polls of the service, tenths of a second: a flood of trigger events must not fill memory.
_MOST_EVENTS = 1024


class Supervisor:
    """Owns the thread; its findings can be read at any time.

    If the line period is known, it compares the cameras' line counts with the trigger's (`stalls.Excess`).

    Attributes
    ----------
    life : stage of the latest recording
    fault : the first failure
    """

    def __init__(
        self,
        trigger: Trigger,
        workers: dict[str, Worker],
        tags: Ring,
        *,
        counters: dict[str, Counters],
        plan: CapturePlan,
        succession: Succession | None = None,
    ) -> None:
        self.fault: str | None = None
        self.life = Lifecycle(continues=plan.continues)
        self._workers = workers
        self._succession = succession or Succession({})
        self._feed = TagFeed(trigger, tags, counters[TRIGGER], report=self.report, fail=self._fail)
        self._plan = plan
        self._loop = Heartbeat(counters[RECORDER], "turns")
        self._cameras = {arm: Heartbeat(counters[arm], "delivered") for arm in ARMS}
        margin, limit_s = plan.margin_lines, plan.stall_timeout_s
        self._excess = {arm: Excess(counters[arm], margin, limit_s) for arm in ARMS if margin is not None}
        self._counters = counters
        self._hold_ups = HoldUps()
        self._turned_s = time.monotonic()
        self._events: deque[Note] = deque(maxlen=_MOST_EVENTS)
        self._dead: set[str] = set()
        self._hung: str | None = None
        self._interruption: Interrupt | None = None
        self._last_words: dict[str, str] = {}
        self._news = threading.Condition()  # its lock is re-entrant: `_note` may call `_fail`
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="acquire-supervisor", daemon=True)

    @property
    def recording(self) -> bool:
        """Whether a recording is open, or will be continued."""
        return self.life.stage in UNDER_WAY

    @property
    def silent_s(self) -> float:
        """How long the recorder has shown no life."""
        return self._loop.still_s

    @property
    def _committed_lines(self) -> int:
        """Lines of the current recording that the recorder has acknowledged."""
        return self._counters[RECORDER]["committed"]

    @property
    def dead(self) -> frozenset[str]:
        """Processes that died and have no successor."""
        return frozenset(self._dead)

    @property
    def pulses(self) -> int:
        """Pulses issued by the trigger, according to its tags."""
        newest = self._feed.newest_pulse
        return 0 if newest is None else newest + 1

    @property
    def trigger_silent_s(self) -> float:
        """Seconds since the trigger's last tag or answer to a query."""
        return time.monotonic() - self._feed.heard_s

    @property
    def still_s(self) -> float:
        """How long this thread has shown no life: a driver of a trigger may not return."""
        return 0.0 if self._ending.is_set() else time.monotonic() - self._turned_s

    def start(self) -> None:
        self._feed.heard_s = self._turned_s = time.monotonic()
        self._thread.start()

    def end(self) -> None:
        """End the thread. Raises TriggerError if it is stuck in the trigger's driver. Idempotent."""
        self._ending.set()
        if self._thread.ident is not None:
            self._thread.join(_JOIN_S)
        if self._thread.is_alive():
            raise TriggerError(
                f"the trigger has not returned from a wait of {_TAG_WAIT_S} s for {_JOIN_S:g} s",
                hint="check its cable and power, then restart the daemon",
            )

    def mark_unsealed(self) -> None:
        """Note that every process has ended: a recording that is not sealed now never will be."""
        self.life.mark_unsealed(self.fault or "its recorder did not end in time", self._committed_lines)

    def begin(self, message: Begin) -> None:
        """Have the recorder begin; returns when it has. Raises the recorder's error if it refuses."""
        with self._news:
            self.life.begin(message)
            self._workers[RECORDER].post(message)
            self._news.wait_for(lambda: self.life.stage is not Stage.ASKED or self.fault, _ANSWER_S)
            if self.life.began is not None:
                return
            if self.life.refused is not None:
                raise self.life.refused.error
            if self.life.stage is Stage.ASKED:
                self.life.on_overdue()
                self._workers[RECORDER].post(Cancel())
            if self.fault is not None:
                raise DeviceError(f"start: {self.fault}", hint="acquire disarm, then check the device")
        waits = self._counters[RECORDER]["disk_since_ns"] or self._counters[RECORDER]["store_since_ns"]
        state = "it waits for the disk" if waits else f"no sign of life for {self.silent_s:.1f} s"
        raise DeviceError(
            f"start: the recorder has not begun within {_ANSWER_S:g} s: {state}",
            possible="nothing was recorded",
            hint="start again once the disk answers",
        )

    def end_recording(self, reason: str, line: int) -> None:
        """Have the recording end at ``line``, also if its recorder is only starting.

        Raises StateError if nothing has been recorded; a recording that has ended stays as it is.
        """
        with self._news:
            self._cancel_if(begins=self.life.end(reason))
        self._workers[RECORDER].post(End(reason, line))

    def interrupt_recording(self, reason: str) -> None:
        """Have the recording end at once, without a further segment."""
        with self._news:
            self._cancel_if(begins=self.life.on_fault())
            self._interruption = Interrupt(reason, ARMS, Cause.INTERRUPTED)
            self._workers[RECORDER].post(self._interruption)

    def extend(self, line: int) -> None:
        """Do not let the recording end before ``line``, unless it is ending already."""
        with self._news:
            self.life.extend(line)
        self._workers[RECORDER].post(Extend(line))

    def report(self, note: Note) -> None:
        """Send a note to the recorder, and keep it for `take_events`.

        A recorder that does not read its messages gets only the first of them.
        """
        self._events.append(note)
        if self._workers[RECORDER].unsent < _MOST_EVENTS:
            self.send(note)

    def send(self, note: Note) -> None:
        """Send a note to the recorder.

        The note is kept, since the recorder may die before it has written it: it is sent to the successor as
        well, and given to the recovery of the orphan.
        """
        with self._news:
            self.life.notes.append(note)
            self._workers[RECORDER].post(note)

    def take_events(self) -> list[Note]:
        """Return the events since the last call; only the latest, if there were too many."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def wait_sealed(self, deadline: float) -> bool:
        """Wait until the recording is closed or lost, or the monotonic ``deadline``; return whether it is."""
        with self._news:
            while self.recording and time.monotonic() < deadline:
                # Whoever waits reads for a thread that a defect has ended: the recorder seals all the same.
                if not self._thread.is_alive() and not self._read_last_words():
                    break
                self._news.wait(_TAG_WAIT_S)
            return not self.recording

    def _read_last_words(self) -> bool:
        """Read the recorder's messages in place of the thread; return whether that was possible."""
        try:
            self._workers[RECORDER].flush()
            self._read_messages(RECORDER, self._workers[RECORDER])
        except Exception as error:  # noqa: BLE001 - perhaps the defect that has ended the thread
            self._fail(f"supervisor: {type(error).__name__}: {error}")
            return False
        return True

    def _run(self) -> None:
        try:
            while not self._ending.is_set():
                begun = self._turned_s = time.monotonic()
                # The recorder must not flag lines as untagged because this process was held up.
                self._hold_ups.update()
                self._counters[TRIGGER]["held_up_to_ns"] = round(self._hold_ups.over_s * NS_PER_S)
                self._counters[TRIGGER]["turned_ns"] = round(begun * NS_PER_S)
                tags = self._feed.take(_TAG_WAIT_S)
                self._feed.query(begun)
                for name, worker in self._workers.items():  # a successor only replaces the value of a key
                    self._read_messages(name, worker)
                    worker.flush()
                # A recording that the disk ended continues in a further segment, unless its end has come.
                with self._news:
                    if self.life.on_line(max(self._counters[arm]["next_line"] for arm in ARMS)):
                        self._news.notify_all()
                    following = self.life.due(time.monotonic())
                if following is not None:
                    self._workers[RECORDER].post(following)
                if self.fault is None:
                    self._watch(time.monotonic())
                if not tags:  # a trigger whose `tags` returns at once must not make this loop spin
                    self._ending.wait(max(0.0, begun + _TAG_WAIT_S - time.monotonic()))
        except Exception as error:  # noqa: BLE001 - the outermost boundary of the thread: reported as a fault
            self._fail(f"supervisor: {type(error).__name__}: {error}")

    def _watch(self, now_s: float) -> None:
        """Detect silent arms, which are a fault; during a recording, the recorder judges them."""
        limit_s = self._plan.stall_timeout_s
        for name in self._workers:
            if self._succession.is_late(name):
                self._fail(f"{self._workers[name].name}: its successor was not ready in time", name)
            elif self._succession.is_starting(name):
                # A camera takes seconds to come back. Until then neither its arm, nor the recorder that waits
                # for it in an open recording, counts as stalled.
                self._loop.revive()
                for arm in self._plan.grabbers.get(name, ()):
                    self._cameras[arm].revive()
                    self._counters[RECORDER].add(f"awaited_{arm}", 1)
        self._watch_recorder(now_s)
        pulse = self._feed.newest_pulse
        for arm, excess in self._excess.items() if pulse is not None else ():
            if line := excess.update(pulse or 0, now_s):
                ahead = f"line {line} came with the trigger at line {pulse}"
                self._fail(f"arm {arm}: {ahead}: the camera does not wait for it")
        if self.recording:
            for camera in self._cameras.values():
                camera.revive()
        silent_s = {arm: camera.update(now_s) for arm, camera in self._cameras.items()}
        if max(silent_s.values()) > limit_s:
            # Arms that fall silent together do so to within a block: half the limit tells both from one.
            arms = " and ".join(arm for arm in ARMS if silent_s[arm] > limit_s / 2)
            self._fail(f"arm {arms}: no line for {limit_s:g} s")

    def _watch_recorder(self, now_s: float) -> None:
        """Kill a recorder that hangs. One that waits for the disk may wait: the rings keep the lines."""
        silent_s, patience_s = self._loop.update(now_s), self._plan.patience_s
        if self._hung is not None:
            if silent_s > 2 * self._plan.hung_after_s:
                self._fail(f"{self._hung}; it was killed, and has not ended")
        elif self.waits_for_disk:
            if patience_s is not None and silent_s > patience_s:
                self._fail(f"the disk has not answered for {patience_s:g} s")
        elif silent_s > self._plan.hung_after_s:
            self._hung = f"{self._workers[RECORDER].name}: no sign of life for {self._plan.hung_after_s:g} s"
            self._workers[RECORDER].kill()

    @property
    def waits_for_disk(self) -> bool:
        """Whether the recorder's loop waits for the disk, and was not stopped by a signal in that wait."""
        return bool(self._counters[RECORDER]["disk_since_ns"]) and not self._workers[RECORDER].is_stopped

    def _read_messages(self, name: str, worker: Worker) -> None:
        death = worker.death  # read before the messages, so that the last message of a dead process is seen
        if death and name == RECORDER and self._hung is not None:
            death = f"{death} after {self._hung.partition(': ')[2]}"
        while (message := worker.message()) is not None:
            self._note(name, message)
        if death and name not in self._dead:
            # A process that reported an error has no successor, which would meet the same error.
            if name not in self._last_words and self._replace(name, worker, death):
                return
            self._dead.add(name)
            if name == RECORDER:
                with self._news:
                    self.life.on_died()
            if name == WATCHER:
                # Recording continues without it; its last verdict does not hold for the lines to come.
                for arm in ARMS:
                    self._counters[WATCHER][f"verdict_{arm}"] = 0
                why = self._last_words.get(name, death)
                self.report(Note((self._feed.newest_pulse or 0) + 1, "unwatched", f"watcher: {why}"))
                return
            self._fail(f"{worker.name}: {self._last_words.get(name, death)}", name)

    def _replace(self, name: str, worker: Worker, death: str) -> bool:
        """Put another process in the place of one that was killed; return whether that was possible."""
        if self.fault is not None or self._ending.is_set():
            return False
        successor = self._succession.successor(name)
        if successor is None:
            return False
        # In one go: what comes before belongs to the dead process, and what comes after, such as a start, to
        # its successor.
        with self._news:
            self._workers[name] = successor
            if name == RECORDER:
                # Marks that were acknowledged and not yet written are sent again: in a night with 48 kills,
                # 11 of 254 were lost otherwise.
                for note in self.life.notes:
                    successor.post(note)
                following = self.life.on_killed(death, self._committed_lines, time.monotonic())
                if following is not None:
                    successor.post(following)
                if self._interruption is not None:  # the dead process may have been the only one to get it
                    successor.post(self._interruption)
                self._news.notify_all()
        worker.end(time.monotonic())  # it is dead: this closes what belonged to it
        self._hung = None
        for arm in self._plan.grabbers.get(name, ()):
            self._cameras[arm].revive()
        self._loop.revive()
        newest = max(self._counters[arm]["next_line"] for arm in ARMS)
        self.report(replacement_note(worker.name, death, max(newest, 0)))
        return True

    def _note(self, name: str, message: object) -> None:
        with self._news:
            match message:
                case Ready():
                    self._succession.ready(name)
                case Began():
                    missed = self.life.on_began(message, time.monotonic())
                    if missed is not None:
                        self._workers[RECORDER].post(missed)
                case Refused(error):
                    if self.life.on_refused(message, time.monotonic()):
                        self._last_words[name] = f"the recording cannot go on: {error}"
                        self._fail(f"{self._workers[name].name}: {self._last_words[name]}", name)
                case Sealed():
                    rows = {arm: self._counters[RECORDER][f"rows_{arm}"] for arm in ARMS}
                    self.life.on_sealed(message, rows, self._committed_lines, time.monotonic())
                case Note():
                    self.report(message)
                case Checked(first_line, _, text):
                    self.report(Note(first_line, "code_check", text))
                case Failed(error):
                    # The text of an unexpected exception begins with the process's name already.
                    self._last_words[name] = str(error).removeprefix(f"{self._workers[name].name}: ")
            self._news.notify_all()

    def _cancel_if(self, *, begins: bool) -> None:
        """Cancel the recording that the recorder is creating, if there is one."""
        if begins:
            self._workers[RECORDER].post(Cancel())
            self._news.notify_all()

    def _fail(self, text: str, name: str | None = None) -> None:
        """Keep the first fault, and have the recording sealed if the recorder is alive."""
        with self._news:  # a command that waits for a start must learn of the fault at once
            self.fault = self.fault or text
            self._cancel_if(begins=self.life.on_fault())
            self._news.notify_all()
        self._workers[RECORDER].post(Interrupt(text, self._plan.grabbers.get(name or "", ())))
