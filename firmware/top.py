r"""The whole trigger, for any board: pins in, pins out, one clock.

::

    rx ─▶ UART ─▶ queue ─▶ deframer ─▶ host ─▶ framer ─▶ UART ─▶ tx
                                       │  ▲
                       registers ◀─────┘  └──── tag queue ◀── tagger
                           │                                    ▲
    edge, START ─▶ commands ─▶ timing ─▶ light, pulses, phases ─┘─▶ pins

All pins that belong to a run are two clocks behind `Timing`: line 0 with delay 0 appears at the pins
START_LATENCY + LED.lead clocks after the external edge, or after the clock in which START is carried out.
"""

from dataclasses import dataclass

from amaranth.hdl import Cat, Elaboratable, Module, Mux, Signal
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out

from acquire.trigger import registers as r
from acquire.trigger.registers import LineMode, TagFlag
from firmware import inputs, timing
from firmware.checks import Checks
from firmware.code import CodeSource
from firmware.codememory import WORDS
from firmware.commands import Commands
from firmware.deframer import Deframer
from firmware.fifo import Queue
from firmware.framer import Framer
from firmware.host import Host
from firmware.inputs import Input
from firmware.light import Light
from firmware.phases import SUBPHASES, Phases
from firmware.pulse import Pulse
from firmware.registerfile import RegisterFile
from firmware.strobes import StrobeCheck
from firmware.tagger import SEQUENCE_BITS, TAG_BITS, Tagger
from firmware.timestamp import Timestamp
from firmware.timing import Timing
from firmware.uart import UartReceiver, UartTransmitter
from firmware.watchdog import Watchdog

FIRMWARE = (0, 1)
"""Major, minor."""
PIN_CLOCKS = 2
"""Clocks from `Timing` to the pins."""
START_LATENCY = inputs.LATENCY + timing.START_CLOCKS + PIN_CLOCKS


@dataclass(frozen=True)
class Build:
    """Parameters that depend on the board."""

    clock_hz: int = 90_000_000
    baud: int = 3_000_000
    board: r.Board = r.Board.NONE
    serial: int = 0
    code_words: int = WORDS
    tags: int = 1024
    rx_bytes: int = 2048
    light_low: bool = False
    """A low level switches the light on: the output is high from the first clock on."""

    @property
    def divisor(self) -> int:
        """Clocks of a bit on the UART."""
        return round(self.clock_hz / self.baud)

    def constants(self) -> dict[r.Register, int]:
        major, minor = FIRMWARE
        return {
            r.ID: r.DEVICE_ID,
            r.VERSION: r.VERSION.pack(
                protocol=r.PROTOCOL_VERSION,
                firmware_minor=minor,
                firmware_major=major,
                board=self.board,
            ),
            r.MAP: r.MAP_CRC,
            r.SERIAL: self.serial,
            r.CLOCK_HZ: self.clock_hz,
            r.CODE_BITS: 32 * self.code_words,
            r.LIMITS: r.LIMITS.pack(
                substep_min=timing.SUBSTEP_CLOCKS_MIN, substep_max_log2=timing.CLOCK_BITS, lead_margin=1
            ),
            r.CAPABILITIES: r.CAPABILITIES.pack(
                substeps=sum(1 << count for count in SUBPHASES),
                phases=1,
                strobes=1,
                pps=1,
                scene_gate=1,
                external_arm=1,
                light_low=self.light_low,
                start_latency=START_LATENCY,
            ),
            r.QUEUES: r.QUEUES.pack(tags=self.tags, rx_bytes=self.rx_bytes),
        }

    def resets(self) -> dict[r.Register, int]:
        """Registers whose reset value differs from the definition's in this build."""
        return {r.LED: r.LED.pack(invert=1)} if self.light_low else {}


class SyncTrigger(wiring.Component):
    rx: In(1, init=1)
    tx: Out(1, init=1)
    clear_to_send: In(1, init=1)
    """Flow control towards the host; tags wait in their queue until then."""
    pps: In(1)
    scene_gate: In(1)
    external_arm: In(1)
    strobe_a: In(1)
    strobe_b: In(1)
    clock_locked: In(1, init=1)
    clock_external: In(1)
    led: Out(1)
    trigger_a: Out(1)
    trigger_b: Out(1)
    direction_a: Out(1)
    direction_b: Out(1)
    phases: Out(3)
    line: Out(1)
    """Marks the first clock of every line, as late as the other pins."""
    substep: Out(1)
    """Marks the first clock of every sub-step."""
    running: Out(1)

    def __init__(self, build: Build) -> None:
        self.build = build
        super().__init__()

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        self._parts(m)
        self._link(m)
        self._registers(m)
        self._code(m)
        self._run(m)
        self._outputs(m)
        self._strobes(m)
        self._status(m)
        self._tags(m)
        return m

    def _parts(self, m: Module) -> None:
        build = self.build
        self.file = m.submodules.registers = RegisterFile(build.constants(), build.resets())
        self.host = m.submodules.host = Host(build.code_words)
        self.code = m.submodules.code = CodeSource(self.file, build.code_words)
        self.checks = m.submodules.checks = Checks(self.file, 32 * build.code_words)
        self.commands = m.submodules.commands = Commands()
        self.timing = m.submodules.timing = Timing()
        self.light = m.submodules.light = Light()
        self.timestamp = m.submodules.timestamp = Timestamp()
        self.tagger = m.submodules.tagger = Tagger()
        self.tag_queue = m.submodules.tag_queue = Queue(SEQUENCE_BITS + TAG_BITS, build.tags)
        self.locked = self._input(m, "locked", self.clock_locked)
        self.pps_input = self._input(m, "pps_input", self.pps)
        self.scene = self._input(m, "scene", self.scene_gate)
        inverted = self.file.field(r.EXTERNAL_ARM, "invert")
        self.arm = self._input(m, "arm", self.external_arm, inverted)

    def _input(self, m: Module, name: str, pin: object, inverted: object = 0) -> Input:
        part = m.submodules[name] = Input()
        m.d.comb += [part.pin.eq(pin), part.inverted.eq(inverted)]
        return part

    def _link(self, m: Module) -> None:
        m.submodules.rx_queue = queue = Queue(8, self.build.rx_bytes)
        m.submodules.deframer = self.deframer = deframer = Deframer(r.MAX_PAYLOAD)
        m.submodules.framer = framer = Framer()
        host = self.host
        wiring.connect(m, queue.output, deframer.bytes)
        self._bytes(m, queue, framer)
        m.d.comb += [
            host.frame.eq(deframer.frame),
            host.length.eq(deframer.length),
            deframer.address.eq(host.frame_address),
            host.frame_data.eq(deframer.data),
            deframer.release.eq(host.release),
            framer.valid.eq(host.valid),
            host.ready.eq(framer.ready),
            framer.data.eq(host.data),
            framer.last.eq(host.last),
        ]

    def _bytes(self, m: Module, queue: Queue, framer: Framer) -> None:
        """Connect the source and sink of bytes: here the UART."""
        m.submodules.receiver = receiver = UartReceiver(self.build.divisor)
        m.submodules.transmitter = transmitter = UartTransmitter(self.build.divisor)
        clear = self._input(m, "clear_to_send_input", self.clear_to_send)
        wiring.connect(m, framer.bytes, transmitter.bytes)
        m.d.comb += [
            receiver.line.eq(self.rx),
            self.tx.eq(transmitter.line),
            transmitter.clear_to_send.eq(clear.level),
            queue.put.eq(receiver.valid),
            queue.data.eq(receiver.data),
        ]

    def _registers(self, m: Module) -> None:
        host, file, commands, idle = self.host, self.file, self.commands, Signal()
        # A clock of delay does not matter: only the host ends idleness, and it waits for its answer.
        m.d.sync += idle.eq(commands.idle)
        m.d.comb += [
            file.address.eq(host.address),
            host.known.eq(file.known),
            host.writable.eq(file.writable),
            host.guarded.eq(file.guarded),
            file.sample.eq(host.sample),
            host.read_data.eq(file.data),
            file.write.eq(host.write),
            file.write_data.eq(host.write_data),
            host.idle.eq(idle),
            commands.execute.eq(host.execute),
            commands.command.eq(host.write_data),
            commands.run.eq(file.value(r.RUN_ID)),
            host.done.eq(commands.done),
            host.error.eq(commands.error),
            host.error_address.eq(commands.address),
        ]

    def _code(self, m: Module) -> None:
        host, code, commands = self.host, self.code, self.commands
        m.d.comb += [
            code.host_address.eq(host.code_address),
            code.host_read.eq(host.code_read & host.idle),
            host.code_data.eq(code.host_data),
            code.host_write.eq(host.code_write),
            code.host_word.eq(host.write_data),
            code.changed.eq(
                host.write
                & (host.address == r.CODE_LENGTH.address)
                & (host.write_data != self.file.value(r.CODE_LENGTH))
            ),
            code.check.eq(commands.check_code),
            code.self_test.eq(commands.self_test),
            code.load.eq(commands.arm),
            code.step.eq(self.timing.advance),
            code.line_first.eq(self.timing.line_comes),
        ]

    def _run(self, m: Module) -> None:
        file, commands, timing, checks = self.file, self.commands, self.timing, self.checks
        m.submodules.watchdog = watchdog = Watchdog()
        enabled = file.field(r.EXTERNAL_ARM, "enable")
        code_busy = Signal()
        m.d.sync += code_busy.eq(
            self.code.busy
        )  # still in time for the next command; without this register its path was the longest
        m.d.comb += [
            checks.code_checked.eq(self.code.checked),
            checks.clock_locked.eq(self.locked.level),
            commands.config_error.eq(checks.error),
            commands.config_address.eq(checks.address),
            commands.length_good.eq(checks.length_good),
            commands.busy.eq(code_busy | self.tagger.telling),
            commands.edge.eq(self.arm.edge & enabled),
            commands.watchdog.eq(watchdog.bark),
            commands.clock_locked.eq(self.locked.level),
            commands.running.eq(timing.running),
            self.running.eq(timing.running),
            commands.budget.eq(timing.last_line),
            watchdog.period.eq(file.value(r.WATCHDOG)),
            watchdog.enable.eq(timing.running),
            watchdog.feed.eq(self.host.heard),
            timing.substep_clocks.eq(file.value(r.SUBSTEP_CLOCKS)),
            timing.substeps.eq(file.field(r.LINE, "substeps")),
            timing.lead.eq(file.field(r.LED, "lead")),
            timing.lines.eq(file.value(r.LINE_BUDGET)),
            timing.start.eq(commands.start),
            timing.stop.eq(commands.stop),
        ]

    def _outputs(self, m: Module) -> None:
        file, timing, light = self.file, self.timing, self.light
        m.submodules.phases = phases = Phases()
        m.d.comb += [
            light.advance.eq(timing.advance),
            light.ending.eq(timing.ending),
            light.code_bit.eq(self.code.bit),
            light.enable.eq(file.field(r.LED, "enable")),
            light.inverted.eq(file.field(r.LED, "invert")),
            light.window_open.eq(file.value(r.WINDOW_OPEN)),
            light.window_close.eq(file.value(r.WINDOW_CLOSE)),
            light.scene_enable.eq(file.field(r.LED, "gate_enable")),
            light.scene_gate.eq(self.scene.level),
            self.led.eq(light.led),
            phases.running.eq(timing.running),
            phases.substep.eq(timing.substep),
            phases.line.eq(timing.line),
            phases.substeps.eq(timing.substeps),
            phases.phase_clocks.eq(file.value(r.PHASE_CLOCKS)),
            phases.backwards.eq(file.field(r.LINE, "direction")),
            self.phases.eq(phases.phases),
        ]
        line, substep = Signal(), Signal()
        # As late as the other pins (PIN_CLOCKS), so that an oscilloscope shows them in step.
        m.d.sync += [line.eq(timing.line), substep.eq(timing.substep)]
        m.d.sync += [self.line.eq(line), self.substep.eq(substep)]

    def _strobes(self, m: Module) -> None:
        fire = Mux(
            self.file.field(r.LINE, "mode") == LineMode.PER_SUBSTEP, self.timing.substep, self.timing.line
        )
        self.camera_a = self._camera(m, "a", fire)
        self.camera_b = self._camera(m, "b", fire)

    def _camera(self, m: Module, arm: str, fire: object) -> StrobeCheck:
        """Trigger, direction and strobe of one camera."""
        file, settings = self.file, getattr(r, f"TRIGGER_{arm.upper()}")
        pulse = m.submodules[f"pulse_{arm}"] = Pulse()
        check = m.submodules[f"check_{arm}"] = StrobeCheck()
        strobe = self._input(m, f"strobe_{arm}_input", getattr(self, f"strobe_{arm}"))
        m.d.comb += [
            pulse.fire.eq(fire),
            pulse.enable.eq(file.field(settings, "enable")),
            pulse.inverted.eq(file.field(settings, "invert")),
            pulse.delay.eq(file.value(getattr(r, f"{settings.name}_DELAY"))),
            pulse.width.eq(file.value(getattr(r, f"{settings.name}_WIDTH"))),
            getattr(self, f"trigger_{arm}").eq(pulse.level),
            getattr(self, f"direction_{arm}").eq(file.field(settings, "direction")),
            check.strobe.eq(strobe.edge),
            check.enable.eq(file.field(settings, "strobe")),
            check.clear.eq(self.commands.arm),
            check.pulse.eq(pulse.begin),
        ]
        for register, counter in (
            ("SEEN", check.seen),
            ("MISSED", check.missed),
            ("UNEXPECTED", check.unexpected),
        ):
            m.d.comb += file.value(getattr(r, f"STROBE_{arm.upper()}_{register}")).eq(counter)
        return check

    def _status(self, m: Module) -> None:
        file, commands, timestamp = self.file, self.commands, self.timestamp
        field, value = file.field, file.value
        m.d.comb += [
            timestamp.edge.eq(self.pps_input.edge),
            field(r.STATUS, "state").eq(commands.state),
            field(r.STATUS, "busy").eq(self.code.busy),
            field(r.STATUS, "code_checked").eq(self.code.checked & ~self.code.busy),
            field(r.STATUS, "clock_locked").eq(self.locked.level),
            field(r.STATUS, "clock_external").eq(self.clock_external),
            field(r.STATUS, "pps_seen").eq(timestamp.pps_seen),
            field(r.STATUS, "scene_gate").eq(self.scene.level),
            field(r.STATUS, "external_arm").eq(self.arm.level ^ self.arm.inverted),
            field(r.STATUS, "end_reason").eq(Mux(commands.state == r.State.ENDED, commands.reason, 0)),
            value(r.REJECT).eq(Cat(commands.reject, commands.reject_address)),
            value(r.CURRENT_RUN).eq(commands.current),
            value(r.TIME).eq(timestamp.now),
            value(r.PPS_TIME).eq(timestamp.pps_time),
            value(r.PPS_COUNT).eq(timestamp.pps_count),
        ]
        # Counted, since even a loss that is over before the host reads the status has spoilt the run.
        losses = field(r.STATUS, "clock_losses")
        was_locked = Signal()
        m.d.sync += was_locked.eq(self.locked.level)
        with m.If(was_locked & ~self.locked.level):
            m.d.sync += losses.eq(losses + 1)
        with m.If(self.deframer.bad):
            m.d.sync += value(r.RX_ERRORS).eq(value(r.RX_ERRORS) + 1)
        with m.If(commands.arm):
            m.d.sync += [value(r.START_TIME).eq(0), value(r.LINES).eq(0)]
        with m.Elif(self.timing.line):
            m.d.sync += value(r.LINES).eq(self.timing.line_number + 1)
            with m.If(self.timing.line_number == 0):
                m.d.sync += value(r.START_TIME).eq(timestamp.now)

    def _tags(self, m: Module) -> None:
        file, timing, tagger, queue = self.file, self.timing, self.tagger, self.tag_queue
        peak = file.field(r.TAG_FIFO, "peak")
        m.d.comb += [
            tagger.run.eq(self.commands.current),
            tagger.interval.eq(file.value(r.TAG_INTERVAL)),
            tagger.clear.eq(self.commands.arm),
            tagger.now.eq(self.timestamp.now),
            tagger.line.eq(timing.line),
            tagger.line_number.eq(timing.line_number),
            tagger.code_index.eq(timing.code_index),
            tagger.external.eq(self.commands.external),
            tagger.full.eq(queue.full),
            tagger.events.eq(
                self.commands.last
                | self._event(TagFlag.PPS, self.pps_input.edge & timing.running)
                | self._event(TagFlag.MISSED_A, self.camera_a.first_missed)
                | self._event(TagFlag.MISSED_B, self.camera_b.first_missed)
                | self._event(TagFlag.UNEXPECTED_A, self.camera_a.first_unexpected)
                | self._event(TagFlag.UNEXPECTED_B, self.camera_b.first_unexpected)
            ),
            queue.put.eq(tagger.put),
            queue.data.eq(tagger.entry),
            file.value(r.TAG_COUNT).eq(tagger.count),
            file.value(r.TAG_LOST).eq(tagger.lost),
            file.field(r.TAG_FIFO, "fill").eq(queue.level),
        ]
        wiring.connect(m, queue.output, self.host.tags)
        with m.If(self.commands.arm):
            m.d.sync += peak.eq(0)
        with m.Elif(queue.level > peak):
            m.d.sync += peak.eq(queue.level)

    def _event(self, flag: TagFlag, happens: object) -> object:
        return Mux(happens, int(flag), 0)
