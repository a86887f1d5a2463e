r"""Runs from the host's point of view: ARM, START, STOP by run id, and other ends of a run.

::

             ARM            START or edge            stop, budget, watchdog, clock lost
    IDLE ──────────▶ ARMED ───────────────▶ RUNNING ──────▶ STOPPING ──(line over)──▶ ENDED
    ENDED                └────── STOP ───────────────────────────────────────────────▶

    execute  _/‾\_______      one clock; ``command`` and ``run`` are constant from it to ``done``
    done     _____/‾\___      two clocks later, with ``error`` (0: carried out, or already so)

A command that has been carried out may be repeated: the answer is the same, and nothing changes.
"""

from amaranth.hdl import Elaboratable, Module, Mux, Signal, Value
from amaranth.lib import wiring
from amaranth.lib.wiring import In, Out

from acquire.trigger.registers import CODE_LENGTH, COMMAND, Command, EndReason, ErrorCode, State, TagFlag

SETTLE_CLOCKS = 4
"""Clocks from ARM until an edge may start the run: the code memory's first bit takes as long. A START comes
later anyway."""


class Commands(wiring.Component):
    execute: In(1)
    command: In(32)
    run: In(64)
    done: Out(1)
    error: Out(16)
    address: Out(16)
    """Address of the register at fault: one of the configuration, or COMMAND."""

    config_error: In(16)
    config_address: In(16)
    length_good: In(1)
    busy: In(1)
    """The code memory is being checked or tested, or the last tag of a run waits."""
    edge: In(1)
    """Edge of the external arm input, if enabled."""
    watchdog: In(1)
    clock_locked: In(1)
    running: In(1)
    budget: In(1)
    """The last line of the budget has started."""

    arm: Out(1)
    start: Out(1)
    stop: Out(1)
    check_code: Out(1)
    self_test: Out(1)
    state: Out(3)
    idle: Out(1)
    """No run is armed or running: the configuration may change."""
    current: Out(64)
    external: Out(1)
    reason: Out(4)
    reject: Out(16)
    reject_address: Out(16)
    last: Out(16)
    """TagFlags of the run's end, for one clock."""

    def elaborate(self, platform: object) -> Elaboratable:
        m = Module()
        pending, same, named = Signal(), Signal(), Signal()
        armed, runs, begun, over = Signal(), Signal(), Signal(), Signal()
        m.d.comb += [
            armed.eq(self.state == State.ARMED),
            runs.eq((self.state == State.RUNNING) | (self.state == State.STOPPING)),
            over.eq(begun & ~self.running),
            self.idle.eq(~armed & ~runs & ~self.busy),
        ]
        m.d.sync += [
            pending.eq(self.execute),
            same.eq((self.run == self.current) & (self.run != 0)),
            named.eq(self.run != 0),
            self.done.eq(pending),
            self.error.eq(0),
            self.address.eq(COMMAND.address),
            begun.eq(self.running),
        ]
        settling = Signal(range(SETTLE_CLOCKS + 1))
        m.d.sync += settling.eq(Mux(self.arm, SETTLE_CLOCKS, Mux(settling == 0, 0, settling - 1)))
        self._follow(m, self.edge & (settling == 0), armed, runs, over)
        asked = {command: Signal(name=f"{command.name.lower()}_asked") for command in Command}
        m.d.sync += [signal.eq(self.command == command) for command, signal in asked.items()]
        with m.If(pending):
            with m.If(asked[Command.ARM]):
                self._arm(m, named, same, armed | runs)
            with m.Elif(asked[Command.START]):
                self._start(m, same, armed)
            with m.Elif(asked[Command.STOP]):
                self._stop(m, same | ~named, armed, runs & ~over)
            with m.Elif(asked[Command.CHECK_CODE]):
                self._check(m)
            with m.Elif(asked[Command.SELF_TEST]):
                self._when_idle(m, self.self_test)
            with m.Else():
                m.d.sync += self.error.eq(ErrorCode.BAD_COMMAND)
        return m

    def _arm(self, m: Module, named: Value, same: Value, active: Value) -> None:
        with m.If(~named):
            m.d.sync += self.error.eq(ErrorCode.BAD_RUN_ID)
        # ARM of the run that is armed or runs already is the same request once more: its answer was lost.
        with m.Elif(active | self.busy):
            m.d.sync += self.error.eq(Mux(same & active, 0, ErrorCode.BUSY))
        # A late ARM must not restart a run that has ended: a run id is used once.
        with m.Elif(same):
            m.d.sync += self.error.eq(ErrorCode.RUN_OVER)
        with m.Else():
            m.d.sync += [
                self.error.eq(self.config_error),
                self.address.eq(self.config_address),
                self.reject.eq(self.config_error),
                self.reject_address.eq(self.config_address),
            ]
            with m.If(self.config_error == 0):
                m.d.comb += self.arm.eq(1)
                m.d.sync += [
                    self.state.eq(State.ARMED),
                    self.current.eq(self.run),
                    self.reason.eq(EndReason.NONE),
                    self.external.eq(0),
                ]

    def _start(self, m: Module, same: Value, armed: Value) -> None:
        with m.If(self.state == State.IDLE):
            m.d.sync += self.error.eq(ErrorCode.NOT_ARMED)
        with m.Elif(~same):
            m.d.sync += self.error.eq(ErrorCode.WRONG_RUN)
        # In any other state START has been carried out before, and changes nothing.
        with m.Elif(armed & self.clock_locked):
            m.d.comb += self.start.eq(1)
            m.d.sync += self.state.eq(State.RUNNING)

    def _stop(self, m: Module, meant: Value, armed: Value, runs: Value) -> None:
        with m.If(~meant):
            m.d.sync += self.error.eq(ErrorCode.WRONG_RUN)
        with m.Elif(armed):
            self._end(m, EndReason.STOPPED)
        with m.Elif(runs):
            self._wind_down(m, EndReason.STOPPED)

    def _check(self, m: Module) -> None:
        with m.If(self.idle & ~self.length_good):
            m.d.sync += [self.error.eq(ErrorCode.BAD_CODE_LENGTH), self.address.eq(CODE_LENGTH.address)]
        with m.Else():
            self._when_idle(m, self.check_code)

    def _when_idle(self, m: Module, what: Signal) -> None:
        with m.If(self.idle):
            m.d.comb += what.eq(1)
        with m.Else():
            m.d.sync += self.error.eq(ErrorCode.BUSY)

    def _follow(self, m: Module, edge: Value, armed: Value, runs: Value, over: Value) -> None:
        """Transitions without the host.

        A command of the same clock is assigned later and takes precedence.
        """
        with m.If(armed & edge):
            m.d.comb += self.start.eq(1)
            m.d.sync += [self.state.eq(State.RUNNING), self.external.eq(1)]
        with m.If((armed | runs) & ~self.clock_locked):
            self._wind_down(m, EndReason.CLOCK_LOST)
            with m.If(armed):
                self._end(m, EndReason.CLOCK_LOST)
        with m.Elif(runs & self.watchdog):
            self._wind_down(m, EndReason.WATCHDOG)
        with m.Elif(runs & self.budget & (self.reason == EndReason.NONE)):
            m.d.sync += [self.reason.eq(EndReason.LINE_BUDGET), self.state.eq(State.STOPPING)]
        with m.If(runs & over):
            m.d.sync += self.state.eq(State.ENDED)
            m.d.comb += self.last.eq(self._flags(self.reason))

    def _wind_down(self, m: Module, reason: EndReason) -> None:
        m.d.comb += self.stop.eq(1)
        m.d.sync += self.state.eq(State.STOPPING)
        # The first reason stays: another one during the last line is its consequence, or too late.
        with m.If(self.reason == EndReason.NONE):
            m.d.sync += self.reason.eq(reason)

    def _end(self, m: Module, reason: EndReason) -> None:
        m.d.comb += self.start.eq(0)  # an edge of the same clock comes too late
        m.d.sync += [self.state.eq(State.ENDED), self.reason.eq(reason)]
        m.d.comb += self.last.eq(self._flags(reason) | int(TagFlag.NO_LINES))

    def _flags(self, reason: Value | EndReason) -> Value:
        extra: Value = Mux(reason == EndReason.LINE_BUDGET, int(TagFlag.BUDGET), 0)
        extra |= Mux(reason == EndReason.WATCHDOG, int(TagFlag.WATCHDOG), 0)
        extra |= Mux(reason == EndReason.CLOCK_LOST, int(TagFlag.CLOCK_LOST), 0)
        return extra | int(TagFlag.LAST)
