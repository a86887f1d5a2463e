"""Writing of a reconstruction that is already in memory, with its provenance."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from acquire import __version__
from acquire.plugins import DENOISERS, SOLVERS, of_others
from acquire.recon.error import error_facts
from acquire.store import write_video

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.lines import Segment
    from acquire.recon import Reconstruction
    from acquire.store import Recording


def save_reconstruction(
    path: Path, result: Reconstruction, recording: Recording, segment: Segment, spatial_merge: int
) -> dict[str, Any]:
    """Write the whole video of a reconstruction as OME-Zarr and return the provenance written with it.

    ``provenance.trusted`` holds the first fully sampled frame and the one after the last; it is empty if the
    lines contradict their description (`Reconstruction.believed`). The frames around them are included
    because the lines depend on them, not because they can be trusted. The side of a voxel is given in pixels
    of the scene at full resolution, the only length that is known. Raises what `write_video` raises.
    """
    provenance = describe(result, recording, segment)
    interval_ns = segment.substep_ns * float(provenance["parameters"]["temporal_merge"])
    since_ns = (segment.first_line - recording.first_line) * recording.line_period_ns
    # The time counts from the read-out of the recording's first line, as in videos of `combine`.
    begin_s = (since_ns + float(result.time_ns[0] - segment.time_ns[0])) * 1e-9
    centre = (spatial_merge - 1) / 2
    write_video(
        path,
        result.video,
        result.time_ns,
        pixel_size=float(spatial_merge),
        frame_interval_ns=interval_ns,
        provenance=provenance,
        pixel_unit=None,
        origin=(begin_s, centre, centre),
    )
    return provenance


def describe(result: Reconstruction, recording: Recording, segment: Segment) -> dict[str, Any]:
    """Return origin and quality of a video as JSON."""
    # As in stitched videos, since the interval follows from the geometry alone.
    trusted = result.trusted if result.believed else slice(result.trusted.start, result.trusted.start)
    quality = {key: value if math.isfinite(value) else None for key, value in asdict(result.quality).items()}
    return {
        "recording": str(recording),
        "run_id": recording.attrs["run_id"],
        "first_line": segment.first_line,
        "lines": segment.geometry.lines,
        "solver": result.solver,
        "denoiser": result.denoiser,
        "iterations": result.iterations,
        "iterations_asked": result.iterations_asked,
        "seconds": round(result.seconds, 3),
        "parameters": result.parameters,
        "quality": quality,
        "error": error_facts(result.error),
        "trusted": [trusted.start, trusted.stop],
        "warnings": list(result.warnings),
        "versions": {"acquire": __version__},
        "plugins": of_others([(SOLVERS, result.solver), (DENOISERS, result.denoiser or "")]),
    }
