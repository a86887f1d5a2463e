"""The check of tests/conftest.py, run on tests that leave something behind."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

LEAKY = """
import mmap, os, subprocess, sys, threading
import pytest

KEPT = []

def test_clean():
    with open(os.devnull) as file:
        assert not file.closed
    thread = threading.Thread(target=str)
    thread.start()

def test_thread():
    event = threading.Event()
    KEPT.append(event)
    threading.Thread(target=event.wait, name="left-thread", daemon=True).start()

def test_child():
    KEPT.append(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"]))

def test_descriptor():
    KEPT.append(os.open(os.devnull, os.O_RDONLY))

def test_shared_memory():
    fd = os.memfd_create("left-memory")
    os.ftruncate(fd, 4096)
    KEPT.append(mmap.mmap(fd, 4096))
    os.close(fd)

def test_end():
    KEPT[0].set()
    KEPT[1].kill()
    KEPT[1].wait()
"""


def test_each_kind_of_leftover_fails_its_test_and_no_other(tmp_path: Path) -> None:
    for name in ("conftest.py", "left_out.py", "throttle.py"):
        shutil.copy(Path(__file__).parent / name, tmp_path)
    (tmp_path / "pytest.ini").write_text("[pytest]\nleak_grace_s = 0.3\n")
    (tmp_path / "test_leaky.py").write_text(LEAKY)
    command = [sys.executable, "-m", "pytest", "-q", "-rA", "-p", "no:cacheprovider", str(tmp_path)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=tmp_path, check=False)
    failed = set(re.findall(r"ERROR test_leaky\.py::(\w+)", run.stdout))
    assert failed == {"test_thread", "test_child", "test_descriptor", "test_shared_memory"}, run.stdout
    for named in ("left-thread", "time.sleep(60)", "/dev/null", "left-memory"):
        assert named in run.stdout
