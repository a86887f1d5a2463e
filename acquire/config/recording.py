"""Models of a rig's ``[recording]``: how recordings are written, and what of an endless one is kept."""

from __future__ import annotations

from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from pydantic import Field, field_validator

from acquire.config.base import FilePath, FrozenModel, Seconds

MOST_GB = 1e9
"""An exabyte."""
USUAL_CHUNK_BYTES = 2 * 2**20
"""A cut reads whole chunks: small ones are quicker to cut, but there are more of them to be written."""
USUAL_CHUNK_S = 0.1
"""What is held in memory until its chunk is whole, in seconds of lines."""
USUAL_TAG_LINES = 4096
"""In the longest chunk of tags: 32 KB of an array at most, written at the cost of a few bytes."""


def usual_chunk_lines(line_bytes: int, line_rate_hz: float) -> int:
    """Lines per chunk that suit lines of so many bytes at such a rate: a power of two, at least 16."""
    most = min(USUAL_CHUNK_BYTES / line_bytes, USUAL_CHUNK_S * line_rate_hz)
    return 1 << max(4, int(most).bit_length() - 1)


def usual_tag_chunks(chunk_lines: int, shard_chunks: int, line_rate_hz: float, commit_s: float) -> int:
    """Chunks of lines whose tags share one chunk: few bytes cost as much to write as many.

    Lines become readable with the chunk of their tags, so it must not take long to be whole.
    """
    most = min(USUAL_TAG_LINES, min(USUAL_CHUNK_S, commit_s) * line_rate_hz) / chunk_lines
    return max(n for n in range(1, shard_chunks + 1) if shard_chunks % n == 0 and n <= max(1, most))


class RetentionConfig(FrozenModel):
    """What of an endless recording is kept; the oldest lines go first, in whole files."""

    max_gb: float | None = Field(
        default=None, gt=0, le=MOST_GB, description="that one recording may take of the disk"
    )
    max_age_s: Seconds | None = Field(default=None, gt=0, description="of lines behind the newest")
    hold_events: tuple[str, ...] = Field(default=("mark",), description="kinds of events that keep lines")
    hold_before_s: Seconds = Field(default=2.0, description="kept before such an event")
    hold_after_s: Seconds = Field(default=2.0, description="kept after it")
    segment_lines: int = Field(
        default=512,
        ge=1,
        le=2**40,
        description="longest segment to be reconstructed; so much is kept around a hold",
    )


class RecordingConfig(FrozenModel):
    """How recordings are written."""

    directory: FilePath = Field(default=Path(), description="where recordings without a path of their own go")
    chunk_lines: int | None = Field(
        default=None,
        ge=16,
        le=2**20,
        description="lines per chunk; absent: at most 2 MiB and a tenth of a second",
    )
    shard_chunks: int = Field(default=240, ge=1, le=255, description="chunks per file")
    codec: Literal["none", "lz4", "zstd", "auto"] = Field(
        default="none", description="'auto': the smallest that holds the rate here, measured at arm"
    )
    fsync: Literal["commit", "seal"] = Field(
        default="seal", description="when bytes are forced to the medium"
    )
    commit_s: float = Field(
        default=1.0, gt=0, le=60, description="lines that may wait for a commit, in seconds of the line rate"
    )
    reserve_gb: float = Field(
        default=0.25,
        ge=0,
        le=MOST_GB,
        description="of the disk left free; a recording is sealed before that",
    )
    after: Literal["armed", "idle"] = Field(
        default="armed",
        description="the state that a recording's end leads to: 'armed', where the rings go on holding the "
        "latest lines for the next recording, or 'idle'",
    )
    on_disk_trouble: Literal["continue", "stop"] = Field(
        default="continue",
        description="a disk that pauses is waited for as long as the rings hold the lines "
        "(stream.ring_seconds); then the recording is sealed, and goes on in a further segment when the disk "
        "is back, or stops there",
    )
    patience_s: float | None = Field(
        default=None,
        ge=1,
        le=1e6,
        description="a disk that does not answer for longer is a fault, and a recorder that shows no life "
        "for another reason is replaced; absent: the disk is waited for, the recorder gets three times what "
        "the rings hold",
    )
    seal_timeout_s: float = Field(
        default=60.0,
        gt=0,
        le=3600,
        description="longest time in which nothing more of an ending recording reaches the disk, though "
        "nobody waits for the disk; beyond it, a fault; nor does the end of a daemon wait for longer",
    )
    retention: RetentionConfig | None = Field(default=None, description="absent: all is kept")
    upload_to: str | None = Field(
        default=None,
        description="URL below which the daemon copies every recording while it grows: s3://bucket/prefix; "
        "endpoint and credentials come from the environment; needs pip install 'tdi-acquire[remote]'",
    )

    @field_validator("upload_to")
    @classmethod
    def _is_a_place(cls, url: str | None) -> str | None:
        """The configuration goes into every recording: no place for secrets."""
        if url is None:
            return None
        parts = urlsplit(url)
        if not parts.scheme or "://" not in url or not (parts.netloc or parts.path.strip("/")):
            raise ValueError("it is not a URL; possible: s3://bucket/prefix, file:///mnt/archive")
        if "@" in parts.netloc or parts.query or parts.fragment:
            raise ValueError("credentials and options come from the environment, as AWS_ACCESS_KEY_ID")
        return url.rstrip("/")
