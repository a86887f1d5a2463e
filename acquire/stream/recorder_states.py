"""What the recorder may do next: a table of (state, event) → state.

::

               RUN              BEGIN             CREATED             LAST_LINE
      waiting ─────▶ discarding ─────▶ opening ─────────▶ recording ───────────▶ sealing
                      ▲  ▲  ▲ REFUSED │   │ CANCEL                                │
                      │  │  └─────────┘   ▼                                       │ SEALED
                      │  └─ REFUSED ── cancelled                                  │
                      └───────────────────────────────────────────────────────────┘

Lines are discarded until a recording can take them: in `recording` alone they are written.
"""

from __future__ import annotations

from enum import StrEnum

from acquire.errors import StateError


class RecorderState(StrEnum):
    """What the recorder is doing."""

    WAITING = "waiting"
    DISCARDING = "discarding"
    OPENING = "opening"
    CANCELLED = "cancelled"
    RECORDING = "recording"
    SEALING = "sealing"


STATES = tuple(RecorderState)
"""In shared memory a state is its place in here."""

MEANINGS = {
    RecorderState.WAITING: "the recorder has not heard yet that the run has started",
    RecorderState.DISCARDING: "nothing is being recorded",
    RecorderState.OPENING: "a recording is being created",
    RecorderState.CANCELLED: "a recording that was cancelled is being removed",
    RecorderState.RECORDING: "a recording is being written",
    RecorderState.SEALING: "a recording is being sealed",
}
"""For refusals and for the status."""

BUSY = frozenset(RecorderState) - {RecorderState.WAITING, RecorderState.DISCARDING}
"""The recorder lives on in these when its owner has gone."""


class RecorderEvent(StrEnum):
    """What can happen to the recorder: the owner's messages, and what follows from disk and lines."""

    RUN = "run"
    BEGIN = "start"
    CANCEL = "cancel"
    END = "stop"
    EXTEND = "extend"
    CREATED = "created"
    REFUSED = "refused"
    LAST_LINE = "last line"
    """Every line that the recording shall have is there, or a disk that failed takes no more."""
    SEALED = "sealed"


_S, _E = RecorderState, RecorderEvent
TABLE: dict[tuple[RecorderState, RecorderEvent], RecorderState] = {
    (_S.WAITING, _E.RUN): _S.DISCARDING,
    (_S.DISCARDING, _E.BEGIN): _S.OPENING,
    (_S.OPENING, _E.CREATED): _S.RECORDING,
    (_S.OPENING, _E.REFUSED): _S.DISCARDING,
    (_S.OPENING, _E.CANCEL): _S.CANCELLED,
    (_S.CANCELLED, _E.REFUSED): _S.DISCARDING,
    (_S.RECORDING, _E.CANCEL): _S.RECORDING,  # which ends as soon as what was taken is written
    (_S.RECORDING, _E.END): _S.RECORDING,
    (_S.RECORDING, _E.EXTEND): _S.RECORDING,
    (_S.RECORDING, _E.LAST_LINE): _S.SEALING,
    (_S.SEALING, _E.SEALED): _S.DISCARDING,
}


def after(state: RecorderState, event: RecorderEvent) -> RecorderState:
    """The state that ``event`` leads to; StateError where the table has no row for it."""
    try:
        return TABLE[state, event]
    except KeyError:
        hint = "again when that is over" if state in BUSY else ""
        raise StateError(f"{event}: {MEANINGS[state]}", hint=hint) from None
