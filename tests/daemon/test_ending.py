"""A thread that hangs in the system keeps no process from ending."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

BEGIN = """
import logging, pathlib, sys, threading, time
from acquire.daemon import ending
logging.basicConfig()
fifo, left = map(pathlib.Path, sys.argv[1:])
threading.Thread(target=fifo.read_bytes, name="reader").start()
"""
LEAVE = "ending.LINGER_S = 0.1; sys.exit(ending.leave(7))"
LAST_RESORT = "ending.LastResort(left.unlink).within(0.1); fifo.read_bytes()"


@pytest.mark.parametrize(("end", "code"), [(LEAVE, 7), (LAST_RESORT, 1)])
def test_a_thread_that_hangs_is_named_and_left(tmp_path: Path, end: str, code: int) -> None:
    fifo, left = tmp_path / "fifo", tmp_path / "c.sock"
    os.mkfifo(fifo)
    left.touch()
    ended = subprocess.run(
        [sys.executable, "-c", BEGIN + end, fifo, left],
        check=False,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert ended.returncode == code, ended.stderr
    assert "thread reader at" in ended.stderr
    assert left.exists() == (end is LEAVE)


def test_nothing_is_forced_where_all_threads_end() -> None:
    ended = subprocess.run(
        [
            sys.executable,
            "-c",
            "import threading, time; from acquire.daemon import ending;"
            "last = ending.LastResort(lambda: None); last.within(60); last.within(0.05); last.cancel();"
            "threading.Thread(target=time.sleep, args=(0.3,)).start(); print(ending.leave(0))",
        ],
        check=False,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "0\n", "")
