"""Progress of long work, and the answer to Ctrl-C: on a terminal, in a pipe, as JSON."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import pytest

from acquire.cli import progress as module
from acquire.cli.interrupts import END_NOW, _Presses, interrupts_handled, stop_on_interrupt
from acquire.cli.progress import ProgressDisplay, span

LIMIT_S = 30.0


@pytest.fixture
def heard(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[[int], list[str]]:
    """Wait for this number of further lines on stderr."""
    monkeypatch.setattr(module, "FIRST_S", 0.0)
    monkeypatch.setattr(module, "EVERY_S", 0.01)

    def lines(count: int) -> list[str]:
        capsys.readouterr()  # what was said before is not asked for
        said, deadline = "", time.monotonic() + LIMIT_S
        while said.count("\n") < count:
            assert time.monotonic() < deadline, said
            said += capsys.readouterr().err
            time.sleep(0.005)
        return said.splitlines()

    return lines


def test_a_pipe_gets_lines_with_share_and_time_left(heard: Callable[[int], list[str]]) -> None:
    with ProgressDisplay("verifying run.zarr") as progress:
        assert re.fullmatch(r"acquire: verifying run\.zarr, \d s", heard(1)[0])
        progress._began_s -= 100
        progress.advance(25, 100)
        said = r"acquire: verifying run\.zarr: 25 of 100 \(25%\), 1 min 4\d s, about 5 min \d+ s left"
        assert re.fullmatch(said, heard(3)[-1])
        progress.advance(2.25, 9)
        assert "2.2 of 9 (25%)" in heard(3)[-1]
    assert not [thread for thread in threading.enumerate() if thread.name == "acquire-progress"]


def test_short_work_shows_no_progress(capsys: pytest.CaptureFixture[str]) -> None:
    with ProgressDisplay("looking") as progress:
        progress.advance(1, 2)
    assert capsys.readouterr().err == ""


def test_programs_get_json(heard: Callable[[int], list[str]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["acquire", "verify", "--json"])
    with ProgressDisplay("verifying") as progress:
        progress._began_s -= 10
        progress.advance(1, 2)
        facts = json.loads(heard(2)[-1])["progress"]
    assert (facts["what"], facts["done"], facts["total"]) == ("verifying", 1, 2)
    assert facts["left_s"] == pytest.approx(10, rel=0.5)


def test_work_within_work_is_shown_in_its_place(heard: Callable[[int], list[str]]) -> None:
    with ProgressDisplay("the demo"):
        heard(1)
        with ProgressDisplay("recording"):
            assert "the demo" not in heard(3)[-1]
        assert heard(3)[-1].startswith("acquire: the demo, ")


def test_long_work_is_announced_once_with_a_faster_alternative(capsys: pytest.CaptureFixture[str]) -> None:
    with ProgressDisplay("reconstructing", "--preview") as progress:
        progress._began_s -= 100  # of compiling, which comes once
        progress.advance(1, 1000)
        progress.advance(2, 1000)
        assert progress._first is not None
        progress._first = (progress._first[0] - 10, 1)
        progress.advance(2, 1000)
    said = capsys.readouterr().err.splitlines()
    assert said == ["acquire: reconstructing will take about 2 h 46 min; quicker: --preview"]


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.4, "0 s"), (59, "59 s"), (61, "1 min 1 s"), (7320, "2 h 2 min")]
)
def test_durations_are_shown_in_words(seconds: float, words: str) -> None:
    assert span(seconds) == words


def test_a_terminal_gets_a_bar() -> None:
    code = (
        "from acquire.cli.progress import ProgressDisplay\n"
        "with ProgressDisplay('verifying') as p: p.advance(30, 40)"
    )
    parent, child = pty.openpty()
    try:
        subprocess.run(
            [sys.executable, "-c", code],
            stderr=child,
            stdout=subprocess.DEVNULL,
            env=os.environ | {"TERM": "xterm"},
            check=True,
            timeout=60,
        )
        said = os.read(parent, 65536).decode()
    finally:
        os.close(parent)
        os.close(child)
    assert "verifying" in said
    assert "30 of 40" in said


def test_ctrl_c_is_answered_before_anything_ends(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acquire.cli.interrupts.SAME_S", 0.0)

    def interrupted() -> None:
        with interrupts_handled():
            try:
                signal.raise_signal(signal.SIGINT)
            finally:  # before whatever takes its time to end
                said.append(capsys.readouterr().err)

    said: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert said == ["acquire: interrupted, ending; press Ctrl-C again to end now\n"]


def test_the_first_ctrl_c_finishes_and_the_second_ends(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acquire.cli.interrupts.SAME_S", 0.0)

    def interrupted_twice() -> None:
        with interrupts_handled(), stop_on_interrupt("finishing the segment") as asked:
            signal.raise_signal(signal.SIGINT)
            assert asked.is_set()
            said.append(capsys.readouterr().err)
            signal.raise_signal(signal.SIGINT)

    said: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        interrupted_twice()
    assert said == ["acquire: finishing the segment; press Ctrl-C again to end now\n"]
    for thread in threading.enumerate():
        if thread.name == END_NOW:
            thread.join(LIMIT_S)
            assert not thread.is_alive()


def test_interrupts_close_together_are_one_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("acquire.cli.interrupts.SAME_S", LIMIT_S)
    monkeypatch.setattr("acquire.cli.interrupts._presses", _Presses())
    with interrupts_handled():
        with stop_on_interrupt("finishing the segment") as asked:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)  # the echo may come after the work has ended in good order
    assert asked.is_set()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_program_s_order_to_end_is_like_ctrl_c(number: signal.Signals) -> None:
    """`timeout`, a batch system, a terminal that is closed: what was begun is put in order."""
    code = f"""
import signal, time
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup may have run these tests
from acquire.cli import interrupts
def end_by():
    try:
        with interrupts.interrupts_handled():
            signal.raise_signal({int(number)})
            time.sleep({LIMIT_S})
    except KeyboardInterrupt:
        return "in order"
print(end_by(), flush=True)
"""
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "in order\n", "")


def test_a_hangup_that_nohup_ignores_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interrupts_handled():
            signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
