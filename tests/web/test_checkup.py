"""The host is examined on request: one examination at a time, for a limited time, in a process of its own."""

from __future__ import annotations

import asyncio
from pathlib import Path

import psutil
import pytest
from fastapi import APIRouter, FastAPI
from httpx import ASGITransport, AsyncClient

from acquire.daemon.answers import Answers
from acquire.errors import AcquireError, BusyError, StateError
from acquire.web import checkup as checkup_module
from acquire.web.app import _add_checkup
from acquire.web.checkup import Checkup

FINDING = {"name": "disk", "level": "bad", "text": "it is full", "todo": "remove something"}
SAYS = f"import json; print(json.dumps([{FINDING}])); raise SystemExit(5)"
SLEEPS = "import time; time.sleep(600)"
FAILS = """
import sys
print('{"error": {"message": "no daemon listens", "hint": "acquire serve"}}', file=sys.stderr)
raise SystemExit(3)
"""


@pytest.fixture
def checkup(tmp_path: Path) -> Checkup:
    return Checkup(tmp_path / "c.sock")


def says(monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    monkeypatch.setattr(checkup_module, "WORDS", ("-S", "-c", program))


def test_findings_are_kept_also_if_something_is_bad(
    checkup: Checkup, monkeypatch: pytest.MonkeyPatch
) -> None:
    says(monkeypatch, SAYS)
    app, api = FastAPI(), APIRouter()
    _add_checkup(api, checkup, Answers())
    app.include_router(api)

    async def work() -> list[dict[str, object]]:
        async with AsyncClient(transport=ASGITransport(app), base_url="http://page") as client:
            return [
                (await client.get("/doctor")).json(),
                (await client.post("/doctor")).json(),
                (await client.get("/doctor")).json(),
            ]

    before, found, after = asyncio.run(work())
    assert before == {"examined": None, "running": False, "findings": []}
    assert found == after
    assert found["findings"] == [FINDING]


def test_one_at_a_time_and_not_for_ever(checkup: Checkup, monkeypatch: pytest.MonkeyPatch) -> None:
    says(monkeypatch, SLEEPS)
    monkeypatch.setattr(checkup_module, "LIMIT_S", 0.3)

    async def two() -> None:
        first = asyncio.create_task(checkup.examine())
        await asyncio.sleep(0.1)
        assert checkup.facts.running
        with pytest.raises(StateError, match="is being examined already"):
            await checkup.examine()
        with pytest.raises(BusyError, match=r"took longer than 0\.3 s"):
            await first

    asyncio.run(two())
    assert not checkup.facts.running
    assert not [one for one in psutil.Process().children() if SLEEPS in one.cmdline()]


def test_why_it_could_not_be_examined_is_told(checkup: Checkup, monkeypatch: pytest.MonkeyPatch) -> None:
    says(monkeypatch, FAILS)
    with pytest.raises(AcquireError, match="could not be examined: no daemon listens; try: acquire serve"):
        asyncio.run(checkup.examine())
    assert checkup.facts.examined is None
