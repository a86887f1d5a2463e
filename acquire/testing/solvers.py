"""Tests that every solver must pass: extend `SolverContract`, or `DenoiserContract` for denoisers."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from acquire.codes import prbs
from acquire.forward import DualArm
from acquire.geometry import Geometry
from acquire.lines import Segment
from acquire.plugins import SOLVERS
from acquire.recon import reconstruct

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from acquire.recon import Reconstruction
    from acquire.recon.denoisers import Denoiser

GEOMETRY = Geometry(8, 2, 80)
SPATIAL_MERGE, TEMPORAL_MERGE = 2, 4
NOISE_PART = 0.01
"""Standard deviation of the lines' noise, as a fraction of their mean."""


def blinking_segment(seed: int = 5) -> tuple[Segment, NDArray[np.float64]]:
    """Return noisy lines of two squares that blink at different rates, and the true video (t, y, x)."""
    draws = np.random.default_rng(seed)
    code = prbs(23, 77, 0, GEOMETRY.span)
    operator = DualArm(GEOMETRY, code, SPATIAL_MERGE, TEMPORAL_MERGE, np.float64)
    frames, rows, columns = operator.video_shape
    t = np.arange(frames) / frames
    video = np.full((frames, rows, columns), 0.05)
    # At different rates: one picture with a common brightness over time leaves an error of 32 %.
    video[:, 1:4, 1:4] += (0.5 + 0.4 * np.sin(2 * np.pi * 3 * t))[:, None, None]
    video[:, 4:7, 3:7] += (0.5 + 0.4 * np.cos(2 * np.pi * 2 * t))[:, None, None]
    lines = operator.forward(video)
    lines = lines + NOISE_PART * lines.mean() * draws.standard_normal(lines.shape)
    segment = Segment(
        lines=lines.astype(np.float32),
        mask=np.ones(lines.shape, bool),
        code=code,
        geometry=GEOMETRY,
        time_ns=np.arange(GEOMETRY.lines, dtype=np.int64) * 20_000,
        substep_ns=10_000.0,
    )
    return segment, video


class SolverContract:
    """Needs ``solver``, the name of an installed solver; ``options`` are passed to it.

    ``most_error`` is the largest RMS error of its video on noisy lines, relative to the truth's RMS, over the
    trusted frames. Without a prior about 0.6 is possible; the built-in solvers reach 0.15 to 0.5.
    """

    solver: ClassVar[str]
    options: ClassVar[Mapping[str, Any]] = {}
    iterations: ClassVar[int] = 40
    most_error: ClassVar[float] = 0.5

    def solve(self, segment: Segment, **more: Any) -> Reconstruction:
        """Reconstruct the segment, with ``iterations`` unless ``more`` overrides it."""
        settings = {"iterations": self.iterations, "check": False} | more
        return reconstruct(
            segment,
            SPATIAL_MERGE,
            TEMPORAL_MERGE,
            solver=self.solver,
            solver_options=self.options,
            **settings,
        )

    def test_it_finds_what_blinks_in_noisy_lines(self) -> None:
        """The scene blinks within a line, so that a picture per line cannot explain it."""
        segment, truth = blinking_segment()
        result = self.solve(segment)
        assert result.video.shape == truth.shape
        assert np.isfinite(result.video).all()
        if not SOLVERS.load(self.solver).signed:
            assert result.video.min() >= 0
        found, true = result.video[result.trusted], truth[result.trusted]
        error = float(np.linalg.norm(found - true) / np.linalg.norm(true))
        assert error < self.most_error, f"the video has an error of {error:.0%} of the truth"
        assert result.quality.misfit < 0.2, f"its lines have a misfit of {result.quality.misfit:.0%}"

    def test_masked_samples_have_no_influence_and_twice_the_light_is_twice_the_video(self) -> None:
        """Masked samples hold anything, and units are not part of a scene."""
        segment, _ = blinking_segment()
        mask = segment.mask.copy()
        # Lost lines, and a defective column.
        mask[0, 20:24] = mask[1, :, 3] = False
        clean = self.solve(replace(segment, mask=mask))
        # Far above all others: any influence on the video would show.
        lines = np.where(mask, segment.lines, np.float32(1e6))
        spoilt = self.solve(replace(segment, mask=mask, lines=lines))
        np.testing.assert_array_equal(spoilt.video, clean.video)
        bright = self.solve(replace(segment, mask=mask, lines=2 * segment.lines))
        scale = float(np.abs(clean.video).max())
        np.testing.assert_allclose(bright.video, 2 * clean.video, atol=0.02 * scale)

    def test_a_stop_ends_it_with_the_best_so_far_and_every_iteration_is_reported(self) -> None:
        """Ctrl-C and budgets rely on it."""
        segment, _ = blinking_segment()
        stop, reported = threading.Event(), []

        def progress(step: Any) -> None:
            reported.append(step.iteration)
            # At the first report: a solver that ignores it would run for 10 000 iterations.
            stop.set()

        result = self.solve(segment, iterations=10_000, progress=progress, stop=stop)
        assert result.ended == "stopped"
        assert len(reported) == result.iterations < 1000, "it continues after a stop: iterate with its clock"
        assert np.isfinite(result.video).all()


class DenoiserContract(ABC):
    """Needs ``make``, which returns the denoiser."""

    @abstractmethod
    def make(self) -> Denoiser:
        """Return the denoiser under test."""

    def test_no_strength_changes_nothing_and_more_leaves_less_noise(self) -> None:
        """A solver chooses the strength by held-out samples, from 0 on."""
        draws = np.random.default_rng(2)
        flat = np.ones((3, 16, 12), np.float32)
        noisy = flat + 0.1 * draws.standard_normal(flat.shape).astype(np.float32)
        kept = noisy.copy()
        np.testing.assert_allclose(self.make().prox(noisy, 0.0), noisy, atol=1e-5)
        cleaned = self.make().prox(noisy, 0.1)
        assert cleaned.shape == noisy.shape
        assert cleaned.dtype == noisy.dtype
        left = float(np.std(cleaned - flat) / np.std(noisy - flat))
        assert left < 0.8, f"a strength equal to the noise leaves {left:.0%} of it"
        np.testing.assert_array_equal(noisy, kept, "it wrote into its input frames")

    def test_one_strength_per_frame_is_possible(self) -> None:
        """Frames are coefficients, whose noise differs from one to the next."""
        frames = np.random.default_rng(3).standard_normal((2, 8, 8)).astype(np.float32)
        weights = np.array([0.0, 0.3], np.float32)
        mixed = self.make().prox(frames, weights)
        np.testing.assert_allclose(mixed[0], frames[0], atol=1e-5)
        assert not np.allclose(mixed[1], frames[1], atol=1e-3)
