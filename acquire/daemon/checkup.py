"""Is the host of a daemon that runs still fit to capture? Judged by the daemon's own setup.

Nothing here disturbs a recording: no device is opened, and nothing is written or measured.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import ValidationError

from acquire.config import RigConfig
from acquire.daemon.doctor import examine

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.daemon.doctor import CheckResult
    from acquire.daemon.facts import Setup
    from acquire.daemon.messages import Status


def examine_running(setup: Setup, status: Status) -> Iterator[CheckResult]:
    """Yield findings about this host, on which a daemon with this setup and status is running."""
    # While a run is armed, its rings have their memory already.
    yield from examine(_rig(setup, status), status.version, has_rings=status.run_id is not None)


def _rig(setup: Setup, status: Status) -> RigConfig | None:
    """Return the daemon's configuration; None if this version of the program cannot read it."""
    try:
        rig = RigConfig.model_validate(setup.config)
    except ValidationError:
        return None  # one of the findings says that the versions differ
    # The page that is running has its port, which is no fault. A relative directory is the daemon's.
    changes: dict[str, object] = {"web": None}
    if status.disk is not None:
        changes["recording"] = rig.recording.model_copy(update={"directory": status.disk.directory})
    return rig.model_copy(update=changes)
