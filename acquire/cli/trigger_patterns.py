"""``acquire trigger blink | square``: drive the light with a square wave, to check wires and levels.

The pattern is loaded into the code memory and runs like an ordinary code, so the test uses the same pins,
levels, delays and watchdog as a measurement.
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
        "--duration",
        "--seconds",
        parser=seconds_between(0.1, 86400),
        metavar="TIME",
        help="End after this time. Default: at Ctrl-C.",
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
    """Blink the light slowly enough to see, while the cameras receive their line triggers.

    No camera is needed. The test shows that the trigger controls the light and which level turns it on: it is
    dark before, between and after the flashes. It runs until Ctrl-C or for --duration; then the light is off.

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
            help="Number of sub-steps for which the light is on, and for which it is then off. 1 is the "
            "fastest. Default: one line.",
        ),
    ] = None,
    seconds: SecondsOption = None,
    json: JsonFlag = False,
) -> None:
    """Drive the light with a square wave in step with the lines, for an oscilloscope.

    By default the light is on for one line and off for the next. Its edges then coincide with the line
    starts, so that an oscilloscope on the line trigger and a photodiode shows the delay of the light.
    --substeps 1 is the fastest light of this rig. The test runs until Ctrl-C, or for --duration; then the
    light is off.

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
    """Load and run the pattern, then turn the light off; print the signals to expect, and the counts."""
    from acquire.cli.interrupts import stop_on_interrupt
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
    with stop_on_interrupt("turning the light off") as stop_requested:
        # Not during a run, which may read its code from the same memory.
        if device.status().at_rest:
            device.load_code(wave.bits)
        driver.prepare(run)  # refuses if another run is in progress
        facts = _facts(rig, wave, device.capabilities.clock_hz)
        try:
            driver.start()
            if not json:
                print_facts({name: facts[name] for name in ("light", "trigger_a", "trigger_b")})
                note("running" + (" until Ctrl-C" if seconds is None else f" for {seconds:g} s"))
            _wait(driver, stop_requested, seconds)
            counted = {key: value for key, value in driver.statistics().items() if key.startswith("strobe")}
        finally:
            # Also after an error: the light must not stay on.
            lines = driver.stop()
    if json:
        print_json(facts | {"lines": lines} | counted)
        return
    # A camera without a strobe answers no pulse: there is nothing to count.
    strobes = {
        f"camera {arm}": f"{counted[f'strobe_{arm}_seen']} strobes, {counted[f'strobe_{arm}_missed']} missed"
        for arm, output in (("a", rig.trigger.a), ("b", rig.trigger.b))
        if output.strobe
    }
    print_facts({"lines": lines, **strobes})


def _wait(driver: TriggerDriver, stop_requested: threading.Event, seconds: float | None) -> None:
    """Wait for the end, and keep the watchdog from ending the run. Raises TriggerError if it ends early."""
    from acquire.errors import TriggerError

    end_s = time.monotonic() + seconds if seconds is not None else float("inf")
    while not stop_requested.is_set() and (left_s := end_s - time.monotonic()) > 0:
        driver.tags(min(_LOOK_S, left_s))
        status = driver.device().status()
        if status.at_rest:
            raise TriggerError(f"the run ended unexpectedly: {status}", hint="acquire trigger info")


def _facts(rig: RigConfig, wave: SquareWave, clock_hz: int) -> dict[str, Any]:
    """Describe the signals on the pins, by their names in `firmware/ELECTRICAL.md`."""
    substep_s = wave.substep_ticks / clock_hz
    per_line = rig.trigger.line_start == "per-line"
    # Otherwise the cameras get a pulse in every sub-step (trigger.line_start).
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
