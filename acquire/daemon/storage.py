"""Storage settings of recordings by the rig; an ``auto`` codec is chosen by a measurement."""

from __future__ import annotations

from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.geometry import Geometry
from acquire.lines import ARMS
from acquire.store import Retention, choose_codec, measure_disk
from acquire.store.refusals import refusal

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.config import RigConfig
    from acquire.store import CodecChoice

SAMPLE_BYTES = 4 * 2**20
"""Bytes of lines on which codecs are tried."""


def storage_settings(config: RigConfig) -> dict[str, Any]:
    """Return the fields of a RecordingSpec that ``[recording]`` determines, except an ``auto`` codec."""
    recording = config.recording
    # Whole chunks of tags, since a line can be committed only once its tags are on disk, too.
    whole = config.chunk_lines * config.tag_chunks
    retention, rate_hz = None, config.line_rate_hz
    if (kept := recording.retention) is not None:
        depth = Geometry(config.geometry.stages, config.geometry.substeps, 1).depth_lines
        retention = Retention(
            max_bytes=None if kept.max_gb is None else round(kept.max_gb * 1e9),
            max_age_lines=None if kept.max_age_s is None else ceil(kept.max_age_s * rate_hz),
            margin_lines=depth + kept.segment_lines,
            hold_events=kept.hold_events,
            hold_lines=(ceil(kept.hold_before_s * rate_hz), ceil(kept.hold_after_s * rate_hz)),
            copied_to=recording.upload_to,
        )
    return {
        "chunk_lines": config.chunk_lines,
        "shard_chunks": recording.shard_chunks,
        "fsync": recording.fsync,
        "tag_chunks": config.tag_chunks,
        "commit_lines": ceil(recording.commit_s * rate_hz / whole) * whole,
        "reserve_bytes": recording.reserve_bytes,
        "retention": retention,
    }


def choose_for(
    config: RigConfig, lines: NDArray[Any] | None = None, directory: Path | None = None
) -> CodecChoice:
    """Choose the codec for both arms at full rate, by measurements of about a second.

    They use ``lines`` (line, pixel) like those to come, or shot noise at half the range, and the disk of
    ``directory``, or of the rig's directory. Raises StoreError if the disk cannot be written to, and
    PlaceError if the directory is not there or this user may not.
    """
    sample = shot_noise(config) if lines is None else lines
    needed = len(ARMS) * config.line_rate_hz * sample[0].nbytes
    directory = directory or config.recording.directory.absolute()
    try:
        return choose_codec(sample, needed, measure_disk(directory))
    except OSError as error:
        raise refusal(
            f"the disk of {directory}", error, "measured", "or another [recording] directory"
        ) from error


def shot_noise(config: RigConfig) -> NDArray[Any]:
    """Return lines (line, pixel) of even light at half the range, with photon noise."""
    camera, pixels = config.cameras.a, config.pixels
    count = max(1, SAMPLE_BYTES // (pixels * np.dtype(camera.dtype).itemsize))
    # Noise is hardly compressible: a codec that sustains it sustains a scene, too.
    light = np.random.default_rng(0).poisson(camera.white_dn / 2, (count, pixels))
    return np.minimum(light, camera.white_dn).astype(camera.dtype)
