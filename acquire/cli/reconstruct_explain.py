"""``acquire reconstruct --explain``: the gain and the cost of each part of a calibration."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from acquire.cli.output import print_table, say
from acquire.cli.progress import stage_progress
from acquire.cli.reconstruct_request import requested_lines
from acquire.errors import UsageError
from acquire.text import counted

if TYPE_CHECKING:
    from acquire.calibrate.choose import Chosen
    from acquire.cli.reconstruct_request import Arguments
    from acquire.store import Recording


def explain_calibration(
    recording: Recording, chosen: Chosen | None, arguments: Arguments, *, json: bool
) -> dict[str, Any]:
    """Leave out the parts of the calibration in turn; return the effects, and print a table unless ``json``.

    The parts are tried on lines in the middle of the selected range.
    """
    from acquire.reconstruct.explain import TRIAL_LINES, explain
    from acquire.reconstruct.liveliest import representative_tile
    from acquire.reconstruct.select import by_lines

    if chosen is None:
        raise UsageError(
            f"{recording} holds no calibration to explain",
            possible="--calibration NAME.zarr",
            hint="acquire calibrate, to make one",
        )
    voxels = arguments.kinds[0]
    first, lines = requested_lines(recording, arguments)
    stream = by_lines(recording, recording.first_available_line if first is None else first, lines).stream
    count = min(stream.end_line - stream.first_line, TRIAL_LINES)
    middle = ((stream.first_line + stream.end_line - count) // 2, count)
    tile = representative_tile(recording, arguments.tiles, middle, chosen.calibration)
    segment = recording.cut(*middle, tile)
    with stage_progress("leaving out the parts of the calibration in turn") as advance:
        found = explain(segment, chosen.calibration, voxels.spatial_merge, voxels.temporal_merge, advance)
    tile_facts = {} if tile is None else {"tile": str(tile)}
    facts = {"calibration": chosen.origin, **tile_facts, "parts": [asdict(worth) for worth in found]}
    # Returned and not printed: with a video, both are in one document.
    if json:
        return facts
    of = "" if tile is None else f" of tile {tile}"
    which = f"{counted(count, 'line')} from line {segment.first_line}{of}"
    say(f"calibration: {chosen.origin}; {which}, voxels {voxels}")
    rows = []
    for worth in found:
        error = f"{worth.prediction:.2%}"
        if worth.gain_db is None or worth.time_factor is None:  # with all parts, or without any
            rows.append((worth.part, error, "", f"{worth.seconds:.1f} s"))
        else:
            gain, factor = f"{worth.gain_db:+.1f}", f"x {worth.time_factor:.2f}"
            rows.append((f"all but {worth.part}", error, gain, factor))
    print_table(("corrected", "held-out error", "gain (dB)", "time"), rows)
    return facts
