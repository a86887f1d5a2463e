"""Lock files that several users share: no moment refuses one of them, and nobody's lock is removed."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from acquire.daemon.endpoint import Endpoint, lock_path
from acquire.errors import UsageError
from acquire.processes.lockfile import LockFile

OTHERS = (65534, 65533)
"""Users that are not this one."""
CONTEND = """
import os, sys
from pathlib import Path
from acquire.processes.lockfile import LockFile
os.seteuid(int(sys.argv[2]))
os.umask(0o077)
print("ready", flush=True)
sys.stdin.readline()
for k in range(300):
    lock = LockFile(Path(sys.argv[1], f"{k}.lock"), 0o666)
    try:
        lock.take()
    except BlockingIOError:
        pass
    lock.close()
"""
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can be several users")


@pytest.fixture
def shared() -> Iterator[Path]:
    """A directory like /run/lock: everybody may write, and nobody may remove what is another's."""
    # Not pytest's: nobody else may enter that.
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o1777)
        yield Path(name)


def test_only_its_creator_decides_who_may_use_it(shared: Path) -> None:
    """A creator that was killed between two calls left a file that no other user could open, for ever."""
    path = shared / "port.lock"
    path.touch(mode=0o600)
    with closing(LockFile(path, 0o666)) as lock:
        lock.take()
        assert path.stat().st_mode & 0o777 == 0o666
        assert lock.owner == str(os.getpid())
    assert path.exists()


def test_what_is_not_a_lock_stays(shared: Path) -> None:
    precious = shared / "precious"
    precious.write_text("x" * 100)
    link = shared / "link.lock"
    link.symlink_to(precious)
    for path, why in ((precious, "left untouched"), (link, "symbolic links")):
        with pytest.raises(OSError, match=why):
            LockFile(path)
    assert precious.read_text() == "x" * 100


@needs_root
def test_users_that_come_at_the_same_moment_are_all_let_in(shared: Path) -> None:
    with ExitStack() as stack:
        users = [
            stack.enter_context(
                subprocess.Popen(
                    [sys.executable, "-c", CONTEND, str(shared), str(uid)],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                )
            )
            for uid in OTHERS
        ]
        for user in users:
            assert user.stdout is not None
            assert user.stdout.readline() == "ready\n"
        for user in users:
            assert user.stdin is not None
            user.stdin.write("\n")
            user.stdin.flush()
        errors = [user.communicate(timeout=300)[1] for user in users]
    assert errors == ["", ""]
    assert len(list(shared.iterdir())) == 300  # nothing but the locks is left


@needs_root
def test_a_lock_of_another_user_is_named_and_stays(shared: Path) -> None:
    code = (
        "import os, sys; from pathlib import Path; from acquire.daemon.endpoint import Endpoint\n"
        "os.seteuid(int(sys.argv[2]))\n"
        "try: Endpoint(Path(sys.argv[1]))\n"
        "except Exception as error: print(type(error).__name__, error)\n"
    )
    path = shared / "c.sock"
    Endpoint(path).close()
    command = [sys.executable, "-c", code, str(path), str(OTHERS[0])]
    refused = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True).stdout
    assert refused.startswith("UsageError")
    assert "it belongs to user root, who keeps it from other users" in refused
    assert "try: another place: --socket PATH" in refused
    assert lock_path(path).exists()


def test_the_daemon_says_what_is_in_its_way(shared: Path) -> None:
    lock_path(shared / "c.sock").mkdir()
    with pytest.raises(UsageError, match="Is a directory"):
        Endpoint(shared / "c.sock")
