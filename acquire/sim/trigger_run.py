"""The state of the trigger model's run."""

from __future__ import annotations

from dataclasses import dataclass

from acquire.trigger.registers import EndReason, State


@dataclass
class ArmedRun:
    """The armed, running or ended run."""

    number: int = 0
    state: State = State.IDLE
    reason: EndReason = EndReason.NONE
    start_tick: int = 0
    lines: int = 0
    """Lines accounted for so far; at the end, all."""
    line_clocks: int = 1
    external: bool = False
    made: int = 0
    lost: int = 0
    gap: bool = False
    """True if tags have been lost since the last one that was queued."""
    peak: int = 0
    budget: int | None = None
    """Lines after which the run ends in any case."""
    bark_tick: int | None = None
    """Time at which the watchdog ends the run, unless a request from the host comes first."""
    limit: int | None = None
    """Final number of lines of a run that is stopping."""
