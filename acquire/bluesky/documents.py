"""What a plan's documents say of a recording: where its lines are, and which of them can be read by now.

Index i of a StreamResource is row i of its arrays. A recording that continues in a further segment is a
further StreamResource for each arm, whose indices begin at 0 again.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from event_model import ComposeStreamResource, StreamRange

from acquire.lines import ARMS

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from bluesky.protocols import StreamAsset
    from event_model import ComposeStreamResourceBundle, DataKey

    from acquire.config import RigConfig

MIMETYPE = "application/x-zarr"


def key_of(name: str, arm: str) -> str:
    return f"{name}-{arm}"


def data_keys(name: str, rig: RigConfig) -> dict[str, DataKey]:
    """One key per arm; an event is one line."""
    return {
        key_of(name, arm): {
            "source": f"acquire://{quote(rig.name)}/{arm}/lines",
            "dtype": "array",
            "dtype_numpy": np.dtype(rig.cameras.arm(arm).dtype).str,
            "shape": [1, rig.pixels],
            "dims": ["line", "pixel"],
            "units": "DN",
            "external": "STREAM:",
        }
        for arm in ARMS
    }


@dataclass(slots=True)
class Segment:
    """One recording on disk: how many rows a reader can see in both arms, and how many documents cover."""

    path: Path
    first_line: int | None = None
    lines: int = 0
    told: int = 0
    bundles: list[ComposeStreamResourceBundle] = field(default_factory=list)


class Account:
    """The segments of one recording, in their order, and what has been told of each; ``budget`` in lines."""

    def __init__(self, name: str, rig: RigConfig, path: Path, budget: int | None) -> None:
        self._name, self._rig = name, rig
        self.budget = budget
        self.segments = [Segment(path)]

    @property
    def now(self) -> Segment:
        return self.segments[-1]

    @property
    def reach(self) -> int:
        """Lines from the first to the last, including those between two segments that neither has."""
        first, last = self.segments[0].first_line, self.now.first_line
        return self.now.lines + (0 if first is None or last is None else last - first)

    @property
    def untold(self) -> list[Segment]:
        return [segment for segment in self.segments if segment.told < segment.lines]

    @property
    def index(self) -> int:
        """Lines that documents can tell of after the next `tell`, which tells of one segment."""
        told = sum(segment.told for segment in self.segments)
        return told + sum(segment.lines - segment.told for segment in self.untold[:1])

    def tell(self, index: int) -> Iterator[StreamAsset]:
        """Documents for the lines up to ``index`` that none covers yet.

        They are of one segment, the first that has such lines: the RunEngine takes one range at a time.
        """
        for segment in self.untold[:1]:
            told = sum(one.told for one in self.segments)
            stop = min(segment.lines, segment.told + index - told)
            if stop <= segment.told:
                return
            if not segment.bundles:
                segment.bundles = [self._bundle(segment, arm) for arm in ARMS]
                for bundle in segment.bundles:
                    yield "stream_resource", bundle.stream_resource_doc
            for bundle in segment.bundles:
                yield "stream_datum", bundle.compose_stream_datum(StreamRange(start=segment.told, stop=stop))
            segment.told = stop

    def _bundle(self, segment: Segment, arm: str) -> ComposeStreamResourceBundle:
        parameters: dict[str, Any] = {
            "dataset": f"{arm}/lines",
            "chunk_shape": (self._rig.chunk_lines, self._rig.pixels),
        }
        uri = f"file://localhost{quote(str(segment.path))}"
        return ComposeStreamResource()(MIMETYPE, uri, key_of(self._name, arm), parameters)
