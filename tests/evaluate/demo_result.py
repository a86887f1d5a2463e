"""A small run with made-up but consistent facts: two areas that swing, one constant, two solvers."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from acquire.evaluate.host import Busyness
from acquire.evaluate.report import (
    ArmAccount,
    CaptureFacts,
    DemoResult,
    Region,
    RigFacts,
    TimedStep,
    evaluate_solver,
)
from acquire.geometry import Geometry
from acquire.lines import Segment

SUBSTEP_NS = 10_000
START_NS = 1_780_000_000_123_456_789
FIRST_LINE = 1733


def make_segment(rng: np.random.Generator) -> Segment:
    geometry = Geometry(8, 3, 51)
    line_time = START_NS + 52_000_000 + np.arange(geometry.lines) * 3 * SUBSTEP_NS
    mask = np.ones(geometry.lines_shape, bool)
    mask[1, 20:22] = False
    return Segment(
        lines=rng.integers(100, 900, geometry.lines_shape).astype(np.uint16),
        mask=mask,
        code=rng.integers(0, 2, geometry.span).astype(np.uint8),
        geometry=geometry,
        time_ns=line_time,
        first_line=FIRST_LINE,
        substep_ns=SUBSTEP_NS,
    )


def make_regions(frames: int, size: int) -> tuple[Region, ...]:
    seconds = np.arange(frames) * SUBSTEP_NS * 1e-9
    curves = {
        "fast": (5000.0, 0.5 + 0.4 * np.sin(2 * np.pi * 5000 * seconds)),
        "slow": (2500.0, 0.5 + 0.3 * np.sin(2 * np.pi * 2500 * seconds + 1)),
        "steady": (None, np.full(frames, 0.7)),
    }
    regions = []
    for i, (name, (set_hz, theory)) in enumerate(curves.items()):
        mask = np.zeros((size, size), bool)
        mask[2:10, 2 + 7 * i : 7 + 7 * i] = True
        regions.append(Region(name, mask, theory, set_hz))
    return tuple(regions)


def make_result() -> DemoResult:
    rng = np.random.default_rng(5)
    segment = make_segment(rng)
    trusted = segment.geometry.trusted
    frames, size = trusted.stop - trusted.start, segment.geometry.size
    regions = make_regions(frames, size)
    truth = sum(region.theory[:, None, None] * region.mask for region in regions).astype(np.float32)
    damped = truth.mean(axis=0) + 0.8 * (truth - truth.mean(axis=0))
    noise = rng.normal(0, 1, truth.shape).astype(np.float32)
    solvers = [
        ("ADMM (default)", truth + 0.011 * noise, 7.62, 118, 118),
        ("TwIST", damped + 0.13 * noise, 31.44, 207, 451),
    ]
    return DemoResult(
        title="Scene #1: <four> LEDs",
        when=datetime(2025, 6, 7, 8, 9, 10, tzinfo=UTC),
        command="acquire demo --seed 4711",
        seed=4711,
        rig=RigFacts("demo", "PRBS of degree 64", "LEDs behind masks", simulated=True),
        capture=CaptureFacts(
            recording=Path("demo & more") / "leds.zarr",
            condition="INCOMPLETE",
            end_reason="all lines",
            seconds=0.617,
            size_bytes=5_312_204,
            arms={
                "a": ArmAccount(20_075, 65, 7, 20_003, 0, 9, 64),
                "b": ArmAccount(20_077, 65, 11, 20_003, 16, 11, 64, {"camera": 2, "ring_full": 14}),
            },
        ),
        segment=segment,
        start_ns=START_NS,
        frame_time_ns=segment.time_ns[0] + np.arange(frames) * SUBSTEP_NS,
        truth=truth,
        solvers=tuple(
            evaluate_solver(
                label,
                video,
                truth,
                regions,
                SUBSTEP_NS * 1e-9,
                seconds=seconds,
                iterations=iterations,
                requested_iterations=asked,
                budget_s=31.5,
            )
            for label, video, seconds, iterations, asked in solvers
        ),
        regions=regions,
        stages=(
            TimedStep("Start the daemon", 1.314),
            TimedStep("Record", 0.923, "20 003 lines"),
            TimedStep("Evaluate", 41),
        ),
        host=Busyness(cores=2, load=3.14, share=0.63, least_share=0.41),
    )
