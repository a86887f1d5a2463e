"""The recorder's state machine: a table of (state, event) → state.

::

               RUN              BEGIN             CREATED             LAST_LINE
      waiting ─────▶ discarding ─────▶ opening ─────────▶ recording ───────────▶ sealing
                      ▲  ▲  ▲ REFUSED │   │ CANCEL                                │
                      │  │  └─────────┘   ▼                                       │ SEALED
                      │  └─ REFUSED ── cancelled                                  │
                      └───────────────────────────────────────────────────────────┘

Lines are discarded until a recording can take them: they are written in `recording` only.
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
"""In shared memory a state is its index in this tuple."""

MEANINGS = {
    RecorderState.WAITING: "the recorder has not received the start of the run yet",
    RecorderState.DISCARDING: "nothing is being recorded",
    RecorderState.OPENING: "a recording is being created",
    RecorderState.CANCELLED: "a recording that was cancelled is being removed",
    RecorderState.RECORDING: "a recording is being written",
    RecorderState.SEALING: "a recording is being sealed",
}
"""Texts for refusals and for the status."""

BUSY = frozenset(RecorderState) - {RecorderState.WAITING, RecorderState.DISCARDING}
"""States in which the recorder keeps running although its owner is gone."""


class RecorderEvent(StrEnum):
    """Events of the recorder: the owner's messages, and consequences of disk and lines."""

    RUN = "run"
    BEGIN = "start"
    CANCEL = "cancel"
    END = "stop"
    EXTEND = "extend"
    CREATED = "created"
    REFUSED = "refused"
    LAST_LINE = "last line"
    """Every line of the recording is there, or the disk failed and takes no more."""
    SEALED = "sealed"


_S, _E = RecorderState, RecorderEvent
TABLE: dict[tuple[RecorderState, RecorderEvent], RecorderState] = {
    (_S.WAITING, _E.RUN): _S.DISCARDING,
    (_S.DISCARDING, _E.BEGIN): _S.OPENING,
    (_S.OPENING, _E.CREATED): _S.RECORDING,
    (_S.OPENING, _E.REFUSED): _S.DISCARDING,
    (_S.OPENING, _E.CANCEL): _S.CANCELLED,
    (_S.CANCELLED, _E.REFUSED): _S.DISCARDING,
    (_S.RECORDING, _E.CANCEL): _S.RECORDING,  # it ends as soon as the lines taken are written
    (_S.RECORDING, _E.END): _S.RECORDING,
    (_S.RECORDING, _E.EXTEND): _S.RECORDING,
    (_S.RECORDING, _E.LAST_LINE): _S.SEALING,
    (_S.SEALING, _E.SEALED): _S.DISCARDING,
}


def after(state: RecorderState, event: RecorderEvent) -> RecorderState:
    """Return the state that ``event`` leads to. Raises StateError if the table has no row for it."""
    try:
        return TABLE[state, event]
    except KeyError:
        hint = "try again when that is over" if state in BUSY else ""
        raise StateError(f"{event}: {MEANINGS[state]}", hint=hint) from None
