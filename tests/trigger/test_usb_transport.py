"""The USB transport over a stand-in for libusb: missing devices, and permissions that are missing."""

from __future__ import annotations

import errno

import pytest
import usb.core
from fake_bus import FakeBus
from trigger_twins import run, wired_model

from acquire.config.device import TriggerConfig
from acquire.errors import TriggerError
from acquire.trigger.driver import TriggerDriver
from acquire.trigger.transports.usb import FoundDevice, UsbTransport, list_devices


def test_the_driver_runs_over_usb_and_reports_an_unplugged_cable() -> None:
    with wired_model() as model:
        bus = FakeBus(model)
        driver = TriggerDriver(lambda: UsbTransport(serial="42", backend=bus), TriggerConfig())
        driver.prepare(run())
        driver.start()
        assert bus.claimed == 1
        assert driver.tags(5.0)[0].line == 0
        bus.gone = True
        with pytest.raises(TriggerError, match="usb 1209:0001 42 was unplugged"):
            driver.device().status()
        bus.gone = False
        assert "run 'run' is running" in str(driver.reopen())
        assert driver.stop() > 0
        driver.close()
        assert bus.claimed == 0


def test_a_missing_usb_device_is_reported_with_those_present() -> None:
    with wired_model() as model:
        with pytest.raises(TriggerError, match="usb 1209:0001 7 is not on the bus; possible: 42"):
            UsbTransport(serial="7", backend=(bus := FakeBus(model)))
        assert bus.open == 0
        with pytest.raises(TriggerError, match="no device of this kind"):
            UsbTransport(backend=FakeBus(model, product=2))
        UsbTransport(backend=FakeBus(model)).close()


@pytest.mark.parametrize(
    ("refusal", "hint"), [(errno.EACCES, "udev rule"), (errno.EBUSY, "another program"), (errno.EIO, "cable")]
)
def test_a_device_without_permission_suggests_a_remedy(refusal, hint) -> None:
    with wired_model() as model:
        bus = FakeBus(model)
        bus.refusal = refusal
        with pytest.raises(TriggerError, match=f"usb 1209:0001 cannot be opened: .*try: .*{hint}"):
            UsbTransport(backend=bus)
        bus.refusal = None
        assert bus.open == 0  # the handle of a device that could not be claimed stayed open
        UsbTransport(backend=bus).close()  # the lock was let go
        assert bus.open == 0


def test_triggers_on_the_bus_are_listed_with_obstacles(monkeypatch) -> None:
    with wired_model() as model:
        bus = FakeBus(model)
        assert list_devices(bus) == [FoundDevice("usb 1209:0001", "42", "")]
        assert list_devices(FakeBus(model, product=2)) == []
        bus.refusal = errno.EACCES
        (found,) = list_devices(bus)
        assert found.serial == ""
        assert "udev rule" in found.lacks


def test_without_libusb_the_error_says_what_is_missing(monkeypatch) -> None:
    def find(**wanted):
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(usb.core, "find", find)
    with pytest.raises(TriggerError, match="No backend available; try: install libusb"):
        UsbTransport()
    with pytest.raises(TriggerError, match="libusb is not installed"):
        list_devices()
