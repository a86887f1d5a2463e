"""Check of a calibration against a new recording: is it still valid?"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from acquire.calibrate.apply import check_fits
from acquire.calibrate.columns import dark, flat
from acquire.calibrate.field import field_edge
from acquire.calibrate.psf import psf
from acquire.calibrate.target import alignment, orientation
from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from acquire.calibrate.calibration import Calibration, Finding
    from acquire.calibrate.exposure import Exposure

SURE = 5.0
"""Standard uncertainties from which a difference is significant."""
MATTERS = {
    "offset_dn": 0.5,
    "gain": 0.003,
    "balance": 0.003,
    "pixels": 0.15,
    "turn_deg": 0.1,
    "blur_px": 0.15,
}
"""Changes that a reconstruction notices; smaller ones leave a calibration true, however certain they are."""


@dataclass(frozen=True, slots=True)
class Compared:
    """Change of one quantity: ``change`` is the largest of its elements, ``sure`` its uncertainty."""

    quantity: str
    unit: str
    change: float
    sure: float
    matters: float

    @property
    def holds(self) -> bool:
        """Whether the change is too small for a reconstruction to notice, or not significant."""
        return abs(self.change) <= max(self.matters, SURE * self.sure)


@dataclass(frozen=True, slots=True)
class Check:
    """Result of comparing a recording with a calibration.

    ``doubts`` are further concerns, apart from the compared quantities. ``same_view`` is whether nothing
    contradicts the orientation.
    """

    compared: tuple[Compared, ...]
    doubts: tuple[str, ...]
    same_view: bool = True

    @property
    def holds(self) -> bool:
        return self.same_view and all(each.holds for each in self.compared)


def check(exposure: Exposure, known: Calibration, *, covered: bool = False) -> Check:
    """Compare a recording of dark lines, a flat or a target, depending on its code, with a calibration.

    Raises UsageError if it is of another instrument, or shows none of these.
    """
    doubts = check_fits(known, exposure.recording)
    if exposure.code_value == 0 or covered:
        found = dark(exposure, covered=covered)
        return Check(tuple(_columns(found, known, "offset_dn", "DN")), doubts)
    if exposure.code_value == 1:
        found = flat(exposure, known)
        corrected = found
        if known.alignment is not None:
            # as `align` corrected the calibration's own flat
            # calibrations from before it was noted have a fall of the light if there was one
            dimmed = bool(known.steps.get("align", {}).get("dimmed", "shading" in known.quantities))
            edge = field_edge(known.with_step(found), known.alignment.alignment, dimmed=dimmed)
            corrected = replace(found, quantities={**found.quantities, **edge.quantities})
        compared = list(_columns(corrected, known, "gain", "1"))
        # The flats themselves, since an alignment may have corrected the balance of the calibration.
        before = known.steps.get("flat", {}).get("part_a")
        if before is not None:
            change, balance = found.facts["part_a"] - before, found.quantities["balance"]
            sure = float(np.hypot(*balance.uncertainty))
            compared.append(Compared("arm A's part of the light", "1", change, sure, MATTERS["balance"]))
        return Check(tuple(compared), doubts)
    if exposure.recording.fibre is not None:
        raise UsageError(
            f"{exposure.recording} shows a target behind a fibre, which is not compared tile by tile",
            possible="a dark or a flat; or `acquire calibrate align`, which measures each tile's alignment",
        )
    blur: tuple[Compared, ...] = ()
    if "blur_px" in known.quantities:
        try:
            blur = tuple(_blur(psf(exposure, known), known))
        except UsageError as error:  # many targets have no edges that show the blur
            doubts += (f"the optics' blur was not compared: {error.message}",)
    found = orientation(exposure, known)
    expected = known.orientation or "turn 90"  # `MODEL`, if none was measured
    if found.orientation is None or found.orientation != expected:
        result = "is not clear" if found.orientation is None else f"is {found.orientation!r}"
        doubt = f"the orientation {result}; the calibration has {expected!r}"
        return Check(blur, (*doubts, doubt), same_view=found.orientation is None)
    return Check((*_alignment(alignment(exposure, known), known), *blur), doubts)


def _columns(found: Finding, known: Calibration, name: str, unit: str) -> Iterator[Compared]:
    if name not in known.quantities:
        return
    before, now = known.quantities[name], found.quantities[name]
    good = np.ones(now.value.shape, np.bool_)
    if known.usable is not None and known.usable.shape == good.shape:
        good &= known.usable
    change: NDArray[np.float64] = np.where(good, now.value - before.value, 0.0)
    sure = np.hypot(now.uncertainty, before.uncertainty)
    # the change that exceeds its own limit (`Compared.holds`) by most; it need not be the largest, and a
    # small one beyond doubt must not hide it
    limit = np.maximum(MATTERS[name], SURE * sure)
    at = np.unravel_index((np.abs(change) - limit).argmax(), change.shape)
    yield Compared(name, unit, float(change[at]), float(sure[at]), MATTERS[name])


def _alignment(found: Finding, known: Calibration) -> Iterator[Compared]:
    assert found.alignment is not None  # `alignment` returns one or raises
    before, now = known.alignment, found.alignment
    # without an alignment, a reconstruction takes the arms to coincide
    then = before.alignment.facts() if before else {"magnification": 1.0}
    errors = before.uncertainty if before else {}
    # magnification and distortion are compared by what they displace at the field's edge
    half = known.instrument.stages * known.instrument.substeps / 2
    scales = {"rows": (1.0, "pixels"), "columns": (1.0, "pixels"), "turn_deg": (1.0, "turn_deg")}
    for name, (scale, kind) in (
        scales | dict.fromkeys(("magnification", "distortion"), (half, "pixels"))
    ).items():
        change = (now.alignment.facts()[name] - then.get(name, 0.0)) * scale
        # a distortion that is 0 has no uncertainty
        sure = float(np.hypot(now.uncertainty.get(name, 0.0), errors.get(name, 0.0))) * scale
        unit = "degrees" if kind == "turn_deg" else "fine pixels"
        yield Compared(name, unit, change, sure, MATTERS[kind])


def _blur(found: Finding, known: Calibration) -> Iterator[Compared]:
    before, now = known.quantities["blur_px"], found.quantities["blur_px"]
    for arm, name in enumerate("ab"):
        for axis, along in enumerate(("along", "across")):
            change = float(now.value[arm, axis] - before.value[arm, axis])
            sure = float(np.hypot(now.uncertainty[arm, axis], before.uncertainty[arm, axis]))
            quantity = f"blur of arm {name} {along} the transfer"
            yield Compared(quantity, "fine pixels", change, sure, MATTERS["blur_px"])
