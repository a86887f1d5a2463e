"""The definition of the registers: no overlap, and the documents that are made from it."""

from __future__ import annotations

from pathlib import Path

import pytest

from acquire.trigger import registers as r
from acquire.trigger.registers_table import protocol_markdown, registers_markdown

FIRMWARE = Path(__file__).parents[2] / "firmware"


@pytest.mark.parametrize(
    ("name", "text"), [("REGISTERS.md", registers_markdown()), ("PROTOCOL.md", protocol_markdown())]
)
def test_the_documents_are_those_of_the_definition(name, text) -> None:
    assert (FIRMWARE / name).read_text(encoding="utf-8") == text, "run tools/registers_table.py"


def test_no_two_registers_share_a_word_and_all_lie_below_the_code_memory() -> None:
    words = [register.address + i for register in r.REGISTERS for i in range(register.words)]
    assert len(words) == len(set(words))
    assert max(words) < r.CODE_MEMORY
    assert len({register.name for register in r.REGISTERS}) == len(r.REGISTERS)


def test_fields_fit_their_registers_and_do_not_overlap() -> None:
    for register in r.REGISTERS:
        taken = 0
        for field in register.fields:
            bits = field.put(field.limit)
            assert bits < 1 << register.width, (register.name, field.name)
            assert not bits & taken, (register.name, field.name)
            taken |= bits
        assert 0 <= register.reset < 1 << register.width


def test_the_configuration_is_one_write() -> None:
    first, last = r.CONFIGURATION[0], r.CONFIGURATION[-1]
    assert last.address + last.words - first.address <= r.MAX_WORDS
    assert r.COMMAND.address == r.RUN_ID.address + r.RUN_ID.words


def test_fields_by_name() -> None:
    value = r.LED.pack(enable=1, lead=200)
    assert r.LED.unpack(value) == {"enable": 1, "gate_enable": 0, "invert": 0, "lead": 200}
    assert r.REJECT.field("address").of(r.REJECT.pack(error=3, address=9)) == 9
    with pytest.raises(ValueError, match="lead = 256 does not fit 8 bits"):
        r.LED.pack(lead=256)
    with pytest.raises(AttributeError, match="no field 'leed'"):
        r.LED.pack(leed=1)
    with pytest.raises(ValueError, match="24 bits"):
        r.SUBSTEP_CLOCKS.to_words(1 << 24)


def test_the_checksum_depends_on_addresses_and_not_on_explanations(monkeypatch) -> None:
    from dataclasses import replace

    def with_first(**changes):
        monkeypatch.setattr(r, "REGISTERS", (replace(r.ID, **changes), *r.REGISTERS[1:]))
        crc = r.map_crc()
        monkeypatch.undo()
        return crc

    assert with_first(doc="other") == r.MAP_CRC
    assert with_first(address=0x30) != r.MAP_CRC
    assert with_first(reset=1) != r.MAP_CRC
