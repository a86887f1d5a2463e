r"""Arming accepts exactly the settings that the other proofs assume.

::

    configuration  ==X held for SETTLED clocks ====
    Checks.error   ==?=?=?=?X 0: every claim below

The claims are stated in terms of the registers, independently of how `firmware.checks` computes its result.
"""

from __future__ import annotations

from amaranth.hdl import Cat, Mux, Signal, Value

from acquire.trigger import registers as r
from acquire.trigger.registers import ErrorCode, LineMode, Source
from firmware.checks import Checks
from firmware.formal.harness import Harness, Proof, opened, times
from firmware.phases import SUBPHASES
from firmware.registerfile import RegisterFile
from firmware.timing import SUBSTEP_CLOCKS_MIN
from firmware.top import Build

SETTLED = 4
"""Clocks; from the last write of a configuration to the ARM that reads it, `Host` needs more."""
CODE_BITS = 32 * Build().code_words


def settings_proof() -> Proof:
    harness = Harness()
    file = RegisterFile(Build().constants(), {})
    checks = Checks(file, CODE_BITS)
    opened(file)  # its registers take any value here, whatever has been written
    harness.m.submodules.checks = checks
    everything = Cat(*(file.value(register) for register in r.CONFIGURATION))
    everything = Cat(everything, checks.code_checked, checks.clock_locked)
    before, held = Signal(len(everything)), Signal(range(SETTLED + 1))
    harness.m.d.sync += before.eq(everything)
    with harness.m.If(before != everything):
        harness.m.d.sync += held.eq(1)
    with harness.m.Elif(held < SETTLED):
        harness.m.d.sync += held.eq(held + 1)
    settled = (held == SETTLED) & (before == everything)
    accepted, conditions = settled & (checks.error == 0), _conditions(file, checks)
    for (name, error), condition in conditions.items():
        harness.claim(name, accepted, condition)
        harness.claim(f"refused_only_unless_{name}", settled & (checks.error == error), ~condition)
    errors = [int(error) for _, error in conditions]
    harness.claim("every_refusal_has_its_reason", settled & ~accepted, checks.error.matches(*errors))
    harness.cover("accepted", settled & (checks.error == 0))
    harness.cover("refused", settled & (checks.error != 0))
    inputs = [file.value(register) for register in r.CONFIGURATION]
    inputs += [checks.code_checked, checks.clock_locked]
    return harness.proof("settings", inputs, cover_depth=8, depth=SETTLED + 1)


def _conditions(file: RegisterFile, checks: Checks) -> dict[tuple[str, ErrorCode], Value]:
    value, field = file.value, file.field
    clocks, substeps, kind = value(r.SUBSTEP_CLOCKS), field(r.LINE, "substeps"), field(r.CODE_SOURCE, "kind")
    per_line = field(r.LINE, "mode") == LineMode.PER_LINE
    distance = Mux(per_line, times(clocks, substeps, 6), clocks)
    moves = {s: times(value(r.PHASE_CLOCKS), Cat(Value.cast(count)), 6) for s, count in SUBPHASES.items()}
    prbs, memory = kind == Source.PRBS, kind == Source.MEMORY
    length = value(r.CODE_LENGTH)
    return {
        ("clock_is_locked", ErrorCode.CLOCK_UNLOCKED): checks.clock_locked,
        ("substep_is_long_enough", ErrorCode.BAD_SUBSTEP): clocks >= SUBSTEP_CLOCKS_MIN,
        ("S_is_one_of_four", ErrorCode.BAD_SUBSTEPS): substeps.matches(*SUBPHASES),
        ("light_leads_by_less_than_a_substep", ErrorCode.BAD_LEAD): field(r.LED, "lead") < clocks,
        ("pulses_keep_the_camera_s_minimum", ErrorCode.BAD_MIN_PERIOD): distance
        >= value(r.CAMERA_MIN_PERIOD),
        ("pulse_a_fits", ErrorCode.BAD_TRIGGER_A): _fits(
            file, r.TRIGGER_A, r.TRIGGER_A_DELAY, r.TRIGGER_A_WIDTH, distance
        ),
        ("pulse_b_fits", ErrorCode.BAD_TRIGGER_B): _fits(
            file, r.TRIGGER_B, r.TRIGGER_B_DELAY, r.TRIGGER_B_WIDTH, distance
        ),
        ("phases_fit", ErrorCode.BAD_PHASES): Cat(
            (substeps != s) | (needs <= clocks) for s, needs in moves.items()
        ).all(),
        ("window_is_in_the_substep", ErrorCode.BAD_WINDOW): (value(r.WINDOW_OPEN) < value(r.WINDOW_CLOSE))
        & (value(r.WINDOW_CLOSE) <= clocks),
        ("tags_have_an_interval", ErrorCode.BAD_TAG_INTERVAL): value(r.TAG_INTERVAL) != 0,
        ("source_is_known", ErrorCode.BAD_SOURCE): kind.matches(*map(int, Source)),
        ("register_never_sticks_at_0", ErrorCode.BAD_SEED): ~prbs
        | ((value(r.PRBS_SEED) != 0) & (value(r.PRBS_MASK) != 0)),
        ("code_fits", ErrorCode.BAD_CODE_LENGTH): ~memory | ((length != 0) & (length <= CODE_BITS)),
        ("code_is_checked", ErrorCode.CODE_UNCHECKED): ~memory | checks.code_checked,
    }


def _fits(
    file: RegisterFile, output: r.Register, delay: r.Register, width: r.Register, distance: Value
) -> Value:
    end = file.value(delay) + file.value(width)
    return ~file.field(output, "enable") | ((file.value(width) != 0) & (end < distance))
