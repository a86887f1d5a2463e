"""Recordings whose every value follows from its line number, so that any of them can be checked alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.clock import ClockFit
from acquire.codes import PrbsCode
from acquire.geometry import Geometry
from acquire.lines import ARMS, LineTable, TaggedBlock
from acquire.store import RecordingSpec

if TYPE_CHECKING:
    from acquire.store import RecordingWriter

CLOCK = ClockFit(90_000_000, 1_790_000_000_123_456_789, 1500)
CODE = PrbsCode.from_seed(64, 7)
CAMERA = {"white_dn": 4095, "black_level_dn": 10.0, "responsivity_dn": 6.0, "DeviceSerialNumber": "S"}


def make_spec(**changes: Any) -> RecordingSpec:
    stages = changes.get("pixels", 8)
    small = changes.get("dtype") == "uint8"
    camera = {**CAMERA, "white_dn": 255} if small else CAMERA
    spec = RecordingSpec(
        run_id="run-1",
        stages=stages,
        substeps=3,
        pixels=stages,
        dtype="uint16",
        first_line=1000,
        clock=CLOCK,
        code=CODE.to_attrs(),
        substep_ticks=900,
        trigger={"model": "simulated", "serial": "T1"},
        cameras={"a": camera, "b": camera},
        config={"name": "test"},
        extra={"simulated": True, "scene": {"kind": "leds"}},
        chunk_lines=16,
        shard_chunks=4,
        codec="lz4",
        fsync="seal",
    )
    return replace(spec, **changes)


@dataclass(frozen=True)
class Truth:
    """What the lines ``first .. first + count - 1`` of an arm hold."""

    spec: RecordingSpec

    def block(self, arm: str, first: int, count: int) -> TaggedBlock:
        spec, S = self.spec, self.spec.substeps
        line = np.arange(first, first + count)
        bits = CODE.bits(S * first, S * count).reshape(count, S)
        size = Geometry(spec.stages, S, 1).size
        tick = ((S * line + size - 1) * spec.substep_ticks).astype(np.uint64)
        return TaggedBlock(
            arm=arm,
            first_line=first,
            pixels=self.pixels(arm, line),
            flags=np.where(line % 50 == 49, 8, 0).astype(np.uint16),
            tags=LineTable(
                code_index=(S * line).astype(np.uint64),
                code=np.packbits(bits, axis=1, bitorder="little")[:, 0],
                tick=tick,
                time_ns=spec.clock.time_ns(tick),
            ),
        )

    def pixels(self, arm: str, line: np.ndarray) -> np.ndarray:
        """Never 0, never saturated: what was not written differs from everything that was."""
        pixel = np.arange(self.spec.pixels)
        mixed = line[:, None] * 7919 + pixel * 104_729 + ARMS.index(arm) * 13
        top = 250 if self.spec.dtype == "uint8" else 4000
        return (mixed % top + 1).astype(self.spec.dtype)

    def arrays(self, arm: str, first: int, count: int) -> dict[str, np.ndarray]:
        """By their names in the recording."""
        block = self.block(arm, first, count)
        return {
            "lines": block.pixels,
            "flags": block.flags,
            "code_index": block.tags.code_index,
            "code": block.tags.code,
            "tick": block.tags.tick,
            "time": block.tags.time_ns,
        }


def array_of(block: TaggedBlock, name: str) -> np.ndarray:
    """The block's pixels, its flags or one of its tags."""
    return getattr(block if name in ("pixels", "flags") else block.tags, name)


def with_array(block: TaggedBlock, name: str, values: np.ndarray) -> TaggedBlock:
    """The block with other pixels, flags or tags."""
    if name in ("pixels", "flags"):
        return replace(block, **{name: values})
    return replace(block, tags=replace(block.tags, **{name: values}))


def fill(writer: RecordingWriter, lines: int, block_lines: int = 37) -> None:
    """Append ``lines`` lines to both arms."""
    truth = Truth(writer.spec)
    first = writer.next_line("a")
    for start in range(first, first + lines, block_lines):
        count = min(block_lines, first + lines - start)
        for arm in ARMS:
            writer.append(truth.block(arm, start, count))


def check_rows(root: Any, spec: RecordingSpec, rows: int, since: int = 0) -> None:
    """Rows ``since .. rows - 1`` in plain zarr-python hold the truth, and there are no more rows."""
    for arm in ARMS:
        expected = Truth(spec).arrays(arm, spec.first_line + since, rows - since)
        for name, values in expected.items():
            array = root[arm][name]
            assert array.shape[0] == rows, f"{arm}/{name}"
            assert array.dtype == values.dtype, f"{arm}/{name}"
            np.testing.assert_array_equal(array[since:rows], values, err_msg=f"{arm}/{name}")
