"""The log of the daemon and its processes: one line per entry, whatever it contains, at a limited rate.

A repeated entry, such as that of a connection that cannot be accepted, is written only a few times a minute;
once the minute is over, another entry states how many were suppressed. Entries about recordings, of which
each is another fact, are bounded less narrowly. The log can thus neither be forged nor fill the disk.

A thread of its own writes the entries: a stopped terminal or a pager that nobody scrolls accepts no text, and
the thread that drives the devices must not wait for that. Entries for which there is no room are counted.
"""

from __future__ import annotations

import json
import logging
import os
import queue
import re
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from acquire.text import counted, visible

if TYPE_CHECKING:
    from collections.abc import Callable

REPEATS = 10
"""Entries of one kind that are written within `WINDOW_S`."""
FACTS = 600
"""The same for entries with `EACH`."""
EACH = {"most": FACTS}
"""``extra`` of an entry that repeats none, whatever its form: a change of state, the end of a recovery."""
WINDOW_S = 60.0
MOST_KINDS = 256
"""Kinds of entries that are counted at a time."""
MOST_CHARACTERS = 4000
"""Upper limit on the length of an entry."""
MOST_TRACEBACK_LINES = 60
"""Number of last lines of a traceback: they name the error and where it arose."""
MOST_WAITING = 1000
"""Entries that wait to be written."""
FLUSH_S = 1.0
"""Time for the waiting entries at the end of the process."""

MOST_KEPT = 50
"""Latest entries that are kept, for who cannot read the log itself."""
MOST_KEPT_CHARACTERS = 500
"""Upper limit on the length of each."""
# None is ever logged, but whoever pastes the page's address into a mark gives away what is in it.
_SECRET = re.compile(r"(\btoken\b['\"]?\s*[=:]\s*['\"]?|\bbearer\s+)[\w.~+/-]+", re.IGNORECASE)

Kind = tuple[str, int, str]
"""Logger, level and message before its arguments are formatted."""


class OneLine(logging.Formatter):
    """Time, level and message on one line; the lines of a traceback are indented below it."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(message)s")

    def format(self, record: logging.LogRecord) -> str:
        text = f"{self.formatTime(record)} {record.levelname} {visible(record.getMessage())}"
        lines = [text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]}…"]
        if record.exc_info:
            traceback = self.formatException(record.exc_info).splitlines()
            lines += [f"  {visible(line)[:MOST_CHARACTERS]}" for line in traceback[-MOST_TRACEBACK_LINES:]]
        return "\n".join(lines)


class JsonLine(OneLine):
    """One JSON object per line, for programs."""

    def format(self, record: logging.LogRecord) -> str:
        facts: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "process": record.process,
            "message": visible(record.getMessage())[:MOST_CHARACTERS],
        }
        if record.exc_info:
            traceback = self.formatException(record.exc_info).splitlines()[-MOST_TRACEBACK_LINES:]
            facts["traceback"] = [visible(line)[:MOST_CHARACTERS] for line in traceback]
        return json.dumps(facts)


def is_journal(file: int) -> bool:
    """Whether a descriptor leads to systemd's journal, according to JOURNAL_STREAM."""
    try:
        found = os.fstat(file)
    except OSError:
        return False
    # The variable is inherited by programs whose output goes elsewhere, so it must name this very file.
    return os.environ.get("JOURNAL_STREAM") == f"{found.st_dev}:{found.st_ino}"


@dataclass(slots=True)
class _Count:
    began_s: float
    most: int
    text: str
    """Of the first entry."""
    seen: int = 0


@dataclass(frozen=True, slots=True)
class KeptEntry:
    """An entry of the log, with neither a traceback nor anything that looks like a token."""

    time: datetime
    level: str
    text: str

    @classmethod
    def of(cls, record: logging.LogRecord) -> KeptEntry:
        text = _SECRET.sub(r"\1…", visible(record.getMessage()))
        if record.exc_info and record.exc_info[0] is not None:
            text = f"{text} ({record.exc_info[0].__name__}, with a traceback)"
        if len(text) > MOST_KEPT_CHARACTERS:
            text = f"{text[:MOST_KEPT_CHARACTERS]}…"
        return cls(datetime.fromtimestamp(record.created, UTC), record.levelname.lower(), text)


class Bounded(logging.Filter):
    """Passes `REPEATS` (or `FACTS`) entries of a kind per `WINDOW_S`, then reports how many it suppressed."""

    def __init__(self, report: Callable[[str], None], now_s: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._report = report
        self._now_s = now_s
        self._counts: dict[Kind, _Count] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether to write the entry, and report what was suppressed in windows that are over."""
        now_s = self._now_s()
        for kind, count in list(self._counts.items()):
            if now_s - count.began_s < WINDOW_S and len(self._counts) < MOST_KINDS:
                break  # kinds are in the order in which their windows began
            del self._counts[kind]
            if count.seen > count.most:
                more = counted(count.seen - count.most, "more entry", "was")
                self._report(f"{more} not written, like this: {count.text}")
        kind = (record.name, record.levelno, str(record.msg)[:MOST_CHARACTERS])
        if kind not in self._counts:
            text = visible(record.getMessage())[:MOST_CHARACTERS]
            self._counts[kind] = _Count(now_s, getattr(record, "most", REPEATS), text)
        count = self._counts[kind]
        count.seen += 1
        return count.seen <= count.most


class Aside(logging.Handler):
    """Writes entries to a descriptor in a thread of its own, so that no other thread waits for its reader."""

    def __init__(self, file: int) -> None:
        super().__init__()
        self._file = file
        self._waiting: queue.SimpleQueue[str | threading.Event] = queue.SimpleQueue()
        self._lost = 0
        self._kept: deque[KeptEntry] = deque(maxlen=MOST_KEPT)
        # A daemon thread: it may be blocked for as long as nothing reads the log.
        threading.Thread(target=self._write, name="log", daemon=True).start()

    def emit(self, record: logging.LogRecord) -> None:
        """Hand the entry to the thread; if too many wait already, it is counted as lost."""
        self._kept.append(KeptEntry.of(record))
        if self._waiting.qsize() < MOST_WAITING:
            self._waiting.put(self.format(record))
        else:
            self._lost += 1

    @property
    def kept(self) -> list[KeptEntry]:
        """The latest entries, newest last, whether or not anything has accepted them."""
        return list(self._kept.copy())  # at once: another thread may append meanwhile

    def flush(self) -> None:
        """Wait until the entries so far are written, for at most `FLUSH_S`."""
        written = threading.Event()
        self._waiting.put(written)
        written.wait(FLUSH_S)

    def _write(self) -> None:
        failed = told = 0
        while True:
            entry = self._waiting.get()
            if isinstance(entry, str) and not self._is_accepted(entry):
                failed += 1
            # Reported where the gap is: entries that still wait are older than those that were lost.
            if (lost := self._lost + failed) > told and self._waiting.empty():
                entries = counted(lost - told, "entry", "was")
                report = _entry(f"{entries} not written: the log accepted no text then")
                if self._is_accepted(self.format(report)):
                    told = lost
            if isinstance(entry, threading.Event):
                entry.set()

    def _is_accepted(self, entry: str) -> bool:
        text = f"{entry}\n".encode(errors="backslashreplace")
        try:
            # Not sys.stderr: the interpreter could not end while a thread holds the lock of its buffer.
            while text:
                text = text[os.write(self._file, text) :]
        except OSError:
            return False
        return True


def write_log(level: int) -> None:
    """Log entries of at least ``level`` to stderr, from now on in this process.

    The entries are text for people, but JSON if stderr is systemd's journal, which stamps every entry itself.
    """
    stderr = sys.stderr.fileno()
    handler = Aside(stderr)
    handler.setFormatter(JsonLine() if is_journal(stderr) else OneLine())
    # `emit` bypasses the filter, which would otherwise count its own entries.
    handler.addFilter(Bounded(lambda text: handler.emit(_entry(text))))
    logging.basicConfig(level=level, handlers=[handler])


def latest_entries() -> list[KeptEntry]:
    """Return the latest entries of this process's log, newest last; none without `write_log`."""
    return [entry for one in logging.getLogger().handlers if isinstance(one, Aside) for entry in one.kept]


def _entry(text: str) -> logging.LogRecord:
    return logging.LogRecord(
        "acquire.daemon", logging.WARNING, __file__, lineno=0, msg=text, args=None, exc_info=None
    )
