"""The benefit of each part of a calibration: short reconstructions with all of it, and without one part each.

The measure needs no ground truth: held-out blocks of samples are predicted, and a part that describes the
instrument correctly improves the prediction. All trials share the lines, the held-out samples, the bandwidth
and the number of iterations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from acquire.alignment import Alignment
from acquire.calibrate import AlignmentFound, calibrated
from acquire.calibrate.apply import belongs_to_flat, blur_of, veil_of
from acquire.calibrate.curve import curve_of
from acquire.calibrate.orientation import MODEL, view_named
from acquire.calibrate.psf import without_blur
from acquire.calibrate.veil import without_veil
from acquire.recon import reconstruct

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.calibrate import Calibration
    from acquire.lines import Segment

TRIAL_ITERATIONS = 80
TRIAL_LINES = 264
OFFSETS, CURVE = ("offset_dn", "ambient_dn"), ("excess_dn",)
LIGHT = ("shading",)
GAINS = ("gain", *LIGHT)
"""The fall of the light is measured against the gains, and means nothing without them."""
NOTHING, ALL = "nothing", "all of it"


@dataclass(frozen=True, slots=True)
class CorrectionWorth:
    """One trial: ``prediction`` is the relative error at held-out samples.

    ``gain_db`` is the loss of prediction without the part and ``time_factor`` the time with all parts over
    the time without this one; both are None for `NOTHING` and `ALL`.
    """

    part: str
    prediction: float
    seconds: float
    gain_db: float | None = None
    time_factor: float | None = None


def explain(
    segment: Segment,
    known: Calibration,
    spatial_merge: int,
    temporal_merge: int,
    progress: Callable[[int, int], object] = lambda _done, _all: None,
) -> tuple[CorrectionWorth, ...]:
    """Measure the benefit and cost of the parts of a calibration for a segment; `NOTHING` and `ALL` first.

    Raises what `calibrated` and `reconstruct` raise.
    """
    merges = (spatial_merge, temporal_merge)
    # A first run compiles, so that no trial is timed with it.
    reconstruct(calibrated(segment, known), *merges, iterations=1, check=False, error=False)
    frames = segment.geometry.video_shape(*merges)[0]
    parts = dict(_without(known))
    total = len(parts) + 2
    bare = _trial(segment, merges, None)
    progress(1, total)
    bandwidth = bare.coefficients / frames
    # It is solved once more, with the bandwidth that all trials share: the search for it would take time and
    # vary.
    bare = _trial(segment, merges, bandwidth)
    whole = _trial(calibrated(segment, known), merges, bandwidth)
    progress(2, total)
    found = [
        CorrectionWorth(NOTHING, bare.prediction, bare.seconds),
        CorrectionWorth(ALL, whole.prediction, whole.seconds),
    ]
    for number, (name, rest) in enumerate(parts.items()):
        left = _trial(calibrated(segment, rest), merges, bandwidth)
        # The factor is 20, because predictions are amplitudes.
        gain_db = 20 * math.log10(left.prediction / whole.prediction)
        found.append(
            CorrectionWorth(name, left.prediction, left.seconds, gain_db, whole.seconds / left.seconds)
        )
        progress(number + 3, total)
    return tuple(found)


@dataclass(frozen=True, slots=True)
class _Trial:
    prediction: float
    seconds: float
    coefficients: int


def _trial(segment: Segment, merges: tuple[int, int], bandwidth: float | None) -> _Trial:
    # There is no check and no estimate of the error, which would count as time of the iterations.
    result = reconstruct(
        segment, *merges, iterations=TRIAL_ITERATIONS, bandwidth=bandwidth, check=False, error=False
    )
    coefficients = int(result.parameters.get("temporal_coefficients", 1))
    # Trials end after different numbers of iterations, so that the time of as many is compared.
    seconds = result.seconds / max(result.iterations, 1) * TRIAL_ITERATIONS
    return _Trial(result.quality.prediction, seconds, coefficients)


def _without(known: Calibration) -> Iterator[tuple[str, Calibration]]:
    """Yield the name of each part that the calibration holds, and the calibration without it."""
    for name, quantities in (
        *([("the cameras' curves", CURVE)] if curve_of(known) else []),
        ("offsets per column", OFFSETS),
        ("gains per column", GAINS),
        ("the arms' balance", ("balance",)),
    ):
        if any(each in known.quantities for each in quantities):
            rest = {key: value for key, value in known.quantities.items() if key not in quantities}
            yield name, replace(known, quantities=rest)
    if known.usable is not None and not known.usable.all():
        yield "columns left out", replace(known, usable=None)
    if known.orientation is not None and view_named(known.orientation) != MODEL:
        yield "the orientation", replace(known, orientation=None)
    if known.alignment is not None or known.tiles:
        # The fall of the light needs an alignment, and is a part of its own.
        coinciding = AlignmentFound(Alignment(), {}) if belongs_to_flat(known) else None
        yield "arm B laid on arm A", replace(known, alignment=coinciding, tiles=())
    if blur_of(known) is not None:
        yield "the optics' blur", without_blur(known)
    if veil_of(known) is not None:
        yield "the lens's veil", without_veil(known)
    if belongs_to_flat(known):
        rest = {key: value for key, value in known.quantities.items() if key not in LIGHT}
        yield "the lens's light", replace(known, quantities=rest)
