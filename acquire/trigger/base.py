"""The protocol of a sync trigger.

At the pulse of line ``k`` the trigger is at code index ``S·k`` of its run: charge packet ``k`` enters the
first row. It is read out M + 1 pulses later, so a camera armed before the start first delivers M + 1 useless
lines (`Geometry.depth_lines`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from acquire.clock import ClockFit
    from acquire.codes import Code
    from acquire.config.device import TriggerConfig


@dataclass(frozen=True, slots=True)
class TriggerIdentity:
    """Identity of a trigger: model, serial number, firmware version, clock."""

    model: str
    serial: str
    firmware: str
    clock_hz: int


@dataclass(frozen=True, slots=True)
class Delays:
    """When light and camera lines start relative to a line's start, in ticks of the trigger's clock."""

    light_lead_ticks: int
    a_ticks: int
    b_ticks: int

    @classmethod
    def of(cls, config: TriggerConfig) -> Delays:
        """Return the delays of a rig."""
        return cls(config.light.lead_ticks, config.a.delay_ticks, config.b.delay_ticks)


@dataclass(frozen=True, slots=True)
class LightWindow:
    """When the light of a lit sub-step is on, in ticks from the sub-step's beginning."""

    open_ticks: int
    close_ticks: int

    @classmethod
    def of(cls, config: TriggerConfig) -> LightWindow:
        """Return the window of a rig."""
        light = config.light
        return cls(light.open_ticks, config.substep_ticks if light.close_ticks is None else light.close_ticks)


@dataclass(frozen=True, slots=True)
class TriggerRun:
    """Settings of one run; a trigger that does not support them refuses in `Trigger.prepare`."""

    run_id: str
    code: Code
    substeps: int
    """S, code bits per line."""
    substep_ticks: int
    """Duration of a sub-step in ticks of the trigger's clock."""
    tag_every_lines: int
    delays: Delays | None = None
    window: LightWindow | None = None
    """Delays and window instead of those in the trigger's configuration."""

    @property
    def line_period_ticks(self) -> int:
        """Time from one line to the next, in periods of the trigger's clock."""
        return self.substeps * self.substep_ticks


@dataclass(frozen=True, slots=True)
class LineTag:
    """The trigger's message about a line: at the pulse of ``line`` it was at ``code_index`` and ``tick``."""

    line: int
    code_index: int
    tick: int


WATCHDOG = "watchdog"
"""Kind of the event that ends a run: the host gave no sign of life for ``trigger.watchdog_s``."""


@dataclass(frozen=True, slots=True)
class TagEvent:
    """Event detected by the trigger during ``line``: ``input``, ``missed_trigger_a`` and so on."""

    line: int
    tick: int
    kind: str


class Trigger(Protocol):
    """One sync trigger. Calls are bounded in time and raise TriggerError."""

    def identify(self) -> TriggerIdentity:
        """Return model, serial number, firmware and clock rate, as the trigger states them."""
        ...

    def prepare(self, run: TriggerRun) -> None:
        """Load code and timing; raise TriggerError if they are not supported. The light stays off.

        While a run goes on, the same run again changes nothing, and another is refused.
        """
        ...

    def start(self) -> ClockFit:
        """Start pulses and code at line 0; return the fit of the trigger's clock to UTC at that moment."""
        ...

    def tags(self, timeout_s: float) -> list[LineTag]:
        """Return the tags since the last call, in order; wait at most ``timeout_s`` for the first.

        It is called by a thread of its own, whose wait `stop` ends.
        """
        ...

    def events(self) -> list[TagEvent]:
        """Return the events reported by the tags of all calls so far, each event once, in order."""
        ...

    def stop(self) -> int:
        """Stop after a whole line, light off; return the number of pulses issued. Idempotent."""
        ...

    def statistics(self) -> dict[str, Any]:
        """Return the counters of this trigger, at least ``pulses`` and ``tags``."""
        ...

    def close(self) -> None:
        """Stop and close the device. Idempotent."""
        ...
