r"""The charge moves one row per line, never two: six moves of the electrodes from one line to the next.

::

    substep /‾\___________/‾\___________/‾\____      S = 3, two moves in each sub-step
    line    /‾\_________________________________
    phases   0   1         2   3         4   5       PIN_CLOCKS later; one electrode changes at a time
"""

from __future__ import annotations

from typing import Any

from amaranth.hdl import Cat, Const, Mux, Signal, Value

from firmware.formal.harness import Harness, Proof, inputs_of, opened, times
from firmware.phases import PATTERN, SUBPHASES, Phases
from firmware.timing import CLOCK_BITS, SUBSTEP_CLOCKS_MIN


class Beat:
    """Sub-steps and lines as proved in `timing`, for any period and S: they drive the phases."""

    def __init__(self, harness: Harness, phases: Phases) -> None:
        m = harness.m
        self.period, self.since = Signal(CLOCK_BITS), Signal(CLOCK_BITS + 1)
        self.begun, self.place, known = Signal(), Signal(3), Signal()
        settings = Cat(self.period, phases.substeps, phases.phase_clocks, phases.backwards)
        before, ran = Signal(len(settings)), Signal()
        m.d.sync += [before.eq(settings), known.eq(1), ran.eq(phases.running), self.since.eq(self.since + 1)]
        self.hold = known & (before == settings)
        harness.assume(~known | self.hold)
        harness.assume(self.period >= SUBSTEP_CLOCKS_MIN)
        harness.assume(phases.substeps.matches(*SUBPHASES) & (phases.phase_clocks != 0))
        self.moves: Value = Const(0, 3)  # in a sub-step
        for substeps, moves in SUBPHASES.items():
            self.moves = Mux(phases.substeps == substeps, moves, self.moves)
        harness.assume(times(phases.phase_clocks, self.moves, 6) <= self.period)
        self.last = self.place + 1 == phases.substeps
        harness.assume(phases.running | ~phases.substep)
        harness.assume(~phases.substep | (ran & phases.running))
        harness.assume(~self.begun | ~phases.running | (phases.substep == (self.since == self.period)))
        harness.assume(phases.line == (phases.substep & (~self.begun | self.last)))
        with m.If(~phases.running):
            m.d.sync += [self.begun.eq(0), self.place.eq(0)]
        with m.Elif(phases.substep):
            m.d.sync += [
                self.begun.eq(1),
                self.since.eq(1),
                self.place.eq(Mux(phases.line, 0, self.place + 1)),
            ]


def transfer_proof() -> Proof:
    harness, phases = Harness(), Phases()
    m, claim = harness.m, harness.claim
    m.submodules.phases, inside = opened(phases)
    beat = Beat(harness, phases)
    shown, lines, runs = Signal(3), Signal(2), Signal(3)  # the latest clock in bit 0
    m.d.sync += [shown.eq(phases.phases), lines.eq(Cat(phases.line, lines))]
    m.d.sync += runs.eq(Cat(phases.running & beat.begun, runs))
    change = phases.phases ^ shown
    goes_on = runs.all() & phases.running
    first, last = PATTERN[0], PATTERN[-1]
    claim(
        "a_line_begins_with_the_first",
        lines[1] & goes_on,
        phases.phases == Mux(phases.backwards, last, first),
    )
    claim("and_ends_with_the_last", lines[0] & goes_on, phases.phases == Mux(phases.backwards, first, last))
    claim("one_electrode_at_a_time", goes_on & (shown != 0), (change & (change - 1)[:3]) == 0)
    claim("none_is_left_out", goes_on & (shown != 0), follows(phases, shown) | (change == 0))
    _lemmas(harness, phases, beat, inside)
    harness.cover("a_whole_line", lines[0] & goes_on)
    return harness.proof("transfer", [*inputs_of(phases), beat.period], cover_depth=24, depth=4)


def follows(phases: Phases, shown: Signal) -> Value:
    """Return whether the levels are the successors of ``shown``."""
    after: Value = Const(0, 3)
    for levels, following in zip(PATTERN, PATTERN[1:] + PATTERN[:1], strict=True):
        after = Mux(~phases.backwards & (shown == levels), following, after)
        after = Mux(phases.backwards & (shown == following), levels, after)
    return phases.phases == after


def _lemmas(harness: Harness, phases: Phases, beat: Beat, inside: dict[str, Any]) -> None:
    lemma, phase, more = harness.lemma, inside["phase"], inside["more"]
    goes = phases.running & beat.begun
    done = (beat.moves - 1 - more)[:3]
    lemma("settings_hold", goes, beat.hold)
    lemma("within_the_substep", goes, (beat.since != 0) & (beat.since <= beat.period))
    lemma("place_is_in_line", goes, beat.place < phases.substeps)
    lemma("no_more_than_there_are", goes, more < beat.moves)
    lemma("phase_counts", goes, phase == times(beat.moves, beat.place, 5) + done)
    due = times(phases.phase_clocks, done + 1, 6)
    lemma("left_until_the_next", goes & (more != 0), inside["left"] + beat.since == due)
    lemma("moving_once_begun", goes, inside["moving"])
    lemma("resting_before", phases.running & ~beat.begun, more == 0)
