"""Run the whole capture path under a given load: real processes, ring, recorder and disk, with stored lines.

::

    pattern ─▶ camera in its grabber's process ─▶ ring ─┐
    pattern ─▶ camera in its grabber's process ─▶ ring ─┼─▶ recorder ─▶ recording, removed afterwards
    simulated trigger, here ─▶ tags ────────────────────┘

No lines are computed while it runs, so that only capture and recording are measured.
"""

from __future__ import annotations

import os
import shutil
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from acquire.capacity.latency import Latencies, TimedOpener
from acquire.capacity.load import CLOCK_HZ, recording_spec, scratch_path, tag_every_lines, trigger_run
from acquire.config import GeometryConfig
from acquire.config.device import CameraConfig, TriggerConfig
from acquire.errors import DataError
from acquire.lines import ARMS
from acquire.sim.clock import Wire
from acquire.sim.pattern import PatternCameraOpener
from acquire.sim.trigger_model import TriggerModel
from acquire.sim.twin_links import TwinTransport
from acquire.store import RunCondition
from acquire.stream import Begin, Capture, CapturePlan
from acquire.trigger.driver import TriggerDriver

if TYPE_CHECKING:
    from acquire.camera.base import CameraOpener
    from acquire.capacity.load import Load
    from acquire.stream import CaptureStatus

_PIXEL_FORMAT: dict[str, Literal["Mono8", "Mono12"]] = {"uint8": "Mono8", "uint16": "Mono12"}
_POLL_S = 0.05
_GRACE_S = 30.0
"""Time after its scheduled end in which the load's recording has to end."""


@dataclass(frozen=True, slots=True)
class LoadReport:
    """Result of a load. Latency is the time from the trigger of a block's last line to its ring commit.

    Attributes
    ----------
    lines, lost, unaccounted : lines of both arms that were recorded, lost for any cause, and neither
    seconds : duration of the recording, until the last line is on its way to the disk
    ring_peak : peak fill of the fuller ring, as a fraction
    cores : process → processor seconds per second: recorder, a, b, owner (with the simulated trigger)
    latency_ms : p50, p99, p99.9, max of the slower grabber
    bytes_written : size of the encoded chunks
    condition : condition of the recording
    """

    load: Load
    lines: int
    lost: int
    unaccounted: int
    seconds: float
    ring_peak: float
    cores: dict[str, float]
    latency_ms: dict[str, float]
    bytes_written: int
    condition: RunCondition

    @property
    def clean(self) -> bool:
        """True if no line was lost."""
        return not (self.lost or self.unaccounted) and self.condition is RunCondition.GOOD

    @property
    def cpu_s_per_gb(self) -> float:
        """Processor seconds of grabbers and recorder per GB of pixels."""
        cores = sum(value for name, value in self.cores.items() if name != "owner")
        return cores / (self.load.bytes_per_s / 1e9)


def run_load(load: Load, directory: Path, seconds: float) -> LoadReport:
    """Record for ``seconds`` below ``directory``; the recording is removed afterwards."""
    path = scratch_path(directory, "load")
    wire = Wire()
    latencies = {arm: Latencies() for arm in ARMS}
    config = TriggerConfig(tag_every_lines=tag_every_lines(load))
    model = TriggerModel(wire, CLOCK_HZ, load.speed)
    trigger = TriggerDriver(partial(TwinTransport, model), config)
    try:
        plan = capture_plan(load, wire)
        timed: dict[str, CameraOpener] = {
            arm: TimedOpener(opener, latencies[arm]) for arm, opener in plan.openers.items()
        }
        capture = Capture(replace(plan, openers=timed), trigger)
        try:
            capture.arm()
            return _measure(load, capture, path, seconds, latencies)
        finally:
            capture.close()
    finally:
        # Before the wire, to which the end of the pulses is written.
        trigger.close()
        wire.close()
        for histogram in latencies.values():
            histogram.close()
        shutil.rmtree(path, ignore_errors=True)


def _measure(
    load: Load, capture: Capture, path: Path, seconds: float, latencies: dict[str, Latencies]
) -> LoadReport:
    pids = {name: pid for name, pid in capture.pids.items() if pid} | {"owner": None}
    capture.start(
        Begin(path, recording_spec(load, capture.clock), max(1, round(load.line_rate_hz * seconds)))
    )
    # While arming, lines wait for processes that are only starting, which is no part of the load.
    for histogram in latencies.values():
        histogram.clear()
    before, begun = _cpu_s(pids), time.monotonic()
    while not (status := capture.poll()).draining and not status.done:
        _check(status, begun + seconds)
        time.sleep(_POLL_S)
    # Until here lines came: the time of sealing is no part of the load.
    elapsed_s = time.monotonic() - begun
    cores = {name: (used - before[name]) / elapsed_s for name, used in _cpu_s(pids).items()}
    while not (status := capture.poll()).done:
        _check(status, begun + seconds)
        time.sleep(_POLL_S)
    worst = max((each.percentiles_ms() for each in latencies.values()), key=lambda found: found["p99.9"])
    # The ledger balances only once no line is on its way any more.
    capture.close()
    status = capture.poll()
    assert status.condition is not None
    return LoadReport(
        load=load,
        lines=sum(arm["recorded"] - arm["missing"] for arm in status.lines.values()),
        lost=sum(sum(arm["lost"].values()) for arm in status.lines.values()),
        unaccounted=sum(_unaccounted(arm) for arm in status.lines.values()),
        seconds=elapsed_s,
        ring_peak=max(ring["peak"] / ring["slots"] for ring in status.ring.values()),
        cores=cores,
        latency_ms=worst,
        bytes_written=status.ledger.get("store", {}).get("bytes_written", 0),
        condition=status.condition,
    )


def _check(status: CaptureStatus, ends_s: float) -> None:
    """Raise DataError if the capture has a fault or the recording does not end in time."""
    if status.fault is not None:
        raise DataError(
            f"the load could not be sustained: {status.fault}",
            hint="a lower line rate, or fewer other programs on this host",
        )
    if time.monotonic() > ends_s + _GRACE_S:
        raise DataError(
            f"the load's recording did not end within {_GRACE_S:g} s of its scheduled end",
            hint="a disk that keeps up with the lines (--out), or a lower line rate",
        )


def _unaccounted(arm: dict[str, Any]) -> int:
    """Return the number of delivered lines for which the ledger does not account."""
    known = arm["preroll"] + arm["lost"]["ring_full"] + arm["discarded"] + arm["recorded"] - arm["missing"]
    return abs(int(arm["delivered"] - known))


def capture_plan(load: Load, wire: Wire) -> CapturePlan:
    """Return the plan of a run whose cameras read out patterns at the pulses of ``wire``.

    The white level is that of the pixel format.
    """
    geometry = GeometryConfig(stages=load.stages, substeps=load.substeps)
    camera = CameraConfig(pixel_format=_PIXEL_FORMAT[load.dtype])
    openers: dict[str, CameraOpener] = {
        arm: PatternCameraOpener(
            wire=wire,
            arm=arm,
            geometry=geometry,
            config=camera,
            block_lines=load.block_lines,
            line_rate_hz=load.line_rate_hz,
            pixels=load.pixels,
        )
        for arm in ARMS
    }
    return CapturePlan(
        run=trigger_run(load),
        stages=load.stages,
        pixels=load.pixels,
        dtype=load.dtype,
        block_lines=load.block_lines,
        ring_slots=load.ring_slots,
        white_dn=camera.white_dn,
        openers=openers,
        line_period_ns=1e9 / load.line_rate_hz,
        # Allowed although the cameras are simulated: these only copy stored lines, as a driver would.
        realtime=True,
    )


def _cpu_s(pids: dict[str, int | None]) -> dict[str, float]:
    """Return the processor seconds of processes (None: this one), including threads that have ended.

    Raises DataError if a process has ended, which does not happen if the load is sustained.
    """
    used_s = {}
    for name, pid in pids.items():
        try:
            # The kernel's clock id for another process's time, as computed by clock_getcpuclockid(3).
            used_s[name] = time.clock_gettime((~(pid or os.getpid()) << 3) | 2)
        except OSError as error:
            raise DataError(
                f"the load could not be sustained: process {name} ended",
                hint="fewer other programs on this host, or more memory; the kernel's log tells what "
                "it ended",
            ) from error
    return used_s
