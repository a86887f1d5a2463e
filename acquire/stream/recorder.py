"""The process that empties both rings: while armed it discards, while recording it writes.

What it may do next is a table (`recorder_states`). Lines are discarded while a recording is opened as well:
its first line is chosen when it can take lines. Unless it begins with what was before (`window`): that is
taken back from the rings at once, and waits there.
A block waits in its ring until a tag of the trigger confirms its lines, but not longer than ``tag_wait_s``
and not once the ring is half full; then its lines are written flagged. A recording that cannot be written as
fast as lines come ends, sealed, while the rings still hold all of it (`stalls.Backlog`).

Creating and sealing a recording wait for the disk: a second thread does them, so that the rings are emptied
meanwhile. What is counted is published in shared memory at every turn of the loop, so that nobody has to
ask; only beginnings and ends are told.
"""

from __future__ import annotations

import select
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from acquire.errors import AcquireError, StateError, StoreError, UsageError
from acquire.lines import ARMS
from acquire.processes.messages import Ready
from acquire.processes.worker import OwnerGone, become_important
from acquire.store import RecordingWriter, RunCondition
from acquire.stream.external_counts import ExternalCounts
from acquire.stream.kept import Kept
from acquire.stream.losses import Cause
from acquire.stream.messages import Began, Begin, Cancel, End, Extend, Interrupt, Note, Refused, RunStarted
from acquire.stream.opening import Notes, Opening, is_verdict
from acquire.stream.recorder_states import BUSY, STATES, TABLE, RecorderEvent, RecorderState, after
from acquire.stream.session import OPEN_END, Session
from acquire.stream.stalls import HELD_UP_S, Arm, Backlog, DiskWaits, HoldUps, Lent, find_stall
from acquire.stream.tagger import Tagger
from acquire.stream.window import hold, span

if TYPE_CHECKING:
    from acquire.processes.shared import Counters
    from acquire.processes.worker import Mailbox
    from acquire.stream.messages import Sealed
    from acquire.stream.recorder_plan import RecorderPlan
    from acquire.stream.ring import Ring, RingBlock

# Bells end the wait as soon as lines come. This is for what has none: a commit that is due, silence.
_WAIT_S = 0.02
# What `kill -9` may take, besides the chunks that are not whole yet.
_COMMIT_INTERVAL_S = 0.1
_COMMIT_SHARE = 4
"""Commits take at most one part in so many of the time, however slow the disk."""
# A recorder that lags behind must still commit, and hear that it is to end.
_BLOCKS_PER_TURN = 8
_CALM_BLOCKS = 2
"""Waiting in a ring. With more, the disk is kept busy while blocks are made ready: two processors for one."""
_LONGEST_DRAIN_S = 0.05
"""While messages and commits wait."""
_CROSSING = {Cancel: RecorderEvent.CANCEL, Extend: RecorderEvent.EXTEND, End: RecorderEvent.END}
"""Commands that may be on the way while a recording ends by itself: without a row they change nothing."""


def record(
    mailbox: Mailbox,
    plan: RecorderPlan,
    rings: dict[str, Ring],
    tags: Ring,
    counters: Counters,
    others: dict[str, Counters],
) -> None:
    """Life of the recorder: empty the rings, write recordings when told to, until told to end.

    ``others``: what ``trigger`` and ``watcher`` count, where there is one.
    """
    if plan.realtime:
        become_important()  # not in real time: it computes, and must not keep the grabbers waiting
    with ThreadPoolExecutor(1, thread_name_prefix="store") as disk:
        recorder = Recorder(
            mailbox, plan, rings, tags=tags, counters=counters, disk=disk, external=ExternalCounts(others)
        )
        mailbox.post(Ready())
        while recorder.turn():
            recorder.wait()


class Recorder:
    """See the module. `turn` does what can be done now and never waits."""

    def __init__(
        self,
        mailbox: Mailbox,
        plan: RecorderPlan,
        rings: dict[str, Ring],
        tags: Ring,
        counters: Counters,
        disk: ThreadPoolExecutor,
        external: ExternalCounts,
    ) -> None:
        self._mailbox = mailbox
        self._plan = plan
        self._arms = {name: Arm(ring) for name, ring in rings.items()}
        self._tags = tags
        self._counters = counters
        self._disk = disk
        self._external = external
        self._state = RecorderState.WAITING
        self._tagger: Tagger | None = None
        self._opening: Opening | None = None
        self._session: Session | None = None
        self._closing: tuple[Session, Future[Sealed]] | None = None
        self._notes = Notes()
        self._line_rate_hz = 0.0
        self._trouble: tuple[str, dict[str, Cause]] | None = None
        self._owner = True
        self._busy = False
        self._commit_s = 0.0
        self._waits = DiskWaits(counters)
        self._hold_ups = HoldUps()
        self._cut_short = False
        self._waited_in_vain_for = -1
        shape = rings[ARMS[0]].shape
        self._blank = np.zeros((shape.rows, shape.width), shape.dtype)
        self._waiting = select.poll()
        sources: list[Mailbox | Ring] = [mailbox, tags, *rings.values()]
        for source in sources:
            self._waiting.register(source, select.POLLIN | select.POLLHUP)

    def turn(self) -> bool:
        """One round over messages, disk, tags and rings; False when nothing is left to live for."""
        self._counters.add("turns", 1)
        try:
            # The order matters: commands are not kept waiting by lines, and tags come before the lines that
            # they confirm, which else would wait a turn for them.
            self._listen()
            self._look_at_disk()
            while (block := self._tags.acquire()) is not None:
                found = self._tagger.verify(block.pixels) if self._tagger else []
                self._tags.release()
                if self._session is not None:
                    self._session.mismatches(found)
            self._busy = self._drain()
            if self._session is not None:
                self._look_after(self._session)
        except (AcquireError, OSError) as error:
            if self._session is None:
                raise
            self._close(self._session, error)
        return self._owner or self._state in BUSY

    def wait(self) -> None:
        """Until something may have come, at most for a moment; not at all while there is work."""
        if self._busy:
            return
        self._waiting.poll(_WAIT_S * 1000)
        for ring in (self._tags, *(arm.ring for arm in self._arms.values())):
            ring.hush()

    # ---- messages

    def _listen(self) -> None:
        try:
            while self._owner and (message := self._mailbox.take()) is not None:
                event = _CROSSING.get(type(message))
                if event is None or (self._state, event) in TABLE:
                    self._obey(message)
        except OwnerGone as gone:
            self._owner = False
            self._waiting.unregister(self._mailbox)
            self._interrupt(str(gone), dict.fromkeys(ARMS, Cause.INTERRUPTED))

    def _obey(self, message: object) -> None:
        match message:
            case RunStarted(clock, kept):
                for name, arm in self._arms.items():
                    arm.kept = Kept(kept.get(name, ()))
                self._tagger = Tagger(self._plan.run, self._plan.stages, clock)
                self._line_rate_hz = clock.clock_hz / self._plan.run.line_period_ticks
                self._go(RecorderEvent.RUN)
            case Begin():
                self._begin(message)
            case Cancel() if self._opening is not None:
                self._opening = replace(self._opening, span=None)
                self._go(RecorderEvent.CANCEL)
            case Cancel() if self._session is not None:
                self._session.end(self._common_line(), "cancelled", RunCondition.INTERRUPTED)
            case Note():
                self._note(message)
            case Extend(line) if self._session is not None:
                self._session.extend(line)
            case End(reason, line) if self._session is not None:
                self._session.end(self._newest_line() if line is None else line, reason)
            case Interrupt(reason, lost, cause):
                self._interrupt(reason, dict.fromkeys(lost, cause))

    def _go(self, event: RecorderEvent) -> None:
        self._state = after(self._state, event)
        self._counters["state"] = STATES.index(self._state)

    def _begin(self, begin: Begin) -> None:
        """Lines go on being discarded until the recording can take them."""
        try:
            after(self._state, RecorderEvent.BEGIN)  # before anything is touched
            lines = None
            if not begin.window.is_now:
                # Taken back from the rings' history at once, before the cameras come round to it.
                held = hold(begin.window, {name: arm.ring for name, arm in self._arms.items()})
                for name, blocks in held.taken.items():
                    for block in blocks:
                        self._count(name, block.start, block.stop, -1)
                lines = span(begin.window, begin.lines, held, self._line_rate_hz)
        except (StateError, UsageError) as error:
            self._mailbox.post(Refused(error))
            return
        # Directories, locks and reserved space can take a busy disk seconds, in which the rings must be
        # emptied.
        writer = self._disk.submit(
            self._waits.elsewhere, RecordingWriter.prepare, begin.path, begin.spec, self._plan.disk
        )
        self._opening = Opening(begin, lines, writer)
        self._go(RecorderEvent.BEGIN)

    def _count(self, name: str, first: int, end: int, sign: int = 1) -> None:
        """Lines of a block that leaves the ring; with ``sign`` -1, of one that was taken back."""
        stored = self._arms[name].kept.count(first, end)
        self._counters.add(f"stored_{name}", sign * stored)
        self._counters.add(f"discarded_{name}", sign * (end - first - stored))

    def _note(self, note: Note) -> None:
        self._notes.add(note)
        if self._session is not None:
            if is_verdict(note, before=self._session.first_line):
                note = replace(note, line=self._session.first_line)
            self._session.note(note.kind, note.line, note.text)

    def _interrupt(self, reason: str, lost: dict[str, Cause]) -> None:
        """What is lost stays lost: a recording that is only being created will know."""
        before = self._trouble[1] if self._trouble else {}
        self._trouble = reason, lost | before  # the first cause of an arm's loss stays
        if self._session is not None:
            self._session.lost = lost | self._session.lost
            self._session.end(self._common_line(), reason, RunCondition.INTERRUPTED)

    def _newest_line(self) -> int:
        """The line before which everything has come, from one arm at least."""
        return max(arm.ring.newest_line for arm in self._arms.values())

    def _common_line(self) -> int:
        """The line up to which both arms have delivered."""
        return min(arm.ring.newest_line for arm in self._arms.values())

    # ---- the disk's answers

    def _look_at_disk(self) -> None:
        if self._opening is not None and self._opening.writer.done() and self._is_ready_for(self._opening):
            opening, self._opening = self._opening, None
            self._opened(opening)
        if self._closing is not None and self._closing[1].done():
            (session, sealed), self._closing = self._closing, None
            self._go(RecorderEvent.SEALED)
            self._publish(session)  # without what the disk did not keep
            for name, lines in session.surplus.items():
                self._forget(name, lines, session.end_line, "discarded")
            for name, lines in session.left_out.items():
                # Of a block that was taken in part, all lines are counted as discarded.
                self._forget(name, lines, session.end_line, "unsaved" if lines > 0 else "discarded")
            ended = sealed.result()
            if self._cut_short and ended.on_disk:
                ended = replace(ended, end_line=session.end_line)
            self._mailbox.post(ended)

    def _is_ready_for(self, opening: Opening) -> bool:
        """What waits goes first: a recording must not begin with rings that are about to overflow."""
        if opening.span is not None or self._state is RecorderState.CANCELLED:
            return True
        if opening.writer.exception() is not None:
            return True
        return all(2 * arm.ring.fill < arm.ring.shape.slots for arm in self._arms.values())

    def _forget(self, name: str, lines: int, end_line: int, place: str) -> None:
        """The recording ends before so many lines that were taken for it: they belong to ``place``, unless an
        earlier recording has them. Below 0: the disk kept more than was counted.
        """
        kept = self._arms[name].kept
        kept.end_at(end_line)
        if lines > 0:
            lines -= kept.count(end_line, end_line + lines)
        self._counters.add(f"stored_{name}", -lines)
        self._counters.add(f"{place}_{name}", lines)

    def _opened(self, opening: Opening) -> None:
        """From the newest line on: both arms have still to deliver what comes after it; or from the past."""
        if opening.span is not None:
            first_line = opening.span.first_line
        else:
            # Past what found a ring full, too: a recording must not begin with lines that are lost already.
            dropped_end = max(arm.ring.dropped_end for arm in self._arms.values())
            first_line = max(self._newest_line(), dropped_end)
        try:
            writer = opening.writer.result()
            with self._waits.loop():
                # Nobody wants it any more, or it would begin where it should have ended.
                if self._state is RecorderState.CANCELLED or opening.is_over(first_line):
                    writer.abandon()
                    past = f"line {first_line} is past the recording's end"
                    raise UsageError(f"start: {past}; nothing was recorded")
                writer.begin(first_line)
        except AcquireError as error:
            self._refuse(error)
            return
        except (OSError, ValueError, MemoryError) as error:
            self._refuse(StoreError(f"the recording cannot be created: {error!r}"))
            return
        self._cut_short = False
        self._go(RecorderEvent.CREATED)
        self._session = self._new_session(writer, opening, first_line)
        for arm in self._arms.values():
            arm.revive(time.monotonic())
            arm.backlog = Backlog()
            arm.kept.begin(arm.ring.history_line)
        # The counters first: whoever hears that it began must not find those of the recording before.
        self._publish(self._session)
        end_line = self._session.end_line
        self._mailbox.post(Began(first_line, None if end_line == OPEN_END else end_line))
        if self._trouble is not None:
            self._interrupt(*self._trouble)

    def _refuse(self, error: AcquireError) -> None:
        if self._state is not RecorderState.CANCELLED:  # else nobody waits for the answer
            self._mailbox.post(Refused(error))
        self._go(RecorderEvent.REFUSED)

    def _new_session(self, writer: RecordingWriter, opening: Opening, first_line: int) -> Session:
        assert self._tagger is not None
        session = Session(writer, self._tagger, self._blank, first_line, opening.lines_from(first_line))
        self._external.begin()
        session.doubted = self._external.doubted()
        window = opening.begin.window
        if window.padded:
            session.before = Cause.RECORDER_LOST
            session.bridges_to = self._newest_line()
        if window.kind:
            at = first_line if opening.span is None else opening.span.at
            self._notes.add(Note(at, window.kind, window.text))
        if doubt := self._external.doubt():
            self._notes.add(Note(first_line, "code_check", doubt))
        for note in self._notes.before_and_since(first_line):
            session.note(note.kind, note.line, note.text)
        return session

    def _close(self, session: Session, error: Exception | None = None) -> None:
        # Lent blocks lie in the rings: they are given back before another thread has the writer.
        for name, arm in self._arms.items():
            try:
                self._release(name, arm)
            except (AcquireError, OSError) as another:
                error = error or another
        self._session = None
        self._go(RecorderEvent.LAST_LINE)
        self._publish(session)
        self._closing = session, self._disk.submit(self._waits.elsewhere, session.close, error)

    # ---- tags and lines

    def _drain(self) -> bool:
        """Take what the rings have, some blocks at most; says whether there was any.

        The arms take turns: in a hurry, one's block is made ready while the disk writes the other's.
        """
        until_s = time.monotonic() + _LONGEST_DRAIN_S
        for taken in range(_BLOCKS_PER_TURN):
            moved = [self._move(name, arm) for name, arm in self._arms.items()]
            if not any(moved):
                return taken > 0
            if time.monotonic() > until_s:
                break
        return True

    def _move(self, name: str, arm: Arm) -> bool:
        """Release the arm's last block and take the next, if there is one that may go."""
        self._release(name, arm)
        arm.watch(time.monotonic(), self._counters[f"awaited_{name}"])
        self._hold_ups.update()
        if self._opening is not None and self._opening.span is not None:
            return False  # it waits for the recording
        block = arm.ring.acquire()
        if block is None or not self._may_go(arm.ring, block):
            return False
        arm.lent = Lent(block.first_line, block.end_line)
        if self._session is None:
            self._release(name, arm)
        else:
            self._take(name, arm, block, self._session)
        return True

    def _take(self, name: str, arm: Arm, block: RingBlock, session: Session) -> None:
        """Write the block; end while all lines are still there, should the disk be too slow for them.

        Once the ring has overflowed, before the first line that it had no room for: whatever held us up, the
        recording has every line that it covers.
        """
        assert arm.lent is not None
        if (line := session.overrun(name, block)) is not None:
            self._cut_short = True
            full = f"the ring of arm {name} was full at line {line}"
            session.cut(line, f"too slow to write: {full}{self._held_up}")
        self._count_overrun(name, block, session)  # before the book goes past the lines in question
        with self._waits.loop():
            written = session.take(name, block, hurry=arm.ring.fill > _CALM_BLOCKS)
        if written:
            end_line = session.books[name].next_line
            arm.kept.add(end_line - written, end_line)
        fill, slots = arm.ring.fill, arm.ring.shape.slots
        if arm.backlog.grows(fill, slots) and not session.ending:
            # Before the slot is released: nothing has been lost as long as the ring is not overtaken.
            self._cut_short = True
            waiting = f"{fill} of {slots} ring slots of arm {name} wait for disk or codec"
            reason = f"too slow to write: {waiting}{self._held_up}"
            session.end(self._common_line(), reason, RunCondition.INTERRUPTED)
        self._hold_ups.took(block.time_ns / 1e9)

    def _count_overrun(self, name: str, block: RingBlock, session: Session) -> None:
        """Lines that found the ring full are lost where a recording lists them; each once."""
        for loss in block.losses:
            first = max(loss.first_line, session.books[name].next_line, self._counters[f"overrun_to_{name}"])
            end = min(loss.end_line, session.end_line)
            if loss.cause is Cause.RING_FULL and first < end:
                self._counters.add(f"overrun_{name}", end - first)
                self._counters[f"overrun_to_{name}"] = end

    def _release(self, name: str, arm: Arm) -> None:
        """Give the arm's last block back to its ring, once it is written."""
        lent, arm.lent = arm.lent, None
        if lent is None:
            return
        try:
            if self._session is not None:
                with self._waits.loop():
                    self._session.give_back(name)
        finally:
            self._count(name, lent.first_line, lent.end_line)
            arm.ring.release()

    @property
    def _held_up(self) -> str:
        """For an end reason."""
        longest_s = self._hold_ups.longest_s
        return f", after {longest_s:.1f} s without an answer of the disk" if longest_s >= 1 else ""

    def _may_go(self, ring: Ring, block: RingBlock) -> bool:
        """Nothing is gained by letting the block wait any longer for its tag."""
        if self._session is None or self._tagger is None or block.end_line <= self._tagger.confirmed_end:
            return True
        # Once one block has waited in vain, those after it do not wait at all until a tag comes again.
        now_s = time.monotonic()
        waited_s = now_s - max(block.time_ns / 1e9, self._hold_ups.over_s)
        is_pressing = 2 * ring.fill > ring.shape.slots and now_s > self._hold_ups.over_s + HELD_UP_S
        if waited_s > self._plan.tag_wait_s or is_pressing:
            self._waited_in_vain_for = self._tagger.confirmed_end
        overdue = self._waited_in_vain_for == self._tagger.confirmed_end
        return overdue or not self._owner

    # ---- the recording under way

    def _look_after(self, session: Session) -> None:
        session.doubted = self._external.doubted()
        session.trigger, session.cameras = self._external.trigger(), self._external.cameras()
        session.verified = self._external.verified()
        for name, arm in self._arms.items():
            # Once more: what came while this was held up by the disk is no silence.
            arm.watch(time.monotonic(), self._counters[f"awaited_{name}"])
            if name in session.lost and not arm.ring.fill:
                session.give_up(name)
        if session.done:
            self._close(session)
            return
        stall = find_stall(session, self._arms, self._plan.stall_timeout_s, self._plan.max_skew_lines)
        if stall is not None:
            session.lost.update(dict.fromkeys(stall.arms, Cause.STALLED))
            session.end(self._common_line(), stall.reason, stall.condition)
        begun = time.monotonic()
        if begun >= self._commit_s:
            with self._waits.loop():
                session.commit()
            ended = time.monotonic()
            self._commit_s = ended + max(_COMMIT_INTERVAL_S, (_COMMIT_SHARE - 1) * (ended - begun))
        # After the commit: what is published as committed is what survives a kill.
        self._publish(session)

    def _publish(self, session: Session) -> None:
        counters = self._counters
        rows = {name: book.next_line - session.first_line for name, book in session.books.items()}
        counters["recorded"] = min(rows.values())
        counters["committed"] = session.committed_lines
        counters["draining"] = session.ending and not (self._cut_short and self._plan.goes_on)
        for name, book in session.books.items():
            counters[f"rows_{name}"] = rows[name]
            counters[f"missing_{name}"] = book.missing.total()
