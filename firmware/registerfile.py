r"""The registers that `acquire.trigger.registers` defines, as words the host reads and writes.

::

    clk       _/‾\_/‾\_/‾\_/‾\_
    sample    _/‾‾‾\___________     every word of `read` registers wider than 32 bits, in one clock:
    address   -----X a ---------    what is read after it belongs to one moment
    data      -------------X w      READ_LATENCY clocks after the address
    write     _____/‾‾‾\_______     writable registers take ``write_data`` (COMMAND: see `commands`)

``known``, ``writable`` and ``guarded`` refer to ``address`` of the previous clock: whether the word exists,
may be written, and may be written only while nothing is armed or running.
"""

from collections.abc import Mapping

from amaranth.hdl import Cat, Const, Elaboratable, Module, Signal, Value
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out

from acquire.trigger import registers as r

ADDRESS_BITS = (r.MAP_END - 1).bit_length()
READ_LATENCY = 2
GROUP = 8
"""Words that the first stage of the read multiplexer chooses from."""


class RegisterFile(wiring.Component):
    """``value(REGISTER)`` is the value that the host wrote, or the one to be assigned for it to read."""

    address: In(ADDRESS_BITS)
    known: Out(1)
    writable: Out(1)
    guarded: Out(1)
    sample: In(1)
    data: Out(32)
    write: In(1)
    write_data: In(32)

    def __init__(self, constants: Mapping[r.Register, int | Value], resets: dict[r.Register, int]) -> None:
        """``resets``: power-up values of a board that differ from the definition's."""
        super().__init__()
        self._constants = constants
        self._values = {
            register.name: Signal(
                register.width, name=register.name.lower(), init=resets.get(register, register.reset)
            )
            for register in r.REGISTERS
            if register.access not in {"constant", "command"}
        }

    def value(self, register: r.Register) -> Signal:
        return self._values[register.name]

    def field(self, register: r.Register, name: str) -> Value:
        part: r.Field = getattr(register, name)
        return self.value(register)[part.low : part.low + part.width]

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        words = [Const(0, 32)] * (1 << ADDRESS_BITS)
        for register in r.REGISTERS:
            for at, word in enumerate(self._words(m, register)):
                words[register.address + at] = word
        self._read(m, words)
        m.d.sync += [self.known.eq(0), self.writable.eq(0), self.guarded.eq(0)]
        with m.Switch(self.address):
            for register in r.REGISTERS:
                with m.Case(*range(register.address, register.address + register.words)):
                    m.d.sync += [
                        self.known.eq(1),
                        self.writable.eq(register.writable),
                        self.guarded.eq(register.access == "config"),
                    ]
        for register in r.REGISTERS:
            if register.access in {"config", "operand"}:
                self._store(m, register)
        return m

    def _words(self, m: Module, register: r.Register) -> list[Value]:
        if register.access == "constant":
            value = Value.cast(self._constants[register])
            value = Cat(value, Const(0, register.width))[: register.width]
        elif register.access == "command":
            value = Const(0, register.width)
        else:
            value = self.value(register)
            if register.access == "read" and register.words > 1:
                value = self._sampled(m, register)
        padded = Cat(value, Const(0, 32 * register.words - register.width))
        return [padded.word_select(at, 32) for at in range(register.words)]

    def _sampled(self, m: Module, register: r.Register) -> Signal:
        # Its words are read one after the other; all belong to the moment of the request.
        kept = Signal(register.width, name=f"{register.name.lower()}_sampled")
        with m.If(self.sample):
            m.d.sync += kept.eq(self.value(register))
        return kept

    def _read(self, m: Module, words: list[Value]) -> None:
        """Two stages, so that no path goes through the whole multiplexer."""
        low, high = self.address[:3], Signal(ADDRESS_BITS - 3)
        groups = []
        for start in range(0, len(words), GROUP):
            chosen = Signal(32, name=f"group_{start:02x}")
            with m.Switch(low):
                for at in range(GROUP):
                    with m.Case(at):
                        m.d.sync += chosen.eq(words[start + at])
            groups.append(chosen)
        m.d.sync += high.eq(self.address[3:])
        with m.Switch(high):
            for at, group in enumerate(groups):
                with m.Case(at):
                    m.d.sync += self.data.eq(group)

    def _store(self, m: Module, register: r.Register) -> None:
        value = self.value(register)
        for at in range(register.words):
            part = value[32 * at : min(32 * (at + 1), register.width)]
            with m.If(self.write & (self.address == register.address + at)):
                m.d.sync += part.eq(self.write_data)
