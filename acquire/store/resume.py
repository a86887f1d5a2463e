"""Continuing a recording after an outage, as a separate segment that is listed in the first one.

The first recording is not reopened.

::

    run.zarr  (sealed, or recovered) ──outage──▶ run-2.zarr ──outage──▶ run-3.zarr
       └ segments: run-2.zarr, run-3.zarr        └ segment: number, of, outage (lines, from, to)

All segments have the same run_id. If the trigger kept counting, line numbers continue through all of them,
which gives the length of the outage in lines; if it restarted, the outage is known by time only.
"""

from __future__ import annotations

from dataclasses import replace
from glob import escape
from typing import TYPE_CHECKING

from acquire.codes import code_from_attrs
from acquire.errors import DataError, PlaceError, UsageError
from acquire.lines import ARMS
from acquire.store.attributes import segment_of
from acquire.store.files import DISK, SCRATCH, Publisher, locked
from acquire.store.layout import to_json
from acquire.store.links import refuse_link
from acquire.store.opening import read_root
from acquire.store.reader import open_recording
from acquire.store.source import LocalSource
from acquire.store.terms import Continuation

if TYPE_CHECKING:
    from pathlib import Path

    from acquire.store.files import Disk
    from acquire.store.reader import Recording
    from acquire.store.spec import RecordingSpec


def next_segment(path: Path, spec: RecordingSpec, cause: str = "interrupted") -> tuple[Path, RecordingSpec]:
    """Return path and specification of the segment that continues the recording at ``path``.

    It is prepared and begun like any other recording, and listed in the first one once it has begun. Raises
    UsageError unless the recording is sealed, and ``spec`` describes the same kind of lines and code.
    """
    first = open_recording(path)
    if "segment" in first.attrs:
        raise UsageError(
            f"resuming is not possible with {path}, which is a segment itself",
            possible=first.attrs["segment"]["of"],
        )
    _check_alike(first, spec)
    # All of them sealed: where an open one ends, and so the outage, is known once it is recovered.
    segments = [first, *first.segments]
    last = segments[-1]
    if any(segment.state != "sealed" for segment in segments):
        raise UsageError(f"{path} cannot be resumed: it is not sealed", hint=f"acquire recover {last}")
    number = len(segments) + 1
    follows = Continuation(path.name, number, last.first_line + last.lines, last.end_ns(), cause)
    # In the same directory, since recordings know their segments by name alone.
    place = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return place, replace(spec, run_id=str(first.attrs["run_id"]), continues=follows)


def list_segment(segment: Path, follows: Continuation, disk: Disk = DISK) -> None:
    """List a segment that has begun in the first recording. Raises OSError, DataError and StateError."""
    first = segment.with_name(follows.first)
    # A recovery of the first recording replaces its root, too: one of the two would be lost.
    with locked(first, "listing a segment of"):
        _name(first, [segment.name], disk)


def list_segments(path: Path, disk: Disk = DISK) -> None:
    """List all segments of the run of the recording at ``path`` in its first recording; idempotent.

    Segments are looked for in the same directory. Raises OSError, DataError, and StateError while another
    process writes the first recording.
    """
    segment = segment_of(read_root(LocalSource(path))["attributes"])
    first = path if segment is None else path.with_name(segment[0])
    if not first.is_dir():
        return
    with locked(first, "listing the segments of"):
        run_id = read_root(LocalSource(first))["attributes"].get("run_id")
        found = []
        for beside in first.parent.glob(f"{escape(first.stem)}-*{escape(first.suffix)}"):
            try:
                attributes = read_root(LocalSource(beside))["attributes"]
            except (DataError, PlaceError):
                continue  # no recording, or a damaged one
            # The file name proves nothing: a user may have called another recording NAME-2.
            segment = segment_of(attributes)
            if segment and (segment[0], attributes.get("run_id")) == (first.name, run_id):
                found.append((segment[1], beside.name))
        _name(first, [name for _, name in sorted(found)], disk)


def _name(first: Path, segments: list[str], disk: Disk) -> None:
    """List the segments that are not listed yet; the caller holds the lock of ``first``."""
    refuse_link(first, first / ARMS[0] / "lines")
    refuse_link(first, first / "zarr.json")
    document = read_root(LocalSource(first))
    listed = document["attributes"].get("segments", [])
    if not isinstance(listed, list):
        raise DataError(
            f"{first}: segments is {listed!r:.50}, not a list of names",
            hint="a copy of its zarr.json; the lines in a/ and b/ do not depend on it",
        )
    if new := [name for name in segments if name not in listed]:
        # A recovered segment may be listed after its successors. By length first: NAME-2 before NAME-10.
        document["attributes"]["segments"] = sorted([*listed, *new], key=lambda name: (len(name), name))
        publisher = Publisher(first / ARMS[0] / "lines" / SCRATCH, disk)
        publisher.replace(first / "zarr.json", to_json(document), durable=True)


def _check_alike(first: Recording, spec: RecordingSpec) -> None:
    known = first.attrs
    # One code can be given by its seed or by its state, and format 1 has only the state.
    has_same_code = code_from_attrs(known["code"]) == code_from_attrs(spec.code)
    for key, value, is_same in (
        ("geometry", spec.geometry, known["geometry"] == spec.geometry),
        ("code", spec.code, has_same_code),
        ("layout", spec.layout, known["layout"] == spec.layout),
    ):
        if not is_same:
            raise UsageError(f"resuming {first} needs the same {key}, not {value}", possible=str(known[key]))
    if first.arms[ARMS[0]].dtype != spec.line_dtype:
        raise UsageError(
            f"resuming {first} needs the same samples, not {spec.dtype}",
            possible=str(first.arms["a"].dtype),
        )
