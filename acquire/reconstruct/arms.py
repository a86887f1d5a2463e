"""The arms' balance of a recording, estimated from its lines and compared with its calibration."""

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

MOST_SAMPLES = 8
"""Ranges of a long recording that are evaluated: their ends are unknown, which averages out over several."""
PASSES = 4
"""Passes of the scene across the sensor in each of these ranges."""


def balance_of_recording(
    recording: Recording, options: Options
) -> tuple[Balance | None, dict[str, Any] | None, tuple[str, ...]]:
    """Return the balance to divide arm B's light by, the estimate as JSON, and warnings.

    A balance in the calibration takes precedence; a warning is given if the lines contradict it.
    """
    # They are taken as they will be solved: with what a calibration and a turn of the arms leave of a
    # difference.
    segments = [as_read(each, options) for each in _sample_segments(recording)]
    found = balance_of(segments)
    if found is None:
        return None, None, ()
    # A calibration marks the lines that it has balanced.
    measured = any(each.balanced for each in segments)
    if not found.clear:
        return None, found.facts(corrected=False), ()
    if not measured:
        return found, found.facts(corrected=True), (found.corrected_words,)
    drifted = (
        f"{found.words}, although the calibration should have made them equal: it no longer holds, and the "
        "video uses it nevertheless (`acquire calibrate check` compares, `flat` measures again)"
    )
    return None, found.facts(corrected=False), (drifted,)


def _sample_segments(recording: Recording) -> Iterator[Segment]:
    """Cut ranges spread over the available lines, and behind a fibre over its tiles.

    Ranges that cannot be cut are skipped: reading their lines raises the error.
    """
    first, end = recording.first_available_line, recording.first_line + recording.lines
    tiles: tuple[Tile | None, ...] = (None,) if recording.fibre is None else recording.fibre.tiles
    length = PASSES * recording.geometry_for(1).stages
    count = (end - first) // length
    if count < MOST_SAMPLES:
        ranges = [(first, end - first)]
    else:
        step = (end - first) // MOST_SAMPLES
        ranges = [(first + index * step, length) for index in range(MOST_SAMPLES)]
    for number in range(max(len(ranges), len(tiles))):  # every tile has its turn, at whatever time
        begin, lines = ranges[number % len(ranges)]
        try:
            yield recording.cut(begin, lines, tiles[number % len(tiles)])
        except AcquireError:
            continue
