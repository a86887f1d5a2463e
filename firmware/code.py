r"""The code bit of the next sub-step, from the source of the run.

::

    load   /‾\________________________     index 0
    step   _________/‾\_______/‾\_____     one per sub-step
    bit    ----X b0     X b1     X b2      at least four clocks before the step that leaves it
    first  _________X s(line's first bit)  the register's state behind CODE_STATE
"""

from amaranth.hdl import Elaboratable, Module, Mux
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out

from acquire.trigger import registers as r
from acquire.trigger.registers import Source
from firmware.codememory import CodeMemory
from firmware.lfsr import Lfsr
from firmware.registerfile import RegisterFile
from firmware.selftest import MASK, SEED, SelfTest


class CodeSource(wiring.Component):
    def __init__(self, file: RegisterFile, words: int) -> None:
        self._file, self._words = file, words
        bits = (words - 1).bit_length()
        super().__init__(
            {
                "load": In(1),
                "step": In(1),
                "line_first": In(1),  # with `step`: the bit that is left begins a line
                "bit": Out(1),
                "host_address": In(bits),
                "host_read": In(1),
                "host_data": Out(32),
                "host_write": In(1),
                "host_word": In(32),
                "changed": In(1),  # CODE_LENGTH is written
                "check": In(1),
                "self_test": In(1),
                "busy": Out(1),
                "checked": Out(1),
            }
        )

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        value, field = self._file.value, self._file.field
        m.submodules.lfsr = lfsr = Lfsr()
        m.submodules.memory = memory = CodeMemory(self._words)
        m.submodules.test = test = SelfTest(self._words)
        whole = 32 * self._words
        m.d.comb += [
            lfsr.mask.eq(Mux(test.busy, MASK, value(r.PRBS_MASK))),
            lfsr.seed.eq(Mux(test.busy, SEED, value(r.PRBS_SEED))),
            lfsr.load.eq(self.load | test.load),
            lfsr.step.eq(self.step | test.step),
            memory.length.eq(Mux(test.busy, whole, value(r.CODE_LENGTH))),
            memory.load.eq(self.load),
            memory.step.eq(self.step),
            memory.write.eq(self.host_write | test.write),
            memory.write_address.eq(Mux(test.busy, test.address, self.host_address)),
            memory.write_data.eq(Mux(test.busy, lfsr.state[:32], self.host_word)),
            memory.host_read.eq(test.busy | self.host_read),
            memory.host_address.eq(Mux(test.busy, test.address, self.host_address)),
            memory.check.eq(self.check | test.check),
            self.host_data.eq(memory.host_data),
            test.run.eq(self.self_test),
            test.state.eq(lfsr.state),
            test.word.eq(memory.host_data),
            test.check_busy.eq(memory.busy),
            test.crc.eq(memory.crc),
            self.busy.eq(memory.busy | test.busy),
            value(r.CODE_CRC).eq(memory.crc),
            value(r.SELF_TEST).eq(
                r.SELF_TEST.pack(done=1) * test.done
                | r.SELF_TEST.pack(memory_failed=1) * test.memory_failed
                | r.SELF_TEST.pack(prbs_failed=1) * test.prbs_failed
                | r.SELF_TEST.pack(crc_failed=1) * test.crc_failed
            ),
        ]
        with m.Switch(field(r.CODE_SOURCE, "kind")):
            with m.Case(Source.CONSTANT):
                m.d.comb += self.bit.eq(field(r.CODE_SOURCE, "value"))
            with m.Case(Source.PRBS):
                m.d.comb += self.bit.eq(lfsr.bit)
            with m.Case(Source.MEMORY):
                m.d.comb += self.bit.eq(memory.bit)
        with m.If(self.step & self.line_first):
            m.d.sync += value(r.CODE_STATE).eq(lfsr.state)
        with m.If(self.host_write | self.changed | self.self_test):
            m.d.sync += self.checked.eq(0)
        with m.Elif(self.check):
            m.d.sync += self.checked.eq(1)
        return m
