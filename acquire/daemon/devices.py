"""The devices of the latest run that was armed: what each of them said of itself."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

from acquire.calibrate.exposure import camera_of
from acquire.daemon.facts import DeviceFacts
from acquire.trigger.driver import TriggerDriver

if TYPE_CHECKING:
    from collections.abc import Mapping

    from acquire.trigger.base import Trigger


class KnownDevices:
    """Kept beyond the end of the run. The devices' thread notes them, and any thread reads them."""

    def __init__(self) -> None:
        self._facts: tuple[DeviceFacts, ...] = ()

    @property
    def facts(self) -> list[DeviceFacts]:
        """Trigger and cameras; empty before the first run."""
        return list(self._facts)

    def note(self, trigger: Trigger, cameras: Mapping[str, Mapping[str, Any]]) -> None:
        """Note the devices of a run that was armed; ``cameras`` are `acquire.stream.Capture.cameras`.

        A device that does not say what it is has only its name: that must not end a run.
        """
        found = [_trigger(trigger)]
        for arm, facts in sorted(cameras.items()):
            said = facts.get("identity", {})
            known = {key: str(said.get(key, "")) for key in ("vendor", "model", "serial", "firmware")}
            found.append(DeviceFacts(device=f"camera {arm}", settings=camera_of(facts), **known))
        self._facts = tuple(found)


def _trigger(trigger: Trigger) -> DeviceFacts:
    known: dict[str, str] = {}
    # Nothing is asked of the device here, but a driver may be somebody else's.
    with contextlib.suppress(Exception):
        said = trigger.identify()
        known = {"model": said.model, "serial": said.serial, "firmware": said.firmware}
        if isinstance(trigger, TriggerDriver):
            device = trigger.device()
            known |= {"board": device.capabilities.board, "port": device.link.transport.name}
    return DeviceFacts(device="trigger", **known)
