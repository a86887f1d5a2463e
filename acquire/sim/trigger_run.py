"""What the model's device knows of its run."""

from __future__ import annotations

from dataclasses import dataclass

from acquire.trigger.registers import EndReason, State


@dataclass
class Run:
    """The armed, running or ended run."""

    number: int = 0
    state: State = State.IDLE
    reason: EndReason = EndReason.NONE
    start_tick: int = 0
    lines: int = 0
    """Lines that are told of in tags so far; at the end, all."""
    line_clocks: int = 1
    external: bool = False
    made: int = 0
    lost: int = 0
    gap: bool = False
    """Tags have been lost since the last one that was not."""
    peak: int = 0
    budget: int | None = None
    """Lines after which it ends in any case."""
    bark_tick: int | None = None
    """When the watchdog ends it, should nothing be heard of the host until then."""
    limit: int | None = None
    """Lines after which it ends: settled."""
