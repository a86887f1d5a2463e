"""Run a gateware module in Amaranth's own simulator: no compiler, no yosys, some 15 000 clocks per second."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from amaranth.sim import Simulator

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine


def simulate(module: Any, *testbenches: Callable[[Any], Coroutine[Any, Any, None]]) -> None:
    """The simulation ends when every testbench has returned."""
    simulator = Simulator(module)
    simulator.add_clock(1e-6)
    for testbench in testbenches:
        simulator.add_testbench(testbench)
    simulator.run()


async def pulse(context: Any, signal: Any) -> None:
    """``signal`` high for one clock."""
    context.set(signal, 1)
    await context.tick()
    context.set(signal, 0)
