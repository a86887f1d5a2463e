"""The recorder as an ophyd-async device; see `acquire.bluesky`.

::

    stage      idle → armed                    unstage    stops its recording; armed → idle, if this
    prepare    sets how much to record                    device armed it
    kickoff    armed → recording
    complete   waits until it is sealed, by its budget, or stops a recording without one
    collect    StreamResource once, StreamDatum for the lines committed since the last call
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import time
from typing import TYPE_CHECKING, Any

from bluesky.protocols import Collectable, Flyable, Movable, Preparable, Stageable, WritesStreamAssets
from ophyd_async.core import DEFAULT_TIMEOUT, AsyncStatus, Device, WatchableAsyncStatus, WatcherUpdate

from acquire.bluesky.documents import Account, RecordedRows, data_keys
from acquire.client import SEALED, AsyncClient, State, Status, core
from acquire.config import RigConfig
from acquire.daemon.messages import StartRequest, fault_error
from acquire.errors import DataError, DeviceError, NoDaemonError, PlaceError, StateError, UsageError
from acquire.store import RunCondition, open_recording
from acquire.store.attributes import segment_of
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from bluesky.protocols import Reading, StreamAsset
    from event_model import DataKey
    from ophyd_async.core import DeviceMock

PATIENCE_S = 30.0
"""Longest wait of `complete` for a daemon that does not answer: a supervisor may restart it, and the new one
reports what it found."""
POLL_S = 0.1

log = logging.getLogger("acquire.bluesky")


class Marker(Device, Movable[str]):
    """Marks the newest line with the text that it is set to."""

    def __init__(self, client: AsyncClient) -> None:
        self._client = client
        super().__init__()

    @AsyncStatus.wrap
    async def set(self, value: str) -> None:
        """Mark the newest line with this text, and finish when the daemon has accepted it."""
        await self._client.mark(value)


class Recorder(Device, Stageable, Preparable, Flyable, Collectable, WritesStreamAssets):
    """One instrument, whose recordings must also be readable from this host.

    The status of `complete` fails, with the reason, if the recording has a fault, if somebody else ends it
    before its budget, or if its daemon dies; the committed lines can be collected even then.
    """

    def __init__(self, place: Path | str | None = None, *, token: str | None = None, name: str = "") -> None:
        """``place`` and ``token`` as for `acquire.client.Client`."""
        self._client = AsyncClient(place, token=token)
        # A plan that fails unstages while a kickoff may still be waiting for the daemon's answer, and the
        # recording that it starts must be known before it can be stopped.
        self._commands = asyncio.Lock()
        # `complete` and `get_index` may update the account concurrently, and both wait for files in between:
        # without a lock they would append the same segment twice.
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
        """Check that the daemon answers. Raises NoDaemonError if it does not, and UsageError for a mock."""
        if mock:
            raise UsageError(
                f"{self.name}: there is no mock of the instrument",
                hint="use acquire serve --config rig-demo, a real service with simulated devices",
            )
        async with asyncio.timeout(timeout):
            await self._client.version()

    # ---- commands

    @AsyncStatus.wrap
    async def stage(self) -> None:
        """Arm the instrument. Raises StateError if somebody else is recording, DeviceError after a fault."""
        async with self._commands:
            status = await self._client.status()
            if status.state is State.FAULTED:
                raise fault_error(status.fault)
            if status.state not in SEALED:
                raise StateError(
                    f"{self.name}: the instrument is {status.state} for another user",
                    possible="stage once it is idle or armed",
                    hint="acquire status",
                )
            if status.state is State.IDLE:
                await self._client.arm()
                self._armed = True  # an instrument that somebody else armed stays armed in the end
            self._staged, self._request, self._account = True, StartRequest(), None

    @AsyncStatus.wrap
    async def prepare(self, value: StartRequest) -> None:
        """Set the request of `kickoff`; without it, the recording lasts until `complete` stops it."""
        if not isinstance(value, StartRequest):
            raise UsageError(
                f"{self.name} cannot be prepared with {value!r}", possible="StartRequest(duration_s=1.0)"
            )
        self._request = value

    @AsyncStatus.wrap
    async def kickoff(self) -> None:
        """Start the recording. Raises StateError unless it is staged.

        Raises UsageError, and stops the recording, if this host cannot access it.
        """
        async with self._commands:
            if not self._staged:
                raise StateError(
                    f"{self.name} is not staged, so that it could not be stopped if the plan failed",
                    possible="bps.stage(recorder), or bluesky.preprocessors.stage_decorator",
                )
            rig = await self._rig()
            status = await self._client.call(core.command("start", Status, self._request))
            recording = status.recording or status.last  # the latter if it has ended already
            if recording is None:
                raise DeviceError(
                    f"{self.name}: the daemon did not report the recording that it started",
                    hint="acquire status shows what the daemon does; then run the plan again",
                )
            budget = status.recording.budget_lines if status.recording else self._request.lines
            self._account = Account(self.name, rig, recording.path, budget)
            # In a thread, as all looks at files: a network disk may hang, and the RunEngine's loop must not.
            if not await asyncio.to_thread(recording.path.exists):
                await self._stop()
                raise UsageError(
                    f"{self.name}: the daemon records to {recording.path}, which does not exist on this host",
                    hint="run the plan on the daemon's host, or mount its recordings at the same path",
                )

    @WatchableAsyncStatus.wrap
    async def complete(self) -> AsyncIterator[WatcherUpdate[int]]:
        """Wait until the recording is sealed. Raises DeviceError unless it has its full budget."""
        account, request = self._current_account(), self._request
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
        if self._staged:  # otherwise `unstage` stopped it, on behalf of the plan
            await asyncio.to_thread(self._check_outcome, account, status)

    @AsyncStatus.wrap
    async def unstage(self) -> None:
        """Stop the recording that the plan started, and disarm if it armed, however the plan ended."""
        async with self._commands:
            if not self._staged:
                return
            # First, so that `complete`, which may still be waiting, does not report this stop as a failure.
            self._staged, armed, self._armed = False, self._armed, False
            try:
                await self._stop_recording(disarm=armed)
            except NoDaemonError as error:
                log.warning("%s: there is nothing left to stop: %s", self.name, error)

    async def _stop_recording(self, *, disarm: bool) -> None:
        """Stop the plan's recording, wait until none is being sealed, and disarm."""
        while True:
            status, account = await self._client.status(), self._account
            ours = (
                account is not None
                and status.recording is not None
                and await self._update_account(account, status)
            )
            # Sealing is waited for: the daemon refuses to disarm in this state.
            if not ours and status.state is not State.DRAINING:
                break
            if status.state is State.RECORDING:
                await self._stop()
            await asyncio.sleep(POLL_S)
        if disarm and status.state is State.ARMED:
            await self._client.disarm()

    async def _stop(self) -> None:
        """Stop the recording, unless it has ended since the last status."""
        with contextlib.suppress(StateError):
            await self._client.stop()

    # ---- documents

    async def describe_collect(self) -> dict[str, DataKey]:
        return data_keys(self.name, await self._rig())

    async def get_index(self) -> int:
        """Return the number of readable lines, which `collect` can cover."""
        account = self._current_account()
        try:
            status = await self._client.status()
        except NoDaemonError:  # `complete` fails with it, but committed lines can still be collected
            status = None
        await self._update_account(account, status)
        return account.index

    async def collect_asset_docs(self, index: int | None = None) -> AsyncIterator[StreamAsset]:
        if self._account is None:
            return
        if index is None:
            index = await self.get_index()
        for document in self._account.documents(index):
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
        """Return a summary of the configuration; the rest is in the recording's own attributes."""
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

    # ---- the daemon's reports

    def _current_account(self) -> Account:
        if self._account is None:
            raise StateError(
                f"{self.name} has not started a recording", possible="bps.kickoff(recorder, wait=True)"
            )
        return self._account

    async def _update_account(self, account: Account, status: Status | None) -> bool:
        """Update ``account`` from the daemon's status, or from the files once the recording has ended.

        Returns True while the recording continues.
        """
        async with self._updating:
            now = None if status is None else status.recording
            if now is not None and now.path != account.now.path:
                try:
                    await asyncio.to_thread(_add_segment, account, now.path)
                except (PlaceError, DataError):
                    if _may_continue(account, now.path):
                        return True  # a segment that has only just begun cannot be read yet
            if now is not None and now.path == account.now.path:
                first_line = account.now.first_line
                # The daemon may report the path of a new segment with the counts of the previous one: counts
                # are valid once their first line is the segment's own.
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
        """Raise DeviceError unless the recording is sealed, complete and fully covered by one collect."""
        path = account.now.path
        attrs = open_recording(path).attrs
        if attrs["state"] != "sealed":
            raise DeviceError(
                f"{self.name}: the daemon that recorded {path} has ended; the present daemon, process "
                f"{status.pid}, is {status.state}",
                hint="acquire status shows how the recording is recovered",
            )
        condition, reason = attrs["run_condition"], attrs["end_reason"]
        if condition in (RunCondition.ABORTED, RunCondition.INTERRUPTED):
            raise DeviceError(
                f"{self.name}: {path} is {condition}, {counted(account.reach, 'line')}: {reason}",
                hint="acquire verify lists the lines that it holds; check the cause, then run the plan again",
            )
        if account.budget is not None and account.reach < account.budget:
            raise DeviceError(
                f"{self.name}: {path} has {account.reach} of {counted(account.budget, 'line')}: {reason}",
                hint="acquire verify lists the lines that it holds; check the cause, then run the plan again",
            )
        if len(account.uncovered) > 1:
            paths = ", ".join(str(segment.path) for segment in account.uncovered)
            raise DeviceError(
                f"{self.name}: one collect cannot cover all segments of the recording: {paths}",
                hint="bps.collect_while_completing(..., flush_period=1.0) covers them one after another",
            )
        if condition != RunCondition.GOOD:
            log.warning("%s: %s is %s: %s", self.name, path, condition, reason)


def _may_continue(account: Account, path: Path) -> bool:
    """Return whether a recording's name is that of a segment of the current one, see `next_segment`."""
    first = account.segments[0].path
    pattern = rf"{re.escape(first.stem)}-\d+{re.escape(first.suffix)}"
    return path.parent == first.parent and re.fullmatch(pattern, path.name) is not None


def _add_segment(account: Account, path: Path) -> None:
    """Add the recording at ``path`` if it continues the current one, and is not another user's."""
    next_segment, current = open_recording(path), open_recording(account.now.path)
    known, found = segment_of(current.attrs), segment_of(next_segment.attrs)
    if found is None or found[0] != (known[0] if known is not None else account.now.path.name):
        return
    # A recording recovered after its recorder was killed may contain lines that the next segment has, too.
    account.now.lines = min(current.lines, next_segment.first_line - current.first_line)
    account.segments.append(RecordedRows(path, next_segment.first_line))
