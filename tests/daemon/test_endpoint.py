"""The control socket: private, the only one, and free again however its daemon ended."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from acquire.daemon.endpoint import LONGEST_PATH, Endpoint, lock_path
from acquire.errors import StateError, UsageError


@pytest.fixture
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("s") / "c.sock"


def test_only_its_user_may_connect(path: Path) -> None:
    before = os.umask(0)
    try:
        endpoint = Endpoint(path)
        assert os.umask(0) == 0
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(lock_path(path).stat().st_mode) == 0o600
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(path))
    endpoint.close()
    endpoint.close()
    assert not path.exists()


def test_second_is_refused_and_the_first_lives_on(path: Path) -> None:
    first = Endpoint(path)
    inode = path.stat().st_ino
    with pytest.raises(StateError, match=f"process {os.getpid()}"):
        Endpoint(path)
    assert path.stat().st_ino == inode
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(path))
    first.close()
    Endpoint(path).close()


def test_a_daemon_whose_socket_was_removed_is_named(path: Path) -> None:
    """`acquire status` said to start one, and `acquire serve` to ask for the status."""
    with contextlib.closing(Endpoint(path)):
        path.unlink()
        with pytest.raises(StateError, match=f"which was removed; try: kill {os.getpid()},"):
            Endpoint(path)


def test_names_that_were_removed_are_made_again(path: Path) -> None:
    with contextlib.closing(Endpoint(path)) as endpoint:
        assert endpoint.renewed() is None
        for names in ([path], [lock_path(path)], [path, lock_path(path)]):
            before = endpoint.socket
            for name in names:
                name.unlink()
            if endpoint.renewed() is not None:
                before.close()
            with socket.socket(socket.AF_UNIX) as client:
                client.connect(str(path))
            with pytest.raises(StateError, match=f"process {os.getpid()}"):
                Endpoint(path)
        assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_what_took_the_place_of_the_socket_stays(path: Path) -> None:
    with contextlib.closing(Endpoint(path)) as endpoint:
        path.unlink()
        path.write_text("precious")
        with pytest.raises(UsageError, match="something else is there now, and is left untouched"):
            endpoint.renewed()
    assert path.read_text() == "precious"


def test_left_behind_by_a_killed_process(path: Path) -> None:
    code = (
        "import os, signal, sys, pathlib; from acquire.daemon.endpoint import Endpoint;"
        "e = Endpoint(pathlib.Path(sys.argv[1])); os.kill(os.getpid(), signal.SIGKILL)"
    )
    ended = subprocess.run([sys.executable, "-c", code, str(path)], check=False, timeout=300)
    assert ended.returncode == -9
    assert path.exists()
    endpoint = Endpoint(path)
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(path))
    endpoint.close()


def test_what_is_not_a_socket_stays(path: Path) -> None:
    path.write_text("precious")
    with pytest.raises(UsageError, match="untouched"):
        Endpoint(path)
    assert path.read_text() == "precious"
    path.unlink()
    Endpoint(path).close()


@pytest.mark.parametrize("path", [Path("/nowhere/c.sock"), Path("/tmp") / ("x" * LONGEST_PATH)])
def test_impossible_paths(path: Path) -> None:
    with pytest.raises(UsageError, match="control socket"):
        Endpoint(path)


def test_failing_to_listen_frees_the_lock(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(socket.socket, "listen", full)
        with pytest.raises(UsageError, match="No space"):
            Endpoint(path)
    Endpoint(path).close()
