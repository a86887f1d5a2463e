"""The rest of the API, by its clients: news with replay, request ids, facts, metrics."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import json
import logging
import socket
import threading
import time
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from typing import Self

import httpx
import pytest
from fake_run import FakeRun
from prometheus_client.parser import text_string_to_metric_families
from served import api

from acquire.client import AsyncClient, Client, News, State, core
from acquire.daemon import stream
from acquire.daemon.endpoint import Endpoint
from acquire.daemon.facts import API_VERSION, Reloaded
from acquire.daemon.local import Local
from acquire.daemon.messages import CapacityStatus, error_body
from acquire.daemon.service import Service
from acquire.errors import AcquireError, NoDaemonError, StateError, UsageError
from acquire.logs import Bounded

EVENTS = b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nConnection: close\r\n\r\n"


def raw_client(path: Path) -> httpx.Client:
    return httpx.Client(transport=httpx.HTTPTransport(uds=str(path)), base_url="http://x", timeout=300)


def test_the_same_request_id_gives_the_same_answer_and_acts_once(daemon: Client, run: FakeRun) -> None:
    first = daemon.arm(request_id="one")
    assert daemon.arm(request_id="one") == first  # armed already: without the id it would be refused
    assert run.names == ["arm"]
    with pytest.raises(StateError, match="cannot arm while armed"):
        daemon.arm(request_id="two")
    with pytest.raises(StateError, match="cannot arm while armed"):
        daemon.arm(request_id="two")
    with pytest.raises(UsageError, match="given to another request"):
        daemon.disarm(request_id="one")


def test_a_request_that_comes_again_while_it_is_carried_out_waits_for_its_answer(
    daemon: Client, run: FakeRun
) -> None:
    run.may_arm.clear()
    found: list[State] = []
    askers = [
        threading.Thread(target=lambda: found.append(daemon.arm(request_id="x").state)) for _ in range(3)
    ]
    for asker in askers:
        asker.start()
    run.may_arm.set()
    for asker in askers:
        asker.join(300)
    assert (found, run.names) == ([State.ARMED] * 3, ["arm"])


def test_who_gave_a_command_is_in_the_log_and_in_the_recording(
    path: Path, daemon: Client, run: FakeRun, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    headers = {"Acquire-By": "operator at 10.0.0.7"}
    with raw_client(path) as raw:
        raw.post("/arm", headers=headers)
        raw.post("/start", json={"path": str(tmp_path / "x.zarr")}, headers=headers)
        assert raw.post("/mark", json={}, headers={"Acquire-By": "x" * 200}).status_code == 422
        daemon.mark("nobody says who")
    assert "arm by operator at 10.0.0.7" in caplog.text
    assert [call for call in run.calls if call[:2] == ("note", "operator")] == [
        ("note", "operator", "start by operator at 10.0.0.7")
    ]


@pytest.mark.parametrize("command", ["capacity", "reload"])
def test_a_measurement_and_a_reload_that_come_again_are_carried_out_once(
    path: Path, daemon: Client, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    times: list[str] = []

    async def reload(self: Local) -> Reloaded:
        times.append("reload")
        return Reloaded(file=f"{len(times)}.toml", changed=[])

    async def measure(self: Local) -> CapacityStatus:
        times.append("capacity")
        return CapacityStatus(line_rate_hz=len(times))

    monkeypatch.setattr(Local, "reload", reload)
    monkeypatch.setattr(Local, "measure", measure)
    with raw_client(path) as raw:
        one, again, other = (
            raw.post(f"/{command}", headers={"Request-Id": name}) for name in ("one", "one", "two")
        )
        assert (one.status_code, one.text) == (again.status_code, again.text)
        assert other.text != one.text
        assert times == [command, command]
        refused = raw.post("/disarm", headers={"Request-Id": "one"})
        assert "given to another request" in refused.text


def test_request_ids_are_bounded(path: Path, daemon: Client) -> None:
    with raw_client(path) as raw:
        for bad in ("x" * 200, "a b"):
            assert raw.post("/disarm", headers={"Request-Id": bad}).status_code == 422


def test_news_are_pushed_and_replayed_after_a_reconnection(
    path: Path, service: Service, run: FakeRun, tmp_path: Path
) -> None:
    """The API goes away in the middle; the client hears everything once, in order."""
    heard: list[News] = []
    with contextlib.closing(Endpoint(path)) as endpoint, Client(path) as client:

        def listen() -> None:
            for one in client.events(history=True):
                heard.append(one)
                if one.text == "last":
                    return

        listener = threading.Thread(target=listen)
        with api(service, endpoint):
            listener.start()
            client.arm()
            client.start(tmp_path / "x.zarr")
            client.mark("first")
            until(lambda: any(one.text == "first" for one in heard))
    service.mark("while nobody was connected")
    service.news.closed = False
    with contextlib.closing(Endpoint(path)) as endpoint, api(service, endpoint), Client(path) as client:
        client.mark("last")
        listener.join(300)
        assert not listener.is_alive()
    texts = [one.text for one in heard if one.kind == "mark"]
    assert texts == ["first", "while nobody was connected", "last"]
    assert len({one.id for one in heard}) == len(heard)


def test_both_clients_hear_the_same(path: Path, daemon: Client, run: FakeRun) -> None:
    daemon.arm()
    daemon.mark("ü")

    async def listen() -> list[str]:
        found = []
        async with AsyncClient(path) as client:
            assert (await client.status()).state is State.ARMED
            async for one in client.events(history=True):
                found.append(one.text)
                if one.kind == "mark":
                    return found
        return found

    assert asyncio.run(listen()) == [one.text for one in daemon.events(history=True, timeout_s=0)]


def test_the_async_client_commands_and_is_refused_as_the_other(path: Path, daemon: Client) -> None:
    async def work() -> None:
        async with AsyncClient(path) as client:
            with pytest.raises(StateError, match="cannot stop while idle"):
                await client.stop()
            assert (await client.arm(request_id="x")).state is State.ARMED
            assert (await client.arm(request_id="x")).state is State.ARMED
            assert (await client.health()).level in ("good", "degraded")
            assert (await client.version()).api == API_VERSION
            assert (await client.setup()).name == "demo"
            assert (await client.rings()).run_id == "fake-run"
            assert (await client.log()).entries == []  # this process writes none
            await client.disarm()

    asyncio.run(work())


def test_clients_offer_the_same() -> None:
    """But for what has no meaning without a thread of one's own to wait in."""
    names = {name for name, _ in inspect.getmembers(Client, inspect.isfunction) if not name.startswith("_")}
    theirs = {
        name for name, _ in inspect.getmembers(AsyncClient, inspect.isfunction) if not name.startswith("_")
    }
    assert names - theirs == {"wait", "open"}
    assert theirs - names == {"call", "follow"}


def test_a_status_comes_with_the_news_and_by_itself(path: Path, daemon: Client) -> None:
    with raw_client(path) as raw, raw.stream("GET", "/events", params={"status_s": 0.05}) as answer:
        reader, kinds = core.EventReader(), []
        lines = answer.iter_lines()
        while len(kinds) < 3:
            kinds += [type(one).__name__ for one in reader.take(next(lines))]
        daemon.arm()
        while "News" not in kinds:
            kinds += [type(one).__name__ for one in reader.take(next(lines))]
    assert kinds[:3] == ["Status"] * 3


def _breaking_off(
    path: Path, ends: list[bytes], late_s: float = 0.0, head: bytes = EVENTS
) -> threading.Thread:
    """A daemon that answers each connection with one of ``ends`` of a stream of events, and hangs up."""
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen()
    listener.settimeout(60)

    def serve() -> None:
        with listener:
            for end in ends:
                with listener.accept()[0] as connection:
                    connection.recv(1 << 16)
                    connection.sendall(head)
                    time.sleep(late_s)
                    connection.sendall(end)

    server = threading.Thread(target=serve)
    server.start()
    return server


@pytest.mark.parametrize("kind", ["blocking", "asynchronous"])
@pytest.mark.parametrize("cut", [20, -30, -1])
def test_half_an_event_is_forgotten_with_its_connection(tmp_path: Path, kind: str, cut: int) -> None:
    """It comes again, whole; read on with the rest of the old one, it would never be understood."""
    news = News(id="a-1", time=datetime.now(UTC), kind="mark", text="drop", state=State.ARMED)
    whole = f"event: news\nid: a-1\ndata: {news.model_dump_json()}\n\n".encode()
    path = tmp_path / "sock"
    server = _breaking_off(path, [whole[:cut], whole])

    async def first() -> News:
        async with AsyncClient(path) as client:
            return await anext(aiter(client.events()))

    assert (asyncio.run(first()) if kind == "asynchronous" else next(Client(path).events())) == news
    server.join(60)


def test_the_history_of_events_arrives_whole_however_late_the_daemon_is(tmp_path: Path) -> None:
    news = News(id="a-1", time=datetime.now(UTC), kind="mark", text="drop", state=State.ARMED)
    whole = f"id: a-1\nevent: news\ndata: {news.model_dump_json()}\n\n: alive\n\n".encode()
    server = _breaking_off(tmp_path / "sock", [whole], late_s=0.5)
    assert list(Client(tmp_path / "sock").events(history=True, timeout_s=0)) == [news]
    server.join(60)


@pytest.mark.parametrize("kind", ["blocking", "asynchronous"])
def test_a_refusal_that_comes_in_parts_is_understood(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "sock"
    body = json.dumps(error_body(StateError("16 clients follow the news already"))).encode()
    head = f"HTTP/1.1 409 Conflict\r\nContent-Length: {len(body)}\r\n\r\n".encode()
    server = _breaking_off(path, [body[10:]], late_s=0.2, head=head + body[:10])

    async def first() -> News:
        async with AsyncClient(path) as client:
            return await anext(aiter(client.events()))

    with pytest.raises(StateError, match="16 clients"):
        asyncio.run(first()) if kind == "asynchronous" else next(Client(path).events())
    server.join(60)


def test_an_event_of_another_version_is_refused_once() -> None:
    reader = core.EventReader()
    lines = ["event: news", "data: {}", ""]
    with pytest.raises(AcquireError, match="another version"):
        [one for line in lines for one in reader.take(line)]
    assert not [one for line in ["event: later", "data: {}", ""] for one in reader.take(line)]


def test_streams_are_bounded_and_end_with_their_clients(
    path: Path, daemon: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "MOST_STREAMS", 2)
    with raw_client(path) as raw, contextlib.ExitStack() as stack:
        streams = [stack.enter_context(raw.stream("GET", "/events", params={"status_s": 0.1})) for _ in "ab"]
        lines = [one.iter_lines() for one in streams]
        assert [next(one) for one in lines] == ["event: status"] * 2
        with raw.stream("GET", "/events") as answer:
            assert answer.status_code == 409
    with raw_client(path) as raw:
        until(lambda: _opens(raw))


def _opens(raw: httpx.Client) -> bool:
    with raw.stream("GET", "/events") as answer:
        return answer.status_code == 200


def test_a_client_of_nobody_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("acquire.client.blocking.PATIENCE_S", 0.1)
    with pytest.raises(NoDaemonError):
        next(Client(tmp_path / "none.sock").events())
    assert "none.sock" in repr(Client(str(tmp_path / "none.sock")))
    for wrong in ("http://", "http://host:x", "http://host/path"):
        with pytest.raises(UsageError, match="is not a valid address"):
            Client(wrong)
    with pytest.raises(NoDaemonError, match="no page answers"):
        Client("http://127.0.0.1:9").status()


def test_metrics_follow_the_conventions(path: Path, daemon: Client) -> None:
    daemon.arm()
    with raw_client(path) as raw:
        answer = raw.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    families = {one.name: one for one in text_string_to_metric_families(answer.text)}
    states = {sample.labels["state"]: sample.value for sample in families["acquire_state"].samples}
    assert states == {str(state): float(state is State.ARMED) for state in State}
    assert families["acquire_lines_lost"].type == "counter"
    assert {sample.labels["arm"] for sample in families["acquire_lines_lost"].samples} == {"a", "b"}
    assert all(name.startswith("acquire_") and one.documentation for name, one in families.items())


def test_healthz_says_503_for_a_fault(path: Path, daemon: Client, run: FakeRun, service: Service) -> None:
    with raw_client(path) as raw:
        assert raw.get("/healthz").json()["level"] in ("idle", "degraded")
        daemon.arm()
        run.see(fault="no light")
        service.supervise()
        answer = raw.get("/healthz")
    assert answer.status_code == 503
    assert "no light" in answer.json()["message"]


def test_a_clock_that_is_set_back_hides_no_slow_lines(
    daemon: Client, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rates are judged some seconds after arming, which was an hour in the future."""
    monkeypatch.setattr("acquire.daemon.health.SETTLED_S", 0.0)

    class Ahead(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> Self:
            return super().now(tz) + timedelta(hours=1)

    with monkeypatch.context() as clock:
        clock.setattr("acquire.daemon.states.datetime", Ahead)
        daemon.arm()
    names = {check.name for check in daemon.health().checks}
    assert {"rate a", "rate b"} <= names


def test_setup_says_what_is_not_the_default(daemon: Client, service: Service) -> None:
    service.origin = "/etc/rig-demo.toml"
    found = daemon.setup()
    assert found.changed["recording.directory"]
    assert found.file.endswith("rig-demo.toml")
    assert "recording.commit_s" not in found.changed
    assert {"numpy", "zarr", "acquire"} <= set(found.versions)


def until(met: object, limit_s: float = 300.0) -> None:
    deadline = time.monotonic() + limit_s
    while not met():  # type: ignore[operator]
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_the_log_has_every_change_of_state_of_a_minute(
    daemon: Client, caplog: pytest.LogCaptureFixture
) -> None:
    """It had the first three recordings, and of the others their number."""
    caplog.set_level(logging.INFO)
    for _ in range(12):
        daemon.arm()
        daemon.disarm()
    bounded = Bounded(lambda _: None)
    written = [entry.getMessage() for entry in caplog.records if bounded.filter(entry)]
    assert sum("→" in one for one in written) == 24, written
