"""``acquire reconstruct --explain``: what the parts of a calibration give, and what they cost."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

from acquire.cli.output import print_json, print_table, print_warning, say
from acquire.cli.progress import stage_progress
from acquire.cli.reconstruct_request import parse_voxels
from acquire.errors import UsageError

if TYPE_CHECKING:
    from acquire.calibrate.choose import Chosen
    from acquire.cli.reconstruct_request import Asked
    from acquire.reconstruct.explain import Worth
    from acquire.store import Recording


def explain_calibration(
    recording: Recording, chosen: Chosen | None, asked: Asked, *, wanted: bool, json: bool
) -> bool:
    """Say what is doubtful about the calibration; and, where that is ``wanted``, try it part by part on lines
    in the middle of what is asked for, and print a table. Whether it was.
    """
    for doubt in () if chosen is None else chosen.doubts:
        print_warning(doubt)
    if wanted:
        _explain(recording, chosen, asked, json=json)
    return wanted


def _explain(recording: Recording, chosen: Chosen | None, asked: Asked, *, json: bool) -> None:
    from acquire.cores import idle_cores, limit_blas
    from acquire.reconstruct.explain import MOST_LINES, explain
    from acquire.reconstruct.liveliest import representative_tile

    if chosen is None:
        raise UsageError(
            f"{recording} carries no calibration to be explained",
            possible="--calibration NAME.zarr",
            hint="acquire calibrate, which makes one",
        )
    voxels = parse_voxels(asked.voxels[0])
    first = recording.first_available_line if asked.first_line is None else asked.first_line
    lines = recording.first_line + recording.lines - first if asked.lines is None else asked.lines
    count = min(lines, MOST_LINES)
    middle = (first + (lines - count) // 2, count)
    tile = representative_tile(recording, asked.tiles, middle, chosen.calibration)
    segment = recording.cut(*middle, tile)
    with (
        stage_progress("leaving out one part of the calibration after the other") as advance,
        limit_blas(idle_cores()),
    ):
        found = explain(segment, chosen.calibration, voxels.spatial_merge, voxels.temporal_merge, advance)
    if json:
        whose = {} if tile is None else {"tile": str(tile)}
        parts = [asdict(worth) for worth in found]
        print_json({"calibration": chosen.origin, **whose, "parts": parts})
        return
    which = f"{count} lines from line {segment.first_line} on" + ("" if tile is None else f" of tile {tile}")
    say(f"calibration: {chosen.origin}; {which}, voxels {voxels}")
    print_table(("corrected", "unseen samples missed by", "gives (dB)", "time"), map(_row, found))


def _row(worth: Worth) -> tuple[str, str, str, str]:
    if worth.gain_db is None or worth.time_factor is None:
        return worth.part, f"{worth.prediction:.2%}", "", f"{worth.seconds:.1f} s"
    name, missed = f"all but {worth.part}", f"{worth.prediction:.2%}"
    return name, missed, f"{worth.gain_db:+.1f}", f"x {worth.time_factor:.2f}"
