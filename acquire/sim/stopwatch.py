"""How long each stage of a pipeline works by itself, however the stages call one another."""

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
    """Exclusive times by name: while a timed function runs, its caller's time stands still. One thread."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._running: list[str] = []
        self._since = 0.0

    def timed(self, name: str, work: Callable[..., Any]) -> Callable[..., Any]:
        """The same function, on the watch."""

        def watched(*given: Any) -> Any:
            self._turn(name)
            try:
                return work(*given)
            finally:
                self._turn(None)

        return watched

    def stage(self, stage: Stage) -> Stage:
        """The same stage, on the watch: of light it is the series that take time, not their making."""
        if stage.place != "light":
            return replace(stage, run=self.timed(stage.effect, stage.run))

        def run(light: Illumination) -> Illumination:
            changed: Illumination = stage.run(light)
            names = ("bits", "drives", "light")
            series = {name: self.timed(stage.effect, getattr(changed, name)) for name in names}
            return replace(changed, **series)

        return replace(stage, run=run)

    def _turn(self, name: str | None) -> None:
        """Charge what has passed to whoever ran; then ``name`` runs, or None: whoever ran before."""
        now = time.perf_counter()
        if self._running:
            self.seconds[self._running[-1]] += now - self._since
        self._since = now
        if name is None:
            self._running.pop()
        else:
            self._running.append(name)
