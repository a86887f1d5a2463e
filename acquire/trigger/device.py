"""One trigger behind a link, at the level of its registers: handshake, status, commands, code memory."""

from __future__ import annotations

import time
import zlib
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import TriggerError
from acquire.text import counted
from acquire.trigger import registers as r
from acquire.trigger.registers import Command, EndReason, State
from acquire.trigger.settings import Capabilities
from acquire.trigger.tags import signed_ticks

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from acquire.trigger.link import Link
    from acquire.trigger.registers import Register

ANSWER_S = 3.0
"""Time within which the device has done anything that it does at once."""
UNANSWERED = "acquire trigger info shows its state; if that does not change, power it off and on"
# The quickest comparison is used: a slower one was delayed somewhere, before or after the device's reading.
_COMPARISONS = 8
_LOOK_AGAIN_S = 0.001
_COUNTERS = (
    *("TAG_COUNT", "TAG_LOST", "RX_ERRORS", "PPS_COUNT"),
    *(f"STROBE_{arm}_{what}" for arm in "AB" for what in ("SEEN", "MISSED", "UNEXPECTED")),
)


@dataclass(frozen=True, slots=True)
class DeviceStatus:
    """Current status of the device."""

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
        """Whether no run is armed or running."""
        return self.state in (State.IDLE, State.ENDED)

    def __str__(self) -> str:
        reason = self.end_reason.name.lower().replace("_", " ")
        words = f"{self.state.name.lower()} with {counted(self.lines, 'line')}"
        return words if self.end_reason == EndReason.NONE else f"{words} ({reason})"


class Device:
    """The device behind ``link``. Raises TriggerError unless this program supports it.

    Attributes
    ----------
    capabilities : as reported by the device
    """

    def __init__(self, link: Link) -> None:
        """Read the constants, and compare versions: the error names both."""
        self.link = link
        # All constants, of which QUEUES is the last, in one round trip.
        last = r.QUEUES
        values = _values(r.ID.address, link.read(r.ID.address, last.address + last.words))
        name = link.transport.name
        # What it is comes first: the words of another device have no meaning as versions.
        if values[r.ID] != r.DEVICE_ID:
            raise TriggerError(
                f"{name} answers with ID {values[r.ID]:#010x}, not the trigger's {r.DEVICE_ID:#010x}",
                hint="check that it is the trigger's port",
            )
        theirs = r.VERSION.protocol.of(values[r.VERSION])
        if (theirs, values[r.MAP]) != (r.PROTOCOL_VERSION, r.MAP_CRC):
            raise TriggerError(
                f"{name} has protocol {theirs} with register map {values[r.MAP]:#010x}, "
                f"but this program has protocol {r.PROTOCOL_VERSION} with map {r.MAP_CRC:#010x}",
                hint="load the firmware that belongs to this program",
            )
        self.capabilities = Capabilities.read(values)
        link.window_bytes = self.capabilities.rx_bytes

    def read(self, register: Register) -> int:
        """Return a register's value."""
        return _value(self.link.read(register.address, register.words))

    def status(self) -> DeviceStatus:
        """Return the current status; everything is of one moment, except STATUS itself."""
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

    def await_status(
        self,
        done: Callable[[DeviceStatus], bool],
        limit_s: float,
        what: str,
        ticks: int = 0,
        hint: str = UNANSWERED,
    ) -> DeviceStatus:
        """Poll until ``done``. Raises TriggerError if the device did not do ``what`` in time.

        ``ticks`` : by the device's clock, ``what`` may take so long; ``limit_s`` counts after that. The time
        of a simulated device may pass more slowly than the host's.
        """
        begun_s = time.monotonic()
        deadline_s = begun_s + limit_s
        begun = seen = self.read(r.TIME) if ticks else 0
        while not done(status := self.status()):
            if time.monotonic() > deadline_s:
                now = self.read(r.TIME) if ticks else 0
                # A stopped clock measures nothing: without this, a device without a clock is awaited forever.
                if now == seen or signed_ticks(seen - begun) > ticks:
                    given_s = deadline_s - begun_s
                    raise TriggerError(
                        f"the trigger did not {what} within {given_s:.3g} s: {status}",
                        hint=hint,
                    )
                seen, deadline_s = now, time.monotonic() + limit_s
            time.sleep(_LOOK_AGAIN_S)
        return status

    def line_ticks(self) -> int:
        """Return the length of a line as the device is configured, by whichever program."""
        return int(r.LINE.substeps.of(self.read(r.LINE)) * self.read(r.SUBSTEP_CLOCKS))

    def counters(self) -> dict[str, int]:
        """Return counters of this run, or since power-up: see the registers."""
        return {name.lower(): self.read(getattr(r, name)) for name in _COUNTERS}

    def configure(self, values: Mapping[Register, int]) -> None:
        """Write the config registers in one block, read them back, compare."""
        # One frame, so that the device has either the old configuration or the new one.
        first, last = r.CONFIGURATION[0], r.CONFIGURATION[-1]
        words = [0] * (last.address + last.words - first.address)
        for register in r.CONFIGURATION:
            at = register.address - first.address
            words[at : at + register.words] = register.to_words(values[register])
        self.link.write(first.address, words)
        for register, have in self.configuration().items():
            if have != values[register]:
                raise TriggerError(
                    f"{register.name} reads {have:#x} where {values[register]:#x} was written",
                    hint="acquire trigger info shows whether its firmware is the one for this program; "
                    "check cable and power",
                )

    def configuration(self) -> dict[Register, int]:
        """Return the values of the config registers."""
        first, last = r.CONFIGURATION[0], r.CONFIGURATION[-1]
        words = self.link.read(first.address, last.address + last.words - first.address)
        return _values(first.address, words)

    def command(self, command: Command, number: int = 0) -> None:
        """Send one command for run ``number``. Repetition on a bad link does no harm."""
        # Run id and command in one frame, so that commands of two clients cannot interleave. A command that
        # is sent twice because an answer was lost refers to the same run, and changes nothing.
        self.link.write(r.RUN_ID.address, [*r.RUN_ID.to_words(number), command])

    def load_code(self, bits: NDArray[np.uint8]) -> int:
        """Load the code memory (0 or 1 per bit) and check it on the device; return its CRC-32."""
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
            raise TriggerError(
                f"the code memory has CRC {crc:#010x}, not {zlib.crc32(packed):#010x}",
                hint="load it once more; if it fails again, acquire trigger selftest checks the memory",
            )
        return crc

    def read_code(self, length: int) -> NDArray[np.uint8]:
        """Return the first ``length`` bits of the code memory, 0 or 1 each."""
        words = self.link.read_block(r.CODE_MEMORY, -(-length // 32))
        return np.unpackbits(np.array(words, "<u4").view(np.uint8), bitorder="little")[:length]

    def code_length(self) -> int:
        """Return the loaded bits of the code memory. Raises TriggerError if there are none."""
        if not self.status().code_checked or not (length := self.read(r.CODE_LENGTH)):
            raise TriggerError("the code memory holds no checked code", hint="acquire trigger load")
        return length

    def self_test(self) -> dict[str, int]:
        """Have the device test itself; return the fields of SELF_TEST.

        The code memory's contents are lost.
        """
        self.command(Command.SELF_TEST)
        self.await_status(lambda status: not status.busy, ANSWER_S, "test itself")
        return r.SELF_TEST.unpack(self.read(r.SELF_TEST))

    def compare_clocks(self) -> tuple[int, int, int]:
        """Return UTC (ns), the device's TIME at that moment, and the uncertainty of their relation (ns)."""
        found = []
        for _ in range(_COMPARISONS):
            # The device read its clock at an unknown moment between request and answer: in the middle, plus
            # or minus half of the time (Cristian 1989). The time is measured with the monotonic clock.
            before_ns, utc_ns = time.monotonic_ns(), time.time_ns()
            tick = self.read(r.TIME)
            half_ns = (time.monotonic_ns() - before_ns) // 2
            found.append((utc_ns + half_ns, tick, half_ns))
        return min(found, key=lambda one: one[2])


def facts_of(status: DeviceStatus | Capabilities) -> dict[str, Any]:
    """Return values for printing, with names instead of numbers."""
    return {name: getattr(value, "name", value) for name, value in asdict(status).items()}


def _values(address: int, words: Sequence[int]) -> dict[Register, int]:
    """Return the values of the registers that are completely in ``words`` from ``address`` on."""
    return {
        register: _value(words[register.address - address :][: register.words])
        for register in r.REGISTERS
        if address <= register.address and register.address + register.words <= address + len(words)
    }


def _value(words: Sequence[int]) -> int:
    return sum(word << r.WORD_BITS * i for i, word in enumerate(words))
