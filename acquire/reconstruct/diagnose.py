"""Diagnosis of a recording: a range of its lines is compared with its description."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from acquire.calibrate import calibrated
from acquire.codes import code_from_attrs
from acquire.lines import ARMS
from acquire.recon.diagnosis import TURNED, Diagnosis, diagnose
from acquire.recon.hypotheses import AS_BUILT, MOST_LINES, Hypothesis
from acquire.recon.search import Standing
from acquire.reconstruct.reorient import reoriented
from acquire.reconstruct.select import by_lines
from acquire.stream.lightcheck import Judge, Sight, Verdict, explain

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.calibrate import Calibration
    from acquire.fibre import Tile
    from acquire.lines import Segment
    from acquire.store import Recording

SINCE = "since the calibration was made"
FAR_LINES = 8192
"""Lines for the light check, which finds delays of thousands of sub-steps."""


def diagnosed_range(recording: Recording, first_line: int | None, lines: int | None) -> tuple[int, int]:
    """Return first line and number of the lines to diagnose: as requested, or the middle of the recording."""
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
    """Find the hypothesis that explains the lines; if none does, ask the light check, which looks farther.

    Lines are read with the ``calibration``, as for a reconstruction; behind a fibre those of one ``tile``.

    Raises UsageError and DataError as `Recording.cut` does.
    """
    first, count = diagnosed_range(recording, first_line, lines)
    segment = recording.cut(first, count, tile)
    if calibration is not None:
        segment = calibrated(segment, calibration)
    code = code_from_attrs(recording.attrs["code"])
    # It also gives bits before and after the segment's: a delay moves it along the code.
    begin = segment.geometry.substeps * first

    def bits(start: int, length: int) -> NDArray[np.uint8]:
        return code.bits(begin + start, length)

    found = diagnose(segment, bits)
    turn = AS_BUILT if found.hypothesis is None else found.hypothesis.turn
    if calibration is not None and found.standing is Standing.NAMED and turn in TURNED:
        return _since_calibration(found, recording.cut(first, count, tile), calibration)
    if found.standing is not Standing.UNEXPLAINED:
        return found
    return _with_light_check(recording, found, tile)


def _since_calibration(found: Diagnosis, segment: Segment, calibration: Calibration) -> Diagnosis:
    """Complete a diagnosis of turned arms: a calibration with their orientation was made before the turn.

    A delay that was found together with it may be the alignment's, which no longer lies where it was.
    """
    if calibration.orientation is None and calibration.alignment is None:
        return found
    assert found.hypothesis is not None
    turn = found.hypothesis.turn
    if calibration.alignment is None or not reoriented(segment, calibration, turn).aligned:
        return replace(found, sentence=f"{found.sentence} ({SINCE})")
    return replace(
        found, sentence=f"{TURNED[turn]} ({SINCE})", hypothesis=Hypothesis(turn=turn), alternative=None
    )


def _with_light_check(recording: Recording, found: Diagnosis, tile: Tile | None) -> Diagnosis:
    """Complete an unexplained diagnosis with the light check's verdict on up to `FAR_LINES` lines."""
    stream = by_lines(recording).stream
    whole = stream.end_line - stream.first_line
    count = min(FAR_LINES, whole)
    first = stream.first_line + (whole - count) // 2
    segment = recording.cut(first, count, tile)
    judge = Judge(
        stages=segment.geometry.stages,
        substeps=segment.geometry.substeps,
        code=code_from_attrs(recording.attrs["code"]),
        white_dn=int(segment.lines.max()),  # what counts as dark is relative to it
        registration=dict.fromkeys(ARMS, 0),  # a known delay would be found, and named, too
    )
    findings = judge.look(first, _sights(segment))
    shifted = all(finding.verdict is Verdict.SHIFTED for finding in findings.values())
    delays = {finding.shift for finding in findings.values()}
    # Arms with different delays are no common delay of the lines, which is all that is named here.
    if not shifted or len(delays) != 1:
        words = f"light check of {count} lines: {explain(findings, segment.geometry.substeps)}"
        return replace(found, sentence=f"{found.sentence} ({words})")
    late = delays.pop()
    return replace(
        found,
        standing=Standing.NAMED,
        sentence=f"the lines are {abs(late)} sub-steps {'late' if late > 0 else 'early'} against the code",
        hypothesis=Hypothesis(late=(late, late)),
    )


def _sights(segment: Segment) -> dict[str, Sight]:
    """Return the mean of each line and of each column above black, per arm, over usable samples."""
    # There is one level, or one per arm: no calibration was applied, which would have one per column.
    black = np.broadcast_to(np.asarray(segment.black_level_dn, float).reshape(-1), (2,))
    sights = {}
    for name, lines, mask, level in zip(ARMS, segment.lines, segment.mask, black, strict=True):
        light = np.maximum(lines - level, 0.0)  # of lost samples none, of saturated ones the most
        dn = np.where(mask, lines - level, 0.0)
        per_line, per_column = mask.sum(1), np.maximum(mask.sum(0), 1)
        energy = np.where(per_line > 0, dn.sum(1) / np.maximum(per_line, 1), np.nan)
        saturated = float(light[~mask].sum() / max(light.sum(), 1e-12))
        sights[name] = Sight(energy, dn.sum(0) / per_column, saturated)
    return sights
