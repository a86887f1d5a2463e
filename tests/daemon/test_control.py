"""API and client over a real socket: what the service refuses arrives as the same error."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from fake_run import FakeRun, rig_config

from acquire import errors
from acquire.client import AsyncClient, Client, core
from acquire.daemon import connections
from acquire.daemon import server as server_module
from acquire.daemon.endpoint import Endpoint
from acquire.daemon.messages import ErrorMessage, http_status
from acquire.daemon.service import Service
from acquire.daemon.states import State
from acquire.daemon.stream import MOST_STREAMS
from acquire.errors import (
    AcquireError,
    BusyError,
    CameraError,
    DeviceError,
    NoDaemonError,
    StateError,
    UsageError,
)


def test_commands(daemon: Client, run: FakeRun, tmp_path: Path) -> None:
    assert daemon.arm().state is State.ARMED
    status = daemon.start(tmp_path / "x.zarr", lines=7)
    assert (status.state, status.possible) == (State.RECORDING, ["mark", "stop"])
    assert run.calls[-1] == ("start", tmp_path / "x.zarr", 7)
    assert daemon.stop().state is State.ARMED
    assert daemon.disarm().state is State.IDLE


def test_relative_paths_are_the_callers(
    daemon: Client, run: FakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    daemon.arm()
    daemon.start(Path("x.zarr"))
    daemon.stop()
    assert ("start", tmp_path / "x.zarr", None) in run.calls


def test_refused_by_state(daemon: Client, run: FakeRun) -> None:
    with pytest.raises(StateError) as caught:
        daemon.start()
    assert caught.value.possible == "arm"
    assert run.calls == []


def test_device_error_keeps_its_class_and_words(daemon: Client, run: FakeRun) -> None:
    run.refuse["arm"] = CameraError("camera a is not there", possible="SIM-A", hint="plug it in")
    with pytest.raises(CameraError) as caught:
        daemon.arm()
    assert str(caught.value) == "camera a is not there; possible: SIM-A; try: plug it in"


def test_impossible_start_is_refused_before_it_is_sent(daemon: Client) -> None:
    with pytest.raises(UsageError, match="lines"):
        daemon.start(lines=0)
    with pytest.raises(UsageError, match="lines and duration_s exclude each other"):
        daemon.start(lines=1, duration_s=1.0)
    with pytest.raises(UsageError, match="pre_s must be less than duration_s"):
        daemon.start(duration_s=1.0, pre_s=1.0)
    with pytest.raises(UsageError, match="there is no option 'duration'; did you mean 'duration_s'"):
        daemon.start(duration=1.0)  # type: ignore[call-arg]


def test_malformed_request_names_the_key(path: Path, daemon: Client) -> None:
    with httpx.Client(transport=httpx.HTTPTransport(uds=str(path)), base_url="http://x", timeout=60) as raw:
        answer = raw.post("/start", json={"line": 5})
        assert answer.status_code == 422
        message = ErrorMessage.model_validate_json(answer.content)
        assert message.error == "UsageError"
        assert message.message.startswith("line = 5")
        both = ErrorMessage.model_validate_json(
            raw.post("/start", json={"lines": 1, "duration_s": 1}).content
        )
        assert both.message.endswith(": lines and duration_s exclude each other: give one")
        described = raw.get("/openapi.json").json()
    assert {"/status", "/arm", "/start", "/mark", "/stop", "/disarm"} < set(described["paths"])
    assert "Status" in described["components"]["schemas"]


@pytest.mark.parametrize(
    ("method", "url", "code"), [("GET", "/nothing", 404), ("GET", "/arm", 405), ("POST", "/start", 400)]
)
def test_requests_that_no_route_takes_are_answered_alike(
    path: Path, daemon: Client, method: str, url: str, code: int
) -> None:
    with httpx.Client(transport=httpx.HTTPTransport(uds=str(path)), base_url="http://x", timeout=60) as raw:
        answer = raw.request(method, url, content=b"\xff", headers={"content-type": "application/json"})
    assert answer.status_code == code
    message = ErrorMessage.model_validate_json(answer.content)
    assert message.error == "UsageError"
    assert message.message.startswith(f"the daemon cannot answer {method} {url}: ")


@pytest.mark.parametrize("url", ["/status", "/health", "/metrics", "/openapi.json", "/events?status_s=0.05"])
def test_head_is_answered_as_get_without_the_body(path: Path, daemon: Client, url: str) -> None:
    """It was refused with 405. A stream has no end of its own, but the answer to HEAD has."""
    with httpx.Client(transport=httpx.HTTPTransport(uds=str(path)), base_url="http://x", timeout=30) as raw:
        head = raw.head(url)
        with raw.stream("GET", url) as get:
            assert (head.status_code, head.content) == (get.status_code, b"")
            assert head.headers["content-type"] == get.headers["content-type"]
        assert raw.head(url).status_code == 200  # on the same connection
        assert raw.head("/arm").status_code == 405
        assert raw.head("/nothing").status_code == 404


def test_heads_of_streams_leave_no_stream_behind(path: Path, daemon: Client) -> None:
    with httpx.Client(transport=httpx.HTTPTransport(uds=str(path)), base_url="http://x", timeout=30) as raw:
        for _ in range(2 * MOST_STREAMS):
            assert raw.head("/events").status_code == 200


def test_long_requests_are_not_read(path: Path, daemon: Client, run: FakeRun) -> None:
    def body() -> Iterator[bytes]:  # of a length that no header tells
        for _ in range(70):
            yield b" " * 1000

    daemon.arm()
    with httpx.Client(transport=httpx.HTTPTransport(uds=str(path)), base_url="http://x", timeout=60) as raw:
        for content in (b" " * 70_000, body()):
            answer = raw.post("/start", content=content, headers={"content-type": "application/json"})
            assert answer.status_code == 413
            assert "more than 65536 bytes" in ErrorMessage.model_validate_json(answer.content).message
    assert run.names == ["arm"]


@pytest.mark.parametrize("name", ["nul\0.zarr", "not-utf8-\udcff.zarr"])
def test_paths_that_cannot_be_are_refused_before_they_are_sent(
    daemon: Client, tmp_path: Path, name: str
) -> None:
    with pytest.raises(UsageError, match="is not UTF-8, or has a NUL") as caught:
        daemon.start(tmp_path / name)
    assert str(caught.value).encode()  # can be printed


@pytest.mark.parametrize("name", ["x" * 300 + ".zarr", "µ" * 150 + ".zarr"])
def test_names_that_no_file_system_takes_are_refused(
    daemon: Client, run: FakeRun, tmp_path: Path, name: str
) -> None:
    daemon.arm()
    with pytest.raises(UsageError, match="at most 200 bytes"):
        daemon.start(tmp_path / name)
    assert run.names == ["arm"]


def test_status_is_answered_while_arming(daemon: Client, run: FakeRun) -> None:
    run.may_arm.clear()
    arming = threading.Thread(target=daemon.arm)
    arming.start()
    deadline = time.monotonic() + 300
    while (status := daemon.status()).busy != "arm":
        assert time.monotonic() < deadline
    assert status.state is State.IDLE
    run.may_arm.set()
    arming.join(300)
    assert daemon.status().state is State.ARMED


def test_wait(daemon: Client, run: FakeRun) -> None:
    assert daemon.wait({State.IDLE}, 0.0).state is State.IDLE
    with pytest.raises(StateError, match=r"still idle after 0\.2 s of waiting for recording"):
        daemon.wait({State.RECORDING}, 0.2)


def test_a_defect_in_the_daemon_is_reported_and_logged(
    daemon: Client, run: FakeRun, caplog: pytest.LogCaptureFixture
) -> None:
    run.refuse["arm"] = ZeroDivisionError("oops")  # type: ignore[assignment]
    with pytest.raises(AcquireError, match=r"defect in the daemon.*oops"):
        daemon.arm()
    deadline = time.monotonic() + 300
    while "ZeroDivisionError" not in caplog.text:  # the server logs after it has answered
        assert time.monotonic() < deadline
    assert daemon.status().busy is None


def test_nobody_there(tmp_path: Path) -> None:
    with Client(tmp_path / "none.sock") as client, pytest.raises(NoDaemonError, match=r"none\.sock"):
        client.status()


def test_socket_left_behind(path: Path) -> None:
    dead = path.with_name("dead.sock")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(dead))
    with Client(dead) as client, pytest.raises(NoDaemonError, match="refused"):
        client.status()


def test_daemon_that_does_not_answer(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(core, "STATUS_TIMEOUT_S", 0.2)
    deaf = path.with_name("deaf.sock")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(deaf))
        listener.listen(1)
        with (
            Client(deaf) as client,
            pytest.raises(NoDaemonError, match=r"did not answer status within 0\.2 s"),
        ):
            client.status()


@contextlib.contextmanager
def answering(path: Path, answer: bytes) -> Iterator[Path]:
    """A socket beside ``path`` whose server gives one connection this answer, whatever is asked."""
    odd = path.with_name("odd.sock")
    odd.unlink(missing_ok=True)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(odd))
        listener.listen(1)

        def reply() -> None:
            with listener.accept()[0] as connection:
                connection.recv(4096)
                connection.sendall(answer)

        thread = threading.Thread(target=reply)
        thread.start()
        yield odd
        thread.join(300)


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (b"", "closed the connection"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\n", "closed the connection"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 200\r\n\r\n{}", "closed the connection"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\n{}", "another version"),
    ],
)
@pytest.mark.parametrize(
    "ask",
    [lambda socket: Client(socket).status(), lambda socket: asyncio.run(AsyncClient(socket).status())],
    ids=["blocking", "async"],
)
def test_daemon_that_answers_strangely(
    path: Path, answer: bytes, told: str, ask: Callable[[Path], object]
) -> None:
    with answering(path, answer) as odd, pytest.raises(AcquireError, match=told):
        ask(odd)


@pytest.mark.parametrize(
    "ask",
    [
        lambda socket: next(Client(socket).events()),
        lambda socket: asyncio.run(anext(aiter(AsyncClient(socket).events()))),
    ],
    ids=["blocking", "async"],
)
def test_news_that_are_no_text(path: Path, ask: Callable[[Path], object]) -> None:
    text = b"HTTP/1.1 200 OK\r\n\r\nevent: news\ndata: {\xff}\n\n"
    with answering(path, text) as odd, pytest.raises(AcquireError, match="another version"):
        ask(odd)


TREE = [
    kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, errors.AcquireError)
]


@pytest.mark.parametrize("kind", TREE)
def test_every_error_survives_the_wire(kind: type[AcquireError]) -> None:
    error = kind("what", possible="this", hint="that")
    again = ErrorMessage.model_validate_json(ErrorMessage.of(error).model_dump_json()).rebuild()
    assert type(again) is kind
    assert (again.message, again.possible, again.hint) == ("what", "this", "that")
    # 500 is a defect of the server's, which a damaged recording is not.
    assert (http_status(error) == 500) == (kind in (AcquireError, errors.NumericsError))
    assert http_status(error) in (409, 422, 424, 500, 503)


def test_unknown_error_of_another_version() -> None:
    message = ErrorMessage(error="FutureError", message="m", exit_code=9)
    assert type(message.rebuild()) is AcquireError
    assert http_status(DeviceError("x")) == 503


def raw_client(path: Path) -> httpx.Client:
    return httpx.Client(transport=httpx.HTTPTransport(uds=str(path)), base_url="http://x", timeout=60)


LONG = "x" * 60_000


@pytest.mark.parametrize(
    "body",
    [
        {"lines": True},
        {"lines": "5"},
        {"lines": 5.0},
        {"duration_s": True},
        {"pre_s": float("1e400")},
        {"path": LONG},
        {"path": [LONG]},
        {LONG: 1},
        {f"key {i}": LONG[:500] for i in range(100)},
    ],
)
def test_a_refusal_does_not_echo_what_was_sent(path: Path, daemon: Client, body: dict[str, object]) -> None:
    with raw_client(path) as raw:
        content = json.dumps(body).encode()
        answer = raw.post("/start", content=content, headers={"content-type": "application/json"})
    assert answer.status_code in (400, 422)
    assert len(answer.content) < 4000
    ErrorMessage.model_validate_json(answer.content)


@pytest.mark.parametrize("content", [b"[" * 60_000, b"9" * 20_000, b'{"lines": ' + b"9" * 10_000 + b"}"])
def test_json_that_no_parser_takes_is_refused_in_words(path: Path, daemon: Client, content: bytes) -> None:
    with raw_client(path) as raw:
        answer = raw.post("/start", content=content, headers={"content-type": "application/json"})
    assert answer.status_code in (400, 422)
    assert len(answer.content) < 1000
    ErrorMessage.model_validate_json(answer.content)


def test_marks_are_bounded_and_text(daemon: Client, run: FakeRun) -> None:
    daemon.arm()
    with pytest.raises(UsageError, match=r"mark: text = 'xxx.*xxx': must have at most 400 char"):
        daemon.mark("x" * 401)
    with pytest.raises(UsageError, match=r"mark: text .*unicode"):
        daemon.mark("caf\udce9")
    daemon.mark("a\nb")
    assert run.calls[-1] == ("note", "mark", "a\nb")


def test_every_answer_is_documented(path: Path, daemon: Client) -> None:
    with raw_client(path) as raw:
        paths = raw.get("/openapi.json").json()["paths"]
    for operations in paths.values():
        for operation in operations.values():
            assert {"400", "404", "405", "409", "413", "422", "424", "500", "503"} <= set(
                operation["responses"]
            )
            assert all(one["description"] for one in operation["responses"].values())


ODD = (None, 0, -1, 2**70, 1e308, "", "../..", "\0", "L2000", "0.5s", "x" * 500, [], {}, [1], True)


def test_whatever_is_asked_the_answer_is_one_of_those_described(path: Path, daemon: Client) -> None:
    """Odd values in every field and parameter of every request, in the states to which these lead."""
    chance = random.Random(0)
    with raw_client(path) as raw:
        described = raw.get("/openapi.json").json()
        requests = [
            (method, url, operation)
            for url, operations in described["paths"].items()
            for method, operation in operations.items()
            if url not in ("/events", "/capacity")  # a stream, and a measurement
        ]
        for method, url, operation in [one for one in requests for _ in range(12)]:
            body = None
            if "requestBody" in operation:
                named = json.dumps(operation["requestBody"]).partition("/schemas/")[2].partition('"')[0]
                fields = described["components"]["schemas"][named]["properties"]
                body = {field: chance.choice(ODD) for field in fields if chance.random() < 0.5}
            asked = {one["name"]: str(chance.choice(ODD)) for one in operation.get("parameters", [])}
            answer = raw.request(method, url, params=asked, json=body)
            assert str(answer.status_code) in {*operation["responses"]} - {"500"}, (method, url, asked, body)


@pytest.fixture
def _no_log() -> Iterator[None]:
    """What cannot be encoded reaches no report of the tests."""
    logging.disable()
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.usefixtures("_no_log")
def test_whatever_is_in_the_status_it_is_answered(daemon: Client, path: Path, run: FakeRun) -> None:
    """File names that are not UTF-8, and a device's own words, reach JSON as text."""
    odd = "caf\udce9 \x1b[2J\u202e"
    daemon.arm()
    run.see(fault=odd, path=f"/{odd}.zarr", end_reason=odd)
    with raw_client(path) as raw:
        answer = raw.post("/start", json={"path": "/d/x.zarr"})
        assert answer.status_code == 503
        assert r"caf\udce9 \x1b[2J\u202e" in answer.json()["message"]
        answer = raw.get("/status")
    assert answer.status_code == 200
    assert r"caf\udce9 \x1b[2J\u202e" in answer.json()["fault"]
    assert answer.json()["last"]["path"] == r"/caf\udce9 \x1b[2J\u202e.zarr"


def test_half_a_request_is_ended_and_a_slow_one_too(
    path: Path, daemon: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "REQUEST_S", 0.2)
    for sent in (b"", b"GET /sta", b"POST /mark HTTP/1.1\r\nHost: x\r\nContent-Length: 9\r\n\r\n{"):
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(300)
            connection.connect(str(path))
            connection.sendall(sent)
            assert connection.recv(100) == b""
    assert daemon.status().state is State.IDLE


def test_commands_that_wait_are_bounded(path: Path, run: FakeRun, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "MOST_WAITING", 2)
    run.may_arm.clear()

    async def crowd() -> list[object]:
        with contextlib.closing(Endpoint(path)) as endpoint:
            daemon = server_module.Daemon(Service(rig_config(path.parent), lambda _: run), endpoint)
            arming = [asyncio.create_task(daemon._command(daemon._service.arm)) for _ in range(5)]
            _, waiting = await asyncio.wait(arming, return_when=asyncio.FIRST_COMPLETED)
            run.may_arm.set()
            await asyncio.wait(waiting)
            daemon._devices.shutdown()
            return [one.exception() for one in arming]

    refused = [error for error in asyncio.run(crowd()) if "commands are waiting already" in str(error)]
    assert [http_status(error) for error in refused if isinstance(error, BusyError)] == [503, 503]
