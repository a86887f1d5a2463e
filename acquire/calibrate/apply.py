"""Application of a calibration to a segment: offsets, responsivities, mask, alignment, optics.

The lines themselves are not altered.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.blur import SHARP, Blur, falling
from acquire.calibrate.calibration import COLUMN, QUANTITIES, Calibration, Measured, differences_between
from acquire.calibrate.curve import curve_of
from acquire.calibrate.exposure import instrument_of
from acquire.calibrate.orientation import oriented, view_named
from acquire.errors import UsageError
from acquire.noise import Noise

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.calibrate.calibration import AlignmentFound
    from acquire.lines import Segment
    from acquire.store import Recording

OLD_DAYS = 30
"""Days between calibration and recording from which there is a doubt. A convention: no instrument's drift
over weeks has been measured."""
WARMER_K = 5.0
"""Difference of temperature from which there is a doubt: silicon's dark current, generated across half of its
band gap (0.56 eV), is 1.4 times as large 5 K above 25 °C."""
SLOWER = 0.01
"""Relative difference of the sub-steps from which there is a doubt. Dark current and ambient light are
proportional to them: 1 % of 29 DN is the noise of rounding, 0.29 DN."""
CLEAR = 2.0
"""Standard uncertainties by which a width of the blur, or a veil, must exceed 0 to be part of the model."""


def calibration_of(recording: Recording) -> Calibration | None:
    """Return the copy that a recording carries, or None. Raises DataError for a damaged one."""
    attrs = recording.attrs.get("calibration")
    return None if attrs is None else Calibration.from_attrs(attrs)


def check_fits(calibration: Calibration, recording: Recording) -> tuple[str, ...]:
    """Return doubts about using a calibration for a recording, in sentences: its age, its temperature.

    Raises UsageError if it is of another instrument: geometry, layout, camera, pixel format, gain.
    """
    mine, theirs = calibration.instrument, instrument_of(recording)
    if differences := differences_between(mine, theirs):
        raise UsageError(
            f"the calibration does not fit {recording}: " + "; ".join(differences),
            hint="a calibration of that instrument, or none: --calibration none",
        )
    doubts = []
    if abs(mine.substep_s / theirs.substep_s - 1) > SLOWER:
        doubts.append(
            f"the calibration was made at sub-steps of {mine.substep_s:.3g} s, the recording has "
            f"{theirs.substep_s:.3g} s: dark current and ambient light differ"
        )
    made = [datetime.fromisoformat(step["made"]) for step in calibration.steps.values() if "made" in step]
    # retention may have deleted the first lines
    row = recording.first_available_line - recording.first_line if recording.lines else 0
    if made and row < recording.lines:
        begun = datetime.fromtimestamp(int(recording.arms["a"].read("time", row, row + 1)[0]) * 1e-9, UTC)
        days = max(abs((begun - each).total_seconds()) for each in made) / 86400
        if days > OLD_DAYS:
            doubts.append(f"calibration and recording are {days:.0f} days apart")
    for arm, before in calibration.steps.get("dark", {}).get("temperature_c", {}).items():
        now = recording.attrs["cameras"].get(arm, {}).get("DeviceTemperature")
        if now is not None and abs(now - before) > WARMER_K:
            doubts.append(f"camera {arm} is at {now:.0f} °C; its offsets were measured at {before:.0f} °C")
    return tuple(doubts)


def calibrated(segment: Segment, calibration: Calibration) -> Segment:
    """Return the segment with all corrections that the calibration holds.

    Raises UsageError for another number of columns, and for an orientation that cannot be corrected.
    """
    if segment.geometry.stages != calibration.instrument.stages:
        raise UsageError(
            f"a calibration of {calibration.instrument.stages} columns does not fit lines of "
            f"{segment.geometry.stages} pixels",
            possible=f"lines of {calibration.instrument.stages} pixels",
        )
    calibration = _of_columns(calibration, segment)
    black, curve = black_level(segment, calibration), curve_of(calibration)
    if curve is not None:
        # samples are linearised before anything is subtracted, so that their black level has to be, too
        black = curve.straight(_columns(segment.black_level_dn, segment) if black is None else black)
    gain, balance = calibration.value("gain"), calibration.value("balance")
    responsivity = None
    if gain is not None or balance is not None:
        responsivity = _columns(segment.responsivity_dn, segment)
        responsivity = responsivity if gain is None else responsivity * gain
        responsivity = responsivity if balance is None else responsivity * balance[:, None]
    optics, veil = blur_of(calibration), veil_of(calibration)
    if veil is not None:
        optics = replace(optics or SHARP, veil=veil)
    known = {
        "curve": curve,
        "black_level_dn": black,
        "responsivity_dn": responsivity,
        "blur": optics,
        "noise": _noise(calibration),
    }
    changes: dict[str, Any] = {name: value for name, value in known.items() if value is not None}
    if balance is not None:
        # a reconstruction does not estimate the balance once more
        changes["balanced"] = True
    if calibration.usable is not None and not calibration.usable.all():
        changes["mask"] = segment.mask & calibration.usable[:, None, :]
    # what belongs to the cameras comes before the orientation, which may swap the arms
    corrected = replace(segment, **changes)
    if calibration.orientation is not None:
        corrected = oriented(corrected, view_named(calibration.orientation))
    if belongs_to_flat(calibration):
        corrected = shaded(corrected, calibration.quantities["shading"].value)
    # measured between the arms as they are turned by then
    return aligned(corrected, calibration.alignment)


def aligned(segment: Segment, found: AlignmentFound | None) -> Segment:
    """Return the segment with arm B's alignment, if there is one.

    Registration blurs arm B in the model, and the measured width includes that: it is subtracted here.
    """
    if found is None:
        return segment
    segment = replace(segment, alignment=found.alignment)
    if segment.blur is None:
        return segment
    from acquire.forward import interpolation_variance  # compiled loops, which a capture host lacks

    rows, columns = interpolation_variance(found.alignment, segment.geometry.size)
    along, across = segment.blur.b  # of arm B's charge, which moves along the scene's columns
    left = (max(0.0, along**2 - columns) ** 0.5, max(0.0, across**2 - rows) ** 0.5)
    return replace(segment, blur=replace(segment.blur, b=left))


def belongs_to_flat(calibration: Calibration) -> bool:
    """Return whether the shading was measured with the gains that the calibration has now."""
    if "shading" not in calibration.quantities or "align" not in calibration.steps:
        return False
    made = calibration.steps.get("flat", {}).get("made")
    return calibration.alignment is not None and calibration.steps["align"].get("shading_of_flat") == made


def shaded(segment: Segment, shading: NDArray[np.float64]) -> Segment:
    """Move the smooth part of the columns' gains from the responsivities to the image in the model."""
    geometry = segment.geometry
    fine = (np.arange(geometry.size) - (geometry.size - 1) / 2) / (geometry.size / 2)
    responsivity = _columns(segment.responsivity_dn, segment)
    for arm, (r1, r2, c1, c2, _) in enumerate(shading.tolist()):
        rows, columns = falling((r1, r2), fine), falling((c1, c2), fine)
        # arm A's pixels are the scene's columns, arm B's its rows
        own = (rows if arm else columns).reshape(geometry.stages, -1).mean(axis=1)
        responsivity[arm] *= rows.max() * columns.max() / own
    # the centre of the lenses passes all light
    responsivity /= np.sqrt(shading[:, 4].prod())
    a, b = (tuple(row) for row in shading[:, :4].tolist())
    blur = replace(segment.blur or SHARP, shade_a=a, shade_b=b)
    return replace(segment, responsivity_dn=responsivity, blur=blur)


def _of_columns(calibration: Calibration, segment: Segment) -> Calibration:
    """Restrict a calibration to the segment's columns, and behind a fibre to the alignment of its tile.

    Raises UsageError if the calibration does not cover these columns.
    """
    if max(segment.first_column) + segment.geometry.stages > calibration.instrument.columns:
        raise UsageError(
            f"a calibration of {calibration.instrument.columns} columns does not cover those of the lines, "
            f"which begin at column {max(segment.first_column)}",
            possible="a calibration of this instrument",
        )
    if calibration.instrument.columns == segment.geometry.stages:
        return calibration
    stages = segment.geometry.stages

    def cut(values: NDArray[Any]) -> NDArray[Any]:
        return np.stack(
            [row[first : first + stages] for row, first in zip(values, segment.first_column, strict=True)]
        )

    return replace(
        calibration,
        # as if the sensor had only the columns that see the tile
        instrument=calibration.instrument.model_copy(update={"pixels": None}),
        quantities={
            name: Measured(cut(each.value), cut(each.uncertainty))
            if QUANTITIES[name].dimensions == COLUMN
            else each
            for name, each in calibration.quantities.items()
        },
        usable=None if calibration.usable is None else cut(calibration.usable),
        # a segment does not name its tile, but its first columns do
        alignment=next((e.found for e in calibration.tiles if e.columns == segment.first_column), None),
    )


def black_level(segment: Segment, calibration: Calibration) -> NDArray[np.float64] | None:
    """Return the DN of each column without the coded light (arm, column); None if it was not measured."""
    offset, ambient = calibration.value("offset_dn"), calibration.value("ambient_dn")
    if offset is None and ambient is None:
        return None
    base = _columns(segment.black_level_dn, segment) if offset is None else offset
    return base if ambient is None else base + ambient


def blur_of(calibration: Calibration) -> Blur | None:
    """Return the optics' blur, with unclear widths as 0; None if none is clear or it was not measured."""
    if "blur_px" not in calibration.quantities:
        return None
    found = calibration.quantities["blur_px"]
    clear = np.where(found.value > CLEAR * found.uncertainty, found.value, 0.0)
    a, b = clear.tolist()
    return Blur(tuple(a), tuple(b)) if clear.any() else None


def veil_of(calibration: Calibration) -> tuple[float, float] | None:
    """Return each arm's veil, an unclear one as 0; None if none is clear or it was not measured."""
    if "veil" not in calibration.quantities:
        return None
    found = calibration.quantities["veil"]
    a, b = np.where(found.value > CLEAR * found.uncertainty, found.value, 0.0).tolist()
    return (a, b) if a or b else None


def _noise(calibration: Calibration) -> Noise | None:
    """Return the samples' noise, including shot noise of ambient light; None without DN per electron."""
    K, read = calibration.value("dn_per_electron"), calibration.value("read_noise_e")
    if K is None or read is None:
        return None
    known = Noise((float(K[0]), float(K[1])), (float(K[0] * read[0]), float(K[1] * read[1])))
    ambient = calibration.value("ambient_dn")
    if ambient is None:
        return known
    a, b = ambient.mean(axis=1).tolist()
    return known.with_ambient((a, b))


def _columns(value: Any, segment: Segment) -> NDArray[np.float64]:
    """Expand a number, one per arm, or one per arm and column to (arm, column)."""
    given = np.asarray(value, np.float64)
    given = given if given.ndim == 2 else given.reshape(-1, 1)
    # a copy, because broadcast arrays cannot be written to
    return np.broadcast_to(given, (len(segment.lines), segment.geometry.stages)).copy()
