"""Simulated cameras that replay a recording: real lines for tests, load tests and demonstrations.

Line ℓ of the new run is row ℓ of the recording, and the code is the stored one from that row on, since the
state of the code's register can be computed at any index (`replay_code`). Lines that were missing are missing
again, and the other flags of a line are replayed with it, as properties of the stored line. Rows repeated in
a loop meet a code that is not theirs: from the second round on they are flagged as such.

With a ``gate``, which is a file, no line comes before that file exists. The caller creates it once the new
recording has begun, however long that takes on a busy host. The last row is followed by dark lines, which
complete a recording whose own last lines are missing.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire import __version__
from acquire.camera.base import CameraBlock, CameraIdentity
from acquire.codes import ConstantCode, PrbsCode, code_from_attrs, state_at
from acquire.errors import CameraError, UsageError
from acquire.geometry import Geometry
from acquire.lines import LineFlag
from acquire.store import open_recording
from acquire.store.present import flags_of, present_values

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.camera.base import Camera
    from acquire.codes import Code
    from acquire.sim.clock import Wire
    from acquire.store.reader import Recording

_PAGE_LINES = 4096
_NAP_S = 0.001
_CATCH_UP = Fraction(5, 4)
"""Lines per pulse of a camera that catches up."""


def replay_code(recording: Recording) -> Code:
    """Return the code of a run whose line 0 is the recording's first line."""
    code = code_from_attrs(recording.attrs["code"])
    index = recording.geometry_for(1).substeps * recording.first_line
    # a register that starts in the state of that index makes the same bits from there on
    if isinstance(code, PrbsCode):
        return PrbsCode(code.degree, state_at(code.degree, code.state, index))
    if isinstance(code, ConstantCode):
        return code
    raise UsageError(
        f"{recording} cannot be replayed: its code is of kind {recording.attrs['code']['kind']!r}, which the "
        "simulated trigger cannot generate",
        possible="recordings with codes of kind prbs or constant",
    )


def describe_replay(path: Path) -> dict[str, Any]:
    """Return the origin of replayed lines for the new recording, as the first recording states it (JSON)."""
    attrs = open_recording(path).attrs
    keys = ("simulated", "scene", "effects", "plugins")
    kept: dict[str, Any] = {key: attrs[key] for key in keys if key in attrs}
    return {**kept, "replayed": {"run_id": attrs["run_id"], "first_line": attrs["first_line"]}}


@dataclass(frozen=True, slots=True)
class ReplayCameraOpener:
    """Opens one arm of a recording as a camera. Picklable.

    No line comes before the file ``gate`` exists, so that a recording can be started before the first line.
    """

    wire: Wire
    path: Path
    arm: str
    block_lines: int
    loop: bool = False
    gate: Path | None = None

    def __call__(self) -> Camera:
        return ReplayCamera(self)


class ReplayCamera:
    """Reads out one stored line per pulse on the wire, in blocks; stops at the end unless it loops."""

    def __init__(self, opener: ReplayCameraOpener) -> None:
        self._opener = opener
        self._wire = opener.wire
        self._recording = open_recording(opener.path)
        self._stream = self._recording.camera(opener.arm)
        geometry = self._recording.geometry_for(1)
        self._depth_lines = Geometry(geometry.stages, geometry.substeps, 1).depth_lines
        self._rows = self._recording.lines
        self._open = opener.gate is None
        self._tail_lines = 0 if opener.gate is None else opener.block_lines
        self._run: int | None = None
        self._delivered = self._lost = 0
        self._not_before_ns = 0
        self._ready: deque[CameraBlock] = deque()
        self._page: tuple[int, NDArray[Any], NDArray[np.uint16]] | None = None

    def identify(self) -> CameraIdentity:
        return CameraIdentity("acquire", "replayed TDI camera", str(self._opener.path), __version__)

    def settings(self) -> dict[str, Any]:
        """Return the settings stored in the recording."""
        return dict(self._recording.attrs["cameras"][self._opener.arm])

    def arm(self) -> None:
        """Follow the next train of pulses from its beginning."""
        reading = self._wire.read()
        if reading.running:
            raise CameraError(
                "a replay cannot be armed while the trigger is running", hint="arm it before the start"
            )
        self._run = reading.run + 1
        self._delivered = self._lost = 0
        self._not_before_ns = 0
        self._ready.clear()

    def next_block(self, timeout_s: float) -> CameraBlock | None:
        """Return the next lines that are due; None at the end, and if all lines of a block are missing."""
        if self._run is None:
            raise CameraError("a block was requested from a camera that is not armed", hint="arm it")
        if self._ready:
            return self._ready.popleft()
        deadline_ns = self._wire.clock.monotonic_ns() + int(timeout_s * 1e9)
        while not (count := self._deliverable()):
            if self._wire.clock.monotonic_ns() >= deadline_ns:
                return None
            self._wire.clock.sleep(min(_NAP_S, timeout_s))
        self._ready.extend(self._blocks(count))
        return self._ready.popleft() if self._ready else None

    def release(self, block: CameraBlock) -> None:
        """Do nothing: every block has its own memory."""

    def disarm(self) -> None:
        self._run = None

    def statistics(self) -> dict[str, int]:
        return {"lines": self._delivered - self._lost, "lost": self._lost, "behind_lines": self._due()}

    def close(self) -> None:
        self.disarm()

    def _deliverable(self) -> int:
        """Return the number of lines of the next block, 0 before it is due.

        A camera that fell behind catches up, but only at a limited rate: stored lines can be read so much
        faster than pulses come that the ring would overflow.
        """
        now_ns, count, reading = self._wire.clock.monotonic_ns(), self._due(), self._wire.read()
        # The last block may be short, since no further lines will come to fill it.
        last = not self._opener.loop and self._delivered + count >= self._last
        whole = count >= self._opener.block_lines or last or reading.stopped
        if now_ns < self._not_before_ns or not whole:
            return 0
        count = min(count, self._opener.block_lines)
        train = reading.train
        if train is not None:
            self._not_before_ns = now_ns + int(count * train.line_period_ns / train.speed / _CATCH_UP)
        return count

    def _due(self) -> int:
        """Return the lines whose pulses have come but that are not delivered; 0 while the gate is closed."""
        reading, gate = self._wire.read(), self._opener.gate
        self._open = self._open or gate is None or gate.exists()  # once open, it stays open
        if reading.train is None or reading.run != self._run or not self._open:
            return 0
        issued = reading.train.issued(self._wire.clock.monotonic_ns())
        last = issued if self._opener.loop else min(issued, self._last)
        return last - self._delivered

    @property
    def _last(self) -> int:
        """Total lines without a loop: the preroll before line 0, the rows, and the dark tail."""
        return self._depth_lines + self._rows + self._tail_lines

    def _blocks(self, count: int) -> Iterator[CameraBlock]:
        """Return the next ``count`` lines as blocks, without the missing ones."""
        position = self._delivered
        self._delivered += count
        while position < self._delivered:
            # the first pulses read out what was on the sensor before line 0
            line, left = position - self._depth_lines, self._delivered - position
            if line < 0:
                pixels, flags = self._dark(min(-line, left))
            elif line >= self._rows and not self._opener.loop:
                pixels, flags = self._dark(left)
            else:
                pixels, flags = self._stored(line, left)
            missing = (flags & LineFlag.MISSING) != 0
            self._lost += int(missing.sum())
            edges = np.flatnonzero(np.diff(missing, prepend=True, append=True))
            for begin, end in edges.reshape(-1, 2).tolist():
                yield CameraBlock(
                    position + begin, pixels[begin:end], flags[begin:end] & ~np.uint16(LineFlag.MISSING)
                )
            position += len(flags)

    def _dark(self, count: int) -> tuple[NDArray[Any], NDArray[np.uint16]]:
        """Return dark lines for before line 0 and after the last, which no recording keeps."""
        pixels = np.zeros((count, self._stream.pixels), self._stream.dtype)
        return pixels, np.zeros(count, np.uint16)

    def _stored(self, line: int, count: int) -> tuple[NDArray[Any], NDArray[np.uint16]]:
        """Return rows from ``line`` on, up to ``count`` or the end of the page that holds it."""
        round_number, row = divmod(line, self._rows)
        page, skip = divmod(row, _PAGE_LINES)
        if self._page is None or self._page[0] != page:
            start, stop = page * _PAGE_LINES, min((page + 1) * _PAGE_LINES, self._rows)
            flags = flags_of(self._recording, self._opener.arm, start, stop)
            pixels = present_values(self._recording, self._opener.arm, "lines", start, flags)
            # in the host's byte order, as a camera's samples; a recording has the format's
            self._page = (page, pixels.astype(self._stream.dtype.newbyteorder("=")), flags)
        _, pixels, flags = self._page
        part = slice(skip, skip + count)
        foreign_code = np.uint16(LineFlag.CODE_UNVERIFIED if round_number else 0)
        return pixels[part], flags[part] | foreign_code
