"""``acquire demo``: the whole instrument on a simulated rig, from arming to a report."""

from __future__ import annotations

import itertools
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.cli.output import JsonFlag, print_facts, print_json
from acquire.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from acquire.config import RigConfig
    from acquire.evaluate.report import Stage

SEGMENT_LINES = 263
"""L_R of Fig. 9: 598 trusted frames."""

SEGMENT_START_S = 0.052
"""Where Fig. 9 cuts, from the start of the recording."""


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Begin here")(demo)


def demo(
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="New directory for everything; else acquire-demo, -2, …"),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Another exposure code.")] = 1,
    lines: Annotated[int, typer.Option(help="Lines to record.")] = 33_334,
    budget: Annotated[float | None, typer.Option(metavar="SECONDS", help="For the default solver.")] = None,
    twist_budget: Annotated[float, typer.Option(metavar="SECONDS", help="For the paper's solver.")] = 30.0,
    config: Annotated[str, typer.Option("--config", "-c", metavar="FILE", help="Rig file.")] = "rig-demo",
    json: JsonFlag = False,
) -> None:
    """Record Scene #1 of the paper with a simulated rig, reconstruct it, and write a report.

    A real daemon is started, armed, and records; nothing is left running.

    Example: [bold]acquire demo --out /tmp/demo --seed 7[/]
    """
    from acquire.cli.demo_analysis import analyse
    from acquire.cli.demo_capture import record
    from acquire.config import load_rig
    from acquire.evaluate.report import write_report

    rig = load_rig(config, {"code.seed": seed})
    out = out or _free(Path("acquire-demo"))
    _check(out, lines, rig)
    out.mkdir(parents=True)
    journal = Journal()
    capture = record(out, config, seed, lines, journal)
    command = f"acquire demo --seed {seed} --lines {lines}"
    result = analyse(out, capture, rig, journal, seed, command, (budget, twist_budget))
    with journal.stage("Write the report"):
        page = write_report(result, out)
    if json:
        print_json({"report": str(page), **result.summary()})
        return
    print_facts(_headline(page, result.summary()))


@dataclass
class Journal:
    """The stages of the run: told on stderr as they happen, kept for the report."""

    stages: list[Stage] = field(default_factory=list)
    when: datetime = field(default_factory=lambda: datetime.now(UTC))

    @contextmanager
    def stage(self, name: str) -> Iterator[dict[str, str]]:
        """Times a stage; ``detail`` may be set in the dictionary given."""
        from acquire.evaluate.report import Stage

        note: dict[str, str] = {}
        started = time.perf_counter()
        yield note
        seconds = time.perf_counter() - started
        self.stages.append(Stage(name, seconds, note.get("detail", "")))
        detail = f"  {note['detail']}" if "detail" in note else ""
        typer.echo(f"{name:<34} {seconds:6.1f} s{detail}", err=True)


def _free(path: Path) -> Path:
    """``path``, or with the first number behind it that is free."""
    names = (path if n == 1 else path.with_name(f"{path.name}-{n}") for n in itertools.count(1))
    return next(name for name in names if not name.exists())


def _check(out: Path, lines: int, rig: RigConfig) -> None:
    if out.exists():
        raise UsageError(f"demo to {out}: it exists and stays untouched", hint="--out with a new directory")
    if not out.absolute().parent.is_dir():
        raise UsageError(f"demo to {out}: there is no directory {out.absolute().parent}")
    least = round(SEGMENT_START_S * rig.line_rate_hz) + SEGMENT_LINES
    if lines < least:
        raise UsageError(
            f"demo of {lines} lines", possible=f"{least} or more: it cuts {SEGMENT_LINES} at 52 ms"
        )


def _headline(page: Path, summary: dict[str, Any]) -> dict[str, Any]:
    capture, best = summary["capture"], summary["solvers"][0]
    arms = capture["arms"]
    return {
        "lines": ", ".join(
            f"{arm} {facts['recorded']} recorded, {facts['missing']} missing" for arm, facts in arms.items()
        ),
        "recording": f"{capture['recording']}, {capture['size_mb']} MB, {capture['condition']}",
        **{
            solver["label"]: f"{solver['psnr_db']} dB, SSIM {solver['ssim']}, {solver['seconds']} s"
            for solver in summary["solvers"]
        },
        "frequencies": ", ".join(
            f"{curve['name']} {curve['measured_hz']} Hz" for curve in best["curves"] if curve["measured_hz"]
        ),
        "report": page,
    }
