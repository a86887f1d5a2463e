"""How well the lines agree with what is said of them: code, its place, arms' orientation, geometry.

Two sorts of evidence, both log likelihoods in blocks of lines (`gaussian`):

    own       of each arm's lines, if that code was shone: no matter how the arm looks at the scene
    mutual    what each arm's lines gain when the other arm's scene, turned as said, foretells them

An arm alone cannot tell a code that is late by d sub-steps from a scene that lies d rows off, nor a mirrored
scene from one that is not: only the other arm, whose pixels are this one's rows, can.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from acquire.recon.gaussian import Fit, Model, Prior, Response, best_model

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from acquire.lines import Segment

    Floats = NDArray[np.float64]
    Scene = NDArray[np.float32]

MOST_LINES = 320
"""From the segment's middle: more cost more and tell little more."""
MOST_PIXELS = 64
"""More are averaged to as many."""
MOST_BLOCKS = 192
"""Of rows: fine rows as far as these."""
UNKNOWN_BIT = 0.5


@dataclass(frozen=True, slots=True)
class Turn:
    """How arm B sees the scene of arm A: ``across``: along the other axis, as it should; then its rows
    and its pixels in the other order than they should be."""

    across: bool = True
    rows: bool = False
    pixels: bool = False

    def to_b(self, scene: Scene) -> Scene:
        """Arm A's scene (row, cosine, pixel) as arm B sees it."""
        seen = _transposed(scene)[::-1] if self.across else scene
        seen = seen[::-1] if self.rows else seen
        return seen[:, :, ::-1] if self.pixels else seen

    def to_a(self, scene: Scene) -> Scene:
        """Arm B's as arm A sees it."""
        seen = scene[:, :, ::-1] if self.pixels else scene
        seen = seen[::-1] if self.rows else seen
        return _transposed(seen[::-1]) if self.across else seen


def _transposed(scene: Scene) -> Scene:
    """Rows, which are as many times finer, for pixels, whose light is held over them."""
    rows, cosines, pixels = scene.shape
    finer = rows // pixels
    merged = scene.reshape(pixels, finer, cosines, pixels).mean(1, dtype=np.float32)
    return np.asarray(np.repeat(merged.transpose(2, 1, 0), finer, axis=0))


AS_BUILT = Turn()
TURNS = tuple(
    Turn(across, rows, pixels)
    for across in (True, False)
    for rows in (False, True)
    for pixels in (False, True)
)


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """What may be the case. ``late``: sub-steps by which the lines of arm A, B are late against the code;
    ``substeps``: S, where it is not the segment's; ``strange``: a random code of that number in its place."""

    inverted: bool = False
    late: tuple[int, int] = (0, 0)
    turn: Turn = AS_BUILT
    substeps: int | None = None
    strange: int = 0

    @property
    def changes(self) -> int:
        """In how many points it differs from what is said."""
        return self.inverted + (self.late != (0, 0)) + (self.turn != AS_BUILT)


Said = tuple[bool, int, int, int]
"""A hypothesis without turn, of one arm, as `Witness` remembers it."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Log likelihoods in blocks of lines (2·blocks,), arm A's first; see the module."""

    own: Floats
    mutual: Floats

    @property
    def total(self) -> Floats:
        return self.own + self.mutual


class Witness:
    """The lines of both arms of a segment, to be asked about hypotheses; remembers what it worked out.

    ``bits(start, length)`` are the code's, counted from the segment's first; else those of the segment, and
    what lies beyond it is unknown.
    """

    def __init__(self, segment: Segment, bits: Callable[[int, int], NDArray[np.uint8]] | None = None) -> None:
        self.substeps = segment.geometry.substeps
        self.stages = segment.geometry.stages
        self._bits = bits or padded(segment.code)
        self.first, self.arms = prepared_lines(segment)
        self.lines, self.pixels = self.arms[0].shape
        self._view = lru_cache(maxsize=64)(self._make_view)
        self._prior: Prior | None = None

    def settle(self, hypothesis: Hypothesis = Hypothesis()) -> Prior:
        """From now on everything is judged under the prior that suits this hypothesis best."""
        said = (hypothesis.inverted, hypothesis.late[0], hypothesis.substeps or self.substeps, 0)
        response = self._response(*said)
        found = best_model(response, list(self.arms)).prior
        self.prior = found
        return found

    @property
    def prior(self) -> Prior | None:
        """What everything is judged under; None before anything was settled."""
        return self._prior

    @prior.setter
    def prior(self, prior: Prior) -> None:
        self._prior = prior
        self._view.cache_clear()

    def evidence(self, hypothesis: Hypothesis) -> Evidence:
        views = [self.view(hypothesis, arm) for arm in (0, 1)]
        own = [view.fits[arm].blocks for arm, view in enumerate(views)]
        turn = hypothesis.turn
        told = (turn.to_a(views[1].scene(1)), turn.to_b(views[0].scene(0)))
        gain = [view.gain(arm, each) for arm, (view, each) in enumerate(zip(views, told, strict=True))]
        return Evidence(np.concatenate(own), np.concatenate(gain))

    def view(self, hypothesis: Hypothesis, arm: int) -> View:
        substeps = hypothesis.substeps or self.substeps
        return self._view(hypothesis.inverted, hypothesis.late[arm], substeps, hypothesis.strange)

    def _make_view(self, *said: *Said) -> View:
        if self.prior is None:
            self.settle()
        assert self.prior is not None
        return View(Model.of(self._response(*said), self.prior, self.pixels), self.arms)

    def _response(self, inverted: bool, late: int, substeps: int, strange: int) -> Response:
        rows = self.stages * substeps
        span = substeps * (self.lines + self.stages) - 1
        code = self._bits(substeps * self.first - late, span).astype(np.float64)
        if strange:
            code = np.random.default_rng(strange).integers(0, 2, span).astype(np.float64)
        finer = max(1, min(rows, MOST_BLOCKS) // self.pixels)
        lit = 1 - code if inverted else code
        return Response(lit, rows, substeps, self.lines, self.pixels, finer)


class View:
    """Both arms under one code: their fits, and the scenes that these imply."""

    def __init__(self, model: Model, arms: tuple[Floats, Floats]) -> None:
        self.model = model
        self.fits: tuple[Fit, Fit] = (model.fit(arms[0]), model.fit(arms[1]))
        self._scenes: dict[int, Scene] = {}

    def scene(self, arm: int) -> Scene:
        if arm not in self._scenes:
            self._scenes[arm] = self.model.scene(self.fits[arm])
        return self._scenes[arm]

    def gain(self, arm: int, told: Scene) -> Floats:
        """What an arm's lines gain in likelihood by a scene that the other tells, in blocks of lines."""
        informed = self.model.informed(self.fits[arm], self.model.foretell(told))
        return np.asarray(informed.blocks - self.fits[arm].blocks)


def padded(code: NDArray[np.uint8]) -> Callable[[int, int], NDArray[np.float64]]:
    """The bits of a segment by index; half lit where they are not known."""

    def bits(start: int, length: int) -> NDArray[np.float64]:
        found = np.full(length, UNKNOWN_BIT)
        low, high = max(start, 0), min(start + length, len(code))
        if low < high:
            found[low - start : high - start] = code[low:high]
        return found

    return bits


def prepared_lines(segment: Segment) -> tuple[int, tuple[Floats, Floats]]:
    """The first line, and the lines (line, pixel) of each arm that are looked at, in units of the scene.

    Samples that are masked are interpolated along the lines: few do no harm.
    """
    length = min(segment.geometry.lines, MOST_LINES)
    first = (segment.geometry.lines - length) // 2
    samples = segment.samples(np.float64)[:, first : first + length]
    mask = segment.mask[:, first : first + length] & np.isfinite(samples)
    a, b = (
        _merged(_filled(arm, known), min(MOST_PIXELS, segment.geometry.stages))
        for arm, known in zip(samples, mask, strict=True)
    )
    return first, (a, b)


def _filled(lines: Floats, known: NDArray[np.bool_]) -> Floats:
    if known.all():
        return lines
    out, at = lines.copy(), np.arange(len(lines))
    for pixel in np.flatnonzero(~known.all(0)):
        good = known[:, pixel]
        out[:, pixel] = np.interp(at, at[good], lines[good, pixel]) if good.any() else 0.0
    return out


def _merged(lines: Floats, pixels: int) -> Floats:
    edges = np.linspace(0, lines.shape[1], pixels + 1).round().astype(int)
    return np.asarray(np.add.reduceat(lines, edges[:-1], axis=1) / np.diff(edges))


def compare(one: Floats, other: Floats) -> tuple[float, float]:
    """By how much ``one`` is likelier than ``other``, and that in standard errors over the blocks."""
    difference = one - other
    spread = float(difference.std(ddof=1)) if len(difference) > 1 else np.inf
    total = float(difference.sum())
    return total, total / max(spread * np.sqrt(len(difference)), 1e-12)
