"""A client sends nothing to anybody but its own user's daemon."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from acquire.client import Client
from acquire.daemon import endpoint, peer
from acquire.daemon.endpoint import Endpoint, lock_path
from acquire.errors import NoDaemonError, UsageError
from acquire.place import default_socket


@pytest.fixture
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("s") / "c.sock"


@pytest.fixture
def impostor(path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen(4)
        listener.settimeout(300)
        yield listener


def test_another_user_s_listener_gets_nothing(
    path: Path, impostor: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peer.os, "geteuid", lambda: 4321)
    monkeypatch.setattr(peer, "_check_owner", lambda _: None)  # the last line of defence
    with pytest.raises(NoDaemonError, match=rf"process {os.getpid()} of user {os.getuid()}") as caught:
        Client(path).mark("secret")
    assert "--socket" in caught.value.hint
    assert "XDG_RUNTIME_DIR" in caught.value.hint
    connection, _ = impostor.accept()
    with connection:
        assert connection.recv(100) == b""


@pytest.mark.parametrize("where", ["directory", "socket"])
def test_what_belongs_to_another_user_is_not_even_connected_to(
    path: Path, impostor: socket.socket, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    other = path.parent if where == "directory" else path
    stat = Path.stat

    def stat_of(self: Path, **options: bool) -> os.stat_result:
        found = stat(self, **options)
        return os.stat_result((*found[:4], 4321, *found[5:])) if self == other else found

    monkeypatch.setattr(Path, "stat", stat_of)
    with pytest.raises(NoDaemonError, match="belongs to user 4321"):
        Client(path).status()
    impostor.settimeout(0)
    with pytest.raises(BlockingIOError):
        impostor.accept()


def test_a_directory_that_all_may_write_to_is_no_place(path: Path, impostor: socket.socket) -> None:
    path.parent.chmod(0o777)
    with pytest.raises(NoDaemonError, match="others can write to"):
        Client(path).status()


@pytest.fixture
def home(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The directory of the default socket, in a place of the test's own."""
    home = tmp_path_factory.mktemp("s") / "acquire-1"
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(endpoint, "default_socket", lambda: home / "acquire.sock")
    return home


def test_default_directory_is_the_user_s_own(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Endpoint(home / "acquire.sock").close()
    assert home.stat().st_mode & 0o777 == 0o700
    home.chmod(0o750)
    with pytest.raises(UsageError, match="open to others") as caught:
        Endpoint(home / "acquire.sock")
    assert "XDG_RUNTIME_DIR" in str(caught.value)
    home.chmod(0o700)
    monkeypatch.setattr(endpoint.os, "geteuid", lambda: 4321)
    with pytest.raises(UsageError, match=f"belongs to user {os.getuid()}"):
        Endpoint(home / "acquire.sock")


@pytest.mark.parametrize("kind", ["link", "file"])
def test_default_directory_is_no_link(home: Path, tmp_path: Path, kind: str) -> None:
    home.symlink_to(tmp_path) if kind == "link" else home.touch()
    with pytest.raises(UsageError, match="not a directory"):
        Endpoint(home / "acquire.sock")
    assert list(tmp_path.iterdir()) == []


def test_default_socket(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    assert default_socket() == Path("/run/user/7/acquire.sock")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert default_socket() == Path(f"/tmp/acquire-{os.geteuid()}/acquire.sock")


@pytest.mark.parametrize("kind", ["fifo", "huge", "link", "directory"])
def test_a_lock_that_is_none_of_ours_is_refused_in_words(path: Path, tmp_path: Path, kind: str) -> None:
    lock = lock_path(path)
    match kind:
        case "fifo":
            os.mkfifo(lock)
        case "huge":
            lock.write_bytes(b"precious " * 1000)
        case "link":
            lock.symlink_to(tmp_path / "elsewhere")
        case "directory":
            lock.mkdir()
    with pytest.raises(UsageError, match="lock"):
        Endpoint(path)
    assert not (tmp_path / "elsewhere").exists()
    assert kind != "huge" or lock.stat().st_size == 9000


def test_a_lock_with_strange_bytes_is_held_or_free_all_the_same(path: Path) -> None:
    lock_path(path).write_bytes(b"\xff\xfe\x1b[2J")
    first = Endpoint(path)
    lock_path(path).write_bytes(b"\xff\xfe\x1b[2J")
    with pytest.raises(Exception, match="process unknown"):
        Endpoint(path)
    first.close()
