"""Random configurations that arming accepts, and the code bits that they must show."""

from __future__ import annotations

import random

import numpy as np
from numpy.typing import NDArray

from acquire.codes import TAPS, prbs
from acquire.trigger import registers as r
from acquire.trigger.registers import Source


def random_run(choose: random.Random) -> tuple[dict[r.Register, int], NDArray[np.uint8]]:
    """A configuration that arming accepts, and the code bits it must show."""
    S, clocks = choose.choice([1, 2, 3, 6]), choose.choice([5, 6, 7, *range(8, 60)])
    mode = choose.choice(list(r.LineMode))
    distance = clocks if mode == r.LineMode.PER_SUBSTEP else S * clocks
    closes = choose.choice([clocks, choose.randint(1, clocks)])
    config = {
        r.SUBSTEP_CLOCKS: clocks,
        r.LINE: r.LINE.pack(substeps=S, mode=mode, direction=choose.getrandbits(1)),
        r.PHASE_CLOCKS: choose.randint(0, clocks * S // 6),
        r.LED: r.LED.pack(
            enable=choose.random() < 0.9,
            invert=choose.getrandbits(1),
            lead=choose.choice([0, choose.randrange(clocks)]),
        ),
        r.WINDOW_OPEN: choose.choice([0, choose.randrange(closes)]),
        r.WINDOW_CLOSE: closes,
        r.CAMERA_MIN_PERIOD: choose.randint(0, distance),
        r.TAG_INTERVAL: choose.randint(1, 5),
    }
    for arm in "AB":
        delay = choose.randrange(distance - 1)
        config[getattr(r, f"TRIGGER_{arm}")] = r.TRIGGER_A.pack(
            enable=choose.random() < 0.9, invert=choose.getrandbits(1), direction=choose.getrandbits(1)
        )
        config[getattr(r, f"TRIGGER_{arm}_DELAY")] = delay
        config[getattr(r, f"TRIGGER_{arm}_WIDTH")] = choose.randint(1, distance - delay - 1)
    source, code = random_code(choose)
    return config | source, code


def random_code(choose: random.Random) -> tuple[dict[r.Register, int], NDArray[np.uint8]]:
    kind, count = choose.choice(list(Source)), 1000
    settings = {r.CODE_SOURCE: r.CODE_SOURCE.pack(kind=kind)}
    if kind == Source.CONSTANT:
        value = choose.getrandbits(1)
        return {r.CODE_SOURCE: r.CODE_SOURCE.pack(kind=kind, value=value)}, np.full(count, value, np.uint8)
    if kind == Source.PRBS:
        degree = choose.choice(sorted(TAPS))
        seed = choose.randint(1, (1 << degree) - 1)
        mask = sum(1 << tap - 1 for tap in TAPS[degree])
        return settings | {r.PRBS_MASK: mask, r.PRBS_SEED: seed}, prbs(degree, seed, 0, count)
    length = choose.randint(1, 200)
    bits = np.array([choose.getrandbits(1) for _ in range(length)], np.uint8)
    return settings | {r.CODE_LENGTH: length}, np.resize(bits, count)
