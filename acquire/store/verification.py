"""Verification of a recording: every chunk is read, and all redundant facts have to agree."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.errors import DataError
from acquire.lines import ARMS
from acquire.reading import parse_object
from acquire.store import overview
from acquire.store.layout import DAMAGE
from acquire.store.links import refuse_links
from acquire.store.plugin_codecs import missing_codec
from acquire.store.reader import open_source
from acquire.store.refusals import refused
from acquire.store.scan import chunks_of, missing_rows, scan
from acquire.store.shortfall import Damage, missing_segments
from acquire.store.source import LocalSource, source_of
from acquire.store.suspect import suspect_lines
from acquire.text import cause_in_words, counted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from acquire.store.reader import Recording
    from acquire.store.scan import ArmScan


@dataclass(frozen=True, slots=True)
class Verification:
    """Result of a verification.

    Attributes
    ----------
    path, state, lines : path, state and lines of the recording
    bytes : its size
    damage : lines that are not intact on disk, and not known to be lost
    recovered : lines that are not intact on disk, all of which are flagged as missing
    contradictions : redundant facts that disagree, in words
    notes : remarks that do not report damage
    """

    path: str
    state: str
    lines: int
    bytes: int
    damage: tuple[Damage, ...]
    recovered: tuple[Damage, ...]
    contradictions: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def intact(self) -> bool:
        """Whether everything that it claims to hold is there; it may state that lines are lost."""
        return not (self.damage or self.contradictions)

    def to_dict(self) -> dict[str, Any]:
        return {
            "path": self.path,
            "intact": self.intact,
            "state": self.state,
            "lines": self.lines,
            "bytes": self.bytes,
            "damage": [damage.to_dict() for damage in self.damage],
            "recovered": [damage.to_dict() for damage in self.recovered],
            "contradictions": list(self.contradictions),
            "notes": list(self.notes),
        }


def verify(place: Path | str, progress: Callable[[int, int], None] | None = None) -> Verification:
    """Read all of a recording, local or remote, and verify it.

    Checks are presence, length and checksum of every chunk, that numbering, gaps, flags and ledger agree, and
    that listed segments exist. Raises as `open_recording` does, and DataError for a recording that holds
    links. What cannot be read now, for want of permission, memory or a network, is no damage: PlaceError or
    StoreError.
    """
    source = source_of(place)
    if isinstance(source, LocalSource):
        refuse_links(source.path)
    with refused(source, "read"):
        recording = open_source(source)
        scans = scan(recording, recording.kept_rows(), progress)
        gone = open_source(source).dropped  # lines that retention deleted during the scan are not damaged
        found = [
            one
            for arm in scans.values()
            for one in arm.damages(recording.lines)
            if not any(first <= one.first_line < first + count for first, count in gone)
        ]
        # What a recovery has flagged is known to be lost: the recording claims nothing that is not there.
        damage = tuple(one for one in found if not _is_flagged(recording, one))
        return Verification(
            path=str(source),
            state=recording.state,
            lines=recording.lines,
            bytes=source.total_bytes(),
            damage=damage,
            recovered=tuple(one for one in found if one not in damage),
            contradictions=tuple(_contradictions(recording, scans)),
            notes=tuple(_notes(recording)),
        )


def _is_flagged(recording: Recording, damage: Damage) -> bool:
    """Return whether all lines of a damage are flagged as missing."""
    start = damage.first_line - recording.first_line
    stop, stream = start + damage.count, recording.arms[damage.arm]
    size = stream.reader("flags").shape.chunk_rows
    try:
        # Chunk by chunk, as in `_read_tags`.
        return all(
            missing_rows(stream.read("flags", row, min(row + size, stop))).all()
            for row in range(start, stop, size)
        )
    except DataError:  # the flags are damaged themselves
        return False


def _contradictions(recording: Recording, scans: dict[str, ArmScan]) -> Iterator[str]:
    yield from _metadata(recording)
    yield from missing_segments(recording)
    try:
        listed = {arm: _listed(recording, arm) for arm in ARMS}
        complete = recording.gaps_not_listed == 0
        # The tables are read here once, so that a damaged one is a contradiction and no failure of `verify`.
        recording.events  # noqa: B018 - reads the table
    except DataError as error:
        yield error.message
        return
    for arm, found in scans.items():
        lengths = {found.stream.reader(name).rows for name in found.troubles}
        if len(lengths) > 1:
            yield f"{arm}: arrays of {sorted(lengths)} lines"
        flagged, misnumbered = _read_tags(recording, found)
        if misnumbered:
            lines = counted(misnumbered, "line", "has")
            yield f"{arm}: {lines} a code index that is not S times the line's number"
        every, kept = listed[arm]
        if complete and flagged is not None and flagged != kept:
            yield f"{arm}: {counted(flagged, 'line', 'is')} flagged as missing, gaps list {kept}"
        yield from _unbalanced(recording, arm, every if complete else None)
        yield from overview.contradictions(recording, arm)


def _listed(recording: Recording, arm: str) -> tuple[int, int]:
    """Return the number of lines listed as lost, and of those that retention has not dropped."""
    lost = recording.lost_rows(arm)
    every = sum(len(rows) for rows in lost)
    gone = sum(
        len(range(max(rows.start, drop.start), min(rows.stop, drop.stop)))
        for rows in lost
        for drop in recording.dropped_rows()
    )
    return every, every - gone


def _read_tags(recording: Recording, found: ArmScan) -> tuple[int | None, int]:
    """Return the number of lines flagged as missing (None if flags are damaged), and of misnumbered lines."""
    flagged, misnumbered = 0, 0
    size = found.stream.reader("flags").shape.chunk_rows
    for chunk in chunks_of(size, recording.kept_rows()):
        if chunk in found.troubles["flags"] or chunk in found.troubles["code_index"]:
            return None, misnumbered
        rows = min(size, recording.lines - chunk * size)  # the rest of the last chunk is padding
        # Chunk by chunk: the tags of a recording of days do not fit into memory.
        missing = missing_rows(found.stream.reader("flags").chunk(chunk)[:rows])
        flagged += int(missing.sum())
        first = recording.first_line + chunk * size
        expected = recording.substeps * np.arange(first, first + rows, dtype=np.uint64)
        wrong = found.stream.reader("code_index").chunk(chunk)[:rows] != expected
        misnumbered += int((wrong & ~missing).sum())
    return flagged, misnumbered


def _unbalanced(recording: Recording, arm: str, listed: int | None) -> Iterator[str]:
    """Check lines = stored + missing by the ledger of a sealed recording, and missing by the gaps."""
    ledger = recording.attrs["ledger"]
    book = ledger.get(arm)
    # `stored` may be null, which balances with nothing.
    if recording.state != "sealed" or not isinstance(book, dict) or book.get("stored") is None:
        return
    missing = sum(book.get("missing", {}).values())
    if book["stored"] + missing != recording.lines:
        lines = counted(recording.lines, "line")
        yield f"{arm}: the ledger does not balance: {lines}, {book['stored']} stored, {missing} missing"
    if listed is not None and missing != listed:
        yield f"{arm}: the ledger has {counted(missing, 'missing line')}, gaps list {listed}"


def _metadata(recording: Recording) -> Iterator[str]:
    """Check the arrays' own metadata, which readers use that do not begin at the root."""
    if recording.state != "sealed":  # in a growing recording they are rewritten only once a second
        return
    nodes = recording.document["consolidated_metadata"]["metadata"]
    for path, document in nodes.items():
        try:
            own = parse_object(recording.source.read(f"{path}/zarr.json"))
        except DAMAGE as error:
            yield f"{path}/zarr.json cannot be read: {cause_in_words(error)}"
            continue
        # Nodes in the root have no consolidated metadata of their own; the files of the groups have.
        if any(own.get(key) != value for key, value in document.items() if key != "consolidated_metadata"):
            yield f"{path}/zarr.json differs from its copy in the root"


def _notes(recording: Recording) -> Iterator[str]:
    if missing := missing_codec(recording.codec):
        yield f"chunks of pixels were verified by their checksums alone, and not unpacked: {missing}"
    with contextlib.suppress(DataError):  # unreadable events are reported by `_contradictions`
        yield from map(str, suspect_lines(recording))
    for lost in recording.tables_lost.values():
        yield f"lost of a table when it was recovered: {lost}"
    for first, count in recording.dropped:
        yield f"lines {first} to {first + count - 1} were dropped by retention"
    if recording.state != "sealed":
        yield "the recording is not sealed: it is being written, or `acquire recover` seals it"
