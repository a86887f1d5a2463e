"""A host's capacity is measured with the real capture path, and the measurement leaves nothing behind."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from acquire.capacity import search
from acquire.capacity.latency import Latencies
from acquire.capacity.load import Load
from acquire.capacity.parts import Pace, Parts, measure_parts
from acquire.capacity.run import LoadReport, run_load
from acquire.capacity.search import best, search_rate
from acquire.config import load_rig
from acquire.errors import DataError, UsageError
from acquire.store import RunCondition

SMALL = Load(16, "uint8", 20_000.0, stages=16, block_lines=128, ring_slots=256, chunk_lines=512)


@pytest.mark.parametrize("codec", ["none", "lz4"])
def test_a_load_is_run_and_every_line_is_accounted_for(tmp_path: Path, codec: str) -> None:
    report = run_load(replace(SMALL, codec=codec), tmp_path, 0.5)
    assert report.clean
    assert report.lines == 2 * 10_000
    assert set(report.cores) == {"recorder", "a", "b", "owner"}
    late = report.latency_ms
    assert 0 < late["p50"] <= late["p99"] <= late["p99.9"]
    assert late["max"] > 0
    assert not any(tmp_path.iterdir())


def test_parts_are_measured_where_it_is_recorded(tmp_path: Path) -> None:
    parts = measure_parts(SMALL, tmp_path)
    assert parts.line_rate_hz == parts.limits[parts.limit] == min(parts.limits.values()) > 0
    assert parts.limits["recorder"] < parts.limits["ring"]
    assert not any(tmp_path.iterdir())
    with pytest.raises(UsageError, match="does not exist"):
        measure_parts(SMALL, tmp_path / "absent")


def test_the_remains_of_a_killed_measurement_are_removed(tmp_path: Path) -> None:
    dead = 4194305  # above the largest process number
    for kind in ("capacity", "load"):
        (tmp_path / f".{kind}-{dead}.zarr" / "a").mkdir(parents=True)
        (tmp_path / f".{kind}-1.zarr").mkdir()
    measure_parts(SMALL, tmp_path)
    run_load(SMALL, tmp_path, 0.1)
    assert {path.name for path in tmp_path.iterdir()} == {".capacity-1.zarr", ".load-1.zarr"}


def test_the_remains_of_a_killed_daemon_with_this_process_number_are_removed(tmp_path: Path) -> None:
    """In a container the daemon has the same number after every start."""
    for kind in ("capacity", "load"):
        (tmp_path / f".{kind}-{os.getpid()}.zarr" / "a").mkdir(parents=True)
    measure_parts(SMALL, tmp_path)
    run_load(SMALL, tmp_path, 0.1)
    assert not any(tmp_path.iterdir())


def test_processors_are_shared_by_all_parts() -> None:
    pace = Pace(lines_per_s=1000.0, cpu_s_per_line=0.002)
    parts = Parts(SMALL, ring=pace, codec=pace, recorder=pace, cores=2)
    assert parts.limits["processors"] == pytest.approx(500.0)
    assert parts.limit == "processors"


def test_a_load_is_derived_from_a_rig() -> None:
    rig = load_rig("rig-demo", {"simulation.speed": 2.0})
    load = Load.of(rig)
    assert (load.pixels, load.dtype, load.codec) == (64, "uint16", "lz4")
    assert load.line_rate_hz == pytest.approx(66_667, rel=1e-4)
    assert load.bytes_per_s == pytest.approx(2 * 64 * 2 * load.line_rate_hz)


@pytest.mark.parametrize("rate_hz", [7.0, 1e3, 33_333.3, 1e5, 6e5, 1e6, 3e6])
def test_any_rate_is_a_whole_number_of_ticks_and_a_speed(rate_hz: float) -> None:
    load = replace(SMALL, line_rate_hz=rate_hz)
    real_hz = 90_000_000 / (load.substep_ticks * load.substeps) * load.speed
    assert real_hz == pytest.approx(rate_hz, rel=2e-4)


def test_the_search_ends_near_the_rate_that_is_possible(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def limited(load: Load, directory: Path, seconds: float) -> LoadReport:
        assert (directory, seconds) == (tmp_path, 0.1)
        if load.line_rate_hz > 50_000:
            raise DataError("too fast")
        return LoadReport(load, 10, 0, 0, 0.1, 0.1, {}, {}, 0, RunCondition.GOOD)

    monkeypatch.setattr(search, "run_load", limited)
    told: list[float] = []
    trials = search_rate(SMALL, tmp_path, 300_000.0, 0.1, lambda trial: told.append(trial.line_rate_hz))
    found = best(trials)
    assert found is not None
    assert 50_000 / search.NEAR <= found.line_rate_hz <= 50_000
    assert told == [trial.line_rate_hz for trial in trials]
    assert len(trials) <= search.MOST_RUNS
    assert best([trial for trial in trials if not trial.held]) is None


def test_percentiles_of_latencies() -> None:
    latencies = Latencies()
    try:
        assert not any(latencies.percentiles_ms().values())
        latencies.add(4_000)
        assert set(latencies.percentiles_ms().values()) == {0.004}  # none later than the latest
        latencies.clear()
        for latency_us in range(1, 1001):
            latencies.add(latency_us * 1000)
        latencies.add(10**9)
        found = latencies.percentiles_ms()
        assert found["p50"] == pytest.approx(0.5, abs=0.02)
        assert found["p99"] == pytest.approx(0.99, abs=0.02)
        assert found["max"] == 1000.0
        latencies.clear()
        latencies.add(300_000_000)  # later than the histogram's last step begins
        assert latencies.percentiles_ms()["p99.9"] == 300.0
    finally:
        latencies.close()
