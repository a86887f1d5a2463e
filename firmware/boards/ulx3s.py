"""Radiona ULX3S with an ECP5-25F: 25 MHz · 18 / 5 = 90 MHz exactly, the FTDI's UART, GPIO pins."""

from amaranth.hdl import ClockDomain, Elaboratable, Instance, Module, Signal

from acquire.trigger.registers import Board
from firmware.top import Build, SyncTrigger

BUILD = Build(board=Board.ULX3S)
REFERENCE_HZ = 25_000_000
PACKAGE, SPEED, DENSITY = "CABGA381", "6", "25k"

PINS = {
    "reference": "G2",
    "rx": "M1",
    "tx": "L4",
    "pps": "B11",  # GPIO 0+
    "scene_gate": "C11",
    "external_arm": "A10",
    "strobe_a": "A11",
    "strobe_b": "A9",
    "led": "A7",  # GPIO 4+
    "trigger_a": "A8",
    "trigger_b": "C8",
    "direction_a": "B8",
    "direction_b": "C6",
    "line": "C7",
    "phases[0]": "A6",
    "phases[1]": "B6",
    "phases[2]": "A4",
    "running": "B2",  # the board's LED 0
}
INPUTS = ("rx", "pps", "scene_gate", "external_arm", "strobe_a", "strobe_b")
OUTPUTS = ("tx", "led", "trigger_a", "trigger_b", "direction_a", "direction_b", "phases", "line", "running")


class Ulx3s(Elaboratable):
    """`SyncTrigger` between the board's pins; ``ports`` are named as in `PINS`."""

    sites = PINS

    def __init__(self, trigger: SyncTrigger | None = None) -> None:
        self.trigger = trigger or SyncTrigger(BUILD)
        self.reference = Signal()
        self.pins = {
            name: Signal.like(getattr(self.trigger, name), name=name, init=0) for name in INPUTS + OUTPUTS
        }

    @property
    def ports(self) -> list[Signal]:
        return [self.reference, *self.pins.values()]

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        trigger, clock, locked = self.trigger, ClockDomain("sync", reset_less=True), Signal()
        m.domains += clock
        m.submodules.trigger = trigger
        m.submodules.pll = _pll(self.reference, clock.clk, locked)
        m.d.comb += trigger.clock_locked.eq(locked)
        m.d.comb += [getattr(trigger, name).eq(self.pins[name]) for name in INPUTS]
        m.d.comb += [self.pins[name].eq(getattr(trigger, name)) for name in OUTPUTS]
        return m


def _pll(reference: Signal, clock: Signal, locked: Signal) -> Instance:
    """The oscillator runs at 25 MHz · 18 = 450 MHz, a fifth of which is 90 MHz.

    Its eighteenth is compared with the reference itself, at 25 MHz: the manufacturer requires 10 MHz or
    more there, and 400 to 800 MHz for the oscillator.
    """
    feedback = Signal()
    return Instance(
        "EHXPLLL",
        p_CLKI_DIV=1,
        p_CLKFB_DIV=1,
        p_CLKOP_DIV=5,
        p_CLKOP_CPHASE=2,
        p_CLKOP_FPHASE=0,
        p_CLKOP_ENABLE="ENABLED",
        p_CLKOS_DIV=18,
        p_CLKOS_CPHASE=2,
        p_CLKOS_FPHASE=0,
        p_CLKOS_ENABLE="ENABLED",
        p_FEEDBK_PATH="CLKOS",
        p_PLLRST_ENA="DISABLED",
        p_STDBY_ENABLE="DISABLED",
        p_INTFB_WAKE="DISABLED",
        p_DPHASE_SOURCE="DISABLED",
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
        o_CLKOP=clock,
        o_CLKOS=feedback,
        o_LOCK=locked,
    )


def constraints(sites: dict[str, str], light_low: bool = False) -> str:
    """The pins and the reference as nextpnr reads them (LPF)."""
    lines = [f'FREQUENCY PORT "reference" {REFERENCE_HZ / 1e6:g} MHZ;']
    for name, site in sites.items():
        pull = f" PULLMODE={pull_of(name, light_low)}"
        lines += [f'LOCATE COMP "{name}" SITE "{site}";', f'IOBUF PORT "{name}" IO_TYPE=LVCMOS33{pull};']
    return "\n".join(lines) + "\n"


def pull_of(port: str, light_low: bool) -> str:
    """Return the pull of an undriven pin: inputs to rest, light and triggers to off."""
    if port == "rx" or (port == "led" and light_low):
        return "UP"
    if port in INPUTS or port in {"led", "trigger_a", "trigger_b"}:
        return "DOWN"
    return "NONE"
