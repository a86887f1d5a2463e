"""Every pair of state and event, against the drawing written out a second time."""

from __future__ import annotations

import itertools

import pytest

from acquire.daemon.states import COMMANDS, Event, State, after, commands
from acquire.errors import StateError

ARROWS = """
idle arm armed
armed start recording
armed mark armed
armed disarm idle
armed fault faulted
recording mark recording
recording stop draining
recording ended draining
recording fault faulted
draining mark draining
draining sealed armed
draining released idle
draining fault faulted
faulted disarm idle
"""
DRAWN = {(State(a), Event(e)): State(b) for a, e, b in (row.split() for row in ARROWS.split("\n") if row)}
PAIRS = list(itertools.product(State, Event))


@pytest.mark.parametrize(("state", "event"), PAIRS)
def test_pair(state: State, event: Event) -> None:
    if (state, event) in DRAWN:
        assert after(state, event) is DRAWN[state, event]
        return
    with pytest.raises(StateError) as caught:
        after(state, event)
    assert state in caught.value.message
    assert event in caught.value.message
    allowed = {e for s, e in DRAWN if s is state} & set(COMMANDS)
    assert set(caught.value.possible.split(", ")) == allowed


@pytest.mark.parametrize("state", State)
def test_every_state_leads_back_to_idle(state: State) -> None:
    reached, frontier = {state}, {state}
    while frontier:
        frontier = {b for (a, _), b in DRAWN.items() if a in frontier} - reached
        reached |= frontier
    assert State.IDLE in reached


def test_commands_are_what_the_table_allows() -> None:
    assert commands(State.ARMED) == (Event.START, Event.MARK, Event.DISARM)
    assert commands(State.DRAINING) == (Event.MARK,)
