"""The single definition of the interface between trigger and host: registers, commands, errors, tags.

The gateware's decoder, the behavioural model, the driver and the table in ``firmware/REGISTERS.md`` are
all generated from this file. Addresses count 32-bit words; a register wider than 32 bits takes two words,
the low one first. Bit 15 of an address selects the code memory, with code bit 0 in bit 0 of its word 0::

    0x0000  identity and capabilities            constants of the device
    0x0010  current state                        counters and time stamps
    0x0040  run id and command                   one write of three words is one command
    0x0048  configuration of the next run        checked when the run is armed
    0x8000  code memory

All times are counted in clocks of the trigger. Line ``k`` starts ``k · S · SUBSTEP_CLOCKS`` clocks after
the run's start; the code bit of its first sub-step has index ``S · k``.
"""

from __future__ import annotations

import zlib

# ruff: noqa: F401 - everything is imported from here
from acquire.trigger.fields import WORD_BITS, Access, Field, Register
from acquire.trigger.protocol import (
    MAX_PAYLOAD,
    MAX_WORDS,
    PROTOCOL_VERSION,
    TAG_BYTES,
    TAG_FIELDS,
    TIME_BITS,
    Board,
    Command,
    EndReason,
    ErrorCode,
    FrameType,
    LineMode,
    Source,
    State,
    TagFlag,
    TagRecord,
    pack_tag,
    unpack_tag,
)

DEVICE_ID = int.from_bytes(b"TDIT", "little")
CODE_MEMORY = 0x8000
"""First address of the code memory."""
MAP_END = 0x80
"""First address beyond the map; words below it without a register read as 0."""

# Identity and capabilities.

ID = Register("ID", 0x00, "constant", 32, "Always 'TDIT' in ASCII.", reset=DEVICE_ID)
VERSION = Register(
    "VERSION",
    0x01,
    "constant",
    32,
    "Versions of the protocol and the gateware, and the board.",
    (
        Field("protocol", 0, 8, "version of the protocol"),
        Field("firmware_minor", 8, 8, "version of the gateware, after the point"),
        Field("firmware_major", 16, 8, "version of the gateware, before the point"),
        Field("board", 24, 8, "see Board"),
    ),
)
MAP = Register(
    "MAP", 0x02, "constant", 32, "CRC-32 of this register map, which must be the same on both sides."
)
SERIAL = Register("SERIAL", 0x03, "constant", 64, "Serial number.")
CLOCK_HZ = Register("CLOCK_HZ", 0x05, "constant", 32, "Frequency of the clock.")
CODE_BITS = Register("CODE_BITS", 0x06, "constant", 32, "Size of the code memory in bits.")
LIMITS = Register(
    "LIMITS",
    0x07,
    "constant",
    32,
    "Limits of a sub-step.",
    (
        Field("substep_min", 0, 8, "fewest clocks of a sub-step"),
        Field("substep_max_log2", 8, 8, "a sub-step has at most 2^this - 1 clocks"),
        Field("lead_margin", 16, 8, "clocks by which LED.lead must stay below the sub-step"),
    ),
)
CAPABILITIES = Register(
    "CAPABILITIES",
    0x08,
    "constant",
    32,
    "Capabilities of the device.",
    (
        Field("substeps", 0, 8, "bit S set: S sub-steps per line are possible"),
        Field("phases", 8, 1, "charge-transfer phase outputs"),
        Field("strobes", 9, 1, "camera strobe inputs"),
        Field("pps", 10, 1, "pulse-per-second input"),
        Field("scene_gate", 11, 1, "external scene gate input"),
        Field("external_arm", 12, 1, "external arm input"),
        Field(
            "light_low",
            13,
            1,
            "built for a light that a low level switches on: LED resets with invert set",
        ),
        Field("start_latency", 16, 16, "clocks from START or the external edge to line 0, minus LED.lead"),
    ),
)
QUEUES = Register(
    "QUEUES",
    0x09,
    "constant",
    32,
    "Room for tags and requests.",
    (
        Field("tags", 0, 16, "number of tags that the FIFO holds"),
        Field("rx_bytes", 16, 16, "encoded bytes of unanswered requests that the host may have sent"),
    ),
)

# Current state.

STATUS = Register(
    "STATUS",
    0x10,
    "read",
    32,
    "State of the device and its inputs.",
    (
        Field("state", 0, 3, "see State"),
        Field("busy", 3, 1, "CHECK_CODE or SELF_TEST is under way"),
        Field("code_checked", 4, 1, "CODE_CRC is that of the present code memory and CODE_LENGTH"),
        Field("clock_locked", 5, 1, "the clock's PLL is locked to its reference"),
        Field("clock_external", 6, 1, "the reference is the external one"),
        Field("pps_seen", 7, 1, "there has been a pulse-per-second edge since power-up"),
        Field("scene_gate", 8, 1, "level of the input"),
        Field("external_arm", 9, 1, "level of the input"),
        Field("end_reason", 12, 4, "end reason of the latest run, see EndReason"),
        Field("clock_losses", 16, 16, "number of times that the lock was lost since power-up"),
    ),
)
REJECT = Register(
    "REJECT",
    0x11,
    "read",
    32,
    "Reason why the latest ARM was refused; 0 if it was not.",
    (Field("error", 0, 16, "see ErrorCode"), Field("address", 16, 16, "the register at fault")),
)
CURRENT_RUN = Register(
    "CURRENT_RUN", 0x12, "read", 64, "Id of the armed, running or ended run; 0 if there was none yet."
)
TIME = Register("TIME", 0x14, "read", 48, "Clocks since power-up.")
START_TIME = Register("START_TIME", 0x16, "read", 48, "TIME at the start of line 0; 0 before that.")
LINES = Register("LINES", 0x18, "read", 48, "Lines started in this run.")
CODE_STATE = Register(
    "CODE_STATE",
    0x1A,
    "read",
    64,
    "State of the PRBS register at the first code bit of the latest line; defined while no run is running.",
)
TAG_COUNT = Register("TAG_COUNT", 0x1C, "read", 32, "Tags made in this run, including lost ones.")
TAG_LOST = Register(
    "TAG_LOST", 0x1D, "read", 32, "Tags of this run that were lost because the FIFO was full."
)
TAG_FIFO = Register(
    "TAG_FIFO",
    0x1E,
    "read",
    32,
    "Fill level of the tag FIFO.",
    (Field("fill", 0, 16, "tags"), Field("peak", 16, 16, "most tags in this run")),
)
RX_ERRORS = Register("RX_ERRORS", 0x1F, "read", 32, "Frames dropped because of their CRC, form or length.")
STROBE_A_SEEN = Register("STROBE_A_SEEN", 0x20, "read", 32, "Strobes of camera A in this run.")
STROBE_A_MISSED = Register(
    "STROBE_A_MISSED", 0x21, "read", 32, "Pulses of A without a strobe before the next pulse."
)
STROBE_A_UNEXPECTED = Register(
    "STROBE_A_UNEXPECTED", 0x22, "read", 32, "Strobes of A without a pulse of their own."
)
STROBE_B_SEEN = Register("STROBE_B_SEEN", 0x23, "read", 32, "As for A.")
STROBE_B_MISSED = Register("STROBE_B_MISSED", 0x24, "read", 32, "As for A.")
STROBE_B_UNEXPECTED = Register("STROBE_B_UNEXPECTED", 0x25, "read", 32, "As for A.")
PPS_TIME = Register("PPS_TIME", 0x26, "read", 48, "TIME at the latest pulse-per-second edge.")
PPS_COUNT = Register("PPS_COUNT", 0x28, "read", 32, "Pulse-per-second edges since power-up.")
CODE_CRC = Register(
    "CODE_CRC",
    0x29,
    "read",
    32,
    "CRC-32 of the words of the code memory that hold CODE_LENGTH bits, computed by CHECK_CODE over whole "
    "words of four bytes each, the low byte first.",
)
SELF_TEST = Register(
    "SELF_TEST",
    0x2A,
    "read",
    32,
    "Result of the latest self-test.",
    (
        Field("done", 0, 1, "a test has been carried out since power-up"),
        Field("memory_failed", 1, 1, "the code memory does not hold what was written"),
        Field("prbs_failed", 2, 1, "the sequence of the PRBS register is wrong"),
        Field("crc_failed", 3, 1, "the result of the CRC unit is wrong"),
    ),
)

# Run id and command: a write of three words from RUN_ID on is one command.

RUN_ID = Register("RUN_ID", 0x40, "operand", 64, "Run to which COMMAND refers.")
COMMAND = Register("COMMAND", 0x42, "command", 32, "See Command.")

# Configuration of the next run.

CODE_SOURCE = Register(
    "CODE_SOURCE",
    0x48,
    "config",
    32,
    "Source of the code bits.",
    (Field("kind", 0, 2, "see Source"), Field("value", 2, 1, "code bit of the source CONSTANT")),
)
CODE_LENGTH = Register(
    "CODE_LENGTH",
    0x49,
    "config",
    32,
    "Number of bits of the code memory in use, after which the code repeats.",
)
PRBS_MASK = Register(
    "PRBS_MASK",
    0x4A,
    "config",
    64,
    "Σ 1 << (tap - 1). Each step: bit = r & 1; r >>= 1; if bit: r ^= PRBS_MASK.",
)
PRBS_SEED = Register("PRBS_SEED", 0x4C, "config", 64, "r at code index 0.")
SUBSTEP_CLOCKS = Register("SUBSTEP_CLOCKS", 0x50, "config", 24, "Clocks of a sub-step.", reset=900)
LINE = Register(
    "LINE",
    0x51,
    "config",
    32,
    "Structure of a line.",
    (
        Field("substeps", 0, 3, "S"),
        Field("mode", 3, 1, "see LineMode"),
        Field("direction", 4, 1, "1: the charge-transfer phases run backwards"),
    ),
    reset=3,
)
PHASE_CLOCKS = Register(
    "PHASE_CLOCKS",
    0x52,
    "config",
    24,
    "Clocks of a charge-transfer sub-phase. A line has six and a sub-step 6/S, the last of which takes "
    "the rest. 0: the phases rest low.",
)
LED = Register(
    "LED",
    0x53,
    "config",
    32,
    "The light: code bit AND window AND scene gate.",
    (
        Field("enable", 0, 1, "0: the light is off"),
        Field("gate_enable", 1, 1, "the scene gate input gates the light"),
        Field("invert", 2, 1, "the output is low while the light is on"),
        Field("lead", 8, 8, "clocks by which the light precedes its sub-step"),
    ),
)
WINDOW_OPEN = Register(
    "WINDOW_OPEN", 0x54, "config", 24, "Clock of the sub-step from which the light may be on."
)
WINDOW_CLOSE = Register(
    "WINDOW_CLOSE", 0x55, "config", 24, "Clock of the sub-step from which it is off.", reset=900
)
_TRIGGER_FIELDS = (
    Field("enable", 0, 1, "0: no pulses"),
    Field("invert", 1, 1, "the output is low during the pulse"),
    Field("direction", 2, 1, "level of the camera's direction output"),
    Field("strobe", 3, 1, "the camera answers every pulse with a strobe; missed ones are counted"),
)
TRIGGER_A = Register("TRIGGER_A", 0x56, "config", 32, "Line trigger of camera A.", _TRIGGER_FIELDS)
TRIGGER_A_DELAY = Register(
    "TRIGGER_A_DELAY", 0x57, "config", 24, "Clocks from the start of the line to the pulse."
)
TRIGGER_A_WIDTH = Register("TRIGGER_A_WIDTH", 0x58, "config", 24, "Width of the pulse in clocks.", reset=90)
TRIGGER_B = Register("TRIGGER_B", 0x59, "config", 32, "Line trigger of camera B.", _TRIGGER_FIELDS)
TRIGGER_B_DELAY = Register("TRIGGER_B_DELAY", 0x5A, "config", 24, "As for A.")
TRIGGER_B_WIDTH = Register("TRIGGER_B_WIDTH", 0x5B, "config", 24, "As for A.", reset=90)
CAMERA_MIN_PERIOD = Register(
    "CAMERA_MIN_PERIOD",
    0x5C,
    "config",
    32,
    "Smallest period in clocks between pulses that the cameras tolerate.",
)
LINE_BUDGET = Register(
    "LINE_BUDGET", 0x5D, "config", 48, "Number of lines after which the run ends; 0: no limit."
)
TAG_INTERVAL = Register(
    "TAG_INTERVAL", 0x5F, "config", 24, "Number of lines from one tag of a line to the next.", reset=256
)
WATCHDOG = Register(
    "WATCHDOG",
    0x60,
    "config",
    32,
    "Number of clocks without a valid request after which a run ends, from its first clock on; 0: never.",
    reset=900_000_000,
)
EXTERNAL_ARM = Register(
    "EXTERNAL_ARM",
    0x61,
    "config",
    32,
    "Start of an armed run by an external input.",
    (Field("enable", 0, 1, "1: wait for an edge"), Field("invert", 1, 1, "1: the edge is a falling one")),
)

REGISTERS: tuple[Register, ...] = tuple(
    sorted((item for item in list(globals().values()) if isinstance(item, Register)), key=lambda r: r.address)
)
"""All registers in the order of their addresses."""

CONFIGURATION = tuple(register for register in REGISTERS if register.access == "config")


def map_crc() -> int:
    """Return the CRC-32 of everything in the map on which a program can depend, without explanations."""
    # Without the explanations, so that a better text does not part a program from its device.
    parts: list[object] = [
        [(r.name, r.address, r.access, r.width, r.reset) for r in REGISTERS],
        [(r.name, f.name, f.low, f.width) for r in REGISTERS for f in r.fields],
        [
            (kind.__name__, [(item.name, int(item)) for item in kind])
            for kind in (Command, State, EndReason, ErrorCode, Source, LineMode, FrameType, TagFlag)
        ],
        TAG_FIELDS,
    ]
    return zlib.crc32(repr(parts).encode())


MAP_CRC = map_crc()
"""Value of MAP."""
