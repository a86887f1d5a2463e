"""The documents of a recording: where its lines are, and which of them can be read so far.

Index i of a StreamResource is row i of its arrays. A recording that continues in another segment has another
StreamResource for each arm, whose indices start at 0 again.
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
    """Return the key of an arm in documents: ``NAME-a`` or ``NAME-b``."""
    return f"{name}-{arm}"


def data_keys(name: str, rig: RigConfig) -> dict[str, DataKey]:
    """Return one key per arm; an event is one line."""
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
class RecordedRows:
    """One recording on disk: rows that are readable in both arms, and rows that documents cover."""

    path: Path
    first_line: int | None = None
    lines: int = 0
    covered: int = 0
    bundles: list[ComposeStreamResourceBundle] = field(default_factory=list)


class Account:
    """The segments of one recording, in order, and the lines of each that documents cover.

    ``budget`` is in lines.
    """

    def __init__(self, name: str, rig: RigConfig, path: Path, budget: int | None) -> None:
        self._name, self._rig = name, rig
        self.budget = budget
        self.segments = [RecordedRows(path)]

    @property
    def now(self) -> RecordedRows:
        """The segment that is being recorded, or was recorded last."""
        return self.segments[-1]

    @property
    def reach(self) -> int:
        """Lines from the first to the last, including those missing between two segments."""
        first, last = self.segments[0].first_line, self.now.first_line
        return self.now.lines + (0 if first is None or last is None else last - first)

    @property
    def uncovered(self) -> list[RecordedRows]:
        """Segments with lines that no document covers yet."""
        return [segment for segment in self.segments if segment.covered < segment.lines]

    @property
    def index(self) -> int:
        """Lines that documents can cover after the next `documents`, which is about one segment."""
        covered = sum(segment.covered for segment in self.segments)
        return covered + sum(segment.lines - segment.covered for segment in self.uncovered[:1])

    def documents(self, index: int) -> Iterator[StreamAsset]:
        """Yield documents for the lines up to ``index`` that none covers yet.

        They are about one segment, the first with such lines, because the RunEngine takes one range at a
        time.
        """
        for segment in self.uncovered[:1]:
            covered = sum(each.covered for each in self.segments)
            stop = min(segment.lines, segment.covered + index - covered)
            if stop <= segment.covered:
                return
            if not segment.bundles:
                uri = f"file://localhost{quote(str(segment.path))}"
                for arm in ARMS:
                    parameters: dict[str, Any] = {
                        "dataset": f"{arm}/lines",
                        "chunk_shape": (self._rig.chunk_lines, self._rig.pixels),
                    }
                    bundle = ComposeStreamResource()(MIMETYPE, uri, key_of(self._name, arm), parameters)
                    segment.bundles.append(bundle)
                for bundle in segment.bundles:
                    yield "stream_resource", bundle.stream_resource_doc
            covered_range = StreamRange(start=segment.covered, stop=stop)
            for bundle in segment.bundles:
                yield "stream_datum", bundle.compose_stream_datum(covered_range)
            segment.covered = stop
