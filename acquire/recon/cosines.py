"""Coefficients of cosines: how many the lines call for, and a solver in them with fitting parameters."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from acquire.recon.admm import Admm, AdmmParameters
from acquire.recon.band import segment_operator
from acquire.recon.bandwidth import FEWEST_COEFFICIENTS, estimate_coefficients
from acquire.recon.basis import cosine_hz
from acquire.recon.candidates import USUAL_FRAMES
from acquire.recon.estimates import InBand

if TYPE_CHECKING:
    from acquire.arrays import Array
    from acquire.recon.basis import Basis
    from acquire.recon.given import Given

TENTATIVE_SHARE = 0.15
"""Share of the budget after which the search for the bandwidth hurries."""
LAMPS_SHARE = 0.3
"""Share of the budget within which the search for the fastest lamp must end; otherwise it is skipped."""
# A share of 0.2 was a cliff on a busy host, where posing alone may take as much.
UNSEARCHED_SHARE = 0.4
"""Share of the budget that posing the problem may take; beyond it, the bandwidth is not searched for."""
FEW_FRAMES = 32
"""Largest number of frames that counts as few."""
HELD_BACK = 100.0
"""Factor of the penalties for few frames unless they explain the lines."""
STILL_PARAMETERS = AdmmParameters(tv_weight=5e-6, tv_penalty=1e-5, sign_penalty=3e-6, gradient_steps=6)
"""Parameters for a single frame. All sub-steps add up in it, so that the mean light has an eigenvalue some
thousand times that of a detail: lower penalties admit details, and more gradient steps reach them."""


def begin_in_cosines(given: Given, basis: Basis, start: Array | None, *, explained: bool = False) -> InBand:
    """A solver in the coefficients of a basis, from a start."""
    problem, options = given.problem, given.options
    frames, side, _ = given.video_shape
    operator = segment_operator(given.segment, basis, *given.merges)
    parameters = parameters_for(frames, explained=explained)
    if options.tv_weight is not None:
        parameters = replace(parameters, tv_weight=options.tv_weight)
    solver = Admm(
        problem.masked(operator),
        problem.used_samples,
        (basis.count, side, side),
        basis,
        parameters,
        start=start,
        denoiser=options.denoiser,
    )
    return InBand(solver, operator, basis, problem, parameters)


def find_band(given: Given) -> int:
    """Number of cosines: as requested, or as the lines show, or a few if no time is left."""
    segment, clock, frames = given.segment, given.clock, given.video_shape[0]
    if given.options.bandwidth is not None:
        return min(frames, max(1, round(given.options.bandwidth * frames)))
    if clock.spent(UNSEARCHED_SHARE):
        few = min(frames, FEWEST_COEFFICIENTS)
        limit_hz = few * cosine_hz(segment.substep_ns * given.options.temporal_merge, frames)
        clock.shortcuts.append(
            f"{clock.cause} left no time to search for the scene's bandwidth: the video holds only changes "
            f"slower than {limit_hz:.3g} Hz"
        )
        return few
    return estimate_coefficients(
        segment,
        given.problem,
        given.merges,
        partial(clock.spent, TENTATIVE_SHARE),
        partial(clock.affords, share=LAMPS_SHARE),
    )


def parameters_for(frames: int, *, explained: bool = False) -> AdmmParameters:
    """Parameters for a video of this many frames.

    Coefficients scale with the square root of the number of frames, and so does the suitable threshold λ/ρ. A
    handful of frames of a moving scene cannot explain its lines: higher penalties fit less of the motion. If
    they do (``explained``), the scene is at rest and is solved as a still is.
    """
    if frames == 1:
        return STILL_PARAMETERS
    usual = AdmmParameters()
    threshold = usual.tv_weight / usual.tv_penalty * min(1.0, frames / USUAL_FRAMES) ** 0.5
    penalty = usual.tv_penalty * (HELD_BACK if frames <= FEW_FRAMES and not explained else 1.0)
    return replace(
        usual,
        tv_weight=threshold * penalty,
        tv_penalty=penalty,
        sign_penalty=usual.sign_penalty * penalty / usual.tv_penalty,
        gradient_steps=STILL_PARAMETERS.gradient_steps if explained else usual.gradient_steps,
    )
