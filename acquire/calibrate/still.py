"""Image of a scene at rest from one arm alone: there are more equations than unknowns, so no prior is needed.

For a scene at rest, line i of an arm is Σ_m E(m + i·S)·z(m), where z is the image summed over S rows at a
time and m its last row (Eq. 1 with the sums over u and r in the other order). z has n + S − 1 rows, all of
them fine, and M columns: it is box-filtered over S × S fine pixels and sampled at every row. Arm B's is
sampled at every column of arm A's view instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.ndimage import gaussian_filter1d

from acquire.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.geometry import Geometry
    from acquire.lines import Segment

FINE = 4.0
"""Standard deviation, in fine pixels, of the smoothing that leaves what is no detail: a dot has at most 6."""
SPARE = 1.25
"""Least number of lines per unknown; with fewer, noise dominates the image."""


@dataclass(frozen=True, slots=True, eq=False)
class Still:
    """One arm's image.

    Attributes
    ----------
    image : (n + S − 1, M) in the arm's own rows and columns, scene units summed over S × S fine pixels
    uncertainty : standard deviation of its elements
    misfit : RMS residual of the lines, relative to their RMS
    usable : (M,) columns with samples
    unrest : correlation of the residuals of successive lines: 0 for noise, not of a scene that moves
    """

    image: NDArray[np.float64]
    uncertainty: float
    misfit: float
    usable: NDArray[np.bool_]
    unrest: float = 0.0

    @property
    def detail(self) -> int:
        """Width of the image's detail in fine pixels: where its rows are half alike, M at most."""
        image = self.image[:, self.usable]
        image = image - image.mean()
        power = float((image**2).mean())
        farthest = len(self.usable)
        alike = ((image[:-far] * image[far:]).mean() < power / 2 for far in range(1, farthest))
        return next((far for far, less in enumerate(alike, 1) if less), farthest)

    @property
    def fine(self) -> float:
        """Share of the image's variation along its rows that is finer than `FINE`, without the noise's."""
        image = self.image[:, self.usable]
        rough = image - gaussian_filter1d(image, FINE, axis=0)
        power, noise = float((image - image.mean()).var()), self.uncertainty**2
        return (float((rough**2).mean()) - noise) / (power - noise) if power > noise else 0.0

    def contrast(self, substeps: int) -> float:
        """Variation of the image without the noise's, relative to its mean; 0 if there is no light."""
        image = self.blocks(substeps)[:, self.usable]
        mean, power = float(image.mean()), float(image.var()) - self.uncertainty**2
        return power**0.5 / mean if mean > 0 and power > 0 else 0.0

    def blocks(self, substeps: int) -> NDArray[np.float64]:
        """Return the image in blocks of S × S fine pixels without overlap: (M, M)."""
        found: NDArray[np.float64] = self.image[substeps - 1 :: substeps]
        return found


def stills(segment: Segment) -> tuple[Still, Still]:
    """Solve for both arms' images of a scene at rest.

    Raises UsageError for too few lines, and for a code that does not determine an image.
    """
    samples, geometry = segment.samples(np.float64), segment.geometry
    width = geometry.size + geometry.substeps - 1
    view = np.lib.stride_tricks.sliding_window_view(segment.code, width)[:: geometry.substeps]
    windows = view[: geometry.lines].astype(np.float64)  # E(m + i·S): (L_R, n + S − 1)
    a, b = (_still(samples[arm], segment.mask[arm], windows, geometry) for arm in range(len(samples)))
    return a, b


def _still(
    samples: NDArray[np.float64], mask: NDArray[np.bool_], windows: NDArray[Any], geometry: Geometry
) -> Still:
    share = mask.mean(axis=0)
    # relative to the best column: lost lines are missing in all of them
    usable = share > 0.5 * share.max()
    # complete lines, so that one factorisation serves all columns
    lines = mask[:, usable].all(axis=1) if usable.any() else np.zeros(len(mask), np.bool_)
    needed = int(np.ceil(SPARE * windows.shape[1]))
    if lines.sum() < needed:
        raise UsageError(
            f"{lines.sum()} complete lines do not determine an image of {windows.shape[1]} rows",
            possible=f"{needed} or more; {4 * geometry.size} for a good one",
            hint="more lines of a target at rest, not saturated",
        )
    A, y = windows[lines], samples[lines]
    y = np.where(usable, y, 0)
    try:
        factor = cho_factor(A.T @ A)
    except LinAlgError as error:
        raise UsageError(
            "the light's code does not distinguish the rows of the scene",
            possible="a pseudo-random code",
            hint="a run with code.kind = 'prbs'",
        ) from error
    image = cho_solve(factor, A.T @ y)
    residual = y - A @ image
    # degrees of freedom of each column
    spare = lines.sum() - windows.shape[1]
    noise = float(np.sqrt((residual**2).sum() / (spare * max(usable.sum(), 1))))
    inverse = cho_solve(factor, np.eye(windows.shape[1]))
    level = float(np.sqrt((y[:, usable] ** 2).mean()))
    return Still(
        image=image,
        uncertainty=noise * float(np.sqrt(np.diag(inverse).mean())),
        misfit=noise / level if level > 0 else 0.0,
        usable=usable,
        unrest=_successive(residual[:, usable]),
    )


def _successive(residual: NDArray[np.float64]) -> float:
    """Return the correlation of each line's residual with the next one's, without the columns' means."""
    change = residual - residual.mean(axis=0)
    power = float((change**2).sum())
    return float((change[:-1] * change[1:]).sum()) / power if power > 0 else 0.0
