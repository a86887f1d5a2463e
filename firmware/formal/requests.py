"""Assumptions of `runs` and `settings` about the host's side: how it writes registers and gives commands.

A configuration is written only while nothing is armed or running, and has settled before an ARM can check it;
a command is constant until it is answered.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from amaranth.hdl import Cat, Signal, Value

from acquire.trigger import registers as r
from firmware.formal.harness import Harness, Proof, inputs_of, opened
from firmware.formal.settings import SETTLED
from firmware.host import Host
from firmware.registerfile import RegisterFile
from firmware.top import Build

if TYPE_CHECKING:
    from collections.abc import Iterable

CLOCKS = 8
"""Depth of the induction: fewer clocks pass from one write to the next."""


def requests_proof() -> Proof:
    harness, host = Harness(), Host(Build().code_words)
    m, claim = harness.m, harness.claim
    m.submodules.host, _ = opened(host)
    m.submodules.file = file = RegisterFile(Build().constants(), {})
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
    _heard(harness, host, changes)
    harness.cover("written", host.write & ~host.execute)
    inside = {"known", "writable", "guarded"}
    inputs = [signal for signal in inputs_of(host) if signal.name not in inside]
    return harness.proof("requests", inputs, cover_depth=24, depth=CLOCKS)


def _heard(harness: Harness, host: Host, changes: Value) -> None:
    """Claim that each well-formed request resets the watchdog once, and that a silent host never does."""
    m, claim = harness.m, harness.claim
    heard, asked = Signal(), Signal()
    with m.If(host.release):
        m.d.sync += heard.eq(0)
    with m.Elif(host.heard):
        m.d.sync += heard.eq(1)
    m.d.sync += asked.eq(host.frame)
    harness.assume(~asked | host.frame | _was(harness, host.release))  # a frame waits until it is released
    claim("nothing_is_heard_without_a_frame", host.heard, host.frame)
    claim("a_frame_is_heard_once", host.heard, ~heard)
    claim("what_changes_anything_was_heard", changes, heard)
    at, lemma = host.within, harness.lemma
    answers = host.tag_turn & (at["SEND"] | at["SENT"])
    accepted = _any(at, "READ CHECK", "FETCH", "WRITE", "COMMAND", "WRITTEN")
    asks = _any(at, "HEAD", "CHECK", "READ", "NAK") | accepted
    lemma("it_is_the_request_s_turn", asks, host.tag_turn)
    lemma("a_tag_ends_by_itself", at["SEND"] & ~host.tag_turn, ~host.more)
    lemma("its_frame_waits", asks | answers, host.frame)
    lemma("heard_when_accepted", accepted, heard)
    lemma("not_heard_before", ~(asks | answers) | at["HEAD"] | at["CHECK"], ~heard)


def _any(at: dict[str, Value], *states: str) -> Value:
    return Cat(at[state] for state in states).any()


def _was(harness: Harness, signal: Signal) -> Signal:
    before = Signal()
    harness.m.d.sync += before.eq(signal)
    return before


def _among(host: Host, registers: Iterable[r.Register]) -> Value:
    return host.address.matches(
        *(register.address + at for register in registers for at in range(register.words))
    )
