"""Steps of a long command: printed on stderr as they end, and kept for its report."""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from acquire.cli.output import say
from acquire.cli.progress import stage_progress

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.evaluate.report import TimedStep


@dataclass
class StepJournal:
    """The steps of a command that began at ``when``."""

    stages: list[TimedStep] = field(default_factory=list)
    when: datetime = field(default_factory=lambda: datetime.now(UTC))

    @contextmanager
    def stage(self, name: str) -> Iterator[dict[str, str]]:
        """Time a step. The caller may set ``detail`` in the dictionary that it gets."""
        # Only now: it imports NumPy and SciPy, which a run that is refused does without.
        from acquire.evaluate.report import TimedStep

        note: dict[str, str] = {}
        started = time.perf_counter()
        with stage_progress(name):
            yield note
        seconds = time.perf_counter() - started
        # A step that fails does not come here: its command ends with an error and without a report.
        self.stages.append(TimedStep(name, seconds, note.get("detail", "")))
        detail = f"  {note['detail']}" if "detail" in note else ""
        say(f"{name:<34} {seconds:6.1f} s{detail}", err=True)
