"""``acquire replay``: a stored stream goes through the simulated devices into a daemon again."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.output import JsonFlag, print_facts, print_json
from acquire.cli.progress import stage_progress
from acquire.cli.recordings import PlaceArgument
from acquire.errors import AcquireError, DataError, UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.store.compare import Difference
    from acquire.store.reader import Recording

FASTEST = 32.0
"""What ``--speed 0`` begins with: a trigger of some MHz keeps a process busy with nothing but its tags."""
SLOWER, TRIES = 4.0, 4
"""Where lines of a recording that no ring can hold are lost: by how much slower it is tried, how often."""
LONGEST_SOCKET = 90
"""Bytes of a socket's path that every system takes."""


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Simulation")(replay)


def replay(
    recording: PlaceArgument,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="New recording of the replay; absent: a daemon waits for commands."
        ),
    ] = None,
    speed: Annotated[
        float, typer.Option(help="Simulated seconds per second; 0: as fast as no line is lost.")
    ] = 1.0,
    loop: Annotated[bool, typer.Option(help="Replay over and over, for a daemon under load.")] = False,
    socket: Annotated[
        Path | None,
        typer.Option(envvar="ACQUIRE_SOCKET", help="Control socket, without --out; else the user's."),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Feed a recording through the simulated devices into a daemon; the lines come out identical.

    With --out the daemon lives for one recording, on a socket of its own, and every array of that recording
    is compared with the first: exit code 0 where all are equal, 6 where one differs, 2 where the recording
    cannot be replayed. Gaps stay gaps, and flags come back as they were recorded: the light's code is not
    judged anew, since when a verdict comes depends on the load. A recording that is too large for the memory
    is tried again more slowly when lines are lost.

    Without --out the daemon runs until Ctrl-C and is armed and started like any other.

    Example: [bold]acquire replay run.zarr --out again.zarr --speed 0[/]
    """
    from acquire.store.files import check_new_path

    if not 0 <= speed <= 1000:
        raise UsageError(
            f"--speed {speed:g} is out of range", possible="0 for as fast as it goes, or up to 1000"
        )
    if out is not None:
        if loop:
            raise UsageError("--loop with --out would never end", possible="one of them")
        check_new_path(out)
    with _at_hand(recording) as stored:
        if out is None:  # the daemon in this process, until it is told to end
            from acquire.cli.replay_rig import replay_rig
            from acquire.cli.serve import serve

            with _private_directory() as directory:
                table = replay_rig(stored, speed or 1.0, Path.cwd(), replay_loop=loop)
                serve(str(_rig_file(directory, table)), socket, None)
            return
        used, differences = _until_nothing_is_lost(stored, out, speed or FASTEST)
        facts = {
            "path": str(out),
            "lines": stored.lines,
            "speed": used,
            "identical": not differences,
            "differences": [one.to_dict() for one in differences],
        }
        if json:
            print_json(facts)
        else:
            print_facts(facts | {"differences": "; ".join(map(str, differences)) or None})
    if differences:
        arrays = ", ".join(one.array for one in differences)
        raise DataError(f"{out} differs from {recording} in {arrays}", hint=f"acquire info {out}")


@contextmanager
def _at_hand(place: str) -> Iterator[Recording]:
    """The recording, fetched to this machine where it is far away: cameras cannot wait for a network."""
    from acquire.store import open_recording
    from acquire.store.remote import RemoteSource

    place = place.removeprefix("file://")
    with ExitStack() as held:
        stored = open_recording(place)
        if not stored.lines:
            raise UsageError(f"{place} cannot be replayed: it holds no lines")
        if stored.state != "sealed":
            raise UsageError(
                f"{place} cannot be replayed: it is not sealed",
                hint=f"acquire stop where it is being written, or acquire recover {place}",
            )
        if isinstance(stored.source, RemoteSource):
            directory = Path(held.enter_context(tempfile.TemporaryDirectory(prefix="acquire-")))
            stored = open_recording(_fetched(stored.source, directory / place.rpartition("/")[2]))
        yield stored


def _fetched(source: Any, path: Path) -> Path:
    """A copy of all parts of a recording below ``path``."""
    from acquire.store.refusals import refused

    with refused(source, "read"):
        sizes = source.sizes()
    room, size = shutil.disk_usage(path.parent).free, sum(sizes.values())
    if size > room:
        raise UsageError(
            f"{source} cannot be fetched: it has {size} bytes, and {path.parent} has room for {room}",
            hint="TMPDIR on a larger disk",
        )
    done = 0
    with stage_progress(f"fetching {path.name}") as advance:
        for key, part_size in sizes.items():
            target = path / key
            target.parent.mkdir(parents=True, exist_ok=True)
            with refused(source, "read"):
                data = source.read(key)
            target.write_bytes(data)
            done += part_size
            advance(done, size)
    return path


def _until_nothing_is_lost(stored: Recording, out: Path, speed: float) -> tuple[float, list[Difference]]:
    """The speed at which nothing was lost, and what differs; slower and slower where lines are lost."""
    from acquire.store import open_recording
    from acquire.store.compare import compare

    for number in range(TRIES):
        pace, last = speed / SLOWER**number, number == TRIES - 1
        fault = _record(stored, out, pace)
        if fault is None:
            with stage_progress(f"comparing {out.name}") as advance:
                return pace, compare(stored, open_recording(out), advance)
        if last:
            break
        shutil.rmtree(out, ignore_errors=True)  # made by `_record`, of a name that was free
    raise AcquireError(
        f"the replay to {out} lost lines at every speed that was tried, down to {pace:g}: {fault}",
        hint="fewer other processes on this host, or more memory, so that the ring can hold the recording",
    )


def _record(stored: Recording, out: Path, speed: float) -> str | None:
    """One attempt; what was lost on the way, None where nothing was."""
    from acquire.cli.demo.capture import await_daemon, daemon_process, follow
    from acquire.cli.replay_rig import replay_rig
    from acquire.client import Client

    with ExitStack() as held:
        directory = held.enter_context(_private_directory())
        gate, socket, log = (directory / name for name in ("gate", "c.sock", "daemon.log"))
        table = replay_rig(stored, speed, directory, replay_gate=str(gate))
        table["check"] = {"enable": False}  # flags are replayed, and when a verdict comes depends on the load
        table["recording"]["after"] = "idle"
        # A process of its own: the daemon's signals and threads are not for this one.
        options = [f"--config={_rig_file(directory, table)}", f"--socket={socket}"]
        process = held.enter_context(daemon_process(options, log))
        client = held.enter_context(Client(socket))
        advance = held.enter_context(stage_progress(f"replaying {out.name}"))
        await_daemon(client, process, log)
        client.arm(force=True)  # the ring holds what the disk does not take in time
        client.start(out.absolute(), lines=stored.lines)
        gate.touch()  # no line comes before, so that none can come before the recording has begun
        status = follow(client, stored.lines, advance)
    if status.fault:
        return status.fault
    last = status.last
    if last is None or last.lines < stored.lines:
        return "none was made" if last is None else f"it ended after {last.lines} lines: {last.end_reason}"
    return "the rings were full" if any(_lost_more(stored, out)) else None


def _lost_more(stored: Recording, out: Path) -> Iterator[bool]:
    """Whether more lines of an arm are missing than there were."""
    from acquire.store import open_recording

    again = open_recording(out)
    for arm in again.arms:
        before = sum(map(len, stored.lost_rows(arm))) + sum(map(len, stored.dropped_rows()))
        yield sum(map(len, again.lost_rows(arm))) > before


@contextmanager
def _private_directory() -> Iterator[Path]:
    """A directory of our own for socket, rig and log, with a path that is short enough for a socket."""
    with ExitStack() as held:
        name = held.enter_context(tempfile.TemporaryDirectory(prefix="acquire-"))
        if len(f"{name}/c.sock".encode()) > LONGEST_SOCKET:
            name = held.enter_context(tempfile.TemporaryDirectory(prefix="acquire-", dir="/tmp"))
        yield Path(name)


def _rig_file(directory: Path, table: dict[str, Any]) -> Path:
    from acquire.cli.config import dotted

    path = directory / "rig.toml"
    path.write_text("\n".join(dotted(table)) + "\n", encoding="utf-8")
    return path
