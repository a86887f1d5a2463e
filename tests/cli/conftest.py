"""Commands in this process, as the entry point runs them."""

from __future__ import annotations

import sys
from collections.abc import Callable

import pytest
from answers import Answer

from acquire.cli import main


@pytest.fixture
def cli(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.delenv("ACQUIRE_SOCKET", raising=False)

    def run(*words: object) -> Answer:
        monkeypatch.setattr(sys, "argv", ["acquire", *map(str, words)])
        try:
            code = main()
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 1
        said = capsys.readouterr()
        return Answer(code, said.out, said.err)

    return run
