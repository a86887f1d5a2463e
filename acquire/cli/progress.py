"""How far long work is: a bar on a terminal; in a pipe, a line every few seconds on stderr.

All commands use the same class. Work of less than two seconds says nothing in a pipe. With ``--json`` each
line is a JSON object, ``{"progress": {…}}``. Work within work is shown in place of what it is part of.
"""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Self

from acquire.cli.output import json_asked, note, note_json

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import TracebackType

FIRST_S, EVERY_S = 2.0, 5.0
"""In a pipe: until the first line, and from one to the next."""
ADVISE_S = 60.0
"""What takes longer than this from now on is said to do so, once, with what would be quicker."""
KNOWN_S = 4.0
"""For so long the rate of work is not trusted for advice: whatever starts is slow."""


class Progress:
    """Work under way, from entering the ``with`` block to leaving it.

    ``what`` is a participle, as "verifying run.zarr"; ``advice`` says what to choose where this takes too
    long. One thread calls; another one prints.
    """

    _shown: list[Progress] = []  # noqa: RUF012  # the innermost one is last; of the process, like its stderr

    def __init__(self, what: str, advice: str = "") -> None:
        self._what, self._advice = what, advice
        self._done, self._total = 0.0, 0.0
        self._began_s = time.monotonic()
        self._first: tuple[float, float] | None = None
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._printer: threading.Thread | None = None
        self._bar: Any = None

    def advance(self, done: float, total: float) -> None:
        """So much is done, of so much in all."""
        with self._lock:
            self._done, self._total = done, total
            if self._first is None and done > 0:
                self._first = (time.monotonic(), done)
        self._advise()
        if self._bar is not None:
            self._bar.update(0, completed=done, total=total or None, amount=self.amount)

    def doing(self, what: str) -> None:
        """The work is now this; how much of it there is, is not known."""
        with self._lock:
            self._what, self._done, self._total, self._first = what, 0.0, 0.0, None
        if self._bar is not None:
            self._bar.update(0, description=what, completed=0, total=None, amount="")

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self._began_s

    @property
    def left_s(self) -> float | None:
        """At the rate so far; None while that is not known. The first piece, which compiling or a cold disk
        may delay, is left out as soon as there are others.
        """
        if self._first is None or not 0 < self._done <= self._total:
            return None
        begun_s, before = self._first if self._done >= 2 * self._first[1] else (self._began_s, 0.0)
        return (time.monotonic() - begun_s) * (self._total - self._done) / (self._done - before)

    @property
    def amount(self) -> str:
        """What is done of how much: 12 of 40."""
        if not self._total:
            return ""
        digits = 0 if self._done == int(self._done) else 1
        return f"{self._done:.{digits}f} of {self._total:.0f}"

    def __enter__(self) -> Self:
        if Progress._shown:
            Progress._shown[-1]._pause()
        Progress._shown.append(self)
        self._resume()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pause()
        Progress._shown.remove(self)
        if Progress._shown:
            Progress._shown[-1]._resume()

    def _resume(self) -> None:
        from rich.console import Console

        console = Console(stderr=True)
        if console.is_terminal:
            self._bar = _bar(console)
            self._bar.add_task(
                self._what, total=self._total or None, completed=self._done, amount=self.amount
            )
            self._bar.start()
            return
        self._over.clear()
        self._printer = threading.Thread(target=self._print, name="acquire-progress", daemon=True)
        self._printer.start()

    def _pause(self) -> None:
        bar, self._bar = self._bar, None
        if bar is not None:
            bar.stop()
        printer, self._printer = self._printer, None
        if printer is not None:
            self._over.set()
            printer.join()

    def _print(self) -> None:
        if self._over.wait(max(0.0, FIRST_S - self.elapsed_s)):
            return
        while True:
            with self._lock:
                self._line()
            if self._over.wait(EVERY_S):
                return

    def _line(self) -> None:
        left = self.left_s
        if json_asked():
            facts = {"what": self._what, "done": self._done, "total": self._total or None}
            times = {
                "elapsed_s": round(self.elapsed_s, 1),
                "left_s": None if left is None else round(left, 1),
            }
            note_json({"progress": facts | times})
            return
        share = f" ({self._done / self._total:.0%})" if self._total else ""
        ahead = "" if left is None else f", about {span(left)} left"
        note(f"{self._what}{': ' if self.amount else ''}{self.amount}{share}, {span(self.elapsed_s)}{ahead}")

    def _advise(self) -> None:
        left = self.left_s
        known = self._first is not None and time.monotonic() - self._first[0] > KNOWN_S
        if self._advice and known and left is not None and left > ADVISE_S:
            advice, self._advice = self._advice, ""
            if not json_asked():
                note(f"{self._what} will take about {span(left)}; in less time: {advice}")


def _bar(console: Any) -> Any:
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    return Bars(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.fields[amount]}", markup=False),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
    )


def span(seconds: float) -> str:
    """A duration for people: 8 s, 2 min 30 s, 3 h 20 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


@contextmanager
def stage_progress(what: str, advice: str = "") -> Iterator[Callable[[float, float], None]]:
    """`Progress` of work that says how far it is: the function given takes (done, of how much)."""
    with Progress(what, advice) as progress:
        yield progress.advance


def teller() -> Callable[[str], None]:
    """Prints what a command is waiting for, a line whenever that changes, in a pipe as on a terminal."""
    latest = ""

    def tell(what: str) -> None:
        nonlocal latest
        if what != latest:
            latest = what
            if json_asked():
                note_json({"waiting": what})
            else:
                note(f"{what} …")

    return tell


@contextmanager
def told(what: str = "working") -> Iterator[Callable[[str], None]]:
    """`Progress` of work that says what it does: the function given takes the words."""
    with Progress(what) as progress:
        yield progress.doing
