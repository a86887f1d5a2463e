"""One recording while it is written: every line of its range gets its row, from a ring or as missing.

A session depends neither on processes nor on time. It is given blocks, the line at which to end, and the arms
that will deliver no more, and keeps the books: per arm, rows = stored + missing by cause.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from acquire.errors import AcquireError
from acquire.lines import ARMS, LineBlock, LineFlag
from acquire.store import RunCondition
from acquire.store.suspect import DOUBTFUL
from acquire.stream.losses import Cause
from acquire.stream.messages import Sealed
from acquire.stream.tagger import UNCONFIRMED
from acquire.text import cause_in_words

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import TaggedBlock
    from acquire.stream.ring import RingBlock
    from acquire.stream.tagger import Tagger, TagMismatch

OPEN_END = 1 << 62
"""End line of a recording without a budget."""

TAINTING = (
    *("tags_wrong", "tags_repeated"),
    *("strobe_a_missed", "strobe_a_unexpected", "strobe_b_missed", "strobe_b_unexpected"),
)
"""Counts of the trigger that make lines doubtful: a camera that misses a pulse stays a line behind."""

TAINTING_EVENTS = (
    *("missed_trigger_a", "missed_trigger_b", "unexpected_strobe_a", "unexpected_strobe_b"),
    "clock_lost",
)
"""Events of the run so far that make lines doubtful."""

CODE_DOUBTS = frozenset(DOUBTFUL.values())
"""Events that make lines of the recording doubtful, possibly after these lines were written."""

# With a wrong code every tag is a mismatch, and a recording lists 4096 events in all.
MAX_MISMATCH_EVENTS = 100
_BEST_FIRST = (
    RunCondition.GOOD,
    RunCondition.TAINTED,
    RunCondition.INCOMPLETE,
    RunCondition.INTERRUPTED,
    RunCondition.ABORTED,
)


class Writer(Protocol):
    """The part of `acquire.store.RecordingWriter` that a session needs."""

    @property
    def committed_lines(self) -> int:
        """Lines of each arm that a reader finds, whatever happens to this process."""
        ...

    @property
    def nearly_full(self) -> str | None:
        """Why the recording should end before the disk is full, in words; None if it need not."""
        ...

    @property
    def beyond_bytes(self) -> int:
        """Bytes by which lines that are held exceed the limit of retention."""
        ...

    @property
    def events_not_listed(self) -> int:
        """Number of events that found no room in their table."""
        ...

    @property
    def packs(self) -> bool:
        """Whether lines are packed, in other threads: lent lines need not be copied."""
        ...

    def append(self, block: TaggedBlock, *, lent: bool = False) -> None:
        """Take the next lines of an arm; ``lent`` memory must stay as it is until `give_back`."""

    def give_back(self, arm: str) -> None:
        """Wait until the memory that was lent with the arm's last block may be reused."""

    def add_gap(self, arm: str, first_line: int, count: int, cause: str) -> None:
        """List ``count`` lines as lost, for the table of gaps of the next commit."""

    def add_event(self, kind: str, tick: int, line: int, text: str = "") -> None:
        """List an event at a line, and at the trigger's ``tick``, for the table of the next commit."""

    def commit(self) -> None:
        """Make all whole chunks of both arms visible to readers."""

    def rescue(self) -> int:
        """Return the rows that `seal` will keep, which after an error of the disk are those on it."""
        ...

    def seal(self, condition: RunCondition, end_reason: str, ledger: dict[str, Any]) -> None:
        """End the recording for good, with its condition and the ledger's account of every line."""

    def close(self) -> None:
        """Close all files; lines that are not committed are dropped. Idempotent."""


@dataclass(slots=True)
class Book:
    """One arm's account, in lines."""

    next_line: int
    stored: int = 0
    missing: Counter[Cause] = field(default_factory=Counter)
    unverified: int = 0
    doubted: int = 0
    incomplete: int = 0
    saturated: int = 0
    left_out: int = 0

    def store(self, flags: NDArray[np.uint16]) -> None:
        """Count rows that were stored, with their flags."""
        self.next_line += len(flags)
        self.stored += len(flags)
        if flags.any():
            self.unverified += int(np.count_nonzero(flags & UNCONFIRMED))
            self.incomplete += int(np.count_nonzero(flags & LineFlag.INCOMPLETE))
            self.saturated += int(np.count_nonzero(flags & LineFlag.SATURATED))

    def miss(self, count: int, cause: Cause) -> None:
        """Count the next rows as missing."""
        self.next_line += count
        self.missing[cause] += count

    def balances(self, lines: int) -> bool:
        """Return whether each of ``lines`` rows is either stored or missing."""
        return lines == self.stored + self.missing.total()

    def end_at(self, line: int, missed: Counter[Cause]) -> int:
        """Remove all rows from ``line`` on, ``missed`` of them missing; return the stored lines removed."""
        removed = self.next_line - line - missed.total()
        self.next_line = line
        self.missing -= missed
        self.stored -= removed
        return removed

    def to_attrs(self, lines: int) -> dict[str, Any]:
        """Return the account as JSON values, for a recording of ``lines`` rows."""
        return {
            "stored": self.stored,
            "missing": {str(cause): count for cause, count in self.missing.items()},
            "unverified": self.unverified,
            "doubted": self.doubted,
            "incomplete": self.incomplete,
            "saturated": self.saturated,
            **({"left_out": self.left_out} if self.left_out else {}),
            "balanced": self.balances(lines),
        }


@dataclass(frozen=True, slots=True)
class ExternalState:
    """Counts and findings of the others at one moment of a recording.

    Attributes
    ----------
    trigger : the trigger's counts during this recording
    cameras : arm → the camera's counts since it was armed
    doubted : arms whose lines contradict the code at the moment: their next lines are flagged
    verified : arm → the line up to which it is known to follow the light's code
    """

    trigger: dict[str, int] = field(default_factory=dict)
    cameras: dict[str, dict[str, int]] = field(default_factory=dict)
    doubted: frozenset[str] = frozenset()
    verified: dict[str, int] = field(default_factory=dict)


class Session:
    """See the module. Methods raise the writer's errors; only `close` can follow then.

    ``blank`` (line, pixel) is zeros: the rows of missing lines, written in pieces of this size.

    Attributes
    ----------
    writer : the recording's, which has the arms' last blocks until it has given them back
    lost : arm → why it will deliver no more
    others : what trigger, cameras and watcher have counted and found so far
    left_out : arm → lines that were taken, but that a failed disk did not keep; negative: lines that are on
        disk although they were not counted as taken
    surplus : arm → lines that were taken before the other arm's ring overflowed at an earlier line: not part
        of the recording
    bridges_to : lines up to this one that found their ring full are a gap, because there was no recorder;
        later ones end the recording
    """

    def __init__(
        self, writer: Writer, tagger: Tagger, blank: NDArray[Any], first_line: int, lines: int | None
    ) -> None:
        self.first_line = first_line
        self.end_line = OPEN_END if lines is None else first_line + lines
        self.end_reason = "line budget reached"
        self.books = {arm: Book(first_line) for arm in ARMS}
        self.lost: dict[str, Cause] = {}
        self.before = Cause.MIXED
        """Cause of missing lines before an arm's first block for which the block states none."""
        self.others = ExternalState()
        self.left_out: dict[str, int] = {}
        self.surplus: dict[str, int] = {}
        self.bridges_to = -1
        self.writer = writer
        self._tagger = tagger
        self._blank = blank
        self._floor = RunCondition.GOOD
        self._mismatches = 0
        self._doubts: Counter[str] = Counter()
        self._gaps: list[tuple[str, range, Cause]] = []
        """Gaps that are not committed yet."""
        self._end_known = False
        self._note("started", first_line, "")

    @property
    def done(self) -> bool:
        """Whether every row is written."""
        return all(self.reached(arm) for arm in ARMS)

    @property
    def ending(self) -> bool:
        """Whether the last line is known, or one arm has it already."""
        return self._end_known or any(self.reached(arm) for arm in ARMS)

    @property
    def skew(self) -> int:
        """Number of lines by which one arm is ahead of the other."""
        lines = [book.next_line for book in self.books.values()]
        return max(lines) - min(lines)

    def reached(self, arm: str) -> bool:
        """Return whether the arm has all its rows."""
        return self.books[arm].next_line >= self.end_line

    def take(self, arm: str, block: RingBlock, *, hurry: bool = False) -> int:
        """Write the block's losses, and its lines that are in range; return the number of these lines.

        In a ``hurry``, or if lines are packed, the block may still be on its way to the disk afterwards: it
        is lent to the writer until `Writer.give_back`.
        """
        book = self.books[arm]
        if block.end_line <= book.next_line:
            return 0
        for loss in block.losses:
            self._miss_until(arm, loss.end_line, loss.cause)
        unstated = Cause.MIXED if book.stored or book.missing else self.before
        self._miss_until(arm, block.first_line, unstated)
        if self.reached(arm):
            return 0
        tagged = self._tagger.tag(arm, block.part(book.next_line, self.end_line))
        if arm in self.others.doubted:
            tagged = replace(tagged, flags=tagged.flags | np.uint16(LineFlag.CODE_CONTRADICTED))
            book.doubted += len(tagged)
        # Packing takes longer than writing: it is done in parallel, while the other arm's lines are taken.
        self.writer.append(tagged, lent=hurry or self.writer.packs)
        book.store(tagged.flags)
        return len(tagged)

    def overrun(self, arm: str, block: RingBlock) -> int | None:
        """Return the first line before the block that is lost because the ring was full, or None."""
        start = self.books[arm].next_line
        for loss in block.losses:
            first = max(loss.first_line, start)
            is_lost = loss.cause is Cause.RING_FULL and loss.first_line > self.bridges_to
            if is_lost and first < min(loss.end_line, self.end_line):
                return first
        return None

    def cut(self, line: int, reason: str) -> None:
        """End before ``line``, which found its ring full, although the other arm may be past it."""
        if line >= self.end_line:
            return
        if self._floor is not RunCondition.INTERRUPTED:  # else the first reason stays
            self.end_reason = reason
            self._note("fault", line, reason)
        self.end_line = line
        self._end_known = True
        self._floor = _worse(self._floor, RunCondition.INTERRUPTED)

    def give_up(self, arm: str) -> None:
        """Fill the remaining rows of a lost arm."""
        self._miss_until(arm, self.end_line, self.lost[arm])

    def end(self, line: int, reason: str, condition: RunCondition = RunCondition.GOOD) -> None:
        """End before ``line``, or after the last row written; the condition is at best ``condition``."""
        # Both arms get every row up to the last: each must reach the rows that the other has written already.
        reach = max(book.next_line for book in self.books.values())
        last = min(self.end_line, max(reach, line))
        if last < self.end_line or _worse(self._floor, condition) is not self._floor:
            self.end_reason = reason
            self._note("stopped" if condition is RunCondition.GOOD else "fault", last, reason)
        self.end_line = last
        self._end_known = True
        self._floor = _worse(self._floor, condition)

    def extend(self, line: int) -> None:
        """Do not end before ``line``; too late once an arm has all its rows."""
        if not self.ending:
            self.end_line = max(self.end_line, line)

    def note(self, kind: str, line: int, text: str) -> None:
        """List an event of a line in range. Earlier ones are not listed, but may taint this recording."""
        if kind in TAINTING_EVENTS and line < self.end_line:
            self._doubts[kind] += 1
        if self.first_line <= line < self.end_line:
            if kind in CODE_DOUBTS:
                self._doubts[kind] += 1
            self._note(kind, line, text)

    def mismatches(self, found: list[TagMismatch]) -> None:
        """Note tags that contradict the line count; all are counted, the first ones are listed."""
        for mismatch in found[: max(0, MAX_MISMATCH_EVENTS - self._mismatches)]:
            self.writer.add_event("tag_mismatch", mismatch.tag.tick, mismatch.tag.line, str(mismatch))
        self._mismatches += len(found)

    def commit(self) -> None:
        """Make the written rows visible to readers; a disk that is nearly full ends the recording."""
        self.writer.commit()
        # Uncommitted gaps are kept for `close` after a write error, which removes rows that are not on disk
        # from the books.
        committed = self.first_line + self.writer.committed_lines
        self._gaps = [gap for gap in self._gaps if gap[1].stop > committed]
        if (reason := self.writer.nearly_full) is not None and not self._end_known:
            self.end(max(book.next_line for book in self.books.values()), reason, RunCondition.INTERRUPTED)

    def close(self, error: Exception | None = None) -> Sealed:
        """Seal the recording if the disk allows it; as aborted after a write ``error``, or if that fails."""
        if error is None:
            try:
                if self.done:
                    self.surplus = self._end_at(self.end_line - self.first_line)
                return self._seal(self._condition(), self.end_reason)
            except (AcquireError, OSError) as found:
                error = found
        reason = f"write error: {_words(error)}"
        try:
            self._leave_out(self.writer.rescue())
            return self._seal(RunCondition.ABORTED, reason)
        except (AcquireError, OSError) as second:
            self._leave_out(self.writer.committed_lines)
            self.writer.close()
            # A disk that is gone refuses both alike, and its words are those of one error.
            same = _cause(second) == _cause(error)
            reason += "; nor could it be sealed" if same else f"; not sealed: {_words(second)}"
            return Sealed(RunCondition.ABORTED, reason, self._ledger(), on_disk=False)

    def _leave_out(self, rows: int) -> None:
        """Remove rows that the disk did not take from the books; it took the first ``rows``."""
        for arm, lines in self._end_at(rows).items():
            self.left_out[arm] = self.left_out.get(arm, 0) + lines
            self.books[arm].left_out += lines

    def _end_at(self, rows: int) -> dict[str, int]:
        """Keep the first ``rows`` rows in the books; return, per arm, the stored lines removed from them."""
        self.end_line = self.first_line + rows
        removed = {}
        for arm, book in self.books.items():
            missed: Counter[Cause] = Counter()
            for of, lines, cause in self._gaps:
                if of == arm:
                    missed[cause] += max(0, lines.stop - max(lines.start, self.end_line))
            removed[arm] = book.end_at(self.end_line, +missed)  # +: drops causes that have no line left
        self._gaps = [(arm, lines, cause) for arm, lines, cause in self._gaps if lines.stop <= self.end_line]
        return removed

    def _seal(self, condition: RunCondition, reason: str) -> Sealed:
        ledger = self._ledger()
        self.writer.seal(condition, reason, ledger)
        return Sealed(condition, reason, ledger)

    def _miss_until(self, arm: str, line: int, cause: Cause) -> None:
        book = self.books[arm]
        count = min(line, self.end_line) - book.next_line
        if count <= 0:
            return
        self.writer.add_gap(arm, book.next_line, count, cause)
        self._gaps.append((arm, range(book.next_line, book.next_line + count), cause))
        # In pieces of one block: a gap may be many rings long, and blank rows take memory.
        while count:
            pixels = self._blank[:count]
            flags = np.full(len(pixels), LineFlag.MISSING, np.uint16)
            self.writer.append(self._tagger.tag(arm, LineBlock(book.next_line, pixels, flags)))
            book.miss(len(pixels), cause)
            count -= len(pixels)

    def _condition(self) -> RunCondition:
        books = self.books.values()
        lines = self.end_line - self.first_line
        # A recording without a line was interrupted before it held anything.
        found = RunCondition.GOOD if lines else RunCondition.INTERRUPTED
        if self._taints():
            found = _worse(found, RunCondition.TAINTED)
        if any(book.missing or not book.balances(lines) for book in books):
            found = _worse(found, RunCondition.INCOMPLETE)
        return _worse(found, self._floor)

    def _taints(self) -> dict[str, int]:
        """Return the reasons to doubt stored lines, each with its count."""
        reasons = {"tag_mismatches": self._mismatches, **self._doubts}
        for name in TAINTING:
            reasons[name] = self.others.trigger.get(name, 0)
        for arm, book in self.books.items():
            reasons |= {
                f"unconfirmed_{arm}": book.unverified,
                f"code_contradicted_{arm}": book.doubted,
                f"incomplete_{arm}": book.incomplete,
            }
        return {reason: count for reason, count in reasons.items() if count > 0}

    def _ledger(self) -> dict[str, Any]:
        # A recording that the disk ended may have had no end line yet.
        end = min(self.end_line, max(book.next_line for book in self.books.values()))
        lines, others = end - self.first_line, self.others
        arms = {arm: book.to_attrs(lines) for arm, book in self.books.items()}
        return {
            "pulses": lines,
            "tag_mismatches": self._mismatches,
            "trigger": others.trigger,
            "cameras": others.cameras,
            "tainted_by": self._taints(),
            **({"code_verified_to": others.verified} if others.verified else {}),
            **({"events_not_listed": more} if (more := self.writer.events_not_listed) else {}),
            **arms,
        }

    def _note(self, kind: str, line: int, text: str) -> None:
        self.writer.add_event(kind, int(self._tagger.table(line, 1).tick[0]), line, text)


def _words(error: Exception) -> str:
    """Return the error without its advice, which is out of date by the time somebody reads the recording."""
    return error.message if isinstance(error, AcquireError) else str(error)


def _cause(error: Exception) -> str:
    """Return what the disk said, whatever was being done."""
    cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
    return cause_in_words(cause)


def _worse(one: RunCondition, other: RunCondition) -> RunCondition:
    return max(one, other, key=_BEST_FIRST.index)
