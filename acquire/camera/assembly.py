"""The common part of all GenICam cameras, for any library: from features and frames to blocks of lines."""

from __future__ import annotations

import math
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.camera.base import CameraBlock, CameraLoss, LossCause
from acquire.camera.frames import FrameCount, Tally
from acquire.camera.pixels import LineReader, PixelLayout, layout_of
from acquire.errors import CameraError
from acquire.lines import LineFlag

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from acquire.camera.frames import FrameFacts, FramePlace
    from acquire.camera.settings import Features, Node
    from acquire.camera.spec import GenicamSpec

STATISTICS = ("lines", "lost", "incomplete_frames", "stale_frames")
"""Lines delivered and lost; frames that arrived incomplete; frames that were late or sent twice."""
_WAITING_SHARE = 4
"""One in this many of a camera's buffers may hold frames whose place is not known yet."""
# Frames of thousands of lines would otherwise get one or two, and those of a fast camera take all memory.
_LEAST_BUFFERS = 16
_MOST_BUFFER_BYTES = 1 << 30


@dataclass(frozen=True, slots=True)
class FrameFormat:
    """Pixels per line, lines per frame, and layout of pixels in a buffer."""

    width: int
    height: int
    layout: PixelLayout


def frame_format(modules: Mapping[str, Features]) -> FrameFormat:
    """Return the format as the camera is set now; the height of a frame grabber's stream takes precedence."""
    height = modules["stream"].find("BufferHeight") if "stream" in modules else None
    return FrameFormat(
        width=int(demand(modules, "Width").read()),
        height=max(1, int((height or demand(modules, "Height")).read())),
        layout=layout_of(str(demand(modules, "PixelFormat").read())),
    )


def demand(modules: Mapping[str, Features], name: str) -> Node:
    """Return a feature of the camera itself. Raises CameraError if it has none of that name."""
    node = modules["remote"].find(name)
    if node is None:
        raise CameraError(f"the camera has no feature {name}", hint="acquire camera features")
    return node


def check_format(found: FrameFormat, spec: GenicamSpec) -> None:
    """Raise CameraError unless the lines have the format that the rig expects."""
    if spec.pixels and found.width != spec.pixels:
        raise CameraError(
            f"camera {spec.serial} delivers lines of {found.width} pixels",
            possible=f"{spec.pixels}, as the rig's geometry has stages",
            hint=f'the setting ["remote", "Width", {spec.pixels}]',
        )
    if spec.bits and found.layout.bits != spec.bits:
        raise CameraError(
            f"camera {spec.serial} delivers pixel format {found.layout.name} of {found.layout.bits} bits",
            possible=f"{spec.bits} bits, as the rig's pixel_format",
            hint=f'the setting ["remote", "PixelFormat", "Mono{spec.bits}"]',
        )


def buffer_count(spec: GenicamSpec, found: FrameFormat) -> int:
    """Return the number of buffers for ``buffer_s`` of lines, within limits."""
    size = found.height * found.layout.row_bytes(found.width)
    # By time and not by number: 16 buffers that held 10 ms of lines were overrun on a loaded host.
    wanted = math.ceil(spec.buffer_s * spec.line_rate_hz / found.height)
    return max(_LEAST_BUFFERS, min(wanted, _MOST_BUFFER_BYTES // size))


def read_settings(modules: Mapping[str, Features]) -> dict[str, Any]:
    """Return the current value of every readable number, entry, boolean and text of camera and stream."""
    facts: dict[str, Any] = {}
    # The camera's own features last: of a name that both have, its value is the one to be recorded.
    for module in ("stream", "remote"):
        for name in modules[module].names() if module in modules else ():
            node = modules[module].find(name)
            with suppress(CameraError):  # a defective feature must not make the camera unusable
                if node is not None and node.kind not in ("command", "other") and node.readable:
                    facts[name] = node.read()
    return facts


class MissedTriggers:
    """The camera's counter of missed line triggers, if a setting has configured one."""

    def __init__(self, modules: Mapping[str, Features]) -> None:
        source = modules["remote"].find("CounterEventSource")
        # Both are those of the counter that CounterSelector selects: no later setting may select another.
        counts = source is not None and source.readable and source.read() == "LineTriggerMissed"
        self._value = modules["remote"].find("CounterValue") if counts else None
        self._tally = Tally(self._read())

    def _read(self) -> int:
        return int(self._value.read()) if self._value is not None else 0

    def count(self) -> int:
        """Return the triggers missed since the counter was found."""
        return self._tally.note(self._read())


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One buffer from the driver.

    Its lines are in the first ``filled`` bytes of ``memory``, each followed by ``padding`` bytes; not more
    than ``rows``, if the library reports them (otherwise 0). ``buffer`` is the driver's handle. ``facts``
    have no frame ID if the frame is incomplete and its ID not reliable.
    """

    buffer: Any
    memory: NDArray[np.uint8]
    filled: int
    facts: FrameFacts
    complete: bool
    padding: int = 0
    rows: int = 0


class Assembly:
    """Makes blocks from the frames of one acquisition, counts them, and remembers whose buffers they use.

    ::

        take(frame) ──▶ ready ──▶ next_block() ──▶ lent ──▶ release(block)
             │                                                    │
             └───▶ buffers without lines: to be queued again ◀────┘

    A frame without a number waits until the next one with a number has come: see `acquire.camera.frames`.
    """

    def __init__(
        self, found: FrameFormat, spec: GenicamSpec, buffers: int, skips_zero: bool | None = None
    ) -> None:
        self._format = found
        self._count = FrameCount(found.height, spec.frame_id_bits, spec.frame_id_first, skips_zero)
        self._reader: LineReader | None = None
        self._most_waiting = max(1, buffers // _WAITING_SHARE)
        self._waiting: list[Frame] = []
        self._unnumbered = 0
        self._owed: tuple[CameraLoss, ...] = ()
        self._ready: deque[tuple[CameraBlock, Any]] = deque()
        self._lent: dict[CameraBlock, Any] = {}
        self._statistics = dict.fromkeys(STATISTICS, 0)

    def take(self, frame: Frame) -> list[Any]:
        """Take a filled frame, and return the buffers that are free again.

        Raises CameraError if the camera's frame IDs make no sense.
        """
        self._statistics["incomplete_frames"] += not frame.complete
        if frame.facts.frame_id is None:
            return self._wait(frame)
        # False once waiting frames were given up: the rest could not fill the whole hole.
        keep = len(self._waiting) == self._unnumbered
        place = self._count.place(frame.facts, self._unnumbered, keep=keep)
        if place is None:
            self._statistics["stale_frames"] += 1
            return [frame.buffer]
        # Only now: the size of a frame shows how its lines are packed, see `for_frames`.
        if self._reader is None:
            found = self._format
            self._reader = LineReader.for_frames(
                found.layout, found.width, frame.padding, found.height, frame.filled
            )
        # Frames that waited are directly before this one. Kept frames leave no hole, so that there are no
        # losses that `replace` would repeat with each.
        waiting, self._waiting, self._unnumbered = self._waiting, [], 0
        frames = [*waiting, frame] if place.kept else [frame]
        first = place.first_line - (len(frames) - 1) * self._format.height
        places = [replace(place, first_line=first + k * self._format.height) for k in range(len(frames))]
        free = [] if place.kept else [waited.buffer for waited in waiting]
        for each, its_place in zip(frames, places, strict=True):
            block = self._block(each, its_place)
            if block is None:
                free.append(each.buffer)
            else:
                self._ready.append((block, each.buffer))
        return free

    def _wait(self, frame: Frame) -> list[Any]:
        """Let the frame wait for a number; return the buffers that have to be given up for that."""
        self._unnumbered += 1
        self._waiting.append(frame)
        # Those that wait keep their buffers: if all did, no frame could come that would end their wait.
        if len(self._waiting) <= self._most_waiting:
            return []
        free, self._waiting = [waited.buffer for waited in self._waiting], []
        return free

    def _block(self, frame: Frame, place: FramePlace) -> CameraBlock | None:
        """Return the block of a frame; None if it has no line.

        Lines of an incomplete frame are flagged; those that it lacks are losses before the next block.
        """
        height, reader, filled = self._format.height, self._reader, frame.filled
        assert reader is not None
        # Of a part of a frame only whole lines; the pitch of joined lines is rounded up, so never too many.
        count = height if filled >= reader.size(height) else filled // reader.pitch
        count = min(count, frame.rows or count)
        losses = self._owed + place.losses
        # Losses are reported before a block, and these lines are after this one.
        self._owed = (CameraLoss(LossCause.INCOMPLETE, height - count),) if count < height else ()
        if not count:
            self._owed = losses + self._owed
            return None
        flag = LineFlag(0) if frame.complete and not place.doubtful else LineFlag.INCOMPLETE
        return CameraBlock(
            place.first_line,
            reader.lines(frame.memory, count),
            np.full(count, flag, np.uint16),
            losses,
            frame.facts.time_ns,
        )

    def next_block(self) -> CameraBlock | None:
        """Return the next block that has its place; its buffer is lent until `release`. None if none has."""
        if not self._ready:
            return None
        block, buffer = self._ready.popleft()
        self._lent[block] = buffer
        self._statistics["lines"] += len(block.flags)
        self._statistics["lost"] += sum(loss.count for loss in block.losses)
        return block

    def release(self, block: CameraBlock) -> Any:
        """Return the block's buffer, which is free again; None if it is not lent."""
        return self._lent.pop(block, None)

    def forget_buffers(self) -> None:
        """Drop all blocks at the end of the acquisition, which frees their memory."""
        self._ready.clear()
        self._lent.clear()
        self._waiting.clear()

    def statistics(self) -> dict[str, int]:
        return dict(self._statistics)
