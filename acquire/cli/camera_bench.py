"""Cameras on the bench: those of a rig, with its trigger, or one found through GenTL producers."""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import TYPE_CHECKING

from acquire.errors import TriggerError, UsageError

if TYPE_CHECKING:
    from acquire.camera.base import CameraOpener
    from acquire.config import RigConfig
    from acquire.daemon.options import LightCode
    from acquire.rig import Rig

OPEN_S = 60.0
_LISTEN_S = 0.2


class CameraBench:
    """A rig under inspection; without a rig file, any camera that the environment's GenTL producers show."""

    def __init__(self, config: str | None, code: LightCode = "rig") -> None:
        from acquire.config import load_rig
        from acquire.daemon.plan import with_code

        self.config: RigConfig | None = with_code(load_rig(config), code) if config else None
        self._rig: Rig | None = None
        self._ending = threading.Event()
        self._listener = threading.Thread(target=self._listen, name="acquire-look-trigger", daemon=True)

    @property
    def line_rate_hz(self) -> float:
        # A guess for a camera with a trigger of its own, from which only time limits follow.
        return self.config.line_rate_hz if self.config else 1000.0

    def opener(self, serial: str) -> CameraOpener:
        if self._rig is None or self.config is None:
            from acquire.camera.harvesters import HarvestersOpener
            from acquire.camera.spec import GenicamSpec

            return HarvestersOpener(GenicamSpec(serial))
        return self._rig.openers()[self.arms(serial)[0]]

    def arms(self, serial: str) -> list[str]:
        """Return the arms of the rig's camera with this serial number. Raises UsageError if there is none."""
        from acquire.lines import ARMS

        assert self.config is not None
        serials = {arm: self.config.cameras.arm(arm).serial for arm in ARMS}
        if serial not in serials.values():
            raise UsageError(
                f"the rig has no camera {serial!r}", possible=", ".join(dict.fromkeys(serials.values()))
            )
        return [arm for arm in ARMS if serials[arm] == serial]

    def pulse(self) -> None:
        """Start the rig's trigger. A camera without a rig has its own trigger."""
        if self._rig is not None and self.config is not None:
            from acquire.daemon.plan import trigger_run

            self._rig.trigger.prepare(trigger_run(self.config, "look"))
            self._rig.trigger.start()
            self._listener.start()

    def _listen(self) -> None:
        """Read the trigger's tags, which keeps its watchdog from ending the run.

        A broken link is not reported here: the camera then delivers no lines.
        """
        assert self._rig is not None
        with suppress(TriggerError):
            while not self._ending.wait(_LISTEN_S):
                self._rig.trigger.tags(_LISTEN_S)

    def __enter__(self) -> CameraBench:
        if self.config is not None:
            from acquire.rig import Rig

            self._rig = Rig(self.config)
        return self

    def __exit__(self, *_: object) -> None:
        # The thread first: it reads from the trigger that is closed below.
        self._ending.set()
        # A thread that was never started cannot be joined.
        if self._listener.ident is not None:
            self._listener.join(OPEN_S)
        if self._rig is not None:
            self._rig.close()
