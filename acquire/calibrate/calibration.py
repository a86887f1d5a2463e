"""The model of a calibration: quantities with uncertainties, their instrument, and how they were measured.

::

    offset_dn        (arm, column)   DN of a pixel under a dark code
    noise_dn         (arm, column)   temporal standard deviation of a dark pixel
    ambient_dn       (arm, column)   DN added by light that no code switches
    gain             (arm, column)   response relative to the arm's mean; 1 where the optics hide the column
    balance          (arm)           response relative to the mean of both arms, which the splitter divides
    dn_per_electron  (arm)           K of EMVA 1288
    read_noise_e     (arm)           σ_d of EMVA 1288
    full_well_e      (arm)           μ_e.sat of EMVA 1288
    light_late_ticks (arm)           delay of the light relative to the charge, without lead and delays
    linearity_error  (arm)           LE of EMVA 1288
    blur_px          (arm, axis)     standard deviation of the optics' blur, along the transfer and across it
    veil             (arm,)          share of the arm's light that its lens spreads over the whole field
    shading          (arm, term)     light on the image of the model's arms, relative to its centre
    excess_dn        (arm, knot)     excess of samples that read 0 … white, at evenly spaced knots

and ``usable`` (arm, column), the orientation of arm B, and its alignment with arm A.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from acquire.alignment import Alignment
from acquire.errors import DataError, UsageError
from acquire.lines import ARMS
from acquire.showing import in_words
from acquire.text import cause_in_words

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

FORMAT = "acquire-calibration/1"
DIGITS = 7
"""Significant digits of the copy in a recording, more than any measurement has."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """Description of an array of a calibration."""

    dimensions: tuple[str, ...]
    unit: str
    meaning: str


ARM, COLUMN, CURVE, WIDTHS = ("arm",), ("arm", "column"), ("arm", "knot"), ("arm", "axis")
SHADING = ("arm", "term")
TERMS = 5
KNOTS = 65
"""Knots of a camera's curve; between them a bend of a percent is straight to a part in 10⁶."""
QUANTITIES = {
    "offset_dn": Quantity(COLUMN, "DN", "of a pixel under a dark code"),
    "noise_dn": Quantity(COLUMN, "DN", "temporal standard deviation of a dark pixel"),
    "ambient_dn": Quantity(COLUMN, "DN", "added by light that no code switches"),
    "gain": Quantity(COLUMN, "1", "response relative to the mean of the arm's columns"),
    "balance": Quantity(ARM, "1", "response of the arm relative to the mean of both"),
    "dn_per_electron": Quantity(ARM, "DN", "system gain K of EMVA 1288"),
    "read_noise_e": Quantity(ARM, "electron", "temporal dark noise of EMVA 1288"),
    "full_well_e": Quantity(ARM, "electron", "saturation capacity of EMVA 1288"),
    "light_late_ticks": Quantity(
        ARM,
        "1",
        "delay of the light after the charge transfer, without lead and delays, in the trigger's ticks",
    ),
    "blur_px": Quantity(
        WIDTHS, "1", "standard deviation of the optics' blur along the transfer and across it, in fine pixels"
    ),
    "veil": Quantity(ARM, "1", "share of the arm's light that its lens spreads evenly over the field"),
    "linearity_error": Quantity(ARM, "1", "linearity error of EMVA 1288"),
    "shading": Quantity(
        SHADING,
        "1",
        "light on the image relative to its centre: r1, r2 along the scene's rows, c1, c2 along its columns; "
        "and the gain in the centre",
    ),
    "excess_dn": Quantity(CURVE, "DN", "excess of samples that read 0 … white, at evenly spaced knots"),
}

FOUND_BY = {
    "dark": ("offset_dn", "noise_dn"),
    "ambient": ("ambient_dn",),
    "flat": ("gain", "balance"),
    "transfer": ("dn_per_electron", "read_noise_e", "full_well_e"),
    "linearity": ("linearity_error", "excess_dn"),
    "delay": ("light_late_ticks",),
    "psf": ("blur_px",),
    "veil": ("veil",),
}
"""Step → the quantities that it measures."""
NOT_ALWAYS = ("full_well_e", "excess_dn")
"""Those of them that a step may leave open."""
ABOVE_ZERO = ("gain", "balance", "dn_per_electron")
"""Quantities that lines are divided by."""


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Values and their standard uncertainties, float64 of one shape."""

    value: NDArray[np.float64]
    uncertainty: NDArray[np.float64]

    def __repr__(self) -> str:
        mean, doubt = (float(each.mean()) if each.size else 0.0 for each in (self.value, self.uncertainty))
        return in_words("Measured", mean=f"{mean:.6g} ± {doubt:.2g} each", shape=self.value.shape)

    def __post_init__(self) -> None:
        if self.value.shape != self.uncertainty.shape:
            raise UsageError(
                f"values {self.value.shape} cannot have uncertainties {self.uncertainty.shape}",
                possible="the same shape",
            )


class Instrument(BaseModel):
    """The instrument that a calibration belongs to."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    stages: int = Field(ge=1, le=2**16)
    substeps: int = Field(ge=1, le=8)
    substep_s: float = Field(gt=0, allow_inf_nan=False)
    layout: str
    cameras: dict[str, dict[str, Any]] = Field(description="arm → serial, and settings that lines depend on")
    pixels: int | None = Field(
        default=None, ge=1, le=2**16, description="of a line, where a fibre ends on more than M"
    )

    @property
    def columns(self) -> int:
        """Number of columns of each sensor."""
        return self.stages if self.pixels is None else self.pixels


@dataclass(frozen=True, slots=True)
class AlignmentFound:
    """An alignment of arm B with arm A, and the standard uncertainty of each number."""

    alignment: Alignment
    uncertainty: dict[str, float]


@dataclass(frozen=True, slots=True)
class TileAlignment:
    """The alignment of a ``tile`` behind a fibre, which begins at ``columns`` of arms A and B."""

    tile: str
    columns: tuple[int, int]
    found: AlignmentFound


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """Result of one step. Properties that the step does not measure are None or empty.

    Attributes
    ----------
    step : its name
    instrument : that of the recordings
    quantities : name → value and uncertainty
    usable : (arm, column), False for columns without useful samples
    orientation : name of arm B's view of the scene; see `acquire.calibrate.orientation`
    alignment : that of arm B with arm A
    tiles : alignments behind a fibre
    facts : JSON: recordings, lines, and whatever else is worth knowing
    warnings : problems with the result, in sentences
    """

    step: str
    instrument: Instrument
    quantities: Mapping[str, Measured] = field(default_factory=dict)
    usable: NDArray[np.bool_] | None = None
    orientation: str | None = None
    alignment: AlignmentFound | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    tiles: tuple[TileAlignment, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Measured properties of an instrument; see the module. ``steps``: name → how and when it was done."""

    instrument: Instrument
    quantities: Mapping[str, Measured] = field(default_factory=dict)
    usable: NDArray[np.bool_] | None = None
    orientation: str | None = None
    alignment: AlignmentFound | None = None
    steps: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    tiles: tuple[TileAlignment, ...] = ()

    def __repr__(self) -> str:
        sizes = self.instrument
        return in_words(
            "Calibration",
            geometry=f"M = {sizes.stages}, S = {sizes.substeps}, {sizes.layout}",
            steps=" ".join(self.steps) or "none yet",
            quantities=" ".join(self.quantities) or "none yet",
            arm_b="aligned" if self.alignment or self.tiles else None,
        )

    def __post_init__(self) -> None:
        sizes = {"arm": len(ARMS), "column": self.instrument.columns, "knot": KNOTS, "axis": 2, "term": TERMS}
        columns = tuple(sizes[dimension] for dimension in COLUMN)
        if self.usable is not None and self.usable.shape != columns:
            raise UsageError(
                f"a calibration cannot have usable columns of shape {self.usable.shape}",
                possible=f"{columns}",
            )
        for name, measured in self.quantities.items():
            if name not in QUANTITIES:
                raise UsageError(f"a calibration has no quantity {name!r}", possible=", ".join(QUANTITIES))
            shape = tuple(sizes[dimension] for dimension in QUANTITIES[name].dimensions)
            if measured.value.shape != shape or not np.isfinite(measured.value).all():
                raise UsageError(
                    f"{name} of shape {measured.value.shape} does not fit the calibration, or is not finite",
                    possible=f"finite numbers {shape}",
                )
            # "not all", which is also true of NaN
            if not (measured.uncertainty >= 0).all():
                raise UsageError(f"the uncertainties of {name} are not numbers", possible="0 or more")
            if name in ABOVE_ZERO and not (measured.value > 0).all():
                raise UsageError(
                    f"{name} of the calibration is not above 0: it is {measured.value.min():.3g}",
                    possible="numbers above 0",
                )

    def value(self, name: str) -> NDArray[np.float64] | None:
        """Return the values of a quantity, or None if it was not measured."""
        return self.quantities[name].value if name in self.quantities else None

    def check_same(self, other: Instrument, what: str, place: str) -> None:
        """Raise UsageError unless ``other``, on which ``what`` was made, is this calibration's instrument."""
        if differences := differences_between(self.instrument, other):
            raise UsageError(
                f"{what} is of another instrument than {place}: " + "; ".join(differences),
                possible="a calibration of the same instrument, or a new one",
                hint="--out with another name",
            )

    def is_after(self, step: str, base: str) -> bool:
        """Return whether both steps were done, and ``step`` not before ``base``."""
        if step not in self.steps or base not in self.steps:
            return False
        dates = [facts["made"] for facts in (self.steps[base], self.steps[step]) if "made" in facts]
        made = [datetime.fromisoformat(date) for date in dates]
        # one that was never dated may have been
        return len(made) < 2 or made[0] <= made[1]

    def with_step(self, found: Finding) -> Calibration:
        """Return the calibration with a step's result in place of earlier ones.

        Raises UsageError if the step's recordings are of another instrument.
        """
        self.check_same(found.instrument, f"the recording of step {found.step!r}", "the calibration")
        now = datetime.now(UTC).isoformat(timespec="seconds")
        step = {**found.facts, "made": now, "warnings": list(found.warnings)}
        if found.usable is not None:
            step["unusable_columns"] = unusable_columns(found.usable)
        steps = {**self.steps, found.step: step}
        before = dict(self.quantities)
        if found.step == "align":
            # a lens's light that is not seen any more
            before.pop("shading", None)
        return replace(
            self,
            quantities={**before, **found.quantities},
            # from all steps anew: a step that is repeated can make columns usable again
            usable=usable_of(steps, self.instrument.columns),
            # one that was not clear is None, and replaces nothing
            orientation=found.orientation or self.orientation,
            alignment=found.alignment or self.alignment,
            steps=steps,
            tiles=found.tiles or self.tiles,
        )

    def finding(self, step: str) -> Finding:
        """Return the result of a step, as far as no later step has replaced it.

        Raises UsageError if the step was not done.
        """
        if step not in self.steps:
            raise UsageError(
                f"the step {step!r} was not done", possible=", ".join(self.steps) or "none was done yet"
            )
        facts = self.steps[step]
        usable = usable_of({step: facts}, self.instrument.columns)
        return Finding(
            step,
            self.instrument,
            {name: self.quantities[name] for name in FOUND_BY.get(step, ()) if name in self.quantities},
            usable,
            orientation=self.orientation if step == "orientation" else None,
            alignment=self.alignment if step == "align" else None,
            facts=facts,
            warnings=tuple(facts.get("warnings", ())),
            tiles=self.tiles if step == "align" else (),
        )

    def to_attrs(self) -> dict[str, Any]:
        """Return the whole calibration as JSON: the copy that a recording carries."""
        arrays = {
            name: {"value": _rounded(each.value), "uncertainty": _rounded(each.uncertainty)}
            for name, each in self.quantities.items()
        }
        return {**self.facts(), "quantities": arrays}

    def facts(self) -> dict[str, Any]:
        """Return everything but the arrays, as JSON."""

        def facts(found: AlignmentFound) -> dict[str, Any]:
            return {**found.alignment.facts(), "uncertainty": found.uncertainty}

        return {
            "format": FORMAT,
            "instrument": self.instrument.model_dump(mode="json"),
            "usable": None if self.usable is None else self.usable.tolist(),
            "orientation": self.orientation,
            "alignment": self.alignment and facts(self.alignment),
            "steps": dict(self.steps),
            "tiles": [{"tile": e.tile, "seen_from": list(e.columns), **facts(e.found)} for e in self.tiles],
        }

    @classmethod
    def from_attrs(
        cls, attrs: Mapping[str, Any], quantities: Mapping[str, Measured] | None = None
    ) -> Calibration:
        """Rebuild a calibration from `to_attrs`; ``quantities`` replace those in ``attrs``.

        Raises DataError if it is damaged.
        """
        try:
            if quantities is None:
                quantities = {
                    name: Measured(np.asarray(each["value"], float), np.asarray(each["uncertainty"], float))
                    for name, each in attrs["quantities"].items()
                }
            _check_complete(attrs["steps"], quantities)
            usable, found = attrs["usable"], attrs["alignment"]
            return cls(
                instrument=Instrument.model_validate(attrs["instrument"]),
                quantities=quantities,
                usable=None if usable is None else np.asarray(usable, np.bool_),
                orientation=attrs["orientation"],
                alignment=None if found is None else _alignment(found),
                steps={name: _step(step) for name, step in attrs["steps"].items()},
                tiles=tuple(
                    TileAlignment(
                        str(e["tile"]), (int(e["seen_from"][0]), int(e["seen_from"][1])), _alignment(e)
                    )
                    # calibrations from before tiles were aligned have none
                    for e in attrs.get("tiles", ())
                ),
            )
        except (LookupError, TypeError, ValueError, AttributeError, ValidationError, UsageError) as error:
            why = error.message if isinstance(error, UsageError) else cause_in_words(error)
            raise DataError(f"the calibration is damaged: {why}", hint="measure it again") from error


def unusable_columns(usable: NDArray[np.bool_]) -> dict[str, list[int]]:
    """Return the columns of each arm that are not usable."""
    return {arm: np.flatnonzero(~row).tolist() for arm, row in zip(ARMS, usable, strict=True)}


def usable_of(steps: Mapping[str, dict[str, Any]], columns: int) -> NDArray[np.bool_] | None:
    """Return the columns (arm, column) that no step excluded; None if no step examined them."""
    excluded = [step["unusable_columns"] for step in steps.values() if "unusable_columns" in step]
    if not excluded:
        return None
    usable = np.ones((len(ARMS), columns), np.bool_)
    for each in excluded:
        for row, arm in zip(usable, ARMS, strict=True):
            row[each.get(arm, [])] = False
    return usable


def _check_complete(steps: Mapping[str, Any], quantities: Mapping[str, Measured]) -> None:
    for step, names in FOUND_BY.items():
        lost = [each for each in names if each not in (*quantities, *NOT_ALWAYS)]
        if step in steps and lost:
            raise ValueError(f"{lost[0]}, which its step {step} measured, is missing")


def _step(attrs: Mapping[str, Any]) -> dict[str, Any]:
    # a moment without a zone cannot be compared with a recording's
    if "made" in attrs and datetime.fromisoformat(attrs["made"]).tzinfo is None:
        raise ValueError(f"a step was made at {attrs['made']}, in no time zone")
    return dict(attrs)


def _alignment(attrs: Mapping[str, Any]) -> AlignmentFound:
    # calibrations from before the distortion was measured have none
    numbers = {key: float(attrs[key]) for key in Alignment().facts() if key in attrs or key != "distortion"}
    return AlignmentFound(Alignment(**numbers), {k: float(v) for k, v in attrs["uncertainty"].items()})


def _rounded(values: NDArray[np.float64]) -> Any:
    """Return the values as lists, rounded to significant digits of the largest."""
    size = np.abs(values[values != 0])
    decimals = DIGITS - 1 - int(np.floor(np.log10(size.max()))) if size.size else 0
    return np.round(values, decimals).tolist()


def differences_between(known: Instrument, other: Instrument) -> list[str]:
    """Return, in words, the differences of two instruments that keep them from sharing a calibration."""
    found = []
    for name, meaning in (
        ("stages", "stages M"),
        ("substeps", "sub-steps S"),
        ("layout", "layout"),
        ("columns", "number of columns"),
    ):
        mine, theirs = getattr(known, name), getattr(other, name)
        if mine != theirs:
            found.append(f"{meaning} is {theirs} instead of {mine}")
    for arm in ARMS:
        mine, theirs = known.cameras.get(arm, {}), other.cameras.get(arm, {})
        found += [
            f"camera {arm}: {key} is {theirs[key]} instead of {mine[key]}"
            for key in mine
            # cameras differ in the settings that they report
            if key in theirs and mine[key] != theirs[key]
        ]
    return found
