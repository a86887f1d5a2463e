"""The rules of the code itself: style, types, layers. They are tests so that one command checks all."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path

import pytest

import acquire

ROOT = Path(__file__).parents[2]

TOOLS = {
    "style": ["-m", "ruff", "check", "."],
    "format": ["-m", "ruff", "format", "--check", "."],
    "types": ["-m", "mypy"],
    "layers": ["-c", "from importlinter.cli import lint_imports_command; lint_imports_command()"],
}


@pytest.mark.parametrize("rule", TOOLS)
def test_rule(rule: str) -> None:
    done = subprocess.run(
        [sys.executable, *TOOLS[rule]], cwd=ROOT, capture_output=True, text=True, timeout=800, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_drawing_of_the_layers_is_the_contract() -> None:
    """The drawing lacked a dozen modules, and had others on floors where they are not checked to be."""
    document = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = document["tool"]["importlinter"]["contracts"][0]["layers"]
    floor = {name: number for number, names in enumerate(layers) for name in re.findall(r"\w+", names)}
    drawing = (acquire.__doc__ or "").partition("(checked by the tests)::")[2].partition("`GLOSSARY.md`")[0]
    drawn: list[str] = []
    for row in drawing.strip().splitlines():
        drawn += row.strip()[:33].split()
    assert sorted(drawn) == sorted(floor)
    assert [floor[name] for name in drawn] == sorted(floor.values())


DRAW_SOMETHING_ELSE = {"daemon", "web", "evaluate/paper", "sim/effects"}
"""Rooms whose drawing is of threads and requests, of figures, or of kinds, instead of modules."""


def test_the_drawing_of_a_room_names_its_modules() -> None:
    """A newcomer looks there for what a module does; `reconstruct` named six of its sixteen."""
    unnamed = {}
    for init in sorted((ROOT / "acquire").rglob("__init__.py")):
        room, text = init.parent, ast.get_docstring(ast.parse(init.read_text(encoding="utf-8"))) or ""
        name = str(room.relative_to(ROOT / "acquire"))
        if "::" not in text or name in {*DRAW_SOMETHING_ELSE, "."}:
            continue
        modules = {path.stem for path in room.glob("[a-z]*.py")} | {
            path.parent.name for path in room.glob("*/__init__.py")
        }
        if missing := modules - set(re.findall(r"\w+", text)):
            unnamed[name] = sorted(missing)
    assert unnamed == {}


def test_modules_of_tests_have_names_of_their_own() -> None:
    """Of two with one name the second is not collected, and a run of one room does not notice."""
    names = Counter(path.name for path in (ROOT / "tests").rglob("*.py"))
    shared = {name for name, count in names.items() if count > 1}
    assert shared <= {"conftest.py", "__init__.py"}


def test_types_and_the_front_door_are_shipped() -> None:
    """`user_script` is typed strictly; a checker believes a package's types where it has py.typed."""
    assert (ROOT / "acquire" / "py.typed").is_file()
    for name in acquire.__all__:
        assert getattr(acquire, name) is not None


def test_commands_print_through_one_door() -> None:
    """`acquire.cli.output` makes foreign text harmless; what is printed past it is not."""
    past = [
        f"{path.name}: {line.strip()}"
        for path in sorted((ROOT / "acquire/cli").rglob("*.py"))
        if path.name != "output.py"
        for line in path.read_text(encoding="utf-8").splitlines()
        if re.search(r"\btyper\.(s?echo)\b|\bprint\(|sys\.stdout\.write", line)
    ]
    assert past == []
