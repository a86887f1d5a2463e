"""The output of the control commands, over a scripted client."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from acquire.cli import control, main
from acquire.cli.durations import seconds
from acquire.cli.output import quantity
from acquire.daemon.messages import (
    ArmStatus,
    DiskStatus,
    LastRecording,
    RecordingStatus,
    RingStatus,
    Status,
    TriggerStatus,
    TroubleStatus,
)
from acquire.daemon.states import State, commands
from acquire.errors import EXIT_INTERRUPTED, NoDaemonError

Cli = Callable[..., Any]


def status(state: State, **more: Any) -> Status:
    ring = RingStatus(slots=64, fill=3, peak=9, drops=0)
    arm = ArmStatus(
        delivered=1000,
        preroll=65,
        lost={"camera": 2, "ring_full": 0},
        recorded=500,
        missing=1,
        rate_hz=33_333.3,
        ring=ring,
    )
    facts: dict[str, Any] = {
        "busy": None,
        "run_id": None,
        "recording": None,
        "arms": {"a": arm},
        "last": None,
        "fault": None,
    }
    return Status(
        state=state,
        since=datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC),
        possible=[str(command) for command in commands(state)],
        name="demo",
        version="0",
        pid=42,
        uptime_s=7.0,
        **(facts | more),
    )


def last(condition: str | None) -> LastRecording:
    return LastRecording(path=Path("/d/x.zarr"), lines=500, condition=condition, end_reason="stopped")


class FakeClient:
    """Answers every command with one status."""

    def __init__(self, answer: Status) -> None:
        self.answer = answer
        self.calls: list[Any] = []

    def __enter__(self) -> FakeClient:
        return self

    def __exit__(self, *_: object) -> None: ...

    def __getattr__(self, name: str) -> Callable[..., Status]:
        def command(*words: Any, **options: Any) -> Status:
            self.calls.append((name, *words, options))
            return self.answer

        return command


@pytest.fixture
def answering(monkeypatch: pytest.MonkeyPatch) -> Callable[[Status], FakeClient]:
    def use(answer: Status) -> FakeClient:
        client = FakeClient(answer)
        monkeypatch.setattr(control, "_daemon", lambda _: client)
        monkeypatch.setattr(control, "status_document", lambda _: json.loads(answer.model_dump_json()))
        return client

    return use


def test_status_in_words(cli: Cli, answering: Callable[[Status], FakeClient]) -> None:
    now = RecordingStatus(
        path=Path("/d/x.zarr"), first_line=40, budget_lines=900, recorded_lines=500, committed_lines=256
    )
    answering(status(State.RECORDING, recording=now, run_id="r-1", busy="stop"))
    out = cli("status").out
    assert "recording since 2025-01-02 03:04:05 UTC" in out
    assert "/d/x.zarr, 500 of 900 lines from line 40, 256 readable" in out
    assert "process 42" in out
    arm = {name: words for name, *words in (line.split() for line in out.rpartition("\n\n")[2].splitlines())}
    assert arm["arm"] == ["a"]
    assert arm["rate"] == ["33.3", "kHz"]
    assert (arm["delivered"], arm["preroll"], arm["recorded"]) == (["1000"], ["65"], ["500"])
    assert (arm["missing"], arm["lost"], arm["drops"]) == (["1"], ["camera", "2"], ["0"])
    assert (arm["ring"], arm["ledger"]) == (["3", "of", "64,", "peak", "9"], ["-"])


def test_status_as_json_is_the_message(cli: Cli, answering: Callable[[Status], FakeClient]) -> None:
    answer = status(State.FAULTED, fault="camera a is gone")
    answering(answer)
    assert Status.model_validate(cli("status", "--json").json) == answer
    assert "camera a is gone" in cli("status").out


def test_commands_pass_on_the_options_that_were_given(
    cli: Cli, answering: Callable[[Status], FakeClient]
) -> None:
    client = answering(status(State.RECORDING))
    assert cli("start", "x.zarr", "--lines", 5).code == 0
    assert cli("start", "--duration", 0.5).code == 0
    assert cli("start", "--pre", "2s", "--post", "250ms").code == 0
    assert cli("mark", "a bang").code == 0
    assert cli("arm", "--code", "dark", "--without-calibration").code == 0
    assert client.calls == [
        ("start", Path("x.zarr"), {"lines": 5, "resume": False}),
        ("start", None, {"duration_s": 0.5, "resume": False}),
        ("start", None, {"pre_s": 2.0, "post_s": 0.25, "resume": False}),
        ("mark", "a bang", {}),
        ("arm", {"force": False, "code": "dark", "calibration": "none"}),
    ]


@pytest.mark.parametrize(("light", "state"), [("dark", "off"), ("steady", "on")])
def test_a_start_without_the_lights_code_is_warned_of(
    cli: Cli, answering: Callable[[Status], FakeClient], light: str, state: str
) -> None:
    """A calibration that was killed leaves the instrument armed like that."""
    answering(status(State.RECORDING, light=light))
    told = f"the light stays {state}, as for a calibration"
    answer = cli("start", "x.zarr")
    assert answer.code == 0
    assert told in answer.err
    assert f"WARNING: {told}" in cli("status").out


def test_the_rigs_own_code_is_not_mentioned(cli: Cli, answering: Callable[[Status], FakeClient]) -> None:
    answering(status(State.RECORDING, light="rig"))
    answer = cli("start", "x.zarr")
    assert "light" not in answer.out + answer.err


def test_wait_passes_on_state_and_time(cli: Cli, answering: Callable[[Status], FakeClient]) -> None:
    client = answering(status(State.IDLE))
    assert cli("status", "--wait", "idle", "--timeout", 300).code == 0
    assert client.calls == [("wait", {State.IDLE}, 300.0, {})]


@pytest.mark.parametrize(
    ("condition", "code"), [("GOOD", 0), ("TAINTED", 0), ("INCOMPLETE", 6), ("ABORTED", 6), (None, 6)]
)
def test_stop_reports_lost_lines(
    cli: Cli, answering: Callable[[Status], FakeClient], condition: str | None, code: int
) -> None:
    answering(status(State.IDLE, last=last(condition)))
    answer = cli("stop")
    assert answer.code == code
    assert "/d/x.zarr, 500 lines" in answer.out
    assert ("acquire info /d/x.zarr" in answer.err) == bool(code)


@pytest.mark.parametrize(
    ("text", "value"),
    [("2s", 2.0), ("500ms", 0.5), ("1.5min", 90.0), ("1h", 3600.0), ("3", 3.0), ("1e-3", 1e-3)],
)
def test_durations_in_words(text: str, value: float) -> None:
    assert seconds(text) == pytest.approx(value)


@pytest.mark.parametrize("text", ["", "s", "2 weeks", "-1s", "1s2", "nan", "inf", "1..2s"])
def test_an_invalid_duration_is_refused(cli: Cli, text: str) -> None:
    answer = cli("start", f"--pre={text}")
    assert answer.code == 2
    assert "is not a duration, such as 2s, 500ms" in " ".join(answer.err.split())


class Terminal(io.StringIO):
    """A standard output that is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("columns", [60, 80, 120, 200])
def test_status_fits_the_terminal(
    answering: Callable[[Status], FakeClient], monkeypatch: pytest.MonkeyPatch, columns: int
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setattr(sys, "argv", ["acquire", "status"])
    monkeypatch.setattr(sys, "stdout", terminal := Terminal())
    now = RecordingStatus(
        path=Path("/data/2025/recordings/run-of-the-valve-7.zarr"),
        first_line=40,
        budget_lines=900_000,
        recorded_lines=500_000,
        committed_lines=256,
    )
    disk = DiskStatus(
        directory=Path("/data/2025/recordings"),
        free_bytes=10**12,
        reserve_bytes=10**8,
        bytes_per_s=1e9,
        seconds_to_full=1000.0,
    )
    trigger = TriggerStatus(
        clock_hz=90_000_000, uncertainty_ns=1200, pulses=123_456, silent_s=7.5, answers=False
    )
    trouble = TroubleStatus(text="uploads: ValueError: \x1b[31m", times=3, last=datetime.now(UTC))
    answer = status(State.RECORDING, recording=now, disk=disk, trigger=trigger, troubles=[trouble])
    answering(answer.model_copy(update={"arms": {"a": answer.arms["a"], "b": answer.arms["a"]}}))
    main()
    lines = terminal.getvalue().splitlines()
    assert max(map(len, lines)) <= columns
    words = " ".join(" ".join(lines).split())
    assert "run-of-the-valve-7.zarr, 500000 of 900000 lines from line 40, 256 readable" in words
    assert "/data/2025/recordings, 1 TB free, full in 16.7 min at 1 GB/s" in words
    assert "SILENT for 8 s, 123456 lines, clock 90 MHz, UTC known to 1.2 us" in words
    assert "uploads: ValueError: \\x1b[31m (3 times)" in words
    assert ["rate", "33.3", "kHz", "33.3", "kHz"] in [line.split() for line in lines]


class PassingClient:
    """Client that answers, is absent, and answers again; then Ctrl-C is pressed."""

    def __init__(self, _: object) -> None:
        self.answers = [status(State.ARMED), status(State.ARMED), None, status(State.RECORDING)]

    def status(self) -> Status:
        if not self.answers:
            raise KeyboardInterrupt
        answer = self.answers.pop(0)
        if answer is None:
            raise NoDaemonError("no daemon listens")
        return answer


def test_watching_the_status_lasts_until_ctrl_c_and_reports_a_daemon_that_ended(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acquire.cli.watch.Client", PassingClient)
    answer = cli("status", "--watch", "--every", "0.1")
    assert answer.code == EXIT_INTERRUPTED
    states = [line.partition(" ")[2] for line in answer.out.splitlines()]
    assert [line.partition(",")[0] for line in states] == ["armed", "armed", "no daemon listens", "recording"]
    lines = cli("status", "--watch", "--every", "100ms", "--json").out.splitlines()
    assert [json.loads(line).get("state") for line in lines] == ["armed", "armed", None, "recording"]
    assert json.loads(lines[2])["error"]["error"] == "NoDaemonError"


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0.0, "0 B"),
        (999.4, "999 B"),
        (999.6, "1 kB"),
        (33_333.3, "33.3 kB"),
        (999_600.0, "1 MB"),
        (2e15, "2 PB"),
    ],
)
def test_quantities_have_no_exponent(value: float, words: str) -> None:
    assert quantity(value, "B") == words


@pytest.mark.parametrize(
    ("left_s", "words"),
    [(90, "90 s"), (1000, "16.7 min"), (86_400, "24 h"), (1e8, "3.17 years"), (1e12, "31688 years")],
)
def test_the_time_until_a_disk_is_full_has_no_exponent(
    cli: Cli, answering: Callable[[Status], FakeClient], left_s: float, words: str
) -> None:
    disk = DiskStatus(
        directory=Path("/data"), free_bytes=10**12, reserve_bytes=0, bytes_per_s=1e3, seconds_to_full=left_s
    )
    answering(status(State.ARMED, disk=disk))
    assert f"full in {words} at" in cli("status").out
