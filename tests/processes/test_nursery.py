"""Workers are born warm, end with their owner, and outlive their nursery."""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from waiting import until

from acquire.errors import AcquireError, DeviceError
from acquire.processes.messages import Ready
from acquire.processes.nursery import Child, Nursery, Own, nursery
from acquire.processes.shared import Counters
from acquire.processes.worker import Mailbox, OwnerGone, Worker

LIMIT_S = 60.0


def tell(mailbox: Mailbox, *names: str) -> None:
    """Where and what the process is, then wait to be ended."""
    facts = {
        "modules": [name for name in names if name in sys.modules],
        "environment": os.environ.get("NURSERY_TEST"),
        "cwd": str(Path.cwd()),
        "parent": os.getppid(),
        "files": len(list(Path("/proc/self/fd").iterdir())),
    }
    mailbox.post(Ready(facts))
    while True:
        mailbox.take()
        time.sleep(0.005)


def count(mailbox: Mailbox, counters: Counters) -> None:
    counters["seen"] = os.getpid()
    mailbox.post(Ready())
    while True:
        mailbox.take()
        time.sleep(0.005)


def finish_slowly(mailbox: Mailbox) -> None:
    """At its end there is something left to do."""
    try:
        tell(mailbox)
    except OwnerGone:
        time.sleep(1.5)
        raise


def fail(_: Mailbox, error: BaseException) -> None:
    raise error


def leave(_: Mailbox, code: int) -> None:
    os._exit(code)


def deadline() -> float:
    return time.monotonic() + LIMIT_S


def test_a_worker_is_where_its_owner_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was imported before is there; environment and directory are the owner's of now."""
    monkeypatch.setenv("NURSERY_TEST", "now")
    monkeypatch.chdir(tmp_path)
    counts = []
    for _ in range(2):  # and nothing is left of the one before
        worker = Worker("one", tell, "acquire.stream.recorder", "harvesters.core")
        facts = worker.expect(Ready, deadline()).facts
        assert (facts["modules"], facts["parent"]) == (["acquire.stream.recorder"], nursery().pid)
        assert (facts["environment"], facts["cwd"]) == ("now", str(tmp_path))
        counts.append(facts["files"])
        assert worker.death is None
        worker.end(deadline())
    assert counts[0] == counts[1]


def test_memory_is_shared() -> None:
    counters = Counters(("seen",))
    worker = Worker("one", count, counters)
    worker.expect(Ready, deadline())
    assert counters["seen"] == worker.pid
    worker.end(deadline())
    counters.close()


def test_how_a_worker_ended_is_known() -> None:
    for target, argument, told in (
        (leave, 3, "ended with exit code 3"),
        (fail, AcquireError("out of ideas"), "out of ideas"),
        (fail, ValueError("odd"), "one: ValueError: odd"),
    ):
        worker = Worker("one", target, argument)
        with pytest.raises(AcquireError, match=told):
            worker.expect(Ready, deadline())
        worker.end(deadline())


def test_what_cannot_be_sent_to_a_worker_is_no_lack_of_memory() -> None:
    """The opener of a plug-in's camera was a lambda, and the hint was to end other programs."""
    with pytest.raises(DeviceError, match="cannot be started: Can't") as refused:
        Worker("one", tell, lambda: None)
    assert "lambda" in refused.value.hint


def test_a_worker_that_is_killed_and_one_that_does_not_end() -> None:
    worker = Worker("one", tell)
    worker.expect(Ready, deadline())
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGKILL)
    until(lambda: worker.death == "killed by SIGKILL")
    worker.end(deadline())
    worker = Worker("one", tell)
    worker.expect(Ready, deadline())
    pid = worker.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    with pytest.raises(DeviceError, match="did not end when told to"):
        worker.end(time.monotonic())
    assert not psutil.pid_exists(pid)


def test_a_worker_that_stands_still_is_not_waited_for_as_one_at_work(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Until it goes on, should that come soon; what works is not ended by force before its time."""
    monkeypatch.setattr("acquire.processes.worker._STOPPED_WAIT_S", 0.5)
    still, busy = Worker("still", tell), Worker("busy", finish_slowly)
    for worker in (still, busy):
        worker.expect(Ready, deadline())
    assert still.pid is not None
    os.kill(still.pid, signal.SIGSTOP)
    with pytest.raises(DeviceError, match="still: the process did not end when told to, and was killed"):
        still.end(math.inf)
    busy.end(math.inf)
    monkeypatch.setattr("acquire.processes.worker._STOPPED_WAIT_S", LIMIT_S)
    paused = Worker("paused", tell)
    paused.expect(Ready, deadline())
    pid = paused.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    goes_on = threading.Timer(0.3, os.kill, (pid, signal.SIGCONT))
    goes_on.start()
    paused.end(math.inf)
    goes_on.join()


@pytest.fixture
def mortal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Own]:
    """A nursery that the other tests do not need."""
    own = Own()
    own.replace(lambda: Nursery(("acquire.stream.recorder",)))
    monkeypatch.setattr("acquire.processes.worker.nursery", own.get)
    yield own
    own.replace(lambda: None)


def test_a_nursery_that_dies_is_replaced_and_its_workers_go_on(mortal: Own) -> None:
    worker = Worker("one", tell)
    worker.expect(Ready, deadline())
    before = mortal.get().pid
    os.kill(before, signal.SIGKILL)
    until(lambda: mortal.get().pid != before, "another nursery")
    assert worker.death is None
    another = Worker("another", tell, "acquire.stream.recorder")
    assert another.expect(Ready, deadline()).facts["modules"] == ["acquire.stream.recorder"]
    another.end(deadline())
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGKILL)
    until(lambda: worker.death == "ended, with an unknown exit code")
    worker.end(deadline())


def test_the_end_of_a_worker_that_was_not_yet_forked_is_reported() -> None:
    one = Nursery()
    os.kill(one.pid, signal.SIGSTOP)
    child = one.fork("one", leave, 0)
    assert (child.pid(0.01), child.exit_code()) == (None, None)
    one.close()
    assert child.exit_code(LIMIT_S) == 255
    child.close()


def test_any_number_of_threads_may_ask_for_a_number_that_is_just_coming() -> None:
    """A status request beside the supervisor: one of them waited for the end of the process (83 of 300)."""
    for _ in range(100):
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        child = Child(ours)
        asking = [threading.Thread(target=_ask, args=(child,)) for _ in range(4)]
        for thread in asking:
            thread.start()
        time.sleep(0.002)
        pidfd = os.pidfd_open(os.getpid())
        socket.send_fds(theirs, [b"%d" % os.getpid()], [pidfd])
        os.close(pidfd)
        for thread in asking:
            thread.join(LIMIT_S)
        waiting = [thread for thread in asking if thread.is_alive()]
        theirs.close()  # which frees those that wait
        assert not waiting
        assert child.pid() == os.getpid()
        child.close()


def _ask(child: Child) -> None:
    deadline_s = time.monotonic() + LIMIT_S
    while child.pid() is None:
        assert time.monotonic() < deadline_s


OWNER = """
import json, time
from test_nursery import tell
from acquire.processes.messages import Ready
from acquire.processes.nursery import nursery
from acquire.processes.worker import Worker
workers = [Worker(name, tell) for name in ("one", "two")]
for worker in workers:
    worker.expect(Ready, time.monotonic() + 60)
print(json.dumps([nursery().pid, *(worker.pid for worker in workers)]), flush=True)
time.sleep(600)
"""


def test_all_end_with_an_owner_that_is_killed() -> None:
    here = Path(__file__).parent
    environment = os.environ | {"PYTHONPATH": f"{here}:{here.parent}"}
    with subprocess.Popen(
        [sys.executable, "-c", OWNER], stdout=subprocess.PIPE, text=True, env=environment
    ) as owner:
        assert owner.stdout is not None
        pids = json.loads(owner.stdout.readline())
        owner.kill()
    assert len(pids) == 3
    until(lambda: not any(map(_lives, pids)), "the end of all")


def _lives(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE  # of which nobody here is the parent
    except psutil.NoSuchProcess:
        return False
