"""Foreign text for a terminal, a log or the wire: escaped, shortened, and exceptions in words.

Foreign is whatever this program did not write: an operator's mark, the attributes of a recording, file
names, answers of a device or a remote store. A newline in it forges a line of the log, an escape sequence
recolours or rewrites the terminal, a bidirectional override shows a name backwards, and a file name that is
not UTF-8 cannot be encoded at all.
"""

from __future__ import annotations

import difflib
import os
import re
import reprlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

_ALLOWED = " \u00a0\u202f"
"""Spaces that typography needs; every other separator and control character is escaped."""
_SUSPECT = re.compile(r"[^ -~]")
_NOUN = re.compile(r"^(Input|String|List|Tuple|Value|Dictionary) should ")
_PREFIX = re.compile(r"(^|(?<=: ))Value error, ")


def visible(text: object, *, lines: bool = False) -> str:
    """Return ``text`` with unprintable characters as their escapes: ``\\n``, ``\\x1b``, ``\\u202e``.

    With ``lines``, newlines and tabs stay, for text whose line breaks are our own.
    """
    kept = _ALLOWED + "\n\t" if lines else _ALLOWED

    def escape(found: re.Match[str]) -> str:
        character = found[0]
        if character in kept or character.isprintable():
            return character
        return character.encode("unicode_escape").decode("ascii")

    return _SUSPECT.sub(escape, str(text))


def shortened(text: object, characters: int = 120) -> str:
    """Return ``text``, visible and cut to ``characters``, with an ellipsis at the cut."""
    shown = visible(text)
    return shown if len(shown) <= characters else f"{shown[: characters - 1]}…"


def unexpanded(path: object) -> str:
    """Return what to try for a path with a ~ that the shell has left as it is; else an empty text."""
    # As in --out=~/x.zarr and in quotes. A directory of that name is one that nobody wants.
    if not any(part.startswith("~") for part in str(path).split("/")):
        return ""
    return "$HOME in place of ~, which the shell replaces only at the beginning of a word without quotes"


_OF_SEVERAL = {"was": "were", "is": "are", "has": "have", "does": "do", "follows": "follow", "finds": "find"}


def counted(number: int, noun: str, verb: str = "") -> str:
    """Return "1 line", "3 lines"; with the verb "was": "1 line was", "3 lines were".

    Of a noun such as "line of it", the first part has the plural.
    """
    if number != 1:
        head, of, rest = noun.partition(" of ")
        noun = f"{head[:-1]}ies{of}{rest}" if head.endswith("try") else f"{head}s{of}{rest}"
        verb = _OF_SEVERAL.get(verb, verb)
    return f"{number} {noun} {verb}".rstrip()


def did_you_mean(word: str, possible: Iterable[str]) -> str:
    """Return ``; did you mean 'start'?`` for a word close to a possible one, else an empty text."""
    near = difflib.get_close_matches(word, list(possible), n=1)
    return f"; did you mean {near[0]!r}?" if near else ""


def cause_in_words(error: BaseException) -> str:
    """Return what an exception of Python or of a library says, as a clause that a reader understands."""
    if isinstance(error, KeyError) and error.args:
        return f"{error.args[0]!r} is missing"  # its text is the key alone
    if isinstance(error, FileNotFoundError) and error.filename:
        return f"{os.path.basename(error.filename)} is missing"  # noqa: PTH119 (it may be a URL)
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error) or type(error).__name__


def system_words(error: OSError) -> str:
    """Return what the operating system says of a file, with the whole name of the file."""
    if error.filename is None or not error.strerror:
        return shortened(str(error) or type(error).__name__, 400)
    return f"{shortened(os.fsdecode(error.filename), 400)}: {error.strerror}"


def own_words(message: str) -> str:
    """Return pydantic's message about a value in words that follow the value, without any prefix."""
    return _NOUN.sub("must ", _PREFIX.sub("", message, count=1), count=1)


# Not `repr`, which would first write out all of a large value.
_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = 100
_REPR.maxlevel = 3


def shown(value: object) -> str:
    """Return the repr of a value, visible and short, however long or deeply nested it is."""
    try:
        return shortened(_REPR.repr(value))
    except (ValueError, RecursionError):  # an integer of thousands of digits, or a list in a list in a list
        return f"a {type(value).__name__} too large to be shown"
