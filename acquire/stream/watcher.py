"""The process that checks lines while they pass: does the light follow the code, was a level crossed?

It observes the rings, no process waits for it, and it reports to the capture's owner. A dead or late watcher
costs no line: lines that it missed are not checked, which its counters show.

::

    ring a ─▶ means ──┐  the same lines of both, twice a second     ┌▶ counters: verdicts
    ring b ─▶ means ──┴─▶ Judge (`lightcheck`) ─────────────────────┼▶ Checked, when a verdict changes
                   │                                                ├▶ Note, from which line on it holds
                   └────▶ Threshold ────────────────────────────────┴▶ Note, at a crossing
"""

from __future__ import annotations

import select
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from acquire.flags import ARMS, NO_IMAGE
from acquire.processes.messages import Ready
from acquire.store.suspect import DOUBTFUL, VERIFIED
from acquire.stream.lightcheck import ArmVerdict, Judge, Sight, Verdict, explain
from acquire.stream.messages import Checked, Note
from acquire.stream.observer import Observer
from acquire.stream.threshold import Threshold
from acquire.text import counted

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
"""Per arm: index in `VERDICTS`, shift in sub-steps, the line after the last one checked, the first line of
the last check that was verified, the number of checks; the number of ring slots overwritten unread."""
VERDICTS = tuple(Verdict)
OBSERVER = 0
"""The watcher's place among a ring's observers."""

_CHECK_EVERY_S = 0.5
_POLL_S = 0.02
_REPORT_EVERY_S = 0.1
"""Crossings that follow sooner than this on a reported one are only counted."""
_MOST_COLUMNS = 128
_MOST_PROFILE_LINES = 256
"""At most so many columns of a line, and lines of a check, are averaged: see `BlockMeans.take`."""


@dataclass(frozen=True, slots=True)
class WatchPlan:
    """Settings of the watcher. Picklable.

    ``judge`` checks the code, None: no check; ``lines`` per check; ``black_dn``: arm → black level.
    """

    judge: Judge | None
    lines: int
    black_dn: dict[str, float]
    threshold: ThresholdPlan | None = None


def watch(mailbox: Mailbox, plan: WatchPlan, rings: dict[str, Ring], counters: Counters) -> None:
    """Main function of the watcher: check the lines that come, until Quit."""
    watcher = Watcher(mailbox, plan, rings, counters)
    mailbox.post(Ready())
    waiting = select.poll()
    waiting.register(mailbox, select.POLLIN | select.POLLHUP)
    while True:
        mailbox.take()
        watcher.turn(time.monotonic())
        waiting.poll(_POLL_S * 1000)


class Watcher:
    """See the module. `turn` never waits."""

    def __init__(self, mailbox: Mailbox, plan: WatchPlan, rings: dict[str, Ring], counters: Counters) -> None:
        self._mailbox = mailbox
        self._plan = plan
        self._rings = rings
        self._counters = counters
        self._observers = {arm: Observer(ring, OBSERVER) for arm, ring in rings.items()}
        self._threshold = None if plan.threshold is None else Threshold(plan.threshold)
        self._intakes: dict[str, BlockMeans] = {}
        self._reported = dict.fromkeys(ARMS, ArmVerdict(Verdict.UNKNOWN))
        self._doubted: dict[str, bool | None] = dict.fromkeys(ARMS)
        """Whether doubt was reported last, per arm; None: nothing yet."""
        self._next_s = self._now_s = self._report_s = 0.0
        self._unreported = 0
        # A watcher that replaces another begins with new lines: it must not check a ring's whole history.
        for observer in self._observers.values():
            observer.skip()

    def turn(self, now_s: float) -> None:
        """Take the blocks that have come; judge the code once both arms have the lines of a check."""
        self._now_s = now_s
        if self._plan.judge is not None and not self._intakes and now_s >= self._next_s:
            # The check begins with the first line that neither arm has delivered yet.
            first_line = max(ring.newest_line for ring in self._rings.values())
            self._next_s = now_s + _CHECK_EVERY_S
            self._intakes = {
                arm: BlockMeans(
                    first_line, self._plan.lines, self._plan.black_dn[arm], self._plan.judge.white_dn
                )
                for arm in ARMS
            }
        for arm, observer in self._observers.items():
            self._take_blocks(arm, observer)
        if self._intakes and all(intake.full for intake in self._intakes.values()):
            self._judge(self._plan.judge)
        elif any(intake.broken for intake in self._intakes.values()):
            self._intakes.clear()
            self._next_s = now_s

    def close(self) -> None:
        """Release the rings' memory, before they do."""
        for observer in self._observers.values():
            observer.close()

    def _take_blocks(self, arm: str, observer: Observer) -> None:
        """Take an arm's new blocks, for the check that is under way and for the threshold."""
        intake = self._intakes.get(arm)
        threshold = self._threshold if self._threshold and self._threshold.plan.arm == arm else None
        if threshold is None and (intake is None or intake.full):
            observer.skip()
        while (block := observer.acquire()) is not None:
            crossed = []
            if threshold is not None:
                crossed = threshold.crossings(block.first_line, block.pixels, block.flags)
            if intake is not None:
                intake.take(block)
            if observer.release():
                self._report_crossings(crossed)
            elif intake is not None:
                intake.broken = True
        self._counters[f"lapped_{arm}"] = observer.statistics().lost

    def _report_crossings(self, lines: list[int]) -> None:
        for line in lines:
            if self._now_s < self._report_s:
                self._unreported += 1
                continue
            plan, self._report_s = self._plan.threshold, self._now_s + _REPORT_EVERY_S
            assert plan is not None
            text = f"arm {plan.arm} {'above' if plan.rising else 'below'} {plan.level_dn:g} DN"
            more = f", {counted(self._unreported, 'more time')} before" if self._unreported else ""
            self._unreported = 0
            self._mailbox.post(Note(line, "threshold", text + more))

    def _judge(self, judge: Judge | None) -> None:
        assert judge is not None
        first_line = self._intakes[ARMS[0]].first_line
        found = judge.look(first_line, {arm: intake.sight() for arm, intake in self._intakes.items()})
        self._intakes.clear()
        for arm, finding in found.items():
            self._locate(arm, finding, first_line)
            self._counters[f"shift_{arm}"] = finding.shift
            self._counters[f"checked_line_{arm}"] = first_line + self._plan.lines
            # Last, so that whoever sees a first verdict also sees its shift.
            self._counters[f"verdict_{arm}"] = VERDICTS.index(finding.verdict)
            self._counters.add(f"checks_{arm}", 1)
        # Report a change of verdict or shift, not of the peak, which differs from check to check.
        last = {arm: (finding.verdict, finding.shift) for arm, finding in self._reported.items()}
        if any((finding.verdict, finding.shift) != last[arm] for arm, finding in found.items()):
            self._reported = found
            doubtful = any(finding.verdict.doubtful for finding in found.values())
            self._mailbox.post(Checked(first_line, doubtful, explain(found, judge.substeps)))

    def _locate(self, arm: str, finding: ArmVerdict, first_line: int) -> None:
        """Report from which line on an arm's code is in doubt, or no longer in doubt.

        If lines slip in the middle of a check its verdict may be either, and lines between checks are not
        judged: doubt begins with the last check that found none, and ends after the first such check.
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


class BlockMeans:
    """Means of ``lines`` consecutive lines of one arm from ``first_line`` on, as the check needs them.

    Lines that were lost, overwritten unread or damaged are left out. `broken`: if these are more than half,
    or a block was overwritten while it was read; the check cannot be made.
    """

    def __init__(self, first_line: int, lines: int, black_dn: float, white_dn: int) -> None:
        self.first_line = first_line
        self.broken = False
        self._energy = np.full(lines, np.nan)
        self._count = self._seen = 0
        self._black_dn, self._white_dn = black_dn, white_dn
        self._saturated = self._columns = 0
        self._profile: list[NDArray[np.float64]] = []
        self._profile_step = max(1, lines // _MOST_PROFILE_LINES)

    @property
    def full(self) -> bool:
        """Whether all lines have come, and enough of them can be used."""
        return self._count == len(self._energy) and not self.broken

    def take(self, block: RingBlock) -> None:
        """Add the block's lines, and those lost before it."""
        if self.broken or self.full or block.end_line <= self.first_line + self._count:
            return
        lost = max(0, block.first_line - self.first_line - self._count)
        self._count = min(self._count + lost, len(self._energy))
        part = block.part(self.first_line + self._count, self.first_line + len(self._energy))
        usable, pixels = (part.flags & NO_IMAGE) == 0, part.pixels
        if not usable.all():
            pixels = pixels[usable]
        # Evenly spaced columns and lines: the mean of all would take a processor at 100 kHz, and the code
        # shows in any part of the line.
        sampled = pixels[:, :: -(-pixels.shape[1] // _MOST_COLUMNS)]
        energy = sampled.mean(axis=1)
        self._saturated += int(np.count_nonzero(sampled >= self._white_dn))
        self._columns = sampled.shape[1]
        self._energy[self._count + np.flatnonzero(usable)] = energy
        self._count += len(usable)
        self._seen += len(energy)
        if len(energy):
            self._profile.append(pixels[:: self._profile_step].mean(axis=0, dtype=np.float64))
        self.broken = self.full and 2 * self._seen < len(self._energy)

    def sight(self) -> Sight:
        """Return the means of the lines and of the pixels, above the black level."""
        energy, profile = self._energy - self._black_dn, np.mean(self._profile, axis=0) - self._black_dn
        light = float(np.nansum(energy)) * self._columns
        saturated = self._saturated * (self._white_dn - self._black_dn)
        return Sight(energy, profile, saturated / light if light > 0 else 0.0)
