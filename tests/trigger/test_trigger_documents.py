"""The documents are complete: a client written from them alone runs the device, gateware and model."""

from __future__ import annotations

import ast
import zlib
from collections.abc import Iterator
from pathlib import Path

import paper_client
import pytest
from paper_client import Client, Documents, Refused
from trigger_twins import DEVICES

import firmware
from acquire.sim.twin_links import PtyTwin

DOCUMENTS = Documents(Path(firmware.__file__).parent)
RUN = 0xFEDC_BA98_7654_3210
WATCHDOG = 40_000
"""Clocks; the gateware's link takes some thousand for a request and its answer."""


@pytest.fixture(params=DEVICES)
def client(request: pytest.FixtureRequest) -> Iterator[Client]:
    with DEVICES[request.param]() as device:
        twin = PtyTwin(device)
        made = Client(twin.path, DOCUMENTS)
        try:
            yield made
        finally:
            made.close()
            twin.close()


def refused(client: Client, name: str, run: int = 0) -> str:
    """The error that a command is refused with, by its name in the document."""
    names = {number: error for error, number in DOCUMENTS.numbers("Errors").items()}
    with pytest.raises(Refused) as caught:
        client.command(name, run)
    return names[caught.value.error]


def test_the_client_uses_only_the_documents() -> None:
    tree = ast.parse(Path(paper_client.__file__).read_text(encoding="utf-8"))
    imported = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = [
        alias.name if isinstance(node, ast.Import) else node.module
        for node in imported
        for alias in node.names
    ]
    assert not [name for name in names if name.split(".")[0] in {"acquire", "firmware", "cobs"}]


def configure(client: Client, lines: int, watchdog: int) -> None:
    """Lines of 3 · 400 clocks, lit by the code memory."""
    sources, modes = DOCUMENTS.numbers("CODE_SOURCE.kind"), DOCUMENTS.numbers("LINE.mode")
    client.write("SUBSTEP_CLOCKS", 400)
    client.write("WINDOW_CLOSE", 400)
    client.write("LINE", client.packed("LINE", substeps=3, mode=modes["PER_LINE"]))
    client.write("CODE_SOURCE", client.packed("CODE_SOURCE", kind=sources["MEMORY"]))
    client.write("LED", client.packed("LED", enable=1))
    client.write("TRIGGER_A", client.packed("TRIGGER_A", enable=1))
    client.write("TAG_INTERVAL", 4)
    client.write("LINE_BUDGET", lines)
    client.write("WATCHDOG", watchdog)


def load_code(client: Client) -> None:
    words = [0xDEADBEEF, 0x12345678, 0x0000FFFF]
    client.write_words(0x8000, words)
    client.write("CODE_LENGTH", 70)
    client.command("CHECK_CODE")
    while client.field("STATUS", "busy"):
        pass
    covered = b"".join(word.to_bytes(4, "little") for word in words)
    assert client.read("CODE_CRC") == zlib.crc32(covered), "70 bits lie in three words, which count whole"


def await_last(client: Client) -> None:
    last = DOCUMENTS.numbers("Flags of a tag")["LAST"]
    while not client.tags or not client.tags[-1][1]["flags"] & last:
        client.hear()


def test_a_run_from_the_handshake_to_its_last_tag(client: Client) -> None:
    registers = DOCUMENTS.registers
    for name in ("ID", "MAP"):
        assert client.read(name) == int(registers[name].reset, 16)
    assert client.field("VERSION", "protocol") == DOCUMENTS.version
    assert client.field("VERSION", "board") in DOCUMENTS.numbers("VERSION.board").values()
    for name, register in registers.items():
        if register.access == "config":
            assert client.read(name) == int(register.reset, 16), name
    assert client.field("STATUS", "state") == DOCUMENTS.numbers("STATUS.state")["IDLE"]
    assert refused(client, "CHECK_CODE") == "BAD_CODE_LENGTH"
    load_code(client)
    configure(client, lines=10, watchdog=0)
    client.command("ARM", RUN)
    client.command("ARM", RUN)
    assert refused(client, "ARM", RUN + 1) == "BUSY"
    assert refused(client, "START", RUN ^ 1 << 63) == "WRONG_RUN"
    client.command("START", RUN)
    await_last(client)
    flags = DOCUMENTS.numbers("Flags of a tag")
    *lines, (_, last) = client.tags
    assert [sequence for sequence, _ in client.tags] == list(range(4))
    assert [tag["line"] for _, tag in lines] == [0, 4, 8]
    start = client.read("START_TIME")
    for _, tag in lines:
        assert tag["run"] == RUN & 0xFFFFFFFF
        assert tag["code_index"] == 3 * tag["line"]
        assert tag["timestamp"] == start + tag["line"] * 1200
        assert tag["flags"] == flags["LINE"] | (flags["FIRST"] if tag["line"] == 0 else 0)
    assert (last["line"], last["flags"]) == (9, flags["LAST"] | flags["BUDGET"])
    assert 0 <= last["timestamp"] - (start + 10 * 1200) <= 15
    assert (client.read("LINES"), client.read("TAG_COUNT")) == (10, 4)
    assert client.field("STATUS", "state") == DOCUMENTS.numbers("STATUS.state")["ENDED"]
    assert client.field("STATUS", "end_reason") == DOCUMENTS.numbers("STATUS.end_reason")["LINE_BUDGET"]
    assert refused(client, "ARM", RUN) == "RUN_OVER"
    client.command("START", RUN)


def test_a_silent_client_s_run_is_ended_by_the_watchdog(client: Client) -> None:
    load_code(client)
    configure(client, lines=0, watchdog=WATCHDOG)
    client.command("ARM", RUN)
    client.command("START", RUN)
    await_last(client)
    flags, (_, last) = DOCUMENTS.numbers("Flags of a tag"), client.tags[-1]
    assert last["flags"] == flags["LAST"] | flags["WATCHDOG"]
    assert last["line"] == WATCHDOG // 1200
    assert client.field("STATUS", "end_reason") == DOCUMENTS.numbers("STATUS.end_reason")["WATCHDOG"]


def test_a_run_that_is_stopped_before_it_starts_has_a_last_tag(client: Client) -> None:
    configure(client, lines=0, watchdog=WATCHDOG)
    load_code(client)
    client.command("ARM", RUN)
    client.command("STOP", 0)
    await_last(client)
    flags = DOCUMENTS.numbers("Flags of a tag")
    ((sequence, last),) = client.tags
    assert (sequence, last["line"], last["code_index"]) == (0, 0, 0)
    assert last["flags"] == flags["LAST"] | flags["NO_LINES"]
    assert client.read("START_TIME") == 0


def test_the_documented_end_of_the_map_and_words_that_are_too_wide(client: Client) -> None:
    errors = DOCUMENTS.numbers("Errors")

    def refusal(words: list[int] | int, address: int) -> tuple[int, int]:
        with pytest.raises(Refused) as caught:
            client.read_words(address, words) if isinstance(words, int) else client.write_words(
                address, words
            )
        return caught.value.error, caught.value.address

    bad = errors["BAD_ADDRESS"]
    assert client.read_words(0x7F, 1) == [0]
    client.write_words(0x7F, [0])
    assert refusal([1], 0x7F) == (bad, 0x7F)
    assert refusal(2, 0x7F) == (bad, 0x7F)
    assert refusal([0, 0], 0x7F) == (bad, 0x80)
    code_end = 0x8000 + client.read("CODE_BITS") // 32
    assert refusal(3, code_end - 2) == (bad, code_end - 2)
    assert refusal([0], code_end) == (bad, code_end)
    substep, led = (DOCUMENTS.registers[name].address for name in ("SUBSTEP_CLOCKS", "LED"))
    client.write_words(substep, [0xFFFFFFFF])
    assert client.read("SUBSTEP_CLOCKS") == 0xFFFFFF
    client.write_words(led, [0xFFFFFFF0])
    assert client.read("LED") == 0xFFFFFFF0
    assert refusal([0], DOCUMENTS.registers["ID"].address) == (errors["READ_ONLY"], 0)
    configure(client, lines=0, watchdog=0)
    load_code(client)
    client.command("ARM", RUN)
    assert refusal(1, 0x8000) == (errors["BUSY"], 0x8000)
    assert refusal(3, code_end - 2) == (bad, code_end - 2)
    assert refusal([1, 2], led - 1) == (errors["BUSY"], led - 1)
    assert client.read("COMMAND") == 0
    client.command("STOP", RUN)


@pytest.mark.parametrize("data", [b"", b"a", bytes(3), bytes(range(256)) * 3, b"x" * 254, b"x" * 508 + b"\0"])
def test_the_client_s_cobs_agrees_with_the_package(data: bytes) -> None:
    from cobs import cobs

    assert paper_client.unstuffed(cobs.encode(data)) == data
    assert cobs.decode(paper_client.stuffed(data)) == data
