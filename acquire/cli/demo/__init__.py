"""``acquire demo``: the whole instrument on a simulated rig, from arming to a report."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from acquire.cli.completion import rigs
from acquire.cli.demo.plan import (
    LINES,
    RIG,
    SEED,
    TWIST_BUDGET_S,
    DemoPlan,
    check,
    rig_of,
    trigger_settings,
)
from acquire.cli.durations import seconds
from acquire.cli.journal import Journal
from acquire.cli.output import JsonFlag, print_facts, print_json


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Begin here")(demo)


def demo(
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="New directory for everything; else acquire-demo, -2, …"),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the exposure code.")] = SEED,
    lines: Annotated[int, typer.Option(help="Number of lines that are recorded.")] = LINES,
    budget: Annotated[
        float | None, typer.Option(parser=seconds, metavar="TIME", help="Wall time of the default solver.")
    ] = None,
    twist_budget: Annotated[
        float, typer.Option(parser=seconds, metavar="TIME", help="Wall time of the paper's solver.")
    ] = TWIST_BUDGET_S,
    config: Annotated[
        str,
        typer.Option(
            "--config",
            "-c",
            metavar="FILE",
            autocompletion=rigs,
            help="Rig file, or the name of a built-in one.",
        ),
    ] = RIG,
    trigger: Annotated[
        Literal["simulated", "rtl"],
        typer.Option(help="A model of the sync trigger, or its gateware itself, clock by clock."),
    ] = "simulated",
    cameras: Annotated[
        Literal["simulated", "gentl", "gige"],
        typer.Option(help="Cameras in the grabbers, or behind a GenTL producer or GigE Vision."),
    ] = "simulated",
    json: JsonFlag = False,
) -> None:
    """Record Scene #1 of the paper with a simulated rig, reconstruct it, and write a report.

    A real daemon is started, armed, and records; nothing is left running.

    Example: [bold]acquire demo --out /tmp/demo --seed 7[/]
    """
    from acquire.config import load_rig

    config = rig_of(config, cameras)
    plan = DemoPlan(
        out=out or _free(Path("acquire-demo")),
        config=config,
        seed=seed,
        lines=lines,
        budget_s=budget,
        twist_budget_s=twist_budget,
        trigger=trigger,
    )
    rig = load_rig(config, trigger_settings(plan))
    check(plan, rig)

    from acquire.cli.demo.analysis import analyse
    from acquire.cli.demo.capture import compile_gateware, record
    from acquire.evaluate.report import write_report
    from acquire.evaluate.summary import summarise

    plan.out.mkdir()
    journal = Journal()
    if rig.trigger.driver == "rtl":
        compile_gateware(rig, journal)
    result = analyse(plan, record(plan, journal), rig, journal)
    with journal.stage("Write the report"):
        page = write_report(result, plan.out)
    if json:
        print_json({"report": str(page), **summarise(result)})
        return
    print_facts(_headline(page, summarise(result)))


def _free(path: Path) -> Path:
    """``path``, or with the first number behind it that is free."""
    names = (path if n == 1 else path.with_name(f"{path.name}-{n}") for n in itertools.count(1))
    return next(name for name in names if not name.exists())


def _headline(page: Path, summary: dict[str, Any]) -> dict[str, Any]:
    capture, best = summary["capture"], summary["solvers"][0]
    arms = capture["arms"]
    return {
        "lines": ", ".join(
            f"{arm} {facts['recorded']} recorded, {facts['missing']} missing" for arm, facts in arms.items()
        ),
        "recording": f"{capture['recording']}, {capture['size_mb']} MB, {capture['condition']}",
        **{solver["label"]: _solver(solver) for solver in summary["solvers"]},
        "frequencies": ", ".join(
            f"{curve['name']} {curve['measured_hz']} Hz" for curve in best["curves"] if curve["measured_hz"]
        ),
        "report": page,
    }


def _solver(facts: dict[str, Any]) -> str:
    text = f"{facts['psnr_db']} dB, SSIM {facts['ssim']}, {facts['seconds']} s"
    if facts["stopped_by_budget_s"] is None:
        return text
    return (
        f"{text}, {facts['iterations']} of {facts['requested_iterations']} iterations "
        f"(stopped by its budget of {facts['stopped_by_budget_s']:g} s)"
    )
