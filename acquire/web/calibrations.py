"""The calibration that the page's steps add to: where it is, what is to be done, what was found."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from acquire.calibrate.guide import STEPS, Step
from acquire.errors import AcquireError, DataError, NoDaemonError, PlaceError, UsageError
from acquire.text import shortened
from acquire.web.messages import CalibrationFacts, CalibrationRequest, FindingFacts, StepFacts

if TYPE_CHECKING:
    from acquire.calibrate import Calibration
    from acquire.daemon.facts import Setup

RECORDINGS = "calibration-recordings"
"""Directory of what the steps record, below that of the recordings, as the command's is below where it is."""
UNNAMED = "calibration.zarr"
"""In that directory, where the rig names no calibration."""


def place_of(directory: Path, setup: Setup | None) -> tuple[Path, bool]:
    """Where the calibration is kept, and whether that is the one that the rig names.

    Raises NoDaemonError where that is not known yet.
    """
    if setup is None:
        raise NoDaemonError("the daemon has not said yet what its rig is", hint="again in a moment")
    named = setup.config.get("calibration")
    return (Path(str(named)), True) if named else (directory / RECORDINGS / UNNAMED, False)


def calibration_facts(place: Path, *, named: bool) -> CalibrationFacts:
    """For one thread that may wait for the disk. What cannot be read is told, and the steps all the same."""
    known, error = None, None
    try:
        known = _open(place)
        steps = [_step(step, known) for step in STEPS]
    except AcquireError as trouble:
        error = shortened(trouble.message, 300)
        steps = [_step(step, None) for step in STEPS]
    return CalibrationFacts(path=str(place), named=named, error=error, steps=steps)


def step_of(request: CalibrationRequest) -> Step:
    """Raises UsageError for a step that there is not, or too few lines of it."""
    step = next((one for one in STEPS if one.name == request.step), None)
    if step is None:
        raise UsageError(
            f"the step {request.step!r} is not known", possible=", ".join(one.name for one in STEPS)
        )
    if request.lines is not None and request.lines < step.least_lines:
        raise UsageError(
            f"{request.lines} lines are too few for the step {step.name!r}",
            possible=f"{step.least_lines} or more",
        )
    return step


def _open(place: Path) -> Calibration | None:
    from acquire.calibrate.file import open_calibration  # its libraries: when somebody asks

    try:
        return open_calibration(place)
    except PlaceError:
        if place.exists():
            raise
        return None


def _step(step: Step, known: Calibration | None) -> StepFacts:
    found = []
    if known is not None and step.finds[0] in known.steps:  # others may be known by another step, too
        found = [_finding(known, name) for name in step.finds if name in known.steps]
    return StepFacts(
        name=step.name,
        prepare=step.prepare,
        lines=step.lines,
        least_lines=step.least_lines,
        after=step.after,
        found=found,
    )


def _finding(known: Calibration, name: str) -> FindingFacts:
    from acquire.calibrate.words import found_facts

    try:
        finding = known.finding(name)
        facts = {key: str(text) for key, text in found_facts(finding).items() if text is not None}
        return FindingFacts(
            name=name,
            made=str(finding.facts["made"]),
            facts={key: text for key, text in facts.items() if key != "step"},
            lines=int(finding.facts.get("lines", 0)),
            warnings=list(finding.warnings),
        )
    except (LookupError, TypeError, ValueError) as error:
        raise DataError(f"the step {name!r} of the calibration cannot be read: {error!r}") from error
