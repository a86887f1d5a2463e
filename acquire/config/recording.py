"""Models of a rig's ``[recording]``: how recordings are written, and how much of an endless one is kept."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlsplit

from pydantic import Field, field_validator

from acquire.config.base import FilePath, FrozenModel, Seconds
from acquire.config.variants import NameOf, OptionsOf
from acquire.plugins import CODECS

MOST_GB = 1e9
"""An exabyte."""
USUAL_CHUNK_BYTES = 2 * 2**20
"""A cut reads whole chunks: small chunks are quicker to cut, but more of them have to be written."""
USUAL_CHUNK_S = 0.1
"""Seconds of lines that are held in memory until their chunk is complete."""
USUAL_TAG_LINES = 4096
"""Lines of the longest chunk of tags: at most 32 KB of an array, as cheap to write as a few bytes."""


def usual_chunk_lines(line_bytes: int, line_rate_hz: float) -> int:
    """Return the lines per chunk that suit this line size and rate: a power of two, at least 16."""
    most = min(USUAL_CHUNK_BYTES / line_bytes, USUAL_CHUNK_S * line_rate_hz)
    # The least that a rig file may ask for (`chunk_lines`).
    return 1 << max(4, int(most).bit_length() - 1)


def usual_tag_chunks(chunk_lines: int, shard_chunks: int, line_rate_hz: float, commit_s: float) -> int:
    """Return the chunks of lines whose tags share one chunk: few bytes cost as much to write as many.

    Lines become readable with the chunk of their tags, so this chunk must not take long to complete.
    """
    most = min(USUAL_TAG_LINES, min(USUAL_CHUNK_S, commit_s) * line_rate_hz) / chunk_lines
    # A shard holds whole chunks of tags, as it holds whole chunks of lines.
    return max(n for n in range(1, shard_chunks + 1) if shard_chunks % n == 0 and n <= max(1, most))


class RetentionConfig(FrozenModel):
    """How much of an endless recording is kept; the oldest lines are removed first, in whole files."""

    max_gb: float | None = Field(
        default=None, gt=0, le=MOST_GB, description="disk space that one recording may use"
    )
    max_age_s: Seconds | None = Field(default=None, gt=0, description="age of lines, relative to the newest")
    hold_events: tuple[str, ...] = Field(
        default=("mark",), description="kinds of events around which lines are kept"
    )
    hold_before_s: Seconds = Field(default=2.0, description="time kept before such an event")
    hold_after_s: Seconds = Field(default=2.0, description="time kept after such an event")
    segment_lines: int = Field(
        default=512,
        ge=1,
        le=2**40,
        description="longest segment to be reconstructed; this much more is kept around a hold",
    )


class RecordingConfig(FrozenModel):
    """How recordings are written."""

    directory: FilePath = Field(default=Path(), description="directory of recordings that are given no path")
    chunk_lines: int | None = Field(
        default=None,
        ge=16,
        le=2**20,
        description="lines per chunk; absent: at most 2 MiB and a tenth of a second",
    )
    # The index of 255 chunks fits one page. 240 has twenty divisors: chunks of tags, of which a shard holds
    # a whole number, can have nearly any length.
    shard_chunks: int = Field(default=240, ge=1, le=255, description="chunks per file")
    codec: Annotated[str, NameOf(CODECS)] = Field(
        default="none",
        description="'none', 'lz4', 'zstd'; 'auto': the strongest of these that sustains the rate on this "
        "host, measured at arm; or one that `acquire plugins` lists",
    )
    codec_options: Annotated[FrozenModel | None, OptionsOf(CODECS, named_by="codec")] = Field(
        default=None, validate_default=True, description="options of the codec"
    )
    fsync: Literal["commit", "seal"] = Field(
        default="seal", description="when bytes are forced to the medium"
    )
    commit_s: float = Field(
        default=1.0, gt=0, le=60, description="lines that may wait for a commit, in seconds at the line rate"
    )
    reserve_gb: float = Field(
        default=0.25,
        ge=0,
        le=MOST_GB,
        description="disk space to leave free; a recording is sealed before less is left",
    )
    after: Literal["armed", "idle"] = Field(
        default="armed",
        description="the state after a recording: 'armed', in which the rings keep the latest lines for the "
        "next recording, or 'idle'",
    )
    on_disk_trouble: Literal["continue", "stop"] = Field(
        default="continue",
        description="if a disk pauses, the recorder waits for as long as the rings can hold the lines "
        "(stream.ring_seconds), then the recording is sealed. 'continue': it continues in a further segment "
        "when the disk is back; 'stop': it ends there",
    )
    patience_s: float | None = Field(
        default=None,
        ge=1,
        le=1e6,
        description="a disk that does not answer for longer is a fault, and a recorder that does not respond "
        "for another reason is replaced; absent: there is no limit for the disk, and for the recorder it is "
        "three times what the rings hold",
    )
    seal_timeout_s: float = Field(
        default=60.0,
        gt=0,
        le=3600,
        description="longest time in which an ending recording writes nothing to the disk, although the disk "
        "is not being waited for; longer is a fault. A daemon that ends does not wait for longer, either",
    )
    retention: RetentionConfig | None = Field(default=None, description="absent: everything is kept")
    upload_to: str | None = Field(
        default=None,
        description="URL below which the daemon copies every recording while it grows, as in "
        "s3://bucket/prefix; endpoint and credentials come from the environment; needs pip install "
        "'tdi-acquire[remote]'",
    )

    @property
    def reserve_bytes(self) -> int:
        """Bytes of the disk to leave free."""
        return round(self.reserve_gb * 1e9)

    @field_validator("upload_to")
    @classmethod
    def _is_a_place(cls, url: str | None) -> str | None:
        """Refuse secrets, because the configuration is stored in every recording."""
        # pydantic does not check a default, but a recording holds its rig with every key, and null for this
        # one.
        if url is None:
            return None
        parts = urlsplit(url)
        if not parts.scheme or "://" not in url or not (parts.netloc or parts.path.strip("/")):
            raise ValueError("it is not a URL; possible: s3://bucket/prefix, file:///mnt/archive")
        if "@" in parts.netloc or parts.query or parts.fragment:
            raise ValueError("credentials and options must come from the environment, as AWS_ACCESS_KEY_ID")
        return url.rstrip("/")
