r"""Runs begin when they should, end when they must, and the state that the host reads is correct.

`Commands`, `Timing`, `Watchdog` and `Light` as connected in `firmware.top`; commands, edges, signs of life of
the host and the loss of the clock come at any time, in any combination::

    edge or START, armed   ──▶ line 0 exactly START_CLOCKS + lead clocks later
    STOP, silence, clock   ──▶ one line more at most, then dark
    state ENDED            ◀─▶ nothing runs, and a tag LAST has been asked for, once
    WATCHDOG silent clocks ──▶ the run is over two lines later, whoever started it: see `silence`
"""

from __future__ import annotations

from typing import Any

from amaranth.hdl import Cat, Mux, Signal

from acquire.trigger.registers import Command, EndReason, ErrorCode, State, TagFlag
from firmware.commands import SETTLE_CLOCKS, Commands
from firmware.formal.harness import Harness, Proof, opened
from firmware.formal.settings import SETTLED
from firmware.formal.silence import silence_and_dark
from firmware.formal.timing import Observer, assume_settings, timing_facts
from firmware.timing import Timing


class Story:
    """The host's knowledge: which run is armed, whether a stop was requested, and what was reported."""

    def __init__(self, harness: Harness, commands: Commands, timing: Timing) -> None:
        m = harness.m
        self.was, self.started_before = Signal(3), Signal()
        self.ended_told, self.told_before = Signal(), Signal()
        self.asked, self.answered = Signal(), Signal()  # 1 and 2 clocks after a command
        self.asked_command, self.arm_was_good = Signal(32), Signal()
        self.since_arm, self.since_command, self.commanded = Signal(4), Signal(4), Signal()
        m.d.sync += self.commanded.eq(self.commanded | commands.execute)
        self.must_end = Signal()
        self.other_end = ~commands.clock_locked | commands.watchdog
        m.d.comb += self.ended_told.eq((commands.last & int(TagFlag.LAST)) != 0)
        m.d.sync += [
            self.was.eq(commands.state),
            self.started_before.eq(timing.start),
            self.told_before.eq(self.ended_told),
            self.asked.eq(commands.execute),
            self.answered.eq(self.asked),
            self.asked_command.eq(commands.command),
            self.arm_was_good.eq((commands.config_error == 0) & (commands.run != 0)),
        ]
        for since, event in ((self.since_arm, commands.arm), (self.since_command, commands.execute)):
            m.d.sync += since.eq(Mux(event, 1, Mux(since.all(), since, since + 1)))
        with m.If(commands.arm):
            m.d.sync += self.must_end.eq(0)
        with m.Elif(timing.stop & timing.running):
            m.d.sync += self.must_end.eq(1)


def runs_proof() -> Proof:
    harness, commands, timing = Harness(), Commands(), Timing()
    fragment, inside = opened(timing)
    harness.m.submodules.timing = fragment
    harness.m.submodules.commands, within = opened(commands)
    harness.m.d.comb += [
        timing.start.eq(commands.start),
        timing.stop.eq(commands.stop),
        commands.running.eq(timing.running),
        commands.budget.eq(timing.last_line),
    ]
    story = Story(harness, commands, timing)
    _host(harness, commands, story)
    assume_settings(harness, timing, hold=(commands.state != State.IDLE) & (commands.state != State.ENDED))
    seen = timing_facts(harness, timing, inside)
    _claims(harness, commands, timing, story)
    _lemmas(harness, commands, timing, seen, story)
    _pipeline(harness, commands, seen, story, within)
    free = ["execute", "command", "run", "config_error", "config_address", "length_good", "busy", "edge"]
    inputs = [getattr(commands, name) for name in [*free, "clock_locked"]]
    inputs += [timing.substep_clocks, timing.substeps, timing.lead, timing.lines]
    inputs += silence_and_dark(harness, commands, timing, seen, inside["leaving"])
    return harness.proof("runs", inputs, cover_depth=24)


def _host(harness: Harness, commands: Commands, story: Story) -> None:
    """One command at a time, which is constant until it is answered (`Host` waits for ``done``)."""
    operands = Cat(commands.command, commands.run)
    before = Signal(len(operands))
    harness.m.d.sync += before.eq(operands)
    waits = story.asked | story.answered
    harness.assume(~waits | (operands == before))
    harness.assume(~commands.execute | ~story.commanded | (story.since_command > SETTLED))


def _claims(harness: Harness, commands: Commands, timing: Timing, story: Story) -> None:
    claim, state = harness.claim, commands.state
    armed = state == State.ARMED
    active = (state == State.RUNNING) | (state == State.STOPPING)
    stop_asked = story.asked & (commands.command == Command.STOP)
    claim("starts_only_when_armed", timing.start, armed & ~timing.running)
    claim("armed_only_with_a_good_configuration", armed & (story.was != State.ARMED), story.arm_was_good)
    claim("never_armed_over_a_run", commands.arm, ~timing.running & ~active & ~armed & ~commands.busy)
    claim(
        "edge_starts_at_once",
        armed & commands.edge & commands.clock_locked & ~stop_asked & (story.since_arm > SETTLE_CLOCKS),
        timing.start,
    )
    claim("starts_with_its_code_at_hand", timing.start, story.since_arm > SETTLE_CLOCKS)
    claim("only_a_command_or_the_edge_starts", timing.start, commands.edge | story.asked)
    claim("running_is_told", timing.running, active)
    claim("ended_within_a_clock", active & ~timing.running, commands.last.any())
    claim("configuration_waits_for_the_end", commands.idle, ~timing.running & ~timing.start)
    claim("every_end_is_told", (state == State.ENDED) & (story.was != State.ENDED), story.told_before)
    claim("only_an_end_is_told", story.told_before, state == State.ENDED)
    claim("end_has_a_reason", state == State.ENDED, commands.reason != EndReason.NONE)
    claim("stopping_ends", (state == State.STOPPING) & timing.running, story.must_end | timing.last_line)
    claim(
        "lost_clock_ends_the_run",
        active & ~commands.clock_locked & timing.running,
        timing.stop,
    )
    claim("watchdog_ends_the_run", active & commands.watchdog & timing.running, timing.stop)
    meant = commands.run == commands.current  # all 64 bits
    asked_start, asked_stop = (
        story.answered & (story.asked_command == command) for command in (Command.START, Command.STOP)
    )
    wrong = commands.error == ErrorCode.WRONG_RUN
    claim("only_the_run_that_is_named_starts", timing.start & ~commands.edge, meant)
    claim("a_start_of_another_is_refused", asked_start & ~meant & (story.was != State.IDLE), wrong)
    claim("a_stop_of_another_is_refused", asked_stop & ~meant & (commands.run != 0), wrong)
    claim("any_run_can_be_stopped", asked_stop & (meant | (commands.run == 0)), commands.error == 0)
    claim(
        "a_refused_stop_stops_nothing",
        stop_asked & timing.stop & ~story.other_end,
        meant | (commands.run == 0),
    )
    claim("the_id_armed_is_the_one_named", armed & (story.was != State.ARMED), meant)
    free = ~active & ~armed & ~commands.busy & (commands.config_error == 0) & (commands.run != 0)
    arm_asked = story.asked & (commands.command == Command.ARM)
    claim("a_new_id_is_armed", arm_asked & free & ~meant, commands.arm)
    claim("an_old_id_is_not", arm_asked & meant, ~commands.arm)
    claim("every_command_is_answered", story.answered, commands.done)
    claim("no_answer_unasked", commands.done, story.answered)
    harness.cover("stopped_while_running", (state == State.ENDED) & (commands.reason == EndReason.STOPPED))
    harness.cover("budget", (state == State.ENDED) & (commands.reason == EndReason.LINE_BUDGET))
    harness.cover("second_run", commands.arm & story.was.matches(State.ENDED))


def _lemmas(harness: Harness, commands: Commands, timing: Timing, seen: Observer, story: Story) -> None:
    lemma, state = harness.lemma, commands.state
    active = (state == State.RUNNING) | (state == State.STOPPING)
    has_reason = commands.reason != EndReason.NONE
    lemma("state_is_one", 1, state <= State.ENDED)
    lemma("active_runs_or_just_ran", active & ~timing.running, seen.was_running)
    lemma("not_stopped_yet", state == State.ARMED, ~story.must_end)
    lemma("budget_is_a_reason", timing.running & timing.last_line & ~timing.line, has_reason)
    lemma("over_for_a_reason", active & ~timing.running, has_reason)
    lemma("must_end_is_stopping", timing.running & seen.stopped, story.must_end)
    lemma("must_end_is_stopped", timing.running & story.must_end, seen.stopped)
    lemma("stopping_has_a_reason", state == State.STOPPING, has_reason)
    lemma("stopped_is_stopping", timing.running & story.must_end, state == State.STOPPING)
    lemma("idle_runs_nothing", ~active, ~timing.running)
    lemma("nothing_before_the_start", active & timing.running & ~seen.was_running, story.started_before)


def _pipeline(
    harness: Harness, commands: Commands, seen: Observer, story: Story, within: dict[str, Any]
) -> None:
    lemma = harness.lemma
    lemma("commanded", story.asked | story.answered | (commands.state == State.ARMED), story.commanded)
    lemma("commanded_once_asked", story.asked, story.since_command == 1)
    lemma("answered_after_asked", story.answered, story.since_command == 2)
    armed = commands.state == State.ARMED
    settling = within["settling"]
    lemma("settles", armed & (settling != 0), settling + story.since_arm == SETTLE_CLOCKS + 1)
    lemma("settled", armed & (settling == 0), story.since_arm > SETTLE_CLOCKS)
    lemma("commanded_before_armed", armed, story.since_arm + 1 >= story.since_command)
    lemma("settled_when_commanded", armed & story.asked, story.since_arm > SETTLE_CLOCKS)
    named = commands.run != 0
    lemma("named_is_decoded", story.asked, within["named"] == named)
    lemma("same_is_decoded", story.asked, within["same"] == ((commands.run == commands.current) & named))
    lemma("pending_is_asked", 1, within["pending"] == story.asked)
    lemma("done_is_answered", 1, commands.done == story.answered)
    lemma("begun_is_was_running", 1, within["begun"] == seen.was_running)
    for command, decoded in within["asked"].items():
        lemma(f"{command.name.lower()}_is_decoded", story.asked, decoded == (commands.command == command))
