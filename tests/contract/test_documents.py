"""The documents say what is so: commands and options exist, paths and links lead somewhere, examples run.

A Python example that needs more than a recording `run.zarr` names the test that runs it, in a comment above:
``<!-- run by tests/service/test_client.py -->``.
"""

from __future__ import annotations

import re
import shlex
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

import acquire
from acquire.cli import app
from acquire.config import load_rig, load_scene
from acquire.simulate import simulate
from acquire.store import open_recording

ROOT = Path(__file__).parents[2]
ROOMS = ("acquire", "configs", "firmware", "tests", "tools")
DOCUMENTS = sorted(
    [*ROOT.glob("*.md"), *(path for room in ROOMS for path in (ROOT / room).rglob("*.md"))],
    key=str,
)
OF_NOW = [path for path in DOCUMENTS if path.name != "CHANGELOG.md"]
"""A changelog tells of commands that have gone."""
EXAMPLE = re.compile(r"(?:<!-- run by (\S+) -->\n)?```python\n(.*?)```", re.DOTALL)
SPAN = re.compile(r"`([^`\n]+)`")
HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)
FENCE = re.compile(r"```.*?```", re.DOTALL)
QUOTED = re.compile(r"\"([^\"\n]+)\"")
SPOKEN = re.compile(r"`([a-z]+ [^`\n]* [^`\n]*)`")
"""Three or more words in backticks: what the program prints, and no name."""
SHORTEST_WORDS = 8
LONGEST_LINE = 150


def names(paths: list[Path]) -> list[Any]:
    return [pytest.param(path, id=str(path.relative_to(ROOT))) for path in paths]


@cache
def commands() -> Any:
    return typer.main.get_command(app)


def shown(text: str) -> list[str]:
    """Commands of shell blocks and of code spans, one line each."""
    blocks = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [*lines, *SPAN.findall(FENCE.sub("", text))]


def called(line: str) -> list[list[str]]:
    """The words of every call of the program in a line of shell, behind its name."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
    lexer.whitespace_split = True
    try:
        words = list(lexer)
    except ValueError:
        return []
    calls, current = [], list[str]()
    for word in [*words, ";"]:
        if set(word) <= set(";&|<>()"):
            calls.append(current)
            current = []
        else:
            current.append(word)
    return [call[1:] for call in calls if len(call) > 1 and call[0].rpartition("/")[2] == "acquire"]


def wrong(call: list[str]) -> str | None:
    """What of a call does not exist."""
    command, path = commands(), "acquire"
    words = iter(call)
    for word in words:
        below = getattr(command, "commands", {})
        if not below or word.startswith("-"):
            call = [word, *words]
            break
        if word not in below:
            return f"{path} {word}"
        command, path = below[word], f"{path} {word}"
    else:
        call = []
    known = {
        option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)
    }
    known |= {"--help", "-h"}
    asked = [word.partition("=")[0] for word in call if re.match(r"--?[a-z]", word)]
    return next((f"{path} {option}" for option in asked if option not in known), None)


@pytest.mark.parametrize("path", names(OF_NOW))
def test_commands_and_options_exist(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    calls = [call for line in shown(text) for call in called(line)]
    assert [found for call in calls if (found := wrong(call))] == []


def test_the_check_of_commands_sees_what_is_wrong() -> None:
    assert wrong(["calibrate", "darkness"]) == "acquire calibrate darkness"
    assert wrong(["start", "run.zarr", "--for", "3s"]) == "acquire start --for"
    assert called("A=1 true && .venv/bin/acquire arm --force | cat # --no") == [["arm", "--force"]]
    tour = (ROOT / "README.md").read_text(encoding="utf-8")
    assert {"demo", "serve", "arm", "start", "status"} <= {c[0] for s in shown(tour) for c in called(s)}


@pytest.mark.parametrize("path", names(DOCUMENTS))
def test_lines_are_wrapped(path: Path) -> None:
    """Rows of tables and addresses of pictures cannot be."""
    lines = path.read_text(encoding="utf-8").splitlines()
    long = [number for number, line in enumerate(lines, 1) if len(line) > LONGEST_LINE]
    assert [n for n in long if not lines[n - 1].startswith(("|", "!["))] == [], (
        f"wrap at {LONGEST_LINE} columns"
    )


@pytest.mark.parametrize("path", names(DOCUMENTS))
def test_paths_exist(path: Path) -> None:
    spans = SPAN.findall(FENCE.sub("", path.read_text(encoding="utf-8")))
    named = [span for span in spans if re.fullmatch(rf"(?:{'|'.join(ROOMS)})/[\w./-]*", span)]
    places = [
        (name, base / f"{name}{end}") for name in named for base in (ROOT, path.parent) for end in ("", ".py")
    ]
    assert sorted(set(named) - {name for name, place in places if place.exists()}) == []


def test_every_fault_names_its_test() -> None:
    rows = re.findall(r"^\|.*\| ([^|]+) \|$", (ROOT / "tests/FAULTS.md").read_text("utf-8"), re.MULTILINE)
    tests = [name for row in rows[2:] for name in re.findall(r"`((?:[a-z/]+/)?test_\w+)`", row)]
    assert len(tests) > 30
    assert [name for name in tests if not (ROOT / "tests" / f"{name}.py").exists()] == []


@pytest.mark.parametrize("path", names(DOCUMENTS))
def test_links_lead_somewhere(path: Path) -> None:
    dead = []
    for link in re.findall(r"\]\(([^)\s]+)\)", FENCE.sub("", path.read_text(encoding="utf-8"))):
        if re.match(r"https?://", link):
            continue
        name, _, anchor = link.partition("#")
        target = (path.parent / name).resolve() if name else path
        if not target.exists() or (anchor and anchor not in anchors(target)):
            dead.append(link)
    assert dead == []


def anchors(path: Path) -> set[str]:
    """As GitHub makes them of headings."""
    headings = HEADING.findall(FENCE.sub("", path.read_text(encoding="utf-8")))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("path", names(DOCUMENTS))
def test_no_machine_is_named(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    for place in {ROOT, Path.home()} - {Path("/")}:
        assert f"{place}/" not in text


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("documents")
    rig = load_rig("rig-demo", {"geometry.stages": 16})
    simulate(rig, load_scene("scene-leds"), directory / "run.zarr", 2000)
    return directory


def examples(path: Path) -> list[str]:
    """Those that run on a recording."""
    return [code for test, code in EXAMPLE.findall(path.read_text(encoding="utf-8")) if not test]


@pytest.mark.parametrize("path", names([path for path in OF_NOW if examples(path)]))
def test_python_examples_run_on_a_recording(
    path: Path, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(recording)
    found: dict[str, Any] = {}
    for example in examples(path):
        exec(example.replace("lines=263", "lines=60"), found)
    if "reconstruct" in found:
        assert found["video"].shape == (3 * 60 - 3 * 16 + 1, 16, 16)


def test_examples_that_need_more_name_the_test_that_runs_them() -> None:
    named = {test for path in OF_NOW for test, _ in EXAMPLE.findall(path.read_text("utf-8")) if test}
    assert "tests/service/test_client.py" in named
    assert [test for test in named if not (ROOT / test).is_file()] == []


def test_the_documented_reader_cuts_what_the_store_cuts(recording: Path) -> None:
    found: dict[str, Any] = {}
    exec(examples(ROOT / "acquire/store/FORMAT.md")[-1], found)
    ours = open_recording(recording / "run.zarr").cut(700, 100)
    samples, usable, code, time_ns = found["cut"](recording / "run.zarr", 700, 100)
    assert usable.all()
    np.testing.assert_array_equal(usable, ours.mask)
    np.testing.assert_allclose(samples, ours.samples(np.float64))
    np.testing.assert_array_equal(code, ours.code)
    np.testing.assert_array_equal(time_ns, ours.time_ns)
    with pytest.raises(IndexError, match="does not hold"):
        found["cut"](recording / "run.zarr", 1990, 10)


@pytest.mark.parametrize(
    ("name", "quoted", "least"), [("TROUBLESHOOTING", QUOTED, 16), ("calibrate/FIRST_LIGHT", SPOKEN, 7)]
)
def test_symptoms_are_what_the_program_says(name: str, quoted: re.Pattern[str], least: int) -> None:
    source = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "acquire").rglob("*.py"))
    joined = re.sub(r"\"\s*\n\s*f?\"", "", source)
    rows = re.findall(r"^\| (.*?) \|", (ROOT / f"acquire/{name}.md").read_text("utf-8"), re.MULTILINE)
    said = [part.strip() for row in rows for quote in quoted.findall(row) for part in quote.split("…")]
    said = [part for part in said if len(part) >= SHORTEST_WORDS]
    assert len(said) >= least
    assert [part for part in said if part not in joined] == []


def test_the_citation_is_of_this_version() -> None:
    citation = (ROOT / "tools/CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {acquire.__version__}\n" in citation
