"""Output of the commands: results on stdout, as text or JSON; errors and notes on stderr.

Everything that is printed passes through here, where unprintable characters of foreign text are escaped: a
name or an attribute of somebody else's recording can neither forge a line nor send an escape sequence to the
terminal.
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
    """Print one line. A stderr that takes nothing (a closed pipe, a full disk) does not end the work."""
    if not err:
        _write(visible(text))
        return
    with contextlib.suppress(OSError):
        typer.echo(visible(text), err=True)


def print_json(value: Any) -> None:
    """Print one JSON document; values of other types are written as text."""
    # Not by `say`, which would escape the line breaks of the document.
    _write(json_text(value, indent=2))


def _write(text: str) -> None:
    try:
        typer.echo(text)
    except OSError as error:
        # An error of a stream names none, and then no user knows what is full.
        error.filename = "standard output"
        raise


def json_text(value: Any, indent: int | None = None) -> str:
    """Return JSON that can be encoded and shown anywhere: unprintable characters become ``\\uXXXX``."""
    text = json.dumps(value, indent=indent, default=str, ensure_ascii=False)
    # Readable where it can be: only what a terminal could take for a command is escaped.
    return _IN_JSON.sub(
        lambda found: found[0] if found[0].isprintable() else json.dumps(found[0])[1:-1], text
    )


def print_facts(facts: Mapping[str, Any]) -> None:
    """Print `fact_lines`."""
    for line in fact_lines(facts):
        say(line)


def fact_lines(facts: Mapping[str, Any]) -> list[str]:
    """Return ``name  value`` lines, aligned. None is left out; the items of a tuple are joined by commas.

    On a terminal, values that are longer than the line (`line_width`) are wrapped between words; in a pipe
    each fact stays on one line.
    """
    shown = {name: value for name, value in facts.items() if value is not None}
    width = max(map(len, shown), default=0)
    return [
        line
        for name, value in shown.items()
        for line in _wrapped(f"{name:<{width}}  {visible(_text_of(value))}", width + 2, line_width())
    ]


def line_width(*, err: bool = False) -> int:
    """Return the width of a line: that of the terminal, or COLUMNS for stdout; unlimited in a pipe."""
    terminal = (sys.stderr if err else sys.stdout).isatty()
    # Shells set COLUMNS without exporting it: who has exported it asks for this width.
    requested = bool(os.environ.get("COLUMNS")) and not err
    return shutil.get_terminal_size().columns if terminal or requested else sys.maxsize


def _wrapped(text: str, indent: int, columns: int) -> list[str]:
    if len(text) <= columns:
        return [text]
    return textwrap.wrap(
        text,
        # A terminal narrower than the names would leave no room for the values.
        max(columns, 2 * indent),
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
        drop_whitespace=True,
        replace_whitespace=False,
    )


def _text_of(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text_of(below)}" for name, below in value.items())
    if isinstance(value, bool):
        return "yes" if value else "no"
    return ", ".join(map(_text_of, value)) if isinstance(value, tuple) else str(value)


def print_table(columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Print `table_lines`."""
    for line in table_lines(columns, rows):
        say(line)


def table_lines(columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> list[str]:
    """Return a plain, aligned table; numbers are right-aligned. Nothing is truncated: grep reads it, too.

    A table that is wider than the line (`line_width`) is shown row by row, with one cell per line.
    """
    cells = [[visible(cell) for cell in row] for row in rows]
    titles = list(columns)
    widths = [max(map(len, column)) for column in zip(titles, *cells, strict=True)]
    # A row that the terminal breaks can be read by nobody.
    if sum(widths) + 2 * (len(widths) - 1) > line_width():
        # Without the empty cells, each of which would take a line of its own here.
        blocks = [fact_lines({t: cell for t, cell in zip(titles, row, strict=True) if cell}) for row in cells]
        return [line for block in blocks for line in ("", *block)][1:]
    # By their first characters, since numbers have units.
    right = [bool(cells) and all(row[i][:1].isdigit() for row in cells) for i in range(len(titles))]
    return [
        "  ".join(
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(line, widths, right, strict=True)
        ).rstrip()
        for line in (titles, *cells)
    ]


def json_requested() -> bool:
    """Whether ``--json`` is on the command line, even if that could not be parsed."""
    return "--json" in sys.argv[1:]


def print_error(error: AcquireError, *, as_json: bool) -> None:
    """Print an error to stderr: the message, what is possible, what to try. As JSON: ``{"error": {…}}``."""
    if as_json:
        # `kind`, since the object itself is called error.
        facts = error.to_dict()
        about = {"kind": facts.pop("error"), **facts}
        # As a whole, so that a program finds one document on stderr.
        note_json({"error": about})
        return
    first, *others = error.message.split("\n")
    paragraphs = [f"acquire: error: {first}", *(f"  {line.strip()}" for line in others)]
    paragraphs += [
        f"  {word}: {text}" for word, text in (("possible", error.possible), ("try", error.hint)) if text
    ]
    for paragraph in paragraphs:
        for line in _wrapped(visible(paragraph), 4, line_width(err=True)):
            say(line, err=True)


def print_warning(text: str) -> None:
    """Print a warning to stderr: something the user should know although the command succeeded."""
    say(f"acquire: warning: {text}", err=True)


def note(text: str) -> None:
    """Print to stderr what the command is doing."""
    say(f"acquire: {text}", err=True)


def note_json(facts: Any) -> None:
    """Print one line of JSON to stderr, for programs."""
    say(json_text(facts), err=True)


def quantity(value: float, unit: str) -> str:
    """Format ``value`` with three significant digits and a metric prefix: 33.3 kHz, 1.2 MB."""
    # Rounded first: 999.6 Hz are 1 kHz, and would be 1e+03 Hz otherwise.
    rounded = float(f"{value:.3g}")
    for factor, prefix in ((1e18, "E"), (1e15, "P"), (1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(rounded) >= factor:
            return f"{rounded / factor:.3g} {prefix}{unit}"
    return f"{rounded:.3g} {unit}"
