"""The link's gateware against zlib and the COBS package: every byte is right, no wrong one accepted."""

from __future__ import annotations

import random
import zlib
from typing import Any

import pytest
from bench import pulse, simulate
from cobs import cobs

from firmware.deframer import Deframer
from firmware.framer import Framer
from firmware.uart import UartReceiver, UartTransmitter

MAX_PAYLOAD = 240
AWKWARD = [
    bytes(4),
    bytes(10),
    b"\x01" * 4,
    b"\x00\x01\x02\x00",
    bytes(range(1, 245)),
    bytes(244),
    b"\xff" * 244,
    random.Random(1).randbytes(97),
]


def framed(body: bytes) -> bytes:
    return cobs.encode(body + zlib.crc32(body).to_bytes(4, "little")) + b"\0"


@pytest.mark.parametrize("body", AWKWARD, ids=lambda body: f"{len(body)} {body[:4].hex()}")
def test_framer_sends_what_the_package_encodes(body: bytes) -> None:
    framer, sent = Framer(), bytearray()

    async def talk(context: Any) -> None:
        for _ in range(2):
            for at, byte in enumerate(body):
                context.set(framer.valid, 1)
                context.set(framer.data, byte)
                context.set(framer.last, at == len(body) - 1)
                await context.tick().until(framer.ready)
            context.set(framer.valid, 0)

    async def listen(context: Any) -> None:
        context.set(framer.bytes.ready, 1)
        while sent.count(0) < 2:
            (byte,) = await context.tick().sample(framer.bytes.payload).until(framer.bytes.valid)
            sent.append(byte)

    simulate(framer, talk, listen)
    assert bytes(sent) == framed(body) * 2


@pytest.mark.parametrize("body", AWKWARD, ids=lambda body: f"{len(body)} {body[:4].hex()}")
def test_deframer_gives_back_the_frame(body: bytes) -> None:
    assert deframe(framed(body)) == ([body], 0)


def test_deframer_drops_and_counts_what_is_damaged_and_keeps_the_rest() -> None:
    good = framed(b"\x01\x02\x03\x04good")
    damaged = bytearray(framed(b"\x01\x02\x03\x04evil"))
    damaged[6] ^= 1
    cut = framed(b"\x01\x02\x03\x04cut off")[:-5] + b"\0"
    short = cobs.encode(b"abc") + b"\0"
    long = framed(bytes(range(1, 252))) + framed(b"x" * 500)
    frames, bad = deframe(good + bytes(damaged) + b"\0\0" + cut + short + long + good)
    assert frames == [b"\x01\x02\x03\x04good"] * 2
    assert bad == 5


def deframe(data: bytes) -> tuple[list[bytes], int]:
    """The frames in ``data`` as the gateware sees them, and how many it dropped."""
    deframer = Deframer(MAX_PAYLOAD)
    frames: list[bytes] = []
    dropped = 0

    async def bench(context: Any) -> None:
        nonlocal dropped
        for byte in data:
            context.set(deframer.bytes.valid, 1)
            context.set(deframer.bytes.payload, byte)
            await context.tick()
            context.set(deframer.bytes.valid, 0)
            dropped += context.get(deframer.bad)
            if context.get(deframer.frame):
                frames.append(await fetch(context))

    async def fetch(context: Any) -> bytes:
        body = bytearray()
        for address in range(context.get(deframer.length)):
            context.set(deframer.address, address)
            await context.tick().repeat(2)
            body.append(context.get(deframer.data))
        await pulse(context, deframer.release)
        return bytes(body)

    simulate(deframer, bench)
    return frames, dropped


@pytest.mark.parametrize("divisor", [8, 30])
def test_uart_carries_every_byte_back_to_back(divisor: int) -> None:
    sent, got = bytes([0, 255, 0x55, 0xAA, 1, 0x80]), bytearray()
    transmitter, receiver = UartTransmitter(divisor), UartReceiver(divisor)

    async def wire(context: Any) -> None:
        for _ in range(divisor * 10 * (len(sent) + 1)):
            context.set(receiver.line, context.get(transmitter.line))
            await context.tick()
            if context.get(receiver.valid):
                got.append(context.get(receiver.data))

    async def talk(context: Any) -> None:
        for byte in sent:
            context.set(transmitter.bytes.valid, 1)
            context.set(transmitter.bytes.payload, byte)
            await context.tick().until(transmitter.bytes.ready)
        context.set(transmitter.bytes.valid, 0)

    simulate(together(transmitter, receiver), wire, talk)
    assert bytes(got) == sent


def together(*parts: Any) -> Any:
    from amaranth.hdl import Module

    module = Module()
    module.submodules += parts
    return module
