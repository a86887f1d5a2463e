"""Tests that every sync trigger must pass: extend `TriggerContract` with a fixture ``trigger``."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any

import pytest

from acquire.codes import PrbsCode, mix_seed
from acquire.errors import TriggerError
from acquire.trigger.base import LineTag, TriggerRun

if TYPE_CHECKING:
    from acquire.trigger.base import Trigger

WAIT_S = 300.0
"""Longest wait for tags, so that a test cannot hang."""
CODE = PrbsCode(64, mix_seed(3, 64))
SUBSTEPS, SUBSTEP_TICKS, TAG_EVERY = 3, 900, 16


class TriggerContract:
    """Needs a fixture ``trigger``: a `Trigger` without a run so far, which the fixture closes at its end."""

    def run(self, run_id: str = "run", **changes: Any) -> TriggerRun:
        """Return the run to prepare; override this if your trigger needs other sub-steps."""
        settings: dict[str, Any] = {
            "code": CODE,
            "substeps": SUBSTEPS,
            "substep_ticks": SUBSTEP_TICKS,
            "tag_every_lines": TAG_EVERY,
        }
        return TriggerRun(run_id, **(settings | changes))

    def test_it_says_who_it_is(self, trigger: Trigger) -> None:
        """Recordings state the trigger, and times are computed from its clock's rate."""
        identity = trigger.identify()
        assert identity.model
        assert identity.clock_hz > 0

    def test_a_run_is_tagged_without_a_gap_and_knows_its_lines(self, trigger: Trigger) -> None:
        """Code and time of every line are derived from the tags: each has to be there, and right."""
        run = self.run()
        trigger.prepare(run)
        before_ns = time.time_ns()
        fit = trigger.start()
        assert fit.clock_hz == trigger.identify().clock_hz
        early_ns = before_ns - fit.uncertainty_ns - 10**7
        assert early_ns <= fit.utc_ns_at_tick_0 <= time.time_ns() + fit.uncertainty_ns
        tags = collect(trigger, 10 * run.tag_every_lines)
        lines = trigger.stop()
        assert trigger.stop() == lines, "a second stop must have no effect"
        # The last tags may still have been on their way at the stop.
        tags += trigger.tags(0.1)
        assert [tag.line for tag in tags] == list(range(0, lines, run.tag_every_lines))
        assert all(tag.code_index == run.substeps * tag.line for tag in tags)
        assert all(tag.tick == run.line_period_ticks * tag.line for tag in tags), "the line period jitters"
        statistics = trigger.statistics()
        assert statistics["pulses"] == lines
        assert statistics["tags"] >= len(tags)

    def test_a_second_run_starts_from_zero(self, trigger: Trigger) -> None:
        """A line number that went on would be that of another code bit."""
        for name in ("first", "second"):
            trigger.prepare(self.run(name))
            trigger.start()
            assert collect(trigger, 64)[0] == LineTag(0, 0, 0)
            trigger.stop()

    def test_preparing_a_run_again_changes_nothing_and_another_is_refused(self, trigger: Trigger) -> None:
        """A daemon repeats a request whose answer was lost; a running code must not change."""
        for _ in range(2):
            trigger.prepare(self.run())
        trigger.start()
        trigger.prepare(self.run())
        with pytest.raises(TriggerError):
            trigger.prepare(self.run("other"))
        assert collect(trigger, 32)[0].line == 0
        trigger.stop()

    def test_stop_before_start_leaves_no_line(self, trigger: Trigger) -> None:
        """Arming that fails half-way is undone by a stop."""
        trigger.prepare(self.run())
        assert trigger.stop() == 0

    def test_what_cannot_be_is_refused_in_words_before_a_pulse(self, trigger: Trigger) -> None:
        """The operator sees the error as it is raised, and the light has to stay off."""
        with pytest.raises(TriggerError) as refused:
            trigger.prepare(self.run(substep_ticks=0))
        assert refused.value.possible or refused.value.hint, (
            "the error states neither what is possible nor why"
        )

    def test_stop_ends_a_wait_for_tags(self, trigger: Trigger) -> None:
        """Another thread waits for tags, and must not outlive its run."""
        trigger.prepare(self.run(tag_every_lines=60_000))
        trigger.start()
        # The first tag, after which 60 000 lines bring none: only the stop can end the wait.
        collect(trigger, 0)
        waited = []

        def wait() -> None:
            trigger.tags(2 * WAIT_S)
            waited.append(True)

        waiter = threading.Thread(target=wait, daemon=True)
        waiter.start()
        trigger.stop()
        waiter.join(WAIT_S)
        assert waited, "a wait for tags must end with its run"

    def test_closing_twice_is_closing_once(self, trigger: Trigger) -> None:
        """Whoever closes after an error does not know what is closed already."""
        # Drivers may open their link only now; before, there would be nothing to close.
        trigger.identify()
        trigger.close()
        trigger.close()


def collect(trigger: Trigger, lines: int) -> list[LineTag]:
    """Return the tags up to the first of line ``lines`` or later."""
    tags: list[LineTag] = []
    deadline = time.monotonic() + WAIT_S
    while not tags or tags[-1].line < lines:
        assert time.monotonic() < deadline, f"only {len(tags)} tags came"
        # In short waits, so that a trigger without tags fails at the deadline and does not hang.
        tags += trigger.tags(0.5)
    return tags
