"""Latency of a simulated camera's blocks until they are in the ring, as a histogram."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from acquire.processes.shared import WORD_BYTES, SharedBytes
from acquire.sim.devices import SimulatedCamera

if TYPE_CHECKING:
    from acquire.camera.base import Camera, CameraBlock, CameraOpener


class Latencies:
    """A histogram in shared memory with bins of 10 µs up to 0.2 s: one process adds, any number read."""

    STEP_NS, BINS = 10_000, 20_000

    def __init__(self, memory: SharedBytes | None = None) -> None:
        self._memory = memory or SharedBytes("latencies", (self.BINS + 1) * WORD_BYTES)
        self._words = self._memory.words(0, self.BINS + 1)

    def add(self, latency_ns: int) -> None:
        self._words[min(max(latency_ns, 0) // self.STEP_NS, self.BINS - 1)] += 1
        # The maximum has a word of its own, as it may lie far beyond the last bin.
        self._words[self.BINS] = max(self._words[self.BINS], latency_ns)

    def clear(self) -> None:
        self._words[:] = memoryview(bytes((self.BINS + 1) * WORD_BYTES)).cast("q")

    def percentiles_ms(self) -> dict[str, float]:
        """Return percentiles as upper edges of their bins, at most the maximum; 0 if nothing was added."""
        cumulative = np.cumsum(np.array(self._words[: self.BINS]))
        longest_ns = int(self._words[self.BINS])
        percentiles = {"max": longest_ns / 1e6}
        for name, part in (("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999)):
            step = int(np.searchsorted(cumulative, part * cumulative[-1]))
            is_last = step >= self.BINS - 1  # the last bin also holds everything longer
            percentiles[name] = (longest_ns if is_last else min((step + 1) * self.STEP_NS, longest_ns)) / 1e6
        return percentiles

    def close(self) -> None:
        """Release the memory. Idempotent."""
        # First: memory of which a view is left cannot be unmapped (BufferError).
        self._words.release()
        self._memory.close()

    def __reduce__(self) -> tuple[Any, ...]:
        # It is pickled with its opener for the grabber's process, which maps the same memory.
        return Latencies, (self._memory,)


@dataclass(frozen=True, slots=True)
class TimedOpener:
    """Opens a camera that records the latency of its blocks until they are in the ring."""

    opener: CameraOpener
    latencies: Latencies

    def __call__(self) -> Camera:
        return TimedCamera(self.opener(), self.latencies)


class TimedCamera:
    """A simulated camera that is timed; see `TimedOpener`."""

    def __init__(self, camera: Camera, latencies: Latencies) -> None:
        # Only a simulated camera knows when its lines were triggered.
        assert isinstance(camera, SimulatedCamera)
        self._camera, self._latencies = camera, latencies

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)

    def release(self, block: CameraBlock) -> None:
        # The grabber releases a block once it is in the ring.
        last = block.first_line + len(block.flags) - 1
        self._latencies.add(time.monotonic_ns() - int(self._camera.times_ns(last, 1)[0]))
        self._camera.release(block)
