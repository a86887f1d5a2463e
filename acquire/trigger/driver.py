"""The driver of the sync trigger, the same for all transports and twins.

::

    prepare   handshake → limits checked → registers written, read back, compared → ARM
    start     clocks compared → START → the tick of line 0
    stop      STOP → the last line ends → lines counted

Nothing is opened before it is needed. When the link dies, TriggerError is raised at once in all waiting
calls, and in every later call except three: `prepare` and `stop` reconnect automatically, since the light may
still be flashing; `reopen` reconnects and reports the state of the run.

The device's watchdog (``trigger.watchdog_s``) watches every run from its first clock. Requests reset it:
`start` sends them until line 0 has begun, and `tags` whenever they are due, so the light stays on only while
somebody takes the tags. If the host hangs, dies, is unplugged, or has called `release`, the run ends after
``watchdog_s`` and the current line, with the reason WATCHDOG. `stop` and `close` end it at once. An armed run
without its host stays armed, and dark; if an external edge starts it, the watchdog ends it.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from hashlib import blake2b
from typing import TYPE_CHECKING, Any

from acquire.clock import NS_PER_S, ClockFit
from acquire.errors import TriggerError
from acquire.trigger import registers as r
from acquire.trigger.base import LineTag, TagEvent, TriggerIdentity
from acquire.trigger.device import ANSWER_S, UNANSWERED, Device, DeviceStatus
from acquire.trigger.link import Link
from acquire.trigger.registers import Command, State
from acquire.trigger.settings import register_values
from acquire.trigger.tags import TagReader, signed_ticks

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.config.device import TriggerConfig
    from acquire.trigger.base import TriggerRun
    from acquire.trigger.transports import Transport

_DRIFT = 1e-4
"""Relative error of an ordinary oscillator: the uncertainty that grows with the age of a comparison."""
# The watchdog ends the run: on a busy host, all signs but one may be lost or late.
_SIGNS_OF_LIFE_PER_WATCHDOG = 8
_SIGN_OF_LIFE_S = 0.5
"""Longest time between two signs of life: a simulated device's time may pass faster than the host's."""


@dataclass(frozen=True, slots=True)
class Reconnection:
    """State of the run when a driver reconnects. ``str()`` gives it in words."""

    run_id: str | None
    """The run that the driver had prepared or started."""
    continues: bool
    """Whether the run is still armed, running, or about to end."""
    lines: int | None
    """Lines started in it; None if it is not the device's latest run any more."""
    status: DeviceStatus

    def __str__(self) -> str:
        if self.run_id is None:
            return f"connected; the device is {self.status}"
        if self.lines is None:
            return f"run {self.run_id!r} is over: the device was restarted, or was given another run"
        return f"run {self.run_id!r} is {self.status}"


class TriggerDriver:
    """One device behind ``open_transport``, as `acquire.trigger.base.Trigger`. Thread-safe.

    Parameters
    ----------
    open_transport : connects; called when first needed, and again after the link died
    config : the rig's configuration of the outputs
    """

    def __init__(self, open_transport: Callable[[], Transport], config: TriggerConfig) -> None:
        self._open_transport = open_transport
        self._config = config
        self._lock = threading.RLock()  # `prepare` and `close` call `stop`
        self._stopped = threading.Condition()
        self._device: Device | None = None
        self._prepared: TriggerRun | None = None
        self._run: TriggerRun | None = None
        self._tags: TagReader | None = None
        self._unstopped = 0  # number of a run that could not be stopped without a link
        self._sign_of_life_s = 0.0

    # ---- the protocol of triggers

    def identify(self) -> TriggerIdentity:
        can = self.device().capabilities
        return TriggerIdentity(f"sync trigger ({can.board})", can.serial, can.firmware, can.clock_hz)

    def prepare(self, run: TriggerRun) -> None:
        """Configure and arm. Preparing the same run again changes nothing, even while it runs."""
        with self._lock:
            device = self._connected()
            values = register_values(
                run, self._config, device.capabilities, device.link.transport.bytes_per_s
            )
            status = device.status()
            if not status.at_rest and status.run == run_number(run.run_id):
                # Started by this driver or another program: a daemon that was killed and restarted finds its
                # run alive, and may continue it.
                if run not in (self._prepared, self._run):
                    if device.configuration() != values:
                        raise TriggerError(
                            f"run {run.run_id!r} is {status}, with other settings",
                            hint="stop it, or use another run id",
                        )
                    self._prepared, self._run, self._tags = run, None, None
                return
            if not status.at_rest:
                # End a run that our stop did not reach, but no run that this driver was not asked to stop.
                if status.run != self._unstopped:
                    raise TriggerError(
                        f"run {run.run_id!r} cannot be prepared while another one runs: "
                        f"number {status.run:#018x} is {status}",
                        hint="stop it first: acquire trigger stop",
                    )
                self.stop()
            device.configure(values)
            device.command(Command.ARM, run_number(run.run_id))
            self._prepared, self._run, self._tags = run, None, None

    def start(self) -> ClockFit:
        """Start, or wait for the external start or a stop; return the fit of the device's clock to UTC."""
        with self._lock:
            run = self._prepared
            if run is None:
                raise TriggerError("a trigger cannot start without a run", hint="prepare one")
            device = self.device()
            device.link.tags(0)  # drop those of the run before
            compared = device.compare_clocks()
            external = self._config.external_start != "off"
            if not external:
                device.command(Command.START, run_number(run.run_id))
        # Without the lock from here on: `stop` must be able to end the wait for an edge that never comes.
        limit_s, hint = ANSWER_S, UNANSWERED
        if external:
            limit_s = self._config.external_timeout_s
            hint = "check what gives the external start, or give it longer: trigger.external_timeout_s"
        status = device.await_status(
            lambda status: status.lines > 0 or status.state == State.ENDED, limit_s, "start", hint=hint
        )
        if not status.lines:
            raise TriggerError(
                f"run {run.run_id!r} was stopped before its first line",
                hint="arm again; acquire trigger info shows its state and why it stopped",
            )
        start_tick = device.read(r.START_TIME)
        if external:  # the edge may have come long after the first comparison, and clocks drift
            compared = device.compare_clocks()
        with self._lock:
            self._tags = TagReader(run, run_number(run.run_id), start_tick)
            self._run, self._prepared = run, None
        # UTC of the start follows from a comparison some time before or after it. The possible drift of the
        # oscillator in between is added to the uncertainty of the comparison.
        (utc_ns, tick, uncertainty_ns), hz = compared, device.capabilities.clock_hz
        elapsed = signed_ticks(start_tick - tick)
        drift_ns = int(abs(elapsed) * NS_PER_S / hz * _DRIFT)
        return ClockFit(hz, utc_ns + elapsed * NS_PER_S // hz, uncertainty_ns + drift_ns + 1)

    def tags(self, timeout_s: float) -> list[LineTag]:
        """Return the tags of lines since the last call; a stop ends the wait, a watchdog shortens it."""
        # Without the lock, here as well: `stop` needs it, and ends both waits below.
        device, tags = self._device, self._tags
        if device is None or tags is None:
            if device is not None and device.link.dead is not None:
                raise device.link.dead
            with self._stopped:
                self._stopped.wait(timeout_s)
            return []
        try:
            if self._config.watchdog_s:
                # It has to be reset while tags are taken; any valid request does that.
                patience_s = min(self._config.watchdog_s / _SIGNS_OF_LIFE_PER_WATCHDOG, _SIGN_OF_LIFE_S)
                if time.monotonic() > self._sign_of_life_s + patience_s:
                    device.read(r.STATUS)
                    self._sign_of_life_s = time.monotonic()
                timeout_s = min(timeout_s, patience_s)
            return tags.take(device.link.tags(timeout_s))
        except TriggerError as error:
            raise TriggerError(
                f"{error.message}; its tags have reported {tags}", possible=error.possible, hint=error.hint
            ) from error

    def events(self) -> list[TagEvent]:
        return self._tags.events() if self._tags is not None else []

    def stop(self) -> int:
        """End the run after a whole line; return the number of lines. Idempotent."""
        with self._lock:
            run, self._prepared = self._run or self._prepared, None
            if self._device is None and not self._unstopped:
                return 0
            # Noted before the link is used: if it fails, the next `stop` or `prepare` ends this run.
            self._unstopped = run_number(run.run_id) if run else self._unstopped
            device = self._connected()
            # 0, any run: a device that was restarted in the meantime would refuse to stop one that it lacks.
            device.command(Command.STOP, 0)
            # The device ends after a whole line, which may take longer than any answer.
            ticks = device.line_ticks()
            status = device.await_status(lambda status: status.at_rest, ANSWER_S, "end", ticks)
            self._unstopped = 0
            # Both waits of `tags`, for the link or for a run, would wait for tags that do not come any more.
            device.link.interrupt()
            with self._stopped:
                self._stopped.notify_all()
            return status.lines

    def statistics(self) -> dict[str, Any]:
        """Return counters of device, link and driver; without a link the latest ones, and ``link_lost``."""
        device, tags = self._device, self._tags
        known = tags.statistics() if tags else dict(TagReader.NOTHING)
        if device is None:  # not connected: counting must not open the port
            return {"pulses": 0, **known}
        link = {"link": device.link.statistics()}
        if device.link.dead is not None:
            pulses = tags.lines_known if tags else 0
            return {"pulses": pulses, **known, **link, "link_lost": str(device.link.dead)}
        return {"pulses": device.read(r.LINES), **known, **device.counters(), **link}

    def close(self) -> None:
        """Stop, if the device can still be reached, and close it. Idempotent."""
        with self._lock:
            device = self._device
            try:
                if device is not None and device.link.dead is None:
                    self.stop()
            finally:
                self.release()

    # ---- further methods

    def device(self) -> Device:
        """Return the device, connecting when first needed. Raises TriggerError once the link is dead."""
        with self._lock:
            if self._device is None:
                link = Link(self._open_transport())
                try:
                    self._device = Device(link)
                except TriggerError:
                    link.close()  # its thread would go on reading, and its port would stay locked
                    raise
            if self._device.link.dead is not None:
                raise self._device.link.dead
            return self._device

    def reopen(self) -> Reconnection:
        """Reconnect, and return the state of the run. Nothing is started or stopped."""
        with self._lock:
            self.release()  # also a link that lives: its port can be opened once
            run, status = self._run or self._prepared, self.device().status()
            if run is None:
                return Reconnection(None, False, None, status)
            if status.run == run_number(run.run_id):
                return Reconnection(run.run_id, not status.at_rest, status.lines, status)
            self._run = self._prepared = self._tags = None
            return Reconnection(run.run_id, False, None, status)

    def release(self) -> None:
        """Close the link and leave the device as it is. Idempotent."""
        with self._lock:
            device, self._device = self._device, None
            if device is not None:
                device.link.close()

    def _connected(self) -> Device:
        """Return the device, replacing a dead link."""
        if self._device is not None and self._device.link.dead is not None:
            self.release()
        return self.device()


def run_number(run_id: str) -> int:
    """Return the device's 64-bit number of a run, never 0."""
    # A hash, not a count, so that it survives restarts of host and device; 0 means no run to the device.
    return int.from_bytes(blake2b(run_id.encode(), digest_size=8).digest(), "little") or 1
