"""A calibration that is replaced: by one process at a time, and there whole whenever a process is killed."""

from __future__ import annotations

import errno
import logging
import os
import signal
import sys
import threading
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acquire.calibrate import Calibration, Measured, open_calibration, save_calibration
from acquire.calibrate.calibration import Finding, Instrument
from acquire.calibrate.file import change_calibration, check_calibration_place
from acquire.errors import PlaceError
from acquire.store import swap
from acquire.store.files import DISK, Disk

INSTRUMENT = Instrument(stages=4, substeps=3, substep_s=1e-5, layout="dual", cameras={})
CHANGES = {"open", "os.mkdir", "os.remove", "os.rename", "os.rmdir", "os.scandir", "shutil.rmtree"}
"""Names of what Python reports before it asks the system for it: where a process is killed here."""


def veil(value: float) -> Finding:
    return Finding("veil", INSTRUMENT, {"veil": Measured(np.full(2, value), np.zeros(2))})


OLD, NEW = (Calibration(INSTRUMENT).with_step(veil(value)) for value in (0.01, 0.02))


class TwoRenames(Disk):
    """As a network disk, which cannot exchange two names."""

    def exchange(self, one: Path, other: Path) -> None:
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))


def save_until(path: Path, step: int) -> bool:
    """Save NEW in a process that is killed before the given step; return whether it came so far."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # zarr has a thread, which it starts again
        child = os.fork()
    if child == 0:
        done = 0

        def kill_here(event: str, args: tuple[object, ...]) -> None:
            nonlocal done
            if event in CHANGES and str(path.parent) in str(args):
                if done == step:
                    os.kill(os.getpid(), signal.SIGKILL)
                done += 1

        sys.addaudithook(kill_here)
        try:
            save_calibration(path, NEW)
        finally:
            os._exit(0)
    return os.waitpid(child, 0)[1] == signal.SIGKILL


@pytest.mark.parametrize("disk", [DISK, TwoRenames()], ids=["exchange", "two renames"])
def test_a_kill_at_any_moment_leaves_the_old_calibration_or_the_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, disk: Disk
) -> None:
    """Between two renames there was none under its name, and nothing that said where it was."""
    monkeypatch.setattr(swap, "DISK", disk)
    path = tmp_path / "cal.zarr"
    save_calibration(path, OLD)
    step, found = 0, set()
    while save_until(path, step):
        found.add(float(open_calibration(path).quantities["veil"].value[0]))
        save_calibration(path, OLD)
        assert [each.name for each in tmp_path.iterdir()] == ["cal.zarr"]
        step += 1
    assert found == {0.01, 0.02}
    assert step > 20


def test_what_is_put_back_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "cal.zarr"
    save_calibration(path, OLD)
    path.rename(tmp_path / ".cal.zarr.4711.before")
    with caplog.at_level(logging.WARNING):
        check_calibration_place(path)
    assert f"{path} was put back: a process was killed while it replaced it" in caplog.text
    assert [each.name for each in tmp_path.iterdir()] == ["cal.zarr"]

    path.rename(tmp_path / ".cal.zarr.4711.before")

    class ReadOnly(Disk):
        def rename(self, source: Path, target: Path) -> None:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(swap, "DISK", ReadOnly())
    with pytest.raises(PlaceError, match="cannot be renamed: Read-only file system") as refused:
        open_calibration(path)
    assert refused.value.hint.startswith(f"mv {tmp_path}/.cal.zarr.4711.before {path}")


def test_what_was_removed_on_purpose_does_not_come_back_in_parts(tmp_path: Path) -> None:
    path = tmp_path / "cal.zarr"
    save_calibration(path, OLD)
    path.rename(tmp_path / ".cal.zarr.4711.before")
    (tmp_path / ".cal.zarr.4711.before" / "veil" / "c" / "0").unlink()
    with pytest.raises(PlaceError, match="does not exist"):
        open_calibration(path)


def test_of_two_that_add_a_step_at_once_neither_loses_its_own(tmp_path: Path) -> None:
    """Each read the calibration, added its step, and wrote: the second without the first one's."""
    path = tmp_path / "cal.zarr"
    save_calibration(path, OLD)
    inside, both = threading.Barrier(2), [f"step-{k}" for k in range(2)]

    def add(step: str) -> None:
        found = Finding(step, INSTRUMENT)
        inside.wait(30)
        for _ in range(5):
            change_calibration(path, lambda known: known.with_step(found))

    threads = [threading.Thread(target=add, args=(step,)) for step in both]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert set(open_calibration(path).steps) == {"veil", *both}
    assert [each.name for each in tmp_path.iterdir()] == ["cal.zarr"]


def test_one_that_is_replaced_while_it_is_read_is_read_again(tmp_path: Path) -> None:
    """Attributes of one and arrays of the next were taken for one calibration."""
    path = tmp_path / "cal.zarr"
    first, second = (
        replace(
            known, steps={"veil": {**known.steps["veil"], "value": float(known.quantities["veil"].value[0])}}
        )
        for known in (OLD, NEW)
    )
    save_calibration(path, first)
    done = threading.Event()

    def swap_them() -> None:
        while not done.is_set():
            save_calibration(path, second)
            save_calibration(path, first)

    swapping = threading.Thread(target=swap_them)
    swapping.start()
    try:
        for _ in range(100):
            known = open_calibration(path)
            assert known.quantities["veil"].value[0] == known.steps["veil"]["value"]
    finally:
        done.set()
        swapping.join()


def test_a_link_stays_one(tmp_path: Path) -> None:
    """The link was replaced, and what it led to was left as it was."""
    (tmp_path / "real").mkdir()
    save_calibration(tmp_path / "real" / "2026.zarr", OLD)
    link = tmp_path / "cal.zarr"
    link.symlink_to("real/2026.zarr")
    check_calibration_place(link)
    save_calibration(link, NEW)
    assert link.is_symlink()
    assert open_calibration(tmp_path / "real" / "2026.zarr").quantities["veil"].value[0] == 0.02
