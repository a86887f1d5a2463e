"""Before a run is armed: can ring, codec and disk of this host sustain the configured rate?

A sufficient result is valid for some minutes: a disk fills, and other programs use it. An insufficient one is
measured again at once, the best of three counts, and it is not kept. If the codec is ``auto`` it is chosen
first, then measured, and used by the run.
"""

from __future__ import annotations

import logging
import os
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from acquire.capacity.load import Load
from acquire.capacity.parts import measure_parts
from acquire.cores import usable_cores
from acquire.daemon.messages import CapacityStatus
from acquire.daemon.storage import choose_for
from acquire.errors import ConfigError, StoreError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.capacity.parts import Parts
    from acquire.config import RigConfig
    from acquire.store import CodecChoice

VALID_S = 600.0
"""How long a measurement of this host is used: other programs come and go."""
TRIES = 3
"""Number of measurements before a rig is refused: a disturbed one gives too little."""
TIGHT = 0.7
"""Share of the sustained rate above which a rig is armed with a warning."""

log = logging.getLogger("acquire.daemon")


class Proof:
    """Compares the needs of one rig's recordings with the host's capacity."""

    def __init__(self, config: RigConfig) -> None:
        self._config = config
        self._directory = config.recording.directory.absolute()
        self._chosen: tuple[float, CodecChoice] | None = None
        self._measured: tuple[float, Parts] | None = None
        self._at: datetime | None = None

    def choose(self, config: RigConfig) -> CodecChoice:
        """Return the measured codec for the rig, kept for some minutes. Raises as `choose_for` does."""
        now_s = time.monotonic()
        if self._chosen is None or now_s - self._chosen[0] > VALID_S:
            self._chosen = now_s, choose_for(config)
            self._measured = None  # it may have been of another codec
        return self._chosen[1]

    def __call__(
        self, *, force: bool = False, progress: Callable[[str], object] = lambda _: None, fresh: bool = False
    ) -> CapacityStatus:
        """Return the sustained rate; ``fresh`` measures it again even if a recent result is valid.

        Raises UsageError if it is below the configured rate, unless forced, and ConfigError for a codec that
        does not give back what it packs.
        """
        if fresh:
            self._chosen = self._measured = None
        try:
            parts = self._parts(progress)
        # Recordings would be lost, however fast.
        except ConfigError:
            raise
        except (UsageError, StoreError) as error:
            log.warning("capacity: it cannot be measured: %s", error)
            rate_hz = self._config.passing_hz
            return CapacityStatus(line_rate_hz=rate_hz, warning=f"not measured: {error}")
        load = parts.load
        tight = parts.line_rate_hz * TIGHT < load.line_rate_hz
        little = "less than" if parts.line_rate_hz < load.line_rate_hz else "hardly more than"
        warning = (
            f"this host sustains {little} is configured: {_sustained(parts)}; configured: {_configured(load)}"
        )
        # Simulated cameras wait for a busy host, but cannot do with too few processors.
        limit_hz = parts.limits["processors"] if self._config.simulates_cameras else parts.line_rate_hz
        if limit_hz < load.line_rate_hz and not force:
            raise UsageError(
                f"arm: {_configured(load)} is more than this host sustains",
                possible=f"{_sustained(parts)}; the best of {TRIES} measurements at a load of {_load()}",
                hint="end other programs, try another codec or directory (acquire bench), or arm --force",
            )
        if tight:
            log.warning("capacity: %s", warning)
        return CapacityStatus(
            line_rate_hz=load.line_rate_hz,
            codec=str(load.codec),
            sustained_hz=round(parts.line_rate_hz),
            limit=parts.limit,
            limits_hz={name: round(rate) for name, rate in parts.limits.items()},
            measured=self._at,
            warning=warning if tight else None,
        )

    def _parts(self, progress: Callable[[str], object]) -> Parts:
        """Return a valid measurement, or make one; see the module for insufficient ones."""
        if self._measured is not None and time.monotonic() - self._measured[0] <= VALID_S:
            return self._measured[1]
        progress("measuring what this host sustains")
        auto = self._config.recording.codec == "auto"
        self._at = datetime.now(UTC)
        load = Load.of(self._config, self.choose(self._config).codec if auto else None)
        best = measure_parts(load, self._directory)
        for attempt in range(2, TRIES + 1):
            if best.line_rate_hz >= load.line_rate_hz:
                break
            progress(f"measuring what this host sustains, {attempt} of {TRIES} (load {_load()})")
            best = max(best, measure_parts(load, self._directory), key=lambda parts: parts.line_rate_hz)
        if best.line_rate_hz >= load.line_rate_hz:
            self._measured = time.monotonic(), best
        else:
            # Nor is the codec kept, which was chosen under the same disturbance.
            self._chosen = self._measured = None
        return best


def _load() -> str:
    """Return the load of the processors by the kernel's average of a minute."""
    return f"{os.getloadavg()[0]:.1f} on {usable_cores()} processors"


def _configured(load: Load) -> str:
    mb_s = load.bytes_per_s / 1e6
    return f"2 x {load.pixels} px x {load.line_rate_hz:.6g} lines/s = {mb_s:.4g} MB/s, codec {load.codec}"


def _sustained(parts: Parts) -> str:
    limits = ", ".join(f"{name} {_three_digits(rate)}" for name, rate in parts.limits.items())
    rate = _three_digits(parts.line_rate_hz)
    return f"{rate} lines/s, limited by {parts.limit} (lines/s: {limits})"


def _three_digits(rate: float) -> str:
    """Return a rate with three digits that count, and without an exponent."""
    return f"{float(f'{rate:.3g}'):.12g}"
