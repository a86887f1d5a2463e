"""The registers of the trigger model: their contents, its constants, and what may be written when."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

from acquire.sim.arming import Refusal
from acquire.trigger import registers as r
from acquire.trigger.registers import ErrorCode

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

CODE_BITS = 1 << 19
TAG_ROOM = 1 << 15
RX_BYTES = 2048
START_LATENCY = 6
RUN_CLOCKS = 2
"""Clocks from the start of a run to line 0, less LED.lead: the run's first clock is one later."""
BARK_CLOCKS = 2
"""Clocks from the last silent clock that the watchdog allows to the end that it causes."""
SUBSTEP_MIN = 5
SUBSTEP_MAX_LOG2 = 24
LEAD_MARGIN = 1
INPUTS = ("pps", "external_arm")
# The divisors of the six sub-phases of a line's transfer (`arming`).
_SUBSTEPS = (1, 2, 3, 6)
_REGISTER_AT = {register.address + i: register for register in r.REGISTERS for i in range(register.words)}


class RegisterBank:
    """Registers and code memory of one trigger.

    Parameters
    ----------
    constants : initial values that differ from the registers' reset values
    status : computes the value of each register that the trigger itself changes
    command : carries out a word written to COMMAND, or raises Refusal
    demand_idle : raises Refusal, with an address, while a run is armed or running
    """

    def __init__(
        self,
        constants: Mapping[r.Register, int],
        status: Mapping[r.Register, Callable[[], int]],
        command: Callable[[int], None],
        demand_idle: Callable[[int], None],
    ) -> None:
        self._status, self._command, self._demand_idle = status, command, demand_idle
        self._words: dict[int, int] = {}
        for register in r.REGISTERS:
            self.put(register, constants.get(register, register.reset))
        self._memory = bytearray(CODE_BITS // 8)
        self.code_checked = False

    def get(self, register: r.Register) -> int:
        """Return the value of all words of a register."""
        return sum(self._words[register.address + i] << 32 * i for i in range(register.words))

    def put(self, register: r.Register, value: int) -> None:
        for i, word in enumerate(register.to_words(value)):
            self._words[register.address + i] = word

    def field(self, register: r.Register, name: str) -> int:
        """Return one field of a register."""
        return register.field(name).of(self.get(register))

    def check_code(self) -> None:
        """Set CODE_CRC to the checksum of the code memory in use."""
        length = self.get(r.CODE_LENGTH)
        if not 0 < length <= CODE_BITS:
            raise Refusal(ErrorCode.BAD_CODE_LENGTH, r.CODE_LENGTH.address)
        # In whole words, as the protocol defines it.
        self.put(r.CODE_CRC, zlib.crc32(self._memory[: -(-length // 32) * 4]))
        self.code_checked = True

    def clear_code(self) -> None:
        """Set the code memory to 0."""
        self._memory[:] = bytes(len(self._memory))
        self.code_checked = False

    def read(self, address: int, count: int) -> list[int]:
        """Return words, all from one moment. Raises Refusal, with the first address, if any is not there."""
        in_code = address >= r.CODE_MEMORY
        if address + count > (r.CODE_MEMORY + len(self._memory) // 4 if in_code else r.MAP_END):
            raise Refusal(ErrorCode.BAD_ADDRESS, address)
        if in_code:
            self._demand_idle(address)
            at = (address - r.CODE_MEMORY) * 4
            return [int.from_bytes(self._memory[i : i + 4], "little") for i in range(at, at + 4 * count, 4)]
        for register, value in self._status.items():
            if register.address < address + count and register.address + register.words > address:
                self.put(register, value())
        return [self._words.get(address + i, 0) for i in range(count)]

    def write(self, address: int, word: int) -> None:
        """Write one word, with its effects. Raises Refusal if it cannot be written, or not now."""
        at = (address - r.CODE_MEMORY) * 4
        if 0 <= at < len(self._memory):
            self._demand_idle(address)
            self._memory[at : at + 4] = word.to_bytes(4, "little")
            self.code_checked = False
            return
        register = _REGISTER_AT.get(address)
        if register is None:
            # A block of registers is written by one request, and the map has holes: a 0 may be written there.
            if word or not 0 <= address < r.MAP_END:
                raise Refusal(ErrorCode.BAD_ADDRESS, address)
            return
        if not register.writable:
            raise Refusal(ErrorCode.READ_ONLY, address)
        if register is r.COMMAND:
            self._command(word)
            return
        if register.access == "config":
            self._demand_idle(address)
        # CODE_CRC covers CODE_LENGTH bits: another length has not been checked.
        if register is r.CODE_LENGTH and word != self._words[address]:
            self.code_checked = False
        # A register ignores the bits of a word above its own width.
        implemented = (1 << min(32, register.width - 32 * (address - register.address))) - 1
        self._words[address] = word & implemented


def constants(clock_hz: int, serial: int) -> dict[r.Register, int]:
    """Return the registers in which the model describes itself."""
    return {
        r.VERSION: r.VERSION.pack(
            protocol=r.PROTOCOL_VERSION, firmware_major=1, firmware_minor=0, board=r.Board.MODEL
        ),
        r.MAP: r.MAP_CRC,
        r.SERIAL: serial,
        r.CLOCK_HZ: clock_hz,
        r.CODE_BITS: CODE_BITS,
        r.LIMITS: r.LIMITS.pack(
            substep_min=SUBSTEP_MIN, substep_max_log2=SUBSTEP_MAX_LOG2, lead_margin=LEAD_MARGIN
        ),
        r.CAPABILITIES: r.CAPABILITIES.pack(
            substeps=sum(1 << substeps for substeps in _SUBSTEPS),
            start_latency=START_LATENCY,
            **dict.fromkeys(INPUTS, 1),
        ),
        r.QUEUES: r.QUEUES.pack(tags=TAG_ROOM, rx_bytes=RX_BYTES),
    }
