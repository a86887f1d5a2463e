"""The capture path's counters as the status shows them, with rates."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING

from acquire.daemon.messages import ArmStatus, CheckStatus, LedgerStatus, RingStatus

if TYPE_CHECKING:
    from acquire.stream import CaptureStatus

RATE_WINDOW_S = 5.0
"""Cameras deliver blocks: over a few of them, arms that are equally fast seem to differ."""


class Rates:
    """Lines per second of each arm over the last seconds, from the count at each look."""

    def __init__(self) -> None:
        self._looks: deque[tuple[float, dict[str, int]]] = deque(maxlen=256)

    def look(self, delivered: dict[str, int]) -> None:
        now = time.monotonic()
        self._looks.append((now, delivered))
        while self._looks[0][0] < now - RATE_WINDOW_S and len(self._looks) > 2:
            self._looks.popleft()

    def of(self, arm: str) -> float:
        """0 before the second look."""
        if len(self._looks) < 2:
            return 0.0
        (t0, first), (t1, last) = self._looks[0], self._looks[-1]
        return (last[arm] - first[arm]) / (t1 - t0) if t1 > t0 else 0.0


def delivered_lines(seen: CaptureStatus) -> dict[str, int]:
    """Arm → lines that its camera delivered since it was armed."""
    return {arm: counts["delivered"] for arm, counts in seen.lines.items()}


def arm_statuses(seen: CaptureStatus, rates: Rates) -> dict[str, ArmStatus]:
    """What the status says of each arm."""
    return {
        arm: ArmStatus(
            delivered=counts["delivered"],
            preroll=counts["preroll"],
            discarded=counts["discarded"],
            lost={str(cause): lines for cause, lines in counts["lost"].items()},
            recorded=counts["recorded"],
            missing=counts["missing"],
            rate_hz=rates.of(arm),
            ring=_ring(seen.ring[arm]),
            ledger=LedgerStatus(**seen.accounts[arm].to_dict()) if arm in seen.accounts else None,
            check=CheckStatus(**counts["check"]) if counts.get("check") else None,
        )
        for arm, counts in seen.lines.items()
    }


def _ring(counts: dict[str, int]) -> RingStatus:
    return RingStatus(**{name: counts[name] for name in RingStatus.model_fields if name in counts})
