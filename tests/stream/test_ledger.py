"""Accounts of runs that are thought up: whatever happens to a pulse, it is in one place."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from acquire.stream.ledger import UNDELIVERED, Counted, account

lines = st.integers(0, 10_000)


@given(lines, lines, lines, lines, lines, lines, st.integers(0, 65), lines)
def test_what_is_counted_right_balances(
    stored: int, discarded: int, camera: int, ring: int, waiting: int, pending: int, preroll: int, owed: int
) -> None:
    came = stored + discarded + camera + ring + waiting
    preroll = 65 if came else preroll
    counted = Counted(
        pulses=preroll + came + pending,
        next_line=came + preroll - 65,
        depth=65,
        stored=stored,
        discarded=discarded,
        lost={"camera": camera, "ring_full": ring},
        room=10_000,
        block=10,
    )
    running = account(counted, closed=False)
    assert running.balanced
    assert (running.preroll, running.waiting, running.pending) == (preroll, waiting, pending)
    recorded_to = came + owed
    closed = account(replace(counted, discarded=discarded + waiting, recorded_to=recorded_to), closed=True)
    assert closed.balanced
    assert closed.lost.get(UNDELIVERED, 0) == min(owed, pending)
    for ledger in (running, closed):
        placed = ledger.preroll + ledger.stored + ledger.discarded + ledger.waiting + ledger.pending
        assert ledger.issued == placed + sum(ledger.lost.values())


COUNTED = Counted(1000, 900, 65, 500, 400, {"camera": 0}, 200, 20)


def test_a_line_that_nobody_knows_of_shows() -> None:
    assert account(COUNTED, closed=True).balanced
    assert not account(replace(COUNTED, stored=499), closed=True).balanced
    assert not account(replace(COUNTED, stored=501), closed=True).balanced
    assert not account(replace(COUNTED, lost={"camera": 1}), closed=True).balanced


def test_lines_without_a_pulse_show_once_the_pulses_are_known() -> None:
    phantom = replace(COUNTED, pulses=964)
    assert account(phantom, closed=False).issued == 965  # a tag may be late
    assert not account(phantom, closed=True).balanced


def test_more_lines_than_the_ring_holds_do_not_wait_there() -> None:
    assert not account(replace(COUNTED, discarded=100), closed=False).balanced
    assert not account(replace(COUNTED, discarded=700), closed=False).balanced
