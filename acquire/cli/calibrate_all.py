"""``acquire calibrate all``: the guided sequence on a running daemon."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.control import SocketOption
from acquire.cli.output import JsonFlag, note, print_facts, print_json, print_warning, say
from acquire.errors import StateError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.calibrate.calibration import Calibration, Finding
    from acquire.calibrate.exposure import Exposure
    from acquire.client import Client
    from acquire.daemon.messages import LightCode

LINES = 1024
"""That each recording has; see `acquire calibrate dark --help` and its neighbours for what they give."""
SEALED_S = 120.0
"""Longest wait for a recording to be sealed, beside the time that its lines take."""
TRIES = 3
"""Of a step, where somebody can mend what was wrong."""


@dataclass(frozen=True)
class Step:
    """One recording of the sequence: what to do before it, its light, and the steps that look at it."""

    name: str
    prepare: str
    code: LightCode
    finds: tuple[str, ...]


STEPS = (
    Step("dark", "Leave everything as in use; the light stays off.", "dark", ("dark",)),
    Step(
        "flat",
        "Put a uniform white scene in, larger than the field; the light stays on, best at 50 to 70 % of it.",
        "steady",
        ("flat", "transfer"),
    ),
    Step(
        "target",
        "Put a target in, at rest, with sharp, irregular texture: dots or bars of 2 to 6 fine pixels.",
        "rig",
        ("orientation", "align"),
    ),
)


def calibrate_all(
    out: Annotated[
        str, typer.Option("--out", metavar="CAL", help="The calibration: new, or one that is added to.")
    ],
    directory: Annotated[
        Path, typer.Option(metavar="DIR", help="Where the recordings go, which stay; made if absent.")
    ] = Path("calibration-recordings"),
    lines: Annotated[int, typer.Option(min=64, max=2**20, help="Of each recording.")] = LINES,
    only: Annotated[
        list[str] | None, typer.Option(metavar="STEP", help="dark, flat or target; repeatable. Else all.")
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Ask nothing: everything is in place already, or moves by itself.")
    ] = False,
    socket: SocketOption = None,
    json: JsonFlag = False,
) -> None:
    """Calibrate the instrument that the daemon runs: dark, flat, target, one after the other.

    Says before each recording what to do, and waits for Enter. What was found is kept step by step; begun
    again with --only, it goes on where it ended. The instrument is left as it was: armed or not.

    Example: [bold]acquire calibrate all --out cal.zarr[/]
    """
    names = [step.name for step in STEPS]
    if wrong := [each for each in only or () if each not in names]:
        raise UsageError(f"step {wrong[0]!r} is not known", possible=", ".join(names))
    steps = [step for step in STEPS if not only or step.name in only]
    found: list[Finding] = []
    with _daemon(socket) as daemon:
        was = daemon.status().state
        if was not in ("idle", "armed"):
            raise StateError(f"the daemon is {was}", possible="idle or armed", hint="acquire stop, or disarm")
        directory.mkdir(parents=True, exist_ok=True)
        run_id = daemon.status().run_id
        try:
            for step in steps:
                found += _step(daemon, step, out, directory, lines, ask=not yes, quiet=json)
        finally:
            if daemon.status().run_id != run_id:
                _leave(daemon, armed=was == "armed")
    if json:
        print_json({"calibration": out, "steps": {each.step: each.facts for each in found}})
    else:
        say(f"kept in  {out}; acquire calibrate show {out} --out DIR draws it")


def _daemon(socket: Path | None) -> Client:
    from acquire.cli.progress import teller
    from acquire.client import Client

    return Client(socket, teller())


def _step(
    daemon: Client, step: Step, out: str, directory: Path, lines: int, *, ask: bool, quiet: bool
) -> list[Finding]:
    """Record, look, keep; again where it failed and somebody is there."""
    for left in reversed(range(TRIES)):
        note(f"{step.name}: {step.prepare} {lines} lines.")
        if ask:
            _wait_for_enter()
        try:
            exposure = _record(daemon, step, directory, lines)
            found = []
            for look in _looks(step, exposure):
                found.append(_kept(out, exposure, look))
                if not quiet:
                    _tell(found[-1])
        except UsageError as error:
            if not (ask and left):
                raise
            print_warning(f"{step.name}: {error}")
            note("again:")
            continue
        return found
    raise AssertionError  # the last try returns or raises


def _record(daemon: Client, step: Step, directory: Path, lines: int) -> Exposure:
    """Arm with the step's light, record, disarm."""
    from acquire.calibrate.exposure import open_exposure
    from acquire.client import SEALED

    if daemon.status().state == "armed":
        daemon.disarm()
    daemon.arm(code=step.code, calibration="none")
    path = _free(directory, step.name)
    status = daemon.start(path, lines=lines)
    rates = [arm.rate_hz for arm in status.arms.values() if arm.rate_hz > 0]
    daemon.wait(SEALED, timeout_s=SEALED_S + lines / min(rates, default=1000.0))
    daemon.disarm()
    return open_exposure(path)


def _free(directory: Path, name: str) -> Path:
    """A name that nothing has yet: what was recorded before stays."""
    number = 1
    while (path := directory.absolute() / f"{name}-{number}.zarr").exists():
        number += 1
    return path


def _looks(step: Step, exposure: Exposure) -> Iterator[Callable[[Calibration], Finding]]:
    """What is to be found in a step's recording, given what is known."""
    from acquire.calibrate import columns, target
    from acquire.calibrate.transfer import transfer

    looks: dict[str, Callable[[Calibration], Finding]] = {
        "dark": lambda _: columns.dark(exposure),
        "flat": lambda known: columns.flat(exposure, known),
        "transfer": lambda known: transfer([exposure], known),
        "orientation": lambda known: target.orientation(exposure, known),
        "align": lambda known: target.alignment(exposure, known),
    }
    return (looks[name] for name in step.finds)


def _kept(out: str, exposure: Exposure, look: Callable[[Calibration], Finding]) -> Finding:
    """Look, and add what was found to the calibration at a place."""
    from acquire.calibrate import Calibration, open_calibration, save_calibration
    from acquire.store.source import source_of

    known = open_calibration(out) if source_of(out).exists() else Calibration(exposure.instrument)
    found = look(known)
    if found.step == "orientation" and found.orientation is None:
        raise UsageError(f"orientation: {found.warnings[0]}")
    save_calibration(out, known.with_step(found))
    return found


def _tell(found: Finding) -> None:
    from acquire.cli.calibrate_words import found_facts

    print_facts(found_facts(found))
    for text in found.warnings:
        print_warning(text)
    say()


def _wait_for_enter() -> None:
    """StateError where nobody can press it."""
    note("Enter goes on, Ctrl-C ends; what was found so far is kept")
    if not sys.stdin.readline():
        raise StateError("nobody is there to press Enter", hint="--yes, where everything is in place")


def _leave(daemon: Client, *, armed: bool) -> None:
    """The instrument as it was before."""
    from acquire.client import SEALED

    status = daemon.status()
    if status.state == "recording":
        daemon.stop()
        status = daemon.wait(SEALED, timeout_s=SEALED_S)
    if status.state == "armed":
        daemon.disarm()
    if armed:
        daemon.arm()
