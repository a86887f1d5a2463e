"""A small recording of known lines, as a command is given one."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from acquire.clock import ClockFit
from acquire.codes import PrbsCode
from acquire.lines import ARMS, LineFlag, LineTable, TaggedBlock
from acquire.store import RecordingSpec, RecordingWriter, RunCondition

M, S, FIRST, LINES = 4, 2, 100, 64
CODE = PrbsCode(15, 77)


def spec() -> RecordingSpec:
    camera = {"white_dn": 4095, "black_level_dn": 1.0, "responsivity_dn": 2.0}
    return RecordingSpec(
        run_id="run-1",
        stages=M,
        substeps=S,
        pixels=M,
        dtype="uint16",
        first_line=FIRST,
        clock=ClockFit(90_000_000, 1_700_000_000_000_000_000, 100),
        code=CODE.to_attrs(),
        substep_ticks=900,
        trigger={"model": "test"},
        cameras={"a": camera, "b": camera},
        config={},
        chunk_lines=16,
    )


def block(arm: str, lost: range) -> TaggedBlock:
    line = np.arange(FIRST, FIRST + LINES, dtype=np.uint64)
    bits = CODE.bits(S * FIRST, S * LINES).reshape(LINES, S)
    flags = np.where(np.isin(line, lost), LineFlag.MISSING, 0).astype(np.uint16)
    return TaggedBlock(
        arm=arm,
        first_line=FIRST,
        pixels=np.full((LINES, M), 7 if arm == "a" else 9, np.uint16),
        flags=flags,
        tags=LineTable(
            code_index=S * line,
            code=np.packbits(bits, axis=1, bitorder="little")[:, 0],
            tick=900 * S * line,
            time_ns=(20_000 * line).astype(np.int64),
        ),
    )


def write(path: Path, lost: range = range(0)) -> Path:
    with RecordingWriter.create(path, spec()) as writer:
        for arm in ARMS:
            gone = lost if arm == "b" else range(0)
            if gone:
                writer.add_gap(arm, gone.start, len(gone), "ring_full")
            writer.append(block(arm, gone))
        condition = RunCondition.INCOMPLETE if lost else RunCondition.GOOD
        writer.seal(condition, "stopped", {})
    return path
