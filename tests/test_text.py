"""Harmless foreign text is shown unchanged, other text as its escapes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.text import cause_in_words, counted, shortened, visible


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("33.3 kHz → Grüße, 試験 µ", "33.3 kHz → Grüße, 試験 µ"),
        ("a\n2026-01-01 ERROR b\r", r"a\n2026-01-01 ERROR b\r"),
        ("\x1b[2J\x07\x00\x7f\x9b31m", r"\x1b[2J\x07\x00\x7f\x9b31m"),
        ("a\u202eb\u2066c\u200bd\u2028e\ufeff", r"a\u202eb\u2066c\u200bd\u2028e\ufeff"),
        ("caf\udce9.zarr", r"caf\udce9.zarr"),
    ],
)
def test_visible(text: str, shown: str) -> None:
    assert visible(text) == shown


def test_line_breaks_of_our_own_stay() -> None:
    assert visible("a\n\tb\x1b\r", lines=True) == "a\n\tb\\x1b\\r"


@given(st.text(st.characters(exclude_categories=())))
def test_whatever_it_is_can_be_encoded_and_is_one_line(text: str) -> None:
    shown = visible(text)
    shown.encode()
    assert len(shown.splitlines()) <= 1
    assert visible(shown) == shown


def test_a_cut_is_marked() -> None:
    assert shortened("x" * 500, 10) == "x" * 9 + "…"
    assert shortened("x" * 10, 10) == "x" * 10


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (KeyError("shape"), "'shape' is missing"),
        (FileNotFoundError(2, "No such file or directory", "/data/r.zarr/events/text/c"), "c is missing"),
        (PermissionError(13, "Permission denied"), "Permission denied"),
        (ValueError("3 is not a name"), "3 is not a name"),
        (ArithmeticError(), "ArithmeticError"),
    ],
)
def test_exceptions_are_said_without_the_names_of_classes(error: Exception, words: str) -> None:
    assert cause_in_words(error) == words


def test_one_is_singular() -> None:
    assert [counted(n, "line", "was") for n in (0, 1, 2)] == ["0 lines were", "1 line was", "2 lines were"]
    assert [counted(n, "entry") for n in (1, 2)] == ["1 entry", "2 entries"]
    assert counted(3, "line of it", "is") == "3 lines of it are"
    assert counted(2, "line", "came") == "2 lines came"
