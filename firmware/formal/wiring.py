"""The parts are connected as the other proofs assume: the whole trigger, from the registers to the pins.

Only the link, the host's side and the source of the code are removed; their outputs are arbitrary.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

from amaranth.hdl import Cat, Elaboratable, Module, Mux, Signal, Value
from amaranth.lib.wiring import Out

from acquire.trigger import registers as r
from acquire.trigger.registers import LineMode
from firmware import top
from firmware.formal.harness import Harness, Proof, inputs_of, opened
from firmware.inputs import LATENCY
from firmware.light import Light
from firmware.top import PIN_CLOCKS, Build, SyncTrigger

if TYPE_CHECKING:
    from firmware.pulse import Pulse
    from firmware.watchdog import Watchdog

FREE = ("Host", "CodeSource", "Deframer", "Framer", "UartReceiver", "UartTransmitter")

STROBE_COUNTERS = ("SEEN", "MISSED", "UNEXPECTED")

DEPTH = LATENCY + 3
"""Clocks until every pipeline holds what the last clocks have put into it."""


def wiring_proof() -> Proof:
    harness, trigger = Harness(), SyncTrigger(Build(tags=16, rx_bytes=16))
    outputs: list[Signal] = []
    with ExitStack() as stack:
        for name in FREE:
            stack.enter_context(patch.object(top, name, _free(getattr(top, name), outputs)))
        harness.m.submodules.trigger, local, light = opened(trigger, SyncTrigger, Light)
    parts = local["m"].submodules
    _settings(harness, trigger, parts)
    _commands(harness, trigger)
    _watchdog(harness, trigger, parts.watchdog)
    _witnesses(harness, trigger, parts)
    _pins(harness, trigger)
    _light(harness, trigger, light)
    _tags(harness, trigger)
    harness.cover("a_line", trigger.line)
    return harness.proof("wiring", [*inputs_of(trigger), *outputs], cover_depth=24, depth=DEPTH)


def _free(kind: type, outputs: list[Signal]) -> type:
    """The same ports with nothing behind them."""

    class Free(kind):
        def elaborate(self, platform: object) -> Elaboratable:
            members = self.signature.flatten(self)
            outputs.extend(Value.cast(signal) for _, member, signal in members if member.flow == Out)
            return Module()

    return Free


def _equal(harness: Harness, name: str, left: Value, right: Value) -> None:
    harness.claim(name, 1, left == right)


def _settings(harness: Harness, trigger: SyncTrigger, parts: Any) -> None:
    file, timing, checks = trigger.file, trigger.timing, trigger.checks
    _equal(harness, "substep_is_the_register_s", timing.substep_clocks, file.value(r.SUBSTEP_CLOCKS))
    _equal(harness, "S_is_the_register_s", timing.substeps, file.field(r.LINE, "substeps"))
    _equal(harness, "lead_is_the_register_s", timing.lead, file.field(r.LED, "lead"))
    _equal(harness, "lines_are_the_register_s", timing.lines, file.value(r.LINE_BUDGET))
    _equal(harness, "what_is_refused_is_told", trigger.commands.config_error, checks.error)
    _equal(harness, "clock_is_checked", checks.clock_locked, trigger.locked.level)
    per_substep = file.field(r.LINE, "mode") == LineMode.PER_SUBSTEP
    fire = Mux(per_substep, timing.substep, timing.line)
    for arm, settings, delay, width in (
        ("a", r.TRIGGER_A, r.TRIGGER_A_DELAY, r.TRIGGER_A_WIDTH),
        ("b", r.TRIGGER_B, r.TRIGGER_B_DELAY, r.TRIGGER_B_WIDTH),
    ):
        pulse: Pulse = getattr(parts, f"pulse_{arm}")
        given = Cat(pulse.fire, pulse.enable, pulse.delay, pulse.width, pulse.inverted)
        enable, inverted = file.field(settings, "enable"), file.field(settings, "invert")
        wanted = Cat(fire, enable, file.value(delay), file.value(width), inverted)
        _equal(harness, f"pulse_{arm}_is_the_registers", given, wanted)
        _equal(harness, f"trigger_{arm}_is_the_pulse", getattr(trigger, f"trigger_{arm}"), pulse.level)
        direction = file.field(settings, "direction")
        _equal(harness, f"direction_{arm}_is_the_register_s", getattr(trigger, f"direction_{arm}"), direction)


def _commands(harness: Harness, trigger: SyncTrigger) -> None:
    commands, timing, file = trigger.commands, trigger.timing, trigger.file
    _equal(harness, "start_starts", timing.start, commands.start)
    _equal(harness, "stop_stops", timing.stop, commands.stop)
    _equal(harness, "running_is_running", commands.running, timing.running)
    _equal(harness, "budget_is_the_last_line", commands.budget, timing.last_line)
    _equal(harness, "lock_is_followed", commands.clock_locked, trigger.locked.level)
    harness.claim("no_run_over_an_end_untold", trigger.tagger.telling, ~commands.idle)
    pin, before = Signal(LATENCY), Signal()
    level = pin[-1] ^ file.field(r.EXTERNAL_ARM, "invert")  # of LATENCY clocks ago
    harness.m.d.sync += [pin.eq(Cat(trigger.external_arm, pin)), before.eq(level)]
    enabled = file.field(r.EXTERNAL_ARM, "enable")
    _equal(harness, "the_edge_is_the_pin_s", commands.edge, level & ~before & enabled)


def _watchdog(harness: Harness, trigger: SyncTrigger, watchdog: Watchdog) -> None:
    given = Cat(watchdog.enable, watchdog.feed, watchdog.period)
    wanted = Cat(trigger.timing.running, trigger.host.heard, trigger.file.value(r.WATCHDOG))
    _equal(harness, "it_watches_the_run_and_the_host", given, wanted)
    _equal(harness, "its_bark_is_heard", trigger.commands.watchdog, watchdog.bark)


def _witnesses(harness: Harness, trigger: SyncTrigger, parts: Any) -> None:
    """Strobes and seconds are those of their pins, and are reported in the host's registers."""
    file, m, stamp = trigger.file, harness.m, trigger.timestamp
    for arm in "ab":
        check, letter = getattr(trigger, f"camera_{arm}"), arm.upper()
        edge = _edge(harness, getattr(trigger, f"strobe_{arm}"))
        given = Cat(check.strobe, check.pulse, check.enable, check.clear)
        pulse = getattr(parts, f"pulse_{arm}").begin
        enabled = file.field(getattr(r, f"TRIGGER_{letter}"), "strobe")
        _equal(
            harness, f"strobes_{arm}_are_the_pin_s", given, Cat(edge, pulse, enabled, trigger.commands.arm)
        )
        counters = Cat(*(file.value(getattr(r, f"STROBE_{letter}_{name}")) for name in STROBE_COUNTERS))
        _equal(harness, f"strobes_{arm}_are_told", counters, Cat(check.seen, check.missed, check.unexpected))
    _equal(harness, "seconds_are_the_pin_s", stamp.edge, _edge(harness, trigger.pps))
    told = Cat(file.value(r.TIME), file.value(r.PPS_TIME), file.value(r.PPS_COUNT))
    _equal(harness, "seconds_are_told", told, Cat(stamp.now, stamp.pps_time, stamp.pps_count))
    armed, line_0, now, before = Signal(), Signal(), Signal(48), Signal(48)
    start_time = file.value(r.START_TIME)
    m.d.sync += [armed.eq(trigger.commands.arm), now.eq(stamp.now), before.eq(start_time)]
    m.d.sync += line_0.eq(trigger.timing.line & (trigger.timing.line_number == 0))
    wanted = Mux(armed, 0, Mux(line_0, now, before))
    harness.claim("start_time_is_that_of_line_0", ~_first_clock(harness), start_time == wanted)


def _first_clock(harness: Harness) -> Value:
    """The first clock: the one before it is unknown."""
    later = Signal()
    harness.m.d.sync += later.eq(1)
    return ~later


def _edge(harness: Harness, pin: Signal) -> Value:
    """Whether the pin rose LATENCY clocks ago."""
    levels = Signal(LATENCY + 1)
    harness.m.d.sync += levels.eq(Cat(pin, levels))
    return levels[-2] & ~levels[-1]


def _pins(harness: Harness, trigger: SyncTrigger) -> None:
    begun = Signal(PIN_CLOCKS)
    harness.m.d.sync += begun.eq(Cat(trigger.timing.line, begun))
    _equal(harness, "line_is_shown_as_late_as_a_pulse", trigger.line, begun[-1])
    _equal(harness, "running_is_shown", trigger.running, trigger.timing.running)


def _light(harness: Harness, trigger: SyncTrigger, inside: dict[str, Any]) -> None:
    """The pin shows the code bit of its sub-step, within the window, while the gate is open."""
    file, timing, m = trigger.file, trigger.timing, harness.m
    bit, clock, shown, glows = Signal(), Signal(24), Signal(), Signal()
    with m.If(timing.advance):
        m.d.sync += [bit.eq(trigger.code.bit & ~timing.ending), clock.eq(0)]
    with m.Else():
        m.d.sync += clock.eq(clock + 1)
    window = (clock >= file.value(r.WINDOW_OPEN)) & (clock < file.value(r.WINDOW_CLOSE))
    gate = ~file.field(r.LED, "gate_enable") | trigger.scene.level
    m.d.sync += shown.eq(bit & window & file.field(r.LED, "enable"))
    m.d.sync += glows.eq(shown & gate)
    harness.lemma("light_counts", 1, (inside["clock"] == clock) & (trigger.light.lit == bit))
    wanted = glows ^ file.field(r.LED, "invert")
    _equal(harness, "light_is_code_and_window_and_gate", trigger.led, wanted)
    _equal(harness, "code_goes_on_with_the_light", trigger.code.step, timing.advance)
    _equal(harness, "code_begins_anew_at_arm", trigger.code.load, trigger.commands.arm)


def _tags(harness: Harness, trigger: SyncTrigger) -> None:
    tagger, timing, queue, host = trigger.tagger, trigger.timing, trigger.tag_queue, trigger.host
    given = Cat(tagger.line, tagger.line_number, tagger.code_index, tagger.now, tagger.run, tagger.clear)
    commands = trigger.commands
    wanted = Cat(timing.line, timing.line_number, timing.code_index, trigger.timestamp.now)
    _equal(harness, "tags_are_of_the_run", given, Cat(wanted, commands.current[:32], commands.arm))
    _equal(harness, "tags_are_queued", Cat(queue.put, queue.data), Cat(tagger.put, tagger.entry))
    _equal(harness, "a_full_queue_is_told", tagger.full, queue.full)
    _equal(harness, "the_queue_is_never_flushed", queue.flush, Signal())
    handed = Cat(host.tags.valid, host.tags.payload, queue.output.ready)
    _equal(
        harness, "tags_are_handed_on", handed, Cat(queue.output.valid, queue.output.payload, host.tags.ready)
    )
    last = (tagger.events & commands.last) == commands.last
    harness.claim("the_end_is_an_event", 1, last)
