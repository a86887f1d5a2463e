"""Access by host name, origin, token, role and rate; nothing outside the recordings' directory is served."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Route

from acquire.config import builtin_directory, load_rig
from acquire.config.web import WebConfig
from acquire.daemon.control import new_app
from acquire.errors import ConfigError, PlaceError, UsageError
from acquire.web import app as app_module
from acquire.web import guard as guard_module
from acquire.web import tokens as tokens_module
from acquire.web.archive import Archive
from acquire.web.guard import Buckets, Guard
from acquire.web.server import address_of, link, names_of
from acquire.web.tokens import COOKIE, TokenFile, Tokens, load_tokens

TOKENS = Tokens("o" * 32, "v" * 32)
OPERATOR = {"Authorization": f"Bearer {TOKENS.operator}"}
VIEWER = {"Authorization": f"Bearer {TOKENS.viewer}"}


async def _answer(_: object) -> PlainTextResponse:
    return PlainTextResponse("in")


def ask(method: str, path: str, *requests: dict[str, str]) -> list[httpx.Response]:
    """One request after the other, with these headers."""
    route = Route("/{rest:path}", _answer, methods=["GET", "POST"])
    app = Guard(Starlette(routes=[route]), TOKENS, frozenset({"127.0.0.1"}))

    async def work() -> list[httpx.Response]:
        transport = httpx.ASGITransport(app)  # type: ignore[arg-type]
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:8300") as client:
            return [await client.request(method, path, headers=headers) for headers in requests]

    return asyncio.run(work())


@pytest.mark.parametrize(
    ("method", "path", "headers", "code"),
    [
        ("GET", "/", {}, 200),
        ("GET", "/static/app.js", {}, 200),
        ("GET", "/api/status", {}, 401),
        ("GET", "/api/status", {"Authorization": "Bearer x"}, 401),
        ("GET", "/api/status", {"Authorization": f"Basic {TOKENS.operator}"}, 401),
        ("GET", "/api/status", VIEWER, 200),
        ("GET", "/api/status", {"Cookie": f"{COOKIE}={TOKENS.cookie('viewer')}"}, 200),
        ("GET", "/api/status", {"Cookie": f"{COOKIE}={TOKENS.viewer}"}, 401),
        ("POST", "/api/arm", VIEWER, 403),
        ("POST", "/api/arm", {"Cookie": f"{COOKIE}={TOKENS.cookie('viewer')}"}, 403),
        ("POST", "/api/arm", OPERATOR, 200),
        ("POST", "/api/arm", {**OPERATOR, "Origin": "http://127.0.0.1:8300"}, 200),
        ("POST", "/api/arm", {**OPERATOR, "Origin": "http://evil.example"}, 403),
        ("POST", "/api/arm", {**OPERATOR, "Origin": "null"}, 403),
        ("POST", "/api/arm", {**OPERATOR, "Sec-Fetch-Site": "cross-site"}, 403),
        ("POST", "/api/arm", {**OPERATOR, "Sec-Fetch-Site": "same-site"}, 403),
        ("POST", "/api/session", {"Origin": "http://evil.example"}, 403),
        ("GET", "/api/status", {**OPERATOR, "Host": "evil.example"}, 421),
        ("GET", "/", {"Host": "evil.example:8300"}, 421),
        ("GET", "/api/healthz", {}, 200),
        ("GET", "/api/metrics", VIEWER, 200),  # as Prometheus does
    ],
)
def test_who_may_do_what(method: str, path: str, headers: dict[str, str], code: int) -> None:
    (answer,) = ask(method, path, headers)
    assert answer.status_code == code
    assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
    if code != 200:
        assert answer.json()["message"]
        assert TOKENS.operator not in answer.text


def test_guessing_is_slow_and_locks_nobody_out(caplog: pytest.LogCaptureFixture) -> None:
    """Five wrong tokens of any user of the host kept the operator out, for as long as others followed."""
    guesses = [{"Authorization": f"Bearer guess-{k}"} for k in range(8)]
    codes = [one.status_code for one in ask("GET", "/api/status", *guesses, OPERATOR, guesses[0])]
    assert codes == [401] * 5 + [429] * 3 + [200, 429]
    assert caplog.text.count("a wrong token from") == 5
    assert "guess" not in caplog.text
    assert "a wrong token from" in caplog.text


def test_requests_of_one_address_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard_module, "REQUESTS", (3.0, 0.0))
    monkeypatch.setattr(guard_module, "ADMITTED", (4.0, 0.0))
    codes = [one.status_code for one in ask("GET", "/", *[{}] * 5, *[OPERATOR] * 5)]
    assert codes == [200, 200, 200, 429, 429, 200, 200, 200, 200, 429]  # a stranger's flood keeps nobody out


def test_a_full_queue_of_readers_asks_to_come_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was answered as if the request were wrong (422)."""
    monkeypatch.setattr(app_module, "MOST_READING", 2)

    reading, page = app_module.DiskReads(), new_app("a list that waits for the disk")

    @page.get("/list")
    async def _() -> list[str]:
        return await reading(lambda: [path.name for path in tmp_path.iterdir()])

    async def crowd() -> list[httpx.Response]:
        transport = httpx.ASGITransport(page)
        async with httpx.AsyncClient(transport=transport, base_url="http://page") as client:
            return [
                *await asyncio.gather(*[client.get("/list") for _ in range(5)]),
                await client.get("/list"),
            ]

    with contextlib.closing(reading):
        *found, later = asyncio.run(crowd())
    assert sorted(one.status_code for one in found) == [200, 200, 503, 503, 503]
    refused = next(one for one in found if one.status_code == 503)
    assert refused.headers["retry-after"] == "1"
    assert (refused.json()["error"], refused.json()["exit_code"]) == ("BusyError", 4)
    assert later.status_code == 200


def test_buckets_fill_again_and_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    buckets = Buckets(2, 1.0, lambda: now)
    assert [buckets.take("a") for _ in range(3)] == [True, True, False]
    now = 1.0
    assert [buckets.take("a") for _ in range(2)] == [True, False]
    monkeypatch.setattr(guard_module, "MOST_ADDRESSES", 10)
    for k in range(100):
        buckets.take(str(k))
    assert len(buckets._buckets) == 10


def test_tokens_that_were_changed_are_those_of_a_running_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The old ones stayed valid, and `acquire web --link` printed new ones that the page refused."""
    monkeypatch.setattr(tokens_module, "LOOK_EVERY_S", 0.0)
    path = tmp_path / "tokens"
    page = TokenFile(path)
    before = page.current
    assert page.role_of_token(before.viewer) == "viewer"
    path.unlink()
    made = load_tokens(path)  # as `acquire web --link` does
    assert page.role_of_token(made.operator) == "operator"
    assert page.role_of_cookie(made.cookie("viewer")) == "viewer"
    assert page.cookie("viewer") == made.cookie("viewer")
    assert page.role_of_token(before.operator) is page.role_of_cookie(before.cookie("operator")) is None
    path.unlink()
    assert page.role_of_token(made.operator) is None
    now = load_tokens(path)
    assert page.current == now  # the page has made the file
    path.unlink()
    path.write_text("{}")
    path.chmod(0o600)
    assert page.current == now
    assert "is not valid" in caplog.text
    caplog.clear()
    assert page.current == now
    assert not caplog.text  # said once


def test_tokens_are_made_once_for_their_owner_alone(tmp_path: Path) -> None:
    path = tmp_path / "tokens"
    made = load_tokens(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert load_tokens(path).operator == made.operator
    assert made.operator not in repr(made)
    assert made.role_of_token(made.viewer) == "viewer"
    assert made.role_of_token("") is None
    assert made.role_of_cookie(made.cookie("operator")) == "operator"


FULL = """
import resource, sys
from pathlib import Path
from acquire.web.tokens import load_tokens
resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
load_tokens(Path(sys.argv[1]))
"""


def test_a_full_disk_leaves_no_token_file(tmp_path: Path) -> None:
    """An empty one was refused ever after, also once there was room."""
    path = tmp_path / "tokens"
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(path)], capture_output=True, check=False, text=True, timeout=300
    )
    assert "UsageError: the token file" in done.stderr
    assert not list(tmp_path.iterdir())
    load_tokens(path)


def test_whoever_asks_first_at_the_same_time_gets_the_same_tokens(tmp_path: Path) -> None:
    for number in range(20):
        with ThreadPoolExecutor(4) as threads:
            found = list(threads.map(load_tokens, [tmp_path / f"tokens-{number}"] * 4))
        assert len({tokens.operator for tokens in found}) == 1
    assert len(list(tmp_path.iterdir())) == 20


@pytest.mark.parametrize("content", ["", "{}", "[]", json.dumps({"operator": "x", "viewer": "y"}), "\0"])
def test_an_invalid_token_file_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "tokens"
    path.write_text(content)
    path.chmod(0o600)
    with pytest.raises(UsageError, match="is not valid"):
        load_tokens(path)


def test_tokens_that_others_can_read_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "tokens"
    load_tokens(path)
    path.chmod(0o640)
    with pytest.raises(UsageError, match="can be read by others"):
        load_tokens(path)
    path.unlink()
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UsageError, match="tokens"):
        load_tokens(path)
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"host": "0.0.0.0"}, "can be reached from other hosts"),
        ({"host": ""}, r"web\.host = '': it must be an address: 127\.0\.0\.1, or 0\.0\.0\.0 for every"),
        ({"host": "a b"}, "web.host = 'a b': it must be an address"),
        ({"certificate": "c.pem"}, "must be given together"),
        ({"port": 99999}, "less than or equal to 65535"),
    ],
)
def test_the_page_is_closed_to_other_hosts_by_default(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_rig("rig-demo", {f"web.{key}": value for key, value in settings.items()})


def test_an_address_that_is_not_this_host_s_is_refused_as_such(tmp_path: Path) -> None:
    """Another port was advised, which helps only if that is the trouble."""
    rig = tmp_path / "rig.toml"
    rig.write_text((builtin_directory() / "rig-demo.toml").read_text() + "\n[web]\nplain = true\n")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        for host, advice in (
            ("no.such.host.invalid", "choose an address of this host as web.host (--host)"),
            ("192.0.2.1", "choose an address of this host as web.host (--host)"),
            ("127.0.0.1", "choose another web.port (--port)"),
        ):
            words = ["web", f"--config={rig}", f"--host={host}", f"--port={port}", f"--socket={tmp_path}/s"]
            done = subprocess.run(
                [sys.executable, "-m", "acquire", *words],
                capture_output=True,
                text=True,
                timeout=60,
                check=False,
            )
            assert done.returncode == 2, done.stderr
            assert f"the page cannot listen on {host}:{port}: " in done.stderr
            assert f"try: {advice}" in done.stderr
            assert "Traceback" not in done.stderr


def test_names_and_addresses(tmp_path: Path) -> None:
    plain = WebConfig(port=1)
    assert names_of(plain) == {"127.0.0.1", "localhost", "::1"}
    named = WebConfig(host="10.0.0.2", names=("Lab",), plain=True)
    assert names_of(named) == {"10.0.0.2", "lab"}
    assert address_of(WebConfig(host="::1", port=2)) == "http://[::1]:2/"
    told = link(plain, tmp_path / "c.sock", "viewer")
    assert told.startswith("http://127.0.0.1:1/#token=")
    assert (
        load_tokens(plain.token_path(tmp_path / "c.sock")).role_of_token(told.partition("=")[2]) == "viewer"
    )


@pytest.mark.parametrize(
    "name",
    [
        "../outside.zarr",
        "..",
        ".",
        "",
        "a/b.zarr",
        "/etc/passwd",
        "link.zarr",
        "file.zarr",
        "\0.zarr",
        "x.zarr\0",
    ],
)
def test_nothing_outside_the_directory_is_served(tmp_path: Path, name: str) -> None:
    inside = tmp_path / "inside"
    (tmp_path / "outside.zarr").mkdir()
    inside.mkdir()
    (inside / "link.zarr").symlink_to(tmp_path / "outside.zarr")
    (inside / "file.zarr").write_text("x")
    (inside / "cut.npz").symlink_to("/etc/passwd")
    archive = Archive(inside)
    for suffix in (".zarr", ".npz"):
        with pytest.raises(PlaceError, match="among the recordings"):
            archive.path_of(name, suffix)
    with pytest.raises(PlaceError, match="among the recordings"):
        archive.path_of("cut.npz", ".npz")
    assert archive.recordings() == []
    (tmp_path / "outside.zarr").rename(inside / "odd.zarr")
    assert [one.error is None for one in archive.recordings()] == [False]
