"""The thread of an armed run: it moves tags to the recorder, hears what the processes say, and notices when
they are silent.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

from acquire.errors import AcquireError, DeviceError, TriggerError
from acquire.lines import ARMS
from acquire.processes.messages import Failed, Ready
from acquire.stream.external_counts import TRIGGER, TRIGGER_COUNTERS, WATCHER
from acquire.stream.messages import Began, Cancel, Checked, End, Extend, Interrupt, Note, Refused, Sealed
from acquire.stream.stalls import Excess, Heartbeat
from acquire.stream.succession import (
    Orphan,
    Resumption,
    Succession,
    continuation,
    once_more,
    replacement_note,
    resumed,
)
from acquire.stream.tagger import tag_rows

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.processes.shared import Counters
    from acquire.processes.worker import Worker
    from acquire.stream.messages import Begin
    from acquire.stream.plan import CapturePlan
    from acquire.stream.ring import Ring
    from acquire.trigger.base import LineTag, Trigger

RECORDER = "recorder"
"""Key of the recorder among the workers; the grabbers have their arms' names."""

_TAG_WAIT_S = 0.02
_ANSWER_S = 120.0
"""For a recording to be created. A recorder that hangs, rather than waits for the disk, is noticed sooner."""
_JOIN_S = 30.0
_MOST_EVENTS = 1024
_MOST_KEPT = 256
"""Recordings whose lines are remembered; those that a ring still holds lines of are fewer."""
_ASK_EVERY_S = 1.0


class Supervisor:
    """Owns the thread. What it learnt can be read at any time: `began`, `sealed`, `fault`.

    Where time is told, it holds the cameras' count of lines against the trigger's (`stalls.Excess`).

    Attributes
    ----------
    began : the answer to the latest `begin`, unless that was refused
    sealed : how the latest recording ended
    fault : what failed first
    path : where the latest recording is: not where it was begun, if its recorder was killed meanwhile
    resumption : when a recording that the disk has ended goes on, and why it has not yet
    """

    def __init__(
        self,
        trigger: Trigger,
        workers: dict[str, Worker],
        tags: Ring,
        counters: dict[str, Counters],
        plan: CapturePlan,
        succession: Succession | None = None,
    ) -> None:
        self.began: Began | None = None
        self.sealed: Sealed | None = None
        self.fault: str | None = None
        self.path: Path | None = None
        self._trigger = trigger
        self._workers = workers
        self._succession = succession or Succession({})
        self._asked: Begin | None = None
        self._begin: Begin | None = None
        self._end_reason: str | None = None
        self._tags = tags
        self._plan = plan
        self._loop = Heartbeat(counters[RECORDER], "turns")
        self._cameras = {arm: Heartbeat(counters[arm], "delivered") for arm in ARMS}
        self._arms_of = plan.grabbers
        margin, limit_s = plan.margin_lines, plan.stall_timeout_s
        self._excess = {arm: Excess(counters[arm], margin, limit_s) for arm in ARMS if margin is not None}
        self._counters = counters
        self._ask_s = 0.0
        self._newest_pulse: int | None = None
        self._refused: Refused | None = None
        self._trigger_lost = False
        self._trigger_told_s = time.monotonic()
        self._events: deque[Note] = deque(maxlen=_MOST_EVENTS)
        self._dead: set[str] = set()
        self._orphans: list[Orphan] = []
        self._kept: dict[str, deque[tuple[int, int]]] = {arm: deque(maxlen=_MOST_KEPT) for arm in ARMS}
        self._going_on = False
        self.resumption = Resumption()
        self._cut_short: Sealed | None = None
        self._hung: str | None = None
        self._last_words: dict[str, str] = {}
        self._news = threading.Condition()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._live, name="acquire-supervisor", daemon=True)

    @property
    def recording(self) -> bool:
        """A recording is open, as far as the living can tell."""
        return self.began is not None and self.sealed is None and RECORDER not in self._dead

    @property
    def silent_s(self) -> float:
        """How long the recorder has shown no life."""
        return self._loop.still_s

    @property
    def _committed_lines(self) -> int:
        """That the recorder has acknowledged of the recording under way."""
        return self._counters[RECORDER]["committed"]

    @property
    def dead(self) -> frozenset[str]:
        """Processes that died, and whose place nobody took."""
        return frozenset(self._dead)

    @property
    def orphans(self) -> tuple[Orphan, ...]:
        """Recordings that were not sealed; not while another recorder only begins, which has more to do."""
        return () if self._going_on else tuple(self._orphans)

    def kept(self, arm: str, released_line: int) -> list[tuple[int, int]]:
        """Ranges of the arm's lines that recordings hold, the one under way up to ``released_line``."""
        ranges = list(self._kept[arm])
        if self.began is not None and self.sealed is None:
            ranges.append((self.began.first_line, max(self.began.first_line, released_line)))
        return ranges

    @property
    def pulses(self) -> int:
        """Issued by the trigger, as far as its tags tell."""
        return 0 if self._newest_pulse is None else self._newest_pulse + 1

    @property
    def trigger_silent_s(self) -> float:
        """Since the trigger last told anything: a tag, or the answer to a question."""
        return time.monotonic() - self._trigger_told_s

    def start(self) -> None:
        self._trigger_told_s = time.monotonic()
        self._thread.start()

    def end(self) -> None:
        """End the thread. Raises TriggerError when the trigger holds it. Idempotent."""
        self._ending.set()
        if self._thread.ident is not None:
            self._thread.join(_JOIN_S)
        if self._thread.is_alive():
            raise TriggerError(
                f"the trigger has not returned from a wait of {_TAG_WAIT_S} s for {_JOIN_S:g} s"
            )

    def mark_unsealed(self) -> None:
        """Every process has ended: a recording that is not sealed now will not be."""
        self._going_on = False
        if self.began is not None and self.sealed is None and self.path is not None:
            why = self.fault or "its recorder did not end in time"
            self._orphans.append(Orphan(self.path, why, self._committed_lines))

    def begin(self, message: Begin) -> None:
        """Have the recorder begin; returns when it has. Raises what it refuses with."""
        with self._news:
            self.began = self.sealed = self._refused = self._begin = self._end_reason = self._cut_short = None
            self.resumption = Resumption()
            self._asked = message
            self._workers[RECORDER].post(message)
            self._news.wait_for(lambda: self.began or self._refused or self.fault, _ANSWER_S)
            self._asked = None
            if self.began is not None:
                self._begin, self.path = message, message.path
                return
            if self._refused is not None:
                raise self._refused.error
            if self.fault is None:
                self._end_reason = "cancelled"  # should it begin all the same
                self._workers[RECORDER].post(Cancel())
        if self.fault is None:
            raise DeviceError(
                f"start: the recorder has not begun within {_ANSWER_S:g} s: {self._excuse()}",
                possible="nothing was recorded",
                hint="start again once the disk answers",
            )
        raise DeviceError(f"start: {self.fault}")

    def end_recording(self, reason: str, line: int) -> None:
        """Have the recording end at ``line``; a recorder that is only starting will hear of it."""
        with self._news:
            self._end_reason = reason
            self._stay_ended()
        self._workers[RECORDER].post(End(reason, line))

    def extend(self, line: int) -> None:
        """Let the recording not end before ``line``, unless it is ending already."""
        with self._news:
            if self.began is not None and self.began.end_line is not None:
                self.began = replace(self.began, end_line=max(line, self.began.end_line))
                if self._cut_short is not None and self._begin is not None:
                    self._begin = replace(self._begin, end_line=self.began.end_line)
        self._workers[RECORDER].post(Extend(line))

    def happened(self, note: Note) -> None:
        """Tell the recorder, and whoever asks with `take_events`.

        A recorder that does not listen hears of the first of them only.
        """
        self._events.append(note)
        if self._workers[RECORDER].unsent < _MOST_EVENTS:
            self._workers[RECORDER].post(note)

    def take_events(self) -> list[Note]:
        """What happened since the last call; the latest, if it was too much."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def wait_sealed(self, deadline: float) -> bool:
        """Until the recording is closed, or cannot be any more, or the monotonic ``deadline``."""
        with self._news:
            self._news.wait_for(lambda: not self.recording, max(0.0, deadline - time.monotonic()))
            return not self.recording

    def _live(self) -> None:
        try:
            while not self._ending.is_set():
                self._turn()
        except Exception as error:  # noqa: BLE001 - the outermost boundary of the thread: a fault, told
            self._fail(f"supervisor: {type(error).__name__}: {error}")

    def _turn(self) -> None:
        begun = time.monotonic()
        tags = self._take_tags()
        self._ask_trigger(begun)
        for name, worker in self._workers.items():
            self._hear(name, worker)
            worker.flush()
        self._resume_when_due()
        if self.fault is None:
            self._watch(time.monotonic())
        if not tags:  # a trigger that does not wait by itself must not make this loop spin
            self._ending.wait(max(0.0, begun + _TAG_WAIT_S - time.monotonic()))

    def _take_tags(self) -> list[LineTag]:
        if self._trigger_lost:
            return []
        try:
            tags = self._trigger.tags(_TAG_WAIT_S)
        except Exception as error:  # noqa: BLE001 - told; a driver's defect must not cost the recording
            self._trigger_lost = True
            kind = "" if isinstance(error, AcquireError) else f"{type(error).__name__}: "
            self._fail(f"trigger: {kind}{error}")
            return []
        if tags:
            self._newest_pulse = tags[-1].line
            self._trigger_told_s = time.monotonic()
        for event in self._trigger.events():
            self.happened(Note(event.line, event.kind, f"tick {event.tick}"))
        rows = self._tags.shape.rows
        for at in range(0, len(tags), rows):
            self._pass_on(tags[at : at + rows])
        return tags

    def _ask_trigger(self, now_s: float) -> None:
        """Publish what the trigger counts; one that cannot answer fails when it is asked for tags."""
        if self._trigger_lost or now_s < self._ask_s:
            return
        self._ask_s = now_s + _ASK_EVERY_S
        with contextlib.suppress(AcquireError):
            counts = self._trigger.statistics()
            for name in TRIGGER_COUNTERS:
                self._counters[TRIGGER][name] = int(counts.get(name, 0))
            if "link_lost" not in counts:
                self._trigger_told_s = time.monotonic()

    def _pass_on(self, tags: list[LineTag]) -> None:
        """To the recorder; should it be too late to take them, later tags confirm the same lines."""
        slot = self._tags.claim()
        if slot is None:
            self._tags.drop(tags[0].line, len(tags))
            return
        slot.pixels[: len(tags)] = tag_rows(tags)
        self._tags.commit(0, len(tags))

    def _watch(self, now_s: float) -> None:
        """A silent arm is a fault; in a recording, the recorder judges it."""
        limit_s = self._plan.stall_timeout_s
        self._bear_with_successors()
        self._watch_recorder(now_s)
        self._watch_counts(now_s)
        if self.recording:
            for camera in self._cameras.values():
                camera.revive()
        silent_s = {arm: camera.update(now_s) for arm, camera in self._cameras.items()}
        if max(silent_s.values()) > limit_s:
            # Arms that fall silent together do so to within a block: half the limit tells both from one.
            arms = " and ".join(arm for arm in ARMS if silent_s[arm] > limit_s / 2)
            self._fail(f"arm {arms}: no line for {limit_s:g} s")

    def _watch_recorder(self, now_s: float) -> None:
        """One that hangs is replaced. A disk is waited for: the rings keep what comes meanwhile."""
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

    def _excuse(self) -> str:
        waits = self._counters[RECORDER]["disk_since_ns"] or self._counters[RECORDER]["store_since_ns"]
        return "it waits for the disk" if waits else f"no sign of life for {self.silent_s:.1f} s"

    @property
    def waits_for_disk(self) -> bool:
        """The recorder's loop does; not one that was stopped by a signal while it did."""
        return bool(self._counters[RECORDER]["disk_since_ns"]) and not self._workers[RECORDER].is_stopped

    def _bear_with_successors(self) -> None:
        for name in self._workers:
            if self._succession.is_late(name):
                self._fail(f"{self._workers[name].name}: its successor was not ready in time", name)
            elif self._succession.is_starting(name):
                self._loop.revive()
                for arm in self._arms_of.get(name, ()):
                    self._cameras[arm].revive()
                    self._counters[RECORDER].add(f"awaited_{arm}", 1)

    def _watch_counts(self, now_s: float) -> None:
        pulse = self._newest_pulse
        for arm, excess in self._excess.items() if pulse is not None else ():
            if line := excess.update(pulse or 0, now_s):
                self._fail(
                    f"arm {arm}: line {line} came with the trigger at line {pulse}: "
                    "the camera does not wait for it"
                )

    def _hear(self, name: str, worker: Worker) -> None:
        death = worker.death  # looked at before the messages: what a process said last counts
        if death and name == RECORDER and self._hung is not None:
            death = f"{death} after {self._hung.partition(': ')[2]}"
        while (message := worker.message()) is not None:
            self._note(name, message)
        if death and name not in self._dead:
            if name not in self._last_words and self._succeed(name, worker, death):
                return
            self._dead.add(name)
            if name == WATCHER:
                self._lose_watcher(self._last_words.get(name, death))
                return
            self._fail(f"{worker.name}: {self._last_words.get(name, death)}", name)

    def _lose_watcher(self, why: str) -> None:
        """Lines come and are recorded all the same; what it said last does not hold for them."""
        for arm in ARMS:
            self._counters[WATCHER][f"verdict_{arm}"] = 0
        self.happened(Note((self._newest_pulse or 0) + 1, "unwatched", f"watcher: {why}"))

    def _succeed(self, name: str, worker: Worker, death: str) -> bool:
        """Put another process in the place of one that was killed."""
        if self.fault is not None or self._ending.is_set():
            return False
        successor = self._succession.successor(name)
        if successor is None:
            return False
        self._workers[name] = successor
        worker.end(time.monotonic())
        self._hung = None
        for arm in self._arms_of.get(name, ()):
            self._cameras[arm].revive()
        self._loop.revive()
        if name == RECORDER and self._begin is not None and self.began is not None and self.sealed is None:
            successor.post(self._go_on(self._begin, self.began, death))
        elif name == RECORDER and self._asked is not None:
            self._orphans.append(Orphan(self._asked.path, f"its recorder was {death}"))
            self._note(name, Refused(DeviceError(f"start: the recorder was {death}", hint="start again")))
        newest = max(self._counters[arm]["next_line"] for arm in ARMS)
        self.happened(replacement_note(worker.name, death, max(newest, 0)))
        return True

    def _go_on(self, begin: Begin, began: Began, death: str) -> Begin:
        """With the recording of a recorder that was killed, beside it."""
        committed = self._committed_lines
        if self._going_on or self._cut_short is not None:  # and the counters may be neither's
            following, committed = once_more(begin), 0
        else:
            following = continuation(begin, began, committed, death)
        self._begin = following
        if following.path != begin.path:  # else it was killed before it had made anything
            why = f"its recorder was {death}; it goes on in {following.path.name}"
            self._orphans.append(Orphan(begin.path, why, committed))
        self._going_on, self.path = True, following.path
        return following

    def _note(self, name: str, message: object) -> None:
        with self._news:
            match message:
                case Ready():
                    self._succession.ready(name)
                case Began():
                    self.began, self._going_on, self._cut_short = message, False, None
                    self.resumption.began(time.monotonic())
                    self.path = self._begin.path if self._begin else self.path
                    if self._end_reason is not None:
                        self._workers[RECORDER].post(End(self._end_reason))
                case Refused(error):
                    self._take_refusal(name, message, error)
                case Sealed():
                    self._take_end(message)
                case Note():
                    self.happened(message)
                case Checked(first_line, _, text):
                    self.happened(Note(first_line, "code_check", text))
                case Failed(error):
                    # Those of a defect begin with the process's name already.
                    self._last_words[name] = str(error).removeprefix(f"{self._workers[name].name}: ")
            self._news.notify_all()

    def _take_refusal(self, name: str, refused: Refused, error: AcquireError) -> None:
        """Of a first recording, or of one that goes on after a disk's trouble or a recorder's death."""
        if self._cut_short is not None:
            self.resumption.ended(time.monotonic(), error.message)
        elif self._begin is None:
            self._refused = refused
        else:
            self._last_words[name] = f"the recording cannot go on: {error}"
            self.fault = self.fault or f"{self._workers[name].name}: {self._last_words[name]}"

    def _take_end(self, sealed: Sealed) -> None:
        self._note_kept()
        if not sealed.on_disk and self.path is not None:
            self._orphans.append(Orphan(self.path, sealed.end_reason, self._committed_lines))
        begin, began, is_over = self._begin, self.began, self._end_reason or self.fault
        following = None
        if self._plan.goes_on and sealed.end_line is not None and begin and began and not is_over:
            following = resumed(begin, began, sealed.end_line, sealed.end_reason)
        if following is None:
            self.sealed = sealed
            return
        self._begin, self._cut_short = following, sealed
        self.resumption.ended(time.monotonic(), sealed.end_reason)

    def _note_kept(self) -> None:
        if self.began is None:
            return
        first = self.began.first_line
        for arm, ranges in self._kept.items():
            ranges.append((first, first + self._counters[RECORDER][f"rows_{arm}"]))

    def _resume_when_due(self) -> None:
        """Have a recording that the disk ended go on in a further segment."""
        with self._news:
            if self._begin is None or not self.resumption.is_due(time.monotonic()):
                return
            self._begin = once_more(self._begin)
        self._workers[RECORDER].post(self._begin)

    def _stay_ended(self) -> None:
        """Nobody wants the further segment any more that has not begun yet."""
        if self._cut_short is not None:
            self.sealed, self._cut_short = self._cut_short, None
            self.resumption = Resumption()
            self._workers[RECORDER].post(Cancel())
            self._news.notify_all()

    def _fail(self, text: str, name: str | None = None) -> None:
        """Keep the first fault, and have the recording sealed if the recorder lives."""
        with self._news:
            self.fault = self.fault or text
            self._stay_ended()
            self._news.notify_all()
        self._workers[RECORDER].post(Interrupt(text, self._arms_of.get(name or "", ())))
