"""What happened is told once, in order, to whoever asks, and never kept for anybody."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, cast

import pytest
from fake_run import FakeRun, rig_config

from acquire.daemon.health import health_of
from acquire.daemon.messages import (
    ArmRequest,
    ArmStatus,
    CheckStatus,
    DiskStatus,
    RingStatus,
    StartRequest,
    Status,
)
from acquire.daemon.news import LOSSES_EVERY_S, Changes, NewsLog
from acquire.daemon.service import Service
from acquire.daemon.states import State
from acquire.daemon.stream import ALIVE, MOST_STREAMS, Streams
from acquire.errors import StateError
from acquire.stream.messages import Note
from acquire.web.page_stream import MOST_PAGES, OpenPages


def arm_status(lost: int = 0, fill: int = 0, verdict: str = "verified", **more: Any) -> ArmStatus:
    facts = {
        "delivered": 100,
        "preroll": 0,
        "lost": {"camera": lost},
        "recorded": 0,
        "missing": 0,
        "rate_hz": 1000.0,
        "ring": RingStatus(slots=100, fill=fill, peak=fill, drops=0),
        "check": CheckStatus(verdict=verdict, shift=0, checked_line=7, lapped=0),
    }
    return ArmStatus.model_validate({**facts, **more})


def disk(seconds: float) -> DiskStatus:
    return DiskStatus(
        directory=Path("/d"), free_bytes=1, reserve_bytes=0, bytes_per_s=1.0, seconds_to_full=seconds
    )


def status(arm: ArmStatus | None = None, run_id: str | None = "r", **more: Any) -> Status:
    facts: dict[str, Any] = {
        "state": State.RECORDING if run_id else State.IDLE,
        "since": "2026-01-01T00:00:00Z",
        "possible": [],
        "busy": None,
        "name": "rig",
        "version": "1",
        "pid": 1,
        "uptime_s": 1.0,
        "run_id": run_id,
        "recording": None,
        "arms": {"a": arm or arm_status()} if run_id else {},
        "last": None,
        "fault": None,
        "disk": disk(1e6),
    }
    return Status.model_validate({**facts, **more})


def test_a_client_that_was_away_hears_what_it_missed() -> None:
    log = NewsLog()
    for text in "abc":
        log.add("mark", text)
    first = log.after(None)
    assert [one.text for one in first] == ["a", "b", "c"]
    assert [one.text for one in log.after(first[0].id)] == ["b", "c"]
    assert log.after(log.last_id) == []


def test_news_that_are_not_kept_any_more_are_reported_as_missed() -> None:
    log = NewsLog(kept=2)
    log.add("mark", "first")
    seen = log.last_id
    for text in "abcd":
        log.add("mark", text)
    missed, *others = log.after(seen)
    assert (missed.kind, missed.text) == ("missed", "2 earlier events are not kept any more")
    assert [one.text for one in others] == ["c", "d"]
    assert [one.text for one in log.after(missed.id)] == ["c", "d"]  # its id is a place in the log as well


def test_news_of_another_life_of_the_daemon_are_not_taken_for_its_own() -> None:
    log = NewsLog()
    log.add("mark", "a")
    for foreign in (f"{'0' * 8}-1", "nonsense", f"{log.life}-x"):
        missed, one = log.after(foreign)
        assert (missed.kind, one.text) == ("missed", "a")


def test_listeners_are_woken_until_they_are_forgotten() -> None:
    log, woken = NewsLog(), []
    wake = lambda: woken.append(1)  # noqa: E731
    log.listen(wake)
    log.add("mark", "a")
    log.close()
    assert len(woken) == 2
    log.forget(wake)
    log.add("mark", "b")
    assert len(woken) == 2


def test_lost_lines_are_reported_at_once_and_then_summed() -> None:
    now = 100.0
    changes = Changes(lambda: now)
    assert changes.of(status()) == []
    (told,) = changes.of(status(arm_status(lost=5)))
    assert (told["kind"], told["lines"], told["arm"], told["level"]) == ("loss", 5, "a", "error")
    assert changes.of(status(arm_status(lost=9))) == []
    now += LOSSES_EVERY_S
    (told,) = changes.of(status(arm_status(lost=12)))
    assert told["lines"] == 7
    now += LOSSES_EVERY_S
    assert changes.of(status(arm_status(lost=0), run_id="next")) == []
    (told,) = changes.of(status(arm_status(lost=3), run_id="next"))
    assert told["lines"] == 3


def test_a_verdict_is_reported_when_it_changes() -> None:
    changes = Changes()
    assert changes.of(status(arm_status(verdict="unknown"))) == []
    (good,) = changes.of(status(arm_status(verdict="verified")))
    (bad,) = changes.of(status(arm_status(verdict="wrong_code")))
    assert (good["level"], bad["level"]) == ("info", "error")
    assert bad["text"] == "arm a: the light's code is wrong code"
    assert changes.of(status(arm_status(verdict="wrong_code"))) == []


def test_waiting_is_reported_when_it_begins_and_ends() -> None:
    changes = Changes()
    assert changes.of(status()) == []
    assert [one["kind"] for one in changes.of(status(waiting="the disk, for 2 s"))] == ["waiting"]
    assert changes.of(status(waiting="the disk, for 3 s")) == []
    assert [one["text"] for one in changes.of(status())] == ["the wait is over"]
    pause = "the recording will continue in a further segment once the disk allows it: "
    for why in ("too slow to write", "no recording can begin in /d: its disk is not mounted on /d any more"):
        assert [one["text"] for one in changes.of(status(waiting=pause + why))] == [pause + why]
        assert changes.of(status(waiting=pause + why)) == []


def test_old_news_are_not_repeated_when_a_run_begins() -> None:
    changes = Changes()
    recovered = {"path": "/d/x.zarr", "state": "recovered", "text": "killed"}
    trouble = {"text": "oh", "times": 1, "last": "2026-01-01T00:00:00Z"}
    facts = {"recoveries": [recovered], "troubles": [trouble]}
    assert [one["kind"] for one in changes.of(status(run_id=None, **facts))] == ["trouble", "recovery"]
    for run_id in ("a", None, "b"):
        assert changes.of(status(run_id=run_id, **facts)) == []


def test_a_disk_that_fills_is_reported_once() -> None:
    changes = Changes(lambda: 0.0)
    assert changes.of(status(disk=disk(1e6))) == []
    changes = Changes(lambda: 0.0)
    (told,) = changes.of(status(disk=disk(100.0)))
    assert (told["kind"], told["level"], told["text"]) == ("disk", "error", "the disk is full in 2 min")
    assert changes.of(status(disk=disk(90.0))) == []


def recording(beyond_bytes: int, path: str = "/d/x.zarr") -> dict[str, Any]:
    lines = {"first_line": 0, "budget_lines": None, "recorded_lines": 9, "committed_lines": 9}
    return {"path": path, "beyond_bytes": beyond_bytes, **lines}


def test_held_lines_beyond_the_limit_are_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    changes = Changes()
    assert changes.of(status(recording=recording(0))) == []
    (told,) = changes.of(status(recording=recording(3_000_000)))
    words = "x.zarr takes 3 MB more than recording.retention.max_gb allows: lines are held"
    assert (told["kind"], told["level"], told["text"]) == ("disk", "warning", words)
    assert changes.of(status(recording=recording(4_000_000))) == []
    assert caplog.messages == [words]
    assert [one["kind"] for one in changes.of(status(recording=recording(5, "/d/y.zarr")))].count("disk") == 1


def test_an_unforeseen_error_is_reported_every_time_it_happens(tmp_path: Path) -> None:
    service = Service(rig_config(tmp_path), lambda _: FakeRun())
    for _ in range(2):
        service.troubles.note("thread x", ValueError("oh"))
        service.supervise()
        service.supervise()
    told = [one for one in service.news.after(None) if one.kind == "trouble"]
    assert [(one.text, one.level) for one in told] == [("thread x: ValueError: oh", "error")] * 2


def test_the_service_tells_states_marks_and_faults(tmp_path: Path) -> None:
    run = FakeRun()
    service = Service(rig_config(tmp_path), lambda _: run)
    service.arm(ArmRequest())
    service.start(StartRequest(path=tmp_path / "x.zarr"))
    service.mark("the valve\nopens")
    run.happened.append(Note(5, "input", "edge"))
    service.supervise()
    run.see(fault="camera b is gone")
    service.supervise()
    told = [(one.kind, one.state) for one in service.news.after(None)]
    assert told == [
        ("state", State.ARMED),
        ("state", State.RECORDING),
        ("mark", State.RECORDING),
        ("input", State.RECORDING),
        ("state", State.FAULTED),
    ]
    mark, fault = service.news.after(None)[2], service.news.after(None)[-1]
    assert (mark.line, mark.text) == (77, "the valve\nopens")
    assert (fault.level, "camera b is gone" in fault.text) == ("error", True)
    service.disarm()


def test_a_directory_that_is_away_is_reported_when_it_goes_and_when_it_is_back() -> None:
    changes = Changes()
    changes.of(status())
    (told,) = changes.of(status(disk=None, disk_trouble="no recording can begin in /d: silent for 11 s"))
    assert (told["kind"], told["level"]) == ("disk", "error")
    assert not changes.of(status(disk=None, disk_trouble="no recording can begin in /d: silent for 12 s"))
    (told,) = changes.of(status())
    assert (told["kind"], told["level"]) == ("disk", "info")


@pytest.mark.parametrize(
    ("seen", "level", "words"),
    [
        (status(run_id=None), "idle", "Nothing is armed"),
        (status(), "good", "nothing is lost"),
        (status(arm_status(lost=3)), "lost", "3 lines were lost"),
        (status(arm_status(fill=30)), "degraded", "ring a is 30% full"),
        (status(arm_status(verdict="inverted")), "degraded", "inverted"),
        (status(arm_status(saturated_part=0.2)), "degraded", "20.0% of the lines"),
        (status(arm_status(rate_hz=500.0)), "degraded", "500 lines/s of 1000"),
        (status(disk=disk(300.0)), "degraded", "full in 5 min"),
        (status(disk=None, disk_trouble="/d is away; mount it"), "degraded", "; /d is away; mount it."),
        (status(recording=recording(7)), "degraded", "7 B more than recording.retention.max_gb allows"),
        (status(state=State.FAULTED, fault="no light"), "fault", "no light"),
    ],
)
def test_health_is_one_word_and_one_sentence(seen: Status, level: str, words: str) -> None:
    found = health_of(seen, 1000.0, age_s=60.0)
    assert found.level == level
    assert words in found.sentence


def test_a_rate_is_not_judged_before_it_is_known() -> None:
    assert health_of(status(arm_status(rate_hz=0.0)), 1000.0, age_s=1.0).level == "good"


def test_places_of_streams_are_taken_at_once_and_given_back_with_them() -> None:
    """A place was taken by a stream's first step: of requests in one moment, more than the limit got in."""
    streams = Streams(NewsLog(), lambda: status(arm_status()))

    def opened() -> AsyncIterator[str]:
        return streams.open(None, None, history=False)

    kept = [opened() for _ in range(MOST_STREAMS)]
    with pytest.raises(StateError, match="16 clients follow the news already"):
        opened()
    kept.pop()  # dropped before its first step
    kept.append(opened())

    async def begun() -> None:
        stream = kept.pop()
        assert await anext(stream) == ALIVE
        with pytest.raises(StateError):
            opened()
        await stream.aclose()  # type: ignore[attr-defined]
        kept.append(opened())

    asyncio.run(begun())


def test_places_of_pages_are_taken_at_once() -> None:
    pages = OpenPages(cast("Any", None))
    kept = [pages.open(pictures=False, glimpses=False) for _ in range(MOST_PAGES)]
    with pytest.raises(StateError, match="24 pages are open already"):
        pages.open(pictures=False, glimpses=False)
    kept.pop()
    kept.append(pages.open(pictures=False, glimpses=False))
