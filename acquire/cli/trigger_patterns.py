"""``acquire trigger blink | square``: the light as a square wave, to see that wires and levels are right.

The code memory holds the pattern and the run is an ordinary one, so that what is seen here is what a
measurement has: the same pins, levels, delays and watchdog.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.durations import seconds_between
from acquire.cli.output import JsonFlag, note, print_facts, print_json, quantity
from acquire.cli.trigger_device import ConfigOption, SetOption, UrlOption, device_of

if TYPE_CHECKING:
    import threading

    from acquire.config import RigConfig
    from acquire.trigger.driver import TriggerDriver
    from acquire.trigger.patterns import SquareWave

_LOOK_S = 0.2

SecondsOption = Annotated[
    float | None,
    typer.Option(
        parser=seconds_between(0.1, 86400), metavar="TIME", help="End after this time; absent: at Ctrl-C."
    ),
]


def blink(
    config: ConfigOption = "rig-demo",
    url: UrlOption = None,
    settings: SetOption = None,
    hz: Annotated[float, typer.Option(min=1e-3, max=1e9, help="Flashes per second.")] = 2.0,
    seconds: SecondsOption = None,
    json: JsonFlag = False,
) -> None:
    """Let the light blink, slowly enough for the eye, while the cameras get their line triggers.

    Needs no camera. Shows that the light is the trigger's and which level lights it: dark before, between and
    after. Runs until Ctrl-C or --seconds, then the light is off.

    Example: [bold]acquire trigger blink --url /dev/ttyUSB0[/]
    """
    from acquire.trigger import patterns

    with device_of(config, url, settings) as (driver, rig):
        ticks = rig.trigger.substep_ticks
        wave = patterns.blink(hz, ticks, driver.device().capabilities)
        _run(driver, rig, wave, "blink", seconds, json=json)


def square(
    config: ConfigOption = "rig-demo",
    url: UrlOption = None,
    settings: SetOption = None,
    substeps: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=2**31,
            help="That the light is on, and then off; 1 is the fastest. Absent: those of a line.",
        ),
    ] = None,
    seconds: SecondsOption = None,
    json: JsonFlag = False,
) -> None:
    """Let the light be a square wave of the instrument's own pace, for an oscilloscope.

    A line lit, a line dark: the light's edges then stand at every line start, so that a scope on the line
    trigger and a photodiode shows how late the light is. --substeps 1 is the fastest light of this rig.
    Runs until Ctrl-C or --seconds, then the light is off.

    Example: [bold]acquire trigger square --url /dev/ttyUSB0 --substeps 1[/]
    """
    from acquire.trigger import patterns

    with device_of(config, url, settings) as (driver, rig):
        half = substeps or rig.geometry.substeps
        wave = patterns.square(half, rig.trigger.substep_ticks, driver.device().capabilities)
        _run(driver, rig, wave, "square", seconds, json=json)


def _run(
    driver: TriggerDriver,
    rig: RigConfig,
    wave: SquareWave,
    name: str,
    seconds: float | None,
    *,
    json: bool,
) -> None:
    """Load the pattern, run it until it is time, light off; say what is to be seen, and what was counted."""
    from acquire.cli.interrupts import first_interrupt_asks
    from acquire.daemon.plan import new_run_id
    from acquire.trigger.base import TriggerRun
    from acquire.trigger.settings import LoadedCode

    device = driver.device()
    run = TriggerRun(
        run_id=new_run_id(f"{rig.name}-{name}"),
        code=LoadedCode(wave.bits),
        substeps=rig.geometry.substeps,
        substep_ticks=wave.substep_ticks,
        tag_every_lines=rig.trigger.tag_every_lines,
    )
    with first_interrupt_asks("light off") as asked:
        if device.status().at_rest:
            device.load_code(wave.bits)
        driver.prepare(run)  # which refuses where another run is under way
        facts = _facts(rig, wave, device.capabilities.clock_hz)
        try:
            driver.start()
            if not json:
                print_facts({name: facts[name] for name in ("light", "trigger_a", "trigger_b")})
                note("runs" + (" until Ctrl-C" if seconds is None else f" for {seconds:g} s"))
            _until(driver, asked, seconds)
            counted = {key: value for key, value in driver.statistics().items() if key.startswith("strobe")}
        finally:
            lines = driver.stop()
    if json:
        print_json(facts | {"lines": lines} | counted)
        return
    print_facts({"lines": lines, **_answers(rig, counted)})


def _until(driver: TriggerDriver, asked: threading.Event, seconds: float | None) -> None:
    """Keep the watchdog quiet until it is time. TriggerError where the run ends by itself."""
    from acquire.errors import TriggerError

    end_s = time.monotonic() + seconds if seconds is not None else float("inf")
    while not asked.is_set() and (left_s := end_s - time.monotonic()) > 0:
        driver.tags(min(_LOOK_S, left_s))
        status = driver.device().status()
        if status.at_rest:
            raise TriggerError(f"the run ended by itself: {status}", hint="acquire trigger info")


def _facts(rig: RigConfig, wave: SquareWave, clock_hz: int) -> dict[str, Any]:
    """What the pins do, by the names of `firmware/ELECTRICAL.md`."""
    substep_s = wave.substep_ticks / clock_hz
    per_line = rig.trigger.line_start == "per-line"
    pulses_hz = 1 / substep_s / (rig.geometry.substeps if per_line else 1)
    hz = wave.frequency_hz(clock_hz)
    lit_s = wave.half_substeps * substep_s
    facts = {
        "light": f"{quantity(hz, 'Hz')}: {_time(lit_s)} lit, {_time(lit_s)} dark",
        "light_hz": hz,
        "substep_ticks": wave.substep_ticks,
        "half_substeps": wave.half_substeps,
    }
    for arm, output in (("a", rig.trigger.a), ("b", rig.trigger.b)):
        facts[f"trigger_{arm}"] = f"{quantity(pulses_hz, 'Hz')} pulses" if output.enable else "off"
    return facts


def _time(seconds: float) -> str:
    for factor, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
        if seconds >= factor:
            return f"{seconds / factor:.4g} {unit}"
    return f"{seconds * 1e9:.4g} ns"


def _answers(rig: RigConfig, counted: dict[str, Any]) -> dict[str, str]:
    """Strobes of the cameras that answer, in words."""
    return {
        f"camera {arm}": f"{counted[f'strobe_{arm}_seen']} strobes, {counted[f'strobe_{arm}_missed']} missed"
        for arm, output in (("a", rig.trigger.a), ("b", rig.trigger.b))
        if output.strobe
    }
