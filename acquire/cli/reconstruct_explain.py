"""``acquire reconstruct --explain``: the gain and the cost of each part of a calibration."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

from acquire.cli.output import print_json, print_table, print_warning, say
from acquire.cli.progress import stage_progress
from acquire.cli.reconstruct_request import parse_voxels
from acquire.errors import UsageError

if TYPE_CHECKING:
    from acquire.calibrate.choose import Chosen
    from acquire.cli.reconstruct_request import Arguments
    from acquire.store import Recording


def explain_calibration(
    recording: Recording, chosen: Chosen | None, arguments: Arguments, *, wanted: bool, json: bool
) -> None:
    """Warn about doubts in the calibration. If ``wanted``, also leave out its parts in turn and print a
    table.

    The parts are tried on lines in the middle of the selected range.
    """
    from acquire.cores import idle_cores, limit_blas
    from acquire.reconstruct.explain import MOST_LINES, explain
    from acquire.reconstruct.liveliest import representative_tile

    for doubt in () if chosen is None else chosen.doubts:
        print_warning(doubt)
    if not wanted:
        return
    if chosen is None:
        raise UsageError(
            f"{recording} carries no calibration to be explained",
            possible="--calibration NAME.zarr",
            hint="acquire calibrate, to make one",
        )
    voxels = parse_voxels(arguments.voxels[0])
    first = recording.first_available_line if arguments.first_line is None else arguments.first_line
    lines = recording.first_line + recording.lines - first if arguments.lines is None else arguments.lines
    count = min(lines, MOST_LINES)
    middle = (first + (lines - count) // 2, count)
    tile = representative_tile(recording, arguments.tiles, middle, chosen.calibration)
    segment = recording.cut(*middle, tile)
    with (
        stage_progress("leaving out the parts of the calibration in turn") as advance,
        limit_blas(idle_cores()),
    ):
        found = explain(segment, chosen.calibration, voxels.spatial_merge, voxels.temporal_merge, advance)
    if json:
        tile_facts = {} if tile is None else {"tile": str(tile)}
        parts = [asdict(worth) for worth in found]
        print_json({"calibration": chosen.origin, **tile_facts, "parts": parts})
        return
    which = f"{count} lines from line {segment.first_line}" + ("" if tile is None else f" of tile {tile}")
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
