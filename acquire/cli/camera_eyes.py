"""Whose lines ``acquire camera live`` looks at: the daemon's, whatever it does, or the cameras' own."""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Protocol

from acquire.camera.gauge import Gauge
from acquire.camera.live import TURN_S, LiveCamera, View
from acquire.cli.camera_bench import OPEN_S, Bench
from acquire.errors import NoDaemonError, StateError, UsageError
from acquire.lines import ARMS
from acquire.stream.peek import Peek

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self

    from acquire.camera.gauge import Reading
    from acquire.client import Client
    from acquire.daemon.facts import Setup
    from acquire.daemon.messages import LightCode

LATE_S = 1.0
"""A camera that tells nothing for so long is shown as one without lines."""
MOST_BLOCKS = 4096
"""Looked at in one turn; the rest waits for the next."""
ASK_S = 1.0
"""Between two questions whether the daemon still has the cameras."""


class Eyes(Protocol):
    """A context manager that looks while it is entered. ``names``: arm → the camera's serial number."""

    names: dict[str, str]
    where: str

    def take(self) -> dict[str, Reading]:
        """The next readings, by arm; waits for them. An arm without any is absent."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class CameraEyes:
    """The cameras themselves, opened for as long as this lasts; the rig's trigger runs meanwhile."""

    def __init__(self, bench: Bench, serial: str | None) -> None:
        self._bench, self._serial = bench, serial
        self._cameras: list[LiveCamera] = []
        self._end = ExitStack()
        self.names: dict[str, str] = {}
        self.where = "the cameras themselves"

    def take(self) -> dict[str, Reading]:
        found: dict[str, Reading] = {}
        for camera in self._cameras:
            found |= camera.take(LATE_S)
        return found

    def __enter__(self) -> CameraEyes:
        self._end.enter_context(self._bench)
        try:
            for serial, views in self._wanted().items():
                camera = LiveCamera(f"camera {serial}", self._bench.opener(serial), views, OPEN_S)
                self._end.callback(camera.close)
                self._cameras.append(camera)
                self.names |= dict.fromkeys(views, serial)
            self._bench.pulse()
            for camera in self._cameras:
                while camera.take(0.0):
                    pass  # from before the first line
        except BaseException:
            self._end.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end.close()

    def _wanted(self) -> dict[str, dict[str, View]]:
        """Serial number → what is looked at of that camera, by arm."""
        config = self._bench.config
        if config is None:
            assert self._serial is not None  # else there would be a daemon, or a rig
            return {self._serial: {"camera": View()}}
        asked = ARMS if self._serial is None else self._bench.arms(self._serial)
        wanted: dict[str, dict[str, View]] = {}
        for arm in asked:
            camera = config.cameras.arm(arm)
            view = View(config.columns.get(arm), camera.black_level_dn, camera.white_dn)
            wanted.setdefault(camera.serial, {})[arm] = view
        return wanted


class RingEyes:
    """What the daemon's rings pass on: nobody waits for who looks. Ends where the daemon disarms."""

    def __init__(self, client: Client, serial: str | None) -> None:
        """Raises StateError where the daemon has no cameras open."""
        from acquire.web.places import shape_of

        status, setup, rings = client.status(), client.setup(), client.rings()
        if not rings.arms:
            raise StateError(
                f"the daemon is {status.state}: no lines come",
                possible="armed or recording",
                hint="acquire arm, or --config RIG to look at the cameras without the daemon",
            )
        self._client, self._run_id = client, rings.run_id
        self._asked_s = time.monotonic()
        self.names = _named(setup, serial)
        self.where = f"the daemon's, which is {status.state}"
        self._gauges = {
            arm: Gauge(setup.black_dn[arm], setup.white_dn) for arm in rings.arms if arm in self.names
        }
        self._peeks: dict[str, Peek] = {}
        with ExitStack() as undo:
            for arm in self._gauges:
                self._peeks[arm] = Peek(arm, rings.arms[arm].path, shape_of(rings.arms[arm]))
                undo.callback(self._peeks[arm].close)
            undo.pop_all()

    def take(self) -> dict[str, Reading]:
        time.sleep(TURN_S)
        if time.monotonic() > self._asked_s + ASK_S:
            self._asked_s = time.monotonic()
            if self._client.rings().run_id != self._run_id:
                raise StateError("the daemon has disarmed: no more lines come", hint="acquire arm")
        for arm, peek in self._peeks.items():
            self._drain(peek, self._gauges[arm])
        return {arm: gauge.take() for arm, gauge in self._gauges.items()}

    def _drain(self, peek: Peek, gauge: Gauge) -> None:
        for _ in range(MOST_BLOCKS):
            block = peek.next()
            if block is None:
                return
            seen = gauge.look(block.pixels, block.flags, sum(loss.count for loss in block.losses))
            del block  # it may be overwritten at any moment
            if peek.took():
                gauge.keep(seen)

    def __enter__(self) -> RingEyes:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for peek in self._peeks.values():
            peek.close()


def eyes_of(config: str | None, serial: str | None, code: LightCode | None, client: Client) -> Eyes:
    """Where to look: a rig's cameras if a file is named, else the daemon's, else one of the environment's."""
    if config is not None:
        return CameraEyes(Bench(config, code or "rig"), serial)
    try:
        client.status()
    except NoDaemonError as error:
        if serial is None:
            raise NoDaemonError(
                error.message, hint="acquire serve, or --config RIG to open the cameras"
            ) from error
        return CameraEyes(Bench(None), serial)
    if code is not None:
        raise UsageError(
            "--code cannot change the light of cameras that the daemon has", hint=f"acquire arm --code {code}"
        )
    return RingEyes(client, serial)


def _named(setup: Setup, serial: str | None) -> dict[str, str]:
    serials = {arm: str(setup.config["cameras"][arm]["serial"]) for arm in ARMS}
    if serial is not None and serial not in serials.values():
        raise UsageError(
            f"the rig has no camera {serial!r}", possible=", ".join(dict.fromkeys(serials.values()))
        )
    return {arm: name for arm, name in serials.items() if serial in (None, name)}
