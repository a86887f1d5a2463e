"""The ULX3S with its own USB socket (US2, full speed) for the link in place of the FTDI's UART.

::

    25 MHz ─▶ PLL · 18 / 5 ─┬▶ 90 MHz           sync
                            └▶ PLL 480 MHz ─┬▶ 48 MHz  usb_io    finds the bits on D+ and D−
                                            └▶ 12 MHz  usb       everything else of USB
"""

from dataclasses import replace
from types import SimpleNamespace

from amaranth.hdl import ClockDomain, ClockSignal, Elaboratable, Instance, IOPort, Module, Signal, Value

from firmware.boards import ulx3s
from firmware.boards.ulx3s import Ulx3s
from firmware.usb import UsbSyncTrigger

PINS = {**ulx3s.PINS, "usb_dp": "D15", "usb_dn": "E15", "usb_pullup": "B12"}


class Ulx3sUsb(Ulx3s):
    sites = PINS

    def __init__(self, light_low: bool = False) -> None:
        self.lines = {name: SimpleNamespace(i=Signal(), o=Signal(), oe=Signal()) for name in ("d_p", "d_n")}
        self.pullup = Signal(name="usb_pullup")
        bus = SimpleNamespace(**self.lines, pullup=SimpleNamespace(o=self.pullup))
        super().__init__(UsbSyncTrigger(replace(ulx3s.BUILD, light_low=light_low), bus))
        self.pads = {"d_p": IOPort(1, name="usb_dp"), "d_n": IOPort(1, name="usb_dn")}

    @property
    def ports(self) -> list[Signal | IOPort]:
        return [*super().ports, self.pullup, *self.pads.values()]

    def elaborate(self, platform: object) -> Elaboratable:
        m = super().elaborate(platform)
        assert isinstance(m, Module)
        m.domains.usb, m.domains.usb_io = usb, usb_io = (
            ClockDomain("usb", reset_less=True),
            ClockDomain("usb_io", reset_less=True),
        )
        m.submodules.usb_pll = _usb_pll(ClockSignal("sync"), usb.clk, usb_io.clk)
        for name, line in self.lines.items():
            m.submodules[name] = Instance("BB", i_I=line.o, i_T=~line.oe, o_O=line.i, io_B=self.pads[name])
        return m


def _usb_pll(reference: Value, usb: Signal, usb_io: Signal) -> Instance:
    """The oscillator at 480 MHz, divided by 10 and 40 for 48 and 12 MHz; 480 / 48 is compared with 90 / 9.

    From 25 MHz the comparison would be at 5 MHz; the manufacturer requires 10.
    """
    feedback = Signal()
    return Instance(
        "EHXPLLL",
        p_CLKI_DIV=9,
        p_CLKFB_DIV=1,
        p_CLKOP_DIV=10,
        p_CLKOP_ENABLE="ENABLED",
        p_CLKOS_DIV=40,
        p_CLKOS_ENABLE="ENABLED",
        p_CLKOS2_DIV=48,
        p_CLKOS2_ENABLE="ENABLED",
        p_FEEDBK_PATH="CLKOS2",
        i_CLKI=reference,
        i_CLKFB=feedback,
        i_RST=0,
        i_STDBY=0,
        i_PHASESEL0=0,
        i_PHASESEL1=0,
        i_PHASEDIR=1,
        i_PHASESTEP=1,
        i_PHASELOADREG=1,
        i_PLLWAKESYNC=0,
        i_ENCLKOP=0,
        o_CLKOP=usb_io,
        o_CLKOS=usb,
        o_CLKOS2=feedback,
    )
