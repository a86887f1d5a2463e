"""A recording's description, from its metadata and its small tables: no line is read.

Lists and summaries need no more. It imports only the standard library and a checksum, so that `acquire ls`
answers at once. `acquire.store.reader.Recording` is the same, with the lines.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

from acquire.clock import NS_PER_S, ClockFit
from acquire.errors import DataError, UsageError
from acquire.fibre import Fibre
from acquire.flags import ARMS
from acquire.geometry import Geometry
from acquire.store.array_files import COLUMNS, ArmFiles, ArrayFiles
from acquire.store.attributes import size_limit_bytes
from acquire.store.files import DISK, is_locked
from acquire.store.opening import opened
from acquire.store.shape import PluginCodec
from acquire.store.source import LocalSource, source_of
from acquire.store.table_reader import read_events, read_gaps, salvage_events
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from acquire.store.layout import Document
    from acquire.store.shape import Codec
    from acquire.store.source import Source
    from acquire.store.table_reader import Event, Gap

_WITHOUT = {
    "events": "marks and other events, or their texts, have been incomplete since a recovery",
    "gaps": "the causes of lost lines have been incomplete since a recovery",
}
"""Table → what follows from its loss."""


def open_outline(place: Path | str, document: Document | None = None) -> Outline:
    """Open a recording without its lines; raises as `acquire.store.open_recording` does.

    ``document``: its root, if it has just been read.
    """
    return opened(source_of(place), Outline, document)


class Outline:
    """One recording, as far as its metadata describe it; `open_outline` returns it.

    It is a snapshot: of a growing recording it shows the lines committed when it was opened. `refreshed`
    shows more.
    """

    arms: Mapping[str, ArmFiles]

    def __init__(self, source: Source, document: Document) -> None:
        """``document`` is the root's zarr.json. Raises one of `layout.DAMAGE` if it is damaged."""
        self.source = source
        self.document = document
        self.attrs: dict[str, Any] = document["attributes"]
        self._nodes = nodes = document["consolidated_metadata"]["metadata"]
        self.arms = {arm: self._arm(arm, {name: nodes[f"{arm}/{name}"] for name in COLUMNS}) for arm in ARMS}

    def _arm(self, arm: str, documents: dict[str, Document]) -> ArmFiles:
        """Return an arm by its arrays' documents; `Recording` returns one whose lines can be read."""
        files = {name: ArrayFiles(self.source, f"{arm}/{name}", found) for name, found in documents.items()}
        return ArmFiles(self.source, arm, files, self.first_line)

    def __str__(self) -> str:
        return str(self.source)

    @property
    def is_here(self) -> bool:
        """Whether it is on a disk of this machine."""
        return isinstance(self.source, LocalSource)

    def refreshed(self) -> Self:
        """Return the recording as it is now, with the lines committed since."""
        return opened(self.source, type(self))

    @property
    def state(self) -> str:
        """``recording`` until it is sealed."""
        return str(self.attrs["state"])

    @property
    def is_written(self) -> bool | None:
        """Whether a process of this machine writes it; None if that cannot be known."""
        if self.state == "sealed":
            return False
        return is_locked(self.source.path) if isinstance(self.source, LocalSource) else None

    @property
    def codec(self) -> Codec:
        """The codec of the pixels, which need not be installed here if it is a plug-in's."""
        return self.arms[ARMS[0]].files("lines").shape.codec

    @property
    def first_line(self) -> int:
        """The trigger's number of the line in row 0."""
        return int(self.attrs["first_line"])

    @property
    def lines(self) -> int:
        """Rows of each arm."""
        # They differ only if the metadata are damaged: then no row counts that an arm lacks.
        return min(len(stream) for stream in self.arms.values())

    @property
    def clock(self) -> ClockFit:
        """Fit of the trigger's clock to UTC, as recorded."""
        return ClockFit.from_attrs(self.attrs["clock"])

    @property
    def line_period_ns(self) -> float:
        """Time from one line to the next, by the trigger's clock as it was fitted."""
        return int(self.attrs["trigger"]["line_period_ticks"]) * NS_PER_S / self.clock.clock_hz

    @property
    def substeps(self) -> int:
        """S, sub-steps per line."""
        return int(self.attrs["geometry"]["substeps"])

    @cached_property
    def fibre(self) -> Fibre | None:
        """The fibre's assignment of columns to tiles; None if a line's pixels see one scene, in order.

        Raises DataError for an inconsistent table.
        """
        try:
            return Fibre.of(self.attrs["geometry"])
        except UsageError as error:
            raise DataError(
                f"{self}: {error}", hint="a copy of the recording, or of its zarr.json"
            ) from error

    @property
    def dropped(self) -> tuple[tuple[int, int], ...]:
        """Lines that retention has deleted: first line and count of every range."""
        return tuple((int(first), int(count)) for first, count in self.attrs.get("dropped", ()))

    @property
    def first_available_line(self) -> int:
        """The first line that retention has not deleted."""
        line = self.first_line
        # Only ranges that begin the recording: others lie behind lines that are held.
        for first, count in sorted(self.dropped):
            line = first + count if first == line else line
        return line

    def dropped_rows(self) -> list[range]:
        """Return `dropped` as ranges of rows."""
        return [range(first - self.first_line, first - self.first_line + n) for first, n in self.dropped]

    @cached_property
    def segments(self) -> tuple[Self, ...]:
        """Recordings that continue this one after an outage, in order. Raises DataError for a damaged one."""
        return tuple(self.beside(name) for name in self.attrs.get("segments", ()))

    def beside(self, name: str) -> Self:
        """Return the recording of this name in the same place. Raises DataError."""
        return opened(self.source.beside(name), type(self))

    def kept_rows(self) -> list[range]:
        """Return the rows that have not been deleted; retention deletes whole files."""
        kept, start = [], 0
        for dropped in sorted(self.dropped_rows(), key=lambda rows: rows.start):
            kept.append(range(start, dropped.start))
            start = dropped.stop
        return [rows for rows in [*kept, range(start, self.lines)] if rows]

    def lost_rows(self, arm: str, lines: int | None = None) -> list[range]:
        """Return the rows of one arm that are listed in gaps, of the first ``lines`` rows or of all."""
        start, end = self.first_line, self.lines if lines is None else lines
        # A gap is listed as a whole, and may reach beyond the lines that are committed so far.
        gaps = [
            range(gap.first_line - start, min(end, gap.first_line - start + gap.count))
            for gap in self.gaps
            if gap.arm == arm
        ]
        return [rows for rows in gaps if rows]

    @cached_property
    def gaps_not_listed(self) -> int:
        """Number of gaps for which the table had no room."""
        return int(self._nodes["gaps"]["attributes"]["not_listed"])

    @cached_property
    def events_not_listed(self) -> int:
        """Number of events for which the table had no room."""
        return int(self._nodes["events"]["attributes"]["not_listed"])

    def geometry_for(self, lines: int) -> Geometry:
        """Return the geometry of a cut of ``lines`` lines."""
        sizes = self.attrs["geometry"]
        return Geometry(int(sizes["stages"]), int(sizes["substeps"]), lines)

    @cached_property
    def gaps(self) -> tuple[Gap, ...]:
        """Lost lines in the order of their detection."""
        return read_gaps(self.source, self._nodes)

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """Events in the order in which they were noted."""
        return read_events(self.source, self._nodes)

    @cached_property
    def unreadable(self) -> dict[str, str]:
        """Damaged tables, ``gaps`` or ``events``, and why they cannot be read. The lines do not need them."""
        found = {}
        for name in ("gaps", "events"):
            try:
                getattr(self, name)
            except DataError as error:
                found[name] = error.message.removeprefix(f"{self}: ")
        return found

    def salvaged_events(self) -> tuple[tuple[Event, ...], list[str]]:
        """Return the events of a damaged table as far as they can be read, and what is wrong with it."""
        return salvage_events(self.source, self._nodes)

    @property
    def tables_lost(self) -> dict[str, str]:
        """Tables, ``gaps`` or ``events``, of which a recovery could not read all, and what it lost."""
        lost = self.attrs.get("tables_lost")
        return {str(name): str(text) for name, text in lost.items()} if isinstance(lost, dict) else {}

    @property
    def tables_lack(self) -> list[str]:
        """What the tables of events and gaps do not have, and where else to find it, in words."""
        found = [f"{_WITHOUT.get(name, name)}: {text}" for name, text in self.tables_lost.items()]
        if self.events_not_listed:
            found.append(
                f"the last {counted(self.events_not_listed, 'event')} found no room in the table: "
                "the daemon's log has all marks"
            )
        if self.gaps_not_listed:
            found.append(
                f"the last {counted(self.gaps_not_listed, 'gap')} found no room in the table: "
                "the ledger and the flags of the lines have all that were lost"
            )
        return found

    def info(self) -> dict[str, Any]:
        """Return a summary of the recording, as JSON; without the facts of a table that is `unreadable`."""
        period_ns, lines = self.line_period_ns, self.lines
        gaps = None if "gaps" in self.unreadable else self.gaps
        keys = ("run_id", "state", "run_condition", "end_reason", "layout", "geometry", "clock")
        return {
            "path": str(self),
            **{key: self.attrs[key] for key in keys},
            "written": self.is_written,
            "code": self._code_facts(),
            "first_line": self.first_line,
            "lines": lines,
            "first_available_line": self.first_available_line,
            "dropped": [list(stretch) for stretch in self.dropped],
            "holds": self.attrs.get("holds", []),
            "duration_s": lines * period_ns / NS_PER_S,
            "line_rate_hz": NS_PER_S / period_ns,
            "start_ns": self._start_ns(),
            "dtype": self.arms["a"].data_type,
            "codec": str(self.codec),
            "codec_missing": self._codec_missing(),
            "bytes": self.source.total_bytes(),
            "max_bytes": size_limit_bytes(self.attrs),
            "segment": self.attrs.get("segment"),
            "segments": self.attrs.get("segments", []),
            "gaps": None if gaps is None else len(gaps),
            "lost_lines": None
            if gaps is None
            else {arm: sum(gap.count for gap in gaps if gap.arm == arm) for arm in ARMS},
            "events": None if "events" in self.unreadable else len(self.events),
            "tables_lost": self.tables_lost,
            "tables_lack": self.tables_lack,
            "simulated": bool(self.attrs.get("simulated", False)),
            "cameras": self.attrs["cameras"],
            "imported": self.attrs.get("imported"),
            "calibration": self.attrs.get("calibration"),
            "calibration_missing": self.attrs.get("calibration_missing"),
            "disk": self._disk_facts(),
            "ledger": self.attrs["ledger"],
            "durability": self.attrs.get("durability", {}),
            "versions": self.attrs["versions"],
            "plugins": self.attrs.get("plugins"),
        }

    def _codec_missing(self) -> str | None:
        """Return why the pixels cannot be unpacked here, and what to install; None if they can."""
        if not isinstance(self.codec, PluginCodec):
            return None
        from acquire.store.plugin_codecs import missing_codec  # numpy, for which no list waits

        return missing_codec(self.codec) or None

    def _code_facts(self) -> dict[str, Any]:
        """Return the code; of format 1, which calls the register's state ``seed``, by today's names."""
        code: dict[str, Any] = self.attrs["code"]
        if code["kind"] != "prbs" or "state" in code:
            return code
        seed = self.attrs.get("config", {}).get("code", {}).get("seed")
        return code | {"state": code["seed"], "seed": seed}

    def _disk_facts(self) -> dict[str, float] | None:
        """Return, of a local growing recording, bytes free, bytes per second, and seconds to a full disk."""
        # One that nobody writes does not grow, and of a store nobody knows the room.
        if self.is_written is False or not isinstance(self.source, LocalSource) or not self.lines:
            return None
        free = DISK.free_bytes(self.source.path)
        rate = self.source.total_bytes() * NS_PER_S / (self.lines * self.line_period_ns)
        return {"free_bytes": free, "bytes_per_s": rate, "seconds_to_full": free / rate}

    def _start_ns(self) -> int | None:
        """Return when the first available line was read out, from its number and the clock."""
        line = self.first_available_line
        if line >= self.first_line + self.lines:
            return None
        period, substeps = int(self.attrs["trigger"]["line_period_ticks"]), self.substeps
        readout = self.geometry_for(1).readout_substep
        return self.clock.instant_ns((line * substeps + readout) * period // substeps)
