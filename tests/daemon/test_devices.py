"""What the devices said of themselves when they were armed is known afterwards."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, cast

from fake_run import FakeRun, rig_config

from acquire.daemon.devices import KnownDevices
from acquire.daemon.local import Local
from acquire.daemon.service import Service
from acquire.rig import Rig

if TYPE_CHECKING:
    from acquire.trigger.base import Trigger

CAMERA = {"vendor": "maker", "model": "TDI 16k", "serial": "S-1", "firmware": "2.3"}


class Silent:
    """Somebody else's trigger, whose driver has a defect."""

    def identify(self) -> None:
        raise RuntimeError("oops")


def test_a_device_has_what_it_said_of_itself(tmp_path: Path) -> None:
    known = KnownDevices()
    assert known.facts == []
    with contextlib.closing(Rig(rig_config(tmp_path))) as rig:
        known.note(rig.trigger, {"b": {"identity": CAMERA, "Width": 8, "Gain": 2.0}, "a": {}})
        trigger, a, b = known.facts
        assert (trigger.device, trigger.port) == ("trigger", "simulated trigger")
        assert trigger.board in trigger.model
        assert trigger.firmware == rig.trigger.identify().firmware != ""
    assert (a.device, a.model, a.serial) == ("camera a", "", "")
    assert b.model_dump(include=set(CAMERA)) == CAMERA
    assert (a.settings, b.settings) == ({}, {"serial": "S-1", "Gain": 2.0})


def test_a_driver_that_cannot_say_what_it_drives_ends_no_run() -> None:
    known = KnownDevices()
    known.note(cast("Trigger", Silent()), {"a": {"identity": CAMERA}})
    assert [(one.device, one.serial) for one in known.facts] == [("trigger", ""), ("camera a", "S-1")]


async def _run(work: object) -> None: ...


def test_the_setup_has_them(tmp_path: Path) -> None:
    known = KnownDevices()
    api = Local(Service(rig_config(tmp_path), lambda _: FakeRun()), _run, devices=known)
    assert asyncio.run(api.setup()).devices == []
    known.note(cast("Trigger", Silent()), {"a": {"identity": CAMERA}})
    assert [one.serial for one in asyncio.run(api.setup()).devices] == ["", "S-1"]
