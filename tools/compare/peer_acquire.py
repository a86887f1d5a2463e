"""Ours: the recording's writer, with tags, flags, index and commits, crc32c of everything."""

import sys
import time
from pathlib import Path

import numpy as np
from stream import LINES, PIXELS, measure

from acquire.capacity.load import Load, recording_spec, trigger_run
from acquire.clock import ClockFit
from acquire.lines import LineBlock
from acquire.store import RecordingWriter, RunCondition
from acquire.stream.tagger import Tagger

COMMIT_S = 0.1


class Ours:
    def __init__(self, directory: Path) -> None:
        load, clock = Load(PIXELS, "uint8", 100_000.0, chunk_lines=LINES), ClockFit(90_000_000, 0, 0)
        self._tagger = Tagger(trigger_run(load), load.stages, clock)
        self._writer = RecordingWriter.create(directory / "r.zarr", recording_spec(load, clock))
        self._flags = np.zeros(LINES, np.uint16)
        self._due_s = 0.0

    def append(self, arm: str, block: np.ndarray) -> None:
        line = LineBlock(self._writer.next_line(arm), block, self._flags)
        self._writer.give_back(arm)  # as the recorder does in a hurry: the arms take turns
        self._writer.append(self._tagger.tag(arm, line), lent=True)
        if time.monotonic() > self._due_s:
            self._writer.commit()
            self._due_s = time.monotonic() + COMMIT_S

    def close(self) -> None:
        self._writer.seal(RunCondition.GOOD, "done", {})


measure(Ours(Path(sys.argv[1])), Path(sys.argv[1]), int(sys.argv[2]))
