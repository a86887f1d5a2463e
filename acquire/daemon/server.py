"""The daemon's process: socket, signals, supervision, and the order in which everything ends.

The event loop answers requests; one thread owns the devices, so that commands and supervision run one after
the other and a slow device never delays the status. A signal always ends the process: in order if possible,
by force if a thread hangs (`acquire.daemon.ending`).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, TypeVar

from acquire.daemon.beginning import begin
from acquire.daemon.connections import ApiServer, raise_descriptor_limit
from acquire.daemon.control import build_app
from acquire.daemon.devices import KnownDevices
from acquire.daemon.disk_watch import disk_watch
from acquire.daemon.ending import END_S, LastResort, leave
from acquire.daemon.endpoint import Endpoint
from acquire.daemon.hooks import Hooks
from acquire.daemon.journal import journal_path, only_user
from acquire.daemon.local import Local
from acquire.daemon.messages import ArmRequest
from acquire.daemon.notify import notify
from acquire.daemon.page import Page
from acquire.daemon.plan import Run, armed_as, worker_modules
from acquire.daemon.proof import Proof
from acquire.daemon.reachable import stay_reachable
from acquire.daemon.reload import Reloading
from acquire.daemon.salvage import Salvage
from acquire.daemon.service import Service
from acquire.daemon.states import State
from acquire.daemon.troubles import Troubles
from acquire.daemon.uploads import Uploads
from acquire.daemon.who import WHO
from acquire.errors import EXIT_INTERRUPTED, AcquireError, BusyError, StateError
from acquire.processes.nursery import nursery, warm_up
from acquire.rig import Rig, check_rig

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.config import RigConfig

SUPERVISE_S = 0.2
"""Time between two checks of the capture path."""
DRAIN_S = 0.05
"""The same while a recording is being sealed."""
COMMAND_S = 60.0
"""Time for the current command when the daemon gets a signal to end, such as `arm` on a busy host."""
WATCHDOG_S = 0.5
"""Time between two watchdog messages to systemd: `WatchdogSec` has to be several times as long."""
MOST_WAITING = 8
"""Number of commands that may wait for the current one; each holds a connection."""

log = logging.getLogger("acquire.daemon")
T = TypeVar("T")


def serve(config: RigConfig, origin: str = "", reread: Callable[[], RigConfig] | None = None) -> int:
    """Own the devices of ``config``, read from the file ``origin``, until a signal; return the exit code.

    ``reread`` reads the configuration again. Raises StateError if another daemon has the socket, or the lists
    of this rig's recordings, before any device is touched.
    """
    raise_descriptor_limit()
    troubles = Troubles()
    threading.excepthook = troubles.in_thread
    directory = config.recording.directory.absolute()
    with (
        contextlib.closing(Endpoint(config.control.socket.absolute())) as endpoint,
        only_user(directory, config.name) as claim,
        Rig(config) as rig,
    ):
        # First: it imports modules while the rest begins, so that the first `arm` need not wait for it.
        warm_up(*worker_modules(rig))
        salvage = Salvage(directory, journal_path(directory, config.name, "recordings"))
        salvage.search()
        journal = journal_path(directory, config.name, "uploads")
        uploads = Uploads(config.recording.upload_to, journal, config.recording.reserve_bytes)
        uploads.begin()
        proof, devices = Proof(config), KnownDevices()

        def open_run(request: ArmRequest) -> Run:
            # Not the outer `config`: the service's may have been reloaded.
            config = armed_as(service.config, request)
            check_rig(config)
            return Run(config, rig, proof.choose, devices, request.code)

        service = Service(
            config,
            open_run,
            prove=proof,
            salvage=salvage,
            uploads=uploads,
            troubles=troubles,
            disk=disk_watch(config, claim),
        )
        service.origin = origin
        page, hooks = Page(endpoint.path), Hooks(config.hooks, service.news, config.name)
        reloading = None if reread is None else Reloading(reread, service, hooks)
        # Closed after the loop has ended, so that the last news still reach the hooks.
        with contextlib.closing(page), contextlib.closing(hooks):
            code = asyncio.run(Daemon(service, endpoint, page, reloading, devices).run())
        last_resort = LastResort(endpoint.remove)
        last_resort.within(END_S)  # for devices that do not close
    last_resort.cancel()
    return leave(code)


def ends_with_terminal() -> bool:
    """Return whether SIGHUP means that the terminal of this process was closed, and so ends it.

    It does not without a controlling terminal, nor if it was ignored when this process was started (nohup).
    """
    if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
        return False
    try:
        os.close(os.open("/dev/tty", os.O_RDWR | os.O_NOCTTY))
    except OSError:
        return False
    return True


class Daemon:
    """One service on one endpoint, for the life of an event loop in the main thread."""

    def __init__(
        self,
        service: Service,
        endpoint: Endpoint,
        page: Page | None = None,
        reloading: Reloading | None = None,
        devices: KnownDevices | None = None,
    ) -> None:
        self._service = service
        self._api = Local(service, self._command, reloading, devices)
        self._hangup_reloads = reloading is not None and not ends_with_terminal()
        self._hung_up: asyncio.Task[None] | None = None
        self._page = page
        self._endpoint = endpoint
        self._troubles = service.troubles
        self._devices = ThreadPoolExecutor(1, thread_name_prefix="devices")
        self._waiting = 0
        self._begun_s: float | None = None
        self._ending = asyncio.Event()
        self._last_resort = LastResort(endpoint.remove)
        self._exit_code = 0
        self._server = ApiServer(build_app(self._api), endpoint.socket)

    async def run(self) -> int:
        """Serve until a signal; return the exit code."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            loop.add_signal_handler(number, self._on_signal, number)
        loop.set_exception_handler(self._troubles.in_loop)
        serving = asyncio.create_task(self._server.answer())
        # READY=1 only once requests are answered: a daemon that reports it to systemd, and then cannot load
        # its modules, would never be restarted.
        answering = asyncio.create_task(self._server.answering.wait())
        await asyncio.wait((serving, answering), return_when=asyncio.FIRST_COMPLETED)
        answering.cancel()
        if self._server.answering.is_set():  # otherwise `serving` has the error
            log.info("listening on %s (process %d)", self._endpoint.path, os.getpid())
            notify("READY=1")
        watchdog = asyncio.create_task(self._feed_watchdog())
        beginning = asyncio.create_task(begin(self._service.config.service, self._service, self._command))
        reachable = asyncio.create_task(
            stay_reachable(self._endpoint, self._server, self._service.news, self._troubles)
        )
        try:
            await self._supervise(serving)
        finally:
            beginning.cancel()
            reachable.cancel()
            await self._end(serving)
            watchdog.cancel()
            self._last_resort.cancel()
        return self._exit_code

    async def _supervise(self, serving: asyncio.Task[None]) -> None:
        while not (self._ending.is_set() or serving.done()):
            try:
                if self._page is not None:
                    self._page.poll(self._service.config)
                nursery()  # restarts it if it has died: the next run must not wait for its imports
                await self._in_device_thread(self._service.supervise)
            except Exception as error:  # noqa: BLE001 - a defect in one step must not end the service
                self._troubles.note("supervision", error)
            draining = self._service.status().state is State.DRAINING
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._ending.wait(), DRAIN_S if draining else SUPERVISE_S)

    async def _feed_watchdog(self) -> None:
        """Send watchdog messages to systemd, while there is no command, or the current one makes progress."""
        while True:
            begun_s = self._begun_s
            moved_s = max(begun_s or 0.0, self._service.moved_s)
            if begun_s is None or time.monotonic() - moved_s < self._service.patience_s:
                notify("WATCHDOG=1")
            await asyncio.sleep(WATCHDOG_S)

    async def _end(self, serving: asyncio.Task[None]) -> None:
        """Seal and release first, while the status is still answered; then close the API."""
        self._ending.set()
        notify("STOPPING=1")
        patience = asyncio.create_task(self._wait_for_the_disk())
        try:
            await self._in_device_thread(self._service.shutdown)
        finally:
            patience.cancel()
            # Only now: until here those who follow the news see how the recording is sealed.
            self._service.news.close()
            self._server.should_exit = True
            try:
                await serving
            finally:
                self._devices.shutdown()
        log.info("ended")

    async def _wait_for_the_disk(self) -> None:
        """Grant a recording that is being sealed more time, as long as it makes progress on disk."""
        known = None
        while not self._service.hurried:
            now = self._service.status().recording
            if now is not None and now != known:
                known = now
                self._last_resort.within(END_S + self._service.patience_s)
            await asyncio.sleep(SUPERVISE_S)

    async def _command(self, work: Callable[[], None]) -> None:
        if self._ending.is_set():
            raise StateError("the daemon is ending", possible="status")
        # One more than may wait, since one of them is being carried out.
        if self._waiting > MOST_WAITING:
            raise BusyError(f"{MOST_WAITING} commands are waiting already", possible="status")
        self._waiting += 1
        try:
            await self._in_device_thread(work)
        finally:
            self._waiting -= 1

    async def _in_device_thread(self, work: Callable[[], T]) -> T:
        def timed() -> T:
            self._begun_s = time.monotonic()  # from here on the watchdog demands progress
            try:
                return work()
            finally:
                self._begun_s = None

        return await asyncio.get_running_loop().run_in_executor(self._devices, timed)

    async def _reload(self) -> None:
        WHO.set(signal.SIGHUP.name)
        with contextlib.suppress(AcquireError):  # reported in the log and the news
            await self._api.reload()

    def _on_signal(self, number: signal.Signals) -> None:
        if number is signal.SIGHUP and self._hangup_reloads:
            if self._hung_up is None or self._hung_up.done():
                self._hung_up = asyncio.create_task(self._reload())
            return
        if self._ending.is_set():
            self._service.hurry()
            self._last_resort.within(END_S)
            log.warning("%s again: ending without waiting for lines on the way", number.name)
            return
        # The devices have one thread: the shutdown cannot begin before the current command has ended.
        busy = self._service.status().busy is not None
        self._last_resort.within(END_S + (COMMAND_S if busy else 0.0))
        log.info("%s: ending", number.name)  # only now: a log that takes no text holds this thread up
        self._exit_code = EXIT_INTERRUPTED if number is signal.SIGINT else 0
        self._ending.set()
