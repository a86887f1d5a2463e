"""The documents made from `acquire.trigger.registers`: ``firmware/REGISTERS.md`` and ``PROTOCOL.md``."""

from __future__ import annotations

import inspect
import re
from itertools import accumulate
from typing import TYPE_CHECKING

from acquire.trigger import registers
from acquire.trigger.protocol_text import PROTOCOL
from acquire.trigger.registers import (
    REGISTERS,
    TAG_FIELDS,
    Board,
    Command,
    EndReason,
    ErrorCode,
    FrameType,
    LineMode,
    Source,
    State,
    TagFlag,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from enum import IntEnum, IntFlag

    from acquire.trigger.registers import Register

_NOTE = "<!-- Made by tools/registers_table.py from acquire/trigger/registers.py: edit that file. -->"


def registers_markdown() -> str:
    """Return the text of ``firmware/REGISTERS.md``."""
    lines = [
        _NOTE,
        "",
        "# Registers of the sync trigger",
        "",
        (inspect.getdoc(registers) or "").replace("::\n", ":\n"),
        "",
        "## Access",
        "",
        "constant: never changes. read: changed by the device. config: can be written while no run is armed",
        "or running, and reads back. operand: can be written at any time, and reads back. command: acts when",
        "written, and reads as 0.",
        "",
        "Bits are counted from the lowest bit of the register's first word. The reset value is the value at",
        "power-up. The values of a field are listed in [PROTOCOL.md](PROTOCOL.md). A host must first compare",
        "ID, VERSION.protocol and MAP with the values given here.",
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
    """Return the text of ``firmware/PROTOCOL.md``."""
    kinds: dict[str, type[IntEnum | IntFlag]] = {
        "types": FrameType,
        "commands": Command,
        "states": State,
        "reasons": EndReason,
        "sources": Source,
        "modes": LineMode,
        "boards": Board,
        "flags": TagFlag,
        "errors": ErrorCode,
    }
    tables: dict[str, str] = {}
    for name, kind in kinds.items():
        # From the source, since Python does not keep the texts below the members of an enumeration.
        texts = re.findall(r"^    (\w+) = .*\n    \"\"\"(.*?)\"\"\"", inspect.getsource(kind), re.MULTILINE)
        docs = dict(texts)
        form = "0x{:02x}" if kind is FrameType else "{}"  # types in hexadecimal: their bits have a meaning
        rows = [f"| {form.format(int(item))} | {item.name} | {docs[str(item.name)]} |\n" for item in kind]
        tables[name] = "| value | name | |\n|---|---|---|\n" + "".join(rows)
    starts = accumulate((bits // 8 for _, bits in TAG_FIELDS), initial=0)
    fields = zip(TAG_FIELDS, starts, strict=False)  # the last start is the end
    return PROTOCOL.substitute(
        tables,
        note=_NOTE,
        version=registers.PROTOCOL_VERSION,
        max_payload=registers.MAX_PAYLOAD,
        max_words=registers.MAX_WORDS,
        map_end=f"0x{registers.MAP_END:04x}",
        code_memory=f"0x{registers.CODE_MEMORY:04x}",
        time_bits=registers.TIME_BITS,
        tag_fields="".join(f"| {name} | {bits} | {at} |\n" for (name, bits), at in fields),
    )


def _rows(register: Register) -> Iterator[str]:
    # A constant has a reset value here only if it is the same in all devices.
    known = register.access != "constant" or register.reset
    reset = f"{register.reset:#x}" if known else "by device"
    if register is registers.MAP:
        reset = f"{registers.MAP_CRC:#x}"
    yield (
        f"| 0x{register.address:04x} | {register.name} | {register.width} | {register.access} "
        f"| {reset} | {register.doc} |"
    )
    for field in register.fields:
        top = field.low + field.width - 1
        bits = str(field.low) if field.width == 1 else f"{top}:{field.low}"
        yield f"| | .{field.name} | {bits} | | | {field.doc} |"
