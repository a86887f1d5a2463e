"""What happened, for those who want to be told: the latest, in order, each with a number.

::

    Service (device thread) ──tell, look──▶ News ──wake──▶ streams (event loop): each reads on from its number

Nobody is waited for, and nothing is kept per listener: who reads too slowly finds that what it has not read
is gone, and is told so. What must be kept for good lies in the recordings' own events.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections import deque
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, cast, get_args

from acquire.daemon.facts import Level, News, NewsKind
from acquire.daemon.health import disk_check
from acquire.daemon.states import State

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.daemon.messages import Status

MOST_KEPT = 2000
LOSSES_EVERY_S = 1.0
"""Between two news of lines lost for one cause: the first is told at once, later ones are summed."""
DISK_EVERY_S = 10.0
"""Between two news of how long the disk lasts."""


class NewsLog:
    """Any thread may call everything here."""

    def __init__(self, kept: int = MOST_KEPT, now_s: Callable[[], float] = time.monotonic) -> None:
        self.life = secrets.token_hex(4)
        """Of this log: numbers of another one mean nothing here."""
        self._lock = threading.Lock()
        self._kept: deque[News] = deque(maxlen=kept)
        self._count = 0
        self._state = State.IDLE
        self._changes = Changes(now_s)
        self._listeners: set[Callable[[], None]] = set()
        self.closed = False

    def tell(self, kind: str, text: str, state: State | None = None, **facts: Any) -> None:
        """Something happened; ``facts`` as `News` has them."""
        known = cast("NewsKind", kind if kind in get_args(NewsKind) else "event")
        with self._lock:
            self._state = state or self._state
            self._count += 1
            made = f"{self.life}-{self._count}"
            now = datetime.now(UTC)
            self._kept.append(News(id=made, time=now, kind=known, text=text, state=self._state, **facts))
        self.wake()

    def update(self, status: Status) -> None:
        """Tell what has changed since the last status."""
        for facts in self._changes.of(status):
            self.tell(**facts)

    def after(self, last_id: str | None) -> list[News]:
        """What came after the news ``last_id``, or all that is kept; first of all, if any of it is gone."""
        with self._lock:
            life, _, number = (last_id or "").partition("-")
            ours = life == self.life and number.isdecimal()
            seen = int(number) if ours else 0
            first = self._count - len(self._kept) + 1
            news = [one for k, one in enumerate(self._kept, first) if k > seen]
            if last_id is None or (ours and seen >= first - 1):
                return news
            # Who asks for what came after a news that is gone has to hear that something is missing.
            text = "the daemon was started anew: what happened before is in its log and in the recordings"
            if ours:
                text = f"{first - 1 - seen} news are not kept any more"
            made, now = f"{self.life}-{first - 1}", datetime.now(UTC)
            return [News(id=made, time=now, kind="missed", text=text, state=self._state), *news]

    @property
    def last_id(self) -> str:
        """Of the latest; with it, only what is still to come is heard."""
        return f"{self.life}-{self._count}"

    def listen(self, wake: Callable[[], None]) -> None:
        """Call ``wake``, which must not wait, when something has happened, until `forget`."""
        self._listeners.add(wake)

    def forget(self, wake: Callable[[], None]) -> None:
        self._listeners.discard(wake)

    def wake(self) -> None:
        """Have the listeners look."""
        for wake in tuple(self._listeners):  # one of another thread may come or go meanwhile
            wake()

    def close(self) -> None:
        """End the streams: nothing more will happen."""
        self.closed = True
        self.wake()


class Changes:
    """What two statuses, one after the other, tell of what happened between them."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._before: Status | None = None
        self._lost: dict[tuple[str, str], tuple[int, float]] = {}
        self._disk = ("unknown", -DISK_EVERY_S)

    def of(self, status: Status) -> list[dict[str, Any]]:
        """Facts for `NewsLog.tell`. The daemon's own state is told by whoever changes it."""
        before, self._before = self._before, status
        # Counts begin anew with a run: a difference to those of the run before means nothing.
        same_run = before is not None and before.run_id == status.run_id
        if not same_run:
            self._lost.clear()
        found = []
        for arm, facts in status.arms.items():
            for cause, lines in facts.lost.items():
                told, at_s = self._lost.get((arm, cause), (0, -LOSSES_EVERY_S))
                if lines <= told or self._now_s() - at_s < LOSSES_EVERY_S:
                    continue
                self._lost[arm, cause] = lines, self._now_s()
                text = f"arm {arm} lost {lines - told} lines: {cause.replace('_', ' ')}"
                found.append(_fact("loss", text, "error", arm=arm, lines=lines - told))
        if before is not None and same_run:
            found += _verdicts(before, status) + _segment(before, status)
        known = {one.text: one.times for one in before.troubles} if before else {}
        new = [one for one in status.troubles if one.times > known.get(one.text, 0)]
        troubles = [_fact("trouble", one.text, "error") for one in new]
        found += self._disk_level(status) + troubles
        return found + _waiting(before, status) + _recoveries(before, status) + _uploads(before, status)

    def _disk_level(self, status: Status) -> list[dict[str, Any]]:
        """The estimate jumps where a recording begins: it is not told too often."""
        check, (told, at_s) = disk_check(status.disk), self._disk
        if check.level in (told, "unknown") or self._now_s() - at_s < DISK_EVERY_S:
            return []
        self._disk = check.level, self._now_s()
        if told == "unknown" and check.level == "good":
            return []
        level: Level = {"good": "info", "warning": "warning"}.get(check.level, "error")  # type: ignore[assignment]
        return [_fact("disk", check.text, level)]


def _fact(kind: NewsKind, text: str, level: Level = "info", **more: Any) -> dict[str, Any]:
    return {"kind": kind, "text": text, "level": level, **more}


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


def _segment(before: Status, after: Status) -> list[dict[str, Any]]:
    """A recording that goes on in a further one."""
    old, new = before.recording, after.recording
    if old is None or new is None or old.path == new.path:
        return []
    return [_fact("segment", f"{old.path} goes on in {new.path}", "warning", path=new.path)]


def _waiting(before: Status | None, after: Status) -> list[dict[str, Any]]:
    """Its words change with every second: only beginning and end are told."""
    was, now = bool(before and before.waiting), after.waiting
    if now and not was:
        return [_fact("waiting", now, "warning")]
    return [_fact("waiting", "what was waited for has answered")] if was and not now else []


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
