"""Writing of a reconstruction that is already in memory, with the same account as a stitched video's."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire import __version__
from acquire.plugins import DENOISERS, SOLVERS, of_others
from acquire.recon.error import regions_of
from acquire.reconstruct.facts import result_facts, why_not_trusted
from acquire.store import write_video

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.lines import Segment
    from acquire.recon import Reconstruction
    from acquire.store import Recording


def save_reconstruction(
    path: Path | str, result: Reconstruction, recording: Recording, segment: Segment, spatial_merge: int
) -> dict[str, Any]:
    """Write the whole video of a reconstruction as OME-Zarr and return the provenance written with it.

    ``path`` is a new path or URL. As in a video of `combine`, each frame has its residual and its estimated
    error beside it, and ``provenance.trusted`` holds the first fully sampled frame and the one after the
    last: none if the lines contradict their description (`Reconstruction.believed`), if the run was stopped,
    or if its budget ended it before it explained the lines. The frames around them are included because the
    lines depend on them, not because they can be trusted. The side of a voxel is given in pixels of the scene
    at full resolution, the only length that is known. Raises what `write_video` raises.
    """
    provenance = describe(result, recording, segment)
    interval_ns = segment.substep_ns * float(provenance["parameters"]["temporal_merge"])
    since_ns = (segment.first_line - recording.first_line) * recording.line_period_ns
    # The time counts from the read-out of the recording's first line, as in videos of `combine`.
    begin_s = (since_ns + float(result.time_ns[0] - segment.time_ns[0])) * 1e-9
    centre = (spatial_merge - 1) / 2
    write_video(
        path,
        result.video.astype(np.float32, copy=False),
        result.time_ns,
        pixel_size=float(spatial_merge),
        frame_interval_ns=interval_ns,
        provenance=provenance,
        pixel_unit=None,
        origin=(begin_s, centre, centre),
        quality=result.frame_error,
        error=regions_of(result.error, len(result.video)),
    )
    return provenance


def describe(result: Reconstruction, recording: Recording, segment: Segment) -> dict[str, Any]:
    """Return origin and quality of a video as JSON."""
    lines = segment.geometry.lines
    last = segment.first_line + lines - 1
    doubt = why_not_trusted(result, f"the video of lines {segment.first_line} to {last}")
    first, stop = result.trusted.start, result.trusted.stop
    return {
        **result_facts(result),
        "recording": str(recording),
        "run_id": recording.attrs["run_id"],
        "first_line": segment.first_line,
        "lines": lines,
        "solver": result.solver,
        "denoiser": result.denoiser,
        "state": "interrupted" if result.ended == "stopped" else "complete",
        "trusted": [first, stop if doubt is None else first],
        "warnings": [*([] if doubt is None else [doubt]), *result.warnings],
        "versions": {"acquire": __version__},
        "plugins": of_others([(SOLVERS, result.solver), (DENOISERS, result.denoiser or "")]),
    }
