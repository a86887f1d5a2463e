"""A night of simulated shifts: operators record while clients stall, flood and lie, and processes are killed.

::

    operator   arm ─▶ record with pre-trigger ─▶ mark ─▶ stop ─▶ cut, reconstruct ─▶ … by socket and by page
    others     browsers that come and go, clients that stall, flood, and send invalid requests
    kill -9    page, daemon, recorder, grabbers, at random; the daemon restarts as under systemd
    in the end every acknowledged line and mark is there, nothing is left behind, nothing has grown

``python -m tools.shifts --minutes 30`` prints what was done and what was wrong. The cameras show a pattern
without zeros, so that a row that was never written is noticed.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from shutil import which
from typing import TYPE_CHECKING, Any

import httpx

from acquire.client import SEALED, Client
from acquire.daemon.states import State
from acquire.errors import AcquireError, NoDaemonError, StateError
from acquire.store import open_recording
from tools.kill_storm import check_recording
from tools.shift_host import Host
from tools.shift_strangers import STRANGERS

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.daemon.messages import Status
    from acquire.store import Recording

WAIT_S = 120.0
JOB_S = 240.0
SHIFT_S = 90.0
"""Time between two changes of shift: the operator leaves, and another one arms again."""
TAKE_S = (1.0, 12.0)
VICTIMS = {"page": 2, "daemon": 1, "recorder": 3, "a": 2, "b": 2}
"""Relative frequency with which each is killed."""
POLL_S = 0.2


@dataclass
class Night:
    """What was done, and what was wrong (nothing, if all is well)."""

    done: Counter[str] = field(default_factory=Counter)
    killed: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    missing: Counter[str] = field(default_factory=Counter)
    strangers: Counter[str] = field(default_factory=Counter)
    lines: int = 0
    marks: list[str] = field(default_factory=list)
    """Acknowledged during a recording, but in no recording."""
    wrong: list[str] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def rows(self) -> list[str]:
        return [
            f"done        {dict(self.done)}",
            f"killed      {self.killed.total()}: {dict(self.killed)}",
            f"strangers   {dict(self.strangers)}",
            f"refused     {dict(self.refused) or 0} (in words, and tried again)",
            f"lines       {self.lines} of each arm; missing {dict(self.missing) or 0} (flagged and listed)",
        ]


@dataclass
class Take:
    """What was acknowledged of a recording: the end of its lines, and its marks."""

    path: Path
    end: int = 0
    marks: list[str] = field(default_factory=list)


class Books:
    """What the daemon has acknowledged, as read by an observer."""

    def __init__(self, host: Host, night: Night) -> None:
        self._host, self._night = host, night
        self.takes: dict[Path, Take] = {}
        self.states: Counter[str] = Counter()

    def run(self, ending: threading.Event) -> None:
        while not ending.wait(POLL_S):
            with contextlib.suppress(NoDaemonError):
                self.note(Client(self._host.socket).status())

    def note(self, status: Status) -> None:
        self.states[status.state] += 1
        self._night.wrong += [
            f"unforeseen failure: {one.text}"
            for one in status.troubles
            if f"unforeseen failure: {one.text}" not in self._night.wrong
        ]
        seen = status.recording
        if seen is None or seen.first_line is None:
            return
        with self._night.lock:
            take = self.takes.setdefault(self._host.first_part(seen.path), Take(seen.path))
            if seen.committed_lines:
                take.end = max(take.end, seen.first_line + seen.committed_lines)


class Operator:
    """An operator who works shift by shift, whatever happens to the instrument."""

    def __init__(self, host: Host, night: Night, books: Books, seed: int) -> None:
        self._host, self._night, self._books = host, night, books
        self._chance = random.Random(seed)
        self._count = 0

    def work(self, until_s: float) -> None:
        shift_s = time.monotonic() + SHIFT_S
        while time.monotonic() < until_s:
            with self._bears("take"):
                self._take()
            if time.monotonic() > shift_s:
                shift_s = time.monotonic() + SHIFT_S
                with self._bears("change of shift"):
                    self._hand_over()

    def _client(self) -> Client:
        """Connect by the socket, or by the page as from another computer."""
        if self._chance.random() < 0.5:
            return Client(self._host.socket)
        return Client(self._host.address, token=self._host.token)

    @contextlib.contextmanager
    def _bears(self, what: str) -> Any:
        """Accept a refusal with a reason; anything else is a defect."""
        try:
            yield
        except AcquireError as error:
            self._night.refused[f"{what}: {type(error).__name__}"] += 1
            if type(error) is AcquireError:  # not a kind of error that a user can act on
                self._night.wrong.append(f"{what}: {error}")
            time.sleep(0.5)
        except Exception as error:  # noqa: BLE001 - it is reported
            self._night.wrong.append(f"{what}: {type(error).__name__}: {error}")
            time.sleep(0.5)

    def _take(self) -> None:
        self._ready()
        path = self._host.home / f"take-{self._count}.zarr"
        self._count += 1
        self._client().start(path, pre_s=self._chance.choice([0.0, 0.0, 0.5, 1.0]))
        with self._night.lock:
            take = self._books.takes.setdefault(path, Take(path))
        try:
            self._record(take)
        finally:
            self._end()
        self._night.done["takes"] += 1
        self._look_at(take)

    def _record(self, take: Take) -> None:
        end_s = time.monotonic() + self._chance.uniform(*TAKE_S)
        while time.monotonic() < end_s:
            time.sleep(self._chance.uniform(0.1, 1.5))
            text = f"mark {self._night.done['marks']} of {take.path.stem}."
            with self._bears("mark"):
                self._client().mark(text)
                self._night.done["marks"] += 1
                take.marks.append(text)

    def _end(self) -> None:
        """Stop the recording, whatever has died in the meantime."""
        deadline = time.monotonic() + WAIT_S
        while time.monotonic() < deadline:
            with self._bears("stop"):
                client = Client(self._host.socket)
                status = client.status()
                self._books.note(status)
                if status.state is State.RECORDING:
                    self._client().stop()
                client.wait({*SEALED, State.FAULTED}, WAIT_S)
                return
        self._night.wrong.append(f"a recording could not be stopped within {WAIT_S:g} s")

    def _ready(self) -> None:
        """Arm the instrument from any state."""
        deadline = time.monotonic() + WAIT_S
        while time.monotonic() < deadline:
            with self._bears("arm"):
                client = self._client()
                state = client.status().state
                if state is State.FAULTED:
                    self._night.done["faults cleared"] += 1
                    client.disarm()
                elif state in (State.RECORDING, State.DRAINING):
                    self._end()
                elif state is State.ARMED:
                    return
                else:
                    client.arm(force=True)
        raise StateError(f"not armed within {WAIT_S:g} s")

    def _hand_over(self) -> None:
        client = self._client()
        client.disarm()
        self._night.done["changes of shift"] += 1
        for path in sorted(self._host.home.glob("take-*.zarr"))[:-6]:
            self._check_and_remove(path)

    def finish(self) -> None:
        """Check all remaining recordings."""
        self._ready()
        Client(self._host.socket).disarm()
        until(lambda: not self._host.unsealed())
        for path in sorted(self._host.home.glob("take-*.zarr")):
            self._check_and_remove(path)

    # ---- what was recorded

    def _look_at(self, take: Take) -> None:
        """As an operator does on the page: cut a range, reconstruct it, fetch the picture."""
        kind = self._chance.choice(["cut", "reconstruct", "preview", "picture", "nothing"])
        if kind == "nothing":
            return
        with self._bears(kind), self._page() as page:
            name = take.path.name
            found = page.get(f"/api/recordings/{name}").json()
            if found.get("state") != "sealed" or found["lines"] < 100:
                return
            if kind == "picture":
                assert page.get(f"/api/recordings/{name}/picture").content[1:4] == b"PNG"
            else:
                stretch = {"first_line": found["first_line"], "lines": min(64, found["lines"])}
                self._job(page, {"kind": kind, "recording": name, "preset": "fast", **stretch})
            self._night.done[kind] += 1

    @contextlib.contextmanager
    def _page(self) -> Any:
        """Call the API of the page; a page that was just killed is not a defect."""
        headers = {"Authorization": f"Bearer {self._host.token}"}
        try:
            with httpx.Client(base_url=self._host.address, headers=headers, timeout=WAIT_S) as page:
                yield page
        except httpx.TransportError as error:
            raise NoDaemonError(f"the page went away: {error}") from error

    def _job(self, page: httpx.Client, request: dict[str, Any]) -> None:
        answer = page.post("/api/jobs", json=request)
        if answer.status_code >= 400:
            raise StateError(f"{request['kind']} was refused: {answer.json()['message']}")
        number, deadline = answer.json()["id"], time.monotonic() + JOB_S
        while True:
            (job,) = [one for one in page.get("/api/jobs").json() if one["id"] == number] or [None]
            if job is None:
                raise NoDaemonError("the page was restarted, and its jobs with it")
            if job["state"] == "done":
                made = self._host.home / job["result"]
                assert made.exists(), made
                shutil.rmtree(made) if made.is_dir() else made.unlink()
                return
            if job["state"] == "failed":
                raise StateError(f"{request['kind']} failed: {job['text']}")
            if time.monotonic() > deadline:
                page.delete(f"/api/jobs/{number}")
                raise StateError(f"{request['kind']} took longer than {JOB_S:g} s")
            time.sleep(0.3)

    def _check_and_remove(self, path: Path) -> None:
        """Check a recording and its further segments: rows, ledgers, and what was acknowledged."""
        if self._host.first_part(path) != path:
            return
        with self._night.lock:
            take = self._books.takes.pop(path, None)
        try:
            parts = [open_recording(path)]
            parts += [open_recording(segment.path) for segment in parts[0].segments]
        except AcquireError as error:
            self._night.wrong.append(f"{path.name}: {error}")
            return
        wrong = [f"{each.path.name}: {fault}" for each in parts for fault in check_recording(each.path)]
        wrong += [f"{path.name}: {fault}" for fault in self._held(parts, take)]
        self._night.wrong += wrong
        self._night.lines += sum(each.lines for each in parts)
        for each in parts:
            self._night.missing.update({gap.cause: gap.count for gap in each.gaps})
            if not wrong:
                shutil.rmtree(each.path)
        self._night.done["recordings checked"] += 1

    def _held(self, parts: list[Recording], take: Take | None) -> list[str]:
        """Acknowledged lines and marks that are missing."""
        wrong, end = [], parts[0].first_line
        for each in parts:
            if each.first_line > end:
                wrong.append(f"lines {end} to {each.first_line} are in no part")
            end = each.first_line + each.lines
        if take is None:
            return wrong
        if take.end > end:
            wrong.append(f"lines to {take.end} were acknowledged, it ends at {end}")
        texts = {event.text for each in parts for event in each.events}
        lost = [text for text in take.marks if text not in texts]
        self._night.marks += lost
        return wrong + [f"{text!r} was acknowledged, and is in no part" for text in lost]


class Killer:
    """Kill processes with kill -9 at random moments."""

    def __init__(self, host: Host, night: Night, seed: int, every_s: float) -> None:
        self._host, self._night, self._every_s = host, night, every_s
        self._chance = random.Random(seed)

    def run(self, ending: threading.Event) -> None:
        while not ending.wait(self._chance.expovariate(1 / self._every_s)):
            (name,) = self._chance.choices(list(VICTIMS), list(VICTIMS.values()))
            pid = self._host.page_pid if name == "page" else self._host.pid if name == "daemon" else None
            if pid is None and name not in ("page", "daemon"):
                with contextlib.suppress(AcquireError):
                    pid = Client(self._host.socket).status().processes.get(name)
            if pid is None:
                continue
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
                self._night.killed[name] += 1


def until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + WAIT_S
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"waited {WAIT_S:g} s")
        time.sleep(0.1)


def night_of(home: Path, minutes: float, seed: int, kill_s: float, *, browser: bool) -> tuple[Night, Host]:
    """Work for ``minutes`` with all disturbances; then check all recordings."""
    night, ending, strangers_out = Night(), threading.Event(), threading.Event()
    host = Host(home)
    books, killer = Books(host, night), Killer(host, night, seed + 1, kill_s)
    operator = Operator(host, night, books, seed)
    others = [
        threading.Thread(target=work, args=(host, night.strangers, random.Random(seed + k), strangers_out))
        for k, (name, work) in enumerate(STRANGERS.items(), 2)
        if name != "browser" or browser
    ]
    mine = [threading.Thread(target=work, args=(ending,)) for work in (books.run, killer.run)]
    keeping = threading.Thread(target=host.keep, args=(strangers_out,))
    for thread in (*others, *mine, keeping):
        thread.start()
    try:
        until_s = time.monotonic() + 60 * minutes
        operator.work(until_s)
        ending.set()
        for thread in mine:
            thread.join()
        until(host.answers)
        operator.finish()
        strangers_out.set()
        for thread in (*others, keeping):
            thread.join()
        night.wrong += host.failures_in_log()
        night.wrong += host.judge()
    finally:
        ending.set()
        strangers_out.set()
        for thread in (*others, *mine, keeping):
            thread.join(WAIT_S)
        night.wrong += host.close()
    return night, host


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kill-s", type=float, default=25.0, help="mean time between two kills")
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--no-browser", action="store_true")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    home = Path(tempfile.mkdtemp(prefix="acquire-night-", dir=options.out))
    begun_s = time.monotonic()
    browser = which("chromium") is not None and not options.no_browser
    night, host = night_of(home, options.minutes, options.seed, options.kill_s, browser=browser)
    print("\n".join(night.rows() + host.rows()))
    print(f"wrong       {len(night.wrong)}")
    print("\n".join(night.wrong[:50]))
    print(
        f"{(time.monotonic() - begun_s) / 60:.1f} minutes, seed {options.seed}, load {os.getloadavg()[1]:.1f}"
    )
    if night.wrong:
        print(f"what is left to look at: {home}")
        return 1
    shutil.rmtree(home)
    return 0


if __name__ == "__main__":
    sys.exit(main())
