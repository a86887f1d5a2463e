"""The calibration that the page's steps extend: its path, its steps and their findings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from acquire.calibrate.guide import BLACK, STEPS, TARGET, Step, lines_of
from acquire.errors import AcquireError, DataError, NoDaemonError, PlaceError, UsageError
from acquire.text import cause_in_words, shortened
from acquire.web.messages import (
    CalibrationFacts,
    CalibrationRequest,
    FindingFacts,
    ForgetRequest,
    StepFacts,
)

if TYPE_CHECKING:
    from acquire.calibrate import Calibration
    from acquire.daemon.facts import Setup

RECORDINGS = "calibration-recordings"
"""Directory of the steps' recordings, below that of the other recordings."""
UNNAMED = "calibration.zarr"
"""Name of the calibration in that directory if the rig names none."""


def place_of(directory: Path, setup: Setup | None) -> tuple[Path, bool]:
    """Return the path of the calibration, and whether the rig names it.

    Raises NoDaemonError if the rig is not known yet.
    """
    if setup is None:
        raise NoDaemonError("the daemon has not reported its rig yet", hint="again in a moment")
    named = setup.config.get("calibration")
    return (Path(str(named)), True) if named else (directory / RECORDINGS / UNNAMED, False)


def rows_of(setup: Setup | None) -> int:
    """Return the number of fine rows that the rig's sensors see (n = M·S); 0 if it is not known yet."""
    geometry = {} if setup is None else setup.config.get("geometry", {})
    return int(geometry.get("stages", 0) * geometry.get("substeps", 0))


def calibration_facts(place: Path, *, named: bool, rows: int) -> CalibrationFacts:
    """Return the steps and their findings, for a sensor that sees ``rows`` fine rows. Blocks on the disk.

    If the calibration cannot be read, the error is returned with steps that have no findings.
    """
    from acquire.calibrate.file import open_calibration  # imports large libraries, so only on demand

    error = None
    try:
        try:
            known = open_calibration(place)
        except PlaceError:
            if place.exists():
                raise
            known = None  # no step has been carried out yet
        steps = [_step(step, known, rows) for step in STEPS]
    except AcquireError as problem:
        error = shortened(problem.message, 300)
        steps = [_step(step, None, rows) for step in STEPS]
    return CalibrationFacts(path=str(place), named=named, error=error, steps=steps)


def forget(place: Path, request: ForgetRequest) -> None:
    """Take steps out of the calibration. Blocks on the disk.

    Raises UsageError for a step that was not done or that others need, and if none would be left.
    """
    from acquire.calibrate.file import change_calibration
    from acquire.calibrate.forget import without

    change_calibration(place, lambda known: without(known, request.steps, str(place)))


def step_of(request: CalibrationRequest) -> Step:
    """Return the step that a request names.

    Raises UsageError if there is none, for too few lines, and for black parts where there is no target.
    """
    step = next((each for each in STEPS if each.name == request.step), None)
    if step is None:
        raise UsageError(
            f"there is no step {request.step!r}", possible=", ".join(each.name for each in STEPS)
        )
    if request.lines is not None and request.lines < step.least_lines:
        raise UsageError(
            f"{request.lines} lines are too few for the step {step.name!r}",
            possible=f"{step.least_lines} or more",
        )
    if request.black and step is not TARGET:
        raise UsageError(
            f"the step {step.name!r} cannot have black parts",
            possible=f"'black' with the step {TARGET.name!r}",
        )
    return step


def _step(step: Step, known: Calibration | None, rows: int) -> StepFacts:
    found = []
    # The first finding is the step's own; the others may come from another step, too.
    if known is not None and step.finds[0] in known.steps:
        found = [_finding(known, name) for name in step.finds if name in known.steps]
    return StepFacts(
        name=step.name,
        prepare=step.prepare,
        lines=lines_of(step, rows),
        least_lines=step.least_lines,
        after=step.after,
        black=BLACK if step is TARGET else "",
        found=found,
    )


def _finding(known: Calibration, name: str) -> FindingFacts:
    from acquire.calibrate.forget import with_dependents
    from acquire.calibrate.words import found_facts

    try:
        going, why = with_dependents(known, {name})
        finding = known.finding(name)
        facts = {key: str(text) for key, text in found_facts(finding).items() if text is not None}
        return FindingFacts(
            name=name,
            made=str(finding.facts["made"]),
            facts={key: text for key, text in facts.items() if key != "step"},
            lines=int(finding.facts.get("lines", 0)),
            warnings=list(finding.warnings),
            also=[each for each in known.steps if each in going and each != name],
            why=why,
        )
    except (LookupError, TypeError, ValueError) as error:
        raise DataError(
            f"the step {name!r} of the calibration cannot be read: {cause_in_words(error)}",
            hint="measure it again",
        ) from error
