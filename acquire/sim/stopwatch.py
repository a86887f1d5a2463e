"""Measure the exclusive time of each stage of a pipeline, even though stages call one another."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from acquire.sim.light import Illumination

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.sim.effects.base import Stage


class Stopwatch:
    """Exclusive times by name: while a timed function runs, its caller's time is paused. For one thread."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._running: list[str] = []
        self._since = 0.0

    def timed(self, name: str, work: Callable[..., Any]) -> Callable[..., Any]:
        """Return the same function, timed under ``name``."""

        def timed_work(*arguments: Any) -> Any:
            self._switch(name)
            try:
                return work(*arguments)
            finally:
                self._switch(None)

        return timed_work

    def stage(self, stage: Stage) -> Stage:
        """Return the same stage, timed. For light the series are timed: setting them up costs nothing."""
        if stage.place != "light":
            return replace(stage, run=self.timed(stage.effect, stage.run))

        def run(light: Illumination) -> Illumination:
            changed: Illumination = stage.run(light)
            # a series calls those of the stages before it, whose time is theirs
            names = ("bits", "drives", "light")
            series = {name: self.timed(stage.effect, getattr(changed, name)) for name in names}
            return replace(changed, **series)

        return replace(stage, run=run)

    def _switch(self, name: str | None) -> None:
        """Charge the elapsed time to the running name; then run ``name``, or its caller again if None."""
        now = time.perf_counter()
        if self._running:
            self.seconds[self._running[-1]] += now - self._since
        self._since = now
        if name is None:
            self._running.pop()
        else:
            self._running.append(name)
