r"""Every request is answered by exactly one camera pulse, with exactly the configured delay.

::

    fire    _/‾\___________________________/‾\____     >= distance apart: see `timing`
    level   ____________/‾‾‾‾‾‾‾‾\___________________     delay + 2 clocks later, for width clocks
             |<-delay+2->|<-width>|

Pulses are therefore exactly as far apart as the requests: no jitter is added here, and with `settings`'
claim that the distance is at least CAMERA_MIN_PERIOD no two are closer than the camera can take.
"""

from __future__ import annotations

from amaranth.hdl import Cat, Signal

from firmware.formal.harness import Harness, Proof, inputs_of, opened
from firmware.pulse import WIDTH, Pulse

DISTANCE_BITS = WIDTH + 3


def pulses_proof() -> Proof:
    harness, pulse = Harness(), Pulse()
    m, claim, lemma = harness.m, harness.claim, harness.lemma
    fragment, inside = opened(pulse)
    m.submodules.pulse = fragment
    distance, fired, since = Signal(DISTANCE_BITS), Signal(), Signal(DISTANCE_BITS + 1)
    begins, known = Signal(), Signal()
    settings = Cat(pulse.enable, pulse.delay, pulse.width, pulse.inverted, distance)
    before = Signal(len(settings))
    m.d.sync += [before.eq(settings), known.eq(1)]
    harness.assume(~known | (before == settings))
    harness.assume((pulse.width != 0) & (pulse.delay + pulse.width < distance))
    harness.assume(~pulse.fire | ~fired | (since >= distance))
    harness.lemma("settings_hold", fired, known & (before == settings))
    with m.If(pulse.fire & pulse.enable):
        m.d.sync += [fired.eq(1), since.eq(1), begins.eq(0)]
    with m.Elif(~since.all()):
        m.d.sync += since.eq(since + 1)
    with m.If(pulse.begin):
        m.d.sync += begins.eq(1)
    first, end = pulse.delay + 1, pulse.delay + 1 + pulse.width
    due = fired & (since >= first) & (since < end)
    was_due, was_inverted = Signal(), Signal()
    m.d.sync += [was_due.eq(due), was_inverted.eq(pulse.inverted)]
    claim("level_is_the_pulse_and_nothing_else", known, pulse.level == (was_due ^ was_inverted))
    claim("begin_is_the_pulse_s_first_clock", fired, pulse.begin == (due & (since == first)))
    claim("one_pulse_per_request", pulse.begin, ~begins)
    claim("nothing_without_a_request", pulse.begin, fired)
    wait, hold, waiting, active = (inside[name] for name in ("wait", "hold", "waiting", "active"))
    lemma("waits_for_the_delay", waiting, fired & (since + wait == pulse.delay) & (hold == pulse.width))
    lemma("holds_for_the_width", active, fired & (since + hold == end) & (hold != 0) & (hold <= pulse.width))
    lemma("waits_or_holds", waiting, ~active)
    lemma("rests_after_it", fired & ~waiting & ~active, since >= end)
    lemma("begun_after_its_first_clock", fired & (since > first), begins)
    lemma("not_begun_before", fired & (since <= first), ~begins)
    harness.cover("two_pulses", pulse.begin & (pulse.delay == 2) & (pulse.width == 3) & known)
    return harness.proof("pulses", [*inputs_of(pulse), distance], cover_depth=12)
