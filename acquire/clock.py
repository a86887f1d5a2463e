"""The trigger's clock, which is the instrument's clock: an affine map to UTC with an uncertainty."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class ClockFit:
    """Relation of the trigger's ticks to UTC: ``utc_ns_at_tick_0 + tick / clock_hz``.

    ``uncertainty_ns`` bounds the error of ``utc_ns_at_tick_0``, not of differences between ticks.
    """

    clock_hz: int
    utc_ns_at_tick_0: int
    uncertainty_ns: int

    def time_ns(self, tick: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Return UTC in ns since 1970 (int64) of ticks (any shape), rounded down, in integer arithmetic."""
        time_ns: NDArray[np.int64] = self._utc_ns(tick.astype("int64"))
        return time_ns

    def instant_ns(self, tick: int) -> int:
        """Return UTC in ns of one tick, however large."""
        return int(self._utc_ns(tick))

    def _utc_ns(self, tick: Any) -> Any:
        # Whole seconds apart: tick · 10⁹ would exceed 64 bits after 102 s at 90 MHz.
        seconds, rest = divmod(tick, self.clock_hz)
        return seconds * NS_PER_S + rest * NS_PER_S // self.clock_hz + self.utc_ns_at_tick_0

    def to_attrs(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_attrs(cls, attrs: Mapping[str, Any]) -> ClockFit:
        return cls(
            clock_hz=int(attrs["clock_hz"]),
            utc_ns_at_tick_0=int(attrs["utc_ns_at_tick_0"]),
            uncertainty_ns=int(attrs["uncertainty_ns"]),
        )
