"""Cases for the operators: geometries small enough for their dense matrix, and codes by seed."""

from __future__ import annotations

from hypothesis import strategies as st

from acquire.geometry import Geometry
from acquire.lines import Segment
from acquire.recon.clock import IterationClock
from acquire.recon.given import Given
from acquire.recon.options import SolveOptions
from acquire.recon.problem import Problem


@st.composite
def cases(draw: st.DrawFn) -> tuple[Geometry, int, int, int, int]:
    """Geometry, N_m, T_m, frequencies kept, seed."""
    g = Geometry(draw(st.integers(1, 5)), draw(st.integers(1, 3)), draw(st.integers(1, 6)))
    N_m, T_m = draw(st.integers(1, g.size)), draw(st.integers(1, g.span + 1))
    frames = g.video_shape(N_m, T_m)[0]
    return g, N_m, T_m, draw(st.integers(1, frames)), draw(st.integers(0, 2**32 - 1))


class Wall:
    """A wall clock that only the test advances."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now

    def process_time(self) -> float:
        return self.now


def given_for(
    segment: Segment,
    problem: Problem,
    merges: tuple[int, int],
    iterations: int = 150,
    clock: IterationClock | None = None,
    **options: float,
) -> Given:
    """What a solver is given, of a posed problem."""
    asked = SolveOptions(*merges, solver="admm", iterations=iterations, **options)
    return Given(segment, problem, asked, clock or IterationClock(iterations))
