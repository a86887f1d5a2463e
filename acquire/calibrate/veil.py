"""Each arm's veil: the share of its light that the lens spreads over the field (ISO 18844), from black parts.

With a veil v, an arm's image is (1 − v)·X + v·mean(X). Where a scene at rest sends no light, v·mean(X) is
left, and the mean of the image is mean(X), so that v is the level of the black parts relative to the mean.
That they are black is for the person to see to: the lines cannot distinguish a veil from grey paint, which
reflects 3 to 5 % of the light, more than a lens spreads. Holes, or chrome on glass lit from behind, are black
enough.

The darkest windows of an image are dark by chance, too. Two images are therefore made (`still`), each from
half of the lines: the windows are chosen in one and measured in the other, and the reverse. Black are all
that the noise does not distinguish from the darkest.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import uniform_filter

from acquire.blur import MOST_VEIL
from acquire.calibrate.apply import calibrated
from acquire.calibrate.calibration import Finding, Measured
from acquire.calibrate.checks import refuse_constant, refuse_fibre
from acquire.calibrate.still import stills
from acquire.errors import UsageError
from acquire.lines import ARMS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from acquire.calibrate.calibration import Calibration
    from acquire.calibrate.exposure import Exposure
    from acquire.calibrate.still import Still
    from acquire.lines import Segment

MOST_LINES = 8192
SIDE = 5
"""Side of a window in coarse pixels."""
AROUND = 1
"""Coarse pixels around a window that have to be black, too, since a blur carries light across an edge.
Without them the sheet's veil was found up to 0.9 % too high with a blur of 1.3 fine pixels."""
BLACK = 0.01
"""Share of the windows that has to be black; a square of twice SIDE has as many in 64 × 64 pixels."""
AS_BLACK = 2.0
"""Standard deviations of the noise by which a window may be brighter than the darkest and still be black."""
UNLIKELY = 2.5
"""Standard errors beyond which the two images differ by more than noise: one in eighty differs by as much."""
HIGH = 0.06
"""Veil from which the black parts are in doubt: good lenses have 1 to 2 %, poor ones 5 %."""
LIGHT = 0.001
"""Share of the light that lamps which take 0.1 µs to go out send a sub-step late: it is even, too."""
SURE = 0.005
"""Largest uncertainty: half of what a good lens spreads."""


def veil(exposure: Exposure, known: Calibration) -> Finding:
    """Measure the veil of each arm, a share of its light, from a target at rest with black parts.

    Raises UsageError for a dark scene, for too much noise, for one without black parts, and for lines behind
    a fibre or with a constant code.
    """
    refuse_fibre(exposure)
    refuse_constant(exposure)
    lines = min(exposure.lines, MOST_LINES)
    # the images of the cameras themselves, in their own rows and columns
    bare = replace(without_veil(known), orientation=None, alignment=None)
    segment = calibrated(replace(exposure, lines=lines).whole(), bare)
    S, samples = segment.geometry.substeps, segment.samples(np.float64)
    halves = [stills(_every_second_line(segment, first)) for first in (0, 1)]
    values, doubts = [], []
    for arm, name in enumerate(ARMS):
        level = float(samples[arm].mean())
        value, doubt = _level_of_black(halves[0][arm], halves[1][arm], S, name)
        if "offset_dn" in known.quantities:
            # a wrong offset looks like even light
            offset = float(known.quantities["offset_dn"].uncertainty[arm].mean())
            doubt = float(np.hypot(doubt, offset / np.mean(np.asarray(segment.responsivity_dn)) / level))
        if not doubt <= SURE:
            raise _undetermined(name, f"its uncertainty is {doubt:.1%}, and {SURE:.1%} is needed")
        if value > MOST_VEIL:
            raise _undetermined(name, f"its darkest parts have {value:.0%} of the mean light")
        values.append(max(value, 0.0))
        doubts.append(doubt)
    return Finding(
        "veil",
        exposure.instrument,
        {"veil": Measured(np.array(values), np.array(doubts))},
        facts={**exposure.facts(), "lines": lines},
        warnings=tuple(_warnings(values, "offset_dn" in known.quantities)),
    )


def veil_of_black(exposure: Exposure, known: Calibration) -> Finding:
    """Measure the veil from a target that may not be black: as `veil`, but nothing that is in doubt.

    Raises UsageError for dark parts that are brighter than lenses make them, too.
    """
    found = veil(exposure, known)
    for arm, value in zip(ARMS, found.quantities["veil"].value.tolist(), strict=True):
        if value > HIGH:
            raise _undetermined(
                arm,
                f"its dark parts have {value:.1%} of the mean light, more than lenses spread, and so they "
                "are not black; printed black reflects 3 to 5 % of the light",
            )
    return found


def without_veil(known: Calibration) -> Calibration:
    """Return the calibration without the veil."""
    return replace(known, quantities={k: v for k, v in known.quantities.items() if k != "veil"})


def _every_second_line(segment: Segment, first: int) -> Segment:
    mask = np.zeros_like(segment.mask)
    mask[:, first::2] = segment.mask[:, first::2]
    return replace(segment, mask=mask)


def _level_of_black(one: Still, other: Still, substeps: int, arm: str) -> tuple[float, float]:
    """Return the level of the darkest windows relative to the mean, and its uncertainty, from two images.

    Raises UsageError for an image without light.
    """
    first, second = (_windows(each, substeps, SIDE) for each in (one, other))
    wider = [_windows(each, substeps, SIDE + 2 * AROUND) for each in (one, other)]
    means = [float(each.image[:, each.usable].mean()) for each in (one, other)]
    noise, wider_noise = (float(np.std(a - b)) / 2**0.5 for a, b in ((first, second), wider))
    # half of the mean is noise at most
    if min(means) < 2 * noise:
        raise _undetermined(arm, "there is too little light")
    fewest = max(2, round(BLACK * first.size))
    levels, errors = [], []
    for chosen, measured, mean in ((wider[0], second, means[1]), (wider[1], first, means[0])):
        order = np.argsort(chosen, axis=None)
        darkest = float(measured.ravel()[order[:fewest]].mean())
        # at least the darkest themselves, whose mean is another in the other half
        count = max(fewest, int((chosen <= darkest + AS_BLACK * wider_noise).sum()))
        black = np.isin(np.arange(order.size), order[:count]).reshape(chosen.shape)
        levels.append(float(measured[black].mean()) / mean)
        errors.append(noise / mean / _independent(black) ** 0.5)
    expected, apart = float(np.hypot(*errors)), abs(levels[1] - levels[0])
    # one difference is itself a matter of chance, and counts only if noise does not explain it
    doubt = max(expected, apart if apart > UNLIKELY * expected else 0.0) / 2
    return sum(levels) / 2, float(np.hypot(doubt, LIGHT))


def _independent(chosen: NDArray[np.bool_]) -> float:
    """Return how many independent windows have as much noise in their mean as these, which overlap."""
    # how many of them contain each coarse pixel; a filter's mean times its area is the sum
    held = uniform_filter(np.pad(chosen, SIDE // 2).astype(np.float64), SIDE, mode="constant") * SIDE**2
    return float(held.sum() ** 2 / (held**2).sum()) / SIDE**2


def _windows(still: Still, substeps: int, side: int) -> NDArray[np.float64]:
    """Return the means over side × side coarse pixels around each one whose window of SIDE is inside.

    The result is (row, column). Columns without samples are left out, and those beside them are neighbours.
    """
    S, image = substeps, still.image[:, still.usable]
    # an element is the sum over the S rows that end at its own, so that a window has S − 1 rows fewer
    rows = SIDE * S - S + 1
    means = uniform_filter(image, (side * S - S + 1, side), mode="nearest")
    inside = means[rows // 2 : means.shape[0] - rows // 2 : S, SIDE // 2 : means.shape[1] - SIDE // 2]
    return np.asarray(inside, np.float64)


def _warnings(values: list[float], with_offsets: bool) -> Iterator[str]:
    for arm, value in zip(ARMS, values, strict=True):
        if value > HIGH:
            yield (
                f"arm {arm}: a veil of {value:.1%} is more than lenses have; are the target's dark parts "
                "black? Printed black is not: it reflects 3 to 5 % of the light"
            )
    if not with_offsets:
        yield "no dark was measured: offsets of the columns that differ from the black level count as a veil"


def _undetermined(arm: str, why: str) -> UsageError:
    return UsageError(
        f"the veil of arm {arm} cannot be measured: {why}",
        possible="a target at rest, of which a few percent are black and send no light at all",
        hint="holes in a white card before a dark room, or chrome on glass lit from behind; 4096 lines",
    )
