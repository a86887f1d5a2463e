r"""A bounded queue in block RAM whose output comes from a register, never from the RAM itself.

::

    clk        _/‾\_/‾\_/‾\_/‾\_
    w_en       _/‾‾‾\___________
    r_valid    _________________/‾‾‾‾      a few clocks later; payload holds until ready
"""

from amaranth.hdl import Elaboratable, Module
from amaranth.lib import stream, wiring
from amaranth.lib.fifo import SyncFIFOBuffered
from amaranth.lib.wiring import In, Out


class Queue(wiring.Component):
    """``depth`` entries of ``width`` bits. A put while ``full`` is ignored: the caller counts it as lost."""

    def __init__(self, width: int, depth: int) -> None:
        self.width, self.depth = width, depth
        super().__init__(
            {
                "put": In(1),
                "data": In(width),
                "full": Out(1),
                "flush": In(1),  # forget everything
                "level": Out(range(depth + 2)),
                "output": Out(stream.Signature(width)),
            }
        )

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        m.submodules.fifo = fifo = SyncFIFOBuffered(width=self.width, depth=self.depth)
        m.d.comb += [
            fifo.w_data.eq(self.data),
            fifo.w_en.eq(self.put & ~self.full),
            self.full.eq(~fifo.w_rdy),
            fifo.r_en.eq(~self.output.valid | self.output.ready | self.flush),
            self.level.eq(fifo.level + self.output.valid),
        ]
        with m.If(fifo.r_en):
            m.d.sync += [
                self.output.valid.eq(fifo.r_rdy & ~self.flush),
                self.output.payload.eq(fifo.r_data),
            ]
        return m
