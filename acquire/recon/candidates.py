"""Candidate priors: what a search tries, and the solver's parameters for each.

A search changes one parameter of a candidate at a time. Nothing here is fixed for good: weights, paces and
numbers of cosines are where a search starts, in units that mean the same whatever the voxels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Literal

from acquire.recon.admm import AdmmParameters
from acquire.recon.basis import CyclicBasis, TemporalBasis
from acquire.recon.cycle import most_harmonics
from acquire.recon.ground import GroundedTv
from acquire.recon.smooth import Smooth
from acquire.recon.tv import FrameTv
from acquire.recon.volume import VolumeTv

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.arrays import Arrays
    from acquire.recon.denoisers import Denoiser

STILL_STEPS, STILL_SHARE = 60, 0.02
"""Largest number of gradient steps for a still, and the share of the residual at which they end."""
COSINES = (8, 12, 16, 24, 36, 54)
HARMONICS = (2, 3, 5, 8, 12, 18)
"""Numbers of harmonics of motion that repeats."""
LEAST_PACE, LARGEST_PACE = 0.25, 64.0
LEAST_WEIGHT, LARGEST_WEIGHT = 1e-7, 1e3
GROUND, LEAST_GROUND, NO_GROUND = 0.1, 1e-2, 1.0
"""A ground's weight at first, and its limits; from the second on, a volume without one costs less."""
WEIGHT_STEP, PACE_STEP = 10**0.5, 4.0
USUAL_FRAMES, USUAL_ENERGY = 980, 7.1e-3
"""Number of frames and response to a voxel in Fig. 9, for which weights are given."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A prior and its parameters: K cosines, weight λ, pace μ (scale of a volume's time axis).

    Of a ``cycle``, the coefficients are the constant and its harmonics.
    ``ground`` is the weight of a still ground behind a volume, relative to that of the volume; 0 is none.
    ``brightness``: times a free brightness of the whole scene; ``change``: the difference from the best
    still; ``fine``: solved at N_m = 1, then merged; ``robust``: samples with large residuals have less
    weight. ``drift`` is the path of a volume's contents and ``rotation`` their turn, see `VolumeTv`;
    () is none. ``speed_changes`` are those of a cycle, or of these. ``learned``: the spectrum of a smooth
    volume is learned from the lines, beginning with this weight and pace (`spectrum`).
    """

    prior: Literal["still", "smooth", "volume", "cycle"]
    coefficients: int
    weight: float
    pace: float = 0.0
    ground: float = 0.0
    brightness: bool = False
    change: bool = False
    fine: bool = False
    robust: bool = False
    period_frames: float = 0.0
    speed_changes: tuple[float, ...] = ()
    drift: tuple[float, ...] = ()
    rotation: tuple[float, ...] = ()
    learned: bool = False

    def denoiser(self) -> Denoiser:
        """The denoiser of this prior."""
        if self.prior == "still":
            return FrameTv(10)
        if self.prior == "smooth":
            return Smooth(self.pace)
        cyclic = self.prior == "cycle"
        # A cycle's basis has its speed.
        rise = 0.0 if cyclic or not self.speed_changes else self.speed_changes[0]
        volume = partial(GroundedTv, ground=self.ground) if self.ground else VolumeTv
        return volume(self.pace, cyclic=cyclic, drift=self.drift, rotation=self.rotation, rise=rise)

    def with_path_of(self, other: Candidate) -> Candidate:
        """The candidate, following what another volume follows."""
        return replace(self, drift=other.drift, rotation=other.rotation, speed_changes=other.speed_changes)

    def basis(self, frames: int, arrays: Arrays) -> TemporalBasis | CyclicBasis:
        """The temporal basis of its coefficients."""
        if self.prior == "cycle":
            return CyclicBasis(frames, self.coefficients // 2, self.period_frames, arrays, self.speed_changes)
        return TemporalBasis(frames, self.coefficients, arrays)

    def is_stronger_than(self, other: Candidate) -> bool:
        """Whether it leaves the video less freedom than ``other``, which differs in one parameter."""
        more = self.weight > other.weight or self.pace > other.pace or self.coefficients < other.coefficients
        return more or (self.ground or NO_GROUND) > (other.ground or NO_GROUND)

    def with_weight(self, factor: float) -> Candidate | None:
        """The candidate with another weight; None beyond the limits."""
        weight = rounded(self.weight * factor)
        return replace(self, weight=weight) if LEAST_WEIGHT <= weight <= LARGEST_WEIGHT else None

    def with_pace(self, factor: float) -> Candidate | None:
        """The candidate with another pace; None beyond the limits."""
        pace = self.pace * factor
        return replace(self, pace=pace) if LEAST_PACE <= pace <= LARGEST_PACE else None

    def with_ground(self, factor: float) -> Candidate | None:
        """The candidate with another weight of its ground; None beyond the limits."""
        ground = rounded((self.ground or NO_GROUND) * factor)
        return replace(self, ground=ground) if LEAST_GROUND <= ground < NO_GROUND else None

    def with_coefficients(self, step: int, frames: int) -> Candidate | None:
        """The candidate with the next number of coefficients in either direction; None beyond the limits."""
        if self.prior == "cycle":
            most = most_harmonics(self.period_frames, self.speed_changes)
            counts = [2 * min(each, most) + 1 for each in HARMONICS]
        else:
            counts = [min(each, frames) for each in COSINES]
        further = [each for each in counts if (each - self.coefficients) * step > 0]
        return replace(self, coefficients=min(further, key=lambda n: n * step)) if further else None

    def steps(self, frames: int) -> Iterator[Callable[[Candidate], Candidate | None]]:
        """Ways to change one parameter; each returns None at its limit."""
        factor = WEIGHT_STEP**2 if self.prior == "smooth" else WEIGHT_STEP
        for by in (1 / factor, factor):
            yield partial(Candidate.with_weight, factor=by)
        if self.prior == "still":
            return
        stride = 2.0 if self.prior == "smooth" else PACE_STEP
        for by in (1 / stride, stride):
            yield partial(Candidate.with_pace, factor=by)
        for step in (1, -1):
            yield partial(Candidate.with_coefficients, step=step, frames=frames)
        if self.prior in ("volume", "cycle"):
            for by in (1 / WEIGHT_STEP, WEIGHT_STEP) if self.ground else (GROUND,):
                yield partial(Candidate.with_ground, factor=by)


STILL = Candidate("still", 1, 2e-3)
SMOOTH = Candidate("smooth", 24, 3e-3, 1.0)
VOLUME = Candidate("volume", 24, 2e-3, 4.0)
CALM = Candidate("volume", 24, 2e-3, 16.0)
GROUNDED = Candidate("volume", 24, 2e-3, 4.0, ground=GROUND)
CYCLE = Candidate("cycle", 2 * 8 + 1, 1e-3, 2.0)


def rounded(weight: float) -> float:
    """A weight to three digits, so that a search recognises candidates it has tried."""
    return float(f"{weight:.3g}")


def parameters(candidate: Candidate, frames: int, response: float) -> AdmmParameters:
    """The solver's parameters for a candidate, scaled so that it means the same whatever the voxels.

    λ scales with the coefficients, hence with the square root of the number of frames, and both λ and ρ with
    the lines' ``response`` to a voxel.
    """
    w, extent = candidate.weight, (frames / USUAL_FRAMES) ** 0.5
    if candidate.prior == "still":
        # All sub-steps add up in one frame, whose mean light outweighs a detail thousands of times: only
        # small penalties and data steps run to their end recover the details.
        weight, penalty, steps = w * extent, 0.1 * w, STILL_STEPS
    elif candidate.prior == "smooth":
        # A spectrum that was learned has the lines' own units.
        weight, penalty, steps = 1 / response if candidate.learned else w, 2e-3, 2
    else:
        weight, penalty, steps = w * extent, 2e-3 * (w / 1e-3) ** 0.5, 2
    weight, penalty = response * weight, response * penalty
    return AdmmParameters(
        tv_weight=weight,
        tv_penalty=penalty,
        sign_penalty=0.3 * penalty,  # the ratio of `AdmmParameters`
        gradient_steps=steps,
        gradient_share=0.0 if steps < STILL_STEPS else STILL_SHARE,
        preconditioned=True,
    )
