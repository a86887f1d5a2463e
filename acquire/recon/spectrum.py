"""The spectrum of what flows, learned from the lines: a prior for flames, smoke and waves on water.

    R(θ) = σ²/2·Σ |θ̂|²/S        θ̂: cosines of rows, columns and time, S: their energies
                                σ²: mean square of what a video leaves of a sample

For a scene that is Gaussian with these energies, this is the likeliest video. A smooth volume
(`smooth.Smooth`) supposes that energy falls with the fourth power of frequency, and that time is one more
axis. No fluid does: its light as a whole may flicker while its details rise, and waves have the frequency of
their length. So the energies are taken from a first video, the lines are solved with them, and the better
video gives better ones. Energy that noise has left in a first video shrinks from round to round, and what the
lines show does not.

There is no weight to search for: σ² is known from the residual, and the energies have the scene's units.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter

from acquire.arrays import host
from acquire.recon.smooth import Wiener, cosines_across
from acquire.recon.workbench import NEXT_ITERATIONS, SEARCH_SHARE

if TYPE_CHECKING:
    from acquire.recon.workbench import Trial

ROUNDS = 8
"""Largest number of rounds; the energies hardly change after five."""
NEIGHBOURS = (0.5, 1.0, 1.0)
"""Standard deviation, in cosines of time, rows and columns, over which energies are averaged: one coefficient
does not show its own."""
LEAST_ENERGY = 1e-14
"""Least energy, relative to the largest."""
LARGEST_PENALTY = 1e20
"""That of coefficients without energy: whatever the weight, it makes them 0, and float32 holds it."""


def learn_spectrum(smooth: Trial) -> Trial:
    """The video of a smooth volume, solved again with its own spectrum, unless that predicts clearly worse.

    Rounds are not ended by a better one before: a narrower spectrum admits less noise, which hardly shows.
    """
    bench, kept = smooth.bench, smooth
    learned = replace(smooth.candidate, learned=True)
    for _ in range(ROUNDS):
        if bench.clock.spent(SEARCH_SHARE):
            break
        found = bench.attempt(learned, NEXT_ITERATIONS, kept, spectrum_of(kept))
        if bench.held_out.clearly_less(smooth.errors, found.errors):
            break
        kept = found
    return kept


def spectrum_of(trial: Trial) -> Wiener:
    """R of a trial's video and residual as a denoiser, whose weight is 1."""
    problem = trial.bench.problem
    residual = (trial.bench.predict(trial) - problem.samples)[problem.weight > 0]
    theta = host(trial.admm.theta)
    across = cosines_across(theta.shape[1])
    own = np.square(across @ theta @ across.T)
    least = LEAST_ENERGY * (own.max() or 1.0)
    # The mean of neighbours is geometric, since energies fall by orders of magnitude. What outshines them,
    # as the light as a whole does, has an energy of its own.
    energies = (own + np.exp(gaussian_filter(np.log(own + least), NEIGHBOURS))) / 2
    penalty = np.square(residual, dtype=np.float64).mean() / np.maximum(energies, least)
    penalty = np.minimum(penalty, LARGEST_PENALTY)
    return Wiener(lambda *_: penalty)
