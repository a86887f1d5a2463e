"""Somebody sets the host's clock while an instrument records: lines, times and waits do not follow it.

The daemon and its processes run with a library that shifts their CLOCK_REALTIME by a number in a shared
file; the clock of this machine is not touched.
"""

from __future__ import annotations

import struct
import subprocess
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from live_daemon import LINE_RATE_HZ, Daemon

from acquire.daemon.states import SEALED, State
from acquire.sim.gentl.build import compiler
from acquire.store import open_recording, verify

SHIFTED = r"""
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static volatile int64_t *shift;
static int64_t none;

static int64_t shift_s(void) {
    if (!shift) {
        int file = open(getenv("CLOCK_SHIFT"), O_RDONLY | O_CLOEXEC);
        void *page = file < 0 ? MAP_FAILED : mmap(0, sizeof *shift, PROT_READ, MAP_SHARED, file, 0);
        shift = page == MAP_FAILED ? &none : page;
        if (file >= 0) close(file);
    }
    return *shift;
}

int clock_gettime(clockid_t clock, struct timespec *now) {
    int failed = syscall(SYS_clock_gettime, clock, now);
    if (!failed && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) now->tv_sec += shift_s();
    return failed;
}

int gettimeofday(struct timeval *now, void *zone) {
    int failed = syscall(SYS_gettimeofday, now, zone);
    if (!failed) now->tv_sec += shift_s();
    return failed;
}

time_t time(time_t *out) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (out) *out = now.tv_sec;
    return now.tv_sec;
}
"""
HOUR_S = 3600


@pytest.mark.skipif(not compiler(), reason="no C compiler")
def test_a_clock_that_is_set_disturbs_no_recording(tmp_path: Path) -> None:
    library, shift = tmp_path / "shifted.so", tmp_path / "shift"
    (tmp_path / "shifted.c").write_text(SHIFTED)
    build = [compiler(), "-shared", "-fPIC", "-O1", "-o", library, tmp_path / "shifted.c"]
    subprocess.run(build, check=True, timeout=300)
    shift.write_bytes(struct.pack("q", 0))

    def set_clock(by_s: int) -> None:
        with shift.open("r+b") as file:  # in place: the processes have it mapped
            file.write(struct.pack("q", by_s))

    daemon = Daemon(tmp_path, LD_PRELOAD=str(library), CLOCK_SHIFT=str(shift))
    try:
        with daemon.client() as client:
            client.arm()
            client.start(tmp_path / "run.zarr")
            news = []
            for by_s in (-HOUR_S, HOUR_S, 0):
                set_clock(by_s)
                client.mark(f"set by {by_s} s")
                before = client.status()
                news += list(client.events(timeout_s=1.5))
                after = client.status()
                assert after.state is State.RECORDING
                assert 1 < after.uptime_s - before.uptime_s < 60
            client.stop()
            last = client.wait(SEALED, 120).last
            # What is begun after a step is as good, and its path is a new one.
            set_clock(-HOUR_S)
            for _ in range(2):
                client.start(lines=LINE_RATE_HZ // 10)
                assert client.wait(SEALED, 120).last.condition == "GOOD"
            client.disarm()
            client.arm()
            assert datetime.now(UTC) - client.status().since > timedelta(seconds=HOUR_S - 60)  # it is shifted
            client.disarm()
            assert client.status().troubles == []
            assert not [one.text for one in news if one.level != "info"]
    finally:
        daemon.close()
    assert (last.condition, last.end_reason) == ("GOOD", "stopped")
    recording = open_recording(tmp_path / "run.zarr")
    # The lines' times are the trigger's: by steps of one line, within the drift of the clocks' comparison.
    steps = np.diff(np.asarray(recording.camera("a").read("time", 0, recording.lines)))
    assert abs(steps - recording.line_period_ns).max() < 1e-3 * recording.line_period_ns
    assert not verify(recording.source.path).contradictions
    assert [event.text for event in recording.events if event.kind == "mark"] == [
        f"set by {by_s} s" for by_s in (-HOUR_S, HOUR_S, 0)
    ]
