"""The paper's Virtex-4 SX55 (XC4VSX55-10FF1148): Verilog and constraints for the vendor's tools.

The board's own pin table is not published: the clock's period and the I/O standards are constrained here,
and `LOCATIONS` of a board goes into the UCF pin by pin.
"""

from dataclasses import replace

from amaranth.back import verilog
from amaranth.hdl import ClockDomain, Elaboratable, Module, Signal

from acquire.trigger.registers import Board
from firmware.boards.ulx3s import INPUTS, OUTPUTS, pull_of
from firmware.top import Build, SyncTrigger

BUILD = Build(board=Board.XC4VSX55)
PART = "xc4vsx55-10-ff1148"
PULLS = {"UP": " | PULLUP", "DOWN": " | PULLDOWN", "NONE": ""}
LOCATIONS: dict[str, str] = {}
"""Port → pad. Empty: the vendor's tool chooses."""


class Xc4vsx55(Elaboratable):
    """`SyncTrigger` with its clock as a port: a DCM on the board makes the 90 MHz."""

    def __init__(self, light_low: bool = False) -> None:
        self.trigger = SyncTrigger(replace(BUILD, light_low=light_low))
        self.clock, self.clock_locked = Signal(name="clock"), Signal(name="clock_locked")
        self.pins = {
            name: Signal.like(getattr(self.trigger, name), name=name, init=0) for name in INPUTS + OUTPUTS
        }

    @property
    def ports(self) -> list[Signal]:
        return [self.clock, self.clock_locked, *self.pins.values()]

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        m.domains.sync = domain = ClockDomain("sync", reset_less=True)
        m.submodules.trigger = trigger = self.trigger
        m.d.comb += [domain.clk.eq(self.clock), trigger.clock_locked.eq(self.clock_locked)]
        m.d.comb += [getattr(trigger, name).eq(self.pins[name]) for name in INPUTS]
        m.d.comb += [self.pins[name].eq(getattr(trigger, name)) for name in OUTPUTS]
        return m


def files(light_low: bool = False) -> dict[str, str]:
    """Return the generated files, name → text."""
    board = Xc4vsx55(light_low)
    return {
        "trigger.v": verilog.convert(board, name="trigger", ports=board.ports, emit_src=False),
        "trigger.ucf": constraints(board.ports, light_low),
        "trigger.xst": f"run -ifn trigger.prj -ifmt mixed -ofn trigger.ngc -p {PART} -top trigger\n",
        "trigger.prj": "verilog work trigger.v\n",
    }


def constraints(ports: list[Signal], light_low: bool = False) -> str:
    """The clock, the I/O standards and the pads that are known (UCF)."""
    period_ns = 1e9 / BUILD.clock_hz
    lines = [
        'NET "clock" TNM_NET = "clock";',
        f'TIMESPEC "TS_clock" = PERIOD "clock" {period_ns:.3f} ns HIGH 50%;',
    ]
    for port in ports:
        width, name = len(port), port.name
        for wire in [name] if width == 1 else [f"{name}<{bit}>" for bit in range(width)]:
            place = f' | LOC = "{LOCATIONS[wire]}"' if wire in LOCATIONS else ""
            pull = PULLS[pull_of(name, light_low)]
            lines.append(f'NET "{wire}" IOSTANDARD = LVCMOS33{pull}{place};')
    return "\n".join(lines) + "\n"
