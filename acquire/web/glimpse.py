"""``python -m acquire.web.glimpse SOCKET``: coarse videos of the latest lines, continuously, on one core.

It reads the rings as the live picture does, cuts the latest lines from them, and reconstructs a few large
voxels with the ordinary solver. Each glimpse is written to standard output as a message of
`acquire.web.frames`; the process ends when its standard input closes. Everything else takes precedence, so
that there are fewer glimpses on a busy host.
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
from acquire.cores import limit_threads
from acquire.errors import AcquireError
from acquire.fibre import Tile
from acquire.flags import NO_IMAGE
from acquire.lines import ARMS, Segment
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
"""Approximate number of voxels along each side."""
FRAMES = 8
"""Approximate number of frames that are sampled in full."""
PASSES = 2
"""Number of lines, in multiples of the stages: the scene is sampled in full during the second pass."""
ITERATIONS = 8
MOST_PER_S = 4.0
"""Upper limit on glimpses per second."""
LOOK_AGAIN_S = 0.5
"""Pause while there is no run, or too few lines of one."""
_NICE = 10
"""Other programs take precedence, and lose a tenth of a core if they are busy; at 19 there was no picture."""


@dataclass(frozen=True, slots=True)
class Sizes:
    """Number of lines of a glimpse, and the fine pixels and sub-steps per voxel."""

    lines: int
    spatial_merge: int
    temporal_merge: int

    @classmethod
    def of(cls, config: RigConfig) -> Sizes:
        stages, substeps = config.geometry.stages, config.geometry.substeps
        spatial = max(1, math.ceil(stages * substeps / SIDE))
        return cls(PASSES * stages, spatial, max(1, stages * substeps // FRAMES))


class Glimpses:
    """Makes glimpses of one armed run; behind a fibre, of the ``tile`` in the middle of the scene."""

    def __init__(self, config: RigConfig, rings: Rings) -> None:
        """Map the rings. Raises DeviceError if they cannot be mapped."""
        self._config = config
        self._sizes = Sizes.of(config)
        fibre, everything = config.laid_out, slice(None)
        self.tile = None if fibre is None else Tile(fibre.tile_rows // 2, fibre.tile_columns // 2)
        self._columns = (everything,) * 2 if fibre is None or self.tile is None else fibre.pixels(self.tile)
        self._code = config.code.build()
        self._peeks: dict[str, Peek] = {}
        with contextlib.ExitStack() as undo:  # closes the first if the second cannot be mapped
            for arm in ARMS:
                place = rings.arms[arm]
                self._peeks[arm] = undo.enter_context(
                    contextlib.closing(Peek(arm, place.path, shape_of(place)))
                )
            undo.pop_all()

    def segment(self) -> Segment | None:
        """Return the latest lines of both arms; None if they are not complete."""
        lines, config = self._sizes.lines, self._config
        first_line = min(peek.newest_line for peek in self._peeks.values()) - lines
        ranges = [peek.stretch(first_line, lines) for peek in self._peeks.values()]
        # A range is None as well if it was overwritten while it was copied.
        if first_line < 0 or any(each is None for each in ranges):
            return None
        pairs = zip(ranges, self._columns, strict=True)
        samples = np.stack([each[0][:, columns] for each, columns in pairs if each is not None])
        flags = np.stack([each[1] for each in ranges if each is not None])
        # A saturated sample tells only that there was at least so much light.
        usable: NDArray[np.bool_] = samples < config.cameras.a.white_dn
        usable[(flags & NO_IMAGE) != 0] = False
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
        """Solve a segment in a fixed number of iterations, without checks and error estimate."""
        sizes = self._sizes
        return reconstruct(
            segment,
            sizes.spatial_merge,
            sizes.temporal_merge,
            "fast",
            iterations=ITERATIONS,
            bandwidth=1.0,
            check=False,  # testing whether other settings explain the lines better takes ten times as long
            error=False,  # its estimate, which is not shown, takes more iterations than the video
        )

    def close(self) -> None:
        for peek in self._peeks.values():
            peek.close()


def glimpse_message(
    result: Reconstruction, taken_s: float, seconds: float, tile: Tile | None = None
) -> bytes:
    """Return a message with the trusted frames, scaled to 8 bits."""
    video = result.video[result.trusted]
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
    """Yield messages until ``is_over``; b"" if there are no lines to show now."""
    # By way of JSON, since the models are strict: a list is no tuple to them, but in JSON it is.
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
                result = run.reconstruct(segment)
                seconds = time.monotonic() - begun_s
                yield glimpse_message(result, begun_s, seconds, run.tile)
                time.sleep(max(0.0, 1 / MOST_PER_S - seconds))


def main() -> None:
    """Write glimpses to standard output until standard input is closed, or its owner has ended."""
    os.nice(_NICE)
    over = threading.Event()

    def end_with_owner() -> None:
        sys.stdin.read()  # returns when the owner closes it, or ends
        over.set()

    threading.Thread(target=end_with_owner, daemon=True).start()
    out = sys.stdout.buffer
    with limit_threads(1):
        while not over.is_set():
            try:
                for glimpse in glimpses(Client(Path(sys.argv[1])), over.is_set):
                    if glimpse:
                        out.write(glimpse)
                        out.flush()
                    else:
                        over.wait(LOOK_AGAIN_S)
            except AcquireError:  # the run or the daemon has ended; either may come back
                over.wait(LOOK_AGAIN_S)
            except BrokenPipeError:
                return


if __name__ == "__main__":
    main()
