"""Recordings and videos of one directory, for the page: facts, pictures and frames, by name and not by path.

A name must be an entry of the directory itself, and not a link, so that nothing outside can be reached. A
dedicated thread reads, so that a slow disk keeps nothing else waiting.
"""

from __future__ import annotations

import os
import stat
from collections import OrderedDict
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from acquire.daemon.messages import on_the_wire
from acquire.errors import AcquireError, DataError, PlaceError, UsageError
from acquire.flags import ARMS, NO_IMAGE
from acquire.store import (
    Recording,
    hold,
    open_outline,
    open_recording,
    open_video,
    taint_words,
)
from acquire.store.attributes import upload_target
from acquire.store.holds import holds_of
from acquire.store.layout import DAMAGE
from acquire.store.listing import SUFFIX, candidates, is_ours
from acquire.store.opening import read_root, stated_format
from acquire.store.refusals import refused
from acquire.store.shortfall import damage_in_words
from acquire.store.source import source_of
from acquire.text import cause_in_words, shortened
from acquire.web.messages import (
    EventFacts,
    GapFacts,
    HoldFacts,
    HoldRequest,
    RecordingDetail,
    RecordingFacts,
    VideoFacts,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from acquire.store import Outline, VideoFile
    from acquire.store.holds import Hold
    from acquire.store.layout import Document

MOST_LISTED = 500
"""Largest number of entries in a list; the newest are listed."""
MOST_EVENTS = 1000
"""Number of latest events, and of latest gaps, that the page gets of a recording."""
MOST_PICTURES = 64
"""Number of pictures, and of display ranges, kept for the next request."""
PICTURE_ROWS, PICTURE_COLUMNS = 96, 128
"""Size of one arm's part of a recording's picture."""
LINES_PER_ROW = 8
"""Lines sampled for one row of the picture."""
MOST_FRAME_BYTES = 4 * 2**20
SAMPLED_FRAMES = 24
"""Number of frames from which a video's display range is computed."""
VIDEO = "acquire-video/"
LOST_COLOUR = (200, 0, 140)
_Stamp = tuple[int, int, int] | None


class Archive:
    """See the module. For one thread at a time."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._pictures: OrderedDict[tuple[Any, ...], bytes] = OrderedDict()
        self._facts: dict[str, tuple[_Stamp, RecordingFacts | VideoFacts]] = {}
        self._kinds: dict[str, tuple[_Stamp, bool]] = {}
        """Name → its root document, and whether it is a video. As the facts, of what is in the directory."""
        self._ranges: OrderedDict[tuple[str, int], tuple[float, float]] = OrderedDict()

    def path_of(self, name: str, suffix: str = SUFFIX) -> Path:
        """Return the path of an entry. Raises PlaceError if it is not in the directory, or is a link.

        ``name``: as in the lists, where a name that is not UTF-8 has escapes.
        """
        # lstat, because a link could lead out of the directory.
        path = self._directory / self._real_name(name)
        valid = "\0" not in name and name not in (".", "..") and Path(name).name == name
        try:
            # Recordings may have any name.
            is_there = valid and (is_ours(path) if suffix == SUFFIX else _is_file(path, suffix))
        except OSError:
            is_there = False
        if not is_there:
            raise PlaceError(
                f"there is no {shortened(name)} among the recordings", possible="/api/recordings"
            )
        return path

    def _real_name(self, name: str) -> str:
        """Return the entry's name on the disk, of which JSON can only have a readable form."""
        if "\\" not in name:
            return name
        with suppress(OSError):  # told by whoever reads the entry
            there = [entry.name for entry in os.scandir(self._directory)]
            if name not in there:
                return next((real for real in there if on_the_wire(real) == name), name)
        return name

    def recordings(self) -> list[RecordingFacts]:
        """Return the recordings, newest first."""
        return [self._recording_facts(entry) for entry in self._entries(video=False)]

    def recording(self, name: str) -> RecordingDetail:
        """Return a recording with its events, gaps and holds. Raises PlaceError and DataError."""
        path = self.path_of(name)
        opened = open_recording(path)
        # A damaged table is reported as damage, and the rest is shown.
        events = () if "events" in opened.unreadable else opened.events[-MOST_EVENTS:]
        gaps = () if "gaps" in opened.unreadable else opened.gaps[-MOST_EVENTS:]
        return RecordingDetail(
            **_facts(path, opened).model_dump(),
            event_list=[EventFacts(kind=event.kind, line=event.line, text=event.text) for event in events],
            gap_list=[
                GapFacts(arm=gap.arm, first_line=gap.first_line, count=gap.count, cause=gap.cause)
                for gap in gaps
            ],
            hold_list=[
                HoldFacts(first_line=int(first), count=int(count), why=str(why[0]) if why else "")
                for first, count, *why in opened.attrs.get("holds", [])
            ]
            + [
                HoldFacts(first_line=new.first_line, count=new.count, why=new.why)
                for new in _new_holds(path, opened)
            ],
        )

    def hold(self, name: str, request: HoldRequest) -> None:
        hold(self.path_of(name), request.first_line, request.lines, request.why)

    def picture(self, name: str) -> bytes:
        """Return a PNG of both arms, with time downwards. Raises PlaceError and DataError."""
        path = self.path_of(name)
        opened = open_recording(path)
        # A recording that grows has another picture, and so has another one of the same name.
        key = (name, opened.state, opened.lines, opened.attrs.get("run_id"))
        if key not in self._pictures:
            parts = [_arm_overview(opened, arm) for arm in ARMS]
            separator = np.full((parts[0].shape[0], 4, 3), 128, np.uint8)
            file = BytesIO()
            Image.fromarray(np.concatenate([parts[0], separator, parts[1]], axis=1)).save(file, "PNG")
            _remember(self._pictures, key, file.getvalue(), MOST_PICTURES)
        return self._pictures[key]

    def videos(self) -> list[VideoFacts]:
        """Return the videos, newest first."""
        return [self._video_facts(entry) for entry in self._entries(video=True)]

    def video(self, name: str) -> VideoFacts:
        """Return a video with its display range. Raises PlaceError and DataError."""
        path = self.path_of(name)
        video = open_video(path)
        # Another video may get the name of one that was removed.
        with refused(path, "read"):
            key = (name, (path / "zarr.json").stat().st_mtime_ns)
        if key not in self._ranges:
            # Black and white are the 0.1 % and 99.9 % quantiles of frames over the whole length.
            frames = video.video.shape[0]
            step = max(1, frames // SAMPLED_FRAMES)
            values = _sampled(video, range(0, frames, step))
            known = values[np.isfinite(values)]  # nothing of a video that was interrupted early
            black, white = map(float, np.quantile(known, (0.001, 0.999))) if known.size else (0.0, 0.0)
            _remember(self._ranges, key, (black, white if white > black else black + 1.0), MOST_PICTURES)
        low, high = self._ranges[key]
        missing = [(frames.start, frames.stop) for frames in video.missing()]
        return _video_facts(name, video).model_copy(update={"low": low, "high": high, "missing": missing})

    def frames(self, name: str, first: int, count: int) -> tuple[bytes, list[range]]:
        """Return consecutive 8-bit frames, as many as exist and fit into one answer, and the unreadable ones.

        Raises DataError if all of them are.
        """
        facts, video = self.video(name), open_video(self.path_of(name))
        most = max(1, MOST_FRAME_BYTES // (facts.rows * facts.columns))
        if not 0 <= first < facts.frames:
            raise UsageError(f"{name} has no frame {first}", possible=f"0 to {facts.frames - 1}")
        values, lost = video.readable(first, min(facts.frames, first + min(count, most)))
        # Voxels of tiles that were not written are NaN, and shown black.
        scaled = np.nan_to_num((values - facts.low) * (255 / max(facts.high - facts.low, 1e-12)))
        content: bytes = np.clip(scaled, 0, 255).astype(np.uint8).tobytes()
        return content, lost

    def _entries(self, *, video: bool) -> Iterator[_Entry]:
        """Yield the directory's newest videos or recordings, newest first, `MOST_LISTED` at most.

        One after the other, so that no more than one root document is kept in memory.
        """
        there = {}
        try:
            paths = candidates(self._directory)
        except OSError as error:
            raise PlaceError(f"{self._directory} cannot be listed: {error.strerror}") from error
        for path in paths:
            # Links are left out: lstat never reports one as a directory.
            with suppress(OSError):
                mode = path.lstat()
                if stat.S_ISDIR(mode.st_mode):
                    there[path.name] = mode.st_mtime_ns, path
        # Recordings come and go for weeks.
        self._kinds = {name: known for name, known in self._kinds.items() if name in there}
        self._facts = {name: known for name, known in self._facts.items() if name in there}
        left = MOST_LISTED
        for _, path in sorted(there.values(), reverse=True):
            entry, is_video = self._entry(path)
            if is_video is video:
                yield entry
                left -= 1
                if not left:
                    return

    def _entry(self, path: Path) -> tuple[_Entry, bool]:
        """Return an entry, and whether it is a video."""
        entry = _Entry(path, _stamp(path))
        known = self._kinds.get(path.name)
        # A page asks for both lists every three seconds, and there may be thousands of entries.
        if known is not None and known[0] == entry.stamp and entry.stamp is not None:
            return entry, known[1]
        is_video = False  # also of one that cannot be read: it is listed among the recordings, with the error
        with suppress(AcquireError):
            entry.root = read_root(source_of(path))
            is_video = (stated_format(entry.root) or "").startswith(VIDEO)
        self._kinds[path.name] = entry.stamp, is_video
        self._facts.pop(path.name, None)
        return entry, is_video

    def _recording_facts(self, entry: _Entry) -> RecordingFacts:
        """Return a recording's facts, from the cache if it is sealed and unchanged."""
        path, before = entry.path, self._facts.get(entry.path.name)
        if before is not None and before[0] == entry.stamp and isinstance(before[1], RecordingFacts):
            return before[1]
        try:
            known = _facts(path, open_outline(path, entry.root))
        except AcquireError as error:
            return RecordingFacts(name=path.name, error=shortened(error.message, 300))
        except (*DAMAGE, MemoryError) as error:
            return RecordingFacts(
                name=path.name, error=f"cannot be read: {shortened(cause_in_words(error), 300)}"
            )
        # A recording that is being written changes more often than its root document does.
        if known.state == "sealed" and entry.stamp is not None:
            self._facts[path.name] = entry.stamp, known
        return known

    def _video_facts(self, entry: _Entry) -> VideoFacts:
        """Return a video's facts, from the cache if it is unchanged: a video appears as a whole."""
        path, before = entry.path, self._facts.get(entry.path.name)
        if before is not None and before[0] == entry.stamp and isinstance(before[1], VideoFacts):
            return before[1]
        try:
            known = _video_facts(path.name, open_video(path))
        except AcquireError as error:
            return VideoFacts(name=path.name, error=shortened(error.message, 300))
        if entry.stamp is not None:
            self._facts[path.name] = entry.stamp, known
        return known


@dataclass(slots=True)
class _Entry:
    """An entry of the directory, with its root document if that had to be read just now."""

    path: Path
    stamp: _Stamp
    root: Document | None = None


def _is_file(path: Path, suffix: str) -> bool:
    """Return whether a path has the suffix, and is a file itself. Raises OSError."""
    return path.name.endswith(suffix) and stat.S_ISREG(path.lstat().st_mode)


def _stamp(path: Path) -> _Stamp:
    """Return what changes whenever the root document does, which is replaced as a whole; None without one."""
    try:
        found = (path / "zarr.json").stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size, found.st_ino


def _remember(cache: OrderedDict[Any, Any], key: Any, value: Any, most: int) -> None:
    cache[key] = value
    while len(cache) > most:
        cache.popitem(last=False)


def _new_holds(path: Path, opened: Outline) -> list[Hold]:
    """Return the holds that the writer has not listed yet, which it does at its next commit."""
    listed = {(first, count) for first, count, *_ in opened.attrs.get("holds", [])}
    return [held for held in holds_of(path) if (held.first_line, held.count) not in listed]


def _facts(path: Path, opened: Outline) -> RecordingFacts:
    info = opened.info()
    return RecordingFacts(
        name=path.name,
        run_id=info["run_id"],
        state=info["state"],
        condition=info["run_condition"],
        end_reason=info["end_reason"],
        first_line=info["first_line"],
        lines=info["lines"],
        duration_s=info["duration_s"],
        line_rate_hz=info["line_rate_hz"],
        bytes=info["bytes"],
        start_ns=info["start_ns"],
        lost_lines=info["lost_lines"],
        tainted_by=taint_words(info["ledger"].get("tainted_by", {})),
        events=info["events"],
        held=bool(info["holds"] or _new_holds(path, opened)),
        uploaded=upload_target(opened.attrs),
        damage=damage_in_words(opened),
        incomplete=info["tables_lack"],
    )


def _sampled(video: VideoFile, frames: range) -> NDArray[np.float32]:
    """Return those of the frames that can be read. Raises DataError if none can."""
    found, error = [], None
    for number in frames:
        try:
            found.append(video.frames(number, number + 1).astype(np.float32))
        except DataError as wrong:
            error = error or wrong
    if error is not None and not found:
        raise error
    return np.concatenate(found)


def _arm_overview(opened: Recording, arm: str) -> NDArray[np.uint8]:
    """Return the brightest values of one arm over the whole recording: (row, column, RGB)."""
    stream, white = opened.camera(arm), float(opened.attrs["cameras"][arm]["white_dn"])
    rows = min(PICTURE_ROWS, max(1, opened.lines))
    columns = min(PICTURE_COLUMNS, stream.pixels)
    edges = np.arange(columns) * stream.pixels // columns
    picture = np.zeros((PICTURE_ROWS, columns, 3), np.uint8)
    kept = opened.kept_rows()
    for row in range(rows if opened.lines else 0):
        start = row * opened.lines // rows
        stop = min(opened.lines, start + LINES_PER_ROW)
        # Dropped by retention, so that nothing of it is on the disk any more.
        if not any(start in rows for rows in kept):
            picture[row] = LOST_COLOUR
            continue
        try:
            lines, flags = stream.read("lines", start, stop), stream.read("flags", start, stop)
        except DataError:  # `RecordingFacts.damage` describes it, and the rest is shown
            picture[row] = LOST_COLOUR
            continue
        no_image = (flags & NO_IMAGE) != 0
        if no_image.all():
            picture[row] = LOST_COLOUR
            continue
        brightest = np.maximum.reduceat(lines[~no_image].max(axis=0).astype(np.float64), edges)
        picture[row] = np.clip(brightest * (255 / white), 0, 255).astype(np.uint8)[:, None]
    return picture[: max(rows, 1)]


def _video_facts(name: str, video: VideoFile) -> VideoFacts:
    frames, rows, columns = video.video.shape
    return VideoFacts(
        name=name,
        frames=frames,
        rows=rows,
        columns=columns,
        interval_ns=video.interval_ns,
        start_ns=int(video.time_ns[0]) if len(video.time_ns) else None,
        trusted=None if video.trusted is None else (video.trusted.start, video.trusted.stop),
    )
