"""The notebooks run as they stand, cell by cell and without a kernel, and carry small outputs."""

from __future__ import annotations

import contextlib
import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import pytest

NOTEBOOKS = sorted((Path(__file__).parents[2] / "tools" / "notebooks").glob("*.ipynb"))
MOST_BYTES = 200_000


def cells(path: Path) -> list[dict[str, Any]]:
    document = json.loads(path.read_text(encoding="utf-8"))
    assert (document["nbformat"], document["nbformat_minor"]) == (4, 5)
    return [cell for cell in document["cells"] if cell["cell_type"] == "code"]


@contextlib.contextmanager
def ended(names: dict[str, Any]) -> Iterator[None]:
    """A daemon that a cell has started does not outlive a cell that fails."""
    try:
        yield
    finally:
        daemon = names.get("daemon")
        if isinstance(daemon, subprocess.Popen) and daemon.poll() is None:
            daemon.kill()
            daemon.wait(timeout=60)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_its_cells_run(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plt, "show", lambda: plt.close("all"))
    matplotlib.use("Agg")
    names: dict[str, Any] = {}
    with ended(names):
        for number, cell in enumerate(cells(path)):
            exec(compile("".join(cell["source"]), f"{path.name}, code cell {number}", "exec"), names)
    said = capsys.readouterr().out
    if "take" in names:
        assert (names["ended"], names["take"].lines, "the valve opens" in said) == (0, 15_000, True)
    elif "results" in names:
        assert [bool(result.warnings) for result in names["results"].values()] == [False, False, True]
    else:
        assert (tmp_path / "lamps.png").stat().st_size > 1000
        assert "no warnings" in said


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_its_outputs_are_kept_and_small(path: Path) -> None:
    code = cells(path)
    kinds = [output["output_type"] for cell in code for output in cell["outputs"]]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert "display_data" in kinds
    assert "error" not in kinds
    assert path.stat().st_size < MOST_BYTES


def test_there_are_three() -> None:
    assert [path.name[0] for path in NOTEBOOKS] == ["1", "2", "3"]
