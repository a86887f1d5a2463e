r"""The time base is exact: claims about `firmware.timing`, for any setting, start and stop.

::

    start   _/‾\_______________________________________________
    line    ___________/‾\___________________________/‾\_______
    substep ___________/‾\___________/‾\_____________/‾\_______
            |          |             |               |
            |<-latency>|<--period--->|<---period---->|              every distance the same: zero jitter
                       |<------- S · period -------->|              S code bits shown, no more, no fewer

Settings are arbitrary, as long as arming accepts them and they are constant from start to end of a run.
Lines are counted to 2⁴⁸ − 3: five years of 1.8 MHz.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from amaranth.hdl import Cat, Mux, Signal, Value

from firmware.formal.harness import Harness, Proof, opened, times
from firmware.phases import SUBPHASES
from firmware.timing import CLOCK_BITS, LEAD_BITS, START_CLOCKS, SUBSTEP_CLOCKS_MIN, Timing

if TYPE_CHECKING:
    from collections.abc import Callable

    Claim = Callable[[str, Value, Value], None]

LINE_CLOCK_BITS = CLOCK_BITS + 3


class Observer:
    """Observations at the outputs, independent of the module's internals."""

    def __init__(self, harness: Harness, timing: Timing) -> None:
        m = harness.m
        self.started = Signal()  # this run has had a line
        self.since_start = Signal(LEAD_BITS + 2)
        self.since_substep = Signal(CLOCK_BITS + 1)
        self.since_line = Signal(LINE_CLOCK_BITS + 1)
        self.substeps_of_line = Signal(3)
        self.lines, self.substeps, self.shown = Signal(48), Signal(64), Signal(64)
        self.lit_ahead, self.ahead = Signal(), Signal(LEAD_BITS)  # a bit shows whose sub-step is to come
        self.dark, self.stopped, self.lines_after_stop = Signal(), Signal(), Signal(2)
        self.since_stop, self.was_running = Signal(LINE_CLOCK_BITS + 2), Signal()
        counters = (self.since_start, self.since_substep, self.since_line, self.since_stop)
        m.d.sync += [counter.eq(counter + 1) for counter in counters]
        m.d.sync += [self.ahead.eq(self.ahead - 1), self.was_running.eq(timing.running)]
        with m.If(self.ahead == 0):
            m.d.sync += self.lit_ahead.eq(0)
        with m.If(timing.substep):
            m.d.sync += [self.since_substep.eq(1), self.substeps.eq(self.substeps + 1)]
            m.d.sync += self.substeps_of_line.eq(Mux(timing.line, 1, self.substeps_of_line + 1))
        with m.If(timing.line):
            m.d.sync += [self.since_line.eq(1), self.lines.eq(self.lines + 1), self.started.eq(1)]
        with m.If(timing.advance):
            m.d.sync += self.dark.eq(timing.ending)
            with m.If(~timing.ending):
                m.d.sync += [self.lit_ahead.eq(1), self.ahead.eq(timing.lead), self.shown.eq(self.shown + 1)]
        self._new_run(harness, timing)
        self._stop(harness, timing)

    def _new_run(self, harness: Harness, timing: Timing) -> None:
        cleared = (self.started, self.lines, self.substeps, self.shown, self.dark)
        with harness.m.If(timing.start & ~timing.running):
            harness.m.d.sync += [signal.eq(0) for signal in cleared]
            harness.m.d.sync += self.since_start.eq(1)

    def _stop(self, harness: Harness, timing: Timing) -> None:
        m = harness.m
        with m.If(~timing.running):
            m.d.sync += self.stopped.eq(0)
        with m.Elif(timing.stop & ~self.stopped):
            m.d.sync += [self.stopped.eq(1), self.lines_after_stop.eq(0), self.since_stop.eq(1)]
        with m.Elif(self.stopped & timing.line):
            m.d.sync += self.lines_after_stop.eq(self.lines_after_stop + 1)


def timing_proof() -> Proof:
    harness, timing = Harness(), Timing()
    fragment, inside = opened(timing)
    harness.m.submodules.timing = fragment
    assume_settings(harness, timing, hold=timing.running | timing.start)
    seen = Observer(harness, timing)
    harness.assume(seen.lines < (1 << 48) - 3)
    _claims(harness.claim, timing, seen)
    _lemmas(harness.lemma, timing, seen, inside)
    harness.cover("third_line", timing.line & (seen.lines == 2) & (timing.substeps == 2))
    harness.cover("stopped_in_the_second_line", ~timing.running & seen.stopped & (seen.lines == 2))
    harness.cover("budget_of_two_used_up", ~timing.running & seen.was_running & (timing.lines == 2))
    inputs = [timing.substep_clocks, timing.substeps, timing.lead, timing.lines, timing.start, timing.stop]
    return harness.proof("timing", inputs, cover_depth=40)


def timing_facts(harness: Harness, timing: Timing, inside: dict[str, Signal]) -> Observer:
    """Return these claims as facts for a proof about a larger design, whose settings are constant as well."""
    seen = Observer(harness, timing)
    harness.assume(seen.lines < (1 << 48) - 3)
    _claims(harness.fact, timing, seen)
    _lemmas(harness.fact, timing, seen, inside)
    return seen


def assume_settings(harness: Harness, timing: Timing, hold: Value) -> None:
    """Assume settings that arming accepts (`settings` proves it), and that are constant after ``hold``."""
    settings = Cat(timing.substep_clocks, timing.substeps, timing.lead, timing.lines)
    before, held = Signal(len(settings)), Signal()
    harness.m.d.sync += [before.eq(settings), held.eq(hold)]
    harness.assume(~held | (before == settings))
    harness.lemma("settings_hold_in_a_run", timing.running, held)
    harness.assume(timing.substep_clocks >= SUBSTEP_CLOCKS_MIN)
    harness.assume(timing.substeps.matches(*SUBPHASES))
    harness.assume(timing.lead < timing.substep_clocks)


def _claims(claim: Claim, timing: Timing, seen: Observer) -> None:
    period = timing.substep_clocks
    whole_line = times(period, timing.substeps, 6)
    later = seen.started & timing.substep
    claim("no_jitter", later, seen.since_substep == period)
    claim("no_substep_left_out", timing.running & seen.started & ~timing.substep, seen.since_substep < period)
    claim("lines_are_S_periods_apart", later & timing.line, seen.since_line == whole_line)
    claim("S_code_bits_in_a_line", later & timing.line, seen.substeps_of_line == timing.substeps)
    claim("line_begins_with_a_substep", timing.line, timing.substep)
    claim("run_begins_with_a_line", timing.substep & ~seen.started, timing.line)
    claim(
        "start_latency_is_constant",
        timing.substep & ~seen.started,
        seen.since_start == START_CLOCKS + timing.lead,
    )
    claim("light_leads_by_lead", timing.substep, seen.lit_ahead & (seen.ahead == 0))
    claim("light_has_its_substep", seen.lit_ahead & (seen.ahead == 0), timing.substep)
    claim("one_light_step_per_code_bit", timing.substep, seen.shown == timing.code_index + 1)
    claim("code_index_counts_substeps", timing.substep, timing.code_index == seen.substeps)
    claim("line_number_counts_lines", timing.line, timing.line_number == seen.lines)
    claim(
        "code_index_is_S_times_line",
        timing.line,
        timing.code_index == times(timing.line_number, timing.substeps, 6),
    )
    claim("dark_once_ending", seen.dark, ~timing.substep & ~seen.lit_ahead)
    # Any clock is within a line's time of the next line or of the end.
    claim("no_line_left_out", timing.running & seen.started & ~timing.line, seen.since_line < whole_line)
    claim("stop_ends_after_one_line_at_most", seen.stopped & timing.line, seen.lines_after_stop == 0)
    claim("stop_ends_within_two_lines", timing.running & seen.stopped, seen.since_stop <= whole_line << 1)
    claim(
        "start_waits_no_longer_than_lead", timing.running & ~seen.started, seen.since_start <= timing.lead + 2
    )
    claim("nothing_outside_a_run", ~timing.running, ~(timing.line | timing.substep | timing.advance))
    claim("budget_is_kept", timing.line & (timing.lines != 0), seen.lines < timing.lines)
    claim(
        "ends_only_for_a_reason",
        seen.was_running & ~timing.running,
        seen.stopped | (seen.lines == timing.lines),
    )


def _lemmas(lemma: Claim, timing: Timing, seen: Observer, inside: dict[str, Signal]) -> None:
    """Relations between internal registers and observations, clock by clock."""
    left, leading = inside["left"], inside["leading"]
    counting, waiting = timing.running & ~leading, timing.running & leading
    lemma("started_once_counting", counting, seen.started | timing.line)
    lemma(
        "nothing_yet_while_waiting",
        waiting,
        ~(seen.started | timing.substep | timing.line) & (seen.lines == 0),
    )
    lemma(
        "wait_is_within_lead", waiting, (left <= timing.lead) & (seen.since_start + left == timing.lead + 1)
    )
    lemma(
        "substep_since",
        counting,
        left + _now(timing.substep, seen.since_substep) == timing.substep_clocks - 1,
    )
    lemma(
        "line_since",
        counting,
        _now(timing.line, seen.since_line)
        == times(timing.substep_clocks, timing.place, 5) + _now(timing.substep, seen.since_substep),
    )
    lemma("place_is_in_line", counting, timing.place < timing.substeps)
    lemma(
        "place_counts",
        counting,
        timing.place + 1 == Mux(timing.line, 1, seen.substeps_of_line + timing.substep),
    )
    lemma("substeps_count", counting, timing.code_index + 1 == seen.substeps + timing.substep)
    lemma("lines_count", counting, timing.line_number + 1 == seen.lines + timing.line)
    lemma(
        "index_in_line",
        counting,
        timing.code_index == times(timing.line_number, timing.substeps, 6) + timing.place,
    )
    _light_lemmas(lemma, timing, seen, inside)
    _end_lemmas(lemma, timing, seen, inside)


def _light_lemmas(lemma: Claim, timing: Timing, seen: Observer, inside: dict[str, Signal]) -> None:
    left, leading, leaving = inside["left"], inside["leading"], inside["leaving"]
    waits = seen.lit_ahead & ~timing.substep
    lemma("only_in_a_run", ~timing.running, ~seen.lit_ahead)
    lemma("ahead_goes_with_left", waits, seen.ahead == left + 1)
    lemma("shown_from_lead_on", timing.running, waits == ((left < timing.lead) & ~leaving))
    lemma("shown_counts", timing.running & ~leading, seen.shown == seen.substeps + seen.lit_ahead)
    lemma(
        "shown_while_waiting", timing.running & leading, (seen.substeps == 0) & (seen.shown == seen.lit_ahead)
    )
    lemma("dark_is_leaving", timing.running, seen.dark == leaving)
    lemma(
        "dark_at_the_line_s_end", leaving & timing.running, ~leading & (timing.place + 1 == timing.substeps)
    )
    lemma("dark_from_lead_on", leaving & timing.running, left < timing.lead)


def _end_lemmas(lemma: Claim, timing: Timing, seen: Observer, inside: dict[str, Signal]) -> None:
    left, leading, leaving = inside["left"], inside["leading"], inside["leaving"]
    counting, last_place = timing.running & ~leading, timing.place + 1 == timing.substeps
    lemma("stop_is_kept", timing.running, inside["stopping"] == seen.stopped)
    lemma("at_most_one_line_more", timing.running & seen.stopped, seen.lines_after_stop + timing.line <= 1)
    lemma("not_yet_the_last_line", timing.running & leading, ~timing.last_line)
    whole_line = times(timing.substep_clocks, timing.substeps, 6)
    before_it = Mux(seen.lines_after_stop == 0, 0, whole_line)
    lemma(
        "stopped_in_this_line_or_the_last",
        counting & seen.stopped,
        seen.since_stop <= Mux(timing.line, whole_line, before_it + seen.since_line),
    )
    lemma(
        "stopped_while_waiting", timing.running & leading & seen.stopped, seen.since_stop < seen.since_start
    )
    lemma("no_line_before_the_first", timing.running & leading & seen.stopped, seen.lines_after_stop == 0)
    leaves = counting & last_place & (left < timing.lead)
    lemma("leaves_after_a_stop", leaves & seen.stopped & (seen.lines_after_stop == 1), leaving)
    lemma("leaves_the_last_line", leaves & timing.last_line, leaving)
    lemma("last_line_known", counting, timing.last_line == (seen.lines + timing.line == timing.lines))
    lemma(
        "next_known",
        counting & ~timing.line,
        inside["last_is_next"] == (timing.line_number + 2 == timing.lines),
    )
    lemma("within_budget", counting & (timing.lines != 0), seen.lines + timing.line <= timing.lines)
    lemma("leaves_for_a_reason", timing.running & leaving, seen.stopped | timing.last_line)


def _now(event: Value, since: Value) -> Value:
    return Mux(event, 0, since)
