"""A recording with a gap, and a video with frames that are not trusted, written by the real writers."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from acquire.cli import main
from acquire.clock import ClockFit
from acquire.codes import PrbsCode
from acquire.lines import ARMS, LineBlock, LineFlag
from acquire.store import RecordingSpec, RecordingWriter, RunCondition, write_video
from acquire.store.video_layout import VideoGrid
from acquire.store.video_writer import VideoWriter
from acquire.stream.tagger import Tagger
from acquire.trigger.base import TriggerRun

Cli = Callable[..., tuple[int, str, str]]
M, S, FIRST, LINES = 6, 2, 100, 90
LOST = range(130, 135)
TIME = 1_700_000_000_000_000_000
TRUSTED = range(3, 17)
INTERVAL_NS = 10_000


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Arm b lacks the lines `LOST`."""
    path = tmp_path_factory.mktemp("recordings") / "run.zarr"
    code, clock = PrbsCode(15, 77), ClockFit(90_000_000, TIME, 100)
    camera = {"white_dn": 4095, "black_level_dn": 1.0, "responsivity_dn": 2.0}
    spec = RecordingSpec(
        run_id="run-1", stages=M, substeps=S, pixels=M, dtype="uint16", first_line=FIRST, clock=clock,
        code=code.to_attrs(), substep_ticks=900, trigger={"model": "test"}, config={},
        cameras={"a": camera, "b": camera}, chunk_lines=16, codec="lz4",
    )  # fmt: skip
    tagger = Tagger(TriggerRun("run-1", code, S, 900, 1), M, clock)
    tagger.confirmed_end = FIRST + LINES
    generator = np.random.default_rng(5)
    with RecordingWriter.create(path, spec) as writer:
        for arm in ARMS:
            pixels = generator.integers(0, 4000, (LINES, M)).astype(np.uint16)
            flags = np.zeros(LINES, np.uint16)
            if arm == "b":
                pixels[LOST.start - FIRST : LOST.stop - FIRST] = 0
                flags[LOST.start - FIRST : LOST.stop - FIRST] = LineFlag.MISSING
                writer.add_gap(arm, LOST.start, len(LOST), "ring_full")
            writer.append(tagger.tag(arm, LineBlock(FIRST, pixels, flags)))
        writer.seal(RunCondition.INCOMPLETE, "stopped", {})
    return path


@pytest.fixture(scope="session")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video of 20 frames of 7 x 5 pixels, of which `TRUSTED` are trusted."""
    path = tmp_path_factory.mktemp("videos") / "video.zarr"
    frames = np.random.default_rng(6).random((20, 7, 5)).astype(np.float32)
    time_ns = TIME + INTERVAL_NS * np.arange(20, dtype=np.int64)
    provenance = {"recording": "run.zarr", "trusted": [TRUSTED.start, TRUSTED.stop]}
    write_video(path, frames, time_ns, pixel_size=2.5, frame_interval_ns=INTERVAL_NS, provenance=provenance)
    return path


@pytest.fixture(scope="session")
def told(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video of 20 frames of 9 x 5 pixels with an estimated error."""
    path, generator = tmp_path_factory.mktemp("told") / "told.zarr", np.random.default_rng(7)
    error = {"rms": 0.02, "low": 0.01, "high": 0.05, "full_scale": 0.5}
    with VideoWriter(
        path, (9, 5), np.dtype(np.float32), VideoGrid((1e-5, 2.5, 2.5)), quality=True, regions=(8, 8)
    ) as writer:
        writer.append(
            generator.random((20, 9, 5)).astype(np.float32),
            TIME + INTERVAL_NS * np.arange(20, dtype=np.int64),
            generator.random(20).astype(np.float32),
            generator.random((20, 8, 8)).astype(np.float32),
        )
        writer.finish({"trusted": [TRUSTED.start, TRUSTED.stop], "error": error})
    return path


@pytest.fixture
def cli(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Cli:
    monkeypatch.delenv("COLUMNS", raising=False)

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["acquire", *map(str, words)])
        code = main()
        said = capsys.readouterr()
        return code, said.out, said.err

    return run
