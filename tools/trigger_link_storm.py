"""Send commands to the behavioural model over a link that damages one byte in a hundred.

``python tools/trigger_link_storm.py [COMMANDS]``: prints the number of wrong values accepted (none) and the
longest wait for an answer (never beyond the link's limit).
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "trigger"))

from noisy import NoisyTransport, storm
from trigger_twins import wired_model

from acquire.trigger.link import Link

RATE = 0.01

commands = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
begun = time.monotonic()
with wired_model() as model:
    transport = NoisyTransport(model, RATE, seed=1)
    link = Link(transport, reply_s=0.05, attempts=40)
    link.window_bytes = 2048
    damage = storm(link, commands)
    statistics, limit_s = link.statistics(), link.limit_s
    link.close()
print(
    f"{commands} commands in {time.monotonic() - begun:.1f} s; {transport.damaged} bytes damaged, {RATE:.0%}"
)
print(f"wrong values accepted: {damage.wrong}; batches given up: {damage.given_up}")
print(f"longest wait for an answer: {statistics['longest_s']:.3f} s; limit: {limit_s:g} s")
print(", ".join(f"{name} {count:g}" for name, count in statistics.items() if name != "longest_s"))
raise SystemExit(damage != (0, 0) or statistics["longest_s"] > limit_s)
