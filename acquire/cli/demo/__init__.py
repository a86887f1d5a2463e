"""``acquire demo``: run the whole instrument on a simulated rig, from arming to a report."""

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
from acquire.cli.journal import StepJournal
from acquire.cli.output import JsonFlag, print_facts, print_json
from acquire.cli.places import make_directory


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Begin here")(demo)


def demo(
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="New directory for all results. Default: acquire-demo, acquire-demo-2 and so on.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the exposure code.")] = SEED,
    lines: Annotated[int, typer.Option(help="Number of lines to record.")] = LINES,
    budget: Annotated[
        float | None,
        typer.Option(
            parser=seconds, metavar="TIME", help="Time limit for the default solver. Default: no limit."
        ),
    ] = None,
    twist_budget: Annotated[
        float,
        typer.Option(
            parser=seconds,
            metavar="TIME",
            help=f"Time limit for the paper's solver, TwIST. Default: {TWIST_BUDGET_S:g}s.",
            show_default=False,
        ),
    ] = TWIST_BUDGET_S,
    config: Annotated[
        str,
        typer.Option(
            "--config",
            "-c",
            metavar="RIG",
            autocompletion=rigs,
            help="Rig file, or the name of a built-in rig.",
        ),
    ] = RIG,
    trigger: Annotated[
        Literal["simulated", "rtl"],
        typer.Option(help="Sync trigger: a model of it, or its gateware, simulated clock by clock (rtl)."),
    ] = "simulated",
    cameras: Annotated[
        Literal["simulated", "gentl", "gige"],
        typer.Option(help="Simulated cameras: built in, behind a GenTL producer, or over GigE Vision."),
    ] = "simulated",
    json: JsonFlag = False,
) -> None:
    """Record Scene #1 of the paper with a simulated rig, reconstruct it, and write a report.

    The command starts a real daemon, arms it, records with it, and stops it again afterwards.

    Example: [bold]acquire demo --out /tmp/demo --seed 7[/]
    """
    from acquire.config import load_rig

    config = rig_of(config, cameras)
    names = (Path(f"acquire-demo-{n}" if n > 1 else "acquire-demo") for n in itertools.count(1))
    plan = DemoPlan(
        out=out or next(name for name in names if not name.exists()),
        config=config,
        seed=seed,
        lines=lines,
        budget_s=budget,
        twist_budget_s=twist_budget,
        trigger=trigger,
    )
    rig = load_rig(config, trigger_settings(plan))
    # Before the slow imports, and before anything is written.
    check(plan, rig)

    from acquire.cli.demo.analysis import analyse
    from acquire.cli.demo.capture import compile_gateware, record, removed_if_interrupted
    from acquire.evaluate.report import write_report
    from acquire.evaluate.summary import summarise

    # Fails if it was made since the check: nobody else's directory is filled.
    make_directory(plan.out)
    journal = StepJournal()
    with removed_if_interrupted(plan.out):
        if rig.trigger.driver == "rtl":
            compile_gateware(rig, journal)
        captured = record(plan, journal)
    result = analyse(plan, captured, rig, journal)
    with journal.stage("Write the report"):
        page = write_report(result, plan.out)
    if json:
        print_json({"report": str(page), **summarise(result)})
        return
    print_facts(_headline(page, summarise(result)))


def _headline(page: Path, summary: dict[str, Any]) -> dict[str, Any]:
    capture, best = summary["capture"], summary["solvers"][0]
    arms = capture["arms"]
    solvers = {}
    for facts in summary["solvers"]:
        text = f"{facts['psnr_db']} dB, SSIM {facts['ssim']}, {facts['seconds']} s"
        if facts["stopped_by_budget_s"] is not None:
            text += (
                f", {facts['iterations']} of {facts['requested_iterations']} iterations "
                f"(stopped by its time limit of {facts['stopped_by_budget_s']:g} s)"
            )
        solvers[facts["label"]] = text
    return {
        "lines": ", ".join(
            f"{arm} {facts['recorded']} recorded, {facts['missing']} missing" for arm, facts in arms.items()
        ),
        "recording": f"{capture['recording']}, {capture['size_mb']} MB, {capture['condition']}",
        **solvers,
        # A constant lamp has none.
        "frequencies": ", ".join(
            f"{curve['name']} {curve['measured_hz']} Hz" for curve in best["curves"] if curve["measured_hz"]
        ),
        "report": page,
    }
