"""The daemon's automatic commands after its start: `[service] begin`.

A daemon that was restarted after a crash arms or records according to the rig. A refusal is reported and
retried, that of the recording too; once a user gives a command, the automatic ones end.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from acquire.daemon.messages import ArmRequest, StartRequest
from acquire.daemon.states import State
from acquire.errors import AcquireError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from acquire.config.service import ServiceConfig
    from acquire.daemon.messages import Status
    from acquire.daemon.service import Service

log = logging.getLogger("acquire.daemon")


async def begin(
    config: ServiceConfig, service: Service, run: Callable[[Callable[[], None]], Awaitable[None]]
) -> None:
    """Arm, or arm and record, according to ``config``; ``run`` calls a function in the devices' thread."""
    if config.begin == "idle":
        return
    log.info("service.begin: %s", config.begin)
    ours: str | None = None
    # Both commands in one loop: a rig that was armed and could not record need not be armed again.
    while _is_untouched(status := service.status(), ours):
        try:
            if status.state is State.IDLE:
                await run(lambda: service.arm(ArmRequest()))
                # By its number: a user may disarm and arm again while this waits for its next try.
                ours = service.status().run_id
            if config.begin == "recording":
                await run(lambda: service.start(StartRequest()))
        except AcquireError as error:
            text = f"service.begin: {error}; tried again in {config.retry_s:g} s"
            log.warning("%s", text)
            service.news.add("waiting", text, level="warning")
        except Exception as error:  # noqa: BLE001 - otherwise nobody would learn why nothing is recorded
            service.troubles.note("service.begin", error)
        else:
            return
        await asyncio.sleep(config.retry_s)


def _is_untouched(status: Status, ours: str | None) -> bool:
    """Return whether nothing was armed yet, or the run ``ours`` was, and no other command has come since."""
    if ours is None:
        return status.state is State.IDLE
    return status.state is State.ARMED and status.run_id == ours and status.last is None
