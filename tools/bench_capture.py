"""The whole capture path at full rate: lost lines, ring, cores, latency; compared with bare disk and memory.

``python tools/bench_capture.py --out DIR`` records into DIR at the rates of the fastest cameras, with a bare
O_DIRECT write and a memcpy before each, so that all comparisons are within one run.
``--search`` also searches for the highest rate without loss; ``--seconds`` is the duration of each case.
The cameras deliver stored lines; no scene is computed. Grabbers have real-time priority where permitted.
"""

from __future__ import annotations

import argparse
import mmap
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from acquire.capacity.load import Load
from acquire.capacity.run import LoadReport, run_load
from acquire.capacity.search import best, search_rate
from tools.results import Run, add_option, recorded

LOADS = {
    "4640 px x 100 kHz": Load(4640, "uint8", 100_000.0),
    "4640 px x 100 kHz, lz4": Load(4640, "uint8", 100_000.0, codec="lz4"),
    "54 px x 600 kHz": Load(54, "uint8", 600_000.0, block_lines=8192),
}
BARE_BYTES = 2 * 10**9
PIECE_BYTES = 4 * 2**20


def bare_write(directory: Path) -> tuple[float, float]:
    """MB/s and processor seconds per GB of one O_DIRECT file, written in pieces from touched memory."""
    source = mmap.mmap(-1, 8 * PIECE_BYTES)
    np.frombuffer(source, np.uint8)[:] = np.random.default_rng(0).integers(0, 256, len(source), np.uint8)
    path = directory / ".bare"
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_DIRECT)
    begun, used = time.perf_counter(), time.process_time()
    try:
        for at in range(0, BARE_BYTES, PIECE_BYTES):
            part = at % len(source)
            os.pwrite(fd, memoryview(source)[part : part + PIECE_BYTES], at)
        size = os.fstat(fd).st_size
        elapsed_s = time.perf_counter() - begun
        return size / elapsed_s / 1e6, (time.process_time() - used) / (size / 1e9)
    finally:
        os.close(fd)
        path.unlink()


def bare_copy() -> float:
    """GB/s of numpy from one place to another, both larger than a cache."""
    source, target = (np.ones(2**26, np.uint8) for _ in range(2))
    begun = time.perf_counter()
    for _ in range(10):
        target[:] = source
    return 10 * len(source) / (time.perf_counter() - begun) / 1e9


def show(name: str, report: LoadReport, run: Run) -> None:
    cores, late = report.cores, report.latency_ms
    mb_s = report.load.bytes_per_s / 1e6
    print(
        f"2 x {name}: {mb_s:.0f} MB/s for {report.seconds:.1f} s: {report.condition}\n"
        f"  lines lost {report.lost}, unaccounted {report.unaccounted}, of {report.lines};"
        f" ring peak {100 * report.ring_peak:.0f} %\n"
        f"  cores: recorder {cores['recorder']:.3f}, grabbers {cores['a']:.3f} + {cores['b']:.3f},"
        f" owner and simulated trigger {cores['owner']:.3f}; {report.cpu_s_per_gb:.3f} s per GB\n"
        f"  grabber latency ms: p50 {late['p50']:.2f}, p99 {late['p99']:.2f}, p99.9 {late['p99.9']:.2f},"
        f" max {late['max']:.2f}"
    )
    run.add(
        f"2 x {name}",
        mb_s=mb_s,
        seconds=report.seconds,
        condition=str(report.condition),
        lines=report.lines,
        lost=report.lost,
        unaccounted=report.unaccounted,
        ring_peak_percent=100 * report.ring_peak,
        **{f"cores_{owner}": cores[owner] for owner in ("recorder", "a", "b", "owner")},
        cpu_s_per_gb=report.cpu_s_per_gb,
        **{f"latency_{name}_ms": late[name] for name in ("p50", "p99", "p99.9", "max")},
    )


def search(name: str, load: Load, directory: Path, run: Run) -> None:
    disk_mb_s, _ = bare_write(directory)
    found = best(search_rate(load, directory, load.line_rate_hz))
    if found is None:
        print(f"2 x {name}: no rate held")
        return
    mb_s = replace(load, line_rate_hz=found.line_rate_hz).bytes_per_s / 1e6
    print(
        f"2 x {name}: highest rate without loss {found.line_rate_hz / 1e3:.0f} klines/s = {mb_s:.0f} MB/s,"
        f" {mb_s / disk_mb_s:.2f} of the bare write ({disk_mb_s:.0f} MB/s)"
    )
    run.add(f"2 x {name}, highest rate without loss", mb_s=mb_s, line_rate_hz=found.line_rate_hz)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--search", action="store_true")
    parser.add_argument("--case", help="only cases whose name contains this", default="")
    add_option(parser)
    options = parser.parse_args()
    cases = [name for name in LOADS if options.case in name]
    if not cases:
        parser.error(f"no case has {options.case!r} in its name; there are: {'; '.join(LOADS)}")
    options.out.mkdir(parents=True, exist_ok=True)
    with recorded("bench_capture", keep=options.record) as run:
        for name in cases:
            mb_s, cpu = bare_write(options.out)
            copy_gb_s = bare_copy()
            print(f"bare O_DIRECT write {mb_s:.0f} MB/s, {cpu:.3f} s per GB; memcpy {copy_gb_s:.1f} GB/s")
            run.add(f"bare write before {name}", mb_s=mb_s, cpu_s_per_gb=cpu, memcpy_gb_s=copy_gb_s)
            show(name, run_load(LOADS[name], options.out, options.seconds), run)
            if options.search:
                search(name, LOADS[name], options.out, run)


if __name__ == "__main__":
    main()
