"""Log of the latest news, in order, each with a number, for clients that follow them.

::

    Service (device thread) ──add, update─▶ News ──wake──▶ streams (event loop): each reads on from its number

No listener is waited for, and nothing is kept per listener: one that reads too slowly is informed that it
missed news. Facts that must be kept permanently are in the recordings' own events.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections import deque
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, cast, get_args

from acquire.daemon.facts import Level, News, NewsKind
from acquire.daemon.health import disk_check, held_check
from acquire.daemon.states import State
from acquire.stream.lifecycle import MEANINGS, Stage
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.daemon.messages import Status

log = logging.getLogger("acquire.daemon")

MOST_KEPT = 2000
"""Number of latest news kept for clients that connect, or connect again."""
LOSSES_EVERY_S = 1.0
"""Time between two news of lines lost for one cause: the first is reported at once, later ones are summed."""
DISK_EVERY_S = 10.0
"""Time between two news of how long the disk lasts."""


class NewsLog:
    """All methods may be called from any thread."""

    def __init__(self, kept: int = MOST_KEPT, now_s: Callable[[], float] = time.monotonic) -> None:
        self.life = secrets.token_hex(4)
        """Identifies this log: numbers of another one mean nothing here."""
        self._lock = threading.Lock()
        self._kept: deque[News] = deque(maxlen=kept)
        self._count = 0
        self._state = State.IDLE
        self._changes = Changes(now_s)
        self._listeners: set[Callable[[], None]] = set()
        self.closed = False

    def add(self, kind: str, text: str, state: State | None = None, **facts: Any) -> None:
        """Add news; ``facts`` are further fields of `News`."""
        known = cast("NewsKind", kind if kind in get_args(NewsKind) else "event")
        with self._lock:
            self._state = state or self._state
            self._count += 1
            made = f"{self.life}-{self._count}"
            now = datetime.now(UTC)
            self._kept.append(News(id=made, time=now, kind=known, text=text, state=self._state, **facts))
        # Without the lock, which a listener that reads at once needs.
        self.wake()

    def update(self, status: Status) -> None:
        """Add news about the changes since the last status."""
        for facts in self._changes.of(status):
            self.add(**facts)

    def after(self, last_id: str | None) -> list[News]:
        """Return the news after ``last_id``, or all; preceded by a 'missed' if some are not kept any more."""
        with self._lock:
            life, _, number = (last_id or "").partition("-")
            ours = life == self.life and number.isdecimal()  # it comes from a client, and may be anything
            seen = int(number) if ours else 0
            first = self._count - len(self._kept) + 1
            news = [one for k, one in enumerate(self._kept, first) if k > seen]
            if last_id is None or (ours and seen >= first - 1):
                return news
            # A client that continues after news that are gone must learn that it missed some.
            text = "the daemon was restarted: earlier news are in its log and in the recordings"
            if ours:
                text = f"{counted(first - 1 - seen, 'earlier event', 'is')} not kept any more"
            made, now = f"{self.life}-{first - 1}", datetime.now(UTC)
            return [News(id=made, time=now, kind="missed", text=text, state=self._state), *news]

    @property
    def last_id(self) -> str:
        """ID of the latest news; after it, only future ones follow."""
        return f"{self.life}-{self._count}"

    def listen(self, wake: Callable[[], None]) -> None:
        """Call ``wake``, which must not wait, whenever there are news, until `forget`."""
        self._listeners.add(wake)

    def forget(self, wake: Callable[[], None]) -> None:
        self._listeners.discard(wake)

    def wake(self) -> None:
        """Wake the listeners."""
        for wake in tuple(self._listeners):  # another thread may add or remove one in the meantime
            wake()

    def close(self) -> None:
        """End the streams: no more news will come."""
        self.closed = True
        self.wake()


class Changes:
    """Derives news from the differences between consecutive statuses."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._before: Status | None = None
        self._lost: dict[tuple[str, str], tuple[int, float]] = {}
        self._disk = ("unknown", -DISK_EVERY_S)

    def of(self, status: Status) -> list[dict[str, Any]]:
        """Return facts for `NewsLog.add`. The service itself reports changes of its state."""
        before, self._before = self._before, status
        # Counts restart with every run: a difference to those of the run before means nothing.
        same_run = before is not None and before.run_id == status.run_id
        if not same_run:
            self._lost.clear()
        found = []
        for arm, facts in status.arms.items():
            for cause, lines in facts.lost.items():
                reported, at_s = self._lost.get((arm, cause), (0, -LOSSES_EVERY_S))
                if lines <= reported or self._now_s() - at_s < LOSSES_EVERY_S:
                    continue
                self._lost[arm, cause] = lines, self._now_s()
                text = f"arm {arm} lost {counted(lines - reported, 'line')}: {cause.replace('_', ' ')}"
                found.append(_fact("loss", text, "error", arm=arm, lines=lines - reported))
        if before is not None and same_run:
            found += _verdicts(before, status)
            was, now = before.recording, status.recording
            if was is not None and now is not None and was.path != now.path:
                found.append(
                    _fact("segment", f"{was.path} continues in {now.path}", "warning", path=now.path)
                )
        known = {one.text: one.times for one in before.troubles} if before else {}
        new = [one for one in status.troubles if one.times > known.get(one.text, 0)]
        troubles = [_fact("trouble", one.text, "error") for one in new]
        found += _directory(before, status) + self._disk_level(status) + _held(before, status) + troubles
        found += _waiting(before, status)
        return found + _recoveries(before, status) + _uploads(before, status)

    def _disk_level(self, status: Status) -> list[dict[str, Any]]:
        # Not too often: the estimate jumps when a recording begins.
        check, (reported, at_s) = disk_check(status.disk), self._disk
        if check.level in (reported, "unknown") or self._now_s() - at_s < DISK_EVERY_S:
            return []
        self._disk = check.level, self._now_s()
        if reported == "unknown" and check.level == "good":
            return []
        level: Level = {"good": "info", "warning": "warning"}.get(check.level, "error")  # type: ignore[assignment]
        return [_fact("disk", check.text, level)]


def _fact(kind: NewsKind, text: str, level: Level = "info", **more: Any) -> dict[str, Any]:
    return {"kind": kind, "text": text, "level": level, **more}


def _directory(before: Status | None, after: Status) -> list[dict[str, Any]]:
    """Report when the recordings' directory cannot be used any more, and when it can be used again."""
    was, now = before.disk_trouble if before else None, after.disk_trouble
    # Without what changes every second, such as for how long a disk has not answered.
    if bool(was) == bool(now):
        return []
    text = now or "recordings can begin in the configured directory again"
    log.log(logging.ERROR if now else logging.INFO, "%s", text)
    return [_fact("disk", text, "error" if now else "info")]


def _waiting(before: Status | None, after: Status) -> list[dict[str, Any]]:
    """Report when a wait begins and ends, and another reason why a recording does not continue."""
    was, now = (before.waiting if before else None) or "", after.waiting or ""
    if was and not now:
        log.warning("over: %s", was)
        return [_fact("waiting", "the wait is over")]
    # Not every change: the text of other waits changes every second.
    paused = MEANINGS[Stage.PAUSED]
    if not now or (was and (was == now or not now.startswith(paused) or not was.startswith(paused))):
        return []
    log.warning("%s", now)
    return [_fact("waiting", now, "warning")]


def _held(before: Status | None, after: Status) -> list[dict[str, Any]]:
    """Report when the lines held in a recording begin to exceed its limit."""
    was = before.recording if before else None
    known = was.beyond_bytes if was and after.recording and was.path == after.recording.path else 0
    if known or (check := held_check(after)) is None or check.level == "good":
        return []
    log.warning("%s", check.text)
    return [_fact("disk", check.text, "warning")]


def _verdicts(before: Status, after: Status) -> list[dict[str, Any]]:
    found = []
    for arm, facts in after.arms.items():
        old, new = before.arms[arm].check if arm in before.arms else None, facts.check
        if new is None or (old is not None and (old.verdict, old.shift) == (new.verdict, new.shift)):
            continue
        verdict = new.verdict.replace("_", " ")
        if old is None and verdict == "unknown":
            continue
        shift = f" by {new.shift:+d} sub-steps" if new.shift else ""
        level: Level = "info" if verdict in ("verified", "unknown") else "error"
        text = f"arm {arm}: the light's code is {verdict}{shift}"
        found.append(_fact("verdict", text, level, arm=arm, line=new.checked_line))
    return found


def _recoveries(before: Status | None, after: Status) -> list[dict[str, Any]]:
    known = {one.path: one.state for one in before.recoveries} if before else {}
    return [
        _fact(
            "recovery",
            f"{one.path.name} {one.state}: {one.text}",
            "info" if one.state == "recovered" else "warning",
            path=one.path,
        )
        for one in after.recoveries
        if known.get(one.path) != one.state
    ]


def _uploads(before: Status | None, after: Status) -> list[dict[str, Any]]:
    known = {one.path: (one.state, one.error) for one in before.uploads} if before else {}
    return [
        _fact(
            "upload",
            f"{one.path.name} {one.state}" + (f": {one.error}" if one.error else ""),
            "warning" if one.error else "info",
            path=one.path,
        )
        for one in after.uploads
        if known.get(one.path) != (one.state, one.error)
    ]
