"""The README: its two commands are the ones that are run, it stays short, and its picture moves."""

from __future__ import annotations

import re
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
PICTURE_BYTES = 1_500_000


def test_ci_runs_the_second_command_as_it_stands() -> None:
    assert BLOCKS[1].strip() in (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()


def test_the_first_command_ends_in_the_demo() -> None:
    assert BLOCKS[0].strip().endswith(".venv/bin/acquire demo")


def test_it_is_read_in_one_sitting() -> None:
    assert len(README.splitlines()) < 250


def test_it_leads_to_every_document() -> None:
    rooms = [ROOT / room for room in ("acquire", "firmware", "tests", "tools")]
    there = {path for room in rooms for path in room.rglob("*.md")}
    seen, new = set(), {ROOT / "README.md"}
    while new:
        seen |= new
        text = [(path, path.read_text(encoding="utf-8")) for path in new]
        links = {
            (path.parent / link).resolve()
            for path, words in text
            for link in re.findall(r"\]\(([^)#:]+\.md)", words)
        }
        new = links - seen
    assert sorted(str(path.relative_to(ROOT)) for path in there - seen) == []


def test_its_picture_moves_and_is_small() -> None:
    (name,) = re.findall(r"!\[[^]]+\]\(([^)]+)\)", README)
    with Image.open(ROOT / name) as picture:
        assert getattr(picture, "n_frames", 1) > 20
    assert (ROOT / name).stat().st_size < PICTURE_BYTES
