"""Sources of the lines that ``acquire camera live`` shows: the daemon's rings, or the cameras themselves."""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Protocol

from acquire.camera.gauge import Gauge
from acquire.camera.live import TURN_S, ImagePart, LiveCamera
from acquire.cli.camera_bench import OPEN_S, CameraBench
from acquire.daemon.states import State, refusal
from acquire.errors import NoDaemonError, StateError, UsageError
from acquire.lines import ARMS
from acquire.stream.peek import Peek

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self

    from acquire.camera.gauge import Reading
    from acquire.client import Client
    from acquire.daemon.options import LightCode

LATE_S = 1.0
"""A camera that delivers no readings for this time is shown as one without lines."""
MOST_BLOCKS = 4096
"""Largest number of blocks read in one turn; the rest are read in the next one."""
ASK_S = 1.0
"""Time between two checks that the daemon is still armed."""


class LiveSource(Protocol):
    """A context manager that reads lines while it is entered.

    ``names`` maps each arm to the serial number of its camera; ``where`` describes the source.
    """

    names: dict[str, str]
    where: str

    def take(self) -> dict[str, Reading]:
        """Wait for the next readings and return them by arm. An arm without readings is absent."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class CameraSource:
    """The cameras themselves, opened while this is entered, with the rig's trigger running."""

    def __init__(self, bench: CameraBench, serial: str | None) -> None:
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

    def __enter__(self) -> CameraSource:
        self._end.enter_context(self._bench)
        try:
            for serial, views in self._views().items():
                camera = LiveCamera(f"camera {serial}", self._bench.opener(serial), views, OPEN_S)
                # At once: what is opened so far is closed if the next camera fails.
                self._end.callback(camera.close)
                self._cameras.append(camera)
                self.names |= dict.fromkeys(views, serial)
            self._bench.pulse()
            for camera in self._cameras:
                while camera.take(0.0):
                    pass  # discard readings from before the first line
        # `with` does not call `__exit__` if `__enter__` raises.
        except BaseException:
            self._end.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end.close()

    def _views(self) -> dict[str, dict[str, ImagePart]]:
        """Map serial numbers to the views of that camera, by arm."""
        config = self._bench.config
        if config is None:
            assert self._serial is not None  # otherwise `open_source` has found a daemon or a rig
            return {self._serial: {"camera": ImagePart()}}
        arms = ARMS if self._serial is None else self._bench.arms(self._serial)
        views: dict[str, dict[str, ImagePart]] = {}
        for arm in arms:
            camera = config.cameras.arm(arm)
            view = ImagePart(config.columns.get(arm), camera.black_level_dn, camera.white_dn)
            # One camera may carry both arms (layout `compact`): it is opened once, and read in two views.
            views.setdefault(camera.serial, {})[arm] = view
        return views


class RingSource:
    """The lines in the daemon's rings. The daemon never waits for this reader; it ends when that disarms."""

    def __init__(self, client: Client, serial: str | None) -> None:
        """Raises StateError if the daemon is not armed, UsageError if its rig has no such camera."""
        from acquire.web.places import shape_of

        status, setup, rings = client.status(), client.setup(), client.rings()
        if status.state is State.FAULTED:
            raise refusal("no lines are arriving while the daemon is faulted", status.state, status.fault)
        if not rings.arms:
            raise StateError(
                f"the daemon is {status.state}, so that no lines are arriving",
                possible="armed or recording",
                hint="acquire arm, or --config RIG to open the cameras without the daemon",
            )
        serials = {arm: str(setup.config["cameras"][arm]["serial"]) for arm in ARMS}
        if serial is not None and serial not in serials.values():
            raise UsageError(
                f"the rig has no camera {serial!r}", possible=", ".join(dict.fromkeys(serials.values()))
            )
        self._client, self._run_id = client, rings.run_id
        self._asked_s = time.monotonic()
        self.names = {arm: name for arm, name in serials.items() if serial in (None, name)}
        self.where = f"lines of the daemon, which is {status.state}"
        self._gauges = {
            arm: Gauge(setup.black_dn[arm], setup.white_dn) for arm in rings.arms if arm in self.names
        }
        self._peeks: dict[str, Peek] = {}
        with ExitStack() as undo:  # closes the first if the second cannot be opened
            for arm in self._gauges:
                self._peeks[arm] = Peek(arm, rings.arms[arm].path, shape_of(rings.arms[arm]))
                undo.callback(self._peeks[arm].close)
            undo.pop_all()

    def take(self) -> dict[str, Reading]:
        time.sleep(TURN_S)
        if time.monotonic() > self._asked_s + ASK_S:
            self._asked_s = time.monotonic()
            # The memory of a disarmed run stays mapped here, but nothing more comes into it.
            if self._client.rings().run_id != self._run_id:
                raise StateError("the daemon was disarmed, so no more lines are arriving", hint="acquire arm")
        for arm, peek in self._peeks.items():
            gauge = self._gauges[arm]
            for _ in range(MOST_BLOCKS):
                block = peek.next()
                if block is None:
                    break
                measured = gauge.look(block.pixels, block.flags, sum(loss.count for loss in block.losses))
                del block  # the daemon may overwrite it at any moment
                if peek.took():  # it was not overwritten while it was measured
                    gauge.keep(measured)
        return {arm: gauge.take() for arm, gauge in self._gauges.items()}

    def __enter__(self) -> RingSource:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for peek in self._peeks.values():
            peek.close()


def open_source(config: str | None, serial: str | None, code: LightCode | None, client: Client) -> LiveSource:
    """Return the cameras of a rig file if one is given, else the daemon's, else one of the environment's."""
    if config is not None:
        return CameraSource(CameraBench(config, code or "rig"), serial)
    try:
        client.status()
    except NoDaemonError as error:
        if serial is None:
            raise NoDaemonError(
                error.message, hint="acquire serve, or --config RIG to open the cameras"
            ) from error
        # Without a rig, the cameras are those of the environment's producers, which only a serial number
        # tells apart.
        return CameraSource(CameraBench(None), serial)
    if code is not None:
        raise UsageError(
            "--code cannot change the light while the daemon uses the cameras",
            hint=f"acquire arm --code {code}",
        )
    return RingSource(client, serial)
