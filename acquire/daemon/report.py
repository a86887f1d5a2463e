"""The capture path's counters in the form of the status, with rates."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING

from acquire.daemon.messages import ArmStatus, CheckStatus, LedgerStatus, RingStatus, TriggerStatus

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.stream import CaptureStatus

RATE_WINDOW_S = 5.0
"""Line rates are means over this time."""
LOOK_EVERY_S = 0.1
ANSWER_S = 5.0
"""A trigger that is silent for longer does not answer: it is queried every second."""


class Rates:
    """Lines per second of each arm over the last seconds, and the saturated share of them.

    Lines come in blocks: a rate is measured from one change of the count to another, so that neither the size
    of a block nor the moment of a reading makes two arms differ.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._looked_s = -LOOK_EVERY_S
        self._changes: dict[str, deque[tuple[float, int, int]]] = {}

    def update(self, seen: CaptureStatus) -> None:
        now_s = self._now_s()
        if now_s - self._looked_s < LOOK_EVERY_S:
            return
        self._looked_s = now_s
        for arm, counts in seen.lines.items():
            changes = self._changes.setdefault(arm, deque())
            if not changes or counts["delivered"] != changes[-1][1]:
                changes.append((now_s, counts["delivered"], counts.get("saturated", 0)))
            # One change from before the window stays, so that the rates cover all of it.
            while len(changes) > 2 and changes[1][0] <= now_s - RATE_WINDOW_S:
                changes.popleft()

    def of(self, arm: str) -> float:
        """Return the rate; 0 before the second change, and if nothing came for the length of the window."""
        changes = self._changes.get(arm)
        if changes is None or len(changes) < 2:
            return 0.0
        (first_s, first, _), (last_s, last, _) = changes[0], changes[-1]
        usual_s = (last_s - first_s) / (len(changes) - 1)
        quiet_s = self._looked_s - last_s
        if quiet_s >= RATE_WINDOW_S:
            return 0.0
        # An overdue change lowers the rate; one that is merely not due yet must not.
        over_s = last_s - first_s + (quiet_s if quiet_s > 2 * usual_s else 0.0)
        return (last - first) / over_s

    def saturated_part(self, arm: str) -> float:
        """Return the saturated share of the lines in the window, 0 to 1."""
        changes = self._changes.get(arm)
        if changes is None or len(changes) < 2:
            return 0.0
        (_, first, white), (_, last, whites) = changes[0], changes[-1]
        return min(1.0, (whites - white) / (last - first))


def seconds_since(monotonic_s: float) -> float:
    """Return the time since a `time.monotonic`, rounded to milliseconds."""
    return round(time.monotonic() - monotonic_s, 3)


def trigger_status(seen: CaptureStatus) -> TriggerStatus | None:
    """Return the status of the trigger."""
    if not seen.trigger:
        return None
    return TriggerStatus.model_validate({**seen.trigger, "answers": seen.trigger["silent_s"] < ANSWER_S})


def arm_statuses(seen: CaptureStatus, rates: Rates) -> dict[str, ArmStatus]:
    """Return the status of each arm."""
    return {
        arm: ArmStatus(
            delivered=counts["delivered"],
            preroll=counts["preroll"],
            discarded=counts["discarded"],
            # The ledger's losses include lines that never came, so its counts take precedence.
            lost={str(cause): lines for cause, lines in counts["lost"].items()}
            | (seen.accounts[arm].lost if arm in seen.accounts else {}),
            recorded=counts["recorded"],
            missing=counts["missing"],
            rate_hz=rates.of(arm),
            saturated=counts.get("saturated", 0),
            saturated_part=rates.saturated_part(arm),
            drift_ppb=counts.get("clock", {}).get("drift_ppb", 0),
            ring=RingStatus(**{k: n for k, n in seen.ring[arm].items() if k in RingStatus.model_fields}),
            ledger=LedgerStatus(**seen.accounts[arm].to_dict()) if arm in seen.accounts else None,
            check=CheckStatus(**counts["check"]) if counts.get("check") else None,
        )
        for arm, counts in seen.lines.items()
    }
