"""Recordings with impossible attributes: every command ends with a sentence and exit code 6, not a traceback.

One recording, changed in one place at a time: whatever a crafted or a torn root claims, nobody counts to it,
allocates it, follows it out of the directory, or repeats it as if it were true.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquire.capacity.load import Load, recording_spec, trigger_run
from acquire.cli import recordings
from acquire.cli.replay_rig import replay_rig
from acquire.clock import ClockFit
from acquire.errors import DataError, UsageError
from acquire.lines import ARMS, LineBlock
from acquire.store import RecordingWriter, RunCondition, open_recording, verify
from acquire.store.reader import open_source
from acquire.store.source import LocalSource
from acquire.stream.tagger import Tagger
from acquire.web.archive import Archive

CLOCK = ClockFit(90_000_000, 0, 0)
LOAD = Load(8, "uint16", 1000.0, chunk_lines=16, shard_chunks=4)
SPEC = replace(recording_spec(LOAD, CLOCK), first_line=100, stages=LOAD.pixels)
LINES = 128
HUGE = (10**9, 10**12, 10**15, 10**18, 10**30)

Change = Callable[[dict[str, Any]], None]


def attribute(path: str, value: object) -> Change:
    """Set one attribute of the root; ``path`` is dotted."""

    def change(document: dict[str, Any]) -> None:
        *parents, last = path.split(".")
        at = document["attributes"]
        for key in parents:
            at = at[key]
        at[last] = value

    return change


def node(path: str, value: object) -> Change:
    """Set something in the metadata of one array; ``path`` begins with the array, then a colon."""

    def change(document: dict[str, Any]) -> None:
        array, _, keys = path.partition(":")
        at: Any = document["consolidated_metadata"]["metadata"]
        *parents, last = [array, *(keys.split(".") if keys else [])]
        for key in parents:
            at = at[int(key) if isinstance(at, list) else key]
        at[int(last) if isinstance(at, list) else last] = value

    return change


def length(rows: int) -> Change:
    """Let all arrays claim this number of rows."""

    def change(document: dict[str, Any]) -> None:
        for path, metadata in document["consolidated_metadata"]["metadata"].items():
            if path[:2] in ("a/", "b/"):
                metadata["shape"][0] = rows

    return change


def both(*changes: Change) -> Change:
    def change(document: dict[str, Any]) -> None:
        for one in changes:
            one(document)

    return change


ODD: tuple[object, ...] = (None, [], {}, 5, -1, 1e30, "x", [1], True)
MUTANTS: dict[str, Change] = {
    **{f"lines {rows:.0e}": length(rows) for rows in HUGE},
    **{
        f"first_line {value!r:.20}": attribute("first_line", value) for value in (1e30, 10**30, -1, "x", None)
    },
    **{
        f"{key} {value!r}": attribute(key, value)
        for key in (
            "state",
            "geometry",
            "clock",
            "trigger",
            "cameras",
            "code",
            "versions",
            "ledger",
            "run_id",
        )
        for value in ODD
        if not (key == "run_id" and value == "x") and not (key == "ledger" and value == {})
    },
    **{
        f"{key} {value!r}": attribute(key, value)
        for key, values in {
            "config": (None, [], 5),
            "host": (None, [1], {"name": 5}),
            "segments": (None, 5, [1], ["../x"], ["/etc"], [""]),
            "segment": (5, {}, {"number": 2, "of": "../x", "outage": {}}),
            "holds": ("junk", [1], [[1, 2]], [["a", 1, "x"]]),
            "durability": ([], {"kill_lines": "x"}),
            "dropped": (5, [1], [[1, 2, 3]], [[100, 10**15]], [[0, 16]], [[100, 64], [100, 64]], [[1e30, 1]]),
            "geometry.stages": (0, 10**9, 1.5),
            "geometry.substeps": (0, 9),
            "geometry.pixels": (0, "8"),
            "trigger.line_period_ticks": (0, 10**30, None),
            "clock.clock_hz": (0, -1, 1e300, "x"),
            "clock.utc_ns_at_tick_0": (None, 10**40),
            "clock.uncertainty_ns": ([],),
            "cameras.a": (None, 5),
            "cameras.b.white_dn": (0, "x", float("nan"), float("inf")),
            "ledger.a": (
                {"stored": "x"},
                {"stored": 1, "missing": 5},
                {"stored": 1, "missing": {"x": "y"}},
            ),
            "ledger.tainted_by": (5, {"incomplete_a": "x"}),
            "calibration": (5, {"steps": 5}, {"steps": {"dark": 3}}),
            "code.degree": (10**9, "x", None),
            "code.state": ("x", [], 10**30),
            "code.seed": ("x", []),
            "code.kind": (None, "x", []),
            "layout": (5,),
            "end_reason": (5,),
            "run_condition": (5, []),
            "simulated": ("yes",),
        }.items()
        for value in values
    },
    **{
        f"{key} {value!r}": node(key, value)
        for key, values in {
            "a/lines": (None, 5, []),
            "a/lines:shape": (None, [], [128], [128, -8], ["x", 8], [10**15, 10**15]),
            "a/lines:codecs": (None, [], [{}], 5),
            "a/lines:codecs.0.configuration.chunk_shape": ([0, 8], [10**15, 8], [10**9, 8], [-16, 8], 5),
            "a/lines:chunk_grid.configuration.chunk_shape": ([64 * 10**12, 8], [0, 8], None),
            "a/tick:data_type": ("object", 5, "float64"),
            "a/lines:attributes": (None, []),
            "gaps": (None, 5),
            "gaps:attributes": (None, {}),
            "../../out": ({"node_type": "array", "attributes": {}},),
            "/etc": ({"node_type": "array", "attributes": {}},),
        }.items()
        for value in values
    },
    "nested": attribute("config", json.loads("[" * 300 + "]" * 300)),
}


@pytest.fixture(scope="module")
def templates(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    home = tmp_path_factory.mktemp("templates")
    made = {}
    for state in ("open", "sealed"):
        made[state] = home / f"{state}.zarr"
        with RecordingWriter.create(made[state], SPEC) as writer:
            tagger = Tagger(trigger_run(LOAD), SPEC.stages, CLOCK)
            for arm in ARMS:
                pixels, flags = np.ones((LINES, LOAD.pixels), np.uint16), np.zeros(LINES, np.uint16)
                writer.append(tagger.tag(arm, LineBlock(100, pixels, flags)))
            writer.add_event("mark", 5, 110, "x")
            writer.commit()
            if state == "sealed":
                writer.seal(RunCondition.GOOD, "done", {"a": {"stored": LINES, "missing": {}}})
    return made


TABLES: dict[str, Change] = {
    f"{key} {value!r}": node(key, value)
    for key, values in {
        "b/tick:codecs.0.configuration.chunk_shape": ([1],),
        "events/text:data_type": ("uint64",),
        "events/text:shape": ([10**15], [-1], 5),
        "events/line:data_type": ("object", "string"),
        "events/kind:attributes": ({}, {"flag_values": [0], "flag_meanings": "other"}),
    }.items()
    for value in values
}
"""What does not keep a recording from being opened."""


def bytes_of(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def commands(path: Path, out: Path) -> dict[str, tuple[object, ...]]:
    return {
        "info": ("info", path),
        "info as JSON": ("info", path, "--json"),
        "verify": ("verify", path),
        "cut": ("cut", path, "--first-line", 110, "--lines", 10, "--out", out / "x.npz"),
        "upload": ("upload", path, f"file://{out}/far/x.zarr"),
        "hold": ("hold", path, "--first-line", 110, "--lines", 10),
        "recover": ("recover", path),
        "reconstruct": ("reconstruct", path, "--first-line", 110, "--lines", 16, "--out", out / "v.zarr"),
    }


@pytest.mark.parametrize("name", MUTANTS)
def test_impossible_attributes_are_refused_on_opening(name: str, templates: dict[str, Path]) -> None:
    """All commands begin by opening the recording."""
    document = json.loads((templates["open"] / "zarr.json").read_bytes())
    MUTANTS[name](document)

    class Mutant(LocalSource):
        def read(self, key: str) -> bytes:
            return json.dumps(document).encode() if key == "zarr.json" else super().read(key)

    with pytest.raises(DataError, match="damaged"):
        open_source(Mutant(templates["open"]))


@pytest.mark.parametrize(
    "name",
    ["lines 1e+18", "ledger 5", "segments [1]", "holds 'junk'", "gaps None"],
)
def test_every_command_reports_the_damage(
    name: str, templates: dict[str, Path], tmp_path: Path, cli: Any
) -> None:
    path, out = tmp_path / "in" / "x.zarr", tmp_path / "out"
    out.mkdir()
    shutil.copytree(templates["open"], path)
    document = json.loads((path / "zarr.json").read_bytes())
    MUTANTS[name](document)
    (path / "zarr.json").write_text(json.dumps(document))
    before = bytes_of(path)
    codes = {command: cli(*words).code for command, words in commands(path, out).items()}
    assert codes == dict.fromkeys(codes, 6)
    listed = cli("ls", path.parent)
    assert (listed.code, "damaged" in listed.out) == (0, True)
    assert bytes_of(path) == before, "refused before anything was touched"
    assert not any(out.iterdir())


@pytest.mark.parametrize("name", TABLES)
def test_verify_reports_attributes_that_contradict_the_lines(
    name: str, templates: dict[str, Path], tmp_path: Path
) -> None:
    path = tmp_path / "x.zarr"
    shutil.copytree(templates["open"], path)
    document = json.loads((path / "zarr.json").read_bytes())
    TABLES[name](document)
    (path / "zarr.json").write_text(json.dumps(document))
    assert not verify(path).intact


def test_an_endless_recording_may_have_dropped_any_number_of_lines(
    templates: dict[str, Path], tmp_path: Path, cli: Any
) -> None:
    """The dropped lines are not counted one by one."""
    path = tmp_path / "x.zarr"
    shutil.copytree(templates["open"], path)
    document = json.loads((path / "zarr.json").read_bytes())
    both(length(64 * 10**12), attribute("dropped", [[100, 64 * 10**12]]))(document)
    (path / "zarr.json").write_text(json.dumps(document))
    for command in ("info", "verify", "upload", "recover"):
        assert cli(*commands(path, tmp_path)[command]).code == 0


def test_the_templates_are_valid(templates: dict[str, Path], tmp_path: Path, cli: Any) -> None:
    """Every command accepts the recordings from which the mutants are made."""
    path = tmp_path / "x.zarr"
    shutil.copytree(templates["open"], path)
    for command, words in commands(path, tmp_path).items():
        if command != "reconstruct":
            assert cli(*words).code == 0, command


def test_a_file_without_a_number_is_not_a_shard(templates: dict[str, Path], tmp_path: Path, cli: Any) -> None:
    path = tmp_path / "x.zarr"
    shutil.copytree(templates["open"], path)
    for name in ("²", "-1", "007", "9" * 30, "x"):
        (path / "a" / "lines" / "c" / name).mkdir()
        (path / "a" / "tick" / "c" / name).write_bytes(b"")
    assert cli("recover", path).code == 0
    assert cli("verify", path).code == 0
    assert (path / "a" / "lines" / "c" / "²").is_dir()


def test_truncated_or_missing_parts_make_a_recording_damaged(
    templates: dict[str, Path], tmp_path: Path, cli: Any
) -> None:
    short, alone = tmp_path / "short.zarr", tmp_path / "alone.zarr"
    for path in (short, alone):
        shutil.copytree(templates["sealed"], path)
    shutil.copytree(templates["sealed"], tmp_path / "whole.zarr")
    with (short / "a" / "lines" / "c" / "0" / "0").open("r+b") as file:
        file.truncate(5000)
    document = json.loads((alone / "zarr.json").read_bytes())
    document["attributes"]["segments"] = ["alone-2.zarr"]
    (alone / "zarr.json").write_text(json.dumps(document))
    rows = {row.split()[0]: row for row in cli("ls", tmp_path).out.splitlines()}
    assert {name for name, row in rows.items() if "DAMAGED" in row} == {"short.zarr", "alone.zarr"}
    assert "GOOD" in rows["whole.zarr"]
    verified = cli("verify", alone)
    assert verified.code == 6
    assert "its segment alone-2.zarr is listed and cannot be read" in verified.out
    assert "lines 116 to 163: its file is cut short" in cli("info", short).out
    refused = cli("upload", short, f"file://{tmp_path}/far.zarr")
    assert (refused.code, "is not copied: a/lines" in refused.err) == (6, True)
    assert not (tmp_path / "far.zarr").exists()


WRONG: tuple[object, ...] = (None, "x", [], {}, -1, 10**30, float("nan"), "\ud800")


def places(value: object, at: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Every value of the attributes, however deep."""
    yield at
    if isinstance(value, dict):
        for key in value:
            yield from places(value[key], (*at, key))


@pytest.mark.parametrize(
    "key",
    [
        *("state", "run_condition", "end_reason", "run_id", "layout", "first_line", "geometry", "trigger"),
        *("clock", "code", "cameras", "ledger", "versions", "config", "host", "durability", "calibration"),
        *("dropped", "holds", "segments", "segment", "imported", "plugins", "simulated", "effects", "scene"),
    ],
)
def test_whatever_an_attribute_is_the_recording_is_shown_or_refused_in_words(
    key: str, templates: dict[str, Path], tmp_path: Path
) -> None:
    """By the commands' own functions and the page's: any other exception is a traceback, or an HTTP 500."""
    path = tmp_path / "x.zarr"
    shutil.copytree(templates["sealed"], path)
    whole = json.loads((path / "zarr.json").read_bytes())
    # What it is deep inside is checked as well.
    within = list(places(whole["attributes"][key])) if key in whole["attributes"] else [()]
    for deep in within:
        for value in WRONG:
            document = json.loads((path / "zarr.json").read_bytes())
            document["attributes"] = json.loads(json.dumps(whole["attributes"]))
            at, (*parents, last) = document["attributes"], (key, *deep)
            for parent in parents:
                at = at[parent]
            at[last] = value
            (path / "zarr.json").write_text(json.dumps(document))
            shown: list[Callable[[], object]] = [
                lambda: recordings.info(str(path), json=True),
                lambda: recordings.info(str(path)),
                lambda: recordings.list_recordings(tmp_path),
                lambda: open_recording(path).cut(110, 10),
                lambda: verify(path),
                lambda: replay_rig(open_recording(path), 1.0, tmp_path),
                lambda: [one.model_dump_json() for one in Archive(tmp_path).recordings()],
                lambda: Archive(tmp_path).recording("x.zarr").model_dump_json(),
                lambda: Archive(tmp_path).picture("x.zarr"),
            ]
            try:
                open_recording(path)
            except DataError:
                shown = [shown[0], shown[2], shown[6]]  # the others begin by opening it
            for show in shown:
                with contextlib.suppress(DataError, UsageError):
                    show()


@pytest.mark.parametrize("table", ["events/line", "gaps/cause"])
def test_a_damaged_table_keeps_nothing_else_from_being_shown(
    table: str, templates: dict[str, Path], tmp_path: Path, cli: Any
) -> None:
    path = tmp_path / "x.zarr"
    with RecordingWriter.create(path, SPEC) as writer:
        writer.add_event("mark", 5, 110, "x")
        writer.add_gap("a", 103, 1, "camera")
        writer.seal(RunCondition.GOOD, "done", {})
    (path / table / "c" / "0").write_bytes(b"\0" * 40)
    shown = cli("info", path)
    assert shown.code == 0, shown.err
    assert f"table {table} cannot be read: the checksum is wrong" in " ".join(shown.out.split())
    assert f"unknown, since the {table.partition('/')[0]} cannot be read" in shown.out
    facts = cli("info", path, "--json").json
    assert (facts["events"], facts["suspect"]) == ((None, None) if "events" in table else (1, []))
    assert facts["lost_lines"] == ({"a": 1, "b": 0} if "events" in table else None)
    assert "DAMAGED" in cli("ls", tmp_path).out
    assert cli("verify", path).code == 6


def test_old_recordings_open(templates: dict[str, Path], tmp_path: Path, cli: Any) -> None:
    """Facts that came later may be absent: the first version wrote none of them."""
    path = tmp_path / "x.zarr"
    shutil.copytree(templates["sealed"], path)
    document = json.loads((path / "zarr.json").read_bytes())
    for key in ("durability", "host", "config", "simulated", "dropped", "holds", "segments", "segment"):
        document["attributes"].pop(key, None)
    (path / "zarr.json").write_text(json.dumps(document))
    (path / "a" / "lines" / ".attributes").unlink()
    for command, code in (("info", 0), ("verify", 0), ("recover", 0)):
        assert cli(command, path).code == code, command
