"""The wire: exact pulse counts, no torn readings, bounded waits."""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sim_helpers import CODE, ManualClock, watching_child

from acquire.errors import DeviceError, UsageError
from acquire.sim import clock as clock_module
from acquire.sim.clock import PulseTrain, Wire

CODE_ATTRS = CODE.to_attrs()
LINE_PERIOD_NS = Fraction(30_000)


@pytest.fixture
def clock():
    return ManualClock()


@pytest.fixture
def wire(clock):
    wire = Wire(clock)
    yield wire
    wire.close()


@pytest.mark.parametrize("speed", ["0.5", "1", "50"])
def test_pulses_keep_pace_with_the_clock_times_the_speed(wire, clock, speed):
    train = wire.start(LINE_PERIOD_NS, Fraction(speed), CODE_ATTRS)
    assert train.start_ns == clock.now_ns
    for elapsed_ns in (0, 599, 600, 29_999, 30_000, 59_999, 60_000, 1_000_003, 86_400 * 10**9 + 1):
        clock.now_ns = train.start_ns + elapsed_ns
        simulated_lines = Fraction(elapsed_ns) * Fraction(speed) / 30_000
        assert wire.read().issued == int(simulated_lines) + 1


def test_a_fractional_line_period_does_not_drift(wire, clock):
    train = wire.start(Fraction(10**9, 600_000), Fraction(1), CODE_ATTRS)  # 600 kHz: 1666.66… ns
    clock.now_ns = train.start_ns + 3600 * 10**9
    assert wire.read().issued == 3600 * 600_000 + 1
    clock.now_ns -= 1
    assert wire.read().issued == 3600 * 600_000


@given(
    pulse=st.integers(0, 10**12),
    period=st.fractions(Fraction(1, 7), 10**7, max_denominator=10**9),
    speed=st.fractions(Fraction(1, 1000), 1000, max_denominator=10**6),
    start_ns=st.integers(0, 2**62),
)
@settings(deadline=None)
def test_a_pulse_is_due_at_the_first_nanosecond_that_counts_it(pulse, period, speed, start_ns):
    train = PulseTrain(1, start_ns, period, speed, CODE_ATTRS)
    due_ns = train.due_ns(pulse)
    assert train.issued(due_ns) >= pulse + 1
    assert train.issued(due_ns - 1) <= pulse
    assert due_ns - 1 < start_ns + pulse * period / speed <= due_ns


def test_nothing_is_issued_before_a_start_in_the_future(wire, clock):
    start_ns = clock.now_ns + 5_000_000
    wire.start(LINE_PERIOD_NS, Fraction(1), CODE_ATTRS, start_ns=start_ns)
    assert (wire.read().issued, wire.read().running) == (0, True)
    assert wire.wait(1, 1, timeout_s=1.0).issued == 1
    assert clock.now_ns == start_ns


def test_a_start_in_the_past_has_issued_pulses_already(wire, clock):
    wire.start(LINE_PERIOD_NS, Fraction(1), CODE_ATTRS, start_ns=clock.now_ns - 300_000)
    assert wire.read().issued == 11


def test_stop_keeps_the_count_and_is_idempotent(wire, clock):
    assert wire.stop() == 0
    wire.start(LINE_PERIOD_NS, Fraction(1), CODE_ATTRS)
    clock.now_ns += 100_000
    assert wire.stop() == 4
    clock.now_ns += 10**9
    assert wire.stop() == 4
    assert (wire.read().issued, wire.read().stopped) == (4, True)


def test_a_train_cannot_start_while_another_runs_but_after_it(wire, clock):
    first = wire.start(LINE_PERIOD_NS, Fraction(1), CODE_ATTRS)
    with pytest.raises(DeviceError, match="train 1 is still running"):
        wire.start(LINE_PERIOD_NS, Fraction(1), CODE_ATTRS)
    wire.stop()
    second = wire.start(LINE_PERIOD_NS, Fraction(2), {"kind": "constant", "value": 1})
    assert (first.run, second.run) == (1, 2)
    assert wire.read().train == second


def test_wait_ends_when_the_pulse_is_due_and_not_before(wire, clock):
    train = wire.start(LINE_PERIOD_NS, Fraction(1), CODE_ATTRS)
    assert wire.wait(1, 101, timeout_s=10.0).issued == 101
    assert train.due_ns(100) <= clock.now_ns < train.due_ns(101)


def test_wait_is_bounded_with_and_without_a_train(wire, clock):
    begin_ns = clock.now_ns
    assert wire.wait(1, 1, timeout_s=0.25).train is None
    assert clock.now_ns - begin_ns == pytest.approx(0.25e9, rel=1e-3)
    wire.start(LINE_PERIOD_NS, Fraction(1), CODE_ATTRS)
    begin_ns = clock.now_ns
    assert wire.wait(1, 10**9, timeout_s=0.25).running
    assert clock.now_ns - begin_ns == pytest.approx(0.25e9, rel=1e-3)


def test_wait_notices_a_start_and_a_stop(wire, clock):
    clock.on_sleep = lambda: wire.read().train or wire.start(LINE_PERIOD_NS, Fraction(1), CODE_ATTRS)
    assert wire.wait(1, 5, timeout_s=1.0).issued == 5
    clock.on_sleep = wire.stop
    begin_ns = clock.now_ns
    assert wire.wait(1, 10**6, timeout_s=1.0).stopped
    assert clock.now_ns - begin_ns < 0.01e9


def test_a_code_that_does_not_fit_is_refused_and_leaves_the_wire_whole(wire):
    with pytest.raises(UsageError, match="too long for the wire"):
        wire.start(LINE_PERIOD_NS, Fraction(1), {"kind": "x" * 5000})
    assert wire.read().train is None


@pytest.mark.parametrize("place", [0, clock_module._PAYLOAD_AT + 3])
def test_a_torn_record_is_never_accepted(wire, monkeypatch, place):
    """A writer that died half-way: its sequence is odd, or the bytes do not match their checksum."""
    monkeypatch.setattr(clock_module, "_TORN_S", 0.02)
    wire.start(LINE_PERIOD_NS, Fraction(1), CODE_ATTRS)
    wire._known = (0, None)
    wire._page[place] ^= 1
    with pytest.raises(DeviceError, match="died"):
        wire.read()


def test_a_stop_in_the_middle_of_a_reading_is_noticed(wire, clock):
    """The reader holds the running train, then the writer stops it, then time passes: the stop counts."""
    late = ManualClock()
    reader = Wire.__new__(Wire)
    reader._attach(os.dup(wire._descriptor), late)
    train = wire.start(LINE_PERIOD_NS, Fraction(1), CODE_ATTRS)
    assert reader.read().running

    def stop_then_look_at_the_clock():
        if not wire.read().stopped:
            wire.stop()
        return train.start_ns + 10**9

    late.monotonic_ns = stop_then_look_at_the_clock
    assert (reader.read().issued, reader.read().stopped) == (1, True)
    reader.close()


def test_no_other_process_ever_sees_a_pulse_that_a_stop_cut_off():
    wire = Wire()
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    child = context.Process(target=watching_child, args=(wire, theirs), daemon=True)
    child.start()
    issued = {}
    try:
        assert ours.poll(30)
        ours.recv()
        for run in range(1, 401):
            wire.start(Fraction(50), Fraction(1), CODE_ATTRS)  # 20 MHz: every look sees another count
            wire.wait(run, 5_000, timeout_s=5.0)
            issued[run] = wire.stop()
        ours.send("enough")
        assert ours.poll(30)
        most, looks = ours.recv()
        child.join(300)
        assert child.exitcode == 0
    finally:
        child.kill()
        wire.close()
    assert looks > 100
    assert len(most) > 10, "the child saw too few runs to say anything"
    assert {run: count for run, count in most.items() if run and count > issued[run]} == {}


def test_a_wire_goes_to_spawned_children_only(wire):
    with pytest.raises(RuntimeError, match="through inheritance"):
        pickle.dumps(wire)


def test_a_closed_or_collected_wire_leaves_no_descriptor():
    wire = Wire()
    descriptor = wire._descriptor
    wire.close()
    wire.close()
    with pytest.raises(OSError, match="descriptor"):
        os.fstat(descriptor)
    wire = Wire()
    descriptor = wire._descriptor
    del wire
    gc.collect()
    with pytest.raises(OSError, match="descriptor"):
        os.fstat(descriptor)
