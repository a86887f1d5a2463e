"""Load of the machine, from the processor time that a thread gets."""

from __future__ import annotations

import os
import subprocess
import sys

from acquire.evaluate.host import HostWatch


def test_a_core_in_use_by_others_is_reported() -> None:
    allowed = os.sched_getaffinity(0)
    core = min(allowed)
    spin = f"import os; os.sched_setaffinity(0, {{{core}}}); print(flush=True)\nwhile True: pass"
    other = subprocess.Popen([sys.executable, "-c", spin], stdout=subprocess.PIPE)
    try:
        assert other.stdout is not None
        other.stdout.readline()
        os.sched_setaffinity(0, {core})
        watch = HostWatch()
        for _ in range(3):
            watch.look()
    finally:
        os.sched_setaffinity(0, allowed)
        other.kill()
        other.communicate()
    found = watch.busyness()
    assert 0 < found.least_share <= found.share < 0.8
    assert found.load >= 0
    assert 1 <= found.facts()["least_share_percent"] <= found.facts()["share_percent"] < 80


def test_load_is_measured_at_the_first_request() -> None:
    found = HostWatch().busyness()
    assert 0 < found.share == found.least_share <= 1
    assert found.cores >= 1
