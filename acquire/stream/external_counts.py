"""Other parties' counts for a recording: the trigger's and cameras' counts, and the watcher's verdicts.

They are read from shared memory when they are needed; without a trigger to query, or without a watcher, there
is nothing to doubt.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.clock import NS_PER_S
from acquire.lines import ARMS
from acquire.stream.grabber import CAMERA_CAUSES
from acquire.stream.session import ExternalState
from acquire.stream.stalls import HELD_UP_S
from acquire.stream.watcher import VERDICTS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from acquire.processes.shared import Counters
    from acquire.stream.lightcheck import Verdict

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

    def state(self) -> ExternalState:
        """Return what the others have counted and found by now."""
        return ExternalState(self._since_begin(), self._delivered(), self._doubted(), self._verified())

    def tags_pass_since_s(self, now_s: float) -> float:
        """Return the monotonic time since which tags are passed on without a hold-up; ``now_s`` in one."""
        if self._trigger is None or not self._trigger["turned_ns"]:
            return 0.0
        still_s = now_s - self._trigger["turned_ns"] / NS_PER_S
        # One that is held up will catch up; one that is stuck is a fault of the trigger, reported elsewhere.
        is_held_up = HELD_UP_S < still_s < _LONGEST_HOLD_UP_S
        return now_s if is_held_up else self._trigger["held_up_to_ns"] / NS_PER_S

    def doubt(self) -> str:
        """Return the doubtful verdicts in words; "" if there are none."""
        verdicts = ((arm, verdict) for arm, verdict in self._verdicts().items() if verdict.doubtful)
        return ", ".join(f"arm {arm} {verdict}".replace("_", " ") for arm, verdict in verdicts)

    def _since_begin(self) -> dict[str, int]:
        """Return the trigger's counts since `begin`; of strobes, since arm: a camera behind stays behind."""
        return {
            name: count if name.startswith("strobe") else count - self._begun.get(name, 0)
            for name, count in self._counts().items()
        }

    def _delivered(self) -> dict[str, dict[str, int]]:
        """Return, per arm, the lines that its camera delivered and lost since it was armed.

        A block that is just being taken counts as ``delivered`` already, while ``next_line`` is still its
        first line.
        """
        return {
            arm: {str(name): counted[name] for name in CAMERA_COUNTS if counted[name]}
            for arm, counted in self._cameras.items()
        }

    def _verdicts(self) -> dict[str, Verdict]:
        watcher = self._watcher
        return {} if watcher is None else {arm: VERDICTS[watcher[f"verdict_{arm}"]] for arm in ARMS}

    def _doubted(self) -> frozenset[str]:
        return frozenset(arm for arm, verdict in self._verdicts().items() if verdict.doubtful)

    def _verified(self) -> dict[str, int]:
        watcher = self._watcher
        return {} if watcher is None else {arm: watcher[f"verified_line_{arm}"] for arm in ARMS}

    def _counts(self) -> dict[str, int]:
        return {} if self._trigger is None else {name: self._trigger[name] for name in TRIGGER_COUNTERS}
