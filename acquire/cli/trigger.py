"""``acquire trigger``: operate the sync trigger directly. Its test patterns are in
`acquire.cli.trigger_patterns`.

These commands talk to the device and not to the daemon. They fail with a message while a daemon uses the
port.
"""

from __future__ import annotations

import json as json_text
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from acquire.cli.durations import seconds_between
from acquire.cli.output import JsonFlag, print_facts, print_json, say
from acquire.cli.trigger_device import ConfigOption, SetOption, UrlOption, device_of
from acquire.cli.trigger_patterns import blink, square
from acquire.codes import ListedCode
from acquire.errors import TriggerError
from acquire.text import counted

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.trigger.device import Device
    from acquire.trigger.registers import TagRecord

_LOOK_S = 0.2


def register(app: typer.Typer) -> None:
    group = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")
    for command in (info, load, arm, stop, selftest, monitor, blink, square):
        group.command()(command)
    app.add_typer(
        group,
        name="trigger",
        help="Operate the sync trigger directly, without the daemon.",
        rich_help_panel="Rig",
    )


def info(
    config: ConfigOption = "rig-demo",
    url: UrlOption = None,
    settings: SetOption = None,
    json: JsonFlag = False,
) -> None:
    """Show the identity, the capabilities and the current state of the trigger.

    Example: [bold]acquire trigger info --url /dev/ttyUSB0[/]
    """
    from acquire.trigger.device import facts_of

    with device_of(config, url, settings) as (driver, _):
        facts = {"model": driver.identify().model, **facts_of(driver.device().capabilities)}
        facts |= {**facts_of(driver.device().status()), **driver.statistics()}
    if json:
        print_json(facts)
        return
    print_facts(facts)


def load(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="File with the code: text of 0 and 1 (white space is ignored) or of 0x…, or a .npy array.",
        ),
    ],
    config: ConfigOption = "rig-demo",
    url: UrlOption = None,
    settings: SetOption = None,
    json: JsonFlag = False,
) -> None:
    """Load a code into the code memory, let the device check it, and read it back.

    Example: [bold]acquire trigger load code.txt --url /dev/ttyUSB0[/]
    """
    from acquire.exchange import parse_code

    # By an absolute path, since a name such as 0x1f would be read as the bits themselves.
    code = parse_code(f"bits:{file.absolute()}")
    assert isinstance(code, ListedCode)
    bits = code.bits(0, code.length)
    with device_of(config, url, settings) as (driver, _):
        device = driver.device()
        begun_s = time.monotonic()
        crc = device.load_code(bits)
        facts = {"bits": len(bits), "ones": int(bits.sum()), "crc": f"{crc:#010x}"}
        facts["load_ms"] = round((time.monotonic() - begun_s) * 1000, 1)
        # The device's CRC has covered its memory, but not what a host reads from it.
        if (device.read_code(len(bits)) != bits).any():
            raise TriggerError(
                "the code memory reads back differently from what was loaded",
                hint="acquire trigger load once more, then acquire trigger selftest",
            )
    if json:
        print_json(facts)
        return
    print_facts(facts)


def arm(
    config: ConfigOption = "rig-demo",
    url: UrlOption = None,
    settings: SetOption = None,
    run_id: Annotated[
        str | None, typer.Option(metavar="NAME", help="Name of the run. Default: a new name.")
    ] = None,
    start: Annotated[bool, typer.Option("--start", help="Also start the run.")] = False,
    memory: Annotated[
        bool,
        typer.Option("--memory", help="Use the code loaded by `acquire trigger load` instead of the rig's."),
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Configure the trigger as in the rig file and arm it. It stays armed when the command ends.

    Without a host, a run ends with the light off after [bold]trigger.watchdog_s[/] (10 s). `acquire trigger
    monitor` keeps it running; trigger.watchdog_s = 0 disables the watchdog.

    Example: [bold]acquire trigger arm --url /dev/ttyUSB0 --set trigger.substep_ticks=50 --start[/]
    """
    from dataclasses import replace

    from acquire.daemon.plan import new_run_id
    from acquire.trigger.base import TriggerRun
    from acquire.trigger.device import facts_of
    from acquire.trigger.settings import LoadedCode

    with device_of(config, url, settings) as (driver, rig):
        run = TriggerRun(
            run_id=run_id or new_run_id(rig.name),
            code=rig.code.build(),
            substeps=rig.geometry.substeps,
            substep_ticks=rig.trigger.substep_ticks,
            tag_every_lines=rig.trigger.tag_every_lines,
        )
        if memory:
            # A run states its code bit by bit: what is in the device is read back.
            run = replace(run, code=LoadedCode(driver.device().read_code(driver.device().code_length())))
        driver.prepare(run)
        fit = driver.start() if start else None
        facts = {"run_id": run.run_id, **facts_of(driver.device().status())}
        facts["utc_ns_at_tick_0"] = fit and fit.utc_ns_at_tick_0
        facts["watchdog_s"] = rig.trigger.watchdog_s
    if json:
        print_json(facts)
        return
    print_facts(facts)


def stop(
    config: ConfigOption = "rig-demo",
    url: UrlOption = None,
    settings: SetOption = None,
    json: JsonFlag = False,
) -> None:
    """End the trigger's run after a complete line, with the light off.

    Example: [bold]acquire trigger stop --url /dev/ttyUSB0[/]
    """
    with device_of(config, url, settings) as (driver, _):
        # This opens the link, without which `stop` would have nothing to end.
        driver.device()
        lines = driver.stop()
    if json:
        print_json({"lines": lines})
        return
    say(f"stopped after {counted(lines, 'line')}")


def selftest(
    config: ConfigOption = "rig-demo",
    url: UrlOption = None,
    settings: SetOption = None,
    json: JsonFlag = False,
) -> None:
    """Let the trigger test its memory, its code generator and its checksum unit.

    Example: [bold]acquire trigger selftest --url /dev/ttyUSB0[/]
    """
    with device_of(config, url, settings) as (driver, _):
        result = driver.device().self_test()
    failed = [name.removesuffix("_failed") for name, bit in result.items() if name != "done" and bit]
    # A self-test that was not run has found nothing wrong, either.
    if failed or not result["done"]:
        raise TriggerError(
            f"the self-test failed: {', '.join(failed) or 'it was not run'}",
            hint="load its bitstream again, or power it off and on; if it fails again, replace the board",
        )
    if json:
        print_json({"passed": True})
        return
    say("the self-test passed")


def monitor(
    config: ConfigOption = "rig-demo",
    url: UrlOption = None,
    settings: SetOption = None,
    tags: Annotated[
        int | None, typer.Option(min=1, help="End after this number of tags. Default: no limit.")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            "--duration",
            "--seconds",
            parser=seconds_between(0),
            metavar="TIME",
            help="End after this time. Default: no limit.",
        ),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Print the trigger's tags as they arrive, until the run ends or Ctrl-C. With --json, one object per
    line.

    Example: [bold]acquire trigger monitor --url /dev/ttyUSB0 --duration 5[/]
    """
    from itertools import islice

    from acquire.trigger.registers import TagFlag

    with device_of(config, url, settings) as (driver, _):
        for tag in islice(_watch(driver.device(), seconds), tags):
            facts = {
                "line": tag.line,
                "code_index": tag.code_index,
                "time": tag.timestamp,
                "flags": "+".join(str(flag.name) for flag in TagFlag if tag.flags & flag),
            }
            text = json_text.dumps(facts) if json else "  ".join(f"{k} {v}" for k, v in facts.items())
            say(text)


def _watch(device: Device, seconds: float | None) -> Iterator[TagRecord]:
    """Yield the tags of the current run. Polling the status keeps the watchdog from ending the run."""
    from acquire.trigger.registers import TagFlag

    if device.status().at_rest:
        raise TriggerError(
            "there are no tags to monitor: no run is armed or running", hint="acquire trigger arm --start"
        )
    end_s = time.monotonic() + seconds if seconds is not None else float("inf")
    while time.monotonic() < end_s:
        for _, tag in device.link.tags(min(_LOOK_S, max(0.0, end_s - time.monotonic()))):
            yield tag
            if tag.flags & TagFlag.LAST:
                return
        # Any valid request resets the watchdog, also while no tags come.
        device.status()
