"""A look from outside sees what passes, can change nothing, and keeps no memory."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from acquire.errors import DeviceError
from acquire.stream.peek import Peek
from acquire.stream.ring import Ring, RingShape

SHAPE = RingShape(slots=4, rows=2, width=3, dtype="uint16")


def put(ring: Ring, number: int) -> None:
    slot = ring.claim(2 * number, 2)
    assert slot is not None
    slot.pixels[:] = number
    ring.commit(slot)


def take(ring: Ring) -> None:
    assert ring.acquire() is not None
    ring.release()


@pytest.fixture
def ring():
    made = Ring("a", SHAPE)
    yield made
    made.close()


def test_it_sees_what_comes_and_changes_nothing(ring: Ring) -> None:
    put(ring, 0)
    peek = Peek("a", ring.path, SHAPE)
    assert peek.next() is None  # it begins with what is still to come
    put(ring, 1)
    block = peek.next()
    assert block is not None
    assert (block.first_line, block.pixels[0, 0]) == (2, 1)
    with pytest.raises(ValueError, match="read-only"):
        block.pixels[0, 0] = 9
    assert peek.took()
    assert ring.fill == 2
    del block
    peek.close()


def test_what_is_overwritten_while_it_is_looked_at_is_not_kept(ring: Ring) -> None:
    peek = Peek("a", ring.path, SHAPE)
    put(ring, 0)
    assert peek.next() is not None
    for number in range(1, 6):
        take(ring)
        put(ring, number)
    assert not peek.took()
    block = peek.next()
    assert block is not None
    assert block.first_line // 2 + 1 > peek.lapped >= 1
    assert np.all(block.pixels == block.first_line // 2)
    del block
    peek.close()


def test_another_process_looks_and_the_memory_goes_with_its_owner(ring: Ring) -> None:
    """The looker stands still with the memory mapped; what it held is free once it is discarded."""
    big = RingShape(slots=64, rows=256, width=1024, dtype="uint8")
    made = Ring("big", big)
    code = (
        "import sys; from acquire.stream.peek import Peek; from acquire.stream.ring import RingShape\n"
        f"peek = Peek('big', {made.path!r}, {big!r}); peek._ring._memory.map[0:: 4096]\n"
        "print('mapped', flush=True); sys.stdin.read()"
    )
    looker = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert looker.stdout is not None
    assert looker.stdout.readline() == "mapped\n"
    file = os.open(made.path, os.O_RDONLY)
    assert os.fstat(file).st_blocks * 512 >= big.size
    made.discard()
    made.close()
    assert os.fstat(file).st_blocks == 0
    os.close(file)
    looker.communicate()
    assert looker.returncode == 0


def test_memory_that_is_not_a_ring_is_refused(ring: Ring, tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="cannot be read"):
        Peek("a", str(tmp_path / "none"), SHAPE)
    (tmp_path / "file").write_bytes(b"x")
    with pytest.raises(DeviceError, match="is not the memory of this ring"):
        Peek("a", str(tmp_path / "file"), SHAPE)
