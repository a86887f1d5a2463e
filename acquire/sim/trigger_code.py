"""The trigger's light, as its registers define it: the code on the wire, and the state of the code."""

from __future__ import annotations

from functools import reduce
from operator import xor
from typing import TYPE_CHECKING, Any

from acquire.codes import TAPS
from acquire.trigger import registers as r

if TYPE_CHECKING:
    from collections.abc import Callable


def light_attrs(get: Callable[[r.Register], int]) -> dict[str, Any]:
    """Return the light's code for the cameras; dark if the LED is off or cameras cannot follow the code."""
    source, mask = get(r.CODE_SOURCE), get(r.PRBS_MASK)
    kind = r.CODE_SOURCE.kind.of(source)
    lit = r.LED.enable.of(get(r.LED))
    degree = mask.bit_length()
    taps = TAPS.get(degree, ())
    # a register with other taps makes another code, which `acquire.codes` does not know
    if lit and kind == r.Source.PRBS and mask == sum(1 << tap - 1 for tap in taps):
        state = f"{get(r.PRBS_SEED):#x}"
        return {"kind": "prbs", "degree": degree, "taps": list(taps), "state": state, "start": 0}
    value = r.CODE_SOURCE.value.of(source) if lit and kind == r.Source.CONSTANT else 0
    return {"kind": "constant", "value": value, "start": 0}


def prbs_state(mask: int, seed: int, index: int) -> int:
    """Return the register's state at a code index. A step is linear in GF(2), and its square is two steps."""
    step = [mask, *(1 << bit for bit in range(63))]  # the next state of a state in which only bit i is set
    state = seed
    while index:
        if index & 1:
            state = _apply(step, state)
        step = [_apply(step, image) for image in step]
        index >>= 1
    return state


def _apply(step: list[int], state: int) -> int:
    return reduce(xor, (image for bit, image in enumerate(step) if state >> bit & 1), 0)
