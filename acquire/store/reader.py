"""Reading recordings: what they say about themselves, and segments cut out of them for reconstruction.

A `Recording` is a snapshot: of one that is still growing it shows what was committed when it was opened;
`refreshed` shows more. Nothing is read before it is asked for.
"""

from __future__ import annotations

import math
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.clock import NS_PER_S, ClockFit
from acquire.codes import code_from_attrs
from acquire.errors import DataError, UsageError
from acquire.geometry import Geometry
from acquire.lines import ARMS, LineFlag, Segment
from acquire.noise import Noise
from acquire.showing import as_table, in_words
from acquire.store.camera_stream import CameraStream
from acquire.store.files import DISK
from acquire.store.layout import line_columns
from acquire.store.source import LocalSource
from acquire.store.table_reader import read_events, read_gaps

if TYPE_CHECKING:
    from collections.abc import Callable

    import zarr
    from numpy.typing import NDArray

    from acquire.store.layout import Document
    from acquire.store.source import Source
    from acquire.store.stretch import Stretch
    from acquire.store.table_reader import Event, Gap

CUT_COLUMNS = ("lines", "flags", "code", "code_index", "time")
"""Arrays that a segment is made of."""

NOISE_KEYS = ("dn_per_electron", "read_noise_e")
UNUSABLE = LineFlag.MISSING | LineFlag.INCOMPLETE


class Recording:
    """One recording, opened for reading; `open_recording` makes it."""

    def __init__(self, source: Source, document: Document, opener: Callable[[Source], Recording]) -> None:
        """``document`` is the root's zarr.json; ``opener`` opens further segments.

        Raises one of `camera_stream.DAMAGE` where the document is damaged.
        """
        self.source = source
        self._opener = opener
        self.document = document
        self.attrs: dict[str, Any] = document["attributes"]
        self._nodes = nodes = document["consolidated_metadata"]["metadata"]
        columns = [column.name for column in line_columns("any")]
        self.arms = {
            arm: CameraStream(
                source, arm, {name: nodes[f"{arm}/{name}"] for name in columns}, self.first_line, self._open
            )
            for arm in ARMS
        }

    def __str__(self) -> str:
        return str(self.source)

    def __repr__(self) -> str:
        state = self.attrs["run_condition"] or self.state
        return in_words("Recording", str(self), state, **self._holds())

    def _repr_html_(self) -> str:
        facts = {"run": self.attrs["run_id"], "state": self.attrs["run_condition"] or self.state}
        return as_table(str(self), {**facts, **self._holds(), "end": self.attrs["end_reason"]})

    def _holds(self) -> dict[str, str]:
        """What it holds, in words; nothing is read for it."""
        first, count, sizes = self.first_line, self.lines, self.attrs["geometry"]
        period_ns = self.line_period_ns
        return {
            "lines": f"{first} to {first + count - 1} of each arm" if count else "none yet",
            "duration": f"{count * period_ns / NS_PER_S:.6g} s at {NS_PER_S / period_ns:.6g} lines/s",
            "geometry": f"M = {sizes['stages']}, S = {sizes['substeps']}",
            "samples": f"{self.arms[ARMS[0]].pixels} pixels {self.arms[ARMS[0]].dtype.name}",
            "code": self.attrs["code"]["kind"],
        }

    @property
    def path(self) -> Path:
        """Where it lies; of a remote recording only the name means something."""
        return Path(str(self.source))

    @cached_property
    def group(self) -> zarr.Group:
        """The recording in zarr-python, which is imported when somebody asks for it."""
        import zarr

        return zarr.open_group(self.source.zarr_store(), mode="r", zarr_format=3)

    def _open(self) -> zarr.Group:
        return self.group

    @property
    def is_here(self) -> bool:
        """It lies on a disk of this machine."""
        return isinstance(self.source, LocalSource)

    def refreshed(self) -> Recording:
        """The recording as it is now: of one that is growing, what was committed since."""
        return self._opener(self.source)

    @property
    def state(self) -> str:
        """``recording`` until it is sealed."""
        return str(self.attrs["state"])

    @property
    def first_line(self) -> int:
        """The trigger's number of the line in row 0."""
        return int(self.attrs["first_line"])

    @property
    def lines(self) -> int:
        """Rows of each arm."""
        return min(len(stream) for stream in self.arms.values())

    @property
    def clock(self) -> ClockFit:
        return ClockFit.from_attrs(self.attrs["clock"])

    @property
    def line_period_ns(self) -> float:
        return int(self.attrs["trigger"]["line_period_ticks"]) * NS_PER_S / self.clock.clock_hz

    @property
    def substeps(self) -> int:
        """S."""
        return int(self.attrs["geometry"]["substeps"])

    @property
    def dropped(self) -> tuple[tuple[int, int], ...]:
        """Lines that retention has deleted: first line and count of every stretch."""
        return tuple((int(first), int(count)) for first, count in self.attrs.get("dropped", ()))

    @property
    def first_available_line(self) -> int:
        """The first line that retention has left."""
        line = self.first_line
        for first, count in sorted(self.dropped):
            line = first + count if first == line else line
        return line

    def dropped_rows(self) -> list[range]:
        """The same, in rows."""
        return [range(first - self.first_line, first - self.first_line + n) for first, n in self.dropped]

    @cached_property
    def segments(self) -> tuple[Recording, ...]:
        """Recordings that continue this one after an outage, in order. Raises DataError for a damaged one."""
        return tuple(self.beside(name) for name in self.attrs.get("segments", ()))

    def beside(self, name: str) -> Recording:
        """The recording of this name in the same place. Raises DataError."""
        return self._opener(self.source.beside(name))

    def end_ns(self) -> int | None:
        """UTC at which the line after the last is read out; None without lines."""
        if not self.lines:
            return None
        last = int(self.arms[ARMS[0]].read("time", self.lines - 1, self.lines)[0])
        return last + round(self.line_period_ns)

    def kept_rows(self) -> list[range]:
        """Rows that have not been deleted; retention deletes whole files."""
        kept, start = [], 0
        for dropped in sorted(self.dropped_rows(), key=lambda rows: rows.start):
            kept.append(range(start, dropped.start))
            start = dropped.stop
        return [rows for rows in [*kept, range(start, self.lines)] if rows]

    def lost_rows(self, arm: str, lines: int | None = None) -> list[range]:
        """Rows of one arm that are listed in gaps; of the first ``lines`` rows, or of all that there are."""
        start, end = self.first_line, self.lines if lines is None else lines
        gaps = [
            range(gap.first_line - start, min(end, gap.first_line - start + gap.count))
            for gap in self.gaps
            if gap.arm == arm
        ]
        return [rows for rows in gaps if rows]

    @cached_property
    def gaps_not_listed(self) -> int:
        """Gaps for which the table had no room."""
        return int(self._nodes["gaps"]["attributes"]["not_listed"])

    def camera(self, arm: str) -> CameraStream:
        """The arrays of arm ``"a"`` or ``"b"``."""
        if arm not in self.arms:
            raise UsageError(f"{self} has no arm {arm!r}", possible=", ".join(self.arms))
        return self.arms[arm]

    def geometry_for(self, lines: int) -> Geometry:
        """Geometry of a segment of ``lines`` lines."""
        sizes = self.attrs["geometry"]
        return Geometry(int(sizes["stages"]), int(sizes["substeps"]), lines)

    @cached_property
    def gaps(self) -> tuple[Gap, ...]:
        """Lost lines in the order in which they were noticed."""
        return read_gaps(self.source, self._nodes)

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """What happened, in the order in which it was noted."""
        return read_events(self.source, self._nodes)

    def cut(self, first_line: int, lines: int) -> Segment:
        """The segment of ``lines`` lines from the trigger's line ``first_line`` on.

        A sample is masked when its line is missing or incomplete, or when it stands at the top of the range.
        Raises UsageError for lines that are not there, and DataError when the file is damaged or the code
        that the attributes describe is not the one recorded with the lines.
        """
        if (segment := self._segment_with(first_line)) is not None:
            return segment.cut(first_line, lines)
        start, stop = self._rows(first_line, lines)
        geometry = self.geometry_for(lines)
        if (pixels := self.arms["a"].pixels) != geometry.stages:
            raise UsageError(
                f"lines with {pixels} pixels cannot be cut for reconstruction",
                possible=f"M = {geometry.stages} pixels",
            )
        stretches = self._fetched(start, stop)
        samples = np.empty((len(ARMS), lines, pixels), self.arms["a"].dtype)
        for arm, of_arm in zip(stretches.values(), samples, strict=True):
            arm["lines"].read(out=of_arm)
        flags = np.stack([arm["flags"].read() for arm in stretches.values()])
        return Segment(
            lines=samples,
            mask=self._usable(samples, flags),
            code=self._checked_code(first_line, geometry, flags, stretches),
            geometry=geometry,
            time_ns=stretches["a"]["time"].read(),
            first_line=first_line,
            substep_ns=self.line_period_ns / geometry.substeps,
            black_level_dn=self._per_arm("black_level_dn"),
            responsivity_dn=self._per_arm("responsivity_dn"),
            noise=self._noise(),
        )

    def _fetched(self, start: int, stop: int) -> dict[str, dict[str, Stretch]]:
        """Arm → array → its rows ``start .. stop - 1``, all on their way from the disk at once."""
        found = {
            arm: {name: stream.stretch(name, start, stop) for name in CUT_COLUMNS}
            for arm, stream in self.arms.items()
        }
        stretches = [stretch for arm in found.values() for stretch in arm.values()]
        for stretch in stretches:
            stretch.expect_index()
        for stretch in stretches:
            stretch.expect()
        return found

    def info(self) -> dict[str, Any]:
        """What one wants to know of a recording at a glance; everything is JSON."""
        period_ns, lines = self.line_period_ns, self.lines
        keys = ("run_id", "state", "run_condition", "end_reason", "layout", "geometry", "code", "clock")
        return {
            "path": str(self),
            **{key: self.attrs[key] for key in keys},
            "first_line": self.first_line,
            "lines": lines,
            "first_available_line": self.first_available_line,
            "dropped": [list(stretch) for stretch in self.dropped],
            "holds": self.attrs.get("holds", []),
            "duration_s": lines * period_ns / NS_PER_S,
            "line_rate_hz": NS_PER_S / period_ns,
            "start_ns": self._start_ns(),
            "dtype": self.arms["a"].dtype.name,
            "bytes": self.source.total_bytes(),
            "segment": self.attrs.get("segment"),
            "segments": self.attrs.get("segments", []),
            "gaps": len(self.gaps),
            "lost_lines": {arm: sum(gap.count for gap in self.gaps if gap.arm == arm) for arm in ARMS},
            "events": len(self.events),
            "simulated": bool(self.attrs.get("simulated", False)),
            "cameras": self.attrs["cameras"],
            "imported": self.attrs.get("imported"),
            "calibration": self.attrs.get("calibration"),
            "calibration_missing": self.attrs.get("calibration_missing"),
            "disk": self._disk_facts(),
            "ledger": self.attrs["ledger"],
            "durability": self.attrs.get("durability", {}),
            "versions": self.attrs["versions"],
        }

    def _disk_facts(self) -> dict[str, float] | None:
        """While it grows here: bytes free, bytes per second that it takes, seconds until the disk is full."""
        if self.state == "sealed" or not isinstance(self.source, LocalSource) or not self.lines:
            return None
        free = DISK.free_bytes(self.source.path)
        rate = self.source.total_bytes() * NS_PER_S / (self.lines * self.line_period_ns)
        return {"free_bytes": free, "bytes_per_s": rate, "seconds_to_full": free / rate}

    def _segment_with(self, line: int) -> Recording | None:
        """The further segment that has a line which is not here."""
        if line < self.first_line + self.lines:
            return None
        return next((s for s in self.segments if s.first_line <= line < s.first_line + s.lines), None)

    def _start_ns(self) -> int | None:
        """When the first line that there is was read out."""
        row = self.first_available_line - self.first_line
        return int(self.arms[ARMS[0]].read("time", row, row + 1)[0]) if row < self.lines else None

    def _rows(self, first_line: int, lines: int) -> tuple[int, int]:
        start = first_line - self.first_line
        for first, count in self.dropped:
            if lines > 0 and first < first_line + lines and first_line < first + count:
                raise DataError(
                    f"{self}: lines {first} to {first + count - 1} were dropped by retention",
                    possible=f"lines {self.first_available_line} to {self.first_line + self.lines - 1}",
                    hint="`acquire hold` keeps lines while a recording is being written",
                )
        if lines < 1 or start < 0 or start + lines > self.lines:
            have = (
                f"lines {self.first_line} to {self.first_line + self.lines - 1}"
                if self.lines
                else "no lines yet"
            )
            raise UsageError(f"{lines} lines from line {first_line} on are not all there", possible=have)
        return start, start + lines

    def _camera_numbers(self, key: str) -> list[float]:
        return [float(self.attrs["cameras"][arm][key]) for arm in ARMS]

    def _noise(self) -> Noise | None:
        """What the rig said of the cameras' noise; None where it said nothing."""
        cameras = [self.attrs["cameras"][arm] for arm in ARMS]
        if any(camera.get(key) is None for camera in cameras for key in NOISE_KEYS):
            return None
        (K_a, read_a), (K_b, read_b) = ([float(camera[key]) for key in NOISE_KEYS] for camera in cameras)
        return Noise((K_a, K_b), (K_a * read_a, K_b * read_b))

    def _per_arm(self, key: str) -> float | tuple[float, float]:
        a, b = self._camera_numbers(key)
        return a if a == b else (a, b)

    def _usable(self, samples: NDArray[Any], flags: NDArray[np.uint16]) -> NDArray[np.bool_]:
        usable = np.empty(samples.shape, np.bool_)
        for arm, white in enumerate(self._camera_numbers("white_dn")):
            np.less(samples[arm], math.ceil(white), out=usable[arm])  # whole numbers: many times faster
        usable[(flags & UNUSABLE) != 0] = False
        return usable

    def _checked_code(
        self,
        first_line: int,
        geometry: Geometry,
        flags: NDArray[np.uint16],
        stretches: dict[str, dict[str, Stretch]],
    ) -> NDArray[np.uint8]:
        """E of the segment from the attributes, compared with what stands beside each line of either arm."""
        S, lines = geometry.substeps, geometry.lines
        bits = code_from_attrs(self.attrs["code"]).bits(S * first_line, geometry.span)
        index = S * np.arange(first_line, first_line + lines, dtype=np.uint64)
        packed = np.packbits(bits[: S * lines].reshape(lines, S), axis=1, bitorder="little")[:, 0]
        for (arm, columns), arm_flags in zip(stretches.items(), flags, strict=True):
            wrong = (columns["code"].read() != packed) | (columns["code_index"].read() != index)
            self._refuse_code(self.arms[arm], first_line, wrong & ((arm_flags & LineFlag.MISSING) == 0))
        return bits

    def _refuse_code(self, stream: CameraStream, first_line: int, wrong: NDArray[np.bool_]) -> None:
        if wrong.any():
            raise DataError(
                f"{stream}: the code recorded with line {first_line + int(wrong.argmax())} is not what "
                f"the recording's attributes describe ({wrong.sum()} of {len(wrong)} lines disagree)",
                hint="lines from before or after; the lines themselves are intact",
            )
