"""Lines of both arms under a known light, read from a recording block by block, and their moments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.calibrate.calibration import Instrument
from acquire.codes import ConstantCode, code_from_attrs
from acquire.errors import UsageError
from acquire.lines import ARMS
from acquire.store import open_recording

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from acquire.lines import Segment
    from acquire.store import Recording

    Progress = Callable[[int, int], object]
    """Called with the number of lines done, and of all lines."""

BLOCK_LINES = 1024
FEWEST_LINES = 16
SETTINGS = (
    "PixelFormat",
    "Gain",
    "AnalogGain",
    "DigitalGain",
    "BlackLevel",
    "Gamma",
    "PRNUMode",
    "OperationMode",
    "TDIStages",
    "ScanDirection",
    "ReverseX",
    "OffsetX",
    "BinningHorizontal",
    "BinningVertical",
    "white_dn",
    "black_level_dn",
    "responsivity_dn",
)
"""Settings, as read back from a camera, that the numbers of a calibration depend on."""


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """``lines`` lines of a recording from ``first_line`` on."""

    recording: Recording
    first_line: int
    lines: int

    @property
    def instrument(self) -> Instrument:
        return instrument_of(self.recording)

    @property
    def code_value(self) -> int | None:
        """0 or 1 if the light's code is constant, else None."""
        code = code_from_attrs(self.recording.attrs["code"])
        return code.value if isinstance(code, ConstantCode) else None

    @property
    def light(self) -> str:
        """What the light did, in words."""
        return {0: "was off (code 0)", 1: "was steady (code 1)", None: "blinked with a code"}[self.code_value]

    def camera(self, key: str) -> NDArray[np.float64]:
        """Return a number of each camera: (arm,)."""
        return np.array([float(self.recording.attrs["cameras"][arm][key]) for arm in ARMS])

    def blocks(self) -> Iterator[Segment]:
        """Yield all lines in blocks that fit into memory."""
        for first in range(0, self.lines, BLOCK_LINES):
            count = min(BLOCK_LINES, self.lines - first)
            yield self.recording.cut(self.first_line + first, count)

    def samples(self) -> Iterator[tuple[NDArray[Any], NDArray[np.bool_]]]:
        """Yield the samples (arm, line, column) of all columns, lit or not, and which are usable."""
        # behind a fibre a cut segment has one tile's columns; the steps measure all
        if self.recording.fibre is None:
            yield from ((block.lines, block.mask) for block in self.blocks())
            return
        for first in range(0, self.lines, BLOCK_LINES):
            count = min(BLOCK_LINES, self.lines - first)
            yield self.recording.whole_lines(self.first_line + first, count)

    @property
    def lit(self) -> NDArray[np.bool_]:
        """Columns (arm, column) that see the scene: behind a fibre those within a band."""
        fibre = self.recording.fibre
        if fibre is None:
            return np.ones((len(ARMS), self.recording.arms[ARMS[0]].pixels), np.bool_)
        return np.stack([fibre.table(arm)[:, 0] >= 0 for arm in ARMS])

    def whole(self) -> Segment:
        """Return all lines at once."""
        return self.recording.cut(self.first_line, self.lines)

    def facts(self) -> dict[str, Any]:
        """Return the origin of the lines, as JSON."""
        cameras = self.recording.attrs["cameras"]
        warm = {arm: cameras[arm]["DeviceTemperature"] for arm in ARMS if "DeviceTemperature" in cameras[arm]}
        return {
            "recording": str(self.recording),
            "run_id": self.recording.attrs["run_id"],
            "first_line": self.first_line,
            "lines": self.lines,
            **({"temperature_c": warm} if warm else {}),
        }


def open_exposure(place: Path | str, first_line: int | None = None, lines: int | None = None) -> Exposure:
    """Open all lines of a recording, or those requested.

    Raises UsageError for too few lines, and what `open_recording` raises.
    """
    recording = open_recording(place)
    first = recording.first_available_line if first_line is None else first_line
    end = recording.first_line + recording.lines
    # Of a recording without lines, the number of lines below says enough.
    if recording.lines and not recording.first_line <= first < end:
        raise UsageError(
            f"{recording} has no line {first}", possible=f"lines {recording.first_line} to {end - 1}"
        )
    count = end - first if lines is None else lines
    if count < FEWEST_LINES:
        raise UsageError(
            f"{recording} with {count} lines is too short to calibrate from",
            possible=f"{FEWEST_LINES} lines or more",
        )
    return Exposure(recording, first, count)


def camera_of(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return what lines depend on of what a camera reports: `SETTINGS`, and ``serial`` if it states one."""
    serial = facts.get("identity", {}).get("serial") or facts.get("DeviceSerialNumber")
    known = {"serial": serial} if serial else {}
    return known | {key: facts[key] for key in SETTINGS if key in facts}


def instrument_of(recording: Recording) -> Instrument:
    """Return the instrument that made a recording, as far as the recording describes it."""
    attrs = recording.attrs
    cameras = {}
    for arm in ARMS:
        configured = attrs.get("config", {}).get("cameras", {}).get(arm, {})
        cameras[arm] = {"serial": configured.get("serial", "unknown"), **camera_of(attrs["cameras"][arm])}
    geometry = recording.geometry_for(1)
    return Instrument(
        stages=geometry.stages,
        substeps=geometry.substeps,
        substep_s=recording.line_period_ns * 1e-9 / geometry.substeps,
        layout=str(attrs["layout"]),
        cameras=cameras,
        pixels=None if recording.fibre is None else recording.fibre.sensor_pixels,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Statistics of samples over lines; all arrays are (arm, column).

    Attributes
    ----------
    lines : number of lines used of each arm
    mean : in DN
    variance : temporal, within blocks of `BLOCK_LINES` lines
    own_variance : the same without the common part of all columns of a line, as from flickering light
    drift : largest difference of a block's mean from the mean, in standard errors of a block's mean
    at_zero, saturated : share of the samples
    """

    lines: NDArray[np.int64]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    own_variance: NDArray[np.float64]
    drift: NDArray[np.float64]
    at_zero: NDArray[np.float64]
    saturated: NDArray[np.float64]


def no_progress(done: int, total: int) -> None:
    """Ignore the progress."""


def moments(exposure: Exposure, progress: Progress = no_progress) -> Moments:
    """Compute the statistics of an exposure. Raises UsageError if an arm has no usable line."""
    # samples are whole numbers
    white = np.ceil(exposure.camera("white_dn"))[:, None, None]
    parts: list[tuple[NDArray[Any], ...]] = []
    done = 0
    for samples, usable in exposure.samples():
        parts.append(_block_moments(samples, usable, white))
        done += samples.shape[1]
        progress(done, exposure.lines)
    counts, means, variances, own, zeros, saturated = (np.stack(each) for each in zip(*parts, strict=True))
    # lost lines are left out, so that the arms may differ
    total = counts.sum(axis=0)
    if not total.all():
        raise UsageError(f"{exposure.recording}: an arm has no line that arrived", hint="other lines")

    def pooled(values: NDArray[Any], weights: NDArray[Any]) -> NDArray[np.float64]:
        weights = weights[:, :, None].astype(np.float64)
        average: NDArray[np.float64] = (values * weights).sum(axis=0) / weights.sum(axis=0).clip(1)
        return average

    # Every block has a mean of its own, so drift does not count as noise; that costs it a degree of freedom.
    mean, variance = pooled(means, counts), pooled(variances, (counts - 1).clip(0))
    errors = np.sqrt(variance / counts.clip(1)[:, :, None]).clip(1e-9)
    # a block of which no line arrived has no mean that could differ
    apart = np.where(counts[:, :, None] > 0, np.abs(means - mean) / errors, 0.0)
    return Moments(
        lines=total,
        mean=mean,
        variance=variance,
        own_variance=pooled(own, (counts - 1).clip(0)),
        drift=apart.max(axis=0) if len(parts) > 1 else np.zeros_like(mean),
        at_zero=pooled(zeros, counts),
        saturated=pooled(saturated, counts),
    )


def _block_moments(
    samples: NDArray[Any], usable: NDArray[np.bool_], white: NDArray[Any]
) -> tuple[NDArray[Any], ...]:
    lines = samples.astype(np.float64)
    # Saturated samples are not usable, but show that their line has arrived.
    arrived = np.asarray((usable | (lines >= white)).any(axis=2))
    counts = arrived.sum(axis=1)
    shape = (len(ARMS), lines.shape[2])
    found = [np.zeros(shape) for _ in range(5)]
    mean, variance, own, zeros, saturated = found
    for arm, here in enumerate(arrived):
        samples = lines[arm, here]
        if not len(samples):
            continue
        mean[arm] = samples.mean(axis=0)
        zeros[arm], saturated[arm] = (samples == 0).mean(axis=0), (samples >= white[arm]).mean(axis=0)
        # a single line has no variance, and no weight in that of all
        if len(samples) > 1:
            variance[arm] = samples.var(axis=0, ddof=1)
            own[arm] = _own_variance(samples, mean[arm])
    return counts, *found


def _own_variance(samples: NDArray[np.float64], mean: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the temporal variance of columns without the factor that all columns of a line share.

    The factor of a line is the mean of its samples relative to those of all lines. Removing it also removes
    the share g_j/Σg of a column's own noise, for which the result is corrected.
    """
    share = mean / mean.sum() if mean.sum() > 0 else np.full(len(mean), 1 / len(mean))
    change = samples - mean
    own_change = change - change.sum(axis=1, keepdims=True) * share
    raw = (own_change**2).sum(axis=0) / (len(samples) - 1)
    # Var(own_change_j) = v_j·(1 − 2·s_j) + s_j²·Σv, with Σv = Σ raw / (1 − Σs²) to first order
    total = raw.sum() / max(1 - float((share**2).sum()), 0.5)
    own: NDArray[np.float64] = (raw - share**2 * total) / np.maximum(1 - 2 * share, 0.1)
    return own
