"""``acquire simulate``: record a scene, a picture or a video, and show which of its effects matter."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.completion import rigs, scenes
from acquire.cli.durations import seconds
from acquire.cli.output import JsonFlag, print_facts, print_json, print_table, say
from acquire.cli.progress import stage_progress
from acquire.errors import UsageError

if TYPE_CHECKING:
    from acquire.simulate import Study, Worth


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Simulation")(simulate)


def simulate(
    scene: Annotated[
        str,
        typer.Argument(
            metavar="SCENE",
            autocompletion=scenes,
            help="Scene file, the name of a built-in scene, a picture, a video or a .npy file.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="RECORDING", help="New recording NAME.zarr. Required without --explain."),
    ] = None,
    config: Annotated[
        str | None,
        typer.Option(
            "--config",
            "-c",
            metavar="RIG",
            autocompletion=rigs,
            help="Rig file, or the name of a built-in rig. Default: the one named in the scene file.",
        ),
    ] = None,
    lines: Annotated[
        int | None, typer.Option(help="Number of lines. Default: the number in the scene file.")
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(parser=seconds, metavar="TIME", help="Duration of the recording, instead of --lines."),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Override one value of the rig file, such as code.seed=7. Repeatable.",
        ),
    ] = None,
    explain: Annotated[
        bool, typer.Option(help="Only show the simulated effects and the cost of each; record nothing.")
    ] = False,
    advice: Annotated[bool, typer.Option(help="Show which of the scene's effects matter.")] = True,
    json: JsonFlag = False,
) -> None:
    """Record a simulated scene as fast as possible, without a daemon.

    Example: [bold]acquire simulate scene-digits --out digits.zarr[/]
    """
    from acquire.config import load_rig, load_scene, parse_settings
    from acquire.cores import limit_blas
    from acquire.simulate import bench_of, study
    from acquire.simulate import simulate as run
    from acquire.store.files import check_new_path

    if out is None and not explain:
        raise UsageError(
            "simulate needs --out, the recording to write", possible="--out NAME.zarr, or --explain"
        )
    limit_blas(1)  # both arms compute at the same time
    shown = load_scene(scene)
    # With the scene, for a rig file that names none: it was refused although a scene had been given.
    rig = load_rig(shown.rig if config is None else config, parse_settings(settings or []), scene)
    count = shown.lines if lines is None else lines
    if duration is not None:
        if lines is not None:
            raise UsageError("--lines and --duration exclude each other", possible="one of them")
        if not duration > 0:
            raise UsageError(f"--duration {duration} is out of range", possible="more than 0")
        # Rounded down to 0, a duration below half a line would record nothing.
        count = max(1, round(duration * rig.line_rate_hz))
    facts: dict[str, Any] = {}
    if out is not None and not explain:
        # Refused now, and not after the lines have been computed.
        check_new_path(out)
        with stage_progress(f"simulating {out.name}") as advance:
            done = run(rig, shown, out, count, advance)
        facts = {**asdict(done), "path": str(done.path), "speed": done.speed}
    found = None
    if explain or (advice and shown.effects):
        with stage_progress("leaving out the effects in turn"):
            found = study(bench_of(rig, shown), rig.code.build())
    if json:
        print_json({**facts, "study": found and asdict(found)})
        return
    if facts:
        lost = {arm: count for arm, count in facts["lost_lines"].items() if any(facts["lost_lines"].values())}
        print_facts(
            {
                "recording": facts["path"],
                "lines": f"{facts['lines']} of both arms, {facts['simulated_s']:.4g} s",
                "took": f"{facts['seconds']:.2f} s, {facts['speed']:.3g} x real time",
                "dropped": ", ".join(f"{arm} {count}" for arm, count in lost.items()) or None,
            }
        )
    if found:
        _print_study(found, explain=explain)


def _print_study(found: Study, *, explain: bool) -> None:
    say()
    if explain:
        rows = [("Eq. (1)", "forward", f"{found.bare_us_per_line:.2f}")]
        rows += [(worth.effect, worth.place, f"{worth.us_per_line:.2f}") for worth in found.effects]
        rows.append(("all", "", f"{found.all_us_per_line:.2f}"))
        print_table(("stage", "acts on", "us per line and arm"), rows)
        say()
    say(
        f"signal {found.signal_dn:.3g} DN RMS, temporal noise {found.noise_dn:.3g} DN RMS (rounding included)"
    )
    if found.effects:
        # An effect that loses lines has no size: the lines that are left do not change.
        by_size = sorted(found.effects, key=lambda worth: -(worth.noises or 0))
        changes = [(w.effect, f"{w.change_dn:.3g}", f"{w.noises or 0:.3g}", verdict(w)) for w in by_size]
        print_table(("left out", "change (DN)", "change (noise)", "verdict"), changes)


def verdict(worth: Worth) -> str:
    """State what the size of an effect means for the scene."""
    if worth.noises is None:
        return "loses lines, which are flagged"
    if worth.noises < 0.05:
        return f"can be left out, saves {worth.us_per_line:.2f} us per line"
    return "small relative to the noise" if worth.noises < 0.5 else "matters"
