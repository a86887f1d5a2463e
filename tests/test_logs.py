"""The daemon's log cannot be forged, and repeated entries do not fill the disk."""

from __future__ import annotations

import json
import logging
import subprocess
import sys

import pytest

from acquire.logs import (
    EACH,
    FACTS,
    MOST_CHARACTERS,
    MOST_KEPT,
    MOST_KEPT_CHARACTERS,
    MOST_WAITING,
    REPEATS,
    WINDOW_S,
    Bounded,
    KeptEntry,
    OneLine,
)


def record(text: str, *words: object, level: int = logging.INFO) -> logging.LogRecord:
    return logging.LogRecord("acquire.daemon", level, __file__, 1, text, words, None)


def test_a_mark_is_one_line_whatever_it_contains() -> None:
    line = OneLine().format(record("event: %s", "a\n2026-01-01 00:00:00 ERROR forged\x1b[31m\x00\u202e"))
    assert line.count("\n") == 0
    assert line.endswith(r"event: a\n2026-01-01 00:00:00 ERROR forged\x1b[31m\x00\u202e")


def test_a_traceback_stays_below_its_entry() -> None:
    entry = record("failed")
    error = ValueError("a\nERROR forged\x1b[2J")
    entry.exc_info = (type(error), error, None)
    first, *others = OneLine().format(entry).splitlines()
    assert first.endswith("INFO failed")
    assert others[-1] == r"  ERROR forged\x1b[2J"
    assert all(line.startswith("  ") for line in others)


def test_an_entry_is_of_bounded_length() -> None:
    assert len(OneLine().format(record("x" * 10**6))) < MOST_CHARACTERS + 10


def test_repeated_entries_are_counted_instead() -> None:
    told: list[str] = []
    clock = [0.0]
    bounded = Bounded(told.append, lambda: clock[0])
    passed = sum(bounded.filter(record("too many files: %d", i)) for i in range(1000))
    assert passed == REPEATS
    assert bounded.filter(record("another"))
    assert told == []
    clock[0] = WINDOW_S
    assert bounded.filter(record("too many files: %d", 1))
    assert told == [f"{1000 - REPEATS} more entries were not written, like this: too many files: 0"]


def test_entries_about_recordings_are_no_repetitions() -> None:
    """The log had the first three takes of a minute, and the others only as a number."""
    told: list[str] = []
    bounded = Bounded(told.append, lambda: 0.0)
    entries = [record("%s → %s (%s)", "armed", "recording", f"take-{i}.zarr") for i in range(FACTS + 1)]
    for entry in entries:
        entry.__dict__.update(EACH)
    assert [bounded.filter(entry) for entry in entries] == [True] * FACTS + [False]


def test_the_latest_entries_are_kept_and_bounded() -> None:
    """As many as are written: those that repeat others are only counted."""
    code = (
        "import json, logging\n"
        "from acquire.logs import latest_entries, write_log\n"
        "assert latest_entries() == []\n"
        "write_log(logging.INFO); log = logging.getLogger('acquire.daemon')\n"
        "for number in range(150): log.warning(f'entry {number}: %s', 'x' * 10**4)\n"
        "for _ in range(150): log.info('again')\n"
        "print(json.dumps([(one.level, one.text) for one in latest_entries()]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True
    )
    kept = json.loads(done.stdout)
    assert len(kept) == MOST_KEPT
    assert kept[-REPEATS:] == [["info", "again"]] * REPEATS
    others = kept[:-REPEATS]
    first = 150 - len(others)
    assert [text.split(":")[0] for _, text in others] == [f"entry {number}" for number in range(first, 150)]
    assert {(level, len(text)) for level, text in others} == {("warning", MOST_KEPT_CHARACTERS + 1)}


@pytest.mark.parametrize(
    "text",
    [
        "mark: http://host:8300/#token=SECRET-_1",
        "{'token': 'SECRET-_1'}",
        "Authorization: Bearer SECRET-_1",
        "ACQUIRE token: SECRET-_1 of the operator",
    ],
)
def test_what_looks_like_a_token_is_not_kept(text: str) -> None:
    kept = KeptEntry.of(record("event: %s", text)).text
    assert "SECRET" not in kept
    assert "…" in kept


def test_a_kept_entry_is_one_line_and_names_its_error() -> None:
    entry = record("failed\nERROR forged")
    entry.exc_info = (ValueError, ValueError("a"), None)
    assert KeptEntry.of(entry).text == r"failed\nERROR forged (ValueError, with a traceback)"
    assert KeptEntry.of(record("the token file was changed")).text == "the token file was changed"


def test_the_number_of_kinds_is_bounded() -> None:
    told: list[str] = []
    bounded = Bounded(told.append, lambda: 0.0)
    assert all(bounded.filter(record(f"kind {i}")) for i in range(5000))
    assert len(bounded._counts) <= 256


def test_under_systemd_the_log_is_json() -> None:
    """If JOURNAL_STREAM names stderr, the log has the same content within the same bounds."""
    code = (
        "import logging, os, sys\n"
        "found = os.fstat(2); os.environ['JOURNAL_STREAM'] = f'{found.st_dev}:{found.st_ino}'\n"
        "from acquire.logs import write_log\n"
        "write_log(logging.INFO); log = logging.getLogger('acquire.daemon')\n"
        "log.info('a %s', 'new\\nline')\n"
        "try: 1 / 0\n"
        "except ZeroDivisionError: log.exception('oh')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True
    )
    first, second = map(json.loads, done.stderr.splitlines())
    assert (first["level"], first["logger"], first["message"]) == ("info", "acquire.daemon", r"a new\nline")
    assert second["traceback"][-1].startswith("ZeroDivisionError")
    assert first["time"].endswith("+00:00")


def test_a_log_that_nobody_reads_holds_up_nobody() -> None:
    """A stopped terminal, or a pager that nobody scrolls, held up the thread that drove the devices."""
    code = (
        "import logging, sys\n"
        "from acquire.logs import EACH, write_log\n"
        "write_log(logging.INFO); log = logging.getLogger('acquire.daemon')\n"
        "for i in range(4000): log.info('%d %s', i, 'x' * 1000, extra={'most': 10**6})\n"
        "print('done', flush=True); input()\n"
        # Until then the entries that wait leave no room for another.
        "for i in range(20): logging.getLogger().handlers[0].flush()\n"
        "log.info('read again'); logging.shutdown(); log.info('last')\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdin
    assert process.stdout
    assert process.stderr
    with process:
        assert process.stdout.readline() == "done\n"  # nothing has read the log until now
        process.stdin.write("\n")
        process.stdin.close()
        lines = process.stderr.read().splitlines()
    assert process.returncode == 0
    written = [line for line in lines if line.endswith("x")]
    [told] = [line for line in lines if "entries were not written: the log accepted" in line]
    assert MOST_WAITING <= len(written) < 4000
    assert int(told.split(" WARNING ")[1].split()[0]) == 4000 - len(written)
    assert any(line.endswith("read again") for line in lines)
