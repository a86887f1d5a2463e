"""The documents made from `acquire.trigger.registers`: ``firmware/REGISTERS.md`` and ``PROTOCOL.md``."""

from __future__ import annotations

import inspect
import re
from typing import TYPE_CHECKING

from acquire.trigger import registers
from acquire.trigger.registers import REGISTERS, TAG_FIELDS, Command, ErrorCode, FrameType, TagFlag

if TYPE_CHECKING:
    from collections.abc import Iterator
    from enum import Enum

    from acquire.trigger.registers import Register

_NOTE = "<!-- Made by tools/registers_table.py from acquire/trigger/registers.py: change that. -->"

_PROTOCOL = f"""\
{_NOTE}

# The sync trigger's protocol, version {registers.PROTOCOL_VERSION}

Bytes in both directions (UART 8N1, or USB bulk) are frames. All numbers are little endian.

```
version u8 | type u8 | sequence u16 | payload, at most {registers.MAX_PAYLOAD} bytes | CRC-32 u32
```

The CRC (zlib's) covers everything before it. The whole is COBS-encoded and ended by one 0x00. A receiver
drops what is between two zeros if it is not a frame; the device counts it in RX_ERRORS and says nothing.

| type | value | direction | payload |
|---|---|---|---|
| READ | 0x01 | to the device | address u16, count u8 (1 to {registers.MAX_WORDS} words) |
| WRITE | 0x02 | to the device | address u16, 1 to {registers.MAX_WORDS} words u32 |
| DATA | 0x81 | answer to READ | address u16, words u32 |
| ACK | 0x82 | answer to WRITE | address u16, count u8 |
| NAK | 0x83 | answer to any | error u16, address u16 |
| TAG | 0x90 | unasked | see below |

- An answer has the sequence of its request. Requests are answered in their order. The device does not
  compare sequences: a request sent twice is done twice, and every request may be sent twice (see commands).
- A host keeps no more than QUEUES.rx_bytes encoded bytes of unanswered requests on the way.
- A frame of another version is answered by NAK BAD_VERSION in a frame of the device's version.
- Words of a WRITE take effect in their order; at the first that cannot, NAK says which (its address), and
  those before it have taken effect. A READ beyond the map is NAK BAD_ADDRESS; words without a register
  within it read as 0. Writing 0 to such a word is allowed, so that a block of registers is one WRITE.
- Reading the low word of a register of access `read` with two words captures both: the high word that
  follows in the same READ belongs to it.
- A write to a `config` register, or to the code memory, while a run is armed, running or stopping, or
  while the device is busy, is NAK BUSY.

## Commands

One WRITE of three words from RUN_ID on: run id, command. Asking again changes nothing:

| command | what is done | asked again | refused |
|---|---|---|---|
| ARM | configuration checked, counters cleared, state ARMED; an external edge of the next 4 clocks is \
ignored | ACK while the same run is armed or running | BUSY: another run, or the last tag of the run before \
waits for room; RUN_OVER: this run has ended; 32 and more: the configuration, see REJECT |
| START | line 0 begins start_latency + LED.lead clocks later | ACK while the same run runs or has ended | \
NOT_ARMED, WRONG_RUN |
| STOP | the run ends after the line that runs; no line if none has begun | ACK | WRONG_RUN |
| CHECK_CODE | CODE_CRC is computed, STATUS.busy until then | done again | BUSY |
| SELF_TEST | SELF_TEST is found out, STATUS.busy until then | done again | BUSY |

## Tags

| field | bits |
|---|---|
""" + "".join(f"| {name} | {bits} |\n" for name, bits in TAG_FIELDS)

_PROTOCOL_END = """
The frame's sequence is the low half of TAG_COUNT when the tag was made, 0 for a run's first: a gap is a lost
tag. Tags of lines and tags of events are made in the order of their time stamps.
"""


def registers_markdown() -> str:
    """``firmware/REGISTERS.md``."""
    lines = [
        _NOTE,
        "",
        "# Registers of the sync trigger",
        "",
        (inspect.getdoc(registers) or "").replace("::\n", ":\n"),
        "",
        "## Access",
        "",
        "constant: never changes. read: changes by itself. config: written while no run is armed or running. "
        "operand: written at any time. command: acts when written.",
        "",
        "## Map",
        "",
        "| address | register | bits | access | reset | |",
        "|---|---|---|---|---|---|",
        *(row for register in REGISTERS for row in _rows(register)),
        "",
    ]
    return "\n".join(lines)


def protocol_markdown() -> str:
    """``firmware/PROTOCOL.md``."""
    tables = [_enum_table(kind) for kind in (FrameType, Command, ErrorCode, TagFlag)]
    flags = f"\n## Flags of a tag\n\n{tables[3]}"
    return f"{_PROTOCOL}{_PROTOCOL_END}{flags}\n## Errors\n\n{tables[2]}"


def _rows(register: Register) -> Iterator[str]:
    yield (
        f"| 0x{register.address:04x} | {register.name} | {register.width} | {register.access} "
        f"| {register.reset:#x} | {register.doc} |"
    )
    for field in register.fields:
        top = field.low + field.width - 1
        bits = str(field.low) if field.width == 1 else f"{top}:{field.low}"
        yield f"| | .{field.name} | {bits} | | | {field.doc} |"


def _enum_table(kind: type[Enum]) -> str:
    docs = _member_docs(kind)
    rows = [f"| {item.value} | {item.name} | {docs.get(item.name, '')} |\n" for item in kind]
    return "| value | name | |\n|---|---|---|\n" + "".join(rows)


def _member_docs(kind: type[Enum]) -> dict[str, str]:
    """The text below each member in the source."""
    found = re.findall(r"^    (\w+) = .*\n    \"\"\"(.*?)\"\"\"", inspect.getsource(kind), re.MULTILINE)
    return dict(found)
