"""``acquire replay``: a stored stream goes through the simulated devices into a daemon again."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.output import JsonFlag, print_facts, print_json
from acquire.cli.recordings import RecordingArgument
from acquire.errors import DataError, UsageError

if TYPE_CHECKING:
    from acquire.store.reader import Recording

HOLD_S = 2.0
"""Between arming and the first replayed line: time to start the recording that is to hold all of them."""
SPEEDS = (32.0, 16.0, 8.0, 4.0, 2.0, 1.0)
"""Tried one after the other by ``--speed 0`` until no line is lost."""
COMPARED_LINES = 65_536


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Simulation")(replay)


def replay(
    recording: RecordingArgument,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Record it again; else a daemon waits for commands.")
    ] = None,
    speed: Annotated[
        float, typer.Option(help="Simulated seconds per second; 0: as fast as no line is lost.")
    ] = 1.0,
    loop: Annotated[bool, typer.Option(help="Over and over, for a daemon under load.")] = False,
    socket: Annotated[
        Path | None, typer.Option(envvar="ACQUIRE_SOCKET", help="Control socket; else the recording's.")
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Feed a recording through the simulated devices into a daemon; the lines come out identical.

    With --out the daemon lives for one recording, which is compared with the first. Without it, it runs until
    Ctrl-C and is armed and started like any other.

    Example: [bold]acquire replay run.zarr --out again.zarr --speed 0[/]
    """
    from acquire.store import open_recording
    from acquire.store.files import check_new_path

    if not 0 <= speed <= 1000:
        raise UsageError(f"replay at speed {speed:g}", possible="0 for as fast as it goes, or up to 1000")
    stored = open_recording(recording)
    if not stored.lines:
        raise UsageError(f"replay of {recording}: it holds no lines")
    if out is None:
        _serve(stored, speed or SPEEDS[-1], loop, socket)
        return
    if loop:
        raise UsageError("replay --loop --out: it would never end", possible="one of them")
    check_new_path(out)
    used = next(pace for pace in _paces(speed) if _record(stored, out, pace, last=pace == _paces(speed)[-1]))
    facts = {"path": str(out), "lines": stored.lines, "speed": used, **compare(stored, open_recording(out))}
    if json:
        print_json(facts)
    else:
        print_facts(facts)
    if not facts["identical"]:
        raise DataError(f"{out} differs from {recording}", hint="acquire info, a slower --speed")


def compare(stored: Recording, again: Recording) -> dict[str, Any]:
    """Whether rows of the new recording are those of the first, line by line."""
    different = abs(stored.lines - again.lines)
    shift = again.first_line
    for arm in ("a", "b"):
        for start in range(0, again.lines, COMPARED_LINES):
            stop = min(start + COMPARED_LINES, again.lines)
            for name in ("lines", "code"):
                old = stored.camera(arm).read(name, start + shift, stop + shift)
                new = again.camera(arm).read(name, start, stop)
                different += int((old != new).reshape(len(old), -1).any(axis=1).sum())
    return {"identical": not different, "different_rows": different}


def _paces(speed: float) -> tuple[float, ...]:
    return (speed,) if speed else SPEEDS


def replay_settings(stored: Recording, speed: float, *, loop: bool, hold_s: float) -> dict[str, Any]:
    """The recording's own rig as a table, with cameras that replay it and the code of its rows."""
    from acquire.sim.replay import replay_code

    table: dict[str, Any] = {key: value for key, value in stored.attrs["config"].items() if key != "code"}
    code = replay_code(stored).to_attrs()
    if code["kind"] == "prbs":
        table["code"] = {"kind": "prbs", "degree": code["degree"], "state": code["seed"]}
    else:
        table["code"] = {"kind": "constant", "value": code["value"]}
    table["trigger"] = {**table["trigger"], "driver": "simulated"}
    table["simulation"] = {
        "speed": speed,
        "replay": str(stored.path.resolve()),
        "replay_loop": loop,
        "replay_hold_s": hold_s,
    }
    return table


def _rig_file(directory: Path, table: dict[str, Any]) -> Path:
    from acquire.cli.config import dotted

    path = directory / "rig.toml"
    path.write_text("\n".join(dotted(table)) + "\n", encoding="utf-8")
    return path


def _serve(stored: Recording, speed: float, loop: bool, socket: Path | None) -> None:
    """The daemon in this process, until it is told to end."""
    from acquire.cli.serve import serve

    with tempfile.TemporaryDirectory(prefix="acquire-") as directory:
        table = replay_settings(stored, speed, loop=loop, hold_s=0.0)
        table["recording"] = {**table["recording"], "directory": str(Path.cwd())}
        serve(str(_rig_file(Path(directory), table)), socket, None)


def _record(stored: Recording, out: Path, speed: float, *, last: bool) -> bool:
    """One attempt; False when lines were lost and a slower one is left."""
    from acquire.cli.demo_capture import await_daemon, daemon_process, follow
    from acquire.cli.progress import stage_progress
    from acquire.daemon.client import Client

    with (
        tempfile.TemporaryDirectory(prefix="acquire-") as name,
        stage_progress(f"replaying {out.name}") as advance,
    ):
        directory = Path(name)
        table = replay_settings(stored, speed, loop=False, hold_s=HOLD_S)
        table["recording"] = {**table["recording"], "directory": str(directory)}
        table["control"] = {"socket": str(directory / "c.sock")}
        config, log = _rig_file(directory, table), directory / "daemon.log"
        with daemon_process([f"--config={config}"], log) as process, Client(directory / "c.sock") as client:
            await_daemon(client, process, log)
            client.arm()
            client.start(out, lines=stored.lines)
            status = follow(client, stored.lines, advance)
    condition = status.last.condition if status.last else "none"
    lost = len(stored.gaps) == 0 and condition != "GOOD"
    if lost and not last:
        shutil.rmtree(out)
        return False
    if status.fault:
        raise DataError(f"replay to {out}: {status.fault}", hint="a slower --speed")
    return True
