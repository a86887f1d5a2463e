"""The gateware's code equals `acquire.codes`, bit by bit."""

from __future__ import annotations

import random
import zlib
from typing import Any

import pytest
from bench import pulse, simulate

from acquire.codes import TAPS, mix_seed, prbs
from firmware.codememory import CodeMemory
from firmware.lfsr import Lfsr
from firmware.selftest import MASK, SEED, SelfTest, expected


@pytest.mark.parametrize("degree", sorted(TAPS))
def test_lfsr_makes_the_bits_of_its_python_twin(degree: int) -> None:
    lfsr, made = Lfsr(), []
    seed = mix_seed(degree, degree)

    async def bench(context: Any) -> None:
        context.set(lfsr.mask, sum(1 << (tap - 1) for tap in TAPS[degree]))
        context.set(lfsr.seed, seed)
        await pulse(context, lfsr.load)
        context.set(lfsr.step, 1)
        for _ in range(300):
            made.append(context.get(lfsr.bit))
            await context.tick()

    simulate(lfsr, bench)
    assert made == prbs(degree, seed, 0, 300).tolist()


def test_lfsr_is_constant_without_a_step() -> None:
    lfsr = Lfsr()

    async def bench(context: Any) -> None:
        context.set(lfsr.mask, 0x60)
        context.set(lfsr.seed, 0x55)
        await pulse(context, lfsr.load)
        await context.tick().repeat(5)
        assert context.get(lfsr.state) == 0x55

    simulate(lfsr, bench)


@pytest.mark.parametrize("length", [1, 31, 32, 33, 100, 256])
def test_code_memory_plays_its_bits_and_begins_again(length: int) -> None:
    memory, words = CodeMemory(8), [random.Random(length).getrandbits(32) for _ in range(8)]
    bits = [words[k // 32] >> k % 32 & 1 for k in range(length)]
    made: list[int] = []

    async def bench(context: Any) -> None:
        await fill(context, memory, words)
        context.set(memory.length, length)
        await pulse(context, memory.load)
        for _ in range(2 * length + 3):
            await context.tick().repeat(4)
            made.append(context.get(memory.bit))
            await pulse(context, memory.step)

    simulate(memory, bench)
    assert made == [bits[k % length] for k in range(2 * length + 3)]


@pytest.mark.parametrize("length", [32, 33, 256])
def test_code_memory_reads_back_and_computes_the_crc_of_its_contents(length: int) -> None:
    memory, words = CodeMemory(8), [random.Random(7).getrandbits(32) for _ in range(8)]
    read: list[int] = []

    async def bench(context: Any) -> None:
        await fill(context, memory, words)
        context.set(memory.length, length)
        for _ in range(2):  # the second sum does not inherit from the first
            await pulse(context, memory.check)
            while context.get(memory.busy):
                await context.tick()
        context.set(memory.host_read, 1)
        for address in range(8):
            context.set(memory.host_address, address)
            await context.tick().repeat(2)
            read.append(context.get(memory.host_data))
        held = b"".join(word.to_bytes(4, "little") for word in words[: (length + 31) // 32])
        assert context.get(memory.crc) == zlib.crc32(held)

    simulate(memory, bench)
    assert read == words


async def fill(context: Any, memory: CodeMemory, words: list[int]) -> None:
    context.set(memory.write, 1)
    for address, word in enumerate(words):
        context.set(memory.write_address, address)
        context.set(memory.write_data, word)
        await context.tick()
    context.set(memory.write, 0)


@pytest.mark.parametrize("fault", ["none", "memory", "prbs", "crc"])
def test_the_self_test_reports_the_broken_part(fault: str) -> None:
    words = 4
    test = SelfTest(words)
    state, crc = expected(words)
    found: dict[str, int] = {}

    async def device(context: Any) -> None:
        """A register, a memory and a CRC unit, one of them broken."""
        held, register = [0] * words, SEED
        for _ in range(60):
            context.set(test.state, register ^ (fault == "prbs" and register == state))
            context.set(test.word, held[context.get(test.address)] ^ (fault == "memory"))
            context.set(test.crc, crc ^ (fault == "crc"))
            if context.get(test.write):
                held[context.get(test.address)] = register & 0xFFFFFFFF
            load, step = context.get(test.load), context.get(test.step)
            await context.tick()
            if load:
                register = SEED
            elif step:
                register = register >> 1 ^ (MASK if register & 1 else 0)

    async def host(context: Any) -> None:
        await pulse(context, test.run)
        while context.get(test.busy):
            await context.tick()
        found.update(
            done=context.get(test.done),
            memory=context.get(test.memory_failed),
            prbs=context.get(test.prbs_failed),
            crc=context.get(test.crc_failed),
        )

    simulate(test, device, host)
    assert found == {"done": 1, "memory": 0, "prbs": 0, "crc": 0} | ({} if fault == "none" else {fault: 1})
