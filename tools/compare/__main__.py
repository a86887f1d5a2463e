"""Write the same stream with other libraries' writers and ours, one after the other, in one run.

``python -m tools.compare --out DIR`` makes an environment per peer (pip, kept in ``--environments``), has
each write the same blocks at full speed, and prints rates, processor time, and ratios to a bare O_DIRECT
write and to ours. Rounds alternate, and the best of each peer counts, since other load can only slow it.
odin-data is not included, because it is C++ and in no package index.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
PEERS: dict[str, tuple[str, ...] | None] = {
    "bare": None,
    "acquire": None,
    "tensorstore": ("tensorstore==0.1.86",),
    "acquire_zarr": ("acquire-zarr==0.10.0",),
    "zarr": ("zarr==3.1.6",),
    "ndtiff": ("ndstorage==0.1.18",),
}
"""Peer → what pip installs for it; None: this environment."""
GIGABYTES = 2.0
BLOCK_GB = 1024 * 4640 / 1e9
LIMIT_S = 300


def interpreter(peer: str, environments: Path) -> Path:
    """Python of the peer's environment, which is made if it does not exist."""
    packages = PEERS[peer]
    if packages is None:
        return Path(sys.executable)
    home = environments / peer
    if not (home / "ready").exists():
        venv.create(home, with_pip=True, clear=True)
        subprocess.run([home / "bin" / "pip", "install", "-q", "numpy", *packages], check=True)
        (home / "ready").touch()
    return home / "bin" / "python"


def run(peer: str, environments: Path, out: Path, gigabytes: float) -> dict[str, Any]:
    """Let one peer write, and remove what it wrote."""
    python = interpreter(peer, environments)
    directory = Path(tempfile.mkdtemp(prefix=f"compare-{peer}-", dir=out))
    command = [python, HERE / f"peer_{peer}.py", directory, str(round(gigabytes / 2 / BLOCK_GB))]
    paths = os.pathsep.join([str(HERE), str(HERE.parent.parent)])
    try:
        ended = subprocess.run(
            command,
            env=os.environ | {"PYTHONPATH": paths},
            capture_output=True,
            text=True,
            check=False,
            timeout=LIMIT_S,
        )
        if ended.returncode != 0:
            raise SystemExit(f"{peer}: {ended.stderr}")
        result: dict[str, Any] = json.loads(ended.stdout.strip().splitlines()[-1])
        return result
    finally:
        shutil.rmtree(directory, ignore_errors=True)


def table(found: dict[str, list[dict[str, Any]]]) -> str:
    """Markdown table of the best rate and the least processor time of each peer's rounds."""
    best = {
        peer: {
            "rate": max(one["mb_per_s"] for one in rounds),
            "cpu": min(one["cpu_s_per_gb"] for one in rounds),
            "slowest": min(one["slowest_ms"] for one in rounds),
            "memory": min(one["memory_mb"] for one in rounds),
        }
        for peer, rounds in found.items()
    }
    rows = [
        "| writer | MB/s | of bare | ours faster by | CPU s/GB | ours needs | slowest append | memory |",
        "|---|---|---|---|---|---|---|---|",
    ]
    ours, bare = best["acquire"], best["bare"]
    for peer, one in best.items():
        rows.append(
            f"| {peer.replace('_', '-')} | {one['rate']:.0f} | {one['rate'] / bare['rate']:.2f}"
            f" | {ours['rate'] / one['rate']:.1f} | {one['cpu']:.2f} | {ours['cpu'] / one['cpu']:.2f}"
            f" | {one['slowest']:.0f} ms | {one['memory']:.0f} MB |"
        )
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--environments", type=Path, default=Path.home() / ".cache" / "acquire-compare")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--gigabytes", type=float, default=GIGABYTES)
    parser.add_argument(
        "--peer", action="append", choices=[name for name in PEERS if name not in ("bare", "acquire")]
    )
    options = parser.parse_args()
    peers = [
        "bare",
        "acquire",
        *(options.peer or [name for name in PEERS if name not in ("bare", "acquire")]),
    ]
    found: dict[str, list[dict[str, Any]]] = {peer: [] for peer in peers}
    for number in range(options.rounds):
        for peer in peers:
            result = run(peer, options.environments, options.out, options.gigabytes)
            found[peer].append(result)
            print(f"round {number + 1}: {peer}: {result['mb_per_s']:.0f} MB/s", file=sys.stderr)
    print(table(found))


if __name__ == "__main__":
    main()
