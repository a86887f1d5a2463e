"""Reading recordings: their description, and segments cut out of them for reconstruction.

Everything is read lazily.
"""

from __future__ import annotations

import math
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.clock import NS_PER_S
from acquire.codes import code_from_attrs
from acquire.errors import DataError, UsageError
from acquire.flags import NO_IMAGE
from acquire.geometry import check_integers
from acquire.lines import ARMS, LineFlag, Segment
from acquire.noise import Noise
from acquire.showing import PICTURE_PX, as_picture, as_table, in_words
from acquire.store.camera_stream import CameraStream
from acquire.store.opening import opened
from acquire.store.outline import Outline
from acquire.store.overview import read_overview
from acquire.store.plugin_codecs import variant_of
from acquire.store.present import present_values
from acquire.store.shape import PluginCodec
from acquire.store.source import source_of
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Mapping

    import zarr
    from numpy.typing import NDArray

    from acquire.fibre import Tile
    from acquire.geometry import Geometry
    from acquire.store.layout import Document
    from acquire.store.overview import Overview
    from acquire.store.source import Source
    from acquire.store.stored_rows import StoredRows

CUT_COLUMNS = ("lines", "flags", "code", "code_index", "time")
"""Arrays from which a segment is cut."""

NOISE_KEYS = ("dn_per_electron", "read_noise_e")


def open_recording(place: Path | str) -> Recording:
    """Open a recording, growing or sealed.

    Raises PlaceError if there is none, DataError if it is damaged, and StoreError if that cannot be found
    out.
    """
    return open_source(source_of(place))


def open_source(source: Source) -> Recording:
    """Do as `open_recording`, with a source."""
    return opened(source, Recording)


class Recording(Outline):
    """One recording, opened for reading; `open_recording` returns it."""

    arms: Mapping[str, CameraStream]

    def _arm(self, arm: str, documents: dict[str, Document]) -> CameraStream:
        # Not `self.group` itself, which would import zarr: most recordings are read without it.
        return CameraStream(self.source, arm, documents, self.first_line, lambda: self.group)

    def __repr__(self) -> str:
        state = self.attrs["run_condition"] or self.state
        return in_words("Recording", str(self), state, **self._holds())

    def _repr_html_(self) -> str:
        """Return a table with both arms side by side, if there is a readable overview."""
        facts = {"run": self.attrs["run_id"], "state": self.attrs["run_condition"] or self.state}
        picture = ""
        with suppress(DataError):  # reported when the overview is read
            if overviews := [found.rows for arm in ARMS if (found := self.overview(arm)) is not None]:
                both = np.hstack(overviews)
                rows, columns = (-(-size // PICTURE_PX) for size in both.shape)
                picture = as_picture(both[::rows, ::columns], "both arms, time downwards")
        return as_table(str(self), {**facts, **self._holds(), "end": self.attrs["end_reason"]}, picture)

    def _holds(self) -> dict[str, str]:
        """Return a description in words, without reading any lines."""
        first, count, sizes = self.first_line, self.lines, self.attrs["geometry"]
        period_ns = self.line_period_ns
        return {
            "lines": f"{first} to {first + count - 1} of each arm" if count else "none yet",
            "duration": f"{count * period_ns / NS_PER_S:.6g} s at {NS_PER_S / period_ns:.6g} lines/s",
            "geometry": f"M = {sizes['stages']}, S = {sizes['substeps']}",
            "samples": f"{self.arms[ARMS[0]].pixels} pixels {self.arms[ARMS[0]].data_type}",
            "code": self.attrs["code"]["kind"],
        }

    @property
    def path(self) -> Path:
        """Its path; of a remote recording only the name is meaningful."""
        return Path(str(self.source))

    @cached_property
    def group(self) -> zarr.Group:
        """The recording as a zarr-python group; zarr is imported only here.

        Raises UsageError if the codec of the pixels is not installed, without which zarr opens no part of it.
        """
        import zarr

        if isinstance(self.codec, PluginCodec):
            variant_of(self.codec)
        return zarr.open_group(self.source.zarr_store(), mode="r", zarr_format=3)

    def end_ns(self) -> int | None:
        """Return the UTC at which the line after the last one is read out; None without lines."""
        if not self.lines:
            return None
        last = int(self.arms[ARMS[0]].read("time", self.lines - 1, self.lines)[0])
        return last + round(self.line_period_ns)

    def camera(self, arm: str) -> CameraStream:
        """Return the arrays of arm ``"a"`` or ``"b"``."""
        if arm not in self.arms:
            raise UsageError(f"{self} has no arm {arm!r}", possible=", ".join(self.arms))
        return self.arms[arm]

    def cut(self, first_line: int, lines: int, tile: Tile | None = None) -> Segment:
        """Return the segment of ``lines`` lines from the trigger's line ``first_line`` on.

        Behind a fibre, ``tile`` is the tile of the scene. A sample is masked if its line is missing or
        incomplete, or if it is at the top of the range. Raises UsageError for lines and tiles that are not
        there, and DataError if the file is damaged or the code recorded with the lines is not the one that
        the attributes describe.
        """
        check_integers(first_line=first_line, lines=lines)
        # Users know lines by number, and not in which segment an outage has put them.
        if (segment := self._segment_with(first_line)) is not None:
            return segment.cut(first_line, lines, tile)
        start, stop = self._rows(first_line, lines)
        geometry, columns = self.geometry_for(lines), self._columns(tile)
        stretches = self._fetched(start, stop)
        # Read into their final place, without a copy of all of them.
        samples = np.empty((len(ARMS), lines, geometry.stages), self.arms["a"].dtype)
        flags = np.stack([arm["flags"].read() for arm in stretches.values()])
        for arm, of_arm, those, known in zip(ARMS, samples, columns, flags, strict=True):
            try:
                stretches[arm]["lines"].read(out=of_arm, columns=those)
            except DataError:  # what a recovery has flagged as missing need not be there
                of_arm[:] = self._present(arm, "lines", start, known)[:, those]
        cameras, noise = [self.attrs["cameras"][arm] for arm in ARMS], None
        # a rig need not give the cameras' noise
        if all(camera.get(key) is not None for camera in cameras for key in NOISE_KEYS):
            (K_a, read_a), (K_b, read_b) = ([float(camera[key]) for key in NOISE_KEYS] for camera in cameras)
            noise = Noise((K_a, K_b), (K_a * read_a, K_b * read_b))
        return Segment(
            lines=samples,
            mask=self._usable(samples, flags),
            code=self._checked_code(first_line, geometry, flags, stretches),
            geometry=geometry,
            time_ns=self._times(start, flags, stretches),
            first_line=first_line,
            substep_ns=self.line_period_ns / geometry.substeps,
            black_level_dn=self._per_arm("black_level_dn"),
            responsivity_dn=self._per_arm("responsivity_dn"),
            noise=noise,
            first_column=(columns[0].start, columns[1].start),
        )

    def whole_lines(self, first_line: int, lines: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return samples (arm, line, pixel) of ``lines`` lines from ``first_line`` on, and which are usable.

        All columns are included, whatever they see: for calibrations per column. Raises as `cut` does.
        """
        check_integers(first_line=first_line, lines=lines)
        if (segment := self._segment_with(first_line)) is not None:
            return segment.whole_lines(first_line, lines)
        rows = self._rows(first_line, lines)
        flags = np.stack([stream.stretch("flags", *rows).read() for stream in self.arms.values()])
        samples = np.stack(
            [self._present(arm, "lines", rows[0], known) for arm, known in zip(ARMS, flags, strict=True)]
        )
        return samples, self._usable(samples, flags)

    def _present(self, arm: str, name: str, start: int, flags: NDArray[np.uint16]) -> NDArray[Any]:
        """Return rows of an array; 0 for missing ones that are not on disk. Raises DataError for others."""
        return present_values(self, arm, name, start, flags)

    def _times(
        self, start: int, flags: NDArray[np.uint16], stretches: dict[str, dict[str, StoredRows]]
    ) -> NDArray[np.int64]:
        """Return the time of each row: of arm A, or of the other arm, or by the clock, if it is missing."""
        try:
            return stretches["a"]["time"].read()
        except DataError:
            times = [self._present(arm, "time", start, known) for arm, known in zip(ARMS, flags, strict=True)]
        missing = (flags & LineFlag.MISSING) != 0
        found: NDArray[np.int64] = np.where(missing[0], times[1], times[0]).astype(np.int64)
        period, S = int(self.attrs["trigger"]["line_period_ticks"]), self.substeps
        for row in np.flatnonzero(missing.all(axis=0)).tolist():
            readout = (self.first_line + start + row) * S + self.geometry_for(1).readout_substep
            found[row] = self.clock.instant_ns(readout * period // S)
        return found

    def _columns(self, tile: Tile | None) -> tuple[slice, slice]:
        """Return the columns of arms A and B that see a tile, or all of them."""
        if self.fibre is not None:
            if tile is None:
                raise UsageError(
                    f"{self} shows {len(self.fibre.tiles)} tiles of a scene behind a fibre; none was named",
                    possible=f"a tile ROW,COLUMN from 0,0 to {self.fibre.tiles[-1]}",
                )
            return self.fibre.pixels(tile)
        pixels, stages = self.arms["a"].pixels, self.geometry_for(1).stages
        if pixels != stages:
            raise UsageError(
                f"lines with {pixels} pixels cannot be cut for reconstruction",
                possible=f"M = {stages} pixels",
            )
        if tile is not None:
            raise UsageError(f"{self} has no tile {tile}: its lines see one scene", possible="no tile")
        return slice(0, pixels), slice(0, pixels)

    def overview(self, arm: str) -> Overview | None:
        """Return a whole arm in at most a thousand rows; None if there is no overview, or not yet.

        Raises DataError if it is damaged.
        """
        return read_overview(self, self.camera(arm).arm)

    def _fetched(self, start: int, stop: int) -> dict[str, dict[str, StoredRows]]:
        """Return, per arm and array, rows ``start .. stop - 1``, all being fetched at once."""
        found = {
            arm: {name: stream.stretch(name, start, stop) for name in CUT_COLUMNS}
            for arm, stream in self.arms.items()
        }
        stretches = [stretch for arm in found.values() for stretch in arm.values()]
        # All indices first, then all chunks: disks and remote stores are fastest if everything is requested
        # before anything is waited for.
        for stretch in stretches:
            stretch.expect_index()
        for stretch in stretches:
            stretch.expect()
        return found

    def _segment_with(self, line: int) -> Recording | None:
        """Return the further segment that holds the line, if it is not in this one."""
        if line < self.first_line + self.lines:
            return None
        return next((s for s in self.segments if s.first_line <= line < s.first_line + s.lines), None)

    def _rows(self, first_line: int, lines: int) -> tuple[int, int]:
        if lines < 1:
            raise UsageError(f"a range of {lines} lines cannot be read", possible="1 or more")
        start = first_line - self.first_line
        # First: dropped lines count among the recording's, and the second check would let them pass.
        for first, count in self.dropped:
            if first < first_line + lines and first_line < first + count:
                raise DataError(
                    f"{self}: lines {first} to {first + count - 1} were dropped by retention",
                    possible=f"lines {self.first_available_line} to {self.first_line + self.lines - 1}",
                    hint="`acquire hold` keeps lines while a recording is being written",
                )
        if start < 0 or start + lines > self.lines:
            have = (
                f"lines {self.first_line} to {self.first_line + self.lines - 1}"
                if self.lines
                else "no lines yet"
            )
            wanted = counted(lines, "line")
            raise UsageError(f"{wanted} from line {first_line} on cannot be read in full", possible=have)
        return start, start + lines

    def _camera_numbers(self, key: str) -> list[float]:
        return [float(self.attrs["cameras"][arm][key]) for arm in ARMS]

    def _per_arm(self, key: str) -> float | tuple[float, float]:
        a, b = self._camera_numbers(key)
        return a if a == b else (a, b)

    def _usable(self, samples: NDArray[Any], flags: NDArray[np.uint16]) -> NDArray[np.bool_]:
        usable = np.empty(samples.shape, np.bool_)
        for arm, white in enumerate(self._camera_numbers("white_dn")):
            np.less(samples[arm], math.ceil(white), out=usable[arm])  # integer comparison: many times faster
        usable[(flags & NO_IMAGE) != 0] = False
        return usable

    def _checked_code(
        self,
        first_line: int,
        geometry: Geometry,
        flags: NDArray[np.uint16],
        stretches: dict[str, dict[str, StoredRows]],
    ) -> NDArray[np.uint8]:
        """Return E of the segment from the attributes, after comparing it with the code stored per line."""
        S, lines = geometry.substeps, geometry.lines
        # Computed, and only compared with what is stored: the sub-steps of the last lines reach beyond the
        # end of the recording, and their bits are stored with no line.
        bits = code_from_attrs(self.attrs["code"]).bits(S * first_line, geometry.span)
        index = S * np.arange(first_line, first_line + lines, dtype=np.uint64)
        packed = np.packbits(bits[: S * lines].reshape(lines, S), axis=1, bitorder="little")[:, 0]
        for (arm, columns), arm_flags in zip(stretches.items(), flags, strict=True):
            try:
                code, numbers = columns["code"].read(), columns["code_index"].read()
            except DataError:
                start = first_line - self.first_line
                code, numbers = (
                    self._present(arm, name, start, arm_flags) for name in ("code", "code_index")
                )
            wrong = (code != packed) | (numbers != index)
            wrong &= (arm_flags & LineFlag.MISSING) == 0  # filled with 0, as the rest of a missing line is
            if wrong.any():
                line = first_line + int(wrong.argmax())
                raise DataError(
                    f"{self.arms[arm]}: the code recorded with line {line} is not what the recording's "
                    f"attributes describe ({wrong.sum()} of {len(wrong)} lines disagree)",
                    hint="lines from before or after; the lines themselves are intact",
                )
        return bits
