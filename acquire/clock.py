"""The trigger's clock is the instrument's clock; its relation to UTC is an affine map with an uncertainty."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class ClockFit:
    """UTC of a tick of the trigger's clock: ``utc_ns_at_tick_0 + tick / clock_hz``.

    ``uncertainty_ns`` bounds the error of ``utc_ns_at_tick_0``, not of differences between ticks.
    """

    clock_hz: int
    utc_ns_at_tick_0: int
    uncertainty_ns: int

    def time_ns(self, tick: NDArray[np.uint64]) -> NDArray[np.int64]:
        """UTC in ns since 1970 (int64) of ticks (any shape), rounded down; exact integer arithmetic."""
        seconds, rest = np.divmod(tick.astype(np.int64), self.clock_hz)
        time_ns: NDArray[np.int64] = seconds * NS_PER_S + rest * NS_PER_S // self.clock_hz
        return time_ns + self.utc_ns_at_tick_0

    def to_attrs(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_attrs(cls, attrs: Mapping[str, Any]) -> ClockFit:
        return cls(
            clock_hz=int(attrs["clock_hz"]),
            utc_ns_at_tick_0=int(attrs["utc_ns_at_tick_0"]),
            uncertainty_ns=int(attrs["uncertainty_ns"]),
        )
