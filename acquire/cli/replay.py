"""``acquire replay``: feed a recording through the simulated devices into a daemon again."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.output import JsonFlag, print_facts, print_json
from acquire.cli.places import SOCKET, private_directory
from acquire.cli.progress import stage_progress
from acquire.cli.recording_page import what_to_try
from acquire.cli.recordings import PlaceArgument
from acquire.errors import AcquireError, DataError, UsageError
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from acquire.store.compare import Difference
    from acquire.store.reader import Recording
    from acquire.store.shortfall import Damage

FASTEST = 32.0
"""First speed tried by ``--speed 0``: at a few MHz, the trigger's tags alone keep a process busy."""
SLOWER, TRIES = 4.0, 4
"""If lines are lost because the ring cannot hold the recording, each attempt is slower by this factor."""


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Simulation")(replay)


def replay(
    recording: PlaceArgument,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Record the replay in this new recording. Default: run a daemon that waits for commands.",
        ),
    ] = None,
    speed: Annotated[
        float,
        typer.Option(help="Speed relative to real time, or 0 for the highest speed without lost lines."),
    ] = 1.0,
    loop: Annotated[bool, typer.Option(help="Replay endlessly, to put a daemon under load.")] = False,
    socket: Annotated[
        Path | None,
        typer.Option(
            envvar="ACQUIRE_SOCKET",
            help="Without --out: control socket to listen on. Default: the user's usual one.",
        ),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Feed a recording through the simulated devices into a daemon again. The lines come out identical.

    With --out, a daemon makes one recording, on a socket of its own, and every array of it is compared with
    the original. The exit code is 0 if all are equal, 6 if one differs, and 2 if the recording cannot be
    replayed. Gaps and flags are replayed as recorded; the exposure code is not checked again, because the
    moment at which a check reports depends on the load. If lines are lost because the recording does not
    fit into memory, the replay is repeated at a lower speed.

    Without --out, the daemon runs until Ctrl-C and is armed and started like any other.

    Example: [bold]acquire replay run.zarr --out again.zarr --speed 0[/]
    """
    from acquire.store.array_files import COLUMNS
    from acquire.store.files import check_new_path

    if not 0 <= speed <= 1000:
        raise UsageError(
            f"--speed {speed:g} is out of range", possible="0 for the highest possible speed, or up to 1000"
        )
    if out is not None:
        if loop:
            raise UsageError("--loop with --out would never end", possible="one of them")
        check_new_path(out)
    with _local_recording(recording) as stored:
        # Now, in a moment: otherwise a camera without its lines is a fault once all is armed, at every speed.
        _refuse_shortfall(recording, stored, ("lines", "flags") if out is None else COLUMNS)
        if out is None:  # run the daemon in this process until it is stopped
            from acquire.cli.replay_rig import replay_rig
            from acquire.cli.serve import serve

            with private_directory() as directory:
                table = replay_rig(stored, speed or 1.0, Path.cwd(), replay_loop=loop)
                serve(str(_rig_file(directory, table)), socket, None)
            return
        used, differences = _replay_without_loss(stored, out, speed or FASTEST)
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
def _local_recording(place: str) -> Iterator[Recording]:
    """Open a recording; a remote one is downloaded first, because cameras cannot wait for a network.

    Raises UsageError if it cannot be replayed.
    """
    from acquire.store import open_recording
    from acquire.store.remote import RemoteSource

    place = place.removeprefix("file://")
    with ExitStack() as held:
        stored = open_recording(place)
        if not stored.lines:
            raise UsageError(f"{place} cannot be replayed: it has no lines")
        if stored.state != "sealed":
            raise UsageError(
                f"{place} cannot be replayed: it is not sealed",
                hint=f"acquire stop, if it is being written, or acquire recover {place}",
            )
        # Only now, so that what cannot be replayed is not downloaded.
        if isinstance(stored.source, RemoteSource):
            directory = Path(held.enter_context(tempfile.TemporaryDirectory(prefix="acquire-")))
            stored = open_recording(_download(stored.source, directory / place.rpartition("/")[2]))
        yield stored


def _download(source: Any, path: Path) -> Path:
    """Copy all files of a remote recording below ``path``."""
    from acquire.store.refusals import refused

    with refused(source, "read"):
        sizes = source.sizes()
    # Refused before the download, and not by a full disk in the middle of it.
    room, size = shutil.disk_usage(path.parent).free, sum(sizes.values())
    if size > room:
        raise UsageError(
            f"{source} cannot be downloaded: it has {size} bytes, but {path.parent} has room for {room}",
            hint="TMPDIR on a larger disk",
        )
    done = 0
    with stage_progress(f"downloading {path.name}") as advance:
        for key, part_size in sizes.items():
            target = path / key
            target.parent.mkdir(parents=True, exist_ok=True)
            with refused(source, "read"):
                data = source.read(key)
            target.write_bytes(data)
            done += part_size
            advance(done, size)
    return path


def _replay_without_loss(stored: Recording, out: Path, speed: float) -> tuple[float, list[Difference]]:
    """Replay at lower and lower speeds until no lines are lost; return that speed and the differences."""
    from acquire.store import open_recording
    from acquire.store.compare import compare

    for number in range(TRIES):
        pace, last = speed / SLOWER**number, number == TRIES - 1
        fault = _record(stored, out, pace)
        if fault is None:
            with stage_progress(f"comparing {out.name}") as advance:
                return pace, compare(stored, open_recording(out), advance)
        # Damage that lengths do not show: with it, no speed is slow enough.
        if number == 0 and (found := _damage(stored)) is not None:
            _discard(out)
            raise _damaged(stored, found)
        if last:
            break
        _discard(out)
    raise AcquireError(
        f"the replay to {out} lost lines at every speed that was tried, down to {pace:g}: {fault}",
        hint="fewer other processes on this host, or more memory, so that the ring can hold the recording",
    )


def _refuse_shortfall(place: str, stored: Recording, needed: Collection[str]) -> None:
    """Raise DataError if some of the arrays ``needed`` of either arm are not whole on disk."""
    from acquire.store.shortfall import shortfalls

    found = next((one for one in shortfalls(stored) if one.array in needed), None)
    if found is not None:
        raise _damaged(place, found)


def _damage(stored: Recording) -> Damage | None:
    """Read all of a recording; return its first damage."""
    from acquire.store import verify

    with stage_progress(f"verifying {stored.path.name}") as advance:
        return next(iter(verify(stored.path, advance).damage), None)


def _damaged(place: object, found: Damage) -> DataError:
    return DataError(
        f"{place} cannot be replayed: {found}",
        hint=f"{what_to_try(place, str(found))}: lines that are missing are replayed as missing",
    )


def _discard(out: Path) -> None:
    """Remove what `_record` has made, and the segments in which the recording went on."""
    from acquire.store import open_outline

    with suppress(AcquireError):  # no recording was begun, or it is damaged
        for name in open_outline(out).attrs.get("segments", ()):
            shutil.rmtree(out.with_name(name), ignore_errors=True)
    shutil.rmtree(out, ignore_errors=True)


def _record(stored: Recording, out: Path, speed: float) -> str | None:
    """Replay once; return the reason why lines were lost, None if none were."""
    from acquire.cli.demo.capture import await_daemon, daemon_process, follow
    from acquire.cli.replay_rig import replay_rig
    from acquire.client import Client
    from acquire.store import open_recording

    with ExitStack() as held:
        directory = held.enter_context(private_directory())
        gate, socket, log = (directory / name for name in ("gate", SOCKET, "daemon.log"))
        table = replay_rig(stored, speed, directory, replay_gate=str(gate))
        # Flags are replayed; the time of a new verdict depends on the load.
        table["check"] = {"enable": False}
        table["recording"]["after"] = "idle"
        # A process of its own, because the daemon installs signal handlers and starts threads.
        options = [f"--config={_rig_file(directory, table)}", f"--socket={socket}"]
        process = held.enter_context(daemon_process(options, log))
        client = held.enter_context(Client(socket))
        advance = held.enter_context(stage_progress(f"replaying {out.name}"))
        await_daemon(client, process, log)
        # Even if the disk is too slow: the ring holds the lines until they are written.
        client.arm(force=True)
        client.start(out.absolute(), lines=stored.lines)
        gate.touch()  # lets the cameras deliver lines, now that the recording has begun
        status = follow(client, stored.lines, advance)
    if status.fault:
        return status.fault
    # It may have ended early without a fault, as a disk that is too slow makes it end.
    last = status.last
    if last is None or last.lines < stored.lines:
        return (
            "no recording was made"
            if last is None
            else f"the recording ended after {counted(last.lines, 'line')}: {last.end_reason}"
        )
    again, dropped = open_recording(out), sum(map(len, stored.dropped_rows()))
    for arm in again.arms:  # are more lines missing than in the original?
        # What retention has dropped is missing in the copy, too, and was not lost on the way.
        if sum(map(len, again.lost_rows(arm))) > sum(map(len, stored.lost_rows(arm))) + dropped:
            return "the rings were full"
    return None


def _rig_file(directory: Path, table: dict[str, Any]) -> Path:
    from acquire.cli.config import dotted

    path = directory / "rig.toml"
    path.write_text("\n".join(dotted(table)) + "\n", encoding="utf-8")
    return path
