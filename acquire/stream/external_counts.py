"""What others know about the lines of a recording: the trigger's and cameras' counts, the watcher's verdicts.

Both are read from shared memory where they are needed; where there is no trigger to ask, or no watcher, there
is nothing to doubt.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.lines import ARMS
from acquire.stream.grabber import CAMERA_CAUSES
from acquire.stream.watcher import VERDICTS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from acquire.processes.shared import Counters

TRIGGER, WATCHER = "trigger", "watcher"

TRIGGER_COUNTERS = (
    *("pulses", "tags", "tags_missing", "tags_repeated", "tags_wrong", "tag_lost"),
    *("strobe_a_missed", "strobe_a_unexpected", "strobe_b_missed", "strobe_b_unexpected"),
)
"""Of a trigger's statistics, those that the ledger needs: pulses issued; tags received, made but not
received, dropped, lost in the device; strobes by which cameras answer pulses, missed or in excess."""

CAMERA_COUNTS = ("delivered", "preroll", "next_line", "reopened", *CAMERA_CAUSES)


class ExternalCounts:
    """See the module; ``others`` maps `TRIGGER`, `WATCHER` and the arms to what they count."""

    def __init__(self, others: Mapping[str, Counters]) -> None:
        self._trigger = others.get(TRIGGER)
        self._watcher = others.get(WATCHER)
        self._cameras = {arm: others[arm] for arm in ARMS if arm in others}
        self._begun: dict[str, int] = {}

    def begin(self) -> None:
        """A recording begins: the trigger's counts of before are not its."""
        self._begun = self._counts()

    def trigger(self) -> dict[str, int]:
        """What the trigger counted since `begin`; of strobes, since arm: a line behind is behind for good."""
        return {
            name: count if name.startswith("strobe") else count - self._begun.get(name, 0)
            for name, count in self._counts().items()
        }

    def cameras(self) -> dict[str, dict[str, int]]:
        """Arm → what its camera gave and lost since it was armed.

        A block that is being taken just now is ``delivered`` already, and ``next_line`` is still its first.
        """
        return {
            arm: {str(name): counted[name] for name in CAMERA_COUNTS if counted[name]}
            for arm, counted in self._cameras.items()
        }

    def doubted(self) -> set[str]:
        """Arms whose lines contradict the code."""
        watcher = self._watcher
        if watcher is None:
            return set()
        return {arm for arm in ARMS if VERDICTS[watcher[f"verdict_{arm}"]].doubtful}

    def verified(self) -> dict[str, int]:
        """Arm → the line up to which the code is known to be followed; empty where nobody checks."""
        watcher = self._watcher
        return {} if watcher is None else {arm: watcher[f"verified_line_{arm}"] for arm in ARMS}

    def doubt(self) -> str:
        """What is wrong with them, in words; "" where nothing is."""
        watcher = self._watcher
        if watcher is None:
            return ""
        verdicts = {arm: VERDICTS[watcher[f"verdict_{arm}"]] for arm in sorted(self.doubted())}
        return ", ".join(f"arm {arm} {verdict}".replace("_", " ") for arm, verdict in verdicts.items())

    def _counts(self) -> dict[str, int]:
        return {} if self._trigger is None else {name: self._trigger[name] for name in TRIGGER_COUNTERS}
