"""What benchmarks measured is kept with where it comes from, and tables are made of that."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tools import results
from tools.results import DOCUMENTS, Machine, Run, choose, commit, read, recorded, table, with_tables


def test_a_run_is_kept_with_its_origin_and_shown_as_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "results.jsonl"
    words = [str(results.ROOT / "tools/bench_store.py"), "--out", "/home/somebody", "--gigabytes", "0.5"]
    monkeypatch.setattr(sys, "argv", words)
    with recorded("bench_store", keep=True, file=file) as run:
        run.add("bare", mb_s=np.float32(1234.5), cpu_s_per_gb=0.09123)
        run.add("direct", mb_s=87.66, cpu_s_per_gb=float("nan"))
        run.add("of a|b", condition="GOOD", ratio=float("inf"), lines=12_000_000)
    (kept,) = read(file)
    assert (kept, kept.whole) == (run, True)
    assert kept.command == "python tools/bench_store.py --out DIR --gigabytes 0.5"
    assert kept.machine.cores >= 1
    assert kept.machine.cpu
    assert kept.machine.load_before >= 0
    assert table(choose(read(file), "bench_store", None)).splitlines()[2:] == [
        "",
        "| case | MB/s | cpu (s per GB) |",
        "| --- | --- | --- |",
        "| bare | 1234 | 0.0912 |",
        "| direct | 87.7 |  |",
        "",
        "| case | condition | lines |",
        "| --- | --- | --- |",
        "| of a\\|b | GOOD | 12000000 |",
    ]


def test_nothing_is_kept_unasked_and_what_was_cut_short_says_so(tmp_path: Path) -> None:
    file = tmp_path / "results.jsonl"
    with recorded("bench_store", keep=False, file=file) as run:
        run.add("one", s=1.0)
    assert not file.exists()

    def interrupted() -> None:
        with recorded("bench_store", keep=True, file=file) as run:
            run.add("one", s=1.0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    (cut,) = read(file)
    assert not cut.whole
    assert "; cut short)" in table(cut)
    with pytest.raises(ValueError, match="no whole run of bench_store; there are: bench_store"):
        choose([cut], "bench_store", None)
    assert choose([cut], None, 1) is cut
    with pytest.raises(ValueError, match="run 2: there are 1"):
        choose([cut], None, 2)
    with pytest.raises(TypeError, match="is no figure"):
        run.add("two", s=[1.0])


def test_the_newest_whole_run_is_shown(tmp_path: Path) -> None:
    machine = Machine("a cpu", 2, 8.0, 0.5, "6.1", "3.11.7", "2.4.6")
    runs = [
        Run(
            "bench_store",
            "python …",
            f"2026-01-0{day}T00:00:00Z",
            "abc",
            "1",
            machine,
            [{"case": "x"}],
            whole,
        )
        for day, whole in ((1, True), (2, True), (3, False))
    ]
    assert choose(runs, "bench_store", None) is runs[1]
    assert "2026-01-02, commit abc; a cpu, 2 cores, load 0.5 before" in table(runs[1])


def test_a_line_that_is_no_run_is_named(tmp_path: Path) -> None:
    file = tmp_path / "results.jsonl"
    for line in ("{", '{"benchmark": "x"}', json.dumps({"machine": {}})):
        file.write_text(f"{line}\n")
        with pytest.raises(ValueError, match=r"results\.jsonl, line 1: not a run of a benchmark"):
            read(file)


@pytest.mark.needs_git
def test_the_commit_says_whether_the_tree_was_as_committed(tmp_path: Path) -> None:
    def git(*words: str) -> None:
        names = ("-c", "user.name=n", "-c", "user.email=e")
        subprocess.run(
            ["git", *names, *words], cwd=tmp_path, check=True, timeout=60, stdout=subprocess.DEVNULL
        )

    assert commit(tmp_path) == "unknown"
    (tmp_path / "tools").mkdir()
    for name in ("code.py", "tools/results.jsonl"):
        (tmp_path / name).write_text("1\n")
    git("init", "-q")
    git("add", "-A")
    git("commit", "-qm", "all")
    at = commit(tmp_path)
    assert len(at) == 12
    (tmp_path / "tools/results.jsonl").write_text("2\n")
    assert commit(tmp_path) == at
    (tmp_path / "code.py").write_text("2\n")
    assert commit(tmp_path) == f"{at}+"


def test_what_is_kept_here_can_be_read() -> None:
    for run in read():
        assert table(run).startswith("(`python ")
        assert "/" not in run.command.replace("tools/", "")


def test_tables_in_documents_are_the_newest_whole_run_of_their_command() -> None:
    machine = Machine("a cpu", 2, 8.0, 0.5, "6.1", "3.11.7", "2.4.6")

    def run(command: str, s: float, *, whole: bool = True) -> Run:
        return Run("b", command, "2026-01-01T00:00:00Z", "abc", "1", machine, [{"case": "x", "s": s}], whole)

    runs = [
        run("python tools/b.py --long --record", 1.0),
        run("python tools/b.py --long --record", 2.0),
        run("python tools/b.py --long --record", 3.0, whole=False),
        run("python tools/b.py --record", 4.0),
    ]
    place = "Before.\n<!-- results of python tools/b.py --long -->\n{}<!-- end of results -->\nAfter.\n"
    made = with_tables(place.format("| old |\n"), runs)
    assert made == place.format(f"{table(runs[1])}\n")
    assert "| x | 2.00 |" in made
    assert with_tables(made, runs) == made
    with pytest.raises(ValueError, match=r"no whole run of 'python tools/b\.py --long' is kept"):
        with_tables(made, runs[2:])


def test_the_tables_of_the_documents_are_those_that_were_kept() -> None:
    texts = [path.read_text(encoding="utf-8") for path in DOCUMENTS]
    assert sum(text.count("<!-- results of ") for text in texts) >= 2
    for path, text in zip(DOCUMENTS, texts, strict=True):
        assert with_tables(text, read()) == text, (
            f"{path.name}: python tools/results.py --write makes it anew"
        )
