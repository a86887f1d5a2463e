"""The recorder in plans of a real RunEngine, on the real daemon."""

from __future__ import annotations

import asyncio
import contextlib
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import bluesky.plan_stubs as bps
import bluesky.preprocessors as bpp
import numpy as np
import psutil
import pytest
import zarr
from bluesky import RunEngine
from bluesky.utils import FailedStatus, RunEngineInterrupted
from event_model import DocumentNames, schema_validators
from live_daemon import Daemon
from ophyd_async.core import NotConnectedError, init_devices
from waiting import until

from acquire.bluesky import Recorder, StartRequest
from acquire.client import State
from acquire.store import Recording, open_recording

DOCUMENT = Path(__file__).parents[2] / "acquire/client/SCRIPTING.md"


class Emitted:
    """The documents of a plan, each checked by event-model as it comes, and against what a reader finds."""

    def __init__(self) -> None:
        self.documents: list[tuple[str, dict[str, Any]]] = []

    def __call__(self, name: str, document: Any) -> None:
        schema_validators[DocumentNames[name]].validate(document)
        self.documents.append((name, document))
        if name == "stream_datum":
            resource = self.resource(document["stream_resource"])
            assert document["indices"]["stop"] <= open_recording(path_of(resource)).lines

    def all(self, name: str) -> list[dict[str, Any]]:
        return [document for kind, document in self.documents if kind == name]

    def resource(self, uid: str) -> dict[str, Any]:
        (found,) = (one for one in self.all("stream_resource") if one["uid"] == uid)
        return found

    def rows(self, resource: dict[str, Any]) -> int:
        """Rows covered by the resource's documents: from the first on, without gaps or repetitions."""
        end = 0
        for datum in self.all("stream_datum"):
            if datum["stream_resource"] == resource["uid"]:
                assert datum["indices"]["start"] == end
                end = datum["indices"]["stop"]
        return end

    def covered(self) -> dict[tuple[str, str], int]:
        """Recording and data key → rows."""
        return {(path_of(one).name, one["data_key"]): self.rows(one) for one in self.all("stream_resource")}


def path_of(resource: dict[str, Any]) -> Path:
    return Path(unquote(urlsplit(resource["uri"]).path))


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with contextlib.closing(Daemon(tmp_path_factory.mktemp("daemon"))) as found:
        with found.client() as client:  # the first run starts a helper process that stays with the daemon
            client.arm()
            client.disarm()
        yield found


@pytest.fixture
def daemon(running: Daemon) -> Iterator[Daemon]:
    """The daemon of all tests, idle before each."""
    with running.client() as client:
        assert client.status().state is State.IDLE
        yield running
        if client.status().state is State.RECORDING:
            client.stop()
        if client.status().state is not State.IDLE:
            client.disarm()


@pytest.fixture(scope="module")
def engine() -> Iterator[RunEngine]:
    made = RunEngine({}, context_managers=[])  # signals are pytest's
    yield made
    made.loop.call_soon_threadsafe(made.loop.stop)
    made._th.join(10)
    made.loop.close()


@pytest.fixture
def emitted(engine: RunEngine) -> Iterator[Emitted]:
    made = Emitted()
    token = engine.subscribe(made)
    yield made
    engine.unsubscribe(token)


def fly(recorder: Recorder, request: StartRequest | None, during: Callable[[], Any] = list) -> Any:
    """The usual plan; ``during`` is run once lines are recorded."""

    @bpp.stage_decorator([recorder])
    @bpp.run_decorator()
    def plan() -> Any:
        if request is not None:
            yield from bps.prepare(recorder, request, wait=True)
        yield from bps.declare_stream(recorder, name="lines", collect=True)
        yield from bps.kickoff(recorder, wait=True)
        yield from during()
        yield from bps.collect_while_completing([recorder], [recorder], flush_period=0.2, stream_name="lines")

    return plan()


def until_committed(daemon: Daemon, lines: int = 600) -> None:
    with daemon.client() as client:
        until(lambda: (now := client.status().recording) is not None and now.committed_lines > lines)


def in_words(engine: RunEngine, plan: Any) -> str:
    """Return the message with which a plan fails."""
    with pytest.raises(FailedStatus) as failed:
        engine(plan)
    return str(failed.value.__cause__ or failed.value.args[0].exception())


def test_a_recording_that_another_client_stops_first_is_completed(
    daemon: Daemon, engine: RunEngine, emitted: Emitted, monkeypatch: pytest.MonkeyPatch
) -> None:
    with init_devices(), daemon.client() as other:
        recorder = Recorder(daemon.socket, name="recorder")
        stop, asked = recorder._client.stop, []

        async def too_late() -> Any:
            asked.append(await asyncio.to_thread(other.stop))
            return await stop()

        monkeypatch.setattr(recorder._client, "stop", too_late)
    engine(fly(recorder, None))
    assert asked
    (end,) = emitted.all("stop")
    assert end["exit_status"] == "success"


def test_the_example_s_documents_cover_exactly_the_recorded_lines(
    daemon: Daemon, engine: RunEngine, emitted: Emitted, monkeypatch: pytest.MonkeyPatch
) -> None:
    (example,) = re.findall(
        r"```python\n(import bluesky.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL
    )
    monkeypatch.setattr("acquire.client.core.default_socket", lambda: daemon.socket)
    monkeypatch.setattr("bluesky.RunEngine", lambda: engine)
    monkeypatch.chdir(daemon.home)
    exec(example, {})
    (start,) = emitted.all("start")
    (descriptor,) = emitted.all("descriptor")
    (stop,) = emitted.all("stop")
    assert (stop["run_start"], stop["exit_status"]) == (start["uid"], "success")
    assert descriptor["configuration"]["recorder"]["data"]["recorder-rig"] == "small"
    resources = emitted.all("stream_resource")
    assert [one["data_key"] for one in resources] == ["recorder-a", "recorder-b"]
    recording = open_recording(path_of(resources[0]))
    assert recording.state == "sealed"
    assert recording.lines == 20_000  # of two seconds
    assert len(emitted.all("stream_datum")) > 4  # while it grew
    for one in resources:
        assert emitted.rows(one) == recording.lines
        array = zarr.open_group(path_of(one), mode="r")[one["parameters"]["dataset"]]
        assert isinstance(array, zarr.Array)
        key = descriptor["data_keys"][one["data_key"]]
        assert (array.dtype, array.chunks) == (key["dtype_numpy"], one["parameters"]["chunk_shape"])
        assert array.shape == (recording.lines, key["shape"][1])
        arm = one["data_key"][-1]
        assert np.array_equal(array[:], recording.camera(arm).lines[: recording.lines])
    assert "the valve opens" in [event.text for event in recording.events if event.kind == "mark"]
    with daemon.client() as client:
        assert client.status().state is State.IDLE


def test_without_a_budget_complete_ends_it_and_an_armed_instrument_stays_armed(
    daemon: Daemon, engine: RunEngine, emitted: Emitted
) -> None:
    recorder = Recorder(daemon.socket, name="recorder")
    with daemon.client() as client:
        client.arm()
        engine(fly(recorder, None, lambda: bps.sleep(0.5)))
        assert client.status().state is State.ARMED
        recording = client.open()
    assert recording.attrs["end_reason"] == "stopped"
    assert set(emitted.covered().values()) == {recording.lines}


def test_impossible_requests_are_refused_with_an_explanation(
    daemon: Daemon, engine: RunEngine, tmp_path: Path
) -> None:
    recorder = Recorder(daemon.socket, name="recorder")

    def unstaged() -> Any:
        yield from bps.open_run()
        yield from bps.kickoff(recorder, wait=True)

    assert "recorder is not staged" in in_words(engine, unstaged())
    assert "cannot be prepared with 7" in in_words(engine, fly(recorder, 7))  # type: ignore[arg-type]
    nowhere = StartRequest(path=tmp_path / "no/run.zarr")
    assert "no/run.zarr" in in_words(engine, fly(recorder, nowhere))
    with daemon.client() as client:
        assert client.status().state is State.IDLE
        client.arm()
        client.start(tmp_path / "somebody.zarr")
        assert "is recording for another user" in in_words(engine, fly(recorder, None))
        assert client.status().state is State.RECORDING
    absent = Recorder(tmp_path / "nobody.sock", name="absent")
    with pytest.raises(NotConnectedError, match=r"nobody\.sock"), init_devices():
        connecting = absent
    assert connecting is absent
    with pytest.raises(NotConnectedError, match="no mock of the instrument"), init_devices(mock=True):
        mocked = Recorder(daemon.socket)
    assert mocked.name == "mocked"


def test_no_look_at_a_recording_holds_up_the_engine_s_loop(
    daemon: Daemon, engine: RunEngine, emitted: Emitted, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A network disk that hangs at the end of a recording would have stopped every other device's status."""
    looking: set[threading.Thread] = set()

    def looked(path: Path) -> Recording:
        looking.add(threading.current_thread())
        return open_recording(path)

    monkeypatch.setattr("acquire.bluesky.recorder.open_recording", looked)
    with init_devices():
        recorder = Recorder(daemon.socket, name="recorder")
    engine(fly(recorder, StartRequest(lines=300)))
    assert looking
    assert engine._th not in looking


def test_an_aborted_plan_stops_the_recording(daemon: Daemon, engine: RunEngine, emitted: Emitted) -> None:
    recorder = Recorder(daemon.socket, name="recorder")

    def interrupt() -> None:
        until_committed(daemon)
        until(lambda: emitted.covered() != {})
        engine.request_pause()

    interrupting = threading.Thread(target=interrupt)
    interrupting.start()
    with pytest.raises(RunEngineInterrupted):
        engine(fly(recorder, StartRequest(duration_s=600.0)))
    interrupting.join()
    engine.abort("the sample has melted")
    (stop,) = emitted.all("stop")
    assert stop["exit_status"] == "abort"
    with daemon.client() as client:
        assert client.status().state is State.IDLE
        recording = client.open()
    assert (recording.state, recording.attrs["end_reason"]) == ("sealed", "stopped")
    assert all(0 < rows <= recording.lines for rows in emitted.covered().values())


def test_a_fault_and_a_foreign_stop_fail_the_status_with_an_explanation(
    daemon: Daemon, engine: RunEngine, emitted: Emitted
) -> None:
    recorder = Recorder(daemon.socket, name="recorder")
    long = StartRequest(duration_s=600.0)

    def stop() -> Any:
        until_committed(daemon)
        with daemon.client() as client:
            client.stop()
        return bps.null()

    assert re.search(r"has \d+ of 6000000 lines: stopped; try: ", in_words(engine, fly(recorder, long, stop)))

    def lose_the_directory() -> Any:
        until_committed(daemon)
        with daemon.client() as client:
            path = client.open().path
        (path / "a/zarr.json").unlink()
        (path / "a").rename(path / "away")
        return bps.null()

    fault = "fault: the recording was aborted: write error: "
    assert in_words(engine, fly(recorder, long, lose_the_directory)).startswith(fault)
    assert [one["exit_status"] for one in emitted.all("stop")] == ["fail", "fail"]
    assert in_words(engine, fly(recorder, long)).startswith(fault)  # it waits to be read
    with daemon.client() as client:
        assert client.disarm().state is State.IDLE


def test_a_killed_daemon_fails_the_status_and_its_committed_lines_are_reported(
    tmp_path: Path, engine: RunEngine, emitted: Emitted, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acquire.bluesky.recorder.PATIENCE_S", 1.0)

    def kill() -> Any:
        until_committed(daemon)
        daemon.end(signal.SIGKILL)
        return bps.null()

    with contextlib.closing(Daemon(tmp_path)) as daemon:
        recorder = Recorder(daemon.socket, name="recorder")
        failure = in_words(engine, fly(recorder, StartRequest(lines=10**7), kill))
    assert str(daemon.socket) in failure
    (recording,) = {path_of(one) for one in emitted.all("stream_resource")}
    assert min(emitted.covered().values()) > 600
    assert max(emitted.covered().values()) <= open_recording(recording).lines


def test_a_replaced_recorder_adds_a_resource(daemon: Daemon, engine: RunEngine, emitted: Emitted) -> None:
    path = daemon.home / "x.zarr"

    def kill_the_recorder() -> None:
        until(lambda: min(emitted.covered().values(), default=0) > 600)
        with daemon.client() as client:
            psutil.Process(client.status().processes["recorder"]).kill()

    killing = threading.Thread(target=kill_the_recorder)
    killing.start()
    engine(fly(Recorder(daemon.socket, name="recorder"), StartRequest(path=path, duration_s=12.0)))
    killing.join()
    first, second = open_recording(path), open_recording(daemon.home / "x-2.zarr")
    rows = emitted.covered()
    for arm in ("a", "b"):
        of_first, of_second = rows["x.zarr", f"recorder-{arm}"], rows["x-2.zarr", f"recorder-{arm}"]
        assert 600 < of_first <= first.lines
        assert of_second == second.lines
        assert first.first_line + of_first == second.first_line  # no line twice, none left out
        assert of_first + of_second == 120_000


def test_a_missing_extra_is_named() -> None:
    program = """
import sys
class Without:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "ophyd_async":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Without())
from acquire.errors import UsageError
try:
    import acquire.bluesky
except UsageError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == (
        "acquire.bluesky needs the Python package 'ophyd_async', which is not installed; "
        "try: pip install 'tdi-acquire[bluesky]'\n"
    )
