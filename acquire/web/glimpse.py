"""``python -m acquire.web.glimpse SOCKET``: the latest lines as a coarse video, again and again, on one core.

It looks at the rings as the live picture does, cuts what has just passed out of them, and solves for few
large voxels with the solver that every reconstruction has. Each glimpse goes to standard output as a message
of `acquire.web.frames`; the process ends when its standard input does. It stands back for everything else:
where the host is busy, glimpses are fewer.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acquire.client import Client
from acquire.config import RigConfig
from acquire.cores import limit_blas
from acquire.errors import AcquireError
from acquire.fibre import Tile
from acquire.lines import ARMS, LineFlag, Segment
from acquire.recon import reconstruct
from acquire.stream.peek import Peek
from acquire.web.frames import message
from acquire.web.places import shape_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from acquire.daemon.facts import Rings
    from acquire.recon import Reconstruction

SIDE = 24
"""Voxels across, about."""
FRAMES = 8
"""That are sampled in full, about."""
PASSES = 2
"""Lines, in passes over the sensor: of the second all is sampled in full."""
ITERATIONS = 8
MOST_PER_S = 4.0
LOOK_AGAIN_S = 0.5
_NICE = 10
"""Other programs go before it, and lose a tenth of a core where they are busy; at 19 there was no picture."""


@dataclass(frozen=True, slots=True)
class Sizes:
    """Of a glimpse: lines that it is made of, and fine pixels and sub-steps per voxel."""

    lines: int
    spatial_merge: int
    temporal_merge: int

    @classmethod
    def of(cls, config: RigConfig) -> Sizes:
        stages, substeps = config.geometry.stages, config.geometry.substeps
        spatial = max(1, math.ceil(stages * substeps / SIDE))
        return cls(PASSES * stages, spatial, max(1, stages * substeps // FRAMES))


class Glimpses:
    """Of one armed run; behind a fibre, of the ``tile`` in the middle of the scene."""

    def __init__(self, config: RigConfig, rings: Rings) -> None:
        """Raises DeviceError where the rings cannot be had."""
        self._config = config
        self._sizes = Sizes.of(config)
        fibre, everything = config.laid_out, slice(None)
        self.tile = None if fibre is None else Tile(fibre.tile_rows // 2, fibre.tile_columns // 2)
        self._columns = (everything,) * 2 if fibre is None or self.tile is None else fibre.pixels(self.tile)
        self._code = config.code.build()
        self._peeks: dict[str, Peek] = {}
        with contextlib.ExitStack() as undo:
            for arm in ARMS:
                place = rings.arms[arm]
                self._peeks[arm] = undo.enter_context(
                    contextlib.closing(Peek(arm, place.path, shape_of(place)))
                )
            undo.pop_all()

    def segment(self) -> Segment | None:
        """What has just passed, of both arms; None where that is not whole."""
        lines, config = self._sizes.lines, self._config
        first_line = min(peek.newest_line for peek in self._peeks.values()) - lines
        found = [peek.stretch(first_line, lines) for peek in self._peeks.values()]
        if first_line < 0 or any(one is None for one in found):
            return None
        seen = zip(found, self._columns, strict=True)
        samples = np.stack([one[0][:, columns] for one, columns in seen if one is not None])
        flags = np.stack([one[1] for one in found if one is not None])
        usable: NDArray[np.bool_] = samples < config.cameras.a.white_dn
        usable[(flags & (LineFlag.MISSING | LineFlag.INCOMPLETE)) != 0] = False
        geometry = config.geometry.segment(lines)
        substeps = config.geometry.substeps
        period_ns = 1e9 / config.line_rate_hz
        return Segment(
            lines=samples,
            mask=usable,
            code=self._code.bits(substeps * first_line, geometry.span),
            geometry=geometry,
            time_ns=np.arange(lines, dtype=np.int64) * round(period_ns),
            first_line=first_line,
            substep_ns=period_ns / substeps,
            black_level_dn=(config.cameras.a.black_level_dn, config.cameras.b.black_level_dn),
            responsivity_dn=(config.cameras.a.responsivity_dn, config.cameras.b.responsivity_dn),
        )

    def reconstruct(self, segment: Segment) -> Reconstruction:
        sizes = self._sizes
        return reconstruct(
            segment,
            sizes.spatial_merge,
            sizes.temporal_merge,
            "fast",
            iterations=ITERATIONS,
            bandwidth=1.0,
            check=False,  # asking what explains the lines better takes ten times as long as the glimpse
        )

    def close(self) -> None:
        for peek in self._peeks.values():
            peek.close()


def glimpse_message(found: Reconstruction, taken_s: float, seconds: float, tile: Tile | None = None) -> bytes:
    """The frames that were sampled in full, 8 bits over their own range."""
    video = found.video[found.trusted]
    low, high = (float(video.min()), float(video.max())) if video.size else (0.0, 1.0)
    scaled = ((video - low) * (255 / max(high - low, 1e-12))).astype(np.uint8)
    header = {
        "type": "glimpse",
        "frames": video.shape[0],
        "rows": video.shape[1],
        "columns": video.shape[2],
        "seconds": round(seconds, 3),
        "age_s": round(time.monotonic() - taken_s, 3),
        "tile": None if tile is None else str(tile),
    }
    return message(header, scaled.tobytes())


def glimpses(client: Client, is_over: Callable[[], bool]) -> Iterator[bytes]:
    """Messages, as long as it is not over; b"" where there is nothing to be seen now."""
    config = RigConfig.model_validate_json(json.dumps(client.setup().config))
    while not is_over():
        rings = client.rings()
        if rings.run_id is None or not rings.arms:
            yield b""
            continue
        with contextlib.closing(Glimpses(config, rings)) as run:
            while not is_over() and client.status().run_id == rings.run_id:
                begun_s = time.monotonic()
                segment = run.segment()
                if segment is None:
                    yield b""
                    continue
                found = run.reconstruct(segment)
                seconds = time.monotonic() - begun_s
                yield glimpse_message(found, begun_s, seconds, run.tile)
                time.sleep(max(0.0, 1 / MOST_PER_S - seconds))


def main() -> None:
    os.nice(_NICE)
    limit_blas(1)
    over = threading.Event()
    threading.Thread(target=_end_with_owner, args=(over,), daemon=True).start()
    out = sys.stdout.buffer
    while not over.is_set():
        try:
            for told in glimpses(Client(Path(sys.argv[1])), over.is_set):
                if told:
                    out.write(told)
                    out.flush()
                else:
                    over.wait(LOOK_AGAIN_S)
        except AcquireError:  # the run has ended, or the daemon: both may come back
            over.wait(LOOK_AGAIN_S)
        except BrokenPipeError:
            return


def _end_with_owner(over: threading.Event) -> None:
    sys.stdin.read()
    over.set()


if __name__ == "__main__":
    main()
