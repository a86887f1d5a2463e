"""``acquire bench``: find the highest line rate that this host captures and records without losing lines."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.completion import rigs
from acquire.cli.durations import seconds_between
from acquire.cli.output import JsonFlag, print_facts, print_json, print_table, quantity, say
from acquire.cli.progress import stage_progress
from acquire.errors import DeviceError

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.capacity.load import Load
    from acquire.capacity.parts import Parts
    from acquire.capacity.search import RateTrial


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Capture")(bench)


def bench(
    config: Annotated[
        str,
        typer.Option(
            "--config",
            "-c",
            metavar="RIG",
            autocompletion=rigs,
            help="Rig file, or the name of a built-in rig.",
        ),
    ] = "rig-demo",
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Override one value of the rig file, such as recording.codec=lz4. Repeatable.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Directory to record in. Default: the one in the rig file."),
    ] = None,
    seconds: Annotated[
        float,
        typer.Option(
            "--duration",
            "--seconds",
            parser=seconds_between(0.1, 600),
            metavar="TIME",
            help="Duration of each run. Default: 2s.",
            show_default=False,
        ),
    ] = 2.0,
    runs: Annotated[int, typer.Option(min=1, max=100, help="Maximum number of runs.")] = 9,
    json: JsonFlag = False,
) -> None:
    """Find the highest line rate without lost lines.

    The cameras deliver stored lines; everything else works as in a real run. Every run has its own processes,
    rings and recording, which is deleted afterwards. The exit code is 5 if lines were lost at every rate
    tried.

    Example: [bold]acquire bench --config rig-vt-4k5c-h100 --out /data[/]
    """
    from acquire.capacity.load import Load
    from acquire.capacity.parts import measure_parts
    from acquire.capacity.search import best, search_rate
    from acquire.config import load_rig, parse_settings
    from acquire.daemon.storage import choose_for

    rig = load_rig(config, parse_settings(settings or []))
    directory = (out or rig.recording.directory).absolute()
    # Chosen before anything is measured, so that the limits are those of the codec that a run would use.
    chosen = choose_for(rig, directory=directory).codec if rig.recording.codec == "auto" else None
    load = Load.of(rig, chosen)
    with stage_progress("measuring ring, codec and disk"):
        parts = measure_parts(load, directory)
    if not json:
        limits = ", ".join(f"{name} {quantity(rate, 'Hz')}" for name, rate in parts.limits.items())
        print_facts(
            {
                "lines": f"2 x {load.pixels} px {load.dtype}, codec {load.codec}",
                "recorded to": str(directory),
                "limits": limits,
            }
        )
    with stage_progress(f"recording up to {runs} times") as advance:
        reporter = _TrialReporter(advance, runs, aloud=not json)
        # From the rate that the parts reach alone: together they reach no more.
        trials = search_rate(
            load, directory, parts.line_rate_hz, seconds=seconds, progress=reporter, most_runs=runs
        )
    found = best(trials)
    if json:
        print_json(_facts(load, parts, trials, found))
    elif found is not None:
        columns = ("lines/s", "MB/s", "lost", "ring peak", "cores", "latency p99.9", "")
        # The search goes up and down; read by rate, the table shows where losses begin.
        slowest_first = sorted(trials, key=lambda trial: trial.line_rate_hz)
        say()
        print_table(columns, [_row(load, trial, found) for trial in slowest_first])
    if found is None:
        slowest = min(trial.line_rate_hz for trial in trials)
        raise DeviceError(
            f"this host lost lines at every line rate that was tried, down to {quantity(slowest, 'Hz')}",
            hint="another disk (--out), recording.codec, a longer ring (stream.ring_slots), or an idle host",
        )


class _TrialReporter:
    """Callback that reports each trial as it ends."""

    def __init__(self, advance: Callable[[int, int], None], runs: int, *, aloud: bool) -> None:
        self._advance, self._runs, self._aloud = advance, runs, aloud
        self._done = 0

    def __call__(self, trial: RateTrial) -> None:
        self._done += 1
        self._advance(self._done, self._runs)
        if self._aloud:
            result = "sustained" if trial.held else "not sustained"
            # On stderr: on stdout the trials are a table, in another order.
            say(f"  {quantity(trial.line_rate_hz, 'Hz')}: {result}", err=True)


def _row(load: Load, trial: RateTrial, found: RateTrial) -> tuple[str, ...]:
    rate, mb_s = quantity(trial.line_rate_hz, "Hz"), f"{trial.line_rate_hz * load.line_bytes / 1e6:.0f}"
    report = trial.report
    if report is None:
        return (rate, mb_s, "", "", "", "", trial.trouble)
    return (
        rate,
        mb_s,
        str(report.lost + report.unaccounted),
        f"{100 * report.ring_peak:.0f} %",
        f"{sum(report.cores.values()):.2f}",
        f"{report.latency_ms['p99.9']:.1f} ms",
        "highest without loss" if trial is found else ("sustained" if trial.held else "not sustained"),
    )


def _facts(load: Load, parts: Parts, trials: list[RateTrial], found: RateTrial | None) -> dict[str, Any]:
    measured = []
    for trial in trials:
        facts: dict[str, Any] = {"line_rate_hz": trial.line_rate_hz, "held": trial.held}
        if trial.report is None:
            facts["trouble"] = trial.trouble
        else:
            names = ("lines", "lost", "unaccounted", "ring_peak", "cores", "latency_ms")
            facts |= {name: getattr(trial.report, name) for name in names}
        measured.append(facts)
    return {
        "pixels": load.pixels,
        "dtype": load.dtype,
        "codec": str(load.codec),
        "configured_hz": load.line_rate_hz,
        "limits_hz": parts.limits,
        "highest_hz": None if found is None else found.line_rate_hz,
        "highest_bytes_per_s": None if found is None else found.line_rate_hz * load.line_bytes,
        "trials": measured,
    }
