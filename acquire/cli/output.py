"""How commands speak: facts on stdout, as text or JSON; errors on stderr."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from acquire.errors import AcquireError

JsonFlag = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]


def print_json(value: Any) -> None:
    """One JSON document; what JSON does not know is written as text."""
    typer.echo(json.dumps(value, indent=2, default=str, ensure_ascii=False))


def print_facts(facts: Mapping[str, Any]) -> None:
    """``name  value`` per line, aligned; None is left out, several values stand side by side."""
    shown = {name: value for name, value in facts.items() if value is not None}
    width = max(map(len, shown), default=0)
    for name, value in shown.items():
        typer.echo(f"{name:<{width}}  {_words(value)}")


def _words(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_words(below)}" for name, below in value.items())
    if isinstance(value, bool):
        return "yes" if value else "no"
    return ", ".join(map(_words, value)) if isinstance(value, tuple) else str(value)


def print_table(columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """A plain table, aligned; numbers to the right. Never cut: it is read by people and by grep."""
    cells = [[str(cell) for cell in row] for row in rows]
    titles = list(columns)
    widths = [max(map(len, column)) for column in zip(titles, *cells, strict=True)]
    right = [bool(cells) and all(row[i][:1].isdigit() for row in cells) for i in range(len(titles))]
    for line in (titles, *cells):
        padded = (
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(line, widths, right, strict=True)
        )
        typer.echo("  ".join(padded).rstrip())


def print_error(error: AcquireError, *, as_json: bool) -> None:
    """What was asked, what is possible, what to try; on stderr."""
    if as_json:
        typer.echo(json.dumps(error.to_dict(), ensure_ascii=False), err=True)
        return
    typer.echo(f"acquire: error: {error.message}", err=True)
    for word, text in (("possible", error.possible), ("try", error.hint)):
        if text:
            typer.echo(f"  {word}: {text}", err=True)


def print_warning(text: str) -> None:
    """What a user should know although the command did what was asked; on stderr."""
    typer.echo(f"acquire: warning: {text}", err=True)


def quantity(value: float, unit: str) -> str:
    """``value`` with three significant digits and a metric prefix: 33.3 kHz, 1.2 MB."""
    for factor, prefix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= factor:
            return f"{value / factor:.3g} {prefix}{unit}"
    return f"{value:.3g} {unit}"
