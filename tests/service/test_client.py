"""The documented example of a script, word for word, on a real daemon."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

import pytest
from live_daemon import Daemon

from acquire.cli.status_page import status_lines
from acquire.client import Client
from acquire.daemon.glance import status_document

DOCUMENT = Path(__file__).parents[2] / "acquire/client/SCRIPTING.md"


def test_the_example_arms_records_marks_cuts_and_reconstructs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (example,) = re.findall(
        r"```python\n(from acquire.client.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL
    )
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    with contextlib.closing(Daemon(tmp_path)) as daemon:
        monkeypatch.setattr("acquire.client.core.default_socket", lambda: daemon.socket)
        exec(example.replace("lines=200", "lines=40"), names)
    assert names["video"].shape[1:] == (8, 8)  # type: ignore[attr-defined]
    said = capsys.readouterr().out
    assert re.search(r"armed|arm:", said)
    assert "the valve opens" in said
    assert "sealed: " in said


def test_the_quick_status_is_the_client_s(tmp_path: Path) -> None:
    """`acquire status` shows the same without the models as with them."""
    with contextlib.closing(Daemon(tmp_path, "stream.ring_slots=64")) as daemon:
        quick = status_document(daemon.socket)
        full = Client(daemon.socket).status().model_dump(mode="json")
    changing = ("uptime_s", "state_s", "disk")
    assert quick.keys() == full.keys()
    assert {key: quick[key] for key in quick if key not in changing} == {
        key: full[key] for key in full if key not in changing
    }
    assert status_lines(quick)[0] == status_lines(full)[0]
