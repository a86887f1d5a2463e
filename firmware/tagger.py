r"""The trigger's unsolicited reports: every N-th line, and events, each with its time stamp.

::

    line       /‾\________________/‾\________________/‾\____
    events     __________/‾\________________________________     kept in `pending` until they have a tag
    put        ____/‾\_______/‾\____________________/‾\______     a line's tag goes first
    tag            LINE,FIRST    MISSED_A               LINE

A line's tag that finds the queue full is counted, and the next one that finds room reports it (TAGS_LOST). An
event waits for room together with its time stamp: the end of a run is always reported.
"""

from amaranth.hdl import Cat, Elaboratable, Module, Mux, Signal
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out

from acquire.trigger.registers import TAG_FIELDS, TIME_BITS, TagFlag

TAG_BITS = sum(bits for _, bits in TAG_FIELDS)
SEQUENCE_BITS = 16


class Tagger(wiring.Component):
    run: In(32)
    interval: In(24)
    clear: In(1)
    now: In(TIME_BITS)
    line: In(1)
    line_number: In(48)
    code_index: In(64)
    """Of the latest line, from ``line`` on."""
    external: In(1)
    """The run was started by the external edge."""
    events: In(16)
    """TagFlag bits, each high for one clock or more."""
    full: In(1)

    put: Out(1)
    entry: Out(SEQUENCE_BITS + TAG_BITS)
    """The frame's sequence, then the tag."""
    count: Out(32)
    lost: Out(32)
    telling: Out(1)
    """The end of a run waits for room: no other may be armed."""

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        pending, flags = Signal(16), Signal(16)
        ahead, none_ahead, begun, ready, hidden = Signal(24), Signal(), Signal(), Signal(), Signal()
        line_number, code_index, time = Signal(48), Signal(64), Signal(TIME_BITS)
        due = Signal()
        told = flags | Mux(hidden, int(TagFlag.TAGS_LOST), 0)
        m.d.comb += [
            due.eq(self.line & none_ahead),
            self.entry.eq(Cat(self.count[:SEQUENCE_BITS], self.run, line_number, code_index, time, told)),
            self.put.eq(ready & ~self.full),
            self.telling.eq((pending & int(TagFlag.LAST)).any()),
        ]
        m.d.sync += [ready.eq(0), pending.eq(pending | self.events)]
        m.d.sync += none_ahead.eq(ahead == 0)  # in time: lines are at least five clocks apart
        with m.If(self.line):
            m.d.sync += [line_number.eq(self.line_number), code_index.eq(self.code_index), begun.eq(1)]
            m.d.sync += ahead.eq(Mux(due, self.interval, ahead) - 1)
        with m.If(due):
            first = int(TagFlag.FIRST) | Mux(self.external, int(TagFlag.EXTERNAL), 0)
            m.d.sync += [
                ready.eq(1),
                time.eq(self.now),
                flags.eq(int(TagFlag.LINE) | Mux(begun, 0, first)),
            ]
        # Not in the clock of a line, since both would be put at once, and not while the previous entry is
        # still in the registers (`ready`).
        with m.Elif(pending.any() & ~self.line & ~self.full & ~ready):
            m.d.sync += [ready.eq(1), time.eq(self.now), flags.eq(pending), pending.eq(self.events)]
        with m.If(ready):
            m.d.sync += [self.count.eq(self.count + 1), hidden.eq(self.full)]
            with m.If(self.full):
                m.d.sync += self.lost.eq(self.lost + 1)
        with m.If(self.clear):
            m.d.sync += [
                self.count.eq(0),
                self.lost.eq(0),
                ahead.eq(0),
                begun.eq(0),
                hidden.eq(0),
                ready.eq(0),
                pending.eq(0),
                line_number.eq(0),
                code_index.eq(0),
            ]
        return m
