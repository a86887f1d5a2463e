"""A real writer in a process of its own, to be killed, limited or watched: ``writer_process.py PATH LINES``.

It says on stdout how many lines it acknowledges, after every commit, and ends with what stopped it.
"""

from __future__ import annotations

import resource
import sys
from pathlib import Path

from store_helpers import Truth, make_spec

from acquire.errors import DataError
from acquire.lines import ARMS
from acquire.store import RecordingWriter, RunCondition

BLOCK_LINES = 24
PIXELS = 512
SPEC = make_spec(pixels=PIXELS, chunk_lines=64, shard_chunks=4, tag_chunks=2, codec="none")
"""Chunks of 64 KiB: some kills fall into the middle of one."""


def say(word: str, number: int) -> None:
    sys.stdout.write(f"{word} {number}\n")
    sys.stdout.flush()


def record(writer: RecordingWriter, lines: int) -> None:
    """Append blocks to either arm in turn, arm b up to five blocks behind, and commit after each pair."""
    truth, first = Truth(SPEC), SPEC.first_line
    for turn, start in enumerate(range(0, lines, BLOCK_LINES)):
        writer.append(truth.block("a", first + start, BLOCK_LINES))
        if turn % 6 == 5:
            for late in range(turn - 5, turn + 1):
                writer.append(truth.block("b", first + late * BLOCK_LINES, BLOCK_LINES))
        writer.commit()
        say("committed", writer.committed_lines)


def main(path: Path, lines: int, file_limit: int) -> None:
    say("ready", 0)
    with RecordingWriter.create(path, SPEC) as writer:
        if file_limit:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_limit, resource.RLIM_INFINITY))
        try:
            record(writer, lines)
        except DataError as error:
            say(f"error {error} ; committed", writer.committed_lines)
            refuse_more(writer)
            writer.seal(RunCondition.ABORTED, "disk full", {})
        else:
            writer.seal(RunCondition.GOOD, "done", {})
        say("sealed", writer.committed_lines)


def refuse_more(writer: RecordingWriter) -> None:
    """After a disk error neither lines nor commits are taken, even if the disk would."""
    for arm in ARMS:
        try:
            writer.append(Truth(SPEC).block(arm, writer.next_line(arm), 1))
        except DataError:
            continue
        raise AssertionError("a line was taken after a disk error")
    try:
        writer.commit()
    except DataError:
        return
    raise AssertionError("a commit was acknowledged after a disk error")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
