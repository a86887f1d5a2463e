"""A recording goes on after an outage: as a segment of its own, listed in the first, which is not reopened.

::

    run.zarr  (sealed, or recovered) ──outage──▶ run-2.zarr ──outage──▶ run-3.zarr
       └ segments: run-2.zarr, run-3.zarr        └ segment: number, of, outage (lines, from, to)

All of them have one run_id. Where the trigger went on counting, lines keep their numbers through all of them,
and the outage is that many lines long; where it began anew, the outage is known by time only.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from acquire.errors import UsageError
from acquire.lines import ARMS
from acquire.store.files import DISK, SCRATCH, Publisher, locked
from acquire.store.layout import to_json
from acquire.store.opening import open_recording

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.store.files import Disk
    from acquire.store.reader import Recording
    from acquire.store.spec import RecordingSpec


@dataclass(frozen=True, slots=True)
class Continuation:
    """What a segment follows.

    Attributes
    ----------
    first : name of the run's first recording, in the same directory
    number : of the segment; the first recording is 1
    end_line, end_ns : line after the last one before the outage, and when that was read out
    cause : why there was an outage
    """

    first: str
    number: int
    end_line: int
    end_ns: int | None
    cause: str

    def to_attrs(self, first_line: int, start_ns: int) -> dict[str, Any]:
        """For the segment's root, once its first line is known."""
        lost = first_line - self.end_line
        outage = {
            "after_line": self.end_line - 1,
            "lines": lost if lost >= 0 else None,
            "from_ns": self.end_ns,
            "to_ns": start_ns,
            "cause": self.cause,
        }
        return {"number": self.number, "of": self.first, "outage": outage}


def next_segment(path: Path, spec: RecordingSpec, cause: str = "interrupted") -> tuple[Path, RecordingSpec]:
    """Path and specification of the segment that continues the recording at ``path``, to be prepared and
    begun as any other; it is listed in the first once it has begun.

    Raises UsageError unless the recording is sealed, and ``spec`` describes lines and a code like its own.
    """
    first = open_recording(path)
    if "segment" in first.attrs:
        raise UsageError(f"resuming {path}, a segment itself", possible=first.attrs["segment"]["of"])
    _check_alike(first, spec)
    segments = [first, *first.segments]
    last = segments[-1]
    if any(segment.state != "sealed" for segment in segments):
        raise UsageError(f"resuming {path}: it is not sealed", hint=f"acquire recover {last}")
    number = len(segments) + 1
    follows = Continuation(path.name, number, last.first_line + last.lines, last.end_ns(), cause)
    place = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return place, replace(spec, run_id=str(first.attrs["run_id"]), continues=follows)


def list_segment(segment: Path, follows: Continuation, disk: Disk = DISK) -> None:
    """Name a segment that has begun in the first recording. Raises OSError, DataError and StateError."""
    first = segment.with_name(follows.first)
    with locked(first, "listing a segment of"):
        document = json.loads((first / "zarr.json").read_bytes())
        listed = document["attributes"].get("segments", [])
        document["attributes"]["segments"] = [*listed, segment.name]
        publisher = Publisher(first / ARMS[0] / "lines" / SCRATCH, disk)
        publisher.replace(first / "zarr.json", to_json(document), durable=True)


def _check_alike(first: Recording, spec: RecordingSpec) -> None:
    asked = {
        "geometry": {"stages": spec.stages, "substeps": spec.substeps, "pixels": spec.pixels},
        "code": spec.code,
        "layout": spec.layout,
    }
    for key, value in asked.items():
        if first.attrs[key] != value:
            raise UsageError(f"resuming {first} with {key} {value}", possible=str(first.attrs[key]))
    if first.arms[ARMS[0]].dtype != spec.line_dtype:
        raise UsageError(f"resuming {first} with {spec.dtype} samples", possible=str(first.arms["a"].dtype))
