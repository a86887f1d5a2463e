r"""A run whose host is silent for WATCHDOG clocks is over two lines later; without a run there is no light.

::

    running   ___/‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾\____
    feed      __________/‾\_____________________________      any time, or never: also before the first line
    silent       1 2 3 .. 1 2 3 ... period ... <= period + BARK_CLOCKS + two lines
    led       =====light or not=====================\____      PIN_CLOCKS behind

Part of the proof `runs`: the watchdog, the light, and the claims about both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from amaranth.hdl import Cat, Mux, Signal

from firmware.formal.harness import Harness, opened, times
from firmware.formal.timing import LINE_CLOCK_BITS, Observer
from firmware.light import Light
from firmware.timing import Timing
from firmware.top import PIN_CLOCKS
from firmware.watchdog import BARK_CLOCKS, Watchdog

if TYPE_CHECKING:
    from firmware.commands import Commands

SILENT_BITS = 33 + LINE_CLOCK_BITS


def silence_and_dark(
    harness: Harness, commands: Commands, timing: Timing, seen: Observer, leaving: Signal
) -> list[Signal]:
    """Make the claims; return the free inputs. ``leaving``: the last sub-step's light is over."""
    return [*_silence(harness, commands, timing, seen), *_dark(harness, timing, leaving)]


def _silence(harness: Harness, commands: Commands, timing: Timing, seen: Observer) -> list[Signal]:
    m, dog = harness.m, Watchdog()
    m.submodules.watchdog, inside = opened(dog)
    m.d.comb += [dog.enable.eq(timing.running), commands.watchdog.eq(dog.bark)]
    before, ran, fed, silent = Signal(32), Signal(), Signal(), Signal(SILENT_BITS)
    m.d.sync += [before.eq(dog.period), ran.eq(timing.running), fed.eq(dog.feed & timing.running)]
    harness.assume(~(timing.running | commands.arm | commands.start) | (before == dog.period))
    m.d.sync += silent.eq(Mux(dog.feed | ~timing.running, 0, silent + 1))
    watched = timing.running & (dog.period != 0)
    late = silent > dog.period  # clocks of silence before this one
    two_lines = times(timing.substep_clocks, timing.substeps, 6) << 1
    harness.claim("silence_stops_the_run", watched & late, timing.stop | seen.stopped)
    harness.claim("silence_ends_the_run", watched, silent <= dog.period + BARK_CLOCKS + two_lines)
    harness.claim("only_silence_makes_it_bark", commands.watchdog & timing.running, watched & late)
    harness.lemma("period_holds", timing.running, before == dog.period)
    harness.lemma("watching_is_known", timing.running, inside["watching"] == (dog.period != 0))
    left = inside["left"]
    counted = silent <= dog.period
    harness.lemma("left_is_what_is_left", timing.running & counted, left + silent == dog.period)
    harness.lemma("nothing_is_left", timing.running & ~counted, left == 0)
    harness.lemma("barks_when_nothing_is_left", timing.running, dog.bark == (watched & late))
    harness.lemma("stopped_since_the_bark", watched & (silent > dog.period + 1), seen.stopped)
    harness.lemma(
        "stopped_no_later",
        watched & seen.stopped & (silent > dog.period + 1),
        seen.since_stop + dog.period + 1 >= silent,
    )
    harness.lemma("silent_in_this_run", ~ran, silent == 0)
    harness.cover("ended_by_silence", late & watched & seen.was_running)
    return [dog.period, dog.feed]


def _dark(harness: Harness, timing: Timing, leaving: Signal) -> list[Signal]:
    m, light = harness.m, Light()
    m.submodules.light, inside = opened(light)
    m.d.comb += [light.advance.eq(timing.advance), light.ending.eq(timing.ending)]
    idle = Signal(PIN_CLOCKS, init=-1)  # the latest clock in bit 0; none has run before power-up
    m.d.sync += idle.eq(Cat(~timing.running, idle))
    dark = light.led == light.inverted
    harness.claim("no_light_without_a_run", idle.all(), dark)
    harness.lemma("unlit_without_a_run", ~timing.running, ~light.lit)
    harness.lemma("unlit_in_the_last_substep", timing.running & leaving, ~light.lit)
    harness.lemma("nothing_shown", idle[0], ~inside["shown"])
    harness.cover("lit", ~dark & timing.running)
    return [
        *(light.code_bit, light.enable, light.inverted, light.window_open, light.window_close),
        *(light.scene_enable, light.scene_gate),
    ]
