"""The trigger's protocol apart from its registers: frames, commands, states, errors, tags.

The rest of the program and the gateware import everything here from `acquire.trigger.registers`.
"""

from __future__ import annotations

import struct
from enum import IntEnum, IntFlag
from typing import NamedTuple

PROTOCOL_VERSION = 1
"""Version in every frame; a frame with another version is refused with BAD_VERSION."""
MAX_PAYLOAD = 240
"""In bytes; with header and CRC, COBS needs a single extra byte for a frame of up to 254."""
MAX_WORDS = 59
"""Largest number of words of one read or write: the payload is at most 2 + 4·59 = 238 bytes."""
TIME_BITS = 48
"""Width of the device's time stamps, which wrap after weeks."""


class Command(IntEnum):
    """Values of COMMAND. The run id is written just before it, in the same frame."""

    ARM = 1
    """Check the configuration, take RUN_ID, clear the counters, wait for START or the external edge."""
    START = 2
    """Start the armed run RUN_ID."""
    STOP = 3
    """End run RUN_ID, or any run if RUN_ID is 0, after the current line, with the light off."""
    CHECK_CODE = 4
    """Compute CODE_CRC over CODE_LENGTH bits, rounded up to words."""
    SELF_TEST = 5
    """Test the device; the contents of the code memory are lost."""


class State(IntEnum):
    """STATUS.state."""

    IDLE = 0
    """No run has been armed since power-up."""
    ARMED = 1
    """The device waits for START or the external edge; the light is off."""
    RUNNING = 2
    """Lines are being carried out, or the first is about to begin."""
    STOPPING = 3
    """The last line is being carried out."""
    ENDED = 4
    """The run is over and the light is off; STATUS.end_reason gives the reason."""


class EndReason(IntEnum):
    """STATUS.end_reason."""

    NONE = 0
    """No run has ended since the latest ARM."""
    STOPPED = 1
    """The run was ended by STOP."""
    LINE_BUDGET = 2
    """LINE_BUDGET lines have been carried out."""
    WATCHDOG = 3
    """There was no valid request for WATCHDOG clocks."""
    CLOCK_LOST = 4
    """The PLL lost its reference."""


class ErrorCode(IntEnum):
    """Reasons for a NAK. From 32 on: reasons why a configuration cannot be armed."""

    BAD_VERSION = 1
    """The frame has another protocol version; the answer has the device's."""
    BAD_TYPE = 2
    """The type is neither READ nor WRITE."""
    BAD_LENGTH = 3
    """The payload does not have the form of its type, or requests 0 or too many words."""
    BAD_ADDRESS = 4
    """The address is beyond the map or the code memory, or has no register and the word is not 0."""
    READ_ONLY = 5
    """A WRITE to a register with access constant or read."""
    BUSY = 6
    """A configuration, code word, check or test while a run is armed or running, or ARM of another run."""
    BAD_COMMAND = 7
    """There is no such command."""
    WRONG_RUN = 8
    """START or STOP of a run that is not the current one."""
    RUN_OVER = 9
    """ARM of the run that has just ended: a run id can be used only once."""
    NOT_ARMED = 10
    """START before any run was armed."""
    BAD_RUN_ID = 11
    """ARM with run id 0."""

    BAD_SUBSTEP = 32
    """SUBSTEP_CLOCKS is outside LIMITS."""
    BAD_SUBSTEPS = 33
    """S is not in CAPABILITIES."""
    BAD_PHASES = 34
    """The 6/S sub-phases of PHASE_CLOCKS do not fit into a sub-step."""
    BAD_SOURCE = 35
    """CODE_SOURCE.kind is not a Source."""
    BAD_SEED = 36
    """The source is PRBS, and its mask or seed is 0."""
    BAD_CODE_LENGTH = 37
    """CODE_LENGTH is 0 or more than CODE_BITS (ARM with source MEMORY, CHECK_CODE with any source)."""
    CODE_UNCHECKED = 38
    """Code words or CODE_LENGTH were written after the last CHECK_CODE."""
    BAD_WINDOW = 39
    """WINDOW_OPEN < WINDOW_CLOSE <= SUBSTEP_CLOCKS does not hold."""
    BAD_LEAD = 40
    """LED.lead + LIMITS.lead_margin > SUBSTEP_CLOCKS."""
    BAD_TRIGGER_A = 41
    """The width is 0, or delay + width >= the period of A's pulses."""
    BAD_TRIGGER_B = 42
    """The same for B."""
    BAD_MIN_PERIOD = 43
    """Pulses would be closer than CAMERA_MIN_PERIOD."""
    BAD_TAG_INTERVAL = 44
    """TAG_INTERVAL is 0."""
    CLOCK_UNLOCKED = 45
    """The PLL is not locked; the address is that of STATUS."""


class Source(IntEnum):
    """CODE_SOURCE.kind."""

    CONSTANT = 0
    """CODE_SOURCE.value is the bit of every sub-step."""
    PRBS = 1
    """The shift register of PRBS_MASK and PRBS_SEED."""
    MEMORY = 2
    """The first CODE_LENGTH bits of the code memory, repeated."""


class LineMode(IntEnum):
    """LINE.mode: when the trigger outputs A and B pulse."""

    PER_LINE = 0
    """Once, at the start of each line."""
    PER_SUBSTEP = 1
    """Once per sub-step, which is then a camera line, as the paper's setup emulates S = 3."""


class Board(IntEnum):
    """VERSION.board."""

    NONE = 0
    """Gateware in a simulator."""
    ULX3S = 1
    """Radiona ULX3S, ECP5-25F."""
    XC4VSX55 = 2
    """Virtex-4 SX55."""
    MODEL = 255
    """The behavioural model."""


class FrameType(IntEnum):
    """Type byte of a frame; answers and tags have bit 7 set."""

    READ = 0x01
    """To the device: read words."""
    WRITE = 0x02
    """To the device: write words."""
    DATA = 0x81
    """Answer to READ."""
    ACK = 0x82
    """Answer to WRITE: carried out."""
    NAK = 0x83
    """Answer to either: refused."""
    TAG = 0x90
    """From the device, unsolicited: a line or an event of the run."""


class TagFlag(IntFlag):
    """Reasons for a tag. Every tag has at least one of them."""

    LINE = 1 << 0
    """The time stamp is that of the start of ``line``. Sent every TAG_INTERVAL lines, from line 0 on."""
    FIRST = 1 << 1
    """Line 0; LINE is set as well."""
    LAST = 1 << 2
    """The run has ended; ``line`` is the last one. (If no line was started: line = 0 and NO_LINES.)"""
    NO_LINES = 1 << 3
    """With LAST: the run ended before its first line."""
    EXTERNAL = 1 << 4
    """With FIRST: the external edge started the run."""
    BUDGET = 1 << 5
    """With LAST: the line budget is used up."""
    WATCHDOG = 1 << 6
    """With LAST: there was no valid request for WATCHDOG clocks."""
    CLOCK_LOST = 1 << 7
    """With LAST: the reference clock was lost."""
    PPS = 1 << 8
    """There was a pulse-per-second edge; PPS_TIME has its time."""
    MISSED_A = 1 << 9
    """The first missed strobe of camera A in this run."""
    MISSED_B = 1 << 10
    """The same for B."""
    UNEXPECTED_A = 1 << 11
    """The first unexpected strobe of camera A in this run."""
    UNEXPECTED_B = 1 << 12
    """The same for B."""
    TAGS_LOST = 1 << 13
    """Tags before this one were lost because the FIFO was full; TAG_LOST has their number."""


class TagRecord(NamedTuple):
    """Payload of a tag. ``run`` is the low half of the run id.

    Without LINE in ``flags`` the tag reports an event: ``line`` and ``code_index`` are those of the latest
    line, and ``timestamp`` is that of the event, at most 15 clocks late, or, if the queue was full, of the
    clock in which there was room.
    """

    run: int
    line: int
    code_index: int
    timestamp: int
    flags: int


TAG_FIELDS = (("run", 32), ("line", 48), ("code_index", 64), ("timestamp", TIME_BITS), ("flags", 16))
"""Name → bits of a tag's payload, in the order of its bytes, each little endian: 26 bytes."""
TAG_BYTES = sum(bits for _, bits in TAG_FIELDS) // 8

# The fields of 48 bits are two each, the low one first: `struct` has no such integer.
_TAG = struct.Struct("<IIHQIHH")


def pack_tag(tag: TagRecord) -> bytes:
    """Return a tag's payload."""
    line, time = tag.line, tag.timestamp
    return _TAG.pack(
        tag.run, line & 0xFFFFFFFF, line >> 32, tag.code_index, time & 0xFFFFFFFF, time >> 32, tag.flags
    )


def unpack_tag(payload: bytes) -> TagRecord:
    """Return the tag of a payload of `TAG_BYTES` bytes. Raises struct.error for another length."""
    run, line_low, line_high, code_index, time_low, time_high, flags = _TAG.unpack(payload)
    return TagRecord(run, line_high << 32 | line_low, code_index, time_high << 32 | time_low, flags)
