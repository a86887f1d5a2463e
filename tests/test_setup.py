"""What conftest.py and left_out.py do about tests that leave something behind, are late, or crash."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent

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
    KEPT.append(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]))

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

LATE = """
import os, time
import pytest

@pytest.mark.timeout(1)
def test_late():
    time.sleep(3600)

def test_after_the_late_one():
    pass

def test_crash():
    os._exit(3)

def test_after_the_crash():
    pass

@pytest.mark.needs_gpu
@pytest.mark.parametrize("number", range(3))
def test_gpu(number):
    raise AssertionError
"""

CONFTEST = """
import left_out

left_out.find_missing = lambda: {"needs_gpu": "a GPU"}
left_out.leave_out_folder("tests/firmware/rtl", "there is no g++")
pytest_plugins = ["checks", "left_out"]
"""


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The summary of such tests, run by one worker process after another."""
    place = tmp_path_factory.mktemp("inner")
    shutil.copy(HERE / "conftest.py", place / "checks.py")
    for name, text in (("conftest.py", CONFTEST), ("test_leaky.py", LEAKY), ("test_more.py", LATE)):
        (place / name).write_text(text)
    settings = "leak_grace_s = 0.3\ntimeout_method = signal\ntestpaths = .\n"
    (place / "pytest.ini").write_text(f"[pytest]\n{settings}")
    command = [sys.executable, "-m", "pytest", "-q", "-rA", "-p", "no:cacheprovider", "-n", "1"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    run = subprocess.run(
        [*command, "--dist", "worksteal"],
        capture_output=True,
        text=True,
        cwd=place,
        env=environment | {"PYTHONPATH": f"{HERE}{os.pathsep}{HERE.parent}"},
        timeout=600,
        check=False,
    )
    return run.stdout


def outcomes(word: str, said: str) -> set[str]:
    return set(re.findall(rf"^{word} test_\w+\.py::(\w+)", said, re.MULTILINE))


def test_each_kind_of_leftover_fails_its_test_and_no_other(said: str) -> None:
    assert outcomes("ERROR", said) == {
        "test_thread",
        "test_child",
        "test_descriptor",
        "test_shared_memory",
    }, said
    for named in ("left-thread", "time.sleep(600)", "/dev/null", "left-memory"):
        assert named in said


def test_one_that_is_late_or_ends_its_process_fails_alone(said: str) -> None:
    assert outcomes("FAILED", said) == {"test_late", "test_crash"}, said
    assert {"test_clean", "test_end", "test_after_the_late_one", "test_after_the_crash"} <= outcomes(
        "PASSED", said
    )
    assert "Timeout (>1.0s)" in said
    assert re.search(r"2 failed, \d+ passed.* 4 errors", said), said


def test_what_workers_left_out_is_named_once(said: str) -> None:
    assert said.count("left out, for want of a GPU: 3 tests") == 1, said
    assert said.count("tests/firmware/rtl was left out: there is no g++") == 1, said


def test_limits_are_those_of_the_project(request: pytest.FixtureRequest) -> None:
    """A test that no signal reaches ends its process, later than one that a signal does."""
    ini = request.config.getini
    assert ini("timeout_method") == "signal"
    assert float(ini("timeout")) < float(ini("faulthandler_timeout"))
    assert ini("faulthandler_exit_on_timeout")
