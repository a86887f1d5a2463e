"""A few cycles of `tools/soak.py`: scheduled faults, complete ledgers, no growth."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path

from acquire.lines import ARMS
from tools.shift_host import left_in_shared_memory, mapped
from tools.soak import Soak, soak
from tools.weeks import Life


def test_every_line_is_accounted_for_and_memory_does_not_grow(tmp_path: Path) -> None:
    found = soak(tmp_path, 60_000, 10_000.0, seed=1)
    assert found.wrong == []
    assert found.segments >= found.cycles >= 2
    assert found.faults.total() >= 4
    (handles, threads), *_, (handles_end, threads_end) = found.usage
    assert (handles_end, threads_end) == (handles, threads)
    assert set(found.memory) == {"owner", "recorder", *ARMS}
    assert "too short to judge" in str(found)
    assert not any(tmp_path.iterdir())


def test_steady_growth_is_a_defect_and_fluctuation_is_not() -> None:
    found = Soak()
    found.memory["steady"] = [(second, 80.0 + second % 3) for second in range(40)]
    found.memory["leaking"] = [(second, 80.0 + 0.2 * second) for second in range(40)]
    found.memory["settling"] = [(second, 80.0 + min(second, 15)) for second in range(40)]
    found.judge()
    assert found.wrong == ["leaking: grew by 3.8 MB in the second half"]


def test_what_1000_recordings_add_is_a_slope_of_the_second_half() -> None:
    life = Life()
    for number in range(40):
        life.looks.append(
            {
                "recordings": 20.0 * number,
                "memory_mb": 80.0 + min(number, 15) + 0.1 * (number % 2),
                "objects": 1000.0 + 40 * number,
                "descriptors": 20.0 + (number == 30),
            }
        )
    slopes = life.slopes()
    assert abs(slopes["memory_mb"]) < 0.1
    assert abs(slopes["objects"] - 2000) < 1
    assert slopes["descriptors"] == 0


def test_shared_memory_of_other_programs_is_not_counted(tmp_path: Path) -> None:
    """Semaphores that other tests made and left in the meantime counted as ours."""
    code = "import mmap; f = open({!r}, 'r+b'); m = mmap.mmap(f.fileno(), 1); print(flush=True); input()"
    with contextlib.ExitStack() as stack:
        users = []
        for whose in ("ours", "another"):
            file = Path(f"/dev/shm/sem.{tmp_path.parent.parent.name}-{os.getpid()}-{whose}")
            stack.callback(file.unlink, missing_ok=True)
            file.write_bytes(b"x")
            command = [sys.executable, "-c", code.format(str(file))]
            user = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
            users.append(stack.enter_context(user))
            assert user.stdout is not None
            user.stdout.readline()
        found = mapped([users[0].pid])
        for user in users:
            user.kill()
        assert [name.rpartition("-")[2] for name in left_in_shared_memory(found)] == ["ours"]
