"""From a recording on disk to a video on disk, whatever its length.

::

    select    lines, times or a plan ──▶ VideoRequest: ranges on one grid
    combine   VideoRequest ──▶ sub-segments ──▶ pool ──▶ stitched in order ──▶ video
    pools     where sub-segments are solved: in this process, in others, on a cluster
    work      one sub-segment: cut, solve, resample to the grid
    facts     what is recorded of its result, and whether it is trusted
    sheet     its frames in the video: in a row, or behind a fibre tile by tile
    single    a reconstruction that is already in memory, made by `acquire.recon.reconstruct`

    before    propose (voxels by the tempo), budget and learned (time), explain and arms (calibration),
              diagnose and reorient (description), liveliest (the tile to try them on)
    together  sharing: one choice of prior for all tiles or sub-segments

The sub-segments in work bound the memory: the recording is read and the video written piece by piece.
"""

from acquire.recon import reconstruct
from acquire.reconstruct.combine import Monitor, Outcome, combine
from acquire.reconstruct.pools import Pool, open_pool
from acquire.reconstruct.select import (
    VideoRequest,
    along_plan,
    by_lines,
    by_time,
    in_glimpses,
    in_tiles,
    in_voxels,
)
from acquire.reconstruct.single import describe, save_reconstruction
from acquire.reconstruct.work import Options

__all__ = [
    "Monitor",
    "Options",
    "Outcome",
    "Pool",
    "VideoRequest",
    "along_plan",
    "by_lines",
    "by_time",
    "combine",
    "describe",
    "in_glimpses",
    "in_tiles",
    "in_voxels",
    "open_pool",
    "reconstruct",
    "save_reconstruction",
]
