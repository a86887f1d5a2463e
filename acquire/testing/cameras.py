"""Tests that every camera driver must pass: extend `CameraContract` with a fixture ``stand``."""

from __future__ import annotations

import itertools
import json
import pickle
import signal
import time
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from acquire.camera.base import CameraBlock
from acquire.errors import CameraError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from acquire.camera.base import Camera, CameraOpener

WAIT_S = 300.0
"""Longest wait for lines, so that a test cannot hang."""


@dataclass
class CameraStand:
    """A camera under test, and its trigger.

    Attributes
    ----------
    opener : opens the camera
    start, stop : start and stop the trigger's pulses; both may be called repeatedly
    serial : part of the serial number that the camera reports
    sent : the part of the opener that is pickled, if a child process inherits the rest; None: all of it
    lines : (first line since arming, count) → the pixels that these lines must have; None: not known
    """

    opener: CameraOpener
    start: Callable[[], object]
    stop: Callable[[], object]
    serial: str = ""
    lines: Callable[[int, int], NDArray[Any]] | None = None
    sent: object = None


class CameraContract:
    """Needs a fixture ``stand``, a `CameraStand`; use scope "module" if opening takes long."""

    @pytest.fixture
    def camera(self, stand: CameraStand) -> Iterator[Camera]:
        """The opened camera; it is closed at the end, and its trigger stopped."""
        opened = stand.opener()
        yield opened
        opened.close()
        stand.stop()

    def test_it_says_who_it_is_and_how_it_is_set(self, stand: CameraStand, camera: Camera) -> None:
        """A recording states both; without the serial number, arms could be exchanged unnoticed."""
        identity, settings = camera.identify(), camera.settings()
        assert identity.model
        assert stand.serial in identity.serial
        assert settings["Width"] >= 1
        assert settings["PixelFormat"].startswith("Mono")
        json.dumps(settings)  # a recording's attributes: numbers of numpy are refused when it begins

    def test_a_camera_that_is_not_armed_gives_no_lines(self, camera: Camera) -> None:
        """A wait that could only time out is an error of the caller."""
        with pytest.raises(CameraError, match="not armed"):
            camera.next_block(0.1)

    def test_without_a_trigger_the_wait_is_bounded_and_in_vain(
        self, stand: CameraStand, camera: Camera
    ) -> None:
        """A grabber looks after its process between waits: an endless one could not be stopped."""
        camera.arm()
        if stand.lines is not None:
            # Not for a camera whose lines are unknown: it may run freely, without triggers.
            begin = time.monotonic()
            assert camera.next_block(0.1) is None
            assert time.monotonic() - begin < 60
        camera.disarm()

    def test_lines_count_from_arm_without_a_hole_and_are_what_the_sensor_saw(
        self, stand: CameraStand, camera: Camera
    ) -> None:
        """Lines of both arms are matched by their numbers, so that a hole that is not told shifts one arm."""
        camera.arm()
        stand.start()
        blocks = take(camera, 12)
        if stand.lines is not None:
            assert blocks[0].first_line == 0
            expected = stand.lines(0, 12 * len(blocks[0].flags))
            np.testing.assert_array_equal(np.concatenate([block.pixels for block in blocks]), expected)
        for before, after in itertools.pairwise(blocks):
            assert after.first_line == before.first_line + len(before.flags) + sum(
                loss.count for loss in after.losses
            )
        assert all(block.pixels.ndim == 2 and len(block.pixels) == len(block.flags) for block in blocks)
        assert camera.statistics()["lines"] == sum(len(block.flags) for block in blocks)

    def test_every_arming_counts_anew_and_ending_twice_is_ending_once(
        self, stand: CameraStand, camera: Camera
    ) -> None:
        """After a fault nobody knows what has been ended already, so that everything is ended again."""
        for _ in range(2):
            camera.arm()
            stand.start()
            assert take(camera, 2)[0].first_line == 0
            camera.disarm()
            camera.disarm()
            stand.stop()
        camera.close()
        camera.close()

    def test_a_closed_camera_can_be_opened_again(self, stand: CameraStand) -> None:
        # A grabber closes a camera that is gone, even if it cannot disarm it, and opens it again
        # (stream.reopen_s).
        for _ in range(2):
            opened = stand.opener()
            opened.arm()
            opened.close()

    def test_opening_leaves_signals_and_warnings_as_they_were(self, stand: CameraStand) -> None:
        # harvesters, for one, takes over SIGINT and changes the warning filters; a driver has to restore
        # both.
        before = signal.getsignal(signal.SIGINT), list(warnings.filters)
        stand.opener().close()
        assert (signal.getsignal(signal.SIGINT), list(warnings.filters)) == before

    def test_what_opens_it_can_be_given_to_another_process(self, stand: CameraStand) -> None:
        # A camera is opened by its grabber, which is a process of its own.
        sent = stand.opener if stand.sent is None else stand.sent
        assert pickle.loads(pickle.dumps(sent)) == sent  # noqa: S301  # our own bytes


def take(camera: Camera, blocks: int) -> list[CameraBlock]:
    """Return ``blocks`` blocks, which are copied and released."""
    taken: list[CameraBlock] = []
    deadline = time.monotonic() + WAIT_S
    while len(taken) < blocks:
        assert time.monotonic() < deadline, f"only {len(taken)} of {blocks} blocks came"
        block = camera.next_block(0.2)
        if block is not None:
            # Once released, a block may be overwritten by the camera.
            taken.append(CameraBlock(block.first_line, block.pixels.copy(), block.flags.copy(), block.losses))
            camera.release(block)
    return taken
