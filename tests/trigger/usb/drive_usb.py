"""A run over pyusb, libusb-1.0 and the simulated bus; prints the events as one JSON text per line."""

from __future__ import annotations

import json
import sys

import usb.backend.libusb1
from trigger_twins import run

from acquire.config.device import TriggerConfig
from acquire.errors import TriggerError
from acquire.trigger.driver import TriggerDriver
from acquire.trigger.transports.usb import UsbTransport


def say(**facts: object) -> None:
    sys.stdout.write(json.dumps(facts) + "\n")
    sys.stdout.flush()


driver = TriggerDriver(lambda: UsbTransport(serial="42"), TriggerConfig())
say(backend=usb.backend.libusb1.get_backend().__module__, device=driver.identify().serial)
driver.prepare(run())
driver.start()
tags = []
while not tags or tags[-1].line < 1000:
    tags += driver.tags(1.0)
lines = driver.stop()
tags += driver.tags(0.2)
say(lines=lines, tagged=[tag.line for tag in tags], **driver.statistics())
sys.stdin.readline()
try:
    while True:
        driver.device().status()
except TriggerError as error:
    say(error=str(error))
driver.close()
