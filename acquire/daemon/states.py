"""The daemon's state machine: a table of (state, event) → state.

::

                ARM             START               STOP, FULL
       idle ──────────▶ armed ──────────▶ recording ──────────▶ draining
         ▲               │  ▲                 │                  │ │ │
         │               │  └──────── SEALED ─┼──────────────────┘ │ │
         ├── DISARM ─────┤                    │                    │ │
         ├── RELEASED ───┼────────────────────┼────────────────────┘ │
         │               │ FAULT              │ FAULT                │ FAULT
         │               ▼                    ▼                      │
         └── DISARM ── faulted ◀─────────────────────────────────────┘

ARM, START, MARK (while armed, recording or draining, without a change of state), STOP and DISARM are
commands. The others come from the capture path: FULL (the line budget is recorded, or the recording ended
early without a command), SEALED (the recording is closed, the instrument stays armed for the next), RELEASED
(it is closed, and the devices are released, by configuration or a signal) and FAULT. Transitions that are not
drawn are refused.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum

from acquire.errors import StateError


class State(StrEnum):
    """What the daemon is doing."""

    IDLE = "idle"
    """No device is in use."""
    ARMED = "armed"
    """The trigger runs, the cameras deliver; the rings hold the latest lines, older ones are discarded."""
    RECORDING = "recording"
    """Lines are written."""
    DRAINING = "draining"
    """The last line is known; lines on their way are written, then the recording is sealed."""
    FAULTED = "faulted"
    """A device or the capture path failed; the devices are released, the fault waits to be read."""


SEALED = frozenset({State.IDLE, State.ARMED})
"""States without a current recording."""


class Event(StrEnum):
    """Events of the state machine."""

    ARM = "arm"
    START = "start"
    MARK = "mark"
    STOP = "stop"
    DISARM = "disarm"
    FULL = "ended"
    SEALED = "sealed"
    RELEASED = "released"
    FAULT = "fault"


COMMANDS = (Event.ARM, Event.START, Event.MARK, Event.STOP, Event.DISARM)
"""Events that a user can cause."""

TABLE: dict[tuple[State, Event], State] = {
    (State.IDLE, Event.ARM): State.ARMED,
    (State.ARMED, Event.START): State.RECORDING,
    (State.ARMED, Event.MARK): State.ARMED,
    (State.ARMED, Event.DISARM): State.IDLE,
    (State.ARMED, Event.FAULT): State.FAULTED,
    (State.RECORDING, Event.MARK): State.RECORDING,
    (State.RECORDING, Event.STOP): State.DRAINING,
    (State.RECORDING, Event.FULL): State.DRAINING,
    (State.RECORDING, Event.FAULT): State.FAULTED,
    (State.DRAINING, Event.MARK): State.DRAINING,
    (State.DRAINING, Event.SEALED): State.ARMED,
    (State.DRAINING, Event.RELEASED): State.IDLE,
    (State.DRAINING, Event.FAULT): State.FAULTED,
    (State.FAULTED, Event.DISARM): State.IDLE,
}


def after(state: State, event: Event) -> State:
    """Return the state that ``event`` leads to. Raises StateError if the table has no row for it."""
    if (state, event) not in TABLE:
        raise refusal(f"cannot {event} while {state}", state)
    return TABLE[state, event]


def refusal(what: str, state: State, fault: str | None = None) -> StateError:
    """Return the error for something that ``state`` does not allow; it names the fault, if that is why."""
    if state is not State.FAULTED:
        return StateError(what, possible=possible(state))
    return StateError(
        f"{what}: {fault or 'the fault is not known'}",
        possible=possible(state),
        hint="acquire disarm clears the fault, and acquire devices shows any problem with a device",
    )


def commands(state: State) -> tuple[Event, ...]:
    """Return the commands that ``state`` allows."""
    return tuple(event for event in COMMANDS if (state, event) in TABLE)


def possible(state: State) -> str:
    """Return the commands that ``state`` allows, as text."""
    return ", ".join(commands(state))


@dataclass(slots=True)
class Situation:
    """The state, since when (UTC, and monotonic), the command in progress, and the fault to be read."""

    state: State = State.IDLE
    since: datetime = field(default_factory=lambda: datetime.now(UTC))
    since_s: float = field(default_factory=time.monotonic)
    busy: str | None = None
    fault: str | None = None

    def check(self, event: Event) -> None:
        """Raise StateError, with the fault if there is one, if the table has no row for ``event``."""
        if (self.state, event) not in TABLE:
            raise self.refusal(f"cannot {event} while {self.state}")

    def refusal(self, what: str) -> StateError:
        """Return the error for something that the state does not allow."""
        return refusal(what, self.state, self.fault)

    def go(self, event: Event) -> None:
        """Change to the state that ``event`` leads to. Raises StateError if the table has no row for it."""
        self.state = after(self.state, event)
        self.since, self.since_s = datetime.now(UTC), time.monotonic()
