"""Make wheel and source distribution, and report files that are missing or should not be in them.

``python tools/packages.py --out dist`` makes them from a checkout: from all files that git does not ignore,
committed or not. The wheel is made from the source distribution, as pip does; a wheel made from the checkout
must hold the same files. All are packed with the hatchling that is installed here.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
ADDED = {"PKG-INFO"}
"""Files that the build backend adds to the source distribution."""
LONGEST_S = 600


@dataclass(frozen=True)
class Packages:
    """The packages that were made."""

    sdist: Path
    wheel: Path
    wheel_of_checkout: Path


def make(out: Path, root: Path = ROOT) -> Packages:
    """Make the source distribution, and wheels from it and from the checkout. Raises CalledProcessError."""
    aside = out / "of-checkout"
    _build(root, out)
    _build(root, aside, "--wheel")
    (sdist,), (wheel,), (other,) = out.glob("*.tar.gz"), out.glob("*.whl"), aside.glob("*.whl")
    return Packages(sdist, wheel, other)


def _build(root: Path, out: Path, *options: str) -> None:
    words = ("-m", "build", "--no-isolation", "--outdir", str(out), *options, str(root))
    subprocess.run(
        [sys.executable, *words],
        check=True,
        timeout=LONGEST_S,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )


def files_of_wheel(path: Path) -> set[str]:
    with zipfile.ZipFile(path) as file:
        return {name for name in file.namelist() if not name.endswith("/")}


def files_of_sdist(path: Path) -> set[str]:
    """Files below the one folder to which it unpacks."""
    with tarfile.open(path) as file:
        return {entry.name.partition("/")[2] for entry in file if not entry.isdir()}


def files_of_git(root: Path = ROOT) -> set[str]:
    """Files that git tracks, or would track if they were added."""
    words = ("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard")
    listed = subprocess.run(words, cwd=root, check=True, capture_output=True, text=True, timeout=LONGEST_S)
    return {name for name in listed.stdout.split("\0") if name and (root / name).exists()}


def faults(made: Packages, root: Path = ROOT) -> list[str]:
    """Describe the defects of the packages; the checkout must be a git checkout."""
    packed, known = files_of_sdist(made.sdist) - ADDED, files_of_git(root)
    wheel, other = files_of_wheel(made.wheel), files_of_wheel(made.wheel_of_checkout)
    program = {name for name in known if name.startswith("acquire/")}
    program |= {f"acquire/{name}" for name in known if name.startswith("configs/")}
    inside = {name for name in wheel if ".dist-info/" not in name}
    differences = {
        "the source distribution lacks": known - packed,
        "the source distribution has, and the checkout does not": packed - known,
        "the wheel lacks": program - inside,
        "the wheel has, and the program does not": inside - program,
        "the wheel from the checkout and the one from the source distribution differ in": wheel ^ other,
    }
    return [f"{what} {_few(names)}" for what, names in differences.items() if names]


def _few(names: set[str], most: int = 5) -> str:
    first = sorted(names)[:most]
    return ", ".join(first) + (f" and {len(names) - most} more" if len(names) > most else "")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=ROOT / "dist", help="directory for the packages (default: dist)"
    )
    out = parser.parse_args().out
    with tempfile.TemporaryDirectory() as home:
        try:
            made = make(Path(home))
        except subprocess.CalledProcessError as error:
            print(f"the packages cannot be made:\n{error.stdout.decode(errors='replace')}", file=sys.stderr)
            return 1
        wrong = faults(made)
        for text in wrong:
            print(text, file=sys.stderr)
        if wrong:
            return 1
        out.mkdir(parents=True, exist_ok=True)
        for path in (made.sdist, made.wheel):
            print(f"{shutil.copy(path, out)}, {path.stat().st_size / 1e6:.2f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
