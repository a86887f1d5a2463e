"""Checks that the trigger makes when a run is armed, in the order in which it reports the first error."""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.trigger import registers as r
from acquire.trigger.registers import ErrorCode, LineMode, Source

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


class Refusal(Exception):  # noqa: N818 - a NAK on its way to the host, not an error of this program
    """The trigger refuses a request: ``code`` is an ErrorCode, ``address`` that of the word at fault."""

    def __init__(self, code: int, address: int) -> None:
        super().__init__(code, address)
        self.code, self.address = code, address


def check_configuration(get: Callable[[r.Register], int], locked: bool, code_checked: bool) -> None:
    """Raise Refusal for the first setting that cannot be honoured. ``get`` reads a register."""
    if not locked:
        raise Refusal(ErrorCode.CLOCK_UNLOCKED, r.STATUS.address)
    for checks in (_timing(get), _code(get, code_checked), _outputs(get)):
        for failed, code, register in checks:
            if failed:
                raise Refusal(code, register.address)


_Check = tuple[bool, ErrorCode, r.Register]
"""Whether the check failed, the error to report, and the register at fault."""


def _timing(get: Callable[[r.Register], int]) -> Iterator[_Check]:
    limits, clocks, substeps = get(r.LIMITS), get(r.SUBSTEP_CLOCKS), r.LINE.substeps.of(get(r.LINE))
    longest = (1 << r.LIMITS.substep_max_log2.of(limits)) - 1
    yield not r.LIMITS.substep_min.of(limits) <= clocks <= longest, ErrorCode.BAD_SUBSTEP, r.SUBSTEP_CLOCKS
    # bit S of the capability stands for S sub-steps
    possible = r.CAPABILITIES.substeps.of(get(r.CAPABILITIES))
    yield not possible >> substeps & 1, ErrorCode.BAD_SUBSTEPS, r.LINE
    # The six sub-phases of a line's transfer are divided among its S sub-steps.
    yield 6 // substeps * get(r.PHASE_CLOCKS) > clocks, ErrorCode.BAD_PHASES, r.PHASE_CLOCKS
    yield get(r.TAG_INTERVAL) == 0, ErrorCode.BAD_TAG_INTERVAL, r.TAG_INTERVAL


def _code(get: Callable[[r.Register], int], checked: bool) -> Iterator[_Check]:
    kind = r.CODE_SOURCE.kind.of(get(r.CODE_SOURCE))
    yield kind not in tuple(Source), ErrorCode.BAD_SOURCE, r.CODE_SOURCE
    if kind == Source.PRBS:
        # A register of zeros stays one, and so does one without taps: neither makes a code.
        yield get(r.PRBS_MASK) == 0, ErrorCode.BAD_SEED, r.PRBS_MASK
        yield get(r.PRBS_SEED) == 0, ErrorCode.BAD_SEED, r.PRBS_SEED
    if kind == Source.MEMORY:
        length = get(r.CODE_LENGTH)
        yield not 0 < length <= get(r.CODE_BITS), ErrorCode.BAD_CODE_LENGTH, r.CODE_LENGTH
        # Otherwise the checksum is that of another content, or of none.
        yield not checked, ErrorCode.CODE_UNCHECKED, r.CODE_LENGTH


def _outputs(get: Callable[[r.Register], int]) -> Iterator[_Check]:
    clocks, opens, closes = get(r.SUBSTEP_CLOCKS), get(r.WINDOW_OPEN), get(r.WINDOW_CLOSE)
    yield not opens < closes <= clocks, ErrorCode.BAD_WINDOW, r.WINDOW_CLOSE
    margin = r.LIMITS.lead_margin.of(get(r.LIMITS))
    yield r.LED.lead.of(get(r.LED)) + margin > clocks, ErrorCode.BAD_LEAD, r.LED
    distance = pulse_distance(get)
    for enable, delay, width, code in (
        (r.TRIGGER_A, r.TRIGGER_A_DELAY, r.TRIGGER_A_WIDTH, ErrorCode.BAD_TRIGGER_A),
        (r.TRIGGER_B, r.TRIGGER_B_DELAY, r.TRIGGER_B_WIDTH, ErrorCode.BAD_TRIGGER_B),
    ):
        on = bool(enable.enable.of(get(enable)))
        # an output that is off may have any timing
        yield on and get(width) == 0, code, width
        # The next request must not come before this pulse has ended: the gateware would abandon its rest.
        yield on and get(delay) + get(width) >= distance, code, delay
    yield distance < get(r.CAMERA_MIN_PERIOD), ErrorCode.BAD_MIN_PERIOD, r.CAMERA_MIN_PERIOD


def pulse_distance(get: Callable[[r.Register], int]) -> int:
    """Clock cycles between two pulses of an output."""
    line = get(r.LINE)
    per_substep = r.LINE.mode.of(line) == LineMode.PER_SUBSTEP
    return get(r.SUBSTEP_CLOCKS) * (1 if per_substep else r.LINE.substeps.of(line))
