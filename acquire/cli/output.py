"""How commands speak: facts on stdout, as text or JSON; errors on stderr.

Everything that is printed passes through here, where foreign text is made visible: a name or an attribute
of somebody else's recording can neither forge a line nor send an escape sequence to the terminal.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import sys
import textwrap
from typing import TYPE_CHECKING, Annotated, Any

import typer

from acquire.text import visible

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from acquire.errors import AcquireError

JsonFlag = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]


_IN_JSON = re.compile(r"[^ -~\n]")


def say(text: str = "", *, err: bool = False) -> None:
    """One line. What is said on stderr to nobody any more, as to a page that was killed, ends no work."""
    with contextlib.suppress(*(BrokenPipeError,) if err else ()):
        typer.echo(visible(text), err=err)


def print_json(value: Any) -> None:
    """One JSON document; what JSON does not know is written as text."""
    typer.echo(json_text(value, indent=2))


def json_text(value: Any, indent: int | None = None) -> str:
    """JSON that can be encoded and shown anywhere: what is not printable is ``\\u`` and its number."""
    text = json.dumps(value, indent=indent, default=str, ensure_ascii=False)
    return _IN_JSON.sub(
        lambda found: found[0] if found[0].isprintable() else json.dumps(found[0])[1:-1], text
    )


def print_facts(facts: Mapping[str, Any]) -> None:
    """`fact_lines`, printed."""
    for line in fact_lines(facts):
        say(line)


def fact_lines(facts: Mapping[str, Any]) -> list[str]:
    """``name  value`` per line, aligned; None is left out, several values stand side by side.

    What is longer than its line (`room`) goes on below itself, by whole words; for other programs a fact
    stays on one line.
    """
    shown = {name: value for name, value in facts.items() if value is not None}
    width = max(map(len, shown), default=0)
    return [
        line
        for name, value in shown.items()
        for line in _wrapped(f"{name:<{width}}  {visible(_words(value))}", width + 2, room())
    ]


def room(*, err: bool = False) -> int:
    """Columns of a line: those of the terminal, or what COLUMNS says for stdout; no limit in a pipe."""
    terminal = (sys.stderr if err else sys.stdout).isatty()
    asked = bool(os.environ.get("COLUMNS")) and not err
    return shutil.get_terminal_size().columns if terminal or asked else sys.maxsize


def _wrapped(text: str, indent: int, columns: int) -> list[str]:
    if len(text) <= columns:
        return [text]
    return textwrap.wrap(
        text,
        max(columns, 2 * indent),
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
        drop_whitespace=True,
        replace_whitespace=False,
    )


def _words(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_words(below)}" for name, below in value.items())
    if isinstance(value, bool):
        return "yes" if value else "no"
    return ", ".join(map(_words, value)) if isinstance(value, tuple) else str(value)


def print_table(columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """`table_lines`, printed."""
    for line in table_lines(columns, rows):
        say(line)


def table_lines(columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> list[str]:
    """A plain table, aligned; numbers to the right. Never cut: it is read by people and by grep.

    What is wider than the line (`room`) is shown row by row, a cell in a line, and no word is broken.
    """
    cells = [[visible(cell) for cell in row] for row in rows]
    titles = list(columns)
    widths = [max(map(len, column)) for column in zip(titles, *cells, strict=True)]
    if sum(widths) + 2 * (len(widths) - 1) > room():
        blocks = [fact_lines({t: cell for t, cell in zip(titles, row, strict=True) if cell}) for row in cells]
        return [line for block in blocks for line in ("", *block)][1:]
    right = [bool(cells) and all(row[i][:1].isdigit() for row in cells) for i in range(len(titles))]
    return [
        "  ".join(
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(line, widths, right, strict=True)
        ).rstrip()
        for line in (titles, *cells)
    ]


def json_asked() -> bool:
    """Whether this command was given ``--json``; also where its words are wrong and were never taken."""
    return "--json" in sys.argv[1:]


def print_error(error: AcquireError, *, as_json: bool) -> None:
    """What was asked, what is possible, what to try; on stderr. As JSON: one line, ``{"error": {…}}``."""
    if as_json:
        facts = error.to_dict()
        about = {"kind": facts.pop("error"), **facts}
        typer.echo(json_text({"error": about}), err=True)
        return
    first, *others = error.message.split("\n")
    paragraphs = [f"acquire: error: {first}", *(f"  {line.strip()}" for line in others)]
    paragraphs += [
        f"  {word}: {text}" for word, text in (("possible", error.possible), ("try", error.hint)) if text
    ]
    for paragraph in paragraphs:
        for line in _wrapped(visible(paragraph), 4, room(err=True)):
            say(line, err=True)


def print_warning(text: str) -> None:
    """What a user should know although the command did what was asked; on stderr."""
    say(f"acquire: warning: {text}", err=True)


def note(text: str) -> None:
    """What happens meanwhile; on stderr."""
    say(f"acquire: {text}", err=True)


def note_json(facts: Any) -> None:
    """The same for programs: one line of JSON on stderr."""
    say(json_text(facts), err=True)


def quantity(value: float, unit: str) -> str:
    """``value`` with three significant digits and a metric prefix: 33.3 kHz, 1.2 MB."""
    for factor, prefix in ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= factor:
            return f"{value / factor:.3g} {prefix}{unit}"
    return f"{value:.3g} {unit}"
