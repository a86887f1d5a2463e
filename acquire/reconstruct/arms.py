"""The arms' balance of a recording: what its lines say of it, beside what its calibration says."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from acquire.errors import AcquireError
from acquire.recon.balance import balance_of
from acquire.reconstruct.work import as_read

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.fibre import Tile
    from acquire.lines import Segment
    from acquire.recon.balance import Balance
    from acquire.reconstruct.work import Options
    from acquire.store import Recording

MOST_STRETCHES = 8
"""Of a long recording, spread over it: the ends of a stretch are what is not known, and these average out."""
PASSES = 4
"""Of light across the sensor, in each stretch."""


def balance_of_recording(
    recording: Recording, options: Options
) -> tuple[Balance | None, dict[str, Any] | None, tuple[str, ...]]:
    """What to divide arm B's light by, what was found as JSON, and what to say of it.

    A balance that the calibration holds is believed; lines that contradict it are told.
    """
    stretches = [as_read(each, options) for each in _stretches(recording)]
    found = balance_of(stretches)
    if found is None:
        return None, None, ()
    measured = any(each.balanced for each in stretches)
    if not found.clear:
        return None, found.facts(corrected=False), ()
    if not measured:
        return found, found.facts(corrected=True), (found.corrected_words,)
    drifted = (
        f"{found.words}, and with the calibration it should be as much: the calibration no longer holds; the "
        "video is made with it nevertheless (`acquire calibrate check` compares, `flat` measures anew)"
    )
    return None, found.facts(corrected=False), (drifted,)


def _stretches(recording: Recording) -> Iterator[Segment]:
    """Spread over the lines that are there; what cannot be cut is told to whoever asks for those lines."""
    first, end = recording.first_available_line, recording.first_line + recording.lines
    tiles: tuple[Tile | None, ...] = (None,) if recording.fibre is None else recording.fibre.tiles
    stages = recording.geometry_for(1).stages
    length = PASSES * stages
    count = min(MOST_STRETCHES, (end - first) // length)
    whole = [(first, end - first)] if count < MOST_STRETCHES else []
    step = (end - first) // max(count, 1)
    places = whole or [(first + index * step, length) for index in range(count)]
    for number in range(max(len(places), len(tiles))):  # behind a fibre every tile, wherever in time
        begin, lines = places[number % len(places)]
        try:
            yield recording.cut(begin, lines, tiles[number % len(tiles)])
        except AcquireError:
            continue
