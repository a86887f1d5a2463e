"""Lamps beside something that moves: patterns with curves in pixels, and a volume in voxels, in one solver.

    X(r, c, t) = Σ_k u_k(t)·Z_k(r, c) + V(r, c, t)

Whatever moves needs a pattern for each of its places, so that such a scene is no sum of a few; and a volume
does not hold lamps, because light that blinks costs its total variation twice its contrast in every period.
Solved together, each part takes what it explains at the lower cost. The still ground belongs to the patterns,
which are finer. Which is which shows in the fast cosines of the first look, which only lamps reach.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.arrays import host
from acquire.recon.admm import Admm
from acquire.recon.band import segment_operator
from acquire.recon.bandwidth import FEWEST_COEFFICIENTS
from acquire.recon.basis import TemporalBasis
from acquire.recon.joined import JoinedLayout, JoinedOperator, JoinedPrior, JoinedSign
from acquire.recon.patterns import GAP, PARAMETERS, Patterns, Refinement
from acquire.recon.sign import SignSplit
from acquire.recon.tv import FrameTv
from acquire.recon.volume import VolumeTv

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.arrays import Array
    from acquire.recon.admm import AdmmParameters
    from acquire.recon.basis import Basis, LearnedBasis
    from acquire.recon.given import Given
    from acquire.recon.problem import Operator

MOST_LAMPS, MOST_SLOW = 8, 3
"""Largest number of fast patterns, and of slow ones besides the ground."""
PACE, VOLUME_WEIGHT = 3.0, 0.3
"""μ of the volume, and its λ/ρ relative to the patterns'."""
WEIGHT = 0.5
"""λ and ρ relative to those of patterns alone. λ is held from the start: what moves is lost in the patterns'
errors if these are smoothed first."""


def find_lamps(theta: NDArray[Any], basis: Basis) -> list[Patterns]:
    """Lamps and still ground of a look's coefficients (K, n′, n′), and what moves; empty without fast lamps.

    The patterns are those of the fast cosines, which hold nothing that moves, and the mean. Lamps that are
    slow as well are the strongest patterns of the rest: each further result has one more of these.
    """
    count, side, _ = theta.shape
    fast = basis.held >= FEWEST_COEFFICIENTS
    flat = theta.reshape(count, -1).astype(np.float64)
    lamps, strength = _principal(flat[fast])
    gaps = np.flatnonzero(strength[:-1][:MOST_LAMPS] > GAP * strength[1:][:MOST_LAMPS]) + 1
    if not len(gaps):
        return []
    space = np.linalg.qr(np.concatenate([lamps[: gaps[-1]], flat[:1]]).T)[0].T
    others = _principal(flat - flat @ space.T @ space)[0][:MOST_SLOW]
    found = []
    for more in range(len(others) + 1):
        images = np.concatenate([space, others[:more]])
        mixed = flat @ images.T
        curves, sizes, turn = np.linalg.svd(mixed, full_matrices=False)
        patterns = ((sizes[:, None] * turn) @ images).reshape(-1, side, side).astype(theta.dtype)
        moving = (flat - mixed @ images)[~fast].reshape(-1, side, side).astype(theta.dtype)
        found.append(Patterns(curves.astype(theta.dtype), patterns, moving))
    return found


def _principal(rows: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Right singular vectors of rows (K, n′²), strongest first, and their singular values."""
    energy, left = np.linalg.eigh(rows @ rows.T)
    strength = np.sqrt(np.maximum(energy[::-1], 0))
    images = left.T[::-1] @ rows / np.maximum(strength, np.finfo(np.float64).tiny)[:, None]
    return images, strength


class PatternsAndMotion:
    """The unknowns of patterns and of a volume, ``motion`` (K, n′, n′) at first: θ is both in one array."""

    share, loosens = WEIGHT, False

    def __init__(self, given: Given, cosines: TemporalBasis, motion: Array) -> None:
        self._given = given
        self._slow = TemporalBasis(cosines.frames, motion.shape[0], given.problem.arrays)
        """The basis of the volume."""
        self._volume_operator = segment_operator(given.segment, self._slow, *given.merges)

    def stacked(self, found: Patterns) -> Array:
        """Return volume and patterns in one array, flat, since their shapes differ."""
        asarray = self._given.problem.arrays.asarray  # what a refinement begins with is on the host
        return self._layout(found).joined(asarray(found.motion), asarray(found.patterns))

    def unstacked(self, theta: Array, found: Patterns) -> Patterns:
        """Return the patterns with the volume, which a next round begins with."""
        motion, patterns = self._layout(found).parts(theta)
        return Patterns(found.curves, patterns, motion)

    def operator(self, patterns: Operator, found: Patterns) -> Operator:
        """Return the sum of both operators, the volume's in few cosines."""
        return JoinedOperator(self._layout(found), self._volume_operator, patterns)

    def priors(
        self, found: Patterns, basis: LearnedBasis, parameters: AdmmParameters, /, *, emphasis: Array
    ) -> dict[str, Any]:
        """Return a prior and a sign for each part: the volume's prior also acts in time."""
        layout = self._layout(found)
        parts = layout.parts(self.stacked(found))
        volume = SignSplit(Admm.grid_of(self._slow, parameters), parts[0], None)
        patterns = SignSplit(Admm.grid_of(basis, parameters), parts[1], None)
        denoisers = VolumeTv(PACE), FrameTv(parameters.tv_iterations, joint=True)
        weights = VOLUME_WEIGHT, self._given.problem.arrays.asarray(emphasis)
        return {
            "denoiser": JoinedPrior(layout, denoisers, weights),
            "sign": JoinedSign(layout, volume, patterns),
        }

    def other_lines(self, found: Patterns) -> Array:
        """Return the volume's lines, which the curves are fitted beside."""
        return self._volume_operator.forward(found.motion)

    def other_video(self, found: Patterns) -> NDArray[Any]:
        """Return the frames (T, n′, n′) of the volume."""
        return host(self._slow.synthesize(found.motion))

    def _layout(self, found: Patterns) -> JoinedLayout:
        assert found.motion is not None
        # A voxel's penalty is that of its pixels.
        scale = float(self._given.options.spatial_merge)
        return JoinedLayout(tuple(found.motion.shape), tuple(found.patterns.shape), scale)


def beside_motion(
    given: Given, cosines: TemporalBasis, found: Patterns, parameters: AdmmParameters = PARAMETERS
) -> Refinement:
    """A refinement of patterns and, in the same solver, of a volume; ``found.motion`` is its start."""
    assert found.motion is not None
    return Refinement(given, cosines, found, parameters, PatternsAndMotion(given, cosines, found.motion))
