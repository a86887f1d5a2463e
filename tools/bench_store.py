"""Cost of the store compared with the bare disk: writing, packing, and cutting a segment from an hour.

``python tools/bench_store.py --out DIR`` alternates a bare O_DIRECT write of the same bytes with every case,
so that each ratio is within one run. Lines are 4640 pixels of 8 bit, both arms, with the photon noise of a
sensor whose white is 20 000 electrons; blocks like those of a ring, in page-aligned memory.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from acquire.clock import ClockFit
from acquire.codes import ConstantCode
from acquire.config.recording import usual_chunk_lines, usual_tag_chunks
from acquire.lines import ARMS, LineTable, TaggedBlock
from acquire.store import RecordingSpec, RecordingWriter, RunCondition, open_recording
from acquire.store.codecs import encode
from acquire.store.files import DISK
from acquire.store.pages import PAGE, aligned_bytes, open_direct, page_up
from acquire.store.retention import shard_files
from acquire.store.shape import CODECS, Codec, crc32c, shard_key
from tools.results import Run, add_option, recorded

PIXELS, SHARD_CHUNKS, SUBSTEPS = 4640, 240, 3
LINE_RATE_HZ = 100_000
CHUNK_LINES = usual_chunk_lines(PIXELS, LINE_RATE_HZ)
COMMIT_S = 0.1
BLOCK_LINES = 1024
HOUR_LINES = 3600 * LINE_RATE_HZ
SHARD_LINES = CHUNK_LINES * SHARD_CHUNKS
MIDDLE = HOUR_LINES // 2 // SHARD_LINES * SHARD_LINES
CUT_LINES = 263
MEMORY_BYTES = 2**30
"""Bytes of lines whose packing is measured: more than the largest shared cache of a processor."""
WHITE_ELECTRONS = 20_000
CAMERA = {"white_dn": 255, "black_level_dn": 0.0, "responsivity_dn": 1.0}


@dataclass(frozen=True)
class Pace:
    """MB of lines per second, and processor seconds per GB of lines."""

    mb_s: float
    cpu_s_per_gb: float


def spec(codec: str = "none", fsync: str = "seal") -> RecordingSpec:
    return RecordingSpec(
        run_id="bench",
        stages=PIXELS,
        substeps=SUBSTEPS,
        pixels=PIXELS,
        dtype="uint8",
        first_line=0,
        clock=ClockFit(90_000_000, 0, 0),
        code=ConstantCode(1).to_attrs(),
        substep_ticks=300,
        trigger={},
        cameras={"a": CAMERA, "b": CAMERA},
        config={},
        chunk_lines=CHUNK_LINES,
        shard_chunks=SHARD_CHUNKS,
        tag_chunks=usual_tag_chunks(CHUNK_LINES, SHARD_CHUNKS, LINE_RATE_HZ, COMMIT_S),
        codec=codec,
        fsync=fsync,
        commit_lines=round(COMMIT_S * LINE_RATE_HZ),
        reserve_bytes=0,
    )


def block_memory(count: int = 8) -> list[np.ndarray]:
    """Page-aligned blocks of lines like those of a camera."""
    generator = np.random.default_rng(0)
    blocks = []
    for _ in range(count):
        memory = aligned_bytes(BLOCK_LINES * PIXELS)[: BLOCK_LINES * PIXELS]
        lines = memory.reshape(BLOCK_LINES, PIXELS)
        along, across = np.arange(BLOCK_LINES)[:, None], np.arange(PIXELS)
        light = 100 * (1.2 + np.sin(across / 300)) * generator.uniform(0.8, 1, (BLOCK_LINES, 1)) + along % 7
        noise = generator.normal(0, 1, light.shape) * np.sqrt(light * 255 / WHITE_ELECTRONS)
        lines[:] = np.clip(np.rint(light + noise), 0, 255)
        blocks.append(lines)
    return blocks


def block(arm: str, number: int, pixels: np.ndarray) -> TaggedBlock:
    line = np.arange(number * BLOCK_LINES, (number + 1) * BLOCK_LINES, dtype=np.uint64)
    return TaggedBlock(
        arm=arm,
        first_line=int(line[0]),
        pixels=pixels,
        flags=np.zeros(len(line), np.uint16),
        tags=LineTable(
            code_index=SUBSTEPS * line,
            code=np.full(len(line), 7, np.uint8),
            tick=900 * line,
            time_ns=(10_000 * line).astype(np.int64),
        ),
    )


def paced(work: Callable[[], None], size: int) -> Pace:
    begun, used = time.perf_counter(), time.process_time()
    work()
    seconds = time.perf_counter() - begun
    return Pace(size / seconds / 1e6, (time.process_time() - used) / (size / 1e9))


def bare(directory: Path, memory: list[np.ndarray], count: int) -> Pace:
    """Write one file with direct I/O from the same memory, in pieces of the same size."""
    path = directory / ".bare"
    path.touch()
    fd, size = open_direct(path), memory[0].nbytes // PAGE * PAGE

    def work() -> None:
        for number in range(count):
            os.pwrite(fd, memory[number % len(memory)].data.cast("B")[:size], number * size)

    try:
        return paced(work, count * size)
    finally:
        os.close(fd)
        path.unlink()


def written(directory: Path, memory: list[np.ndarray], count: int, codec: str, fsync: str) -> Pace:
    """Write a recording of both arms, ``count`` blocks in total, until its last line is committed."""
    path = directory / ".bench-store.zarr"
    blocks = [
        [block(arm, number, memory[number % len(memory)]) for arm in ARMS]
        for number in range(count // len(ARMS))
    ]
    with RecordingWriter.create(path, spec(codec, fsync)) as writer:

        def work() -> None:
            for pair in blocks:
                for one in pair:  # as the recorder does: the arms alternate between preparing and writing
                    writer.give_back(one.arm)
                    writer.append(one, lent=True)
            writer.commit()

        pace = paced(work, count * memory[0].nbytes)
        writer.seal(RunCondition.GOOD, "done", {})
    DISK.remove_tree(path)
    return pace


def write_cases(directory: Path, gigabytes: float, run: Run) -> None:
    memory = block_memory()
    count = max(2, int(gigabytes * 1e9 / memory[0].nbytes) // 2 * 2)
    cases = [("none", "seal"), ("none", "commit"), ("lz4", "seal"), ("zstd", "seal")]
    for codec, fsync in cases:
        disk = bare(directory, memory, count)
        ours = written(directory, memory, count, codec, fsync)
        print(
            f"writer, codec {codec}, fsync at {fsync}: {ours.mb_s:.0f} MB/s, {ours.cpu_s_per_gb:.3f} s "
            f"per GB; {ours.mb_s / disk.mb_s:.2f} of the bare write ({disk.mb_s:.0f} MB/s, "
            f"{disk.cpu_s_per_gb:.3f} s per GB)"
        )
        run.add(
            f"write, codec {codec}, fsync at {fsync}",
            mb_s=ours.mb_s,
            cpu_s_per_gb=ours.cpu_s_per_gb,
            of_the_bare_write=ours.mb_s / disk.mb_s,
            bare_write_mb_s=disk.mb_s,
            bare_write_cpu_s_per_gb=disk.cpu_s_per_gb,
        )


def codec_cases(run: Run) -> None:
    """Pack chunks from memory, as in a recording: more than any cache holds, each packed once per pass.

    Processor time is used, which depends less on other load. ``cached_mb_s`` is for one chunk again and again
    from the cache, as in `measure_codec`: a checksum is many times faster there, but never in a recording.
    """
    lines = np.resize(np.concatenate(block_memory()), (MEMORY_BYTES // PIXELS, PIXELS))
    chunks = lines[: len(lines) // CHUNK_LINES * CHUNK_LINES].reshape(-1, CHUNK_LINES, PIXELS)
    reading = _pace_mb_s(chunks, lambda chunk: chunk.reshape(-1).view(np.uint64).max())
    print(f"reading the lines alone, one thread: {reading:.0f} MB/s")
    run.add("reading the lines alone, one thread", mb_s=reading, ratio=None, cached_mb_s=None)
    for codec in CODECS:

        def pack(chunk: np.ndarray, codec: Codec = codec) -> None:
            crc32c(encode(chunk, codec).data)

        mb_s = _pace_mb_s(chunks, pack)
        cached = _pace_mb_s([chunks[0]] * 64, pack)
        ratio = chunks[0].nbytes / len(encode(chunks[0], codec))
        print(
            f"codec {codec} with crc32c, one thread: {mb_s:.0f} MB/s, x {ratio:.2f}; "
            f"of one chunk in the cache {cached:.0f} MB/s"
        )
        run.add(f"codec {codec} with crc32c, one thread", mb_s=mb_s, ratio=ratio, cached_mb_s=cached)


def _pace_mb_s(chunks: Sequence[np.ndarray] | np.ndarray, work: Callable[[np.ndarray], object]) -> float:
    """MB per second of the thread's processor time; the best of three passes."""
    seconds = []
    for _ in range(3):
        begun = time.thread_time()
        for chunk in chunks:
            work(chunk)
        seconds.append(time.thread_time() - begun)
    return len(chunks) * chunks[0].nbytes / min(seconds) / 1e6


def hour(directory: Path) -> Path:
    """Make a recording of an hour: one shard in its middle has lines, the others are only names of files."""
    path = directory / ".bench-hour.zarr"
    lines = block_memory(1)[0]
    small = replace(spec(), first_line=MIDDLE)
    with RecordingWriter.create(path, small) as writer:
        for first in range(MIDDLE, MIDDLE + SHARD_LINES, BLOCK_LINES):
            for arm in ARMS:
                writer.append(block(arm, first // BLOCK_LINES, lines))
        writer.seal(RunCondition.GOOD, "done", {})
    _stretch(path, small.first_line)
    return path


def _stretch(path: Path, first_line: int) -> None:
    """Extend the recording to an hour of rows, with its only shard in the middle."""
    shard, shards = first_line // SHARD_LINES, HOUR_LINES // SHARD_LINES
    root = path / "zarr.json"
    document = json.loads(root.read_bytes())
    document["attributes"]["first_line"] = 0
    for name, node in document["consolidated_metadata"]["metadata"].items():
        if node["node_type"] != "array" or name.split("/")[0] not in ARMS:
            continue
        axes = len(node["shape"])
        node["shape"][0] = HOUR_LINES
        for other in range(shards + 1):
            file = path / name / shard_key(other, axes)
            file.parent.mkdir(parents=True, exist_ok=True)
            if other not in (0, shard):
                file.touch()
        (path / name / shard_key(0, axes)).rename(path / name / shard_key(shard, axes))
    root.write_text(json.dumps(document))


def cut_case(directory: Path, run: Run) -> None:
    path = hour(directory)
    try:
        starts = np.random.default_rng(1).integers(0, SHARD_LINES - CUT_LINES, 9)
        times = [_cut_cold(path, MIDDLE + int(start)) for start in starts]
    finally:
        DISK.remove_tree(path)
    names = ("open and cut", "cut alone", "the same, warm", "others, cold", "bare O_DIRECT read of chunks")
    for name, values in zip(names, zip(*times, strict=True), strict=True):
        found = f"median {np.median(values):.1f} ms, worst {max(values):.1f} ms"
        print(f"{CUT_LINES} lines of an hour, a fresh process, {name}: {found}")
        run.add(f"{CUT_LINES} lines of an hour, {name}", median_ms=np.median(values), worst_ms=max(values))


def _cut_cold(path: Path, line: int) -> list[float]:
    """Measure in a separate process, with the files out of the page cache: ms to open and cut, to cut, to cut
    the same lines again, to cut others after evicting the files again, and to read only their chunks.
    """
    _chill(path)
    command = [sys.executable, __file__, "--cut", str(path), str(line)]
    return list(
        map(float, subprocess.run(command, check=True, capture_output=True, text=True).stdout.split())
    )


def _chill(path: Path) -> None:
    """Evict the files of the lines from the page cache."""
    for file in shard_files(path, MIDDLE // SHARD_LINES):
        fd = os.open(file, os.O_RDONLY)
        os.fsync(fd)
        os.posix_fadvise(fd, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(fd)


def cut_here(path: Path, line: int) -> None:
    begun = time.perf_counter()
    recording = open_recording(path)
    opened = time.perf_counter()
    recording.cut(line, CUT_LINES)
    cut = time.perf_counter()
    recording.cut(line, CUT_LINES)
    again = time.perf_counter()
    _chill(path)
    other = MIDDLE + (line - MIDDLE + SHARD_LINES // 2) % (SHARD_LINES - CUT_LINES)
    chilled = time.perf_counter()
    recording.cut(other, CUT_LINES)
    others = time.perf_counter()
    bare_s = _bare_read(path, other)
    seconds = cut - begun, cut - opened, again - cut, others - chilled, bare_s
    print(*(1e3 * value for value in seconds))


def _bare_read(path: Path, line: int) -> float:
    """Read the chunks that the cut needs, of both arms, one after the other, past the page cache."""
    row = line - MIDDLE
    chunks = range(row // CHUNK_LINES, -(-(row + CUT_LINES) // CHUNK_LINES))
    memory = aligned_bytes(CHUNK_LINES * PIXELS)
    begun = time.perf_counter()
    for arm in ARMS:
        fd = os.open(path / arm / "lines" / shard_key(MIDDLE // SHARD_LINES, 2), os.O_RDONLY | os.O_DIRECT)
        for chunk in chunks:
            os.preadv(fd, [memory.data], PAGE + chunk * page_up(CHUNK_LINES * PIXELS + 4))
        os.close(fd)
    return time.perf_counter() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--gigabytes", type=float, default=2.0, help="written per case")
    parser.add_argument("--only", choices=("write", "codecs", "cut"), help="one of the three parts")
    parser.add_argument("--cut", nargs=2, metavar=("RECORDING", "LINE"), help=argparse.SUPPRESS)
    add_option(parser)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.cut:
        cut_here(Path(options.cut[0]), int(options.cut[1]))
        return
    with recorded("bench_store", keep=options.record) as run:
        if options.only in (None, "write"):
            write_cases(options.out, options.gigabytes, run)
        if options.only in (None, "codecs"):
            codec_cases(run)
        if options.only in (None, "cut"):
            cut_case(options.out, run)


if __name__ == "__main__":
    main()
