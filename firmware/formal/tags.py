r"""No tag is lost silently: the tagger and its queue, however slowly the host takes them.

::

    lines, events ──▶ made ──▶ put ──▶ [ level ] ──▶ delivered
                        └────▶ lost: counted, a gap of that length in the sequence, TAGS_LOST in the next

    made == put + lost,  put == level + delivered,  events and the end of a run are never among the lost
"""

from __future__ import annotations

from typing import Any

from amaranth.hdl import Mux, Signal
from amaranth.lib.fifo import SyncFIFOBuffered

from acquire.trigger.registers import TagFlag
from firmware.fifo import Queue
from firmware.formal.harness import Harness, Proof, inputs_of, opened
from firmware.tagger import SEQUENCE_BITS, TAG_BITS, Tagger
from firmware.top import Build

FLAGS = slice(SEQUENCE_BITS + TAG_BITS - 16, SEQUENCE_BITS + TAG_BITS)
SOON = 1
"""Clocks with room and no line within which an event must have its tag."""


class Ledger:
    """Counts of tags put, lost and delivered, as observed at the ports."""

    def __init__(self, harness: Harness, tagger: Tagger, queue: Queue) -> None:
        m = harness.m
        self.put, self.all_put, self.delivered = Signal(32), Signal(32), Signal(32)
        self.known, self.last_sequence, self.lost_then = Signal(), Signal(SEQUENCE_BITS), Signal(32)
        self.owed, self.patience = Signal(16), Signal(range(SOON + 2))
        flags = tagger.entry[FLAGS]
        self.told = Mux(tagger.put & ~flags[0], flags, 0)
        self.just_come = just_come = Signal(16)  # while a tag was being made, hence in the next one
        m.d.sync += just_come.eq(tagger.events)
        m.d.sync += self.owed.eq((self.owed & ~self.told) | just_come | tagger.events)
        m.d.sync += self.delivered.eq(self.delivered + (queue.output.valid & queue.output.ready))
        with m.If(tagger.put):
            m.d.sync += [self.put.eq(self.put + 1), self.all_put.eq(self.all_put + 1), self.known.eq(1)]
            m.d.sync += [self.last_sequence.eq(tagger.entry[:SEQUENCE_BITS]), self.lost_then.eq(tagger.lost)]
        with m.If(self.owed.any() & ~tagger.full & ~tagger.line & ~tagger.put):
            m.d.sync += self.patience.eq(self.patience + 1)
        with m.Else():
            m.d.sync += self.patience.eq(0)
        with m.If(tagger.clear):
            m.d.sync += [signal.eq(0) for signal in (self.put, self.known, self.owed, self.lost_then)]
            m.d.sync += [self.patience.eq(0), just_come.eq(0)]


class Lines:
    """When a line has to be reported, and with which contents."""

    def __init__(self, harness: Harness, tagger: Tagger) -> None:
        m = harness.m
        self.begun, self.since, self.due = Signal(), Signal(24), Signal()
        self.was_due, self.number, self.time = Signal(), Signal(48), Signal(48)
        self.code_index = Signal(64)
        first = tagger.line_number == 0
        self.quiet = quiet = Signal(2)  # clocks without a line or a clear
        m.d.comb += self.due.eq(tagger.line & (~self.begun | (self.since == tagger.interval)))
        m.d.sync += self.was_due.eq(self.due)
        m.d.sync += quiet.eq(Mux(tagger.line | tagger.clear, 0, Mux(quiet.all(), quiet, quiet + 1)))
        harness.assume(~tagger.line | quiet.all())
        with m.If(tagger.line):
            m.d.sync += [
                self.begun.eq(1),
                self.since.eq(Mux(self.due, 1, self.since + 1)),
                self.number.eq(tagger.line_number),
                self.time.eq(tagger.now),
                self.code_index.eq(tagger.code_index),
            ]
        with m.If(tagger.clear):
            m.d.sync += self.begun.eq(0)
        before = Signal(24)
        m.d.sync += before.eq(tagger.interval)
        harness.assume(~self.begun | (tagger.interval == before))
        harness.assume(tagger.interval != 0)
        harness.assume(~tagger.line | (self.begun != first))
        harness.assume(~tagger.clear | (~tagger.line & ~self.was_due))


def tags_proof() -> Proof:
    harness, tagger, queue = Harness(), Tagger(), Queue(SEQUENCE_BITS + TAG_BITS, Build().tags)
    m = harness.m
    m.submodules.tagger, inside = opened(tagger)
    m.submodules.queue, fifo = opened(queue, SyncFIFOBuffered)
    m.d.comb += [queue.put.eq(tagger.put), queue.data.eq(tagger.entry), tagger.full.eq(queue.full)]
    harness.assume(~queue.flush)
    harness.assume(~tagger.clear | ~tagger.telling)  # `runs`: nothing is armed while the device is busy
    harness.assume((tagger.events & int(TagFlag.LINE | TagFlag.TAGS_LOST)) == 0)
    harness.assume(~tagger.lost.all())
    ledger, lines = Ledger(harness, tagger, queue), Lines(harness, tagger)
    _claims(harness, tagger, queue, ledger)
    _line_claims(harness, tagger, lines, inside)
    _lemmas(harness, tagger, queue, ledger, inside)
    _queue_lemmas(harness, fifo)
    harness.cover("event_told", tagger.put & (tagger.entry[FLAGS] == int(TagFlag.LAST)))
    harness.cover("third_delivered", ledger.delivered == 3)
    inputs = [signal for signal in inputs_of(tagger) if signal is not tagger.full]
    return harness.proof("tags", [*inputs, queue.output.ready, queue.flush], cover_depth=16)


def _claims(harness: Harness, tagger: Tagger, queue: Queue, ledger: Ledger) -> None:
    claim, flags = harness.claim, tagger.entry[FLAGS]
    gap = (tagger.entry[:SEQUENCE_BITS] - ledger.last_sequence - 1)[:SEQUENCE_BITS]
    lost = tagger.lost - ledger.lost_then
    still = ledger.owed & ~ledger.told
    claim("made_is_put_or_lost", 1, tagger.count == (ledger.put + tagger.lost)[:32])
    claim("put_is_delivered_or_waits", 1, ledger.all_put == (ledger.delivered + queue.level)[:32])
    claim("put_only_where_there_is_room", tagger.put, ~queue.full)
    claim("sequence_gap_is_what_was_lost", tagger.put & ledger.known, gap == lost[:SEQUENCE_BITS])
    first_gap = tagger.entry[:SEQUENCE_BITS] == tagger.lost[:SEQUENCE_BITS]
    claim("sequence_begins_at_what_was_lost", tagger.put & ~ledger.known, first_gap)
    claim("tags_lost_is_said", tagger.put, (flags & int(TagFlag.TAGS_LOST)).any() == (lost[:32] != 0))
    claim("the_end_is_told_before_the_next_run", tagger.clear, (still & int(TagFlag.LAST)) == 0)
    claim("events_wait_no_longer_than_they_must", 1, ledger.patience <= SOON)


def _line_claims(harness: Harness, tagger: Tagger, lines: Lines, inside: dict[str, Any]) -> None:
    entry, ready = tagger.entry, inside["ready"]
    run = entry.word_select(0, SEQUENCE_BITS)
    number, rest = entry[SEQUENCE_BITS + 32 :][:48], entry[SEQUENCE_BITS + 80 :]
    content = (number == lines.number) & (rest[:64] == lines.code_index) & (rest[64:112] == lines.time)
    of_line = (number == lines.number) & (rest[:64] == lines.code_index)
    harness.claim("every_due_line_makes_a_tag", lines.was_due, ready & entry[FLAGS][0])
    harness.claim("no_line_tag_but_a_due_line_s", ready & entry[FLAGS][0], lines.was_due)
    harness.claim("the_tag_is_of_its_line", lines.was_due, content & (run == tagger.count[:SEQUENCE_BITS]))
    now, event = Signal(48), ready & ~entry[FLAGS][0]
    harness.m.d.sync += now.eq(tagger.now)
    harness.claim("an_event_s_tag_has_its_time", event, rest[64:112] == now)
    harness.claim("an_event_is_of_the_latest_line", event & lines.begun, of_line)
    kept = (inside["line_number"] == lines.number) & (inside["code_index"] == lines.code_index)
    harness.lemma("the_latest_line_is_kept", lines.begun, kept)
    harness.lemma("due_is_due", 1, inside["due"] == lines.due)
    harness.lemma("begun_is_begun", 1, inside["begun"] == lines.begun)
    harness.lemma("none_ahead_of_the_first", ~lines.begun, inside["ahead"] == 0)
    harness.lemma("none_ahead_is_known", lines.quiet != 0, inside["none_ahead"] == (inside["ahead"] == 0))
    harness.lemma(
        "ahead_goes_with_since",
        lines.begun,
        (inside["ahead"] + lines.since == tagger.interval) & (lines.since != 0),
    )


def _lemmas(harness: Harness, tagger: Tagger, queue: Queue, ledger: Ledger, inside: dict[str, Any]) -> None:
    lemma, pending, flags = harness.lemma, inside["pending"], inside["flags"]
    event_ready = Mux(inside["ready"] & ~flags[0], flags, 0)
    lost = (tagger.lost - ledger.lost_then)[:32]
    lemma("just_come_waits", 1, (ledger.just_come & ~pending) == 0)
    lemma("none_else_waits_while_told", event_ready.any(), pending == ledger.just_come)
    lemma("owed_is_kept", 1, (pending | event_ready) == ledger.owed)
    lemma("pending_is_events", 1, (pending & int(TagFlag.LINE | TagFlag.TAGS_LOST)) == 0)
    lemma("flags_do_not_say_lost", inside["ready"], (flags & int(TagFlag.TAGS_LOST)) == 0)
    lemma("an_event_s_tag_finds_room", event_ready.any(), ~queue.full)
    lemma("hidden_says_lost", 1, inside["hidden"] == (lost != 0))
    lemma(
        "gap_grows_with_lost",
        ledger.known,
        (tagger.count - ledger.last_sequence - 1)[:SEQUENCE_BITS] == lost[:SEQUENCE_BITS],
    )
    lemma("nothing_put_yet", ~ledger.known, (ledger.put == 0) & (ledger.lost_then == 0))
    lemma("no_less_lost_than_then", 1, ledger.lost_then <= tagger.lost)
    lemma("patience_ends", ledger.patience != 0, event_ready.any())


def _queue_lemmas(harness: Harness, fifo: dict[str, Any]) -> None:
    """Lemma about the ring: the distance of its two ends is its fill level."""
    depth, level = fifo["inner_depth"], fifo["inner_level"]
    consume, produce = fifo["consume"], fifo["produce"]
    reach = consume + level
    harness.lemma("level_fits", 1, (level <= depth) & (consume < depth) & (produce < depth))
    harness.lemma("ends_of_the_ring", 1, produce == Mux(reach >= depth, reach - depth, reach))
    harness.claim(
        "no_word_is_read_while_it_is_written",
        fifo["w_port"].en & fifo["r_port"].en,
        fifo["w_port"].addr != fifo["r_port"].addr,
    )
