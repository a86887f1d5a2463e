"""Foreign text on a terminal, in a log or on the wire: one function that makes it harmless.

Foreign is whatever this program did not write: an operator's mark, the attributes of a recording, file
names, what a device or a remote store answers. A newline in it forges a line of the log, an escape sequence
recolours or rewrites the terminal, a bidirectional override shows a name backwards, and a file name that is
not UTF-8 cannot be encoded at all.
"""

from __future__ import annotations

import difflib
import re
import reprlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

_ALLOWED = " \u00a0\u202f"
"""Spaces that typography needs; every other separator and control character is escaped."""
_SUSPECT = re.compile(r"[^ -~]")


def visible(text: object, *, lines: bool = False) -> str:
    """``text`` with every character that is not printable as its escape: ``\\n``, ``\\x1b``, ``\\u202e``.

    With ``lines``, newlines and tabs stay: for text whose lines are our own.
    """
    kept = _ALLOWED + "\n\t" if lines else _ALLOWED

    def escape(found: re.Match[str]) -> str:
        character = found[0]
        if character in kept or character.isprintable():
            return character
        return character.encode("unicode_escape").decode("ascii")

    return _SUSPECT.sub(escape, str(text))


def shortened(text: object, characters: int = 120) -> str:
    """``text``, visible, and at most so many characters of it, with a mark where it was cut."""
    shown = visible(text)
    return shown if len(shown) <= characters else f"{shown[: characters - 1]}…"


def did_you_mean(word: str, possible: Iterable[str]) -> str:
    """``; did you mean 'start'?`` for a word that is close to a possible one; empty for any other."""
    near = difflib.get_close_matches(word, list(possible), n=1)
    return f"; did you mean {near[0]!r}?" if near else ""


_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = 100
_REPR.maxlevel = 3


def shown(value: object) -> str:
    """A value as Python writes it, visible and short, however long or deeply nested it is."""
    try:
        return shortened(_REPR.repr(value))
    except (ValueError, RecursionError):  # an integer of thousands of digits, or a list in a list in a list
        return f"a {type(value).__name__} too large to be shown"
