"""The cases of a trade-off: recordings with a known scene, and procedural scenes with camera noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.errors import UsageError
from acquire.evaluate.tradeoff import TruthJudge

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from acquire.fibre import Tile
    from acquire.store import Recording

READ_NOISE_E = 10.0
"""Read noise of an ordinary camera, in electrons."""


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A scene or recording to measure. ``name`` includes its noise; ``judge`` makes repeat 0, 1, ….

    ``repeats`` states how the repeats differ.
    """

    name: str
    judge: Callable[[int], TruthJudge]
    repeats: str


def recording_case(
    name: str,
    recording: Recording,
    *,
    first_line: int,
    lines: int,
    apart: int,
    tile: Tile | None = None,
) -> Case:
    """Return a case of a recording: ``lines`` lines, with repeats ``apart`` lines apart while there are any.

    Behind a fibre the lines are those of ``tile``.
    """
    last = recording.first_line + recording.lines - lines

    def judge(repeat: int) -> TruthJudge:
        # where the recording ends, the last lines once more
        first = max(recording.first_line, min(first_line + apart * repeat, last))
        return TruthJudge.of(recording, recording.cut(first, lines, tile), tile)

    differences = "other lines if there are any, with other code bits and other noise"
    return Case(name if tile is None else f"{name}, tile {tile}", judge, differences)


def procedural(name: str, full_well_e: float, lines: int) -> Case:
    """Return a case of a procedural scene, 192 × 192 fine pixels; each repeat draws scene, code and noise."""
    from acquire.sim.procedural import CameraNoise, record

    noisy = math.isfinite(full_well_e)
    camera = CameraNoise(full_well_e, READ_NOISE_E if noisy else 0.0)

    def judge(repeat: int) -> TruthJudge:
        # a seed determines scene, code and noise
        recorded = record(name, repeat + 1, lines=lines, camera=camera)
        return TruthJudge(recorded.segment, None, recorded.light)

    noise = f"{full_well_e:.0f} electrons at the brightest" if noisy else "clean"
    return Case(f"{name}, {noise}", judge, "another draw of scene, code and noise")


def full_wells(words: Sequence[str]) -> list[float]:
    """Parse electrons in the brightest sample: numbers, or ``clean`` for infinity. Raises UsageError."""
    found = []
    for word in words:
        try:
            value = math.inf if word == "clean" else float(word)
        except ValueError:
            value = math.nan
        # Not `<=`, which would be false for NaN and accept it.
        if not value > 1:
            raise UsageError(
                f"the full well {word!r} cannot be read", possible="electrons, such as 1e4, or 'clean'"
            )
        found.append(value)
    return found
