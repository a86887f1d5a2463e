"""Gaussian process model of one arm's lines under a code and a geometry, in closed form.

The light of the scene is taken as Gaussian, with a covariance that is a product over rows, columns and time::

    x(r, c, t) = u + Σ_k cos_k(t)·θ_k(r, c),    cov θ_k = a_k·exp(−|Δr|/ℓ)·exp(−|Δc|/ℓ)

Lines are linear in it, by the same map F for every pixel of both arms, so that their covariance is G(line,
line') ⊗ exp(−|Δc|/ℓ) + noise: two small eigendecompositions give the likelihood of all samples, the most
likely scene, and each arm's prediction of the other, without iterations. The level u and the scale are
fitted. No such prior makes a good picture; but lines that were made by another code are unlikely under any of
them, which is all that is needed here.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

FINE, SLOW, FAST = 4, 16, 128
"""Numbers of cosines that are resolved in fine rows, in rows as wide as pixels, and in few rows: sharp edges
at rest would look like a delay if they fell between blocks."""
FAST_ROWS = 16
"""Number of those few rows."""
EVIDENCE_LINES = 24
"""Length of the blocks of lines in which evidence is counted; their spread gives its uncertainty."""
SMALLEST = 1e-30
"""Keeps quotients finite for lines that do not vary."""


@dataclass(frozen=True, slots=True)
class Prior:
    """Parameters of the covariance.

    ``length``: ℓ as a share of the picture; a_0 = 1 and a_k = ``change``/(1 + (k/``fast``)²); ``noise``:
    variance of a sample's noise relative to that of its light.
    """

    length: float
    change: float
    fast: float
    noise: float

    @property
    def spectrum(self) -> Floats:
        """a_k (FAST,)."""
        k = np.arange(1, FAST)
        return np.concatenate([[1.0], self.change / (1 + (k / self.fast) ** 2)])


LADDER = tuple(
    Prior(length, change, fast, 1e-3)
    for length in (0.02, 0.06, 0.2)
    for change, fast in (
        (1e-4, 1.0),
        (0.03, 3.0),
        (0.3, 3.0),
        (1.0, 3.0),
        (0.03, 40.0),
        (0.3, 40.0),
        (0.01, np.inf),
    )
)
"""From a fine still to a smooth and fast scene; the noise of each is the best of `NOISES`.

Light that blinks at a steady rate has its changes in a few cosines, high ones in a long segment, where the
spectra that fall have none left. The last one expects any rate alike: its cosines together have about as much
light as there is at rest, as if it blinked on and off.
"""
NOISES = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1)


def correlation(count: int, length: float) -> Floats:
    """Matrix of exp(−|Δ|/ℓ) between ``count`` neighbours that tile the picture."""
    at = (np.arange(count) + 0.5) / count
    return np.exp(-np.abs(at[:, None] - at) / length)


class Response:
    """F: response of the lines to each row block and cosine, under ``code`` (T,).

    ``rows`` is the number of fine rows of the scene, ``substeps`` that of a line, ``pixels`` that of a line,
    and ``finer`` the number of finest row blocks per pixel.
    """

    def __init__(
        self, code: Floats, *, rows: int, substeps: int, lines: int, pixels: int, finer: int
    ) -> None:
        self.lines, self.pixels, self.finer = lines, pixels, finer
        k = np.arange(FAST)[:, None]
        cosines = np.sqrt(2) * np.cos(np.pi * k * (np.arange(len(code)) + 0.5) / len(code))
        cosines[0] = 1
        lit = (cosines * code).T
        # This is the light in each window of S sub-steps, summed over time.
        running = np.concatenate([np.zeros((1, FAST)), np.cumsum(lit, axis=0)])
        windows = running[substeps:] - running[:-substeps]
        running = np.concatenate([np.zeros((1, FAST)), np.cumsum(windows, axis=0)])
        # Summed twice, the light of any range of rows is a difference of two elements.
        first = (np.arange(lines) * substeps)[:, None]
        self.tiers: list[tuple[slice, NDArray[np.float32]]] = []
        tiers = ((0, FINE, pixels * finer), (FINE, SLOW, pixels), (SLOW, FAST, min(pixels, FAST_ROWS)))
        for begin, end, blocks in tiers:
            # Row r is exposed r sub-steps after the first.
            edges = np.linspace(0, rows, blocks + 1).round().astype(np.int64)
            sums = np.diff(running[:, begin:end][first + edges], axis=1)
            # float32 is enough: the products with these take most of the time, and the noise is far above its
            # rounding.
            self.tiers.append((slice(begin, end), sums.astype(np.float32)))
        # A uniform scene at rest is cosine 0 in every block.
        self.flat: Floats = self.tiers[0][1][:, :, 0].sum(1, dtype=np.float64)

    def covariance(self, prior: Prior) -> Floats:
        """G (line, line)."""
        total = np.zeros((self.lines, self.lines), np.float32)
        for cosines, factor in self.tiers:
            near = correlation(factor.shape[1], prior.length).astype(np.float32)
            smoothed = (near @ factor) * prior.spectrum[cosines].astype(np.float32)
            total += smoothed.reshape(self.lines, -1) @ factor.reshape(self.lines, -1).T
        return total.astype(np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Fit of one arm: ``level`` u, ``scale`` (variance), log likelihood in ``blocks`` of lines.

    ``modes`` are the lines minus their level in the covariance's eigenvectors; ``amount`` is the coefficient
    of the other arm's prediction.
    """

    modes: Floats
    level: float
    scale: float
    blocks: Floats
    amount: float = 0.0

    @property
    def evidence(self) -> float:
        """Log likelihood of all lines."""
        return float(self.blocks.sum())


@dataclass(frozen=True, eq=False)
class Model:
    """Lines (line, pixel) of either arm under a response and a prior."""

    response: Response
    prior: Prior
    _vectors: Floats = field(repr=False)
    _values: Floats = field(repr=False)
    _pixel_vectors: Floats = field(repr=False)
    _pixel_values: Floats = field(repr=False)
    _unit: float = 1.0

    @classmethod
    def of(cls, response: Response, prior: Prior, pixels: int) -> Model:
        """Return the model for lines of ``pixels`` pixels, with the eigenvectors of both covariances."""
        covariance = response.covariance(prior)
        # A prior's noise is relative to the light, whose mean variance becomes 1.
        unit = max(float(np.trace(covariance)) / len(covariance), SMALLEST)
        values, vectors = np.linalg.eigh(covariance / unit)
        across = np.linalg.eigh(correlation(pixels, prior.length))
        # Rounding of the float32 products leaves eigenvalues slightly below 0.
        return cls(
            response,
            prior,
            _vectors=vectors,
            _values=np.maximum(values, 0),
            _pixel_vectors=across[1],
            _pixel_values=across[0],
            _unit=unit,
        )

    def with_noise(self, noise: float) -> Model:
        """Return the model with other noise, without decomposing the covariances again."""
        changed = replace(self, prior=replace(self.prior, noise=noise))
        changed.__dict__["_level"] = self._level  # modes do not depend on the noise
        return changed

    @cached_property
    def _variance(self) -> Floats:
        return self._values[:, None] * self._pixel_values + self.prior.noise

    @cached_property
    def _level(self) -> Floats:
        """Modes of the lines of a uniform steady scene."""
        return self.modes(np.broadcast_to(self.response.flat[:, None], (self.response.lines, self.pixels)))

    @property
    def pixels(self) -> int:
        """Voxels of one frame."""
        return len(self._pixel_values)

    def modes(self, lines: Floats) -> Floats:
        """Return lines (line, pixel) in the covariances' eigenvectors, in which samples are independent."""
        return np.asarray(self._vectors.T @ lines @ self._pixel_vectors)

    def fit(self, lines: Floats) -> Fit:
        """The likelihood of ``lines``."""
        return self._explained(self.modes(lines), [self._level])

    def informed(self, fit: Fit, predicted: Floats) -> Fit:
        """The fit of the same lines with a prediction as a regressor, if its coefficient is positive."""
        better = self._explained(fit.modes, [self._level, self.modes(predicted)])
        return better if better.amount > 0 else fit

    def _explained(self, modes: Floats, regressors: list[Floats]) -> Fit:
        amounts, _ = self.regress(modes, regressors)
        rest = modes - sum(amount * each for amount, each in zip(amounts, regressors, strict=True))
        scale = max(float((rest**2 / self._variance).mean()), SMALLEST)
        amount = float(amounts[1]) if len(amounts) > 1 else 0.0
        lines = self.response.lines
        # The log likelihood of a line is its part of the quadratic form, and an equal part of the rest. For
        # it, modes become lines again; across pixels modes do as well, since sums of squares are the same.
        values, pulled = self._vectors @ rest, self._vectors @ (rest / self._variance)
        per_line = (values * pulled).sum(1) / scale
        constant = (np.log(self._variance).sum() + rest.size * np.log(scale)) / lines
        edges = np.linspace(0, lines, max(1, round(lines / EVIDENCE_LINES)) + 1).round().astype(int)
        evidence = np.asarray(-0.5 * np.add.reduceat(per_line + constant, edges[:-1]))
        return Fit(rest, float(amounts[0]), scale, evidence, amount)

    def evidence(self, modes: Floats) -> float:
        """Log likelihood of lines given as modes."""
        # This is `fit` with its single regressor, but without the blocks: the ladder tries this for every
        # noise.
        level, weighted = self._level, self._level / self._variance
        rest = modes - float((weighted * modes).sum() / (weighted * level).sum()) * level
        scale = max(float((rest**2 / self._variance).mean()), SMALLEST)
        return -0.5 * float(rest.size * (1 + np.log(scale)) + np.log(self._variance).sum())

    def regress(self, modes: Floats, regressors: list[Floats]) -> tuple[Floats, Floats]:
        """Least-squares coefficients of ``regressors``, and their covariance for a scale of 1."""
        weighted = [each / self._variance for each in regressors]
        normal = np.array([[float((a * b).sum()) for b in regressors] for a in weighted])
        inverse = np.linalg.inv(normal + SMALLEST * np.eye(len(normal)))
        amounts = inverse @ np.array([float((a * modes).sum()) for a in weighted])
        return amounts.astype(np.float64), inverse.astype(np.float64)

    def scene(self, fit: Fit) -> NDArray[np.float32]:
        """The most likely slow scene (fine row, cosine, pixel), in units of the lines per sub-step."""
        # The mean of the scene given the lines is the prior's covariance times Fᵀ·C⁻¹·lines.
        pulled = self._vectors @ (fit.modes / self._variance) / self._unit
        pulled = ((pulled * self._pixel_values) @ self._pixel_vectors.T).astype(np.float32)
        parts = []
        for cosines, factor in self.response.tiers[:2]:
            near = correlation(factor.shape[1], self.prior.length).astype(np.float32)
            part = np.tensordot(near, np.tensordot(factor, pulled, axes=(0, 0)), axes=1)
            part *= self.prior.spectrum[cosines, None].astype(np.float32)
            parts.append(np.repeat(part, self.response.pixels * self.response.finer // len(part), axis=0))
        # u is steady (cosine 0) and the same in all rows.
        parts[0][:, 0] += np.float32(fit.level)
        return np.concatenate(parts, axis=1)

    def predict(self, scene: NDArray[np.float32]) -> Floats:
        """Lines (line, pixel) of a scene (fine row, cosine, pixel)."""
        total = np.zeros((self.response.lines, scene.shape[2]), np.float32)
        for cosines, factor in self.response.tiers[:2]:
            blocks = factor.shape[1]
            part = scene[:, cosines].reshape(blocks, len(scene) // blocks, -1, scene.shape[2]).mean(1)
            total += factor.reshape(len(factor), -1) @ part.reshape(-1, scene.shape[2])
        return total.astype(np.float64)

    def constant(self, lines: Floats) -> tuple[float, float]:
        """Constant light of every sample that does not follow the code, and its standard error."""
        modes = self.modes(lines)
        amounts, covariance = self.regress(modes, [self._level, self.modes(np.ones_like(lines))])
        rest = modes - amounts[0] * self._level - amounts[1] * self.modes(np.ones_like(lines))
        scale = float((rest**2 / self._variance).mean())
        return float(amounts[1]), float(np.sqrt(scale * covariance[1, 1]))


def best_model(response: Response, arms: list[Floats]) -> Model:
    """The model with the prior of the ladder under which the lines of all ``arms`` are likeliest."""
    best: tuple[float, Model] | None = None
    for step in LADDER:
        model = Model.of(response, step, arms[0].shape[1])
        modes = [model.modes(arm) for arm in arms]
        for noise in NOISES:
            # Noise only adds to the eigenvalues: one decomposition serves all.
            noisy = model.with_noise(noise)
            total = sum(noisy.evidence(each) for each in modes)
            if best is None or total > best[0]:
                best = (total, noisy)
    assert best is not None
    return best[1]
