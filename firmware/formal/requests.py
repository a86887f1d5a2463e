"""What `runs` and `settings` suppose of the host's side: how it writes registers and gives commands.

A configuration is never written but while nothing is armed or runs, has settled before an ARM can look at
it, and a command holds still until it is answered.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from amaranth.hdl import Signal, Value

from acquire.trigger import registers as r
from firmware.formal.harness import Harness, Proof, inputs_of
from firmware.formal.settings import SETTLED
from firmware.host import Host
from firmware.registerfile import RegisterFile
from firmware.top import Build

if TYPE_CHECKING:
    from collections.abc import Iterable

CLOCKS = 8
"""Of induction: from one write to the next takes fewer."""


def requests_proof() -> Proof:
    harness, host = Harness(), Host(Build().code_words)
    m, claim = harness.m, harness.claim
    m.submodules.host = host
    m.submodules.file = file = RegisterFile(Build().constants())
    m.d.comb += [
        file.address.eq(host.address),
        host.known.eq(file.known),
        host.writable.eq(file.writable),
        host.guarded.eq(file.guarded),
    ]
    asked, answered = Signal(), Signal()
    word, since_write = Signal.like(host.write_data), Signal(4)
    m.d.sync += [asked.eq(host.execute), answered.eq(asked), word.eq(host.write_data)]
    with m.If(host.write | host.code_write):
        m.d.sync += since_write.eq(1)
    with m.Elif(~since_write.all()):
        m.d.sync += since_write.eq(since_write + 1)
    harness.assume(host.done == answered)  # proved in `runs`
    changes = host.write | host.code_write
    wrote = Signal()
    m.d.sync += wrote.eq(wrote | changes)
    claim("configuration_is_written_only_when_idle", host.write & _among(host, r.CONFIGURATION), host.idle)
    claim("code_is_written_only_when_idle", host.code_write, host.idle)
    writable = [register for register in r.REGISTERS if register.writable]
    claim("only_what_may_be_is_written", host.write, _among(host, writable))
    claim("a_command_is_a_write", host.execute, host.write)
    claim("a_command_holds_still", asked | answered, ~changes & ~host.execute & (host.write_data == word))
    claim("settled_before_a_command", changes & wrote, since_write > SETTLED)
    harness.cover("written", host.write & ~host.execute)
    inside = {"known", "writable", "guarded"}
    inputs = [signal for signal in inputs_of(host) if signal.name not in inside]
    return harness.proof("requests", inputs, cover_depth=24, depth=CLOCKS)


def _among(host: Host, registers: Iterable[r.Register]) -> Value:
    return host.address.matches(
        *(register.address + at for register in registers for at in range(register.words))
    )
