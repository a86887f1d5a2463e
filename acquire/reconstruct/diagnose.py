"""A stretch of a recording held against what the recording says of it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from acquire.calibrate import calibrated
from acquire.codes import code_from_attrs
from acquire.lines import ARMS
from acquire.recon.diagnosis import Diagnosis, diagnose
from acquire.recon.hypotheses import MOST_LINES, Hypothesis
from acquire.recon.search import Standing
from acquire.reconstruct.select import by_lines
from acquire.stream.lightcheck import Finding, Judge, Sight, Verdict, explain

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.calibrate import Calibration
    from acquire.fibre import Tile
    from acquire.lines import Segment
    from acquire.recon.segments import Stream
    from acquire.store import Recording

FAR_LINES = 8192
"""That the light check takes, which finds delays of thousands of sub-steps."""


def stretch(recording: Recording, first_line: int | None, lines: int | None) -> tuple[int, int]:
    """First line and number of those to look at: as asked, or the middle of the recording."""
    stream = by_lines(recording, first_line, lines).stream
    if lines is not None:
        return stream.first_line, lines
    count = stream.end_line - stream.first_line
    taken = min(count, max(MOST_LINES, 2 * stream.stages))
    return stream.first_line + (0 if first_line is not None else (count - taken) // 2), taken


def diagnose_recording(
    recording: Recording,
    first_line: int | None,
    lines: int | None,
    calibration: Calibration | None = None,
    tile: Tile | None = None,
) -> Diagnosis:
    """Which hypothesis explains the lines; where none near does, what the light check finds farther off.

    Lines are read with the ``calibration``, as for a reconstruction; behind a fibre those of one ``tile``.

    UsageError and DataError as `Recording.cut` raises them.
    """
    first, count = stretch(recording, first_line, lines)
    segment = recording.cut(first, count, tile)
    if calibration is not None:
        segment = calibrated(segment, calibration)
    code = code_from_attrs(recording.attrs["code"])
    begin = segment.geometry.substeps * first

    def bits(start: int, length: int) -> NDArray[np.uint8]:
        return code.bits(begin + start, length)

    found = diagnose(segment, bits)
    if found.standing is not Standing.UNEXPLAINED:
        return found
    return _farther(recording, by_lines(recording).stream, found, tile)


def _farther(recording: Recording, stream: Stream, found: Diagnosis, tile: Tile | None) -> Diagnosis:
    """With the light check's word on as many lines as it likes, where that is more."""
    whole = stream.end_line - stream.first_line
    count = min(FAR_LINES, whole)
    first = stream.first_line + (whole - count) // 2
    segment = recording.cut(first, count, tile)
    judge = Judge(
        stages=segment.geometry.stages,
        substeps=segment.geometry.substeps,
        code=code_from_attrs(recording.attrs["code"]),
        white_dn=int(segment.lines.max()),
        registration=dict.fromkeys(ARMS, 0),
    )
    findings = judge.look(first, _sights(segment))
    words = f"light check of {count} lines: {explain(findings, segment.geometry.substeps)}"
    late = _agreed_delay(findings)
    if late is None:
        return replace(found, sentence=f"{found.sentence} ({words})")
    return replace(
        found,
        standing=Standing.NAMED,
        sentence=f"the lines are {abs(late)} sub-steps {'late' if late > 0 else 'early'} against the code",
        hypothesis=Hypothesis(late=(late, late)),
    )


def _agreed_delay(findings: dict[str, Finding]) -> int | None:
    """The delay that both arms show."""
    shifted = all(finding.verdict is Verdict.SHIFTED for finding in findings.values())
    delays = {finding.shift for finding in findings.values()}
    return delays.pop() if shifted and len(delays) == 1 else None


def _sights(segment: Segment) -> dict[str, Sight]:
    black = np.broadcast_to(np.asarray(segment.black_level_dn, float).reshape(-1), (2,))
    sights = {}
    for name, lines, mask, level in zip(ARMS, segment.lines, segment.mask, black, strict=True):
        dn = np.where(mask, lines - level, 0.0)
        seen = np.maximum(mask.sum(1), 1), np.maximum(mask.sum(0), 1)
        sights[name] = Sight(dn.sum(1) / seen[0], dn.sum(0) / seen[1])
    return sights
