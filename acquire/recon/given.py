"""What a solver is given, in one object that its parts hand on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from acquire.lines import Segment
    from acquire.recon.clock import IterationClock
    from acquire.recon.options import SolveOptions
    from acquire.recon.problem import Problem


@dataclass(frozen=True, slots=True, eq=False)
class Given:
    """The arguments of `Solver.solve`: lines, the problem that they pose, how to solve it, and the time.

    Whoever solves something slightly different, as with other weights or in another band, hands on a copy
    with another problem or other options (`dataclasses.replace`). All copies share one clock.
    """

    segment: Segment
    problem: Problem
    options: SolveOptions
    clock: IterationClock

    @property
    def merges(self) -> tuple[int, int]:
        """N_m and T_m."""
        return self.options.spatial_merge, self.options.temporal_merge

    @property
    def video_shape(self) -> tuple[int, int, int]:
        """(⌈T/T_m⌉, ⌈n/N_m⌉, ⌈n/N_m⌉)."""
        return self.segment.geometry.video_shape(*self.merges)

    @property
    def noise(self) -> float:
        """`Problem.noise`: relative to the samples, infinite without light, NaN if it is unknown."""
        return self.problem.noise(self.segment)
