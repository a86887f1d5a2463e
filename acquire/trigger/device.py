"""One trigger behind a link, at the level of its registers: handshake, status, commands, code memory."""

from __future__ import annotations

import time
import zlib
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import TriggerError
from acquire.trigger import registers as r
from acquire.trigger.registers import Command, EndReason, State
from acquire.trigger.settings import Capabilities

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from acquire.trigger.link import Link
    from acquire.trigger.registers import Register

ANSWER_S = 3.0
"""What a device does at once has been done by then."""
# The quickest is taken: what took longer was held up somewhere on the way, on either side of the answer.
_COMPARISONS = 8
_LOOK_AGAIN_S = 0.001
_COUNTERS = (
    *("TAG_COUNT", "TAG_LOST", "RX_ERRORS", "PPS_COUNT"),
    *(f"STROBE_{arm}_{what}" for arm in "AB" for what in ("SEEN", "MISSED", "UNEXPECTED")),
)


@dataclass(frozen=True, slots=True)
class DeviceStatus:
    """What the device does at this moment."""

    state: State
    run: int
    """The number of its run, 0 before the first."""
    lines: int
    end_reason: EndReason
    clock_locked: bool
    clock_external: bool
    clock_losses: int
    code_checked: bool
    busy: bool

    @property
    def at_rest(self) -> bool:
        """No run is armed or running."""
        return self.state in (State.IDLE, State.ENDED)

    def __str__(self) -> str:
        reason = self.end_reason.name.lower().replace("_", " ")
        words = f"{self.state.name.lower()} with {self.lines} lines"
        return words if self.end_reason == EndReason.NONE else f"{words} ({reason})"


class Device:
    """The device behind ``link``; TriggerError unless it is one that this program knows.

    Attributes
    ----------
    capabilities : what it says of itself
    """

    def __init__(self, link: Link) -> None:
        self.link = link
        self.capabilities = _shake_hands(link)
        link.window_bytes = self.capabilities.rx_bytes

    def read(self, register: Register) -> int:
        """A register's value."""
        return _value(self.link.read(register.address, register.words))

    def status(self) -> DeviceStatus:
        """What it does now, all of one moment but for STATUS itself."""
        words = self.link.read_block(r.STATUS.address, r.CODE_STATE.address - r.STATUS.address)
        values = _values(r.STATUS.address, words)
        flags = r.STATUS.unpack(values[r.STATUS])
        return DeviceStatus(
            State(flags["state"]),
            values[r.CURRENT_RUN],
            values[r.LINES],
            EndReason(flags["end_reason"]),
            clock_locked=bool(flags["clock_locked"]),
            clock_external=bool(flags["clock_external"]),
            clock_losses=flags["clock_losses"],
            code_checked=bool(flags["code_checked"]),
            busy=bool(flags["busy"]),
        )

    def await_status(self, done: Callable[[DeviceStatus], bool], limit_s: float, what: str) -> DeviceStatus:
        """Look until ``done``; TriggerError when it did not do ``what`` in time."""
        deadline_s = time.monotonic() + limit_s
        while not done(status := self.status()):
            if time.monotonic() > deadline_s:
                raise TriggerError(f"the trigger did not {what} within {limit_s:.3g} s: {status}")
            time.sleep(_LOOK_AGAIN_S)
        return status

    def counters(self) -> dict[str, int]:
        """Of this run, or since power-up: see the registers."""
        return {name.lower(): self.read(getattr(r, name)) for name in _COUNTERS}

    def configure(self, values: Mapping[Register, int]) -> None:
        """Write the config registers in one block, read them back, compare."""
        # One frame, so that the device has the old configuration or the new one, and no mixture.
        first, last = r.CONFIGURATION[0], r.CONFIGURATION[-1]
        words = [0] * (last.address + last.words - first.address)
        for register in r.CONFIGURATION:
            at = register.address - first.address
            words[at : at + register.words] = register.to_words(values[register])
        self.link.write(first.address, words)
        for register, have in self.configuration().items():
            if have != values[register]:
                raise TriggerError(f"{register.name} reads {have:#x} where {values[register]:#x} was written")

    def configuration(self) -> dict[Register, int]:
        """What the config registers hold."""
        first, last = r.CONFIGURATION[0], r.CONFIGURATION[-1]
        words = self.link.read(first.address, last.address + last.words - first.address)
        return _values(first.address, words)

    def command(self, command: Command, number: int = 0) -> None:
        """One command, about run ``number``. It may be repeated on a bad link without harm."""
        # Run id and command in one frame: two clients cannot put their commands between each other's. What a
        # lost answer has sent twice meets the same run, and changes nothing.
        self.link.write(r.RUN_ID.address, [*r.RUN_ID.to_words(number), command])

    def load_code(self, bits: NDArray[np.uint8]) -> int:
        """Load the code memory (0 or 1 per bit) and check it on the device; its CRC-32."""
        room = self.capabilities.code_bits
        if not 0 < len(bits) <= room:
            raise TriggerError(
                f"the code memory cannot hold a code of {len(bits)} bits", possible=f"1 to {room}"
            )
        packed = np.packbits(bits, bitorder="little").tobytes()
        packed += bytes(-len(packed) % 4)  # the device computes its CRC over whole words
        self.link.write_block(r.CODE_MEMORY, np.frombuffer(packed, "<u4").tolist())
        self.link.write(r.CODE_LENGTH.address, [len(bits)])
        self.command(Command.CHECK_CODE)
        self.await_status(lambda status: not status.busy, ANSWER_S, "check its code")
        crc = self.read(r.CODE_CRC)
        if crc != zlib.crc32(packed):
            raise TriggerError(f"the code memory has CRC {crc:#010x}, not {zlib.crc32(packed):#010x}")
        return crc

    def read_code(self, length: int) -> NDArray[np.uint8]:
        """The first ``length`` bits of the code memory, 0 or 1 each."""
        words = self.link.read_block(r.CODE_MEMORY, -(-length // 32))
        return np.unpackbits(np.array(words, "<u4").view(np.uint8), bitorder="little")[:length]

    def code_length(self) -> int:
        """Bits of the code memory that were loaded; TriggerError if none were."""
        if not self.status().code_checked or not (length := self.read(r.CODE_LENGTH)):
            raise TriggerError("the code memory holds no checked code", hint="acquire trigger load")
        return length

    def self_test(self) -> dict[str, int]:
        """Have the device test itself; the fields of SELF_TEST. What its code memory held is lost."""
        self.command(Command.SELF_TEST)
        self.await_status(lambda status: not status.busy, ANSWER_S, "test itself")
        return r.SELF_TEST.unpack(self.read(r.SELF_TEST))

    def compare_clocks(self) -> tuple[int, int, int]:
        """UTC (ns), the device's TIME at that moment, and how far the two may be apart (ns)."""
        return min((self._compare_once() for _ in range(_COMPARISONS)), key=lambda found: found[2])

    def _compare_once(self) -> tuple[int, int, int]:
        # The device read its clock between question and answer, nobody knows when: in the middle, give or
        # take half of the time (Cristian 1989). The difference is of the clock that is never set.
        before_ns, utc_ns = time.monotonic_ns(), time.time_ns()
        tick = self.read(r.TIME)
        half_ns = (time.monotonic_ns() - before_ns) // 2
        return utc_ns + half_ns, tick, half_ns


def facts_of(status: DeviceStatus | Capabilities) -> dict[str, Any]:
    """For printing: names instead of numbers."""
    return {name: getattr(value, "name", value) for name, value in asdict(status).items()}


def _shake_hands(link: Link) -> Capabilities:
    """Read the constants; TriggerError names both sides where they do not match."""
    last = r.QUEUES
    values = _values(r.ID.address, link.read(r.ID.address, last.address + last.words))
    name = link.transport.name
    if values[r.ID] != r.DEVICE_ID:
        raise TriggerError(
            f"{name} answers with ID {values[r.ID]:#010x}, not the trigger's {r.DEVICE_ID:#010x}",
            hint="is it the trigger's port?",
        )
    theirs = r.VERSION.protocol.of(values[r.VERSION])
    if (theirs, values[r.MAP]) != (r.PROTOCOL_VERSION, r.MAP_CRC):
        raise TriggerError(
            f"{name} has protocol {theirs} with register map {values[r.MAP]:#010x}, "
            f"this program protocol {r.PROTOCOL_VERSION} with map {r.MAP_CRC:#010x}",
            hint="load the firmware that belongs to this program",
        )
    return Capabilities.read(values)


def _values(address: int, words: Sequence[int]) -> dict[Register, int]:
    """Register → value, of those that lie wholly in ``words`` from ``address`` on."""
    return {
        register: _value(words[register.address - address :][: register.words])
        for register in r.REGISTERS
        if address <= register.address and register.address + register.words <= address + len(words)
    }


def _value(words: Sequence[int]) -> int:
    return sum(word << r.WORD_BITS * i for i, word in enumerate(words))
