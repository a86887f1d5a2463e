"""Evidence for hypotheses about the lines: code, its position, orientation of the arms, geometry.

There are two kinds of evidence, both log likelihoods in blocks of lines (`gaussian`):

    own       likelihood of each arm's lines under the code, whatever the arm's orientation
    mutual    gain of each arm's likelihood if the scene of the other arm, turned accordingly, predicts it

One arm alone cannot distinguish a code that is late by d sub-steps from a scene displaced by d rows, nor a
mirrored scene from one that is not: only the other arm, whose pixels are this one's rows, can.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from acquire.forward import interpolation
from acquire.recon.gaussian import Fit, Model, Prior, Response, best_model

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray
    from scipy import sparse

    from acquire.alignment import Alignment
    from acquire.lines import Segment

    Floats = NDArray[np.float64]
    Scene = NDArray[np.float32]

MOST_LINES = 320
"""Largest number of lines, from the segment's middle: more cost more and add little."""
MOST_PIXELS = 64
"""Largest number of pixels of a line; more are averaged to as many."""
MOST_BLOCKS = 192
"""Largest number of row blocks; below it there is one for each fine row."""
UNKNOWN_BIT = 0.5
"""Mean of a code bit, in place of one that is not known."""


@dataclass(frozen=True, slots=True)
class Turn:
    """How arm B sees the scene of arm A.

    ``across``: along the other axis, as it should; ``rows`` and ``pixels``: with these in reverse order.
    """

    across: bool = True
    rows: bool = False
    pixels: bool = False

    def to_b(self, scene: Scene) -> Scene:
        """Arm A's scene (row, cosine, pixel) as arm B sees it."""
        view = _transposed(scene)[::-1] if self.across else scene
        view = view[::-1] if self.rows else view
        return view[:, :, ::-1] if self.pixels else view

    def to_a(self, scene: Scene) -> Scene:
        """Arm B's scene as arm A sees it."""
        view = scene[:, :, ::-1] if self.pixels else scene
        view = view[::-1] if self.rows else view
        return _transposed(view[::-1]) if self.across else view


def _transposed(scene: Scene) -> Scene:
    """The scene with rows and pixels exchanged; rows are several times finer: averaged and repeated."""
    rows, cosines, pixels = scene.shape
    finer = rows // pixels
    merged = scene.reshape(pixels, finer, cosines, pixels).mean(1, dtype=np.float32)
    return np.asarray(np.repeat(merged.transpose(2, 1, 0), finer, axis=0))


@lru_cache(maxsize=8)
def _sources(alignment: Alignment, size: int, rows: int, pixels: int, *, to_a: bool) -> sparse.csr_array:
    """The matrix that displaces frames (rows, pixels), of a field of ``size`` fine pixels, between the views.

    A point of the result shows what lies where ``alignment`` has it in the other view, arm A's if ``to_a``.
    Beyond the edge, the edge continues.
    """
    cell = size / np.array([[[rows]], [[pixels]]])
    centre = (np.array([[[rows]], [[pixels]]]) - 1) / 2
    points = (np.indices((rows, pixels)) - centre) * cell
    found = (alignment.to_a if to_a else alignment.to_b)(points, size / 2) / cell + centre
    return interpolation(*found).astype(np.float32)


def _displaced(scene: Scene, size: int, alignment: Alignment, *, to_a: bool) -> Scene:
    """A scene (row, cosine, pixel) as it appears in the view of the other arm; see `_sources`."""
    rows, cosines, pixels = scene.shape
    matrix = _sources(alignment, size, rows, pixels, to_a=to_a)
    # one product for all cosines
    flat = scene.transpose(0, 2, 1).reshape(rows * pixels, cosines)
    return np.asarray((matrix @ flat).reshape(rows, pixels, cosines).transpose(0, 2, 1))


AS_BUILT = Turn()
TURNS = tuple(
    Turn(across, rows, pixels)
    for across in (True, False)
    for rows in (False, True)
    for pixels in (False, True)
)


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A possible description of the lines.

    ``late``: sub-steps by which the lines of arm A, B are late against the code; ``substeps``: S, if it is
    not the segment's; ``random_code``: number of a random code that replaces the segment's, or 0.
    """

    inverted: bool = False
    late: tuple[int, int] = (0, 0)
    turn: Turn = AS_BUILT
    substeps: int | None = None
    random_code: int = 0

    @property
    def changes(self) -> int:
        """Number of points in which it differs from the segment's description."""
        return self.inverted + (self.late != (0, 0)) + (self.turn != AS_BUILT)


Exposure = tuple[bool, int, int, int]
"""The part of a hypothesis that affects one arm alone: inverted, late, S, random code."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Log likelihoods in blocks of lines (2·blocks,), those of arm A first; see the module."""

    own: Floats
    mutual: Floats

    @property
    def total(self) -> Floats:
        """Own and mutual evidence of each block."""
        return self.own + self.mutual


class LineModel:
    """Gaussian model of the lines of both arms, which gives the evidence for hypotheses; caches its results.

    ``bits(start, length)`` returns bits of the code, counted from the segment's first one; if None, bits
    beyond the segment's are unknown. ``alignment`` is the segment's, and may be replaced.
    """

    def __init__(self, segment: Segment, bits: Callable[[int, int], NDArray[np.uint8]] | None = None) -> None:
        self.substeps = segment.geometry.substeps
        self.stages = segment.geometry.stages
        self._bits = bits or padded(segment.code)
        self._size, self.alignment = segment.geometry.size, segment.alignment
        self.first, self.arms = prepared_lines(segment)
        self.lines, self.pixels = self.arms[0].shape
        # The cache belongs to this object alone: it ends with it, and another prior can empty it.
        self._view = lru_cache(maxsize=64)(self._make_view)
        self._prior: Prior | None = None

    def fit_prior(self, hypothesis: Hypothesis = Hypothesis()) -> Prior:
        """Judge everything from now on under the prior that suits this hypothesis best, and return it."""
        exposure = (hypothesis.inverted, hypothesis.late[0], hypothesis.substeps or self.substeps, 0)
        found = best_model(self._response(*exposure), list(self.arms)).prior
        self.prior = found
        return found

    @property
    def prior(self) -> Prior | None:
        """The prior that everything is judged under; None before one was fitted."""
        return self._prior

    @prior.setter
    def prior(self, prior: Prior) -> None:
        self._prior = prior
        # Views contain the prior's eigenvectors.
        self._view.cache_clear()

    def evidence(self, hypothesis: Hypothesis) -> Evidence:
        """Return the evidence for a hypothesis: of each arm alone, and of what each predicts of the other."""
        views = [self.view(hypothesis, arm) for arm in (0, 1)]
        own = [view.fits[arm].blocks for arm, view in enumerate(views)]
        turn = hypothesis.turn
        # Both are in arm A's axes, for the alignment: a displaced arm would otherwise seem early or late.
        a, b = views[0].scene(0), turn.to_a(views[1].scene(1))
        if self.alignment is not None:
            a = _displaced(a, self._size, self.alignment, to_a=True)
            b = _displaced(b, self._size, self.alignment, to_a=False)
        # What arm B saw predicts arm A, and the other way round.
        scenes = (b, turn.to_b(a))
        gain = [view.gain(arm, each) for arm, (view, each) in enumerate(zip(views, scenes, strict=True))]
        return Evidence(np.concatenate(own), np.concatenate(gain))

    def view(self, hypothesis: Hypothesis, arm: int) -> FittedArms:
        """Return the fits of both arms, exposed as the hypothesis says of ``arm``; kept for the next call."""
        substeps = hypothesis.substeps or self.substeps
        return self._view(hypothesis.inverted, hypothesis.late[arm], substeps, hypothesis.random_code)

    def _make_view(self, *exposure: *Exposure) -> FittedArms:
        prior = self.prior or self.fit_prior()
        return FittedArms(Model.of(self._response(*exposure), prior, self.pixels), self.arms)

    def _response(self, inverted: bool, late: int, substeps: int, random_code: int) -> Response:
        rows = self.stages * substeps
        span = substeps * (self.lines + self.stages) - 1
        # Late lines show earlier bits.
        code = self._bits(substeps * self.first - late, span).astype(np.float64)
        if random_code:
            code = np.random.default_rng(random_code).integers(0, 2, span).astype(np.float64)
        # The number is a multiple of the pixels, since the arms exchange rows and pixels.
        finer = max(1, min(rows, MOST_BLOCKS) // self.pixels)
        lit = 1 - code if inverted else code
        return Response(lit, rows=rows, substeps=substeps, lines=self.lines, pixels=self.pixels, finer=finer)


class FittedArms:
    """Both arms under one code: their fits, and the scenes that follow from them."""

    def __init__(self, model: Model, arms: tuple[Floats, Floats]) -> None:
        self.model = model
        self.fits: tuple[Fit, Fit] = (model.fit(arms[0]), model.fit(arms[1]))
        self._scenes: dict[int, Scene] = {}

    def scene(self, arm: int) -> Scene:
        if arm not in self._scenes:
            self._scenes[arm] = self.model.scene(self.fits[arm])
        return self._scenes[arm]

    def gain(self, arm: int, scene: Scene) -> Floats:
        """Gain of an arm's log likelihood by the other arm's ``scene``, in blocks of lines."""
        informed = self.model.informed(self.fits[arm], self.model.predict(scene))
        return np.asarray(informed.blocks - self.fits[arm].blocks)


def padded(code: NDArray[np.uint8]) -> Callable[[int, int], NDArray[np.float64]]:
    """The bits of a segment by index; 0.5 where they are unknown."""

    def bits(start: int, length: int) -> NDArray[np.float64]:
        found = np.full(length, UNKNOWN_BIT)
        low, high = max(start, 0), min(start + length, len(code))
        if low < high:
            found[low - start : high - start] = code[low:high]
        return found

    return bits


def prepared_lines(segment: Segment) -> tuple[int, tuple[Floats, Floats]]:
    """The first of the lines that are used, and these lines (line, pixel) of each arm, in units of the scene.

    Masked samples are interpolated along time, which does no harm for a few.
    """
    length = min(segment.geometry.lines, MOST_LINES)
    first = (segment.geometry.lines - length) // 2
    samples = segment.samples(np.float64)[:, first : first + length]
    mask = segment.mask[:, first : first + length] & np.isfinite(samples)
    stages = segment.geometry.stages
    edges = np.linspace(0, stages, min(MOST_PIXELS, stages) + 1).round().astype(int)
    arms, at = [], np.arange(length)
    for arm, known in zip(samples, mask, strict=True):
        lines = arm.copy()
        for pixel in np.flatnonzero(~known.all(0)):
            good = known[:, pixel]
            lines[:, pixel] = np.interp(at, at[good], arm[good, pixel]) if good.any() else 0.0
        arms.append(np.asarray(np.add.reduceat(lines, edges[:-1], axis=1) / np.diff(edges)))
    return first, (arms[0], arms[1])


def compare(one: Floats, other: Floats) -> tuple[float, float]:
    """Log likelihood of ``one`` over ``other``, and the same in standard errors over the blocks."""
    difference = one - other
    spread = float(difference.std(ddof=1)) if len(difference) > 1 else np.inf
    total = float(difference.sum())
    return total, total / max(spread * np.sqrt(len(difference)), 1e-12)
