"""The process that empties both rings: while armed it discards, while recording it writes.

Its state machine is a table (`recorder_states`). Lines are also discarded while a recording is being created:
its first line is chosen when it can take lines. If it begins with past lines (`window`), these are taken back
from the rings at once, and wait there.
A block waits in its ring until a tag of the trigger confirms its lines, but no longer than ``tag_wait_s`` and
not once the ring is half full; then its lines are written flagged. A recording that cannot be written as fast
as lines come ends, sealed, while the rings still hold all of it (`stalls.Backlog`).

Creating and sealing a recording wait for the disk: a second thread does both, so that the rings are emptied
in the meantime. Counts are published in shared memory at every turn of the loop, so that nobody has to
request them; messages report only beginnings and ends.
"""

from __future__ import annotations

import select
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from acquire.errors import AcquireError, StateError, UsageError
from acquire.lines import ARMS
from acquire.processes.messages import Ready
from acquire.processes.rank import become_important
from acquire.processes.worker import OwnerGone
from acquire.store import RecordingWriter, RunCondition
from acquire.stream.external_counts import RECORDER, ExternalCounts
from acquire.stream.kept import Kept
from acquire.stream.losses import Cause
from acquire.stream.messages import Began, Begin, Cancel, End, Extend, Interrupt, Note, Refused, RunStarted
from acquire.stream.opening import Notes, Opening, is_verdict, not_created, prepare
from acquire.stream.recorder_states import BUSY, STATES, TABLE, RecorderEvent, RecorderState, after
from acquire.stream.session import OPEN_END, Session
from acquire.stream.stalls import HELD_UP_S, ArmView, Backlog, DiskWaits, HoldUps, find_stall
from acquire.stream.tagger import Tagger
from acquire.stream.window import hold, span

if TYPE_CHECKING:
    from acquire.processes.shared import Counters
    from acquire.processes.worker import Mailbox
    from acquire.stream.messages import Sealed
    from acquire.stream.recorder_plan import RecorderPlan
    from acquire.stream.ring import Ring, RingBlock

# Doorbells end the wait as soon as lines come. The limit is for events without one: a due commit, silence.
_WAIT_S = 0.02
# The time that `kill -9` may cost, besides the chunks that are not complete yet.
_COMMIT_INTERVAL_S = 0.1
_COMMIT_SHARE = 4
"""Commits take at most this fraction (1/4) of the time, however slow the disk."""
# A recorder that lags behind must still commit, and read its messages.
_BLOCKS_PER_TURN = 8
_CALM_BLOCKS = 2
"""With more blocks waiting, the disk writes while the next blocks are prepared: two processors, not one."""
_LONGEST_DRAIN_S = 0.05
"""Longest time that messages and commits wait for a drain."""
_CROSSING = {Cancel: RecorderEvent.CANCEL, Extend: RecorderEvent.EXTEND, End: RecorderEvent.END}
"""Commands that may be on their way when a recording ends: without a row in the table they are ignored."""


def record(
    mailbox: Mailbox,
    plan: RecorderPlan,
    rings: dict[str, Ring],
    tags: Ring,
    counters: dict[str, Counters],
) -> None:
    """Main function of the recorder: empty the rings and write recordings on request, until Quit.

    ``counters`` are its own and, see `ExternalCounts`, those of cameras, trigger and watcher.
    """
    if plan.realtime:
        become_important()  # not in real time: it computes, and must not keep the grabbers waiting
    with ThreadPoolExecutor(1, thread_name_prefix="store") as disk:
        recorder = Recorder(
            mailbox,
            plan,
            rings,
            tags=tags,
            counters=counters[RECORDER],
            disk=disk,
            external=ExternalCounts(counters),
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
        *,
        tags: Ring,
        counters: Counters,
        disk: ThreadPoolExecutor,
        external: ExternalCounts,
    ) -> None:
        self._mailbox = mailbox
        self._plan = plan
        self._arms = {name: ArmView(ring) for name, ring in rings.items()}
        self._tags = tags
        self._counters = counters
        self._disk = disk
        self._external = external
        # One recording at a time of each: created, written, sealed.
        self._state = RecorderState.WAITING
        self._opening: Opening | None = None
        self._session: Session | None = None
        self._closing: tuple[Session, Future[Sealed]] | None = None
        self._tagger: Tagger | None = None
        self._line_rate_hz = 0.0
        self._notes = Notes()
        self._disk_waits = DiskWaits(counters)
        self._hold_ups = HoldUps()
        self._waited_in_vain_for = -1  # the tags' end at which the latest block waited too long
        self._interruption: tuple[str, dict[str, Cause]] | None = None
        self._cut_short = False  # by a disk that was too slow: a further segment may follow
        self._next_commit_s = 0.0
        self._has_owner, self._busy = True, False
        shape = rings[ARMS[0]].shape
        self._blank = np.zeros((shape.rows, shape.width), shape.dtype)
        self._doorbells = select.poll()
        sources: list[Mailbox | Ring] = [mailbox, tags, *rings.values()]
        for source in sources:
            self._doorbells.register(source, select.POLLIN | select.POLLHUP)

    def turn(self) -> bool:
        """Do one round over messages, disk, tags and rings; return False once there is nothing left to do."""
        self._counters.add("turns", 1)
        try:
            # The order matters: lines must not keep commands waiting, and tags come before the lines that
            # they confirm, which would otherwise wait a turn for them.
            self._read_messages()
            self._check_disk()
            while (block := self._tags.acquire()) is not None:
                found = self._tagger.verify(block.pixels) if self._tagger else []
                self._tags.release()
                if self._session is not None:
                    self._session.mismatches(found)
            self._busy = self._drain()
            if self._session is not None:
                self._update(self._session)
        except (AcquireError, OSError) as error:
            if self._session is None:
                raise
            self._close(self._session, error)
        return self._has_owner or self._state in BUSY

    def wait(self) -> None:
        """Wait until something may have come, for `_WAIT_S` at most; not at all while there is work."""
        if self._busy:
            return
        self._doorbells.poll(_WAIT_S * 1000)
        # Before the next turn takes the blocks: a bell that is rung from now on ends the next wait.
        for ring in (self._tags, *(arm.ring for arm in self._arms.values())):
            ring.hush()

    # ---- messages

    def _read_messages(self) -> None:
        try:
            while self._has_owner and (message := self._mailbox.take()) is not None:
                event = _CROSSING.get(type(message))
                if event is None or (self._state, event) in TABLE:
                    self._handle(message)
        except OwnerGone as gone:
            self._has_owner = False
            self._doorbells.unregister(self._mailbox)
            self._interrupt(str(gone), dict.fromkeys(ARMS, Cause.INTERRUPTED))

    def _handle(self, message: object) -> None:
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
        """Have a recording created; lines are discarded until it can take them."""
        try:
            after(self._state, RecorderEvent.BEGIN)  # refuse before anything is touched
            lines = None
            if not begin.window.is_now:
                # Take lines back from the rings' history at once, before the cameras overwrite them.
                held = hold(begin.window, {name: arm.ring for name, arm in self._arms.items()})
                for name, blocks in held.taken.items():
                    for block in blocks:
                        self._count(name, block.start, block.stop, -1)
                lines = span(begin.window, begin.lines, held, self._line_rate_hz)
        except (StateError, UsageError) as error:
            self._mailbox.post(Refused(error))
            return
        # On a busy disk, directories, locks and reserved space can take seconds, during which the rings must
        # be emptied.
        writer = self._disk.submit(self._disk_waits.elsewhere, prepare, begin, self._plan.disk)
        self._opening = Opening(begin, lines, writer)
        self._go(RecorderEvent.BEGIN)

    def _count(self, name: str, first: int, end: int, sign: int = 1) -> None:
        """Count the lines of a block that leaves the ring; with ``sign`` -1, of one that was taken back."""
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
        """End the recording early, also one that is still being created."""
        before = self._interruption[1] if self._interruption else {}
        self._interruption = reason, lost | before  # the first cause of an arm's loss stays
        if self._session is not None:
            self._session.lost = lost | self._session.lost
            self._session.end(self._common_line(), reason, RunCondition.INTERRUPTED)

    def _newest_line(self) -> int:
        """Return the line up to which at least one arm has delivered."""
        return max(arm.ring.newest_line for arm in self._arms.values())

    def _common_line(self) -> int:
        """Return the line up to which both arms have delivered."""
        return min(arm.ring.newest_line for arm in self._arms.values())

    # ---- the disk's answers

    def _check_disk(self) -> None:
        opening = self._opening
        if opening is not None and opening.writer.done():
            at_once = opening.span is not None or self._state is RecorderState.CANCELLED
            at_once = at_once or opening.writer.exception() is not None
            # With a backlog, the rings might overflow as soon as the recording began.
            if at_once or all(2 * arm.ring.fill < arm.ring.shape.slots for arm in self._arms.values()):
                self._opening = None
                self._opened(opening)
        if self._closing is not None and self._closing[1].done():
            (session, sealed), self._closing = self._closing, None
            self._go(RecorderEvent.SEALED)
            self._publish(session)  # the books no longer contain lines that the disk did not keep
            for name, lines in session.surplus.items():
                self._forget(name, lines, session.end_line, "discarded")
            for name, lines in session.left_out.items():
                # Negative: a block that was taken in part had all its lines counted as discarded.
                self._forget(name, lines, session.end_line, "unsaved" if lines > 0 else "discarded")
            ended = sealed.result()
            if self._cut_short and ended.on_disk:
                ended = replace(ended, end_line=session.end_line)
            self._mailbox.post(ended)

    def _forget(self, name: str, lines: int, end_line: int, place: str) -> None:
        """Move ``lines`` taken for the recording, but not part of it, to the count ``place``.

        Lines of an earlier recording stay. Negative: the disk kept more than was counted.
        """
        kept = self._arms[name].kept
        kept.end_at(end_line)
        if lines > 0:
            lines -= kept.count(end_line, end_line + lines)
        self._counters.add(f"stored_{name}", -lines)
        self._counters.add(f"{place}_{name}", lines)

    def _opened(self, opening: Opening) -> None:
        """Begin the recording, once it is created, at its span or at the newest line of both arms."""
        if opening.span is not None:
            first_line = opening.span.first_line
        else:
            # Also after lines that found a ring full: a recording must not begin with lines lost already.
            dropped_end = max(arm.ring.dropped_end for arm in self._arms.values())
            first_line = max(self._newest_line(), dropped_end)
        try:
            writer = opening.writer.result()
            with self._disk_waits.loop():
                if self._state is RecorderState.CANCELLED or opening.is_over(first_line):
                    writer.abandon()
                    past = f"line {first_line} is past the recording's end"
                    raise UsageError(f"start: {past}; nothing was recorded")
                writer.begin(first_line)
        except AcquireError as error:
            self._refuse(error)
            return
        except (OSError, ValueError, MemoryError) as error:
            self._refuse(not_created(error))
            return
        self._cut_short = False
        self._go(RecorderEvent.CREATED)
        self._session = self._new_session(writer, opening, first_line)
        for arm in self._arms.values():
            arm.revive(time.monotonic())
            arm.backlog = Backlog()
            arm.kept.begin(arm.ring.history_line)
        # Counters first: the receiver of Began must not find those of the recording before.
        self._publish(self._session)
        end_line = self._session.end_line
        self._mailbox.post(Began(first_line, None if end_line == OPEN_END else end_line, writer.mount))
        if self._interruption is not None:
            self._interrupt(*self._interruption)

    def _refuse(self, error: AcquireError) -> None:
        if self._state is not RecorderState.CANCELLED:  # then nobody waits for the answer
            self._mailbox.post(Refused(error))
        self._go(RecorderEvent.REFUSED)

    def _new_session(self, writer: RecordingWriter, opening: Opening, first_line: int) -> Session:
        assert self._tagger is not None
        session = Session(writer, self._tagger, self._blank, first_line, opening.lines_from(first_line))
        self._external.begin()
        session.others = self._external.state()
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
        # Blocks lent to the writer are in the rings: release them before the other thread gets the writer.
        for name, arm in self._arms.items():
            try:
                self._release(name, arm)
            except (AcquireError, OSError) as another:
                error = error or another
        self._session = None
        self._go(RecorderEvent.LAST_LINE)
        self._publish(session)
        self._closing = session, self._disk.submit(self._disk_waits.elsewhere, session.close, error)

    # ---- tags and lines

    def _drain(self) -> bool:
        """Take a limited number of blocks from the rings; return whether there were any.

        The arms take turns: in a hurry, one arm's block is prepared while the disk writes the other's.
        """
        until_s = time.monotonic() + _LONGEST_DRAIN_S
        for taken in range(_BLOCKS_PER_TURN):
            moved = [self._move(name, arm) for name, arm in self._arms.items()]
            if not any(moved):
                return taken > 0
            if time.monotonic() > until_s:
                break
        return True

    def _move(self, name: str, arm: ArmView) -> bool:
        """Release the arm's last block and take the next one; return False if none is ready."""
        self._release(name, arm)
        arm.watch(time.monotonic(), self._counters[f"awaited_{name}"])
        self._hold_ups.update()
        if self._opening is not None and self._opening.span is not None:
            return False  # the blocks taken back wait for the recording
        block = arm.ring.acquire()
        if block is None or not self._is_ready(arm.ring, block):
            return False
        arm.lent = range(block.first_line, block.end_line)
        if self._session is None:
            self._release(name, arm)
        else:
            self._take(name, arm, block, self._session)
        return True

    def _take(self, name: str, arm: ArmView, block: RingBlock, session: Session) -> None:
        """Write the block; if the disk is too slow, end the recording while the rings still hold all lines.

        Once a ring has overflowed, the recording ends before the first line that found no room: whatever held
        the recorder up, the recording has every line that it covers.
        """
        if (line := session.overrun(name, block)) is not None:
            self._cut_short = True
            full = f"the ring of arm {name} was full at line {line}"
            session.cut(line, f"too slow to write: {full}{self._held_up}")
        # Before the book goes past them: each line that found the ring full, and is a gap in a recording, is
        # counted once.
        for loss in block.losses:
            first = max(loss.first_line, session.books[name].next_line, self._counters[f"overrun_to_{name}"])
            end = min(loss.end_line, session.end_line)
            if loss.cause is Cause.RING_FULL and first < end:
                self._counters.add(f"overrun_{name}", end - first)
                self._counters[f"overrun_to_{name}"] = end
        with self._disk_waits.loop():
            written = session.take(name, block, hurry=arm.ring.fill > _CALM_BLOCKS)
        if written:
            end_line = session.books[name].next_line
            arm.kept.add(end_line - written, end_line)
        fill, slots = arm.ring.fill, arm.ring.shape.slots
        if arm.backlog.grows(fill, slots) and not session.ending:
            # Decided before the slot is released: nothing is lost until the ring overflows.
            self._cut_short = True
            waiting = f"{fill} of {slots} ring slots of arm {name} wait for disk or codec"
            reason = f"too slow to write: {waiting}{self._held_up}"
            session.end(self._common_line(), reason, RunCondition.INTERRUPTED)
        self._hold_ups.took(block.committed_ns / 1e9)

    def _release(self, name: str, arm: ArmView) -> None:
        """Release the arm's last block to its ring, once it is written."""
        lent, arm.lent = arm.lent, None
        if lent is None:
            return
        try:
            if self._session is not None:
                with self._disk_waits.loop():
                    self._session.writer.give_back(name)
        finally:
            self._count(name, lent.start, lent.stop)
            arm.ring.release()

    @property
    def _held_up(self) -> str:
        """The latest hold-up, in words for an end reason."""
        longest_s = self._hold_ups.longest_s
        return f", after {longest_s:.1f} s without an answer of the disk" if longest_s >= 1 else ""

    def _is_ready(self, ring: Ring, block: RingBlock) -> bool:
        """Return whether the block is confirmed, or need not wait any longer for its tag."""
        if self._session is None or self._tagger is None or block.end_line <= self._tagger.confirmed_end:
            return True
        # Once one block has waited in vain, those after it do not wait at all until a tag comes again.
        now_s = time.monotonic()
        over_s = max(self._hold_ups.over_s, self._external.tags_pass_since_s(now_s))
        waited_s = now_s - max(block.committed_ns / 1e9, over_s)
        is_pressing = 2 * ring.fill > ring.shape.slots and now_s > self._hold_ups.over_s + HELD_UP_S
        if waited_s > self._plan.tag_wait_s or is_pressing:
            self._waited_in_vain_for = self._tagger.confirmed_end
        overdue = self._waited_in_vain_for == self._tagger.confirmed_end
        return overdue or not self._has_owner

    # ---- the current recording

    def _update(self, session: Session) -> None:
        session.others = self._external.state()
        looked_s = time.monotonic()
        for name, arm in self._arms.items():
            # Once more: an arm whose lines came while the disk held up this loop is not silent.
            arm.watch(looked_s, self._counters[f"awaited_{name}"])
            if name in session.lost and not arm.ring.fill:
                session.give_up(name)
        if session.done:
            self._close(session)
            return
        limits = self._plan.stall_timeout_s, self._plan.max_skew_lines
        stall = find_stall(session, self._arms, looked_s, *limits)
        if stall is not None:
            session.lost.update(dict.fromkeys(stall.arms, Cause.STALLED))
            session.end(self._common_line(), stall.reason, stall.condition)
        begun = time.monotonic()
        if begun >= self._next_commit_s:
            with self._disk_waits.loop():
                session.commit()
            ended = time.monotonic()
            self._next_commit_s = ended + max(_COMMIT_INTERVAL_S, (_COMMIT_SHARE - 1) * (ended - begun))
        # After the commit: the lines published as committed must survive a kill.
        self._publish(session)

    def _publish(self, session: Session) -> None:
        counters = self._counters
        rows = {name: book.next_line - session.first_line for name, book in session.books.items()}
        counters["recorded"], counters["committed"] = min(rows.values()), session.writer.committed_lines
        counters["beyond_bytes"] = session.writer.beyond_bytes
        counters["draining"] = session.ending and not (self._cut_short and self._plan.continues)
        for name, book in session.books.items():
            counters[f"rows_{name}"] = rows[name]
            counters[f"missing_{name}"] = book.missing.total()
