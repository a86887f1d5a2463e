"""What every GenICam camera has in common, whichever library moves its buffers: from features and delivered
frames to blocks of lines.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.camera.base import CameraBlock, CameraLoss, LossCause
from acquire.camera.frames import FrameCount
from acquire.camera.pixels import LineReader, PixelLayout, layout_of
from acquire.errors import CameraError
from acquire.lines import LineFlag

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from acquire.camera.frames import FrameFacts
    from acquire.camera.settings import Features, Node
    from acquire.camera.spec import GenicamSpec

STATISTICS = ("lines", "lost", "incomplete_frames")
_LEAST_BUFFERS = 16
_MOST_BUFFER_BYTES = 1 << 30


@dataclass(frozen=True, slots=True)
class FrameFormat:
    """Pixels per line, lines per frame, and how pixels lie in a buffer."""

    width: int
    height: int
    layout: PixelLayout


def frame_format(modules: Mapping[str, Features]) -> FrameFormat:
    """As the camera is set now; of a grabber's stream the height is what counts."""
    height = modules["stream"].find("BufferHeight") if "stream" in modules else None
    return FrameFormat(
        width=int(demand(modules, "Width").read()),
        height=max(1, int((height or demand(modules, "Height")).read())),
        layout=layout_of(str(demand(modules, "PixelFormat").read())),
    )


def demand(modules: Mapping[str, Features], name: str) -> Node:
    """A feature of the camera itself. Raises CameraError when it has none of that name."""
    node = modules["remote"].find(name)
    if node is None:
        raise CameraError(f"the camera has no feature {name}", hint="acquire camera features")
    return node


def check_format(found: FrameFormat, spec: GenicamSpec) -> None:
    """Raise CameraError unless the lines are what the rig expects."""
    if spec.pixels and found.width != spec.pixels:
        raise CameraError(
            f"camera {spec.serial}: lines of {found.width} pixels",
            possible=f"{spec.pixels}, as the rig's geometry has stages",
            hint=f'the setting ["remote", "Width", {spec.pixels}]',
        )
    if spec.bits and found.layout.bits != spec.bits:
        raise CameraError(
            f"camera {spec.serial}: pixel format {found.layout.name} of {found.layout.bits} bits",
            possible=f"{spec.bits} bits, as the rig's pixel_format",
            hint=f'the setting ["remote", "PixelFormat", "Mono{spec.bits}"]',
        )


def buffer_count(spec: GenicamSpec, found: FrameFormat) -> int:
    """Buffers for ``buffer_s`` of lines, within reason."""
    size = found.height * found.layout.row_bytes(found.width)
    wanted = math.ceil(spec.buffer_s * spec.line_rate_hz / found.height)
    return max(_LEAST_BUFFERS, min(wanted, _MOST_BUFFER_BYTES // size))


def read_settings(modules: Mapping[str, Features]) -> dict[str, Any]:
    """Every readable number, entry, boolean and text of the camera and its stream, as it is now."""
    facts: dict[str, Any] = {}
    for module in ("stream", "remote"):
        for name in modules[module].names() if module in modules else ():
            node = modules[module].find(name)
            with suppress(CameraError):  # a feature that its maker got wrong is not worth the camera
                if node is not None and node.kind not in ("command", "other") and node.readable:
                    facts[name] = node.read()
    return facts


class MissedTriggers:
    """The camera's counter of line triggers that it missed, where a setting has made one of it."""

    def __init__(self, modules: Mapping[str, Features]) -> None:
        source = modules["remote"].find("CounterEventSource")
        counts = source is not None and source.readable and source.read() == "LineTriggerMissed"
        self._value = modules["remote"].find("CounterValue") if counts else None
        self._before = 0
        self._before = self.count()

    def count(self) -> int:
        """Missed since the counter was found."""
        return int(self._value.read()) - self._before if self._value is not None else 0


class Assembly:
    """Makes blocks of the frames of one acquisition, and counts."""

    def __init__(self, found: FrameFormat, spec: GenicamSpec) -> None:
        self._format = found
        self._count = FrameCount(found.height, spec.frame_id_bits, spec.frame_id_first)
        self._reader: LineReader | None = None
        self._owed: tuple[CameraLoss, ...] = ()
        self._statistics = dict.fromkeys(STATISTICS, 0)

    def block(
        self,
        memory: NDArray[np.uint8],
        filled: int,
        padding: int,
        facts: FrameFacts,
        *,
        complete: bool,
        rows: int = 0,
    ) -> CameraBlock:
        """The lines in the first ``filled`` bytes of ``memory``, each followed by ``padding`` bytes; not more
        than ``rows``, where the library tells them.

        Lines of a frame that is not ``complete`` are flagged; those that it lacks are losses before the
        next block.
        """
        found = self._format
        if self._reader is None:
            self._reader = LineReader.for_frames(found.layout, found.width, padding, found.height, filled)
        place = self._count.place(facts)
        count = found.height if filled >= self._reader.size(found.height) else filled // self._reader.pitch
        count = min(count, rows or count)
        flag = LineFlag(0) if complete and not place.doubtful else LineFlag.INCOMPLETE
        losses = self._owed + place.losses
        short = found.height - count
        self._owed = (CameraLoss(LossCause.INCOMPLETE, short),) if short else ()
        self._statistics["lines"] += count
        self._statistics["lost"] += sum(loss.count for loss in losses)
        self._statistics["incomplete_frames"] += not complete
        return CameraBlock(
            place.first_line,
            self._reader.lines(memory, count),
            np.full(count, flag, np.uint16),
            losses,
            facts.time_ns,
        )

    def statistics(self) -> dict[str, int]:
        return dict(self._statistics)
