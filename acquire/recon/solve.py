"""Solvers other than the default, which is `choose`: the paper's, and the light of a known image.

twist       the paper's, on all frames
twist-band  the same algorithm with the default's band and sign
(static image known)  one curve, least squares
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from acquire.arrays import host
from acquire.forward import merge_video
from acquire.recon.band import InBasis, band_operator
from acquire.recon.basis import TemporalBasis
from acquire.recon.cosines import find_band
from acquire.recon.curves import CurveFit, CurveOperator
from acquire.recon.estimates import InBand
from acquire.recon.given import Given
from acquire.recon.solver import Solver
from acquire.recon.twist import Twist, TwistParameters

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.recon.clock import IterationClock
    from acquire.recon.estimates import Estimate
    from acquire.recon.options import SolveOptions
    from acquire.recon.problem import Problem


class TwistSolver(Solver):
    """The paper's: TwIST on all frames, with neither a band nor a sign constraint."""

    passes: ClassVar[float] = 18.0
    signed: ClassVar[bool] = True
    holds_out: ClassVar[bool] = False

    def solve(
        self, segment: Segment, problem: Problem, options: SolveOptions, clock: IterationClock
    ) -> Estimate:
        """Solve with the paper's TwIST for a fixed weight of total variation, in all frames."""
        return solve_twist(Given(segment, problem, options, clock), banded=False)


class BandedTwistSolver(Solver):
    """The paper's algorithm with the band and the sign constraint of the default."""

    def solve(
        self, segment: Segment, problem: Problem, options: SolveOptions, clock: IterationClock
    ) -> Estimate:
        """Solve with TwIST in the band that the lines support, for light that is not negative."""
        return solve_twist(Given(segment, problem, options, clock), banded=True)


def solve_twist(given: Given, *, banded: bool) -> Estimate:
    """Solve with the paper's algorithm; ``banded``: in the band that the lines show."""
    segment, problem, options, shape = given.segment, given.problem, given.options, given.video_shape
    count = find_band(given) if banded else shape[0]
    basis = TemporalBasis(shape[0], count, problem.arrays)
    # With all cosines, the shear is less work than dense factors.
    make = band_operator if banded else InBasis
    operator = make(
        segment.geometry,
        segment.code,
        basis,
        *given.merges,
        alignment=segment.alignment,
        blur=segment.blur,
    )
    parameters = TwistParameters()
    if options.tv_weight is not None:
        parameters = replace(parameters, tv_weight=options.tv_weight)
    solver = Twist(
        problem.masked(operator),
        problem.used_samples,
        (basis.count, *shape[1:]),
        parameters,
        basis if banded else None,
    )
    estimate = InBand(solver, operator, basis, problem, parameters)
    for _ in given.clock.run(options.iterations, "solve", video=estimate.video):
        solver.step()
    return estimate


class KnownImage:
    """Estimate of a known image with an unknown curve: X = s(t)·image.

    Frames that the code leaves dark are not observed: their light is interpolated from their neighbours.
    """

    held_out_error: float | None = None

    def __init__(self, given: Given, image: NDArray[Any]) -> None:
        segment, frames = given.segment, given.video_shape[0]
        self._merge, temporal_merge = given.merges
        self._problem = problem = given.problem.on_host()
        arrays = problem.arrays
        self._image = image.astype(arrays.dtype)
        # There is no band: with the picture known, the lines determine its light up to pulses of single
        # sub-steps.
        basis = TemporalBasis(frames, frames, arrays)
        # The norm is 1, whatever the image's units, so that the fit's ridge means the same.
        patterns = self._image[None] / np.linalg.norm(self._image)
        self._operator = CurveOperator(segment, patterns, basis, temporal_merge)
        coefficients = np.zeros((frames, 1))
        # There is a single iteration, but one of the clock's, so that progress and time are counted.
        for _ in given.clock.run(1, "light"):
            coefficients = CurveFit(segment, problem, basis, temporal_merge)(patterns, coefficients)
        self._coefficients = arrays.asarray(coefficients)
        seen = np.add.reduceat(segment.code, np.arange(0, len(segment.code), temporal_merge)) > 0
        light = basis.synthesize(self._coefficients)[:, 0] / np.linalg.norm(self._image)
        self._light = np.interp(np.arange(frames), np.flatnonzero(seen), light[seen]).astype(arrays.dtype)

    def predict(self) -> NDArray[Any]:
        """Return the lines of the picture under its light s(t)."""
        return host(self._operator.forward(self._coefficients)) / self._problem.norm

    def video(self) -> NDArray[Any]:
        """Return s(t) · picture (T, n′, n′)."""
        video: NDArray[Any] = self._light[:, None, None] * merge_video(self._image[None], self._merge, 1)
        return video

    def facts(self) -> dict[str, Any]:
        """Return the number of coefficients of the light, the only unknowns."""
        return {"patterns": 1}
