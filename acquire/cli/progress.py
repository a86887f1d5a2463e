"""Progress of long work on the terminal's stderr; silent where stderr is not a terminal."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


@contextmanager
def stage_progress(title: str) -> Iterator[Callable[[int, int], None]]:
    """A bar with the time left; the function given takes (done, of how many)."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        task = bars.add_task(title, total=None)

        def advance(done: int, total: int) -> None:
            bars.update(task, completed=done, total=total)

        yield advance


@contextmanager
def told() -> Iterator[Callable[[str], None]]:
    """A line that says what is being done; the function given takes the words."""
    from rich.console import Console

    with Console(stderr=True).status("") as status:
        yield status.update
