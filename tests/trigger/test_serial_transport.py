"""Serial ports: real pseudo-terminals, their locks, and ports that vanish or stall."""

from __future__ import annotations

import errno
import fcntl
import multiprocessing
import os
import sys
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import serial
from serial.tools.list_ports_common import ListPortInfo
from trigger_twins import CLOCK_HZ, run, wired_model

from acquire.config.device import TriggerConfig
from acquire.errors import TriggerError
from acquire.sim.twin_links import PtyTwin
from acquire.trigger.driver import TriggerDriver
from acquire.trigger.transports.lock import PortLock, lock_directory
from acquire.trigger.transports.serial import FoundPort, SerialTransport, list_ports


def test_a_loop_brings_back_what_was_sent() -> None:
    port = SerialTransport("loop://", 3_000_000)
    port.write(b"abc")
    assert port.read() == b"abc"
    assert port.read() == b""
    port.close()
    port.close()


def test_ports_are_listed_with_who_uses_them(monkeypatch: pytest.MonkeyPatch) -> None:
    with wired_model() as model:
        twin = PtyTwin(model)
        there = ListPortInfo(twin.path)
        monkeypatch.setattr("acquire.trigger.transports.serial.comports", lambda: [there])
        assert list_ports() == [FoundPort(twin.path, "", "", "")]
        port = SerialTransport(twin.path, 3_000_000)
        assert f"in use by process {os.getpid()}" in list_ports()[0].held_by
        port.close()
        twin.close()


def test_a_missing_port_is_named() -> None:
    with pytest.raises(TriggerError, match=r"/dev/ttyNONE is not there; possible: .*; try: check cable"):
        SerialTransport("/dev/ttyNONE", 3_000_000)
    with pytest.raises(TriggerError, match="nonsense://x cannot be opened"):
        SerialTransport("nonsense://x", 3_000_000)


def test_a_port_that_may_not_be_opened_leads_to_the_udev_rule(monkeypatch) -> None:
    def refuse(url, **settings):
        raise serial.SerialException(errno.EACCES, f"could not open port {url}: Permission denied")

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(
        TriggerError, match="may not be opened: permission denied; try: install the udev rule"
    ):
        SerialTransport("/dev/ttyUSB0", 3_000_000)


def test_an_echo_is_not_taken_for_a_trigger() -> None:
    driver = TriggerDriver(lambda: SerialTransport("loop://", 3_000_000), TriggerConfig())
    begun = time.monotonic()
    with pytest.raises(TriggerError, match=r"loop://: no answer .*try: check that it is the trigger's port"):
        driver.identify()
    assert time.monotonic() - begun < 60


def _hold(path, link) -> None:
    lock = PortLock(path)
    link.send("held")
    link.poll(30)
    lock.release()


@pytest.mark.usefixtures("locks_of_the_host")
def test_a_port_has_one_user_and_the_error_names_it_to_the_second(tmp_path) -> None:
    path = str(tmp_path / "tty")
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    child = context.Process(target=_hold, args=(path, theirs), daemon=True)
    child.start()
    assert ours.poll(30)
    with pytest.raises(TriggerError, match=rf"{path} is in use by process {child.pid} \(.*python"):
        PortLock(path)
    child.kill()
    child.join(300)
    PortLock(path).release()
    ours.close()
    theirs.close()


def test_a_port_that_is_only_looked_at_can_be_opened(tmp_path) -> None:
    """Whoever lists the ports holds the lock of each for a moment."""
    path = str(tmp_path / "tty")
    with _held_elsewhere(path) as held:
        ending = threading.Timer(0.02, os.close, [held])
        ending.start()
        PortLock(path).release()
        ending.join()


def test_a_holder_that_has_not_said_who_it_is_is_unknown(tmp_path) -> None:
    path = str(tmp_path / "tty")
    with _held_elsewhere(path) as held:
        with pytest.raises(TriggerError, match=f"{path} is in use by process unknown;"):
            PortLock(path)
        os.close(held)


@contextmanager
def _held_elsewhere(path: str) -> Iterator[int]:
    """The lock's file, held by a descriptor that the block closes, and without a number in it."""
    PortLock(path).release()
    (file,) = lock_directory().glob(f"*{Path(path).parent.name.replace('_', '-')}-tty.lock")
    held = os.open(file, os.O_RDWR | os.O_TRUNC)
    fcntl.flock(held, fcntl.LOCK_EX)
    yield held


def test_a_port_that_vanishes_while_it_is_opened_is_not_held_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def gone(*_: object) -> None:
        raise termios.error(errno.EIO, "Input/output error")

    with wired_model() as model:
        twin = PtyTwin(model)
        with monkeypatch.context() as patched:
            patched.setattr(termios, "tcflush", gone)
            with pytest.raises(TriggerError, match=f"{twin.path} cannot be opened: .*Input/output error"):
                SerialTransport(twin.path, 3_000_000)
        SerialTransport(twin.path, 3_000_000).close()
        twin.close()


def test_two_drivers_on_one_port() -> None:
    with wired_model() as model:
        twin = PtyTwin(model)
        first = SerialTransport(twin.path, 3_000_000, rts_cts=True)
        with pytest.raises(TriggerError, match="is in use by process"):
            SerialTransport(twin.path, 3_000_000)
        first.close()
        SerialTransport(twin.path, 3_000_000).close()
        twin.close()


def test_a_disappearing_port_is_reported() -> None:
    with wired_model() as model:
        twin = PtyTwin(model)
        port = SerialTransport(twin.path, 3_000_000)
        twin.close()
        with pytest.raises(TriggerError, match="is gone"):
            port.read()
        port.close()


def test_tags_that_nobody_takes_are_lost_by_the_device_and_counted(monkeypatch) -> None:
    monkeypatch.setattr("acquire.sim.trigger_model.TAG_ROOM", 40)
    with wired_model() as model:
        way = _Stalling(model)
        driver = TriggerDriver(lambda: way, TriggerConfig(clock_hz=CLOCK_HZ))
        driver.prepare(run(tag_every_lines=1))
        driver.start()
        tags = []
        way.stall_s = 0.02  # 666 lines
        while driver.statistics()["tags_missing"] < 100:
            tags += driver.tags(0.1)
        lines = driver.stop()
        deadline = time.monotonic() + 300
        while (now := driver.statistics())["tags"] + now["tag_lost"] < lines + 1:
            assert time.monotonic() < deadline, now
            tags += driver.tags(0.1)
        assert now["tag_count"] == now["tags"] + now["tag_lost"] == lines + 1
        assert now["tags_missing"] <= now["tag_lost"]
        assert all((tag.code_index, tag.tick) == (3 * tag.line, 2700 * tag.line) for tag in tags)
        driver.close()


class _Stalling:
    """A host that sometimes does not read."""

    name = "stalling"
    bytes_per_s = float("inf")

    def __init__(self, model) -> None:
        self.model, self.stall_s, self.wake = model, 0.0, threading.Event()

    def read(self) -> bytes:
        self.wake.wait(self.stall_s or 0.001)
        return self.model.take()

    def write(self, data: bytes) -> None:
        self.model.feed(data)

    def close(self) -> None:
        """Nothing."""


class Talker:
    """Device that sends more than a pseudo-terminal holds."""

    busy = False

    def __init__(self) -> None:
        self.rest = bytes(k % 251 for k in range(100_000))

    def feed(self, data: bytes) -> None:
        """Ignore all input."""

    def take(self) -> bytes:
        data, self.rest = self.rest, b""
        return data


def test_a_full_terminal_makes_the_device_wait_and_loses_nothing() -> None:
    talker = Talker()
    said = talker.rest
    twin = PtyTwin(talker)
    slave = os.open(twin.path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    waiting, deadline = -1, time.monotonic() + 300
    while (now := _waiting(slave)) != waiting or not now:  # until nothing more fits
        assert time.monotonic() < deadline
        waiting = now
        time.sleep(0.05)
    assert waiting < len(said) / 2
    heard = b""
    while len(heard) < len(said):
        assert time.monotonic() < deadline
        with suppress(BlockingIOError):
            heard += os.read(slave, 4096)
    assert heard == said
    os.close(slave)
    twin.close()


def _waiting(descriptor: int) -> int:
    return int.from_bytes(fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4)), sys.byteorder)
