"""The process that looks at the lines while they pass: does the light follow the code, was a level crossed.

It observes the rings and nobody waits for it; what it sees it tells the capture's owner. Dead or late, it
costs no line: what it did not see is not checked, which the counters tell.

::

    ring a ─▶ Intake ─┐  the same lines of both, twice a second     ┌▶ counters: verdicts
    ring b ─▶ Intake ─┴─▶ Judge (`lightcheck`) ─────────────────────┼▶ Checked, when a verdict changes
                   │                                                ├▶ Note, from which line on it holds
                   └────▶ Threshold ────────────────────────────────┴▶ Note, at a crossing
"""

from __future__ import annotations

import select
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from acquire.lines import ARMS
from acquire.processes.messages import Ready
from acquire.store.suspect import DOUBTFUL, VERIFIED
from acquire.stream.lightcheck import Finding, Judge, Sight, Verdict, explain
from acquire.stream.messages import Checked, Note
from acquire.stream.observer import Observer
from acquire.stream.threshold import Threshold

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.processes.shared import Counters
    from acquire.processes.worker import Mailbox
    from acquire.stream.ring import Ring, RingBlock
    from acquire.stream.threshold import ThresholdPlan

COUNTERS = tuple(
    f"{name}_{arm}"
    for arm in ARMS
    for name in ("verdict", "shift", "checked_line", "verified_line", "checks", "lapped")
)
"""Per arm: position in `VERDICTS`, shift in sub-steps, the line after the last that was checked, the first of
the last check that was verified, how many checks there were; ring slots that came and went unseen."""
VERDICTS = tuple(Verdict)
OBSERVER = 0
"""The watcher's place among a ring's observers."""

_CHECK_EVERY_S = 0.5
_LOOK_S = 0.02
_TELL_EVERY_S = 0.1
"""Crossings that follow sooner than this on one that was told are only counted."""
_MOST_COLUMNS = 128
_MOST_PROFILE_LINES = 256


@dataclass(frozen=True, slots=True)
class WatchPlan:
    """What the watcher looks for. Picklable.

    ``judge``: None: the code is not checked; ``lines``: that a check takes; ``black_dn``: arm → black level.
    """

    judge: Judge | None
    lines: int
    black_dn: dict[str, float]
    threshold: ThresholdPlan | None = None


def watch(mailbox: Mailbox, plan: WatchPlan, rings: dict[str, Ring], counters: Counters) -> None:
    """Life of the watcher: look at what comes, until told to end."""
    watcher = Watcher(mailbox, plan, rings, counters)
    mailbox.post(Ready())
    waiting = select.poll()
    waiting.register(mailbox, select.POLLIN | select.POLLHUP)
    while True:
        mailbox.take()
        watcher.turn(time.monotonic())
        waiting.poll(_LOOK_S * 1000)


class Watcher:
    """See the module. `turn` never waits."""

    def __init__(self, mailbox: Mailbox, plan: WatchPlan, rings: dict[str, Ring], counters: Counters) -> None:
        self._mailbox = mailbox
        self._plan = plan
        self._rings = rings
        self._counters = counters
        self._observers = {arm: Observer(ring, OBSERVER) for arm, ring in rings.items()}
        self._threshold = None if plan.threshold is None else Threshold(plan.threshold)
        self._intakes: dict[str, Intake] = {}
        self._told = dict.fromkeys(ARMS, Finding(Verdict.UNKNOWN))
        self._doubted: dict[str, bool | None] = dict.fromkeys(ARMS)
        """As it was told last; None: not yet."""
        self._next_s = self._now_s = self._tell_s = 0.0
        self._untold = 0
        # A watcher that replaces another begins with what comes: it must not judge a ring's whole history.
        for observer in self._observers.values():
            observer.skip()

    def turn(self, now_s: float) -> None:
        """Take what has come; judge when both arms have the lines for it."""
        self._now_s = now_s
        if self._plan.judge is not None and not self._intakes and now_s >= self._next_s:
            # From the first line on that neither arm has delivered yet.
            first_line = max(ring.newest_line for ring in self._rings.values())
            self._next_s = now_s + _CHECK_EVERY_S
            self._intakes = {
                arm: Intake(first_line, self._plan.lines, self._plan.black_dn[arm]) for arm in ARMS
            }
        for arm, observer in self._observers.items():
            self._look(arm, observer)
        if self._intakes and all(intake.full for intake in self._intakes.values()):
            self._judge(self._plan.judge)
        elif any(intake.broken for intake in self._intakes.values()):
            self._intakes.clear()
            self._next_s = now_s

    def close(self) -> None:
        """Release the rings' memory, before they do."""
        for observer in self._observers.values():
            observer.close()

    def _look(self, arm: str, observer: Observer) -> None:
        intake = self._intakes.get(arm)
        threshold = self._threshold if self._threshold and self._threshold.plan.arm == arm else None
        if threshold is None and (intake is None or intake.full):
            observer.skip()
        while (block := observer.acquire()) is not None:
            crossed = [] if threshold is None else threshold.crossings(block.first_line, block.pixels)
            if intake is not None:
                intake.take(block)
            if observer.release():
                self._tell(crossed)
            elif intake is not None:
                intake.broken = True
        self._counters[f"lapped_{arm}"] = observer.statistics().lost

    def _tell(self, crossed: list[int]) -> None:
        for line in crossed:
            if self._now_s < self._tell_s:
                self._untold += 1
                continue
            plan, self._tell_s = self._plan.threshold, self._now_s + _TELL_EVERY_S
            assert plan is not None
            text = f"arm {plan.arm} {'above' if plan.rising else 'below'} {plan.level_dn:g} DN"
            more = f", {self._untold} more times before" if self._untold else ""
            self._untold = 0
            self._mailbox.post(Note(line, "threshold", text + more))

    def _judge(self, judge: Judge | None) -> None:
        assert judge is not None
        first_line = self._intakes[ARMS[0]].first_line
        found = judge.look(first_line, {arm: intake.sight() for arm, intake in self._intakes.items()})
        self._intakes.clear()
        for arm, finding in found.items():
            self._locate(arm, finding, first_line)
            self._counters[f"verdict_{arm}"] = VERDICTS.index(finding.verdict)
            self._counters[f"shift_{arm}"] = finding.shift
            self._counters[f"checked_line_{arm}"] = first_line + self._plan.lines
            self._counters.add(f"checks_{arm}", 1)
        # Told when a verdict changes, not when its certainty does, which differs from check to check.
        told = {arm: (finding.verdict, finding.shift) for arm, finding in self._told.items()}
        if any((finding.verdict, finding.shift) != told[arm] for arm, finding in found.items()):
            self._told = found
            doubtful = any(finding.verdict.doubtful for finding in found.values())
            self._mailbox.post(Checked(first_line, doubtful, explain(found, judge.substeps)))

    def _locate(self, arm: str, finding: Finding, first_line: int) -> None:
        """Tell from which line on an arm is in doubt, or no more.

        A check whose lines slip half-way may say either, and nothing is known of the lines between checks:
        doubt begins with the last check that saw none, and ends after the first.
        """
        if finding.verdict is Verdict.UNKNOWN:
            return
        before, doubtful = self._doubted[arm], finding.verdict.doubtful
        if doubtful and not before:
            self._mailbox.post(Note(self._counters[f"verified_line_{arm}"], DOUBTFUL[arm], str(finding)))
        elif not doubtful and before is not False:
            since = first_line + (self._plan.lines if before else 0)
            self._mailbox.post(Note(since, VERIFIED[arm], str(finding)))
        self._doubted[arm] = doubtful
        if not doubtful:
            self._counters[f"verified_line_{arm}"] = first_line


class Intake:
    """``lines`` consecutive lines of one arm from ``first_line`` on, as the check needs them: no pixels."""

    def __init__(self, first_line: int, lines: int, black_dn: float) -> None:
        self.first_line = first_line
        self.broken = False
        self._energy = np.empty(lines)
        self._count = 0
        self._black_dn = black_dn
        self._profile: list[NDArray[np.float64]] = []
        self._profile_step = max(1, lines // _MOST_PROFILE_LINES)

    @property
    def full(self) -> bool:
        return self._count == len(self._energy) and not self.broken

    def take(self, block: RingBlock) -> None:
        """Lines that were lost make it `broken`: they cannot be judged."""
        expected = self.first_line + self._count
        if self.broken or self.full or block.end_line <= expected:
            return
        if block.first_line > expected:
            self.broken = True
            return
        pixels = block.pixels[expected - block.first_line :][: len(self._energy) - self._count]
        # Evenly spaced columns and lines: the mean of all would cost a processor at 100 kHz, and the code
        # shows in any part of the line.
        energy = pixels[:, :: -(-pixels.shape[1] // _MOST_COLUMNS)].mean(axis=1)
        self._energy[self._count : self._count + len(energy)] = energy
        self._count += len(energy)
        self._profile.append(pixels[:: self._profile_step].mean(axis=0, dtype=np.float64))

    def sight(self) -> Sight:
        """What was taken, above the black level."""
        profile = np.mean(self._profile, axis=0)
        return Sight(self._energy - self._black_dn, profile - self._black_dn)
