"""Lost, doubled and reordered packets over GigE Vision: what is missing is counted as by the sender."""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from gige_helpers import (
    WAIT_S,
    aravis_camera,
    open_in_time,
    our_camera,
    sent_and_dropped,
    spec_at,
)
from ramp_sensor import ramp

from acquire.camera.aravis import AravisCamera, AravisOpener
from acquire.camera.settings import Setting
from acquire.camera.spec import GenicamSpec
from acquire.lines import LineFlag
from acquire.sim.gige.camera import Transmission

pytestmark = pytest.mark.needs_aravis

HEIGHT = 50
FRAMES = 300
WINDOW = 6
"""Frames that the camera may be ahead of the reader."""
PACKETS = 6
"""A frame of 50 lines of 48 pixels is four packets of payload between leader and trailer."""
LEADER, TRAILER = 0, PACKETS - 1


@pytest.fixture(scope="module", autouse=True)
def _first_look() -> Iterator[None]:
    """Aravis keeps what its first look at a camera made."""
    with our_camera(HEIGHT, Transmission()) as (_, address):
        open_in_time(AravisOpener(spec_at(address, HEIGHT))).close()
    return


class LossyLink:
    """Loses a ``share`` of packets by chance, and what a test wants.

    Of the frames in ``without`` those packets are lost; frames in ``again`` come twice, the second time
    before the frame that is given for them. The first frame, unless it is among those, and frames from
    ``FRAMES`` on are whole.
    """

    def __init__(
        self,
        share: float = 0.0,
        without: dict[int, set[int]] | None = None,
        again: dict[int, int] | None = None,
        shuffled: bool = False,
        doubled: bool = False,
    ) -> None:
        self.share, self.without, self.again = share, without or {}, again or {}
        self.shuffled, self.doubled = shuffled, doubled
        self.chance = random.Random(5)
        self.came: dict[int, set[int]] = {}
        self.kept: dict[int, list[bytes]] = {}

    def __call__(self, frame: int, packets: list[bytes]) -> list[bytes]:
        assert len(packets) == PACKETS
        lost = {k for k in range(PACKETS) if self.chance.random() < self.share}
        lost = self.without.get(frame, lost if 0 < frame < FRAMES else set())
        self.came[frame] = set(range(PACKETS)) - lost
        come = [packets[k] for k in sorted(self.came[frame])]
        if self.doubled:
            come = [packet for packet in come for _ in range(2)]
        if self.shuffled:
            self.chance.shuffle(come)
        if frame in self.again:
            self.kept[self.again[frame]] = packets
        return self.kept.pop(frame, []) + come


@dataclass(frozen=True)
class Expected:
    """What must come of a transmission: places of whole and of flagged frames, lines lost by cause."""

    whole: list[int]
    flagged: list[int]
    lost: dict[str, int]


def expected(came: dict[int, set[int]], end: int, begins: bool, packets: int = PACKETS) -> Expected:
    """By the sender's own account. A frame with its leader has its number, one without has its place if no
    frame beside it is lost wholly. ``begins``: the first id is known, so that the first frames can be missed.
    """
    whole, flagged, lost = [], [], Counter()
    hole: list[int] = []
    started = begins
    for frame in range(end):
        arrived = came[frame]
        if LEADER not in arrived:
            hole += [frame] if arrived or started else []
            continue
        partial = [between for between in hole if came[between]]
        if partial == hole:
            flagged += hole
        else:
            lost["incomplete"] += len(partial) * HEIGHT
            lost["id_gap"] += (len(hole) - len(partial)) * HEIGHT
        hole, started = [], True
        (whole if len(arrived) == packets else flagged).append(frame)
    return Expected(whole, flagged, {cause: lines for cause, lines in lost.items() if lines})


def take(camera: AravisCamera, sensor: object, last_frame: int, window: int) -> Expected:
    """Frames up to ``last_frame``, which is whole; whole ones are checked pixel by pixel."""
    whole, flagged, lost = [], [], Counter()
    deadline = time.monotonic() + WAIT_S
    next_line = allowed = 0
    while next_line <= last_frame * HEIGHT:
        assert time.monotonic() < deadline, f"at line {next_line} of {last_frame * HEIGHT}"
        allowed = max(allowed, next_line + window * HEIGHT)
        sensor.allowed = min(allowed, (last_frame + 1) * HEIGHT)
        block = camera.next_block(0.05)
        if block is None:  # all that came is read, and none of it has a number
            allowed += HEIGHT
            continue
        for loss in block.losses:
            lost[str(loss.cause)] += loss.count
            next_line += loss.count
        assert block.first_line == next_line
        assert len(block.flags) == HEIGHT
        if block.flags.any():
            assert set(block.flags) == {LineFlag.INCOMPLETE}
            flagged.append(next_line // HEIGHT)
        else:
            lines = np.arange(next_line, next_line + HEIGHT)
            np.testing.assert_array_equal(block.pixels, ramp(lines))
            whole.append(next_line // HEIGHT)
        next_line += HEIGHT
        camera.release(block)
    return Expected(whole, flagged, dict(lost))


EVERY = set(range(PACKETS))
AT_WRAP = dict.fromkeys((233, 234, 236, 237), EVERY)
CASES: dict[str, tuple[dict, dict, dict]] = {
    "3 per cent": ({"share": 0.03}, {}, {}),
    "30 per cent": ({"share": 0.3}, {}, {}),
    "half": ({"share": 0.5}, {}, {}),
    "leaders": ({"without": {k: {LEADER} for k in (3, 4, 9, 20, 21, 22, 80)}}, {}, {}),
    "every other leader": ({"without": {k: {LEADER} for k in range(1, 280, 2)}}, {}, {}),
    "trailers": ({"without": {k: {TRAILER} for k in (3, 4, 9, 20, 21, 22, 80)}}, {}, {}),
    "payload": ({"without": {k: {2, 3} for k in (3, 4, 9, 20, 21, 22, 80)}}, {}, {}),
    "whole frames": ({"without": dict.fromkeys((3, 9, 10, 11, 80), EVERY)}, {}, {}),
    "the first frames": ({"without": {0: EVERY, 1: {LEADER}}}, {}, {"frame_id_first": 1}),
    "the first leaders": ({"without": {0: {LEADER}, 1: {LEADER}}}, {}, {}),
    "at a wrap": ({"share": 0.1, "without": AT_WRAP}, {"first_id": 65_300}, {}),
    "at the sign of 16 bits": ({"share": 0.1, "without": AT_WRAP}, {"first_id": 32_767 - 235}, {}),
    "ids of 64 bits": (
        {"share": 0.1, "without": AT_WRAP},
        {"first_id": 2**32 - 235, "extended": True},
        {"frame_id_bits": 64},
    ),
    "ids of 64 bits, unannounced": ({"share": 0.1}, {"first_id": 65_536 - 235, "extended": True}, {}),
    "reordered": ({"share": 0.03, "shuffled": True}, {}, {}),
    "doubled": ({"share": 0.03, "doubled": True}, {}, {}),
}  # fmt: skip


def transmit(
    link: LossyLink, spec: dict, *settings: Setting, window: int = WINDOW, **sent: object
) -> tuple[Expected, dict[str, int]]:
    """What comes through that link, and the camera's statistics."""
    with our_camera(HEIGHT, Transmission(link=link, **sent)) as (sensor, address):
        camera = open_in_time(AravisOpener(spec_at(address, HEIGHT, *settings, **spec)))
        try:
            camera.arm()
            return take(camera, sensor, FRAMES, window), camera.statistics()
        finally:
            camera.close()


@pytest.mark.parametrize("name", CASES)
def test_losses_are_counted_exactly_and_whole_frames_are_where_they_belong(
    name: str,
) -> None:
    losses, sent, spec = CASES[name]
    link = LossyLink(**losses)
    found, statistics = transmit(link, spec, resends=False, **sent)
    assert found == expected(link.came, FRAMES + 1, begins="frame_id_first" in spec)
    assert statistics["stale_frames"] == 0
    assert statistics["lines"] == (len(found.whole) + len(found.flagged)) * HEIGHT
    assert statistics["lost"] == sum(found.lost.values())


def test_frames_that_come_again_are_no_wrap() -> None:
    """Aravis itself drops what is less than a hundred frames late."""
    link = LossyLink(again={50: 200, 51: 201, 52: 202, 170: 290, 280: 285})
    found, statistics = transmit(link, {}, resends=False, first_id=65_535 - 160)
    assert found == Expected(list(range(FRAMES + 1)), [], {})
    assert statistics["stale_frames"] == 4


def test_packets_that_are_sent_again_make_frames_whole() -> None:
    ratio = Setting("stream", "packet-request-ratio", 2.0)
    quick = Setting("stream", "packet-timeout", 2000)
    link = LossyLink(0.05)
    found, statistics = transmit(link, {}, ratio, quick)
    assert found == Expected(list(range(FRAMES + 1)), [], {})
    assert statistics["incomplete_frames"] == 0
    assert sum(packets != EVERY for packets in link.came.values()) > 40


@pytest.mark.needs_gige_camera
@pytest.mark.parametrize("per_thousand", [30, 300])
def test_aravis_own_lossy_camera_agrees_with_its_own_account(tmp_path: Path, per_thousand: int) -> None:
    """Its ids begin at 65401 and wrap after 135 frames; a pixel is the sum of frame id, row and column."""
    log, height, packets, frames = tmp_path / "camera.log", 32, 4, 250
    whole, flagged, lost = {}, [], Counter()
    with aravis_camera(log, per_thousand) as serial:
        settings = (
            Setting("remote", "Width", 64),
            Setting("remote", "Height", height),
            Setting("remote", "PixelFormat", "Mono8"),
            Setting("remote", "AcquisitionFrameRate", 150.0),
        )
        spec = GenicamSpec(serial, settings=settings, bits=8, line_rate_hz=height * 150.0)
        camera = open_in_time(AravisOpener(spec))
        try:
            camera.arm()
            next_line = 0
            deadline = time.monotonic() + WAIT_S
            while (
                next_line < height * frames or next_line // height - 1 not in whole
            ):  # ends with a whole one
                assert time.monotonic() < deadline
                block = camera.next_block(0.2)
                if block is None:
                    continue
                for loss in block.losses:
                    lost[str(loss.cause)] += loss.count // height
                    next_line += loss.count
                assert block.first_line == next_line
                if block.flags.any():
                    flagged.append(next_line // height)
                else:
                    whole[next_line // height] = int(block.pixels[0, 0])
                next_line += height
                camera.release(block)
            statistics = camera.statistics()
        finally:
            camera.close()
    came = {frame: set(range(packets)) - lacking for frame, lacking in sent_and_dropped(log, packets).items()}
    begin = next(frame for frame, there in came.items() if there)
    came = {frame - begin: there for frame, there in came.items()}
    wanted = expected(came, next_line // height, begins=False, packets=packets)
    assert (sorted(whole), flagged) == (wanted.whole, wanted.flagged)
    assert dict(lost) == {cause: lines // HEIGHT for cause, lines in wanted.lost.items()}
    for frame, pixel in whole.items():
        number = 65_401 + begin + frame
        assert pixel == (number - 65_535 if number > 65_535 else number) % 255, f"frame {frame}"
    assert statistics["lines"] + statistics["lost"] == next_line
    assert len(flagged) > frames * per_thousand // 1000
