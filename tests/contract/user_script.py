"""What somebody who types their own scripts strictly may write; checked by the command that checks ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import acquire
from acquire.reconstruct import reconstruct


def newest_mark(recording_path: str) -> int:
    recording = acquire.open_recording(recording_path)
    marks = [event.line for event in recording.events if event.kind == "mark"]
    return marks[-1] if marks else recording.first_line


def brightness(recording_path: str | Path, first_line: int, lines: int = 263) -> NDArray[Any]:
    recording = acquire.open_recording(recording_path)
    result = reconstruct(recording.cut(first_line, lines), spatial_merge=2, temporal_merge=3, budget_s=5.0)
    trusted: NDArray[Any] = result.video[result.trusted]
    return np.asarray(trusted.mean(axis=(1, 2)))


def misspelt() -> None:
    acquire.open_recordng("run.zarr")  # type: ignore[attr-defined]  # unused if a checker accepted any name


def take(name: str) -> str:
    with acquire.Client() as client:
        client.arm()
        began = client.start(name, post_s=1.0)
        return began.state.value


def misspelt_options(client: acquire.Client) -> None:
    client.arm(code="bright")  # type: ignore[arg-type]  # unused if any value were accepted
    client.start("run.zarr", duration=1.0)  # type: ignore[call-arg]  # unused if any keyword were accepted
    client.start("run.zarr", duration_s="1s")  # type: ignore[arg-type]
