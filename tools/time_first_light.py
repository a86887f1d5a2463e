"""Time first light: carry out every command of FIRST_LIGHT.md on the practice instrument, in order.

Usage: python -m tools.time_first_light [--until 5] [--json FILE]

It runs the document's commands unchanged in a directory of its own, puts the scenes that it names in front of
the cameras, enters the delays into the rig file as a person would, and restarts the daemon where the document
says so. Columns: wall-clock seconds; processor seconds of the command and of the daemon with its processes;
and the seconds in which none of them could have used a processor, because they waited for lines or a timer.
The rest was lost to other processes. ``--until`` ends after that step; 5 is the calibration.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

from acquire.calibrate import open_calibration
from acquire.config import builtin_directory

if TYPE_CHECKING:
    from collections.abc import Iterator

DOCUMENT = Path(__file__).parents[1] / "acquire" / "calibrate" / "FIRST_LIGHT.md"
PARTS = re.compile(r"^## (\d+)|In front of the lenses: `([\w-]+)`|```sh\n(.*?)```", re.DOTALL | re.MULTILINE)
LISTENS_S = 60.0
LOOK_EVERY_S = 0.03


@dataclass(frozen=True)
class Took:
    """Times of one command."""

    step: int
    command: str
    seconds: float
    processor_s: float
    waited_s: float


class Watch(threading.Thread):
    """Sample repeatedly whether a thread of a child process runs, or could run."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.looks = self.idle = 0
        self._ended = threading.Event()

    def run(self) -> None:
        own = psutil.Process()
        while not self._ended.wait(LOOK_EVERY_S):
            below = own.children(recursive=True)
            self.looks += 1
            self.idle += not any(state in "RD" for each in below for state in states(each.pid))

    def end(self) -> None:
        self._ended.set()
        self.join()


def states(pid: int) -> list[str]:
    """States of a process's threads; none if it has just ended."""
    found = []
    for stat in Path(f"/proc/{pid}/task").glob("*/stat"):
        try:
            found.append(stat.read_text().rpartition(")")[2].split()[0])
        except OSError:
            continue
    return found


class Bench:
    """The practice instrument in a directory, and its daemon."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        scripts = Path(sys.executable).parent
        self.environment = os.environ | {
            "ACQUIRE_SOCKET": str(directory / "c.sock"),
            "XDG_RUNTIME_DIR": str(directory),
            "PATH": f"{scripts}:{os.environ['PATH']}",
        }
        self.daemon: subprocess.Popen[bytes] | None = None
        shutil.copy(builtin_directory() / "rig-practice.toml", directory / "rig.toml")

    def put(self, scene: str) -> None:
        shutil.copy(builtin_directory() / f"{scene}.toml", self.directory / "scene-practice.toml")

    def run(self, words: list[str]) -> None:
        if words[-1] == "&":
            self.serve(words[:-1])
            return
        subprocess.run(words, cwd=self.directory, env=self.environment, check=True, stdout=subprocess.DEVNULL)

    def serve(self, words: list[str]) -> None:
        """Start the daemon, and wait until it answers."""
        with (self.directory / "serve.log").open("ab") as log:
            self.daemon = subprocess.Popen(
                words, cwd=self.directory, env=self.environment, stdout=log, stderr=log
            )
        due = time.monotonic() + LISTENS_S
        while not (self.directory / "c.sock").exists():
            if self.daemon.poll() is not None or time.monotonic() > due:
                raise SystemExit(f"the daemon does not listen: {(self.directory / 'serve.log').read_text()}")
            time.sleep(0.05)

    def enter_delays(self) -> None:
        """Enter the delays as a person would, and restart the daemon."""
        found = open_calibration(self.directory / "cal.zarr").steps["delay"]["rig"]
        rig, table, lines = self.directory / "rig.toml", "", []
        for line in rig.read_text(encoding="utf-8").splitlines():
            table = line.strip("[]") if line.startswith("[") else table
            key = f"{table}.{line.split(' ')[0]}".removeprefix("trigger.")
            lines.append(f"{line.split(' ')[0]} = {found[key]}" if key in found else line)
        rig.write_text("\n".join(lines), encoding="utf-8")
        self.close()
        self.run(["acquire", "serve", "--config", "rig.toml", "&"])

    def processor_s(self) -> float:
        """Processor time of all commands that have ended, and of the daemon with its processes."""
        spent = os.times()
        total = spent.children_user + spent.children_system
        if self.daemon is not None and self.daemon.poll() is None:
            root = psutil.Process(self.daemon.pid)
            for each in (root, *root.children(recursive=True)):
                try:
                    used = each.cpu_times()
                except psutil.NoSuchProcess:
                    continue
                total += used.user + used.system
            total += root.cpu_times().children_user + root.cpu_times().children_system
        return total

    def close(self) -> None:
        if self.daemon is not None:
            self.daemon.terminate()
            self.daemon.wait(60)
            self.daemon = None


def steps(text: str) -> Iterator[tuple[int, str, list[str]]]:
    """Yield the step of the document, the scene to show or "", and the words of a command."""
    step = 0
    for number, scene, block in PARTS.findall(text):
        step = int(number or step)
        if scene:
            yield step, scene, []
        for line in block.splitlines():
            words = shlex.split(line, comments=True)
            if words and words[0] == "acquire":
                yield step, "", words


def timed(bench: Bench, until: int) -> Iterator[Took]:
    for step, scene, words in steps(DOCUMENT.read_text(encoding="utf-8")):
        if step > until:
            return
        if scene:
            bench.put(scene)
            continue
        began, spent, watch = time.monotonic(), bench.processor_s(), Watch()
        watch.start()
        bench.run(words)
        if words[:3] == ["acquire", "calibrate", "delay"]:
            bench.enter_delays()
        watch.end()
        seconds = time.monotonic() - began
        waited_s = seconds * watch.idle / max(watch.looks, 1)
        yield Took(step, " ".join(words[1:]), seconds, max(0.0, bench.processor_s() - spent), waited_s)


def row(name: str, seconds: float, processor_s: float, waited_s: float, about: str) -> str:
    return f"{name:3}  {seconds:7.1f} s  {processor_s:7.1f} s  {waited_s:7.1f} s  {about}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--until", type=int, default=7)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found: list[Took] = []
    with tempfile.TemporaryDirectory() as directory:
        bench = Bench(Path(directory))
        bench.put("scene-practice")
        try:
            for took in timed(bench, options.until):
                spent = took.seconds, took.processor_s, took.waited_s
                print(row(str(took.step), *spent, took.command), flush=True)
                found.append(took)
        finally:
            bench.close()
    total = [sum(getattr(each, name) for each in found) for name in ("seconds", "processor_s", "waited_s")]
    load = os.getloadavg()[0]
    print(row("all", *total, f"at a load of {load:.1f} on {os.cpu_count()} processors"))
    if options.json:
        rows = [asdict(each) for each in found]
        options.json.write_text(json.dumps({"load": load, "commands": rows}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
