"""Health of the daemon: one word, one sentence and the checks behind them, with all their thresholds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from acquire.daemon.facts import Health, HealthCheck
from acquire.daemon.states import State
from acquire.text import counted

if TYPE_CHECKING:
    from acquire.daemon.messages import ArmStatus, DiskStatus, Status

RING_GOOD, RING_BAD, RING_STOP = 0.25, 0.60, 0.95
"""Fill of a ring: good below the first, bad above the second; lines are lost from the third on."""
DISK_GOOD_S, DISK_BAD_S = 3600.0, 600.0
"""Time until the disk is full."""
SATURATED_GOOD, SATURATED_BAD = 0.001, 0.05
"""Shares of lines with a saturated pixel."""
RATE_TOLERANCE = 0.02
"""Relative deviation by which lines may come slower than configured."""
SETTLED_S = 6.0
"""Time after arming until rates are judged, since they are averaged over five seconds."""

CheckLevel = Literal["good", "unknown", "warning", "bad"]
# What is not known yet degrades nothing: a run begins with it.
_RANK = {"good": 0, "unknown": 0, "warning": 1, "bad": 2}


def health_of(status: Status, line_rate_hz: float, age_s: float = 0.0) -> Health:
    """Judge a status. ``line_rate_hz``: expected line rate; ``age_s``: time since arming."""
    # Without a run, the counts are those of the last one.
    lost = sum(sum(arm.lost.values()) for arm in status.arms.values()) if status.run_id else 0
    checks = [*_of_arms(status, line_rate_hz, age_s), *_of_service(status)]
    # The first of several equally bad ones is named: those of the arms come before those of the service.
    worst = max((check for check in checks), key=lambda check: _RANK[check.level])
    level: Literal["idle", "good", "degraded", "lost", "fault"]
    if status.state is State.FAULTED:
        level, sentence = "fault", f"Fault: {status.fault}"
    elif lost:
        level, sentence = "lost", f"{counted(lost, 'line', 'was')} lost since the instrument was armed."
    elif _RANK[worst.level]:
        level, sentence = "degraded", f"Nothing is lost; {worst.text}."
    elif status.state is State.IDLE:
        level, sentence = "idle", "Nothing is armed; all is well."
    else:
        level, sentence = "good", "All is well; nothing is lost."
    return Health(level=level, sentence=sentence, lost_lines=lost, checks=checks)


def _of_arms(status: Status, line_rate_hz: float, age_s: float) -> list[HealthCheck]:
    if status.run_id is None:
        return []
    found = []
    for name, arm in status.arms.items():
        found += [_ring(name, arm, status.state), _saturation(name, arm), _code(name, arm)]
        # A rate over five seconds is too low until these have passed.
        if age_s > SETTLED_S:
            slow = arm.rate_hz < line_rate_hz * (1 - RATE_TOLERANCE)
            found.append(
                HealthCheck(
                    name=f"rate {name}",
                    level="warning" if slow else "good",
                    text=f"arm {name} delivers {arm.rate_hz:.0f} lines/s of {line_rate_hz:.0f}",
                    value=round(arm.rate_hz, 1),
                    unit="1/s",
                    limit=f"good from {1 - RATE_TOLERANCE:.0%} of the configured rate on",
                )
            )
        if arm.ledger is not None and not arm.ledger.balanced:
            found.append(
                HealthCheck(name=f"ledger {name}", level="bad", text=f"ledger {name} does not balance")
            )
    return found


def _ring(name: str, arm: ArmStatus, state: State) -> HealthCheck:
    fill = arm.ring.fill / arm.ring.slots
    # While nothing is recorded blocks are released at once, and a moderate fill means nothing.
    busy = state in (State.RECORDING, State.DRAINING)
    level: CheckLevel = "bad" if fill > RING_BAD else "warning" if fill >= RING_GOOD and busy else "good"
    return HealthCheck(
        name=f"ring {name}",
        level=level,
        text=f"ring {name} is {fill:.0%} full",
        value=round(fill, 4),
        limit=f"good below {RING_GOOD:.0%}, bad above {RING_BAD:.0%}; lines are lost from {RING_STOP:.0%} on",
    )


def _saturation(name: str, arm: ArmStatus) -> HealthCheck:
    part = arm.saturated_part
    level: CheckLevel = "bad" if part > SATURATED_BAD else "warning" if part > SATURATED_GOOD else "good"
    return HealthCheck(
        name=f"saturation {name}",
        level=level,
        text=f"{part:.1%} of the lines of arm {name} are saturated",
        value=part,
        limit=f"good up to {SATURATED_GOOD:.1%} of the lines, bad above {SATURATED_BAD:.0%}",
    )


def _code(name: str, arm: ArmStatus) -> HealthCheck:
    check = arm.check
    if check is None or check.verdict == "unknown":
        why = "is not checked" if check is None else "has not been seen yet"
        return HealthCheck(name=f"code {name}", level="unknown", text=f"the code of arm {name} {why}")
    verdict = check.verdict.replace("_", " ") + (f" by {check.shift:+d} sub-steps" if check.shift else "")
    level: CheckLevel = "good" if check.verdict == "verified" else "bad"
    return HealthCheck(
        name=f"code {name}",
        level=level,
        text=f"the light's code in arm {name} is {verdict}",
        value=check.shift,
    )


def _of_service(status: Status) -> list[HealthCheck]:
    found = [disk_check(status.disk, status.disk_trouble)]
    if (held := held_check(status)) is not None:
        found.append(held)
    if status.trigger is not None:
        answers = status.trigger.answers
        text = (
            "the trigger answers"
            if answers
            else f"the trigger has been silent for {status.trigger.silent_s:.0f} s"
        )
        level: CheckLevel = "good" if answers else "bad"
        found.append(
            HealthCheck(name="trigger", level=level, text=text, value=status.trigger.silent_s, unit="s")
        )
    if status.waiting:
        found.append(HealthCheck(name="waiting", level="bad", text=status.waiting))
    if status.capacity is not None and status.capacity.warning:
        found.append(HealthCheck(name="capacity", level="warning", text=status.capacity.warning))
    failing = next((one for one in status.uploads if one.error), None)
    if failing is not None:
        text = f"{counted(status.uploads_left, 'recording', 'is')} not copied: {failing.error}"
        found.append(HealthCheck(name="uploads", level="warning", text=text, value=status.uploads_left))
    if status.troubles:
        found.append(HealthCheck(name="troubles", level="warning", text=status.troubles[-1].text))
    return found


def held_check(status: Status) -> HealthCheck | None:
    """Judge whether held lines exceed the limit of retention; None while nothing is recorded."""
    now = status.recording
    if now is None:
        return None
    text = "held lines exceed no limit"
    if now.beyond_bytes:
        size = f"{now.beyond_bytes / 1e6:.0f} MB" if now.beyond_bytes >= 1e6 else f"{now.beyond_bytes} B"
        text = f"{now.path.name} takes {size} more than recording.retention.max_gb allows: lines are held"
    return HealthCheck(
        name="held lines",
        level="warning" if now.beyond_bytes else "good",
        text=text,
        value=now.beyond_bytes,
        unit="B",
        limit="good up to recording.retention.max_gb",
    )


def disk_check(disk: DiskStatus | None, trouble: str | None = None) -> HealthCheck:
    """Judge how long the disk lasts; with ``trouble``, nothing can be recorded on it."""
    limit = f"good from {DISK_GOOD_S / 3600:.0f} h on, bad below {DISK_BAD_S / 60:.0f} min"
    if trouble is not None:
        return HealthCheck(name="disk", level="bad", text=trouble, limit=limit)
    if disk is None:
        return HealthCheck(name="disk", level="unknown", text="the disk has not answered yet", limit=limit)
    left_s = disk.seconds_to_full
    level: CheckLevel = "bad" if left_s < DISK_BAD_S else "warning" if left_s < DISK_GOOD_S else "good"
    shown = f"{left_s / 3600:.1f} h" if left_s >= 7200 else f"{left_s / 60:.0f} min"
    return HealthCheck(
        name="disk",
        level=level,
        text=f"the disk is full in {shown}",
        value=round(left_s),
        unit="s",
        limit=limit,
    )
