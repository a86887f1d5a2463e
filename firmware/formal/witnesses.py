r"""Inputs are reported exactly: strobes relative to pulses, and the instant of a second.

::

    pulse       /‾\_________/‾\_________/‾\______     a strobe belongs to the pulse before it, if that has
    strobe      ____/‾\_______/‾\______/‾\_/‾\___     none yet; in a pulse's own clock it comes too late for
    missed                              +1           the one before and too early for this one
    unexpected               +1              +1
"""

from __future__ import annotations

from amaranth.hdl import Mux, Signal

from firmware.formal.harness import Harness, Proof, inputs_of, opened
from firmware.strobes import StrobeCheck
from firmware.timestamp import Timestamp


def witnesses_proof() -> Proof:
    harness = Harness()
    check, stamp = StrobeCheck(), Timestamp()
    harness.m.submodules.check, inside = opened(check)
    harness.m.submodules.stamp = stamp
    _strobes(harness, check, inside["owed"])
    _seconds(harness, stamp)
    return harness.proof("witnesses", [*inputs_of(check), *inputs_of(stamp)], cover_depth=8)


def _strobes(harness: Harness, check: StrobeCheck, owed: Signal) -> None:
    m, claim = harness.m, harness.claim
    waits, pulses, strobes, answered = Signal(), Signal(32), Signal(32), Signal(32)
    enabled = Signal()
    m.d.sync += enabled.eq(check.enable)
    harness.assume((check.enable == enabled) | check.clear)  # configuration
    with m.If(check.clear):
        m.d.sync += [signal.eq(0) for signal in (waits, pulses, strobes, answered)]
    with m.Else():
        m.d.sync += [
            waits.eq(Mux(check.pulse, 1, waits & ~check.strobe)),
            pulses.eq(pulses + check.pulse),
            strobes.eq(strobes + check.strobe),
            answered.eq(answered + (check.strobe & waits & ~check.pulse)),
        ]
    late = Signal(32)  # strobes that came in the clock of the next pulse: counted with the missed
    with m.If(check.clear):
        m.d.sync += late.eq(0)
    with m.Elif(check.strobe & check.pulse & waits):
        m.d.sync += late.eq(late + 1)
    claim("every_strobe_is_seen", enabled, check.seen == strobes)
    claim("pulses_are_answered_missed_or_wait", enabled, pulses == (answered + check.missed + waits)[:32])
    claim(
        "strobes_answer_or_come_late_or_unasked",
        enabled,
        strobes == (answered + late + check.unexpected)[:32],
    )
    claim(
        "off_it_counts_nothing", ~enabled, (check.seen == 0) & (check.missed == 0) & (check.unexpected == 0)
    )
    for what in ("missed", "unexpected"):
        count, told, before = getattr(check, what), getattr(check, f"first_{what}"), Signal()
        m.d.sync += before.eq(told & ~check.clear)
        claim(f"the_first_{what}_is_told", before, count == 1)
        claim(f"no_other_{what}_is_told", told, count == 0)
    harness.lemma("owed_is_waited_for", 1, owed == waits)
    harness.lemma("nothing_yet_while_off", ~enabled, check.seen == 0)
    harness.cover("late", late == 1)
    harness.cover("unexpected", check.unexpected == 2)


def _seconds(harness: Harness, stamp: Timestamp) -> None:
    m, claim = harness.m, harness.claim
    time, instant, seconds, known = Signal(48), Signal(48), Signal(32), Signal()
    m.d.sync += time.eq(time + 1)
    with m.If(stamp.edge):
        m.d.sync += [instant.eq(time), seconds.eq(seconds + 1), known.eq(1)]
    claim("time_counts_clocks", 1, stamp.now == time)
    claim("a_second_has_the_time_of_its_edge", known, stamp.pps_time == instant)
    claim("seconds_are_counted", 1, (stamp.pps_count == seconds) & (stamp.pps_seen == known))
    harness.cover("two_seconds", seconds == 2)
