"""Other parties' counts for a recording: the trigger's and cameras' counts, and the watcher's verdicts.

They are read from shared memory when they are needed; without a trigger to query, or without a watcher, there
is nothing to doubt.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.clock import NS_PER_S
from acquire.lines import ARMS
from acquire.stream.grabber import CAMERA_CAUSES
from acquire.stream.stalls import HELD_UP_S
from acquire.stream.watcher import VERDICTS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from acquire.processes.shared import Counters

RECORDER, TRIGGER, WATCHER = "recorder", "trigger", "watcher"
"""Keys of the counters, and of the workers; the grabbers have their arms' names."""
_LONGEST_HOLD_UP_S = 10.0
"""Time after which the thread that passes tags on counts as stuck in its trigger's driver."""

TRIGGER_COUNTERS = (
    *("pulses", "tags", "tags_missing", "tags_repeated", "tags_wrong", "tag_lost"),
    *("strobe_a_missed", "strobe_a_unexpected", "strobe_b_missed", "strobe_b_unexpected"),
)
"""The trigger's statistics that the ledger needs: pulses issued; tags received, missing, repeated, wrong, and
lost in the device; the cameras' strobes in answer to pulses, missed or unexpected."""

TAG_READER_COUNTERS = ("turned_ns", "held_up_to_ns")
"""By the monotonic clock: the latest turn of the owner's thread that passes tags on, and the end of its last
hold-up; 0: not yet."""

CAMERA_COUNTS = ("delivered", "preroll", "next_line", "reopened", *CAMERA_CAUSES)


class ExternalCounts:
    """See the module; ``others`` maps `TRIGGER`, `WATCHER` and the arms to their counters."""

    def __init__(self, others: Mapping[str, Counters]) -> None:
        self._trigger = others.get(TRIGGER)
        self._watcher = others.get(WATCHER)
        self._cameras = {arm: others[arm] for arm in ARMS if arm in others}
        self._begun: dict[str, int] = {}

    def begin(self) -> None:
        """Begin a recording: the trigger's earlier counts do not belong to it."""
        self._begun = self._counts()

    def trigger(self) -> dict[str, int]:
        """Return the trigger's counts since `begin`; of strobes, since arm: a camera behind stays behind."""
        return {
            name: count if name.startswith("strobe") else count - self._begun.get(name, 0)
            for name, count in self._counts().items()
        }

    def cameras(self) -> dict[str, dict[str, int]]:
        """Return, per arm, the lines that its camera delivered and lost since it was armed.

        A block that is just being taken counts as ``delivered`` already, while ``next_line`` is still its
        first line.
        """
        return {
            arm: {str(name): counted[name] for name in CAMERA_COUNTS if counted[name]}
            for arm, counted in self._cameras.items()
        }

    def tags_pass_since_s(self, now_s: float) -> float:
        """Return the monotonic time since which tags are passed on without a hold-up; ``now_s`` in one."""
        if self._trigger is None or not self._trigger["turned_ns"]:
            return 0.0
        still_s = now_s - self._trigger["turned_ns"] / NS_PER_S
        # One that is held up will catch up; one that is stuck is a fault of the trigger, reported elsewhere.
        is_held_up = HELD_UP_S < still_s < _LONGEST_HOLD_UP_S
        return now_s if is_held_up else self._trigger["held_up_to_ns"] / NS_PER_S

    def doubted(self) -> set[str]:
        """Return the arms whose lines contradict the code."""
        watcher = self._watcher
        if watcher is None:
            return set()
        return {arm for arm in ARMS if VERDICTS[watcher[f"verdict_{arm}"]].doubtful}

    def verified(self) -> dict[str, int]:
        """Return, per arm, the line up to which the light follows the code; empty without a watcher."""
        watcher = self._watcher
        return {} if watcher is None else {arm: watcher[f"verified_line_{arm}"] for arm in ARMS}

    def doubt(self) -> str:
        """Return the doubtful verdicts in words; "" if there are none."""
        watcher = self._watcher
        if watcher is None:
            return ""
        verdicts = {arm: VERDICTS[watcher[f"verdict_{arm}"]] for arm in sorted(self.doubted())}
        return ", ".join(f"arm {arm} {verdict}".replace("_", " ") for arm, verdict in verdicts.items())

    def _counts(self) -> dict[str, int]:
        return {} if self._trigger is None else {name: self._trigger[name] for name in TRIGGER_COUNTERS}
