"""Progress of long work: a bar on a terminal; in a pipe, a line every few seconds on stderr.

All commands use the same class. Work of less than two seconds prints nothing in a pipe. With ``--json`` each
line is a JSON object, ``{"progress": {…}}``. Nested work replaces the display of the work that contains it.
"""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Self

from acquire.cli.output import json_requested, note, note_json

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import TracebackType

FIRST_S, EVERY_S = 2.0, 5.0
"""Time until the first line in a pipe, and between two lines."""
ADVISE_S = 60.0
"""If the remaining time exceeds this, the quicker alternatives are printed, once."""
KNOWN_S = 4.0
"""Time for which the rate of work is not trusted for that advice, because work starts slowly."""


class ProgressDisplay:
    """Work in progress, from entering the ``with`` block to leaving it.

    ``what`` is a participle, such as "verifying run.zarr"; ``advice`` names quicker alternatives. The methods
    are called from one thread; another thread prints.
    """

    _shown: list[ProgressDisplay] = []  # noqa: RUF012  # one per process, like its stderr; the innermost is last

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
        """Report the amount done and the total amount."""
        with self._lock:
            self._done, self._total = done, total
            if self._first is None and done > 0:
                self._first = (time.monotonic(), done)
        left = self.left_s
        known = self._first is not None and time.monotonic() - self._first[0] > KNOWN_S
        if self._advice and known and left is not None and left > ADVISE_S:
            advice, self._advice = self._advice, ""
            if not json_requested():
                note(f"{self._what} will take about {span(left)}; quicker: {advice}")
        if self._bar is not None:
            self._bar.update(0, completed=done, total=total or None, amount=self.amount)

    def doing(self, what: str) -> None:
        """Change the description of the work. The amount is unknown from now on."""
        with self._lock:
            # The rate of what was done before says nothing of this.
            self._what, self._done, self._total, self._first = what, 0.0, 0.0, None
        if self._bar is not None:
            self._bar.update(0, description=what, completed=0, total=None, amount="")

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self._began_s

    @property
    def left_s(self) -> float | None:
        """Remaining time at the rate so far; None if the rate is unknown.

        The first piece of work may be delayed by compilation or a cold disk, so it is left out of the rate as
        soon as others are done.
        """
        if self._first is None or not 0 < self._done <= self._total:
            return None
        begun_s, before = self._first if self._done >= 2 * self._first[1] else (self._began_s, 0.0)
        return (time.monotonic() - begun_s) * (self._total - self._done) / (self._done - before)

    @property
    def amount(self) -> str:
        """Amount done and total: "12 of 40"."""
        if not self._total:
            return ""
        digits = 0 if self._done == int(self._done) else 1
        return f"{self._done:.{digits}f} of {self._total:.0f}"

    def __enter__(self) -> Self:
        # Two bars at a time would overwrite each other.
        if ProgressDisplay._shown:
            ProgressDisplay._shown[-1]._pause()
        ProgressDisplay._shown.append(self)
        self._resume()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pause()
        ProgressDisplay._shown.remove(self)
        if ProgressDisplay._shown:
            ProgressDisplay._shown[-1]._resume()

    def _resume(self) -> None:
        from rich.console import Console

        console = Console(stderr=True)
        if console.is_terminal:
            self._bar = _bar(console)
            self._bar.add_task(
                # without a total rich shows that something moves
                self._what,
                total=self._total or None,
                completed=self._done,
                amount=self.amount,
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
            # So that no line of it comes after the command's results.
            printer.join()

    def _print(self) -> None:
        if self._over.wait(max(0.0, FIRST_S - self.elapsed_s)):
            return
        while True:
            with self._lock:  # the other thread changes several of these at a time
                left = self.left_s
                if json_requested():
                    times = {
                        "elapsed_s": round(self.elapsed_s, 1),
                        "left_s": None if left is None else round(left, 1),
                    }
                    facts = {"what": self._what, "done": self._done, "total": self._total or None}
                    note_json({"progress": facts | times})
                else:
                    amount = f": {self.amount} ({self._done / self._total:.0%})" if self._total else ""
                    ahead = "" if left is None else f", about {span(left)} left"
                    note(f"{self._what}{amount}, {span(self.elapsed_s)}{ahead}")
            if self._over.wait(EVERY_S):
                return


def _bar(console: Any) -> Any:
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    return Bars(
        # a file's name may have brackets, which rich would take for a style
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.fields[amount]}", markup=False),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        # the bar is gone before the results are printed
        transient=True,
    )


def span(seconds: float) -> str:
    """Format a duration: 8 s, 2 min 30 s, 3 h 20 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


@contextmanager
def stage_progress(what: str, advice: str = "") -> Iterator[Callable[[float, float], None]]:
    """Show the progress of work that knows its amount: yield a callback that takes (done, total)."""
    with ProgressDisplay(what, advice) as progress:
        yield progress.advance


def waiting_printer() -> Callable[[str], None]:
    """Return a callback that prints what a command is waiting for, one line whenever that changes."""
    latest = ""

    def print_waiting(what: str) -> None:
        nonlocal latest
        if what != latest:
            latest = what
            if json_requested():
                note_json({"waiting": what})
            else:
                note(f"{what} …")

    return print_waiting


@contextmanager
def activity_progress(what: str = "working") -> Iterator[Callable[[str], None]]:
    """Show the progress of work of unknown amount: yield a callback that takes the current activity."""
    with ProgressDisplay(what) as progress:
        yield progress.doing
