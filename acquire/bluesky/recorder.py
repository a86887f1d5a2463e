"""The recorder as an ophyd-async device; see `acquire.bluesky`.

::

    stage      idle → armed                    unstage    a recording under way is stopped; armed → idle
    prepare    how much is to be recorded                 where this device armed it
    kickoff    armed → recording
    complete   until that is sealed: waits for the budget, or stops a recording without one
    collect    StreamResource once, StreamDatum for the lines that were committed since
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from typing import TYPE_CHECKING, Any

from bluesky.protocols import Collectable, Flyable, Movable, Preparable, Stageable, WritesStreamAssets
from ophyd_async.core import DEFAULT_TIMEOUT, AsyncStatus, Device, WatchableAsyncStatus, WatcherUpdate

from acquire.bluesky.documents import Account, Segment, data_keys
from acquire.client import SEALED, AsyncClient, State, Status, core
from acquire.config import RigConfig
from acquire.daemon.messages import StartRequest, fault_error
from acquire.errors import DataError, DeviceError, NoDaemonError, PlaceError, StateError, UsageError
from acquire.store import RunCondition, open_recording
from acquire.store.attributes import segment_of

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from bluesky.protocols import Reading, StreamAsset
    from event_model import DataKey
    from ophyd_async.core import DeviceMock

PATIENCE_S = 30.0
"""How long `complete` waits for a daemon that does not answer: a supervisor may restart it, and the new one
says what it found."""
POLL_S = 0.1

log = logging.getLogger("acquire.bluesky")


class Marker(Device, Movable[str]):
    """Setting it to a text marks the newest line with that text."""

    def __init__(self, client: AsyncClient) -> None:
        self._client = client
        super().__init__()

    @AsyncStatus.wrap
    async def set(self, value: str) -> None:
        await self._client.mark(value)


class Recorder(Device, Stageable, Preparable, Flyable, Collectable, WritesStreamAssets):
    """One instrument, whose recordings must be readable from this host, too.

    A recording that faults, that somebody else ends before its budget, or whose daemon dies fails the status
    of `complete`, with what happened in words; what was committed can be collected all the same.
    """

    def __init__(self, place: Path | str | None = None, *, token: str | None = None, name: str = "") -> None:
        """``place`` and ``token`` as for `acquire.client.Client`."""
        self._client = AsyncClient(place, token=token)
        # A plan that fails unstages while a kickoff may be waiting for the daemon's answer: the recording
        # which that starts must be known before it can be stopped.
        self._commands = asyncio.Lock()
        # `complete` and `get_index` update the account at once, and each waits for files in between: both
        # would append the same further segment.
        self._updating = asyncio.Lock()
        self._staged = self._armed = False
        self._request = StartRequest()
        self._account: Account | None = None
        self.mark = Marker(self._client)
        super().__init__(name)

    async def connect(
        self,
        mock: bool | DeviceMock[Any] = False,
        timeout: float = DEFAULT_TIMEOUT,
        force_reconnect: bool = False,  # noqa: ARG002
    ) -> None:
        """Raises NoDaemonError where nobody answers, and UsageError for a mock."""
        if mock:
            raise UsageError(
                f"{self.name}: there is no mock of the instrument",
                hint="acquire serve --config rig-demo, a real service whose devices are simulated",
            )
        async with asyncio.timeout(timeout):
            await self._client.version()

    # ---- commands

    @AsyncStatus.wrap
    async def stage(self) -> None:
        """Raises StateError where somebody records already, DeviceError where a fault waits to be read."""
        async with self._commands:
            status = await self._client.status()
            if status.state is State.FAULTED:
                raise fault_error(status.fault)
            if status.state not in SEALED:
                raise StateError(
                    f"{self.name}: the instrument is {status.state} for somebody else",
                    possible="stage once it is idle or armed",
                    hint="acquire status",
                )
            if status.state is State.IDLE:
                await self._client.arm()
                self._armed = True
            self._staged, self._request, self._account = True, StartRequest(), None

    @AsyncStatus.wrap
    async def prepare(self, value: StartRequest) -> None:
        """What `kickoff` will ask for; without it, a recording with no end but `complete`."""
        if not isinstance(value, StartRequest):
            raise UsageError(
                f"{self.name}: cannot prepare with {value!r}", possible="StartRequest(duration_s=1.0)"
            )
        self._request = value

    @AsyncStatus.wrap
    async def kickoff(self) -> None:
        """Raises StateError unless it is staged, and UsageError, recording nothing more, where this host does
        not see the recording.
        """
        async with self._commands:
            if not self._staged:
                raise StateError(
                    f"{self.name} is not staged: when a plan fails, only what it staged is stopped",
                    possible="bps.stage(recorder), or bluesky.preprocessors.stage_decorator",
                )
            rig = await self._rig()
            status = await self._client.call(core.command("start", Status, self._request))
            made = status.recording or status.last  # the latter if it was over at once
            if made is None:
                raise DeviceError(f"{self.name}: the daemon does not know the recording that it started")
            budget = status.recording.budget_lines if status.recording else self._request.lines
            self._account = Account(self.name, rig, made.path, budget)
            if not await asyncio.to_thread(made.path.exists):
                await self._stop()
                raise UsageError(
                    f"{self.name}: the daemon records to {made.path}, which this host does not see",
                    hint="run the plan on the daemon's host, or mount its recordings at the same path",
                )

    @WatchableAsyncStatus.wrap
    async def complete(self) -> AsyncIterator[WatcherUpdate[int]]:
        """Ends once the recording is sealed; raises DeviceError unless it became what was asked for."""
        account, request = self._under_way(), self._request
        is_open = all(limit is None for limit in (request.lines, request.duration_s, request.post_s))
        while True:
            status = await self._status_patiently()
            if status.fault is not None and self._staged:
                raise fault_error(status.fault)
            if not await self._update_account(account, status):
                break
            yield WatcherUpdate(
                account.reach, 0, account.budget or account.reach, name=self.name, unit="lines"
            )
            if is_open and status.state is State.RECORDING:
                await self._stop()
            await asyncio.sleep(POLL_S)
        if self._staged:  # otherwise `unstage` stopped it, and the plan knows
            self._check_outcome(account, status)

    @AsyncStatus.wrap
    async def unstage(self) -> None:
        """However the plan ended: stop the recording that it started, and disarm what it armed."""
        async with self._commands:
            if not self._staged:
                return
            # First of all: `complete`, which may still be waiting, must not take our stop for a stranger's.
            self._staged, armed, self._armed = False, self._armed, False
            try:
                await self._stop_recording(disarm=armed)
            except NoDaemonError as error:
                log.warning("%s: there is nothing left to stop: %s", self.name, error)

    async def _stop_recording(self, *, disarm: bool) -> None:
        while True:
            status, account = await self._client.status(), self._account
            ours = (
                account is not None
                and status.recording is not None
                and await self._update_account(account, status)
            )
            if not ours and status.state is not State.DRAINING:
                break
            if status.state is State.RECORDING:
                await self._stop()
            await asyncio.sleep(POLL_S)
        if disarm and status.state is State.ARMED:
            await self._client.disarm()

    async def _stop(self) -> None:
        """Stop what is recorded, unless it has ended since the daemon was asked."""
        with contextlib.suppress(StateError):
            await self._client.stop()

    # ---- documents

    async def describe_collect(self) -> dict[str, DataKey]:
        return data_keys(self.name, await self._rig())

    async def get_index(self) -> int:
        """Lines that `collect` can cover: those that a reader can see."""
        account = self._under_way()
        try:
            status = await self._client.status()
        except NoDaemonError:  # `complete` fails with it; what was committed stays
            status = None
        await self._update_account(account, status)
        return account.index

    async def collect_asset_docs(self, index: int | None = None) -> AsyncIterator[StreamAsset]:
        if self._account is None:
            return
        if index is None:
            index = await self.get_index()
        for document in self._account.tell(index):
            yield document

    async def read_configuration(self) -> dict[str, Reading[Any]]:
        now = time.time()
        return {key: {"value": value, "timestamp": now} for key, value in (await self._facts()).items()}

    async def describe_configuration(self) -> dict[str, DataKey]:
        return {
            key: {
                "source": "acquire://setup",
                "dtype": "string" if isinstance(value, str) else "number",
                "shape": [],
            }
            for key, value in (await self._facts()).items()
        }

    async def _facts(self) -> dict[str, str | float]:
        """The configuration in short; everything else is in the recording's own attributes."""
        setup = await self._client.setup()
        facts = {
            "rig": setup.name,
            "acquire": setup.versions["acquire"],
            "line_rate_hz": setup.line_rate_hz,
            "stages": setup.config["geometry"]["stages"],
            "substeps": setup.config["geometry"]["substeps"],
        }
        return {f"{self.name}-{key}": value for key, value in facts.items()}

    async def _rig(self) -> RigConfig:
        return RigConfig.model_validate((await self._client.setup()).config)

    # ---- what the daemon says

    def _under_way(self) -> Account:
        if self._account is None:
            raise StateError(f"{self.name} records nothing", possible="bps.kickoff(recorder, wait=True)")
        return self._account

    async def _update_account(self, account: Account, status: Status | None) -> bool:
        """Update ``account`` from what the daemon says, or from the files once the recording is over.

        Returns whether it is still under way.
        """
        async with self._updating:
            now = None if status is None else status.recording
            if now is not None and now.path != account.now.path:
                try:
                    await asyncio.to_thread(_add_segment, account, now.path)
                except (PlaceError, DataError):
                    return True  # what has only just begun cannot be read yet
            if now is not None and now.path == account.now.path:
                first_line = account.now.first_line
                # The daemon may name a new segment while its numbers are still those of the one before: they
                # count once their first line is the segment's own.
                if first_line in (None, now.first_line):
                    account.now.first_line = now.first_line
                    account.now.lines = max(account.now.lines, now.committed_lines)
                return True
            account.now.lines = (await asyncio.to_thread(open_recording, account.now.path)).lines
            return now is None and status is not None and status.state is State.DRAINING

    async def _status_patiently(self) -> Status:
        end_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                return await self._client.status()
            except NoDaemonError:
                if time.monotonic() > end_s:
                    raise
            await asyncio.sleep(POLL_S)

    def _check_outcome(self, account: Account, status: Status) -> None:
        path = account.now.path
        attrs = open_recording(path).attrs
        if attrs["state"] != "sealed":
            raise DeviceError(
                f"{self.name}: the daemon that recorded {path} has ended; the one that answers now, process "
                f"{status.pid}, is {status.state}",
                hint="acquire status: it recovers what was recorded",
            )
        condition, reason = attrs["run_condition"], attrs["end_reason"]
        if condition in (RunCondition.ABORTED, RunCondition.INTERRUPTED):
            raise DeviceError(f"{self.name}: {path} is {condition}, {account.reach} lines: {reason}")
        if account.budget is not None and account.reach < account.budget:
            raise DeviceError(f"{self.name}: {path} has {account.reach} of {account.budget} lines: {reason}")
        if len(account.untold) > 1:
            paths = ", ".join(str(segment.path) for segment in account.untold)
            raise DeviceError(
                f"{self.name}: one collect cannot cover all segments of the recording: {paths}",
                hint="bps.collect_while_completing(..., flush_period=1.0) covers one after the other",
            )
        if condition != RunCondition.GOOD:
            log.warning("%s: %s is %s: %s", self.name, path, condition, reason)


def _add_segment(account: Account, path: Path) -> None:
    """Add the recording at ``path``, if it continues the one under way and is not somebody's next."""
    following, until_now = open_recording(path), open_recording(account.now.path)
    known, found = segment_of(until_now.attrs), segment_of(following.attrs)
    if found is None or found[0] != (known[0] if known is not None else account.now.path.name):
        return
    # What was left of a killed recorder is recovered, and may then hold lines that are in both.
    account.now.lines = min(until_now.lines, following.first_line - until_now.first_line)
    account.segments.append(Segment(path, following.first_line))
