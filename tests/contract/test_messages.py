"""Every error is a sentence: what is raised in `acquire` with a text of its own has a verb in it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "acquire"

VERBS = frozenset(
    re.findall(
        r"\w+",
        """
        is are was were be been has have had can cannot could does do did must will would
        adds answered answers asked begins belong belongs came carries claims come counts delivers died
        differs ended ends exclude exists failed follow gave goes groups holds lacked leave left lies
        listens misses need needs overlap overflow ran reads records refused refuses runs speaks started
        stays takes tells took wait went
        """,
    )
)
"""Those that messages need: a new one may well need another."""

_QUOTED = re.compile(r"(.*: )?(§ ?)+")
"""A label before a sentence from elsewhere, or pieces that are only joined here."""


def sentence(message: ast.expr) -> str | None:
    """The text up to what is possible: § where a text is put in, 7 for a value; None if not given here."""
    if isinstance(message, ast.Constant):
        text = re.sub(r"\{\w+\}", "§", str(message.value))
    elif isinstance(message, ast.JoinedStr):
        text = "".join(map(_piece, message.values))
    else:
        return None
    return text.partition("; possible:")[0]


def _piece(part: ast.expr) -> str:
    if isinstance(part, ast.FormattedValue):
        return "§" if part.conversion == -1 and part.format_spec is None else "7"
    return str(part.value) if isinstance(part, ast.Constant) else ""


def is_sound(text: str) -> bool:
    return not VERBS.isdisjoint(re.findall(r"[a-z]+", text.lower())) or _QUOTED.fullmatch(text) is not None


def made(tree: ast.AST) -> list[tuple[int, str]]:
    """Line and sentence of every error that is made with one. Those of pydantic have a code before it."""
    found = []
    for call in ast.walk(tree):
        if isinstance(call, ast.Call) and call.args:
            name = getattr(call.func, "attr", getattr(call.func, "id", ""))
            if name.endswith(("Error", "BadParameter")):
                text = sentence(call.args[name == "PydanticCustomError"])
                found += [] if text is None else [(call.lineno, text)]
    return found


ADVISED = frozenset(
    re.findall(
        r"\w+",
        """
        DeviceError TriggerError CameraError CameraLostError StoreError DataError
        StateError BusyError NoDaemonError _DisconnectedError
        """,
    )
)
"""Errors of devices, disks, data and the daemon's state: the request is right, and the remedy not evident."""


def unadvised(tree: ast.AST) -> list[int]:
    """Line of every such error that is made without a word on what is possible or what to try."""
    return [
        call.lineno
        for call in ast.walk(tree)
        if isinstance(call, ast.Call)
        and getattr(call.func, "attr", getattr(call.func, "id", "")) in ADVISED
        and call.args
        and not {keyword.arg for keyword in call.keywords} & {"hint", "possible", None}
    ]


def test_errors_that_the_request_did_not_cause_say_what_to_try() -> None:
    """About 70 stated what had failed, and left the operator alone with it."""
    without = [
        f"{path.relative_to(PACKAGE)}:{line}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for line in unadvised(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert not without, "add a hint, or what is possible:\n" + "\n".join(without)


def test_an_error_without_advice_is_found() -> None:
    text = (
        "raise CameraError('it is gone')\nraise CameraError('it is gone', hint='x')\nraise UsageError('no')"
    )
    assert unadvised(ast.parse(text)) == [1]


def test_every_error_has_a_verb() -> None:
    checked, without = 0, []
    for path in sorted(PACKAGE.rglob("*.py")):
        for line, text in made(ast.parse(path.read_text(encoding="utf-8"))):
            checked += 1
            if not is_sound(text):
                without.append(f"{path.relative_to(PACKAGE)}:{line}: {text}")
    assert checked > 500
    assert not without, "write a sentence, or add its verb to VERBS:\n" + "\n".join(without)


@pytest.mark.parametrize(
    ("text", "sound"),
    [
        ("prbs degree §", False),
        ("ring of § slots of § x §", False),
        ("light of §: 7", False),
        ("there is no prbs code of degree §", True),
        ("arm § of §: §", True),
        ("§ §", True),
    ],
)
def test_a_sentence_is_distinguished_from_a_heading(text: str, sound: bool) -> None:
    assert is_sound(text) is sound
