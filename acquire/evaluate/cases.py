"""What trade-offs are measured on: recordings with a known scene, procedural scenes with a camera's noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquire.errors import UsageError
from acquire.evaluate.tradeoff import Judge

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from acquire.fibre import Tile
    from acquire.store import Recording

READ_NOISE_E = 10.0
"""Electrons of an ordinary camera's read noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """``name`` says what is measured on, and with which noise; ``judge`` makes it for a repeat from 0 on.

    ``repeats`` says in what these differ.
    """

    name: str
    judge: Callable[[int], Judge]
    repeats: str


def of_recording(
    name: str, recording: Recording, first_line: int, lines: int, apart: int, tile: Tile | None = None
) -> Case:
    """Segments of ``lines`` lines, ``apart`` lines from one repeat to the next as far as there are any.

    Behind a fibre they are of a ``tile``.
    """
    last = recording.first_line + recording.lines - lines

    def judge(repeat: int) -> Judge:
        first = max(recording.first_line, min(first_line + apart * repeat, last))
        return Judge.of(recording, recording.cut(first, lines, tile), tile)

    words = "other lines, as far as there are any: another stretch of code, and other noise"
    return Case(name if tile is None else f"{name}, tile {tile}", judge, words)


def procedural(name: str, full_well_e: float, lines: int) -> Case:
    """A procedural scene of 192 × 192 fine pixels; every repeat draws scene, code and noise anew."""
    from acquire.sim.procedural import Camera, record

    noisy = math.isfinite(full_well_e)
    camera = Camera(full_well_e, READ_NOISE_E if noisy else 0.0)

    def judge(repeat: int) -> Judge:
        recorded = record(name, repeat + 1, lines=lines, camera=camera)
        return Judge(recorded.segment, None, recorded.light)

    noise = f"{full_well_e:.0f} electrons at the brightest" if noisy else "clean"
    return Case(f"{name}, {noise}", judge, "another draw of scene, code and noise")


def full_wells(words: Sequence[str]) -> list[float]:
    """Electrons at the brightest sample, from numbers and the word ``clean``; UsageError for others."""
    found = []
    for word in words:
        try:
            value = math.inf if word == "clean" else float(word)
        except ValueError:
            value = math.nan
        if not value > 1:
            raise UsageError(f"full well {word!r} cannot be read", possible="electrons, as 1e4, or clean")
        found.append(value)
    return found
