r"""The device's self test: it fills the code memory from the pseudo-random register, and checks the results.

::

    run      /‾\_____________________________________________
    busy     __/‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾\_
             seed | fill | seed | compare | sum | wait | done

After the fill, the register's state and the memory's CRC-32 must be those that Python computed when the
gateware was generated, and every word read back must equal that of a second run of the register.
"""

import zlib
from functools import cache

from amaranth.hdl import Elaboratable, Module, Signal
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out

from firmware.codememory import READ_LATENCY

MASK = 0xD800000000000000
"""Degree 64, taps 64, 63, 61, 60."""
SEED = 0x0123456789ABCDEF


@cache
def expected(words: int) -> tuple[int, int]:
    """Return the register's state after ``words`` steps, and the CRC-32 of earlier states' low halves."""
    state, crc = SEED, 0
    for _ in range(words):
        crc = zlib.crc32((state & 0xFFFFFFFF).to_bytes(4, "little"), crc)
        state = state >> 1 ^ (MASK if state & 1 else 0)
    return state, crc


class SelfTest(wiring.Component):
    """Uses register and memory exclusively while ``busy``."""

    def __init__(self, words: int) -> None:
        self._words = words
        bits = (words - 1).bit_length()
        super().__init__(
            {
                "run": In(1),
                "busy": Out(1),
                "done": Out(1),
                "memory_failed": Out(1),
                "prbs_failed": Out(1),
                "crc_failed": Out(1),
                "state": In(64),
                "load": Out(1),
                "step": Out(1),
                "address": Out(bits),
                "write": Out(1),
                "word": In(32),
                "check": Out(1),
                "check_busy": In(1),
                "crc": In(32),
            }
        )

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        state, crc = expected(self._words)
        wait = Signal(range(READ_LATENCY + 1))
        last = self.address == self._words - 1
        with m.FSM() as fsm:
            m.d.comb += self.busy.eq(~fsm.ongoing("IDLE"))
            with m.State("IDLE"):
                with m.If(self.run):
                    m.d.sync += [self.memory_failed.eq(0), self.prbs_failed.eq(0), self.crc_failed.eq(0)]
                    m.next = "SEED"
            with m.State("SEED"):
                m.d.comb += self.load.eq(1)
                m.d.sync += self.address.eq(0)
                m.next = "FILL"
            with m.State("FILL"):
                m.d.comb += [self.write.eq(1), self.step.eq(1)]
                m.d.sync += self.address.eq(self.address + 1)
                with m.If(last):
                    m.next = "SEED AGAIN"
            with m.State("SEED AGAIN"):
                m.d.comb += self.load.eq(1)
                m.d.sync += [self.address.eq(0), wait.eq(0), self.prbs_failed.eq(self.state != state)]
                m.next = "COMPARE"
            with m.State("COMPARE"):
                m.d.sync += wait.eq(wait + 1)
                with m.If(wait == READ_LATENCY):
                    m.d.comb += self.step.eq(1)
                    m.d.sync += [wait.eq(0), self.address.eq(self.address + 1)]
                    with m.If(self.word != self.state[:32]):
                        m.d.sync += self.memory_failed.eq(1)
                    with m.If(last):
                        m.next = "SUM"
            with m.State("SUM"):
                m.d.comb += self.check.eq(1)
                m.next = "WAIT"
            with m.State("WAIT"):
                with m.If(~self.check_busy):
                    m.d.sync += [self.crc_failed.eq(self.crc != crc), self.done.eq(1)]
                    m.next = "IDLE"
        return m
